# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Newton's method in numpy, on constraint equations that are not compiled as a whole.

Values, derivatives and steps are dimensionless; states may be batches.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeVar

import numpy as np

from pkm_twin.codegen.arrays import Array

S = TypeVar("S")

RELATIVE_RANK_TOLERANCE: Final = 1e-9
"""Singular values below this fraction of the largest count as zero."""
MAX_ITERATIONS: Final = 12
MAX_STEP: Final = 0.2
"""Largest damped step, rad or relative to the machine's size: the linearisation holds about so far."""
MAX_VALUE: Final = 1e-9
"""Largest residual of an equation that counts as satisfied."""


def solve_least_norm(table: Array, values: Array) -> Array:
    """Return the shortest step that reduces the linearised values as far as possible."""
    return np.asarray(np.linalg.lstsq(table, -values, rcond=RELATIVE_RANK_TOLERANCE)[0], np.float64)


def solve_damped(table: Array, values: Array) -> Array:
    """Return the least-squares step with Levenberg's damping, at most MAX_STEP; NaN if too large."""
    with np.errstate(over="ignore"):
        square = table.T @ table
    if not np.isfinite(square).all():
        return np.full(table.shape[1], np.nan)
    # A damping below 1e-14 of the largest entry would be lost in its rounding.
    square += max(1e-6, 1e-14 * float(square.max())) * np.eye(table.shape[1])
    step = np.asarray(np.linalg.solve(square, -table.T @ values), np.float64)
    return step * min(1.0, MAX_STEP / max(float(np.abs(step).max(initial=0.0)), 1e-300))


def newton(
    x: S,
    evaluate: Callable[[S], tuple[Array, Any]],
    move: Callable[[S, Array], S],
    solve: Callable[[Any, Array], Array] = solve_least_norm,
    *,
    iterations: int = MAX_ITERATIONS,
    gain: float = 0.5,
    tolerance: float = 1e-12,
    most: float = MAX_VALUE,
) -> tuple[S, bool]:
    """Solve for a state in which all values vanish; return the last state, and whether they vanish.

    :param evaluate: returns the residuals in a state, and their derivatives for ``solve``.
    :param move: returns the state after a step of rates.
    :param solve: returns the step that cancels the residuals, from derivatives and residuals.
    :param gain: end if a step is longer than this fraction of the step before.
    :param tolerance: end after a step shorter than this. ``most``: largest value that then counts
        as zero.
    """
    last = np.inf
    for _ in range(iterations):
        values, table = evaluate(x)
        if not np.isfinite(values).all():
            break
        step = solve(table, values)
        size = float(np.abs(step).max(initial=0.0))
        if not size < gain * last:
            break
        x = move(x, step)
        if size < tolerance:
            return x, float(np.abs(values).max(initial=0.0)) < most
        last = max(size, 0.1 * tolerance)
    return x, False
