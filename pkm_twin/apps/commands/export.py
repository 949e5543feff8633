# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin export ...``: a robot as files of other software."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import click

from pkm_twin.apps.frame import Group, command
from pkm_twin.apps.options import OverwriteOption, RobotArgument
from pkm_twin.console import print_message, reject_existing
from pkm_twin.errors import ParameterError
from pkm_twin.extensions import Extensible
from pkm_twin.files import replace_file, replace_files
from pkm_twin.report import Fact, Report
from pkm_twin.robot.printers import Firmware, convert_to_printer, write_configuration
from pkm_twin.settings import setting


@dataclass(frozen=True, kw_only=True)
class ToFolder(RobotArgument, OverwriteOption):
    """Option of the folder to write a package to."""

    out: Path = setting(..., "folder of the new package", metavar="FOLDER")

    def write(self, files: Mapping[str, str]) -> Report:
        """Write all files, or none if one of them may not be replaced."""
        paths = [self.out / name for name in files]
        for path in paths:
            path.parent.mkdir(parents=True, exist_ok=True)
            reject_existing(path, self.overwrite)
        texts = (text.encode() for text in files.values())
        replace_files(dict(zip(paths, texts, strict=True)))
        written = list(map(str, paths))
        return Report(f"{self.out}: {len(written)} files", [Fact("files", written)], notes=written)


@dataclass(frozen=True, kw_only=True)
class ExportFileOption(RobotArgument, OverwriteOption):
    """Option of the exported file, which must be given."""

    out: Path = setting(..., "the file to write", writes=True)

    def write(self, data: bytes | str) -> Report:
        """Write the file."""
        replace_file(self.out, data.encode() if isinstance(data, str) else data)
        return Report(files={"out": self.out})


@dataclass(frozen=True, kw_only=True)
class TextOutput(RobotArgument, OverwriteOption):
    """Option of a file to write instead of printing."""

    out: Path | None = setting(None, "a file; default: print", writes=True)

    def write(self, text: str) -> Report:
        """Print the text, or write the file."""
        if self.out is None:
            return Report(facts=[Fact("text", text)], raw=text)
        replace_file(self.out, text.encode())
        return Report(files={"out": self.out})


@dataclass(frozen=True, kw_only=True)
class Moveit(ToFolder):
    """Write a MoveIt configuration: URDF, SRDF, limits, controllers, kinematics and a launch file.

    MoveIt sends its plans to delta_dynamics, which adds efforts for the controller. The package has
    a kinematics plugin for poses of the platform, in C++.
    """

    kinematics_plugin: str = setting(
        "", "plugin for the inverse kinematics; default: the package's own", metavar="NAME"
    )


@command()
def moveit(given: Moveit) -> Report:
    """Write a package for MoveIt."""
    from pkm_twin.export.moveit import moveit_package

    return given.write(moveit_package(given.machine(), given.kinematics_plugin))


@dataclass(frozen=True, kw_only=True)
class C(ToFolder):
    """Write kinematics, dynamics and elasticity as C99 that needs only math.h.

    The code is for controllers in C or C++, PLCs and Simulink. It uses no heap and no recursion,
    its loops are bounded, and every function returns a status. Functions use the payload of the
    robot's file; functions whose names end in _with take the payload as an argument.
    """


@command()
def c(given: C) -> Report:
    """Write a package in C."""
    from pkm_twin.export.c_package import c_package

    return given.write(c_package(given.machine()))


@dataclass(frozen=True, kw_only=True)
class PythonFile(ExportFileOption):
    """Write kinematics, torques and the transmission as one Python file.

    For training and for GPUs: the file needs only the array library. jax and torch differentiate
    its functions, and jax compiles and vectorises them. Each returns its results and a mask of
    valid samples.
    """

    array: str = setting("numpy", "array library", choices=("numpy", "jax", "torch"))


@command()
def python(given: PythonFile) -> Report:
    """Write a Python module."""
    from pkm_twin.export.python_file import python_file

    return given.write(python_file(given.machine(), given.array))


@dataclass(frozen=True, kw_only=True)
class Ros2Control(ToFolder):
    """Write a package of C++ plugins for ros2_control.

    A chainable feedforward controller (inverse dynamics plus PD), a gravity controller to fall back
    to, a kinematics_interface and an inverse_dynamics_solver use the robot's exported C. Build the
    package with colcon; it builds and runs without pkm_twin.
    """

    bandwidth: float = setting(0.0, "bandwidth of the gains; 0: no gains", metavar="HZ")


@command()
def ros2_control(given: Ros2Control) -> Report:
    """Write a package of controllers."""
    from pkm_twin.export.ros2_control import ros2_control_package

    return given.write(ros2_control_package(given.machine(), given.bandwidth))


