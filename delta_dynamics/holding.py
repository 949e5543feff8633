# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The effort that holds a machine at rest, sent on a stop. Pure: times are arguments."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from delta_dynamics.torques.virtual_work import inverse_dynamics
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError
from pkm_twin.machine.joint_map import ControllerNumbers
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.effort_limits import EffortLimits, LimitedEfforts


class MeasuredPose(NamedTuple):
    """Measured joint positions ``q``, shape (n,), rad or m, with the time of the measurement.

    ``measured``: on the steady clock, ns, so that a ROS clock that stands still does not keep a
    pose fresh.
    """

    q: Array
    measured: int

    @classmethod
    def from_sample(cls, q: Array, stamp: int, now: int, steady: int) -> MeasuredPose:
        """Return the pose of a sample that arrives now.

        :param stamp: of the sample, ns; ``now``, ``steady``: the ROS and the steady clock, ns.
        """
        return cls(q, steady - max(0, now - stamp))

    def age(self, steady: int) -> float:
        """Return the time since the measurement, s."""
        return (steady - self.measured) / SECOND


def find_holding_effort(
    limits: EffortLimits, pose: MeasuredPose | None, steady: int, max_age: float, base: Array | None = None
) -> LimitedEfforts:
    """Return the effort against gravity in the pose, shape (n,), or zeros.

    Zeros without a pose, if the pose is older than ``max_age`` (s), if the model has no effort for
    it, and if the effort exceeds a limit: a part of the holding effort would move the machine.

    :param base: acceleration of the base less gravity, shape (3,), m/s2; None: at rest.
    """
    robot = limits.robot
    zeros, _ = limits.apply(ControllerNumbers(np.zeros(robot.joints_count)), "zeros")
    if pose is None or pose.age(steady) > max_age:
        return zeros
    rest = np.zeros(robot.joints_count)
    try:
        moving = None if base is None else np.concatenate([np.zeros(6), base])
        effort = inverse_dynamics(robot, pose.q, rest, rest, base=moving)
        return limits.apply(robot.controller.controller_efforts(effort), "zeros")[0]
    except (PkmTwinError, ValueError):
        return zeros
