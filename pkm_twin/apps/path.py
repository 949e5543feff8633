# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin path``: a motion along waypoints, a cycle or a circle, as a trajectory or table."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer
from numpy.typing import NDArray

from pkm_twin.apps.options import (
    Json,
    LimitShare,
    MotionOut,
    OverwriteBoth,
    Payload,
    Platform,
    RobotName,
    SampleRate,
    drawing_of,
    loaded,
)
from pkm_twin.console import answer, numbers, writing
from pkm_twin.errors import ParameterError, UnknownNameError, warn
from pkm_twin.files import STANDARD, parse_numbers
from pkm_twin.options import OptionalFloat, OptionalPath, OptionalText
from pkm_twin.paths.geometry import Path as Way
from pkm_twin.paths.geometry import Space
from pkm_twin.paths.motion import TimedPath
from pkm_twin.recordings import Load, kinds_of, read_table
from pkm_twin.recordings.tables import PAYLOAD
from pkm_twin.robot.robot import Robot

Array = NDArray[np.float64]

ENDINGS: Final = (".mcap", ".csv", ".parquet", ".mat")
OPTIONS: Final = ("blend", "dwell", "arc")
"""Columns of waypoints beside their coordinates."""
MILLIMETRES: Final = 1e-3
LEAST_CYCLE: Final = 1.0
"""Millimetres below which a cycle's numbers look like metres."""


def read_waypoints(
    file: Path, robot: Robot, blend: float | None, carried: Load | None = None
) -> Way:
    """The path of a CSV of waypoints, see :func:`path_command`.

    :param carried: the payload of the motion; that of the table is not used.
    :raises ParameterError: a column is missing, unknown, or a number is out of range.
    """
    from pkm_twin.apps.tables import CHOSEN
    from pkm_twin.paths import lines, through

    columns = read_table(file, kinds_of(robot), CHOSEN.get())
    joints = [f"{name}.position" for name in robot.joint_names]
    words = ("velocity", "acceleration", "effort")
    others = {f"{j}.{word}" for j in (*robot.joint_names, *robot.pose_names) for word in words}
    by_joints = any(name in columns for name in joints)
    by_pose = any(name in columns for name in robot.pose_names)
    space: Space = "pose" if by_pose else "joint"
    needed = list(robot.pose_names) if by_pose else joints
    if not (by_pose or by_joints):
        known = f"{', '.join(robot.pose_names)} or {', '.join(joints)}"
        raise ParameterError(f"{file}: columns", ", ".join(columns), known)
    points = columns.stack(needed)
    known_names = {*robot.pose_names, *joints, *others, *OPTIONS, *PAYLOAD, "time"}
    for name in columns:
        if name not in known_names:
            raise UnknownNameError(f"{file}: column", name, known_names)
    planned = float(columns.get(PAYLOAD[0], np.zeros(1)).max())
    if planned > 0.0 and carried is None:
        warn(file, f"its payload of {planned:g} kg is not used; give --payload")
    if blend is None and not any(name in columns for name in OPTIONS):
        return through(robot, points, space=space)
    given = {name: columns[name] for name in OPTIONS if name in columns}
    if "arc" in given and not np.isin(given["arc"], (0.0, 1.0)).all():
        raise ParameterError(f"{file}: arc", given["arc"].tolist(), "0 or 1")
    arc = given.get("arc", np.zeros(len(points))) == 1.0
    rounded = given.get("blend", np.full(len(points), blend or 0.0))
    if "blend" not in given:
        # An arc's ends and middle are no corners.
        near = arc | np.roll(arc, 1) | np.roll(arc, -1)
        rounded = np.where(near, 0.0, rounded)
    try:
        return lines(
            robot, points, blend=rounded, dwell=given.get("dwell", 0.0), arc=arc, space=space
        )
    except ParameterError as error:
        raise ParameterError(f"{file}: {error.field}", error.value, error.bound) from None


