# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Integrate second-order equations by Runge-Kutta steps that are exact in a linear damping.

The exponential method of order four of Cox and Matthews (2002, Exponential time differencing for
stiff systems) for q' = v, v' = n(q, v) - d v with d >= 0; without damping it is the classical
method for second-order equations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for

from pkm_twin.codegen.arrays import Array


class Stepper:
    """Apply the method for one span of time.

    :param weights: see :func:`_damped_weights`; matrices, shape (11, n, n), with damping.
    :param damping: shape (n, n), 1/s; None without damping.
    """

    def __init__(self, weights: Any, damping: Array | None = None) -> None:
        """Store the method's weights and the damping; without it weights apply element by element."""
        self._weights, self._damping = weights, damping
        self._multiply: Callable[..., Any] = np.multiply if damping is None else np.matmul

    def run(self, q: Array, v: Array, accelerations: Callable[[Array, Array], Array]) -> tuple[Array, Array]:
        """Return positions and velocities at the end, shape (n,) each.

        :param accelerations: called four times with positions and velocities; includes damping.
        """
        multiply, damping = self._multiply, self._damping
        half, drift, lift, whole, far, v0, v1, v2, q0, q1, q2 = self._weights

        def undamped_part(q: Array, v: Array) -> Array:
            a = accelerations(q, v)
            return a if damping is None else a + damping @ v

        def move_half(q: Array, v: Array, n: Array) -> tuple[Array, Array]:
            return q + multiply(drift, v) + multiply(lift, n), multiply(half, v) + multiply(drift, n)

        first = undamped_part(q, v)
        a = move_half(q, v, first)
        second = undamped_part(*a)
        third = undamped_part(*move_half(q, v, second))
        fourth = undamped_part(*move_half(*a, 2.0 * third - first))
        inner = second + third
        return (
            q + multiply(far, v) + multiply(q0, first) + multiply(q1, inner) + multiply(q2, fourth),
            multiply(whole, v) + multiply(v0, first) + multiply(v1, inner) + multiply(v2, fourth),
        )


@lru_cache(64)
def make_undamped_stepper(span: float) -> Stepper:
    """Return the classical method of order four."""
    return Stepper(_undamped_weights(span))


def make_damped_stepper(span: float, modes: Array, to_modes: Array, decays: Array) -> Stepper:
    """Return the method of order four that integrates viscous damping exactly.

    :param modes: of the damping, columns, shape (n, r); other directions are undamped.
    :param to_modes: from rates to modes, shape (r, n).
    :param decays: of the modes, 1/s, shape (r,).
    """
    plain = np.array(_undamped_weights(span))
    # The method's weights for each damped mode, shape (11, r).
    z = -span * decays
    near, far = evaluate_phi(0.5 * z), evaluate_phi(z)

    def stage_weights(k: int) -> list[Array]:
        a, b, c = far[k : k + 3]
        return [a - 3.0 * b + 4.0 * c, 2.0 * (b - 2.0 * c), 4.0 * c - b]

    rows = [near[0], 0.5 * span * near[1], 0.25 * span * span * near[2], far[0], span * far[1]]
    rows += [span * row for row in stage_weights(1)]
    rows += [span * span * row for row in stage_weights(2)]
    deltas = np.array(rows) - plain[:, None]
    weights = plain[:, None, None] * np.eye(len(modes)) + (modes * deltas[:, None, :]) @ to_modes
    return Stepper(weights, (modes * decays) @ to_modes)


def _undamped_weights(h: float) -> list[float]:
    """Return the weights of :func:`_damped_weights` without damping."""
    sixth = h / 6.0
    return [1.0, 0.5 * h, h * h / 8.0, 1.0, h, sixth, 2.0 * sixth, sixth, h * sixth, h * sixth, 0.0]


def evaluate_phi(z: Array) -> list[Array]:
    """Return the functions phi_0 = exp to phi_4 of non-positive numbers, shape (r,) each.

    phi_k(z) = z phi_(k+1)(z) + 1 / k!, so k! phi_k is Kummer's function M(1, k + 1, z).
    """
    more = (scipy.special.hyp1f1(1.0, k + 1.0, z) / math.factorial(k) for k in range(1, 5))
    return [np.exp(z), *(np.asarray(one, np.float64) for one in more)]
