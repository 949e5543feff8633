# SPDX-License-Identifier: Apache-2.0
"""Rates, accelerations and torques of a recording as a node computes them, sample by sample."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import inverse_dynamics
from delta_dynamics.rest import friction_reach, moving_rates
from pkm_twin.apps.loads import by_load
from pkm_twin.apps.recorded import Recording
from pkm_twin.errors import MessageError
from pkm_twin.streams.differentiator import Differentiator
from pkm_twin.streams.rest import SIGMAS, fit_gain, noise, rate_doubt

Array = NDArray[np.float64]
# Samples computed at a time, so that memory stays flat.
_BLOCK = 4096
# Of the differentiator: degree of the velocity's polynomial, samples.
_ORDER, _WINDOW = 3, 9


def predicted(r: Recording) -> tuple[Array, NDArray[np.bool_]]:
    """Efforts that the model expects (samples, n), zero where its window is not full; and where.

    Where a joint stands still dry friction has no direction, and the model none of it.
    """
    qd, qdd, used = motion(r)
    qd = moving_rates(qd, at_rest(r, qd), friction_reach(r.robot))
    wrench = np.zeros((len(r.time), 6)) if r.wrench is None else r.wrench
    efforts = np.zeros_like(r.q)
    for robot, part in by_load(r.robot, r.load, r.time, _BLOCK):
        rows = np.arange(part.start, part.stop)[used[part]]
        efforts[rows] = inverse_dynamics(robot, r.q[rows], qd[rows], qdd[rows], wrench[rows])
    return efforts, used


def at_rest(r: Recording, qd: Array) -> NDArray[np.bool_]:
    """Which joints stand still, shape (samples, n), as far as their rates ``qd`` can tell."""
    if r.qd is not None:
        return np.asarray(np.abs(qd) <= SIGMAS * noise(r.time, r.qd))
    if len(r.time) < 3:
        return np.zeros(r.q.shape, np.bool_)
    gain = fit_gain(_ORDER + 1, _WINDOW, _WINDOW // 2) / float(np.median(np.diff(r.time)))
    return np.asarray(np.abs(qd) <= rate_doubt(r.time, r.q, gain, _WINDOW // 2))


def motion(r: Recording) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Rates and accelerations (samples, n) by the differentiator's middle, and where they are.

    Those of a table that has both are taken as they are.
    """
    if r.qd is not None and r.qdd is not None:
        return r.qd, r.qdd, np.ones(len(r.time), bool)
    late = _WINDOW // 2
    differentiator = Differentiator(order=_ORDER, window=_WINDOW, middle=True)
    gap = 10 * float(np.median(np.diff(r.time))) if len(r.time) > 1 else 1.0
    qd, qdd = np.zeros_like(r.q), np.zeros_like(r.q)
    used = np.zeros(len(r.time), bool)
    for i, stamp in enumerate(r.stamps.tolist()):
        if i and r.time[i] - r.time[i - 1] > gap:
            differentiator.reset()
        try:
            rates = differentiator.push(stamp, r.q[i], None if r.qd is None else r.qd[i])
        except MessageError:  # stamps too uneven here
            continue
        if rates is not None:
            used[i - late], qd[i - late], qdd[i - late] = True, *rates
    return qd, qdd, used
