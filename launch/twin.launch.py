# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Run the nodes of one robot in one namespace. Every argument has a default.

A node that ends is restarted. A node that rejected its configuration is restarted only a few
times, with increasing pauses.
"""

import atexit
import re
import shutil
import tempfile
import time
from pathlib import Path

import yaml
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction, TimerAction
from launch.events.process import ProcessExited
from launch.launch_context import LaunchContext
from launch.launch_description_entity import LaunchDescriptionEntity
from launch_ros.actions import Node

from delta_dynamics.feedforward import Settings
from delta_dynamics.gate import GateSettings
from launch import LaunchDescription
from pkm_twin.ros.arguments import check_launch_arguments
from pkm_twin.ros.launching import (
    LOG_LEVELS,
    check_executables,
    load_robot,
    read_choice,
    read_flag,
)
from pkm_twin.ros.signals import leave_interrupts_to_launch

ROBOT = "delta_cu"
GATE = "command_gate"
"""Runs in a process of its own, so that it outlives the node whose torques it forwards."""
RESPAWN_DELAY = 1.0
"""Pause before a node is restarted, s."""
REJECTED_EXIT_CODE = 1
"""Exit code of a node that rejects its configuration."""
MAX_RETRIES = 3
"""Restarts of a node that rejects its configuration; each pause is twice the one before."""
MIN_VALID_RUN = 30.0
"""Running time that shows that a node accepted its configuration, s."""

ARGUMENTS = {
    "robot": ("", f"the robot, a name or path; default: that of params_file, else {ROBOT}"),
    "namespace": ("", "namespace of the nodes and topics"),
    "params_file": ("", "YAML file of parameters, with a section for each node"),
    "delta_dynamics": ("true", "run this node"),
    "stiffness_monitor": ("true", "run this node"),
    "command_gate": ("false", "run this node, which forwards torques to an effort controller"),
    "machine_state": (
        "false",
        "run this node, which publishes all joints, transforms and markers; see view.launch.py",
    ),
    "joint_states": ("joint_states", "topic of the measured joint states"),
    "wrench": ("wrench", "topic of the measured wrench"),
    "measured_deflection": ("measured_deflection", "topic of the platform's measured deflection"),
    "joint_trajectory_ff": ("~/joint_trajectory_ff", "topic of the trajectories with effort"),
    "controller_action": ("", "parameter of delta_dynamics: the controller's action"),
    "commands": ("~/commands", "topic of an effort controller that command_gate publishes to"),
    "acceleration": ("", "parameter of delta_dynamics: trajectory or differentiate"),
    "use_wrench": ("", "parameter of delta_dynamics: true includes the measured wrench"),
    "wrench_frame": ("", "frame id of the measured wrench"),
    "use_sim_time": ("false", "use simulated time, for a bag replayed with --clock"),
    "executor": ("events", "parameter of all nodes: events or single"),
    "composed": ("false", "run all nodes except command_gate in one process, which saves time"),
    "respawn": ("true", "restart a node that has ended; command_gate is always restarted"),
    "log_level": ("info", "log level: debug, info, warn, error or fatal"),
}

PARAMETERS = {
    "delta_dynamics": ("acceleration", "controller_action", "use_wrench", "wrench_frame"),
    "stiffness_monitor": ("wrench_frame",),
    "command_gate": (),
    "machine_state": ("wrench_frame",),
}
"""Arguments that are parameters, by node."""

TOPICS = {
    "delta_dynamics": ("joint_states", "wrench", "~/joint_trajectory_ff"),
    "stiffness_monitor": ("joint_states", "wrench", "measured_deflection"),
    "command_gate": ("joint_states", "~/commands"),
    "machine_state": ("joint_states", "wrench"),
}
"""Topics of each node that the argument of the same name remaps."""


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=launch_nodes),
        ]
    )


def launch_nodes(context: LaunchContext) -> list[Node]:
    """Return the chosen nodes; called when the arguments have their values."""
    leave_interrupts_to_launch()
    check_launch_arguments(__file__, context.argv, ARGUMENTS)
    return create_processes({name: context.launch_configurations[name] for name in ARGUMENTS})


def create_processes(given: dict[str, str]) -> list[Node]:
    """Check the arguments and create the processes of one robot, without starting them.

    :raises RuntimeError: an argument is wrong, or a program is missing.
    """
    file = given["params_file"]
    if file and not Path(file).is_file():
        raise RuntimeError(f"params_file: {file!r} is no file")
    if given["robot"]:
        load_robot(given["robot"])
    for name in ("respawn", "use_sim_time", *(["use_wrench"] if given["use_wrench"] else [])):
        read_flag(given, name)
    read_choice(given, "executor", ("events", "single"))
    read_choice(given, "acceleration", ("trajectory", "differentiate", ""))
    read_choice(given, "log_level", LOG_LEVELS)
    chosen = [name for name in PARAMETERS if read_flag(given, name)]
    if not chosen:
        raise RuntimeError(f"nothing to run: {', '.join(PARAMETERS)} are all false")
    _check_deadline(given, chosen)
    together = [name for name in chosen if name != GATE]
    if read_flag(given, "composed") and together:
        groups = [[name] for name in chosen if name == GATE] + [together]
    else:
        groups = [[name] for name in chosen]
    check_executables(("pkm_twin", _choose_executable(names)) for names in groups)
    return [_create_process(names, given) for names in groups]


def _check_deadline(given: dict[str, str], chosen: list[str]) -> None:
    """Check that delta_dynamics publishes torques within the deadline of the gate.

    The middleware does not connect a publisher with a longer deadline than its subscriber's.

    :raises RuntimeError: ``stale_after`` exceeds the deadline.
    """
    if not {"delta_dynamics", GATE} <= set(chosen):
        return
    stale_after = _read_parameter(given, "delta_dynamics", "stale_after", Settings().stale_after)
    deadline = _read_parameter(given, GATE, "deadline", GateSettings().deadline)
    if stale_after > deadline:
        raise RuntimeError(
            f"params_file: delta_dynamics has stale_after {stale_after:g} s and command_gate has "
            f"deadline {deadline:g} s: no torque would reach the gate; stale_after has to be at "
            "most the deadline"
        )


def _read_parameter(given: dict[str, str], node: str, name: str, default: float) -> float:
    """Read a parameter of a node from the file; later sections override earlier ones."""
    file = given["params_file"]
    if not file:
        return default
    full, found = _qualify_name(given, node), default

    def search_section(section: object, path: str) -> None:
        nonlocal found
        for key, value in section.items() if isinstance(section, dict) else ():
            if key != "ros__parameters":
                search_section(value, f"{path}/{str(key).strip('/')}")
            elif re.fullmatch(_compile_wildcards(path), full) and isinstance(value, dict):
                found = value.get(name, found)

    try:
        search_section(yaml.safe_load(Path(file).read_text(encoding="utf-8")), "")
        return float(found)
    except (OSError, yaml.YAMLError, TypeError, ValueError) as error:
        raise RuntimeError(f"params_file: {file!r}: {' '.join(str(error).split())}") from None


def _qualify_name(given: dict[str, str], node: str) -> str:
    """Return a node's name with its namespace."""
    return f"/{given['namespace'].strip('/')}/{node}".replace("//", "/")


