# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Wrenches and efforts seen through the window that gives a stream its acceleration.

A differentiated acceleration is a weighted mean of the accelerations in its window: fast parts of
the motion are damped and late in it. A cutter's force makes such parts, and so does the effort that
bears it; next to a damped acceleration neither fits. Through the same weights both do: the
equations of motion are linear in acceleration, wrench and effort, and the pose hardly changes in a
window.

Pure.
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
from pkm_twin.streams.monitor import Core, StreamMonitor, counting
from pkm_twin.streams.wrench import Mount, TimeCache, WrenchReader

MissingWrench = Literal["ignore", "stop"]


def window_weights(stamps: Array, order: int, carries_velocity: bool) -> Array:
    """Weights of the accelerations between the samples in a fit's, at its newest sample.

    The fit's derivative is sum c_k v_k (or sum c_k q_k of positions, second derivative). With the
    acceleration a_j constant between samples j and j + 1 that is sum h_j a_j,
    h_j = dt_j sum_{k > j} c_k (of positions each c_k times t_k - (t_j + t_{j+1}) / 2).

    :param stamps: shape (w,), ns, rising; ``order``: degree of the velocity's polynomial.
    :returns: shape (w - 1,), sum 1.
    """
    t = (stamps - stamps[-1]) / SECOND
    half = -0.5 * float(t[0])
    x = t / half + 1.0
    degree = order + (not carries_velocity)
    powers = np.vander(x, degree + 1, increasing=True).T
    k = np.arange(degree + 1)
    # At x = 1 the powers' derivatives are k and k (k - 1).
    slope = k / half if carries_velocity else k * (k - 1) / half**2
    c = np.linalg.solve(powers @ powers.T, slope) @ powers
    steps = np.diff(t)
    if carries_velocity:
        return np.asarray(steps * c[::-1].cumsum()[::-1][1:], np.float64)
    middles = 0.5 * (t[1:] + t[:-1])
    later = np.tril(np.ones((len(t), len(t))), -1)
    arms = later * (t[:, None] - np.append(middles, 0.0))
    return np.asarray(steps * (c @ arms)[:-1], np.float64)


@dataclass(slots=True)
class _Row:
    """One joint state of the window; ``since``: stamp of the wrench that it has, ns."""

    stamp: int
    rotation: Array
    effort: Array | None
    wrench: Array
    since: int


@dataclass
class WrenchWindow(Core):
    """Wrenches for a stream of joint states.

    ``max_age``: between a joint state and its wrench, ns. ``missing_wrench_policy``: without
    one the joint state counts as one without load (``ignore``), or is rejected (``stop``).
    ``order``, ``window``: the differentiator's.
    """

    reader: WrenchReader
    max_age: int
    missing_wrench_policy: MissingWrench = "ignore"
    order: int = 2
    window: int = 25
    without: int = 0
    """Joint states without a fresh wrench, counted."""
    stream: StreamMonitor = field(default_factory=counting)

    def __post_init__(self) -> None:
        self._recent: TimeCache[tuple[WrenchSample, Mount]] = TimeCache()
        # One more, so that the newest can be taken back.
        self._rows: deque[_Row] = deque(maxlen=self.window + 1)
        self._carries: bool | None = None
        self._weights: tuple[bytes, Array] = (b"", np.zeros(0))

    def change_fit(self, order: int, window: int) -> None:
        """Another differentiator: the window begins again."""
        self.order, self.window = order, window
        self._weights = (b"", np.zeros(0))
        self._rows = deque(maxlen=window + 1)

    def change_stamps(self, accept_zero_stamp: bool, future_tolerance: float) -> None:
        """Other rules for stamps from the next wrench on."""
        settings = dataclasses.replace(
            self.reader.settings,
            accept_zero_stamp=accept_zero_stamp,
            future_tolerance=future_tolerance,
        )
        self.reader = WrenchReader(settings, self.reader.mounts)

    def clear(self) -> None:
        """Forget joint states and wrenches, as when the clock jumps."""
        self._recent.clear()
        self._rows.clear()

    def restart(self) -> None:
        """Forget the joint states: the differentiator begins again."""
        self._rows.clear()

    def take(self, message: object, now: int) -> None:
        """Take a geometry_msgs/WrenchStamped; joint states that it is nearer to get it too.

        :raises MessageError: it is rejected, and counted.
        """
        with self.taking(self.stream):
            sample, mount = self.reader.read(message, now)
            self._recent.push(sample.stamp, (sample, mount))
        for row in reversed(self._rows):
            # It came after the joint state that it was measured with.
            if row.stamp < sample.stamp or row.since >= sample.stamp:
                break
            row.wrench = self.reader.at_reference(sample, mount, row.rotation)
            row.since = sample.stamp

    def require(self, stamp: int) -> tuple[WrenchSample, Mount] | None:
        """The wrench at a joint state, or None where there is none and none is needed.

        :raises MessageError: there is none, and the policy is to stop.
        """
        found = self._recent.held(stamp)
        age = None if found is None else abs(stamp - found[0])
        if found is not None and age is not None and age <= self.max_age:
            return found[1]
        self.without += 1
        if self.missing_wrench_policy == "ignore":
            return None
        far = (
            "no wrench has arrived"
            if age is None
            else f"the nearest wrench is {age / SECOND:.3f} s away, allowed "
            f"{self.max_age / SECOND:g} s"
        )
        raise MessageError("no wrench", f"no wrench: {far}")

    def push(
        self, sample: JointSample, rotation: Array, given: tuple[WrenchSample, Mount] | None
    ) -> None:
        """Add a joint state that the differentiator has taken.

        :param given: what :meth:`require` said; ``rotation``: the platform's, shape (3, 3).
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
        """Take the newest joint state back."""
        if self._rows:
            self._rows.pop()

    def through(self) -> tuple[Array, Array | None]:
        """Wrench (6,) and effort (n,) through the window; no effort where one has none.

        Base axes at the platform's reference point; the window has to be full.
        """
        rows = list(self._rows)[-self.window :]
        weights = self._window_weights(np.array([row.stamp for row in rows]))
        wrenches = np.array([row.wrench for row in rows])
        efforts = [row.effort for row in rows]
        wrench = weights @ (0.5 * (wrenches[1:] + wrenches[:-1]))
        if any(effort is None for effort in efforts):
            return wrench, None
        measured = np.array(efforts)
        return wrench, weights @ (0.5 * (measured[1:] + measured[:-1]))

    def _window_weights(self, stamps: Array) -> Array:
        """Remembered while the stamps are equally far apart."""
        key = np.diff(stamps).tobytes()
        if key != self._weights[0]:
            carries = bool(self._carries)
            self._weights = key, window_weights(stamps, self.order, carries)
        return self._weights[1]
