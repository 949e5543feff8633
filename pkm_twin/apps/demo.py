# SPDX-License-Identifier: Apache-2.0
"""The demonstration: every recorded bag through the real nodes over the real middleware.

For each bag a node and the player run as processes of their own; this process records what the
node publishes into one MCAP, reads that back, and ends with a table, a picture and a verdict.
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from pkm_twin.apps.demo_report import REPORTS, Finding, draw, print_findings
from pkm_twin.bags.reader import BagWriter, inspect
from pkm_twin.errors import BagError, PkmTwinError
from pkm_twin.ros.signals import INTERRUPTED, first_signal

MATCH_SECONDS = 60.0
"""How long a node may take to come up: the first start compiles the kernels."""

STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


@dataclass(frozen=True)
class Stage:
    """One bag, the node that answers it, and the node's output topics with their types."""

    bag: str
    module: str
    parameters: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: dict[str, str]


# A shared machine may leave the node waiting for a while: here nobody is pushed by a late torque.
PATIENT = ("stale_after:=1.0", "qos_overrides./joint_states.subscription.depth:=1000")
DYNAMICS_OUTPUTS = {
    "/delta_dynamics/joint_torques": STATE,
    "/delta_dynamics/torque_residual": STATE,
    "/delta_dynamics/joint_trajectory_ff": TRAJECTORY,
}
STAGES = (
    Stage(
        "delta_cu_pick_and_place",
        "delta_dynamics.node",
        ("mechanism:=delta_cu", *PATIENT),
        ("/joint_states", "/delta_dynamics/joint_trajectory"),
        DYNAMICS_OUTPUTS,
    ),
    Stage(
        "prru_milling",
        "delta_dynamics.node",
        (
            "mechanism:=prru",
            "use_wrench:=true",
            *PATIENT,
            "qos_overrides./wrench.subscription.depth:=1000",
        ),
        ("/joint_states", "/wrench", "/delta_dynamics/joint_trajectory"),
        DYNAMICS_OUTPUTS,
    ),
    Stage(
        "upr_rpu_milling",
        "stiffness_monitor.node",
        (
            "mechanism:=upr_rpu",
            "qos_overrides./joint_states.subscription.depth:=1000",
            "qos_overrides./wrench.subscription.depth:=1000",
        ),
        ("/joint_states", "/wrench"),
        {
            "/stiffness_monitor/compliance": "std_msgs/msg/Float64MultiArray",
            "/stiffness_monitor/strain_energy": "diagnostic_msgs/msg/DiagnosticArray",
            "/stiffness_monitor/dominant_element": "std_msgs/msg/String",
            "/stiffness_monitor/deflection": "geometry_msgs/msg/TransformStamped",
        },
    ),
)


class Recorder:
    """Writes the raw messages of some topics into a bag, under a prefix for each stage."""

    def __init__(self, node: Node, writer: BagWriter) -> None:
        self._node = node
        self._writer = writer
        self._subscriptions: list[Any] = []
        self.counts: dict[str, int] = {}

    def listen(self, prefix: str, topics: dict[str, str]) -> None:
        """Record these topics from now on, as ``prefix`` followed by the topic."""
        qos = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)
        for topic, kind in topics.items():
            name = f"/{prefix}{topic}"
            self._writer.add_topic(name, kind)
            self.counts[name] = 0
            self._subscriptions.append(
                self._node.create_subscription(
                    _message_class(kind), topic, self._keep(name), qos, raw=True
                )
            )

    def stop(self) -> None:
        """Forget the current topics."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def _keep(self, name: str) -> Callable[[bytes], None]:
        def callback(data: bytes) -> None:
            self.counts[name] += 1
            self._writer.write(name, data, time.time_ns())

        return callback


def run_stage(
    stage: Stage, bag: Path, recorder: Recorder, executor: SingleThreadedExecutor, console: Console
) -> None:
    """Start the node, replay the bag, and record until the node has answered all of it."""
    node = executor.get_nodes()[0]
    recorder.listen(stage.bag, stage.outputs)
    parameters = [word for p in ("use_sim_time:=true", *stage.parameters) for word in ("-p", p)]
    report = inspect(bag)
    seconds = (report.end_time - report.start_time) / 1e9
    with (
        process([sys.executable, "-m", stage.module, "--ros-args", *parameters]) as twin,
        Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[messages]} answers"),
            TimeElapsedColumn(),
            console=console,
        ) as progress,
    ):
        bar = progress.add_task(f"{stage.bag} -> {stage.module}", total=seconds, messages=0)
        _wait(
            executor,
            lambda: all(node.count_publishers(topic) for topic in stage.outputs),
            MATCH_SECONDS,
            f"{stage.module} to come up",
            twin,
        )
        command = [sys.executable, "-m", "pkm_twin.apps.cli", "play", str(bag)]
        command += ["--clock", "200", "--wait", "20"]
        command += [word for topic in stage.inputs for word in ("--topic", topic)]
        with process([*command, "--quiet"]) as player:
            begin, before = time.monotonic(), sum(recorder.counts.values())
            while player.poll() is None:
                executor.spin_once(timeout_sec=0.05)
                progress.update(
                    bar,
                    completed=min(seconds, time.monotonic() - begin),
                    messages=sum(recorder.counts.values()) - before,
                )
            if player.returncode != 0:
                raise BagError(f"the player ended with code {player.returncode}", path=bag)
        _drain(executor, recorder)
        answers = sum(recorder.counts.values()) - before
        progress.update(bar, completed=seconds, messages=answers)
    recorder.stop()


@contextmanager
def process(command: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A child process in a session of its own, ended with SIGINT and waited for."""
    child = subprocess.Popen(command, start_new_session=True, env=child_environment())  # noqa: S603
    try:
        yield child
    finally:
        if child.poll() is None:
            child.send_signal(signal.SIGINT)
            try:
                child.wait(timeout=5.0)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()


