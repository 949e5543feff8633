# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Can this machine have made this recording? Asked before anything is fitted.

The efforts are fitted by a machine as far from its file as one may be: friction, rotors, a payload,
masses within a factor of two, current sensors off by a part of the load, all of them physically
possible. What such a machine leaves unexplained is compared with what it leaves of the recording
put right: signs turned, columns exchanged, another unit, another time. A recording that one of
these explains as well as a sound one has that fault; of others no cause is named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, product
from typing import Any, Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.rows import LARGEST, Rows, rows_of
from pkm_twin.identification.samples import held_payload
from pkm_twin.machine.friction import turning_keys
from pkm_twin.machine.inertia import standard_parameters
from pkm_twin.messages.reading import in_base_axes
from pkm_twin.recordings import Recording

OFFSET: Final = 0.1
"""Part of the efforts that a current sensor is off by."""
HEAVIER: Final = 0.3
"""Part of its value that a mass or a rotor of the file is off by."""
REACH: Final = 1.5
"""Machine sizes from the platform within which a payload is."""
SOME: Final = 2000
"""Samples by which other positions and times are judged: those that are explained worst."""
TIMES: Final = {
    "the time is in ms, not in s": 1e-3,
    "the time is in us, not in s": 1e-6,
    "the time is in ns, not in s": 1e-9,
    "the time is in minutes, not in s": 60.0,
    "the time is in s, and was taken for ms": 1e3,
}
ANGLES: Final = {
    "positions are in degrees": np.pi / 180.0,
    "positions are in rad, and were taken for degrees": 180.0 / np.pi,
    "positions are in mm": 1e-3,
    "positions are in turns": 2.0 * np.pi,
}
GOOD: Final = 0.015
"""Part of the efforts' variation that a sound model may leave."""
INDEPENDENT: Final = 15.0
"""As how many independent errors a model's error counts."""
RARE: Final = 14.0
"""What a fault costs, minus twice a logarithm of its probability: one in a thousand,"""
UNIT: Final = 6.0
"""and another unit, one in twenty."""
POOR: Final = 0.3
"""Part of the variation, beside noise, that no recording of the machine leaves."""
NAMED: Final = 0.8
"""A fault is named if without it no more than this part is left."""
LARGE_REST: Final = 0.1
"""What is left from which other positions and times are tried, which costs more."""
BESIDE_NOISE: Final = 0.03
"""What a recording leaves beside noise once its fault is put right: of more the cause is unknown.
"""
HELD: Final = 0.15
"""The same of a payload that is held for a while, whose times are estimated from the efforts."""
RANGE: Final = 2.0
"""How many times as heavy as its file a machine may be, and the inverse."""
LATEST: Final = 0.05
"""Efforts that are late, or early, by no more can be this recording's, s."""
SHORT: Final = 0.01
"""A delay that is no fault, s."""
SEARCHED: Final = 1.5
"""How far efforts are looked for in time, s."""
SLOWEST: Final = 1.0
"""Time between samples of a recording from which no motion can be differentiated, s."""
UNITS: Final = {
    "N mm or mN m": 1e3,
    "kgf cm": 100.0 / 9.80665,
    "kgf or kgf m": 1.0 / 9.80665,
    "lbf": 1.0 / 4.4482216,
    "lbf in": 1.0 / 0.112984829,
    "ozf in": 1.0 / 0.00706155183,
    "kN or kN m": 1e-3,
}
"""Units that efforts come in, by how many are a newton or a newton metre."""
SCALES: Final = tuple(2.0 ** (k / 4.0) for k in range(-6, 7))
"""Around the scale of least squares."""
MAX_SOLUTIONS: Final = 4
"""Most solutions for one recording, each with what the one before has left."""
RATES: Final = (2.0, 0.5, 3.0, 1.0 / 3.0, 4.0, 0.25, 5.0, 0.2, 10.0, 0.1)
"""Of time steps that were taken for others'."""
SPANS: Final = 3
"""Most times that are named."""
MASSES: Final = "all masses are {:.3g} times the file's"
LIKE_A_UNIT: Final = 1.25
"""A scale that is so near to a unit's is named by it."""


