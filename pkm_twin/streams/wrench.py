# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read measured wrenches and transform them to the platform's reference point."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError, ParameterError
from pkm_twin.machine import rotations
from pkm_twin.messages.reading import JointReader, WrenchSample, read_wrench
from pkm_twin.messages.stamps import SECOND, StampRules
from pkm_twin.robot.robot import Robot
from pkm_twin.settings import DURATION_BOUNDS, FUTURE_TOLERANCE_TEXT, ZERO_STAMP_TEXT, setting
from pkm_twin.streams.monitor import Core, make_counter

Triple = tuple[float, float, float]
V = TypeVar("V")

PLATFORM: Final = "platform"
"""Name of the platform's link in an exported URDF."""
ZERO: Final = (0.0, 0.0, 0.0)
STAMP_ORDER: Final = "stamp order"
"""Reason for rejecting a message that is older than the one before."""


@dataclass(frozen=True, eq=False)
class Mount:
    """The pose of a force sensor relative to the platform's reference point, in platform axes.

    ``position``: shape (3,), m. ``rotation``: the sensor's axes as columns, shape (3, 3).
    """

    position: Array
    rotation: Array

    @classmethod
    def of(cls, xyz: Triple, rpy: Triple) -> Mount:
        """Make a mount from the numbers of a URDF origin, m and rad."""
        return cls(np.array(xyz), rotations.from_rpy(np.array(rpy)))


def check_mount(entries: Mapping[str, Triple]) -> None:
    """Reject a position, m, or angles, rad, of a sensor that are out of range.

    :param entries: parameters by name, which ends in ``xyz`` or ``rpy``.
    :raises ParameterError: naming the parameter and its bounds.
    """
    for name, values in entries.items():
        # A sensor farther off than 100 m is a wrong unit.
        bound = 100.0 if name.endswith("xyz") else 4.0 * math.pi
        if len(values) != 3 or not all(abs(value) <= bound for value in values):
            raise ParameterError(name, list(values), f"3 numbers from {-bound:g} to {bound:g}")


Mounts = Callable[[str, int], Mount]
"""Function from a frame and a stamp, ns, to the mount; raises MessageError if it is unknown."""


@dataclass(frozen=True)
class WrenchSettings:
    """Settings: which wrenches are accepted, and where they are measured.

    ``sensor_xyz``, ``sensor_rpy``: the fixed :class:`Mount`, m and rad.
    """

    wrench_frame: str = setting(
        PLATFORM,
        "the only accepted frame of the wrench; it is taken to move with the platform, unless it is base_frame",
        fixed=True,
    )
    base_frame: str = setting("base_link", "frame id of the base", fixed=True)
    accept_empty_frame: bool = setting(False, "accept an empty frame id as wrench_frame")
    max_state_age: float = setting(0.1, "largest time between a wrench and the nearest joint state", **DURATION_BOUNDS)
    future_tolerance: float = setting(0.1, FUTURE_TOLERANCE_TEXT, **DURATION_BOUNDS)
    accept_zero_stamp: bool = setting(False, ZERO_STAMP_TEXT)
    sensor_xyz: Triple = setting(
        ZERO, "position of the sensor from the platform's reference point, platform axes", name="sensor.xyz", unit="m"
    )
    sensor_rpy: Triple = setting(
        ZERO,
        "roll, pitch and yaw of the sensor relative to the platform; must be zeros for a wrench in base_frame",
        name="sensor.rpy",
        unit="rad",
    )

    def __post_init__(self) -> None:
        for name in ("wrench_frame", "base_frame"):
            if not getattr(self, name):
                raise ParameterError(name, "", "a frame's name")
        check_mount({"sensor.xyz": self.sensor_xyz, "sensor.rpy": self.sensor_rpy})
        if self.wrench_frame == self.base_frame and any(self.sensor_rpy):
            raise ParameterError(
                "sensor.rpy", list(self.sensor_rpy), f"zeros where wrench_frame is base_frame, {self.base_frame!r}"
            )

    @property
    def platform_frame(self) -> str:
        """Name of the frame fixed to the platform, derived from the wrench's frame."""
        moved = any(self.sensor_xyz) or any(self.sensor_rpy)
        return PLATFORM if moved or self.wrench_frame == self.base_frame else self.wrench_frame

    @property
    def stamp_rules(self) -> StampRules:
        """The rules for stamps of wrenches."""
        return StampRules(self.accept_zero_stamp, round(self.future_tolerance * SECOND))


