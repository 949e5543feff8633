# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A robot as a Functional Mock-up Unit, FMI 2.0 or 3.0: model exchange and co-simulation."""

from __future__ import annotations

import hashlib
import io
import platform
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Final

from delta_dynamics.torques.virtual_work import MASSLESS_RATIO
from pkm_twin.errors import ParameterError
from pkm_twin.export.c99 import write_table
from pkm_twin.export.c_package import Package
from pkm_twin.export.fmu_xml import Description, Variable, quote_name, write_build_description, write_model_description
from pkm_twin.machine.inertia import list_loaded_joints
from pkm_twin.robot.robot import Robot

VERSIONS: Final = (2, 3)
KINDS: Final = ("dynamics", "torques")
MODEL_FILE: Final = "fmu.c"
CONSTANTS: Final = f"""\
#define LEAST {MASSLESS_RATIO!r}
/* Of the plant: a rate that is none, forces and motions that are equal, rows that depend. */
#define STILL 1e-12
#define TOLERANCE 1e-9
#define REGULAR 1e-11
#define DEPENDENT 1e-14
/* Rate, rad/s or m/s, that a sliding joint may have in the other direction before it stops. */
#define CREEP 1e-10
/* Changes of stick and slip in an internal step whose times are found, and how exactly. */
#define CHANGES 20
#define INSTANT 1e-8
"""


