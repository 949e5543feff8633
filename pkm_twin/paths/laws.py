# SPDX-License-Identifier: Apache-2.0
"""Time laws of a path from rest to rest: a quintic, or an S-curve of limited jerk."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.paths.constraints import Forces, Limits
from pkm_twin.paths.joint_path import JointPath
from pkm_twin.paths.motion import moving, needs_forces

Index = NDArray[np.int64]
Law = Callable[[Array], tuple[Array, Array, Array]]


def quintic(t: Array) -> tuple[Array, Array, Array]:
    """Way, rate and acceleration at parts t of the duration; both derivatives 0 at the ends."""
    way = t**3 * (10.0 + t * (-15.0 + 6.0 * t))
    return way, 30.0 * t**2 * (1.0 - t) ** 2, 60.0 * t * (1.0 - t) * (1.0 - 2.0 * t)


def s_curve(cruise: float, smooth: float) -> Law:
    """The same of seven parts of constant jerk.

    :param cruise: part of the duration at even speed, 0 to below 1.
    :param smooth: part of each ramp in which its acceleration changes, above 0 to 1.
    """
    ramp = 0.5 * (1.0 - cruise)
    change, even = 0.5 * smooth * ramp, (1.0 - smooth) * ramp
    top = 1.0 / (ramp + cruise)
    jerk = top / (ramp - change) / change * np.array([1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0])
    steps = np.array([change, even, change, cruise, change, even, change])
    edges = np.concatenate([[0.0], np.cumsum(steps)])
    starts = np.zeros((8, 3))
    for k, h in enumerate(steps):
        s, v, a = starts[k]
        starts[k + 1] = (
            s + v * h + a * h**2 / 2 + jerk[k] * h**3 / 6, v + a * h + jerk[k] * h**2 / 2,
            a + jerk[k] * h,
        )  # fmt: skip

    def law(t: Array) -> tuple[Array, Array, Array]:
        k = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, 6)
        h, (s, v, a) = t - edges[k], starts[k].T
        way = s + v * h + a * h**2 / 2 + jerk[k] * h**3 / 6
        return way, v + a * h + jerk[k] * h**2 / 2, a + jerk[k] * h

    return law


HALVINGS: Final = 60
"""Steps of the search for the time of a place."""
SHORTEST: Final = 1e-6
"""Duration of a stretch that nothing limits, s."""
LAWS: Final[Mapping[str, Sequence[Law]]] = {
    "quintic": (quintic,),
    "s-curve": tuple(
        s_curve(cruise, smooth)
        for cruise in (0.0, 0.15, 0.3, 0.45, 0.6, 0.75)
        for smooth in (0.3, 0.5, 0.75, 1.0)
    ),
}
"""Laws by name: of several the one that is fastest within the limits."""


@dataclass(frozen=True)
class LawRun:
    """One stretch of a path in time by a law."""

    part: JointPath
    law: Law
    duration: float

    @cached_property
    def ends(self) -> Array:
        """Times of the intervals' ends, shape (i + 1,), s."""
        way = self.part.ends / self.part.ends[-1]
        low, high = np.zeros(len(way)), np.ones(len(way))
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            before = self.law(middle)[0] < way
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        high[0], high[-1] = 0.0, 1.0
        return self.duration * high

    @property
    def times(self) -> Array:
        """The same."""
        return self.ends

    def profile(self) -> Array:
        """v^2 at the intervals' ends, shape (i + 1,)."""
        rate = self.law(self.times / self.duration)[1]
        return np.asarray((self.part.ends[-1] * rate / self.duration) ** 2)

    def slower(self, factor: float) -> LawRun:
        """The same with ``factor`` times the duration."""
        return LawRun(self.part, self.law, self.duration * factor)

    def at(self, time: Array) -> tuple[Index, Array, Array, Array]:
        """Interval, part of it, v and u at times (k,)."""
        ends, length = self.part.ends, float(self.part.ends[-1])
        way, rate, change = self.law(np.clip(time / self.duration, 0.0, 1.0))
        s = length * way
        k = np.clip(np.searchsorted(ends, s, side="right") - 1, 0, len(ends) - 2)
        part = np.clip((s - ends[k]) / self.part.steps[k], 0.0, 1.0)
        return k, part, length * rate / self.duration, length * change / self.duration**2


def shortest(part: JointPath, law: Law, limits: Limits, wrench: Array | None) -> LawRun:
    """A stretch by a law, the shortest within the limits at as many times as it has points."""
    run = LawRun(part, law, 1.0)
    time = np.linspace(0.0, 1.0, len(part.ends))
    interval, share, v, u = run.at(time)
    _, qd, qdd = part.motion(interval, share, v, u)
    jerk = np.gradient(qdd, time, axis=0)
    travel = moving(run, time).felt
    duration = max(
        float((np.abs(qd) / limits.velocity).max()),
        float((travel / limits.speed).max()),
        float((np.abs(qdd) / limits.acceleration).max()) ** (1 / 2),
        float((np.abs(jerk) / limits.jerk).max()) ** (1 / 3),
    )
    if needs_forces(part, limits):
        forces = Forces.of(part, part.left[interval], *part.between(interval, share), wrench)
        square = forces.a * u[:, None] + forces.b * (v**2)[:, None]
        linear, fixed = forces.w * v[:, None], forces.g + forces.k
        for sign in (1.0, -1.0):
            rest = limits.effort - sign * fixed
            if (rest <= 0.0).any():
                row, column = np.argwhere(rest <= 0.0)[0]
                raise ParameterError(
                    f"path: effort of {part.curve.robot.joint_names[column]} at rest",
                    float(fixed[row, column]), f"below {limits.effort[column]:g}",
                )  # fmt: skip
            # square y^2 + linear y <= rest, y = 1 / duration.
            root = np.sqrt(np.maximum((sign * linear) ** 2 + 4.0 * sign * square * rest, 0.0))
            hits = (sign * linear) ** 2 + 4.0 * sign * square * rest >= 0.0
            slowest = np.where(hits, (sign * linear + root) / (2.0 * rest), 0.0)
            duration = max(duration, float(slowest.max()))
    return run.slower(max(duration, SHORTEST))
