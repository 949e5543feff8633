# SPDX-License-Identifier: Apache-2.0
"""Slow sweeps that show friction: each joint alone up and down its range, at several speeds.

At a steady speed weight and friction are all that a drive has to overcome: up and down differ by
twice the friction, and at three speeds a Stribeck law differs from viscous friction.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.excitation import SHRINK, Bounds, Judge, clear, position_range

SPEEDS: Final = (1.0, 4.0, 16.0)
"""Of the sweeps, over the slowest."""
RAMP: Final = 0.1
"""Part of a full traverse that is accelerated, at each end."""
LENGTH: Final = 4.0 + 6.0 * RAMP
"""Time of a sweep, by that of half a traverse."""
SHRINKINGS: Final = 30
"""How often a range that is not clear is made smaller."""
STATES: Final = 200
"""Of one sweep, at which limits are checked."""


@dataclass(frozen=True, eq=False)
class Sweeps:
    """Sweeps of every joint, one after the other, the other joints at their centres.

    ``reach``: half of each joint's travel, rad or m; ``speeds``: shape (n, speeds), rad/s or m/s.
    ``condition``: as of an :class:`~pkm_twin.identification.excitation.Excitation`.
    """

    centre: Array
    reach: Array
    speeds: Array
    condition: float = np.inf

    @property
    def lengths(self) -> Array:
        """Durations of the sweeps, s, shape (n, speeds): two half traverses and a whole one."""
        return np.asarray(LENGTH * self.reach[:, None] / self.speeds)

    @property
    def duration(self) -> float:
        """Of all sweeps, s."""
        return float(self.lengths.sum())

    def at(self, time: Array) -> tuple[Array, Array, Array]:
        """Positions, rates and accelerations, shape (k, n) each."""
        q = np.tile(self.centre, (len(time), 1))
        qd, qdd = np.zeros_like(q), np.zeros_like(q)
        start = 0.0
        for (j, k), length in np.ndenumerate(self.lengths):
            inside = (time >= start) & (time <= start + length)
            place, rate, change = _sweep(
                time[inside] - start, float(self.reach[j]), float(self.speeds[j, k])
            )
            q[inside, j] = self.centre[j] + place
            qd[inside, j], qdd[inside, j] = rate, change
            start += length
        return q, qd, qdd


def _sweep(time: Array, reach: float, speed: float) -> tuple[Array, Array, Array]:
    """From the centre up, down across and back, at rest in between: (k,) each."""
    ramp = RAMP * 2.0 * reach / speed
    result = np.zeros((3, len(time)))
    begin, place = 0.0, 0.0
    for distance, way in ((reach, 1.0), (2.0 * reach, -1.0), (reach, 1.0)):
        whole = distance / speed + ramp
        t = np.clip(time - begin, 0.0, whole)
        up, down = np.minimum(t, ramp), np.maximum(t - (whole - ramp), 0.0)
        wave = np.pi / ramp
        x = t - up + (0.5 * (up - np.sin(wave * up) / wave))
        x -= 0.5 * (down - np.sin(wave * down) / wave)
        v = 0.5 * (1.0 - np.cos(wave * up)) - 0.5 * (1.0 - np.cos(wave * down))
        a = 0.5 * wave * (np.sin(wave * up) - np.sin(wave * down))
        now = (time >= begin) & (time <= begin + whole)
        result[:, now] = (way * speed * np.stack([x, v, a]))[:, now]
        result[0, now] += place
        begin, place = begin + whole, place + way * distance
    return result[0], result[1], result[2]


def sweeps(judge: Judge, duration: float, bounds: Bounds | None = None) -> Sweeps:
    """Sweeps inside all limits.

    :param duration: s; longer where limits of velocity or acceleration ask for it.
    :raises PkmTwinError: a joint that cannot move alone.
    """
    robot, keep = judge.robot, bounds or Bounds()
    centre, reach = position_range(robot, keep.share)
    n, ratios = len(centre), np.array(SPEEDS)
    limits = robot.limits.velocity
    most = np.full(n, np.inf) if limits is None else keep.share * np.broadcast_to(limits, n)
    lengths = LENGTH * np.sum(1.0 / ratios) * n / duration

    def slowest(j: int) -> float:
        """Speed of the slowest sweep: by the duration, and the limits of the fastest one."""
        fastest = most[j]
        if keep.acceleration is not None:
            # A ramp of half a cosine has pi / 2 of its mean acceleration.
            change = keep.share * keep.acceleration
            fastest = min(fastest, np.sqrt(4.0 * RAMP * reach[j] * change / np.pi))
        return float(min(lengths * reach[j], fastest / ratios[-1]))

    for j in range(n):
        for _ in range(SHRINKINGS):
            alone = Sweeps(centre[j : j + 1], reach[j : j + 1], slowest(j) * ratios[None])
            ends = np.append(0.0, np.cumsum(alone.lengths))
            time = np.concatenate([np.linspace(*pair, STATES) for pair in pairwise(ends)])
            q = np.tile(centre, (len(time), 1))
            qd, qdd = np.zeros_like(q), np.zeros_like(q)
            q[:, j], qd[:, j], qdd[:, j] = (one[:, 0] for one in alone.at(time))
            if clear(robot, keep, q, qd, qdd, 1.0):
                break
            reach[j] *= SHRINK
        else:
            raise PkmTwinError(
                f"{robot.joint_names[j]} cannot move alone inside the limits; try a smaller "
                "--singularity or wider limits.position"
            )
    found = Sweeps(centre, reach, np.array([slowest(j) for j in range(n)])[:, None] * ratios)
    motion = found.at(np.linspace(0.0, found.duration, 3 * n * STATES))
    return Sweeps(centre, reach, found.speeds, judge.condition(*motion))
