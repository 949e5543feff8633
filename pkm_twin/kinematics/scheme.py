# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Choose how a graph's equations are solved: independent closures, pivots, pose coordinates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import combinations
from typing import Any, Final, Protocol

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import Numbers, Objects
from pkm_twin.codegen.key import EMPTY, ProgramKey
from pkm_twin.codegen.lu import Order, independent_rows, pivot_order
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics import pose as poses
from pkm_twin.kinematics.diagnosis import find_small_deviations, mobility_error, singular_home_error
from pkm_twin.kinematics.iterations import RELATIVE_RANK_TOLERANCE
from pkm_twin.kinematics.limb_pose import Limb, LimbPose, place_in_order
from pkm_twin.kinematics.limbs import find_hanging_limbs
from pkm_twin.kinematics.linkage import Linkage, count_rank
from pkm_twin.kinematics.motion import Motion, Row, closure_jacobians, to_floats
from pkm_twin.kinematics.pose import Coordinate
from pkm_twin.kinematics.spins import null_space
from pkm_twin.kinematics.three_rods import find_three_rods
from pkm_twin.machine.geometry import describe_pattern, list_geometry
from pkm_twin.machine.graph import BASE, Graph
from pkm_twin.machine.tree import Step, Tree

MIN_DRIVE_MOTION: Final = 1e-6
"""Smallest dimensionless motion of a drive at home, and smallest determinant of a choice of leading
drives relative to the best choice: below, rounding decides."""

MIN_POSE_MOTIONS: Final = (1e-3, 1e-6)
"""Smallest dimensionless motions of the platform along a pose coordinate: above any file's rounding,
and, if too few coordinates move so far, above floating-point rounding."""


class ClosedFormStart(Protocol):
    """A closed form of the forward kinematics, from which Newton's method starts."""

    def solve_unknowns(self, tree: Tree, q: Numbers) -> list[Any]:
        """Return the tree's unknowns at q, numerically or symbolically."""

    def find_conditions(self, motion: Motion) -> list[Any]:
        """Return margins that are all positive if placed bodies are in the closed form's assembly."""

    def find_gap(self, tree: Tree, q: Numbers) -> tuple[str, float] | None:
        """Return the joint or rod that cannot close at q, and its gap, m; None: unknown."""
        return None


