# SPDX-License-Identifier: Apache-2.0
"""What cores have in common that pair joint states with measured wrenches.

Pure: times are arguments.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from pkm_twin.errors import MessageError
from pkm_twin.messages.reading import JointReader
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.monitor import StreamMonitor
from pkm_twin.streams.wrench import STAMP_ORDER, Mounts, WrenchReader, WrenchSettings, counting


@dataclass
class PairingCore:
    """Settings that may change between two messages, and counts of what is taken and refused.

    ``mounts``: tells where a wrench's frame stands; None is the settings' fixed mount.
    """

    robot: Robot
    settings: WrenchSettings = field(default_factory=WrenchSettings)
    mounts: Mounts | None = None

    def __post_init__(self) -> None:
        self.states = counting()
        self.wrenches = counting()
        self.last_reject = ""
        self._reader = JointReader(self.robot)
        self.change_settings(self.settings)

    @property
    def dropped(self) -> int:
        """Joint states that were older than the one before."""
        return self.states.rejected[STAMP_ORDER]

    def change_settings(self, settings: WrenchSettings) -> None:
        """Answer by other settings from the next message on."""
        self.settings = settings
        self._rules = settings.stamp_rules
        self._wrench_reader = WrenchReader(settings, self.mounts)

    def refuse_joint_state(self, error: MessageError) -> None:
        """Count a joint state that is refused."""
        self._refuse(self.states, error)

    @contextmanager
    def _judging(self, counts: StreamMonitor) -> Iterator[None]:
        """Count a message as taken where all went well, else as refused."""
        try:
            yield
        except MessageError as error:
            self._refuse(counts, error)
            raise
        counts.accept()

    def _refuse(self, counts: StreamMonitor, error: MessageError) -> None:
        counts.reject(error.reason, str(error))
        self.last_reject = str(error)
