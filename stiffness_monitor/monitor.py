# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute compliance and strain energy from messages: the stiffness node's core, without ROS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError
from pkm_twin.messages.reading import as_message_error, check_deflection
from pkm_twin.messages.stamps import SECOND
from pkm_twin.streams.continuity import check_step
from pkm_twin.streams.monitor import Pace
from pkm_twin.streams.wrench import TimeCache, TimeSynchronizer, WrenchSettings, check_order
from stiffness_monitor.compliance import PlatformResponse, platform_response

Settings = WrenchSettings
"""Settings for how the node pairs and accepts messages."""


@dataclass(frozen=True)
class Answer:
    """Hold the platform's response to one wrench.

    ``wrench`` (6,) and the response ``energy`` are in base axes at the platform's reference point;
    ``rotation`` (3, 3) is that of the platform relative to the base.
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
        self._last_wrench = 0
        """Stamp of the newest wrench, ns."""
        self.pace = Pace(0.0)

    @property
    def latest(self) -> tuple[int, Array] | None:
        """Stamp and joint positions of the newest state, None before the first."""
        return self._recent.latest

    def reset(self) -> None:
        """Discard all joint states, as when the clock jumps."""
        self._recent.clear()
        self._last_wrench = 0
        self.pace.reset()

    def joint_state(self, message: Any, now: int) -> None:
        """Add a joint state's positions.

        :raises MessageError: the message is rejected, and counted; also one that is older than the last,
            or that a joint could not reach since then, such as one of a second publisher.
        """
        with self.taking(self.states):
            sample = self._reader.positions(message, now, self._rules)
            check_step(self._reader, sample, self.latest)
            self._recent.push(sample.stamp, sample.q)

    def wrench(self, message: Any, now: int) -> Answer | None:
        """Compute the response to a wrench that is not older than the last; None if ``pace`` skips it.

        A wrench in the base frame has base axes; one in any other frame has the platform's, as a
        force-torque sensor mounted there measures it. It is moved from its measuring point, given
        by the settings or transforms, to the platform's reference point.

        :raises MessageError: the message is rejected, and counted.
        """
        with self.taking(self.wrenches):
            sample, mount = self._wrench_reader.read(message, now)
            if not self.pace.due(sample.stamp):
                return None
            found = self._recent.nearest(sample.stamp)
            if found is None:
                raise MessageError("no pose", "no pose: no joint state has arrived")
            stamp, q = found
            age, allowed = abs(sample.stamp - stamp) / SECOND, self.settings.max_state_age
            if age > allowed:
                text = f"no pose: the nearest joint state is {age:.3f} s away, allowed {allowed:g} s"
                raise MessageError("no pose", text)
            check_order(sample.stamp, self._last_wrench)
            self._last_wrench = sample.stamp
            pose, _, rotation = as_message_error(self.robot.placed, q)
            fixed = self._wrench_reader.at_reference(sample, mount, rotation)
            energy = as_message_error(platform_response, self.robot, q, fixed)
            if not (np.isfinite(energy.compliance).all() and np.isfinite(energy.deflection).all()):
                raise MessageError("non-finite result", "the model gave a value that is not finite")
            check_deflection(energy.deflection)
            self.pace.answered(sample.stamp)
            return Answer(sample.stamp, q, pose, fixed, energy, rotation)
