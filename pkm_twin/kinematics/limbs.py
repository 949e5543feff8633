# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Limbs whose joint values follow in closed form from the bodies at their ends.

A limb hangs between two placed bodies. At most one of its joints, the reach, sets the distance of
two points; then turns about one centre take one of these points to the other. Both are subproblems
of Paden and Kahan (Murray, Li, Sastry 1994, section 3.2). So are solved: drive and rod, R-R-R and
R-P-R in a plane, R-P-S, R-S-U, U-P-S, and a universal joint whose limb is driven.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import Numbers, Objects, reference, snapped, snapped_all
from pkm_twin.codegen.operations import absolute, sqrt
from pkm_twin.kinematics.motion import Columns, Motion, Row, difference, numbers
from pkm_twin.machine.graph import BASE, Graph
from pkm_twin.machine.joints import UNITS
from pkm_twin.machine.tree import Link, Step, Tree

MIN_LEVER: Final = 1e-2
"""Least lever of a limb's turns and least slope of its reach at home, of unit one: at a lever of 0
the limb is singular, and nearby the closed form loses digits."""
MIN_SLOPE: Final = 1e-4
"""Least singular value, of unit one, of the equations that closed limbs leave to Newton's method:
a limb about one point leaves a distance that nothing changes."""
SAME_STATE: Final = 1e-9
"""Largest difference of a sampled state and its closed form: rounding, amplified near a
singularity of the limb. Another solution differs by much more."""


class Closures(Protocol):
    """A linkage whose closures are solved, see :class:`pkm_twin.kinematics.scheme.Scheme`."""

    tree: Tree
    graph: Graph

    @property
    def samples(self) -> list[tuple[Array, Array]]:
        """States (x, q) at home and near it."""

    @property
    def parts(self) -> list[str]:
        """The joint or rod of every closure."""

    @property
    def independent(self) -> list[int]:
        """Closures that determine the unknowns."""

    @property
    def varying(self) -> list[int]:
        """Unknown rates of coordinates that are not held at their value at home."""

    def varies(self, step: Step) -> bool:
        """Return whether a step is passive, and its value not held."""

    def holds(self, step: Step) -> bool:
        """Return whether closures hold a passive step at its value at home."""

    def at(self, x: Numbers, q: Numbers) -> tuple[Motion, list[Row]]:
        """Return motion and closures in a state."""

    def scaled(self, rows: Sequence[Row]) -> tuple[Array, Array]:
        """Return derivatives of closures by u and by qd, of unit one."""


