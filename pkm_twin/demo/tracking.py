# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compare PD control with and without feedforward on the demonstration's simulated machine.

The parameters of machine_sim are perturbed from the model's. It keeps simulated time and follows
a trajectory by itself, starting with brakes on, so that the result does not depend on the computer.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rich.console import Console
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from pkm_twin import load
from pkm_twin.bags.definitions import JOINT_STATE, TRAJECTORY
from pkm_twin.bags.reader import read_messages
from pkm_twin.codegen.arrays import Array
from pkm_twin.demo.recorder import (
    QUEUE_DEPTH,
    Recorder,
    receive_remaining,
    run_process,
    wait_for,
)
from pkm_twin.demo.report import Panel, judge_share, unjudged_fact
from pkm_twin.errors import BagError
from pkm_twin.messages.reading import JointReader
from pkm_twin.messages.stamps import SECOND, stamp_of
from pkm_twin.recordings.bags import TOPIC
from pkm_twin.report import Fact, make_judged_fact, plots
from pkm_twin.streams.path import JointPath

MIN_IMPROVEMENT: Final = 5.0
"""Smallest ratio of tracking errors without and with feedforward, at the smallest perturbation."""
ROBOT: Final = "delta_cu"
"""Robot of the tracking demonstration."""
PERIOD: Final = 2e-3
"""Period of the machine's joint states, s, which a busy computer can still record."""
SPREADS: Final = (0.01, 0.2)
"""Relative standard deviations of the machine's parameters."""
DURATION: Final = 0.8
"""Duration of the motion, s."""
TRAJECTORY_POINTS: Final = 81
"""Number of points of the tracked trajectory."""
INPUT_TOPIC: Final = "/machine_sim/joint_trajectory"


class _MachineWatch:
    """Follows the machine's clock, ns, and whether the machine is at rest or has finished its path."""

    def __init__(self) -> None:
        self.newest = 0
        self.is_at_rest = self.done = False
        self._since: int | None = None

    def update(self, state: JointState) -> None:
        """Update with a joint state, whose velocities are exactly zero while the brakes are on."""
        self.newest = stamp_of(state.header)
        self.is_at_rest = not any(state.velocity)
        if self._since is None and not self.is_at_rest:
            self._since = self.newest
        if self._since is not None:
            self.done |= self.newest > self._since + 1.1 * DURATION * SECOND

    def start(self) -> None:
        """Start to watch another path."""
        self.is_at_rest = self.done = False
        self._since = None


def run(spread: float, recorder: Recorder, executor: SingleThreadedExecutor, console: Console) -> None:
    """Record a run without and a run with feedforward on a machine with this perturbation."""
    node = executor.get_nodes()[0]
    recorder.start_recording(topic_prefix(spread), {"/joint_states": JOINT_STATE, INPUT_TOPIC: TRAJECTORY})
    watch = _MachineWatch()
    states = node.create_subscription(JointState, "/joint_states", watch.update, QUEUE_DEPTH)
    answers: list[JointTrajectory] = []
    twin_answers = node.create_subscription(JointTrajectory, f"{TOPIC}_ff", answers.append, 10)
    depth = QoSProfile(depth=1)
    twin, machine = (node.create_publisher(JointTrajectory, t, depth) for t in (TOPIC, INPUT_TOPIC))
    reset = node.create_client(Trigger, "/machine_sim/reset")
    module = [sys.executable, "-m"]
    # The twin answers trajectories alone, so give it an empty topic of joint states.
    twin_command = [*module, "delta_dynamics.nodes.twin", "--ros-args", "-p", f"mechanism:={ROBOT}"]
    twin_command += ["-r", "joint_states:=/delta_dynamics/joint_states"]
    machine_command = [*module, "delta_dynamics.nodes.simulation", "--ros-args", "-p", f"mechanism:={ROBOT}"]
    machine_command += ["-p", "clock:=simulated", "-p", f"period:={PERIOD}"]
    # Use deep queues, because a busy computer catches up in bursts.
    queue = f"qos_overrides./joint_states.publisher.depth:={QUEUE_DEPTH}"
    machine_command += ["-p", f"spread:={spread}", "-p", queue]
    console.print(f"machine_sim at {100 * spread:g} % spread: PD, then with feedforward")
    # Make a trajectory from home and back, at rest at both ends, that starts on receipt.
    robot = load(ROBOT)
    home = robot.inverse(robot.home())
    x = np.linspace(0.0, 1.0, TRAJECTORY_POINTS)
    # 64 (x - x^2)^3 is 1 at x = 1/2, and its first two derivatives vanish at both ends.
    blend = 64.0 * np.array([-1.0, 3.0, -3.0, 1.0, 0.0, 0.0, 0.0])
    rows = [np.outer(np.polyval(np.polyder(blend, k), x) / DURATION**k, (0.5, -0.4, 0.6)) for k in range(3)]
    trajectory_without_effort = JointTrajectory(joint_names=list(robot.joint_names))
    for k in range(TRAJECTORY_POINTS):
        point = JointTrajectoryPoint(
            positions=(home + rows[0][k]).tolist(), velocities=rows[1][k].tolist(), accelerations=rows[2][k].tolist()
        )
        time = round(x[k] * DURATION * SECOND)
        point.time_from_start.sec, point.time_from_start.nanosec = divmod(time, SECOND)
        trajectory_without_effort.points.append(point)
    with run_process(machine_command) as first, run_process(twin_command) as second:

        def wait_for_machine(condition: Callable[[], bool], what: str) -> None:
            wait_for(executor, condition, what, first)

        def publish_until_answered() -> bool:
            # Publish repeatedly: discovery is not complete in both directions at once.
            if not answers:
                twin.publish(trajectory_without_effort)
            return bool(answers)

        wait_for_machine(lambda: watch.newest > 0, "machine_sim")
        wait_for(executor, publish_until_answered, "delta_dynamics", second)
        # Wait until the machine and the recorder subscribe.
        wait_for_machine(lambda: machine.get_subscription_count() >= 2, "machine_sim")
        for trajectory in (trajectory_without_effort, answers[0]):
            wait_for_machine(reset.service_is_ready, "machine_sim's reset")
            done = reset.call_async(Trigger.Request())
            wait_for_machine(done.done, "machine_sim's reset")
            watch.start()
            wait_for_machine(lambda: watch.is_at_rest, "the machine at its start")
            watch.start()
            machine.publish(trajectory)
            wait_for_machine(lambda: watch.done, "the path's end")
    # Receive the messages that are still in the queues.
    receive_remaining(executor, recorder)
    recorder.stop_recording()
    for subscription in (states, twin_answers):
        node.destroy_subscription(subscription)
    node.destroy_client(reset)
    for publisher in (twin, machine):
        node.destroy_publisher(publisher)


