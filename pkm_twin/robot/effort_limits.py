# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The limits that every effort passes before it leaves a node.

Publishers of efforts ask for :data:`LimitedEfforts`, which only :meth:`EffortLimits.apply` makes:
the type checker finds an effort that would leave without limits.
"""

from __future__ import annotations

import math
from operator import gt
from typing import Final, Literal, NewType

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError
from pkm_twin.machine.joint_map import ControllerNumbers
from pkm_twin.robot.robot import Robot

LimitedEfforts = NewType("LimitedEfforts", ControllerNumbers)
"""Finite efforts in the controller's numbers, shape (..., n), after the limits' policy."""
LimitPolicy = Literal["warn", "reject", "clamp"]
NON_FINITE: Final = "non-finite result"
"""Reason of a rejection: a model or a message gave an effort that is not finite."""


def effort_limits(robot: Robot) -> Array:
    """Return the robot's effort limits, shape (n,), N m or N; infinite where it has none."""
    efforts = getattr(getattr(robot, "limits", None), "effort", None)
    return np.full(len(robot.joint_names), np.inf) if efforts is None else np.asarray(efforts)


class EffortLimits:
    """The effort limits of a robot in the controller's numbers.

    They are converted as efforts are: an effort at its limit does not pass it by rounding.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self._limits = np.abs(robot.controller.controller_efforts(effort_limits(robot)))
        self._listed = self._limits.tolist()

    def apply(self, efforts: ControllerNumbers, policy: LimitPolicy | Literal["zeros"]) -> tuple[LimitedEfforts, bool]:
        """Return the efforts that may leave, and whether a limit was exceeded.

        :param efforts: shape (..., n), in the controller's numbers.
        :param policy: for efforts beyond a limit: ``warn`` lets them pass, ``clamp`` limits each,
            ``zeros`` makes all efforts of the sample zero, ``reject`` rejects them.
        :raises MessageError: an effort is not finite, or beyond its limit with ``reject``.
        """
        if efforts.ndim == 1:
            # One sample of a stream: Python floats are faster than numpy's calls.
            values = efforts.tolist()
            finite = all(map(math.isfinite, values))
            beyond = finite and any(map(gt, map(abs, values), self._listed))
        else:
            finite = bool(np.isfinite(efforts).all())
            beyond = finite and bool((np.abs(efforts) > self._limits).any())
        if not finite:
            raise MessageError(NON_FINITE, "an effort is not finite")
        if beyond and policy == "reject":
            excess = np.abs(efforts) - self._limits
            worst = np.unravel_index(int(excess.argmax()), efforts.shape)
            joint = int(worst[-1])
            raise MessageError(
                "effort limit",
                f"effort of {self.robot.controller.names[joint]} is {efforts[worst]:g}, "
                f"allowed {self._limits[joint]:g}",
            )
        limited = efforts
        if beyond and policy == "clamp":
            limited = ControllerNumbers(np.clip(efforts, -self._limits, self._limits))
        elif beyond and policy == "zeros":
            within = (np.abs(efforts) <= self._limits).all(-1, keepdims=True)
            limited = ControllerNumbers(np.where(within, efforts, 0.0))
        return LimitedEfforts(limited), beyond
