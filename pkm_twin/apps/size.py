# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin size``: what drives must give for a recorded or planned motion."""

from __future__ import annotations

from typing import Annotated

import typer

from pkm_twin.apps.options import (
    BagTopics,
    Follow,
    Json,
    LoadTimes,
    Payload,
    Platform,
    RobotName,
    load_of,
    read_options,
)
from pkm_twin.console import answer, numbers, refuse_existing, writing
from pkm_twin.errors import LEAST_LIMIT, check_limit
from pkm_twin.options import OptionalFloat, OptionalPath, OptionalText, file_name


def size(
    robot: RobotName,
    motion: Annotated[
        OptionalPath, typer.Argument(help="a recording or a path: MCAP, rosbag2 folder or CSV")
    ] = None,
    drives: Annotated[
        OptionalPath,
        typer.Option(
            help="YAML of motors to compare, or `shipped` for the motors in config/drives"
        ),
    ] = None,
    motor: Annotated[
        list[str], typer.Option(help="compare only this motor of the drives file; may be repeated")
    ] = [],  # noqa: B006  typer copies it
    ratio: Annotated[
        OptionalFloat,
        typer.Option(
            help="gear of the joints that turn, where the file has no drive: turns of the motor "
            "per turn of the joint",
            min=1e-6,
            max=1e6,
        ),
    ] = None,
    lead: Annotated[
        OptionalFloat,
        typer.Option(
            help="screw or belt of the joints that slide, where the file has no drive: m per turn "
            "of the motor",
            min=1e-6,
            max=1e6,
        ),
    ] = None,
    efficiency: Annotated[
        float, typer.Option(help="efficiency of --ratio and --lead", min=1e-3, max=1.0)
    ] = 1.0,
    over_workspace: Annotated[
        OptionalText,
        typer.Option(
            help="in place of a motion: SPEED,ACCELERATION of the tool point (m/s, m/s2), in the "
            "worst direction at the worst pose"
        ),
    ] = None,
    singularity: Annotated[
        float,
        typer.Option(help="least singularity index for --over-workspace, 0 to 1", min=0.0, max=1.0),
    ] = 0.05,
    efforts: Annotated[
        str, typer.Option(help="efforts to use: those of the motion's file if it has any, or model")
    ] = "file",
    follow: Follow = None,
    payload: Payload = None,
    load_times: LoadTimes = None,
    platform: Platform = None,
    topic: BagTopics = [],  # noqa: B006
    picture: Annotated[
        OptionalPath,
        typer.Option(help="write a PNG of torque against speed for each drive", callback=file_name),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the picture")] = False,
    as_json: Json = False,
) -> None:
    """Size the drives for a motion.

    Prints for each drive: peak and RMS effort (RMS heats the motor), speed, power, net energy
    (supplied minus regenerated), and the machine's inertia at the joint. If the robot's file has a
    section drive (inertia, ratio or lead, efficiency), or with --ratio or --lead, it prints the
    same at the motor, and the inertia ratio. The shipped robots have no gear in their files.

    --drives compares each motor of a file with the needs of each drive, in percent of what the
    motor can do: peak torque against its torque curve, RMS torque against its continuous torque,
    and speed. The inertia ratio is that of load to rotor. The motor's rotor replaces the one in the
    robot's file.

    The motion is a CSV of `pkm-twin path` or `pkm-twin torques`, a bag of joint states, or a bag
    with a JointTrajectory.
    """
    from pkm_twin import load
    from pkm_twin.apps import sizes
    from pkm_twin.paths.along import compared
    from pkm_twin.paths.sizing import Gear
    from pkm_twin.recordings import read

    if efforts not in ("file", "model"):
        raise typer.BadParameter(f"--efforts {efforts}: file or model")
    if picture is not None:
        refuse_existing(picture, overwrite, motion)
    if (motion is None) == (over_workspace is None):
        raise typer.BadParameter("give a recording or path, or --over-workspace")
    if motor and drives is None:
        raise typer.BadParameter("--motor selects from a drives file; give --drives too")
    carried = load_of(payload, load_times)
    machine = load(robot, platform=platform)
    motors = [] if drives is None else sizes.read_motors(drives, motor)
    geared = ratio is not None or lead is not None
    if over_workspace is not None and (geared or motors):
        raise typer.BadParameter(
            "--over-workspace reports joints; leave out --drives, --ratio and --lead"
        )
    gear = Gear(ratio, lead, efficiency) if geared else None
    if over_workspace is not None:
        speed, change = numbers(over_workspace, 2, "SPEED,ACCELERATION")
        for value in (speed, change):
            # The other alone may be asked for.
            check_limit("over-workspace", value or LEAST_LIMIT)
        if carried is not None:
            machine = carried.on(machine)
        data, text = sizes.worst_report(machine, speed, change, singularity)
    else:
        assert motion is not None  # noqa: S101  one of the two is given
        how = read_options(topic, payload, load_times, follow, planned=True)
        taken = compared(read(motion, machine, how).with_rates(), efforts)
        result = sizes.duties(taken, motors, gear)
        data, text = sizes.report(taken, result)
        if picture is not None:
            with writing(picture):
                sizes.draw(taken, result, picture)
            text += f"\n{picture}"
    answer(data, text, as_json)
