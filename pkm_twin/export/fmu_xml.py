# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""An FMU's variables and its modelDescription.xml of FMI 2.0 and 3.0, always the same bytes."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

TOOL: Final = "pkm_twin"
UNITS: Final[dict[str, dict[str, int]]] = {
    "s": {"s": 1},
    "m": {"m": 1},
    "rad": {"rad": 1},
    "m/s": {"m": 1, "s": -1},
    "rad/s": {"rad": 1, "s": -1},
    "m/s2": {"m": 1, "s": -2},
    "rad/s2": {"rad": 1, "s": -2},
    "kg": {"kg": 1},
    "kg.m2": {"kg": 1, "m": 2},
    "N": {"kg": 1, "m": 1, "s": -2},
    "N.m": {"kg": 1, "m": 2, "s": -2},
}
"""Exponents of SI base units for each unit."""
PLAIN_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


@dataclass(frozen=True)
class Variable:
    """A variable of the FMU; its value reference is its index.

    ``kind``: t time, i input, p parameter, s state, d derivative or event indicator, o output.
    ``start``: start value, if any. ``derivative``: index of the state whose derivative it is.
    ``needs``: indices of the inputs and states that it depends on.
    """

    name: str
    kind: str
    unit: str
    description: str
    start: float | None = None
    derivative: int | None = None
    needs: Sequence[int] = ()
    whole: bool = False

    @property
    def causality(self) -> str:
        """The causality of FMI; states are outputs."""
        words = {"t": "independent", "i": "input", "p": "parameter", "d": "local"}
        return words.get(self.kind, "output")

    @property
    def variability(self) -> str:
        """The variability of FMI."""
        if self.whole:
            return "discrete"
        return "tunable" if self.kind == "p" else "continuous"

    @property
    def initial(self) -> str:
        """The attribute initial of FMI; none for inputs and time."""
        return {"p": "exact", "s": "exact", "d": "calculated", "o": "calculated"}.get(self.kind, "")


@dataclass(frozen=True)
class Description:
    """The content of modelDescription.xml, for both versions.

    ``indicators``: indices of the event indicators. ``resets``: True if events change rates.
    """

    name: str
    identifier: str
    token: str
    text: str
    variables: Sequence[Variable]
    indicators: Sequence[int]
    resets: bool
    sources: Sequence[str]

    def states(self) -> list[int]:
        """Return the indices of the continuous states."""
        return [k for k, v in enumerate(self.variables) if v.kind == "s"]

    def unknowns(self, kinds: str) -> list[tuple[int, Variable]]:
        """List the variables of the given kinds with their indices: outputs (``so``) or derivatives (``d``)."""
        return [(k, v) for k, v in enumerate(self.variables) if v.kind in kinds and k not in self.indicators]


def quote_name(name: str) -> str:
    """Quote a name for use in FMI's structured names, such as ``q.NAME``."""
    if PLAIN_NAME.fullmatch(name):
        return name
    safe = "".join(c if c.isascii() and c.isprintable() else "_" for c in name)
    safe = safe.replace("\\", "\\\\").replace("'", "\\'").replace('"', '\\"')
    return f"'{safe}'"


def write_model_description(d: Description, version: int) -> str:
    """Write modelDescription.xml of FMI 2 or 3."""
    second = version == 2
    # FMI 2 counts variables from 1, references of FMI 3 begin at 0.
    first = 1 if second else 0
    token = {"guid" if second else "instantiationToken": d.token}
    top = ET.Element(
        "fmiModelDescription",
        {"fmiVersion": f"{version}.0", "modelName": d.name, **token},
        description=d.text,
        generationTool=TOOL,
        variableNamingConvention="structured",
    )
    if second:
        top.set("numberOfEventIndicators", str(len(d.indicators)))
    step = {"completedIntegratorStepNotNeeded": "true"} if second else {"needsCompletedIntegratorStep": "false"}
    state = "FMUstate" if second else "FMUState"
    for kind, more in (("ModelExchange", step), ("CoSimulation", {"canHandleVariableCommunicationStepSize": "true"})):
        more |= {f"canGetAndSet{state}": "true", f"canSerialize{state}": "true"}
        element = ET.SubElement(top, kind, {"modelIdentifier": d.identifier, **more})
        if second:
            files = ET.SubElement(element, "SourceFiles")
            for name in d.sources:
                ET.SubElement(files, "File", name=name)
    units = ET.SubElement(top, "UnitDefinitions")
    for name in sorted({v.unit for v in d.variables if v.unit}):
        unit = ET.SubElement(units, "Unit", name=name)
        ET.SubElement(unit, "BaseUnit", {key: str(k) for key, k in UNITS[name].items()})
    ET.SubElement(top, "DefaultExperiment", startTime="0", stopTime="1", stepSize="0.001")
    variables = ET.SubElement(top, "ModelVariables")
    for k, v in enumerate(d.variables):
        entry = {
            "name": v.name,
            "valueReference": str(k),
            "description": v.description,
            "causality": v.causality,
            "variability": v.variability,
            "initial": v.initial,
        }
        entry = {key: text for key, text in entry.items() if text}
        own = {"start": repr(v.start)} if v.start is not None else {}
        if v.unit:
            own["unit"] = v.unit
        if v.kind == "s" and d.resets:
            own["reinit"] = "true"
        if v.derivative is not None:
            own["derivative"] = str(v.derivative + first)
        if second:
            scalar = ET.SubElement(variables, "ScalarVariable", entry)
            ET.SubElement(scalar, "Integer" if v.whole else "Real", own)
        else:
            ET.SubElement(variables, "Int32" if v.whole else "Float64", entry | own)
    structure = ET.SubElement(top, "ModelStructure")
    for group, tag, kinds in (
        ("Outputs", "Output", "so"),
        ("Derivatives", "ContinuousStateDerivative", "d"),
        ("InitialUnknowns", "InitialUnknown", "od"),
    ):
        rows = d.unknowns(kinds)
        part = ET.SubElement(structure, group) if second and rows else structure
        for k, v in rows:
            needs = " ".join(str(i + first) for i in v.needs)
            place = {"index" if second else "valueReference": str(k + first)}
            ET.SubElement(part, "Unknown" if second else tag, place, dependencies=needs)
    for k in () if second else d.indicators:
        needs = " ".join(map(str, d.variables[k].needs))
        ET.SubElement(structure, "EventIndicator", valueReference=str(k), dependencies=needs)
    ET.indent(top)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(top, encoding="unicode") + "\n"


def write_build_description(d: Description) -> str:
    """Write ``sources/buildDescription.xml`` of FMI 3.0."""
    top = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    build = ET.SubElement(top, "BuildConfiguration", modelIdentifier=d.identifier)
    files = ET.SubElement(build, "SourceFileSet", language="C99")
    for name in d.sources:
        ET.SubElement(files, "SourceFile", name=name)
    ET.SubElement(build, "Library", name="m")
    ET.indent(top)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(top, encoding="unicode") + "\n"
