# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Run a robot under ros2_control: mock hardware, controllers, and the feedforward efforts.

Trajectories go to ``delta_dynamics/joint_trajectory``, or as goals of the action
``delta_dynamics/follow_joint_trajectory``, and on to joint_trajectory_controller with effort. With
``command_gate:=true`` the stamped torques go through the gate to effort_controller instead. With
``use:=plugin`` no node is involved: joint_trajectory_controller is chained to the controller
that ``pkm-twin export ros2-control`` has written, and takes the trajectories itself.
"""

import subprocess
import tempfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml
from ament_index_python.packages import (
    PackageNotFoundError,
    get_package_prefix,
    get_package_share_directory,
)
from launch.actions import (
    DeclareLaunchArgument,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
)
from launch.event_handlers import OnProcessExit, OnShutdown
from launch.events.process import ProcessExited
from launch.launch_context import LaunchContext
from launch.launch_description_entity import LaunchDescriptionEntity
from launch_ros.actions import Node

from delta_dynamics.simulation.machine import tune_position_control
from launch import LaunchDescription
from pkm_twin import Robot
from pkm_twin.export.ros2_control import CONTROLLER as FEEDFORWARD
from pkm_twin.export.ros2_control import GRAVITY_CONTROLLER, TRAJECTORY_CONTROLLER, package_name
from pkm_twin.ros.arguments import check_launch_arguments
from pkm_twin.ros.launching import (
    check_executables,
    load_launch_file,
    load_robot,
    read_choice,
    read_flag,
)
from pkm_twin.ros.signals import leave_interrupts_to_launch

HERE = Path(__file__).parent
EFFORT_CONTROLLER = "effort_controller"

ARGUMENTS = {
    "robot": ("delta_cu", "the robot, a name or path"),
    "use": (
        "twin",
        "twin: efforts of delta_dynamics; plugin: those of the robot's exported package",
    ),
    "namespace": ("", "namespace of all nodes and topics"),
    "description": (
        "",
        "a URDF with a ros2_control element; default: what pkm-twin export urdf writes",
    ),
    "controllers": (
        "",
        "settings of ros2_control; default: controllers.yaml in this folder, or the package's",
    ),
    "hardware_plugin": ("mock_components/GenericSystem", "plugin in the default description"),
    "bandwidth": ("", "Hz: gains by the machine's masses; default: the file's"),
    "command_gate": ("false", f"true: torques through command_gate to {EFFORT_CONTROLLER}"),
    "robot_state_publisher": ("true", "false if another node publishes robot_description"),
    "params_file": ("", "YAML file of parameters of delta_dynamics"),
    "use_sim_time": ("false", "use simulated time, of a simulator that publishes /clock"),
    "log_level": ("info", "log level of delta_dynamics: debug, info, warn, error or fatal"),
}


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=launch_control),
        ]
    )


def launch_control(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """Return all nodes and controllers; called when the arguments have their values."""
    leave_interrupts_to_launch()
    check_launch_arguments(__file__, context.argv, ARGUMENTS)
    given = {name: context.launch_configurations[name] for name in ARGUMENTS}
    namespace = given["namespace"]
    gate = read_flag(given, "command_gate")
    sim_time = {"use_sim_time": read_flag(given, "use_sim_time")}
    plugin = read_choice(given, "use", ("twin", "plugin")) == "plugin"
    if plugin and gate:
        raise RuntimeError("command_gate: with use:=plugin no torques pass through topics")
    publishes_description = read_flag(given, "robot_state_publisher")
    check_executables(
        [
            ("controller_manager", "ros2_control_node"),
            ("controller_manager", "spawner"),
            *([("robot_state_publisher", "robot_state_publisher")] if publishes_description else []),
            ("pkm_twin", "pkm-twin"),
        ]
    )
    controller = EFFORT_CONTROLLER if gate else TRAJECTORY_CONTROLLER
    # The controller whose gains hold the position.
    holding = FEEDFORWARD if plugin else controller
    space = f"/{namespace}".rstrip("/")
    folder = tempfile.TemporaryDirectory(prefix="pkm_twin_")
    file = Path(folder.name) / "controllers.yaml"
    sections = _read_controllers(given, space)
    file.write_text(yaml.safe_dump(sections), encoding="utf-8")
    publisher = Node(
        package="robot_state_publisher",
        executable="robot_state_publisher",
        namespace=namespace,
        parameters=[{"robot_description": _read_description(given), **sim_time}],
    )
    settings = sections.get(f"{space}/{holding}", {}).get("ros__parameters", {})
    gains = settings.get("gains", {})
    without_gain = [joint for joint, gain in gains.items() if not gain.get("p")]
    warning = (
        f"{holding} has no gain for {', '.join(without_gain)}: the machine is carried and not held in "
        "place; see bandwidth:=HZ"
    )
    manager_settings = sections.get(f"{space}/controller_manager", {}).get("ros__parameters", {})
    # The fallback controller has to be configured before the controller that names it is activated.
    spawners = [
        *(
            [_create_spawner(space, file, GRAVITY_CONTROLLER, "--inactive")]
            if plugin and GRAVITY_CONTROLLER in manager_settings
            else []
        ),
        _create_spawner(
            space,
            file,
            "joint_state_broadcaster",
            *([FEEDFORWARD] if plugin else []),
            controller,
        ),
    ]
    return [
        *([LogInfo(msg=warning)] if without_gain and holding != EFFORT_CONTROLLER else []),
        RegisterEventHandler(OnShutdown(on_shutdown=lambda *_: folder.cleanup())),
        *([publisher] if publishes_description else []),
        Node(
            package="controller_manager",
            executable="ros2_control_node",
            namespace=namespace,
            parameters=[str(file), sim_time],
            output="screen",
            on_exit=_end_launch,
        ),
        *(RegisterEventHandler(OnProcessExit(target_action=one, on_exit=[after])) for one, after in pairwise(spawners)),
        spawners[0],
        *([] if plugin else _create_twin_nodes(given, controller)),
    ]


def _end_launch(event: ProcessExited, context: LaunchContext) -> None:
    """Stop the launch with exit code 1 if ros2_control_node ends on its own.

    :raises RuntimeError: the launch is not being shut down.
    """
    if not context.is_shutdown:
        raise RuntimeError(f"ros2_control_node has ended with exit code {event.returncode}")


def _create_spawner(space: str, file: Path, *arguments: str) -> Node:
    """Create the process that loads, configures and activates controllers of a namespace's manager."""
    return Node(
        package="controller_manager",
        executable="spawner",
        namespace=space.removeprefix("/"),
        arguments=[
            *arguments,
            *("--param-file", str(file)),
            *("--controller-manager", f"{space}/controller_manager"),
        ],
        output="screen",
    )


