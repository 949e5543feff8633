# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Which limbs of a machine have closed forms, and the order in which bodies and limbs are placed.

A limb hangs between two placed bodies; :mod:`pkm_twin.kinematics.limb_pose` has its formulas.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Any, Final, Protocol

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import Numbers, reference
from pkm_twin.kinematics.limb_pose import Limb, LimbPose, place_in_order
from pkm_twin.kinematics.motion import Motion, Row, to_floats
from pkm_twin.machine.graph import BASE, Graph
from pkm_twin.machine.tree import Link, Step, Tree

MIN_LEVER: Final = 1e-2
"""Smallest dimensionless lever arm and slope of a limb at home, see :class:`.LimbPose`: at 0 the limb
is singular, and near it the closed form loses digits."""
MIN_REMAINING_SINGULAR_VALUE: Final = 1e-4
"""Smallest dimensionless singular value of the equations that limbs in closed form leave to Newton's
method: a limb whose axes meet in one point can leave a distance that no unknown changes."""
MAX_CLOSED_FORM_ERROR: Final = 1e-9
"""Largest difference of a sampled state and its closed form from rounding, amplified near a
singularity of the limb. Another solution differs by much more."""


class SolvableLinkage(Protocol):
    """The linkage as the solver of limbs needs it, see :class:`pkm_twin.kinematics.scheme.Scheme`."""

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
        """Indices of closures that determine the unknowns."""

    @property
    def varying(self) -> list[int]:
        """Indices of the unknown rates of coordinates that closures do not keep at home."""

    def varies(self, step: Step) -> bool:
        """Return whether a step is passive, and no closure keeps it at its home value."""

    def is_constrained(self, step: Step) -> bool:
        """Return whether the closures keep a passive step at its home value."""

    def evaluate_state(self, x: Numbers, q: Numbers) -> tuple[Motion, list[Row]]:
        """Return motion and closures in a state."""

    def scaled_jacobians(self, rows: Sequence[Row]) -> tuple[Array, Array]:
        """Return the dimensionless derivatives of closures by u and by qd."""


def find_hanging_limbs(scheme: SolvableLinkage) -> tuple[Limb, ...]:
    """Find driven limbs between a passive universal joint on the ground and a ball joint.

    Their rotations follow from the bodies at their ends; Newton's method must satisfy the distance
    between the two joint centres.
    """
    tree, graph = scheme.tree, scheme.graph
    ends = [(rod.inner, rod.outer) for rod in graph.rods.values()]
    ends += [(graph.joints[name].inner, graph.joints[name].outer) for name in tree.cut]
    found: list[Limb] = []
    for name in tree.cut:
        joint = graph.joints[name]
        rows = tuple(k for k, part in enumerate(scheme.parts) if part == name)
        kinds = [constraint.kind for constraint in joint.constraints]
        if kinds != ["point"] or not set(rows) <= set(scheme.independent):
            continue
        for tip, beyond in ((joint.inner, joint.outer), (joint.outer, joint.inner)):
            root = _find_root(tree, tip)
            if root is None:
                continue
            bodies = tuple(body for body in tree.links if root in tree.chain_to_base(body))
            inside = set(bodies)
            alone = sum(bool(inside & set(pair)) for pair in ends) == 1
            driven = all(step.actuated for b in bodies if b != root for step in tree.links[b].steps)
            limb = Limb("turns", name, tip, beyond, bodies, "", (root,), rows, 1)
            apart = graph.platform not in inside and beyond not in inside
            if alone and driven and apart and _is_regular_at_home(scheme, limb):
                found.append(limb)
                break
    return tuple(found)


def _find_root(tree: Tree, tip: str) -> str | None:
    """Return the first body from the tip on a passive joint, if that is a universal on the ground.

    On the ground the joint's centre is at rest: if drives moved it, Newton's method could step over
    a singularity.
    """
    for body in tree.chain_to_base(tip):
        steps = tree.links[body].steps
        if not all(step.actuated for step in steps):
            hangs = tree.links[body].parent == BASE and [s.circle for s in steps] == [True, True]
            return body if hangs else None
    return None