@dataclass(frozen=True, kw_only=True)
class Transmission(ToFolder):
    """Write a package with the linkage as a transmission of ros2_control, in C++.

    The joint side has the pose coordinates, the actuator side the actuated joints in the
    controller's names and numbers. Build the package with colcon; it needs nothing of pkm_twin.
    """


@command()
def transmission(given: Transmission) -> Report:
    """Write a package with a transmission of ros2_control."""
    from pkm_twin.export.transmission import transmission_package

    return given.write(transmission_package(given.machine()))


@dataclass(frozen=True, kw_only=True)
class FunctionalMockupUnit(ExportFileOption):
    """Write a Functional Mock-up Unit, for model exchange and co-simulation.

    It contains C sources and, if this computer has a C compiler, a binary for this platform.
    """

    fmi: int = setting(3, "FMI version", choices={"2": 2, "3": 3})
    kind: str = setting("dynamics", "motion under efforts, or efforts of a motion", choices=("dynamics", "torques"))


@command()
def fmu(given: FunctionalMockupUnit) -> Report:
    """Write an archive of sources, with a binary where a compiler is found."""
    from pkm_twin.export.fmu import Fmu, find_compiler

    compiler = find_compiler()
    if compiler is None:
        print_message("warning: no C compiler found: the FMU has sources and no binary")
    return given.write(Fmu(given.machine(), given.fmi, given.kind).archive(compiler))


@dataclass(frozen=True, kw_only=True)
class Mjcf(ExportFileOption):
    """Write an MJCF for MuJoCo: bodies, loops as constraints, motors, a keyframe at home."""


@command()
def mjcf(given: Mjcf) -> Report:
    """Write an MJCF model with a keyframe in which the motors balance gravity."""
    from delta_dynamics import inverse_dynamics
    from pkm_twin.robot.robot_urdf import robot_mjcf

    robot = given.machine()
    home = robot.massive().graph.home
    efforts = inverse_dynamics(robot, home, 0.0 * home, 0.0 * home) - robot.friction.offset
    return given.write(robot_mjcf(robot, list(efforts)))


@dataclass(frozen=True, kw_only=True)
class Sdf(ExportFileOption):
    """Write an SDF model: links and all joints, also those that close the loops."""


@command()
def sdf(given: Sdf) -> Report:
    """Write a model for Gazebo."""
    from pkm_twin.robot.robot_urdf import robot_sdf

    return given.write(robot_sdf(given.machine()))


@dataclass(frozen=True, kw_only=True)
class Urdf(TextOutput):
    """Print a robot as a URDF, with its loops as constraints.

    The URDF is a tree with all joints, actuated and passive, and a <constraint> element for each
    loop that was cut. Parsers that know only trees ignore these elements. The base is the link
    base_link, the platform the link platform. The same robot always gives the same bytes.

    The ros2_control element has the controller's joints: with a joint_map they have their own names
    and numbers, and the joints of the tree follow them through <mimic>.
    """

    hardware_plugin: str = setting("mock_components/GenericSystem", "hardware plugin of ros2_control", metavar="NAME")
    prefix: str = setting("", "prefix for the names of all links and joints")
    no_ros2_control: bool = setting(False, "write no ros2_control element")


@command()
def urdf(given: Urdf) -> Report:
    """Write a URDF.

    :raises ParameterError: a prefix or a plugin that cannot be written.
    """
    from pkm_twin.robot.robot_urdf import robot_urdf

    if re.search(r"[^\w./-]", given.prefix, re.ASCII):
        raise ParameterError("--prefix", given.prefix, "letters, digits and . / _ -")
    plugin = given.hardware_plugin
    if not plugin.strip():
        raise ParameterError("--hardware-plugin", plugin, "a plugin, or --no-ros2-control")
    hardware = "" if given.no_ros2_control else plugin
    return given.write(robot_urdf(given.machine(), hardware, given.prefix))


@dataclass(frozen=True, kw_only=True)
class ToPrinter(TextOutput):
    """Write a linear Delta's geometry as a printer's configuration.

    Towers are turned about z so that the third is at 90 degrees.
    """

    firmware: Firmware = setting(..., "smoothieware cannot be written", choices={one.value: one for one in Firmware})


@command()
def printer(given: ToPrinter) -> Report:
    """Write a printer's configuration."""
    return given.write(write_configuration(convert_to_printer(given.machine()), given.firmware))


EXPORT_COMMANDS: Final = {
    "c": c,
    "python": python,
    "ros2-control": ros2_control,
    "transmission": transmission,
    "fmu": fmu,
    "urdf": urdf,
    "mjcf": mjcf,
    "sdf": sdf,
    "moveit": moveit,
    "printer": printer,
}
export = Group(
    "export",
    "Export a robot to other software.",
    Extensible("pkm_twin.exports", click.Command, EXPORT_COMMANDS, EXPORT_COMMANDS.__getitem__),
    "Design and export",
)