class Scheme(Linkage):
    """A linkage with pose coordinates, and how its equations are solved."""

    def __init__(
        self,
        graph: Graph,
        coordinates: Sequence[Coordinate],
        first: tuple[str, ...] = (),
        start: ClosedFormStart | None = None,
    ) -> None:
        super().__init__(graph, first)
        self._start = start
        self.coordinates = tuple(coordinates)

    @cached_property
    def geometry(self) -> Array:
        """Geometric parameters that programs take as inputs, shape (k,)."""
        return np.array(list_geometry(self.graph), np.float64)

    @cached_property
    def structure(self) -> ProgramKey:
        """Key of everything that programs depend on: machines of the same structure share programs."""
        return EMPTY.extend(
            repr(
                (
                    self.graph.topology,
                    describe_pattern(self.tree),
                    self.coordinates,
                    self.start,
                    self.independent,
                    self.pivots,
                    self.order,
                    self.newton_pivots,
                    self.platform_pivots,
                )
            ),
            type(self.start or self),
        )

    @cached_property
    def start(self) -> ClosedFormStart | None:
        """The closed form of all unknowns; None if there is none."""
        return self._start or find_three_rods(self)

    @cached_property
    def independent(self) -> list[int]:
        """Indices of independent closures, which are solved; the others only verify the result.

        :raises ParameterError: something can move while the actuated joints are locked.
        """
        ju, _ = self._sampled_jacobians
        rows = independent_rows(ju[:, :, self.varying])
        if len(rows) < len(self.varying):
            raise mobility_error(self)
        return rows

    @property
    def varying(self) -> list[int]:
        """Indices of the unknown rates that are solved: all but :attr:`constrained_rates`."""
        return list(range(self.tree.unknown_rates))

    @property
    def constrained_rates(self) -> list[int]:
        """Indices of the unknown rates whose coordinates the closures keep at home."""
        return []

    def varies(self, step: Step) -> bool:
        """Return whether a step is passive and not kept at its home value by closures."""
        return not step.actuated and step.rate not in self.constrained_rates

    def is_constrained(self, step: Step) -> bool:
        """Return whether a step is passive and kept at its home value by closures."""
        return not step.actuated and step.rate in self.constrained_rates

    @property
    def constraining_closures(self) -> list[int]:
        """Indices of the closures that keep the constrained coordinates at home."""
        return []

    @property
    def constraining_pivots(self) -> Order:
        """Elimination order of :attr:`constraining_closures` by :attr:`constrained_rates`."""
        return ()

    @cached_property
    def pivots(self) -> Order:
        """Elimination order of the independent closures by the unknowns, well conditioned near home."""
        return pivot_order(self._sampled_jacobians[0][:, self.independent][:, :, self.varying])

    @cached_property
    def order(self) -> tuple[str | Limb, ...]:
        """Bodies, and limbs in closed form, in the order in which they are placed."""
        limbs = find_hanging_limbs(self)
        inner = {body for limb in limbs for body in limb.bodies}
        return (*(body for body in self.tree.links if body not in inner), *limbs)

    @property
    def platform_pivots(self) -> Order | None:
        """Elimination order of the platform's closed form; None if there is none."""
        return None

    def close_platform(self, tree: Tree, q: Numbers, pivots: Order) -> tuple[list[Any], Any]:
        """Return the platform's unknowns in closed form, and the squared growth of rounding errors."""
        raise NotImplementedError

    @property
    def limbs(self) -> list[Limb]:
        """The limbs that are solved in closed form."""
        return [entry for entry in self.order if isinstance(entry, Limb)]

    @property
    def reduced(self) -> Any:
        """The machine with the platform placed before its limbs; None if that saves no unknowns."""
        return None

    @property
    def checked_closures(self) -> list[int]:
        """Indices of the closures whose residuals decide whether a state is accepted."""
        return list(range(len(self.parts)))

    @cached_property
    def newton_unknowns(self) -> tuple[list[int], list[int]]:
        """Indices of the unknowns and rates that Newton's method solves: not those of limbs."""
        inner = {body for limb in self.limbs for body in limb.bodies}
        places, rates = list(range(len(self.tree.home))), list(range(self.tree.unknown_rates))
        for link in self.tree.links.values():
            for step in link.steps:
                if self.is_constrained(step) or (self.varies(step) and link.body in inner):
                    size = 2 if step.circle else 1
                    places = [k for k in places if not 0 <= k - step.position < size]
                    rates.remove(step.rate)
        return places, rates

    def place(self, tree: Tree, x: Objects, q: Numbers) -> tuple[Motion, list[LimbPose]]:
        """Place all bodies; limbs in closed form write their unknowns into ``x``.

        :param tree: this linkage's tree, or the same tree with a symbolic geometry.
        """
        return place_in_order(tree, self.order, x, q)

    def newton_rows(self, rows: Sequence[Row], poses: Sequence[LimbPose]) -> list[Row]:
        """Return the equations of Newton's method: those that limbs in closed form leave."""
        limbs = {k for limb in self.limbs for k in limb.rows}
        return [rows[k] for k in self.independent if k not in limbs] + [row for pose in poses for row in pose.rows]

    @cached_property
    def newton_pivots(self) -> Order:
        """Elimination order of Newton's equations, well conditioned near home."""
        if not self.limbs:
            return self.pivots
        samples = []
        for x, q in self.samples:
            motion, poses = self.place(self.tree, np.array(x, dtype=object), q)
            table, _ = self.scaled_jacobians(self.newton_rows(motion.closures(), poses))
            samples.append(table[:, self.newton_unknowns[1]])
        return pivot_order(np.array(samples))

    @cached_property
    def inverse_pivots(self) -> Order:
        """Elimination order of closures and pose equations by the unknowns and q."""
        samples = []
        for x, q in self.samples:
            there, closed = self.evaluate_state(x, q)
            position, rotation = (to_floats(part) for part in there.platform())
            here = [float(v) for v in poses.evaluate_coordinates(self.coordinates, position, rotation)]
            samples.append(self._inverse_matrix(there, closed, here))
        return pivot_order(np.array(samples))

    @cached_property
    def jacobian_pivots(self) -> Order:
        """Elimination order of the pose Jacobian by the leading joints' rates."""
        n, tables = len(self.varying), []
        for x, q in self.samples:
            motion, rows = self.evaluate_state(x, q)
            ju, jq = self.scaled_jacobians(rows)
            follow = -np.linalg.solve(ju[self.independent], jq[self.independent])
            position, rotation = (to_floats(part) for part in motion.platform())
            here = [float(v) for v in poses.evaluate_coordinates(self.coordinates, position, rotation)]
            table = to_floats(self.pose_rows(motion, here))
            drives = np.array([self.drive_scale(name) for name in self.graph.leads])
            own = table[:, n:] / drives + (table[:, :n] / np.array(self.tree.scales)) @ follow
            tables.append(np.array(self._pose_scales)[:, None] * own)
        return pivot_order(np.array(tables))

    def check(self) -> None:
        """Reject a graph that its actuated joints and pose coordinates do not determine.

        :raises ParameterError: by the field.
        """
        near = [count_rank(np.hstack([a, b])) for a, b in zip(*self._sampled_jacobians, strict=True)]
        if len(near) > 1 and near[0] < min(near[1:]):
            raise singular_home_error(self, near[0], min(near[1:]))
        if self.mobility.freedoms != self.joints:
            raise mobility_error(self)
        _ = self.independent
        if len(self.coordinates) != self.joints:
            bound = f"{self.joints} coordinates, the mobility"
            ways = choose_coordinates(self.graph)
            if len(ways) < self.joints:
                bound += f"; the platform moves in {', '.join(ways) or 'none'} alone: choose another "
                bound += "base or platform, so that each actuated joint moves it"
            raise ParameterError("pose", [c.name for c in self.coordinates], bound)
        motion, rows = self.evaluate_state(*self.samples[0])
        matrix = self._inverse_matrix(motion, rows, self.home_pose.tolist())
        if count_rank(matrix) < len(matrix):
            raise ParameterError(
                "pose",
                [c.name for c in self.coordinates],
                "coordinates that determine the platform's pose at home, as "
                f"{', '.join(choose_coordinates(self.graph))}",
            )

    @cached_property
    def home_pose(self) -> Array:
        """Pose coordinates at home, shape (m,)."""
        origin = self.graph.origin
        return np.array([0.0 if c.axis is None else origin[c.axis] for c in self.coordinates])

    def _inverse_matrix(self, motion: Motion, rows: Sequence[Row], pose: Numbers) -> Array:
        """Return the dimensionless Jacobian of closures and pose equations by u and qd."""
        ju, jq = self.scaled_jacobians(rows)
        extra = self.pose_rows(motion, pose)
        table = np.array(self._pose_scales)[:, None] * to_floats(extra)
        n = self.tree.unknown_rates
        drives = np.array([self.drive_scale(name) for name in self.graph.leads])
        lower = np.hstack([table[:, :n] / np.array(self.tree.scales), table[:, n:] / drives])
        return np.vstack([np.hstack([ju, jq])[self.independent], lower])

    @property
    def _pose_scales(self) -> list[float]:
        return [1.0 / self.tree.size if c.axis is not None else 1.0 for c in self.coordinates]

    def pose_rows(self, motion: Motion, pose: Numbers) -> Objects:
        """Return the derivatives of the pose equations by the unknown rates and qd."""
        n = self.tree.unknown_rates
        table = np.zeros((len(self.coordinates), n + self.joints), dtype=object)
        for i, (_, columns) in enumerate(poses.rows(self.coordinates, motion, pose)):
            for (kind, k), value in columns.items():
                table[i, k if kind == "u" else n + k] = value
        return table