@dataclass(frozen=True)
class Run:
    """One run along the path: duration and times, s; errors (rad) and efforts (N m), (p, n)."""

    duration: float
    time: Array
    error: Array
    effort: Array

    @property
    def rms(self) -> float:
        """Root mean square of the tracking error over all joints."""
        return float(np.sqrt(np.mean(self.error**2)))


def topic_prefix(spread: float) -> str:
    """Return the prefix of a perturbation's topics in the recording."""
    return f"machine_sim_{100 * spread:g}_percent"


def report(recording: Path) -> tuple[list[Fact], Panel]:
    """Report tracking errors and efforts of both runs for each perturbation."""
    findings: list[Fact] = []
    panel = Panel("machine_sim: tracking error by model error", "error, all joints (mrad)", [])
    robot = load(ROBOT)
    for i, spread in enumerate(SPREADS):
        name = topic_prefix(spread)
        # Read the runs without and with feedforward from the recording.
        reader = JointReader(load(ROBOT), with_effort=True)
        messages = read_messages(recording, [f"/{name}/joint_states"])
        states = {stamp_of(m.message.header): m.message for m in messages}
        stamps = np.array(sorted(states))
        moving = np.array([any(states[stamp].velocity) for stamp in stamps.tolist()])
        # A trajectory begins at the last joint state at rest.
        starts = stamps[:-1][~moving[:-1] & moving[1:]]
        topic = f"/{name}/machine_sim/joint_trajectory"
        trajectories = [reader.trajectory(m.message, 0) for m in read_messages(recording, [topic])]
        found: dict[bool, Run] = {}
        for trajectory, start in zip(trajectories, starts.tolist(), strict=False):
            path = JointPath(trajectory)
            end = start + round(path.duration * SECOND)
            during = stamps[(stamps > start) & (stamps <= end)].tolist()
            # The machine publishes its joints in the robot's order.
            q = np.array([states[s].position for s in during])
            times = (np.array(during) - start) / SECOND
            wanted = np.array([path.at(t).q for t in times.tolist()])
            effort = np.array([states[s].effort for s in during])
            found[trajectory.effort is not None] = Run(path.duration, times, q - wanted, effort)
        if len(found) != 2 or len(starts) != 2:
            raise BagError(f"{name}: {len(found)} of two runs were recorded", path=recording)
        plain, ahead = found[False], found[True]
        recorded = sum(len(run.time) for run in (plain, ahead))
        published = sum(round(run.duration / PERIOD) for run in (plain, ahead))
        findings.append(judge_share(name, "joint states recorded", recorded, published))
        for what, line, one in (("PD", "-", plain), ("PD and feedforward", "--", ahead)):
            size = 1e3 * np.linalg.norm(one.error, axis=1)
            style = {"ls": line, "color": plots.COLOURS[i], "lw": 1.2}
            panel.lines.append((one.time, size, {**style, "label": f"{what}, {100 * spread:g} %"}))
            peaks = ", ".join(f"{peak:.3g}" for peak in np.abs(one.effort).max(0))
            value = f"{1e3 * one.rms:.3f} mrad RMS, {1e3 * np.abs(one.error).max():.3f} worst"
            findings.append(unjudged_fact(name, f"tracking error, {what}", value))
            findings.append(unjudged_fact(name, f"peak effort, {what}", f"{peaks} {robot.effort_unit}"))
        ratio = plain.rms / ahead.rms
        what = f"feedforward at {100 * spread:g} % parameter error"
        bound = f"{MIN_IMPROVEMENT:g} or more" if spread == min(SPREADS) else ""
        value = f"{ratio:.1f} times better"
        findings.append(make_judged_fact(f"{name}: {what}", value, bound, bool(ratio >= MIN_IMPROVEMENT)))
    return findings, panel
