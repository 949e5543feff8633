# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Iterations on closures that are not compiled whole: Newton, and Levenberg and Marquardt.

Values, columns and steps are of unit one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array

Look = Callable[[Array], tuple[Array, Array]]
"""Of a state the values, shape (rows,), and their derivatives, shape (rows, rates)."""
Move = Callable[[Array, Array], Array]
"""A state after a step of rates."""

RANK: Final = 1e-9
"""Part of a matrix's largest singular value below which one counts as zero."""
MAX_ITERATIONS: Final = 12
DAMPING: Final = 1e-6
ROUNDING: Final = 1e-14
"""Part of a matrix's largest entry below which its pivots are rounding."""
MAX_STEP: Final = 0.2


def newton(x: Array, look: Look, move: Move) -> Array | None:
    """Solve for the state where all values vanish; None unless each step halves the last one."""
    last = np.inf
    for _ in range(MAX_ITERATIONS):
        values, table = look(x)
        if not (np.isfinite(values).all() and np.isfinite(table).all()):
            return None
        step = np.asarray(np.linalg.lstsq(table, -values, rcond=RANK)[0], np.float64)
        size = float(np.abs(step).max(initial=0.0))
        if not size < 0.5 * last:
            return None
        x = move(x, step)
        if size < 1e-12:
            return x if float(np.abs(values).max(initial=0.0)) < 1e-9 else None
        last = max(size, 1e-13)
    return None


def least_squares(x: Array, look: Look, move: Move, iterations: int) -> Array | None:
    """Return the values of least squares after damped steps; None if one is not finite."""
    values, table = look(x)
    for _ in range(iterations):
        if not (np.isfinite(values).all() and np.isfinite(table).all()):
            return None
        with np.errstate(over="ignore"):
            damped = table.T @ table
        if not np.isfinite(damped).all():
            return None
        damped += max(DAMPING, ROUNDING * float(damped.max())) * np.eye(table.shape[1])
        step = np.asarray(np.linalg.solve(damped, -table.T @ values), np.float64)
        step *= min(1.0, MAX_STEP / max(float(np.abs(step).max(initial=0.0)), 1e-300))
        x = move(x, step)
        values, table = look(x)
    return values