def child_environment() -> dict[str, str]:
    """The environment, changed so that a child's ROS wheels find their libraries again."""
    environment = dict(os.environ)
    environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    return environment


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demonstration; 0 where every node answered and every figure is in bounds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bags", type=Path, default=Path("bags"), help="folder of the bags")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the results")
    parser.add_argument("--domain", type=int, default=67, help="ROS domain to run in")
    options = parser.parse_args(arguments)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(options.domain)
    console = Console()
    if not console.is_terminal:
        console = Console(width=120)
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        # The children too have to end with this process.
        with first_signal(KeyboardInterrupt):
            findings = run(options.bags, options.out, console)
    except KeyboardInterrupt:
        return INTERRUPTED
    except PkmTwinError as error:
        console.print(f"[red]demo failed:[/red] {error}")
        return 1
    return 0 if all(finding.good for finding in findings) else 1


def run(bags: Path, out: Path, console: Console) -> list[Finding]:
    """Replay every bag through its node, and print and draw what came back."""
    recording = out / "demo.mcap"
    context = Context()
    rclpy.init(context=context)
    try:
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(rclpy.create_node("demo_recorder", context=context))
        with BagWriter(recording, overwrite=True) as writer:
            recorder = Recorder(executor.get_nodes()[0], writer)
            for stage in STAGES:
                run_stage(stage, bags / f"{stage.bag}.mcap", recorder, executor, console)
    finally:
        rclpy.try_shutdown(context=context)
    findings: list[Finding] = []
    series = {}
    for stage in STAGES:
        found, series[stage.bag] = REPORTS[stage.bag](
            bags / f"{stage.bag}.mcap", recording, stage.bag
        )
        findings += found
    picture = draw(series, out / "demo.png")
    print_findings(console, findings)
    console.print(f"picture {picture}, recording {recording}")
    return findings


def _message_class(kind: str) -> Any:
    package, _, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def _wait(
    executor: SingleThreadedExecutor,
    condition: Callable[[], bool],
    seconds: float,
    what: str,
    child: subprocess.Popen[bytes],
) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        executor.spin_once(timeout_sec=0.1)
        if child.poll() is not None:
            raise PkmTwinError(f"waiting for {what}: it ended with code {child.returncode}")
        if time.monotonic() > deadline:
            raise PkmTwinError(f"waiting for {what}: nothing after {seconds:g} s")


def _drain(executor: SingleThreadedExecutor, recorder: Recorder) -> None:
    """Take what is still on its way: until nothing has come for half a second."""
    last, quiet = sum(recorder.counts.values()), time.monotonic()
    while time.monotonic() - quiet < 0.5:
        executor.spin_once(timeout_sec=0.05)
        count = sum(recorder.counts.values())
        if count != last:
            last, quiet = count, time.monotonic()


if __name__ == "__main__":
    sys.exit(main())
