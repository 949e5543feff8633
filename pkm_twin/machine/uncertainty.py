# SPDX-License-Identifier: Apache-2.0
"""How sure a robot's numbers are, and what that makes of anything computed from them.

May import: numpy, this package, the standard library.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import ParameterError
from pkm_twin.machine import schema

if TYPE_CHECKING:
    from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

STEP: Final = 1e-3
"""Part of a deviation by which a number is moved to differentiate: the error is its square's."""


@dataclass(frozen=True, eq=False)
class UncertaintyEntry:
    """Standard deviation of one number, or the common relative one of all numbers below a name."""

    deviation: float | None = schema.number(at_least=0.0, unit="the number's", default=None)
    relative: float | None = schema.number(at_least=0.0, at_most=1.0, default=None)

    def verify(self, path: str) -> None:
        """One of both."""
        if (self.deviation is None) == (self.relative is None):
            raise ParameterError(path, None, "either `deviation` or `relative`")


@dataclass(frozen=True, eq=False)
class Factor:
    """One independent cause: the robots a little below and above, and the steps' part of it."""

    name: str
    low: Robot
    high: Robot

    def effect(self, call: Callable[[Robot], Array]) -> Array:
        """What one standard deviation of the cause changes, by a central difference."""
        return np.asarray((call(self.high) - call(self.low)) / (2.0 * STEP), np.float64)


def causes_of(robot: Robot) -> dict[str, dict[str, float]]:
    """Of each cause that the file names: by path of a number, what one standard deviation adds."""
    found = {}
    for name, entry in robot.uncertainty.items():
        deviation, relative = entry.deviation, float(entry.relative or 0.0)
        found[name] = {
            path: value * relative if deviation is None else deviation
            for path, value in numbers_below(robot, name).items()
            if math.isfinite(value)
        }
    return found


def factors_of(robot: Robot) -> tuple[Factor, ...]:
    """The causes with robots beside.

    :raises ParameterError: a number that cannot vary.
    """
    from pkm_twin.machine.entries import with_entries

    found = []
    for name, steps in robot.causes.items():
        sides = []
        for sign in (-STEP, STEP):
            values = {path: robot.number(path) + sign * step for path, step in steps.items()}
            sides.append(with_entries(robot, values))
        found.append(Factor(name, *sides))
    return tuple(found)


def numbers_below(robot: Robot, name: str) -> dict[str, float]:
    """The numbers that an entry is about."""
    from pkm_twin.machine.entries import entries

    known = entries(robot).items()
    parts = (f"{name}.", f"{name}[")
    below = {path: v for path, (v, _) in known if path == name or path.startswith(parts)}
    entry, field = robot.uncertainty[name], f"uncertainty.{name}"
    if not below:
        raise ParameterError(field, None, "the path of numbers that the file gives")
    if entry.deviation is not None and len(below) > 1:
        raise ParameterError(field, entry.deviation, "relative: it stands for several numbers")
    return below


def check_uncertainty(robot: Robot) -> None:
    """Refuse names that are no numbers of the file.

    :raises ParameterError: by the field.
    """
    for name in robot.uncertainty:
        numbers_below(robot, name)
