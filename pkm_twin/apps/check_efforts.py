# SPDX-License-Identifier: Apache-2.0
"""Measured efforts of a recording against the model, by the filter and noise of `fit`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import inverse_dynamics, torque_deviation
from pkm_twin.apps.check_motion import STANDS, STUCK, TICKS, Bounds, near_jumps, runs_of
from pkm_twin.apps.describe import why_no_torques
from pkm_twin.apps.loads import by_load
from pkm_twin.apps.recorded import Recording
from pkm_twin.apps.recorded_motion import at_rest
from pkm_twin.apps.verdict import Item, Verdict, judged_item
from pkm_twin.errors import SingularityError, UnreachableError, one_line
from pkm_twin.identification.compare import Compared, by_held, compare
from pkm_twin.identification.rows import Recorded
from pkm_twin.streams.drives import COUNT, SAME, idle_samples

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

RESIDUAL: Final = "torque residual"
MEASURED: Final = "measured efforts"
NEAR: Final = 0.5
"""Around a pick or release the payload is neither held nor gone, s."""
DEVIATIONS: Final = (1, 2, 3)
"""Of the model, inside which residuals are counted."""
_BLOCK: Final = 4096


@dataclass(frozen=True)
class ModelBand:
    """A joint's residual compared with the standard deviation by the file's ``uncertainty``.

    ``deviation_rms``: of the model's standard deviation over the judged samples, ``unit``.
    ``share_within``: part of the samples whose residual is inside so many of their deviations.
    """

    deviation_rms: float
    unit: str
    share_within: Mapping[int, float]

    def __str__(self) -> str:
        shares = ", ".join(f"{100 * share:.3g}" for share in self.share_within.values())
        counts = ", ".join(map(str, self.share_within))
        return (
            f"{shares} % inside {counts} standard deviations of the model (RMS "
            f"{self.deviation_rms:.3g} {self.unit})"
        )


@dataclass(frozen=True)
class Efforts:
    """Items on the efforts, the model's bands by joint, and what was compared, if anything was.

    ``left_out``: idle samples and those near jumps, (samples,). ``unjudged``: why there is no
    verdict although efforts were measured; empty where there is one.
    """

    items: list[Item]
    bands: Mapping[str, ModelBand]
    left_out: Mask
    compared: Compared | None = None
    unjudged: str = ""


def judged_efforts(r: Recording, bounds: Bounds) -> Efforts:
    """Compare the efforts of a recording with the model."""
    bound = f"RMS below {100 * bounds.residual:g} % of peak"
    reason = why_no_torques(r.robot) or (
        "" if r.effort is not None else "the bag carries no efforts"
    )
    nothing = np.zeros(len(r.time), np.bool_)
    if reason or r.effort is None:
        return Efforts([Item(RESIDUAL, reason, bound, Verdict.UNKNOWN)], {}, nothing)
    try:
        idle = idle_of(r)
        left_out = idle | near_jumps(r)
        compared = compared_of(r, left_out)
        bands = {} if compared is None else _bands(r, compared)
    except (UnreachableError, SingularityError) as error:
        return Efforts([Item(RESIDUAL, one_line(str(error)), bound, Verdict.BAD)], {}, nothing)
    except ValueError as error:  # numbers within bounds whose result is not finite
        return Efforts([Item(RESIDUAL, str(error), bound, Verdict.BAD)], {}, nothing)
    items, unjudged = _shares(r, idle, compared, bounds)
    if compared is not None and not unjudged:
        stuck = _stuck(r, r.effort, compared, bounds)
        if stuck:
            items.append(Item(MEASURED, stuck, "change as the model's", Verdict.BAD))
        items += _residuals(r, compared, bands, bounds, bound)
    return Efforts(items, bands, left_out, compared, unjudged)


def recorded_of(r: Recording, leave_out: Mask | None = None) -> Recorded:
    """A recording with efforts as `fit` reads it, without samples around a pick or release.

    :param leave_out: more samples that are left out, (samples,): a gap divides the recording.
    """
    assert r.effort is not None  # noqa: S101
    keep = np.ones(len(r.time), np.bool_) if leave_out is None else ~leave_out
    if r.load is not None:
        keep &= ~r.load.near_change(r.time, NEAR)
    wrench = None if r.wrench is None else r.wrench[keep]
    held = None if r.load is None else r.load.held(r.time[keep]).astype(np.float64)
    carried = None if r.load is None else r.load.on(r.robot)
    name = one_line(r.source.rpartition("/")[2], 100)
    return Recorded(name, r.time[keep], r.q[keep], r.effort[keep], wrench, held, carried)


def compared_of(r: Recording, idle: Mask) -> Compared | None:
    """The efforts in the band of the motion, without samples whose drives are idle."""
    recorded = recorded_of(r, idle)
    if len(recorded.time) < 3:
        return None
    known = None
    if r.qd is not None and r.qdd is not None:
        keep = np.isin(r.time, recorded.time)
        known = r.qd[keep], r.qdd[keep]
    return compare(r.robot, recorded, known)


def idle_of(r: Recording) -> Mask:
    """Samples whose efforts are zero, or constant at standstill, against the model, (samples,)."""
    assert r.effort is not None  # noqa: S101
    held, still = np.zeros_like(r.q), np.zeros_like(r.q)
    for robot, part in by_load(r.robot, r.load, r.time, _BLOCK):
        wrench = None if r.wrench is None else r.wrench[part]
        held[part] = inverse_dynamics(robot, r.q[part], still[part], still[part], wrench)
    rates = r.qd
    if rates is None:
        rates = np.gradient(r.q, r.time, axis=0) if len(r.time) > 1 else still
    return idle_samples(r.time, at_rest(r, rates), r.effort, held)


def _shares(
    r: Recording, idle: Mask, compared: Compared | None, bounds: Bounds
) -> tuple[list[Item], str]:
    """What is left out, and why there is no verdict, if there is none."""
    items, total = [], max(float(r.time[-1]), 1e-9) if len(r.time) else 1e-9
    used = 0 if compared is None else sum(len(track.time) for track in compared.tracks)
    share = used / max(len(r.time), 1)
    enough = share >= bounds.judged
    if idle.any():
        seconds = float(np.sum(np.gradient(r.time)[idle])) if len(r.time) > 1 else 0.0
        text = f"{seconds:.3f} s of {total:.3f} s, left out: efforts zero or constant at standstill"
        verdict = Verdict.GOOD if enough else Verdict.UNKNOWN
        items.append(Item("drives off or braked", text, "some efforts measured", verdict))
    text = f"{100 * share:.3g} % of {len(r.time)} samples"
    bound = f"at least {100 * bounds.judged:g} %"
    items.append(Item("compared efforts", text, bound, Verdict.GOOD if enough else Verdict.UNKNOWN))
    if enough:
        return items, ""
    return items, f"efforts can be compared in {text}, {bound} needed for a verdict"


def _stuck(r: Recording, effort: Array, c: Compared, bounds: Bounds) -> str:
    """Efforts that stay at one number while the model's change, by joint; empty for none.

    At its greatest, an effort is saturated.
    """
    texts, good = [], c.good(bounds.residual)
    for j, (joint, unit) in enumerate(zip(r.robot.joint_names, r.robot.effort_units, strict=True)):
        values = effort[:, j]
        most = float(np.abs(values).max())
        if np.ptp(values) <= SAME * most:
            if not good[j]:
                text = f"{values[0] + 0.0:.4g} {unit} throughout: nothing was measured"
                texts.append(f"the effort of {joint} is {text}")
            continue
        steps = np.abs(np.diff(values))
        tick, size = steps[steps > 0.0].min(), STANDS * np.ptp(c.expected[:, j])
        for begin, end in runs_of(steps == 0.0):
            long = end - begin >= COUNT and r.time[end] - r.time[begin] > STUCK
            if not long or abs(values[begin]) >= most * (1.0 - SAME):
                continue
            some = slice(*np.searchsorted(c.time, r.time[[begin, end]]))
            change = float(np.ptp(c.expected[some, j])) if some.stop > some.start else 0.0
            if change > max(TICKS * tick, size):
                texts.append(
                    f"the effort of {joint} stays at {values[begin]:.4g} {unit} from "
                    f"{r.time[begin]:.3f} s to {r.time[end]:.3f} s while the model's changes by "
                    f"{change:.3g} {unit} (sensor?)"
                )
                break
    return "; ".join(texts)


def _residuals(
    r: Recording, c: Compared, bands: Mapping[str, ModelBand], bounds: Bounds, bound: str
) -> list[Item]:
    good, limit, (worst, at) = c.good(bounds.residual), c.limit(bounds.residual), c.local()
    begins = c.begins(limit)
    items = []
    for i, (name, unit) in enumerate(zip(r.robot.joint_names, r.robot.effort_units, strict=True)):
        share = 100 * c.rms[i] / max(c.peak[i], 1e-12)
        text = (
            f"RMS {c.rms[i]:.4g} {unit}, {share:.2f} % of the model's peak {c.peak[i]:.4g}, noise "
            f"{c.noise[i]:.2g}"
        )
        text += f"; {bands[name]}" if name in bands else ""
        if not good[i]:
            text += f"; largest {worst[i]:.4g} {unit} at {at[i]:.3f} s"
            text += f", begins at {begins:.3f} s" if begins is not None else ""
        items.append(judged_item(f"{RESIDUAL} of {name}", text, bound, bool(good[i])))
    if good.all() and abs(c.late) > 0.1 * c.period:
        late = f"{1e3 * abs(c.late):.3g} ms {'late' if c.late > 0.0 else 'early'}, taken out"
        items.append(Item("efforts against positions", late, "", Verdict.GOOD))
    return items


def _bands(r: Recording, c: Compared) -> dict[str, ModelBand]:
    """By joint, where the robot's file has an ``uncertainty``."""
    if not r.robot.uncertainty:
        return {}
    carried = None if r.load is None else r.load.on(r.robot)
    parts = [by_held(r.robot, carried, track, torque_deviation) for track in c.tracks]
    spread = np.concatenate([part[rows] for part, rows in zip(parts, c.inner, strict=True)])
    rms = np.sqrt(np.mean(spread**2, 0))
    shares = np.array([np.mean(np.abs(c.residual) <= k * spread, 0) for k in DEVIATIONS])
    return {
        joint: ModelBand(
            float(rms[i]),
            r.robot.effort_units[i],
            dict(zip(DEVIATIONS, shares[:, i].tolist(), strict=True)),
        )
        for i, joint in enumerate(r.robot.joint_names)
    }
