# SPDX-License-Identifier: Apache-2.0
"""Which body a contact strikes, and where along it, by the direction of the external efforts.

A force F at a point p of a body causes the joint efforts J(p)' F, with the Jacobian J of that
point. Places on all bodies are compared by their marginal likelihood: F is unknown, its prior
normal, of any size. A body that explains efforts of every direction thus has less evidence than
one that explains these alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for
from numpy.typing import NDArray

from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics.traced import Traced
from pkm_twin.machine.graph import BASE, Graph
from pkm_twin.robot.outline import body_points, robot_bars
from pkm_twin.robot.robot import Robot

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

TWISTS: Final = "twists of bodies"
PLATFORM: Final = "platform"
CLAMPING: Final = "clamping"
UNKNOWN: Final = "unknown"
"""Efforts that no single force and no clamping explains better, or that several explain."""
PRIOR: Final = {PLATFORM: 0.4, "limbs": 0.4, CLAMPING: 0.15, UNKNOWN: 0.05}
"""Probabilities before a contact; the limbs share theirs."""
SURE: Final = 0.5
"""Least posterior probability of a class that is named."""
PLACES: Final = 5
"""Places along a bar that are compared."""
GRIP: Final = 0.3
"""Coefficient of friction of a contact: a thin body feels little force along itself."""
MODEL: Final = 0.05
"""Standard deviation of an external effort as a share of it: gains of the drives, geometry."""
CORRELATION: Final = 0.02
"""Time over which the errors of the efforts are one and the same, s."""
MEMORY: Final = 0.1
"""Time after which a sample weighs 1/e, s."""
REACH: Final = 0.4
"""Greatest distance of two bodies that clamp something, as a share of the machine's size."""
CLOSING: Final = 0.02
"""Least rate at which they approach, as a share of the greatest approach in the machine."""
COARSE: Final = 0.15
"""Standard deviation of a clamping's efforts as a share of them: its places are as far apart."""
SIZES: Final = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Forces that are compared, relative to the one that a usual place needs."""


@dataclass(frozen=True)
class ContactPlace:
    """The class of a contact, with its posterior probability, and the place.

    ``where``: ``platform``, a limb's name, ``clamping A and B`` (opposite forces on two bodies), or
    ``unknown`` where no class has the probability ``SURE``. ``confidence``: of the most likely
    class. ``classes``: of all, by name; clamping is one. ``body``: the most likely body,
    or two. ``point``: where on it, base axes, (3,), m, of clamping between both. ``deviation``:
    standard deviation along the body, m; that of an even distribution, 0.29 of the length, where
    the efforts do not determine it.
    """

    where: str
    confidence: float
    classes: dict[str, float]
    body: str
    point: Array
    deviation: float


def limbs_of(robot: Robot) -> dict[str, str]:
    """The limb of each moving body and rod: what is connected without base and platform.

    A limb has the name of its actuated joint's limb, or of its first body where it has none.
    """
    graph = robot.graph
    ends = {BASE, graph.platform}
    limb = {name: name for name in (*graph.bodies, *graph.rods) if name not in ends}
    for a, b in joined_bodies(graph):
        if a in limb and b in limb:
            one, other = limb[a], limb[b]
            limb = {name: one if root == other else root for name, root in limb.items()}
    names: dict[str, str] = {}
    for joint_name, own in zip(graph.actuated, robot.limb_names, strict=True):
        joint = graph.joints[joint_name]
        for body in (joint.outer, joint.inner):
            if body in limb:
                root = limb[body]
                names[root] = f"{names[root]}, {own}" if root in names else own
                break
    return {name: names.get(root, root) for name, root in limb.items()} | {graph.platform: PLATFORM}


def joined_bodies(graph: Graph) -> list[tuple[str, str]]:
    """Bodies and rods that a joint joins, both ways."""
    pairs = [(joint.inner, joint.outer) for joint in graph.joints.values()]
    pairs += [(name, end) for name, rod in graph.rods.items() for end in (rod.inner, rod.outer)]
    return [*pairs, *((b, a) for a, b in pairs)]


def _twists(t: Traced) -> Program:
    """Rotation (9), origin (3), and by joint rate velocity and angular velocity (6), by body."""
    t.solve()
    columns, rows = t.rate_columns(), []
    for body in t.graph.bodies:
        rows += [*np.ravel(t.motion.turned(body)), *t.motion.origin[body]]
    for j in range(t.joints):
        t.motion.set_rates(columns[j], np.eye(t.joints)[j])
        for body in t.graph.bodies:
            rows += [*t.motion.speed[body], *t.motion.omega[body]]
    return Program({"q": t.joints}, 0, {"bodies": t.lift(rows)}, t.equations())


def _kernel(robot: Robot) -> Kernel:
    return robot.engine.kernel(TWISTS, _twists)


class Places:
    """Places on all moving bodies: P of them, on bars between points of bodies.

    ``parts``: body or rod of each; ``limbs``: its limb, or ``platform``. ``thin``: whether it is
    on a thin bar. ``prior``: its probability, even along a limb's bars and over the platform's.
    ``pairs``: numbers of two places that may clamp something, (pairs,) each: on different limbs, or
    on a limb and the platform where no joint joins the two bodies. None with three joints or fewer.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        graph = robot.graph
        bodies = [*graph.bodies, BASE]
        at = robot.engine.tree.at
        limbs = limbs_of(robot)
        found = [(bar.part, bar.start, bar.end) for bar in robot_bars(robot) if bar.part in limbs]
        drawn = {part for part, _, _ in found}
        for body, points in body_points(graph).items():
            if body in limbs and body not in drawn:
                only = (body, points[0] if points else graph.bodies[body].com)
                found.append((body, only, only))
        blocks = _blocks(graph)
        self.parts: list[str] = []
        rows, lengths = [], []
        for part, start, end in found:
            length = float(np.linalg.norm(end[1] - start[1]))
            arms = [point - (at[body] if body != BASE else 0.0) for body, point in (start, end)]
            number = PLACES if length else 1
            for i in range(number):
                # Of the platform's bars the ends count, too: it is wide there.
                s = i / (PLACES - 1) if part == graph.platform else (i + 0.5) / PLACES
                rows.append((bodies.index(start[0]), bodies.index(end[0]), *arms, s * (number > 1)))
                lengths.append(length / number)
                self.parts.append(part)
        self._start, self._end, self._arm, self._far, self._s = map(
            np.array, zip(*rows, strict=True)
        )
        self.limbs = [limbs[part] for part in self.parts]
        size = np.maximum(lengths, 1e-3 * graph.size)
        self.thin = np.array([part not in blocks for part in self.parts]) & (np.array(lengths) > 0)
        self.names = tuple(dict.fromkeys(name for name in self.limbs if name != PLATFORM))
        owners = np.array(self.limbs)
        one, other = np.triu_indices(len(owners), 1)
        joined = {*joined_bodies(graph)}
        # A force on the platform explains three efforts and fewer as well as any clamping.
        apart = (owners[one] != owners[other]) & (robot.joints_count > 3)
        apart &= [
            (self.parts[a], self.parts[b]) not in joined for a, b in zip(one, other, strict=True)
        ]
        self.pairs = one[apart], other[apart]
        self.prior = np.empty(len(owners))
        for name in (PLATFORM, *self.names):
            own = owners == name
            whole = PRIOR[PLATFORM] if name == PLATFORM else PRIOR["limbs"] / len(self.names)
            self.prior[own] = whole * size[own] / max(size[own].sum(), 1e-300)

    def at(self, q: Array) -> tuple[Array, Array, Array]:
        """Positions (P, 3), Jacobians (P, n, 3) and directions of the bars (P, 3), base axes."""
        n, count = self.robot.joints_count, len(self.robot.graph.bodies)
        robot, none = self.robot, np.zeros(0)
        flat = robot.call_one(TWISTS, lambda: _kernel(robot), none, q)
        if flat is None:
            (flat,), status = _kernel(robot)(none, q)
            if status is not None:
                robot.refuse_joints(status, q)
        placed = flat[: 12 * count].reshape(count, 12)
        rotation = np.concatenate([placed[:, :9].reshape(-1, 3, 3), np.eye(3)[None]])
        origin = np.concatenate([placed[:, 9:], np.zeros((1, 3))])
        twist = np.zeros((count + 1, n, 6))
        twist[:count] = flat[12 * count :].reshape(n, count, 6).swapaxes(0, 1)

        def of(body: Indices, arm: Array) -> tuple[Array, Array]:
            lever = np.einsum("pij,pj->pi", rotation[body], arm)
            own = twist[body]
            turned = np.cross(own[:, :, 3:], lever[:, None])
            return origin[body] + lever, own[:, :, :3] + turned

        (a, ja), (b, jb) = of(self._start, self._arm), of(self._end, self._far)
        way = b - a
        length = np.linalg.norm(way, axis=1)[:, None]
        way = np.divide(way, length, out=np.zeros_like(way), where=length > 0.0)
        s = self._s[:, None]
        return a + s * (b - a), ja + s[..., None] * (jb - ja), way


