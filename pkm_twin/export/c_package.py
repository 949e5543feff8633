# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A robot as a package of C99: header, source, example, CMakeLists.txt and README."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from delta_dynamics.torques.at_pose import PoseKernel, pose_acceleration_kernel, pose_mass_kernel, pose_torque_kernel
from delta_dynamics.torques.equations import motion_kernel
from delta_dynamics.torques.transmission import transmission_kernel
from delta_dynamics.torques.virtual_work import (
    acceleration_kernel,
    mass_matrix_kernel,
    moving_base_torque_kernel,
    null_kernel,
    stream_torque_kernel,
    torque_kernel,
)
from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import GEOMETRY, PARAMETERS, Expression, find_prepared
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.program import LAST, Equations
from pkm_twin.errors import ParameterError, warn_of_file
from pkm_twin.export.c99 import C_HEAD, CONTROL_LOOP_PREFIX, CSource, Routine, Substitution, write_table
from pkm_twin.export.c_templates import (
    CMAKE,
    HEADER_TEXT,
    OPERATIONS_TEXT,
    PARAMETERS_TEXT,
    STATELESS_TEXT,
    STREAM_TEXT,
    write_example,
    write_readme,
)
from pkm_twin.export.c_transmission import TransmissionTerms, second_derivative_directions
from pkm_twin.kinematics.programs import actuator_program
from pkm_twin.machine.inertia import Layout
from pkm_twin.machine.members import RigidError
from pkm_twin.machine.sections import MAX_LENGTH, MAX_MASS, payload_margins
from pkm_twin.robot.robot import Robot
from stiffness_monitor.compliance import MIN_PIVOT_RATIO
from stiffness_monitor.programs import Elastic


def c_identifier(name: str) -> str:
    """Return a robot's name as a part of a C identifier, with codes in place of letters beyond ASCII."""
    plain = "".join(c if c.isascii() else f"u{ord(c):04x}" for c in name)
    return re.sub(r"[^A-Za-z0-9_]", "_", plain) or "robot"


def c_package(robot: Robot) -> dict[str, str]:
    """Write the files of a C package, text by name.

    Without masses there are no functions of dynamics, without elastic members none of elasticity.
    """
    package = Package(robot)
    doubles = package.unit.max_local_doubles + max(package.unit.doubles.values())
    return {
        f"{package.prefix}.h": package.header(),
        f"{package.prefix}.c": package.source(),
        "example.c": write_example(robot, package.prefix, package.title),
        "CMakeLists.txt": CMAKE.format(name=package.prefix),
        "README.md": write_readme(robot, package.prefix, doubles),
    }


