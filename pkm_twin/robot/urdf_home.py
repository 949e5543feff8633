# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Choose the home of a tree with loop closures among its assemblies.

The actuated joints are at the initial values of ``<ros2_control>``, else at zero, or in the middle of
limits that exclude zero. Of several such assemblies the drawn one is taken, else the best conditioned;
if there is none, the best conditioned one nearby.

For the kinematics every joint is a series of driven joints of one freedom, whose values count from the
drawing. A closure compares two frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.codegen.expressions import cross
from pkm_twin.errors import ParameterError, SingularityError
from pkm_twin.kinematics.constraints import Equation, angle_equation, constraint_equations
from pkm_twin.kinematics.iterations import newton
from pkm_twin.kinematics.linkage import Linkage
from pkm_twin.kinematics.motion import Motion, to_floats
from pkm_twin.kinematics.rounding import MAX_ERROR_GROWTH, MAX_ROUNDING, MAX_ZERO_SINGULAR_VALUE, Repair, repair_rounded
from pkm_twin.kinematics.scheme import choose_leads
from pkm_twin.kinematics.singularity import singularity_at_home
from pkm_twin.kinematics.spins import RELATIVE_RANK_TOLERANCE, lock_hinges, lock_spins, null_space
from pkm_twin.machine import graph as graphs
from pkm_twin.machine.graph import BASE, Graph
from pkm_twin.machine.joints import CONSTRAINTS, Constraint
from pkm_twin.machine.loop_tree import Joint, LoopTree
from pkm_twin.machine.rotations import Pose, rotation_about, rotation_vector
from pkm_twin.machine.tree import Tree

MAX_ITERATIONS: Final = 100
"""Largest number of corrections to close the loops, and of steps towards the joints' zeros."""
RANK_BOUNDS: Final = (1e-4, 1e-6, 1e-8)
"""Singular values below this part of the largest count as zero; the next one if loops stay open."""
MAX_LOOP_GAP: Final = 1e-9
"""Largest gap of a closed loop, m or rad."""
MAX_DRAWN_GAP: Final = 1e-3
"""Largest gap of loops that are drawn closed but for the rounding of some numbers, of three digits: m or rad."""
MAX_DRAWN_MOVE: Final = 0.5
"""Largest move of a passive joint from the drawing, rad or part of the size, up to which the drawing tells
which assembly is meant: a mirrored assembly of usual linkages is farther away."""
MIN_HOME_INDEX: Final = 1e-4
"""Smallest singularity index of a home."""
MIN_ROUNDING: Final = 1e-6
"""Deviation of axes and points that counts as rounding in every file, rad or relative to the size."""


