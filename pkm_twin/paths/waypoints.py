# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read paths from tables of waypoints."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path as File
from typing import Final

import numpy as np

from pkm_twin.errors import ParameterError, UnknownNameError, warn_of_file
from pkm_twin.files import parse_numbers
from pkm_twin.paths.geometry import Path, Space, lines, through
from pkm_twin.recordings.origin import is_effort_model_column
from pkm_twin.recordings.payload import Load
from pkm_twin.recordings.tables import (
    DEFAULT_DIALECT,
    EFFORTS,
    PAYLOAD,
    WRENCH,
    Dialect,
    map_column_quantities,
    read_table,
)
from pkm_twin.robot.robot import Robot

PATH_COLUMNS: Final = ("blend", "dwell", "arc")
"""Columns of waypoints in addition to their coordinates."""


def read_waypoints(
    file: File,
    robot: Robot,
    blend: float | None,
    dialect: Dialect = DEFAULT_DIALECT,
) -> tuple[Path, list[float] | None]:
    """Read the path of a table of waypoints: pose coordinates, or JOINT.position of every joint.

    A smooth curve; with ``blend`` (m) or one of the columns :data:`PATH_COLUMNS`, lines and arcs.

    :returns: the path, and the payload from each waypoint on, kg, where the table has it, with the
        robot file's centre of mass.
    :raises ParameterError: a column is missing, unknown, or a number is out of range.
    """
    kinds = map_column_quantities(robot)
    table = read_table(file, kinds, dialect)
    joints = [f"{name}.position" for name in robot.joint_names]
    space: Space = "pose" if any(name in table for name in robot.pose_names) else "joint"
    if space == "joint" and not any(name in table for name in joints):
        known = f"{', '.join(robot.pose_names)} or {', '.join(joints)}"
        raise ParameterError(f"{file}: columns", ", ".join(table), known)
    points = table.stack(list(robot.pose_names) if space == "pose" else joints)
    names, units = (robot.pose_names, robot.pose_units) if space == "pose" else (joints, robot.joint_units)
    for name, unit, values in zip(names, units, points.T, strict=True):
        if unit == "rad" and "angle" not in dialect.units and np.abs(values).max() > 2.0 * np.pi:
            most = float(np.abs(values).max())
            warn_of_file(file, f"{name} up to {most:.4g} rad, beyond a turn; degrees? a header {name} [deg]")
    other = {*WRENCH, *(name for name in kinds if name.rpartition(".")[2] in EFFORTS[1:])}
    for name in (*table, *table.left_out):
        if (name not in kinds and not is_effort_model_column(name)) or name in other:
            where, few = f"{file}: column", robot.pose_names if space == "pose" else joints
            if space == "pose":
                where = f"{file}: {robot.name} moves in {', '.join(few)}; column"
            raise UnknownNameError(where, name, (*few, *PATH_COLUMNS, "payload"))
    masses = None
    if PAYLOAD[0] in table:
        kilograms, centre = table[PAYLOAD[0]], table.fill(PAYLOAD[1:])
        for mass in np.unique(kilograms[kilograms != robot.payload.mass]).tolist():
            try:
                Load(mass).apply_to(robot)
            except ParameterError as error:
                where = f"{table.line(int((kilograms == mass).argmax()))}, column payload"
                raise ParameterError(where, error.value, error.bound) from None
        if centre is not None and (centre != robot.payload.com)[kilograms > 0.0].any():
            raise ParameterError(
                f"{file}: {', '.join(PAYLOAD[1:])}",
                "a centre of mass",
                "that of the robot's file; without the columns, --payload MASS,x,y,z carries another",
            )
        masses = kilograms.tolist()
    given = {name: table[name] for name in PATH_COLUMNS if name in table}
    if "arc" in given and not np.isin(given["arc"], (0.0, 1.0)).all():
        raise ParameterError(f"{file}: arc", given["arc"].tolist(), "0 or 1")
    arc = given.get("arc", np.zeros(len(points))) == 1.0
    rounded = given.get("blend", np.full(len(points), blend or 0.0))
    if "blend" not in given:
        # An arc's ends and middle are not corners.
        near = arc | np.roll(arc, 1) | np.roll(arc, -1)
        rounded = np.where(near, 0.0, rounded)
    try:
        if blend is None and not given:
            return through(robot, points, space=space), masses
        made = lines(robot, points, blend=rounded, dwell=given.get("dwell", 0.0), arc=arc, space=space)
    except ParameterError as error:
        raise ParameterError(f"{file}: {error.field}", error.value, error.bound) from None
    return made, masses


def parse_loads(texts: Sequence[str], waypoints: int) -> list[float | None]:
    """Parse texts ``MASS@FROM:TO``; return the payload from each waypoint on, kg, None: the file's.

    :raises ParameterError: another form, waypoints that do not exist, or two masses on one part.
    """
    result: list[float | None] = [None] * waypoints
    for text in texts:
        match = re.fullmatch(r"([^@]+)@([0-9]+):([0-9]+)", text.strip())
        masses = parse_numbers(match[1]) if match else []
        if match is None or len(masses) != 1 or masses[0] < 0.0:
            raise ParameterError("load", text, "MASS@FROM:TO, kg and two waypoints, as in 0.5@2:4")
        begin, end = int(match[2]), int(match[3])
        if not begin < end < waypoints:
            raise ParameterError("load", text, f"two waypoints of 0 to {waypoints - 1}, the second one later")
        if any(mass is not None for mass in result[begin:end]):
            raise ParameterError("load", text, "waypoints on which no other payload is carried")
        result[begin:end] = masses * (end - begin)
    return result
