# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Measure the motion of the base with an inertial measurement unit (IMU) that is fixed to it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError
from pkm_twin.messages.reading import read_imu
from pkm_twin.messages.stamps import SECOND, StampRules
from pkm_twin.settings import AGE_BOUNDS, setting
from pkm_twin.streams.differentiator import Differentiator
from pkm_twin.streams.monitor import Core, StreamMonitor, make_counter
from pkm_twin.streams.wrench import ZERO, Mount, TimeCache, Triple, check_mount, check_order

AVERAGING_TIME: Final = 1.0
"""Time constant of the mean acceleration, s; the mean of a base that stays in place is gravity."""


@dataclass(frozen=True)
class ImuSettings:
    """Settings of the IMU: its frame, its :class:`Mount` on the base, and its age."""

    frame: str = setting("imu_link", "the only accepted frame of base_imu", name="imu.frame")
    xyz: Triple = setting(ZERO, "position of the IMU from the base's origin, base axes", name="imu.xyz", unit="m")
    rpy: Triple = setting(ZERO, "roll, pitch and yaw of the IMU relative to the base", name="imu.rpy", unit="rad")
    max_age: float = setting(
        0.02, "largest time between a joint state and the nearest message of base_imu", name="imu.max_age", **AGE_BOUNDS
    )

    def __post_init__(self) -> None:
        check_mount({"imu.xyz": self.xyz, "imu.rpy": self.rpy})


@dataclass
class BaseImu(Core):
    """Turns messages of an IMU into the motion of the base's origin in base axes.

    With the rotation S and the position r of the IMU, its angular velocity w_s and its acceleration
    less gravity f_s (what an accelerometer measures)::

        w = S w_s,   alpha = dw / dt,   a - g = S f_s - alpha x r - w x (w x r)

    alpha comes from the differentiator that a stream of joint states has. The orientation in the
    messages is not used.
    """

    settings: ImuSettings = field(default_factory=ImuSettings)
    rules: StampRules = field(default_factory=StampRules)
    stream: StreamMonitor = field(default_factory=make_counter)

    def __post_init__(self) -> None:
        self._mount = Mount.of(self.settings.xyz, self.settings.rpy)
        # The window of angular velocities is as long as that of joint states.
        self._fit = Differentiator(time=0.024)
        self._fit.prepare(3)
        self.clear()

    def clear(self) -> None:
        """Forget all messages, for instance after a jump of the clock."""
        self._recent: TimeCache[Array] = TimeCache()
        self._fit.reset()
        self._start = self._last = 0
        self.mean = np.zeros(3)
        """Mean acceleration less gravity, base axes, shape (3,), m/s2."""

    def take(self, message: Any, now: int) -> None:
        """Take a sensor_msgs/Imu.

        :raises MessageError: the message is rejected, and counted.
        """
        with self.taking(self.stream):
            sample = read_imu(message, now, self.rules, self.settings.frame)
            check_order(sample.stamp, self._last + 1)
            axes, r = self._mount.rotation, self._mount.position
            omega, force = axes @ sample.angular_velocity, axes @ sample.acceleration
            elapsed = (sample.stamp - self._last) / SECOND
            if elapsed > AVERAGING_TIME:
                self.clear()
                self._start, self.mean = sample.stamp, force
            try:
                rates = self._fit.push(sample.stamp, np.zeros(3), omega)
            except MessageError:
                self._fit.retract()
                raise
            self._last = sample.stamp
            self.mean = self.mean - math.expm1(-elapsed / AVERAGING_TIME) * (force - self.mean)
            if rates is not None:
                alpha = rates[1]
                change = force - np.cross(alpha, r) - np.cross(omega, np.cross(omega, r))
                self._recent.push(sample.stamp, np.concatenate([omega, alpha, change]))

    def require(self, stamp: int, gravity: Array) -> Array:
        """Return the motion of the base for a joint state's stamp, ns, shape (9,).

        :param gravity: of the robot at rest, m/s2.
        :raises MessageError: there is no recent message, or the mean of the last second is not that
            of an accelerometer.
        """
        found = self._recent.nearest(stamp)
        age = math.inf if found is None else abs(stamp - found[0]) / SECOND
        if found is None or age > self.settings.max_age:
            far = "none has arrived" if found is None else f"the nearest is {age:.3f} s away"
            text = f"no message of base_imu within {self.settings.max_age:g} s: {far}"
            raise MessageError("no base motion", text)
        seen = (self._last - self._start) / SECOND
        size, weight = float(np.linalg.norm(self.mean)), float(np.linalg.norm(gravity))
        if seen < AVERAGING_TIME:
            text = f"base_imu has been measured for {seen:.2f} s; {AVERAGING_TIME:g} s are needed"
            raise MessageError("no base motion", text)
        if size < 0.5 * weight:
            raise MessageError(
                "no base motion",
                f"the mean acceleration of base_imu is {size:.3g} m/s2, expected {weight:.3g}: an "
                "accelerometer at rest measures gravity upwards; does its driver remove gravity?",
            )
        return found[1]
