# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Locate a contact: which body, and where along it, from the direction of external efforts.

A force F at a point p of a body causes the joint efforts J(p)' F, with the Jacobian J of that
point. Candidate positions on all bodies are compared by their marginal likelihood, with a normal
prior of F of any size. A body that can explain efforts of every direction therefore has less
evidence than a body that explains only the observed direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics.traced import Traced
from pkm_twin.machine.graph import BASE, list_limbs
from pkm_twin.robot.outline import body_points, robot_bars
from pkm_twin.robot.robot import Robot

PLATFORM: Final = "platform"
CLAMPING: Final = "clamping"
UNKNOWN: Final = "unknown"
"""Class of efforts that no single force or clamping explains best, or that several explain."""
PRIOR: Final = {PLATFORM: 0.4, "limbs": 0.4, CLAMPING: 0.15, UNKNOWN: 0.05}
"""Prior probabilities of a contact's class; the limbs share theirs."""
MIN_CONFIDENCE: Final = 0.5
"""Smallest posterior probability of a class that is named."""
POSITIONS_PER_BAR: Final = 5
"""Positions along a bar that are compared."""
CONTACT_FRICTION: Final = 0.3
"""Coefficient of friction of a contact: a thin body transmits little force along itself."""
RELATIVE_MODEL_ERROR: Final = 0.05
"""Standard deviation of an estimated external effort, as a fraction of it: errors of drive gains and geometry."""
CORRELATION_TIME: Final = 0.02
"""Correlation time of the efforts' errors, s."""
DECAY_TIME: Final = 0.1
"""Time after which a sample's weight has decayed to 1/e, s."""
FORCE_RATIOS: Final = np.array([0.1, 0.3, 1.0, 3.0, 10.0])
"""Standard deviations of a contact force over which its likelihood is averaged, relative to the force
that noise hides at a typical position."""


