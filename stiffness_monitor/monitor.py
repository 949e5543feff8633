# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute compliance and strain energy from messages: the stiffness node's core, without ROS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError
from pkm_twin.messages.reading import WrenchSample, as_message_error
from pkm_twin.messages.stamps import SECOND
from pkm_twin.streams.monitor import Pace
from pkm_twin.streams.wrench import Mount, TimeCache, TimeSynchronizer, WrenchSettings
from stiffness_monitor.compliance import PlatformResponse, platform_response

Settings = WrenchSettings
"""Settings for how the node pairs and accepts messages."""


@dataclass(frozen=True)
class Answer:
    """Hold the platform's response to one wrench.

    ``energy`` and ``wrench`` (6,) in base axes at the platform's reference point; ``rotation`` (3,
    3) turns platform axes into fixed ones.
    """

    stamp: int
    q: Array
    pose: Array
    wrench: Array
    energy: PlatformResponse
    rotation: Array

    @property
    def compliance(self) -> Array:
        """Compliance of the platform, shape (6, 6)."""
        return self.energy.compliance


@dataclass
class Monitor(TimeSynchronizer):
    """Pair each wrench with the joint state nearest to it in time."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._recent: TimeCache[Array] = TimeCache()
        self.pace = Pace(0.0)

    @property
    def latest(self) -> tuple[int, Array] | None:
        """Stamp and joint positions of the newest state, None before the first."""
        return self._recent.latest

    def reset(self) -> None:
        """Discard all joint states, as when the clock jumps."""
        self._recent.clear()
        self.pace.reset()

    def joint_state(self, message: Any, now: int) -> None:
        """Add a joint state's positions; drop and count one that is older than the last.

        :raises MessageError: the message is rejected, and counted.
        """
        with self.taking(self.states):
            sample = self._reader.positions(message, now, self._rules)
            self._recent.push(sample.stamp, sample.q)

    def wrench(self, message: Any, now: int) -> Answer | None:
        """Compute the response to a wrench; None if ``pace`` skips it.

        A wrench in the base frame has base axes; one in any other frame has the platform's, as a
        force-torque sensor mounted there measures it. It is moved from its measuring point, given
        by the settings or transforms, to the platform's reference point.

        :raises MessageError: the message is rejected, and counted.
        """
        with self.taking(self.wrenches):
            return self._take_wrench(message, now)

    def _take_wrench(self, message: Any, now: int) -> Answer | None:
        sample, mount = self._wrench_reader.read(message, now)
        if not self.pace.due(sample.stamp):
            return None
        q = self._nearest_joints(sample.stamp)
        answer: Answer = as_message_error(self._compute, sample, mount, q)
        found = answer.energy
        if not (np.isfinite(found.compliance).all() and np.isfinite(found.deflection).all()):
            raise MessageError("non-finite result", "the model gave a value that is not finite")
        self.pace.answered(sample.stamp)
        return answer

    def _compute(self, sample: WrenchSample, mount: Mount, q: Array) -> Answer:
        pose, _, rotation = self.robot.placed(q)
        fixed = self._wrench_reader.at_reference(sample, mount, rotation)
        energy = platform_response(self.robot, q, fixed)
        return Answer(sample.stamp, q, pose, fixed, energy, rotation)

    def _nearest_joints(self, stamp: int) -> Array:
        """Return the joint positions of the state nearest in time."""
        found = self._recent.nearest(stamp)
        if found is None:
            raise MessageError("no pose", "no pose: no joint state has arrived")
        age = abs(stamp - found[0])
        if age > self.settings.max_state_age * SECOND:
            raise MessageError(
                "no pose",
                f"no pose: the nearest joint state is {age / SECOND:.3f} s away, allowed "
                f"{self.settings.max_state_age:g} s",
            )
        return found[1]
