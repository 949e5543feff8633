# SPDX-License-Identifier: Apache-2.0
"""Arguments and options that several commands of ``pkm-twin`` share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from pkm_twin.console import refuse_existing
from pkm_twin.errors import ParameterError
from pkm_twin.files import STANDARD
from pkm_twin.options import OptionalPath, OptionalText, file_name

REFUSED, SALVAGED = 1, 3
"""Exit codes: rejected; damaged, with messages that `recover` saves."""

RobotName = Annotated[
    str,
    typer.Argument(help="a robot's name (see `pkm-twin robots`), or its YAML, URDF, MJCF, SDF"),
]
Json = Annotated[bool, typer.Option("--json", help="machine-readable output")]
OptionalRobot = Annotated[
    OptionalText,
    typer.Option("--robot", help="a robot's name or file; default: the robot that the bag names"),
]
BagPath = Annotated[Path, typer.Argument(help="a bag: an MCAP file or a rosbag2 folder")]
BagTopics = Annotated[
    list[str],
    typer.Option(
        "--topic",
        help="topic of joint states or wrenches; default: found by the robot's joint names",
    ),
]
Payload = Annotated[
    OptionalText,
    typer.Option(
        help="payload on the platform: MASS[,x,y,z], kg, m from the platform's reference point; "
        "default: that of the bag or the robot file"
    ),
]
LoadTimes = Annotated[
    OptionalText,
    typer.Option(
        help="intervals in which --payload is held: FROM,TO[,FROM,TO...], s from the start; "
        "default: always"
    ),
]
Follow = Annotated[
    OptionalText,
    typer.Option(
        help="which columns of a table with joint positions and pose are the motion: joints, or "
        "pose, which plans it again for this robot; default: both, which have to agree"
    ),
]
BeyondLimits = Annotated[
    bool,
    typer.Option(
        "--beyond-limits", help="also compute outside the joint limits, and mark these results"
    ),
]
Accept = Annotated[
    bool,
    typer.Option(
        "--accept",
        help="also use data that this machine cannot have produced, and mark the results",
    ),
]
Platform = Annotated[
    OptionalText, typer.Option(help="for a URDF, MJCF or SDF: the link that carries the tool")
]
OverwriteBoth = Annotated[bool, typer.Option("--overwrite", help="replace both files")]
LimitShare = Annotated[
    float, typer.Option(help="fraction of the file's effort and velocity limits to use")
]
SampleRate = Annotated[float, typer.Option(help="samples per second in the file", min=1.0, max=1e5)]
MotionOut = Annotated[
    OptionalPath,
    typer.Option(
        help="file to write: FILE.mcap (a JointTrajectory with efforts), or a table, FILE.csv, "
        ".parquet or .mat",
        callback=file_name,
    ),
]


def load_of(payload: str | None, times: str | None) -> Any:
    """The payload that a command line tells of, None where it tells of none."""
    from pkm_twin.apps.loads import Load, parse_payload, parse_times

    if payload is None:
        if times is not None:
            raise typer.BadParameter("--load-times needs --payload")
        return None
    try:
        spans = () if times is None else parse_times(times)
        return Load(*parse_payload(payload), spans)
    except ParameterError as error:
        raise typer.BadParameter(str(error)) from None


def loaded(robot: str, platform: str | None, payload: str | None) -> tuple[Any, Any]:
    """The robot of a command line with its payload, and that payload, None where none is given."""
    from pkm_twin import load

    machine, carried = load(robot, platform=platform), load_of(payload, None)
    return (machine if carried is None else carried.on(machine)), carried


def drawing_of(
    out: Path | None,
    picture: bool,
    overwrite: bool,
    endings: Sequence[str],
    source: Path | None = None,
) -> Path | None:
    """The picture's name beside a file to write, None for none, both checked before the work.

    :raises ParameterError: another ending.
    :raises PkmTwinError: a file that may not be replaced.
    """
    piped = str(out) == STANDARD
    if out is None:
        return None
    if out.suffix not in endings and not piped:
        raise ParameterError("out", str(out), f"a name that ends in {' or '.join(endings)}")
    drawing = out.with_suffix(".png") if picture and not piped else None
    for target in (out, drawing):
        if target is not None:
            refuse_existing(target, overwrite, source)
    return drawing
