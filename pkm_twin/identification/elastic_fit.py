# SPDX-License-Identifier: Apache-2.0
"""The compliance of a robot's elastic elements from measured loads and deflections.

delta = C(s) w + z: s multiplies each element's compliance of the file, z is a zero of the
instrument, one a recording and direction. C is not linear in s where limbs share a load: the fit
goes by Gauss and Newton, with exact derivatives. The last third of every recording is held out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.elastic_verdict import elastic_verdict, put_right
from pkm_twin.identification.estimation import Estimate, estimate
from pkm_twin.identification.fit import Judged, Result, refuse_faults
from pkm_twin.identification.parameters import SURE, Group, Number, groups_of, number_of
from pkm_twin.identification.rows import HELD_OUT
from pkm_twin.identification.verdict import Verdict
from pkm_twin.machine.shared import above_zero
from pkm_twin.robot.robot import Robot
from stiffness_monitor.response import ElementResponse, element_response

PRIOR: Final = 1.0
"""An element's compliance may be off by all of its value."""
AXES: Final = ("dx", "dy", "dz", "rx", "ry", "rz")
"""Directions of a deflection, as the columns of a table call them: m, then rad."""
LEAST_SAMPLES: Final = 12
MOST_SAMPLES: Final = 2000
"""Of a recording: of more, every so many are taken."""
STIFFEST: Final = 0.02
"""Least factor at which the model is made linear."""
STEPS: Final = 20
CONVERGED: Final = 1e-2
"""Part of its deviation by which no factor moves in the last step."""
ALIKE: Final = 1e-3
"""Loads whose directions, and poses whose places, differ by no more of their size are one."""
SCALE: Final = 50.0
"""How many times softer or stiffer than the file says a machine may be as a whole."""
LIKE: Final = 0.5
"""Correlation of deflections and loads from which the one speaks of the other's scale."""
VARIES: Final = 4.0
"""Variance over that of the noise from which on a direction says something of the elements."""
HIDDEN: Final = 0.5
"""The same of the variation that the robot's file makes of the loads."""
UNEXPLAINED: Final = 0.9
"""Part of the deflections' variation: a fit that leaves more explains nothing."""
UNLIKE: Final = 0.3
"""Part of it from which a fault of the recording is looked for."""
BETTER: Final = 0.85
"""A recording has a fault if without it so much less is left."""