def choose_leads(graph: Graph, wanted: Sequence[str] = (), pose: int = 0) -> tuple[str, ...]:
    """Choose the drives that lead: all, or the most independent ones of redundant drives.

    :param wanted: names of the leading drives; empty: choose. ``pose``: number of pose coordinates;
        0: any.
    :raises MobilityError: drives are redundant only because of a small deviation, or cannot move.
    :raises ParameterError: the wanted drives do not exist or do not determine the machine.
    """
    linkage, names = Linkage(graph), graph.actuated
    freedoms = linkage.mobility.freedoms
    if not 0 < freedoms < len(names) or pose == len(names):
        if wanted and set(wanted) != set(names):
            raise ParameterError("redundancy.leads", list(wanted), f"{', '.join(names)}: all lead")
        return names
    ju, jq = linkage.scaled_at_home()
    rates = null_space(np.hstack([ju, jq]), RELATIVE_RANK_TOLERANCE)[ju.shape[1] :]
    causes = find_small_deviations(graph, freedoms + 1)
    if causes or (np.abs(rates).max(1) < MIN_DRIVE_MOTION).any():
        raise mobility_error(linkage, causes)
    sizes = {
        chosen: abs(float(np.linalg.det(rates[list(chosen)]))) for chosen in combinations(range(len(names)), freedoms)
    }
    best = max(sizes.values())
    if wanted:
        places = tuple(sorted(names.index(name) for name in wanted if name in names))
        if len(places) != len(wanted) or not sizes.get(places, 0.0) > MIN_DRIVE_MOTION * best:
            raise ParameterError(
                "redundancy.leads",
                list(wanted),
                f"{freedoms} of {', '.join(names)} that determine the machine at home",
            )
        return tuple(names[k] for k in places)
    # Rounding must not choose among equivalent sets: take the first.
    return tuple(names[k] for k in next(c for c, size in sizes.items() if size > 0.999 * best))


