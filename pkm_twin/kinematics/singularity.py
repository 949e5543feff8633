# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Measure the distance of a machine from all kinds of singularities: 0 at one, 1 at best.

The measure is the smaller one of two numbers. Bodies united by fixed joints count as one. The motion
of a body is (v, L omega): v of the centre of its joints, L the distance of the farthest joint from
the centre, at least the platform's. Errors of closures are lengths, angles times the platform's L.
Hence the measure does not depend on units, scale or the reference point.

**Held**: with locked actuated joints, how far do the bodies move if a closure has an error of one?
A = d(closures)/d(rates), k rates and r closures, possibly redundant, B = d(bodies)/d(rates):

    held = (k / 2 sqrt(r)) / |B A+|,   |.|^2 the sum of squares,   |B A+|^2 = tr((A'A)^-1 B'B)

An error of one needs a motion of at least one half on both sides, hence the bound of 1. The number
is zero if anything can move while the actuators are locked: in direct-kinematic singularities, and
in constraint singularities of platform, limbs or intermediate bodies. Closures here include all
real constraints, for example the couple that a pair of rods transmits in a parallelogram. The
structure determines which joints are closures, see :func:`find_tree_joints`.

**Moved**: the platform's twist T per joint rate, shape (6, n), compared with each body's motion D:

    moved = min over bodies sqrt(n) / |D T+|,          |D T+|^2 = tr((T'T)^-1 D'D)

The platform is one of the bodies, hence the bound of 1. The number is zero if joints can move while
the platform rests: at the edge of the workspace. If the pose has no angle, the platform is a point:
T is the velocity of the reference point, shape (3, n).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.cholesky import SparseCholesky, trace_over
from pkm_twin.codegen.expressions import Numbers, Objects, norm, plain
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.operations import maximum, minimum, sqrt
from pkm_twin.codegen.program import Program
from pkm_twin.errors import SingularityError
from pkm_twin.kinematics.constraints import rod_pair_equation
from pkm_twin.kinematics.engine import Engine
from pkm_twin.kinematics.gradients import gradient_program
from pkm_twin.kinematics.linkage import Linkage
from pkm_twin.kinematics.motion import (
    Columns,
    Motion,
    Row,
    closure_jacobians,
    to_floats,
)
from pkm_twin.kinematics.traced import Traced
from pkm_twin.machine.graph import BASE, Graph, group_connected, weld
from pkm_twin.machine.tree import Tree


def singularity_kernel(engine: Engine) -> Kernel:
    """Compile the program that returns the singularity measure (1) at q."""
    return engine.kernel("singularity", _write_singularity_program)


def compile_singularity_gradient(engine: Engine) -> Kernel:
    """Compile the singularity measure's derivatives by q and by the geometry, times a weight."""

    def write(t: Traced) -> Program:
        by: dict[str, Numbers] = {"q": t.drives.variables("q"), "geometry": t.geometry}
        return gradient_program(t, _write_singularity_program(t), by)

    return engine.kernel("singularity gradient", write, free=True)


def find_tree_joints(graph: Graph) -> frozenset[str]:
    """Return the tree joints of a spanning tree in which the actuated joints are locked.

    Bodies connected by locked, fixed and screw joints are one part. A part's tree joint is the joint
    on its shortest path to the base, counted in joints. If several joints are, all of them are
    closures, so that the result does not depend on the order of entries.
    """
    rigid = [j for j in graph.joints.values() if j.actuated or not j.type.cost]
    parts = group_connected([BASE, *graph.bodies], [(j.inner, j.outer) for j in rigid])
    part = {body: k for k, bodies in enumerate(parts) for body in bodies}
    doors: list[list[tuple[int, str]]] = [[] for _ in parts]
    for joint in graph.joints.values():
        inner, outer = part[joint.inner], part[joint.outer]
        if inner != outer:
            doors[inner].append((outer, joint.name))
            doors[outer].append((inner, joint.name))
    depth, front = {part[BASE]: 0}, [part[BASE]]
    for here in front:
        for there, _ in doors[here]:
            if there not in depth:
                depth[there] = depth[here] + 1
                front.append(there)
    carriers = {joint.name for joint in rigid}
    for here in front[1:]:
        near = [name for there, name in doors[here] if depth[there] < depth[here]]
        carriers |= set(near if len(near) == 1 else ())
    return frozenset(carriers)


class KinematicCopy(Motion):
    """A second spanning tree of the same bodies, in the state of another motion.

    Virtual joints, which represent other parts, are left out.
    """

    def __init__(self, motion: Motion) -> None:
        graph = weld(motion.graph)
        # Lock all drives, including redundant ones.
        true = {n: replace(j, follows=False) for n, j in graph.joints.items() if not j.virtual}
        self.graph: Graph = replace(graph, joints=true)
        self.tree = Tree(self.graph, find_tree_joints(self.graph))
        # Express errors of closures in metres.
        self.tree.size = 1.0
        self._found = motion
        self.origin: dict[str, Any] = {BASE: np.zeros(3)}
        self.axis: dict[int, Any] = {}
        for link in self.tree.links.values():
            free = link.joint is None
            at = graph.body_scale(link.body)[0] if free else self.tree.at[link.body]
            self.origin[link.body] = motion.point(link.body, at)
            for step in link.steps:
                if not (step.ball or step.free):
                    body = link.body if step.beyond else link.parent
                    self.axis[id(step)] = motion.direction(body, step.axis)

    def point(self, body: str, point: Array) -> Any:
        """Return the position of a point of a body."""
        return self._found.point(body, point)

    def direction(self, body: str, vector: Array) -> Any:
        """Return a vector that is fixed in a body, in base axes."""
        return self._found.direction(body, vector)

    def closures(self) -> list[Row]:
        """Return the equations of all cut joints and rods, and of the couples of rod pairs."""
        rows = super().closures()
        for rod in self.graph.rods.values():
            if rod.pair is not None:
                # The equal lengths of a rod pair prevent rotation about the normal t x w of their plane.
                bodies, (start, end), pair = (rod.inner, rod.outer), rod.ends, np.asarray(rod.pair)
                points = self.point(rod.inner, start), self.point(rod.outer, end)
                vectors = self.direction(rod.inner, pair), self.direction(rod.outer, pair)
                one = rod_pair_equation(rod.name, bodies, points, vectors, norm(plain(end - start)))
                rows.append(self._make_row(one, self._relative_columns(one)))
        return rows


def _write_singularity_program(t: Traced) -> Program:
    t.solve()
    outputs = {"measure": [t.tape.lift(singularity_measure(t))]}
    return Program(t.inputs("q"), 0, outputs, t.equations())


def singularity_measure(t: Traced) -> Any:
    """Return the singularity measure of a solved symbolic machine, whose rates are overwritten."""
    point = all(c.axis is not None for c in t.scheme.coordinates)
    return minimum(_constraint_singularity(t), _motion_singularity(t, point))


def singularity_at_home(graph: Graph) -> float:
    """Return the singularity measure at home numerically, with the platform's rotations.

    :raises SingularityError: something moves although the actuated joints are locked.
    """
    return numeric_singularity(Linkage(graph), graph.lead_home)


def numeric_singularity(linkage: Linkage, q: Array, *, point: bool = False) -> float:
    """Return the singularity measure at joint positions near home numerically.

    :param q: of the actuated joints that lead, shape (m,); ``point``: the pose has no angle.
    :raises SingularityError: something moves although the actuated joints are locked.
    """
    state = _NumericTraced(linkage, q)
    return float(minimum(_constraint_singularity(state), _motion_singularity(state, point)))


class _NumericTraced:
    """Numerical stand-in for :class:`Traced`, with the attributes that the measure reads."""

    def __init__(self, linkage: Linkage, q: Array) -> None:
        self.graph, self.joints = linkage.graph, linkage.joints
        x = linkage.close(q)
        if x is None:
            raise SingularityError("q", (), 0.0, 1e-9)
        self.motion, rows = linkage.evaluate_state(x, q)
        ju, jq = (to_floats(m) for m in closure_jacobians(linkage.tree, rows))
        if ju.size and np.linalg.matrix_rank(ju, 1e-9) < ju.shape[1]:
            raise SingularityError("home", (), 0.0, 1e-9)
        self._rates = -np.linalg.lstsq(ju, jq, rcond=1e-9)[0]

    def rate_columns(self) -> list[Array]:
        """Rates of the unknowns per joint rate."""
        return list(self._rates.T)


def _constraint_singularity(t: Traced | _NumericTraced) -> Any:
    """Return the number **Held**, from the closures while the actuated joints are locked."""
    placed = KinematicCopy(t.motion)
    unknown = placed.tree.unknown_rates
    if not unknown:
        return 1.0
    _, radius = placed.graph.body_scale(placed.graph.platform)
    errors = [
        {key: v * (radius if row.is_angular else row.scale) for key, v in row.columns.items()}
        for row in placed.closures()
        if any(kind == "u" for kind, _ in row.columns)
    ]
    bodies = []
    for name in placed.graph.bodies:
        centre, reach = placed.graph.body_scale(name)
        linear = placed.linear_jacobian(name, placed.point(name, centre))
        turning = placed.angular_jacobian(name)
        bodies += [{k: v[i] for k, v in linear.items()} for i in range(3)]
        bodies += [{k: reach * v[i] for k, v in turning.items()} for i in range(3)]
    response = trace_over(_gram(bodies, unknown), _gram(errors, unknown))
    return minimum(1.0, 0.5 * unknown / np.sqrt(len(errors)) / sqrt(response))


def _motion_singularity(t: Traced | _NumericTraced, point: bool) -> Any:
    """Return the number **Moved**, from the bodies' motions per platform twist.

    :param point: the pose has no angle, so the platform counts as its reference point.
    """
    n, graph = t.joints, weld(t.graph)
    rates = _TwistJacobians(t, graph)
    tool = (graph.origin, 0.0) if point else graph.body_scale(graph.platform)
    twist = rates.twist_jacobian(graph.platform, tool)[: 3 if point else 6]
    table = _gram([{("u", j): v for j, v in enumerate(row)} for row in twist], n)
    lower = {(a, b): table[a, b] for a in range(n) for b in range(a + 1)}
    # Keep pivots positive if the platform rests while a joint moves.
    size = t.motion.tree.size
    lengths = [1.0 if graph.joints[name].slides else size * size for name in graph.leads]
    root = SparseCholesky(lower, [table[k, k] + length for k, length in enumerate(lengths)])
    farthest: Any = float(n)
    for name in graph.bodies:
        if point or name != graph.platform:
            farthest = maximum(farthest, rates.response(name, root))
    return sqrt(n / farthest)


class _TwistJacobians:
    """Compute the bodies' twist Jacobians D = S U.

    S: a body's twist per rate of the tree joints between base and body. U: these rates per rate of
    the leading joints.
    """

    def __init__(self, t: Traced | _NumericTraced, graph: Graph) -> None:
        self.motion, self.graph, self.n = t.motion, graph, t.joints
        columns, own = t.rate_columns(), np.eye(t.joints)
        unknown = t.motion.tree.unknown_rates
        self._by_joints: dict[tuple[str, int], Any] = {("q", k): own[k] for k in range(t.joints)}
        for k in range(unknown):
            self._by_joints["u", k] = [column[k] for column in columns]
        self._halves: dict[tuple[str, int], list[Any]] = {}
        self._products: dict[tuple[tuple[str, int], tuple[str, int]], Any] = {}

    def tree_jacobian(self, name: str, frame: tuple[Any, Any]) -> dict[tuple[str, int], list[Any]]:
        """Return S: the body's scaled twist (6 entries) per rate of each tree joint, by joint.

        :param frame: the point of the body whose velocity is taken, and the length that multiplies
            the angular velocity.
        """
        centre, reach = frame
        linear = self.motion.linear_jacobian(name, self.motion.point(name, centre))
        turning = self.motion.angular_jacobian(name)
        still = [0.0] * 3
        return {
            k: [*linear.get(k, still), *(reach * v for v in turning.get(k, still))]
            for k in dict.fromkeys([*linear, *turning])
        }

    def twist_jacobian(self, name: str, frame: tuple[Any, Any]) -> list[list[Any]]:
        """Return D: the body's scaled twist (6 rows) per rate of each leading joint (columns)."""
        rows: list[list[Any]] = [[0.0] * self.n for _ in range(6)]
        for key, six in self.tree_jacobian(name, frame).items():
            for row, value in zip(rows, six, strict=True):
                for j, rate in enumerate(self._by_joints[key]):
                    row[j] = row[j] + value * rate
        return rows

    def response(self, name: str, root: SparseCholesky) -> Any:
        """Return tr((T'T)^-1 D'D), with T'T = L E L'.

        Computed from D, or from S'S and U (T'T)^-1 U', whichever takes fewer operations.
        """
        frame = self.graph.body_scale(name)
        columns = list(self.tree_jacobian(name, frame).items())
        total: Any = 0.0
        if len(columns) > self.n:
            for row in self.twist_jacobian(name, frame):
                half = root.forward(row)
                total = total + sum((v * v * e for v, e in zip(half, root.inverses, strict=True)), 0.0)
            return total
        for k, (key, six) in enumerate(columns):
            for other, others in columns[: k + 1]:
                entry: Any = sum((a * b for a, b in zip(six, others, strict=True)), 0.0)
                part = entry * self._product(key, other, root)
                total = total + (part if key == other else 2.0 * part)
        return total

    def _product(self, a: tuple[str, int], b: tuple[str, int], root: SparseCholesky) -> Any:
        """Return an entry of U (T'T)^-1 U'."""
        pair = (min(a, b), max(a, b))
        if pair not in self._products:
            for key in pair:
                if key not in self._halves:
                    self._halves[key] = root.forward(self._by_joints[key])
            left, right = (self._halves[key] for key in pair)
            parts = zip(left, root.inverses, right, strict=True)
            self._products[pair] = sum((x * e * y for x, e, y in parts), 0.0)
        return self._products[pair]


def _gram(rows: list[Columns], size: int) -> Objects:
    """Return R'R of the rows R by unknown rates, shape (size, size)."""
    table = np.zeros((size, size), dtype=object)
    for row in rows:
        entries = [(k, value) for (kind, k), value in row.items() if kind == "u"]
        for (i, a), (j, b) in combinations_with_replacement(entries, 2):
            table[i, j] = table[i, j] + a * b
            if i != j:
                table[j, i] = table[i, j]
    return table
