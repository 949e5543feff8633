# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The fit of a calibration by damped steps of Gauss and Newton, and what speaks against it.

Poses that no machine like the file's was in, and measurements that do not fit the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, PkmTwinError, one_line
from pkm_twin.identification.calibration_state import FRAME, TARGET, Instrument, Parameter, State, update_state
from pkm_twin.identification.measurements import Measured, Readings, Weights
from pkm_twin.identification.samples import MIN_OUTLIER_DISTANCE
from pkm_twin.robot.robot import Robot

MAX_STEPS: Final = 60
"""Largest number of steps of a fit."""
MAX_CHANGE: Final = 5.0
"""Largest plausible change of a number, prior standard deviations."""
MIN_COST_SAVING: Final = 14.0
"""Least reduction of the cost by a free frame of the instrument at which the frame is the cause.

The cost is the sum of squared parameter changes over their prior standard deviations. By chance
six free numbers reduce it by so much in 3 of 100 cases."""
MAX_COST_RATIO: Final = 0.5
"""Largest ratio of the cost with the instrument's frame free to the cost without, at which the
frame is the cause: a model error that is not the frame's is also reduced, but by less."""
MAX_OUTLIERS: Final = 0.25
"""Largest fraction of the poses that may be outliers."""


class UnsettledError(ParameterError):
    """A fit that does not settle."""


class Fitted(NamedTuple):
    """A machine as fitted, the parameters' values (p,) and covariance, and how it came about.

    ``table``: derivatives of the measurements over their noise, in units of the priors.
    """

    state: State
    values: Array
    covariance: Array
    table: Array
    weights: Weights
    steps: int


def fit(
    robot: Robot, start: State, measured: Measured, parameters: Sequence[Parameter], progress: Callable[[int], None]
) -> Fitted:
    """Fit all parameters by robust least squares, and estimate the noise with them.

    :raises ParameterError: it does not settle.
    """
    state = start
    tool = start.instrument
    known = dict(zip((*FRAME[:3], *TARGET), (*tool.place, *tool.target), strict=True)) | tool.own
    values = np.array([known.get(p.name, p.before) for p in parameters])
    centre = np.array([p.before for p in parameters])
    prior = np.array([p.prior for p in parameters])

    def right(state: State, values: Array, noise: Weights) -> Array:
        return np.concatenate([noise.over(measured.parts(state)), (centre - values) / prior])

    names = [p.name for p in parameters]
    damping, problem, idle = 0.0, f"{MAX_STEPS} steps", 0
    for steps in range(1, MAX_STEPS + 1):
        progress(1)
        columns = measured.slopes(robot, state, names)
        # After 12 steps noise and weights stay fixed, as they and the fit may otherwise alternate.
        if steps <= 12:
            noise = measured.weighed(measured.parts(state), columns, prior)
        table = noise.over(columns)
        left, before = np.vstack([table, np.diag(1.0 / prior)]), right(state, values, noise)
        # In units of the prior no singular value is below one.
        _, sizes, axes = np.linalg.svd(left * prior, full_matrices=False)
        spread = prior[:, None] * axes.T / sizes
        covariance = spread @ spread.T
        trial, gained = None, 0.0
        for _ in range(8):
            # Along directions that the poses hardly determine the machine is far from linear, and
            # steps without damping may overshoot again and again (Levenberg, Marquardt).
            damped = np.diag(np.sqrt(damping) / prior)[: len(prior) if damping else 0]
            rows, end = np.vstack([left, damped]), np.append(before, np.zeros(len(damped)))
            move = np.asarray(np.linalg.lstsq(rows, end, rcond=None)[0], np.float64)
            small = bool(np.all(np.abs(move) < 1e-3 * np.sqrt(np.diag(covariance))))
            sums = [float(row @ row) for row in (before, before - left @ move)]
            settled = small or sums[0] - sums[1] < 1e-4
            try:
                new = dict(zip(names, (values + move).tolist(), strict=True))
                turn = np.array([dict(zip(names, move.tolist(), strict=True)).get(name, 0.0) for name in FRAME[3:]])
                trial = update_state(robot, state, measured.joints, new, turn)
            except PkmTwinError as error:
                # With these numbers the machine cannot be assembled in the poses: take a smaller step.
                trial, problem = None, str(error)
            else:
                row = right(trial, values + move, noise)
                gained = (sums[0] - float(row @ row)) / max(sums[0] - sums[1], 1e-300)
                if settled or gained > 0.25:
                    break
            # The least damping, in squares of prior standard deviations.
            damping = max(10.0 * damping, 0.01)
        if trial is None:
            break
        state, values = trial, values + move
        # Stop after three steps that hardly reduce the cost.
        idle = idle + 1 if gained * (sums[0] - sums[1]) < 0.02 else 0
        if settled or idle >= 3:
            return Fitted(state, values, covariance, table * prior, noise, steps)
        order = np.argsort(-np.abs(move) / np.sqrt(np.diag(covariance)))[:3]
        problem = f"{steps} steps, {', '.join(names[k] for k in order)} still move"
        if gained > 0.75:
            damping = 0.1 * damping if damping > 0.01 else 0.0
    raise UnsettledError("poses", problem, "poses for which the fit converges: measure more, or fit less (--only)")


