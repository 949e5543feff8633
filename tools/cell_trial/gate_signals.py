# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C twice at random times: the gate's last command is zeros, a starting node ends quietly.

    python3 tools/cell_trial/gate_signals.py [--running 200] [--starting 40] [--load 2] [--seed 1]

A terminal and a launcher each send SIGINT. Needs a sourced Jazzy workspace with pkm_twin.
"""

from __future__ import annotations

import argparse
import multiprocessing
import random
import signal
import sys
import time
from collections import Counter
from typing import Any

from cell import Peer, Process, node, peer
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

NAMES = ("arm_1", "arm_2", "arm_3")
EFFORT = [1.0, 2.0, 3.0]
NODES = ("command_gate", "delta_dynamics", "machine_state", "machine_sim", "stiffness_monitor")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--running", type=int, default=200, help="gates that are stopped running")
    parser.add_argument("--starting", type=int, default=40, help="nodes that are stopped starting")
    parser.add_argument("--load", type=int, default=0, help="processes that compute meanwhile")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    random.seed(given.seed)
    load = [multiprocessing.Process(target=_compute, daemon=True) for _ in range(given.load)]
    for process in load:
        process.start()
    try:
        with peer() as other:
            bad = running(other, given.running)
        bad += starting(given.starting)
    finally:
        for process in load:
            process.kill()
    return 1 if bad else 0


def _compute() -> None:
    while True:
        pass


def running(other: Peer, trials: int) -> int:
    """Stop gates that forward torques; the number of those whose last command is one."""
    offered = QoSProfile(depth=10)
    offered.deadline = offered.lifespan = Duration(seconds=1.0)
    torques = other.node.create_publisher(JointState, "/delta_dynamics/joint_torques", offered)
    commands = other.hear(Float64MultiArray, "/command_gate/commands")

    def send() -> None:
        message = JointState(name=list(NAMES), effort=EFFORT)
        message.header.stamp = other.node.get_clock().now().to_msg()
        torques.publish(message)

    def gate() -> Process:
        return node("command_gate", parameters=("mechanism:=delta_cu", "deadline:=1.0"))

    timer = other.node.create_timer(0.001, send)
    ends: Counter[str] = Counter()
    for _ in range(trials):
        commands.clear()
        process = gate()
        other.until(
            lambda: commands and list(commands[-1].data) == EFFORT,
            "torques forwarded",
            needs=[process],
        )
        other.spin(random.uniform(0.0, 0.1))
        between = 10.0 ** random.uniform(-5, -0.7)
        process.signal(signal.SIGINT)
        until = time.monotonic() + between
        while time.monotonic() < until and process.alive():
            pass
        process.signal(signal.SIGINT)
        other.until(lambda p=process: not p.alive(), "the gate's end")
        # What is on its way arrives, however busy the machine is.
        count = -1
        while count != len(commands):
            count = len(commands)
            other.spin(0.5)
        last = list(commands[-1].data)
        code, said = process.process.returncode, process.output
        verdict = [f"exit code {code}"]
        verdict += ["zeros" if last == [0.0] * 3 else "A TORQUE IS THE LAST COMMAND"]
        verdict += ["traceback"] if "Traceback" in said else []
        ends[", ".join(verdict)] += 1
        process.close()
    timer.destroy()
    return _told("running gates, SIGINT twice", ends, "exit code 0, zeros")


def starting(trials: int) -> int:
    """Stop nodes while they start; the number of those that do not end quietly with 0."""
    ends: Counter[str] = Counter()
    for k in range(trials):
        process = node(NODES[k % len(NODES)])
        _computed(process, random.uniform(0.1, 1.5))
        process.signal(signal.SIGINT)
        time.sleep(10.0 ** random.uniform(-5, -1))
        process.signal(signal.SIGINT)
        code = process.process.wait(60.0)
        verdict = [f"exit code {code}"]
        verdict += ["traceback"] if "Traceback" in process.output else []
        ends[", ".join(verdict)] += 1
        process.close()
    return _told("starting nodes, SIGINT twice", ends, "exit code 0")


def _computed(process: Process, seconds: float) -> None:
    """Wait until a process has computed for so long: how far it is does not hang on the load."""
    while process.alive() and process.usage() < seconds:
        time.sleep(0.002)


def _told(what: str, ends: Counter[str], good: str) -> int:
    bad: Any = sum(ends.values()) - ends[good]
    print(f"{what}: " + "; ".join(f"{number} {end}" for end, number in ends.most_common()))
    sys.stdout.flush()
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