def _compile_wildcards(path: str) -> str:
    """Return the regular expression of a parameter file's node name: * is one name, ** any number."""
    return re.escape(path).replace(r"/\*\*", "(/.*)?").replace(r"\*", "[^/]*")


def _choose_executable(names: list[str]) -> str:
    """Return the executable of one node, or that of several nodes in one process."""
    return names[0] if len(names) == 1 else "composed"


def _create_process(names: list[str], given: dict[str, str], tries: int = 0) -> Node:
    """Create the process of one or several nodes, with a parameter file with a section for each."""
    folder = tempfile.mkdtemp(prefix="pkm_twin_")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    before, after = Path(folder, "before.yaml"), Path(folder, "after.yaml")
    # Later files win: the default robot, then params_file, then the given arguments.
    for file, section in (
        (before, lambda _: {"mechanism": ROBOT}),
        (after, lambda name: _collect_parameters(name, given)),
    ):
        sections = {_qualify_name(given, name): {"ros__parameters": section(name)} for name in names}
        file.write_text(yaml.safe_dump(sections), encoding="utf-8")
    files = [] if given["robot"] else [str(before)]
    files += [given["params_file"]] if given["params_file"] else []
    remappings = [
        word
        for name in names
        for topic in TOPICS[name]
        for word in ("-r", f"{name}:{topic}:={given[topic.removeprefix('~/')]}")
    ]
    single = names[0] if len(names) == 1 else None
    return Node(
        package="pkm_twin",
        executable=_choose_executable(names),
        name=single,
        namespace=given["namespace"],
        arguments=[] if single else names,
        parameters=[*files, str(after)],
        ros_arguments=[*remappings, "--log-level", given["log_level"]],
        on_exit=_Restart(names, given, tries),
        # For such small matrices threads cost more time than they save.
        additional_env={"OMP_NUM_THREADS": "1"},
        output="screen",
    )


def _collect_parameters(name: str, given: dict[str, str]) -> dict[str, object]:
    """Return the parameters of a node that the arguments give."""
    chosen: dict[str, object] = {key: given[key] for key in PARAMETERS[name] if given[key]}
    if given["robot"]:
        chosen["mechanism"] = given["robot"]
    chosen["executor"] = given["executor"]
    if "use_wrench" in chosen:
        chosen["use_wrench"] = read_flag(given, "use_wrench")
    return {**chosen, "use_sim_time": read_flag(given, "use_sim_time")}


class _Restart:
    """Restart processes that ended, or report that they are not restarted."""

    def __init__(self, names: list[str], given: dict[str, str], tries: int) -> None:
        self._names, self._given, self._tries = names, given, tries
        self._began = time.monotonic()

    def __call__(self, event: ProcessExited, context: LaunchContext) -> list[LaunchDescriptionEntity]:
        names, given = self._names, self._given
        gate = names == [GATE]
        if context.is_shutdown or not (gate or read_flag(given, "respawn")):
            return []
        if event.returncode != REJECTED_EXIT_CODE or time.monotonic() - self._began > MIN_VALID_RUN:
            restarted = _create_process(names, given)
            # Restart a failed gate at once, as the controller holds the last torque until then. A gate
            # that was stopped has sent zeros, and the whole launch may be stopping.
            if gate and event.returncode:
                return [restarted]
            return [TimerAction(period=RESPAWN_DELAY, actions=[restarted])]
        if self._tries == MAX_RETRIES:
            text = f"{', '.join(names)}: the configuration is rejected; not started again"
            return [LogInfo(msg=text)]
        pause = RESPAWN_DELAY * 2**self._tries
        restarted = _create_process(names, given, self._tries + 1)
        return [TimerAction(period=pause, actions=[restarted])]