def choose_coordinates(graph: Graph) -> tuple[str, ...]:
    """Choose the usual pose coordinates that determine the platform at home.

    If rotations alone determine it, as for an ankle, the rotations that move most; otherwise the
    first set of :func:`list_coordinates`.

    :raises ParameterError: something is free to move while the actuated joints are locked.
    """
    rates = _pose_rates(graph)
    for least in MIN_POSE_MOTIONS:
        chosen = _pick_independent(rates, list(rates), least)
        turns = sorted(
            (name for name in rates if poses.COORDINATES[name].entries),
            key=lambda name: -round(float(np.linalg.norm(rates[name])), 6),
        )
        turned = _pick_independent(rates, turns, least)
        if len(turned) == len(graph.leads):
            return tuple(name for name in rates if name in turned)
        if len(chosen) == len(graph.leads):
            break
    return tuple(chosen)


def list_coordinates(graph: Graph) -> list[tuple[str, ...]]:
    """List all sets of pose coordinates that determine the platform at home."""
    rates = _pose_rates(graph)
    count = len(graph.leads)
    return [
        names
        for names in combinations(rates, count)
        if len(_pick_independent(rates, names, MIN_POSE_MOTIONS[0])) == count
    ]


def _pick_independent(rates: Mapping[str, Array], names: Sequence[str], least: float) -> list[str]:
    """Pick coordinates in order, each independent of the others: singular values exceed ``least``."""
    chosen: list[str] = []
    for name in names:
        table = np.array([rates[own] for own in (*chosen, name)])
        if np.linalg.matrix_rank(table, least) == len(table):
            chosen.append(name)
    return chosen


def _pose_rates(graph: Graph) -> dict[str, Array]:
    """Return the dimensionless rate of each coordinate at home per rate of each leading drive.

    :raises ParameterError: something is free to move while the actuated joints are locked.
    """
    scheme = Scheme(graph, tuple(poses.COORDINATES.values()))
    motion, closed = scheme.evaluate_state(scheme.tree.home, graph.lead_home)
    ju, jq = (to_floats(m) for m in closure_jacobians(scheme.tree, closed))
    independent = scheme.independent
    rates = np.vstack([-np.linalg.solve(ju[independent], jq[independent]), np.eye(scheme.joints)])
    rows = to_floats(scheme.pose_rows(motion, [0.0] * len(scheme.coordinates)))
    scales = np.array(scheme._pose_scales)[:, None]
    return dict(zip(poses.COORDINATES, scales * rows @ rates, strict=True))


def check_masses(scheme: Scheme, graph: Graph) -> None:
    """Reject actuated joints that can move no mass.

    :param graph: the graph with the masses; those of the scheme's graph may be another machine's.
    :raises ParameterError: names a massless body that can move alone.
    """
    motion, rows = scheme.evaluate_state(scheme.tree.home, graph.lead_home)
    ju, jq = (to_floats(m) for m in closure_jacobians(scheme.tree, rows))
    moved = -np.linalg.solve(ju[scheme.independent], jq[scheme.independent])
    n = scheme.joints
    table = []
    for j in range(n):
        motion.set_rates(moved[:, j], np.eye(n)[j])
        rates = scheme.tree.drive_rates(np.eye(n)[j], moved[:, j])
        column = [
            np.sqrt(graph.joints[name].rotor_inertia) * rate for name, rate in zip(graph.actuated, rates, strict=True)
        ]
        for body in graph.bodies.values():
            # A square root R of the inertia: R' R = inertia.
            moments, axes = np.linalg.eigh(body.inertia)
            root = np.sqrt(np.maximum(moments, 0.0))[:, None] * axes.T
            column += [*(math.sqrt(body.mass) * to_floats(motion.velocity(body.name, body.com)))]
            column += [*(root @ to_floats(motion.omega[body.name]))]
        for rod in graph.rods.values():
            ends = zip((rod.inner, rod.outer), rod.ends, strict=True)
            for body_name, end in ends:
                column += [*(math.sqrt(rod.mass) * to_floats(motion.velocity(body_name, end)))]
        table.append(column)
    values = np.array(table, float)
    size = np.linalg.norm(values, axis=1, keepdims=True)
    if (size > 0.0).all() and np.linalg.matrix_rank(values / size, 1e-6) == n:
        return
    joint = graph.joints[graph.leads[int(np.argmin(size))]]
    idle = next((b for b in (joint.outer, joint.inner) if b != BASE), graph.platform)
    raise ParameterError(
        f"bodies.{idle}.mass",
        graph.bodies[idle].mass,
        f"mass or rotor_inertia that resists {joint.name}: no massless body can move alone",
    )