class Package:
    """The C header and source of a robot.

    :param names: names of the functions; by default all except ``terms``, which returns those of
        :class:`delta_dynamics.torques.equations.Terms` in one table.
    """

    def __init__(self, robot: Robot, names: Collection[str] = ()) -> None:
        self.robot, self._names = robot, names
        self._stateless = STATELESS_TEXT if robot.friction.presliding.any() else ""
        if self._stateless:
            warn_of_file("friction", self._stateless)
        self.prefix = f"pkm_{c_identifier(robot.name)}"
        self.macro = self.prefix.upper()
        self.n, self.m = robot.joints_count, len(robot.pose_names)
        self.massive = robot.has_masses
        self.elastic: Elastic | None = None
        if self._is_wanted("compliance") or self._is_wanted("strain_energy"):
            try:
                made = robot.cached(Elastic)
                _ = made.response
                self.elastic = made
            except RigidError:
                pass
            except ParameterError as error:
                # Cross-sections contradict the masses, or some bodies have no cross-section.
                warn_of_file(robot.name, f"no functions of elasticity: {error}")
        self.fold = Substitution()
        self.payload = self.fold.tape.inputs(PARAMETERS, 13)
        self.hidden: list[Routine] = []
        self.routines = self._list_routines()
        rows = [[e for row in r.outputs.values() for e in row] for r in (*self.hidden, *self.routines)]
        # C has no empty tables: use a parameter if no results depend on any.
        edges = {e.number: e for row in rows for e in find_prepared(row)}
        self.parameters = [*edges.values()] or [self.payload[0]]
        self.unit = CSource(self.prefix, self.parameters, self.routines)
        self._write_functions()

    def _substitute_numbers(
        self, kernel: Kernel, own: Sequence[Any] | Array = (), **more: Sequence[float]
    ) -> tuple[dict[str, list[Expression]], list[Equations]]:
        """Return the outputs and equations of a kernel with this machine's numbers inserted.

        :param more: numbers of other inputs.
        """
        program = kernel.program
        given = {GEOMETRY: kernel.geometry.tolist(), PARAMETERS: list(own), **more}
        rows = {name: self.fold(row, given) for name, row in program.outputs.items()}
        return rows, [self.fold.equations(q, given) for q in program.equations]

    def _list_routines(self) -> list[Routine]:
        robot, n = self.robot, self.n
        q, rates, wrench = {"q": n}, {"q": n, "qd": n}, {"wrench": 6}
        result: list[Routine] = []

        def add_routine(
            name: str,
            summary: str,
            inputs: Mapping[str, int],
            kernels: Callable[[], Kernel] | Sequence[Callable[[], Kernel]],
            own: Sequence[Any] | Array = (),
            upon: str = "",
            judge: Routine | None = None,
            **outputs: str,
        ) -> None:
            if self._is_wanted(name):
                rows: dict[str, list[Expression]] = {}
                for kernel in reversed([kernels] if callable(kernels) else kernels):
                    found, equations = self._substitute_numbers(kernel(), own)
                    rows |= found
                made = {key: rows[row] for key, row in outputs.items()}
                last = rows.get(LAST, ())
                base = next((r for r in result if r.name == upon), None)
                result.append(
                    Routine(
                        name,
                        inputs,
                        made,
                        equations,
                        summary,
                        last,
                        base,
                        judge,
                    )
                )

        engine, p = robot.engine, self._inertial_inputs() if self.massive else ()
        if self.massive:
            add_routine(
                "torques",
                "Actuator efforts tau (N m or N) for a motion.",
                rates | {"qdd": n} | wrench,
                lambda: torque_kernel(robot),
                p,
                tau="efforts",
            )
            add_routine(
                "torques_moving",
                "The efforts of _torques on a base that moves. base, in its own axes: angular "
                "velocity, angular acceleration, and acceleration of its origin less gravity.",
                rates | {"qdd": n} | wrench | {"base": 9},
                lambda: moving_base_torque_kernel(robot),
                p,
                tau="efforts",
            )
            add_routine(
                "torques_and_singularity",
                "Both for the time of one: actuator efforts tau, and the singularity index.",
                rates | {"qdd": n} | wrench,
                [lambda: torque_kernel(robot), robot.singularity_kernel],
                p,
                tau="efforts",
                index="measure",
            )
            add_routine(
                "torques_next",
                "The efforts of _torques",
                rates | {"qdd": n} | wrench,
                lambda: stream_torque_kernel(robot),
                p,
                "torques",
                tau="efforts",
            )
            add_routine(
                "torques_and_singularity_next",
                "The results of _torques_and_singularity",
                rates | {"qdd": n} | wrench,
                [lambda: stream_torque_kernel(robot), robot.singularity_kernel],
                p,
                "torques_and_singularity",
                tau="efforts",
                index="measure",
            )
        add_routine("forward", "Pose of joint positions.", q, lambda: engine.forward, pose="pose")
        if self._is_wanted("inverse"):
            add_routine(
                "inverse",
                "Joint positions of a pose, accepted only if _forward of them is the pose.",
                {"pose": self.m},
                lambda: engine.quick_inverse,
                judge=self._confirmed_inverse,
                q="q",
            )
            if self.massive:
                self._add_at_pose(result, p)
        add_routine(
            "platform",
            "Position (m) of the platform's reference point in base axes, and the platform's "
            "rotation from home, row by row.",
            q,
            lambda: engine.forward,
            position="position",
            rotation="rotation",
        )
        if self.massive:
            add_routine(
                "mass_matrix",
                "Mass matrix of the actuated joints, row by row.",
                q,
                lambda: mass_matrix_kernel(robot),
                p,
                m="matrix",
            )
            add_routine(
                "accelerations",
                "Joint accelerations that efforts tau cause.",
                rates | {"tau": n} | wrench,
                lambda: acceleration_kernel(robot),
                p,
                "mass_matrix",
                qdd="accelerations",
            )
        if robot.redundant:
            add_routine(
                "null_efforts",
                "Efforts that move nothing, of unit length over their limits, row by row.",
                q,
                lambda: null_kernel(robot),
                n="efforts",
            )
            add_routine(
                "project_redundant",
                "Positions, rates and accelerations of all joints, by those that lead: "
                f"{', '.join(robot.graph.leads)}.",
                rates | {"qdd": n},
                lambda: robot.projection_kernel,
                positions="q",
                rates="qd",
                changes="qdd",
            )
        if "terms" in self._names:
            add_routine(
                "terms",
                "Terms of the equations of motion: mass matrix, bias, energies, twists of "
                "the platform, rates and drift of passive joints with friction.",
                rates,
                lambda: motion_kernel(robot),
                p,
                terms="terms",
            )
        add_routine(
            "jacobian",
            "Pose rates per joint rate, row by row.",
            q,
            lambda: engine.jacobian,
            j="rates",
        )
        add_routine(
            "platform_jacobian",
            "Velocity of the platform's reference point and angular velocity, base axes, per joint rate, row by row.",
            q,
            lambda: engine.jacobian,
            j="twist",
        )
        add_routine(
            "singularity",
            "Singularity index: 0 in a singularity, 1 at best.",
            q,
            robot.singularity_kernel,
            index="measure",
        )
        self._add_transmission(result)
        if self.elastic is not None:
            self._add_elastic(self.elastic, result)
        return result

    def _add_at_pose(self, result: list[Routine], own: Sequence[Any] | Array) -> None:
        """Add the dynamics of a motion of the pose, after the inverse kinematics."""
        motion = {"pose": self.m, "rate": self.m}
        programs: tuple[tuple[str, str, Mapping[str, int], PoseKernel, Mapping[str, str]], ...] = (
            (
                "torques",
                "Joint motion q, qd, qdd and efforts tau for a motion of "
                "the pose: its rate and acceleration are those of the pose's coordinates.",
                motion | {"acceleration": self.m, "wrench": 6},
                pose_torque_kernel,
                {name: name for name in ("q", "qd", "qdd", "tau")},
            ),
            (
                "mass_matrix",
                "Mass matrix of the actuated joints at a pose, row by row.",
                {"pose": self.m},
                pose_mass_kernel,
                {"m": "matrix"},
            ),
            (
                "accelerations",
                "Accelerations of the pose's coordinates, and of the joints, that efforts tau cause.",
                motion | {"tau": self.n, "wrench": 6},
                pose_acceleration_kernel,
                {"acceleration": "acceleration", "qdd": "qdd"},
            ),
        )
        for name, summary, inputs, kernel, outputs in programs:
            if not self._is_wanted(f"{name}_at_pose"):
                continue
            rows, equations = self._substitute_numbers(kernel(self.robot, certified=True), own)
            made = {key: rows[row] for key, row in outputs.items()}
            result.append(Routine(f"{name}_at_pose", inputs, made, equations, summary, judge=self._confirmed_inverse))

    @cached_property
    def _confirmed_inverse(self) -> Routine | None:
        """Static function that judges poses whose assembly is uncertain; None if joints are iterated."""
        if self.robot.engine.posed is None:
            return None
        rows, equations = self._substitute_numbers(self.robot.engine.inverse)
        self.hidden.append(Routine("inverse_confirmed", {"pose": self.m}, rows, equations, ""))
        return self.hidden[-1]

    def _is_wanted(self, name: str) -> bool:
        return not self._names or name in self._names

    def _add_transmission(self, result: list[Routine]) -> None:
        """Add the functions of the robot as a transmission between its pose and its joints."""
        robot, n, m = self.robot, self.n, self.m
        for curved, name, summary, inputs in (
            (
                False,
                "joint_to_actuator",
                "The machine as a transmission: joint positions, rates "
                "and efforts of a pose, its rate, and efforts on its coordinates.",
                {"pose": m, "velocity": m, "effort": m},
            ),
            (
                True,
                "gains",
                "Stiffness and damping of the actuated joints, row by row, which "
                "give the pose coordinates a stiffness and damping while the joints have efforts "
                "tau.",
                {"pose": m, "stiffness": m * m, "damping": m * m, "tau": n},
            ),
        ):
            if not self._is_wanted(name):
                continue
            kernel = transmission_kernel(robot, certified=True, curved=curved)
            found = [
                self._substitute_numbers(kernel, rate=way)
                for way in (second_derivative_directions(m) if curved else [[]])
            ]
            rows, equations = found[0]
            terms = TransmissionTerms(robot, self.fold, rows["ratio"])
            equations = terms.reject_singular_poses(equations)
            if curved:
                outputs = terms.gains([rows["change"] for rows, _ in found])
            else:
                outputs = {"q": rows["q"], **terms.actuator_side()}
            result.append(Routine(name, inputs, outputs, equations, summary, judge=self._confirmed_inverse))
        if self._is_wanted("actuator_to_joint"):
            kernel = robot.engine.kernel("actuator to joint", actuator_program)
            rows, equations = self._substitute_numbers(kernel)
            result.append(
                Routine(
                    "actuator_to_joint",
                    {"q": n, "qd": n, "tau": n},
                    rows,
                    equations,
                    "The machine as a transmission: pose, its rate, and efforts on its "
                    "coordinates, of joint positions, rates and efforts.",
                )
            )

    def _add_elastic(self, elastic: Elastic, result: list[Routine]) -> None:
        rows, equations = self._substitute_numbers(elastic.response)
        (row,) = rows.values()
        k = len(elastic.names)
        # Reject frames that are mechanisms.
        sound = self.fold.tape.lift(row[-1] - MIN_PIVOT_RATIO)
        equations = [replace(q, branch=[*q.branch, sound]) for q in equations]
        compliance = Routine(
            "compliance",
            {"q": self.n},
            {"c": row[2 * k + 7 : 2 * k + 43]},
            equations,
            "Compliance of the platform at its reference point, joints locked: x y z rx ry rz, base axes, row by row.",
        )
        energy = Routine(
            "strain_energy",
            {"q": self.n, "wrench": 6},
            {"energies": row[k : 2 * k]},
            equations,
            f"Strain energy (J) of each element: {', '.join(elastic.names)}.",
            upon=compliance if self._is_wanted("compliance") else None,
        )
        result += [routine for routine in (compliance, energy) if self._is_wanted(routine.name)]

    def _inertial_inputs(self) -> Array:
        """Return the run-time inputs of the dynamics as functions of the payload's numbers."""
        mass, com, inertia = self.payload[0], self.payload[1:4], self.payload[4:].reshape(3, 3)
        layout = Layout(self.robot.massive().tree)
        return np.asarray(self.robot.own_inertial + layout.payload(mass, com, inertia))

    @property
    def payload_values(self) -> list[float]:
        """Mass, centre of mass and inertia of the robot's payload."""
        load = self.robot.payload
        return [float(load.mass), *map(float, load.com), *np.ravel(load.inertia).tolist()]

    def _write_functions(self) -> None:
        unit = self.unit
        own = self.fold(self.parameters, {PARAMETERS: self.payload_values})
        unit.append(write_table("@_own", [e.value for e in own]))
        if self.massive:
            self._write_parameters()
        for routine in self.hidden:
            unit.write_routine(routine, "static ")
        for routine in self.routines:
            unit.write_routine(routine, CONTROL_LOOP_PREFIX if routine.name.startswith("torques_and_s") else "")
            unit.write_own(routine)

    def _write_parameters(self) -> None:
        unit, size = self.unit, len(self.parameters)
        mass, com, inertia = self.payload[0], self.payload[1:4], self.payload[4:].reshape(3, 3)
        margins = [self.fold.tape.lift(m) for m in payload_margins(mass, com, inertia)]
        results = [*self.parameters, *margins]
        call = unit.write_function("prepare", results, {})
        unit.append(f"""\
int @_parameters(double mass, const double *com, const double *inertia, double *out)
{{
    double p[13], r[{len(results)}];
    int i, status;
    p[0] = mass;
    for (i = 0; i < 3; i++) {{
        p[1 + i] = com[i];
    }}
    for (i = 0; i < 9; i++) {{
        p[4 + i] = inertia[i];
    }}
    {call % "r"};
    status = ((@_finite(p, 13) != 0) && (@_finite(r, {len(results)}) != 0)) ? 0 : 2;
    for (i = {size}; i < {len(results)}; i++) {{
        if (!(r[i] >= 0.0)) {{
            status = 2;
        }}
    }}
    @_give(status, r, out, {size});
    return status;
}}
""")

    def source(self) -> str:
        """Return the source file with all functions."""
        return (
            f"/* SPDX-License-Identifier: Apache-2.0 */\n/* {self.title} */\n"
            f'#include "{self.prefix}.h"\n\n{C_HEAD}\n{self.unit.text()}'
        )

    @property
    def title(self) -> str:
        """First line of the header, the source and the example."""
        name = self.prefix.removeprefix("pkm_")
        return f"{name}: written by pkm-twin export c, which overwrites changes."

    def header(self) -> str:
        """Write the header: the declarations, with the arguments of each function."""
        guard, size = f"{self.macro}_H", len(self.parameters)
        robot = self.robot
        joints = _list_with_units(zip(robot.joint_names, robot.joint_units, strict=True))
        pose = _list_with_units(zip(robot.pose_names, robot.pose_units, strict=True))
        sizes = [("JOINTS", self.n), ("POSE", self.m), ("PARAMETERS", size)]
        sizes += [("STATE", len(routine.state)) for routine in self.routines if routine.state][:1]
        if self.elastic is not None:
            sizes.append(("ELEMENTS", len(self.elastic.names)))
        # Define macros in capitals, and with the robot's own spelling, which the functions have.
        spelled = dict.fromkeys([self.macro, f"PKM_{self.prefix.removeprefix('pkm_')}"])
        lines = [f"#define {m}_{name} {count}" for m in spelled for name, count in sizes]
        parts = []
        for routine in self.routines:
            most = OPERATIONS_TEXT.format(*routine.max_operations)
            shape = ", ".join(f"{name}[{len(row)}]" for name, row in routine.outputs.items())
            takes = ", ".join(f"{name}[{count}]" for name, count in routine.inputs.items())
            what = f"{routine.summary} {most} {takes} -> {shape}."
            if routine.state:
                what = f"{routine.summary}{STREAM_TEXT.format(size=len(routine.state))}{most}"
            parts.append(
                _write_comment(what)
                + f"\n{self.unit.write_signature(routine, given=False)};\n"
                + f"{self.unit.write_signature(routine, given=True)};\n"
            )
        if self.massive:
            what = _write_comment(PARAMETERS_TEXT.format(size=size, mass=MAX_MASS, reach=MAX_LENGTH))
            parts.append(
                f"{what}\nint @_parameters(double mass, const double *com, const double *inertia, double *out);\n"
            )
        about = _write_comment(HEADER_TEXT.format(joints=joints, pose=pose) + self._stateless)
        text = "\n".join(
            [
                "/* SPDX-License-Identifier: Apache-2.0 */",
                f"/* {self.title} */",
                f"#ifndef {guard}",
                f"#define {guard}",
                "",
                about,
                "",
                *lines,
                "",
                '#ifdef __cplusplus\nextern "C" {\n#endif',
                "",
                *parts,
                "#ifdef __cplusplus\n}\n#endif",
                "",
                f"#endif /* {guard} */",
                "",
            ]
        )
        return text.replace("@", self.prefix)


def _list_with_units(pairs: Any) -> str:
    return ", ".join(f"{name} ({unit})" for name, unit in pairs)


def _write_comment(text: str) -> str:
    """Write a C comment in lines of at most 95 characters."""
    # Change characters of names that would end the comment or form a trigraph.
    safe = "".join(c if c.isprintable() else " " for c in text)
    for bad in ("*/", "/*", "??"):
        safe = safe.replace(bad, " ".join(bad))
    return "/* " + "\n   ".join(textwrap.wrap(safe, 92)) + " */"
