# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Joint values of a limb in closed form, from the placed bodies at its ends.

At most one joint of a limb, the reach, sets the distance of two points; then turns about one centre
take one of these points to the other. Both are subproblems of Paden and Kahan (Murray, Li, Sastry
1994, section 3.2). So are solved: drive and rod, R-R-R and R-P-R in a plane, R-P-S, R-S-U, U-P-S,
and a universal joint whose limb is driven.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import Numbers, Objects, snapped, snapped_all
from pkm_twin.codegen.operations import absolute, maximum, sqrt
from pkm_twin.kinematics.motion import Columns, Motion, Row, subtract_columns
from pkm_twin.machine.graph import BASE
from pkm_twin.machine.joints import UNIT_VECTORS
from pkm_twin.machine.tree import Link, Step, Tree


@dataclass(frozen=True)
class Limb:
    """A limb with a closed form, described by the names of its parts.

    ``kind``: "rod", "reach, turns", "across", "turns, reach" or "turns", see :class:`LimbPose`.
    ``part``: the cut joint or rod that closes the limb, between the bodies ``tip`` and ``beyond``.
    ``bodies``: the bodies that the limb places, in the tree's order. ``reach``: the body whose joint
    sets the distance; empty: none. ``turns``: the bodies that rotate about one centre. ``rows``: the
    limb's closures among the independent ones, by index; ``leaves``: how many of these must be
    satisfied by other joints. ``spin``: the body that rotates about the line from the centre to the
    closing joint, whose axes determine the angle; empty: none.
    """

    kind: str
    part: str
    tip: str
    beyond: str
    bodies: tuple[str, ...]
    reach: str
    turns: tuple[str, ...]
    rows: tuple[int, ...]
    leaves: int = 0
    spin: str = ""