class Fmu:
    """The files of an FMU; ``identifier``: prefix of its functions and name of its binaries.

    ``kind``: dynamics (states q and qd, inputs tau and wrench) or torques (inputs q, qd, qdd and
    wrench). ``version`` of FMI: 2 or 3.

    :raises ParameterError: a robot whose file gives no masses.
    """

    def __init__(self, robot: Robot, version: int = 3, kind: str = "dynamics") -> None:
        robot.massive()
        if robot.laws and kind == "dynamics":
            law = robot.laws[0]
            raise ParameterError(
                "friction", law, "viscous, coulomb and offset in an FMU of kind dynamics; --kind torques has every law"
            )
        if kind == "dynamics":
            robot.check_independent("an FMU's dynamics", "each joint is a state")
        self.robot, self.version, self.kind = robot, version, kind
        self.dynamic = kind == "dynamics"
        self.n = robot.joints_count
        names = ("terms" if self.dynamic else "torques_and_singularity", "forward")
        self._package = Package(robot, names)
        self.identifier = self._package.prefix
        passive = list_loaded_joints(robot.graph)
        dry = [*robot.friction.coulomb, *(joint.coulomb for joint in passive)]
        self._rows = [k for k, force in enumerate(dry) if force > 0.0] if self.dynamic else []
        self._dry = [float(dry[k]) for k in self._rows]
        self._row_names = [*robot.joint_names, *(joint.name for joint in passive)]
        self._passive = [float(joint.viscous) for joint in passive]
        self._starts: dict[str, int] = {}
        self.variables = self._list_variables()
        self.files = self._write_files()

    def _list_variables(self) -> list[Variable]:
        robot, n = self.robot, self.n
        found: list[Variable] = []

        def add_group(group: str, rows: Sequence[Variable]) -> list[int]:
            self._starts[group] = len(found)
            found.extend(rows)
            return list(range(len(found) - len(rows), len(found)))

        names = [quote_name(name) for name in robot.joint_names]
        units = robot.joint_units
        efforts = ["N.m" if unit == "rad" else "N" for unit in units]

        def joint_variables(
            what: str, text: str, kind: str, ends: str = "", start: Sequence[float] | None = None
        ) -> list[Variable]:
            own = efforts if what == "tau" else [unit + ends for unit in units]
            begin = [None] * n if start is None else [float(x) for x in start]
            return [
                Variable(f"{what}.{name}", kind, unit, f"{text} of {joint}", value)
                for name, joint, unit, value in zip(names, robot.joint_names, own, begin, strict=True)
            ]

        still = [0.0] * n
        home, moves = robot.graph.home, "s" if self.dynamic else "i"
        add_group("TIME", [Variable("time", "t", "s", "Time")])
        q = add_group("Q", joint_variables("q", "position", moves, start=home.tolist()))
        qd = add_group("QD", joint_variables("qd", "velocity", moves, "/s", still))
        if self.dynamic:
            # States are outputs, each of which depends on itself.
            for k in (*q, *qd):
                found[k] = replace(found[k], needs=[k])
            add_group(
                "DQ",
                [
                    replace(v, name=f"der({found[k].name})", derivative=k, needs=[j])
                    for k, j, v in zip(q, qd, joint_variables("qd", "velocity", "d", "/s"), strict=True)
                ],
            )
            accelerations = add_group(
                "DQD",
                [
                    replace(v, name=f"der({found[k].name})", derivative=k)
                    for k, v in zip(qd, joint_variables("qdd", "acceleration", "d", "/s2"), strict=True)
                ],
            )
            moved = add_group("TAU", joint_variables("tau", "effort", "i", start=still))
        else:
            moved = add_group("QDD", joint_variables("qdd", "acceleration", "i", "/s2", still))
        wrench = add_group(
            "WRENCH",
            [
                Variable(
                    f"wrench.{axis}",
                    "i",
                    unit,
                    "what the surroundings apply to the platform at its reference point, base axes",
                    0.0,
                )
                for unit, axes in (("N", ("fx", "fy", "fz")), ("N.m", ("mx", "my", "mz")))
                for axis in axes
            ],
        )
        every = [*q, *qd, *moved, *wrench]
        add_group("PAYLOAD", self._payload_variables())
        if self.dynamic:
            for k in accelerations:
                found[k] = replace(found[k], needs=every)
            # Step of the integrator in co-simulation, s, unless the importer sets another one.
            add_group("STEP", [Variable("step", "p", "s", "longest internal step of co-simulation", 1e-4)])
        else:
            efforts_at = joint_variables("tau", "effort that the motion needs", "o")
            add_group("TAU", [replace(v, needs=every) for v in efforts_at])
        add_group(
            "POSE",
            [
                Variable(f"pose.{name}", "o", unit, "pose of the platform", needs=q)
                for name, unit in zip(map(quote_name, robot.pose_names), robot.pose_units, strict=True)
            ],
        )
        if not self.dynamic:
            add_group("SINGULARITY", [Variable("singularity", "o", "", "0 in a singularity, 1 at best", needs=q)])
        text = "0 valid, 1 no assembly or a singularity, 2 not finite"
        add_group("STATUS", [Variable("status", "o", "", text, needs=every, whole=True)])
        add_group(
            "INDICATORS",
            [
                Variable(
                    f"stick_slip.{quote_name(self._row_names[row])}",
                    "d",
                    "",
                    "falls through zero where the joint begins to stick or to slide",
                    needs=every,
                )
                for row in self._rows
            ],
        )
        return found

    def _payload_variables(self) -> list[Variable]:
        load = self.robot.payload
        rows = [Variable("payload.mass", "p", "kg", "mass of the payload", float(load.mass))]
        place = "from the platform's reference point, axes fixed to the platform, base's at home"
        for axis, value in zip("xyz", load.com, strict=True):
            text = f"centre of mass {place}"
            rows.append(Variable(f"payload.com.{axis}", "p", "m", text, float(value)))
        for i, k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
            name, value = f"payload.inertia.{'xyz'[i]}{'xyz'[k]}", float(load.inertia[i][k])
            text = "entry of the inertia matrix about the centre of mass"
            rows.append(Variable(name, "p", "kg.m2", text, value))
        return rows

    def _write_files(self) -> dict[str, str]:
        prefix = self.identifier
        # Write the wrapper's source; its token is a hash of the files and is inserted below.
        robot, size = self.robot, len(self.variables)
        defined = {
            "N": self.n,
            "COUNT": size,
            "DRY": len(self._rows),
            "PASSIVE": len(self._passive),
            "STATES": 2 * self.n if self.dynamic else 0,
            "STATUS_AT": self._starts["STATUS"],
            **self._starts,
        }
        lines = [f"#define {name} {value}" for name, value in defined.items()]
        lines.append(f"#define PARAMETERS {self._package.macro}_PARAMETERS")
        tables = {"START": [v.start or 0.0 for v in self.variables]}
        if self.dynamic:
            lines.append(CONSTANTS)
            tables["OFFSET"] = robot.friction.offset.tolist()
            tables["VISCOUS"] = robot.friction.viscous.tolist()
            tables["PASSIVE_VISCOUS"] = self._passive
            tables["FRICTION"] = self._dry
        kinds = "".join(v.kind for v in self.variables)
        constants = [write_table(name, values) for name, values in tables.items() if values]
        constants.append(f'static const char KIND[] = "{kinds}";\n')
        if self._rows:
            rows = ", ".join(map(str, self._rows))
            constants.append(f"static const int ROW[DRY] = {{{rows}}};\n")
        model = ["torques"]
        if self.dynamic:
            friction = ["dry", "rates", "settle"] if self._rows else ["rates", "smooth"]
            model = ["dynamics", *friction, "steps"]
        title = f"/* {self.identifier}: written by pkm-twin export fmu. */\n"
        parts = [
            f"/* SPDX-License-Identifier: Apache-2.0 */\n{title}",
            read_source("head"),
            "\n".join(lines) + "\n",
            *constants,
            *map(read_source, ["model", *model]),
            write_interface(self.version),
        ]
        sources = {
            f"{prefix}.h": self._package.header(),
            f"{prefix}.c": self._package.source(),
            MODEL_FILE: "\n".join(parts).replace("@", self.identifier),
        }
        described = Description(
            self.robot.name or prefix,
            prefix,
            "",
            self._description,
            self.variables,
            [k for k, v in enumerate(self.variables) if v.name.startswith("stick_slip.")],
            bool(self._rows),
            [name for name in sources if name.endswith(".c")],
        )
        first = write_model_description(described, self.version)
        digest = hashlib.sha256("".join([first, *sources.values()]).encode()).hexdigest()
        token = "-".join(digest[a:b] for a, b in ((0, 8), (8, 12), (12, 16), (16, 20), (20, 32)))
        token = f"{{{token}}}"
        described = replace(described, token=token)
        sources[MODEL_FILE] = sources[MODEL_FILE].replace("#define COUNT", f'#define TOKEN "{token}"\n#define COUNT', 1)
        if self.version == 3:
            sources["buildDescription.xml"] = write_build_description(described)
        return {
            "modelDescription.xml": write_model_description(described, self.version),
            **{f"sources/{name}": text for name, text in sources.items()},
        }

    @property
    def _description(self) -> str:
        name = self.robot.name or self.identifier
        if self.dynamic:
            return f"Motion of {name} under joint efforts and a wrench on its platform"
        return f"Joint efforts that a motion of {name} needs"

    def archive(self, compiler: str | None = None) -> bytes:
        """Return the FMU as a zip archive; with a compiler also a binary for this machine.

        :raises ParameterError: the compiler does not accept the sources, with what it printed.
        """
        files: dict[str, bytes] = {name: text.encode() for name, text in self.files.items()}
        folder = {
            ("x86_64", 2): "linux64",
            ("x86_64", 3): "x86_64-linux",
            ("aarch64", 2): "aarch64-linux",
            ("aarch64", 3): "aarch64-linux",
        }.get((platform.machine(), self.version))
        if compiler is not None and folder is not None and platform.system() == "Linux":
            name = f"binaries/{folder}/{self.identifier}.so"
            files[name] = self._compile_binary(compiler)
        made = io.BytesIO()
        with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in files.items():
                entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.external_attr = 0o644 << 16
                archive.writestr(entry, content)
        return made.getvalue()

    def _compile_binary(self, compiler: str) -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            names = []
            for name, text in self.files.items():
                if name.startswith("sources/"):
                    names.append(name.removeprefix("sources/"))
                    (Path(folder) / names[-1]).write_text(text, encoding="utf-8")
            code = [name for name in names if name.endswith(".c")]
            command = [
                compiler,
                "-std=c99",
                "-O2",
                "-fPIC",
                "-shared",
                "-fvisibility=hidden",
                "-ffp-contract=off",
                *code,
                "-o",
                "model.so",
                "-lm",
            ]
            done = subprocess.run(  # noqa: S603  a compiler of this machine, without a shell
                command, cwd=folder, capture_output=True, text=True, check=False
            )
            if done.returncode:
                raise ParameterError(compiler, done.stderr.strip(), "a C99 compiler")
            return (Path(folder) / "model.so").read_bytes()


