# SPDX-License-Identifier: Apache-2.0
"""The one thing that explains efforts which contradict a robot's file, for ``check`` and ``fit``.

A sign, the axes or the sign of the wrench, or one number: the scale of the efforts, of all drives
or of one, or a payload. Of the numbers the one counts that leaves least. If none does, it is two:
a sign and a number, or a scale and a payload.
What is put right has to make the efforts agree.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final

import numpy as np

from delta_dynamics import dynamics_terms, inverse_dynamics
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
from pkm_twin.identification.plausible import held_payload, listed, scale_text, wrenches
from pkm_twin.identification.suspects import OFF
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

Spans = list[tuple[float, float]]
"""When a payload is held, s; empty: all the time."""


@dataclass(frozen=True, eq=False)
class Cause:
    """A cause in words, the recording put right, and samples that are left out then, (samples,).

    ``exact``: part of the residual's bound within which the efforts agree. ``scale``: how many
    times too large they are, negative with wrong signs.
    """

    text: str
    recording: Recording
    left_out: Mask
    exact: float = EXACT
    scale: float = 1.0

    @property
    def possible(self) -> bool:
        """Whether the efforts as recorded can be a machine's: their scale is nearly right."""
        return 1.0 / SCALED < self.scale < SCALED

    def then(self, others: Iterable[Cause]) -> Iterator[Cause]:
        """Causes of the recording that this one puts right, each together with this one."""
        for other in others:
            text, scale = f"{self.text}; put right, {other.text}", self.scale * other.scale
            yield replace(other, text=text, scale=scale)

    def agrees(self, bound: float) -> bool:
        """Whether the efforts agree with the model once this is put right."""
        return agrees(self.recording, self.left_out, self.exact * bound)


def agrees(r: Recording, without: Mask, bound: float) -> bool:
    """Whether the efforts agree with the model, apart from some samples."""
    try:
        compared = compared_of(r, without, bound)
    except (PkmTwinError, ValueError):
        return False
    return compared is not None and bool(compared.good.all())


def cause_of(r: Recording, c: Compared, left_out: Mask) -> Cause | None:
    """The first thing that makes the efforts agree; None where there is none."""
    found = chain(_turned(r, c, left_out), _numbers(r, c, left_out))
    return next((cause for cause in found if cause.agrees(c.bound)), None)


def number_that_explains(r: Recording) -> Cause | None:
    """What `cause_of` finds of numbers; without words where the efforts agree as they are.

    None where no number makes them agree.
    """
    if r.robot.redundant or why_no_torques(r.robot):
        return None
    none = np.zeros(len(r.time), np.bool_)
    try:
        c = compare(r)
        found = () if c is None or c.good.all() else tuple(_numbers(r, c, none))
    except (PkmTwinError, ValueError):
        return None
    if c is not None and replace(c, bound=EXACT * c.bound).good.all():
        return Cause("", r, none)
    return next((cause for cause in found if cause.agrees(MAX_RESIDUAL)), None)


def _numbers(r: Recording, c: Compared, left_out: Mask) -> Iterator[Cause]:
    """One number or two, and one after efforts are given their signs."""
    yield from _number_of(r, c, left_out)
    for turned in _signs(r, c, left_out):
        other = compared_of(turned.recording, left_out, c.bound)
        if other is not None:
            yield from turned.then(_number_of(turned.recording, other, left_out))


def _signs(r: Recording, c: Compared, left_out: Mask) -> Iterator[Cause]:
    """Efforts that oppose the expected ones."""
    turned = ~c.good & (np.sum(c.measured * c.expected, 0) < 0.0)
    if turned.any():
        names = listed(np.array(r.robot.joint_names)[turned].tolist(), len(turned))
        effort = r.measured * np.where(turned, -1.0, 1.0)
        text = f"efforts of {names} have the wrong sign"
        yield Cause(text, replace(r, effort=effort), left_out, 1.0, -1.0)


def _turned(r: Recording, c: Compared, left_out: Mask) -> Iterator[Cause]:
    """Signs of efforts, and axes and sign of the wrench."""
    yield from _signs(r, c, left_out)
    for text, wrench in wrenches(r):
        yield Cause(text, replace(r, wrench=wrench), left_out, 1.0)


