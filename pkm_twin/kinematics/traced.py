# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The symbolic motion of a machine, solved for its unknowns, from which programs are written."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import (
    GEOMETRY,
    Expression,
    Numbers,
    Objects,
    Tape,
    adjoints,
    cross,
    snapped_all,
)
from pkm_twin.codegen.lu import SparseLU
from pkm_twin.codegen.program import (
    MAX_GROWTH,
    MIN_RELATIVE_DETERMINANT,
    STATE,
    STATE_INDEX,
    UNKNOWNS,
    Equations,
    previous_input_name,
)
from pkm_twin.kinematics.drives import LEADS, TOLERANCE_TIME, Drives
from pkm_twin.kinematics.limb_pose import LimbPose
from pkm_twin.kinematics.motion import FIXED, BaseMotion, Columns, Motion, Row, closure_jacobians
from pkm_twin.kinematics.scheme import Scheme
from pkm_twin.machine.geometry import build_sized_graph
from pkm_twin.machine.graph import Graph
from pkm_twin.machine.tree import Tree

if TYPE_CHECKING:
    from pkm_twin.kinematics.posed import PlatformFirstScheme

NO_NUMBERS: Final = np.zeros(0)
POSED: Final = "y"
"""Name of the unknowns in programs whose input is a pose."""


class Factors(NamedTuple):
    """Limbs in closed form, and factors of the closures, in one state of :class:`Traced`.

    ``jq``: derivatives of the independent closures by the drives; ``lu``: factors of those by the
    unknowns. ``solved``: equations of Newton's method; ``newton``: factors of their Jacobian.
    """

    limbs: Sequence[LimbPose]
    jq: Objects
    lu: SparseLU
    solved: Sequence[Row]
    newton: SparseLU