@dataclass(frozen=True)
class ContactPlace:
    """Hold the class of a contact, with its posterior probability, and its position.

    ``where``: ``platform``, a limb's name, ``clamping A and B`` (opposite forces on two bodies), or
    ``unknown`` where no class has the probability ``MIN_CONFIDENCE``. ``confidence``: of the most likely
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


def map_limbs(robot: Robot) -> dict[str, str]:
    """Return the limb's name for each moving body and rod.

    A limb is a set of parts that remain connected without base and platform. Its name is that of
    its actuated joints' limbs in the file, or that of its first body if it has no actuated joint.
    """
    graph = robot.graph
    limb = {name: names[0] for names in list_limbs(graph) for name in names}
    names: dict[str, str] = {}
    for joint_name, own in zip(graph.actuated, robot.limb_names, strict=True):
        joint = graph.joints[joint_name]
        for body in (joint.outer, joint.inner):
            if body in limb:
                root = limb[body]
                names[root] = f"{names[root]}, {own}" if root in names else own
                break
    return {name: names.get(root, root) for name, root in limb.items()} | {graph.platform: PLATFORM}


def _twist_kernel(robot: Robot) -> Kernel:
    """Return the program of rotation (9), origin (3), and velocity and angular velocity per joint rate, by body."""

    def write(t: Traced) -> Program:
        t.solve()
        columns, rows = t.rate_columns(), []
        for body in t.graph.bodies:
            rows += [*np.ravel(t.motion.rotation_from_home(body)), *t.motion.origin[body]]
        for column, own in zip(columns, np.eye(t.joints), strict=True):
            t.motion.set_rates(column, own)
            for body in t.graph.bodies:
                rows += [*t.motion.origin_velocity[body], *t.motion.omega[body]]
        return Program(t.inputs("q"), 0, {"bodies": t.lift(rows)}, t.equations())

    return robot.engine.kernel("twists of bodies", write)


class CandidatePositions:
    """Hold candidate positions on all moving bodies: P of them, on bars between points of bodies.

    ``parts``: body or rod of each; ``limbs``: its limb, or ``platform``. ``thin``: whether it is
    on a thin bar. ``prior``: its probability, even along a limb's bars and over the platform's.
    ``pairs``: indices of two positions that may clamp something, (pairs,) each: on different limbs,
    or on a limb and the platform if no joint connects the bodies. None with three joints or fewer.

    ``classes``: platform and limbs; ``bodies``: all of ``parts``; ``couples``: pairs of bodies.
    Class and body masks have 1 for the positions that belong to them, (classes, P) and (bodies, P).
    ``couple_of``: index of each pair's couple.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        graph = robot.graph
        bodies = [*graph.bodies, BASE]
        at = robot.engine.tree.at
        limb_of = map_limbs(robot)
        bars = [(bar.part, bar.start, bar.end) for bar in robot_bars(robot) if bar.part in limb_of]
        drawn = {part for part, _, _ in bars}
        for body, points in body_points(graph).items():
            if body in limb_of and body not in drawn:
                end = (body, points[0] if points else graph.bodies[body].com)
                bars.append((body, end, end))
        # The platform, and sliders on the base, are no thin bars.
        sliders = (j.outer for j in graph.joints.values() if j.kind == "prismatic" and j.inner == BASE)
        thick = {graph.platform, *sliders}
        self.parts: list[str] = []
        ends, mix, lengths = [], [], []
        for k, (part, start, end) in enumerate(bars):
            length = float(np.linalg.norm(end[1] - start[1]))
            for body, point in (start, end):
                ends.append((bodies.index(body), point - (at[body] if body != BASE else 0.0)))
            number = POSITIONS_PER_BAR if length else 1
            for i in range(number):
                # On the platform's bars the ends are candidates too, as the platform is wide there.
                s = i / (POSITIONS_PER_BAR - 1) if part == graph.platform else (i + 0.5) / POSITIONS_PER_BAR
                mix.append((k, s * (number > 1)))
                lengths.append(length / number)
                self.parts.append(part)
        self._body, self._arm = map(np.array, zip(*ends, strict=True))
        self._bar = np.array([k for k, _ in mix])
        # Each candidate position is a weighted mean of its bar's two ends.
        self._mix = np.zeros((len(ends), len(mix)))
        for i, (k, s) in enumerate(mix):
            self._mix[2 * k : 2 * k + 2, i] = 1.0 - s, s
        self.limbs = [limb_of[part] for part in self.parts]
        size = np.maximum(lengths, 1e-3 * graph.size)
        self.thin = np.array([part not in thick for part in self.parts]) & (np.array(lengths) > 0)
        self.names = tuple(dict.fromkeys(name for name in self.limbs if name != PLATFORM))
        owners = np.array(self.limbs)
        one, other = np.triu_indices(len(owners), 1)
        joined = {*graph.links, *((b, a) for a, b in graph.links)}
        # With three drives or fewer, a force on the platform explains every effort, so clamping cannot be told.
        eligible = (owners[one] != owners[other]) & (robot.joints_count > 3)
        eligible &= [(self.parts[a], self.parts[b]) not in joined for a, b in zip(one, other, strict=True)]
        self.pairs = one[eligible], other[eligible]
        self.classes = (PLATFORM, *self.names)
        self.of_class = np.array([owners == name for name in self.classes], float)
        self.bodies = tuple(dict.fromkeys(self.parts))
        names = np.array(self.parts)
        self.of_body = np.array([names == name for name in self.bodies], float)
        keys = [(self.parts[a], self.parts[b]) for a, b in zip(*self.pairs, strict=True)]
        self.couples = tuple(dict.fromkeys(keys))
        numbers = {key: k for k, key in enumerate(self.couples)}
        self.couple_of = np.array([numbers[key] for key in keys], np.intp)
        self.prior = np.empty(len(owners))
        for name in self.classes:
            own = owners == name
            class_prior = PRIOR[PLATFORM] if name == PLATFORM else PRIOR["limbs"] / len(self.names)
            self.prior[own] = class_prior * size[own] / max(size[own].sum(), 1e-300)

    def evaluate(self, q: Array) -> tuple[Array, Array, Array]:
        """Return positions (P, 3), Jacobians (P, n, 3) and bar directions (P, 3), base axes."""
        n, count = self.robot.joints_count, len(self.robot.graph.bodies)
        flat = self.robot.function(_twist_kernel)(q)
        placed = np.concatenate([flat[: 12 * count], np.append(np.eye(3), np.zeros(3))]).reshape(count + 1, 12)
        rates = np.zeros((n, count + 1, 6))
        rates[:, :count] = flat[12 * count :].reshape(n, count, 6)
        placed, rates = placed[self._body], rates[:, self._body]
        lever = (placed[:, :9].reshape(-1, 3, 3) @ self._arm[:, :, None])[..., 0]
        ends = placed[:, 9:] + lever
        rows = np.empty((n + 1, 3, len(ends)))
        rows[0] = ends.T
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            # Component i of omega x lever.
            rows[1:, i] = rates[..., i] + rates[..., 3 + j] * lever[:, k]
            rows[1:, i] -= rates[..., 3 + k] * lever[:, j]
        found = (rows.reshape(-1, len(ends)) @ self._mix).reshape(n + 1, 3, -1)
        direction = ends[1::2] - ends[::2]
        length = np.sqrt((direction * direction).sum(1))[:, None]
        direction = np.divide(direction, length, out=np.zeros_like(direction), where=length > 0.0)[self._bar]
        # The axis of positions is last in memory, because it is the longest.
        return found[0].T, found[1:].transpose(2, 0, 1), direction