@dataclass(frozen=True, eq=False)
class Case:
    """A recording's efforts and the machines that may have made them: k rows, n joints.

    ``effort``: measured, (k, n); ``late``: its derivative in time; ``variation``: its standard
    deviation, (n,). ``rest``: what is certain;
    ``columns``: by what is not, (k, n, c), about ``usual``, as far off as ``spread`` (infinite:
    nobody knows), between ``low`` and ``high``, (c,). ``friction``: which columns turn round with
    time, (c,). ``counts``: 1 for what is judged. ``time``: of the rows, s, (k,). ``payload``: which
    columns are the payload's, the first one a mass at the platform's point, (c,). ``inertial``: the
    part of the columns that grows with the square of the rate of time, (k, n, c); None where that
    is not asked.
    """

    effort: Array
    late: Array
    variation: Array
    rest: Array
    columns: Array
    low: Array
    high: Array
    prior: Array
    usual: Array
    friction: Mask
    counts: Array
    time: Array
    payload: Mask
    inertial: Array | None = None

    @property
    def period(self) -> float:
        """Of the rows, s."""
        return float(np.median(np.diff(self.time)))

    def backwards(self) -> Case:
        """Return the case with time reversed: friction helps the motion."""
        return replace(self, columns=np.where(self.friction, -1.0, 1.0) * self.columns)

    def faster(self, rate: float) -> Case:
        """Return the case with time that runs faster than recorded by a factor."""
        extra = 0.0 if self.inertial is None else (rate**2 - 1.0) * self.inertial
        return replace(self, columns=self.columns + extra)

    @cached_property
    def reduced(self) -> Case:
        """The same by as few rows as columns: enough to judge it, and others of these columns."""
        parts = [self.columns, *(one[..., None] for one in (self.effort, self.late, self.rest))]
        parts += [] if self.inertial is None else [self.inertial]
        table = np.concatenate(parts, -1) * self.counts[..., None]
        rows = np.asarray(np.linalg.qr(table.swapaxes(0, 1), mode="r"), np.float64).swapaxes(0, 1)
        columns, effort, late, rest, inertial = np.split(rows, len(self.low) + np.arange(4), axis=-1)
        # Together they count as those that they stand for.
        counts = np.full(effort.shape[:2], effort.size / max(float(self.counts.sum()), 1.0))
        return replace(
            self,
            columns=columns,
            effort=effort[..., 0],
            late=late[..., 0],
            rest=rest[..., 0],
            counts=counts,
            inertial=None if self.inertial is None else inertial,
        )

    def scaled(self, factors: Array) -> Case:
        """Return the case with each joint's efforts times a factor, (n,)."""
        r, size = self.reduced, np.abs(factors) * self.variation
        return replace(r, effort=factors * r.effort, late=factors * r.late, variation=size)

    def judged(self) -> Score:
        """How well, and how likely, the best of these machines explains the efforts."""
        return self._best[0]

    @cached_property
    def _best(self) -> tuple[Score, Array]:
        none = np.zeros((*self.effort.shape, 0))
        return self._solved(none, self.effort, self.variation)

    def missed(self) -> Array:
        """Return the efforts the best machine does not explain, over their variation, (k, n)."""
        x = self._best[1]
        told = self.rest + self.columns @ x[:-1] - x[-1] * self.late
        return np.asarray(self.counts * (self.effort - told) / self.variation, np.float64)

    def loaded_in_part(self) -> tuple[str, Case]:
        """Return the case loaded only while the efforts ask for it, and those times in words.

        Of the best machine's numbers those of the payload are left out.
        """
        x = self._best[1]
        told = self.rest + self.columns @ np.where(self.payload, 0.0, x[:-1]) - x[-1] * self.late
        weight = self.counts / self.variation**2
        mass = self.columns[..., int(np.argmax(self.payload))]
        _, spans, held = held_payload(self.time, mass, self.effort - told, weight)
        share = np.where(self.payload, held[:, None, None], 1.0)
        part = replace(
            self,
            columns=share * self.columns,
            inertial=None if self.inertial is None else share * self.inertial,
        )
        times = [f"{begin:.4g} to {end:.4g} s" for begin, end in spans[:SPANS]]
        times += ["..."] if len(spans) > SPANS else []
        kilograms = float(part._best[1][:-1][self.payload].sum())
        when = f" at {', '.join(times)}" if times else ""
        text = f"an unknown payload of about {kilograms:.2g} kg{when}"
        return f"{text} (--payload, --load-times)", part

    def scales(self, free: Array) -> Array:
        """Factors on the efforts with which a likely machine explains them, of any sign, (n,).

        :param free: joints by the factors that are looked for, 1 or 0, shape (n, factors); a joint
            of no factor keeps its efforts.
        """
        # Homogeneous in the efforts: what is certain of the machine is the measure.
        size = np.std(self.rest + self.columns @ self.start, 0)
        size = np.maximum(size, 1e-6 * max(float(size.max()), 1e-300))
        stays = 1.0 - free.sum(1)
        found = self._solved(-self.effort[..., None] * free, stays * self.effort, size)[1]
        return np.asarray(free @ found[len(self.low) + 1 :] + stays, np.float64)

    @property
    def start(self) -> Array:
        """What is not certain as it is usually, shape (c,)."""
        return np.asarray(np.linalg.pinv(self.prior) @ self.usual, np.float64)

    def _solved(self, free: Array, effort: Array, size: Array) -> tuple[Score, Array]:
        """By rows whose squares sum to the part of ``size``; and the numbers found."""
        weight = self.counts / size / np.sqrt(max(float(self.counts.sum()), 1.0))
        table = np.concatenate([self.columns, -self.late[..., None], free], -1) * weight[..., None]
        width = table.shape[-1]
        values = ((effort - self.rest) * weight).reshape(-1, 1)
        rows = np.concatenate([table.reshape(-1, width), values], 1)
        reduced = np.asarray(np.linalg.qr(rows, mode="r"), np.float64)
        unbound = np.full(free.shape[-1], np.inf)
        low = np.concatenate([self.low, [-LATEST], -unbound])
        high = np.concatenate([self.high, [LATEST], unbound])
        prior = np.pad(self.prior, ((0, 0), (0, width - len(self.low))))
        norm = np.linalg.norm(reduced[:, :width], axis=0)
        norm = np.where(norm > 0.0, norm, 1.0)
        left, x = GOOD, np.zeros(width)
        for _ in range(MAX_SOLUTIONS):
            root = np.sqrt(INDEPENDENT / (left**2 + GOOD**2))
            rows = np.concatenate([root * reduced[:, :width], prior]) / norm
            aim = np.concatenate([root * reduced[:, width], self.usual])
            found = scipy.optimize.lsq_linear(rows, aim, (low * norm, high * norm), method="bvls")
            x = np.asarray(found.x / norm, np.float64)
            before, left = left, float(np.linalg.norm(reduced[:, :width] @ x - reduced[:, width]))
            if abs(left - before) < 0.01 * GOOD:
                break
        cost = INDEPENDENT * np.log(left**2 + GOOD**2) + np.sum((prior @ x - self.usual) ** 2)
        return Score(left, float(cost)), x


