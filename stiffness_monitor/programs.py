# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The elastic frame of a robot as compiled programs of q.

K = sum of d b b' over the frame's columns is factorised once, the platform's six displacements
last: their Schur complement is the platform's stiffness, C its inverse, and the displacements x
under a wrench follow without another solution. An element has the energy sum of d (b . x)^2 / 2.

Points, lengths, moduli, diameters and compliances are run-time inputs; a program depends only on
the machine's structure, and on which compliances are zero, finite or free.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property, partial
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Indices
from pkm_twin.codegen.cholesky import SparseCholesky
from pkm_twin.codegen.expressions import GEOMETRY
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.lu import Order, SparseLU, independent_rows, pivot_order
from pkm_twin.codegen.operations import absolute, less, maximum, minimum, select, sqrt
from pkm_twin.codegen.program import MAX_GROWTH, Program
from pkm_twin.kinematics.motion import Motion
from pkm_twin.kinematics.traced import Traced
from pkm_twin.robot.robot import Robot
from stiffness_monitor.frame import PLATFORM, Frame, Row, bending_shape, sum_forms
from stiffness_monitor.numbers import constant_pattern, list_numbers, substitute_numbers
from stiffness_monitor.structure import FREE, evaluate_plan, plan_structure

DEFLECTION_PARTS: Final = 4
"""Parts that a member is divided into to draw its deflection."""
NO_PARAMETERS: Final = np.zeros(0)
"""Empty parameters of the programs: kernels hold all numbers."""
MIN_SCALE: Final = 1e-200
"""Lower bound of divisors that are zero in a mechanism, far below every stiffness."""


@dataclass(frozen=True)
class DependentCoordinates:
    """Hold the frame coordinates ``chosen`` that the constraint ``rows`` of closures determine.

    ``sample``: index of the engine state at which the closures' rank is largest; 0, home, if
    possible.
    """

    rows: tuple[int, ...]
    chosen: tuple[int, ...]
    pivots: Order
    sample: int


class Elastic:
    """Build a robot's elastic frame: its plan, its numbers and its programs.

    Machines of one structure share the programs: all numbers are run-time inputs. ``names``: of the
    elements, in the order of energies.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot, self.structure = robot, robot.elastic
        self.plan = plan_structure(robot.graph, self.structure)
        soft = [v[0] for s in self.plan.supports for v in s.compliance if v.__class__ is tuple]
        bodies = [member.body for member in self.plan.members]
        self.names = self.structure.order or tuple(dict.fromkeys([*bodies, *soft]))
        self._kernels: dict[str, Kernel] = {}

    @cached_property
    def dependent_coordinates(self) -> DependentCoordinates | None:
        """Dependent coordinates, from the closures' ranks at and near home; None without closures.

        :raises ParameterError: the closures hold the platform itself.
        """
        if not self.plan.closures:
            return None
        engine = self.robot.engine
        frames = [self._build_frame(Motion(engine.tree, x, q)) for x, q in engine.samples]
        tables = np.array([frame.build_constraint_matrix() for frame in frames], np.float64)
        # The frame may be singular at home: take the samples of the largest rank.
        ranks = np.array([len(independent_rows(table[None, :, PLATFORM:])) for table in tables])
        most = ranks == ranks.max()
        rows, chosen = frames[0].choose_dependents(tables[most])
        pivots = pivot_order(tables[most][:, rows][:, :, chosen])
        return DependentCoordinates(tuple(rows), tuple(chosen), pivots, int(most.argmax()))

    def _build_frame(self, motion: Motion) -> Frame:
        """Return the frame in a numeric state, every rigidity and compliance one."""
        model = evaluate_plan(self.plan, motion.point, motion.direction, lambda _: [1.0] * 4, lambda *_: 1.0)
        return Frame(model, static=True)

    @cached_property
    def _key(self) -> str:
        tree, dependents = self.robot.engine.tree, self.dependent_coordinates
        pattern = constant_pattern(self.structure, tree)
        own = self.robot.graph.key if dependents is not None and dependents.sample else ""
        return repr((_plain_data(self.plan), pattern, self.names, dependents, own))

    def kernel(self, name: str, write: Callable[[SymbolicFrame], Program], *, free: bool = False) -> Kernel:
        """Return the compiled program of all numbers of the machine, as :meth:`Engine.kernel`."""
        known = self._kernels.get(name)
        if known is None:
            numbers = np.array(list_numbers(self.structure), np.float64)
            known = self._kernels[name] = self.robot.engine.kernel_with_inputs(
                numbers, name, partial(self._write_program, write), self._key, free=free
            )
        return known

    def _write_program(self, write: Callable[[SymbolicFrame], Program], t: Traced) -> Program:
        return write(SymbolicFrame(t, self))

    @cached_property
    def compliance(self) -> Kernel:
        """Program from q to C (36) of the platform and the pivot ratio of :attr:`response`."""
        return self.kernel("platform compliance", _write_compliance)

    @cached_property
    def response(self) -> Kernel:
        """Program from q and wrench to factors, energies, deflection, energy, C, pivot ratio.

        The measure is the least pivot over its diagonal entry, which no choice of units changes: 0
        where the frame is a mechanism. Factors are zero where the wrench is.
        """
        return self.kernel("platform response", write_response)

    @cached_property
    def deflections(self) -> Kernel:
        """Program from q and wrench to members' points and displacements, (members, 2, k, 3)."""
        return self.kernel("member deflections", _write_deflections)

    @cached_property
    def columns(self) -> Kernel:
        """Program from q to the columns sqrt(d) b: entries, rows, columns, columns' elements."""
        return self.kernel("elastic columns", _write_columns)

    @cached_property
    def column_places(self) -> tuple[Indices, Indices, Indices]:
        """Rows, columns and columns' elements of the entries of :attr:`columns`, the same in every pose."""
        (_, *places), _ = self.columns(NO_PARAMETERS, self.robot.graph.home)
        rows, columns, owner = (place.astype(int) for place in places)
        return rows, columns, owner


