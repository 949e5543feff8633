# SPDX-License-Identifier: Apache-2.0
"""The commands ``robots``, ``info``, ``urdf`` and ``convert``: what a robot is."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table
from rich.text import Text

from pkm_twin.apps.options import Json, Platform, RobotName
from pkm_twin.console import print_json, refuse_existing, table_console
from pkm_twin.errors import ParameterError
from pkm_twin.options import OptionalPath, file_name


def info(
    robot: RobotName,
    platform: Platform = None,
    as_json: Json = False,
    picture: Annotated[
        OptionalPath,
        typer.Option(
            help="draw the robot at home into this file, .png or .svg", callback=file_name
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the picture")] = False,
) -> None:
    """Show a robot's parameters, with units.

    Prints dimensions, masses, limits, home pose and mobility. For an overconstrained mechanism it
    also lists the joint reactions that rigid-body equations do not determine.
    """
    from pkm_twin import load
    from pkm_twin.apps.describe import describe, lines

    if picture is not None:
        refuse_existing(picture, overwrite)
    loaded = load(robot, platform=platform)
    data = describe(loaded)
    if picture is not None:
        from pkm_twin.apps import drawing

        drawing.picture(loaded, picture)
    if as_json:
        # JSON has no infinity: a free axis is null.
        print_json(_finite(data))
        return
    table = Table(show_header=False)
    for what, value in lines(data):
        table.add_row(what, Text(value))
    table_console().print(table)


def _finite(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_finite(value) for value in data]
    return None if isinstance(data, float) and not np.isfinite(data) else data


def urdf(
    robot: RobotName,
    platform: Platform = None,
    hardware_plugin: Annotated[
        str, typer.Option(help="hardware plugin of ros2_control", metavar="NAME")
    ] = "mock_components/GenericSystem",
    prefix: Annotated[
        str, typer.Option(help="prefix for the names of all links and joints", metavar="TEXT")
    ] = "",
    no_ros2_control: Annotated[
        bool, typer.Option("--no-ros2-control", help="write no ros2_control element")
    ] = False,
) -> None:
    """Print a robot as a URDF, with its loops as constraints.

    The URDF is a tree with all joints, actuated and passive, and a <constraint> element for each
    loop that was cut. Parsers that know only trees ignore these elements. The base is the link
    base_link, the platform the link platform. The same robot always gives the same bytes.

    The ros2_control element has the controller's joints: with a joint_map they have their own names
    and numbers, and the joints of the tree follow them through <mimic>.
    """
    from pkm_twin import load
    from pkm_twin.robot.robot_urdf import robot_urdf

    if re.search(r"[^\w./-]", prefix, re.ASCII):
        raise ParameterError("--prefix", prefix, "letters, digits and . / _ -")
    if not hardware_plugin.strip():
        raise ParameterError("--hardware-plugin", hardware_plugin, "a plugin, or --no-ros2-control")
    loaded = load(robot, platform=platform)
    typer.echo(robot_urdf(loaded, "" if no_ros2_control else hardware_plugin, prefix), nl=False)


def convert(robot: RobotName, platform: Platform = None) -> None:
    """Convert a robot, or a URDF with its loops, to a YAML.

    Prints a commented YAML of bodies, joints and rods. It is a complete robot: edit it, and use its
    path in place of a robot's name.
    """
    from pkm_twin import load
    from pkm_twin.machine.machine_yaml import describe_machine_yaml
    from pkm_twin.robot.catalogue import TREES
    from pkm_twin.robot.robot_urdf import robot_description
    from pkm_twin.robot.urdf_read import read_urdf

    path = Path(robot)
    if path.suffix in TREES:
        data = read_urdf(path, platform=platform)
    else:
        data = robot_description(load(robot, platform=platform))
    typer.echo(describe_machine_yaml(data), nl=False)