@dataclass(frozen=True)
class Score:
    """The part of the measurements' variation that is left, and what the machine costs.

    Minus twice a logarithm of its probability: of what is left, and of numbers far from the file's.
    """

    left: float
    cost: float

    @classmethod
    def of(cls, left: float) -> Score:
        """Return the score of a residual, without a price."""
        return cls(left, float(INDEPENDENT * np.log(left**2 + GOOD**2)))


Repair = tuple[str, Callable[[], Score] | None, float]
"""A fault in words, how well a machine explains the recording without it (None: no machine can have
made that), and the fault's price."""


def likeliest(told: Score, repairs: Iterable[Repair]) -> tuple[str, Score, float]:
    """Put each fault right and see: the fault without which a recording is the likeliest.

    :param told: of the recording as it is.
    :returns: also how well the rest is explained and what is gained; no words where nothing is.
    """
    cause, best, most = "", told, 0.0
    for text, other, price in repairs:
        found = told if other is None else other()
        gain = told.cost - found.cost - price
        if gain > most:
            cause, best, most = text, found, gain
    return cause, best, most


def wrenches(r: Recording) -> Iterator[tuple[str, Array | None]]:
    """Faults of a recording's wrenches, and the wrenches without each."""
    if r.wrench is None or not r.wrench.any():
        return
    rotation, axes = r.robot.rotation(r.robot.forward(r.q)), "platform"
    if r.topics.turns:
        rotation, axes = rotation.swapaxes(-1, -2), "base"
    yield f"the wrench has {axes} axes", in_base_axes(r.wrench, rotation)
    text = "the wrench has the opposite sign: it is what the platform applies to its surroundings"
    yield text, -r.wrench
    yield "without the wrench the efforts agree: it does not act on the platform", None


