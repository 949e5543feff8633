# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Draw a robot whose parameters differ randomly from the model's by a stated relative deviation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from typing import Any, Final, Literal

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.machine.places import drop_missing
from pkm_twin.robot.robot import Robot

Distribution = Literal["normal", "uniform"]

MAX_SPREAD: Final = 0.3
"""Largest relative standard deviation; three of them leave masses above zero."""
KINDS: Final = ("masses", "inertias", "friction", "lengths")
POINTS: Final = ("at", "ends")
"""Keys of the points of a machine's joints and rods."""


@dataclass(frozen=True)
class Variation:
    """A robot with other parameters, and what was drawn."""

    robot: Robot
    drawn: Mapping[str, float]
    """The factor of each parameter by its dotted path; for coordinates (``.x``) the shift, m."""


@dataclass(frozen=True)
class _VariedParameter:
    """A parameter that is varied: its path, kind and value."""

    path: tuple[str, ...]
    kind: str
    value: Any


def vary_robot(
    robot: Robot, spread: Mapping[str, float], seed: int, distribution: Distribution = "normal"
) -> Variation:
    """Draw a robot with other masses, inertias, friction and lengths.

    Every number gets its own factor 1 + s d, an inertia one factor for all entries; d is standard
    normal within three deviations, or uniform between -1 and 1. Points of joints and rods are shifted
    by s d times the platform's radius along each axis instead. Derived numbers, such as the inertias of
    rods, follow. Limits, payload, angles and directions stay.

    :param spread: s by kind, see :data:`KINDS`; kinds without one stay.
    :param seed: of the random numbers, which are the same on every computer.
    :raises ParameterError: a deviation out of range, or a machine that closes with its own lengths
        only, as overconstrained ones do.
    """
    for kind, size in spread.items():
        if kind not in KINDS or not 0.0 <= size <= MAX_SPREAD:
            raise ParameterError(f"spread.{kind}", size, f"0 to {MAX_SPREAD:g} for {KINDS}")
    rng = np.random.default_rng(seed)
    data = drop_missing(robot.parameter_sections())
    drawn: dict[str, float] = {}
    for number in _iterate_numbers(data, robot.parameter_units(), ()):
        # Draw for every number, so that a kind's deviation does not change the draws of other kinds.
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
            reduce(getitem, number.path[:-1], data)[number.path[-1]] = value
            drawn |= told
    if not drawn:
        return Variation(robot, drawn)
    try:
        made = type(robot).from_data(data, robot.name)
        made.forward(made.inverse(made.home()))
    except ValueError as error:
        if spread.get("lengths", 0.0) > 0.0:
            raise ParameterError(
                "spread.lengths", spread["lengths"], f"0 for this robot, because its loops do not close ({error})"
            ) from error
        raise
    return Variation(made, drawn)


def _iterate_numbers(data: Any, units: Any, path: tuple[str, ...]) -> Iterator[_VariedParameter]:
    """Yield the numbers that are varied, in the order of the file."""
    for key, value in data.items():
        here = (*path, key)
        unit = units.get(key, "") if isinstance(units, Mapping) else ""
        # Only the rigid bodies are varied.
        if key in ("limits", "payload", "joint_map", "members", "member", "section", "uncertainty", "tolerances"):
            continue
        if isinstance(value, Mapping):
            yield from _iterate_numbers(value, unit, here)
            continue
        kind = _find_kind(here, unit)
        if kind is not None:
            yield _VariedParameter(here, kind, value)


def _find_kind(path: tuple[str, ...], unit: str) -> str | None:
    if "friction" in path:
        return "friction"
    if unit in ("kg", "kg/m3"):
        return "masses"
    if unit == "kg m2":
        return "inertias"
    if unit == "m" and (path[0] == "geometry" or path[-1] in POINTS):
        return "lengths"
    return None


def _draw(rng: np.random.Generator, distribution: Distribution, shape: tuple[int, ...]) -> Array:
    if distribution == "uniform":
        return np.asarray(rng.uniform(-1.0, 1.0, shape))
    values = np.asarray(rng.standard_normal(shape))
    while (far := np.abs(values) > 3.0).any():
        values = np.where(far, rng.standard_normal(shape), values)
    return values
