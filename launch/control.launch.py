# SPDX-License-Identifier: Apache-2.0
"""A robot under ros2_control: mock hardware, controllers, and the twin's efforts between.

Trajectories go to ``delta_dynamics/joint_trajectory``, or as goals of the action
``delta_dynamics/follow_joint_trajectory``, and on to joint_trajectory_controller with effort.
"""

import subprocess
import tempfile
from pathlib import Path

import yaml
from ament_index_python.packages import get_package_prefix
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
    RegisterEventHandler,
    Shutdown,
)
from launch.event_handlers import OnShutdown
from launch.launch_context import LaunchContext
from launch.launch_description_entity import LaunchDescriptionEntity
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.actions import Node

from launch import LaunchDescription
from pkm_twin import load

HERE = Path(__file__).parent
CONTROLLER = "joint_trajectory_controller"

ARGUMENTS = {
    "robot": ("delta_cu", "a name or a path"),
    "namespace": ("", "of everything"),
    "description": ("", "a URDF with a ros2_control element; default: what pkm-twin urdf writes"),
    "controllers": ("", "settings of ros2_control; default: controllers.yaml beside this file"),
    "robot_state_publisher": ("true", "false where another node publishes robot_description"),
    "params_file": ("", "parameters of delta_dynamics, a YAML file"),
    "log_level": ("info", "of delta_dynamics: debug, info, warn, error or fatal"),
}


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=control),
        ]
    )


def control(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """Everything, once the arguments have their values."""
    given = {name: context.launch_configurations[name] for name in ARGUMENTS}
    namespace = given["namespace"]
    space = f"/{namespace}".rstrip("/")
    folder = tempfile.TemporaryDirectory(prefix="pkm_twin_")
    file = Path(folder.name) / "controllers.yaml"
    file.write_text(yaml.safe_dump(_controllers(given, space)), encoding="utf-8")
    publisher = Node(
        package="robot_state_publisher",
        executable="robot_state_publisher",
        namespace=namespace,
        parameters=[{"robot_description": _description(given)}],
    )
    return [
        RegisterEventHandler(OnShutdown(on_shutdown=lambda *_: folder.cleanup())),
        *([publisher] if given["robot_state_publisher"] == "true" else []),
        Node(
            package="controller_manager",
            executable="ros2_control_node",
            namespace=namespace,
            parameters=[str(file)],
            output="screen",
            on_exit=Shutdown(reason="ros2_control_node has ended"),
        ),
        Node(
            package="controller_manager",
            executable="spawner",
            namespace=namespace,
            arguments=[
                "joint_state_broadcaster",
                CONTROLLER,
                *("--param-file", str(file)),
                *("--controller-manager", f"{space}/controller_manager"),
            ],
            output="screen",
        ),
        GroupAction(
            [
                IncludeLaunchDescription(
                    PythonLaunchDescriptionSource(str(HERE / "twin.launch.py")),
                    launch_arguments={
                        "robot": given["robot"],
                        "namespace": namespace,
                        "params_file": given["params_file"],
                        "log_level": given["log_level"],
                        "stiffness_monitor": "false",
                        "joint_trajectory_ff": f"{CONTROLLER}/joint_trajectory",
                        "controller_action": f"{CONTROLLER}/follow_joint_trajectory",
                    }.items(),
                )
            ]
        ),
    ]


def _description(given: dict[str, str]) -> str:
    if given["description"]:
        return Path(given["description"]).read_text(encoding="utf-8")
    program = Path(get_package_prefix("pkm_twin"), "lib/pkm_twin/pkm-twin")
    written = subprocess.run(
        [program, "urdf", given["robot"]], capture_output=True, text=True, check=False
    )
    if written.returncode:
        raise RuntimeError(f"robot: {written.stderr.strip()}")
    return written.stdout


def _controllers(given: dict[str, str], space: str) -> dict[str, object]:
    """The settings with the robot's joints, each section under its node's full name."""
    path = Path(given["controllers"] or HERE / "controllers.yaml")
    sections = yaml.safe_load(path.read_text(encoding="utf-8"))
    joints = list(load(given["robot"]).controller.names)
    for name, section in sections.items():
        parameters = section["ros__parameters"]
        if name not in ("controller_manager", "joint_state_broadcaster"):
            parameters.setdefault("joints", list(joints))
        gains = parameters.get("gains", {})
        if "each" in gains:
            each = gains.pop("each")
            # Copies: the middleware's reader takes no YAML with references.
            parameters["gains"] = {joint: dict(gains.get(joint, each)) for joint in joints}
    return {f"{space}/{name}": section for name, section in sections.items()}
