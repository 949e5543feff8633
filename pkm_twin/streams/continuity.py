# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Whether a stream of joint states is clear of singularities and moves without jumps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.errors import MessageError
from pkm_twin.kinematics.stream import stream_kernel
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.steps import farthest

MAX_MOVE: Final = 0.25
"""Largest move between two samples, in platform radii: beyond it, another assembly is likely."""


@dataclass(slots=True)
class _State:
    """A sample, and its row of :func:`stream_kernel`."""

    stamp: int
    numbers: Array


class Continuity:
    """Checks samples one after the other.

    The edge of reach is a singularity too, so one measure (see :meth:`Robot.singularity`) warns
    of both. Joint positions alone do not determine the assembly mode: modes meet in singularities,
    where the stream is stopped, and what skips over one shows as a jump of a joint or of the pose.

    :param warn: measure below which a sample is near a singularity; ``stop``: too near.
    :param velocity: bounds of the joints' rates, one per joint, rad/s or m/s.
    """

    def __init__(self, robot: Robot, warn: float, stop: float, velocity: Sequence[float]) -> None:
        self.robot = robot
        self.warn, self.stop = warn, stop
        self._velocity = tuple(velocity)
        self._largest = MAX_MOVE * robot.size
        self._scales = robot.pose_scales
        n, m = len(robot.joint_names), len(self._scales)
        self._told = n + m + m * m
        self._nothing = np.zeros(self._told + m + 1)
        self._call = robot.bound(_stream, self._scales)
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
        result = self._call(q, before)
        state = _State(stamp, result)
        *beyond, measure = result.tolist()[self._told :]
        if last is not None:
            self._check_jump(last, state, beyond)
        if not measure >= self.stop:
            raise MessageError(
                "singular",
                f"too close to a singularity or the edge of the workspace: index {measure:.3g}, "
                f"allowed {self.stop:g} or more (singularity_stop)",
            )
        self._before, self._last = last, state
        return bool(measure < self.warn)

    def _check_jump(self, last: _State, state: _State, beyond: list[float]) -> None:
        """No joint moves farther than its velocity limit allows, no pose than its rates tell."""
        period = (state.stamp - last.stamp) / SECOND
        joints = zip(state.numbers.tolist(), last.numbers.tolist(), self._velocity, strict=False)
        for joint, (now, before, velocity) in enumerate(joints):
            bound = farthest(velocity, period)
            if not abs(now - before) <= bound:
                controller = self.robot.controller
                unit = self.robot.joint_units[joint] if controller.plain else "of its units"
                moved, _, most = controller.shown(joint, "velocity", now - before, -bound, bound)
                raise MessageError(
                    "jump",
                    f"{controller.names[joint]} moved by {moved:g} {unit} in "
                    f"{period:g} s, allowed {most:g}",
                )
        worst = max(beyond)
        if not worst <= self._largest:
            raise MessageError(
                "jump",
                f"{self.robot.pose_names[beyond.index(worst)]} of the platform jumped but the "
                "joints did not: the assembly mode changed",
            )


def _stream(robot: Robot) -> Kernel:
    return stream_kernel(robot.engine)
