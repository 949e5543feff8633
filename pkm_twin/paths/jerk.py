# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find the fastest profile with limits on the joints' jerk, by a sequence of linear programs.

A joint's jerk is v (q' du/ds + 3 q'' u + q''' x) with x = v^2, so a limit J on it is a bound
J / sqrt(x) on what is linear in x. That bound is convex: its tangent at a profile that keeps the
limit is stricter, so every program's result keeps it too, and each is at least as fast as the one
before. It starts from a quintic.
"""

from __future__ import annotations

from itertools import product
from typing import Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for

from pkm_twin.codegen.arrays import Array
from pkm_twin.paths.constraints import Limits, Rows
from pkm_twin.paths.joint_path import Index, JointPath
from pkm_twin.paths.motion import Run
from pkm_twin.paths.profile import make_interval_rows

MAX_PROGRAMS: Final = 20
"""Largest number of linear programs."""


def smooth_profile(
    part: JointPath,
    rows: Rows,
    limits: Limits,
    start: Array,
    share: Array,
    jerks: Array,
    programs: int = MAX_PROGRAMS,
) -> Array | None:
    """Find the largest x at the intervals' ends, (i + 1,), within the joints' jerk limits.

    Returns None if no program has a solution.

    :param start: a profile that keeps the limits, shape (i + 1,).
    :param share: fraction of each interval's limits to use, shape (i,); ``jerks``: of jerk limits.
    :param programs: most linear programs that improve it.
    """
    # Scale time so that the start's largest speed is 1.
    unit = float(start.max())
    jerk = limits.jerk / unit**1.5
    rows = Rows(
        rows.alpha * unit,
        rows.beta * unit,
        rows.viscous * np.sqrt(unit),
        rows.fixed,
        rows.dry,
        rows.most / unit,
    )
    h = part.steps
    best, x = np.inf, start / unit
    # Bounds next to a stop by the jerk: from rest s = jerk t^3 / 6 and v = jerk t^2 / 2.
    by_rest = np.full(len(x), np.inf)
    by_rest[[0, -1]] = 0.0
    for k, step, at in ((1, h[0], 0), (-2, h[-1], -1)):
        least = float((jerk / np.maximum(np.abs(part.first[at]), 1e-300)).min())
        by_rest[k] = min(by_rest[k], 0.25 * least ** (2 / 3) * (6.0 * step) ** (4 / 3))
    count = slower = 0
    while count < programs:
        p, q, low, high, most = make_interval_rows(rows, part.left, h, x, share)
        number, column = np.arange(p.size), np.repeat(np.arange(len(p)), p.shape[1])
        # low <= p x + q x' <= high
        own = _sparse_matrix([(p, number, column), (q, number, column + 1)], (p.size, len(x)))
        more, top = _jerk_rows(part, jerk, h, x, jerks)
        v = np.sqrt(np.maximum(x, 1e-12 * x.max()))
        weight = np.zeros(len(x))
        change = h / (v[:-1] + v[1:]) ** 2
        weight[:-1] += change / v[:-1]
        weight[1:] += change / v[1:]
        answer = scipy.optimize.linprog(
            -weight / weight[1:-1].max(),
            A_ub=scipy.sparse.vstack([own, -own, more]).tocsr(),
            b_ub=np.concatenate([high.ravel(), -low.ravel(), top]),
            bounds=np.stack([np.zeros(len(x)), np.minimum(most, by_rest)], 1),
            method="highs",
        )
        if answer.status != 0 and count == 0 and slower < 6:
            # A slower profile has smaller jerks, so that its linearised bounds are feasible.
            x, slower = 0.25 * x, slower + 1
            continue
        if answer.status != 0 and count == 0:
            return None
        new = np.maximum(answer.x, 0.0) if answer.status == 0 else x
        v = np.sqrt(new)
        duration = float(np.sum(2.0 * h / np.maximum(v[:-1] + v[1:], 1e-300)))
        if not duration < best:
            break
        settled = duration > best * (1.0 - 1e-4)
        best, x, count = duration, new, count + 1
        if settled:
            break
    # The machine does not stop inside a stretch.
    x[1:-1] = np.maximum(x[1:-1], 1e-9 * x.max())
    return unit * x


def _sparse_matrix(rows: list[tuple[Array, Index, Index]], shape: tuple[int, int]) -> scipy.sparse.csr_matrix:
    """Return the sparse matrix of triplets (values, rows, columns)."""
    values, row, column = (np.concatenate([np.ravel(r[k]) for r in rows]) for k in range(3))
    return scipy.sparse.coo_matrix((values, (row, column)), shape=shape).tocsr()


def _jerk_rows(part: JointPath, jerk: Array, h: Array, x: Array, share: Array) -> tuple[scipy.sparse.csr_matrix, Array]:
    """Write the jerk limits at points between two intervals, linearised about a profile."""
    used, left = np.isfinite(jerk), part.left
    # Derivatives of the path as fractions of the limits; the third jumps where two pieces meet.
    third = (part.second[left + 1] - part.second[left]) / part.steps[:, None]
    second = 0.5 * (part.second[left[1:]] + part.second[left[:-1] + 1])
    first, second, third = (rows[:, used] / jerk[used] for rows in (part.first[left[1:]], second, third))
    most = np.minimum(share[1:], share[:-1])[:, None]
    count, width = first.shape
    before, behind = h[:-1][:, None], h[1:][:, None]
    middle = 0.5 * (before + behind)
    # u before and behind the point, from x in front, at and after it.
    back = (-0.5 / before, 0.5 / before)
    on = (-0.5 / behind, 0.5 / behind)
    slope = first / middle
    mean = 1.5 * second
    front = back[0] * (-slope + mean)
    here = back[1] * (-slope + mean) + on[0] * (slope + mean)
    after = on[1] * (slope + mean)
    about = np.maximum(x[1:-1], 1e-9 * x.max())[:, None]
    tangent = 0.5 * most / about**1.5
    top = 1.5 * most / np.sqrt(about)
    point = np.repeat(np.arange(count), width)
    made: list[tuple[Array, Index, Index]] = []
    at = 0
    for sign, side in product((1.0, -1.0), (third[:-1], third[1:])):
        number = at + np.arange(count * width)
        made.append((sign * front, number, point))
        made.append((sign * (here + side) + tangent, number, point + 1))
        made.append((sign * after, number, point + 2))
        at += count * width
    bound = np.ravel(np.broadcast_to(top, (count, width)))
    return _sparse_matrix(made, (at, len(x))), np.tile(bound, 4)


def smooth_run(part: JointPath, x: Array) -> Run | None:
    """Convert a profile to a run that never moves backwards; None if none is found.

    Where the machine nearly stops, linear accelerations may give negative speeds: the profile is
    raised there.
    """
    x = x.copy()
    for count in range(20):
        knots, length, v, u = _integrate_profile(part, x)
        # The acceleration may change its sign within an interval, where the speed has a minimum.
        rises = (u[:-1] < 0.0) & (u[1:] > 0.0)
        dip = np.where(rises, -0.5 * u[:-1] ** 2 * np.diff(knots) / np.where(rises, np.diff(u), 1.0), 0.0)
        below = -np.minimum(np.minimum(v[:-1], v[1:]), v[:-1] + dip)
        # Raise the profile's point between the middles where the speed is negative.
        low = np.flatnonzero(below > 1e-12 * v.max())
        if not len(low):
            jerk = np.diff(u) / np.diff(knots)
            return Run(part, knots, np.stack([length[:-1], v[:-1], u[:-1] / 2, jerk / 6]))
        at = np.clip(low, 1, len(x) - 2)
        np.maximum.at(x, at, (np.sqrt(x[at]) + 1.5**count * below[low]) ** 2)
    return None


def _integrate_profile(part: JointPath, x: Array) -> tuple[Array, Array, Array, Array]:
    """Integrate a profile's mean accelerations, linear in time: times, length, v and u.

    Between points y = x^(3/4) is linear in s, as for constant jerk from rest. A smooth bump over
    the whole corrects the error of the final position and speed.
    """
    h = part.steps
    v, y = np.sqrt(x), x**0.75
    even = np.abs(np.diff(y)) < 1e-6 * np.maximum(y[:-1], y[1:])
    with np.errstate(divide="ignore", invalid="ignore"):
        curved = 3.0 * np.diff(np.cbrt(y)) * h / np.diff(y)
    span = np.where(even, 2.0 * h / np.maximum(v[:-1] + v[1:], 1e-300), curved)
    ends = np.concatenate([[0.0], np.cumsum(span)])
    times = np.concatenate([[0.0], 0.5 * (ends[1:] + ends[:-1]), ends[-1:]])
    u = np.concatenate([[0.0], np.diff(v) / span, [0.0]])
    t = times / times[-1]
    step = np.diff(times)

    def integrate_accelerations(u: Array) -> Array:
        return np.concatenate([[0.0], np.cumsum(0.5 * step * (u[1:] + u[:-1]))])

    bump = 6.0 * t * (1.0 - t)
    u = u - bump * integrate_accelerations(u)[-1] / integrate_accelerations(bump)[-1]
    v = integrate_accelerations(u)
    jerk = np.diff(u) / step
    length = np.cumsum(step * (v[:-1] + step * (u[:-1] / 2 + step * jerk / 6)))
    scale = float(part.s[-1]) / length[-1]
    return times, scale * np.append(0.0, length), scale * v, scale * u
