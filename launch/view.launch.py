# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""View a robot: machine_state and, if they are installed, robot_state_publisher and rviz2.

``machine_state`` publishes every joint of the tree, also the passive ones; robot_state_publisher
publishes the transforms of all links. Without it machine_state publishes the transform of the platform.
"""

import tempfile
from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnShutdown
from launch.launch_context import LaunchContext
from launch.launch_description_entity import LaunchDescriptionEntity
from launch_ros.actions import Node

from launch import LaunchDescription
from pkm_twin.robot.robot_urdf import robot_urdf
from pkm_twin.ros.arguments import check_launch_arguments
from pkm_twin.ros.launching import (
    LOG_LEVELS,
    check_executables,
    is_installed,
    load_robot,
    read_choice,
)
from pkm_twin.ros.signals import leave_interrupts_to_launch

HERE = Path(__file__).parent
RVIZ_LAYOUT = "view/machine.rviz"

ARGUMENTS = {
    "robot": ("delta_cu", "the robot, a name or path"),
    "namespace": ("", "namespace of the nodes and topics, and prefix of all frames"),
    "params_file": ("", "YAML file of parameters of machine_state"),
    "joint_states": ("joint_states", "topic of the measured joint states"),
    "wrench": ("wrench", "topic of the measured wrench"),
    "robot_state_publisher": ("auto", "true, false, or auto: if it is installed"),
    "rviz": ("auto", "true, false, or auto: if rviz2 is installed"),
    "use_sim_time": ("false", "use simulated time, for a bag replayed with --clock"),
    "log_level": ("info", "log level of machine_state: debug, info, warn, error or fatal"),
}


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=launch_view),
        ]
    )


def launch_view(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """Return the nodes; called when the arguments have their values."""
    leave_interrupts_to_launch()
    check_launch_arguments(__file__, context.argv, ARGUMENTS)
    given = {name: context.launch_configurations[name] for name in ARGUMENTS}
    namespace = given["namespace"].strip("/")
    prefix = f"{namespace}/" if namespace else ""
    sim_time = {"use_sim_time": _is_wanted(given, "use_sim_time")}
    links = _is_wanted(given, "robot_state_publisher", "robot_state_publisher")
    rviz = _is_wanted(given, "rviz", "rviz2")
    read_choice(given, "log_level", LOG_LEVELS)
    if given["params_file"] and not Path(given["params_file"]).is_file():
        raise RuntimeError(f"params_file: {given['params_file']!r} is no file")
    robot = load_robot(given["robot"])
    programs = {"robot_state_publisher": links, "rviz2": rviz}
    check_executables([("pkm_twin", "machine_state"), *((name, name) for name, on in programs.items() if on)])
    actions: list[LaunchDescriptionEntity] = [
        Node(
            package="pkm_twin",
            executable="machine_state",
            name="machine_state",
            namespace=namespace,
            parameters=[
                {
                    "base_frame": f"{prefix}base_link",
                    "platform_frame": f"{prefix}platform",
                    "tool_frame": f"{prefix}tool0",
                },
                *([given["params_file"]] if given["params_file"] else []),
                {
                    "mechanism": given["robot"],
                    # Two nodes must not publish the transform of one frame.
                    "publish_tf": "tool" if links else "all",
                    **sim_time,
                },
            ],
            remappings=[(topic, given[topic]) for topic in ("joint_states", "wrench")],
            ros_arguments=["--log-level", given["log_level"]],
            output="screen",
        )
    ]
    if links:
        actions.append(
            Node(
                package="robot_state_publisher",
                executable="robot_state_publisher",
                namespace=namespace,
                parameters=[
                    {
                        "robot_description": robot_urdf(robot, ""),
                        "frame_prefix": prefix,
                        "publish_frequency": 100.0,
                        **sim_time,
                    }
                ],
                remappings=[("joint_states", "machine_state/joint_states")],
                output="screen",
            )
        )
    if rviz:
        actions += _create_rviz(prefix, sim_time)
    return actions


def _create_rviz(prefix: str, sim_time: dict[str, bool]) -> list[LaunchDescriptionEntity]:
    """Create RViz with the layout, its topics and frames moved into the namespace."""
    text = (_find_layouts() / RVIZ_LAYOUT).read_text(encoding="utf-8")
    for old, new in (
        ("Value: /", f"Value: /{prefix}"),
        ("Fixed Frame: ", f"Fixed Frame: {prefix}"),
        ('TF Prefix: ""', f"TF Prefix: {prefix[:-1]!r}"),
    ):
        text = text.replace(old, new)
    folder = tempfile.TemporaryDirectory(prefix="pkm_twin_")
    file = Path(folder.name) / "machine.rviz"
    file.write_text(text, encoding="utf-8")
    return [
        RegisterEventHandler(OnShutdown(on_shutdown=lambda *_: folder.cleanup())),
        Node(
            package="rviz2",
            executable="rviz2",
            arguments=["-d", str(file)],
            parameters=[sim_time],
            output="screen",
        ),
    ]


def _find_layouts() -> Path:
    """Return the folder of the layouts: this one in a checkout, its parent if installed."""
    return HERE if (HERE / RVIZ_LAYOUT).is_file() else HERE.parent


def _is_wanted(given: dict[str, str], name: str, package: str = "") -> bool:
    value = given[name].lower()
    if value == "auto" and package:
        return is_installed(package)
    if value not in ("true", "false"):
        words = "true, false or auto" if package else "true or false"
        raise RuntimeError(f"{name}: {given[name]!r} is not {words}")
    return value == "true"
