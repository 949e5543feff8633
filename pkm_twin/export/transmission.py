# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write a linkage as a ROS package with a transmission of ros2_control, on its exported C.

The sources stand in ``transmission_package``; words between two ``@`` stand for the robot's names
and numbers.
"""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

from pkm_twin.export.c_package import Package
from pkm_twin.export.ros2_control import (
    fill_templates,
    package_name,
    printable_name,
    write_cpp_number,
    write_cpp_string,
)
from pkm_twin.robot.robot import Robot


def transmission_package(robot: Robot) -> dict[str, str]:
    """Return the files of the package, text by path.

    :raises ParameterError: a ratio of ``joint_map`` that changes with travel.
    """
    controller, package = robot.controller, package_name(robot, "transmission")
    controller.check_constant_ratios()
    code, shown = Package(robot, ("inverse", "joint_to_actuator", "actuator_to_joint", "gains")), printable_name(robot)
    drives = [
        f"  {{{write_cpp_string(name)}, {write_cpp_number(factor)}, {write_cpp_number(offset)}}},"
        for name, factor, offset in zip(controller.names, controller.factors, controller.offsets, strict=True)
    ]
    words = {
        "ROBOT": shown,
        "XMLROBOT": shown,
        "PACKAGE": package,
        "GUARD": package.upper(),
        "PREFIX": code.prefix,
        "JOINTS": str(code.m),
        "ACTUATORS": str(code.n),
        "ROLES": ", ".join(map(write_cpp_string, robot.pose_names)),
        "DRIVES": "\n".join(drives),
        "JOINTNAMES": ", ".join(f"`{name}`" for name in robot.pose_names),
        "ACTUATORNAMES": ", ".join(f"`{name}`" for name in controller.names),
        "JOINTROWS": _list_xml_elements("joint", robot.pose_names),
        "ACTUATORROWS": _list_xml_elements("actuator", controller.names),
    }
    result = {f"c/{code.prefix}.h": code.header(), f"c/{code.prefix}.c": code.source()}
    for path, text in fill_templates("transmission_package", words).items():
        # Headers are included by PACKAGE/NAME.hpp.
        result[path.replace("include/", f"include/{package}/")] = text
    return dict(sorted(result.items()))


def _list_xml_elements(kind: str, names: tuple[str, ...]) -> str:
    rows = [f"  <{kind} name={quoteattr(name)} role={quoteattr(name)}/>" for name in names]
    return "\n".join(rows)
