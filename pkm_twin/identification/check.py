# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Judge a recording: its file, time stamps, motion, limits, and its efforts against the model.

Efforts are compared by the derivative, filter and noise of `fit`, so that both never disagree.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from delta_dynamics import inverse_dynamics, torque_deviation
from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import PkmTwinError, SingularityError, UnreachableError, one_line
from pkm_twin.identification.compare import (
    MAX_RESIDUAL,
    MIN_PIECE_SAMPLES,
    MIN_REST_TIME,
    EffortComparison,
    compare_part,
    cut_recording,
    describe_delay,
    evaluate_loaded,
    find_idle,
    missing_samples,
    near_change,
    near_jumps,
)
from pkm_twin.identification.fit import Fit, fit
from pkm_twin.identification.friction_laws import fit_recordings
from pkm_twin.identification.hypotheses import NO_MACHINE, Explanation, explain_recording
from pkm_twin.identification.verdict import MAX_DELAY, MAX_NOISE_RATIO, join_names, write_scale, write_unreachable
from pkm_twin.recordings import Recording
from pkm_twin.report import Fact, Verdict, make_judged_fact
from pkm_twin.robot.limits import list_limits
from pkm_twin.robot.plausibility import why_no_torques
from pkm_twin.streams.drives import CONSTANT_SAMPLES, MAX_RELATIVE_CHANGE
from pkm_twin.streams.noise import estimate_deviation
from pkm_twin.streams.rates import MAX_MOVE_DIFFERENCE, STANDSTILL_FRACTION, compare_rates, rms

REJECTED: Final = "messages that a node rejects"
POSITION_STEPS: Final = "position steps"
VELOCITIES: Final = "velocities"
RESIDUAL: Final = "torque residual"
MEASURED: Final = "measured efforts"
COMPARED_EFFORTS: Final = "compared efforts"
IDLE: Final = "drives off or braked"
COMPUTED: Final = "the efforts of this table are the model's; expected columns JOINT.measured"
DEVIATIONS: Final = (1, 2, 3)
"""Multiples of the model's standard deviation within which residuals are counted."""
MIN_SINGULARITY: Final = 1e-3
"""Smallest good singularity index: 0 in a singularity, 1 at best."""
MIN_COMPARED: Final = 0.1
"""Smallest fraction of the samples whose efforts must be compared for a verdict."""