@dataclass(frozen=True)
class Limb:
    """A limb by the names of its parts.

    ``kind``: "rod", "reach, turns", "across", "turns, reach" or "turns", see :class:`LimbPose`.
    ``part``: the cut joint or rod that closes it, from ``tip`` to ``beyond``. ``bodies``: all that
    the limb places, in the tree's order. ``reach``: the body whose step sets the distance, empty
    where the limb has only turns. ``turns``: the bodies that turn about one centre. ``rows``: its
    closures among the independent ones, by index. ``leaves``: how many of them are left to other
    joints. ``spin``: a body that turns about the line from the centre to the closing joint, whose
    axes set its angle; empty: none.
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


def chain_to_base(tree: Tree, body: str) -> list[str]:
    """Return a body and those between it and the ground."""
    chain = []
    while body != BASE:
        chain.append(body)
        body = tree.links[body].parent
    return chain


def find_hanging_limbs(scheme: Closures) -> tuple[Limb, ...]:
    """Find limbs on a passive universal joint of the ground that are driven and end in a ball.

    Their turns follow from the bodies at their ends; of each limb the distance of the two centres
    is left for Newton's method.
    """
    tree, graph = scheme.tree, scheme.graph
    ends = [(rod.inner, rod.outer) for rod in graph.rods.values()]
    ends += [(graph.joints[name].inner, graph.joints[name].outer) for name in tree.cut]
    found: list[Limb] = []
    for name in tree.cut:
        joint = graph.joints[name]
        rows = tuple(k for k, part in enumerate(scheme.parts) if part == name)
        kinds = [held.kind for held in joint.constraints]
        if kinds != ["point"] or not set(rows) <= set(scheme.independent):
            continue
        for tip, beyond in ((joint.inner, joint.outer), (joint.outer, joint.inner)):
            root = _find_root(tree, tip)
            if root is None:
                continue
            bodies = tuple(body for body in tree.links if root in chain_to_base(tree, body))
            inside = set(bodies)
            alone = sum(bool(inside & set(pair)) for pair in ends) == 1
            driven = all(step.actuated for b in bodies if b != root for step in tree.links[b].steps)
            limb = Limb("turns", name, tip, beyond, bodies, "", (root,), rows, 1)
            apart = graph.platform not in inside and beyond not in inside
            if alone and driven and apart and _is_regular(scheme, limb):
                found.append(limb)
                break
    return tuple(found)


def _find_root(tree: Tree, tip: str) -> str | None:
    """Find the first body from the tip on a passive joint, if that is a universal of the ground.

    Its centre rests: where drives carried it, Newton's method could step over a singularity.
    """
    for body in chain_to_base(tree, tip):
        steps = tree.links[body].steps
        if not all(step.actuated for step in steps):
            hangs = tree.links[body].parent == BASE and [s.circle for s in steps] == [True, True]
            return body if hangs else None
    return None


def _is_regular(scheme: Closures, limb: Limb) -> bool:
    """Return whether home is far from where the limb is singular."""
    x, q = scheme.samples[0]
    pose = _solve_sample(scheme, limb, x, q)
    sizes = [*pose.slopes, *pose.levers]
    return all(reference(size) > MIN_LEVER * reference(scale) for size, scale in sizes)


def _solve_sample(scheme: Closures, limb: Limb, x: Numbers, q: Numbers) -> LimbPose:
    """Solve a limb of a sampled state, whose other bodies are placed."""
    tree, inner = scheme.tree, set(limb.bodies)
    others = [body for body in tree.links if not inner.intersection(chain_to_base(tree, body))]
    motion = Motion(tree, x, q, others)
    given = np.array(x, dtype=object)
    for step in (s for body in limb.bodies for s in tree.links[body].steps if not s.actuated):
        # What the limb has to find is not given.
        size = 2 if step.circle else 1
        given[step.position : step.position + size] = tree.home[step.position :][:size]
    # Without a real solution the results are NaN, which no check accepts.
    with np.errstate(all="ignore"):
        return LimbPose(motion, limb, given, q)


def order_closed(scheme: Closures) -> tuple[str | Limb, ...]:
    """Return a tree's bodies in an order of placing, with limbs in closed form where possible.

    Of the others first come bodies on the way to the platform; those that no actuated joint places
    are left for Newton's method. Its equations may not depend on limbs that depend on its unknowns,
    as their derivatives would be incomplete: such limbs are left for it, too.
    """
    barred: set[Limb] = set()
    links = scheme.tree.links
    while True:
        order, varying = _order_once(scheme, barred)
        limbs = [entry for entry in order if isinstance(entry, Limb)]
        rates = _rates_of_newton(scheme, order)
        faulty = {
            limb for limb in limbs
            if varying & set(limb.bodies)
            and rates.intersection(
                step.rate for body in limb.bodies for step in links[body].steps if not step.actuated
            )
        }  # fmt: skip
        if not faulty and not _is_regular_for_newton(scheme, order):
            # What these limbs leave to other joints does not determine them.
            faulty = {limb for limb in limbs if limb.leaves}
        if not faulty:
            return order
        barred |= faulty


def _is_regular_for_newton(scheme: Closures, order: Sequence[str | Limb]) -> bool:
    """Return whether the equations of Newton's method determine its unknowns at home."""
    x, q = scheme.samples[0]
    limbs = [entry for entry in order if isinstance(entry, Limb)]
    rows, links = _rows_of_newton(scheme, order, x, q), scheme.tree.links
    found = {
        step.rate for limb in limbs for body in limb.bodies for step in links[body].steps
        if not step.actuated
    }  # fmt: skip
    rates = [rate for rate in scheme.varying if rate not in found]
    table = scheme.scaled(rows)[0][:, rates]
    sizes = np.linalg.svd(table, compute_uv=False)
    return len(rows) == len(rates) and (not rates or bool(sizes[-1] > MIN_SLOPE))