class Assembly:
    """The tree of a file at given joint values, with the residuals of its closures.

    ``steps``: the joint of each value; ``turns``: true for a rotation. ``size``: of the drawing, m.
    """

    def __init__(self, tree: LoopTree) -> None:
        self.tree = tree
        self.rounding = min(MAX_ROUNDING, MAX_ERROR_GROWTH * tree.rounding)
        """A loop that misses by less is drawn closed: the file has no more digits, m or rad."""
        self.closed = max(1e-5, self.rounding)
        """A loop that misses by more is open, m or rad."""
        self._bodies, self.steps = {tree.root: BASE}, list[str]()
        joints: dict[str, graphs.Joint] = {}
        for joint, parent, child in tree.tree_joints:
            body = self._bodies[parent]
            for k, freedom in enumerate(joint.freedoms(parent)):
                inner, body = body, f"{joint.name} {k}"
                kinds = ("revolute", "helical") if freedom.turns else ("", "prismatic")
                joints[body] = graphs.Joint(
                    body,
                    kinds[bool(freedom.slide)],
                    inner,
                    body,
                    joint.at,
                    freedom.axis[None],
                    actuated=True,
                    pitch=freedom.slide,
                )
                self.steps.append(joint.name)
            self._bodies[child] = body
        self.turns = np.array([joint.kind != "prismatic" for joint in joints.values()], bool)
        self._constraints = {one.name: list(_list_constraints(one)) for one in tree.closures}
        bodies = {name: graphs.Body(name) for name in joints}
        self._chain = Tree(Graph(bodies, joints, {}, BASE, np.zeros(3)))
        self.place(np.zeros(len(joints)))
        extent = float(np.ptp(self.places(), axis=0).max(initial=0.0))
        self.size = extent if extent > 1e-6 else 1.0

    def place(self, values: Array) -> None:
        """Set ``values`` of the steps, shape (count,)."""
        self.values, self._motion = values, Motion(self._chain, (), values)
        self._moves: dict[str, Pose] = {}

    def move(self, link: str) -> Pose:
        """Return how a link has moved since it was drawn, in the root's axes."""
        if link not in self._moves:
            turn = to_floats(self._motion.rotation_from_home(self._bodies[link]))
            at = to_floats(self._motion.point(self._bodies[link], np.zeros(3)))
            self._moves[link] = Pose(turn, at)
        return self._moves[link]

    def places(self) -> Array:
        """Return the positions of the links, shape (links, 3), m."""
        at, links = self._motion.point, self.tree.links
        return to_floats([at(body, links[n].frame.position) for n, body in self._bodies.items()])

    def points(self) -> Array:
        """Return the positions of the links and of the loops' joints, which tell assemblies apart, (points, 3), m."""
        closed = [self.frame(closure, 0).position for closure in self.tree.closures]
        return np.concatenate([self.places(), np.reshape(closed, (-1, 3))])

    def frame(self, joint: Joint, end: int) -> Pose:
        """Return a joint's frame on one of its links."""
        return self.move((joint.inner, joint.outer)[end]) @ joint.frames[end]

    def point_jacobian(self, link: str, point: Array) -> tuple[Array, Array]:
        """Return the Jacobians of a point's velocity and of its link's angular velocity, (3, count) each.

        Their columns are the joint coordinates (``steps``) of the assembly.
        """
        linear, angular = np.zeros((2, 3, len(self.steps)))
        motion, body = self._motion, self._bodies[link]
        for (_, k), column in motion.linear_jacobian(body, point).items():
            linear[:, k] = column
        for (_, k), column in motion.angular_jacobian(body).items():
            angular[:, k] = column
        return linear, angular

    def _write_equations(self, closure: Joint) -> list[Equation]:
        """Return the equations of a closure at the placed values."""
        name, bodies = closure.name, (closure.inner, closure.outer)
        inner, outer = (self.move(link).rotation for link in bodies)
        points = self.frame(closure, 0).position, self.frame(closure, 1).position
        found: list[Equation] = []
        for held, apart in self._constraints[name]:
            if closure.type.count == 2 and held.kind == "angle":
                axes = inner @ held.inner, outer @ held.outer
                found.append(angle_equation(name, bodies, points, axes, closure.cosine))
            else:
                turns = inner.__matmul__, (outer @ apart).__matmul__
                found += constraint_equations(name, bodies, held, points, turns, 1.0)
        return found

    def residuals(self, rates: bool = True) -> tuple[Array, Array]:
        """Return how far the closures are open, shape (rows,), m and rad, and the rates of that.

        :param rates: without them their shape is (rows, 0), else (rows, count).
        """
        closures = [self._write_equations(one) for one in self.tree.closures]
        values = np.array([float(one.value) for found in closures for one in found])
        if not rates:
            return values, np.zeros((len(values), 0))
        table = [np.zeros((0, len(self.steps)))]
        for closure, found in zip(self.tree.closures, closures, strict=True):
            force = np.array([one.force for one in found], float)
            moment = np.array([one.moment for one in found], float)
            part: Array = np.zeros((len(found), len(self.steps)))
            for side, link in enumerate((closure.inner, closure.outer)):
                point = self.frame(closure, side).position
                linear, angular = self.point_jacobian(link, point)
                arm = np.array([one.points[side] for one in found]) - point
                rows = force @ linear + (moment + cross(arm, force)) @ angular
                part = part + (rows if side else -rows)
            table.append(part)
        return values, np.vstack(table)

    def close(self, values: Array, held: Mask | bool = False) -> tuple[Array, float]:
        """Close the loops by smallest steps; return the values and the largest remaining gap.

        Redundant closures of a rounded file contradict each other by the rounding. Directions in which
        only they act are excluded at first, because steps along them are arbitrary; they are not used to
        close a loop that is closed but for rounding.

        :param held: steps that keep their values, shape (count,); by default none does.
        """
        best, miss = values, math.inf
        for rank in RANK_BOUNDS:
            new, left = self._solve_closures(best, rank, held)
            gone = float(np.abs(new - best).max(initial=0.0))
            # A loop that is closed but for rounding moves no joint by 0.01 rad or m.
            if left < 0.5 * miss and (miss > self.closed or gone < 1e-2):
                best, miss = new, left
            # A gap of more than 0.01 m or rad does not close with another rank.
            if miss < max(1e-14, self.rounding) or miss > 1e-2:
                break
        self.place(best)
        return best, miss

    def _solve_closures(self, values: Array, rank: float, held: Mask | bool) -> tuple[Array, float]:
        slow = 0

        def evaluate(values: Array) -> tuple[Array, Array]:
            self.place(values)
            return self.residuals(rates=False)[0], values

        def solve(values: Array, residual: Array) -> Array:
            """Return a truncated step, halved until it closes the loops further; zero if none does."""
            nonlocal slow
            miss = float(np.linalg.norm(residual))
            # Ten corrections in a row that gain less than 2 %: a minimum that is not zero.
            if miss < 1e-15 or slow > 10:
                return np.zeros(len(values))
            rates = np.where(held, 0.0, self.residuals()[1])
            step = np.where(held, 0.0, -np.linalg.lstsq(rates, residual, rcond=rank)[0])
            step *= min(1.0, 0.5 / max(float(np.abs(step).max(initial=0.0)), 1e-300))
            for _ in range(12):
                less = float(np.linalg.norm(evaluate(values + step)[0]))
                if less < miss:
                    slow = slow + 1 if less > 0.98 * miss else 0
                    return np.asarray(step, np.float64)
                step /= 2
            return np.zeros(len(values))

        values, _ = newton(values, evaluate, np.add, solve, iterations=MAX_ITERATIONS, gain=math.inf, tolerance=1e-300)
        self.place(values)
        return values, self.measure_gap()

    def measure_gap(self) -> float:
        """Return how far the loops are open at the placed values, m or rad."""
        return float(np.abs(self.residuals(rates=False)[0]).max(initial=0.0))

    def close_near_drawing(self) -> tuple[Array, float]:
        """Close the loops near the drawing; return the values and their miss.

        :raises ParameterError: a loop that does not close, by how much.
        """
        values, miss = self.close(np.zeros(len(self.steps)))
        rng = np.random.default_rng(0)
        for spread in (0.05, 0.1, 0.2, 0.4, 0.8) * 2:
            if miss <= self.closed:
                break
            # From the drawing small steps may not help: start away from it.
            start = rng.uniform(-spread, spread, len(self.steps))
            other, less = self.close(start)
            if less < miss:
                values, miss = other, less
        self.place(values)
        if miss > self.closed:
            raise self.open_loop_error()
        return values, miss

    def open_loop_error(self) -> ParameterError:
        """Return the error of the loop that is open farthest at the placed values."""
        closure = max(self.tree.closures, key=lambda one: max(abs(float(e.value)) for e in self._write_equations(one)))
        a, b = (self.frame(closure, end) for end in (0, 1))
        apart = 1e3 * float(np.linalg.norm(b.position - a.position))
        turned = float(np.linalg.norm(rotation_vector(b.rotation @ a.rotation.T)))
        what = f"{apart:.3g} mm"
        if closure.kind == "fixed":
            what += f" and {turned:.3g} rad"
        return ParameterError(
            closure.name,
            f"open by {what} between {closure.inner} and {closure.outer}",
            f"loops that close within {self.closed:g} (m or rad)",
        )

    def move_nearest_to_drawing(self, values: Array, held: Mask | bool = False) -> Array:
        """Return, and set, the values nearest to the drawing that the closed loops can reach.

        :param held: steps that keep their values, shape (count,); by default none does.
        """
        self.place(values)
        miss = max(self.measure_gap(), 1e-12)
        for _ in range(MAX_ITERATIONS):
            rates, own = (np.where(held, 0.0, table) for table in (self.residuals()[1], values))
            slope = own - np.linalg.lstsq(rates, rates @ own, rcond=RANK_BOUNDS[0])[0]
            if float(np.abs(slope).max(initial=0.0)) < 1e-12:
                break
            size = float(values @ values)
            for share in (1.0, 0.5, 0.25, 0.1, 0.01):
                other, less = self.close(values - share * slope, held)
                if less <= miss and float(other @ other) < size * (1.0 - 1e-14):
                    values = other
                    break
            else:
                break
            self.place(values)
        self.place(values)
        return values


