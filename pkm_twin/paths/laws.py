# SPDX-License-Identifier: Apache-2.0
"""Time laws of a path from rest to rest: a quintic, or an S-curve of limited jerk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.paths.constraints import Forces, Limits
from pkm_twin.paths.joint_path import JointPath
from pkm_twin.paths.motion import Run, moving, needs_forces


@dataclass(frozen=True, eq=False)
class Law:
    """A way from 0 to 1 in the time from 0 to 1, as :class:`Run` has it."""

    knots: Array
    way: Array

    def on(self, part: JointPath, duration: float) -> Run:
        """A stretch by this law, its duration in s."""
        return Run(part, self.knots, float(part.ends[-1]) * self.way).slower(duration)


QUINTIC: Final = Law(np.array([0.0, 1.0]), np.array([[0.0, 0.0, 0.0, 10.0, -15.0, 6.0]]).T)


def s_curve(cruise: float, smooth: float) -> Law:
    """Seven parts of constant jerk.

    :param cruise: part of the duration at even speed, 0 to below 1.
    :param smooth: part of each ramp in which its acceleration changes, above 0 to 1.
    """
    ramp = 0.5 * (1.0 - cruise)
    change, even = 0.5 * smooth * ramp, (1.0 - smooth) * ramp
    top = 1.0 / (ramp + cruise)
    jerk = top / (ramp - change) / change * np.array([1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0])
    steps = np.array([change, even, change, cruise, change, even, change])
    # A part of no duration is none.
    jerk, steps = jerk[steps > 0.0], steps[steps > 0.0]
    state, rows = np.zeros(3), []
    for h, j in zip(steps, jerk, strict=True):
        s, v, a = state
        rows.append((s, v, a / 2, j / 6))
        state = np.array(
            [s + v * h + a * h**2 / 2 + j * h**3 / 6, v + a * h + j * h**2 / 2, a + j * h]
        )
    return Law(np.concatenate([[0.0], np.cumsum(steps)]), np.array(rows).T)


SHORTEST: Final = 1e-6
"""Duration of a stretch that nothing limits, s."""
LAWS: Final[Mapping[str, Sequence[Law]]] = {
    "quintic": (QUINTIC,),
    "s-curve": tuple(
        s_curve(cruise, smooth)
        for cruise in (0.0, 0.15, 0.3, 0.45, 0.6, 0.75)
        for smooth in (0.3, 0.5, 0.75, 1.0)
    ),
}
"""Laws by name: of several the one that is fastest within the limits."""


def shortest(part: JointPath, law: Law, limits: Limits, wrench: Array | None) -> Run:
    """A stretch by a law, the shortest within the limits at as many times as it has points."""
    run = law.on(part, 1.0)
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
