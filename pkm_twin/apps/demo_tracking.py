# SPDX-License-Identifier: Apache-2.0
"""The demonstration's closed loop: a path gone by PD alone, then with the twin's feedforward.

machine_sim, whose parameters are drawn about the twin's, keeps simulated time and goes all of a
trajectory by itself, brakes on before: so it does the same on every computer, whatever its load.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Final

import numpy as np
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rich.console import Console
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from pkm_twin import load
from pkm_twin.apps.demo_recorder import (
    DEPTH,
    STATE,
    TRAJECTORY,
    Recorder,
    drain,
    process,
    wait_for,
)
from pkm_twin.apps.tracking_report import PERIOD, ROBOT, prefix
from pkm_twin.messages.stamps import SECOND, stamp_of

SPREADS: Final = (0.01, 0.2)
AMPLITUDES: Final = (0.5, -0.4, 0.6)
"""How far the joints go and come back, rad."""
DURATION: Final = 0.8
POINTS: Final = 81
INPUT: Final = "/machine_sim/joint_trajectory"
QUEUE: Final = "qos_overrides./joint_states.publisher.depth"
TWIN: Final = "/delta_dynamics/joint_trajectory"


class _Watch:
    """How far the machine's clock is, ns, whether it stands, and whether its path is over."""

    def __init__(self) -> None:
        self.newest = 0
        self.stands = self.done = False
        self._since: int | None = None

    def take(self, state: JointState) -> None:
        """A joint state: a machine with its brakes on has no rate at all."""
        self.newest = stamp_of(state.header)
        self.stands = not any(state.velocity)
        if self._since is None and not self.stands:
            self._since = self.newest
        if self._since is not None:
            self.done |= self.newest > self._since + 1.1 * DURATION * SECOND

    def begin(self) -> None:
        """Watch another path, from the start."""
        self.stands = self.done = False
        self._since = None


def run(
    spread: float, recorder: Recorder, executor: SingleThreadedExecutor, console: Console
) -> None:
    """Both runs on a machine of this spread, recorded."""
    node = executor.get_nodes()[0]
    recorder.listen(prefix(spread), {"/joint_states": STATE, INPUT: TRAJECTORY})
    watch = _Watch()
    states = node.create_subscription(JointState, "/joint_states", watch.take, DEPTH)
    answers: list[JointTrajectory] = []
    heard = node.create_subscription(JointTrajectory, f"{TWIN}_ff", answers.append, 10)
    depth = QoSProfile(depth=1)
    twin, machine = (node.create_publisher(JointTrajectory, t, depth) for t in (TWIN, INPUT))
    reset = node.create_client(Trigger, "/machine_sim/reset")
    module = [sys.executable, "-m"]
    # Trajectories alone are asked of the twin.
    asked = [*module, "delta_dynamics.node", "--ros-args", "-p", f"mechanism:={ROBOT}"]
    asked += ["-r", "joint_states:=/delta_dynamics/joint_states"]
    moved = [*module, "delta_dynamics.sim_node", "--ros-args", "-p", f"mechanism:={ROBOT}"]
    moved += ["-p", "clock:=simulated", "-p", f"period:={PERIOD}"]
    # A loaded computer catches up in bursts.
    moved += ["-p", f"spread:={spread}", "-p", f"{QUEUE}:={DEPTH}"]
    console.print(f"machine_sim at {100 * spread:g} % spread: PD, then with feedforward")
    plain = _trajectory()
    with process(moved) as first, process(asked) as second:

        def await_that(condition: Callable[[], bool], what: str) -> None:
            wait_for(executor, condition, what, first)

        def answered() -> bool:
            # Asked again and again: who hears a node is not at once heard by it.
            if not answers:
                twin.publish(plain)
            return bool(answers)

        await_that(lambda: watch.newest > 0, "machine_sim")
        wait_for(executor, answered, "delta_dynamics", second)
        # The machine and the recorder.
        await_that(lambda: machine.get_subscription_count() >= 2, "machine_sim")
        for trajectory in (plain, answers[0]):
            await_that(reset.service_is_ready, "machine_sim's reset")
            done = reset.call_async(Trigger.Request())
            await_that(done.done, "machine_sim's reset")
            watch.begin()
            await_that(lambda: watch.stands, "the machine at its start")
            watch.begin()
            machine.publish(trajectory)
            await_that(lambda: watch.done, "the path's end")
    # What the recorder has not taken yet.
    drain(executor, recorder)
    recorder.stop()
    for subscription in (states, heard):
        node.destroy_subscription(subscription)
    node.destroy_client(reset)
    for publisher in (twin, machine):
        node.destroy_publisher(publisher)


def _trajectory() -> JointTrajectory:
    """There and back from home, at rest at both ends, from when it comes; the joints apart."""
    robot = load(ROBOT)
    home = robot.inverse(robot.home())
    x = np.linspace(0.0, 1.0, POINTS)
    # 64 (x - x^2)^3, which is 1 in the middle.
    blend = 64.0 * np.array([-1.0, 3.0, -3.0, 1.0, 0.0, 0.0, 0.0])
    rows = [
        np.outer(np.polyval(np.polyder(blend, k), x) / DURATION**k, AMPLITUDES) for k in range(3)
    ]
    message = JointTrajectory(joint_names=list(robot.joint_names))
    for k in range(POINTS):
        point = JointTrajectoryPoint(
            positions=(home + rows[0][k]).tolist(),
            velocities=rows[1][k].tolist(),
            accelerations=rows[2][k].tolist(),
        )
        time = round(x[k] * DURATION * SECOND)
        point.time_from_start.sec, point.time_from_start.nanosec = divmod(time, SECOND)
        message.points.append(point)
    return message
