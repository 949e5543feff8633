# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin torques``: efforts, their terms and joint reactions along a motion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import (
    BeyondLimitsToo,
    CarriesAtTimes,
    Draws,
    ReadsMotions,
    Writes,
    payload_fact,
)
from pkm_twin.console import progress, writing
from pkm_twin.recordings.tables import ENDINGS, check_target, write_table
from pkm_twin.report import Column, Fact, Report, Table, plots
from pkm_twin.settings import setting


@dataclass(frozen=True, kw_only=True)
class Torques(CarriesAtTimes, ReadsMotions, BeyondLimitsToo, Writes, Draws):
    """Compute torques, their terms and joint reactions.

    Columns of a table: time (s) and JOINT.position (rad or m) for every actuated joint. Optional:
    JOINT.velocity and JOINT.acceleration, which are otherwise differentiated from the positions,
    and the wrench on the platform, fx fy fz mx my mz (N, N m, base axes). `pkm-twin info` lists the
    joint names.

    The command prints peak and RMS effort of each joint. The table that it writes has one row per
    sample: each joint's effort (N m or N), the terms that sum to it (JOINT.effort_gravity,
    _inertia, _velocity, _payload, _friction, _external, _preload), the measured effort of a
    recording, and force and moment in every joint. A reaction that rigid-body equations do not
    determine is empty.
    With --beyond-limits, the column beyond_limits is 1 where a joint is outside its limits.
    """

    motion: Path = setting(
        ..., "a recording or a path: MCAP, rosbag2 folder or table", argument=True
    )
    out: Path = setting(
        Path("torques.csv"), "table to write, .csv, .parquet or .mat", writes=True, endings=ENDINGS
    )


def torques(given: Torques) -> Report:
    """Peak and RMS effort of each joint, and the table."""
    from pkm_twin.paths.along import torque_table
    from pkm_twin.paths.sizing import integral

    check_target(given.out)
    motion = given.read(given.motion, given.machine(), planned=True).with_rates()
    beyond = given.admitted(motion.robot, motion.q, motion.qd)
    with progress("torques", len(motion.time)) as update:
        columns = torque_table(motion, update)
    with writing(given.out):
        write_table(columns, given.out)
    robot, time = motion.robot, columns["time"]
    units = dict(zip(robot.joint_names, robot.effort_units, strict=True))
    rows: dict[str, list[Any]] = {}
    for joint, unit in units.items():
        effort = columns[f"{joint}.effort"]
        at, whole = int(abs(effort).argmax()), float(time[-1] - time[0])
        peak = float(abs(effort[at]))
        rms = math.sqrt(integral(time, effort**2) / whole) if whole > 0.0 else peak
        rows[joint] = [peak, rms, unit, float(time[at])]
    # Forces and moments have no common size.
    alike = [name for name in rows if units[name] == robot.effort_units[0]]
    worst = max(alike, key=lambda name: rows[name][0])
    peak, rms, unit, when = rows[worst]
    answer = (
        f"{robot.name}: largest effort {peak:.4g} {unit} on {worst} at {when:.4g} s, RMS {rms:.4g} "
        f"{unit}"
    )
    return Report(
        answer,
        [
            Fact("robot", robot.name),
            Fact("samples", len(time)),
            Fact("columns", len(columns)),
            payload_fact(motion.load),
            Fact("beyond_limits", [str(item) for item in beyond]),
        ],
        [
            Table(
                "efforts",
                [Column("peak"), Column("rms", text="RMS"), Column("unit"),
                 Column("peak_at_s", "s", "peak at")],
                rows, head="joint",
            )
        ],
        figures={"": lambda: plots.torques(motion, columns, answer)},
        notes=[
            f"table: {len(time)} rows, {len(columns)} columns", *motion.notes,
            *(f"beyond limits: {item}" for item in beyond),
        ],
        files={"out": given.out},
    )  # fmt: skip


COMMAND = command(torques, "Torques, paths and drives")
