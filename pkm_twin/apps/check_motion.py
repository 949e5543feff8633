# SPDX-License-Identifier: Apache-2.0
"""Whether a recording's positions, velocities and time stamps can belong to one moving machine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.apps.recorded import Recording
from pkm_twin.apps.verdict import Item, Verdict, judged_item
from pkm_twin.streams.rest import SIGMAS, noise
from pkm_twin.streams.steps import GAP, Steps, sampling_of, steps_of

Array = NDArray[np.float64]

STEPS: Final = "position steps"
VELOCITIES: Final = "velocities"
OF_MOTION: Final = (STEPS, VELOCITIES)
SHOWN: Final = 4
"""Jumps that are listed."""
CLEAR: Final = 4
"""Samples on each side of a jump that are left out: a gap that divides the recording."""
WINDOW: Final = 0.05
"""Time over which velocities are compared with positions, s: noise averages out."""
STANDS: Final = 0.03
"""Part of the other's motion below which positions, or velocities, stand still."""
STUCK: Final = 0.05
"""Time for which a position stays the same before it counts as stuck, s,"""
TICKS: Final = 10.0
"""and by how many of its least steps its velocity moves the joint meanwhile."""
LIKE: Final = 0.1
"""Relative difference below which a scale is named as a cause."""


@dataclass(frozen=True)
class Bounds:
    """What a good bag keeps to."""

    residual: float = 0.05
    """Torque residual RMS, part of the joint's peak effort."""
    gap: float = 5.0
    """Longest time between joint states, in median periods."""
    rejected: float = 0.0
    """Messages that a node would reject, part of all."""
    singularity: float = 1e-3
    """Least singularity index, 0 in a singularity, 1 at best."""
    missing: float = 0.01
    """Joint states that are missing, part of those that there should be."""
    rate: float = 0.15
    """Difference of the measured velocities from the positions' rates, part of them, RMS."""
    judged: float = 0.1
    """Least part of the recording whose efforts are compared."""


def motion_items(r: Recording, bounds: Bounds) -> list[Item]:
    """The items on time stamps, steps and velocities."""
    if len(r.time) < 3:
        return [Item("rate", f"{len(r.time)} joint states", "3 or more", Verdict.UNKNOWN)]
    periods = np.diff(r.time)
    median, longest = float(np.median(periods)), float(periods.max())
    at = float(r.time[int(periods.argmax())])
    steps = steps_in(r)
    return [
        Item("rate", f"{1 / median:.1f} Hz over {r.time[-1]:.3f} s", "", Verdict.GOOD),
        _missing(r, bounds),
        judged_item(
            "longest gap",
            f"{1e3 * longest:.3f} ms at {at:.3f} s",
            f"at most {1e3 * bounds.gap * median:.3f} ms",
            longest <= bounds.gap * median,
        ),
        judged_item(
            STEPS, step_fault(r, steps) or "no jumps", "within rates and limits",
            not steps.jumps.any(),
        ),
        *([] if r.qd is None or steps.publishers else _velocities(r, r.qd, steps, bounds)),
    ]  # fmt: skip


def steps_in(r: Recording) -> Steps:
    """The steps by the measured velocities, or by the positions alone if these do not jump."""
    limit = r.robot.limits.velocity
    steps = steps_of(r.time, r.q, r.qd, limit)
    if r.qd is None or not steps.jumps.any():
        return steps
    alone = steps_of(r.time, r.q, None, limit)
    # What jumps by wrong velocities only is not the positions' fault.
    return steps if alone.jumps.any() else alone


def step_fault(r: Recording, steps: Steps | None = None) -> str:
    """Jumps of the positions with their times; empty where there are none."""
    steps = steps_in(r) if steps is None else steps
    found = steps.first
    if steps.publishers:
        counts = " and ".join(map(str, steps.publishers))
        return (
            f"two publishers interleaved, {counts} samples: {len(found)} of {len(r.time) - 1} "
            "steps jump"
        )
    texts = [
        f"{r.robot.joint_names[j]} by {steps.sizes[k, j]:.3g} {r.robot.joint_units[j]} at "
        f"{r.time[k + 1]:.3f} s"
        for k, j in found[:SHOWN]
    ]
    more = f" and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
    return f"{len(found)} jumps: {', '.join(texts)}{more}" if found else ""


def near_jumps(r: Recording) -> NDArray[np.bool_]:
    """Samples so near to a jump that no derivative holds there, shape (samples,)."""
    steps = steps_in(r)
    found = np.zeros(len(r.time), np.bool_)
    for k in np.flatnonzero(steps.jumps.any(1)):
        found[max(k - CLEAR, 0) : k + CLEAR + 2] = True
    return found