class Traced:
    """Symbolic motion of a machine as functions of inputs and geometric parameters."""

    unknowns_name, drives_name = UNKNOWNS, "q"

    def __init__(self, scheme: Scheme, more: Array = NO_NUMBERS, *, free: bool = False) -> None:
        self.scheme = scheme
        self.tape = Tape([*scheme.geometry.tolist(), *more.tolist()], free=free)
        given = self.tape.inputs(GEOMETRY, len(self.tape.reference))
        end = len(scheme.geometry)
        self.geometry = given[:end]
        self.graph: Graph = build_sized_graph(scheme.graph, self.geometry)
        self.more = given[end:]
        """Constant inputs in addition to the geometry, see :meth:`.Engine.kernel_with_inputs`."""
        self._span()

    def _span(self) -> None:
        """Build the spanning tree and the inputs of the actuated joints."""
        self.tree, self.joints = Tree(self.graph, first=self.scheme.tree.first), self.scheme.joints
        self.drives = Drives(self)
        self.target = LEADS if self.drives.others else self.drives_name
        self.q = self.tape.inputs(self.target, self.joints)
        """Positions of the leading drives: all drives, unless some are redundant."""

    def platform_first(self, scheme: PlatformFirstScheme) -> Traced:
        """Return the symbolic machine whose tree places the platform first, then the limbs."""
        other = copy(self)
        # Cached properties belong to this tree: do not copy them.
        vars(other).clear()
        vars(other).update(tape=self.tape, geometry=self.geometry, more=self.more)
        other.scheme, other.graph = scheme, scheme.attach_chain(self.graph)
        if scheme.by_pose:
            other.unknowns_name, other.drives_name = POSED, "pose"
        other._span()
        return other

    @property
    def reduced(self) -> Traced:
        """The symbolic machine whose forward kinematics have the fewest unknowns."""
        return self if self.scheme.reduced is None else self.platform_first(self.scheme.reduced)

    def _place(self, unknowns: Numbers) -> tuple[Motion, list[LimbPose], Objects]:
        """Return motion, limbs and all unknowns; constrained coordinates have their home values.

        :param unknowns: those that Newton's method solves.
        """
        x = np.array(self.tree.home, dtype=object)
        x[self.scheme.newton_unknowns[0]] = unknowns
        motion, limbs = self.scheme.place(self.tree, x, self.q)
        return motion, limbs, x

    def solve(self) -> None:
        """Place the machine by its unknowns, and factor its closures."""
        scheme, tree = self.scheme, self.tree
        self.margins: list[Expression] = []
        self.unknowns: Numbers = self.tape.inputs(self.unknowns_name, len(scheme.newton_unknowns[0]))
        if scheme.platform_pivots is not None:
            self.unknowns, growth = scheme.close_platform(tree, self.q, scheme.platform_pivots)
            self.margins = self.lift([MAX_GROWTH - growth])
        self.motion, self.limbs, self.x = self._place(self.unknowns)
        self.rows = self.motion.closures()
        self.ju, self.jq = closure_jacobians(tree, self.rows)
        self.lu = SparseLU(self.ju[scheme.independent][:, scheme.varying], scheme.pivots)
        self.solved = scheme.newton_rows(self.rows, self.limbs)
        self.newton = self.lu
        if self.limbs:
            self.newton = SparseLU(self._newton_jacobian(self.solved), scheme.newton_pivots)

    def _newton_jacobian(self, solved: Sequence[Row]) -> Objects:
        """Return the Jacobian of Newton's equations by the rates that Newton's method solves."""
        return closure_jacobians(self.tree, solved)[0][:, self.scheme.newton_unknowns[1]]

    @property
    def drive_scales(self) -> list[Any]:
        """Factors that make the leading joints' rates dimensionless."""
        joints = (self.graph.joints[name] for name in self.graph.leads)
        return [1.0 / self.tree.size if joint.slides else 1.0 for joint in joints]

    @property
    def pose_scales(self) -> list[Any]:
        """Factors that make pose coordinates dimensionless."""
        size = self.tree.size
        return [1.0 if c.axis is None else 1.0 / size for c in self.scheme.coordinates]

    def inputs(self, *names: str, **more: int) -> dict[str, int]:
        """Return the sizes of a program's inputs: one entry per drive for ``names``, and ``more``."""
        return dict.fromkeys(names, self.drives.count) | more

    def equations(self, **more: Any) -> tuple[Equations, ...]:
        """Return the equations that Newton's method solves at q, from a guess or a closed form.

        :param more: further fields of :class:`.Equations`.
        """
        if self.drives.others and "goal" not in more:
            more["goal"] = self.lift(self.drives.leading_inputs("q"))
            more["branch"] = [*more.pop("branch", ()), *self.lift(self.drives.tolerance_margins())]
        scheme, tree = self.scheme, self.tree
        branch = list(self.margins)
        systems = [(self.lu, [self.rows[k] for k in scheme.independent], scheme.varying)]
        if self.limbs:
            systems.append((self.newton, self.solved, scheme.newton_unknowns[1]))
        for lu, own, columns in systems:
            # Factors used before this call are in the results: their pivots must not vanish.
            if lu.used:
                branch += self.pivot_margins(lu, [row.scale for row in own], [tree.scales[k] for k in columns])
        determinant = self.determinant
        places, rates = scheme.newton_unknowns if scheme.platform_pivots is None else ([], [])
        step: Numbers = -self.newton.solve([row.value for row in self.solved]) if places else []
        rows: list[Any] = [0.0] * tree.unknown_rates
        for k, value in zip(rates, step, strict=True):
            rows[k] = value
        moved = self.motion.retract(self.x, rows)
        before = self.tape.inputs(previous_input_name(self.unknowns_name), len(places))
        state = self.tape.inputs(STATE, len(STATE_INDEX))
        onward = [x + state[STATE_INDEX.onward] * (x - last) for x, last in zip(self.unknowns, before, strict=False)]
        if not places:
            # Without unknowns there is no correction: check the result only.
            branch, determinant = [*branch, *self.lift([determinant - MIN_RELATIVE_DETERMINANT])], 1.0
        judged = [self.rows[k] for k in scheme.checked_closures]
        start: Sequence[Any] = []
        if places:
            start = self._guess() if scheme.start is None else scheme.start.solve_unknowns(tree, self.q)
        solved = Equations(
            self.target,
            self.lift([tree.home[k] for k in places]),
            self.lift(self.graph.lead_home),
            self.lift(start),
            self.retract(onward) if places else [],
            self.lift([moved[k] for k in places]),
            self.square(step, [tree.scales[k] for k in rates]),
            self.tape.lift(determinant),
            self.square([r.value for r in judged], [r.scale for r in judged]),
            scheme.start is None,
            [*branch, *more.pop("branch", ())],
            self.unknowns_name,
            **more,
        )
        return (solved,)

    def pivot_margins(self, lu: SparseLU, rows: Numbers, columns: Numbers) -> list[Expression]:
        """Return a margin that is positive if no pivot of ``lu`` vanishes; empty for a constant matrix.

        :param rows: factors that make rows and ``columns`` of the matrix dimensionless.
        """
        growth = lu.find_growth(rows, columns)
        return self.lift([MAX_GROWTH - growth]) if isinstance(growth, Expression) else []

    def retract(self, values: Numbers, rates: Numbers = ()) -> list[Expression]:
        """Return Newton's unknowns after a small step along ``rates``, with rotations normalised."""
        places, kept = self.scheme.newton_unknowns
        x, du = np.array(self.tree.home, object), np.zeros(self.tree.unknown_rates, object)
        x[places] = values
        if len(rates):
            du[kept] = rates
        moved = self.home.retract(x, du)
        return self.lift([moved[k] for k in places])

    @property
    def determinant(self) -> Any:
        """Determinant of all closures, divided by its value at home."""
        home = self._at_home
        result = home.newton.inverse_determinant / self.newton.inverse_determinant
        for here, there in zip(self.limbs, home.limbs, strict=True):
            for (slope, _), (at_home, _) in zip(here.slopes, there.slopes, strict=True):
                result = result * (slope / at_home)
        if self.scheme.constrained_rates:
            constraining = self._factor_constraining(self.ju, self.lu)
            at_home = self._factor_constraining(
                snapped_all(closure_jacobians(self.tree, self.home.closures())[0]), home.lu
            )
            result = result * (at_home.inverse_determinant / constraining.inverse_determinant)
        return result

    def _factor_constraining(self, ju: Objects, lu: SparseLU) -> SparseLU:
        """Factor the Jacobian of the constraining closures by the constrained rates."""
        scheme, table = self.scheme, ju[self.scheme.constraining_closures]
        constrained = ju[scheme.independent][:, scheme.constrained_rates]
        follow = np.array([lu.solve(column) for column in constrained.T], dtype=object).T
        matrix = table[:, scheme.constrained_rates] - table[:, scheme.varying] @ follow
        return SparseLU(matrix, scheme.constraining_pivots)

    @cached_property
    def home(self) -> Motion:
        """The motion at home."""
        return Motion(self.tree, self.tree.home, self.graph.lead_home)

    @cached_property
    def _at_home(self) -> Factors:
        """Limbs and factors at home."""
        scheme = self.scheme
        x = np.array(self.tree.home, dtype=object)
        _, limbs = scheme.place(self.tree, x, self.graph.lead_home)
        closures = self.home.closures()
        ju, jq = (snapped_all(m[scheme.independent]) for m in closure_jacobians(self.tree, closures))
        lu = newton = SparseLU(ju[:, scheme.varying], scheme.pivots)
        solved = scheme.newton_rows(closures, limbs)
        if limbs:
            newton = SparseLU(snapped_all(self._newton_jacobian(solved)), scheme.newton_pivots)
        return Factors(limbs, jq, lu, solved, newton)

    @property
    def _current_factors(self) -> Factors:
        """Limbs and factors in the current state."""
        jq = self.jq[self.scheme.independent]
        return Factors(self.limbs, jq, self.lu, self.solved, self.newton)

    def rates_of_joints(self, names: Sequence[str]) -> Objects:
        """Return rates of passive joints per rate of each drive, shape (names, n)."""
        return np.array([self._rates_by_closures(name, self._current_factors) for name in names], object)

    def _rates_by_closures(self, name: str, at: Factors) -> Objects:
        unit = np.eye(at.lu.size)[self.scheme.varying.index(self.tree.steps[name].rate)]
        return -(at.jq.T @ at.lu.solve_transposed(unit))

    def fast_rates_of_joints(self, names: Sequence[str], *, home: bool = False) -> Objects:
        """Return :meth:`rates_of_joints`, with few operations for joints that set a limb's length.

        :param home: return the rates at home instead of the present state.
        """
        at, kept = self._at_home if home else self._current_factors, self.scheme.newton_unknowns[1]
        reaches = {limb.reach: pose for limb, pose in zip(self.scheme.limbs, at.limbs, strict=True)}
        bodies = {step.joint: link.body for link in self.tree.links.values() for step in link.steps}
        rows = []
        for name in names:
            columns: Columns = {("u", self.tree.steps[name].rate): 1.0}
            if bodies[name] in reaches:
                columns = reaches[bodies[name]].reach_rates()
            if not all(kind == "q" or k in kept for kind, k in columns):
                rows.append(self._rates_by_closures(name, at))
                continue
            by_q: Any = np.array([columns.get(("q", k), 0.0) for k in range(self.joints)], object)
            if kept:
                by_u = [columns.get(("u", k), 0.0) for k in kept]
                table = closure_jacobians(self.tree, at.solved)[1]
                by_q = by_q - table.T @ at.newton.solve_transposed(by_u)
            rows.append(by_q)
        return np.array(rows, dtype=object)

    def _guess(self) -> list[Expression]:
        """Return a guess of the unknowns, exact to second order: the tangent at home, corrected once.

        The correction uses the factors at home, so it costs less than a Newton step from the tangent.
        """
        scheme, home = self.scheme, self.tree.home
        _, jq, lu, _, newton = self._at_home
        away = self.q - self.graph.lead_home
        # The columns at home are constants: an evaluation only multiplies by them.
        columns = snapped_all([self._all_rates(-lu.solve(jq[:, j])) for j in range(self.joints)])
        moved = self.home.retract(home, columns.T @ away)
        tangent = [moved[k] for k in scheme.newton_unknowns[0]]
        motion, limbs, _ = self._place(tangent)
        solved = scheme.newton_rows(motion.closures(), limbs)
        return self.retract(tangent, -newton.solve([row.value for row in solved]))

    def lift(self, values: Numbers) -> list[Expression]:
        """Convert results, which may be numbers, to expressions."""
        return [self.tape.lift(value) for value in values]

    def square(self, values: Numbers, scales: Numbers) -> Expression:
        """Return the sum of the squares of scaled values."""
        total: Any = 0.0
        for value, scale in zip(values, scales, strict=True):
            part = value * scale
            total = total + part * part
        return self.tape.lift(total)

    def gradient(self, sums: Sequence[tuple[Any, Any]], by: Sequence[Expression]) -> list[Any]:
        """Differentiate a sum of products of results and factors while the closures stay satisfied.

        The unknowns x follow from f(x, q, g) = 0: with J' m = ds/du, J = df/du, the derivative is
        ds - m df (adjoint of the implicit function theorem).
        """
        found = adjoints(sums, [*by, *self.unknowns])
        direct = found[: len(by)]
        by_x: list[Any] = [0.0] * len(self.x)
        places, rates = self.scheme.newton_unknowns
        for k, value in zip(places, found[len(by) :], strict=True):
            by_x[k] = value
        by_rates = self._convert_to_rates(by_x)
        multipliers = self.newton.solve_transposed([by_rates[k] for k in rates])
        values = [row.value for row in self.solved]
        through = adjoints(list(zip(values, multipliers, strict=True)), by)
        return [a - b for a, b in zip(direct, through, strict=True)]

    def _convert_to_rates(self, by_x: Sequence[Any]) -> list[Any]:
        """Convert derivatives by the unknowns to derivatives by their rates, see ``Motion.retract``."""
        result: list[Any] = [0.0] * self.tree.unknown_rates
        for link in self.tree.links.values():
            for step in link.steps:
                k, r = step.position, step.rate
                if step.actuated:
                    continue
                if step.circle:
                    result[r] = self.x[k] * by_x[k + 1] - self.x[k + 1] * by_x[k]
                    continue
                if not (step.ball or step.free):
                    result[r] = by_x[k]
                    continue
                w, v = self.x[k], np.array(self.x[k + 1 : k + 4], dtype=object)
                dw, dv = by_x[k], np.array(by_x[k + 1 : k + 4], dtype=object)
                result[r : r + 3] = list((w * dv - dw * v + cross(v, dv)) * 0.5)
                if step.free:
                    result[r + 3 : r + 6] = by_x[k + 4 : k + 7]
        return result

    def set_rates(self, qd: Numbers) -> Objects:
        """Compute all rates from qd; return those of the unknowns."""
        kept = self.scheme.independent
        self.u = self._all_rates(self.lu.solve(-(self.jq[kept] @ np.asarray(qd, dtype=object))))
        self.qd = qd
        self.motion.set_rates(self.u, qd)
        self.drives.check_dependent("qd", qd, self.u, TOLERANCE_TIME)
        return self.u

    def set_accelerations(self, qdd: Numbers, base: BaseMotion = FIXED) -> None:
        """Compute all accelerations from qdd; call :meth:`set_rates` before.

        Closures are relative to the base, so the unknown accelerations do not depend on its motion.
        """
        kept = self.scheme.independent
        self.motion.set_accelerations(np.zeros(self.tree.unknown_rates), qdd)
        bias = [self.rows[k].bias() for k in kept]
        self.du = self._all_rates(-self.lu.solve(bias))
        self.drives.check_dependent("qdd", qdd, self.du, TOLERANCE_TIME * TOLERANCE_TIME)
        self.motion.set_rates(self.u, self.qd, base)
        self.motion.set_accelerations(self.du, qdd)

    def rate_columns(self) -> list[Objects]:
        """Return rates of the unknowns per joint rate."""
        kept = self.scheme.independent
        return [self._all_rates(self.lu.solve(-self.jq[kept][:, j])) for j in range(self.joints)]

    def _all_rates(self, varying: Numbers) -> Objects:
        """Return all unknown rates from those that are solved; constrained rates are zero."""
        rates = np.zeros(self.tree.unknown_rates, dtype=object)
        rates[self.scheme.varying] = varying
        return rates

    def twists(self, body: str, at: Any, columns: Sequence[Objects]) -> list[tuple[Any, Any]]:
        """Return the velocity of a body's point at position ``at``, and the angular velocity, per joint.

        :param columns: :meth:`rate_columns`.
        """
        linear, angular = self.motion.linear_jacobian(body, at), self.motion.angular_jacobian(body)
        result = []
        for j, u in enumerate(columns):
            pair = []
            for part in (linear, angular):
                total: Any = np.zeros(3, dtype=object)
                for (kind, k), column in part.items():
                    if kind == "u":
                        total = total + np.asarray(column, dtype=object) * u[k]
                    elif k == j:
                        total = total + column
                pair.append(total)
            result.append((pair[0], pair[1]))
        return result