def _plain_data(value: Any) -> Any:
    """Convert a plan to plain data, without the machine's numbers."""
    if isinstance(value, np.ndarray):
        return None
    if isinstance(value, float):
        return value if value in (0.0, FREE) else None
    if is_dataclass(value):
        return [_plain_data(getattr(value, field.name)) for field in fields(value)]
    return [_plain_data(one) for one in value] if isinstance(value, tuple) else value


def _sum_products(a: Iterable[Any], b: Iterable[Any]) -> Any:
    return sum((x * y for x, y in zip(a, b, strict=True)), 0.0)


class SymbolicFrame:
    """Express the elastic frame of a solved motion.

    ``dependent_rows``: linear forms of the dependent coordinates in the independent ones. ``place``:
    index of each independent coordinate. ``columns``: deformation modes by the independent
    coordinates, first those of the members in order, then those of joints.
    """

    def __init__(self, t: Traced, elastic: Elastic) -> None:
        t.solve()
        self.t, self.elastic = t, elastic
        self.structure, self.rigidities = substitute_numbers(elastic.structure, t.graph, t.more)
        self.plan = plan_structure(t.graph, self.structure)
        self.frame = frame = self._build_frame(t.motion)
        self.measure: Any = 1.0
        self.dependent_rows = (
            {} if elastic.dependent_coordinates is None else self._solve_closures(elastic.dependent_coordinates)
        )
        left = (k for k in range(frame.size) if k not in self.dependent_rows)
        self.place = {k: i for i, k in enumerate(left)}
        columns = [column for bar in frame.bars for column in frame.columns(bar)]
        # Express the columns by the independent coordinates.
        self.columns = [
            column._replace(
                row={self.place[k]: value for k, value in _substitute(column.row, self.dependent_rows).items()}
            )
            for column in (*columns, *frame.springs)
        ]

    def _build_frame(self, motion: Motion) -> Frame:
        compliances = self.structure.compliances
        model = evaluate_plan(
            self.plan,
            motion.point,
            motion.direction,
            self.rigidities.__getitem__,
            lambda joint, k: compliances[joint][k],
        )
        return Frame(model, static=True)

    def _solve_closures(self, chosen: DependentCoordinates) -> dict[int, Row]:
        t, assumed, reference_motion = self.t, self.t.tape.assumed, self.t.home
        if chosen.sample:
            reference_motion = Motion(t.tree, *self.elastic.robot.engine.samples[chosen.sample])
            # The reference state is valid for this geometry only.
            assumed += [(e, e.value) for e in t.tape.inputs(GEOMETRY, len(t.tape.reference))]
        dependent_rows, lu, _ = solve_dependents(self.frame, chosen)
        _, home_factors, residuals = solve_dependents(self._build_frame(reference_motion), chosen)
        # A redundant closure must stay redundant with other numbers: assume that its residual is zero. Residuals
        # may be 1e-6, a thousand times the tolerance of assumed numbers.
        assumed += [(e * 1e-3, 0.0) for e in t.lift(residuals)]
        # The measure is zero where the closures do not determine the dependent coordinates.
        self.measure = 1.0 / maximum(absolute(lu.inverse_determinant / home_factors.inverse_determinant), MIN_SCALE)
        growth = lu.find_growth(home_factors.inverse_pivots, np.ones(lu.size))
        self.measure = select(less(growth, MAX_GROWTH), self.measure, 0.0)
        return dependent_rows

    def factorise(self) -> None:
        """Factorise the stiffness; set the platform's ``compliance`` and the frame's ``measure``.

        K = sum of d b b' over the columns is the 2UPR-RPU paper's sum of J_i K_i J_i' (equations 33
        and 34) with the limbs' inner coordinates, last the platform's; C = K^-1 there (equation 35).
        """
        n, first = len(self.place), len(self.place) - PLATFORM
        matrix: dict[tuple[int, int], Any] = {(i, i): 0.0 for i in range(n)}
        for column in self.columns:
            row = sorted(column.row.items())
            for at, (i, x) in enumerate(row):
                scaled = column.rigidity * x
                for j, y in row[: at + 1]:
                    matrix[i, j] = matrix.get((i, j), 0.0) + scaled * y
        scale = [maximum(matrix[i, i], MIN_SCALE) for i in range(n)]
        self.root = root = SparseCholesky(matrix, scale, PLATFORM)
        for index, pivot in zip(root.order, root.pivots, strict=True):
            self.measure = minimum(self.measure, pivot / scale[index])
        # W' D^-1 W of the last six, W the inverse of their L.
        w: list[list[Any]] = np.eye(PLATFORM).tolist()
        for i in range(PLATFORM):
            for j in range(i):
                lower = [root.factors.get((first + i, first + k), 0.0) for k in range(j, i)]
                w[i][j] = -_sum_products(lower, [w[k][j] for k in range(j, i)])
        inverse = [1.0 / pivot for pivot in root.pivots[first:]]
        self.compliance = np.zeros((PLATFORM, PLATFORM), dtype=object)
        for i in range(PLATFORM):
            for j in range(i + 1):
                value = _sum_products(inverse[i:], [w[k][i] * w[k][j] for k in range(i, PLATFORM)])
                self.compliance[i, j] = self.compliance[j, i] = value

    def apply_wrench(self, wrench: Any) -> None:
        """Apply a wrench to the platform; set coordinates ``x`` and the columns' ``deformations``.

        The platform moves by C P; elements move with it, and their work is the wrench's (2UPR-RPU
        paper, equations 29, 31 and 32).
        """
        root, x = self.root, [0.0] * len(self.place)
        x[-PLATFORM:] = self.compliance @ wrench
        for j in reversed(range(len(x) - PLATFORM)):
            x[j] = -_sum_products([root.factors[i, j] for i in root.below[j]], [x[i] for i in root.below[j]])
        ordered = [x[root.place[i]] for i in range(len(x))]
        self.deformations = [_sum_products(c.row.values(), [ordered[i] for i in c.row]) for c in self.columns]
        self.x = {k: ordered[i] for k, i in self.place.items()}
        for k, row in self.dependent_rows.items():
            self.x[k] = _sum_products(row.values(), [self.x[c] for c in row])

    def energies(self) -> list[Any]:
        """Return the strain energies U_ij of the elements under the load, in their order.

        Of bars and joints: W' C_ij W / 2 of the 2UPR-RPU paper (equations 4, 9, 14 and 26), here
        d (b . x)^2 / 2 summed over an element's columns.
        """
        energies: dict[str, Any] = dict.fromkeys(self.elastic.names, 0.0)
        for column, amount in zip(self.columns, self.deformations, strict=True):
            energies[column.element] += 0.5 * column.rigidity * (amount * amount)
        return list(energies.values())

    def program(self, inputs: dict[str, int], outputs: dict[str, Any]) -> Program:
        """Return the program from q and further inputs to these outputs."""
        t = self.t
        rows = {name: t.lift(row) for name, row in outputs.items()}
        sizes = t.inputs("q") | inputs
        return Program(sizes, 0, rows, t.equations())


