# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""How the nodes and launch files behave beside real ROS 2 tools: one line for each property.

    python3 tools/cell_trial/manners.py [CASE ...]

urdf, description: the URDF's ros2_control element. deadline, resume: torques through the gate.
off: efforts of drives that are off or braked. launch: arguments and configurations that are
rejected. control: control.launch.py with the gate. Needs a sourced Jazzy workspace with pkm_twin,
rosbag2, controller_manager, the controllers and mock hardware.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from cell import DEADLINE, Peer, Process, closing, find_executable, node, peer
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped, WrenchStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String

from delta_dynamics import inverse_dynamics
from pkm_twin import load

ROBOT = "delta_cu"
MOCK = "mock_components/GenericSystem"
RATE = 250.0
"""Rate of the joint states, Hz."""


class Results:
    """Print result lines, and record whether all were good."""

    def __init__(self) -> None:
        self.good = True

    def __call__(self, good: Any, what: str) -> None:
        self.good &= bool(good)
        print(f"{'good' if good else 'BAD '}  {what}", flush=True)


def output(*command: str, timeout: float = 2.0 * DEADLINE) -> tuple[int, str]:
    """Run a command; return its exit code and output."""
    process = Process(*command)
    try:
        code = process.process.wait(timeout)
        return code, process.output
    finally:
        process.close()


class States:
    """A stream of joint states near home with gravity efforts."""

    def __init__(self, other: Peer) -> None:
        self.other, self.robot = other, load(ROBOT)
        self.home = self.robot.inverse(self.robot.home())
        self.publisher = other.node.create_publisher(JointState, "joint_states", 1000)
        self.rng = np.random.default_rng(1)

    def stream(self, seconds: float, *, late: float = 0.0, moving: bool = True, drives: str = "on") -> None:
        """Publish for a time, s.

        :param late: age of the stamps, s; ``drives``: on, off, braked, or broken: NaN.
        """
        count = round(seconds * RATE)
        t = np.arange(count)[:, None] / RATE
        # From home and back, without a jump.
        shape = 0.05 * moving * np.sin(np.pi * t / seconds) ** 4
        motion = self.home + shape * np.sin(3.0 * t + np.arange(len(self.home)))
        rates = np.gradient(motion, 1.0 / RATE, axis=0, edge_order=2)
        pushes = np.gradient(rates, 1.0 / RATE, axis=0, edge_order=2)
        efforts = inverse_dynamics(self.robot, motion, rates, pushes)
        clock = self.other.node.get_clock()
        begin = clock.now().nanoseconds
        for k, (q, qd, effort) in enumerate(zip(motion, rates, efforts, strict=True)):
            due = begin + round(k * 1e9 / RATE)
            self.other.spin(1e-9 * (due - clock.now().nanoseconds))
            measured = {
                "on": effort + 1e-3 * self.rng.standard_normal(len(q)),
                "off": 0.0 * effort,
                "braked": np.full_like(effort, 0.3),
                "broken": np.append(np.nan, effort[1:]),
            }[drives]
            message = JointState(name=list(self.robot.joint_names))
            stamp = due - round(1e9 * late)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
            message.position, message.velocity = array("d", q), array("d", qd)
            message.effort = array("d", measured)
            self.publisher.publish(message)


def diagnosed(other: Peer) -> dict[str, Any]:
    """Collect the newest diagnostic status of each node, by its name."""
    found: dict[str, Any] = {}

    def take(array_of: DiagnosticArray) -> None:
        found.update({status.name: status for status in array_of.status})

    other.node.create_subscription(DiagnosticArray, "/diagnostics", take, 1000)
    return found


def urdf(_: Peer, tell: Results) -> None:
    """Check the options of pkm-twin export urdf."""
    program = find_executable("pkm-twin")
    for words in (
        (),
        ("--hardware-plugin", "my_hardware/Drives"),
        ("--prefix", "left_"),
        ("--no-ros2-control",),
    ):
        code, text = output(program, "export", "urdf", ROBOT, *words)
        tree = ElementTree.fromstring(text)
        control = tree.find("ros2_control")
        plugin = None if control is None else control.findtext("hardware/plugin")
        names = [e.get("name", "") for e in (*tree.iter("link"), *tree.findall("joint"))]
        prefixed = all(name.startswith("left_") for name in names)
        wanted = None if "--no-ros2-control" in words else MOCK
        wanted = words[1] if "--hardware-plugin" in words else wanted
        tell(
            code == 0 and plugin == wanted and prefixed == ("--prefix" in words),
            f"export urdf {' '.join((ROBOT, *words))}: hardware plugin {plugin}, first link {names[0]}",
        )


