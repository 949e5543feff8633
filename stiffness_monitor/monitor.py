# SPDX-License-Identifier: Apache-2.0
"""The stiffness node's core: messages in, compliance and strain energy out. Pure.

May import: numpy, pkm_twin's core, this package; never rclpy.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import MessageError
from pkm_twin.machine.robot import Robot
from pkm_twin.ros.messages import (
    SECOND,
    JointReader,
    StampRules,
    WrenchSample,
    as_message_error,
    read_wrench,
)
from pkm_twin.streams.monitor import StreamMonitor
from stiffness_monitor.compliance import StrainEnergy, compliance, strain_energy

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Settings:
    """How the node pairs and accepts messages."""

    wrench_frame: str = "platform"
    base_frame: str = "base_link"
    accept_empty_frame: bool = False
    max_state_age: float = 0.1
    future_tolerance: float = 0.1
    accept_zero_stamp: bool = False

    @property
    def platform_frame(self) -> str:
        """The frame that turns with the platform, as far as the wrench tells it."""
        return "platform" if self.wrench_frame == self.base_frame else self.wrench_frame

    @property
    def stamp_rules(self) -> StampRules:
        """What stamps have to keep to."""
        return StampRules(self.accept_zero_stamp, round(self.future_tolerance * SECOND))


@dataclass(frozen=True)
class Answer:
    """What one wrench did to the platform.

    ``compliance`` (6, 6), ``energy.deflection`` (6,) and ``wrench`` (6,) in fixed axes at the
    platform's origin; ``rotation`` (3, 3) turns platform axes into fixed ones.
    """

    stamp: int
    pose: Array
    wrench: Array
    compliance: Array
    energy: StrainEnergy
    rotation: Array


@dataclass
class Monitor:
    """Pairs each wrench with the joint state nearest to it in time."""

    robot: Robot
    settings: Settings = field(default_factory=Settings)

    def __post_init__(self) -> None:
        self.states = StreamMonitor(trip_count=2**62, recovery_count=1)
        self.wrenches = StreamMonitor(trip_count=2**62, recovery_count=1)
        self.dropped = 0
        self.last_reject = ""
        self._rules = self.settings.stamp_rules
        self._reader = JointReader(self.robot)
        self._recent: deque[tuple[int, Array]] = deque(maxlen=256)

    @property
    def latest(self) -> tuple[int, Array] | None:
        """Stamp and joint positions of the newest state, None before the first."""
        return self._recent[-1] if self._recent else None

    def reset(self) -> None:
        """Forget all joint states, as when the clock jumps."""
        self._recent.clear()

    def change_settings(self, settings: Settings) -> None:
        """Answer by other settings from the next message on."""
        self.settings = settings
        self._rules = settings.stamp_rules

    def refuse_joint_state(self, error: MessageError) -> None:
        """Count a joint state that is refused."""
        self.states.reject(error.reason, str(error))
        self.last_reject = str(error)

    def joint_state(self, message: Any, now: int) -> None:
        """Take a joint state's positions; an older one than the last is dropped and counted.

        :raises MessageError: the message is rejected, and counted.
        """
        try:
            sample = self._reader.positions(message, now, self._rules)
            if self._recent and sample.stamp < self._recent[-1][0]:
                self.dropped += 1
                raise MessageError(
                    "stamp order",
                    f"the stamp is {(self._recent[-1][0] - sample.stamp) / SECOND:.6f} s before "
                    "the last",
                )
        except MessageError as error:
            self.refuse_joint_state(error)
            raise
        self.states.accept()
        self._recent.append((sample.stamp, sample.q))

    def wrench(self, message: Any, now: int) -> Answer:
        """Answer a wrench.

        A wrench in the base frame has fixed axes; one in any other frame has the platform's, as a
        force-torque sensor mounted there measures it.

        :raises MessageError: the message is rejected, and counted.
        """
        try:
            answer = self._wrench(message, now)
        except MessageError as error:
            self.wrenches.reject(error.reason, str(error))
            self.last_reject = str(error)
            raise
        self.wrenches.accept()
        return answer

    def _wrench(self, message: Any, now: int) -> Answer:
        s = self.settings
        sample = read_wrench(message, now, self._rules, s.wrench_frame, s.accept_empty_frame)
        q = self._nearest(sample.stamp)
        answer: Answer = as_message_error(self._answer, sample, q)
        deflection = answer.energy.deflection
        if not (np.isfinite(answer.compliance).all() and np.isfinite(deflection).all()):
            raise MessageError("non-finite result", "the model gave a value that is not finite")
        return answer

    def _answer(self, sample: WrenchSample, q: Array) -> Answer:
        pose = self.robot.forward(q)
        _, rotation = self.robot.platform(q)
        turn = np.eye(3) if sample.frame == self.settings.base_frame else rotation
        fixed = np.concatenate((turn @ sample.wrench[:3], turn @ sample.wrench[3:]))
        energy = strain_energy(self.robot, pose, fixed)
        matrix = compliance(self.robot, pose)
        return Answer(sample.stamp, pose, fixed, matrix, energy, rotation)

    def _nearest(self, stamp: int) -> Array:
        """Joint positions of the state nearest in time."""
        if not self._recent:
            raise MessageError("no pose", "no pose: no joint state has arrived")
        age, q = min((abs(stamp - at), i) for i, (at, _) in enumerate(self._recent))
        if age > self.settings.max_state_age * SECOND:
            raise MessageError(
                "no pose",
                f"no pose: the nearest joint state is {age / SECOND:.3f} s away, allowed "
                f"{self.settings.max_state_age:g} s",
            )
        return self._recent[q][1]