def _rates_of_newton(scheme: Closures, order: Sequence[str | Limb]) -> set[int]:
    """Return the unknown rates that the equations of Newton's method depend on near home."""
    found: set[int] = set()
    for x, q in scheme.samples:
        for row in _rows_of_newton(scheme, order, x, q):
            found |= {
                rate for (kind, rate), value in row.columns.items()
                if kind == "u" and abs(value) * row.scale > SAME_STATE * scheme.tree.scales[rate]
            }  # fmt: skip
    return found


def _rows_of_newton(
    scheme: Closures, order: Sequence[str | Limb], x: Numbers, q: Numbers
) -> list[Row]:
    """Return the closures that no limb solves, and those that limbs leave, in a state."""
    solved = {k for entry in order if isinstance(entry, Limb) for k in entry.rows}
    motion, poses = place_in_order(scheme.tree, order, np.array(x, dtype=object), q)
    closures = motion.closures()
    rows = [closures[k] for k in scheme.independent if k not in solved]
    return rows + [row for pose in poses for row in pose.rows]


def place_in_order(
    tree: Tree, order: Sequence[str | Limb], x: Objects, q: Numbers
) -> tuple[Motion, list[LimbPose]]:
    """Place all bodies; limbs in closed form write their unknowns into ``x``."""
    motion, limbs = Motion(tree, x, q, ()), []
    for entry in order:
        if isinstance(entry, Limb):
            limbs.append(LimbPose(motion, entry, x, q))
        else:
            motion.place((entry,), x, q)
    return motion, limbs


def _order_once(
    scheme: Closures, barred: Collection[Limb]
) -> tuple[tuple[str | Limb, ...], set[str]]:
    """Return an order of placing without some limbs, and the bodies that vary with x."""
    tree = scheme.tree
    order: list[str | Limb] = []
    placed, varying = {BASE}, set()
    wanted = chain_to_base(tree, tree.graph.platform)[::-1]
    wanted += [body for body in tree.links if body not in wanted]
    while len(placed) <= len(tree.links):
        ready = [b for b in wanted if b not in placed and tree.links[b].parent in placed]
        driven = [b for b in ready if not any(scheme.varies(step) for step in tree.links[b].steps)]
        found = (
            limb for limb in _find_candidates(scheme, placed)
            if limb not in barred and _is_closed(scheme, limb)
        )  # fmt: skip
        limb = None if driven else next(found, None)
        if limb is None:
            body = (driven or ready)[0]
            order.append(body)
            placed.add(body)
            if not driven or tree.links[body].parent in varying:
                varying.add(body)
        else:
            order.append(limb)
            placed.update(limb.bodies)
            ends = {limb.tip, limb.beyond, *(tree.links[body].parent for body in limb.bodies)}
            if limb.leaves or ends & varying:
                varying.update(limb.bodies)
    return tuple(order), varying


