# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Shape a motion so that the first mode, whose frequency changes, rests at its end.

ZV and ZVD (Singer and Seering 1990) split a motion into two or three, half a damped vibration
apart. As the frequency changes along the path, delays are measured in the vibration's phase: the
delayed motion is x(theta) with phase(theta(t)) = phase(t) - pi. Pose coordinates are shaped, so
that a straight line stays one. Each stretch comes to rest at its end before the next begins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for
from numpy.typing import ArrayLike

from delta_dynamics import inverse_dynamics_at_pose
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.paths.joint_path import check_positions, check_singularity, reference_velocity
from pkm_twin.paths.motion import Moments, Samples, TimedPath, find_peak_usage
from pkm_twin.robot.derivatives import joint_rates
from stiffness_monitor.modes import natural_frequencies
from stiffness_monitor.vibration import damping_ratios

HALF_PERIODS: Final = {"zv": 1, "zvd": 2}
"""Half vibration periods by which each shaper lengthens a stretch."""
POSES_PER_STRETCH: Final = 16
"""Poses of a stretch at which the frequency is computed."""
SHAPED_SAMPLES: Final = 4001
"""Samples of a shaped motion at which limits and singularities are checked: 2 ms apart in 8 s."""
MAX_SLOWDOWNS: Final = 8
"""Largest number of times that a motion is slowed down: frequencies change with the time scale."""
MIN_TIME_STEP: Final = 1e-9
"""Difference below which two times are the same, s."""


@dataclass(frozen=True)
class Phase:
    """Describe the vibration's phase: ``rate`` (rad/s) at ``times`` (k,), s, constant outside."""

    times: Array
    rate: Array

    @cached_property
    def _curves(self) -> tuple[Any, Any]:
        """Interpolations of the rate and of the phase."""
        rate = scipy.interpolate.PchipInterpolator(self.times, self.rate)
        return rate, rate.antiderivative()

    def at(self, time: Array) -> tuple[Array, Array, Array]:
        """Return phase (rad), its rate and the rate's derivative at times (k,)."""
        inside = np.clip(time, self.times[0], self.times[-1])
        rate_curve, phase_curve = self._curves
        rate = rate_curve(inside)
        slope = np.where(inside == time, rate_curve(inside, 1), 0.0)
        return phase_curve(inside) + rate * (time - inside), rate, slope

    def find_earlier_times(self, time: Array, phase: float) -> tuple[Array, Array, Array]:
        """Return times at which the phase was ``phase`` less, and their two derivatives."""
        now, rate, slope = self.at(time)
        found = time - phase / rate
        for _ in range(50):
            own, own_rate, own_slope = self.at(found)
            step = (own - now + phase) / own_rate
            found = found - step
            if np.abs(step).max(initial=0.0) < 1e-13:
                break
        first = rate / own_rate
        return found, first, (slope - own_slope * first**2) / own_rate


@dataclass(frozen=True)
class ShapedPath(TimedPath):
    """Describe a motion that leaves its first mode at rest at every stop.

    ``runs``: of the unshaped motion.

    ``phase``: of the first mode. ``amplitudes``: of the split motion, sum 1, each half a vibration
    after the one before. ``shaper``: ``zv`` or ``zvd``; ``frequencies``: lowest and highest, Hz;
    ``added``: to the duration, s.
    """

    phase: Phase | None = None
    amplitudes: tuple[float, ...] = (1.0,)
    shaper: str = ""
    frequencies: tuple[float, float] = (0.0, 0.0)
    added: float = 0.0

    @cached_property
    def _sample_times(self) -> Array:
        return np.linspace(0.0, self.duration, SHAPED_SAMPLES)

    @cached_property
    def _peak_usage(self) -> Array:
        assert self.phase is not None  # noqa: S101  shaped() gives it
        plain = np.concatenate([begin + run.times for begin, run in zip(self.begins, self.runs, strict=True)])
        # The accelerations of each delayed copy jump at delayed times.
        late = [self.phase.find_earlier_times(plain, -k * np.pi)[0] for k in range(len(self.amplitudes))]
        even = np.linspace(0.0, self.duration, POSES_PER_STRETCH)
        times = np.unique(np.clip(np.concatenate([even, *late]), 0.0, self.duration))
        times = times[np.diff(times, prepend=-1.0) > MIN_TIME_STEP]

        def sample(time: Array) -> Moments:
            s = self.sample(time)
            return s.effort, s.qd, s.qdd, s.felt

        return np.asarray(find_peak_usage(self.limits, times, sample).max(0), np.float64)

    def sample(self, times: ArrayLike) -> Samples:
        """Return the shaped motion at times (k,), s from its beginning."""
        t = np.asarray(times, np.float64)
        robot = self.robot
        pose, rate, change = (np.zeros((len(t), len(robot.pose_names))) for _ in range(3))
        for k, amplitude in enumerate(self.amplitudes):
            assert self.phase is not None  # noqa: S101  shaped() gives it
            when, first, second = self.phase.find_earlier_times(t, k * np.pi)
            own = super().sample(when)
            jacobian = robot.jacobian(own.q)
            own_rate = (jacobian @ own.qd[..., None])[..., 0]
            own_change = robot.pose_acceleration(own.q, own.qd, own.qdd)
            pose += amplitude * own.pose
            rate += amplitude * own_rate * first[:, None]
            change += amplitude * (own_change * (first**2)[:, None] + own_rate * second[:, None])
        if robot.has_masses:
            found = inverse_dynamics_at_pose(self.carried[0].robot, pose, rate, change, self.wrench)
            q, qd, qdd, effort = found.q, found.qd, found.qdd, found.tau
        else:
            q, effort = robot.inverse(pose), None
            qd, qdd = joint_rates(robot, q, rate, change)
        speed = np.linalg.norm(reference_velocity(robot, q, qd), axis=1)
        return Samples(t, q, qd, qdd, effort, pose, speed, speed)


