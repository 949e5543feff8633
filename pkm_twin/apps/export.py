# SPDX-License-Identifier: Apache-2.0
"""The commands ``pkm-twin export ...``: a robot as files of other software."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from pkm_twin.apps.options import Platform, RobotName
from pkm_twin.apps.printer import export_printer
from pkm_twin.console import refuse_existing
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.files import replace_file
from pkm_twin.options import Commands
from pkm_twin.robot.robot import Robot

app = Commands(help="Export a robot to other software.", no_args_is_help=True)

SHARE = 0.5
"""Fraction of the effort left at home after gravity that a planner may use to accelerate."""


@app.command()
def moveit(
    robot: RobotName,
    out: Annotated[Path, typer.Option(help="folder of the new package")],
    kinematics_plugin: Annotated[
        str, typer.Option(help="MoveIt's plugin for the inverse kinematics", metavar="NAME")
    ] = "",
    platform: Platform = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace its files")] = False,
) -> None:
    """Write a MoveIt configuration: URDF, SRDF, limits, controllers, kinematics and a launch file.

    MoveIt sends its plans to delta_dynamics, which adds efforts for the controller. Goals in joint
    space work as they are; goals of the platform's pose need a kinematics plugin.
    """
    from pkm_twin import load
    from pkm_twin.export.moveit import moveit_package

    loaded = load(robot, platform=platform)
    _write(out, moveit_package(loaded, _accelerations(loaded), kinematics_plugin), overwrite)


@app.command()
def c(
    robot: RobotName,
    out: Annotated[Path, typer.Option(help="folder of the new package")],
    platform: Platform = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace its files")] = False,
) -> None:
    """Write kinematics, dynamics and elasticity as C99 that needs only math.h.

    The code is for controllers in C or C++, PLCs and Simulink. It uses no heap and no recursion,
    its loops are bounded, and every function returns a status. Functions use the payload of the
    robot's file; functions whose names end in _with take the payload as an argument.
    """
    from pkm_twin import load
    from pkm_twin.export.c_package import c_package

    _write(out, c_package(load(robot, platform=platform)), overwrite)


@app.command("ros2-control")
def ros2_control(
    robot: RobotName,
    out: Annotated[Path, typer.Option(help="folder of the new package")],
    bandwidth: Annotated[
        float,
        typer.Option(
            help="bandwidth for the gains, from the masses at home; 0: no gains", metavar="HZ"
        ),
    ] = 0.0,
    platform: Platform = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace its files")] = False,
) -> None:
    """Write a package of C++ plugins for ros2_control.

    A chainable feedforward controller (inverse dynamics plus PD), a gravity controller to fall back
    to, a kinematics_interface and an inverse_dynamics_solver use the robot's exported C. Build the
    package with colcon; it builds and runs without pkm_twin.
    """
    from pkm_twin import load
    from pkm_twin.export.ros2_control import ros2_control_package

    _write(out, ros2_control_package(load(robot, platform=platform), bandwidth), overwrite)


@app.command()
def fmu(
    robot: RobotName,
    out: Annotated[Path, typer.Option(help="the file to write", metavar="FILE.fmu")],
    fmi: Annotated[int, typer.Option(help="FMI version, 2 or 3")] = 3,
    kind: Annotated[
        str, typer.Option(help="dynamics: motion under efforts; torques: efforts of a motion")
    ] = "dynamics",
    platform: Platform = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the file")] = False,
) -> None:
    """Write a Functional Mock-up Unit, for model exchange and co-simulation.

    It contains C sources and, if this computer has a C compiler, a binary for this platform.
    """
    from pkm_twin import load
    from pkm_twin.export import fmu as units

    if fmi not in units.VERSIONS:
        raise ParameterError("--fmi", fmi, "2 or 3")
    if kind not in units.KINDS:
        raise UnknownNameError("--kind", kind, units.KINDS)
    refuse_existing(out, overwrite)
    compiler = units.found_compiler()
    if compiler is None:
        typer.echo("warning: no C compiler found: the FMU has sources and no binary", err=True)
    replace_file(out, units.Fmu(load(robot, platform=platform), fmi, kind).archive(compiler))
    typer.echo(out)


@app.command()
def mjcf(
    robot: RobotName,
    out: Annotated[Path, typer.Option(help="the file to write", metavar="FILE.xml")],
    platform: Platform = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the file")] = False,
) -> None:
    """Write an MJCF for MuJoCo: bodies, loops as constraints, motors, a keyframe at home."""
    from delta_dynamics import inverse_dynamics
    from pkm_twin import load
    from pkm_twin.robot.robot_urdf import robot_mjcf

    loaded = load(robot, platform=platform)
    home = loaded.massive().graph.home
    efforts = inverse_dynamics(loaded, home, 0.0 * home, 0.0 * home) - loaded.friction.offset
    refuse_existing(out, overwrite)
    replace_file(out, robot_mjcf(loaded, list(efforts)).encode())
    typer.echo(out)


@app.command()
def sdf(
    robot: RobotName,
    out: Annotated[Path, typer.Option(help="the file to write", metavar="FILE.sdf")],
    platform: Platform = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the file")] = False,
) -> None:
    """Write an SDF model: links and all joints, also those that close the loops."""
    from pkm_twin import load
    from pkm_twin.robot.robot_urdf import robot_sdf

    refuse_existing(out, overwrite)
    replace_file(out, robot_sdf(load(robot, platform=platform)).encode())
    typer.echo(out)


def _write(out: Path, files: Mapping[str, str], overwrite: bool) -> None:
    """Write the files of a package; all or, where one may not be replaced, none."""
    for name in files:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        refuse_existing(out / name, overwrite)
    for name, text in files.items():
        replace_file(out / name, text.encode())
        typer.echo(out / name)


def _accelerations(robot: Robot) -> list[float]:
    """What each drive can do by itself at home beside the weight, shape (n,).

    Infinite without effort limits.
    """
    from delta_dynamics import inverse_dynamics, mass_matrix

    limits = robot.limits.effort
    if limits is None:
        return [np.inf] * len(robot.joint_names)
    q = robot.inverse(robot.home())
    weight = np.abs(inverse_dynamics(robot, q, 0.0 * q, 0.0 * q))
    inertia = np.diag(mass_matrix(robot, q))
    with np.errstate(divide="ignore"):
        return list(SHARE * np.maximum(limits - weight, 0.0) / inertia)


app.command("printer")(export_printer)