def _create_twin_nodes(given: dict[str, str], controller: str) -> list[Node]:
    """Create delta_dynamics, and command_gate if torques pass through it."""
    twin = load_launch_file(HERE / "twin.launch.py")
    names = ("robot", "namespace", "params_file", "use_sim_time", "log_level")
    processes: list[Node] = twin.create_processes(
        {
            **{name: default for name, (default, _) in twin.ARGUMENTS.items()},
            **{name: given[name] for name in names},
            "stiffness_monitor": "false",
            **(
                {"command_gate": "true", "commands": f"{EFFORT_CONTROLLER}/commands"}
                if controller == EFFORT_CONTROLLER
                else {
                    "joint_trajectory_ff": f"{TRAJECTORY_CONTROLLER}/joint_trajectory",
                    "controller_action": f"{TRAJECTORY_CONTROLLER}/follow_joint_trajectory",
                }
            ),
        }
    )
    return processes


def _read_description(given: dict[str, str]) -> str:
    if given["description"]:
        return Path(given["description"]).read_text(encoding="utf-8")
    program = Path(get_package_prefix("pkm_twin"), "lib/pkm_twin/pkm-twin")
    written = subprocess.run(
        [program, "export", "urdf", given["robot"], "--hardware-plugin", given["hardware_plugin"]],
        capture_output=True,
        text=True,
        check=False,
    )
    if written.returncode:
        raise RuntimeError(f"robot: {written.stderr.strip()}")
    return written.stdout


def _read_controllers(given: dict[str, str], space: str) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the controllers' settings with the robot's joints, by full node name."""
    robot = load_robot(given["robot"])
    try:
        strong, damped = tune_position_control(robot, float(given["bandwidth"] or 0.0))
    except ValueError as error:
        raise RuntimeError(f"bandwidth {given['bandwidth']!r}: {error}") from None
    path = Path(given["controllers"] or _find_settings_file(given, robot))
    sections = {
        name.removeprefix("/**/"): section for name, section in yaml.safe_load(path.read_text(encoding="utf-8")).items()
    }
    joints = list(robot.controller.names)
    # Gains per controller position and velocity instead of the model's.
    scale = robot.controller.factors**2
    tuned_gains = {
        joint: {"p": float(p), "i": 0.0, "d": float(d), "i_clamp": 0.0}
        for joint, p, d in zip(joints, strong / scale, damped / scale, strict=True)
    }
    for name, section in sections.items():
        parameters = section["ros__parameters"]
        if name not in ("controller_manager", "joint_state_broadcaster", FEEDFORWARD, GRAVITY_CONTROLLER):
            parameters.setdefault("joints", list(joints))
        gains = parameters.get("gains", {})
        if "each" in gains:
            each = gains.pop("each")
            # Copies, as the middleware cannot read YAML with references.
            parameters["gains"] = {joint: dict(gains.get(joint, each)) for joint in joints}
        if given["bandwidth"] and name == FEEDFORWARD:
            parameters["gains"] = {joint: {key: gain[key] for key in ("p", "d")} for joint, gain in tuned_gains.items()}
        elif given["bandwidth"] and name == TRAJECTORY_CONTROLLER and FEEDFORWARD not in sections:
            parameters["gains"] = tuned_gains
    return {f"{space}/{name}": section for name, section in sections.items()}


def _find_settings_file(given: dict[str, str], robot: Robot) -> Path:
    if given["use"] == "twin":
        return HERE / "controllers.yaml"
    package = package_name(robot)
    try:
        return Path(get_package_share_directory(package), "config", "controllers.yaml")
    except PackageNotFoundError:
        raise RuntimeError(
            f"use: package {package} is not in the workspace; write it by pkm-twin export "
            f"ros2-control {given['robot']} --out src/{package}, and build it"
        ) from None