def _number_of(r: Recording, c: Compared, left_out: Mask) -> Iterator[Cause]:
    """The number that leaves least of the residual: a scale or a payload; then both together."""
    robot, weight, n = r.robot, 1.0 / c.limit**2, r.robot.joints_count

    change = np.gradient(c.expected, c.period, axis=0)
    change[[row - k for row in c.starts for k in (0, 1)]] = 0.0

    def on_time(column: Array) -> Array:
        """Without what a delay explains: that which was taken out explains a scale in part."""
        late = np.sum(weight * change * column) / max(np.sum(weight * change**2), 1e-300)
        return np.asarray(column - late * change, np.float64)

    residual = on_time(c.residual)

    def left(column: Array) -> tuple[float, float]:
        """The factor on a part of the expected efforts, and the squares of what remains."""
        column = on_time(column)
        size = np.sum(weight * column * residual) / max(np.sum(weight * column**2), 1e-300)
        return 1.0 + float(size), float(np.sum(weight * (residual - size * column) ** 2))

    def weighing(one: Robot, *motion: Array) -> Array:
        return inverse_dynamics(one, *motion[:3]) - dynamics_terms(one, *motion[:3]).friction

    def more(one: Robot, *motion: Array) -> Array:
        heavy = one.changed(payload={"mass": one.payload.mass + 1.0})
        return inverse_dynamics(heavy, *motion) - inverse_dynamics(one, *motion)

    each = [(name, row) for name, row in zip(robot.joint_names, np.eye(n), strict=True) if n > 1]
    drives = [("all joints", np.ones(n)), *each]
    names, which = min(drives, key=lambda one: left(one[1] * c.expected)[1])
    scale, least = left(which * c.expected)

    def scaled(names: str, which: Array, scale: float, masses: float | None = None) -> Cause:
        other_units = replace(r, effort=r.measured / (1.0 + (scale - 1.0) * which))
        return Cause(scale_text(names, scale, masses), other_units, left_out, EXACT, scale)

    def alone() -> Iterator[Cause]:
        """The scale, unless other masses explain more."""
        masses = None
        if which.all():
            columns = [by_held(r, weighing, t.time, *t.joints, t.wrench) for t in c.tracks]
            heavier, other = left(c.filtered(columns))
            if other < least / ALIKE:
                return
            masses = heavier if other < ALIKE * least else None
        if scale > 0.0:
            yield scaled(names, which, scale, masses)

    if r.load is not None:
        yield from alone()
        return
    columns = [by_held(r, more, t.time, *t.joints, t.wrench) for t in c.tracks]
    column = c.filtered(columns)
    total = sum(body.mass for body in robot.graph.bodies.values())

    def loaded(which: Array) -> tuple[float, float, float, Spans]:
        """The squares that remain, the mass, the scale of some drives and the payload's times."""
        mass, size, missed, spans = 0.0, 0.0, np.inf, list[tuple[float, float]]()
        for _ in range(PASSES if which.any() else 1):
            heavy, own = (1.0 + size * which) * column, which * c.expected
            rest = residual - size * on_time(own)
            _, spans, held = held_payload(c.time, on_time(heavy), rest, weight)
            spans = [] if held.all() else spans
            steady = ~Load(1.0, None, tuple(spans)).near_change(c.time, BLOCK)
            if not (held & steady).any():
                return np.inf, 0.0, 1.0, []
            table = np.stack([held[:, None] * heavy, own, change], -1)[steady]
            roots = np.sqrt(weight) * np.ones_like(c.residual[steady])
            target = (roots * c.residual[steady]).ravel()
            table = (roots[..., None] * table).reshape(-1, 3)
            found = np.linalg.lstsq(table, target)[0]
            mass, size = found[:2].tolist()
            missed = float(np.sum((target - table @ found) ** 2) / steady.mean())
        return missed, mass, 1.0 + size, spans

    missed, mass, _, spans = loaded(np.zeros(n))
    lighter = mass <= LIGHTEST * total or missed >= least
    one = alone() if lighter else _payload(r, c, left_out, mass, spans)
    both = min(((*loaded(row), name, row) for name, row in drives), key=lambda found: found[0])
    likely, added, size, times, drive, row = both
    pair: Iterator[Cause] = iter(())
    if added > LIGHTEST * total and size > 0.0:
        other = scaled(drive, row, size)
        if not other.possible:
            pair = other.then(_payload(other.recording, c, left_out, added, times))
    clear = likely < min(missed, least) / BETTER
    yield from chain(pair, one) if clear else chain(one, pair)


def _payload(
    r: Recording, c: Compared, left_out: Mask, mass: float, spans: Spans
) -> Iterator[Cause]:
    """A payload that is held at some times, or all the time."""
    if len(spans) > SPANS:
        return
    times = tuple(spans)
    load = Load(float(f"{r.robot.payload.mass + mass:.3g}"), None, times)
    text = f"a payload of {load.mass:g} kg explains the efforts: use --payload {load.mass:g}"
    if times:
        text += " --load-times " + ",".join(f"{edge:.2f}" for pair in times for edge in pair)
    near, _ = near_change(r, load)
    # On these samples the efforts do not agree without it.
    if not near.any() or not agrees(r, left_out | near, c.bound):
        yield Cause(text, replace(r, load=load), left_out | near)
