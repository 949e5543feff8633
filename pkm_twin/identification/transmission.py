# SPDX-License-Identifier: Apache-2.0
"""Transmissions between a controller's numbers and a machine's joints, as a calibration fits them.

Names of what is fitted: ``joint_map.JOINT.offset``, ``.ratio`` and ``.ratio_change``, and
``joint_map.*.ratio``, one factor on all ratios.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.machine.joint_map import JointMap
from pkm_twin.robot.robot import Robot

SHARED: Final = "joint_map.*.ratio"
SURE: Final = 0.05
"""Standard deviation of a ratio without the poses, part of it; and of its change over the travel
of the poses."""
CONTROLLER: Final = "controller units"
"""Of a joint's sensor whose numbers are not the model's in rad or m, and have no unit's name."""


class Transmission(StrEnum):
    """Which ratios are fitted."""

    AUTO = "auto"
    EACH = "each"
    SHARED = "shared"
    TRAVEL = "travel"
    FILE = "file"


class Number(NamedTuple):
    """A number of the joint map: its unit, value and standard deviation before."""

    name: str
    unit: str
    value: float
    prior: float


def unit_of(robot: Robot, joint: int) -> str:
    """Of a joint's numbers as the controller has them."""
    own = robot.controller
    plain = abs(own.factors[joint]) == 1.0
    return own.units[joint] or (robot.joint_units[joint] if plain else CONTROLLER)


def per(controller: str, model: str) -> str:
    """The unit of a ratio."""
    return f"{controller} per {model}" if " " in controller else f"{controller}/{model}"


def numbers(
    robot: Robot, q: Array, how: Transmission, offsets: bool, prior: float, angle: float
) -> list[Number]:
    """What is fitted of the joint map.

    :param q: the poses' joints, (k, n). ``prior``, ``angle``: standard deviations of lengths, m,
        and angles, rad.
    :raises ParameterError: no joint's transmission can be fitted in this way.
    """
    own, found = robot.controller, []
    scaled = np.abs(own.factors) != 1.0
    sliding = np.array([unit == "m" for unit in robot.joint_units])
    if how is Transmission.FILE:
        fitted = np.zeros_like(scaled)
    else:
        fitted = scaled & sliding if how is Transmission.AUTO else np.ones_like(scaled)
    farthest = np.abs(q).max(0)
    travel = np.maximum(np.ptp(q, axis=0), 1e-9)
    for i, joint in enumerate(robot.joint_names):
        path, unit, ratio = f"joint_map.{joint}", unit_of(robot, i), float(abs(own.factors[i]))
        # An offset is what the controller reads at zero: a ratio that is not sure moves it.
        size = prior if sliding[i] else angle
        size = float(np.hypot(size, SURE * farthest[i] if fitted[i] else 0.0))
        if offsets:
            found.append(Number(f"{path}.offset", unit, float(own.offsets[i]), size * ratio))
        if fitted[i] and how is not Transmission.SHARED:
            its = per(unit, robot.joint_units[i])
            found.append(Number(f"{path}.ratio", its, ratio, SURE * ratio))
        if how is Transmission.TRAVEL:
            change, prior_change = float(own.changes[i]), 2.0 * SURE / float(travel[i])
            found.append(
                Number(f"{path}.ratio_change", f"1/{robot.joint_units[i]}", change, prior_change)
            )
    if how is Transmission.SHARED:
        found.append(Number(SHARED, "", 1.0, SURE))
    return found


def centred(robot: Robot, q: Array) -> JointMap:
    """The file's map with the middle of the poses' travel as the place of every even ratio."""
    own = robot.controller
    middle = np.round(0.5 * (q.max(0) + q.min(0)), 3)
    return replace(own, centres=np.where(own.changes == 0.0, middle, own.centres))


def changed(robot: Robot, own: JointMap, values: Mapping[str, float]) -> JointMap:
    """A map with other numbers, by the names above.

    :raises ParameterError: a ratio that is not positive.
    """
    old = robot.controller
    offsets, ratios, changes = old.offsets.copy(), np.abs(old.factors), old.changes.copy()
    for i, joint in enumerate(robot.joint_names):
        path = f"joint_map.{joint}"
        offsets[i] = values.get(f"{path}.offset", offsets[i])
        ratios[i] = values.get(f"{path}.ratio", ratios[i] * values.get(SHARED, 1.0))
        changes[i] = values.get(f"{path}.ratio_change", changes[i])
    if not (ratios > 0.0).all():
        raise ParameterError("joint_map", float(ratios.min()), "ratios above 0")
    return replace(own, offsets=offsets, factors=np.sign(old.factors) * ratios, changes=changes)


def by_map(robot: Robot, own: JointMap, q: Array, twists: Array) -> dict[str, Array]:
    """Derivatives of the platform by the map's numbers at the controller's positions held.

    :param q: the model's, (k, n). ``twists``: of the platform by q, (k, 6, n).
    :returns: (k, 6) by name.
    """
    away = q - own.centres
    slope = own.slopes(q)
    wound = q + 0.5 * own.changes * away**2
    by_offset = -1.0 / slope
    by_ratio = -np.sign(own.factors) * wound / slope
    by_change = -0.5 * own.factors * away**2 / slope
    shared = -own.factors * wound / slope
    found = {SHARED: np.sum(twists * shared[:, None, :], -1)}
    for i, joint in enumerate(robot.joint_names):
        for name, rate in (("offset", by_offset), ("ratio", by_ratio), ("ratio_change", by_change)):
            found[f"joint_map.{joint}.{name}"] = twists[..., i] * rate[:, i, None]
    return found


def written(
    robot: Robot, own: JointMap, values: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float, str]]:
    """What a file says of a fitted joint map: value, standard deviation and unit by path.

    :param values: of what was fitted of the map, value and deviation by the names above.
    """
    found = {}
    for i, joint in enumerate(robot.joint_names):
        path, unit = f"joint_map.{joint}", unit_of(robot, i)
        units = {
            "offset": unit,
            "ratio": per(unit, robot.joint_units[i]),
            "ratio_change": f"1/{robot.joint_units[i]}",
        }
        for name, its in units.items():
            if f"{path}.{name}" in values:
                found[f"{path}.{name}"] = (*values[f"{path}.{name}"], its)
        if SHARED in values:
            ratio = float(abs(robot.controller.factors[i]))
            factor, deviation = values[SHARED]
            found[f"{path}.ratio"] = (ratio * factor, ratio * deviation, units["ratio"])
        if f"{path}.ratio_change" in values:
            found[f"{path}.ratio_at"] = (float(own.centres[i]), 0.0, robot.joint_units[i])
    return found
