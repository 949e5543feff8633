# SPDX-License-Identifier: Apache-2.0
"""What a map shows: a function of joint positions to a value, its direction and its element."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import ParameterError
from pkm_twin.robot.robot import Robot

Array = NDArray[np.float64]


class Found(NamedTuple):
    """A quantity in k poses: ``value`` (k,), ``direction`` (k, 3), base axes, ``element`` (k,).

    ``element``: index of the name that is to blame. ``shares``: parts of the elements, shape
    (k, elements), of a quantity that has them.
    """

    value: Array
    direction: Array
    element: NDArray[np.int64]
    shares: Array | None = None


@dataclass(frozen=True)
class Case:
    """A load case: its name, and the wrench that the surroundings apply to the platform, or none.

    Force (N) and moment (N m) at the reference point, base axes.
    """

    name: str
    wrench: tuple[float, ...] | None


@dataclass(frozen=True)
class Quantity:
    """One kind of map.

    ``question``: what its picture answers. ``evaluate``: of a robot, joint positions (k, n) and a
    wrench. ``elements``: names that it blames. ``unit``: of a robot and a case. ``largest``: is the
    largest value the worst? ``default``: the case without one given. ``points``: of the grid;
    ``chunk``: poses computed at once; ``samples``, ``population`` and ``rounds``: of the search
    for the worst pose. ``screen``: of a quantity that takes long, one that is bad where it is.
    """

    name: str
    what: str
    question: str
    evaluate: Callable[[Robot, Array, Array | None], Found]
    elements: Callable[[Robot], tuple[str, ...]]
    unit: Callable[[Robot, Case], str]
    default: Case
    element: str = "element"
    largest: bool = True
    has_shares: bool = False
    points: int = 50_000
    chunk: int = 16384
    samples: int = 8192
    population: int = 256
    rounds: int = 200
    screen: Quantity | None = None


def no_wrench(name: str) -> Case:
    """The case of a quantity that needs no load."""
    return Case(name, None)


def require_effort(robot: Robot) -> Array:
    """Effort limits, shape (n,), N m or N.

    :raises ParameterError: the robot's file has none.
    """
    limits = robot.limits.effort
    if limits is None or not np.isfinite(limits).any():
        raise ParameterError("limits.effort", None, "limits of the drives' efforts")
    return np.asarray(limits, np.float64)


def largest_axis(matrices: Array) -> tuple[Array, Array]:
    """Largest eigenvalue (k,) and its direction (k, 3) of symmetric matrices (k, 3, 3).

    The direction's largest entry is positive.
    """
    values, vectors = np.linalg.eigh(matrices)
    direction = vectors[..., -1]
    index = np.abs(direction).argmax(-1)[..., None]
    sign = np.sign(np.take_along_axis(direction, index, -1))
    return values[..., -1], direction * sign


def size_and_direction(vectors: Array) -> tuple[Array, Array]:
    """Lengths (k,) and unit vectors (k, 3); zero where a vector is."""
    size = np.linalg.norm(vectors, axis=-1)
    return size, vectors / np.where(size > 0.0, size, 1.0)[..., None]