def description(other: Peer, tell: Results) -> None:
    """Check machine_state's robot_description with a controller_manager."""
    for plugin in ("", MOCK):
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        texts = other.hear(String, "/robot_description", latched)
        with closing(
            Process("ros2", "run", "controller_manager", "ros2_control_node"),
            node("machine_state", parameters=(f"hardware_plugin:='{plugin}'",)),
        ) as (manager, state):
            other.until(lambda heard=texts: heard, lambda s=state: f"a description\n{s.output}")
            # With a description that has no hardware it says so, and waits for another one.
            other.until(
                lambda m=manager: (
                    "ros2_control" in m.output.partition("Received")[2] or "Successful 'activate'" in m.output
                ),
                lambda m=manager: m.output,
            )
            other.spin(2.0)
            loaded = "Successful 'activate' of hardware" in manager.output
            has = "<ros2_control" in texts[-1].data
            alive = "runs" if manager.alive() else "has ended"
            tell(
                has == loaded == bool(plugin) and manager.alive(),
                f"machine_state with hardware_plugin {plugin or 'empty'}: ros2_control element "
                f"{'there' if has else 'absent'}, controller_manager {alive} and has loaded "
                f"{'the mock hardware' if loaded else 'no hardware'}",
            )


def deadline(other: Peer, tell: Results) -> None:
    """Try a stale_after greater than the gate's deadline."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "parameters.yaml"
        slow = {"delta_dynamics": {"ros__parameters": {"stale_after": 0.5}}}
        file.write_text(yaml.safe_dump(slow))
        code, text = output(
            "ros2",
            "launch",
            "pkm_twin",
            "twin.launch.py",
            "command_gate:=true",
            f"params_file:={file}",
        )
    line = next((line for line in text.splitlines() if "stale_after" in line), "")
    tell(code and line and "process started" not in text, f"launch: exit code {code}, {line}")
    told = diagnosed(other)
    with closing(node("delta_dynamics", parameters=("stale_after:=0.5",)), node("command_gate")):
        other.until(
            lambda: "offers" in getattr(told.get("/command_gate"), "message", ""),
            lambda: f"the gate's diagnostics: {told}",
        )
        tell(True, f"command_gate: {told['/command_gate'].message}")


def resume(other: Peer, tell: Results) -> None:
    """Check torques after a gravity stop that are stamped before the stop's torque."""
    states = States(other)
    torques = other.hear(JointState, "/delta_dynamics/joint_torques", 1000)
    commands = other.hear(Float64MultiArray, "/command_gate/commands", 1000)
    told = diagnosed(other)
    with closing(
        node("delta_dynamics", parameters=("on_stop:=gravity", "stale_after:=1.0")),
        node("command_gate", parameters=("on_stop:=gravity", "deadline:=1.0")),
    ):
        other.until(lambda: len(told) == 2, "diagnostics of both")
        states.stream(3.0, late=0.5)
        torques.clear()
        commands.clear()
        states.stream(0.04, late=0.5, drives="broken")
        states.stream(2.0, late=0.5)
        other.spin(1.5)
        stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in torques]
        # Only the stop's torque is followed by one with an earlier stamp.
        stop = int(np.argmax(np.diff(stamps) < 0.0))
        behind = stamps[stop] - stamps[stop + 1]
        resumed = torques[stop + 1 :]
        sent = {tuple(m.data) for m in commands}
        passed = sum(tuple(m.effort) in sent for m in resumed)
        values = {pair.key: pair.value for pair in told["/command_gate"].values}
        rejected = values.get("torques rejected: stamp order", "0")
        tell(
            behind > 0.0 and passed > 0.9 * len(resumed),
            f"the first torque after a gravity stop is stamped {behind:.3f} s before the stop's; "
            f"{passed} of {len(resumed)} torques pass, {rejected} rejected for their order",
        )


