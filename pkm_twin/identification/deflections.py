# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The compliance of a robot's elastic elements from measured loads and deflections.

delta = C(s) w + z: s multiplies each element's compliance of the file, z is a zero of the
instrument, one a recording and direction. C is not linear in s where limbs share a load: the fit
goes by Gauss and Newton, with exact derivatives. The last third of every recording is held out.
Noise is what differs between neighbours in time where loads change slowly; elsewhere all that the
fit leaves is taken for noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.estimation import Estimate, estimate
from pkm_twin.identification.fit import Judged, Result, refuse_faults
from pkm_twin.identification.identifiable import make_nonnegative_cone
from pkm_twin.identification.judge import Case, fit_and_judge
from pkm_twin.identification.parameters import FITTED_RATIO, Group, group_elements, make_number
from pkm_twin.identification.rows import HELD_OUT_FRACTION
from pkm_twin.identification.verdict import Suspect, Verdict
from pkm_twin.messages.reading import rotate_to_base
from pkm_twin.recordings import Recording
from pkm_twin.robot.robot import Robot
from stiffness_monitor.response import ElementResponse, element_response

COMPLIANCE_DEVIATION: Final = 1.0
"""Prior standard deviation of an element's compliance, as a fraction of the file's value."""
AXES: Final = ("dx", "dy", "dz", "rx", "ry", "rz")
"""Directions of a deflection, as the columns of a table call them."""
UNITS: Final = ("m",) * 3 + ("rad",) * 3
WRENCH: Final = ("fx", "fy", "fz", "mx", "my", "mz")
MIN_SAMPLES: Final = 12
MIN_FACTOR: Final = 0.02
"""Smallest compliance factor at which the model is linearised."""
MAX_RELATIVE_DIFFERENCE: Final = 1e-3
"""Largest relative difference of load directions, and of poses, that count as the same."""
MAX_STIFFNESS_RATIO: Final = 50.0
"""Largest ratio of the machine's overall stiffness to the file's, and of its inverse."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ElasticFit(Result):
    """A fit of deflections: ``numbers`` are the factors of the file's ``element_compliance``.

    ``zeros``: of the instrument by recording, (recordings, 6). ``measured``: which directions are,
    (recordings, 6).
    """

    groups: tuple[Group, ...]
    zeros: Array
    measured: Mask

    @property
    def channels(self) -> tuple[str, ...]:
        """Directions of the deflections."""
        return AXES

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the directions."""
        return UNITS


