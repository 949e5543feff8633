# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The nodes as commands: help without ROS, and one line where ROS is missing."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from functools import partial

from pkm_twin.errors import write_install_command
from pkm_twin.files import open_standard_streams
from pkm_twin.ros.arguments import answer
from pkm_twin.ros.signals import leave_at_once

MODULES = {
    "delta_dynamics": "delta_dynamics.nodes.twin",
    "command_gate": "delta_dynamics.nodes.gate",
    "stiffness_monitor": "stiffness_monitor.node",
    "machine_state": "pkm_twin.state.node",
    "machine_sim": "delta_dynamics.nodes.simulation",
}
COMPOSABLE = tuple(name for name in MODULES if name != "command_gate")


def _run_node(name: str) -> None:
    leave_at_once()
    open_standard_streams()
    answer(
        name,
        {
            "delta_dynamics": "Computes feedforward torques from trajectories and joint states.",
            "command_gate": "Forwards stamped torques to an effort controller, and zeros when they stop.",
            "stiffness_monitor": "Computes compliance and the dominant element from wrenches and joints.",
            "machine_state": "Computes all joints, the platform's motion and markers from joint states.",
            "machine_sim": "Simulates the machine under efforts or trajectories, publishes joint states.",
        }[name],
        sys.argv[1:],
    )
    _start_nodes(name, [name])


delta_dynamics = partial(_run_node, "delta_dynamics")
command_gate = partial(_run_node, "command_gate")
stiffness_monitor = partial(_run_node, "stiffness_monitor")
machine_state = partial(_run_node, "machine_state")
machine_sim = partial(_run_node, "machine_sim")
"""Entry points of ``ros2 run pkm_twin NODE``."""


def composed() -> None:
    """Run several nodes in one process: ``ros2 run pkm_twin composed NODE... --ros-args ...``."""
    leave_at_once()
    open_standard_streams()
    words = sys.argv[1:]
    end = words.index("--ros-args") if "--ros-args" in words else len(words)
    names = [word for word in words[:end] if not word.startswith("-")]
    answer(
        "composed",
        f"Runs several nodes in one process and one executor: {', '.join(COMPOSABLE)}.",
        [word for word in words[:end] if word not in names],
        "NODE",
    )
    if not names or set(names) - set(COMPOSABLE) or len(set(names)) < len(names):
        print(
            f"cannot start: composed {' '.join(names)}: expected one or more of "
            f"{', '.join(COMPOSABLE)}, each once; command_gate must outlive the others, so it runs "
            "in its own process",
            file=sys.stderr,
        )
        sys.exit(2)
    _start_nodes("composed", names)


def _start_nodes(command: str, names: Sequence[str]) -> None:
    try:
        importlib.import_module("rclpy")
    except ImportError as error:
        needed = f"source its setup, or {write_install_command('jazzy')} ({error})"
        print(f"cannot start: {command} needs ROS 2: {needed}", file=sys.stderr)
        sys.exit(1)
    nodes = [importlib.import_module(MODULES[name]).NODE for name in names]
    sys.exit(importlib.import_module("pkm_twin.ros.run").run(*nodes))