@dataclass
class WrenchReader:
    """Reads wrenches and transforms them to the platform's reference point.

    ``mounts``: looks up a frame's mount; None: use the fixed mount of the settings.
    """

    settings: WrenchSettings
    mounts: Mounts | None = None

    def __post_init__(self) -> None:
        s = self.settings
        self._rules = s.stamp_rules
        self._fixed = Mount.of(s.sensor_xyz, s.sensor_rpy)

    def read(self, message: Any, now: int) -> tuple[WrenchSample, Mount]:
        """Read a geometry_msgs/WrenchStamped; return it unchanged, with its mount.

        :raises MessageError: the message is rejected.
        """
        s = self.settings
        sample = read_wrench(message, now, self._rules, s.wrench_frame, s.accept_empty_frame)
        if self.mounts is None or sample.frame in (s.base_frame, PLATFORM):
            return sample, self._fixed
        return sample, self.mounts(sample.frame, sample.stamp)

    def at_reference(self, sample: WrenchSample, mount: Mount, rotation: Array) -> Array:
        """Transform a wrench to the platform's reference point, base axes, shape (6,), N and N m.

        With the sensor's rotation S and position p in platform axes, and the platform's rotation R:
        f = R S f_s, m = R S m_s + (R p) x f (Murray, Li and Sastry 1994, equation 2.66). A wrench
        in the base frame is in base axes already.

        :param rotation: platform axes as columns, shape (3, 3).
        """
        force, moment = sample.wrench[:3], sample.wrench[3:]
        if sample.frame != self.settings.base_frame:
            axes = rotation @ mount.rotation
            force, moment = axes @ force, axes @ moment
        if mount.position.any():
            moment = moment + np.cross(rotation @ mount.position, force)
        return np.concatenate((force, moment))


def check_order(stamp: int, last: int) -> None:
    """Reject a stamp, ns, that is older than the last one, ns.

    :raises MessageError: the stamp is older.
    """
    if stamp < last:
        late = (last - stamp) / SECOND
        raise MessageError(STAMP_ORDER, f"the stamp is {late:.6f} s before the last")


@dataclass
class TimeCache(Generic[V]):
    """The newest values of a stream with their stamps, ns, which do not decrease."""

    length: int = 256
    items: deque[tuple[int, V]] = field(init=False)

    def __post_init__(self) -> None:
        self.items = deque(maxlen=self.length)

    @property
    def latest(self) -> tuple[int, V] | None:
        """The newest stamp and value; None before the first."""
        return self.items[-1] if self.items else None

    def push(self, stamp: int, value: V) -> None:
        """Add a value that is not older than the last.

        :raises MessageError: the stamp is older.
        """
        if self.items:
            check_order(stamp, self.items[-1][0])
        self.items.append((stamp, value))

    def nearest(self, stamp: int) -> tuple[int, V] | None:
        """Return the value nearest in time, the older of two; None if there is none."""
        best: tuple[int, V] | None = None
        for item in reversed(self.items):
            if best is not None and abs(stamp - item[0]) > abs(stamp - best[0]):
                break
            best = item
        return best

    def find_before(self, stamp: int) -> tuple[int, V] | None:
        """Return the newest value that is not later, else the oldest; None if there is none."""
        for item in reversed(self.items):
            if item[0] <= stamp:
                return item
        return self.items[0] if self.items else None

    def around(self, stamp: int) -> tuple[tuple[int, V], tuple[int, V]] | None:
        """Return the two values around a stamp; None if the stamp is outside the stored ones."""
        after: tuple[int, V] | None = None
        for item in reversed(self.items):
            if item[0] <= stamp:
                if item[0] == stamp or after is None:
                    return (item, item) if item[0] == stamp else None
                return item, after
            after = item
        return None

    def clear(self) -> None:
        """Forget all values."""
        self.items.clear()


@dataclass
class TimeSynchronizer(Core):
    """Reads joint states and wrenches of one robot and counts accepted and rejected ones.

    ``settings`` may change between messages. ``mounts``: looks up the mount of a wrench's frame;
    None: use the fixed mount of the settings.
    """

    robot: Robot
    settings: WrenchSettings = field(default_factory=WrenchSettings)
    mounts: Mounts | None = None

    def __post_init__(self) -> None:
        self.states = make_counter()
        self.wrenches = make_counter()
        self._reader = JointReader(self.robot)
        self.change_settings(self.settings)

    @property
    def dropped(self) -> int:
        """Number of joint states that were older than the one before."""
        return self.states.rejected[STAMP_ORDER]

    def change_settings(self, settings: WrenchSettings) -> None:
        """Use other settings from the next message on."""
        self.settings = settings
        self._rules = settings.stamp_rules
        self._wrench_reader = WrenchReader(settings, self.mounts)
