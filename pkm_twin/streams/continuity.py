# SPDX-License-Identifier: Apache-2.0
"""Whether a stream of joint states is clear of singularities and moves without jumps.

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import MessageError
from pkm_twin.kinematics.stream import stream_kernel
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
    """A sample: q (n), pose (m) and rates (m n) as :func:`stream_kernel` gives them."""

    stamp: int
    numbers: Array


class Clearance:
    """A lower bound of a Jacobian's reciprocal condition number, cheap along a stream.

    No singular value moves farther than the matrix does (Weyl), so those of one matrix bound
    those of all near it; they are taken anew only where the bound says too little.
    """

    def __init__(self) -> None:
        self._near: tuple[Array, float, float] | None = None
        self.greatest = math.inf
        """Bound of the last matrix' greatest singular value."""

    def at_least(self, rates: Array, wanted: float) -> float:
        """A bound of the measure of ``rates`` (m, n): the measure itself where it is below."""
        if self._near is not None and self._near[0].shape == rates.shape:
            matrix, least, greatest = self._near
            change = (rates - matrix).ravel()
            moved = _length(change)
            self.greatest = greatest + moved
            bound = (least - moved) / self.greatest if self.greatest > 0.0 else 0.0
            if bound >= wanted:
                return bound
        values = np.linalg.svd(rates, compute_uv=False)
        least, self.greatest = values.item(-1), values.item(0)
        self._near = rates, least, self.greatest
        return least / self.greatest if self.greatest > 0.0 else 0.0


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
        self._scales = robot.pose_scales
        n, m = self._shape = len(robot.joint_names), len(self._scales)
        self._size = n + m + m * n
        self._nothing = np.zeros(self._size)
        self._kernel = stream_kernel(robot.engine)
        self._call = self._kernel.first_of_one(self._scales)
        self._clearance = Clearance()
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
        last = self._last
        before = self._nothing if last is None else last.numbers
        result: Any = self._call(q, before)
        if result is None:
            (result,), status = self._kernel(self._scales, q, before)
            if status is not None:
                self.robot.refuse_joints(status, q)
        state = _State(stamp, result[: self._size])
        if last is not None:
            self._check_jump(last, state, result[self._size :].tolist())
        near = self._near_singularity(q, state)
        self._before, self._last = last, state
        return near

    def _near_singularity(self, q: Array, state: _State) -> bool:
        n, m = self._shape
        rates = state.numbers[n + m :].reshape(m, n) / self.robot.joint_scales
        if self._clearance.at_least(rates, self.warn) >= self.warn:
            return False
        measure = float(self.robot.singularity(q))
        if not measure >= self.stop:
            raise MessageError(
                "singular",
                f"too close to a singularity or the edge of reach: measure {measure:.3g}, "
                f"singularity_stop is {self.stop:g}",
            )
        return measure < self.warn

    def _check_jump(self, last: _State, state: _State, beyond: list[float]) -> None:
        """No joint moves farther than its velocity limit allows, no pose than its rates tell."""
        period = (state.stamp - last.stamp) / SECOND
        factor = JUMP_FACTOR * period + JUMP_SLACK
        joints = zip(state.numbers.tolist(), last.numbers.tolist(), self._velocity, strict=False)
        for joint, (now, before, velocity) in enumerate(joints):
            if not abs(now - before) <= velocity * factor:
                unit = self.robot.joint_units[joint]
                raise MessageError(
                    "jump",
                    f"{self.robot.joint_names[joint]} moved by {now - before:g} {unit} in "
                    f"{period:g} s, allowed {velocity * factor:g}",
                )
        worst = max(beyond)
        if not worst <= self._largest:
            raise MessageError(
                "jump",
                f"{self.robot.pose_names[beyond.index(worst)]} of the platform jumped while the "
                "joints did not: another assembly mode",
            )


def _length(vector: Array) -> float:
    return math.sqrt(float(vector @ vector))
