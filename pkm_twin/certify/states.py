# SPDX-License-Identifier: Apache-2.0
"""Random states that a machine can be judged in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from pkm_twin.certify.description import Array, UnfitError
from pkm_twin.certify.maximal import Maximal

WITHIN: Final = 0.8
"""Part of the joints' limits that positions are drawn from."""
NARROW: Final = 0.3
"""Half the range of a joint without limits, rad; of a sliding one this part of the size."""
CLEAR: Final = 0.1
"""Least condition and least determinant of the pose on the way from home, relative to home's:
nearer to a singularity every engine loses digits, and behind a fold the pose has two answers."""


@dataclass(frozen=True)
class States:
    """Joint states, shape (states, n), rad and m, and wrenches, shape (states, 6), N and N m."""

    q: Array
    qd: Array
    qdd: Array
    wrench: Array
    drawn: int
    """How many positions were drawn; the others are out of reach, near a singularity or folded."""
    skipped: int
    """How many of these only the twin does not reach: on its way from home is a singularity."""


def ranges(judge: Maximal) -> Array:
    """The range that positions are drawn from, shape (n, 2), rad or m."""
    machine, size = judge.machine, extent(judge)
    result = []
    for joint in machine.actuated:
        reach = NARROW * size / 2 if joint.slides else NARROW
        low, high = joint.position
        low = low if np.isfinite(low) else joint.home - reach
        high = high if np.isfinite(high) else joint.home + reach
        middle, half = (low + high) / 2, WITHIN * (high - low) / 2
        result.append((middle - half, middle + half))
    return np.array(result)


def extent(judge: Maximal) -> float:
    """The machine's size: half the diagonal of all its points at home, m."""
    machine = judge.machine
    points = [machine.origin, *(joint.at for joint in machine.joints)]
    points += [body.com for body in machine.bodies.values() if body.mass]
    points += [end for rod in machine.rods for end in rod.ends]
    return float(np.linalg.norm(np.ptp(np.array(points), axis=0)) / 2) or 1.0


def random_states(
    judge: Maximal,
    rng: np.random.Generator,
    count: int,
    reaches: Callable[[Array], bool] = lambda _: True,
) -> States:
    """States inside the limits, connected to home, clear of singularities.

    Rates of the order of the range in a second, wrenches of the order of the machine's weight.

    :param reaches: whether the twin reaches joint positions, shape (n,).
    :raises UnfitError: fewer than ``count`` in twenty times as many draws.
    """
    low, high = ranges(judge).T
    found: list[Array] = []
    drawn = skipped = 0
    while len(found) < count:
        if drawn == 20 * count:
            raise UnfitError(f"only {len(found)} of {drawn} positions in the limits can be judged")
        drawn += 1
        q = rng.uniform(low, high)
        try:
            state = judge.assemble(q)
        except UnfitError:
            continue
        if min(state.least, state.pose) >= CLEAR:
            good = reaches(q)
            skipped += not good
            found += [q] if good else []
    machine, n = judge.machine, len(low)
    span = high - low
    weight = 1.0 + 9.81 * sum(body.mass for body in machine.bodies.values())
    wrench = rng.normal(size=(count, 6)) * weight
    wrench[:, 3:] *= extent(judge)
    qd, qdd = (rng.normal(size=(count, n)) * span * factor for factor in (2.0, 10.0))
    return States(np.array(found), qd, qdd, wrench, drawn, skipped)
