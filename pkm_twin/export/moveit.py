# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A MoveIt configuration of a robot: a ROS package with its URDF, SRDF and settings.

MoveIt knows trees. Its planning group is the actuated joints; the passive joints of the tree are
declared passive, so that nobody waits for their states. Inverse kinematics that knows the loops is
a plugin of the package, on the robot's exported C; its source stands in ``moveit_package``. A
numeric solver only solves the chain of the tree that leads to the platform, a group of its own
where that chain has a drive (a Delta's has none).
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from itertools import combinations
from typing import Any, Final
from xml.sax.saxutils import escape

import numpy as np
import yaml

from delta_dynamics import inverse_dynamics, mass_matrix
from pkm_twin.errors import ParameterError
from pkm_twin.export.c_package import c_identifier, c_package
from pkm_twin.export.ros2_control import (
    fill_templates,
    package_name,
    printable_name,
    write_cpp_number,
    write_cpp_string,
)
from pkm_twin.kinematics.pose import Coordinate, Entry
from pkm_twin.machine.loop_tree import LoopTree, SingleAxisJoint
from pkm_twin.machine.urdf_write import GROUND, PLATFORM, list_single_joints
from pkm_twin.robot.clearance import distance
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.robot_urdf import robot_tree, robot_urdf

PLANNING_GROUP: Final = "actuated"
"""The planning group."""
LIMB_GROUP: Final = "limb"
"""The chain from the ground to the platform, for the numeric solver."""
MAX_POSITION_ERROR: Final = 1e-4
"""Largest distance between a goal and the machine's pose, m: MoveIt's tolerance of goals."""
MAX_ROTATION_ERROR: Final = 1e-3
"""Largest rotation between a goal and the machine's pose, rad."""
MIN_SINGULARITY_INDEX: Final = 0.01
"""Smallest singularity index of solutions: that of the exported ros2_control controllers."""
CONTROLLER_NAME: Final = "delta_dynamics"
"""Name of MoveIt's controller: the node whose action adds efforts to goals."""


def moveit_package(robot: Robot, kinematics: str = "") -> dict[str, str]:
    """Write the package ``ROBOT_moveit_config``: the text of each file by its path.

    :param kinematics: plugin of the planning group's inverse kinematics; empty: the package's own.
    :raises ParameterError: the robot has a ``joint_map``: plans are in the numbers of the URDF.
    """
    robot.check_independent("plans of MoveIt", "it moves each joint by itself")
    if not robot.controller.is_identity or robot.controller.names != tuple(robot.joint_names):
        raise ParameterError("joint_map", list(robot.controller.names), "none: MoveIt plans in the URDF's numbers")
    name = re.sub(r"\W", "_", robot.name or robot.mechanism)
    # Write the SRDF: groups, passive joints, home state, and links that always touch.
    tree = robot_tree(robot)
    parts = list_single_joints(tree)
    root = ET.Element("robot", name=tree.name)
    joints = list(robot.joint_names)
    group = ET.SubElement(root, "group", name=PLANNING_GROUP)
    for joint in joints:
        ET.SubElement(group, "joint", name=joint)
    # List the actuated joints between the ground and the platform.
    above = {part.child: part for part in parts}
    found, link = [], PLATFORM
    while link in above:
        found += [above[link].name] if above[link].name in joints else []
        link = above[link].parent
    if found:
        limb = ET.SubElement(root, "group", name=LIMB_GROUP)
        ET.SubElement(limb, "chain", base_link=GROUND, tip_link=PLATFORM)
    home = ET.SubElement(root, "group_state", name="home", group=PLANNING_GROUP)
    for joint, value in zip(joints, robot.inverse(robot.home()).tolist(), strict=True):
        ET.SubElement(home, "joint", name=joint, value=f"{value:.12g}")
    ET.SubElement(root, "virtual_joint", name="ground", type="fixed", parent_frame="world", child_link=GROUND)
    for joint in robot.passive_joints:
        ET.SubElement(root, "passive_joint", name=joint)
    touching: dict[tuple[str, str], str] = {}
    # Shapes intersect at home where bars meet in a point.
    for one, other in combinations(tree.capsules, 2):
        gap = distance(one.start, one.end - one.start, other.start, other.end - other.start)
        if one.link != other.link and not gap > one.radius + other.radius:
            touching[min(one.link, other.link), max(one.link, other.link)] = "Default"
    touching |= dict.fromkeys(_list_joined_links(tree, parts), "Adjacent")
    for (first, second), reason in touching.items():
        ET.SubElement(root, "disable_collisions", link1=first, link2=second, reason=reason)
    ET.indent(root)
    groups = '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
    package = package_name(robot, "moveit_config")
    solver = kinematics or f"{package}/Kinematics"
    settings = {"kinematics_solver_search_resolution": 0.005, "kinematics_solver_timeout": 0.05}
    solvers = {
        LIMB_GROUP: "kdl_kinematics_plugin/KDLKinematicsPlugin" if (f'name="{LIMB_GROUP}"' in groups) else "",
        PLANNING_GROUP: solver,
    }
    texts = {
        f"config/{name}.urdf": robot_urdf(robot, hardware=""),
        f"config/{name}.srdf": groups,
        "config/joint_limits.yaml": _write_yaml(_write_joint_limits(robot, home_accelerations(robot))),
        "config/kinematics.yaml": _write_yaml(
            {group: {"kinematics_solver": s, **settings} for group, s in solvers.items() if s}
        ),
        "config/moveit_controllers.yaml": _write_yaml(_write_controllers(robot)),
        "config/ompl_planning.yaml": _write_yaml(
            {
                "planning_plugins": ["ompl_interface/OMPLPlanner"],
                "request_adapters": [
                    "default_planning_request_adapters/ResolveConstraintFrames",
                    "default_planning_request_adapters/ValidateWorkspaceBounds",
                    "default_planning_request_adapters/CheckStartStateBounds",
                    "default_planning_request_adapters/CheckStartStateCollision",
                ],
                "response_adapters": [
                    "default_planning_response_adapters/AddTimeOptimalParameterization",
                    "default_planning_response_adapters/ValidateSolution",
                ],
                "planner_configs": {"RRTConnect": {"type": "geometric::RRTConnect", "range": 0.0}},
                PLANNING_GROUP: {"default_planner_config": "RRTConnect", "planner_configs": ["RRTConnect"]},
            }
        ),
        "launch/move_group.launch.py": LAUNCH.format(name=name, package=package),
    }
    texts |= {f"c/{path}": text for path, text in c_package(robot).items()}
    return dict(sorted((texts | fill_templates("moveit_package", _template_words(robot, package))).items()))


def _template_words(robot: Robot, package: str) -> dict[str, str]:
    """Return the texts that replace the words between two ``@`` in the templates."""
    own, shown = c_identifier(robot.name), printable_name(robot)
    limits = robot.limits.position
    ends = np.array([[-np.inf, np.inf]] * robot.joints_count) if limits is None else limits
    drives = zip(robot.joint_names, ends.tolist(), strict=True)
    return {
        "ROBOT": shown,
        "XMLROBOT": escape(shown),
        "PACKAGE": package,
        "PREFIX": f"pkm_{own}",
        "MACRO": f"PKM_{own}".upper(),
        "JOINTNAMES": ", ".join(f"`{joint}`" for joint in robot.joint_names),
        "POSENAMES": ", ".join(robot.pose_names),
        "POSE": ", ".join(map(_write_coordinate, robot.coordinates)),
        "DRIVES": "\n".join(
            f"  {{{write_cpp_string(joint)}, {write_cpp_number(low)}, {write_cpp_number(high)}}},"
            for joint, (low, high) in drives
        ),
        "POSITION": f"{MAX_POSITION_ERROR:g}",
        "ORIENTATION": f"{MAX_ROTATION_ERROR:g}",
        "SINGULARITY": f"{MIN_SINGULARITY_INDEX:g}",
    }


def _write_coordinate(c: Coordinate) -> str:
    """Write a pose coordinate in C++, from position p and rotation r (row-major)."""

    def write_entry(of: Entry) -> str:
        row, column, sign = of
        return f"{'-' if sign < 0.0 else ''}r[{3 * row + column}]"

    if c.axis is not None:
        return f"p[{c.axis}]"
    first, *rest = c.entries
    if rest:
        return f"std::atan2({write_entry(first)}, {write_entry(rest[0])})"
    others = ", ".join(write_entry((row, first[1], 1.0)) for row in range(3) if row != first[0])
    return f"std::atan2({write_entry(first)}, std::hypot({others}))"


def home_accelerations(robot: Robot) -> list[float]:
    """Return the acceleration that each drive can give its joint at home, rad/s2 or m/s2, (n,).

    Infinite without effort limits.
    """
    limits = robot.limits.effort
    if limits is None:
        return [np.inf] * len(robot.joint_names)
    q = robot.inverse(robot.home())
    weight = np.abs(inverse_dynamics(robot, q, 0.0 * q, 0.0 * q))
    inertia = np.diag(mass_matrix(robot, q))
    with np.errstate(divide="ignore"):
        # A planner may use half of the effort that remains at home after gravity.
        return list(0.5 * np.maximum(limits - weight, 0.0) / inertia)


def _list_joined_links(tree: LoopTree, parts: Sequence[SingleAxisJoint]) -> list[tuple[str, str]]:
    """Return pairs of links that a joint, or a cut loop, connects.

    A link without mass and shape is between the axes of one joint, which then connects its neighbours.
    """
    pairs = [(part.parent, part.child) for part in parts]
    pairs += [(closure.inner, closure.outer) for closure in tree.closures]
    solid = {GROUND, PLATFORM, *(capsule.link for capsule in tree.capsules)}
    solid |= {name for name, link in tree.links.items() if link.mass}
    for own in [part.child for part in parts if part.child not in solid]:
        near = {name for pair in pairs if own in pair for name in pair} - {own}
        pairs += combinations(sorted(near), 2)
    return list(dict.fromkeys((min(pair), max(pair)) for pair in pairs))


def _write_joint_limits(robot: Robot, home_accelerations: Sequence[float]) -> dict[str, Any]:
    velocities = robot.limits.velocity
    limits = {}
    for k, joint in enumerate(robot.joint_names):
        velocity = np.inf if velocities is None else float(velocities[k])
        acceleration = float(home_accelerations[k])
        limits[joint] = {
            "has_velocity_limits": velocity < np.inf,
            "max_velocity": velocity if velocity < np.inf else 0.0,
            "has_acceleration_limits": acceleration < np.inf,
            "max_acceleration": acceleration if acceleration < np.inf else 0.0,
        }
    return {"default_velocity_scaling_factor": 0.1, "default_acceleration_scaling_factor": 0.1, "joint_limits": limits}


def _write_controllers(robot: Robot) -> dict[str, Any]:
    return {
        "moveit_controller_manager": ("moveit_simple_controller_manager/MoveItSimpleControllerManager"),
        "moveit_simple_controller_manager": {
            "controller_names": [CONTROLLER_NAME],
            CONTROLLER_NAME: {
                "action_ns": "follow_joint_trajectory",
                "type": "FollowJointTrajectory",
                "default": True,
                "joints": list(robot.joint_names),
            },
        },
    }


def _write_yaml(data: dict[str, Any]) -> str:
    return yaml.safe_dump(data, sort_keys=False)


LAUNCH: Final = """# Made by pkm-twin export moveit {name}.
from moveit_configs_utils import MoveItConfigsBuilder
from moveit_configs_utils.launches import generate_move_group_launch


def generate_launch_description():
    config = (
        MoveItConfigsBuilder("{name}", package_name="{package}")
        .robot_description(file_path="config/{name}.urdf")
        .robot_description_semantic(file_path="config/{name}.srdf")
        .joint_limits(file_path="config/joint_limits.yaml")
        .robot_description_kinematics(file_path="config/kinematics.yaml")
        .trajectory_execution(file_path="config/moveit_controllers.yaml")
        .planning_pipelines(pipelines=["ompl"])
        .to_moveit_configs()
    )
    return generate_move_group_launch(config)
"""
