# SPDX-License-Identifier: Apache-2.0
"""The elastic frame of a robot as compiled programs of q.

K = sum of d b b' over the frame's columns is factorised once, the platform's six displacements
last: what is left there is the platform's stiffness, C its inverse, and the displacements x under a
wrench follow without another solution. An element has the energy sum of d (b . x)^2 / 2.

Moduli, diameters and compliances are run-time parameters; only whether a compliance is zero, finite
or free is part of a program.

May import: numpy, pkm_twin's core, this package, the standard library; never rclpy.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.cholesky import SparseCholesky
from pkm_twin.codegen.expressions import PARAMETERS, absolute, maximum, minimum, sqrt
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.lu import SparseLU, independent_rows, pivot_order
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics.engine import Traced
from pkm_twin.kinematics.motion import Motion
from pkm_twin.machine.robot import Robot
from stiffness_monitor.frame import PLATFORM, Column, Frame, Row, bent, combined
from stiffness_monitor.structure import StructuralModel, plan_of, posed

Array = NDArray[np.float64]

PARTS: Final = 4
"""Parts that a member is divided into where its deflection is drawn."""
_TINY: Final = 1e-200


class Elastic:
    """A robot's elastic frame: its plan, run-time numbers and programs.

    ``names``: of the elements, as energies have them. ``parameters``: of each member EA, GJ, EI
    and 12 E I over the shear rigidity, then each joint's finite compliances.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot, structure = robot, robot.elastic
        self.plan = plan_of(robot.graph, structure)
        self.soft = list(
            dict.fromkeys(
                v for s in self.plan.supports for v in s.compliance if v.__class__ is tuple
            )
        )
        elastic = [member.body for member in self.plan.members] + [name for name, _ in self.soft]
        self.names = structure.order or tuple(dict.fromkeys(elastic))
        rows = [structure.sections[member.section].rigidities for member in self.plan.members]
        values = [structure.compliances[name][k] for name, k in self.soft]
        self.parameters = np.array([*np.ravel(rows), *values], np.float64)
        self._key = hashlib.sha256(
            repr((robot.graph.key, _text(self.plan), self.names)).encode()
        ).hexdigest()

    def posed(self, motion: Motion, p: Any) -> StructuralModel:
        """The plan in a motion, with the parameters ``p``."""
        of = {member.section: 4 * k for k, member in enumerate(self.plan.members)}
        at = {entry: 4 * len(of) + k for k, entry in enumerate(self.soft)}
        return posed(
            self.plan, motion.point, motion.direction, lambda name: p[of[name] : of[name] + 4],
            lambda joint, k: p[at[joint, k]],
        )  # fmt: skip

    def near_home(self) -> Array:
        """What closures hold where they hold most, home first, shape (k, rows, size)."""
        engine, ones = self.robot.engine, np.ones(len(self.parameters))
        frames = (
            Frame(self.posed(Motion(engine.tree, x, q), ones), static=True)
            for x, q in engine._samples
        )
        tables = np.array([frame.table() for frame in frames], np.float64)
        # Home can be a singularity of the frame.
        ranks = np.array([len(independent_rows(table[None, :, PLATFORM:])) for table in tables])
        return np.asarray(tables[ranks == ranks.max()], np.float64)

    def _kernel(self, name: str, write: Callable[[Solved], Program]) -> Kernel:
        return self.robot.engine.kernel(f"{name} {self._key}", lambda t: write(Solved(t, self)))

    @cached_property
    def response(self) -> Kernel:
        """Q and wrench to a row: factors, energies, deflection (6), energy, C (36), measure.

        The measure is the least pivot over its diagonal entry, which no choice of units changes: 0
        where the frame is a mechanism. Factors are zero where the wrench is.
        """
        return self._kernel("platform response", _response)

    @cached_property
    def deflections(self) -> Kernel:
        """Q and wrench to points of every member and their moves, (members, 2, k, 3); measure."""
        return self._kernel("member deflections", _deflections)

    @cached_property
    def columns(self) -> Kernel:
        """Q to the columns sqrt(d) b: entries, their rows, their columns; and columns' elements."""
        return self._kernel("elastic columns", _columns)