def off(other: Peer, tell: Results) -> None:
    """Check efforts of drives that are off or braked, in the node and in a recording."""
    states = States(other)
    loads = other.hear(InertiaStamped, "/delta_dynamics/payload", 1000)
    wrenches = other.hear(WrenchStamped, "/delta_dynamics/external_wrench", 1000)
    told = diagnosed(other)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        recorder = Process("ros2", "bag", "record", "-s", "mcap", "-o", str(bag), "/joint_states")
        estimating = ("estimate_payload:=true", "observe_wrench:=true", "stale_after:=1.0")
        with closing(node("delta_dynamics", parameters=estimating), recorder):
            other.until(lambda: "/delta_dynamics" in told, "diagnostics")
            other.until(lambda: states.publisher.get_subscription_count() > 1, "the recorder")
            for drives in ("off", "braked"):
                states.stream(4.0)
                states.stream(1.0, moving=False)
                loads.clear()
                wrenches.clear()
                states.stream(3.0, moving=False, drives=drives)
                status = told["/delta_dynamics"]
                values = {pair.key: pair.value for pair in status.values}
                # Messages in transit, and the time to detect constant efforts.
                tell(
                    values["drives off or braked"] == "True" and values["contact"] == "False",
                    f"drives {drives} for 3 s: {status.message!r}; contact {values['contact']}, "
                    f"{len(wrenches)} external wrenches, payload "
                    f"{values['payload estimate (kg)']} kg",
                )
            states.stream(4.0)
            least = min((m.inertia.m for m in loads), default=0.0)
            tell(least >= 0.0, f"least payload {least:.3g} kg")
        _, text = output(find_executable("pkm-twin"), "check", str(bag), "--robot", ROBOT, "--json")
    items = [i for i in json.loads(text)["items"] if i["what"].startswith(("drives", "torque"))]
    for item in items:
        tell(item["verdict"] == "good", f"check, {item['what']}: {item['value']}")
    tell(len(items) == 1 + len(states.home), "check of a recording with drives off and braked")


def launch(_: Peer, tell: Results) -> None:
    """Launch an unknown robot, and a configuration that a node rejects."""
    code, text = output("ros2", "launch", "pkm_twin", "twin.launch.py", "robot:=nope")
    line = next((line for line in text.splitlines() if "nope" in line), "")
    tell(code and "process started" not in text, f"robot:=nope: exit code {code}, {line}")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "parameters.yaml"
        bad = {"delta_dynamics": {"ros__parameters": {"differentiator.order": 99}}}
        file.write_text(yaml.safe_dump(bad))
        code, text = output(
            "ros2",
            "launch",
            "pkm_twin",
            "twin.launch.py",
            "stiffness_monitor:=false",
            f"params_file:={file}",
        )
    starts = text.count("process started")
    tell(starts == 4 and "not started again" in text, f"a bad parameter: started {starts} times")


def control(other: Peer, tell: Results) -> None:
    """Check control.launch.py with the gate."""
    commands = other.hear(Float64MultiArray, "/effort_controller/commands", 1000)
    robot = load(ROBOT)
    home = robot.inverse(robot.home())
    weight = inverse_dynamics(robot, home, 0.0 * home, 0.0 * home)
    with closing(
        Process(
            "ros2",
            "launch",
            "pkm_twin",
            "control.launch.py",
            "command_gate:=true",
            "robot_state_publisher:=false",
        ),
        node("machine_state", parameters=(f"hardware_plugin:={MOCK}",)),
    ) as (started, _):
        other.until(lambda: commands, lambda: f"a command of the gate\n{started.output}")
        other.until(lambda: "active" in output("ros2", "control", "list_controllers")[1], "controllers")
        other.spin(3.0)
        _, listed = output("ros2", "control", "list_controllers")
        lines = [" ".join(line.split()) for line in listed.splitlines() if "active" in line]
        tell(
            any("effort_controller" in line and " active" in line for line in lines)
            and np.allclose(commands[-1].data, weight, atol=1e-6),
            f"control.launch.py command_gate:=true: {'; '.join(lines)}; the gate sends the effort "
            f"against gravity, {commands[-1].data[0]:.4f} N m",
        )


CASES: dict[str, Callable[[Peer, Results], None]] = {
    "urdf": urdf,
    "description": description,
    "deadline": deadline,
    "resume": resume,
    "off": off,
    "launch": launch,
    "control": control,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("cases", nargs="*", default=list(CASES), help=", ".join(CASES))
    tell = Results()
    for name in parser.parse_args().cases:
        with peer() as other:
            CASES[name](other, tell)
    return 0 if tell.good else 1


if __name__ == "__main__":
    sys.exit(main())