def _find_candidates(scheme: Closures, placed: Collection[str]) -> Iterator[Limb]:
    """Yield limbs that have the steps of one, by each cut joint or rod."""
    tree, graph = scheme.tree, scheme.graph
    for part in dict.fromkeys(scheme.parts):
        rod = part in graph.rods
        cut: Any = graph.rods[part] if rod else graph.joints[part]
        if not rod and cut.kind not in ("spherical", "revolute", "universal"):
            continue
        rows = tuple(k for k in scheme.independent if scheme.parts[k] == part)
        for tip, beyond in ((cut.inner, cut.outer), (cut.outer, cut.inner)):
            low, high = (
                [body for body in chain_to_base(tree, end)[::-1] if body not in placed]
                for end in (tip, beyond)
            )
            links = [tree.links[body] for body in (*low, *high)]
            if any(scheme.holds(step) for link in links for step in link.steps):
                continue
            bodies = tuple(body for body in tree.links if body in (*low, *high))
            steps, tops = (
                [s for b in ends for s in _main_steps(tree.links[b])] for ends in (low, high)
            )
            passive = [step for link in links for step in link.steps if not step.actuated]
            left = len(rows) - len(passive)
            if not bodies or not all(s.circle or (s.slide and not s.turns) for s in steps + tops):
                continue
            drives = any(step.actuated for link in links for step in link.steps)
            owner = {id(step): link.body for link in links for step in link.steps}
            for kind, reach, turns, spins in _split(steps, tops, rod=rod):
                spins_alone = (
                    len(links[len(low) - 1].steps) == 1 and not rod and cut.kind == "universal"
                )
                if reach is not None and len(tree.links[owner[id(reach)]].steps) > 1:
                    continue
                if spins and not spins_alone:
                    continue
                ways = tuple(dict.fromkeys(owner[id(step)] for step in turns))
                first = tuple(link.body for link in links[: len(ways)])
                if drives and (kind != "turns" or first != ways):
                    # Actuated joints may only follow the turns.
                    continue
                # A single turn leaves its plane; what has no reach leaves the distance.
                if 0 <= left <= (len(turns) == 1) + (reach is None):
                    yield Limb(
                        kind, part, tip, beyond, bodies, owner[id(reach)] if reach else "",
                        ways, rows, left, owner[id(steps[-1])] if spins else "",
                    )  # fmt: skip


def _main_steps(link: Link) -> Sequence[Step]:
    """Return a link's passive steps; of a cylindrical joint the turn, which its slide follows."""
    turns = [step for step in link.steps if step.turns]
    main = turns if len(turns) == 1 and len(link.steps) == 2 else link.steps
    return [step for step in main if not step.actuated]


def _split(
    steps: Sequence[Step], tops: Sequence[Step], *, rod: bool
) -> Iterator[tuple[str, Step | None, Sequence[Step], bool]]:
    """Yield the kinds that a limb may have, its reach, its turns, and whether its tip spins.

    :param steps: from a placed body to the tip; ``tops``: from a placed body beyond it.
    """
    if rod:
        if len(steps) == 1 and not tops:
            yield "rod", steps[0], (), False
        return
    if len(steps) == 1 and len(tops) in (1, 2) and all(step.circle for step in tops):
        yield "across", steps[0], tops, False
    if tops:
        return
    if len(steps) in (1, 2) and all(step.circle for step in steps):
        yield "turns", None, steps, False
        if len(steps) == 2:
            yield "turns", None, steps[:1], True
    if len(steps) not in (2, 3):
        return
    if all(step.circle for step in steps[1:]):
        yield "reach, turns", steps[0], steps[1:], False
        if len(steps) == 3:
            yield "reach, turns", steps[0], steps[1:2], True
    if all(step.circle for step in steps[:-1]):
        yield "turns, reach", steps[-1], steps[:-1], False


def _is_closed(scheme: Closures, limb: Limb) -> bool:
    """Return whether the closed form gives the sampled states, far from singular at home."""
    tree = scheme.tree
    steps = [step for body in limb.bodies for step in tree.links[body].steps]
    if not _is_regular(scheme, limb):
        return False
    for x, q in scheme.samples:
        pose = _solve_sample(scheme, limb, x, q)
        difference = numbers(pose.x) - np.array(x, float)
        difference[[step.position for step in steps if not step.turns]] /= tree.size
        rest = [row.scale * float(row.value) for row in pose.rows]
        if not (np.abs([*difference, *rest]) < SAME_STATE).all():
            return False
    return True