def _is_regular_at_home(scheme: SolvableLinkage, limb: Limb) -> bool:
    x, q = scheme.samples[0]
    pose = _solve_sample(scheme, limb, x, q)
    sizes = [*pose.slopes, *pose.levers]
    return all(reference(size) > MIN_LEVER * reference(scale) for size, scale in sizes)


def _solve_sample(scheme: SolvableLinkage, limb: Limb, x: Numbers, q: Numbers) -> LimbPose:
    """Solve a limb in a sampled state, with all other bodies placed."""
    tree, inner = scheme.tree, set(limb.bodies)
    others = [body for body in tree.links if not inner.intersection(tree.chain_to_base(body))]
    motion = Motion(tree, x, q, others)
    given = np.array(x, dtype=object)
    for step in (s for body in limb.bodies for s in tree.links[body].steps if not s.actuated):
        # The limb must find these unknowns itself: start from home.
        size = 2 if step.circle else 1
        given[step.position : step.position + size] = tree.home[step.position :][:size]
    # Without a real solution the results are NaN, which no check accepts.
    with np.errstate(all="ignore"):
        return LimbPose(motion, limb, given, q)


def order_bodies(scheme: SolvableLinkage) -> tuple[str | Limb, ...]:
    """Order a tree's bodies for placing, with limbs in closed form where possible.

    Bodies between base and platform come first. Newton's method solves the joints that are neither
    actuated nor in closed form. Its equations must not depend on limbs that depend on its unknowns,
    because their derivatives would be incomplete: Newton's method solves such limbs, too.
    """
    barred: set[Limb] = set()
    links = scheme.tree.links
    while True:
        order, varying = _order_bodies_without(scheme, barred)
        limbs = [entry for entry in order if isinstance(entry, Limb)]
        # Unknown rates in the equations of Newton's method, at home or near it.
        rates = {
            rate
            for x, q in scheme.samples
            for row in _newton_rows(scheme, order, x, q)
            for (kind, rate), value in row.columns.items()
            if kind == "u" and abs(value) * row.scale > MAX_CLOSED_FORM_ERROR * scheme.tree.scales[rate]
        }
        faulty = {
            limb
            for limb in limbs
            if varying & set(limb.bodies)
            and rates.intersection(step.rate for body in limb.bodies for step in links[body].steps if not step.actuated)
        }
        if not faulty and not _is_newton_regular(scheme, order):
            # The equations that these limbs leave do not determine the other joints.
            faulty = {limb for limb in limbs if limb.leaves}
        if not faulty:
            return order
        barred |= faulty


def _is_newton_regular(scheme: SolvableLinkage, order: Sequence[str | Limb]) -> bool:
    """Return whether the equations of Newton's method determine its unknowns at home."""
    x, q = scheme.samples[0]
    limbs = [entry for entry in order if isinstance(entry, Limb)]
    rows, links = _newton_rows(scheme, order, x, q), scheme.tree.links
    found = {step.rate for limb in limbs for body in limb.bodies for step in links[body].steps if not step.actuated}
    rates = [rate for rate in scheme.varying if rate not in found]
    table = scheme.scaled_jacobians(rows)[0][:, rates]
    sizes = np.linalg.svd(table, compute_uv=False)
    return len(rows) == len(rates) and (not rates or bool(sizes[-1] > MIN_REMAINING_SINGULAR_VALUE))


def _newton_rows(scheme: SolvableLinkage, order: Sequence[str | Limb], x: Numbers, q: Numbers) -> list[Row]:
    """Return the equations of Newton's method in a state: what limbs in closed form leave."""
    solved = {k for entry in order if isinstance(entry, Limb) for k in entry.rows}
    motion, poses = place_in_order(scheme.tree, order, np.array(x, dtype=object), q)
    closures = motion.closures()
    rows = [closures[k] for k in scheme.independent if k not in solved]
    return rows + [row for pose in poses for row in pose.rows]


def _order_bodies_without(scheme: SolvableLinkage, barred: Collection[Limb]) -> tuple[tuple[str | Limb, ...], set[str]]:
    """Return an order without ``barred`` limbs, and the bodies that depend on Newton's unknowns."""
    tree = scheme.tree
    order: list[str | Limb] = []
    placed, varying = {BASE}, set()
    wanted = tree.chain_to_base(tree.graph.platform)[::-1]
    wanted += [body for body in tree.links if body not in wanted]
    while len(placed) <= len(tree.links):
        ready = [b for b in wanted if b not in placed and tree.links[b].parent in placed]
        driven = [b for b in ready if not any(scheme.varies(step) for step in tree.links[b].steps)]
        found = (
            limb for limb in _find_candidates(scheme, placed) if limb not in barred and _closed_form_holds(scheme, limb)
        )
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