def elastic_of(robot: Robot) -> Elastic:
    """The robot's elastic frame, made once.

    :raises ParameterError: the robot's file lacks a section that elasticity needs.
    """
    found: Elastic | None = robot.calls.get("elastic")
    if found is None:
        found = robot.calls["elastic"] = Elastic(robot)
    return found


def _text(value: Any) -> Any:
    """A plan as plain data."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if is_dataclass(value):
        return [_text(getattr(value, field.name)) for field in fields(value)]
    return [_text(one) for one in value] if isinstance(value, tuple) else value


def _dot(a: Iterable[Any], b: Iterable[Any]) -> Any:
    return sum((x * y for x, y in zip(a, b, strict=True)), 0.0)


class Solved:
    """The frame of a solved motion, as expressions.

    ``follow``: coordinates that closures make follow from others, by those. ``place``: the others,
    numbered. ``columns``: on these, those of the members in order, then those of joints.
    """

    def __init__(self, t: Traced, elastic: Elastic) -> None:
        t.solve()
        self.t, self.elastic = t, elastic
        p = t.tape.inputs(PARAMETERS, len(elastic.parameters))
        self.frame = frame = Frame(elastic.posed(t.motion, p), static=True)
        self.measure: Any = 1.0
        self.follow = self._followers() if frame.held else {}
        left = (k for k in range(frame.size) if k not in self.follow)
        self.place = {k: i for i, k in enumerate(left)}
        columns = [column for bar in frame.bars for column in frame.columns(bar)]
        self.columns = [self._free(column) for column in (*columns, *frame.springs)]

    def _followers(self) -> dict[int, Row]:
        tables = self.elastic.near_home()
        rows, chosen = self.frame.dependents(tables)
        table, samples = self.frame.table()[rows], tables[:, rows][:, :, chosen]
        lu = SparseLU(table[:, chosen], pivot_order(samples))
        # Where they stop to determine what was chosen near home, nothing is known of the frame.
        size = float(abs(np.linalg.det(samples[0])))
        self.measure = 1.0 / maximum(absolute(size * lu.inverse_determinant), _TINY)
        rest = sorted({k for r in rows for k in self.frame.held[r]} - set(chosen))
        solved = [lu.solve(-table[:, k]) for k in rest]
        return {c: combined((rest, [one[i] for one in solved])) for i, c in enumerate(chosen)}

    def _free(self, column: Column) -> Column:
        """A column on the coordinates that closures leave."""
        terms = [(self.follow.get(k, {k: 1.0}), value) for k, value in column.row.items()]
        row = combined(*((own, [value * f for f in own.values()]) for own, value in terms))
        return column._replace(row={self.place[k]: value for k, value in row.items()})

    def factorise(self) -> None:
        """The stiffness: ``compliance`` of the platform, ``measure`` of the frame."""
        n, first = len(self.place), len(self.place) - PLATFORM
        matrix: dict[tuple[int, int], Any] = {(i, i): 0.0 for i in range(n)}
        for column in self.columns:
            row = sorted(column.row.items())
            for at, (i, x) in enumerate(row):
                scaled = column.rigidity * x
                for j, y in row[: at + 1]:
                    matrix[i, j] = matrix.get((i, j), 0.0) + scaled * y
        scale = [maximum(matrix[i, i], _TINY) for i in range(n)]
        self.root = root = SparseCholesky(matrix, scale, PLATFORM)
        for index, pivot in zip(root.order, root.pivots, strict=True):
            self.measure = minimum(self.measure, pivot / scale[index])
        # W' D^-1 W of the last six, W the inverse of their L.
        w: list[list[Any]] = np.eye(PLATFORM).tolist()
        for i in range(PLATFORM):
            for j in range(i):
                lower = [root.factors.get((first + i, first + k), 0.0) for k in range(j, i)]
                w[i][j] = -_dot(lower, [w[k][j] for k in range(j, i)])
        inverse = [1.0 / pivot for pivot in root.pivots[first:]]
        self.compliance = np.zeros((PLATFORM, PLATFORM), dtype=object)
        for i in range(PLATFORM):
            for j in range(i + 1):
                value = _dot(inverse[i:], [w[k][i] * w[k][j] for k in range(i, PLATFORM)])
                self.compliance[i, j] = self.compliance[j, i] = value

    def load(self, wrench: Any) -> None:
        """A wrench on the platform: coordinates ``x`` and the columns' ``amounts``."""
        root, x = self.root, [0.0] * len(self.place)
        x[-PLATFORM:] = self.compliance @ wrench
        for j in reversed(range(len(x) - PLATFORM)):
            x[j] = -_dot([root.factors[i, j] for i in root.below[j]], [x[i] for i in root.below[j]])
        found = [x[root.place[i]] for i in range(len(x))]
        self.amounts = [_dot(c.row.values(), [found[i] for i in c.row]) for c in self.columns]
        self.x = {k: found[i] for k, i in self.place.items()}
        for k, row in self.follow.items():
            self.x[k] = _dot(row.values(), [self.x[c] for c in row])

    def program(self, inputs: dict[str, int], outputs: dict[str, Any]) -> Program:
        """These outputs of q and further inputs."""
        t = self.t
        rows = {name: t.lift(row) for name, row in outputs.items()}
        sizes = {"q": t.joints} | inputs
        return Program(sizes, len(self.elastic.parameters), rows, t.equations())


