# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The one thing that explains efforts which contradict a robot's file, for ``check`` and ``fit``.

A sign, the axes or the sign of the wrench, or one number: the scale of the efforts, of all drives
or of one, or a payload. Of the numbers the one counts that leaves least. If none does, it is two:
a sign and a number, or a scale and a payload.
What is put right has to make the efforts agree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from typing import Final

import numpy as np

from delta_dynamics import dynamics_terms, inverse_dynamics
from delta_dynamics.torques.stiction import friction_reach
from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.compare import (
    MAX_RESIDUAL,
    Compared,
    by_held,
    compare,
    compared_of,
    near_change,
)
from pkm_twin.identification.judge import SIGMAS
from pkm_twin.identification.plausible import MASSES, listed, scale_text, wrenches
from pkm_twin.identification.samples import held_payload, passed_band
from pkm_twin.identification.suspects import OFF
from pkm_twin.machine.friction import KNOWN_FRACTION, Dahl
from pkm_twin.recordings import Load, Recording
from pkm_twin.robot.plausibility import why_no_torques
from pkm_twin.robot.robot import Robot

SPANS: Final = 50
"""Most times that a payload is picked."""
LIGHTEST: Final = 1e-3
"""Part of the machine's mass below which a payload is none."""
EXACT: Final = 0.2
"""Part of the residual's bound that a number leaves: of more, something else is wrong, too."""
SCALED: Final = 1.0 + SIGMAS * OFF
"""Scale, or its inverse, beyond which efforts are not a machine's: less is a usual gain error."""
BETTER: Final = 2.0
"""How many times as much of the residual's square one number leaves that is not the whole cause."""
BLOCK: Final = 0.25
"""Around a pick or release neither mass nor scale is found, s."""
PASSES: Final = 4
"""How often the times of a payload and the scale of the efforts follow from each other."""
ALIKE: Final = 4.0
"""How many times as much of the residual's square other masses leave that explain it as well."""

Spans = tuple[tuple[float, float], ...]
"""When a payload is held, s; empty: all the time."""


@dataclass(frozen=True, eq=False)
class Cause:
    """A cause in words, the recording put right, and samples that are left out then, (samples,).

    ``exact``: part of the residual's bound within which the efforts agree. ``scale``: how many
    times too large they are, negative with wrong signs. ``late``: how late, s.
    """

    text: str
    recording: Recording
    left_out: Mask
    exact: float = EXACT
    scale: float = 1.0
    late: float = 0.0

    def then(self, others: Iterable[Cause]) -> Iterator[Cause]:
        """Causes of the recording that this one puts right, each together with this one."""
        for other in others:
            text, scale = f"{self.text}; put right, {other.text}", self.scale * other.scale
            yield replace(other, text=text, scale=scale)

    def agrees(self, bound: float) -> bool:
        """Whether the efforts agree with the model once this is put right."""
        return agrees(self.recording, self.left_out, self.exact * bound)


def usual(scale: float) -> bool:
    """Whether efforts of a scale can be a machine's: it is nearly right."""
    return 1.0 / SCALED < scale < SCALED


def agrees(r: Recording, without: Mask, bound: float) -> bool:
    """Whether the efforts agree with the model, apart from some samples."""
    try:
        compared = compared_of(r, without, bound)
    except (PkmTwinError, ValueError):
        return False
    return compared is not None and bool(compared.good.all()) and not compared.delayed


def cause_of(r: Recording, c: Compared, left_out: Mask) -> Cause | None:
    """Find the first cause that makes the efforts agree; None where there is none."""
    turned = (Cause(text, replace(r, wrench=w), left_out, 1.0) for text, w in wrenches(r))
    found = chain(turned, _of_efforts(r, c, left_out))
    return next((cause for cause in found if cause.agrees(c.bound)), None)


def payload_hint(r: Recording, c: Compared) -> str:
    """Describe the payload behind most of a residual within its bound; empty: there is none."""
    if r.load is not None or r.robot.redundant:
        return ""
    numbers = _Numbers(r, c)
    (mass, _), left = numbers.solved(numbers.efforts(_kilogram))
    other = min(numbers.solved()[1], *(one.left for one in numbers.scales()))
    if mass < numbers.lightest or not numbers.clear(left, other, ALIKE):
        return ""
    text = _payload_text(r.robot, mass)
    return f"{text} explains most of the residual: --payload {r.robot.payload.mass + mass:.3g}"


