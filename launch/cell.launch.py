# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Run the nodes of several machines, each with its own robot, namespace and topics."""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.launch_context import LaunchContext
from launch_ros.actions import Node

from launch import LaunchDescription
from pkm_twin.ros.arguments import check_launch_arguments
from pkm_twin.ros.launching import load_launch_file
from pkm_twin.ros.signals import leave_interrupts_to_launch

TWIN_LAUNCH = Path(__file__).with_name("twin.launch.py")

DEFAULT_MACHINES = "picker=delta_cu,head=prru"

ARGUMENTS = {
    "machines": (DEFAULT_MACHINES, "the machines: NAMESPACE=ROBOT,NAMESPACE=ROBOT,..."),
    "params_file": ("", "YAML file of parameters, with a section /NAMESPACE/NODE for each node"),
    "command_gate": ("false", "run this node in every namespace"),
    "machine_state": ("false", "run this node in every namespace"),
    "composed": ("false", "run the nodes of each machine, except command_gate, in one process"),
    "use_sim_time": ("false", "use simulated time, for a bag replayed with --clock"),
    "respawn": ("true", "restart a node that has ended"),
    "log_level": ("info", "log level: debug, info, warn, error or fatal"),
}


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=launch_machines),
        ]
    )


def launch_machines(context: LaunchContext) -> list[Node]:
    """Return the nodes of all machines, after all arguments are checked."""
    leave_interrupts_to_launch()
    check_launch_arguments(__file__, context.argv, ARGUMENTS)
    given = {name: context.launch_configurations[name] for name in ARGUMENTS}
    pairs = [pair.strip().partition("=") for pair in given.pop("machines").split(",")]
    for namespace, sign, robot in pairs:
        if not (namespace and sign and robot):
            raise RuntimeError(f"machines: {namespace + sign + robot!r} is not NAMESPACE=ROBOT")
    names = [namespace for namespace, _, _ in pairs]
    if len(set(names)) < len(names):
        raise RuntimeError(f"machines: {', '.join(names)}: two share a namespace")
    twin = load_launch_file(TWIN_LAUNCH)
    defaults = {name: default for name, (default, _) in twin.ARGUMENTS.items()}
    return [
        node
        for namespace, _, robot in pairs
        for node in twin.create_processes({**defaults, **given, "namespace": namespace, "robot": robot})
    ]