class Fault(NamedTuple):
    """Reason to reject the poses, and what would be right."""

    what: str
    right: str

    def __str__(self) -> str:
        return f"poses: {self.what}; {self.right}"


class RejectedPosesError(ParameterError):
    """Error: this machine cannot have been in the poses."""

    def __init__(self, fault: Fault) -> None:
        Exception.__init__(self, one_line(f"{fault}; --accept calibrates anyway", 2000))
        self.field, self.value, self.bound = "poses", fault.what, fault.right


class Away(NamedTuple):
    """Residual of a measurement, m or rad, and as a multiple of the noise."""

    kind: str
    unit: str
    size: float
    sigmas: float


@dataclass(frozen=True)
class Outlier:
    """A line of a table, from 1, whose measurements do not fit the others."""

    line: int
    away: tuple[Away, ...]

    @property
    def worst(self) -> Away:
        """The measurement of the line with the largest residual over its noise."""
        return max(self.away, key=lambda one: one.sigmas)

    def size(self, unit: str) -> float | None:
        """Return the largest residual of one unit; None if there is none."""
        return max((one.size for one in self.away if one.unit == unit), default=None)

    def __str__(self) -> str:
        sizes = ", ".join(f"{one.kind} by {1e3 * one.size:.3g} m{one.unit}" for one in self.away)
        return f"line {self.line} is off: {sizes}; {self.worst.sigmas:.3g} sigma"


def find_outliers(readings: Sequence[Readings], parts: Sequence[Array], noise: Sequence[float]) -> tuple[Outlier, ...]:
    """Find outliers among the residuals (m, a) of readings, the worst first."""
    lines: dict[int, list[Away]] = {}
    for one, part, sigma in zip(readings, parts, noise, strict=True):
        sizes = np.linalg.norm(part, axis=1)
        for line, size in zip(one.lines.tolist(), sizes.tolist(), strict=True):
            over = size / sigma / part.shape[1] ** 0.5
            lines.setdefault(line, []).append(Away(one.kind.name, one.kind.unit, size, over))
    found = [Outlier(line, tuple(away)) for line, away in lines.items()]
    bad = [one for one in found if one.worst.sigmas > MIN_OUTLIER_DISTANCE]
    return tuple(sorted(bad, key=lambda one: -one.worst.sigmas))


def list_faults(
    left: Sequence[tuple[str, float]],
    outliers: Sequence[Outlier],
    count: int,
    changes: Sequence[Parameter],
    prior: float,
    size: float,
) -> list[Fault]:
    """List the reasons why a machine like the file's cannot have been in the poses.

    :param left: unit and noise an axis of each kind of measurement. ``changes``: the
        machine's numbers. ``prior``: of lengths, m. ``size``: of the machine, m.
    """
    faults = []
    # A noise above the prior deviation, 2 % of the size or 50 mrad means another machine's poses.
    bounds = {
        "m": (max(prior, 0.02 * size), "poses of this machine in m and rad"),
        "rad": (
            max(prior / size, 0.05),
            "rotations of this machine from its home, in rad and in the order and axes of the columns",
        ),
    }
    for unit, (most, right) in bounds.items():
        noise = max((one for its, one in left if its == unit), default=0.0)
        if noise > most:
            what = f"RMS residual {noise:.3g} {unit} per axis after the fit"
            faults.append(Fault(what, f"expected at most {most:.3g} {unit} for {right}"))
    if len(outliers) > MAX_OUTLIERS * count:
        what = f"{len(outliers)} of {count} do not fit the others ({outliers[0]})"
        faults.append(Fault(what, f"at most {100 * MAX_OUTLIERS:.0f} % may be outliers"))
    if changes:
        worst = max(changes, key=lambda p: abs(p.value - p.before) / p.prior)
        change = worst.value - worst.before
        if abs(change) > MAX_CHANGE * worst.prior:
            faults.append(
                Fault(
                    f"{worst.name} changes by {f'{change:.3g} {worst.unit}'.rstrip()}, "
                    f"{abs(change) / worst.prior:.2g} times its prior standard deviation",
                    f"at most {MAX_CHANGE:g} times is likely: are the poses in the base's axes and "
                    "in the file's units? A greater --prior allows more",
                )
            )
    return faults


def place_fault(instrument: Instrument) -> Fault:
    """Return the fault that the instrument stands elsewhere."""
    shift, angles = (
        ", ".join(f"{value + 0.0:.4f}" for value in np.round(one, 4))
        for one in (instrument.place, instrument.frame.as_rotvec())
    )
    return Fault(
        f"they fit in an instrument's frame at ({shift}) m, turned by ({angles}) rad, and not in the base's",
        "use --frame to fit the instrument's frame",
    )