def shaped(
    motion: TimedPath,
    shaper: str,
    frequency: Callable[[Array], Array] | None = None,
    damping: float | None = None,
    *,
    singularity: float = 0.01,
) -> ShapedPath:
    """Shape a motion so that it leaves the first mode at rest at every stop.

    Each stretch takes half (``zv``) or one (``zvd``) damped vibration more. ``zvd`` tolerates more
    error of the frequency. Corners that are not stops become a little rounder. Where the shaped
    motion would pass a limit, the whole is slowed down.

    :param frequency: natural frequencies (k,), Hz, of poses (k, m); default the robot's first,
        actuators locked.
    :param damping: ratio of the mode, 0 or above and below 1; default by the robot's file.
    :param singularity: least singularity index of the shaped motion, 0 to 1.
    :raises ParameterError: no such shaper, damping or frequency, or limits that cannot be kept.
    """
    if shaper not in HALF_PERIODS:
        raise UnknownNameError("shaper", shaper, tuple(HALF_PERIODS))
    if len(motion.carried) > 1:
        raise ParameterError("shaper", shaper, "one payload on the whole path")
    robot = motion.robot
    if frequency is None:

        def frequency(poses: Array) -> Array:
            return natural_frequencies(robot, poses, 1)[..., 0]

    damping = float(damping_ratios(robot, damping, 1)[0]) if damping is None else damping
    if not 0.0 <= damping < 1.0:
        raise ParameterError("damping", damping, "0 or above and below 1")
    root = float(np.sqrt(1.0 - damping**2))
    weights = np.array([1.0, 1.0] if shaper == "zv" else [1.0, 2.0, 1.0])
    weights *= float(np.exp(-np.pi * damping / root)) ** np.arange(len(weights))
    amplitudes = tuple((weights / weights.sum()).tolist())

    plain = motion
    for _ in range(MAX_SLOWDOWNS):
        looked, tails = plain, np.zeros(len(plain.runs))
        # Frequencies of the motion, then of the shaped one.
        for _ in range(3):
            # The shaped motion passes its poses later, which changes the frequencies over time.
            spans = zip(looked.begins, looked.runs, tails, strict=True)
            times = np.concatenate(
                [begin + np.linspace(0.0, run.duration + tail, POSES_PER_STRETCH) for begin, run, tail in spans]
            )
            times = times[np.diff(times, prepend=-1.0) > MIN_TIME_STEP]
            undamped = np.asarray(frequency(looked.sample(times).pose), np.float64)
            if not (np.isfinite(undamped).all() and (undamped > 0.0).all()):
                raise ParameterError("frequency", undamped.tolist(), "finite numbers above 0, Hz")
            rate = 2.0 * np.pi * root * undamped
            phase = Phase(times, rate)
            # All delayed copies end before the next stretch begins.
            rests, end = [plain.rests[0]], 0.0
            for run, rest in zip(plain.runs, plain.rests[1:], strict=True):
                end += rests[-1] + run.duration
                arrived = phase.find_earlier_times(np.array([end]), -HALF_PERIODS[shaper] * np.pi)[0]
                rests.append(float(arrived[0]) - end + rest)
            base = replace(plain, rests=tuple(rests))
            tails = np.array(base.rests[1:]) - plain.rests[1:]
            low, high = float(rate.min()), float(rate.max())
            looked = result = ShapedPath(
                **{field.name: getattr(base, field.name) for field in fields(TimedPath)},
                phase=phase,
                amplitudes=amplitudes,
                shaper=shaper,
                frequencies=(low / root / (2.0 * np.pi), high / root / (2.0 * np.pi)),
                added=base.duration - motion.duration,
            )
        over = max(result.worst.values(), default=0.0)
        if over <= 1.0 + 1e-9:
            fine = result.fine
            distance = np.cumsum(fine.speed * np.diff(fine.time, prepend=0.0))
            check_positions(motion.robot, distance, fine.q, 0.0)
            check_singularity(motion.robot, distance, fine.q, singularity)
            return result
        plain = replace(plain, runs=tuple(run.slower(over) for run in plain.runs))
    raise ParameterError("motion", f"{shaper} passes its limits", "wider limits, or no shaper")