def _chosen(
    machine: Robot, waypoints: Path | None, cycle: str | None, circle: float | None,
    at: str | None, direction: float, blend: float | None, dwell: float, carried: Load | None,
) -> Way:  # fmt: skip
    """The path that a command line asks for."""
    from pkm_twin import paths

    asked = [name for name, value in (("WAYPOINTS", waypoints), ("--cycle", cycle),
                                      ("--circle", circle)) if value is not None]  # fmt: skip
    if len(asked) != 1:
        raise typer.BadParameter("give one of WAYPOINTS.csv, --cycle and --circle")
    if waypoints is not None:
        if at is not None or dwell or direction:
            raise typer.BadParameter("--at, --direction and --dwell are for --cycle and --circle")
        return read_waypoints(waypoints, machine, blend, carried)
    names = ", ".join(machine.pose_names)
    centre = None if at is None else numbers(at, len(machine.pose_names), f"a pose: {names}")
    if circle is not None:
        home = machine.home() if centre is None else np.array(centre)
        return paths.circle(machine, home, circle)
    lengths = parse_numbers(cycle or "")
    if len(lengths) not in (2, 3) or min(lengths) < LEAST_CYCLE:
        raise typer.BadParameter(
            f"--cycle {cycle}: HEIGHT,WIDTH[,LIFT] in millimetres, for example 25,305,25"
        )
    metres = [MILLIMETRES * value for value in lengths]
    return paths.cycle(
        machine, *metres, at=centre, direction=math.radians(direction), blend=blend, dwell=dwell
    )


