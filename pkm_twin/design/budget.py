# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Summarise the pose errors of a machine with tolerances over joint states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.design.tolerance import Tolerances, drawn, largest_length, rms_length
from pkm_twin.machine.uncertainty import Tolerance
from pkm_twin.robot.robot import Robot

DECIMALS: Final = 12
"""Decimal places of an error in m or rad; further digits are rounding errors."""


@dataclass(frozen=True)
class Contribution:
    """Describe what one error contributes to the platform's standard deviation over the states.

    ``sigma``, ``bound``: of the error, in its ``unit``. ``position``, ``angle``: RMS and largest
    effect, m and rad. ``calibrated``: RMS position that a calibration leaves, m. ``share``:
    fraction of the variance, 0 to 1. ``text``: description of the error.
    """

    sigma: float
    bound: float
    unit: str
    position: tuple[float, float]
    angle: tuple[float, float]
    calibrated: float
    share: float
    text: str
    moves: bool


@dataclass(frozen=True)
class ErrorSizes:
    """Hold RMS and largest length of position errors, m, and of rotations, rad, over the states."""

    rms_position: float
    greatest_position: float
    rms_angle: float
    greatest_angle: float


@dataclass(frozen=True)
class ExactErrors:
    """Hold the errors of random machines that were assembled exactly, and their first order."""

    machines: int
    states: int
    rms_position_m: float
    greatest_position_m: float
    rms_angle_rad: float
    first_order_rms_position_m: float


@dataclass(frozen=True, eq=False)
class ErrorBudget:
    """Summarise first-order errors at joint states q (k, n).

    ``calibrated``: standard deviation of the position that a calibration leaves of each error,
    shape (k, 3), m.
    """

    robot: Robot
    errors: Tolerances
    q: Array
    calibrated: Mapping[str, Array]

    @cached_property
    def contributions(self) -> dict[str, Contribution]:
        """Contributions by error, the largest share of the variance first."""
        found, result = self.errors, {}
        for name, paths in found.together.items():
            shift, turn = np.split(found.effect(name).round(DECIMALS), 2, -1)
            result[name] = Contribution(
                found.sigma[paths[0]],
                found.bounds[paths[0]],
                found.units[paths[0]],
                (rms_length(shift), largest_length(shift)),
                (rms_length(turn), largest_length(turn)),
                rms_length(self.calibrated[name].round(DECIMALS)),
                sum(found.variance[path] for path in paths),
                found.texts[paths[0]],
                any(np.any(np.abs(found.sensitivity[path]) > 1e-9) for path in paths),
            )
        return dict(sorted(result.items(), key=lambda item: -item[1].share))

    @cached_property
    def deviations(self) -> tuple[Array, Array]:
        """Standard deviations of position and rotation by all errors, (k, 3) each, m and rad."""
        shift, turn = np.split(self.errors.deviation.round(DECIMALS), 2, -1)
        return shift, turn

    @cached_property
    def sizes(self) -> ErrorSizes:
        """Sizes of the standard deviations over all states."""
        shift, turn = self.deviations
        return ErrorSizes(rms_length(shift), largest_length(shift), rms_length(turn), largest_length(turn))

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """Largest displacement (m) and rotation (rad) by all bounds, over all states."""
        shift, turn = self.errors.farthest.round(DECIMALS).max(0).tolist()
        return shift, turn

    @property
    def worst_pose(self) -> Array:
        """Pose with the largest standard deviation: of the rotation if the position is fixed."""
        return self._pose_of(np.linalg.norm(self.deviations[self.errors.only_turns], axis=-1))

    @property
    def bound_pose(self) -> Array:
        """Pose with the largest worst case of all bounds."""
        return self._pose_of(self.errors.farthest.round(DECIMALS)[:, int(self.errors.only_turns)])

    def _pose_of(self, sizes: Array) -> Array:
        return self.robot.forward(self.q[int(sizes.argmax())]).round(DECIMALS) + 0.0

    @property
    def calibrated_position(self) -> float:
        """RMS position error that a calibration without noise leaves, m."""
        squares = sum(left.round(DECIMALS) ** 2 for left in self.calibrated.values())
        return rms_length(np.sqrt(squares))


def draw_machines(budget: ErrorBudget, sigma: Mapping[str, float | Tolerance], count: int, seed: int) -> ExactErrors:
    """Assemble random machines exactly at 25 of the budget's states, and measure their errors."""
    chosen = np.unique(np.linspace(0, len(budget.q) - 1, 25).round().astype(int))
    shift, turn = np.split(drawn(budget.robot, sigma, budget.q[chosen], count, seed), 2, -1)
    first_order, _ = budget.deviations
    return ExactErrors(
        count,
        len(chosen),
        rms_length(shift),
        largest_length(shift),
        rms_length(turn),
        rms_length(first_order[chosen]),
    )
