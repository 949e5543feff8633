# SPDX-License-Identifier: Apache-2.0
"""The command ``torques``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkm_twin.apps.options import (
    BagTopics,
    BeyondLimits,
    Follow,
    LoadTimes,
    Payload,
    Platform,
    RobotName,
    read_options,
)
from pkm_twin.console import progress, refuse_existing, writing
from pkm_twin.files import STANDARD
from pkm_twin.options import file_name


def torques(
    robot: RobotName,
    motion: Annotated[Path, typer.Argument(help="a bag, or a CSV with a header row")],
    out: Annotated[
        Path,
        typer.Option(
            help="table to write, .csv, .parquet or .mat; the picture has the same name with .png",
            callback=file_name,
        ),
    ] = Path("torques.csv"),
    picture: Annotated[bool, typer.Option(help="plot efforts and terms as a PNG")] = True,
    topic: BagTopics = [],  # noqa: B006  typer copies it
    follow: Follow = None,
    payload: Payload = None,
    load_times: LoadTimes = None,
    platform: Platform = None,
    beyond_limits: BeyondLimits = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="replace the table and the picture")
    ] = False,
) -> None:
    """Compute torques, their terms and joint reactions.

    CSV columns: time (s) and JOINT.position (rad or m) for every actuated joint. Optional:
    JOINT.velocity and JOINT.acceleration, which are otherwise differentiated from the positions,
    and the wrench on the platform, fx fy fz mx my mz (N, N m, base axes). `pkm-twin info` lists the
    joint names.

    The table has one row per sample: each joint's effort (N m or N), the terms that sum to it
    (JOINT.effort_gravity, _inertia, _velocity, _payload, _friction, _external), the measured effort
    of a bag, and force and moment in every joint. A reaction that rigid-body equations do not
    determine is empty. With --beyond-limits, the column beyond_limits is 1 where a joint is outside
    its limits.
    """
    from pkm_twin import load
    from pkm_twin.bags.storage import is_bag
    from pkm_twin.paths.along import torque_table
    from pkm_twin.recordings import read, write_table
    from pkm_twin.recordings.tables import check_target
    from pkm_twin.report import plots
    from pkm_twin.robot.limits import beyond_limits as find_beyond
    from pkm_twin.robot.limits import refuse_beyond

    check_target(out)
    drawing, piped = out.with_suffix(".png"), str(out) == STANDARD
    picture = picture and not piped
    for target in (out, drawing) if picture else (out,):
        refuse_existing(target, overwrite, motion)
    how = read_options(topic, payload, load_times, follow, planned=True)
    if topic and not is_bag(motion):
        raise typer.BadParameter(f"--topic is for bags; {motion} is read as CSV")
    data = read(motion, load(robot, platform=platform), how).with_rates()
    _, found = find_beyond(data.robot, data.q, data.qd)
    if not beyond_limits:
        refuse_beyond(found)
    with progress("torques", len(data.time)) as update:
        columns = torque_table(data, update)
    with writing(out):
        write_table(columns, out)
        typer.echo(f"{out}: {len(data.time)} rows, {len(columns)} columns", err=piped)
        if picture:
            typer.echo(f"{plots.save(plots.torques(data, columns), drawing)}")
    for note in (*data.notes, *(f"beyond limits: {item}" for item in found)):
        typer.echo(note, err=piped)