def _find_candidates(scheme: SolvableLinkage, placed: Collection[str]) -> Iterator[Limb]:
    """Yield, for each cut joint or rod, the limbs whose joints may have a closed form."""
    tree, graph = scheme.tree, scheme.graph
    for part in dict.fromkeys(scheme.parts):
        rod = part in graph.rods
        cut: Any = graph.rods[part] if rod else graph.joints[part]
        if not rod and cut.kind not in ("spherical", "revolute", "universal"):
            continue
        rows = tuple(k for k in scheme.independent if scheme.parts[k] == part)
        for tip, beyond in ((cut.inner, cut.outer), (cut.outer, cut.inner)):
            low, high = (
                [body for body in tree.chain_to_base(end)[::-1] if body not in placed] for end in (tip, beyond)
            )
            links = [tree.links[body] for body in (*low, *high)]
            if any(scheme.is_constrained(step) for link in links for step in link.steps):
                continue
            bodies = tuple(body for body in tree.links if body in (*low, *high))
            steps, tops = ([s for b in ends for s in _independent_steps(tree.links[b])] for ends in (low, high))
            passive = [step for link in links for step in link.steps if not step.actuated]
            left = len(rows) - len(passive)
            if not bodies or not all(s.circle or (s.slide and not s.turns) for s in steps + tops):
                continue
            drives = any(step.actuated for link in links for step in link.steps)
            owner = {id(step): link.body for link in links for step in link.steps}
            for kind, reach, turns, spins in _classify_limb(steps, tops, rod=rod):
                spins_alone = len(links[len(low) - 1].steps) == 1 and not rod and cut.kind == "universal"
                if reach is not None and len(tree.links[owner[id(reach)]].steps) > 1:
                    continue
                if spins and not spins_alone:
                    continue
                ways = tuple(dict.fromkeys(owner[id(step)] for step in turns))
                first = tuple(link.body for link in links[: len(ways)])
                if drives and (kind != "turns" or first != ways):
                    # Actuated joints are possible only between the turns and the tip.
                    continue
                # A single turn cannot satisfy the closure along its axis, and a limb without reach
                # not the distance: Newton's method must satisfy these equations.
                if 0 <= left <= (len(turns) == 1) + (reach is None):
                    yield Limb(
                        kind,
                        part,
                        tip,
                        beyond,
                        bodies,
                        owner[id(reach)] if reach else "",
                        ways,
                        rows,
                        left,
                        owner[id(steps[-1])] if spins else "",
                    )


def _independent_steps(link: Link) -> Sequence[Step]:
    """Return a link's passive steps, without a cylindrical joint's slide: it follows the rotation."""
    turns = [step for step in link.steps if step.turns]
    main = turns if len(turns) == 1 and len(link.steps) == 2 else link.steps
    return [step for step in main if not step.actuated]


def _classify_limb(
    steps: Sequence[Step], tops: Sequence[Step], *, rod: bool
) -> Iterator[tuple[str, Step | None, Sequence[Step], bool]]:
    """Yield the kinds that a limb may have, each with reach, turns, and whether its tip spins.

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


def _closed_form_holds(scheme: SolvableLinkage, limb: Limb) -> bool:
    """Return whether the limb is regular at home and its closed form gives the sampled states."""
    tree = scheme.tree
    steps = [step for body in limb.bodies for step in tree.links[body].steps]
    if not _is_regular_at_home(scheme, limb):
        return False
    for x, q in scheme.samples:
        pose = _solve_sample(scheme, limb, x, q)
        difference = to_floats(pose.x) - np.array(x, float)
        difference[[step.position for step in steps if not step.turns]] /= tree.size
        rest = [row.scale * float(row.value) for row in pose.rows]
        if not (np.abs([*difference, *rest]) < MAX_CLOSED_FORM_ERROR).all():
            return False
    return True
