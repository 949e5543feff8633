# SPDX-License-Identifier: Apache-2.0
"""The twin of one robot: its nodes, in one namespace. Every argument has a default."""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.launch_context import LaunchContext
from launch_ros.actions import Node

from launch import LaunchDescription

ROBOT = "delta_cu"
RESPAWN_DELAY = 1.0

ARGUMENTS = {
    "robot": ("", f"robot of all nodes, a name or a path; default: params_file's, else {ROBOT}"),
    "namespace": ("", "of the nodes and of every topic"),
    "params_file": ("", "parameters, a YAML file with a section a node"),
    "delta_dynamics": ("true", "run this node"),
    "stiffness_monitor": ("true", "run this node"),
    "command_gate": ("false", "run this node: torques that end, for effort controllers"),
    "machine_state": (
        "false",
        "run this node: all joints, transforms, markers; see view.launch.py",
    ),
    "joint_states": ("joint_states", "topic of the measured joint states"),
    "wrench": ("wrench", "topic of the measured wrench"),
    "measured_deflection": ("measured_deflection", "topic of the platform's measured deflection"),
    "joint_trajectory_ff": ("~/joint_trajectory_ff", "topic of the trajectories with effort"),
    "controller_action": ("", "of delta_dynamics: the controller's action that goals go on to"),
    "commands": ("~/commands", "topic that command_gate sends to, an effort controller's"),
    "acceleration": ("", "of delta_dynamics: trajectory or differentiate"),
    "use_wrench": ("", "of delta_dynamics: true where torques bear the measured wrench"),
    "wrench_frame": ("", "frame of the measured wrench"),
    "use_sim_time": ("false", "true where a bag is replayed with --clock"),
    "respawn": ("true", "start a node again that has ended; command_gate always is"),
    "log_level": ("info", "debug, info, warn, error or fatal"),
}

PARAMETERS = {
    "delta_dynamics": ("acceleration", "controller_action", "use_wrench", "wrench_frame"),
    "stiffness_monitor": ("wrench_frame",),
    "command_gate": (),
    "machine_state": ("wrench_frame",),
}
"""Nodes, and the arguments that are parameters of each."""

TOPICS = {
    "delta_dynamics": ("joint_states", "wrench", "~/joint_trajectory_ff"),
    "stiffness_monitor": ("joint_states", "wrench", "measured_deflection"),
    "command_gate": ("joint_states", "~/commands"),
    "machine_state": ("joint_states", "wrench"),
}
"""Topics of each node that an argument of that name can move."""


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            # Matrices here are small: threads cost more than they bring.
            SetEnvironmentVariable("OMP_NUM_THREADS", "1"),
            OpaqueFunction(function=nodes),
        ]
    )


def nodes(context: LaunchContext) -> list[Node]:
    """The chosen nodes, once the arguments have their values."""
    given = {name: context.launch_configurations[name] for name in ARGUMENTS}
    file = given["params_file"]
    if file and not Path(file).is_file():
        raise RuntimeError(f"params_file: {file!r} is no file")
    return [_node(name, given) for name in PARAMETERS if _flag(given, name)]


def _node(name: str, given: dict[str, str]) -> Node:
    # A file may name the robot; an argument that is given goes before the file's.
    default = [] if given["robot"] else [{"mechanism": ROBOT}]
    file = [given["params_file"]] if given["params_file"] else []
    chosen = {key: given[key] for key in PARAMETERS[name] if given[key]}
    if given["robot"]:
        chosen["mechanism"] = given["robot"]
    return Node(
        package="pkm_twin",
        executable=name,
        name=name,
        namespace=given["namespace"],
        parameters=[*default, *file, {**chosen, "use_sim_time": _flag(given, "use_sim_time")}],
        remappings=[(topic, given[topic.removeprefix("~/")]) for topic in TOPICS[name]],
        ros_arguments=["--log-level", given["log_level"]],
        respawn=name == "command_gate" or _flag(given, "respawn"),
        # The gate's absence is the time that a controller holds the last torque.
        respawn_delay=0.0 if name == "command_gate" else RESPAWN_DELAY,
        output="screen",
    )


def _flag(given: dict[str, str], name: str) -> bool:
    value = given[name].lower()
    if value not in ("true", "false"):
        raise RuntimeError(f"{name}: {given[name]!r} is neither true nor false")
    return value == "true"