class ContactLocator:
    """Accumulate the evidence of each position for one contact, from its samples.

    During a contact the place on the body and the direction of the force in base axes are constant;
    while the machine moves each sample narrows both. The force is proportional to the external
    efforts. Errors of the efforts last longer than the beginning of a contact, so that all samples
    together are as exact as one.

    A platform with n freedoms explains efforts of all directions by a contact: it then has less
    evidence than a limb that explains fewer.
    """

    def __init__(self, robot: Robot) -> None:
        self.places = CandidatePositions(robot)
        # A contact force on a thin bar is mostly across it: along it only friction acts.
        self._along_reduction = np.where(self.places.thin, 1.0 - CONTACT_FRICTION, 0.0)
        self.reset()

    def reset(self) -> None:
        """Start a new contact."""
        self._sums: Array | None = None

    @np.errstate(all="ignore")
    def push(self, step: float, q: Array, qd: Array, external: Array, deviation: Array) -> None:
        """Add a sample.

        :param step: time since the last one, s.
        :param q: joint positions (n,), with rates ``qd`` and external efforts (n,), N m or N.
        :param deviation: standard deviations of the efforts, (n,).
        """
        weights = 1.0 / np.hypot(deviation, RELATIVE_MODEL_ERROR * np.abs(external))
        y = external * weights
        if not y.any():
            return
        self._positions, jacobians, along = self.places.evaluate(q)
        # The axis of positions is last: jacobian (n, 3, P), direction (3, P).
        jacobian, direction = jacobians.transpose(1, 2, 0), along.T
        if self._sums is None:
            self._start_contact(jacobian, weights, qd)
        # Scale by the effort's size, in the weights of the first sample: the force is proportional to it.
        weights = float(np.linalg.norm(external * self._first_weights)) * weights
        decay = math.exp(-step / DECAY_TIME)
        weight = min(1.0, step / CORRELATION_TIME)
        force_columns = jacobian * weights[:, None, None]
        force_columns -= (self._along_reduction * np.einsum("nip,ip->np", force_columns, direction))[
            :, None
        ] * direction
        # Derivatives of the pairs' distances by joint positions, (n, pairs).
        a, b = self._pairs
        pair_direction = (self._positions[a] - self._positions[b]).T
        pair_direction = pair_direction / np.sqrt((pair_direction * pair_direction).sum(0))
        pair_column = weights[:, None] * np.einsum(
            "nip,ip->np", jacobian.take(a, 2) - jacobian.take(b, 2), pair_direction
        )
        unknown_column = weights * self._unknown_effort
        sums = (
            np.array([len(q), y @ y]),
            np.einsum("nip,njp->ijp", force_columns, force_columns).ravel(),
            np.einsum("n,nip->ip", y, force_columns).ravel(),
            np.einsum("np,np->p", pair_column, pair_column),
            y @ pair_column,
            unknown_column * unknown_column,
            unknown_column * y,
        )
        new = weight * np.concatenate(sums)
        self._sums = new if self._sums is None else decay * self._sums + new

    def _start_contact(self, jacobian: Array, weights: Array, qd: Array) -> None:
        """Set the typical force, and the pairs of approaching bodies that can clamp something."""
        self._first_weights = weights
        sensitivity = np.sqrt(((jacobian * weights[:, None, None]) ** 2).sum((0, 1)))
        nonzero = sensitivity[sensitivity > 0.0]
        self._typical_force = 1.0 / float(np.median(nonzero)) if len(nonzero) else math.inf
        # Unknown contacts: efforts of any size that known contacts can cause.
        self._unknown_effort = self._typical_force * np.sqrt(np.mean(jacobian**2, (1, 2)))
        a, b = self.places.pairs
        offset = self._positions[a] - self._positions[b]
        distance = np.sqrt((offset * offset).sum(1))
        velocity = (qd @ jacobian.swapaxes(0, 1)).T
        rate = ((velocity[a] - velocity[b]) * offset).sum(1) / distance
        # Bodies that clamp something are near each other and approach at 2 % of the fastest pair at least.
        near = (distance > 0.0) & (distance < 0.4 * self.places.robot.graph.size)
        closing = near & (rate < -0.02 * np.abs(rate[near]).max(initial=0.0))
        self._pairs, self._pair_couple = (a[closing], b[closing]), self.places.couple_of[closing]

    @np.errstate(all="ignore")
    def place(self) -> ContactPlace | None:
        """Return the most likely place; None before the first sample, or if it is not finite."""
        if self._sums is None:
            return None
        if not np.isfinite(np.concatenate([self._sums, self._unknown_effort, self._positions.ravel()])).all():
            # A sum that is not finite stays so: start again.
            self.reset()
            return None
        found = self._compute_estimate(self._sums)
        finite = np.isfinite([*found.point, found.deviation, *found.classes.values()]).all()
        return found if finite else None

    def _compute_estimate(self, sums: Array) -> ContactPlace:
        """Return the most likely place by the accumulated sums, which must be finite."""
        n, count, pairs = len(self._unknown_effort), len(self._positions), len(self._pair_couple)
        # Model errors persist: more samples add directions, not accuracy in one direction.
        sums = sums / max(sums[0] / n, 1.0)
        sample_weight, square = sums[:2]
        ends = 2 + 12 * count
        forces = sums[2:ends].reshape(4, 3, count)
        line, sides = sums[ends : ends + 2 * pairs].reshape(2, pairs)
        other, others = sums[-2 * n :].reshape(2, n)
        places = self.places
        precision = ((self._typical_force * FORCE_RATIOS) ** -2.0)[:, None]
        # Log marginal likelihoods, (sizes, hypotheses), up to a common constant.
        (a, b, c), (_, d, e), (_, _, f) = forces[:3]
        x, y, z = forces[3]
        # B' B has no negative eigenvalue, except by rounding.
        first = a + precision
        left, far = b / first, c / first
        second = np.maximum(d + precision - left * b, precision)
        below = e - left * c
        low = below / second
        third = np.maximum(f + precision - far * c - low * below, precision)
        y = y - left * x
        z = z - far * x - low * y
        norms = x * x / first + y * y / second + z * z / third
        size = (first / precision) * (second / precision) * (third / precision)
        force_evidence = _average_over_sizes(np.asarray(0.5 * (norms - np.log(size)), np.float64))
        # The spacing of candidate positions gives clamping efforts an error of 0.15 of their size.
        noise = 1.0 + 0.15**2 * square * n / sample_weight
        clamping_evidence = _average_over_sizes(
            _component_evidence(line / noise, sides / noise, precision, one_sided=True)
        )
        clamping_evidence += 0.5 * (square * (1.0 - 1.0 / noise) - sample_weight * math.log(noise))
        unknown = float(_average_over_sizes(_component_evidence(other, others, FORCE_RATIOS[:, None] ** -2.0).sum(-1)))
        top = max(force_evidence.max(), clamping_evidence.max(initial=-np.inf), unknown)
        likely = places.prior * np.exp(force_evidence - top)
        # The prior of clamping is spread over all pairs, over at least as many as two bars have.
        clamped = PRIOR[CLAMPING] * np.exp(clamping_evidence - top) / max(len(clamping_evidence), POSITIONS_PER_BAR**2)
        unknown_weight = float(PRIOR[UNKNOWN] * np.exp(unknown - top))
        by_class = places.of_class @ likely
        probabilities = np.array([*by_class, clamped.sum(), unknown_weight])
        probabilities /= probabilities.sum()
        classes = dict(zip((*places.classes, CLAMPING, UNKNOWN), probabilities.tolist(), strict=True))
        best = max(classes, key=lambda name: classes[name])
        if best == CLAMPING:
            a, b = self._pairs
            couple = int(np.argmax(np.bincount(self._pair_couple, clamped)))
            weights, at = (
                np.where(self._pair_couple == couple, clamped, 0.0),
                0.5 * (self._positions[a] + self._positions[b]),
            )
            body = " and ".join(places.couples[couple])
            where = f"{CLAMPING} {body}"
        else:
            if best != UNKNOWN:
                likely = likely * places.of_class[places.classes.index(best)]
            number = int(np.argmax(places.of_body @ likely))
            weights, at = likely * places.of_body[number], self._positions
            body, where = places.bodies[number], best
        # The weighted mean of the positions on the body, and their standard deviation.
        fractions = weights / weights.sum()
        point = fractions @ at
        deviation = math.sqrt(float(fractions @ ((at - point) ** 2).sum(1)))
        confidence = classes[best]
        return ContactPlace(
            where if confidence >= MIN_CONFIDENCE else UNKNOWN, confidence, classes, body, point, deviation
        )


def _component_evidence(squares: Array, products: Array, precision: Array, *, one_sided: bool = False) -> Array:
    """Return log marginal likelihoods of forces with one component, (sizes, hypotheses).

    :param squares: B' B of the efforts B by a unit force, (hypotheses,). ``products``: B' y.
    :param precision: inverse variance of the force's prior, (sizes, 1).
    :param one_sided: the force is positive.
    """
    total = squares + precision
    logs = 0.5 * (products / total * products - np.log(total / precision))
    if one_sided:
        deviations = products / np.sqrt(total)
        # The normal distribution's logarithm, log 2 more, without underflow.
        tail = scipy.special.erfcx(np.abs(deviations) / math.sqrt(2.0))
        density = np.exp(-0.5 * deviations * deviations)
        logs += np.where(deviations > 0.0, np.log(2.0 - tail * density), np.log(tail) - 0.5 * deviations * deviations)
    return np.asarray(logs, np.float64)


def _average_over_sizes(logs: Array) -> Array:
    """Return the logarithm of the mean over the force's sizes, (hypotheses,)."""
    top = logs.max(0)
    return np.asarray(top + np.log(np.exp(logs - top).mean(0)), np.float64)