def _list_constraints(closure: Joint) -> Iterator[tuple[Constraint, Array]]:
    """Yield constraints of a closure with the rotation from inner to outer vectors.

    Frames and axes may be drawn apart: the rotation takes a vector of the inner link, as drawn, to
    that of the outer link.
    """
    for key in closure.type.holds:
        apart = np.eye(3)
        if key == "turns":
            apart = closure.frames[1].rotation @ closure.frames[0].rotation.T
            # Perpendicular vectors alone would also allow the frame turned over.
            yield from ((Constraint("angle", one, one), apart) for one in np.eye(3))
        elif closure.type.count == 1:
            apart = _align(closure.axes[0], closure.axes[-1])
        yield from ((held, apart) for held in CONSTRAINTS[key](closure.axes, closure.pitch))


def _align(first: Array, second: Array) -> Array:
    """Return the smallest rotation that turns a line into another; lines have no sign."""
    normal = np.cross(first, second if float(first @ second) >= 0.0 else -second)
    sine = float(np.linalg.norm(normal))
    return rotation_about(normal * (math.asin(min(sine, 1.0)) / sine if sine > 0.0 else 1.0))


@dataclass(frozen=True, eq=False)
class Home:
    """An assembly: the steps' ``values``, and the gap ``miss`` of the loops (m or rad).

    ``how``: "drawn", "wanted" or "near"; ``place``: the wanted values of the actuated joints, in words.
    ``graph``: idealised, with spins held by the joints ``held`` (each with the largest mass times
    offset of the held parts, kg m); None if its mobility is wrong. ``repair``: of the file's rounding.
    ``index``: the singularity index. ``others``: number of other assemblies that
    were found, if the passive joints are too far from the drawing for it to tell which is meant.
    """

    values: Array
    miss: float
    how: str
    place: str
    graph: Graph | None
    held: Mapping[str, float]
    repair: Repair | None
    index: float
    others: int = 0

    @property
    def text(self) -> str:
        """Description of the choice."""
        texts = {
            "drawn": f"as drawn, the actuated joints at {self.place}",
            "wanted": f"the actuated joints at {self.place}, not as drawn",
            "near": f"the best conditioned assembly near {self.place}, as there is none at it",
        }
        return texts[self.how]