def solve_dependents(frame: Frame, chosen: DependentCoordinates) -> tuple[dict[int, Row], SparseLU, list[Any]]:
    """Solve the closures for the chosen coordinates.

    :returns: their rows of the other coordinates, the factors of the system, and the residuals of
        the redundant closures, which must be zero.
    """
    table = frame.build_constraint_matrix()[list(chosen.rows)]
    lu = SparseLU(table[:, list(chosen.chosen)], chosen.pivots)
    others = sorted({k for r in chosen.rows for k in frame.constraints[r]} - set(chosen.chosen))
    solutions = [lu.solve(-table[:, k]) for k in others]
    dependent_rows = {c: sum_forms((others, [one[i] for one in solutions])) for i, c in enumerate(chosen.chosen)}
    redundant = (row for r, row in enumerate(frame.constraints) if r not in chosen.rows)
    residuals = [value for row in redundant for value in _substitute(row, dependent_rows).values()]
    return dependent_rows, lu, residuals


def _substitute(row: Row, dependent_rows: dict[int, Row]) -> Row:
    """Eliminate dependent coordinates from a linear form."""
    terms = [(dependent_rows.get(k, {k: 1.0}), value) for k, value in row.items()]
    return sum_forms(*((own, [value * f for f in own.values()]) for own, value in terms))