@dataclass(frozen=True)
class Checked:
    """All items of a recording; the whole is good where it was judged and none is bad.

    ``bands``: by joint the residual against the standard deviation that the file's ``uncertainty``
    gives, empty without one. ``unjudged``: why efforts have no verdict; empty where they have one.
    ``compared``: the efforts; ``left_out``: idle samples and those near jumps, (samples,).
    """

    recording: Recording
    items: list[Fact]
    bands: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    unjudged: str = ""
    compared: EffortComparison | None = None
    left_out: Mask = field(default_factory=lambda: np.zeros(0, np.bool_))
    causes: tuple[str, ...] = ()
    """Causes with which contradicting efforts agree with the model, or why none were compared."""
    findings: tuple[str, ...] = ()
    """Findings of `fit`, if no cause explains the efforts."""
    explanation: Explanation | None = None
    """Most probable explanation of the efforts, the same as that of `fit`; None if none was searched for."""
    hint: str = ""
    """The payload that explains most of a good residual; empty: none does."""

    @property
    def answer(self) -> str:
        """``bad`` where an item is, ``not judged`` where efforts have no verdict, else ``good``."""
        if self.list_items(Verdict.BAD):
            return "bad"
        return "not judged" if self.unjudged else "good"

    @property
    def planned(self) -> bool:
        """True if every effort is the model's, as in the table of a plan."""
        r, c = self.recording, self.compared
        if c is None or r.qd is None or r.qdd is None:
            return False
        away = np.abs(evaluate_loaded(r, inverse_dynamics, r.time, *r.motion) - r.measured)
        return bool((away <= 1e-6 * c.peak).all())

    @property
    def agreement(self) -> str:
        """Sentence about how well efforts and model agree."""
        r, c = self.recording, self.compared
        assert c is not None  # noqa: S101  without efforts no recording is good
        if self.planned:
            return f"the efforts are those that {r.robot.name} computes, none is measured"
        part = c.rms / np.maximum(c.peak, 1e-12)
        worst = int(part.argmax())
        size = f"{100 * part[worst]:.2g} % of the peak effort of {r.robot.joint_names[worst]}"
        return f"the efforts agree with {r.robot.name}, largest residual {size}"

    @property
    def residuals(self) -> dict[str, dict[str, Any]]:
        """By joint the RMS of residual and noise, its limit and the model's peak; may be empty."""
        c, robot = self.compared, self.recording.robot
        if c is None:
            return {}
        values = {"rms": c.rms, "limit": c.limit, "noise": c.noise, "peak": c.peak}
        return {
            joint: {name: float(each[j]) for name, each in values.items()} | {"unit": unit}
            for j, (joint, unit) in enumerate(zip(robot.joint_names, robot.effort_units, strict=True))
        }

    @property
    def summary(self) -> str:
        """The answer with what it rests on, and the items that are not judged."""
        what, why = ", ".join(self.list_items(Verdict.BAD)) or self.unjudged or self.agreement, "; ".join(self.causes)
        if why and self.compared is None:
            what = f"{why} ({what})"
        # The answer "not judged" already says why efforts are not judged.
        said = (COMPARED_EFFORTS, IDLE, RESIDUAL) if self.answer == "not judged" else ()
        unknown = [item for item in self.list_items(Verdict.UNKNOWN) if item not in said]
        return f"{self.answer}: {what}" + (f"; not judged: {', '.join(unknown)}" if unknown else "")

    def list_items(self, verdict: Verdict) -> list[str]:
        """List the texts of the items with this verdict."""
        return [str(item.text) for item in self.items if item.verdict is verdict]


def compare_with_model(r: Recording, residual: float) -> Checked:
    """Compare a recording with the model, without a look for causes.

    :param residual: largest good one, RMS, part of the peak effort.
    """
    items = [*_judge_file(r), *_judge_motion(r), *_judge_limits(r)]
    left_out = np.zeros(len(r.time), np.bool_)
    bound = f"RMS below {100 * residual:g} % of peak"
    reason = why_no_torques(r.robot)
    if not reason and r.effort is None:
        reason = "joint states without efforts: the bag has none, or NaN, in some or all of them"
        reason = "the table has no columns JOINT.effort" if r.bag is None else reason
        reason = COMPUTED if r.efforts == "model" else reason
    fault = r.backlash_description or r.jump_description
    # Efforts are compared apart from single jumps.
    if reason or r.steps.publishers or r.backlash_description:
        items.append(make_judged_fact(RESIDUAL, fault or reason, bound, None))
        return Checked(r, items, unjudged=reason, causes=(fault,) if fault else ())
    try:
        idle = find_idle(r)
        left_out = idle | near_jumps(r.steps, len(r.time))
        compared = compare_part(r, left_out, residual)
        bands = {} if compared is None else _compare_uncertainty(r, compared)
    # ValueError: numbers within bounds whose result is not finite.
    except (UnreachableError, SingularityError, ValueError) as error:
        text = one_line(str(error))
        causes = (write_unreachable(error),) if isinstance(error, (UnreachableError, SingularityError)) else ()
        return Checked(r, [*items, make_judged_fact(RESIDUAL, text, bound, False)], causes=causes)
    shares, unjudged = _judge_shares(r, idle, compared)
    items += shares
    if compared is not None and compared.hidden.any() and compared.good.all():
        names = ", ".join(np.array(r.robot.joint_names)[compared.hidden])
        unjudged = unjudged or f"noise, as of positions or stamps, hides the efforts of {names}"
    if compared is not None and not unjudged:
        stuck = _stuck_efforts(r, compared)
        if stuck:
            items.append(make_judged_fact(MEASURED, stuck, "change as the model's", False))
        items += _judge_residuals(r, compared, bands, bound)
    return Checked(r, items, bands, unjudged, compared, left_out)


