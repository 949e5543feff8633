# SPDX-License-Identifier: Apache-2.0
"""The fit of a calibration: damped steps of Gauss and Newton's method, robust weights, noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.identification.calibration_state import FRAME, State, moved, value_of
from pkm_twin.identification.measurements import Measured, Weights
from pkm_twin.identification.parameters import OBSERVED
from pkm_twin.robot.robot import Robot

STEPS: Final = 60
WEIGHED: Final = 12
"""Steps after which noise and weights stay: else they and the fit may go round in circles."""
POOR: Final = 0.25
GOOD: Final = 0.75
"""Parts of what a linear machine would gain: below the one steps are damped more, above less."""
SLOW: Final = 0.02
"""Or so little in each of several steps, ``IDLE``: no number moves by its deviation any more."""
IDLE: Final = 3
LIGHT: Final = 0.01
"""The least damping, in squares of prior standard deviations."""
TRIALS: Final = 8
"""Dampings of a step that are tried."""
CONVERGED: Final = 1e-3
"""Part of its deviation by which no parameter moves in the last step."""
GAINED: Final = 1e-4
"""Or by which the sum of squares over the noise falls."""


@dataclass(frozen=True)
class Parameter:
    """One number that is fitted, in its unit, with standard deviations before and after."""

    name: str
    unit: str
    before: float
    prior: float
    value: float = np.nan
    deviation: float = np.nan
    scaled: bool = False
    """Whether it hangs on a scale that was not measured."""

    @property
    def observed(self) -> bool:
        """Whether the poses tell it: they, not the prior, make its deviation."""
        return self.deviation < OBSERVED * self.prior and not self.scaled


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
    robot: Robot, start: State, measured: Measured, parameters: Sequence[Parameter],
    progress: Callable[[int], None],
) -> Fitted:  # fmt: skip
    """Robust least squares over all parameters, the noise found with them.

    :raises ParameterError: it does not settle.
    """
    state = start
    values = np.array([value_of(start, p.name, p.before) for p in parameters])
    centre = np.array([p.before for p in parameters])
    prior = np.array([p.prior for p in parameters])

    def right(state: State, values: Array, noise: Weights) -> Array:
        return np.concatenate([noise.over(measured.parts(state)), (centre - values) / prior])

    names = [p.name for p in parameters]
    damping, problem, idle = 0.0, f"{STEPS} steps", 0
    for steps in range(1, STEPS + 1):
        progress(1)
        columns = measured.slopes(robot, state, names)
        if steps <= WEIGHED:
            noise = measured.weighed(measured.parts(state), columns, prior)
        table = noise.over(columns)
        left, before = np.vstack([table, np.diag(1.0 / prior)]), right(state, values, noise)
        # In units of the prior no singular value is below one.
        _, sizes, axes = np.linalg.svd(left * prior, full_matrices=False)
        spread = prior[:, None] * axes.T / sizes
        covariance = spread @ spread.T
        trial, gained = None, 0.0
        for _ in range(TRIALS):
            move = _move(left, before, np.sqrt(damping) / prior)
            small = bool(np.all(np.abs(move) < CONVERGED * np.sqrt(np.diag(covariance))))
            sums = [float(row @ row) for row in (before, before - left @ move)]
            settled = small or sums[0] - sums[1] < GAINED
            try:
                trial = _stepped(robot, state, measured, names, values, move)
            except PkmTwinError as error:
                # No machine has such numbers, or none of them is in these poses: a smaller step.
                trial, problem = None, str(error)
            else:
                row = right(trial, values + move, noise)
                gained = (sums[0] - float(row @ row)) / max(sums[0] - sums[1], 1e-300)
                if settled or gained > POOR:
                    break
            damping = max(10.0 * damping, LIGHT)
        if trial is None:
            break
        state, values = trial, values + move
        idle = idle + 1 if gained * (sums[0] - sums[1]) < SLOW else 0
        if settled or idle >= IDLE:
            return Fitted(state, values, covariance, table * prior, noise, steps)
        order = np.argsort(-np.abs(move) / np.sqrt(np.diag(covariance)))[:3]
        problem = f"{steps} steps, {', '.join(names[k] for k in order)} still move"
        if gained > GOOD:
            damping = 0.1 * damping if damping > LIGHT else 0.0
    raise UnsettledError(
        "poses", problem, "poses for which the fit converges: measure more, or fit less (--only)"
    )


def _move(left: Array, right: Array, damping: Array) -> Array:
    """A step of Gauss and Newton's method, damped where that is not zero (Levenberg, Marquardt).

    Along a direction that the poses tell badly the machine may turn away from its tangent: without
    damping a step then goes beyond, and back, for ever.
    """
    rows, end = (left, right)
    if damping.any():
        rows = np.vstack([left, np.diag(damping)])
        end = np.concatenate([right, np.zeros(len(damping))])
    return np.asarray(np.linalg.lstsq(rows, end, rcond=None)[0], np.float64)


def _stepped(
    robot: Robot, state: State, measured: Measured, names: Sequence[str], values: Array, move: Array
) -> State:
    by = dict(zip(names, move.tolist(), strict=True))
    turn = np.array([by.get(name, 0.0) for name in FRAME[3:]])
    new = dict(zip(names, (values + move).tolist(), strict=True))
    return moved(robot, state, measured.joints, new, turn)