def _response(s: Solved) -> Program:
    s.factorise()
    wrench = s.t.tape.inputs("wrench", 6)
    size: Any = 0.0
    for value in wrench:
        size = maximum(size, absolute(value))
    # Of unit size, so that squares of tiny and huge loads neither vanish nor overflow.
    s.load(wrench / maximum(size, 1e-300))
    energies: dict[str, Any] = dict.fromkeys(s.elastic.names, 0.0)
    for column, amount in zip(s.columns, s.amounts, strict=True):
        energies[column.element] += 0.5 * column.rigidity * (amount * amount)
    total, square = sum(energies.values(), 0.0), size * size
    row = [value / maximum(total, 1e-300) for value in energies.values()]
    row += [value * square for value in energies.values()]
    row += [s.x[k] * size for k in range(PLATFORM)]
    return s.program(
        {"wrench": 6}, {"row": [*row, total * square, *s.compliance.ravel(), s.measure]}
    )


def _deflections(s: Solved) -> Program:
    s.factorise()
    s.load(s.t.tape.inputs("wrench", 6))
    amounts, rows = iter(s.amounts), []
    for bar in s.frame.bars:
        member = bar.member
        bends = [next(amounts) for _ in s.frame.columns(bar)][2:]
        phi = member.section[3] / (member.length * member.length)
        moved = [
            member.axes @ (node.map[:3] @ np.array([s.x[k] for k in node.own], dtype=object))
            for node in bar.ends
        ]
        shares = np.arange(PARTS + 1) / PARTS
        rows += [member.start + (member.end - member.start) * share for share in shares]
        for share in shares:
            across, _ = bent(share, member.length, phi)
            own = [_dot(across, bends[k : k + 2]) for k in (0, 2)] if bends else [0.0, 0.0]
            rows.append(moved[0] + (moved[1] - moved[0]) * share + member.axes[:, 1:] @ own)
    return s.program({"wrench": 6}, {"rows": np.ravel(rows), "measure": [s.measure]})


def _columns(s: Solved) -> Program:
    entries = [
        (sqrt(column.rigidity) * value, i, j)
        for j, column in enumerate(s.columns)
        for i, value in column.row.items()
    ]
    values, rows, columns = zip(*entries, strict=True)
    owners = [s.elastic.names.index(column.element) for column in s.columns]
    outputs = {"entries": values, "rows": rows, "columns": columns, "owners": owners}
    return s.program({}, outputs)