def _judge_file(r: Recording) -> list[Fact]:
    if r.bag is None:
        found = f"a table of {len(r.time)} rows, all numbers finite"
        return [make_judged_fact("file", found, "finite numbers", True)]
    report = r.bag.report
    whole = None if report.warnings else True
    text = "; ".join(report.warnings) or "complete; checksums and counts agree"
    refused, total = sum(r.rejected.values()), r.message_count
    reasons = ", ".join(f"{k}: {v}" for k, v in r.rejected.items())
    value = f"{refused} of {total}" + (f" ({reasons}; first: {r.first_reject})" if refused else "")
    return [
        make_judged_fact("file", text, "complete and consistent", False if report.miscounts else whole),
        make_judged_fact(REJECTED, value, "at most 0 %", not refused, number=refused, limit=0),
    ]


def _judge_motion(r: Recording) -> list[Fact]:
    """Judge time stamps, steps and velocities."""
    if len(r.time) < 3:
        return [make_judged_fact("rate", f"{len(r.time)} joint states", "3 or more", None)]
    periods = np.diff(r.time)
    median, longest = float(np.median(periods)), float(periods.max())
    gap = f"{1e3 * longest:.3f} ms at {r.time[int(periods.argmax())]:.3f} s"
    within, rate = 5.0 * median, f"{1 / median:.1f} Hz over {r.time[-1]:.3f} s"
    most = f"at most {1e3 * within:.3f} ms"
    fault = r.backlash_description or r.jump_description
    items = [
        make_judged_fact("rate", rate, "", True, number=1 / median, unit="Hz"),
        missing_samples(r.time),
        make_judged_fact("longest gap", gap, most, longest <= within, number=longest, limit=within, unit="s"),
        make_judged_fact(POSITION_STEPS, fault or "no jumps", "within rates and limits", not fault),
    ]
    return items if r.qd is None or r.steps.publishers else items + _judge_velocities(r, r.qd)


def find_stuck(time: Array, values: Array, expected: Array, count: int = 1) -> tuple[int, int] | None:
    """Find the first and last sample of a signal that is stuck; None where it is not.

    :param values: shape (k,); ``expected``: the signal up to a constant, NaN where that is not
        known. ``count``: smallest number of equal samples.
    """
    if not np.isfinite(expected).any():
        return None
    steps = np.abs(np.diff(values))
    tick = steps[steps > 0.0].min(initial=np.inf)
    # A signal that changes by less than ten of its least steps is stuck.
    size = max(10.0 * tick, STANDSTILL_FRACTION * float(np.ptp(expected[np.isfinite(expected)])))
    for begin, end in np.flatnonzero(np.diff(steps == 0.0, prepend=0, append=0)).reshape(-1, 2):
        known = expected[begin : end + 1]
        known = known[np.isfinite(known)]
        long = end - begin >= count and time[end] - time[begin] > MIN_REST_TIME
        if long and len(known) and np.ptp(known) > size:
            return int(begin), int(end)
    return None