def number_that_explains(r: Recording) -> Cause | None:
    """Find what `cause_of` finds from efforts alone; no words where they agree as they are.

    None where nothing makes them agree.
    """
    if r.robot.redundant or why_no_torques(r.robot):
        return None
    none = np.zeros(len(r.time), np.bool_)
    try:
        c = compare(r)
        if c is None or replace(c, bound=EXACT * c.bound).good.all():
            return None if c is None else Cause("", r, none, late=c.late)
        found = () if c.good.all() else _of_efforts(r, c, none)
        return next((cause for cause in found if cause.agrees(MAX_RESIDUAL)), None)
    except (PkmTwinError, ValueError):
        return None


def _of_efforts(r: Recording, c: Compared, left_out: Mask) -> Iterator[Cause]:
    """Find signs of efforts that oppose the expected ones, one or two numbers; or both."""
    opposed = ~c.good & (np.sum(c.measured * c.expected, 0) < 0.0)
    if not opposed.any():
        yield from _number_of(r, c, left_out)
        return
    names = listed(np.array(r.robot.joint_names)[opposed].tolist(), len(opposed))
    effort = r.measured * np.where(opposed, -1.0, 1.0)
    text = f"efforts of {names} have the wrong sign"
    turned = Cause(text, replace(r, effort=effort), left_out, 1.0, -1.0)
    yield turned
    yield from _number_of(r, c, left_out)
    other = compared_of(turned.recording, left_out, c.bound)
    if other is not None:
        yield from turned.then(_number_of(turned.recording, other, left_out))


def _number_of(r: Recording, c: Compared, left_out: Mask) -> Iterator[Cause]:
    """Find the number that leaves least of the residual: scale or payload; then both together.

    Two, or a payload with its times, come first where they leave clearly less.
    """
    numbers, order = _Numbers(r, c), list[_Found]()
    found = [*numbers.scales(), *(numbers.payloads() if r.load is None else ())]
    for count in (1, 2, 3):
        alike = [one for one in found if one.count == count]
        if alike:
            one = min(alike, key=lambda each: each.left)
            clear = not order or numbers.clear(one.left, order[0].left, BETTER)
            order.insert(0 if clear else len(order), one)
    for one in order:
        yield from numbers.causes(one, found, left_out)


@dataclass(frozen=True, eq=False)
class _Found:
    """A scale of the efforts of some drives, ``which`` (n,), and a payload that is held at times.

    ``left``: the mean square that they leave of the residual over its limit.
    """

    left: float
    names: str
    which: Array
    scale: float
    mass: float = 0.0
    spans: Spans = ()

    @property
    def count(self) -> int:
        """Of numbers; all times are one."""
        return bool(self.names) + bool(self.mass) + bool(self.spans)