class HomeSearch:
    """Search for the home of an assembly.

    :param graph: returns the machine at the assembly's values, without held spins.
    """

    def __init__(self, assembly: Assembly, graph: Callable[[], Graph]) -> None:
        self.assembly, self.graph = assembly, graph
        tree, steps = assembly.tree, assembly.steps
        self.held = np.array([name in tree.actuated for name in steps], bool)
        self.turns = assembly.turns
        self.units = np.where(self.turns, 1.0, assembly.size)
        # Joint values are measured from the pose in which the file draws the machine.
        drawn = np.array([tree.joints[name].drawn for name in steps])
        bounds = [tree.joints[name].limits.get("position", (-math.inf, math.inf)) for name in steps]
        self.low, self.high = np.reshape(bounds, (-1, 2)).T - drawn
        self.wanted = np.where(self.held, -drawn, 0.0)
        self.place = "zero"
        if any(name in tree.initial for name in tree.actuated):
            start = np.array([tree.initial.get(name, 0.0) for name in steps])
            if start.any():
                self.wanted = np.where(self.held, start - drawn, 0.0)
                self.place = "the file's initial values"
        outside = self.held & ((self.wanted < self.low) | (self.wanted > self.high))
        if outside.any():
            self.wanted[outside] = (self.low[outside] + self.high[outside]) / 2
            self.place = "zero or amid their limits"

        self._known: list[Array] = []
        """Positions of links and loops in the known assemblies, shape (points, 3), m."""
        self._hinges: dict[str, float] | None = None
        """The joints that hold the spins of one assembly, and of the others too."""

    def home(self) -> Home:
        """Find the home, with parts that only spin at the file's zero where possible.

        The search leaves the angle of such parts to chance, but it matters if their masses are off the
        axis.

        :raises ParameterError: the loops close nowhere; the error states the gap.
        """
        home = self._find_best()
        if not home.held or home.graph is None:
            return home
        values = self.assembly.move_nearest_to_drawing(home.values, self.held)
        steps = list(self.assembly.steps)
        zero = np.array([name in home.held and steps.count(name) == 1 for name in steps], bool)
        for left in range(8, 0, -1):
            values = np.where(zero, values * (left - 1) / left, values)
            values, miss = self.assembly.close(values, self.held | zero)
        if miss > max(home.miss, MAX_LOOP_GAP):
            return home
        turned = replace(self._make_home(self._wrap_turns(values), miss, home.how), others=home.others)
        return turned if turned.index >= MIN_HOME_INDEX else home

    def _find_best(self) -> Home:
        """Find the home; parts that can spin about their own axis have arbitrary angles."""
        drawn = self._close_drawing()
        if drawn is not None and drawn.how == "drawn" and drawn.index >= 0.01:
            return drawn
        if drawn is None:
            # Loops that close nowhere are rejected before the search.
            closed = self.assembly.close_near_drawing()[0]
        # Find other assemblies with the actuated joints at the same values, from random starts.
        rng, reach = np.random.default_rng(0), np.where(self.turns, math.pi, self.units / 2)
        starts = rng.uniform(-reach, reach, (0 if self.held.all() else 12, len(reach)))
        others = [self._close_from(np.where(self.held, self.wanted, start), "wanted") for start in starts]
        found = [home for home in (drawn, *others) if home is not None]
        inside = [home for home in found if self._is_inside_limits(home.values)] or found
        chosen = None
        if inside:
            # Take the best-conditioned assembly; of those within 5 % of the best conditioning index, the
            # one nearest to the zero of all joints.
            best = max(home.index for home in inside)
            good = [home for home in inside if home.index * 1.05 >= best]
            chosen = min(good, key=lambda home: round(float(np.linalg.norm(home.values / self.units)), 6))
        if chosen is not None and chosen.index >= MIN_HOME_INDEX:
            # A drawing that is open by the rounding of some numbers is not meant to be another assembly.
            if drawn is None and self._drawn_gap <= MAX_DRAWN_GAP:
                self.assembly.place(self.wanted)
                raise self.assembly.open_loop_error()
            far = float((np.abs(chosen.values) / self.units)[~self.held].max(initial=0.0))
            count = sum(home.index >= MIN_HOME_INDEX for home in inside) - 1
            return replace(chosen, others=count if far > MAX_DRAWN_MOVE else 0)
        # Try growing distances from the wanted values; take the best conditioned assembly of the first that has one.
        rng = np.random.default_rng(1)
        tried: list[Home] = []
        candidates: list[Home] = []
        for distance in (0.05, 0.1, 0.2, 0.4, 0.8):
            for _ in range(6):
                start = self.wanted + rng.uniform(-distance, distance, len(self.wanted)) * self.units
                start = np.where(self.held, np.clip(start, self.low, self.high), start)
                home = self._close_from(start, "near")
                tried += [] if home is None else [home]
            good = [h for h in tried if self._is_inside_limits(np.where(self.held, h.values, self.low))]
            candidates += [max(good, key=lambda home: home.index)] if good else []
            if tried and (not candidates or candidates[-1].index < MIN_HOME_INDEX):
                # Every assembly is singular, so more starts do not help.
                break
        most = candidates[-1].index if candidates else 0.0
        near = next((home for home in candidates if home.index >= max(0.5 * most, MIN_HOME_INDEX)), None)
        if near is not None:
            return near
        if chosen is not None:
            return chosen
        # Every assembly is singular: return the nearest; creating the robot raises the error.
        values = self.assembly.move_nearest_to_drawing(closed)
        return self._make_home(values, self.assembly.measure_gap(), "near")

    def _close_drawing(self) -> Home | None:
        """Close the loops near the drawing, with the actuated joints at their wanted values."""
        values = self.wanted.copy()
        self.assembly.place(values)
        miss = self.assembly.measure_gap()
        if miss > max(MAX_LOOP_GAP, self.assembly.rounding):
            values, miss = self.assembly.close(values, self.held)
        # As drawn if no passive joint moves by more than 0.1 rad or a tenth of the size.
        far = float((np.abs(values) / self.units)[~self.held].max(initial=0.0))
        self._drawn_gap = miss if far <= 0.1 else math.inf
        if miss > self.assembly.closed:
            return None
        self._known.append(self.assembly.points())
        return self._make_home(values, miss, "drawn" if far <= 0.1 else "wanted")

    def _close_from(self, start: Array, how: str) -> Home | None:
        """Close the loops from a start; None if they stay open or this assembly was found before."""
        values, miss = self.assembly.close(start, self.held)
        if miss > self.assembly.closed and how == "near":
            values, miss = self.assembly.close(values)
        places, apart = self.assembly.points(), 1e-4 * self.assembly.size
        known = any(float(np.abs(places - other).max()) <= apart for other in self._known)
        if miss > self.assembly.closed or known:
            return None
        self._known.append(places)
        return self._make_home(self._wrap_turns(values), miss, how)

    def _wrap_turns(self, values: Array) -> Array:
        """Wrap passive turns to at most half a revolution."""
        turned = (values + math.pi) % (2 * math.pi) - math.pi
        return np.where(self.turns & ~self.held, turned, values)

    def _is_inside_limits(self, values: Array) -> bool:
        """Return whether all joints, passive ones too, are inside the file's limits."""
        return bool(((values >= self.low - 1e-6) & (values <= self.high + 1e-6)).all())

    def _make_home(self, values: Array, miss: float, how: str) -> Home:
        self.assembly.place(values)
        try:
            settled = self._repair_and_lock(self.graph(), miss)
            index = 0.0
            if settled is not None:
                # Redundant drives follow those that lead.
                leads, joints = choose_leads(settled[0]), settled[0].joints
                led = {n: replace(j, follows=j.actuated and n not in leads) for n, j in joints.items()}
                index = singularity_at_home(replace(settled[0], joints=led))
        except (ParameterError, SingularityError, np.linalg.LinAlgError):
            # Creating the robot raises this error again, with its text.
            settled, index = None, 0.0
        sound, held, repaired = settled or (None, {}, None)
        return Home(values, miss, how, self.place, sound, held, repaired, index)

    def _repair_and_lock(self, graph: Graph, miss: float) -> tuple[Graph, dict[str, float], Repair] | None:
        """Remove a file's rounding and hold spins.

        :returns: the graph, the joints that hold spins, and the repair; None if the actuated joints
            do not determine the machine.
        """
        # Numbers with fewer digits than most remove freedoms, so that motors seem redundant.
        own, found = self.assembly.tree.rounding, None
        for rounding in (max(own, miss), *([MAX_ROUNDING] if own > MAX_ZERO_SINGULAR_VALUE else [])):
            repaired = repair_rounded(graph, rounding, MIN_ROUNDING)
            if repaired is None:
                continue
            held = self._hinges or {}
            sound = lock_hinges(repaired.graph, list(held))
            driven = self._hinges is not None and _count_driven(sound)
            if not driven:
                sound, held = lock_spins(repaired.graph)
                driven = _count_driven(sound)
                if driven and all(sound.joints[name].kind == "fixed" for name in held):
                    self._hinges = held
            if driven and (found is None or driven == len(self.assembly.tree.actuated)):
                found = sound, held, repaired
                if driven == len(self.assembly.tree.actuated):
                    break
        return found


def _count_driven(graph: Graph) -> int:
    """Count the freedoms at home if the actuated joints determine the machine, perhaps redundantly; else zero."""
    linkage = Linkage(graph)
    locked = null_space(linkage.scaled_at_home()[0], RELATIVE_RANK_TOLERANCE, absolute=True)
    freedoms = linkage.mobility.freedoms
    return freedoms if not locked.shape[1] and 0 < freedoms <= linkage.joints else 0
