# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Run the demonstration: recorded bags through the real nodes over the real middleware.

For each bag a node runs as a separate process, and at last a simulated machine with feedforward.
This process plays the bags in lockstep with the answers, records the nodes' topics into one MCAP
file, evaluates it, and ends with a table, a picture and a verdict. Time is simulated everywhere, so
a busy computer takes longer with the same results.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from pkm_twin.bags.definitions import JOINT_STATE, TRAJECTORY, TRANSFORM
from pkm_twin.bags.reader import BagMessage, BagWriter, inspect
from pkm_twin.demo import tracking
from pkm_twin.demo.recorder import (
    MAX_WAIT,
    QUEUE_DEPTH,
    Lockstep,
    Recorder,
    receive_remaining,
    run_process,
    wait_for,
)
from pkm_twin.demo.report import REPORTS, draw
from pkm_twin.errors import PkmTwinError
from pkm_twin.report import Fact, Report, Verdict
from pkm_twin.report.terminal import present
from pkm_twin.ros.context import middleware_arguments
from pkm_twin.ros.player import play
from pkm_twin.ros.signals import INTERRUPTED, first_signal


@dataclass(frozen=True)
class Stage:
    """One bag, the node that answers it, and the node's output topics with their types.

    ``paced_input``: the input whose messages are all answered, with their stamps, on ``answer``.
    """

    bag: str
    module: str
    parameters: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: dict[str, str]
    paced_input: str
    answer: str

    @property
    def arguments(self) -> list[str]:
        """Arguments of the node, with queues that do not overflow on a busy computer."""
        queues = [f"qos_overrides.{t}.subscription.reliability:=reliable" for t in self.inputs]
        queues += [f"qos_overrides.{t}.publisher.depth:={QUEUE_DEPTH}" for t in self.outputs]
        given = ("use_sim_time:=true", "future_tolerance:=1.0", f"max_wait:={MAX_WAIT}", *self.parameters, *queues)
        return ["--ros-args", *(word for parameter in given for word in ("-p", parameter))]


# Accept late torques, because they are only recorded.
STALE_PARAMETER = f"stale_after:={MAX_WAIT}"
JOINT_STATES = "/joint_states"
DYNAMICS_OUTPUTS = {
    "/delta_dynamics/joint_torques": JOINT_STATE,
    "/delta_dynamics/torque_residual": JOINT_STATE,
    "/delta_dynamics/joint_trajectory_ff": TRAJECTORY,
}
STAGES = (
    Stage(
        "delta_cu_pick_and_place",
        "delta_dynamics.nodes.twin",
        ("mechanism:=delta_cu", STALE_PARAMETER),
        (JOINT_STATES, "/delta_dynamics/joint_trajectory"),
        DYNAMICS_OUTPUTS,
        JOINT_STATES,
        "/delta_dynamics/joint_torques",
    ),
    Stage(
        "prru_milling",
        "delta_dynamics.nodes.twin",
        ("mechanism:=prru", "use_wrench:=true", STALE_PARAMETER),
        (JOINT_STATES, "/wrench", "/delta_dynamics/joint_trajectory"),
        DYNAMICS_OUTPUTS,
        JOINT_STATES,
        "/delta_dynamics/joint_torques",
    ),
    Stage(
        "upr_rpu_milling",
        "stiffness_monitor.node",
        ("mechanism:=upr_rpu",),
        (JOINT_STATES, "/wrench"),
        {
            "/stiffness_monitor/compliance": "std_msgs/msg/Float64MultiArray",
            "/stiffness_monitor/strain_energy": "diagnostic_msgs/msg/DiagnosticArray",
            "/stiffness_monitor/dominant_element": "std_msgs/msg/String",
            "/stiffness_monitor/deflection": TRANSFORM,
        },
        "/wrench",
        "/stiffness_monitor/deflection",
    ),
)


def run_stage(stage: Stage, bag: Path, recorder: Recorder, executor: SingleThreadedExecutor, console: Console) -> None:
    """Start the node, play the bag as fast as it is answered, and record the answers."""
    node = executor.get_nodes()[0]
    recorder.start_recording(stage.bag, stage.outputs, stage.answer)
    report = inspect(bag)
    seconds = (report.end_time - report.start_time) / 1e9
    what = f"{stage.module} to answer {stage.bag}"
    with (
        run_process([sys.executable, "-m", stage.module, *stage.arguments]) as twin,
        Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[messages]} answers"),
            TimeElapsedColumn(),
            console=console,
        ) as progress,
    ):
        bar = progress.add_task(f"{stage.bag} -> {stage.module}", total=seconds, messages=0)
        wait_for(
            executor,
            lambda: all(node.count_publishers(topic) for topic in stage.outputs),
            f"{stage.module} to come up",
            twin,
        )
        lockstep = Lockstep(stage.paced_input, recorder, executor, twin, what)
        lockstep.start(report.start_time)
        begin, before = time.monotonic(), recorder.total

        def pace_and_show(message: BagMessage) -> None:
            lockstep.pace(message)
            done = (message.log_time - report.start_time) / 1e9
            progress.update(bar, completed=done, messages=recorder.total - before)

        play(bag, topics=stage.inputs, wait_for_subscribers=MAX_WAIT, progress=False, pace=pace_and_show)
        receive_remaining(executor, recorder, lambda: lockstep.answered)
        lockstep.close()
        progress.update(bar, completed=seconds, messages=recorder.total - before)
    recorder.stop_recording()
    taken = time.monotonic() - begin
    if taken > seconds:
        console.print(
            f"[yellow]{stage.bag}: {taken:.0f} s for {seconds:.0f} s of recording. This machine is "
            "too slow or too busy for a live stream of this rate.[/yellow]"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demonstration; return 0 if every node answered and every figure keeps its bound."""
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
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        console.print(f"[red]demo failed:[/red] {options.out}: {error.strerror}")
        return 1
    try:
        # A signal must end the child processes, too.
        with first_signal(KeyboardInterrupt):
            report = run(options.bags, options.out, console)
    except KeyboardInterrupt:
        return INTERRUPTED
    except PkmTwinError as error:
        console.print(f"[red]demo failed:[/red] {error}")
        return 1
    present(report, False)
    return report.exit_code


def run(bags: Path, out: Path, console: Console) -> Report:
    """Play the bags to their nodes, control a simulated machine, and evaluate the recording."""
    recording = out / "demo.mcap"
    context = Context()
    rclpy.init(args=middleware_arguments([]), context=context)
    executor = SingleThreadedExecutor(context=context)
    node = rclpy.create_node("demo_recorder", context=context)
    executor.add_node(node)
    try:
        with BagWriter(recording, overwrite=True) as writer:
            recorder = Recorder(node, writer)
            for stage in STAGES:
                run_stage(stage, bags / f"{stage.bag}.mcap", recorder, executor, console)
            for spread in tracking.SPREADS:
                tracking.run(spread, recorder, executor, console)
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown(context=context)
    parts = [REPORTS[s.bag](bags / f"{s.bag}.mcap", recording, s.bag) for s in STAGES]
    parts.append(tracking.report(recording))
    findings: list[Fact] = [fact for found, _ in parts for fact in found]
    picture = draw([panel for _, panel in parts], out / "demo.png")
    bad = any(fact.verdict is Verdict.BAD for fact in findings)
    return Report(
        f"{'OFF' if bad else 'good'}: recorded bags and a simulated machine through the nodes",
        findings,
        files={"picture": picture, "recording": recording},
        verdict=Verdict.BAD if bad else Verdict.GOOD,
    )


if __name__ == "__main__":
    sys.exit(main())