def _missing(r: Recording, bounds: Bounds) -> Item:
    sampling = sampling_of(r.time)
    bound = f"at most {100 * bounds.missing:g} %"
    if sampling.missing is None:
        text = "the samples have no common period"
        return Item("missing samples", text, bound, Verdict.UNKNOWN)
    share = sampling.missing / sampling.expected
    value = f"{sampling.missing} of {sampling.expected}"
    value += f" ({100 * share:.3g} %)" if sampling.missing else ""
    return judged_item("missing samples", value, bound, share <= bounds.missing)


def _velocities(r: Recording, qd: Array, steps: Steps, bounds: Bounds) -> list[Item]:
    """How far measured velocities are from what the positions move by, over short times."""
    bound = f"RMS below {100 * bounds.rate:g} % of the positions' rate"
    stuck = _stuck(r, qd)
    if stuck:
        return [judged_item(VELOCITIES, stuck, bound, False)]
    span = np.diff(r.time)
    whole = (span <= GAP * np.median(span)) & ~steps.jumps.any(1)
    width = max(1, round(WINDOW / float(np.median(span))))
    if len(span) < 2 * width:
        return []
    told = 0.5 * (qd[1:] + qd[:-1]) * span[:, None]
    sums = [
        _sums(one, width) for one in (np.diff(r.q, axis=0), told, whole[:, None].astype(np.float64))
    ]
    moved, said, full = sums
    rows = full[:, 0] > width - 0.5
    moved, said = moved[rows], said[rows]
    if not len(moved):
        return []
    sizes = np.sqrt(np.mean(moved**2, 0)), np.sqrt(np.mean(said**2, 0))
    # A joint that hardly moves shows noise alone.
    units = np.array(r.robot.joint_units)
    most = np.maximum(*sizes)
    floor = np.array([STANDS * most[units == unit].max() for unit in units])
    size = np.sqrt(np.mean((said - moved) ** 2, 0))
    period = float(np.median(span))
    noisy = 2.0 * noise(r.time, r.q) + np.sqrt(width) * period * noise(r.time, qd)
    apart = size / np.maximum(np.maximum(most, floor), 1e-300)
    bad = (apart > bounds.rate) & (size > SIGMAS * noisy)
    if not bad.any():
        worst = int(np.argmax(apart))
        value = f"RMS difference {100 * apart[worst]:.2g} %, {r.robot.joint_names[worst]}"
        return [judged_item(VELOCITIES, value, bound, True)]
    scales = np.sum(said * moved, 0) / np.maximum(np.sum(moved**2, 0), 1e-300)
    texts = []
    for j in np.flatnonzero(bad):
        text = f"{r.robot.joint_names[j]} {100 * apart[j]:.3g} %"
        left = np.sqrt(np.mean((said[:, j] - scales[j] * moved[:, j]) ** 2))
        if sizes[0][j] < STANDS * sizes[1][j]:
            text += " (the position stands still: encoder?)"
        elif sizes[1][j] < STANDS * sizes[0][j]:
            text += " (the velocity is zero)"
        elif abs(scales[j] + 1.0) < LIKE:
            text += " (wrong sign?)"
        elif left < LIKE * sizes[1][j]:
            text += f" ({scales[j]:.3g} times the positions' rate: time stamps, ratio or unit?)"
        texts.append(text)
    return [judged_item(VELOCITIES, f"RMS difference {', '.join(texts)}", bound, False)]


def runs_of(same: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last sample of each run of steps that are ``same``, shape (samples - 1,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same, [0]]))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def _stuck(r: Recording, qd: Array) -> str:
    """Positions that stay at one number while their velocity moves the joint; else empty."""
    span = np.diff(r.time)
    for j, joint in enumerate(r.robot.joint_names):
        moves = np.diff(r.q[:, j])
        tick = np.abs(moves[moves != 0.0]).min(initial=np.inf)
        told = np.concatenate([[0.0], np.cumsum(0.5 * (qd[1:, j] + qd[:-1, j]) * span)])
        for begin, end in runs_of(moves == 0.0):
            long = r.time[end] - r.time[begin] > STUCK
            if long and abs(told[end] - told[begin]) > max(TICKS * tick, STANDS * np.ptp(told)):
                return (
                    f"the position of {joint} stands still from {r.time[begin]:.3f} s to "
                    f"{r.time[end]:.3f} s while its velocity does not (encoder?)"
                )
    return ""


def _sums(values: Array, width: int) -> Array:
    """Of so many rows in a row, shape (k - width + 1, n)."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, 0)])
    return np.asarray(total[width:] - total[:-width], np.float64)