def _judge_velocities(r: Recording, qd: Array) -> list[Fact]:
    """Compare measured velocities with the rates of the positions over short times."""
    names, span = r.robot.joint_names, np.diff(r.time)
    bound = f"RMS below {100 * MAX_MOVE_DIFFERENCE:g} % of the positions' rate"
    turned = np.cumsum(0.5 * (qd[1:] + qd[:-1]) * span[:, None], 0)
    for j, expected in enumerate(np.concatenate([0.0 * turned[:1], turned]).T):
        found = find_stuck(r.time, r.q[:, j], expected)
        if found is not None:
            begin, end = r.time[list(found)]
            text = f"the position of {names[j]} stands still from {begin:.3f} s to {end:.3f} s"
            text += " while its velocity does not (encoder?)"
            return [make_judged_fact(VELOCITIES, text, bound, False)]
    part, faults = compare_rates(r.robot, r.stamps, r.q, qd, r.steps.jumps)
    if not len(part):
        return []
    worst = int(np.argmax(part))
    value = ", ".join(faults) or f"{100 * part[worst]:.2g} %, {names[worst]}"
    number, text = float(part[worst]), f"RMS difference {value}"
    good = False if faults else True if number <= MAX_MOVE_DIFFERENCE else None
    text += ", no more than noise" * (good is None)
    return [make_judged_fact(VELOCITIES, text, bound, good, number=number, limit=MAX_MOVE_DIFFERENCE)]


def _judge_limits(r: Recording) -> list[Fact]:
    """Judge margins of the limits, and the distance to singularities."""
    recorded = {"position": r.q, "velocity": r.qd, "effort": r.effort}
    items = []
    for what, low, high, units in list_limits(r.robot):
        values = recorded[what]
        if values is None:
            continue
        used = np.maximum((values - high).max(0), (low - values).max(0))
        # Joints that turn and joints that slide have no common margin.
        worst = {u: max(x for x, v in zip(used, units, strict=True) if v == u) for u in units}
        margins = ", ".join(f"{0.0 - most:.4g} {unit}" for unit, most in worst.items())
        good = bool((used <= 0).all())
        text, only = f"least margin {margins}", [(0.0 - most, unit) for unit, most in worst.items()]
        least = {"number": only[0][0], "limit": 0.0, "unit": only[0][1]} if len(only) == 1 else {}
        items.append(make_judged_fact(f"{what} limits", text, "0 or more", good, **least))
    index, bound = "singularity index", f"{MIN_SINGULARITY:g} or more"
    try:
        measure = r.robot.singularity(r.q)
    except (UnreachableError, SingularityError) as error:
        return [*items, make_judged_fact(index, str(error), bound, False)]
    k = int(measure.argmin())
    smallest, text = float(measure[k]), f"{measure[k]:.4f} at {r.time[k]:.3f} s"
    good = smallest >= MIN_SINGULARITY
    return [*items, make_judged_fact(index, text, bound, good, number=smallest, limit=MIN_SINGULARITY)]


def _judge_shares(r: Recording, idle: Mask, compared: EffortComparison | None) -> tuple[list[Fact], str]:
    """Judge the fraction of samples that are compared; return also why too few are left for a verdict."""
    items, total = [], max(float(r.time[-1]), 1e-9)
    used = 0 if compared is None else sum(len(track.time) for track in compared.tracks)
    share = used / len(r.time)
    enough = share >= MIN_COMPARED
    if idle.any():
        seconds = float(np.sum(np.gradient(r.time)[idle])) if len(r.time) > 1 else 0.0
        text = f"{seconds:.3f} s of {total:.3f} s, left out: efforts zero or constant at standstill"
        some = "some efforts measured"
        items.append(make_judged_fact(IDLE, text, some, enough or None, number=seconds, unit="s"))
    text = f"{100 * share:.3g} % of {len(r.time)} samples"
    bound = f"at least {100 * MIN_COMPARED:g} %"
    items.append(make_judged_fact(COMPARED_EFFORTS, text, bound, enough or None, number=share, limit=MIN_COMPARED))
    if enough:
        return items, ""
    near, within = near_change(r)
    left_out = {
        f"are within {within:.3g} s of a change of the payload: record longer between changes, or "
        "one payload throughout": float(np.mean(near)),
        "have idle drives: record with the drives on": float(np.mean(idle & ~near)),
    }
    why = max(left_out, key=lambda reason: left_out[reason])
    part = left_out[why]
    if part < 0.5 * (1.0 - share):
        why = f"are near jumps or gaps, or in pieces of fewer than {MIN_PIECE_SAMPLES} samples: record longer"
        part = 1.0 - share - sum(left_out.values())
    told = f"efforts can be compared in {text}, {bound} needed for a verdict"
    return items, f"{told}; {100 * part:.3g} % {why}"


