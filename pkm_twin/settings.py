# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Settings as fields of a class: a node's parameters, a command's options, a robot file's keys."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping
from dataclasses import MISSING, dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any, Final, TypeVar

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

S = TypeVar("S", bound="DataclassInstance")


@dataclass(frozen=True)
class Setting:
    """The parameter, option or key of a field.

    ``name``: the parameter's name, by default the field's. ``low``, ``high``: smallest and largest
    value. ``above``: a bound that the value exceeds. ``choices``: the allowed words, or the field's
    value for each word.

    For nodes alone: ``fixed``: cannot change while the node runs. ``usual``: description of a default
    that depends on the robot.

    For commands alone: ``argument``: given by its position. ``count``: this many numbers separated
    by commas, 0 for any count. ``writes``: a file that the command writes, whose name ends in one of
    ``endings`` if there are any. ``older``: spellings that the help does not list. ``alone``: the
    value of an option that is given without a value. ``metavar``: the value's name in the help.
    """

    text: str
    name: str = ""
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: Collection[str] | Mapping[str, Any] = ()
    fixed: bool = False
    usual: str = ""
    argument: bool = False
    count: int | None = None
    writes: bool = False
    endings: tuple[str, ...] = ()
    older: tuple[str, ...] = ()
    alone: str | None = None
    metavar: str | None = None
    above: float | None = None

    @property
    def bounds_text(self) -> str:
        """Text of the bounds, such as ", 0 to 1", to append to the name of the quantity."""
        words = "" if self.above is None else f" above {self.above:g}"
        if self.high == math.inf:
            return f"{words}{self._lower_bound_text}, or .inf"
        if self.low is not None and self.high is not None:
            return f", {self.low:g} to {self.high:g}"
        return f"{words}{self._lower_bound_text}" + ("" if self.high is None else f", at most {self.high:g}")

    @property
    def _lower_bound_text(self) -> str:
        return "" if self.low is None else f", {self.low:g} or more"

    def is_within_bounds(self, number: float) -> bool:
        """Return whether a number is within the bounds."""
        low = -math.inf if self.low is None else self.low
        high = math.inf if self.high is None else self.high
        return low <= number <= high and (self.above is None or number > self.above)

    def to_field_value(self, given: Any) -> Any:
        """Convert a parameter's value to the field's."""
        if isinstance(self.choices, Mapping):
            return self.choices[given]
        return tuple(given) if hasattr(given, "__iter__") and not isinstance(given, str) else given

    def to_parameter_value(self, value: Any) -> Any:
        """Convert a field's value to the parameter's."""
        if isinstance(self.choices, Mapping):
            return next(word for word, own in self.choices.items() if own == value)
        return list(value) if isinstance(value, tuple) else value


DURATION_BOUNDS: Final[Mapping[str, Any]] = {"unit": "s", "low": 0.0, "high": 3600.0}
AGE_BOUNDS: Final[Mapping[str, Any]] = {**DURATION_BOUNDS, "low": 1e-3}
COUNT_BOUNDS: Final[Mapping[str, Any]] = {"low": 1, "high": 10**6}
FRACTION_BOUNDS: Final[Mapping[str, Any]] = {"low": 0.0, "high": 1.0}
SCALE_BOUNDS: Final[Mapping[str, Any]] = {"low": 0.0, "high": 1e9}
"""Bounds of settings of one kind."""
FUTURE_TOLERANCE_TEXT: Final = "how far time stamps may be ahead of the clock"
ZERO_STAMP_TEXT: Final = "accept a zero stamp, as the arrival time"
"""Descriptions of parameters that several nodes have."""


def setting(default: Any, text: str, **more: Any) -> Any:
    """Declare a field that is a node parameter or a command option.

    :param default: ``...`` if the user has to give a value.
    :param more: further attributes of :class:`Setting`.
    """
    if default is ...:
        default = MISSING
    return field(default=default, metadata={"setting": Setting(text, **more)})


def map_parameters(kind: Any) -> Mapping[str, tuple[str, Any]]:
    """Return, for each parameter name, the name of the dataclass field and its Setting."""
    return _collect_settings(kind)


@cache
def _collect_settings(kind: Any) -> Mapping[str, tuple[str, Any]]:
    found = {f.name: f.metadata["setting"] for f in dataclasses.fields(kind) if f.metadata}
    return {row.name or name: (name, row) for name, row in found.items()}


def list_changeable(kind: type[DataclassInstance]) -> list[str]:
    """List the parameters that may change while the node runs."""
    return [name for name, (_, row) in map_parameters(kind).items() if not row.fixed]


def with_parameters(settings: S, values: Mapping[str, Any]) -> S:
    """Return the settings with new parameter values; other names in ``values`` are ignored.

    :raises ParameterError: the settings reject a value.
    """
    rows = map_parameters(type(settings))
    fields = {rows[name][0]: rows[name][1].to_field_value(values[name]) for name in rows.keys() & values}
    return dataclasses.replace(settings, **fields)
