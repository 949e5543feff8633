# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Side-by-side timings, single thread, in one run: compare the ratios, not the machine.

Run by ``make bench``, which turns the result into docs/benchmarks.md.
"""

import os
import time

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin import load, variants
from pkm_twin.codegen import code as codes
from stiffness_monitor import platform_response
from test.benchmarks.round_trip import TWIN, Client, start, stop
from test.nodes.harness import Domain
from test.support.robots import parameters_of, random_joints

pytestmark = pytest.mark.benchmark_run

BATCHES = [1, 1_000, 100_000]
SECONDS, SLICES = 1.5, 12
"""Length of a slice of the round trip, s, and how many."""
MINUTE = 60.0
STARTS = 5


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


@pytest.mark.parametrize("threads", ["1", "0"], ids=["one", "all"])
def test_variants(benchmark, monkeypatch, threads):
    """10,000 machines on 200 samples, on one core and on all."""
    monkeypatch.setenv(codes.THREADS_VARIABLE, threads)
    robot = load("delta")
    lengths = np.random.default_rng(3).uniform(0.18, 0.22, 10_000)
    machines = variants(robot, {"geometry.arm_length": lengths})
    what = f"variants(delta), {codes.read_thread_count()} threads"
    benchmark.extra_info.update(what=what, samples=200 * len(machines))
    run(benchmark, 200 * len(machines), machines.inverse_dynamics, *motion(robot, 200))


@pytest.mark.parametrize("count", BATCHES)
@pytest.mark.parametrize("name", ["delta_cu", "prru", "upr_rpu"])
def test_platform_response(benchmark, name, count):
    robot = load(name)
    q, *_ = motion(robot, count)
    wrench = np.random.default_rng(2).normal(0, 100, (*q.shape[:-1], 6))
    benchmark.extra_info.update(what=f"platform_response({name})", samples=count)
    run(benchmark, count, platform_response, robot, q, wrench)


@pytest.mark.parametrize("name", ["delta", "delta_cu"])
def test_pinocchio_closed_loop(benchmark, name):
    """Assembly, velocities, accelerations and torques of one state, driven from Python."""
    pytest.importorskip("pinocchio")
    from bags.recording.pinocchio_delta import DeltaEngine

    engine = DeltaEngine(parameters_of(name))
    q, qd, qdd = motion(load(name), 1)
    benchmark.extra_info.update(what=f"Pinocchio, interpreted loop closure ({name})", samples=1)
    run(benchmark, 100, engine.inverse_dynamics, q, qd, qdd, np.zeros(6))


@pytest.mark.parametrize("name", ["delta", "delta_cu"])
def test_pinocchio_rnea(benchmark, name):
    """Only the tree sweep, its state given: not the loops, not the torques."""
    pytest.importorskip("pinocchio")
    from bags.recording.pinocchio_delta import DeltaEngine

    engine = DeltaEngine(parameters_of(name))
    tree = engine.state(*motion(load(name), 1))
    benchmark.extra_info.update(what=f"Pinocchio, bare rnea of the tree ({name})", samples=1)
    run(benchmark, 1, engine.rnea_only, tree)


@pytest.fixture
def ros():
    """rclpy, a context and a domain of their own."""
    rclpy = pytest.importorskip("rclpy")
    domain = Domain()
    os.environ.update(domain.environment())
    context = rclpy.Context()
    rclpy.init(context=context)
    yield rclpy, context, domain
    rclpy.try_shutdown(context=context)
    domain.close()


def test_round_trip(benchmark, ros):
    """joint_states to ~/joint_torques at 1 kHz, against the echo of the same messages."""
    rclpy, context, domain = ros
    commands = {
        "echo": ["-m", "test.benchmarks.echo_node", "single"],
        "echo_events": ["-m", "test.benchmarks.echo_node", "events"],
        "delta_dynamics": [*TWIN, "-p", "executor:=single"],
        "delta_dynamics_events": [*TWIN, "-p", "executor:=events"],
    }
    client = Client(rclpy, context, commands)
    children = {name: start(domain, name, command) for name, command in commands.items()}
    try:
        for name in commands:
            client.wait_for(name)
        slices = [{name: client.measure(name, SECONDS, children[name].pid) for name in commands} for _ in range(SLICES)]
    finally:
        stop(*children.values())

    # The machine is elsewhere now and then: the median of slices, each beside its own echo.
    def median(name, value, beside=None):
        return float(np.median([value(pair[name]) / (value(pair[beside]) if beside else 1) for pair in slices]))

    values = {
        "p50_us": lambda m: float(np.percentile(m.times, 50)) * 1e6,
        "p99_us": lambda m: float(np.percentile(m.times, 99)) * 1e6,
        "cpu_us": lambda m: m.cpu / m.sent * 1e6,
    }
    figures = {name: {what: median(name, value) for what, value in values.items()} for name in commands}
    ratios = {
        name: {what: median(name, value, name.replace("delta_dynamics", "echo")) for what, value in values.items()}
        for name in commands
        if "echo" not in name
    }
    record(benchmark, "round trip", figures=figures, ratios=ratios, slices=SLICES)


@pytest.mark.parametrize("executor", ["single", "events"])
def test_a_minute_without_a_lost_message(benchmark, ros, executor):
    """Queue depth as by default. A state's age is no matter here: what is late is not lost."""
    rclpy, context, domain = ros
    client = Client(rclpy, context, [executor])
    child = start(domain, executor, [*TWIN, "-p", f"executor:={executor}", "-p", "stale_after:=60.0"])
    try:
        client.wait_for(executor)
        client.stream(executor, 1.0)
        sent, answered = client.stream(executor, MINUTE)
    finally:
        stop(child)
    record(benchmark, "minute", executor=executor, sent=sent, answered=answered)
    assert answered == sent


def test_start_to_first_answer(benchmark, ros):
    """From the start of the process to the first torque of a stream that runs already."""
    rclpy, context, domain = ros
    names = [f"start_{i}" for i in range(STARTS + 1)]
    client = Client(rclpy, context, names)
    seconds = []
    for name in names:
        begin = time.perf_counter()
        child = start(domain, name, TWIN)
        try:
            seconds.append(client.first_answer(name, begin))
        finally:
            stop(child)
    # The first one fills the caches.
    record(benchmark, "first answer", seconds=seconds[1:])


def record(benchmark, what, **figures):
    """Figures of a benchmark that takes its times itself."""
    real_time = os.sched_getscheduler(0) != os.SCHED_OTHER
    benchmark.extra_info.update(what=what, real_time=real_time, **figures)
    benchmark.pedantic(lambda: None, rounds=1)