def _stuck_efforts(r: Recording, c: EffortComparison) -> str:
    """Describe efforts that were not measured, or not all the time, other than saturated ones; or empty."""
    assert r.effort is not None  # noqa: S101
    if r.robot.redundant:
        # One of the drives that share may stay as it is.
        return ""
    rows = np.searchsorted(r.time, c.time).clip(0, len(r.time) - 1)
    texts, good, moved = [], c.good, np.where(c.rests, np.nan, c.expected)
    for j, (joint, unit) in enumerate(zip(r.robot.joint_names, r.robot.effort_units, strict=True)):
        values = r.effort[:, j].copy()
        most, expected = np.abs(values).max(), np.full(len(values), np.nan)
        if np.ptp(values) <= MAX_RELATIVE_CHANGE * most:
            if not good[j]:
                text = f"{values[0] + 0.0:.4g} {unit} throughout: nothing was measured"
                texts.append(f"the effort of {joint} is {text}")
            continue
        values[np.abs(values) >= most * (1.0 - MAX_RELATIVE_CHANGE)] = np.nan
        expected[rows] = moved[:, j]
        found = find_stuck(r.time, values, expected, CONSTANT_SAMPLES)
        if found is not None:
            begin, end = found
            change = np.nanmax(expected[begin : end + 1]) - np.nanmin(expected[begin : end + 1])
            texts.append(
                f"the effort of {joint} stays at {values[begin]:.4g} {unit} from "
                f"{r.time[begin]:.3f} s to {r.time[end]:.3f} s while the model's changes by "
                f"{change:.3g} {unit} (sensor?)"
            )
    return "; ".join(texts)


def _judge_residuals(
    r: Recording, c: EffortComparison, bands: Mapping[str, Mapping[str, Any]], bound: str
) -> list[Fact]:
    good, begins, (worst, at) = c.good, c.find_first_excess(), c.find_largest_local_rms()
    items = []
    for i, (name, unit) in enumerate(zip(r.robot.joint_names, r.robot.effort_units, strict=True)):
        share = 100 * c.rms[i] / max(c.peak[i], 1e-12)
        text = (
            f"RMS {c.rms[i]:.4g} {unit}, {share:.2f} % of the model's filtered peak "
            f"{c.peak[i]:.4g}, noise {c.noise[i]:.2g}"
        )
        if name in bands:
            inside = bands[name]["share_within_deviations"]
            shares = ", ".join(f"{100 * part:.3g}" for part in inside.values())
            size = f"{bands[name]['effort_deviation_rms']:.3g} {unit}"
            text += f"; {shares} % inside {', '.join(inside)} standard deviations of the model"
            text += f" (RMS {size})"
        if not good[i]:
            text += f"; largest {worst[i]:.4g} {unit} at {at[i]:.3f} s"
            text += f", begins at {begins:.3f} s" if begins is not None else ""
        told = {"number": float(c.rms[i]), "limit": float(c.limit[i]), "unit": unit}
        used = bound
        if c.limit[i] > c.bound * c.peak[i]:
            used = f"RMS below {c.limit[i]:.3g} {unit}, {MAX_NOISE_RATIO:g} times the noise"
        items.append(make_judged_fact(f"{RESIDUAL} of {name}", text, used, bool(good[i]), **told))
    late = describe_delay(c.late, c.period)
    if good.all() and late:
        late += ", taken out"
        told = {"number": c.late, "limit": MAX_DELAY, "unit": "s"}
        most = f"at most {1e3 * MAX_DELAY:g} ms"
        items.append(make_judged_fact("efforts against positions", late, most, not c.delayed, **told))
    return items


