# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The functions of FMI 2.0 and 3.0 in C99, with declarations of their own.

The types are those of the standard's headers (fmi-standard.org), so that a binary fits every
importer, and the sources compile without its headers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Final

Functions = Mapping[str, tuple[str, str]]
"""By name: arguments behind the instance, and the body."""

_SECOND: Final[Functions] = {
    "SetDebugLogging": ("int on, size_t count, const char *const *categories", "return STATUS_OK;"),
    "SetupExperiment": (
        "int tolerant, double tolerance, double start, int stops, double stop",
        "c->model.v[0] = start; return STATUS_OK;",
    ),
    "EnterInitializationMode": ("", "return STATUS_OK;"),
    "GetReal": ("const Reference *vr, size_t count, double *values", "return get_reals(c, vr, count, values);"),
    "SetReal": ("const Reference *vr, size_t count, const double *values", "return set_reals(c, vr, count, values);"),
    "GetInteger": ("const Reference *vr, size_t count, int *values", "return get_status(c, vr, count, values);"),
    **{
        f"{what}{kind}": (f"const Reference *vr, size_t count, {const}{kinds} *values", "return unsupported(c, count);")
        for what, const in (("Get", ""), ("Set", "const "))
        for kind, kinds in (("Integer", "int"), ("Boolean", "int"), ("String", "char *"))
        if what + kind != "GetInteger"
    },
    "DeSerializeFMUstate": (
        "const unsigned char *bytes, size_t size, void **state",
        "if (size != sizeof c->model) {\n        return restore(c, NULL, 0);\n    }\n"
        "    if (copy_state(c, state) != STATUS_OK) {\n        return STATUS_ERROR;\n    }\n"
        "    memcpy(*state, bytes, size);\n    return STATUS_OK;",
    ),
    "GetDirectionalDerivative": (
        "const Reference *unknowns, size_t count, const Reference *knowns, size_t n, "
        "const double *seed, double *values",
        "return unsupported(c, 1);",
    ),
    "NewDiscreteStates": ("EventInfo *info", "memset(info, 0, sizeof *info); return update(c, &info->values_changed);"),
    "CompletedIntegratorStep": (
        "int kept, int *event_mode, int *terminate",
        "*event_mode = 0; *terminate = 0; return STATUS_OK;",
    ),
    "GetDerivatives": ("double *values, size_t count", "return get_rates(c, values, count);"),
    "SetRealInputDerivatives": (
        "const Reference *vr, size_t count, const int *orders, const double *values",
        "return unsupported(c, count);",
    ),
    "GetRealOutputDerivatives": (
        "const Reference *vr, size_t count, const int *orders, double *values",
        "return unsupported(c, count);",
    ),
    "DoStep": ("double time, double span, int kept", "return do_step(c, time, span);"),
    "CancelStep": ("", "return unsupported(c, 1);"),
    "GetStatus": ("int kind, Status *value", "return unsupported(c, 1);"),
    "GetRealStatus": (
        "int kind, double *value",
        "if (kind != 2) {\n        return unsupported(c, 1);\n    }\n"
        "    *value = c->model.v[0];\n    return STATUS_OK;",
    ),
    "GetIntegerStatus": ("int kind, int *value", "return unsupported(c, 1);"),
    "GetBooleanStatus": (
        "int kind, int *value",
        "if (kind != 3) {\n        return unsupported(c, 1);\n    }\n    *value = 0;\n    return STATUS_OK;",
    ),
    "GetStringStatus": ("int kind, const char **value", "return unsupported(c, 1);"),
}
_NUMBERS: Final = {
    "Float32": "float",
    "Int8": "int8_t",
    "UInt8": "uint8_t",
    "Int16": "int16_t",
    "UInt16": "uint16_t",
    "UInt32": "uint32_t",
    "Int64": "int64_t",
    "UInt64": "uint64_t",
    "Boolean": "bool",
    "String": "char *",
}
_MANY: Final = "const Reference *vr, size_t count, "
_THIRD: Final[Functions] = {
    "SetDebugLogging": ("bool on, size_t count, const char *const *categories", "return STATUS_OK;"),
    "EnterInitializationMode": (
        "bool tolerant, double tolerance, double start, bool stops, double stop",
        "c->model.v[0] = start; return STATUS_OK;",
    ),
    "GetFloat64": (
        _MANY + "double *values, size_t size",
        "if (size != count) {\n        return unsupported(c, 1);\n    }\n    return get_reals(c, vr, count, values);",
    ),
    "SetFloat64": (
        _MANY + "const double *values, size_t size",
        "if (size != count) {\n        return unsupported(c, 1);\n    }\n    return set_reals(c, vr, count, values);",
    ),
    "GetInt32": (
        _MANY + "int32_t *values, size_t size",
        "if (size != count) {\n        return unsupported(c, 1);\n    }\n    return get_status(c, vr, count, values);",
    ),
    "SetInt32": (_MANY + "const int32_t *values, size_t size", "return unsupported(c, count);"),
    **{
        f"{what}{kind}": (f"{_MANY}{const}{kinds} *values, size_t size", "return unsupported(c, count);")
        for what, const in (("Get", ""), ("Set", "const "))
        for kind, kinds in _NUMBERS.items()
    },
    "GetBinary": (_MANY + "size_t *sizes, const unsigned char **values, size_t size", "return unsupported(c, count);"),
    "SetBinary": (
        _MANY + "const size_t *sizes, const unsigned char *const *values, size_t size",
        "return unsupported(c, count);",
    ),
    "GetClock": (_MANY + "bool *values", "return unsupported(c, count);"),
    "SetClock": (_MANY + "const bool *values", "return unsupported(c, count);"),
    "GetNumberOfVariableDependencies": ("Reference vr, size_t *count", "return unsupported(c, 1);"),
    "GetVariableDependencies": (
        "Reference vr, size_t *elements, Reference *independents, size_t *others, int *kinds, size_t count",
        "return unsupported(c, 1);",
    ),
    "DeserializeFMUState": _SECOND["DeSerializeFMUstate"],
    **{
        f"Get{kind}Derivative": (
            "const Reference *unknowns, size_t count, const Reference *knowns, size_t n, "
            "const double *seed, size_t seeds, double *values, size_t size",
            "return unsupported(c, 1);",
        )
        for kind in ("Directional", "Adjoint")
    },
    "EnterConfigurationMode": ("", "return unsupported(c, 1);"),
    "ExitConfigurationMode": ("", "return unsupported(c, 1);"),
    "GetIntervalDecimal": (_MANY + "double *values, int *kinds", "return unsupported(c, count);"),
    "GetIntervalFraction": (
        _MANY + "uint64_t *counters, uint64_t *resolutions, int *kinds",
        "return unsupported(c, count);",
    ),
    "GetShiftDecimal": (_MANY + "double *values", "return unsupported(c, count);"),
    "GetShiftFraction": (_MANY + "uint64_t *counters, uint64_t *resolutions", "return unsupported(c, count);"),
    "SetIntervalDecimal": (_MANY + "const double *values", "return unsupported(c, count);"),
    "SetShiftDecimal": (_MANY + "const double *values", "return unsupported(c, count);"),
    **{
        f"Set{kind}Fraction": (
            _MANY + "const uint64_t *counters, const uint64_t *resolutions",
            "return unsupported(c, count);",
        )
        for kind in ("Interval", "Shift")
    },
    "EvaluateDiscreteStates": ("", "return STATUS_OK;"),
    "UpdateDiscreteStates": (
        "bool *need_update, bool *terminate, bool *nominals_changed, bool *values_changed, "
        "bool *time_defined, double *time",
        "int changed;\n    const Status status = update(c, &changed);\n"
        "    *need_update = *terminate = *nominals_changed = *time_defined = false;\n"
        "    *values_changed = (changed != 0);\n    *time = 0.0;\n    return status;",
    ),
    "CompletedIntegratorStep": (
        "bool kept, bool *event_mode, bool *terminate",
        "*event_mode = false; *terminate = false; return STATUS_OK;",
    ),
    "GetContinuousStateDerivatives": _SECOND["GetDerivatives"],
    "GetNumberOfEventIndicators": ("size_t *count", "*count = DRY; return STATUS_OK;"),
    "GetNumberOfContinuousStates": ("size_t *count", "*count = STATES; return STATUS_OK;"),
    "EnterStepMode": ("", "return STATUS_OK;"),
    "GetOutputDerivatives": (
        _MANY + "const int32_t *orders, double *values, size_t size",
        "return unsupported(c, count);",
    ),
    "DoStep": (
        "double time, double span, bool kept, bool *event_needed, bool *terminate, bool *early, double *last",
        "const Status status = do_step(c, time, span);\n"
        "    *event_needed = *terminate = *early = false;\n"
        "    *last = (status == STATUS_OK) ? (time + span) : time;\n    return status;",
    ),
    "ActivateModelPartition": ("Reference clock, double time", "return unsupported(c, 1);"),
}


