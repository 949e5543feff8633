# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Interpolate a joint trajectory as joint_trajectory_controller does."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.messages.reading import Trajectory


@dataclass(frozen=True)
class Setpoint:
    """The setpoint at one time, shape (n,) each; effort zero if the trajectory has none."""

    q: Array
    qd: Array
    effort: Array


@dataclass(frozen=True)
class JointPath:
    """A joint trajectory with polynomials between its points.

    Their degree is five if the points have velocities and accelerations, three with velocities
    alone, else one. Efforts are interpolated linearly. Before the first and after the last point
    the joints stand still.
    """

    points: Trajectory

    @property
    def duration(self) -> float:
        """Time of the last point, s."""
        return float(self.points.times[-1])

    def start_from(self, q: Array) -> JointPath:
        """Add a point at rest at q, shape (n,), at time 0 unless the path has a point there."""
        p = self.points
        if p.times[0] == 0.0:
            return self

        def prepend_first(values: Array | None, first: Array) -> Array | None:
            """Put the first row in front of the values; None stays None."""
            return None if values is None else np.vstack([first, values])

        rest = np.zeros_like(q)
        return JointPath(
            dataclasses.replace(
                p,
                times=np.concatenate([[0.0], p.times]),
                q=np.vstack([q, p.q]),
                qd=prepend_first(p.qd, rest),
                qdd=prepend_first(p.qdd, rest),
                effort=None if p.effort is None else np.vstack([p.effort[:1], p.effort]),
            )
        )

    def at(self, time: float) -> Setpoint:
        """Return the setpoint at ``time`` after the start, s."""
        p = self.points
        end = len(p.times) - 1
        after = int(np.searchsorted(p.times, time, side="right"))
        if after in (0, end + 1):
            k = min(after, end)
            effort = np.zeros_like(p.q[k]) if p.effort is None else p.effort[k]
            return Setpoint(p.q[k], np.zeros_like(p.q[k]), effort)
        before = after - 1
        span = float(p.times[after] - p.times[before])
        t = (time - float(p.times[before])) / span
        q, qd = _interpolate(p, before, after, span, t)
        if p.effort is None:
            return Setpoint(q, qd, np.zeros_like(q))
        return Setpoint(q, qd, (1.0 - t) * p.effort[before] + t * p.effort[after])


def _interpolate(p: Trajectory, a: int, b: int, span: float, t: float) -> tuple[Array, Array]:
    """Interpolate by Hermite polynomials at fraction t of the time from point a to b."""
    d = p.q[b] - p.q[a]
    if p.qd is None:
        return p.q[a] + t * d, d / span
    u, v = p.qd[a] * span, p.qd[b] * span
    if p.qdd is None:
        c = [p.q[a], u, 3.0 * d - 2.0 * u - v, -2.0 * d + u + v]
    else:
        x, y = p.qdd[a] * span**2, p.qdd[b] * span**2
        c = [
            p.q[a],
            u,
            0.5 * x,
            10.0 * d - 6.0 * u - 4.0 * v - 1.5 * x + 0.5 * y,
            -15.0 * d + 8.0 * u + 7.0 * v + 1.5 * x - y,
            6.0 * d - 3.0 * (u + v) - 0.5 * (x - y),
        ]
    q, slope = np.zeros_like(d), np.zeros_like(d)
    for coefficient in reversed(c):
        slope = slope * t + q
        q = q * t + coefficient
    return q, slope / span