class _Numbers:
    """Numbers that make a recording's residual of parts of the expected efforts, by least squares.

    Each with a delay: that which was taken out explains a scale in part.
    """

    def __init__(self, r: Recording, c: Compared) -> None:
        self.r, self.c, robot, n = r, c, r.robot, r.robot.joints_count
        each = [*zip(robot.joint_names, np.eye(n), strict=True)] if n > 1 else []
        self.drives = [("all joints", np.ones(n)), *each]
        self.lightest = LIGHTEST * sum(body.mass for body in robot.graph.bodies.values())
        self.noise = float(np.mean((c.noise / c.limit) ** 2))
        # The residual of a joint at rest, or of unknown memory, lacks what its friction may hold.
        doubt = [Dahl.remembered(robot.friction, t.q, t.sure(c.how))[1] for t in c.tracks]
        doubt = [one[rows] for one, rows in zip(doubt, c.inner, strict=True)]
        reach = friction_reach(robot)
        self.used = (~c.rests & (np.concatenate(doubt) <= KNOWN_FRACTION * reach)) | (reach == 0.0)
        self.count = max(int(self.used.sum()), 1) * passed_band(c.how, 1.0 / c.period)

    def clear(self, least: float, other: float, times: float) -> bool:
        """Whether so many times the least squares remain, beside noise, and not by chance."""
        noise, chance = min(self.noise, least), SIGMAS**2 * least / self.count
        return other - least > chance and other - noise > times * (least - noise)

    def solved(self, *columns: Array, some: Mask | None = None) -> tuple[list[float], float]:
        """Return the factors of columns (k, n), then the delay, s; also the mean square left."""
        used = self.used if some is None else self.used & some[:, None]
        table = np.stack([*columns, self.c.change, self.c.residual], -1) / self.c.limit[:, None]
        table = table[used]
        sizes = np.linalg.lstsq(table[:, :-1], table[:, -1])[0]
        left = np.sum((table[:, -1] - table[:, :-1] @ sizes) ** 2)
        return sizes.tolist(), float(left) / max(len(table), 1)

    def efforts(self, function: Callable[..., Array]) -> Array:
        """Evaluate a function of the robot and the recorded motion, in its band, (k, n)."""
        r, tracks = self.r, self.c.tracks
        return self.c.filtered([by_held(r, function, t.time, *t.joints, t.wrench) for t in tracks])

    def scales(self) -> Iterator[_Found]:
        """Estimate the scale of the efforts of all drives, and of each."""
        for names, which in self.drives:
            (size, _), left = self.solved(which * self.c.expected)
            yield _Found(left, names, which, 1.0 + size)

    def payloads(self) -> Iterator[_Found]:
        """Estimate a payload, throughout or at times, alone and with an unusual scale."""
        c, kilogram = self.c, self.efforts(_kilogram)
        alone = ("", 0.0 * self.drives[0][1])
        mass = size = late = left = 0.0
        for (names, which), always in product([alone, *self.drives], [True, False]):
            own, held, spans = which * c.expected, np.ones(len(c.time), np.bool_), Spans()
            # The times are looked for beside the scale with which a payload is held throughout.
            size = 0.0 if always else size
            for _ in range(PASSES if which.any() else 1):
                heavy = (1.0 + size * which) * kilogram
                if not always:
                    rest = c.residual - size * own - late * self.c.change
                    weight = np.broadcast_to(c.limit**-2.0, rest.shape)
                    _, times, held = held_payload(c.time, heavy, rest, weight)
                    spans = tuple(times)
                steady = ~Load(1.0, None, spans).near_change(c.time, BLOCK)
                if not (held & steady).any() or held.all() > always:
                    mass = 0.0
                    break
                (mass, size, late), left = self.solved(held[:, None] * heavy, own, some=steady)
            scale = 1.0 + size
            if mass > self.lightest and (not which.any() or (scale > 0.0 and not usual(scale))):
                yield _Found(left, names, which, scale, mass, spans)

    def causes(self, one: _Found, found: Sequence[_Found], left_out: Mask) -> Iterator[Cause]:
        """Describe what was found; with a scale of all drives also what explains as much."""
        r, whole, others = self.r, found[0], list[str]()
        load = next((each for each in found if each.mass and each.count == 1), None)
        if one is load and not usual(whole.scale) and not self.clear(one.left, whole.left, ALIKE):
            one = whole
        if one is whole:
            (size, _), left = self.solved(self.efforts(_weighing))
            if self.clear(left, one.left, ALIKE):
                return
            if not self.clear(one.left, left, ALIKE):
                others.append(MASSES.format(1.0 + size))
            if load is not None and not self.clear(one.left, load.left, ALIKE):
                others.append(f"{_payload_text(r.robot, load.mass)} is held")
        if not one.which.any():
            yield from _payload(r, self.c, left_out, one)
        elif one.scale > 0.0:
            effort = r.measured / (1.0 + (one.scale - 1.0) * one.which)
            text = scale_text(one.names, one.scale, *others)
            scaled = Cause(text, replace(r, effort=effort), left_out, EXACT, one.scale)
            held = _payload(scaled.recording, self.c, left_out, one)
            yield from scaled.then(held) if one.mass else (scaled,)


def _weighing(robot: Robot, *motion: Array) -> Array:
    """Efforts that grow with the masses."""
    return inverse_dynamics(robot, *motion[:3]) - dynamics_terms(robot, *motion[:3]).friction


def _kilogram(robot: Robot, *motion: Array) -> Array:
    """Efforts of a kilogram more at the payload's centre."""
    heavy = robot.changed(payload={"mass": robot.payload.mass + 1.0})
    return inverse_dynamics(heavy, *motion) - inverse_dynamics(robot, *motion)


def _payload_text(robot: Robot, more: float) -> str:
    """Describe the file's payload with more mass, kg; the estimate assumes its centre."""
    com = robot.payload.com
    at = ", ".join(f"{v:g}" for v in com) + " m" if np.any(com) else "the reference point"
    return f"a payload of {robot.payload.mass + more:.3g} kg with its centre at {at}"


def _payload(r: Recording, c: Compared, left_out: Mask, found: _Found) -> Iterator[Cause]:
    """Describe a payload that is held at some times, or all the time."""
    if len(found.spans) > SPANS:
        return
    times = found.spans
    load = Load(float(f"{r.robot.payload.mass + found.mass:.3g}"), None, times)
    text = f"{_payload_text(r.robot, found.mass)} explains the efforts: use --payload {load.mass:g}"
    if times:
        text += " --load-times " + ",".join(f"{edge:.2f}" for pair in times for edge in pair)
    near, _ = near_change(r, load)
    # On the others the efforts do not agree without it.
    if not near.any() or not agrees(r, left_out | near, EXACT * c.bound):
        yield Cause(text, replace(r, load=load), left_out | near)