class LimbPose:
    """A limb solved for bodies at its ends that are placed, on numbers and expressions alike.

    The limb's unknowns are written into ``x``, and its bodies are placed. C is the centre of the
    turns, J the point of the joint that closes the limb.

    * "rod": the reach brings one end of a rod to its length from the other.
    * "reach, turns": the reach brings C to its distance from J beyond; then the turns bring J.
    * "across": the reach brings J to its distance from C beyond; then the turns there bring J.
    * "turns, reach": the reach beyond the turns brings J to the distance that it has from C.
    * "turns": joints between C and J are driven; their distance is left to other joints.

    ``slopes``: factors of the limb in the determinant of the closures, above zero as at home, and
    what makes them of unit one. ``levers``: of turns, in the same way. ``rows``: the closures that
    are left to other joints.
    """

    def __init__(self, motion: Motion, limb: Limb, x: Objects, q: Numbers) -> None:
        tree, graph = motion.tree, motion.graph
        self.motion, self.tree, self.x = motion, tree, x
        self.slopes: list[tuple[Any, Any]] = []
        self.levers: list[tuple[Any, Any]] = []
        self.rows: list[Row] = []
        self.normal: Any = None
        self.slope: Any = None
        self.ends: tuple[tuple[str, Any], tuple[str, Any]] = (BASE, UNITS[0]), (BASE, UNITS[0])
        if limb.kind == "rod":
            rod = graph.rods[limb.part]
            at, end = rod.ends if rod.inner == limb.tip else rod.ends[::-1]
            target = motion.point(limb.beyond, end)
            self._reach(tree.links[limb.reach], at, target, end, _square(end - at))
            motion.place(limb.bodies, x, q)
            self._keep_ends(limb, at, limb.beyond, target)
            return
        at = graph.joints[limb.part].at
        top, last = tree.links[limb.turns[0]], tree.links[limb.turns[-1]]
        every = [step for body in limb.turns for step in tree.links[body].steps]
        steps = [step for step in every if step.turns]
        beyond = [body for body in limb.bodies if top.body in chain_to_base(tree, body)]
        before = [body for body in limb.bodies if body not in beyond]
        after = beyond[len(limb.turns) :]
        lever = home = snapped_all(last.axes.T @ (at - last.at))
        if limb.kind == "reach, turns":
            target = motion.point(limb.beyond, at)
            square = self._square_between(limb, steps, lever, top.at, target)
            self._reach(tree.links[limb.reach], top.at, target, at, square)
            motion.place(before, x, q)
            self._keep_ends(limb, top.at, limb.beyond, target)
        elif limb.kind == "across":
            centre = motion.point(top.parent, top.at)
            square = self._square_between(limb, steps, lever, at, centre)
            self._reach(tree.links[limb.reach], at, centre, top.at, square)
            motion.place(before, x, q)
            self._keep_ends(limb, at, top.parent, centre)
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
            square = _square(apart)
            if len(steps) == 1:
                square = _square([*towards[:2], lever[2]])
            self._solve_reach(link, at, local, top.at, square)
            self.ends = (limb.beyond, target), (top.parent, centre)
        if limb.kind in ("turns", "turns, reach"):
            lever = Motion(tree, x, q, after, last.body).point(limb.tip, at)
        if len(steps) == 2:
            self._turn_twice(steps, towards, lever, home)
        else:
            self._turn(steps[0], towards, lever)
        if len(steps) == 1:
            self.normal = parent @ steps[0].before[:, 2]
        for slide in (step for step in every if not step.turns):
            # Along the axis of the turn, so that nothing is left to other joints.
            x[slide.position] = slide.sign * (towards[2] - lever[2]) / slide.slide
        if limb.spin:
            motion.place(beyond[:-1], x, q)
            self._spin(limb)
        motion.place(beyond[-1:] if limb.spin else beyond, x, q)
        ends = (top.parent, limb.beyond), (apart, target)
        if limb.leaves and limb.kind == "turns":
            self.rows.append(
                self._distance(limb, *ends, _square(lever[: 2 if len(steps) == 1 else 3]))
            )
        if limb.leaves > len(self.rows):
            self.rows.append(self._plane(limb, *ends, lever[2]))

    def _keep_ends(self, limb: Limb, moved: Array, body: str, target: Objects) -> None:
        """Keep the ends of the distance that the reach sets: carried by its parent, and given."""
        place = self.motion.point(limb.reach, moved)
        self.ends = (body, target), (self.tree.links[limb.reach].parent, place)
        # The vector between them goes from the target to the point that is moved.
        self.slope = -self.slope

    def reach_rates(self) -> Columns:
        """Return the rate of the reach by the rates of the bodies at the limb's ends.

        The distance is set by the reach: slope rate = distance vector . difference of velocities.
        """
        (body, target), (carrier, place) = self.ends
        vector = target - place
        if self.normal is not None:
            vector = _across(vector, self.normal)
        vector = vector / self.slope
        moving = (
            self.motion.linear_jacobian(body, target),
            self.motion.linear_jacobian(carrier, place),
        )
        return {key: column @ vector for key, column in difference(*moving).items()}

    def _square_between(
        self, limb: Limb, steps: Sequence[Step], lever: Numbers, moved: Array, target: Numbers
    ) -> Any:
        """Return the square of the distance that the reach has to set.

        A single turn keeps out of its plane what is there.
        """
        if len(steps) == 2:
            return _square(lever)
        tree, motion = self.tree, self.motion
        link = tree.links[limb.reach]
        turned = motion.rotation[link.parent]
        own = tree.axes[link.parent].T @ (moved - tree.at[link.parent])
        normal = turned @ snapped_all(tree.axes[link.parent].T @ steps[0].axis)
        gap = normal @ (np.asarray(target) - motion.origin[link.parent] - turned @ own)
        return _square([*lever[:2], gap])

    def _reach(self, link: Link, point: Array, target: Numbers, goal: Array, square: Any) -> None:
        """Bring a body's point to a distance from a target; ``goal`` is the target at home."""
        turned, origin = self.motion.rotation[link.parent], self.motion.origin[link.parent]
        local = turned.T @ (np.asarray(target) - origin) - link.arm
        self._solve_reach(link, point, local, goal, square)

    def _solve_reach(
        self, link: Link, point: Array, local: Numbers, goal: Array, square: Any
    ) -> None:
        """Find the one step of a body by |point - target|^2 = square.

        :param local: the target from the joint, in axes of the parent. ``goal``: it at home.
        """
        (step,), parent = link.steps, self.tree.axes[link.parent]
        v = snapped_all(link.axes.T @ (point - link.at))
        home = snapped_all(parent.T @ (goal - link.at))
        if step.circle:
            # a cos + c sin = d, of the turn from home.
            w, w_home = step.before.T @ local, step.before.T @ home
            a, c = v[0] * w[0] + v[1] * w[1], v[0] * w[1] - v[1] * w[0]
            c_home = v[0] * w_home[1] - v[1] * w_home[0]
            d = 0.5 * (_square(v[:2]) + _square(w[:2]) + (v[2] - w[2]) ** 2 - square)
            n = a * a + c * c
            root = sqrt(n - d * d)
            side = -_sign(c_home) * root
            self.x[step.position] = (a * d - c * side) / n
            self.x[step.position + 1] = step.sign * ((c * d + a * side) / n)
            scale = sqrt(_square(v[:2]) * _square(w_home[:2]))
            self.slope = step.sign * side
        else:
            # |e t + d|^2 = square, of the slide t from home.
            own = parent.T @ link.axes @ v
            e = step.local * step.slide * step.sign
            d, d_home = own - local, own - home
            length, h = _square(e), e @ d
            root = sqrt(h * h - (_square(d) - square) * length)
            self.slope = _sign(e @ d_home) * root
            self.x[step.position] = (self.slope - h) / length
            scale = sqrt(_square(d_home) * length)
        self.slopes.append((root, scale))

    def _turn(self, step: Step, towards: Numbers, lever: Numbers) -> None:
        """Turn a lever about an axis z into the direction of a vector."""
        x, y, n = lever[0], lever[1], _square(lever[:2])
        self.levers.append((sqrt(n), self.tree.size))
        self.x[step.position] = (x * towards[0] + y * towards[1]) / n
        self.x[step.position + 1] = step.sign * ((x * towards[1] - y * towards[0]) / n)

    def _turn_twice(
        self, steps: Sequence[Step], towards: Numbers, lever: Numbers, home: Numbers
    ) -> None:
        """Turn a lever about two axes that cross to a vector of its length.

        :param towards: the vector in axes of the first turn. ``home``: the lever at home.
        """
        first, second = steps
        x, y, z = lever
        m = second.before[2]
        a, b = m[0] * x + m[1] * y, m[1] * x - m[0] * y
        c = towards[2] - m[2] * z
        square = a * a + b * b
        root = sqrt(square - c * c)
        # At home the turn is none, and the root is the size of what stands here for b.
        side = -_sign(m[1] * home[0] - m[0] * home[1]) * root
        cosine, sine = (a * c - b * side) / square, (b * c + a * side) / square
        self.x[second.position], self.x[second.position + 1] = cosine, second.sign * sine
        turned = [cosine * x - sine * y, sine * x + cosine * y, z]
        self._turn(first, towards, second.before @ np.array(turned, dtype=object))
        self.slopes.append((root, sqrt(_square(lever))))

    def _spin(self, limb: Limb) -> None:
        """Turn a body about its line to the closing joint, whose axes keep their angle."""
        link, joint = self.tree.links[limb.spin], self.motion.graph.joints[limb.part]
        (step,), (held,) = link.steps, (c for c in joint.constraints if c.kind == "angle")
        mine, other = held.inner, held.outer
        if limb.tip == joint.outer:
            mine, other = other, mine
        # a cos + b sin = d, of the turn from home.
        v = snapped_all(link.axes.T @ mine)
        u = step.before.T @ (
            self.motion.rotation[link.parent].T @ self.motion.direction(limb.beyond, other)
        )
        home = snapped_all(step.before.T @ (self.tree.axes[link.parent].T @ other))
        a, b = v[0] * u[0] + v[1] * u[1], v[0] * u[1] - v[1] * u[0]
        d = snapped(mine @ other) - v[2] * u[2]
        n = a * a + b * b
        root = sqrt(n - d * d)
        side = -_sign(v[0] * home[1] - v[1] * home[0]) * root
        self.x[step.position] = (a * d - b * side) / n
        self.x[step.position + 1] = step.sign * ((b * d + a * side) / n)
        self.slopes.append((root, 1.0))

    def _distance(
        self, limb: Limb, bodies: tuple[str, str], ends: tuple[Objects, Objects], square: Any
    ) -> Row:
        """Return the closure by which a point keeps its distance from the turns' centre.

        Of a single turn, in its plane.

        :param bodies: the turns' parent, and the point's. ``ends``: the point from the centre, and
            from the origin. ``square``: of the distance.
        """
        apart = ends[0] if self.normal is None else _across(ends[0], self.normal)
        scale = 1.0 / (self.tree.size * sqrt(square))
        value = 0.5 * (apart @ apart - square)
        return self._row(limb, bodies, ends[1], apart, value, scale)

    def _plane(
        self, limb: Limb, bodies: tuple[str, str], ends: tuple[Objects, Objects], height: Any
    ) -> Row:
        """Return the closure by which a point stays in the plane of a turn; see above.

        :param height: of the plane above the centre.
        """
        value = self.normal @ ends[0] - height
        return self._row(limb, bodies, ends[1], self.normal, value, 1.0 / self.tree.size)

    def _row(
        self, limb: Limb, bodies: tuple[str, str], place: Objects, along: Objects, value: Any,
        scale: Any,
    ) -> Row:  # fmt: skip
        """Return a closure along a vector fixed in the turns' parent, at a point's place."""
        inner, outer = bodies
        moving = (self.motion.linear_jacobian(body, place) for body in (outer, inner))
        columns = {k: column @ along for k, column in difference(*moving).items()}
        return Row(
            limb.part, value, columns, _no_bias, scale, inner, outer, place, along, np.zeros(3)
        )


def _no_bias() -> Any:
    raise NotImplementedError("rates and accelerations come from the closures themselves")


def _square(vector: Numbers) -> Any:
    """Return the sum of the squares of three numbers or fewer."""
    return sum((value * value for value in vector), 0.0)


def _across(vector: Objects, normal: Objects) -> Objects:
    """Return the part of a vector across a unit vector."""
    part: Objects = vector - normal * (normal @ vector)
    return part


def _sign(value: Any) -> Any:
    """Return 1 or -1 as the sign of a number that is not 0."""
    return value / absolute(value)
