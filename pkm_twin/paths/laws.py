# SPDX-License-Identifier: Apache-2.0
"""Time laws of a path from rest to rest: a quintic, or an S-curve of limited jerk.

May import: numpy, pkm_twin's core, the standard library, this package; never rclpy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import ParameterError
from pkm_twin.machine.robot import Robot
from pkm_twin.paths.constraints import Forces, Limits
from pkm_twin.paths.joint_path import JointPath
from pkm_twin.paths.motion import needs_forces

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Law = Callable[[Array], tuple[Array, Array, Array]]


def quintic(t: Array) -> tuple[Array, Array, Array]:
    """Way, rate and acceleration at parts t of the duration; both derivatives 0 at the ends."""
    way = t**3 * (10.0 + t * (-15.0 + 6.0 * t))
    return way, 30.0 * t**2 * (1.0 - t) ** 2, 60.0 * t * (1.0 - t) * (1.0 - 2.0 * t)


_EDGES: Final = np.array([0.0, 1.0, 2.0, 3.0, 5.0, 6.0, 7.0, 8.0]) / 8.0
_JERKS: Final = 51.2 * np.array([1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0])
"""Seven parts, the middle one at even speed; 51.2 makes the way 1."""


def _s_curve_starts() -> Array:
    rows = [np.zeros(3)]
    for jerk, h in zip(_JERKS, np.diff(_EDGES), strict=True):
        s, v, a = rows[-1]
        rows.append(
            np.array([s + v * h + a * h**2 / 2 + jerk * h**3 / 6, v + a * h + jerk * h**2 / 2,
                      a + jerk * h])
        )  # fmt: skip
    return np.array(rows)


_STARTS: Final = _s_curve_starts()


def s_curve(t: Array) -> tuple[Array, Array, Array]:
    """The same of seven parts of constant jerk, an eighth of the duration each, the middle two."""
    k = np.clip(np.searchsorted(_EDGES, t, side="right") - 1, 0, 6)
    h, jerk = t - _EDGES[k], _JERKS[k]
    s, v, a = _STARTS[k].T
    way = s + v * h + a * h**2 / 2 + jerk * h**3 / 6
    return way, v + a * h + jerk * h**2 / 2, a + jerk * h


LAWS: Final[Mapping[str, Law]] = {"quintic": quintic, "s-curve": s_curve}


@dataclass(frozen=True)
class LawRun:
    """One stretch of a path in time by a law."""

    part: JointPath
    law: Law
    duration: float

    @cached_property
    def times(self) -> Array:
        """As many times as the path has points, shape (i + 1,), s."""
        return np.linspace(0.0, self.duration, len(self.part.left) + 1)

    def profile(self) -> Array:
        """v^2 at the intervals' ends, shape (i + 1,)."""
        s = np.append(self.part.s[self.part.left], self.part.s[-1])
        t = np.linspace(0.0, 1.0, 20 * len(s))
        way, rate, _ = self.law(t)
        return np.asarray((np.interp(s, s[-1] * way, s[-1] * rate) / self.duration) ** 2)

    def slower(self, factor: float) -> LawRun:
        """The same with ``factor`` times the duration."""
        return LawRun(self.part, self.law, self.duration * factor)

    def at(self, time: Array) -> tuple[Index, Array, Array, Array]:
        """Interval, part of it, v and u at times (k,)."""
        begins = self.part.s[self.part.left]
        length = float(self.part.s[-1])
        way, rate, change = self.law(np.clip(time / self.duration, 0.0, 1.0))
        s = length * way
        k = np.clip(np.searchsorted(begins, s, side="right") - 1, 0, len(begins) - 1)
        part = np.clip((s - begins[k]) / self.part.steps[k], 0.0, 1.0)
        return k, part, length * rate / self.duration, length * change / self.duration**2


def shortest(
    robot: Robot, part: JointPath, law: Law, limits: Limits, wrench: Array | None
) -> LawRun:
    """A stretch by a law, as short as the limits let it be."""
    run = LawRun(part, law, 1.0)
    interval, share, v, u = run.at(run.times)
    q, first, second = part.between(interval, share)
    qd = first * v[:, None]
    qdd = first * u[:, None] + second * (v**2)[:, None]
    jerk = np.gradient(qdd, run.times, axis=0)
    left = part.left[interval]
    travel = v * ((1.0 - share) * part.travel[left] + share * part.travel[left + 1])
    duration = max(
        float((np.abs(qd) / limits.velocity).max()),
        float((travel / limits.speed).max()),
        float((np.abs(qdd) / limits.acceleration).max()) ** (1 / 2),
        float((np.abs(jerk) / limits.jerk).max()) ** (1 / 3),
    )
    if needs_forces(robot, limits):
        load = None if wrench is None else np.broadcast_to(wrench, (len(q), 6))
        forces = Forces.of(robot, q, first, second, load)
        square = forces.a * u[:, None] + forces.b * (v**2)[:, None]
        linear, fixed = forces.w * v[:, None], forces.g + forces.k
        for sign in (1.0, -1.0):
            rest = limits.effort - sign * fixed
            if (rest <= 0.0).any():
                row, column = np.argwhere(rest <= 0.0)[0]
                raise ParameterError(
                    f"path: effort of {robot.joint_names[column]} at rest",
                    float(fixed[row, column]), f"below {limits.effort[column]:g}",
                )  # fmt: skip
            # square y^2 + linear y <= rest, y = 1 / duration.
            root = np.sqrt(np.maximum((sign * linear) ** 2 + 4.0 * sign * square * rest, 0.0))
            hits = (sign * linear) ** 2 + 4.0 * sign * square * rest >= 0.0
            slowest = np.where(hits, (sign * linear + root) / (2.0 * rest), 0.0)
            duration = max(duration, float(slowest.max()))
    return run.slower(duration)
