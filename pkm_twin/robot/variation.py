# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A machine beside its model: the same robot with parameters that differ by a stated spread."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.machine.places import given
from pkm_twin.robot.robot import Robot

Distribution = Literal["normal", "uniform"]

MAX_SPREAD: Final = 0.3
"""Greatest relative spread: three of it still leave a mass that is above zero."""
FARTHEST: Final = 3.0
"""Normal deviates are drawn anew beyond so many standard deviations."""
KINDS: Final = ("masses", "inertias", "friction", "lengths")
POINTS: Final = ("at", "ends")
"""Places of a machine's joints and rods."""
_LEFT_ALONE: Final = (
    "limits",
    "payload",
    "joint_map",
    "members",
    "member",
    "section",
    "uncertainty",
    "tolerances",
)
"""What is told of the machine beside its rigid bodies."""


@dataclass(frozen=True)
class Variation:
    """A robot with other parameters, and what was drawn."""

    robot: Robot
    drawn: Mapping[str, float]
    """By parameter, dotted: its factor; of a place's coordinates (``.x``) the shift, m."""


@dataclass(frozen=True)
class _Number:
    """A parameter that is varied: where it stands, and what it is."""

    path: tuple[str, ...]
    kind: str
    value: Any


def varied(robot: Robot, spread: Mapping[str, float], seed: int, distribution: Distribution = "normal") -> Variation:
    """Draw a robot with other masses, inertias, friction and lengths.

    Every number gets a factor 1 + s d of its own, an inertia one for all entries, with d
    standard normal within three deviations or uniform between -1 and 1. The joints and rods of a
    machine that is described by their places are each shifted by s d of the platform's radius
    along each axis instead. What a parameter file leaves to be derived (as rods' inertias)
    follows. Limits and payload stay; angles and directions too.

    :param spread: s by kind, see :data:`KINDS`; a kind that is left out stays.
    :param seed: of the draws; the same on every machine.
    :raises ParameterError: a spread out of range, or a machine that closes with its own lengths
        alone, as overconstrained ones do.
    """
    for kind, size in spread.items():
        if kind not in KINDS or not 0.0 <= size <= MAX_SPREAD:
            raise ParameterError(f"spread.{kind}", size, f"0 to {MAX_SPREAD:g} for {KINDS}")
    rng = np.random.default_rng(seed)
    data = given(robot.parameter_sections())
    drawn: dict[str, float] = {}
    for number in _numbers(data, robot.parameter_units(), ()):
        # Drawn for every number: a spread of one kind leaves the draws of the others.
        size, path = spread.get(number.kind, 0.0), ".".join(number.path)
        if number.path[-1] in POINTS:
            shift = size * robot.size * _draw(rng, distribution, np.shape(number.value))
            value = (np.asarray(number.value) + shift).tolist()
            rows = np.atleast_2d(shift)
            told = {
                f"{path}[{i}].{axis}" if len(rows) > 1 else f"{path}.{axis}": float(row[k])
                for i, row in enumerate(rows)
                for k, axis in enumerate("xyz")
            }
        else:
            each = np.shape(number.value) if number.kind == "friction" else ()
            factors = 1.0 + size * _draw(rng, distribution, each)
            value = (np.asarray(number.value) * factors).tolist()
            told = {path + "".join(f"[{i}]" for i in k): float(f) for k, f in np.ndenumerate(factors)}
        if size > 0.0:
            _section_of(data, number.path)[number.path[-1]] = value
            drawn |= told
    return Variation(robot if not drawn else _built(robot, data, spread), drawn)


def _built(robot: Robot, data: dict[str, Any], spread: Mapping[str, float]) -> Robot:
    try:
        made = type(robot).from_data(data, robot.name)
        made.forward(made.inverse(made.home()))
    except ValueError as error:
        if spread.get("lengths", 0.0) > 0.0:
            raise ParameterError(
                "spread.lengths",
                spread["lengths"],
                f"0 for this robot, because its loops do not close ({error})",
            ) from error
        raise
    return made


def _numbers(data: Any, units: Any, path: tuple[str, ...]) -> Iterator[_Number]:
    """Yield the numbers that are varied, in the order of the file."""
    for key, value in data.items():
        here = (*path, key)
        unit = units.get(key, "") if isinstance(units, Mapping) else ""
        if key in _LEFT_ALONE:
            continue
        if isinstance(value, Mapping):
            yield from _numbers(value, unit, here)
            continue
        kind = _kind(here, unit)
        if kind is not None:
            yield _Number(here, kind, value)


def _kind(path: tuple[str, ...], unit: str) -> str | None:
    if "friction" in path:
        return "friction"
    if unit in ("kg", "kg/m3"):
        return "masses"
    if unit == "kg m2":
        return "inertias"
    if unit == "m" and (path[0] == "geometry" or path[-1] in POINTS):
        return "lengths"
    return None


def _section_of(data: Any, path: tuple[str, ...]) -> Any:
    for key in path[:-1]:
        data = data[key]
    return data


def _draw(rng: np.random.Generator, distribution: Distribution, shape: tuple[int, ...]) -> Array:
    if distribution == "uniform":
        return np.asarray(rng.uniform(-1.0, 1.0, shape))
    values = np.asarray(rng.standard_normal(shape))
    while (far := np.abs(values) > FARTHEST).any():
        values = np.where(far, rng.standard_normal(shape), values)
    return values