def recording_fault(rows: Rows) -> str | None:
    """Why this machine cannot have made a recording; None where it can.

    :param rows: with all parameters of the file.
    """
    time, motion = rows.recording.time, rows.signals.motion
    joints, everything = rows.model.robot.joint_names, rows.model.parameters
    period = float(np.median(np.diff(time)))
    if period > SLOWEST:
        return f"samples {period:.3g} s apart show no motion (is the time in ms?)"
    still = replace(motion, qd=0.0 * motion.qd, qdd=0.0 * motion.qdd)
    moving, standing = (rows.model.columns(one)[0] for one in (motion, still))
    rubs = [group.kind == "friction" for group in everything.groups for _ in group.names]
    case = case_of(rows, np.where(rubs, 0.0, moving - standing))
    told = case.judged()
    # Nothing that is put right is likelier than a perfect machine at the price of another unit.
    if told.cost < Score.of(0.0).cost + UNIT:
        return None
    loaded = (case.loaded_in_part(),) if case.payload.any() else ()
    others = [*_efforts(case, joints), ("time runs backwards", case.reduced.backwards(), RARE)]
    others += [(*one, UNIT) for one in loaded]
    cause, best, gain = likeliest(told, ((t, other.judged, price) for t, other, price in others))
    # The part of the variation that is noise.
    noise = rows.signals.noise * np.sqrt(rows.signals.band)
    noisy = float(np.sqrt(np.mean((noise / case.variation) ** 2)))
    known = min(float(np.hypot(BESIDE_NOISE, noisy)), 2.0 * POOR)
    unclear = bool(cause) and best.left > known
    first = int(np.searchsorted(time, _worst(case, SOME * period)))
    first = max(0, min(first, len(time) - SOME))
    some = slice(first, first + SOME)
    wide = unclear or best.left > LARGE_REST
    pushed = rows.recording.wrench is not None and rows.recording.wrench.any()
    here = _again(rows, some) if wide or pushed else None
    if here is not None:
        # All of them by the same samples: how much better than as recorded?
        own = here.judged()
        again = likeliest(
            own,
            ((t, None if made is None else made.judged, RARE) for t, made in _repaired(rows, some, wide)),
        )
        if again[2] > gain:
            told, (cause, best, _) = own, again
    known = max(known, HELD) if cause in dict(loaded) else known
    if cause and best.left <= known:
        if best.left < NAMED * told.left:
            return (
                f"{cause}: put right, {100 * best.left:.2g} % of the efforts' variation is "
                f"unexplained, as recorded {100 * told.left:.2g} %"
            )
        return f"{cause}: as recorded, masses and payload would be far from the file's"
    # More than all of it: the efforts have nothing of the motion, however large their noise.
    if cause or told.left**2 > min(POOR**2 + noisy**2, 1.0):
        return (
            "no machine like the file's explains the efforts, and no single mistake does: "
            f"{100 * told.left:.2g} % of their variation is left (another machine, another motion, "
            "an unknown load, or noise?)"
        )
    return None


