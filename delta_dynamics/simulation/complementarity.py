# SPDX-License-Identifier: Apache-2.0
"""Forces within bounds that resist motions, and what finds them."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array

States = NDArray[np.int8]
"""By row: 0 a force that holds the row, 1 the greatest force, -1 the least one."""

TOLERANCE: Final = 1e-7
"""Of forces and motions, part of the greatest; above how exactly a change's time is found."""
BLOCKS: Final = 10
"""How often all that is wrong changes at once; then one row after the other, which ends."""
REGULAR: Final = 1e-11
"""What dependent rows are told apart by, part of the greatest diagonal element."""

DEPENDENT: Final = 1e-7
"""Length of a row without what earlier ones have of it, part of its own."""


def resisting(
    matrix: Array, motion: Array, low: Array, high: Array, states: States
) -> tuple[Array, States]:
    """Forces that resist motions: a linear complementarity problem with bounds.

    What is left of the motion, w = motion - matrix force, is zero where the force is between its
    bounds, positive or zero at the upper bound and negative or zero at the lower one: Coulomb's law
    with -low = high = friction, a stop with one bound infinite. By block pivoting (Judice and
    Pires 1994), which ends for every positive definite matrix.

    :param matrix: motions by forces, symmetric and not negative, shape (m, m).
    :param motion: without these forces, shape (m,).
    :param states: where the search begins, shape (m,).
    :returns: the forces and their states; of dependent rows those that are least.
    :raises ValueError: a value that is not finite.
    """
    diagonal = matrix.diagonal()
    widths = np.minimum(np.where(np.isfinite(high), high, 0.0), 1e300)
    size = float(np.abs(motion).max() + (diagonal * np.abs(widths)).max())
    if not np.isfinite(size):
        raise ValueError("the motion is not finite")
    wrong_motion = TOLERANCE * size
    wrong_force = wrong_motion / np.maximum(diagonal, 1e-300)
    regular = matrix + np.eye(len(motion)) * (REGULAR * diagonal.max())
    states = np.where(np.isinf(np.where(states > 0, high, low)), 0, states).astype(np.int8)
    for sweep in range(1000):
        force = np.where(states > 0, high, np.where(states < 0, low, 0.0))
        held = np.flatnonzero(states == 0)
        if len(held):
            rest = motion[held] - matrix[held] @ force
            force[held] = np.linalg.solve(regular[np.ix_(held, held)], rest)
        left = motion - matrix @ force
        turned = np.where(
            states == 0,
            (force > high + wrong_force).astype(np.int8) - (force < low - wrong_force),
            np.where(states * left < -wrong_motion, 0, states),
        ).astype(np.int8)
        changes = np.flatnonzero(turned != states)
        if not len(changes):
            return force, states
        if sweep >= BLOCKS:
            changes = changes[:1]
        states[changes] = turned[changes]
    raise ValueError("no forces resist this motion")


def independent(rows: Array, inverse: Array) -> list[int]:
    """Indices of the rows that depend on no earlier ones.

    :param rows: shape (m, n).
    :param inverse: of the mass matrix, in which they are compared, shape (n, n).
    """
    kept: list[int] = []
    basis: list[Array] = []
    for i, row in enumerate(rows):
        left = row
        for done in basis:
            left = left - (done @ inverse @ left) * done
        if left @ inverse @ left > DEPENDENT**2 * (row @ inverse @ row):
            kept.append(i)
            basis.append(left / np.sqrt(left @ inverse @ left))
    return kept


def first_fall(before: float, fall: float, after: float, last: float, size: float) -> float:
    """Where in [0, 1] the cubic of these ends falls through zero; infinity where it does not.

    :param fall: its slope at 0; ``last``: at 1.
    :param size: how far below zero it has to come.
    """
    if before < -size:
        return 0.0
    square = 3.0 * (after - before) - 2.0 * fall - last
    cube = 2.0 * (before - after) + fall + last

    def value(x: float) -> float:
        return before + x * (fall + x * (square + x * cube))

    above = 0.0
    for end in [*_turns(fall, square, cube), 1.0]:
        if value(end) < -size:
            below = end
            while above < (middle := 0.5 * (above + below)) < below:
                if value(middle) < 0.0:
                    below = middle
                else:
                    above = middle
            return above
        above = end
    return math.inf


def _turns(fall: float, square: float, cube: float) -> list[float]:
    """Where the slope fall + 2 square x + 3 cube x^2 is zero in (0, 1)."""
    inner = square * square - 3.0 * cube * fall
    if inner < 0.0:
        return []
    big = -(square + math.copysign(math.sqrt(inner), square))
    found = [x for a, b in ((big, 3.0 * cube), (fall, big)) if b for x in [a / b] if 0.0 < x < 1.0]
    return sorted(found)
