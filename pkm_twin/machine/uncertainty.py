# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read the uncertainties and tolerances of a robot's numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from pkm_twin.errors import ParameterError, unknown_number_error
from pkm_twin.machine import schema


@dataclass(frozen=True, eq=False)
class UncertaintyEntry:
    """The standard deviation of the number at a path, or of all numbers below it together.

    Entries are statistically independent. ``deviation``: in the number's unit; or ``relative``: of
    a common factor of all these numbers.
    """

    deviation: float | None = schema.number(low=0.0, unit="the number's", default=None)
    relative: float | None = schema.number(low=0.0, high=1.0, default=None)

    def verify(self, path: str) -> None:
        """Check that exactly one of ``deviation`` and ``relative`` is given."""
        if (self.deviation is None) == (self.relative is None):
            raise ParameterError(path, None, "either `deviation` or `relative`")


@dataclass(frozen=True)
class Tolerance:
    """The error allowed at a path as of `design --tolerance`; * stands for any text.

    ``deviation``: standard deviation of a normal distribution; or ``bound``: limits of a uniform
    distribution on both sides of zero. For ``backlash`` or ``clearance`` the bound is the total
    play.
    """

    deviation: float | None = schema.number(low=0.0, unit="m or rad", default=None)
    bound: float | None = schema.number(low=0.0, unit="m or rad", default=None)

    def verify(self, path: str) -> None:
        """Check that exactly one of ``deviation`` and ``bound`` is given."""
        if (self.deviation is None) == (self.bound is None):
            raise ParameterError(path, None, "either `deviation` or `bound`")

    @property
    def size(self) -> float:
        """The standard deviation or bound, whichever is given."""
        return (self.deviation if self.bound is None else self.bound) or 0.0

    @property
    def sigma(self) -> float:
        """The standard deviation; a uniform distribution has bound / sqrt(3)."""
        return self.size if self.bound is None else self.size / math.sqrt(3.0)

    @property
    def max_error(self) -> float:
        """The bound; for a normal distribution three standard deviations."""
        return 3.0 * self.size if self.bound is None else self.size


def list_causes(
    entries: Mapping[str, UncertaintyEntry], numbers: Mapping[str, tuple[float, str]]
) -> dict[str, dict[str, float]]:
    """Return for each entry the changes of numbers, by path, for one standard deviation.

    :param numbers: the file's numbers by dotted path, with units.
    :raises ParameterError: an entry matches no number of the file; the error names its field.
    """
    found = {}
    for name, entry in entries.items():
        deviation, relative = entry.deviation, float(entry.relative or 0.0)
        found[name] = {
            path: value * relative if deviation is None else deviation
            for path, value in match_numbers(name, entry, numbers).items()
            if math.isfinite(value)
        }
    return found


def match_numbers(name: str, entry: UncertaintyEntry, numbers: Mapping[str, tuple[float, str]]) -> dict[str, float]:
    """Return the numbers that an entry's path covers; errors as in :func:`list_causes`."""
    parts = (f"{name}.", f"{name}[")
    below = {path: v for path, (v, _) in numbers.items() if path == name or path.startswith(parts)}
    field = f"uncertainty.{name}"
    if not below:
        raise unknown_number_error(field, (f"uncertainty.{path}" for path in numbers))
    if entry.deviation is not None and len(below) > 1:
        raise ParameterError(field, entry.deviation, "relative, because the path names several numbers")
    return below