def path_command(
    robot: RobotName,
    waypoints: Annotated[
        OptionalPath, typer.Argument(help="CSV of waypoints, unless --cycle or --circle is given")
    ] = None,
    cycle: Annotated[
        OptionalText,
        typer.Option(
            help="pick-and-place cycle there and back: HEIGHT,WIDTH[,LIFT] in mm, as in 25,305,25"
        ),
    ] = None,
    circle: Annotated[OptionalFloat, typer.Option(help="follow a circle of this radius, m")] = None,
    at: Annotated[
        OptionalText,
        typer.Option(
            help="centre of --cycle (between pick and place) or --circle: the pose's coordinates, "
            "separated by commas; default: home"
        ),
    ] = None,
    direction: Annotated[
        float, typer.Option(help="direction of the cycle in the xy plane, degrees from x towards y")
    ] = 0.0,
    blend: Annotated[
        OptionalFloat,
        typer.Option(
            help="distance from a corner at which rounding begins, m; 0 stops at every waypoint; "
            "default: a smooth curve through the waypoints; in a cycle 0.8 of its rise",
            min=0.0,
        ),
    ] = None,
    dwell: Annotated[float, typer.Option(help="dwell at pick and at place, s", min=0.0)] = 0.0,
    fastest: Annotated[
        bool, typer.Option("--fastest", help="plan the shortest motion within all limits")
    ] = False,
    law: Annotated[
        str,
        typer.Option(help="motion law without --fastest: quintic or s-curve, from stop to stop"),
    ] = "quintic",
    duration: Annotated[
        OptionalFloat, typer.Option(help="duration of the motion, s; default: the shortest")
    ] = None,
    effort: Annotated[
        OptionalText,
        typer.Option(
            help="effort limit, one for all joints or one per joint, N m or N; default: the file's"
        ),
    ] = None,
    velocity: Annotated[
        OptionalText,
        typer.Option(help="velocity limit of the joints, rad/s or m/s; default: the file's"),
    ] = None,
    acceleration: Annotated[
        OptionalText,
        typer.Option(help="acceleration limit of the joints, rad/s2 or m/s2; default: none"),
    ] = None,
    jerk: Annotated[
        OptionalText, typer.Option(help="jerk limit of the joints, rad/s3 or m/s3; default: none")
    ] = None,
    speed: Annotated[
        OptionalFloat, typer.Option(help="speed limit of the tool point, m/s; default: none")
    ] = None,
    share: LimitShare = 1.0,
    singularity: Annotated[
        float, typer.Option(help="least singularity index on the path, 0 to 1", min=0.0, max=1.0)
    ] = 0.01,
    shaper: Annotated[
        OptionalText,
        typer.Option(
            help="input shaper for the first natural frequency, which depends on the pose: zv, or "
            "zvd, which tolerates more error of the frequency; costs half or one vibration at each "
            "stop"
        ),
    ] = None,
    damping: Annotated[
        OptionalFloat,
        typer.Option(help="damping ratio of that mode; default: `modal_damping` of the robot file"),
    ] = None,
    payload: Payload = None,
    platform: Platform = None,
    rate: SampleRate = 1000.0,
    out: MotionOut = None,
    picture: Annotated[
        bool, typer.Option(help="plot which limit binds where; the PNG has the file's name")
    ] = True,
    overwrite: OverwriteBoth = False,
    as_json: Json = False,
) -> None:
    """Plan a motion along a path, also the fastest one.

    The CSV of waypoints has a header row and the pose's coordinates (m, rad) or JOINT.position of
    every joint. The platform passes through the points on a smooth curve without a stop. With a
    column blend (m), dwell (s) or arc (1: the middle of an arc), or with --blend, it follows
    straight lines and arcs, and stops where blend is 0. It does not stop between an arc and a
    tangent line.

    --fastest finds the shortest time within effort, velocity, acceleration, jerk and speed limits.
    It uses the exact inverse dynamics with payload and friction. The command prints the duration,
    which limit binds when, and the largest fraction of each limit that the motion uses.

    The CSV that it writes has the columns time, JOINT.position, JOINT.velocity, JOINT.acceleration,
    JOINT.effort, the pose's coordinates with their velocity and acceleration, and the payload
    (payload.mass, and payload.x, .y, .z where given). `pkm-twin torques`, `size`, `loads` and
    `design` read it.
    """
    from pkm_twin.apps.path_report import draw_limits, report, write
    from pkm_twin.paths import timed

    drawing = drawing_of(out, picture, overwrite, ENDINGS, waypoints)
    machine, carried = loaded(robot, platform, payload)
    made = _chosen(machine, waypoints, cycle, circle, at, direction, blend, dwell, carried)
    bounds: dict[str, Any] = {
        name: None if text is None else _limit(name, text, machine)
        for name, text in (
            ("effort", effort), ("velocity", velocity), ("acceleration", acceleration),
            ("jerk", jerk),
        )
    }  # fmt: skip
    motion = timed(
        machine, made, "fastest" if fastest else law, duration=duration, speed=speed, share=share,
        singularity=singularity, **bounds,
    )  # fmt: skip
    if shaper is not None:
        motion = _shaped(motion, shaper, damping, singularity)
    elif damping is not None:
        raise typer.BadParameter("--damping is for --shaper")
    with writing(out):
        if out is not None:
            write(motion, motion.uniform(rate), carried, out, overwrite)
        if drawing is not None:
            draw_limits(motion, drawing)
    data, text = report(motion, carried, out, drawing)
    answer(data, text, as_json, piped=str(out) == STANDARD)


def _shaped(motion: TimedPath, shaper: str, damping: float | None, singularity: float) -> TimedPath:
    """The motion with an input shaper for the first mode of its robot, actuators locked."""
    from pkm_twin.paths import shaped
    from stiffness_monitor.modes import natural_frequencies
    from stiffness_monitor.vibration import damping_ratios

    robot = motion.robot
    return shaped(
        motion, shaper, lambda poses: natural_frequencies(robot, poses, 1)[..., 0],
        float(damping_ratios(robot, damping, 1)[0]), singularity=singularity,
    )  # fmt: skip


def _limit(name: str, text: str, machine: Robot) -> list[float]:
    values = parse_numbers(text)
    n = machine.joints_count
    if len(values) not in (1, n) or min(values) <= 0.0:
        raise typer.BadParameter(f"--{name} {text}: one number above 0, or {n} with commas between")
    return values
