# SPDX-License-Identifier: Apache-2.0
"""Whether a stream of joint states is clear of singularities and moves without jumps.

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import MessageError
from pkm_twin.kinematics.tracking import MAX_MOVE
from pkm_twin.machine.robot import Robot
from pkm_twin.ros.messages import SECOND

Array = NDArray[np.float64]

JUMP_FACTOR: Final = 2.0
JUMP_SLACK: Final = 5e-3
"""How far a joint may move between two samples: so many times what its velocity limit allows,
over the time between their stamps and this slack for stamps that are off, s."""


@dataclass(slots=True)
class _State:
    """A sample: q (n,), the pose (m,) and its rates per joint rate (m, n), angles at the rim."""

    stamp: int
    q: Array
    pose: Array
    rates: Array
    measure: float
    """Of the distance to a singularity; ``greatest``: upper bound of the rates' norm."""
    greatest: float


class Continuity:
    """Checks samples one after the other.

    The edge of reach is a singularity too, so one measure (see :meth:`Robot.singularity`) warns
    of both. Joint positions alone do not tell the assembly mode: modes meet in singularities,
    where the stream is stopped, and what skips over one shows as a jump of a joint or of the pose.

    :param warn: measure below which a sample is near a singularity; ``stop``: too near.
    :param velocity: bounds of the joints' rates, one a joint, rad/s or m/s.
    """

    def __init__(self, robot: Robot, warn: float, stop: float, velocity: Sequence[float]) -> None:
        self.robot = robot
        self.warn, self.stop = warn, stop
        self._velocity = tuple(velocity)
        self._largest = MAX_MOVE * robot.size
        self._rows = robot.pose_scales
        self._matrix = robot.pose_scales[:, None]
        self._joints = robot.joint_scales
        self.reset()

    def reset(self) -> None:
        """Forget the last sample."""
        self._last: _State | None = None
        self._before: _State | None = None

    def retract(self) -> None:
        """Take the newest sample back, as if it had not been there; once after a step."""
        self._last = self._before

    def step(self, stamp: int, q: Array) -> bool:
        """Take a sample, shape (n,): whether it is within the warning band of a singularity.

        :raises MessageError: it is too close to a singularity ("singular"), or it jumped ("jump").
            The next sample is then compared with the one before.
        :raises UnreachableError: the robot has no assembly there.
        """
        pose = self._rows * self.robot.forward(q)
        rates = self._matrix * self.robot.jacobian(q)
        # The sum of squares bounds the greatest singular value, and costs no decomposition.
        greatest = _length((rates / self._joints).ravel())
        state = _State(stamp, q, pose, rates, float(self.robot.singularity(q)), greatest)
        if self._last is not None:
            self._check_jump(self._last, state)
        near = self._near_singularity(state)
        self._before, self._last = self._last, state
        return near

    def _near_singularity(self, state: _State) -> bool:
        if not state.measure >= self.stop:
            raise MessageError(
                "singular",
                f"too close to a singularity or the edge of reach: measure {state.measure:.3g}, "
                f"singularity_stop is {self.stop:g}",
            )
        return state.measure < self.warn

    def _check_jump(self, last: _State, state: _State) -> None:
        """No joint moves farther than its velocity limit allows, no pose than its rates tell."""
        move = state.q - last.q
        period = (state.stamp - last.stamp) / SECOND
        factor = JUMP_FACTOR * period + JUMP_SLACK
        moves = move.tolist()
        for joint, (moved, velocity) in enumerate(zip(moves, self._velocity, strict=True)):
            if not abs(moved) <= velocity * factor:
                unit = self.robot.joint_units[joint]
                raise MessageError(
                    "jump",
                    f"{self.robot.joint_names[joint]} moved by {moved:g} {unit} in {period:g} s, "
                    f"allowed {velocity * factor:g}",
                )
        shift = state.pose - last.pose
        greatest = max(state.greatest, last.greatest)
        # What is predicted is no longer than the joints' move times the greatest singular value,
        # so most samples need no more than two lengths.
        if _length(shift) + 0.5 * greatest * _length(move * self._joints) <= self._largest:
            return
        # What the mean of both rates predicts errs by the third power of the move; how much, the
        # change of the rates tells. Half of what is predicted is for where they turn between.
        predicted = 0.5 * (state.rates + last.rates) @ move
        bend = np.abs(state.rates - last.rates) @ np.abs(move)
        error = np.abs(shift - predicted)
        far = ~(error - 0.5 * np.abs(predicted) - bend <= self._largest)
        if far.any():
            raise MessageError(
                "jump",
                f"{self.robot.pose_names[int(far.argmax())]} of the platform jumped while the "
                "joints did not: another assembly mode",
            )


def _length(vector: Array) -> float:
    return math.sqrt(float(vector @ vector))