def read_source(name: str) -> str:
    """Read a part of the wrapper's sources, without its first line."""
    text = (files(__package__) / "fmu_sources" / f"{name}.c").read_text(encoding="utf-8")
    return text.partition("\n")[2]


def write_interface(version: int) -> str:
    """Write the functions of FMI 2 or 3, which follow the model's."""
    functions = {
        "EnterEventMode": ("", "return STATUS_OK;"),
        "EnterContinuousTimeMode": ("", "return STATUS_OK;"),
        "Terminate": ("", "return STATUS_OK;"),
        "Reset": ("", "begin(&c->model); return STATUS_OK;"),
        "ExitInitializationMode": ("", "int changed; return update(c, &changed);"),
        "SetTime": ("double time", "c->model.v[0] = time; return STATUS_OK;"),
        "GetNominalsOfContinuousStates": ("double *values, size_t count", "return nominals(values, count);"),
        "SetContinuousStates": ("const double *x, size_t count", "return set_states(c, x, count);"),
        "GetContinuousStates": ("double *x, size_t count", "return get_states(c, x, count);"),
        "GetEventIndicators": ("double *values, size_t count", "return get_indicators(c, values, count);"),
    }
    state = "state" if version == 2 else "State"
    functions |= {
        name.format(state=state): entry
        for name, entry in {
            "GetFMU{state}": ("void **state", "return copy_state(c, state);"),
            "SetFMU{state}": ("void *state", "return restore(c, state, sizeof c->model);"),
            "FreeFMU{state}": ("void **state", "return forget(state);"),
            "SerializedFMU{state}Size": ("void *state, size_t *size", "*size = sizeof c->model; return STATUS_OK;"),
            "SerializeFMU{state}": (
                "void *state, unsigned char *bytes, size_t size",
                "return save(c, state, bytes, size);",
            ),
        }.items()
    }
    functions |= _SECOND if version == 2 else _THIRD
    shared = read_source("shared").replace("LOGGER\n", read_source(f"logger{version}") + "\n", 1)
    shared = shared.replace(
        "CALL_LOGGER",
        {
            2: "c->log(c->environment, c->name, status, category[status], what)",
            3: "c->log(c->environment, status, category[status], what)",
        }[version],
    )
    macro = f"""\
/* Sources that are linked with others are compiled with FMI{version}_FUNCTION_PREFIX=@_; a library
   has the standard's names. */
#if defined(FMI{version}_FUNCTION_PREFIX) && !defined(FMI{version}_OVERRIDE_FUNCTION_PREFIX)
#define FMI(name) JOINED(FMI{version}_FUNCTION_PREFIX, fmi{version}##name)
#else
#define FMI(name) fmi{version}##name
#endif
"""
    written = [_function(name, *entry) for name, entry in functions.items()]
    return "\n".join([shared, macro, read_source(f"fmi{version}"), *written])


def _function(name: str, arguments: str, body: str) -> str:
    """Write one function whose first argument is the instance."""
    names = [part.split()[-1].lstrip("*") for part in arguments.split(", ")] if arguments else []
    words = _words(body)
    unused = [f"    (void){name};" for name in names if name not in words]
    head = ", ".join(["void *instance", *([arguments] if arguments else [])])
    first = ["    Instance *c = (Instance *)instance;"] if "c" in words else ["    (void)instance;"]
    lines = [
        line if line.startswith(" ") else f"    {line}"
        for line in body.replace("; return", ";\n    return").replace("; *", ";\n    *").split("\n")
    ]
    return "\n".join([f"EXPORT Status FMI({name})({head})", "{", *first, *unused, *lines, "}", ""])


def _words(body: str) -> Sequence[str]:
    return "".join(x if x.isalnum() or x == "_" else " " for x in body).split()
