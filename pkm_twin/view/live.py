# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The latest message of each running node, and traces of the torques.

Messages are read through their attributes, so that this module needs no ROS.
"""

from __future__ import annotations

import math
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from pkm_twin.bags.definitions import JOINT_STATE, TRANSFORM
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError, one_line
from pkm_twin.messages.reading import JointReader
from pkm_twin.messages.stamps import SECOND, StampRules, stamp_of
from pkm_twin.robot.robot import Robot

TRACE_SECONDS: Final = 20.0
"""Length of the drawn traces, s."""
TOPICS: Final = {
    "state": (JOINT_STATE, "joint_states"),
    "torque": (JOINT_STATE, "delta_dynamics/joint_torques"),
    "residual": (JOINT_STATE, "delta_dynamics/torque_residual"),
    "energy": ("diagnostic_msgs/msg/DiagnosticArray", "stiffness_monitor/strain_energy"),
    "deflection": (TRANSFORM, "stiffness_monitor/deflection"),
}
"""Subscriptions by name: type, and topic in the robot's namespace."""
TRACES: Final = ("torque", "residual")
_ANY_STAMP: Final = StampRules(accept_zero=True, future_tolerance=2**62)


@dataclass(frozen=True, eq=False)
class LiveValues:
    """Hold the latest values that nodes published; ``None`` or empty without a message.

    ``q`` (n,); ``traces``: by name, times (k,) s before the latest, and values (k, n), N m or N;
    ``shares``: of the strain energy by element; ``deflection``: in platform axes, (6,), m and rad.
    ``counts``: accepted messages by name; ``rejected``: number of rejected messages; ``reason``: of
    the last rejection.
    """

    q: Array | None
    traces: dict[str, tuple[Array, Array]]
    dominant: str
    shares: dict[str, float]
    deflection: Array | None
    counts: dict[str, int]
    rejected: int
    reason: str


class Live:
    """Store the latest messages of running nodes; a lock lets other threads read them."""

    def __init__(self, robot: Robot) -> None:
        # Joint states beyond the limits are shown, too.
        self._reader = JointReader(robot, limited=False)
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._rejected, self._reason = 0, ""
        self._q: Array | None = None
        self._traces: dict[str, deque[tuple[int, Array]]] = {name: deque() for name in TRACES}
        self._dominant, self._shares = "", dict[str, float]()
        self._deflection: Array | None = None
        self._take: dict[str, Callable[[Any], None]] = {
            "state": self._take_joint_state,
            "torque": lambda message: self._take_efforts("torque", message),
            "residual": lambda message: self._take_efforts("residual", message),
            "energy": self._take_strain_energy,
            "deflection": self._take_deflection,
        }

    def take(self, name: str, message: Any) -> None:
        """Store a message of the topic ``name`` in TOPICS; count it as rejected if it is invalid."""
        with self._lock:
            try:
                self._take[name](message)
                self._counts[name] += 1
            except MessageError as error:
                self._rejected += 1
                self._reason = one_line(f"{TOPICS[name][1]}: {error}")

    def _take_joint_state(self, message: Any) -> None:
        self._q = self._reader.positions(message, 0, _ANY_STAMP).q

    def _take_efforts(self, name: str, message: Any) -> None:
        sample = self._reader.efforts(message, 0, _ANY_STAMP)
        trace = self._traces[name]
        if trace and sample.stamp < trace[-1][0]:
            trace.clear()  # the clock jumped back: a bag is played again
        # At most 50 points a second are kept.
        if trace and sample.stamp - trace[-1][0] < SECOND / 50.0:
            return
        trace.append((sample.stamp, sample.effort))
        while sample.stamp - trace[0][0] > TRACE_SECONDS * SECOND:
            trace.popleft()

    def _take_strain_energy(self, message: Any) -> None:
        status = next(iter(message.status), None)
        if status is None:
            raise MessageError("empty", "no status")
        stamp_of(message.header)
        values = {pair.key: _parse_finite(pair.value) for pair in status.values}
        total = values.pop("total_energy", None)
        if total is None:
            raise MessageError("empty", "no total_energy")
        # The keys are the factors of the elements, then total_energy, then the pose.
        keys = [pair.key for pair in status.values]
        factors = keys[: keys.index("total_energy")]
        shares = {key: values[key] for key in factors}
        if any(share is None for share in shares.values()):
            raise MessageError("not finite", "a factor is NaN or infinite")
        self._shares = {key: float(share) for key, share in shares.items() if share is not None}
        self._dominant = str(status.message)

    def _take_deflection(self, message: Any) -> None:
        move, turn = message.transform.translation, message.transform.rotation
        numbers = np.array([move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w])
        if not np.isfinite(numbers).all() or not np.any(numbers[3:]):
            raise MessageError("not finite", "the transform is not finite")
        vector = Rotation.from_quat(numbers[3:]).as_rotvec()
        self._deflection = np.concatenate([numbers[:3], vector])

    def read_latest(self) -> LiveValues:
        """Return a copy of the latest values."""
        with self._lock:
            newest = max((t[-1][0] for t in self._traces.values() if t), default=0)
            traces = {
                name: (
                    np.array([(stamp - newest) / SECOND for stamp, _ in trace]),
                    np.array([values for _, values in trace]),
                )
                for name, trace in self._traces.items()
                if trace
            }
            return LiveValues(
                self._q,
                traces,
                self._dominant,
                dict(self._shares),
                self._deflection,
                dict(self._counts),
                self._rejected,
                self._reason,
            )


def _parse_finite(text: Any) -> float | None:
    try:
        value = float(text)
    except (TypeError, ValueError):
        return None
    return value if math.isfinite(value) else None
