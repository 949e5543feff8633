# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Declare a node's parameters with bounds, convert integers to floats, reject others."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter

from pkm_twin.errors import ParameterError, PkmTwinError, UnknownNameError
from pkm_twin.mechanisms.catalogue import load
from pkm_twin.robot.robot import Robot
from pkm_twin.settings import Setting, map_parameters

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

S = TypeVar("S", bound="DataclassInstance")
V = TypeVar("V")


class UnknownParametersError(PkmTwinError):
    """Report undeclared parameters, one line each, with the closest names first."""

    def __init__(self, unknown: Iterable[str], valid: Iterable[str]) -> None:
        names = sorted(valid)
        self.lines = []
        for name in unknown:
            close = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
            hint = f"did you mean {close[0]!r}? " if close else ""
            rest = [n for n in names if n not in close and not n.startswith("qos_overrides.")]
            self.lines.append(f"unknown parameter {name!r}; {hint}valid: {', '.join(close + rest)}")
        super().__init__("; ".join(self.lines))


class ParameterNode(LifecycleNode):
    """Provide parameters that reject undeclared names and invalid values."""

    def __init__(self, name: str) -> None:
        self.followed: set[str] = set()
        """Parameters whose changes are applied while the node runs."""
        self.rows: dict[str, tuple[Any, Setting]] = {}
        """Declared parameters: default and description."""
        super().__init__(name)

    @property
    def given(self) -> dict[str, Any]:
        """Parameters that the node was started with, by name; a live view.

        rclpy, of Jazzy at least, has no public name for them while they are not declared.

        :raises RuntimeError: an rclpy version that stores them elsewhere.
        """
        try:
            overrides: dict[str, Any] = self._parameter_overrides
        except AttributeError:
            try:
                found = version("rclpy")
            except PackageNotFoundError:
                found = "of an unknown version"
            raise RuntimeError(f"rclpy {found} is not supported; use 7.1") from None
        return overrides

    @property
    def declared(self) -> dict[str, Parameter]:
        """All parameters of the node, by name."""
        found: dict[str, Parameter] = self.get_parameters_by_prefix("")
        return found

    def declare(self, name: str, default: Any, text: str, *, changeable: bool = False, **row: Any) -> Any:
        """Declare a parameter and return its value; integers are converted to floats.

        :param row: of a :class:`~pkm_twin.settings.Setting`: ``unit``, ``low``, ``high``,
            ``choices``, and words for a ``usual`` default that depends on the robot.
        :param changeable: whether it may change while the node runs.
        :raises ParameterError: the given value has another type or is out of range, naming both.
        """
        return self._declare(default, Setting(text, name, fixed=not changeable, **row))

    def declare_robot(self, default: str = "delta_cu") -> Robot:
        """Declare the parameter ``mechanism`` and load its robot.

        :raises PkmTwinError: there is no such robot, or its file is rejected.
        """
        text = "robot: a name, or the path of a file"
        return load(self.declare("mechanism", default, text))

    def _declare(self, default: Any, row: Setting) -> Any:
        self.rows[row.name] = default, row
        name, unit, low, high = row.name, row.unit, row.low, row.high
        constraints = f"one of {', '.join(row.choices)}" if row.choices else ""
        usual = f"default: {row.usual}" if row.usual else ""
        descriptor = ParameterDescriptor(
            description="; ".join(part for part in (row.text, usual, unit) if part),
            additional_constraints=constraints,
            read_only=row.fixed,
        )
        if low is not None and high is not None:
            if isinstance(default, float):
                descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
            else:
                descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
            constraints = f"{low:g} to {high:g} {unit}".strip()
        given = self.given.get(name)
        if given is not None:
            given = self.given[name] = _convert_to_float(given, default)
        try:
            value = self.declare_parameter(name, default, descriptor).value
        except (InvalidParameterTypeException, InvalidParameterValueException) as error:
            value = given.value if given is not None else None
            raise ParameterError(name, value, constraints or f"a value like {default!r}") from error
        self.check_parameter(name, value)
        return value

    def declare_settings(self, kind: type[S], *, fixed: bool = False, **given: Any) -> S:
        """Declare the parameters of a settings class and return its settings.

        :param fixed: none of them can be changed. ``given``: fields that are no parameters here.
        :raises ParameterError: a value that is rejected.
        """
        defaults = {field.name: field.default for field in dataclasses.fields(kind)}
        for name, (field, row) in map_parameters(kind).items():
            if field not in given:
                own = dataclasses.replace(row, name=name, fixed=fixed or row.fixed)
                given[field] = row.to_field_value(self._declare(row.to_parameter_value(defaults[field]), own))
        return kind(**given)

    def check_parameter(self, name: str, value: Any) -> None:
        """Reject a value that the parameter's declaration does not allow.

        :raises ParameterError: out of range, not a number, or not one of the words.
        """
        _, row = self.rows.get(name, (None, Setting("")))
        # rclpy accepts NaN.
        if row.low is not None and not row.is_within_bounds(value):
            raise ParameterError(name, value, row.bounds_text.removeprefix(", "))
        if row.choices and value not in row.choices:
            raise UnknownNameError(name, value, row.choices)

    def follow(self, names: Iterable[str], prepare: Callable[[dict[str, Any]], V], take: Callable[[V], object]) -> None:
        """Apply or reject a set of parameters as a whole, between two messages.

        :param names: of all parameters that ``prepare`` knows.

        :param prepare: computes the effect of the new values, by name, without side effects. A
        PkmTwinError rejects the set.

        :param take: applies the effect once the parameters have their values.
        """
        prepared: list[V] = []

        def judge(changes: Sequence[Parameter]) -> SetParametersResult:
            # Drop what a later callback rejected.
            prepared.clear()
            values = {change.name: change.value for change in changes}
            try:
                for name, value in values.items():
                    if self.has_parameter(name):
                        self.check_parameter(name, value)
                prepared.append(prepare(values))
            except PkmTwinError as error:
                return SetParametersResult(successful=False, reason=str(error))
            return SetParametersResult(successful=True)

        def follow(changes: Sequence[Parameter]) -> None:
            while prepared:
                take(prepared.pop())

        self.followed.update(names)
        self.add_on_set_parameters_callback(judge)
        self.add_post_set_parameters_callback(follow)

    def close_declarations(self) -> None:
        """Reject undeclared parameters from now on, and those given at start.

        :raises UnknownParametersError: some were given at start; names each.
        """
        declared = self.declared
        unknown = [name for name in self.given if name not in declared]
        if unknown:
            raise UnknownParametersError(unknown, declared)
        changeable = {name for name, (_, row) in self.rows.items() if not row.fixed}
        deaf = sorted(changeable - self.followed)
        if deaf:
            # Without a callback a change would be reported as successful and ignored.
            raise NotImplementedError(f"nothing follows a change of {', '.join(deaf)}")

        def convert(changes: list[Parameter]) -> list[Parameter]:
            return [
                _convert_to_float(change, self.get_parameter(change.name).value)
                if self.has_parameter(change.name)
                else change
                for change in changes
            ]

        def reject_nameless(changes: list[Parameter]) -> SetParametersResult:
            # rclpy would declare a parameter without a name.
            good = all(change.name for change in changes)
            return SetParametersResult(successful=good, reason="" if good else "a parameter without a name")

        self.add_pre_set_parameters_callback(convert)
        self.add_on_set_parameters_callback(reject_nameless)


def _convert_to_float(given: Parameter, like: Any) -> Parameter:
    if isinstance(like, float) and given.type_ == Parameter.Type.INTEGER:
        return Parameter(given.name, value=float(given.value))
    many = not isinstance(like, str) and hasattr(like, "__len__")
    if many and len(like) and isinstance(like[0], float) and given.type_ == Parameter.Type.INTEGER_ARRAY:
        return Parameter(given.name, value=[float(value) for value in given.value])
    return given