def _repaired(rows: Rows, some: slice, wide: bool) -> Iterator[tuple[str, Case | None]]:
    """Faults of wrenches and, where ``wide``, of positions and times; some samples without each.

    None where the machine cannot move so.
    """
    r, robot = rows.recording, rows.model.robot
    names, eye = robot.joint_names, np.eye(robot.joints_count)
    for text, wrench in wrenches(r):
        yield text, _again(rows, some, wrench=wrench)
    if not wide:
        return
    for text, scale in TIMES.items():
        yield text, _again(rows, some, time=r.time * scale)
    for text, scale in ANGLES.items():
        yield text, _again(rows, some, q=r.q * scale)
    if len(names) > 1:
        yield "positions of all joints have the wrong sign", _again(rows, some, q=-r.q)
    # A drive that counts the wrong way is mirrored at zero, where it was homed, or anywhere.
    middles = 0.0 * robot.graph.home, robot.graph.home, r.q.mean(0)
    for (name, e), middle in product(zip(names, eye, strict=True), middles):
        turned = 1.0 - 2.0 * e
        q = middle + turned * (r.q - middle)
        text = f"of {name} have the wrong sign (joint_map?)"
        yield f"positions {text}", _again(rows, some, q=q)
        yield f"positions and efforts {text}", _again(rows, some, q=q, effort=turned * r.measured)
    for i, k in combinations(range(len(names)), 2):
        order = _swap(len(names), i, k)
        text = f"{names[i]} and {names[k]} are exchanged"
        yield f"positions of {text}", _again(rows, some, q=r.q[:, order])
        yield text, _again(rows, some, q=r.q[:, order], effort=r.measured[:, order])


def _again(rows: Rows, some: slice, **changes: Any) -> Case | None:
    """Return some samples of a changed recording; None where the machine cannot move so."""
    model = rows.model
    try:
        made = rows_of(model.robot, model.parameters, replace(rows.recording, **changes).part(some))
    except (PkmTwinError, ValueError, np.linalg.LinAlgError):
        return None
    needs = made.rest + made.table @ model.parameters.values
    return case_of(made) if np.abs(needs).max() < LARGEST else None


def _worst(case: Case, duration: float) -> float:
    """Where the part of such a duration begins that is explained worst, s."""
    total = np.concatenate([[0.0], np.cumsum(np.sum(case.missed() ** 2, 1))])
    ends = np.searchsorted(case.time, case.time + duration)
    return float(case.time[np.argmax(total[ends] - total[:-1])])