def _compare_uncertainty(r: Recording, c: EffortComparison) -> dict[str, dict[str, Any]]:
    """Compare residuals with the deviations by the file's ``uncertainty``, by joint; empty without one."""
    if not r.robot.uncertainty:
        return {}
    parts = []
    for track, rows in zip(c.tracks, c.inner, strict=True):
        made = evaluate_loaded(r, torque_deviation, track.time, *track.joints, track.wrench)
        parts.append(made[rows])
    spread = np.concatenate(parts)
    inside = {str(k): np.mean(np.abs(c.residual) <= k * spread, 0) for k in DEVIATIONS}
    return {
        joint: {
            "effort_deviation_rms": float(rms(spread)[i]),
            "effort_unit": r.robot.effort_units[i],
            "share_within_deviations": {k: float(share[i]) for k, share in inside.items()},
        }
        for i, joint in enumerate(r.robot.joint_names)
    }


MIN_SATURATED_FRACTION: Final = 0.01
"""Smallest fraction of the samples at the greatest effort from which it is saturated."""


def check(r: Recording, residual: float = MAX_RESIDUAL, thorough: bool = True) -> Checked:
    """Compare a recording with the model, and find why they disagree.

    :param residual: largest good one, RMS, part of the peak effort.
    :param thorough: also ask what `fit` finds, which takes some seconds.
    """
    found = compare_with_model(r, residual)
    c, bad, played = found.compared, found.list_items(Verdict.BAD), POSITION_STEPS in found.list_items(Verdict.BAD)
    if r.jump_description or (found.causes and (found.unjudged or not played)):
        return replace(found, causes=found.causes or (r.jump_description,))
    # Efforts of invalid positions mean nothing; residuals that are noise need no explanation.
    unlike = c is not None and (not c.good.all() or (thorough and (c.rms > MAX_NOISE_RATIO * c.noise).any()))
    one = _explain(found) if played or (unlike and VELOCITIES not in bad) else None
    found = replace(found, explanation=one)
    if played:
        return replace(found, causes=(one.cause,) if one else found.causes)
    if c is None or VELOCITIES in bad:
        return found
    if c.good.all():
        text = one.text.partition(" explains the efforts: use ") if one and one.load else ("",) * 3
        hint = f"{text[0]} explains most of the residual: {text[2]}" if text[2] and found.answer == "good" else ""
        return replace(found, hint=hint, causes=(c.delayed,) if c.delayed else ())
    if one is not None and one.text and not one.text.startswith(NO_MACHINE):
        return replace(found, causes=(one.text,))
    if MEASURED in bad:
        return found
    causes = _find_saturated(r, c) or _find_contact(r, c, found.left_out)
    findings: tuple[str, ...] = ()
    if thorough and not causes:
        causes, findings = _explain_by_fit(found, c.bound)
    return replace(found, causes=causes, findings=findings)


def _explain(found: Checked) -> Explanation | None:
    """Return what explains a recording, as `fit` has it; None where it cannot be fitted."""
    r, c = found.recording, found.compared
    if r.robot.redundant and c is not None:
        # Of drives that share: the signs of some, or the scale of all.
        opposed = ~c.good & (np.sum(c.measured * c.expected, 0) < 0.0)
        scale = float(np.sum(c.measured * c.expected) / max(float(np.sum(c.expected**2)), 1e-300))
        names = join_names(np.array(r.robot.joint_names)[opposed].tolist(), len(opposed))
        tried = [(f"efforts of {names} have the wrong sign", np.where(opposed, -1.0, 1.0))] * bool(opposed.any())
        for text, factors in (*tried, (write_scale("all joints", scale), np.full(len(opposed), 1.0 / scale))):
            if _agrees(replace(r, effort=factors * r.measured), found.left_out, c.bound):
                return Explanation(text, fault=True)
    if r.robot.redundant:
        return None
    try:
        return explain_recording(r.robot, r)
    except (PkmTwinError, ValueError, np.linalg.LinAlgError):
        return None


