# SPDX-License-Identifier: Apache-2.0
"""Calibration from partial measurements: any quantities of some poses, the file as prior."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.identification.calibration import Estimate, parameters_of
from pkm_twin.identification.calibration_faults import (
    Outlier,
    RejectedPosesError,
    faults_of,
)
from pkm_twin.identification.calibration_fit import Parameter, fit
from pkm_twin.identification.calibration_state import (
    BESIDE,
    FRAME,
    TARGET,
    State,
    start_of,
)
from pkm_twin.identification.measurements import Partial, left_over, spans_of
from pkm_twin.identification.noise import OUTLIER, Weighed
from pkm_twin.identification.transmission import Transmission
from pkm_twin.robot.entries import with_entries
from pkm_twin.robot.robot import Robot

SCALED: Final = 0.5
"""Part of its deviation before below which a scale is known; part of a number's variance from
which on it depends on the scale."""
KEPT: Final = 0.1
"""Part of its prior deviation to which a length is kept that is known worse, without a scale."""
CURVED: Final = 1e-4
"""Deviation of a scale below which no measured length is needed: 0.01 mm in 100 mm."""


@dataclass(frozen=True)
class Agreement:
    """Of one kind: root mean squares before, after and left out, the worst after, the noise.

    ``held_out``: of each measurement by the fit to all others.
    """

    name: str
    unit: str
    rows: int
    before: float
    after: float
    held_out: float
    worst: float
    noise: float


class Scale(NamedTuple):
    """Relative standard deviation of distances across the poses, before and after."""

    before: float
    after: float
    determined: bool


@dataclass(frozen=True, kw_only=True)
class PartialCalibration(Estimate):
    """A robot that was calibrated with partial measurements."""

    agreements: tuple[Agreement, ...]
    outliers: tuple[tuple[str, Outlier], ...]
    """By kind, measurements that do not fit the others, the worst first."""
    scale: Scale | None
    """None where the platform does not move from its place."""


def unknowns(
    robot: Robot, measured: Partial, paths: Sequence[str], *, offsets: bool = True,
    frame: bool = False, target: bool = False, prior: float = 0.01,
    transmission: Transmission = Transmission.AUTO,
) -> list[Parameter]:  # fmt: skip
    """What is fitted, as it is before: the machine's numbers, the instrument's, the kinds' own."""
    extra = [*(FRAME if frame else ()), *(TARGET if target else ())]
    q = robot.controller.positions(measured.joints)
    listed = parameters_of(robot, q, paths, offsets, transmission, extra, prior)
    return listed + [Parameter(n, unit, 0.0, far) for n, (unit, far) in measured.own.items()]


def placed(robot: Robot, measured: Partial, paths: Sequence[str]) -> State:
    """The machine as it is at the measured poses, with a first guess of the kinds' own numbers."""
    state = start_of(robot, measured, paths)
    state.instrument.own = dict.fromkeys(measured.own, 0.0)
    for one in measured.readings:
        state.instrument.own |= one.kind.begin(one.seen(state)[0], one.values)
    return state


