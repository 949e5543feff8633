# SPDX-License-Identifier: Apache-2.0
"""The one thing that explains efforts which contradict a robot's file, for ``check`` and ``fit``.

A sign, the axes or the sign of the wrench, or one number: the scale of the efforts, of all drives
or of one, or a payload. Of the numbers the one counts that leaves least.
What is put right has to make the efforts agree.
"""

from __future__ import annotations

from collections.abc import Iterator
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
from pkm_twin.identification.plausible import held_payload, listed, scale_text, wrenches
from pkm_twin.recordings import Load, Recording
from pkm_twin.robot.plausibility import why_no_torques
from pkm_twin.robot.robot import Robot

SPANS: Final = 50
"""Most times that a payload is picked."""
LIGHTEST: Final = 1e-3
"""Part of the machine's mass below which a payload is none."""
EXACT: Final = 0.2
"""Part of the residual's bound that another scale leaves: of more, something else is wrong, too."""
ALIKE: Final = 4.0
"""How many times as much of the residual's square other masses leave that explain it as well."""


@dataclass(frozen=True, eq=False)
class Cause:
    """A cause in words, the recording put right, and samples that are left out then, (samples,).

    ``exact``: part of the residual's bound within which the efforts agree. ``scale``: how many
    times too large they are.
    """

    text: str
    recording: Recording
    left_out: Mask
    exact: float = 1.0
    scale: float = 1.0

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
    found = chain(_turned(r, c, left_out), number_of(r, c, left_out))
    return next((cause for cause in found if cause.agrees(c.bound)), None)


def number_that_explains(r: Recording) -> Cause | None:
    """The number that makes a recording's efforts agree; without words where they do as they are.

    None where no number does.
    """
    if r.robot.redundant or why_no_torques(r.robot):
        return None
    none = np.zeros(len(r.time), np.bool_)
    try:
        c = compare(r)
        found = () if c is None or c.good.all() else tuple(number_of(r, c, none))
    except (PkmTwinError, ValueError):
        return None
    if c is not None and replace(c, bound=EXACT * c.bound).good.all():
        return Cause("", r, none)
    return next((cause for cause in found if cause.agrees(MAX_RESIDUAL)), None)


def _turned(r: Recording, c: Compared, left_out: Mask) -> Iterator[Cause]:
    """Signs of efforts, and axes and sign of the wrench."""
    turned = ~c.good & (np.sum(c.measured * c.expected, 0) < 0.0)
    if turned.any():
        names = listed(np.array(r.robot.joint_names)[turned].tolist(), len(turned))
        effort = r.measured * np.where(turned, -1.0, 1.0)
        text = f"efforts of {names} have the wrong sign"
        yield Cause(text, replace(r, effort=effort), left_out)
    for text, wrench in wrenches(r):
        yield Cause(text, replace(r, wrench=wrench), left_out)


def number_of(r: Recording, c: Compared, left_out: Mask) -> Iterator[Cause]:
    """The number that leaves least of the residual: a scale or a payload."""
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
    names, which = min(
        [("all joints", np.ones(n)), *each], key=lambda one: left(one[1] * c.expected)[1]
    )
    scale, least = left(which * c.expected)
    if r.load is None:
        columns = [by_held(r, more, t.time, *t.joints, t.wrench) for t in c.tracks]
        column = on_time(c.filtered(columns))
        mass, spans, held = held_payload(c.time, column, residual, weight)
        rest = residual - mass * held[:, None] * column
        total = sum(body.mass for body in robot.graph.bodies.values())
        if mass > LIGHTEST * total and np.sum(weight * rest**2) < least:
            if len(spans) <= SPANS:
                yield from _payload(r, c, left_out, mass, () if held.all() else tuple(spans))
            return
    if scale <= 0.0:
        return
    masses = None
    if which.all():
        columns = [by_held(r, weighing, t.time, *t.joints, t.wrench) for t in c.tracks]
        heavier, other = left(c.filtered(columns))
        if other < least / ALIKE:
            return
        masses = heavier if other < ALIKE * least else None
    factor = 1.0 + (scale - 1.0) * which
    other_units = replace(r, effort=r.measured / factor)
    yield Cause(scale_text(names, scale, masses), other_units, left_out, EXACT, scale)


def _payload(
    r: Recording, c: Compared, left_out: Mask, mass: float, times: tuple[tuple[float, float], ...]
) -> Iterator[Cause]:
    load = Load(float(f"{r.robot.payload.mass + mass:.3g}"), None, times)
    text = f"a payload of {load.mass:g} kg explains the efforts: use --payload {load.mass:g}"
    if times:
        text += " --load-times " + ",".join(f"{edge:.2f}" for pair in times for edge in pair)
    near, _ = near_change(r, load)
    # On these samples the efforts do not agree without it.
    if not near.any() or not agrees(r, left_out | near, c.bound):
        yield Cause(text, replace(r, load=load), left_out | near)