class LimbPose:
    """Solve a limb whose end bodies are placed, numerically or symbolically.

    The limb's unknowns are written into ``x``, and its bodies are placed. For a P-R-R-U limb these
    are equations 6 to 12 of the 3-PRRU paper: points, slider, plane and swing angle. C is the centre
    of the limb's rotations (turns), J the point of the joint that closes it; J has a position given
    by each of the two bodies there.

    * "rod": the reach sets the distance of a rod's ends to its length.
    * "reach, turns": the reach sets the distance of C from J on ``beyond``; the turns then move J.
    * "across": the turns are on the side of ``beyond``; the reach moves J to its distance from C.
    * "turns, reach": the reach, after the turns, sets the distance of J from C.
    * "turns": the joints between C and J are driven; other joints must satisfy the distance.

    ``slopes``: pairs of a factor of the limb in the determinant of the closures, positive in the
    assembly of home, and its scale. ``levers``: pairs of a lever arm of the turns and its scale.
    ``rows``: the closures that other joints must satisfy. ``miss``: with ``closest`` (numbers only)
    the gap, m, of a limb that is too short, brought as near as it can be; otherwise it is NaN.
    """

    def __init__(self, motion: Motion, limb: Limb, x: Objects, q: Numbers, *, closest: bool = False) -> None:
        tree, graph = motion.tree, motion.graph
        self.motion, self.tree, self.x = motion, tree, x
        self.slopes: list[tuple[Any, Any]] = []
        self.levers: list[tuple[Any, Any]] = []
        self.rows: list[Row] = []
        self.closest, self.miss = closest, 0.0
        self.normal: Any = None
        self.slope: Any = None
        self.ends: tuple[tuple[str, Any], tuple[str, Any]] = (BASE, UNIT_VECTORS[0]), (BASE, UNIT_VECTORS[0])
        if limb.kind == "rod":
            rod = graph.rods[limb.part]
            at, end = rod.ends if rod.inner == limb.tip else rod.ends[::-1]
            target = motion.point(limb.beyond, end)
            self._place_at_distance(tree.links[limb.reach], at, target, end, square_of(end - at))
            motion.place(limb.bodies, x, q)
            self._store_distance_ends(limb, at, limb.beyond, target)
            return
        at = graph.joints[limb.part].at
        top, last = tree.links[limb.turns[0]], tree.links[limb.turns[-1]]
        every = [step for body in limb.turns for step in tree.links[body].steps]
        steps = [step for step in every if step.turns]
        beyond = [body for body in limb.bodies if top.body in tree.chain_to_base(body)]
        before = [body for body in limb.bodies if body not in beyond]
        after = beyond[len(limb.turns) :]
        lever = home = snapped_all(last.axes.T @ (at - last.at))
        if limb.kind == "reach, turns":
            target = motion.point(limb.beyond, at)
            square = self._required_square(limb, steps, lever, top.at, target)
            self._place_at_distance(tree.links[limb.reach], top.at, target, at, square)
            motion.place(before, x, q)
            self._store_distance_ends(limb, top.at, limb.beyond, target)
        elif limb.kind == "across":
            centre = motion.point(top.parent, top.at)
            square = self._required_square(limb, steps, lever, at, centre)
            self._place_at_distance(tree.links[limb.reach], at, centre, top.at, square)
            motion.place(before, x, q)
            self._store_distance_ends(limb, at, top.parent, centre)
            self.ends = self.ends[::-1]
            target = motion.point(limb.tip, at)
        else:
            target = motion.point(limb.beyond, at)
        parent = motion.rotation[top.parent]
        centre = motion.origin[top.parent] + parent @ top.arm
        apart = target - centre
        towards = steps[0].before.T @ (parent.T @ apart)
        if limb.kind == "turns, reach":
            link = tree.links[limb.reach]
            between = Motion(tree, x, q, after[: after.index(link.body)], last.body)
            turned = between.rotation[link.parent]
            local = -(turned.T @ between.origin[link.parent]) - link.arm
            square = square_of(apart)
            if len(steps) == 1:
                square = square_of([*towards[:2], lever[2]])
            self._solve_distance(link, at, local, top.at, square)
            self.ends = (limb.beyond, target), (top.parent, centre)
        if limb.kind in ("turns", "turns, reach"):
            lever = Motion(tree, x, q, after, last.body).point(limb.tip, at)
        if len(steps) == 2:
            self._rotate_lever_twice(steps, towards, lever, home)
        else:
            self._rotate_lever(steps[0], towards, lever)
        if len(steps) == 1:
            self.normal = parent @ steps[0].before[:, 2]
        for slide in (step for step in every if not step.turns):
            # A slide along the rotation axis satisfies the closure in that direction.
            x[slide.position] = slide.sign * (towards[2] - lever[2]) / slide.slide
        if limb.spin:
            motion.place(beyond[:-1], x, q)
            self._solve_spin(limb)
        motion.place(beyond[-1:] if limb.spin else beyond, x, q)
        bodies = (top.parent, limb.beyond)
        if limb.leaves and limb.kind == "turns":
            # J keeps its distance from C; of a single turn, in the plane of the turn.
            square = square_of(lever[: 2 if len(steps) == 1 else 3])
            across = apart if self.normal is None else _remove_component(apart, self.normal)
            scale = 1.0 / (tree.size * sqrt(square))
            self.rows.append(self._point_row(limb, bodies, target, across, 0.5 * (across @ across - square), scale))
        if limb.leaves > len(self.rows):
            # J stays in the plane of the single turn.
            height = self.normal @ apart - lever[2]
            self.rows.append(self._point_row(limb, bodies, target, self.normal, height, 1.0 / tree.size))

    def _store_distance_ends(self, limb: Limb, moved: Array, body: str, target: Objects) -> None:
        """Store the two points whose distance the reach sets, each with the body that carries it."""
        place = self.motion.point(limb.reach, moved)
        self.ends = (body, target), (self.tree.links[limb.reach].parent, place)
        # The vector between them goes from the target to the point that is moved.
        self.slope = -self.slope

    def reach_rates(self) -> Columns:
        """Return the reach joint's rate per rate of the bodies at the limb's ends.

        The distance is set by the reach: slope rate = distance vector . difference of velocities. In
        the plane of a turn, both are velocities at one place, relative to the carrier of the plane.
        """
        (body, target), (carrier, place) = self.ends
        vector = target - place
        if self.normal is not None:
            vector, place = _remove_component(vector, self.normal), target
        vector = vector / self.slope
        moving = (
            self.motion.linear_jacobian(body, target),
            self.motion.linear_jacobian(carrier, place),
        )
        return {key: column @ vector for key, column in subtract_columns(*moving).items()}

    def _required_square(self, limb: Limb, steps: Sequence[Step], lever: Numbers, moved: Array, target: Numbers) -> Any:
        """Return the square of the distance that the reach has to set.

        A single rotation cannot change the offset along its axis, so the present offset is used.
        """
        if len(steps) == 2:
            return square_of(lever)
        tree, motion = self.tree, self.motion
        link = tree.links[limb.reach]
        turned = motion.rotation[link.parent]
        own = tree.axes[link.parent].T @ (moved - tree.at[link.parent])
        normal = turned @ snapped_all(tree.axes[link.parent].T @ steps[0].axis)
        gap = normal @ (np.asarray(target) - motion.origin[link.parent] - turned @ own)
        return square_of([*lever[:2], gap])

    def _place_at_distance(self, link: Link, point: Array, target: Numbers, goal: Array, square: Any) -> None:
        """Solve a body's joint so that its point has a distance from a target in base axes.

        :param goal: the target at home. ``square``: of the distance.
        """
        turned, origin = self.motion.rotation[link.parent], self.motion.origin[link.parent]
        local = turned.T @ (np.asarray(target) - origin) - link.arm
        self._solve_distance(link, point, local, goal, square)

    def _solve_distance(self, link: Link, point: Array, local: Numbers, goal: Array, square: Any) -> None:
        """Solve |point - target|^2 = square for the single coordinate of a body's joint.

        :param local: the target relative to the joint, in the parent's axes. ``goal``: the target at
            home, in base axes.
        """
        (step,), parent = link.steps, self.tree.axes[link.parent]
        v = snapped_all(link.axes.T @ (point - link.at))
        home = snapped_all(parent.T @ (goal - link.at))
        if step.circle:
            w, w_home = step.before.T @ local, step.before.T @ home
            a, c = v[0] * w[0] + v[1] * w[1], v[0] * w[1] - v[1] * w[0]
            c_home = v[0] * w_home[1] - v[1] * w_home[0]
            d = 0.5 * (square_of(v[:2]) + square_of(w[:2]) + (v[2] - w[2]) ** 2 - square)
            root, side = self._solve_angle(step, a, c, d, c_home, square)
            scale = sqrt(square_of(v[:2]) * square_of(w_home[:2]))
            self.slope = step.sign * side
        else:
            # |e t + d|^2 = square, of the slide t from home.
            own = parent.T @ link.axes @ v
            e = step.local * step.slide * step.sign
            d, d_home = own - local, own - home
            length, h = square_of(e), e @ d
            free = h * h - (square_of(d) - square) * length
            if self.closest and not free > 0.0:
                self._record_miss(sqrt(square - free / length) - sqrt(square))
                free = 0.0
            root = sqrt(free)
            self.slope = sign_of(e @ d_home) * root
            self.x[step.position] = (self.slope - h) / length
            scale = sqrt(square_of(d_home) * length)
        self.slopes.append((root, scale))

    def _solve_angle(self, step: Step, a: Any, b: Any, d: Any, b_home: Any, square: Any) -> tuple[Any, Any]:
        """Solve a cos + b sin = d for a rotation from home, on the branch of home.

        With ``closest``, d is limited to the range of the left side.

        :param b_home: b at home, where the rotation is zero. ``square``: squared distance, which
            decreases by 2 d; 0 if d is a length itself.
        :returns: the root sqrt(a^2 + b^2 - d^2), and a sin - b cos: the root with its sign.
        """
        n = a * a + b * b
        if self.closest and not n > d * d:
            nearest = sqrt(n) * sign_of(d)
            most = sqrt(maximum(square + 2.0 * (d - nearest), 0.0)) - sqrt(square)
            self._record_miss(absolute(most if square else d - nearest))
            d, root = nearest, 0.0
        else:
            root = sqrt(n - d * d)
        side = -sign_of(b_home) * root
        self.x[step.position] = (a * d - b * side) / n
        self.x[step.position + 1] = step.sign * ((b * d + a * side) / n)
        return root, side

    def _record_miss(self, miss: Any) -> None:
        self.miss = max(self.miss, float(miss))

    def _rotate_lever(self, step: Step, towards: Numbers, lever: Numbers) -> None:
        """Solve the rotation about an axis z that aligns a lever with a vector, seen along z."""
        x, y, n = lever[0], lever[1], square_of(lever[:2])
        self.levers.append((sqrt(n), self.tree.size))
        self.x[step.position] = (x * towards[0] + y * towards[1]) / n
        self.x[step.position + 1] = step.sign * ((x * towards[1] - y * towards[0]) / n)

    def _rotate_lever_twice(self, steps: Sequence[Step], towards: Numbers, lever: Numbers, home: Numbers) -> None:
        """Solve the rotations about two intersecting axes that carry a lever onto a vector.

        :param towards: the vector, as long as the lever, in axes of the first rotation. ``home``:
            the lever at home.
        """
        first, second = steps
        x, y, z = lever
        m = second.before[2]
        a, b = m[0] * x + m[1] * y, m[1] * x - m[0] * y
        c = towards[2] - m[2] * z
        root, _ = self._solve_angle(second, a, b, c, m[1] * home[0] - m[0] * home[1], 0.0)
        cosine = self.x[second.position]
        sine = second.sign * self.x[second.position + 1]
        turned = [cosine * x - sine * y, sine * x + cosine * y, z]
        self._rotate_lever(first, towards, second.before @ np.array(turned, dtype=object))
        self.slopes.append((root, sqrt(square_of(lever))))

    def _solve_spin(self, limb: Limb) -> None:
        """Solve the rotation of ``limb.spin`` from the constant angle of the closing joint's axes."""
        link, joint = self.tree.links[limb.spin], self.motion.graph.joints[limb.part]
        (step,), (constraint,) = link.steps, (c for c in joint.constraints if c.kind == "angle")
        mine, other = constraint.inner, constraint.outer
        if limb.tip == joint.outer:
            mine, other = other, mine
        v = snapped_all(link.axes.T @ mine)
        u = step.before.T @ (self.motion.rotation[link.parent].T @ self.motion.direction(limb.beyond, other))
        home = snapped_all(step.before.T @ (self.tree.axes[link.parent].T @ other))
        a, b = v[0] * u[0] + v[1] * u[1], v[0] * u[1] - v[1] * u[0]
        d = snapped(mine @ other) - v[2] * u[2]
        root, _ = self._solve_angle(step, a, b, d, v[0] * home[1] - v[1] * home[0], 0.0)
        self.slopes.append((root, 1.0))

    def _point_row(
        self,
        limb: Limb,
        bodies: tuple[str, str],
        place: Objects,
        along: Objects,
        value: Any,
        scale: Any,
    ) -> Row:
        """Return an equation whose derivatives are relative velocities at ``place`` along a vector."""
        inner, outer = bodies
        moving = (self.motion.linear_jacobian(body, place) for body in (outer, inner))
        columns = {k: column @ along for k, column in subtract_columns(*moving).items()}
        return Row(limb.part, value, columns, scale)


def square_of(vector: Numbers) -> Any:
    """Return the sum of the squares of a vector's components."""
    return sum((value * value for value in vector), 0.0)


def _remove_component(vector: Objects, normal: Objects) -> Objects:
    """Return a vector without its component along a unit vector."""
    part: Objects = vector - normal * (normal @ vector)
    return part


def sign_of(value: Any) -> Any:
    """Return the sign, 1 or -1, of a nonzero number."""
    return value / absolute(value)


def place_in_order(
    tree: Tree, order: Sequence[str | Limb], x: Objects, q: Numbers, *, closest: bool = False
) -> tuple[Motion, list[LimbPose]]:
    """Place all bodies; limbs in closed form write their unknowns into ``x``."""
    motion, limbs = Motion(tree, x, q, ()), []
    for entry in order:
        if isinstance(entry, Limb):
            limbs.append(LimbPose(motion, entry, x, q, closest=closest))
        else:
            motion.place((entry,), x, q)
    return motion, limbs