def _write_compliance(s: SymbolicFrame) -> Program:
    s.factorise()
    return s.program({}, {"compliance": s.compliance.ravel(), "measure": [s.measure]})


def write_response(s: SymbolicFrame) -> Program:
    """Write the program of factors, energies, deflection, energy, C and pivot ratio."""
    s.factorise()
    wrench = s.t.tape.inputs("wrench", 6)
    scale: Any = 0.0
    for value in wrench:
        scale = maximum(scale, absolute(value))
    # Scale the load to unit size, so that squares of tiny or huge loads neither underflow nor overflow.
    s.apply_wrench(wrench / maximum(scale, 1e-300))
    # U_ij, U = sum of U_ij = P' C P / 2 and mu_ij = U_ij / U (2UPR-RPU paper, equations 37 and 38).
    energies, square = s.energies(), scale * scale
    total = sum(energies, 0.0)
    factors = [energy / maximum(total, 1e-300) for energy in energies]
    row = [*factors, *(energy * square for energy in energies)]
    row += [s.x[k] * scale for k in range(PLATFORM)]
    return s.program({"wrench": 6}, {"row": [*row, total * square, *s.compliance.ravel(), s.measure]})


def _write_deflections(s: SymbolicFrame) -> Program:
    s.factorise()
    s.apply_wrench(s.t.tape.inputs("wrench", 6))
    amounts, rows = iter(s.deformations), []
    for bar in s.frame.bars:
        member = bar.member
        bends = [next(amounts) for _ in s.frame.columns(bar)][2:]
        phi = member.section[3] / (member.length * member.length)
        moved = [member.axes @ (node.map[:3] @ np.array([s.x[k] for k in node.own], dtype=object)) for node in bar.ends]
        shares = np.arange(DEFLECTION_PARTS + 1) / DEFLECTION_PARTS
        rows += [member.start + (member.end - member.start) * share for share in shares]
        for share in shares:
            across, _ = bending_shape(share, member.length, phi)
            own = [_sum_products(across, bends[k : k + 2]) for k in (0, 2)] if bends else [0.0, 0.0]
            rows.append(moved[0] + (moved[1] - moved[0]) * share + member.axes[:, 1:] @ own)
    return s.program({"wrench": 6}, {"rows": np.ravel(rows), "measure": [s.measure]})


def _write_columns(s: SymbolicFrame) -> Program:
    entries = [
        (sqrt(column.rigidity) * value, i, j) for j, column in enumerate(s.columns) for i, value in column.row.items()
    ]
    values, rows, columns = zip(*entries, strict=True)
    owners = [s.elastic.names.index(column.element) for column in s.columns]
    outputs = {"entries": values, "rows": rows, "columns": columns, "owners": owners}
    return s.program({}, outputs)