@dataclass(frozen=True, eq=False)
class _Part:
    """Loads and deflections of a recording, and the model in its poses."""

    name: str
    time: Array
    q: Array
    wrench: Array
    deflection: Array
    response: ElementResponse

    @classmethod
    def from_recording(cls, robot: Robot, r: Recording) -> _Part:
        """Return a recording that a fit can begin with.

        :raises PkmTwinError: it is too short, or has no loads or deflections.
        """
        if r.wrench is None or r.deflection is None:
            raise PkmTwinError(f"{r.name}: no wrench or no deflection")
        count = int(np.isfinite(r.deflection).any(1).sum())
        if count < MIN_SAMPLES:
            raise PkmTwinError(f"{r.name}: too short to fit, {count} deflections; {MIN_SAMPLES} or more")
        if not r.wrench.any():
            raise PkmTwinError(f"{r.name}: no load, every wrench is zero")
        values = r.deflection[:, np.isfinite(r.deflection).any(0)]
        if not (np.nanmax(values, 0) > np.nanmin(values, 0)).any():
            raise PkmTwinError(f"{r.name}: no deflection, every one is the same")
        few = slice(None, None, -(-len(r.time) // 2000))
        q = r.q[few]
        response = element_response(robot, robot.forward(q))
        return cls(r.name, r.time[few], q, r.wrench[few], r.deflection[few], response)

    @cached_property
    def measured(self) -> Mask:
        """Mask of the measured directions, (6,)."""
        return np.asarray(np.isfinite(self.deflection).any(0))

    @property
    def size(self) -> Array:
        """RMS of the fitted deflections, (6,); zero where none was measured."""
        squares = np.where(self.measured, self.deflection[: self.split], 0.0) ** 2
        return np.asarray(np.nan_to_num(np.sqrt(np.nanmean(squares, 0))), np.float64)

    @property
    def split(self) -> int:
        return round((1.0 - HELD_OUT_FRACTION) * len(self.time))

    def moved(self, factors: Array) -> tuple[Array, Array]:
        """Return the model's deflections (k, 6) and their derivatives by the factors (k, 6, e)."""
        return self.response.deflection(self.wrench, factors)


def fit_elements(
    robot: Robot,
    recordings: Sequence[Recording],
    *,
    accept: bool = False,
    progress: Callable[[int], None] | None = None,
) -> ElasticFit:
    """Fit a factor on the compliance of every elastic element.

    :param accept: fit recordings that this machine cannot have made, too.
    :param progress: called with the number of recordings whose poses are solved.
    :raises ParameterError: a robot without elastic members.
    :raises PkmTwinError: recordings that are too short, whose loads identify nothing, or that this
        machine cannot have made.
    """
    parts = []
    for i, recording in enumerate(recordings):
        parts.append(_Part.from_recording(robot, recording))
        if progress is not None:
            progress(i + 1)
    _check_loads(parts, robot)
    faults = _list_scale_faults(parts)
    refuse_faults(faults, accept)
    names, one = parts[0].response.names, np.ones(len(parts[0].response.names))
    try:
        found = _solve(parts, len(names))
    except PkmTwinError as error:
        cause, _ = _find_best_repair(robot, parts[0], np.inf)
        raise PkmTwinError(f"{error}" + (f" ({cause}?)" if cause else "")) from None
    # A factor at its bound of zero is not a valid compliance.
    factors = np.maximum(found.values[: len(names)], MIN_FACTOR)
    zeros = found.values[len(names) :].reshape(len(parts), 6)
    verdict = _judge_fit(robot, parts, found, factors, zeros)
    if not faults:
        odd = verdict.answer == "does not explain"
        faults = _list_unexplained(robot, parts, factors, zeros, odd)
        refuse_faults(faults, accept)
    # The noise alone tells whether an element is identified; the reported deviation includes model errors.
    plain, own = (one[: len(names), : len(names)] for one in (found.covariance, verdict.covariance))
    deviations = np.sqrt([np.diag(plain), np.diag(own) * (np.nan if verdict.deviations == "withheld" else 1.0)])
    numbers = []
    for name, factor, (narrow, wide) in zip(names, factors.tolist(), deviations.T.tolist(), strict=True):
        before = float(robot.element_compliance.get(name, 1.0))
        both, prior = (before * narrow, before * wide), COMPLIANCE_DEVIATION * before
        numbers.append(make_number(("element_compliance", name), "", before, before * factor, both, prior))
    if all(number.status == "not excited" for number in numbers):
        raise PkmTwinError("no excitation: the loads identify no element's compliance")
    judged = []
    for part, zero in zip(parts, zeros, strict=True):
        end, (before_fit, _), (after, slopes) = slice(part.split, None), part.moved(one), part.moved(factors)
        spread = np.sqrt(np.sum((slopes @ own) * slopes, -1).clip(0.0))
        measured = part.deflection[end] - zero
        judged.append(Judged(part.name, part.time[end], measured, before_fit[end], after[end], spread[end]))
    known = int(np.sum(np.linalg.eigvalsh(plain / COMPLIANCE_DEVIATION**2) < FITTED_RATIO**2))
    return ElasticFit(
        robot=robot,
        estimate=replace(found, covariance=verdict.covariance, directions=known),
        numbers=tuple(numbers),
        judged=tuple(judged),
        zeros=zeros,
        verdict=verdict,
        groups=group_elements(names, factors, plain, own),
        measured=np.array([part.measured for part in parts]),
        samples=sum(part.split for part in parts),
        accepted=tuple(faults),
    )


def _check_loads(parts: Sequence[_Part], robot: Robot) -> None:
    """Reject loads of one direction in one pose, which cannot separate the elements.

    :raises PkmTwinError: that is all there is.
    """
    loads = np.concatenate([part.wrench for part in parts]) / np.repeat([1.0, robot.size], 3)
    # Squares of the smallest numbers are zero.
    loads /= np.abs(loads).max()
    sizes = np.linalg.norm(loads, axis=1)
    loads = loads[sizes > 0.1 * sizes.max()]
    singular = np.linalg.svd(loads, compute_uv=False)
    q = np.concatenate([part.q for part in parts]) * robot.joint_scales
    apart = float(np.ptp(q, axis=0).max())
    if (
        singular[1:].max(initial=0.0) < MAX_RELATIVE_DIFFERENCE * singular[0]
        and apart < MAX_RELATIVE_DIFFERENCE * robot.size
    ):
        raise PkmTwinError(
            "no excitation: one load direction in one pose; use other directions or other poses to distinguish elements"
        )


def _list_scale_faults(parts: Sequence[_Part]) -> list[str]:
    """List recordings whose deflections are the file's but for a factor that no machine is off by.

    Without the instrument's zero, over all directions at once.
    """
    faults = []
    for part in parts:
        moved, _ = part.moved(np.ones(len(part.response.names)))
        seen = np.where(np.isfinite(part.deflection), moved, np.nan)[:, part.measured]
        told = part.deflection[:, part.measured]
        seen, told = (v - np.nanmean(v, 0) for v in (seen, told))
        size = np.sqrt(np.nanmean(seen**2, 0))
        seen, told = (v / np.where(size > 0.0, size, np.inf) for v in (seen, told))
        both, own, other = (float(np.nansum(v)) for v in (seen * told, seen**2, told**2))
        like = both / max(np.sqrt(own * other), 1e-300)
        # Only deflections that correlate with the model's can show a wrong scale.
        if abs(like) < 0.5:
            continue
        if both < 0.0:
            faults.append(f"{part.name}: the platform moves against its loads: signs, or the axes of either")
        elif not 1.0 / MAX_STIFFNESS_RATIO <= both / own <= MAX_STIFFNESS_RATIO:
            faults.append(
                f"{part.name}: deflections are {both / own:.3g} times what the robot's file makes "
                "of the loads: units? m and rad, N and N m"
            )
    return faults


def _find_unexplained_part(part: _Part, factors: Array, zero: Array) -> float:
    """Return the unexplained part of the deflections' variation, beside neighbours' noise.

    Over all measured directions that vary by more than their noise or would by the robot's file,
    each by its own variation; zero where none does.
    """
    moved, _ = part.moved(factors)
    told = (part.deflection - zero)[: part.split, part.measured]
    left = told - moved[: part.split, part.measured]
    size = np.nanmean((told - np.nanmean(told, 0)) ** 2, 0)
    noise = 0.5 * np.nanmean(np.diff(told, axis=0) ** 2, 0)
    expected, _ = part.moved(np.ones(len(factors)))
    due = np.nanvar(expected[: part.split, part.measured], 0)
    # Only directions that vary more than their noise, or should, have information on the elements.
    good = (size > 4.0 * noise) | (due > 0.5 * noise)
    if not good.any():
        return 0.0
    return float(np.sqrt(np.mean(np.nanmean(left**2, 0)[good] / size[good])))


def _list_unexplained(robot: Robot, parts: Sequence[_Part], factors: Array, zeros: Array, odd: bool) -> list[str]:
    """List recordings that no compliance of this robot explains, each with the likely fault.

    A direction of noise alone is no fault where others are explained.

    :param odd: the verdict is that the model does not explain them.
    """
    faults = []
    for part, zero in zip(parts, zeros, strict=True):
        left = _find_unexplained_part(part, factors, zero)
        if left < 0.3 and not odd:
            continue
        cause, best = _find_best_repair(robot, part, left)
        if cause:
            faults.append(
                f"{part.name}: {cause}: put right, elastic elements leave "
                f"{100 * best:.2g} % of the deflections' variation, as recorded {100 * left:.2g} %"
            )
        elif left > 0.9:
            faults.append(
                f"{part.name}: no compliance of this robot explains the deflections: "
                "other loads, poses or axes than the recording's?"
            )
    return faults


def _find_best_repair(robot: Robot, part: _Part, most: float) -> tuple[str, float]:
    """Return the fault whose repair leaves the smallest residual, and that residual."""
    cause, best, count = "", 0.8 * most, len(part.response.names)
    for text, what, values in _list_repairs(robot, part):
        other = replace(part, wrench=values) if what == "wrench" else replace(part, deflection=values)
        with suppress(PkmTwinError, np.linalg.LinAlgError):
            found = _solve([other], count).values
            left = _find_unexplained_part(other, np.maximum(found[:count], MIN_FACTOR), found[count:])
            if left < best:
                cause, best = text, left
    return cause, best


def _solve(parts: Sequence[_Part], count: int) -> Estimate:
    """Estimate factors and zeros by steps of linear least squares."""
    factors = np.ones(count)
    scales = np.concatenate([np.full(count, COMPLIANCE_DEVIATION), *(np.maximum(part.size, 1e-12) for part in parts)])
    start = np.concatenate([factors, np.zeros(6 * len(parts))])
    cones = [(slice(k, k + 1), make_nonnegative_cone(0, 1)) for k in range(count)]
    for _ in range(20):
        rows = []
        for i, part in enumerate(parts):
            moved, slopes = (one[: part.split] for one in part.moved(factors))
            target = part.deflection[: part.split] - moved + slopes @ factors
            used = np.isfinite(target)
            slopes = np.where(used[..., None], slopes, 0.0)
            columns = np.concatenate([slopes, _make_offset_columns(i, len(parts), used)], -1)
            rows.append((columns, np.where(used, target, 0.0), used.astype(np.float64)))
        table, target, counts = map(np.concatenate, zip(*rows, strict=True))
        # The noise to begin with is what all factors and zeros together leave, by direction.
        change = target - table @ start
        size = np.sqrt(np.sum(change**2 * counts, 0) / np.maximum(np.sum(counts, 0), 1.0))
        weights = counts / np.maximum(size, 1e-300)
        scaled = (table * scales * weights[..., None]).reshape(-1, table.shape[-1])
        equations, unknowns, noise = int(counts.sum()), int((np.abs(scaled).max(0) > 0.0).sum()), None
        if equations >= 1.5 * unknowns:
            free = (1.0 - unknowns / equations) * np.sum(counts, 0)
            first = np.linalg.lstsq(scaled, (change * weights).ravel(), rcond=1e-9)[0]
            left = (change - (table * scales) @ first) * counts
            noise = np.asarray(np.sqrt(np.sum(left**2, 0) / np.maximum(free, 1.0)), np.float64)
        found = estimate(table, target, start, scales, cones, counts, noise)
        new = np.maximum(found.values[:count], MIN_FACTOR)
        step = np.abs(new - factors) / np.sqrt(np.diag(found.covariance)[:count])
        factors = new
        if step.max() < 1e-2:
            return found
    raise PkmTwinError(
        "the compliances do not converge in 20 steps: no compliance of this robot explains "
        "the deflections, or loads in more directions are needed"
    )


def _judge_fit(robot: Robot, parts: Sequence[_Part], found: Estimate, factors: Array, zeros: Array) -> Verdict:
    """Judge the fitted compliance factors and zero offsets (recordings, 6).

    The posterior is of the linearised model; its difference to the nonlinear fit is added to
    the covariance.
    """
    measured = np.any([part.measured for part in parts], 0)
    change = np.concatenate([factors - 1.0, zeros.ravel()])
    cases: list[Case] = []
    suspects: tuple[Suspect, ...] = ()
    for i, (part, zero) in enumerate(zip(parts, zeros, strict=True)):
        moved, slopes = part.moved(factors)
        left = part.deflection - moved - zero
        counts = np.isfinite(left)
        suspects, errors = zip(*_list_errors(robot, part, factors), strict=True)
        own = np.where(counts, moved, 0.0)
        columns = np.concatenate([slopes, _make_offset_columns(i, len(parts), np.ones_like(own))], -1)
        target = np.where(counts, left + columns @ change, 0.0)
        noise = _find_noise(left, own, columns.shape[-1])[measured]
        columns = np.concatenate([columns, np.stack(errors, -1)], -1)[:, measured]
        certain, own, used = (one[:, measured] for one in (own - target, own, counts.astype(np.float64)))
        cases.append(Case(certain, columns, own, used, noise, 1.0, np.zeros(0), part.split))
    names = [name for name, good in zip(AXES, measured.tolist(), strict=True) if good]
    verdict, _ = fit_and_judge(names, suspects, cases, found.prior)
    off = verdict.change - change
    return replace(verdict, covariance=verdict.covariance + np.outer(off, off))


def _make_offset_columns(recording: int, count: int, values: Array) -> Array:
    """Return the columns of the instruments' zeros, shape (k, 6, 6 count).

    One block of six a recording, which is not zero in the rows of its own ``recording``.
    """
    columns = np.zeros((*values.shape, 6 * count))
    columns[..., 6 * recording : 6 * recording + 6] = values[..., None] * np.eye(6)
    return columns


def _find_noise(left: Array, moved: Array, fitted: int) -> Array:
    """Estimate the standard deviation of the deflections' noise, (6,)."""
    result = np.zeros(6)
    for k in range(6):
        good = np.isfinite(left[:, k])
        values, signal = left[good, k], moved[good, k]
        if len(values) < 4:
            continue
        free = max(len(values) - fitted / 6.0, 1.0)
        result[k] = np.sqrt(np.sum((values - values.mean()) ** 2) / free)
        # Of second differences, which are of no slope, the variance is six times the noise's.
        apart = np.sqrt(np.mean(np.diff(signal, 2) ** 2) / 6.0)
        # Of a signal that is smooth, what differs between neighbours is noise.
        if apart < 0.2 * max(float(np.std(signal)), 1e-300):
            rough = np.sqrt(np.mean(np.diff(values, 2) ** 2) / 6.0)
            result[k] = min(result[k], float(rough))
    return result


def _list_errors(robot: Robot, part: _Part, factors: Array) -> Iterator[tuple[Suspect, Array]]:
    """Yield errors of a machine or a recording, with the derivatives of the deflections, (k, 6)."""
    q, wrench = part.q, part.wrench
    moved, _ = part.moved(factors)

    def bent(load: Array) -> Array:
        return part.response.deflection(load, factors)[0]

    def turned(values: Array, about: Array) -> Array:
        return np.concatenate([np.cross(about, values[:, k : k + 3]) for k in (0, 3)], 1)

    usual, eye = 0.05, np.eye(6)
    for name, e in zip(AXES, eye, strict=True):
        yield Suspect("gain of the deflection", name, usual=usual), moved * e
    for name, e in zip(WRENCH, eye, strict=True):
        yield Suspect("gain of the wrench", name, usual=usual), -bent(wrench * e)
    for axis, e in zip("xyz", np.eye(3), strict=True):
        lever = np.concatenate([0.0 * wrench[:, :3], np.cross(e, wrench[:, :3])], 1)
        yield Suspect("the wrench's point of attack", axis, "m", usual * robot.size), bent(lever)
        yield Suspect("axes of the wrench turned about", axis, "rad"), bent(turned(wrench, e))
        yield Suspect("axes of the deflection turned about", axis, "rad"), turned(moved, e)
    size = np.maximum(np.abs(moved).max(0), 1e-300)
    rate = np.sign(np.gradient(moved, axis=0))
    ramp = np.linspace(-0.5, 0.5, len(moved))[:, None]
    place = q - q.mean(0)
    place = place / np.maximum(np.abs(place).max(0), 1e-300)
    for name, unit, e in zip(AXES, UNITS, eye, strict=True):
        give = f"{unit}/{'N' if unit == 'm' else '(N m)'}"
        softer = moved * np.abs(moved) / size
        yield Suspect("stiffness that changes with the load", name), softer * e
        yield Suspect("hysteresis", name, unit), rate * e
        yield Suspect("drift", name, f"{unit}, from first to last"), ramp * e
        yield Suspect("base that gives", name, give), wrench * e
        for joint, here in zip(robot.joint_names, place.T, strict=True):
            pose = Suspect("compliance that changes with the pose", joint)
            yield pose, moved * here[:, None] * e


def _list_repairs(robot: Robot, r: _Part) -> Iterator[tuple[str, str, Array]]:
    """Yield faults that a recording may have, each with the wrenches or deflections without it."""
    rotation = robot.rotation(robot.forward(r.q))
    back = np.swapaxes(rotation, -1, -2)
    base, platform = "the base's axes", "the platform's"

    own, other = (rotate_to_base(r.wrench, one) for one in (rotation, back))
    yield f"the wrench is in {platform} axes, not in {base}", "wrench", own
    yield f"the wrench is in {base}, not in {platform}", "wrench", other
    own = rotate_to_base(r.deflection, rotation)
    yield f"the deflection is in {platform} axes, not in {base}", "deflection", own
    for first, load, move in ((0, "forces", "shifts"), (3, "moments", "turns")):
        for i, j in combinations(range(3), 2):
            order = np.arange(6)
            order[[first + i, first + j]] = first + j, first + i
            pair = f"{'xyz'[i]} and {'xyz'[j]}"
            yield f"{load} along {pair} are exchanged", "wrench", r.wrench[:, order]
            yield f"{move} along {pair} are exchanged", "deflection", r.deflection[:, order]
    for k, (load, move) in enumerate(zip(WRENCH, AXES, strict=True)):
        sign = np.where(np.arange(6) == k, -1.0, 1.0)
        yield f"{load} has the wrong sign", "wrench", r.wrench * sign
        yield f"{move} has the wrong sign", "deflection", r.deflection * sign
    mixed = np.repeat([1.0, 1e-3], 3)
    yield "moments are in N mm, forces in N", "wrench", r.wrench * mixed
    yield "turns are in mrad, shifts in m", "deflection", r.deflection * mixed
    yield "shifts are in mm, turns in rad", "deflection", r.deflection * mixed[::-1]