def find_compiler() -> str | None:
    """Find the first C compiler on the PATH."""
    return next((path for name in ("cc", "gcc", "clang") if (path := shutil.which(name))), None)


def read_source(name: str) -> str:
    """Read a part of the wrapper's sources, without its first line."""
    text = (files(__package__) / "fmu_sources" / f"{name}.c").read_text(encoding="utf-8")
    return text.partition("\n")[2]


def write_interface(version: int) -> str:
    """Write the functions of FMI 2.0 or 3.0 in C99.

    The types are those of the standard's headers (fmi-standard.org), so that a binary fits every
    importer, and the sources compile without its headers.
    """
    words = {
        2: {
            "CALL_LOGGER": "c->log(c->environment, c->name, status, category[status], what)",
            "FMUSTATE": "FMUstate",
            "DESERIALIZE": "DeSerializeFMUstate",
            "DERIVATIVES": "Derivatives",
        },
        3: {
            "CALL_LOGGER": "c->log(c->environment, status, category[status], what)",
            "FMUSTATE": "FMUState",
            "DESERIALIZE": "DeserializeFMUState",
            "DERIVATIVES": "ContinuousStateDerivatives",
        },
    }
    macro = f"""\
/* Sources that are linked with others are compiled with FMI{version}_FUNCTION_PREFIX=@_; a library
   has the standard's names. */
#if defined(FMI{version}_FUNCTION_PREFIX) && !defined(FMI{version}_OVERRIDE_FUNCTION_PREFIX)
#define FMI(name) JOINED(FMI{version}_FUNCTION_PREFIX, fmi{version}##name)
#else
#define FMI(name) fmi{version}##name
#endif
"""
    shared = read_source("shared").replace("LOGGER\n", read_source(f"logger{version}") + "\n", 1)
    text = "\n".join([shared, macro, read_source("functions"), read_source(f"fmi{version}")])
    for word, spelling in words[version].items():
        text = text.replace(word, spelling)
    return text
