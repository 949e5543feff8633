# SPDX-License-Identifier: Apache-2.0
"""Whether a stream of joint states is clear of singularities and moves without jumps.

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.kernels import OK, Kernel
from pkm_twin.errors import MessageError
from pkm_twin.kinematics.tracking import MAX_MOVE
from pkm_twin.machine.robot import Robot
from pkm_twin.ros.messages import SECOND

Array = NDArray[np.float64]

JUMP_FACTOR: Final = 2.0
JUMP_SLACK: Final = 5e-3
"""How far a joint may move between two samples: so many times what its velocity limit allows,
over the time between their stamps and this slack for stamps that are off, s."""

STATE: Final = 15
"""A sample: q, the pose, and its rates per joint rate joint by joint, lengths at the rim."""
JOINT_JUMP: Final = 1.0
POSE_JUMP: Final = 2.0


class Continuity:
    """Checks samples one after the other.

    The edge of reach is a singularity too, so one measure (see :meth:`Robot.singularity`) warns
    of both. Joint positions alone do not tell the assembly mode: modes meet in singularities,
    where the stream is stopped, and what skips over one shows as a jump of a joint or of the pose.

    :param warn: measure below which a sample is near a singularity; ``stop``: too near.
    :param velocity: bounds of the joints' rates, rad/s or m/s.
    """

    def __init__(self, robot: Robot, warn: float, stop: float, velocity: Sequence[float]) -> None:
        self.robot = robot
        self._warn, self._stop = warn, stop
        self._velocity = velocity
        radius = float(getattr(robot, "geometry").platform_radius)  # noqa: B009
        scale = [1.0 if unit == "m" else radius for unit in robot.pose_units]
        self._bounds = np.array([*scale, *velocity, MAX_MOVE * radius])
        self.reset()

    def reset(self) -> None:
        """Forget the last sample."""
        self._stamp = 0
        self._state = np.zeros(STATE)

    def step(self, stamp: int, q: Array) -> bool:
        """Take a sample, shape (3,): whether it is within the warning band of a singularity.

        :raises MessageError: it is too close to a singularity ("singular"), or it jumped ("jump");
            the next sample is compared with this one all the same.
        """
        robot = self.robot
        pose, fault = robot.forward_kernel(robot.parameters, q)
        if fault.item(0) != OK:
            robot.raise_fault(fault, "joint state")
        rates, _, fault = robot.jacobian_kernel(robot.parameters, q)
        if fault.item(0) != OK:
            robot.raise_fault(fault, "joint state")
        period = (stamp - self._stamp) / SECOND if self._stamp else -1.0
        head = np.array([period, 0.0, 0.0])
        state, verdict, _ = COMPARISON(self._bounds, head, q, pose, rates, self._state)
        last, self._stamp, self._state = self._state, stamp, state
        kind, index, clearance = verdict.tolist()
        if kind != 0.0:
            self._refuse(kind == JOINT_JUMP, int(index), period, state - last)
        if clearance >= self._warn:
            return False
        measure = float(robot.singularity(q))
        if not measure >= self._stop:
            raise MessageError(
                "singular",
                f"too close to a singularity or the edge of reach: measure {measure:.3g}, "
                f"singularity_stop is {self._stop:g}",
            )
        return measure < self._warn

    def _refuse(self, of_joint: bool, index: int, period: float, moves: Array) -> None:
        if of_joint:
            allowed = self._velocity[index] * (JUMP_FACTOR * period + JUMP_SLACK)
            raise MessageError(
                "jump",
                f"{self.robot.joint_names[index]} moved by {moves[index]:g} "
                f"{self.robot.joint_unit} in {period:g} s, allowed {allowed:g}",
            )
        raise MessageError(
            "jump",
            f"{self.robot.pose_names[index]} of the platform jumped while the joints did not: "
            "another assembly mode",
        )


def _compare(p, head, q, pose, rates, last, state, verdict, scratch, fault):  # type: ignore[no-untyped-def]
    """No joint moves farther than its velocity limit allows, no pose than its rates tell.

    ``p``: scale of the pose, velocity limits, largest jump of the pose (m). ``head``: time since
    the last sample (s), negative for none. ``verdict``: what jumped, which one, and a lower bound
    of the rates' reciprocal condition number, at least a third of it, by the Frobenius norms of
    the matrix and of its inverse: singular values would take ten times as long.
    """
    for i in range(3):
        state[i] = q[i]
        state[3 + i] = p[i] * pose[i]
        for k in range(3):
            state[6 + 3 * i + k] = p[k] * rates[3 * i + k]
    verdict[0] = 0.0
    verdict[1] = 0.0
    period = head[0]
    if period >= 0.0:
        for i in range(2, -1, -1):
            # What the mean of both rates tells errs by the third power of the move; how much, the
            # change of the rates tells. Half of what is predicted is for where they turn between.
            predicted = 0.0
            bend = 0.0
            for j in range(3):
                move = state[j] - last[j]
                rate = state[6 + 3 * j + i]
                before = last[6 + 3 * j + i]
                predicted += 0.5 * (rate + before) * move
                bend += abs((rate - before) * move)
            error = abs(state[3 + i] - last[3 + i] - predicted)
            if not error - 0.5 * abs(predicted) - bend <= p[6]:
                verdict[0] = POSE_JUMP
                verdict[1] = i
        for i in range(2, -1, -1):
            if not abs(state[i] - last[i]) <= p[3 + i] * (JUMP_FACTOR * period + JUMP_SLACK):
                verdict[0] = JOINT_JUMP
                verdict[1] = i
    a = state[6]
    b = state[7]
    c = state[8]
    d = state[9]
    e = state[10]
    f = state[11]
    g = state[12]
    h = state[13]
    y = state[14]
    m = e * y - f * h
    n = f * g - d * y
    o = d * h - e * g
    s = c * h - b * y
    t = a * y - c * g
    u = b * g - a * h
    v = b * f - c * e
    w = c * d - a * f
    x = a * e - b * d
    matrix = a * a + b * b + c * c + d * d + e * e + f * f + g * g + h * h + y * y
    adjugate = m * m + n * n + o * o + s * s + t * t + u * u + v * v + w * w + x * x
    size = math.sqrt(matrix * adjugate)
    verdict[2] = abs(a * m + b * n + c * o) / size if size > 0.0 else 0.0


COMPARISON: Final = Kernel(_compare, (3, 3, 3, 9, STATE), (STATE, 3), batches=False)
"""As a kernel, to warm up before live use."""
