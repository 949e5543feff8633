# SPDX-License-Identifier: Apache-2.0
"""Side-by-side timings, single thread, in one run: compare the ratios, not the machine.

Run by ``make bench``, which turns the result into docs/benchmarks.md.
"""

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from support.robots import parameters_of, random_joints

from delta_dynamics import inverse_dynamics
from pkm_twin import load
from stiffness_monitor import strain_energy
from test.nodes.harness import Domain, end_with_parent

pytestmark = pytest.mark.benchmark_run

BATCHES = [1, 1_000, 100_000]
PERIOD = 1e-3
SECONDS, SLICES = 1.5, 12
"""Length of a slice of the round trip, s, and how many."""


def motion(robot, count):
    rng = np.random.default_rng(1)
    q = random_joints(robot, rng, count)
    qd, qdd = rng.normal(0, 3, q.shape), rng.normal(0, 30, q.shape)
    return (q[0], qd[0], qdd[0]) if count == 1 else (q, qd, qdd)


def run(benchmark, count, function, *arguments):
    """Time calls in runs long enough for the clock: thousands of single samples, few batches."""
    function(*arguments)
    iterations = max(1, 2000 // count)
    benchmark.pedantic(function, arguments, rounds=40, iterations=iterations, warmup_rounds=2)


@pytest.mark.parametrize("count", BATCHES)
@pytest.mark.parametrize("name", ["delta", "delta_cu", "prru"])
def test_inverse_dynamics(benchmark, name, count):
    robot = load(name)
    benchmark.extra_info.update(what=f"inverse_dynamics({name})", samples=count)
    run(benchmark, count, inverse_dynamics, robot, *motion(robot, count))


@pytest.mark.parametrize("count", BATCHES)
def test_strain_energy(benchmark, count):
    robot = load("upr_rpu")
    rng = np.random.default_rng(1)
    pose = np.array([-0.6, 0.0, 0.0]) + rng.uniform(-0.1, 0.1, (count, 3))
    wrench = rng.normal(0, 100, (count, 6))
    if count == 1:
        pose, wrench = pose[0], wrench[0]
    benchmark.extra_info.update(what="strain_energy(upr_rpu)", samples=count)
    run(benchmark, count, strain_energy, robot, pose, wrench)


@pytest.mark.parametrize("name", ["delta", "delta_cu"])
def test_pinocchio_closed_loop(benchmark, name):
    """Assembly, velocities, accelerations and torques of one state, driven from Python."""
    pytest.importorskip("pinocchio")
    from bags.recording.pinocchio_models import DeltaEngine

    engine = DeltaEngine(parameters_of(name))
    q, qd, qdd = motion(load(name), 1)
    benchmark.extra_info.update(what=f"Pinocchio, full closed-loop solution ({name})", samples=1)
    run(benchmark, 100, engine.inverse_dynamics, q, qd, qdd, np.zeros(6))


@pytest.mark.parametrize("name", ["delta", "delta_cu"])
def test_pinocchio_rnea(benchmark, name):
    """Only the tree sweep, its state given: not the loops, not the torques."""
    pytest.importorskip("pinocchio")
    from bags.recording.pinocchio_models import DeltaEngine

    engine = DeltaEngine(parameters_of(name))
    tree = engine.state(*motion(load(name), 1))
    benchmark.extra_info.update(what=f"Pinocchio, bare rnea of the tree ({name})", samples=1)
    run(benchmark, 1, engine.rnea_only, tree)


def test_round_trip(benchmark):
    """joint_states to ~/joint_torques at 1 kHz, against the echo of the same messages."""
    rclpy = pytest.importorskip("rclpy")
    domain = Domain()
    os.environ.update(domain.environment())
    twin = ["-m", "delta_dynamics.node", "--ros-args", "-p", "mechanism:=delta_cu", "-p"]
    commands = {
        "echo": ["-m", "test.benchmarks.echo_node", "single"],
        "echo_events": ["-m", "test.benchmarks.echo_node", "events"],
        "delta_dynamics": [*twin, "executor:=single"],
        "delta_dynamics_events": [*twin, "executor:=events"],
    }
    context = rclpy.Context()
    rclpy.init(context=context)
    children = {}
    try:
        client = Client(rclpy, context, commands)
        for name, command in commands.items():
            children[name] = start(domain, name, command)
        for name in commands:
            client.wait_for(name)
        slices = [
            {name: client.measure(name, SECONDS, children[name].pid) for name in commands}
            for _ in range(SLICES)
        ]
    finally:
        for child in children.values():
            child.terminate()
        for child in children.values():
            child.wait(10)
        rclpy.try_shutdown(context=context)
        domain.close()

    # The machine is elsewhere now and then: the median of slices, each beside its own echo.
    def median(name, value, beside=None):
        return float(
            np.median(
                [value(pair[name]) / (value(pair[beside]) if beside else 1) for pair in slices]
            )
        )

    values = {
        "p50_us": lambda m: float(np.percentile(m.times, 50)) * 1e6,
        "p99_us": lambda m: float(np.percentile(m.times, 99)) * 1e6,
        "cpu_us": lambda m: m.cpu / m.sent * 1e6,
        "lost": lambda m: m.sent - m.answered,
    }
    figures = {
        name: {what: median(name, value) for what, value in values.items()} for name in commands
    }
    ratios = {
        name: {
            what: median(name, values[what], name.replace("delta_dynamics", "echo"))
            for what in ("p50_us", "p99_us", "cpu_us")
        }
        for name in commands
        if "echo" not in name
    }
    benchmark.extra_info.update(what="round trip", figures=figures, ratios=ratios, slices=SLICES)
    benchmark.pedantic(lambda: None, rounds=1)


def start(domain, name, command):
    environment = domain.environment()
    # Each in a namespace of its own, so that the client speaks to one at a time.
    remap = ["-r", f"__ns:=/{name}"]
    if "--ros-args" not in command:
        remap = ["--ros-args", *remap]
    return subprocess.Popen(
        [sys.executable, *command, *remap],
        env=environment,
        start_new_session=True,
        preexec_fn=end_with_parent,
    )


def cpu_of(process):
    """CPU time of a process so far, s."""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@dataclass
class Measurement:
    """Times to the answer, s, and what else a slice told."""

    times: list[float]
    sent: int
    answered: int
    cpu: float


class Client:
    """Publishes joint states and takes the time until the answer with the same stamp."""

    def __init__(self, rclpy, context, names):
        from rclpy.executors import SingleThreadedExecutor
        from sensor_msgs.msg import JointState

        self.kind = JointState
        self.node = rclpy.create_node("bench_client", context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.publishers, self.answered = {}, None
        self.names = list(load("delta_cu").joint_names)
        for name in names:
            self.publishers[name] = self.node.create_publisher(
                JointState, f"/{name}/joint_states", 10
            )
            self.node.create_subscription(JointState, self._topic(name), self._answer, 10)

    @staticmethod
    def _topic(name):
        return f"/{name}/{name.removesuffix('_events')}/joint_torques"

    def _answer(self, message):
        self.answered = message.header.stamp.sec, message.header.stamp.nanosec

    def wait_for(self, name):
        deadline = time.monotonic() + 60
        while not (
            self.publishers[name].get_subscription_count()
            and self.node.count_publishers(self._topic(name))
        ):
            assert time.monotonic() < deadline, f"{name} did not come up"
            self.executor.spin_once(timeout_sec=0.1)

    def measure(self, name, seconds, process):
        times = []
        used = cpu_of(process)
        begin = time.perf_counter()
        for i in range(round(seconds / PERIOD)):
            due = begin + i * PERIOD
            while time.perf_counter() < due:
                pass
            now = self.node.get_clock().now().to_msg()
            phase = 2.0 * i * PERIOD
            message = self.kind(name=self.names)
            message.header.stamp = now
            message.position = [0.3 * np.sin(phase)] * 3
            message.velocity = [0.6 * np.cos(phase)] * 3
            sent = time.perf_counter()
            self.publishers[name].publish(message)
            while self.answered != (now.sec, now.nanosec):
                self.executor.spin_once(timeout_sec=0.005)
                if time.perf_counter() - sent > 0.02:
                    break  # the node's window fills, or the machine is elsewhere
            else:
                times.append(time.perf_counter() - sent)
        used = cpu_of(process) - used
        return Measurement(times[200:], round(seconds / PERIOD), len(times), used)