@dataclass(frozen=True, eq=False)
class Deflected:
    """A recording: ``time`` (k,), s; joints ``q`` (k, n); what was on the platform, and its answer.

    ``wrench`` and ``deflection``: at the platform's reference point, base axes, (k, 6), N and N m,
    m and rad; NaN in a column of the deflection: not measured.
    """

    name: str
    time: Array
    q: Array
    wrench: Array
    deflection: Array

    def thinned(self) -> Deflected:
        """With so many samples at most."""
        step = -(-len(self.time) // MOST_SAMPLES)
        cut = {k: getattr(self, k)[::step] for k in ("time", "q", "wrench", "deflection")}
        return replace(self, **cut)


@dataclass(frozen=True, eq=False, kw_only=True)
class ElasticFit(Result):
    """A fit of deflections: ``numbers`` are the factors of the file's ``element_compliance``.

    ``zeros``: of the instrument by recording, (recordings, 6). ``measured``: which directions are,
    (recordings, 6). ``told``: how many combinations of factors are known.
    """

    groups: tuple[Group, ...]
    zeros: Array
    measured: Mask
    told: int


@dataclass(frozen=True, eq=False)
class _Part:
    """One recording with the model in its poses; what is fitted comes first."""

    recording: Deflected
    response: ElementResponse
    measured: Mask

    @property
    def split(self) -> int:
        return round((1.0 - HELD_OUT) * len(self.recording.time))

    def rows(self, factors: Array) -> tuple[Array, Array, Array]:
        """Of what is fitted: derivatives (k, 6, e), target and what counts, (k, 6) each."""
        r, end = self.recording, self.split
        moved, slopes = self.response.deflection(r.wrench, factors)
        target = r.deflection - moved + slopes @ factors
        counts = np.isfinite(target)
        keep = counts[:end, :, None]
        return (
            np.where(keep, slopes[:end], 0.0), np.where(counts, target, 0.0)[:end],
            counts[:end].astype(float),
        )  # fmt: skip


def fit_elements(
    robot: Robot,
    recordings: Sequence[Deflected],
    update: Callable[[int], None] | None = None,
    *,
    accept: bool = False,
) -> ElasticFit:
    """Fit a factor on the compliance of every elastic element.

    :param update: called with the number of recordings whose poses are solved.
    :param accept: fit recordings that this machine cannot have made, too.
    :raises ParameterError: a robot without elastic members.
    :raises PkmTwinError: recordings that are too short, whose loads identify nothing, or that this
        machine cannot have made.
    """
    parts = []
    for i, recording in enumerate(recordings):
        _check(recording)
        thin = recording.thinned()
        response = element_response(robot, robot.forward(thin.q))
        measured = np.asarray(np.isfinite(thin.deflection).any(0))
        parts.append(_Part(thin, response, measured))
        if update is not None:
            update(i + 1)
    _check_loads(recordings, robot)
    faults = _scale_faults(parts)
    refuse_faults(faults, accept)
    names = parts[0].response.names
    try:
        found, table = _solve(parts, len(names))
    except PkmTwinError as error:
        cause, _ = _best_put_right(robot, parts[0], len(names), np.inf)
        raise PkmTwinError(f"{error}" + (f" ({cause}?)" if cause else "")) from None
    # What a bound holds at zero would be no compliance, and no file's.
    factors = np.maximum(found.values[: len(names)], STIFFEST)
    zeros = found.values[len(names) :].reshape(len(parts), 6)
    left = [
        part.recording.deflection - part.response.deflection(part.recording.wrench, factors)[0] - z
        for part, z in zip(parts, zeros, strict=True)
    ]
    verdict = elastic_verdict(
        robot, AXES, [(part.response, part.recording.q, part.recording.wrench) for part in parts],
        left, replace(found, values=np.concatenate([factors, zeros.ravel()])), table,
        np.concatenate([np.ones(len(names)), np.zeros(zeros.size)]),
    )  # fmt: skip
    if not faults:
        odd = verdict.answer == "does not explain"
        faults = _unexplained(robot, parts, factors, zeros, odd)
        refuse_faults(faults, accept)
    numbers = _numbers(robot, names, factors, found, verdict)
    if all(number.status == "not excited" for number in numbers):
        raise PkmTwinError("no excitation: the loads identify no element's compliance")
    plain = found.covariance[: len(names), : len(names)]
    found = replace(found, covariance=verdict.widened(found.covariance))
    own = found.covariance[: len(names), : len(names)]
    judged = tuple(
        _judged(part, factors, zero, own) for part, zero in zip(parts, zeros, strict=True)
    )
    return ElasticFit(
        robot=robot, estimate=found, numbers=numbers, judged=judged, zeros=zeros, verdict=verdict,
        groups=groups_of(names, factors, plain, own),
        measured=np.array([part.measured for part in parts]),
        samples=sum(part.split for part in parts),
        told=int(np.sum(np.linalg.eigvalsh(plain / PRIOR**2) < SURE**2)), accepted=tuple(faults),
    )  # fmt: skip


def _numbers(
    robot: Robot, names: Sequence[str], factors: Array, found: Estimate, verdict: Verdict
) -> tuple[Number, ...]:
    """Of the elements: known by the noise alone, their deviations by the verdict too."""
    own, wide = (
        np.sqrt(np.diag(one)[: len(names)])
        for one in (found.covariance, verdict.widened(found.covariance))
    )
    wide = np.full_like(wide, np.nan) if verdict.deviations == "withheld" else wide
    numbers = []
    for name, factor, *deviations in zip(names, factors, own, wide, strict=True):
        before = float(robot.element_compliance.get(name, 1.0))
        plain, told = (float(before * one) for one in deviations)
        key = "element_compliance", name
        after = float(before * factor)
        numbers.append(number_of(key, "", before, after, (plain, told), PRIOR * before))
    return tuple(numbers)


def _check(recording: Deflected) -> None:
    """Refuse what no fit can begin with."""
    count = int(np.isfinite(recording.deflection).any(1).sum())
    if count < LEAST_SAMPLES:
        raise PkmTwinError(
            f"{recording.name}: too short to fit, {count} deflections; {LEAST_SAMPLES} or more"
        )
    if not recording.wrench.any():
        raise PkmTwinError(f"{recording.name}: no load, every wrench is zero")
    values = recording.deflection[:, np.isfinite(recording.deflection).any(0)]
    if not (np.nanmax(values, 0) > np.nanmin(values, 0)).any():
        raise PkmTwinError(f"{recording.name}: no deflection, every one is the same")


def _check_loads(recordings: Sequence[Deflected], robot: Robot) -> None:
    """One load in one pose gives one deflection, whatever its size.

    :raises PkmTwinError: that is all there is.
    """
    loads = np.concatenate([r.wrench for r in recordings]) / np.repeat([1.0, robot.size], 3)
    # Squares of the smallest numbers are zero.
    loads /= np.abs(loads).max()
    sizes = np.linalg.norm(loads, axis=1)
    loads = loads[sizes > 0.1 * sizes.max()]
    singular = np.linalg.svd(loads, compute_uv=False)
    q = np.concatenate([r.q for r in recordings]) * robot.joint_scales
    apart = float(np.ptp(q, axis=0).max())
    if singular[1:].max(initial=0.0) < ALIKE * singular[0] and apart < ALIKE * robot.size:
        raise PkmTwinError(
            "no excitation: one load direction in one pose; use other directions or other poses to "
            "distinguish elements"
        )


def _scale_faults(parts: Sequence[_Part]) -> list[str]:
    """Deflections and the file's own, without the instrument's zero, over all directions at once.

    :returns: recordings in which they are alike but for a factor that no machine is off by.
    """
    faults = []
    for part in parts:
        r = part.recording
        moved, _ = part.response.deflection(r.wrench, np.ones(len(part.response.names)))
        seen = np.where(np.isfinite(r.deflection), moved, np.nan)[:, part.measured]
        told = r.deflection[:, part.measured]
        seen, told = (v - np.nanmean(v, 0) for v in (seen, told))
        size = np.sqrt(np.nanmean(seen**2, 0))
        seen, told = (v / np.where(size > 0.0, size, np.inf) for v in (seen, told))
        both, own, other = (float(np.nansum(v)) for v in (seen * told, seen**2, told**2))
        like = both / max(np.sqrt(own * other), 1e-300)
        if abs(like) < LIKE:
            continue
        if both < 0.0:
            faults.append(
                f"{r.name}: the platform moves against its loads: signs, or the axes of either"
            )
        elif not 1.0 / SCALE <= both / own <= SCALE:
            faults.append(
                f"{r.name}: deflections are {both / own:.3g} times what the robot's file makes of "
                "the loads: units? m and rad, N and N m"
            )
    return faults


def _part_left(part: _Part, factors: Array, zero: Array) -> float:
    """The part of the fitted deflections' variation that is left, beside noise between neighbours.

    Over all measured directions that vary by more than their noise or would by the robot's file,
    each by its own variation; zero where none does.
    """
    moved, _ = part.response.deflection(part.recording.wrench, factors)
    told = (part.recording.deflection - zero)[: part.split, part.measured]
    left = told - moved[: part.split, part.measured]
    size = np.nanmean((told - np.nanmean(told, 0)) ** 2, 0)
    noise = 0.5 * np.nanmean(np.diff(told, axis=0) ** 2, 0)
    expected, _ = part.response.deflection(part.recording.wrench, np.ones(len(factors)))
    due = np.nanvar(expected[: part.split, part.measured], 0)
    good = (size > VARIES * noise) | (due > HIDDEN * noise)
    if not good.any():
        return 0.0
    return float(np.sqrt(np.mean(np.nanmean(left**2, 0)[good] / size[good])))


def _unexplained(
    robot: Robot, parts: Sequence[_Part], factors: Array, zeros: Array, odd: bool
) -> list[str]:
    """Recordings that no compliance of this robot explains, each with the likely fault.

    A direction of noise alone is no fault where others are explained.

    :param odd: the verdict is that the model does not explain them.
    """
    faults = []
    for part, zero in zip(parts, zeros, strict=True):
        left = _part_left(part, factors, zero)
        if left < UNLIKE and not odd:
            continue
        cause, best = _best_put_right(robot, part, len(factors), left)
        if cause and best < BETTER * left:
            faults.append(
                f"{part.recording.name}: {cause}: put right, elastic elements leave "
                f"{100 * best:.2g} % of the deflections' variation, as recorded {100 * left:.2g} %"
            )
        elif left > UNEXPLAINED:
            faults.append(
                f"{part.recording.name}: no compliance of this robot explains the deflections: "
                "other loads, poses or axes than the recording's?"
            )
    return faults


def _best_put_right(robot: Robot, part: _Part, count: int, most: float) -> tuple[str, float]:
    """The fault without which the least is left of a recording, and how much; at most ``most``."""
    r, best, cause = part.recording, most, ""
    for text, wrench, deflection in put_right(robot, r.q, r.wrench, r.deflection):
        other = replace(part, recording=replace(r, wrench=wrench, deflection=deflection))
        try:
            found, _ = _solve([other], count)
        except (PkmTwinError, np.linalg.LinAlgError):
            continue
        factors = np.maximum(found.values[:count], STIFFEST)
        left = _part_left(other, factors, found.values[count:])
        if left < best:
            best, cause = left, text
    return cause, best


def _solve(parts: Sequence[_Part], count: int) -> tuple[Estimate, Array]:
    """Of the factors and the zeros, by steps of linear least squares; and the columns of both."""
    factors = np.ones(count)
    sizes = [np.nan_to_num(np.sqrt(np.nanmean(_measured(part) ** 2, 0))) for part in parts]
    scales = np.concatenate([np.full(count, PRIOR), *(np.maximum(s, 1e-12) for s in sizes)])
    start = np.concatenate([factors, np.zeros(6 * len(parts))])
    cones = [(slice(k, k + 1), above_zero(0, 1)) for k in range(count)]
    for _ in range(STEPS):
        rows = [part.rows(factors) for part in parts]
        tables = []
        for i, (slopes, _, counts) in enumerate(rows):
            zeros = np.zeros((*slopes.shape[:2], 6 * len(parts)))
            zeros[..., 6 * i : 6 * i + 6] = counts[..., None] * np.eye(6)
            tables.append(np.concatenate([slopes, zeros], -1))
        target, judged = (np.concatenate([one[k] for one in rows]) for k in (1, 2))
        table = np.concatenate(tables)
        begin = _noise(table * scales, target - table @ start, judged)
        found = estimate(table, target, start, scales, cones, judged, begin)
        new = np.maximum(found.values[:count], STIFFEST)
        moved = np.abs(new - factors) / np.sqrt(np.diag(found.covariance)[:count])
        factors = new
        if moved.max() < CONVERGED:
            return found, table
    raise PkmTwinError(
        f"the compliances do not converge in {STEPS} steps: no compliance of this robot explains "
        "the deflections, or loads in more directions are needed"
    )


def _noise(table: Array, change: Array, judged: Array) -> Array | None:
    """What all factors and zeros together leave of a change, by direction (6,).

    None where there are hardly more equations than those.
    """
    size = np.sqrt(np.sum(change**2 * judged, 0) / np.maximum(np.sum(judged, 0), 1.0))
    weights = judged / np.maximum(size, 1e-300)
    rows = (table * weights[..., None]).reshape(-1, table.shape[-1])
    equations, unknowns = int(judged.sum()), int((np.abs(rows).max(0) > 0.0).sum())
    if equations < 1.5 * unknowns:
        return None
    found = np.linalg.lstsq(rows, (change * weights).ravel(), rcond=1e-9)[0]
    left = (change - table @ found) * judged
    free = 1.0 - unknowns / equations
    return np.asarray(
        np.sqrt(np.sum(left**2, 0) / np.maximum(free * np.sum(judged, 0), 1.0)), np.float64
    )


def _measured(part: _Part) -> Array:
    """The fitted part's deflections; a direction that is not measured is zero."""
    values = part.recording.deflection[: part.split]
    return np.where(part.measured, values, 0.0)


def _judged(part: _Part, factors: Array, zero: Array, covariance: Array) -> Judged:
    """What is held out, without the instrument's zero."""
    r, end = part.recording, slice(part.split, None)
    before, _ = part.response.deflection(r.wrench, np.ones(len(factors)))
    after, slopes = part.response.deflection(r.wrench, factors)
    spread = np.sqrt(np.sum((slopes @ covariance) * slopes, -1).clip(0.0))
    measured = r.deflection[end] - zero
    return Judged(r.name, r.time[end], measured, before[end], after[end], spread[end])
