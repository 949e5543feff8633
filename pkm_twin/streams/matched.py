# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Average wrenches and efforts over the window that gives a stream its acceleration.

A differentiated acceleration is a weighted mean of the accelerations in its window: fast parts of
the motion, such as those from a cutter's force, appear damped and delayed. The force itself, and
the effort that carries it, do not match such an acceleration. Averaged with the same weights they
do: the equations of motion are linear in acceleration, wrench and effort, and the pose hardly
changes within a window.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError
from pkm_twin.messages.reading import JointSample, WrenchSample
from pkm_twin.messages.stamps import SECOND
from pkm_twin.streams.differentiator import fit_weights
from pkm_twin.streams.monitor import Core, StreamMonitor, make_counter
from pkm_twin.streams.wrench import Mount, TimeCache, WrenchReader

MissingWrench = Literal["ignore", "stop"]


def window_weights(stamps: Array, order: int, carries_velocity: bool) -> Array:
    """Return the weights that the accelerations between samples have in the fitted acceleration.

    The derivative of the fit at its newest sample is sum c_k v_k (for positions sum c_k q_k, the
    second derivative). With a constant acceleration a_j between samples j and j + 1 this equals
    sum h_j a_j with h_j = dt_j sum_{k > j} c_k (for positions each c_k is multiplied by
    t_k - (t_j + t_{j+1}) / 2).

    :param stamps: shape (w,), ns, rising.
    :param order: degree of the velocity's polynomial.
    :param carries_velocity: whether velocities are fitted, otherwise positions.
    :returns: shape (w - 1,), sum 1.
    """
    t = (stamps - stamps[-1]) / SECOND
    c = fit_weights(t, order + (not carries_velocity), 1 if carries_velocity else 2, 0.0)
    steps = np.diff(t)
    if carries_velocity:
        return np.asarray(steps * c[::-1].cumsum()[::-1][1:], np.float64)
    middles = 0.5 * (t[1:] + t[:-1])
    later = np.tril(np.ones((len(t), len(t))), -1)
    arms = later * (t[:, None] - np.append(middles, 0.0))
    return np.asarray(steps * (c @ arms)[:-1], np.float64)


@dataclass(slots=True)
class _Row:
    """One joint state of the window; ``since``: stamp of the assigned wrench, ns, -1 without one."""

    stamp: int
    rotation: Array
    effort: Array | None
    wrench: Array
    since: int


@dataclass
class WrenchWindow(Core):
    """Assigns wrenches to a stream of joint states, and averages them like its acceleration.

    ``max_age``: largest time between a joint state and its wrench, ns. ``missing_wrench_policy``: a
    joint state without wrench counts as unloaded (``ignore``) or is rejected (``stop``).
    ``order``, ``window``: those of the differentiator.
    """

    reader: WrenchReader
    max_age: int
    missing_wrench_policy: MissingWrench = "ignore"
    order: int = 2
    window: int = 25
    without: int = 0
    """Number of joint states without a recent wrench."""
    stream: StreamMonitor = field(default_factory=make_counter)

    def __post_init__(self) -> None:
        self._recent: TimeCache[tuple[WrenchSample, Mount]] = TimeCache()
        # One more than the window, so that the newest sample can be removed.
        self._rows: deque[_Row] = deque(maxlen=self.window + 1)
        self._carries: bool | None = None
        self._weights: tuple[bytes, Array] = (b"", np.zeros(0))

    def change_fit(self, order: int, window: int) -> None:
        """Use another order and window; the window fills again from its start."""
        self.order, self.window = order, window
        self._weights = (b"", np.zeros(0))
        self._rows = deque(maxlen=window + 1)

    def change_stamps(self, accept_zero_stamp: bool, future_tolerance: float) -> None:
        """Use other rules for stamps from the next wrench on."""
        settings = dataclasses.replace(
            self.reader.settings, accept_zero_stamp=accept_zero_stamp, future_tolerance=future_tolerance
        )
        self.reader = WrenchReader(settings, self.reader.mounts)

    def clear(self) -> None:
        """Forget joint states and wrenches, for instance after a jump of the clock."""
        self._recent.clear()
        self._rows.clear()

    def restart(self) -> None:
        """Forget the joint states, as the differentiator was reset."""
        self._rows.clear()

    def take(self, message: object, now: int) -> None:
        """Take a geometry_msgs/WrenchStamped; assign it also to joint states measured after it.

        :raises MessageError: the message is rejected, and counted.
        """
        with self.taking(self.stream):
            sample, mount = self.reader.read(message, now)
            self._recent.push(sample.stamp, (sample, mount))
        for row in reversed(self._rows):
            # The wrench belongs to joint states at least as new whose own wrench is older.
            if row.stamp < sample.stamp or row.since >= sample.stamp:
                break
            row.wrench = self.reader.at_reference(sample, mount, row.rotation)
            row.since = sample.stamp

    def require(self, stamp: int) -> tuple[WrenchSample, Mount] | None:
        """Return the wrench for a joint state's stamp, ns; None if it may be missing.

        :raises MessageError: there is no recent wrench, and the policy is to stop.
        """
        found = self._recent.find_before(stamp)
        age = None if found is None else abs(stamp - found[0])
        if found is not None and age is not None and age <= self.max_age:
            return found[1]
        self.without += 1
        if self.missing_wrench_policy == "ignore":
            return None
        far = (
            "no wrench has arrived"
            if age is None
            else f"the nearest wrench is {age / SECOND:.3f} s away, allowed {self.max_age / SECOND:g} s"
        )
        raise MessageError("no wrench", f"no wrench: {far}")

    def push(self, sample: JointSample, rotation: Array, given: tuple[WrenchSample, Mount] | None) -> None:
        """Add a joint state that the differentiator has taken.

        :param rotation: rotation of the platform, shape (3, 3).
        :param given: the result of :meth:`require`.
        """
        carries = sample.qd is not None
        if carries is not self._carries:
            self._rows.clear()
            self._carries = carries
        wrench, since = np.zeros(6), -1
        if given is not None:
            wrench = self.reader.at_reference(*given, rotation)
            since = given[0].stamp
        self._rows.append(_Row(sample.stamp, rotation, sample.effort, wrench, since))

    def retract(self) -> None:
        """Remove the newest joint state."""
        if self._rows:
            self._rows.pop()

    def through(self) -> tuple[Array, Array | None]:
        """Return wrench (6,) and effort (n,) averaged with the weights of the acceleration.

        The wrench is in base axes at the platform's reference point. The effort is None if a sample
        has none. The window must be full.
        """
        rows = list(self._rows)[-self.window :]
        # The weights are computed only if the intervals of the stamps changed.
        stamps = np.array([row.stamp for row in rows])
        key = np.diff(stamps).tobytes()
        if key != self._weights[0]:
            carries = bool(self._carries)
            self._weights = key, window_weights(stamps, self.order, carries)
        weights = self._weights[1]
        wrenches = np.array([row.wrench for row in rows])
        efforts = [row.effort for row in rows]
        wrench = weights @ (0.5 * (wrenches[1:] + wrenches[:-1]))
        if any(effort is None for effort in efforts):
            return wrench, None
        measured = np.array(efforts)
        return wrench, weights @ (0.5 * (measured[1:] + measured[:-1]))
