# SPDX-License-Identifier: Apache-2.0
"""Arguments and options that several commands of ``pkm-twin`` share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from pkm_twin.errors import ParameterError

RobotName = Annotated[
    str, typer.Argument(help="a robot's name (see `pkm-twin robots`), a YAML file or a URDF")
]
Json = Annotated[bool, typer.Option("--json", help="machine-readable output")]
OptionalRobot = Annotated[
    Optional[str],  # noqa: UP045  typer of Ubuntu 24.04 reads no unions
    typer.Option("--robot", help="a robot's name or file; default: the robot that the bag names"),
]
BagPath = Annotated[
    Path, typer.Argument(help="a bag: an MCAP file or a rosbag2 folder", show_default=False)
]
BagTopics = Annotated[
    list[str],
    typer.Option(
        "--topic",
        help="topic of joint states or wrenches; default: found by the robot's joint names",
    ),
]
Payload = Annotated[
    Optional[str],  # noqa: UP045  typer of Ubuntu 24.04 reads no unions
    typer.Option(
        help="payload on the platform: MASS[,x,y,z], kg, m from the platform's reference point; "
        "default: that of the bag or the robot file"
    ),
]
LoadTimes = Annotated[
    Optional[str],  # noqa: UP045
    typer.Option(
        help="intervals in which --payload is held: FROM,TO[,FROM,TO...], s from the start; "
        "default: always"
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
    Optional[str],  # noqa: UP045  typer reads it
    typer.Option(help="for a URDF: the link that carries the tool", show_default=False),
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
