# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin torques``: efforts, their terms and joint reactions along a motion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
import numpy as np

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import (
    MotionOptions,
    OutputOption,
    PictureOptions,
    PoseOption,
    TimedPayloadOptions,
    payload_fact,
)
from pkm_twin.console import convert_write_errors, draw_progress
from pkm_twin.recordings.tables import WRITABLE_SUFFIXES, check_target, write_table
from pkm_twin.report import Column, Fact, Report, Table, plots
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from pkm_twin.recordings import Recording
    from pkm_twin.robot.robot import Robot

TERMS_AT_REST: Final = ("gravity", "payload", "friction", "external", "preload")
"""Terms of an effort that can differ from zero at rest."""


@dataclass(frozen=True, kw_only=True)
class Torques(TimedPayloadOptions, MotionOptions, PoseOption, OutputOption, PictureOptions):
    """Compute torques, their terms and joint reactions.

    Example: `pkm-twin torques delta --at 0,0,-0.4 --payload 0.5`, at rest at a pose.

    Columns of a table: time (s) and JOINT.position (rad or m) for every actuated joint. Optional:
    JOINT.velocity and JOINT.acceleration, which are otherwise differentiated from the positions,
    and the wrench on the platform, fx fy fz mx my mz (N, N m, base axes). `pkm-twin info` lists the
    joint names.

    The command prints peak and RMS effort of each joint, with --at the effort and its terms, where
    dry friction is zero. The table that it writes has one row per sample: each joint's effort (N m
    or N), the terms that sum to it (JOINT.effort_gravity, _inertia, _velocity, _payload, _friction,
    _external, _preload), a recording's measured effort (JOINT.measured), and force and moment in
    every joint. A reaction that rigid-body equations do not determine is empty. The last columns
    are the inputs of the efforts: wrench, payload, gravity, and a checksum of the robot's numbers
    (computed_with.ROBOT).
    With --beyond-limits, the column beyond_limits is 1 where a joint is outside its limits.
    """

    motion: Path | None = setting(None, "a recording or a path: MCAP, rosbag2 folder or table", argument=True)
    at: str | None = setting(None, "pose at rest, in place of a motion")
    wrench: tuple[float, ...] | None = setting(
        None, "with --at: wrench on the platform, N and N m, base axes", count=6, metavar="fx,fy,fz,mx,my,mz"
    )
    out: Path | None = setting(
        None, "table to write, .csv, .parquet or .mat; default: torques.csv", writes=True, endings=WRITABLE_SUFFIXES
    )

    def __post_init__(self) -> None:
        if self.out is None and self.at is None:
            object.__setattr__(self, "out", Path("torques.csv"))

    def make_resting_recording(self, machine: Robot) -> Recording:
        """Return a motion of one sample at rest at the pose.

        :raises PkmTwinError: the pose is out of reach or beyond the joint limits.
        """
        from pkm_twin.recordings import Recording

        q = np.atleast_2d(machine.inverse(self.pose(machine)))
        wrench = None if self.wrench is None else np.array([self.wrench])
        still = np.zeros_like(q)
        return Recording(machine, np.zeros(1), q, still, still, wrench=wrench, load=self.load)


@command("Torques, paths and drives")
def torques(given: Torques) -> Report:
    """Report peak and RMS effort of each joint, and write the table."""
    from pkm_twin.paths.along import find_peaks, tabulate_torques
    from pkm_twin.robot.limits import beyond_limits

    if given.out is not None:
        check_target(given.out)
    if (given.motion is None) == (given.at is None):
        raise click.UsageError("give a recording or path, or --at")
    if given.motion is None:
        if given.picture is not None or given.load_times is not None:
            raise click.UsageError("--picture and --load-times need a recording or path")
        motion = given.make_resting_recording(given.machine())
    else:
        if given.wrench is not None:
            raise click.UsageError("--wrench needs --at; a motion has it in columns fx ... mz")
        motion = given.read_motion(given.motion, given.machine())
    beyond = given.list_beyond_limits(motion.robot, motion.q, motion.qd)
    with draw_progress("torques", len(motion.time)) as update:
        columns = tabulate_torques(motion, update)
    if given.out is not None:
        with convert_write_errors(given.out):
            write_table(columns, given.out)
    robot, time = motion.robot, columns["time"]
    efforts = np.stack([columns[f"{joint}.effort"] for joint in robot.joint_names], -1)
    _, over = beyond_limits(robot, motion.q, effort=efforts)
    over = [one for one in over if one.quantity == "effort"]
    beyond += over
    units = dict(zip(robot.joint_names, robot.effort_units, strict=True))
    rows: dict[str, list[Any]] = {}
    for joint, peak in find_peaks(robot, columns).items():
        rows[joint] = [abs(peak.effort), peak.effort, peak.rms, units[joint], peak.time]
    # Forces and moments cannot be compared: only joints of the first joint's unit count.
    alike = [name for name in rows if units[name] == robot.effort_units[0]]
    worst = max(alike, key=lambda name: rows[name][0])
    _, effort, rms, unit, when = rows[worst]
    answer = f"{robot.name}: largest effort {effort:.4g} {unit} on {worst} at "
    if given.at is None:
        answer += f"{when:.4g} s, RMS {rms:.4g} {unit}"
        shown = [
            Column("peak", text=None),
            Column("effort_at_peak", text="peak"),
            Column("rms", text="RMS"),
            Column("unit"),
            Column("peak_at_s", "s", "peak at"),
        ]
    else:
        answer += "rest"
        shown = [Column(name) for name in ("effort", "unit", *TERMS_AT_REST)]
        terms = {joint: [columns[f"{joint}.effort_{t}"].item() for t in TERMS_AT_REST] for joint in rows}
        rows = {joint: [rows[joint][1], units[joint], *terms[joint]] for joint in rows}
    if over:
        bounds = (f"{one.joint} {abs(one.value):.4g} of {one.high:g} {one.unit}" for one in over)
        answer += f"; beyond the file's limits: {', '.join(bounds)}"
    return Report(
        motion.with_effort_warning(answer),
        [
            Fact("robot", robot.name),
            Fact("samples", len(time)),
            Fact("columns", len(columns)),
            payload_fact(motion.load),
            Fact("beyond_limits", [str(item) for item in beyond]),
        ],
        [Table("efforts", shown, rows, head="joint")],
        figures={} if given.at is not None else {"": lambda: plots.draw_torques(units, columns, answer)},
        notes=[
            *([f"table: {len(time)} rows, {len(columns)} columns"] if given.out else []),
            *motion.notes,
            *(f"beyond limits: {item}" for item in beyond if item not in over),
        ],
        files={"out": given.out},
    )