def case_of(rows: Rows, inertial: Array | None = None) -> Case:
    """Return the machines that may have made a recording, around the robot's file.

    :param inertial: the part of the rows' table that grows with the square of the rate of time.
    """
    robot, everything = rows.model.robot, rows.model.parameters
    tables = [rows.table] if inertial is None else [rows.table, inertial]
    told = rows.rest + rows.table @ everything.values
    size = np.sqrt(np.mean(told**2, 0))
    total = sum(body.mass for body in robot.graph.bodies.values())
    total += sum(rod.mass for rod in robot.graph.rods.values()) + robot.payload.mass
    parts: list[list[Array]] = []
    bounds: list[tuple[float, float]] = []
    prior: list[tuple[slice, float, float]] = []
    friction: list[bool] = []
    payload: list[bool] = []
    turning = turning_keys() | {"viscous"}
    for where, group in zip(everything.slices, everything.groups, strict=True):
        own, value = [table[..., where] for table in tables], float(group.values[0])
        scale, first = float(everything.scales[where][0]), len(bounds)
        rubs = group.kind == "friction" and group.names[0].rpartition(".")[2] in turning
        bound, known = (0.0, np.inf), (value, scale)
        if group.kind == "inertia":
            own = [(one @ group.values)[..., None] for one in own]
            bound, known = (0.3, 2.5), (1.0, HEAVIER)
        elif group.kind == "payload":
            own = [one @ _points(REACH * robot.size) for one in own]
            bound, known = (0.0, total), (value, scale)
        elif group.kind == "rotor" and value > 0.0:
            known = (value, HEAVIER * value)
        elif group.names[0].endswith("offset"):
            most = OFFSET * float(np.max(np.abs(own[0]).max((0, 1)) * size))
            bound, known = (-np.inf, np.inf), (value, most)
        parts.append(own)
        bounds += [bound] * own[0].shape[-1]
        friction += [rubs] * own[0].shape[-1]
        payload += [group.kind == "payload"] * own[0].shape[-1]
        if not rubs and known[1] > 0.0:
            prior.append((slice(first, len(bounds)), *known))
    rows_of_prior = np.zeros((len(prior), len(bounds)))
    for row, (columns, _, spread) in zip(rows_of_prior, prior, strict=True):
        row[columns] = 1.0 / spread
    low, high = np.array(bounds).T
    wholes = [np.concatenate(each, -1) for each in zip(*parts, strict=True)]
    return Case(
        rows.effort,
        rows.change,
        _variation(rows.effort),
        rows.rest,
        wholes[0],
        low,
        high,
        rows_of_prior,
        np.array([value / spread for _, value, spread in prior]),
        np.array(friction),
        rows.counts,
        rows.time,
        np.array(payload),
        None if inertial is None else wholes[1],
    )


def _variation(effort: Array) -> Array:
    """Return the standard deviation of efforts, shape (n,)."""
    return np.asarray(np.maximum(np.std(effort, 0), 1e-300), np.float64)


def _points(reach: float) -> Array:
    """Ten numbers of a kilogram at the platform's point and around it, shape (10, points)."""
    corners = reach / np.sqrt(3.0) * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    places = [np.zeros(3), *(reach * np.eye(3)), *(-reach * np.eye(3)), *corners]
    return np.stack([standard_parameters(1.0, place, np.zeros((3, 3))) for place in places], -1)


def _efforts(case: Case, joints: Sequence[str]) -> Iterator[tuple[str, Case, float]]:
    """Faults of the efforts, with their prices: signs, scales, columns, delays."""
    n = len(joints)
    for signs in _signs(case.scales(np.eye(n))):
        negative = [joint for joint, sign in zip(joints, signs, strict=True) if sign < 0.0]
        yield f"efforts of {listed(negative, n)} have the wrong sign", case.scaled(signs), RARE
    for which in [np.ones(n), *np.eye(n)] if n > 1 else [np.ones(1)]:
        # The likeliest scale is looked for, as the one of least squares is near it alone.
        near = case.scales(which[:, None])[int(np.argmax(which))]
        tried = [near * step for step in SCALES] + [1.0 / unit for unit in UNITS.values()]
        factors = [np.where(which > 0.0, one, 1.0) for one in tried if one != 0.0]
        likely = min(factors, key=lambda one: case.scaled(one).judged().cost)
        factor = float(likely[int(np.argmax(which))])
        if not 1.0 / RANGE <= factor <= RANGE:
            names = listed([j for j, one in zip(joints, which, strict=True) if one > 0.0], n)
            price = UNIT if factor > 0.0 else RARE + UNIT
            yield scale_text(names, 1.0 / factor), case.scaled(likely), price
    orders = [
        (f"efforts of {joints[i]} and {joints[k]} are exchanged", _swap(n, i, k)) for i, k in combinations(range(n), 2)
    ]
    if n > 2:
        orders += [("columns of the efforts are in another order", np.roll(np.arange(n), s)) for s in (1, n - 1)]
        orders.append(("columns of the efforts are in another order", np.arange(n)[::-1]))
    for text, order in orders:
        effort, late = case.effort[:, order], case.late[:, order]
        other = replace(case, effort=effort, late=late, variation=case.variation[order])
        yield text, other, RARE
    yield from ((text, other, RARE) for text, other in _delays(case, joints))
    if case.inertial is not None:
        for rate in RATES:
            text = f"the motion was {rate:.2g} times as fast as its time stamps are (time steps?)"
            yield text, case.reduced.faster(rate), UNIT