def _blocks(graph: Graph) -> set[str]:
    """Bodies that are no thin bars: the platform, and what slides on the base."""
    return {graph.platform} | {
        joint.outer
        for joint in graph.joints.values()
        if joint.kind == "prismatic" and joint.inner == BASE
    }


class ContactLocator:
    """The evidence of each place for one contact, from the samples since it began.

    Over a contact the place on the body and the direction of the force in base axes are one and
    the same; so while the machine moves each sample narrows both. The force grows as the external
    efforts do. Errors of the efforts last for longer than a contact's beginning, so all samples
    together are as exact as one.

    With n joint efforts a contact with the platform explains all directions of them if the
    platform has n freedoms: it then has less evidence than a limb that explains them by fewer.
    """

    def __init__(self, robot: Robot) -> None:
        self.places = Places(robot)
        self.reset()

    def reset(self) -> None:
        """Begin a contact."""
        self._state: list[Array] = []

    @np.errstate(all="ignore")
    def push(self, step: float, q: Array, qd: Array, external: Array, deviation: Array) -> None:
        """Take a sample.

        :param step: time since the last one, s.
        :param q: joint positions (n,), with rates ``qd`` and external efforts (n,), N m or N.
        :param deviation: standard deviations of the efforts, (n,).
        """
        sure = 1.0 / np.hypot(deviation, MODEL * np.abs(external))
        y = external * sure
        if not y.any():
            return
        self._at, jacobian, way = self.places.at(q)
        if not self._state:
            self._begin(jacobian, sure, qd)
        # The force grows with the efforts, in the units of the first sample.
        size = float(np.linalg.norm(external * self._unit))
        fade = math.exp(-step / MEMORY)
        weight = min(1.0, step / CORRELATION)
        # Thin bars pass little of a force along them on.
        slim = np.where(self.places.thin, 1.0 - GRIP, 0.0)[:, None, None]
        along = jacobian @ way[:, :, None]
        one = size * (jacobian - slim * along * way[:, None]) * sure[:, None]
        pair = size * sure * self._approach(jacobian)
        free = size * sure * self._usual
        sums = (
            np.array([len(q), y @ y]), one.swapaxes(1, 2) @ one, y @ one,
            (pair * pair).sum(1), pair @ y, free * free, free * y,
        )  # fmt: skip
        self._state = [
            fade * old + weight * new for old, new in zip(self._state, sums, strict=True)
        ]

    def _begin(self, jacobian: Array, sure: Array, qd: Array) -> None:
        """The usual force, and which bodies can clamp something: those that approach."""
        self._unit = sure
        whole = np.linalg.norm(jacobian * sure[:, None], axis=(1, 2))
        self._force = (
            1.0 / float(np.median(whole[whole > 0.0])) if (whole > 0.0).any() else math.inf
        )
        # Efforts that no place explains: any of the sizes that others have.
        self._usual = self._force * np.sqrt(np.mean(jacobian**2, (0, 2)))
        near = np.linalg.norm(self._between(self.places.pairs), axis=1)
        reach = REACH * self.places.robot.graph.size
        self._pairs = self._those((near > 0.0) & (near < reach), self.places.pairs)
        rate = self._approach(jacobian) @ qd
        closing = rate < -CLOSING * np.abs(rate).max(initial=0.0)
        self._pairs = self._those(closing, self._pairs)
        count, pairs, n = len(self._at), int(closing.sum()), len(qd)
        self._state = [
            np.zeros(2), np.zeros((count, 3, 3)), np.zeros((count, 3)),
            np.zeros(pairs), np.zeros(pairs), np.zeros(n), np.zeros(n),
        ]  # fmt: skip

    @staticmethod
    def _those(which: Any, pairs: tuple[Indices, Indices]) -> tuple[Indices, Indices]:
        return pairs[0][which], pairs[1][which]

    def _between(self, pairs: tuple[Indices, Indices]) -> Array:
        return np.asarray(self._at[pairs[0]] - self._at[pairs[1]], np.float64)

    def _approach(self, jacobian: Array) -> Array:
        """Rates of the distances of the pairs' places by the joints' rates, (pairs, n)."""
        a, b = self._pairs
        way = self._between(self._pairs)
        way = way / np.linalg.norm(way, axis=1)[:, None]
        return np.asarray(((jacobian[a] - jacobian[b]) @ way[:, :, None])[..., 0], np.float64)

    @np.errstate(all="ignore")
    def place(self) -> ContactPlace | None:
        """What is known by now; None before the first sample, or where nothing finite is known."""
        if not self._state:
            return None
        known = (*self._state, self._usual, self._at)
        if not all([np.isfinite(numbers).all() for numbers in known]):
            # Nothing that is added to it makes it finite.
            self.reset()
            return None
        found = self._found()
        finite = np.isfinite([*found.point, found.deviation, *found.classes.values()]).all()
        return found if finite else None

    def _found(self) -> ContactPlace:
        """The same from finite sums; finite but where they are beyond the range of doubles."""
        # Errors of the model last: more samples show more directions, none of them more exactly.
        share = 1.0 / max(self._state[0][0] / len(self._usual), 1.0)
        (counted, square), matrix, vector, line, sides, other, others = (
            share * one for one in self._state
        )
        places = self.places
        squares, axes = np.linalg.eigh(matrix)
        parts = np.einsum("pji,pj->pi", axes, vector)
        sizes = self._force * np.array(SIZES)
        one = _evidence(np.maximum(squares, 0.0), parts, sizes)
        noise = 1.0 + COARSE**2 * square * len(other) / counted
        pair = _evidence(line[:, None] / noise, sides[:, None] / noise, sizes, one_sided=True)
        pair += 0.5 * (square * (1.0 - 1.0 / noise) - counted * math.log(noise))
        nothing = _evidence(other[None], others[None], np.array(SIZES))
        top = max(one.max(), pair.max(initial=-np.inf), nothing.max())
        likely = places.prior * np.exp(one - top)
        # The fewer places can clamp, the less likely they do.
        clamped = PRIOR[CLAMPING] * np.exp(pair - top) / max(len(pair), PLACES**2)
        odd = float(PRIOR[UNKNOWN] * np.exp(nothing[0] - top))
        total = float(likely.sum() + clamped.sum() + odd)
        limbs = np.array(places.limbs)
        classes = {
            name: float(likely[limbs == name].sum()) / total for name in (PLATFORM, *places.names)
        }
        classes |= {CLAMPING: float(clamped.sum()) / total, UNKNOWN: odd / total}
        best = max(classes, key=lambda name: classes[name])
        if best == CLAMPING:
            body, point, deviation = self._pair(clamped)
            where = f"{CLAMPING} {body}"
        else:
            body, point, deviation = self._one(likely if best == UNKNOWN else
                                               np.where(limbs == best, likely, 0.0))  # fmt: skip
            where = best
        confidence = classes[best]
        return ContactPlace(
            where if confidence >= SURE else UNKNOWN, confidence, classes, body, point, deviation
        )

    def _one(self, likely: Array) -> tuple[str, Array, float]:
        """The most likely body, the mean of its places, and their standard deviation."""
        places = self.places
        names = np.array(places.parts)
        body = max(dict.fromkeys(places.parts), key=lambda name: float(likely[names == name].sum()))
        share = np.where(names == body, likely, 0.0)
        share = share / share.sum()
        point = share @ self._at
        return body, point, math.sqrt(float(share @ ((self._at - point) ** 2).sum(1)))

    def _pair(self, clamped: Array) -> tuple[str, Array, float]:
        """The same of two bodies: the middle between them."""
        parts = self.places.parts
        a, b = self._pairs
        sums: dict[tuple[str, str], float] = {}
        keys = [(parts[i], parts[j]) for i, j in zip(a, b, strict=True)]
        for key, value in zip(keys, clamped.tolist(), strict=True):
            sums[key] = sums.get(key, 0.0) + value
        best = max(sums, key=lambda key: sums[key])
        share = np.where([key == best for key in keys], clamped, 0.0)
        share = share / share.sum()
        middle = 0.5 * (self._at[a] + self._at[b])
        point = share @ middle
        spread = math.sqrt(float(share @ ((middle - point) ** 2).sum(1)))
        return f"{best[0]} and {best[1]}", point, spread


def _evidence(squares: Array, parts: Array, sizes: Array, *, one_sided: bool = False) -> Array:
    """Logarithm of the marginal likelihood, mean over the sizes of the force, (hypotheses,).

    Of y = B f + noise with f normal of mean zero, less what all hypotheses share.

    :param squares: eigenvalues of B' B, (hypotheses, k); ``parts``: of B' y on its eigenvectors.
    :param one_sided: f is positive, k = 1.
    """
    precision = sizes[:, None, None] ** -2.0 + squares
    logs = 0.5 * (parts**2 / precision - np.log(precision) - 2 * np.log(sizes)[:, None, None])
    logs = logs.sum(-1)
    if one_sided:
        logs = logs + math.log(2.0) + scipy.special.log_ndtr((parts / np.sqrt(precision))[..., 0])
    top = logs.max(0)
    return np.asarray(top + np.log(np.exp(logs - top).mean(0)), np.float64)