def calibrate_partial(
    robot: Robot,
    measured: Partial,
    paths: Sequence[str],
    *,
    offsets: bool = True,
    frame: bool = False,
    target: bool = False,
    prior: float = 0.01,
    transmission: Transmission = Transmission.AUTO,
    accept: bool = False,
    progress: Callable[[int], None] = lambda _: None,
) -> PartialCalibration:
    """Fit geometry, joint offsets and what the measurements need to any of their kinds.

    What they do not determine stays near the file's values, by ``prior``. See
    :func:`pkm_twin.identification.calibration.calibrate`.

    :raises ParameterError: measurements of another machine or unit, or a fit that does not settle.
    """
    parameters = unknowns(
        robot, measured, paths, offsets=offsets, frame=frame, target=target, prior=prior,
        transmission=transmission,
    )  # fmt: skip
    start = placed(robot, measured, [p.name for p in parameters if not _beside(p, measured)])
    beside = [p for p in parameters if _beside(p, measured) and not p.name.startswith("joint_map")]
    before = fit(robot, start, measured, beside, progress)[0] if beside else start
    after, values, covariance, _, noise, steps = fit(robot, before, measured, parameters, progress)
    told = [
        replace(p, deviation=float(np.sqrt(d)))
        for p, d in zip(parameters, np.diag(covariance), strict=True)
    ]
    scale, told = _scaled(robot, after, measured, told, covariance)
    if scale is not None and not scale.determined:
        near = [
            replace(p, prior=KEPT * p.prior)
            if p.unit == "m" and p.deviation > KEPT * p.prior and not _beside(p, measured)
            else p
            for p in told
        ]
        after, values, _, _, noise, more = fit(robot, before, measured, near, progress)
        steps += more
    told = [replace(p, value=float(v)) for p, v in zip(told, values, strict=True)]
    slopes = measured.slopes(robot, after, [p.name for p in parameters])
    left = left_over(slopes, noise.noise, np.array([p.prior for p in parameters]))
    agreements, outliers = [], []
    each = zip(
        measured.readings, measured.parts(before), measured.parts(after), left, noise.noise,
        strict=True,
    )  # fmt: skip
    for one, old, new, rest, sigma in each:
        kind, row = one.kind, new[:, 0]
        sizes = [_rms(old), _rms(new), _rms(row / rest), float(np.abs(row).max()), sigma]
        agreements.append(Agreement(kind.name, kind.unit, len(row), *sizes))
        for k in np.flatnonzero(np.abs(row) > OUTLIER * sigma).tolist():
            size, turns = float(abs(row[k])), kind.unit == "rad"
            found = (0.0 if turns else size, size if turns else None, size / sigma)
            outliers.append((kind.name, Outlier(int(one.lines[k]) - 2, *found)))
    outliers.sort(key=lambda one: -one[1].sigmas)
    changes = [
        (p.name, p.unit, p.value - p.before, p.prior) for p in told if p.name not in measured.own
    ]
    worst = tuple(
        max((a.noise for a in agreements if a.unit == unit), default=0.0) for unit in ("m", "rad")
    )
    faults = faults_of(
        Weighed(worst, np.ones(0), np.ones(0)), [one for _, one in outliers],
        sum(a.rows for a in agreements), changes, prior, robot.engine.tree.size,
    )  # fmt: skip
    if faults and not accept:
        raise RejectedPosesError(faults[0])
    return PartialCalibration(
        robot=with_entries(robot, after.numbers), parameters=tuple(told), covariance=covariance,
        steps=steps, faults=tuple(faults), joint_map=after.instrument.map,
        agreements=tuple(agreements), outliers=tuple(outliers), scale=scale,
    )  # fmt: skip


def _rms(part: Array) -> float:
    return float(np.sqrt(np.mean(part**2)))


def _beside(p: Parameter, measured: Partial) -> bool:
    return p.name.startswith(BESIDE) or p.name in measured.own


def _scaled(
    robot: Robot, state: State, measured: Partial, told: list[Parameter], covariance: Array
) -> tuple[Scale | None, list[Parameter]]:
    """How well the scale is known, and the numbers with those marked that hang on it alone."""
    readings = spans_of(state)
    if readings is None:
        return None, told
    names = [p.name for p in told]
    row = replace(measured, readings=(readings,)).slopes(robot, state, names)[0][0, 0]
    prior = np.array([p.prior for p in told])
    before, after = (float(np.sqrt(row @ c @ row)) for c in (np.diag(prior**2), covariance))
    length = any(one.kind.length for one in measured.readings)
    known = after < SCALED * before and (length or after < CURVED)
    scale = Scale(before, after, known)
    if known or not before > 0.0:
        return scale, told
    share = (covariance @ row) ** 2 / (after**2 * np.diag(covariance))
    return scale, [replace(p, scaled=bool(s > SCALED)) for p, s in zip(told, share, strict=True)]