def _signs(scales: Array) -> list[Array]:
    """All of them, each of them, and those that the best scales have."""
    n, best = len(scales), np.sign(scales)
    found = [-np.ones(n), *(1.0 - 2.0 * np.eye(n))] if n > 1 else [-np.ones(1)]
    if (best < 0.0).any() and (best != 0.0).all():
        found.append(best)
    return found


def _swap(n: int, i: int, k: int) -> NDArray[np.int64]:
    order = np.arange(n)
    order[[i, k]] = k, i
    return order


def _delays(case: Case, joints: Sequence[str]) -> Iterator[tuple[str, Case]]:
    """Efforts, of all joints or of one, that belong to another time."""
    k, n = case.effort.shape
    most = min(int(SEARCHED / case.period), k // 4)
    steps = range(-most, most + 1)
    if most * case.period < SHORT:
        return
    inner = slice(most, k - most)
    missed = np.empty((len(steps), n))
    for j in range(n):
        table = np.concatenate([case.columns[inner, j], case.late[inner, j, None]], 1)
        table = table[:, np.abs(table).max(0) > 0.0]
        basis = np.linalg.qr(table / np.linalg.norm(table, axis=0))[0]
        rest = case.rest[inner, j] / case.variation[j]
        own = case.effort[:, j] / case.variation[j]
        shifted = np.stack([own[most + s : k - most + s] for s in steps]) - rest
        missed[:, j] = np.sum(shifted**2, 1) - np.sum((shifted @ basis) ** 2, 1)
    choices: list[tuple[Sequence[int], int]] = [(range(n), int(np.argmin(missed.sum(1))))]
    choices += [((j,), int(np.argmin(missed[:, j]))) for j in range(n)] if n > 1 else []
    for which, place in choices:
        step = steps[place]
        if abs(step) * case.period < SHORT:
            continue
        names = listed([joints[j] for j in which], n)
        cut = {name: getattr(case, name)[inner] for name in ("rest", "columns", "counts", "time")}
        effort, change = case.effort[inner].copy(), case.late[inner].copy()
        for j in which:
            there = slice(most + step, k - most + step)
            effort[:, j], change[:, j] = case.effort[there, j], case.late[there, j]
        size = _variation(effort)
        made = replace(case, effort=effort, late=change, variation=size, **cut)
        yield late_text(names, step * case.period + float(made._best[1][-1])), made


def late_text(names: str, late: float) -> str:
    """Efforts that belong to another time, in words."""
    return f"efforts of {names} are {abs(late):.2g} s {'late' if late > 0 else 'early'}"


def scale_text(names: str, scale: float, *others: str) -> str:
    """Efforts of another scale, in words, or what else explains them as well."""
    sign = " and of the wrong sign" if scale < 0.0 else ""
    alike = "".join(f"; or {other}" for other in others)
    alike += ", the recording cannot tell" if others else ""
    near = sorted(UNITS, key=lambda unit: abs(np.log(abs(scale) / UNITS[unit])))[0]
    unit = f" ({near}?)" if 1.0 / LIKE_A_UNIT < abs(scale) / UNITS[near] < LIKE_A_UNIT else ""
    return (
        f"efforts of {names} are {abs(scale):.3g} times what the robot's file makes of the motion"
        f"{sign}: units? N m and N{unit}" + alike
    )


def listed(names: Sequence[Any], count: int) -> str:
    """Names of joints, of so many, in words."""
    return "all joints" if len(names) == count > 1 else " and ".join(names)