def _agrees(r: Recording, without: Mask, bound: float) -> bool:
    """Return whether the efforts agree with the model, apart from some samples."""
    try:
        compared = compare_part(r, without, bound)
    except (PkmTwinError, ValueError):
        return False
    return compared is not None and bool(compared.good.all()) and not compared.delayed


def _find_contact(r: Recording, c: EffortComparison, left_out: Mask) -> tuple[str, ...]:
    """Find when something else begins to act on the machine, if all efforts before agree."""
    begins = c.find_first_excess()
    if begins is None:
        return ()
    before = c.time < begins
    # Before the motion is under way every machine agrees: a fifth of the recording has to, which
    # shows half of the peak efforts.
    seen = np.abs(c.expected[before]).max(0, initial=0.0) > 0.5 * np.abs(c.expected).max(0)
    if not (before.mean() > 0.2 and seen.all()):
        return ()
    if not _agrees(r, left_out | (r.time >= begins - 2.0 * c.edge), c.bound):
        return ()
    return (
        f"before {begins:.3f} s the efforts agree with the model, from then on something else "
        "acts on the machine (contact, collision or another load?)",
    )


def _find_saturated(r: Recording, c: EffortComparison) -> tuple[str, ...]:
    """Find joints whose effort saturates while the model needs more and otherwise agrees."""
    assert r.effort is not None  # noqa: S101
    if r.robot.redundant:
        return ()
    rows = np.searchsorted(r.time, c.time - 1e-9).clip(0, len(r.time) - 1)
    measured, limit = r.effort[rows], c.limit
    expected = measured - c.raw
    texts = []
    for j in np.flatnonzero(~c.good):
        most = np.abs(measured[:, j]).max()
        full = np.abs(measured[:, j]) >= most * (1.0 - 1e-9)
        unsaturated = c.raw[~full, j]
        usual = float(estimate_deviation(unsaturated)) if len(unsaturated) else 0.0
        slack = limit[j] + 4.0 * usual
        enough = (
            full.mean() > MIN_SATURATED_FRACTION
            and full.sum() >= 30
            and (np.abs(expected[full, j]) > most - slack).mean() > 1.0 - MIN_SATURATED_FRACTION
        )
        if not enough or (len(unsaturated) and rms(unsaturated) > slack):
            return ()
        texts.append(
            f"the effort of {r.robot.joint_names[j]} stays at {most:.4g} "
            f"{r.robot.effort_units[j]} in {100 * full.mean():.2g} % of the samples while the "
            "model needs more: saturated?"
        )
    return tuple(texts)


def _explain_by_fit(found: Checked, bound: float) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return causes if other friction or all fitted numbers explain the efforts, else findings."""
    r = found.recording

    def describe(what: str, made: Fit) -> str:
        late = describe_delay(made.delays[0], made.problem.whole[0].period)
        return f"{what} the efforts" + (f", which are {late}" if late else "") + ": `pkm-twin fit`"

    try:
        part = [cut_recording(r, found.left_out)]
        first = fit(r.robot, part, ("friction",), accept=True, explained=[Explanation("")])
        rubbing = r.robot.with_file_values({one.name: one.after for one in first.numbers})
        if not first.accepted and _agrees(replace(r, robot=rubbing), found.left_out, bound):
            return (describe("friction other than the file's explains", first),), ()
        last, *_ = fit_recordings(r.robot, [r], accept=True)
        verdict = last.verdict
        if last.accepted:
            return (), (last.accepted[0].removeprefix(f"{r.name}: "),)
    except (PkmTwinError, ValueError, np.linalg.LinAlgError):
        return (), ()
    if verdict.answer == "explains":
        return (describe("friction, masses or payload other than the file's explain", last),), ()
    return (), tuple(map(str, verdict.findings[:2]))
