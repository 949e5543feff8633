# SPDX-License-Identifier: Apache-2.0
"""The demonstration's closed loop: a path gone by PD alone, then with the twin's feedforward.

machine_sim, whose parameters are drawn about the twin's, keeps simulated time and goes all of a
trajectory by itself, brakes on before: so it does the same on every computer, whatever its load.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any, Final

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
from pkm_twin.ros.messages import SECOND, stamp_of

SPREADS: Final = (0.01, 0.2)
AMPLITUDES: Final = (0.5, -0.4, 0.6)
"""How far the joints go and come back, rad."""
DURATION: Final = 0.8
POINTS: Final = 81
INPUT: Final = "/machine_sim/joint_trajectory"
QUEUE: Final = "qos_overrides./joint_states.publisher.depth"
TWIN: Final = "/delta_dynamics/joint_trajectory"


class _Watch:
    """When the machine began to move, and how far its clock is, ns."""

    def __init__(self) -> None:
        self.newest = 0
        self.since: int | None = None

    def take(self, state: JointState) -> None:
        """A joint state: a machine with its brakes on has no rate at all."""
        self.newest = stamp_of(state.header)
        if not any(state.velocity):
            self.since = None
        elif self.since is None:
            self.since = self.newest

    @property
    def done(self) -> bool:
        """Whether the path is over."""
        return self.since is not None and self.newest > self.since + 1.1 * DURATION * SECOND


def run(
    spread: float, recorder: Recorder, executor: SingleThreadedExecutor, console: Console
) -> None:
    """Both runs on a machine of this spread, recorded."""
    node = executor.get_nodes()[0]
    recorder.listen(prefix(spread), {"/joint_states": STATE, INPUT: TRAJECTORY})
    watch = _Watch()
    states = node.create_subscription(JointState, "/joint_states", watch.take, DEPTH)
    depth = QoSProfile(depth=1)
    topics = {t: node.create_publisher(JointTrajectory, t, depth) for t in (INPUT, TWIN)}
    reset = node.create_client(Trigger, "/machine_sim/reset")
    module = [sys.executable, "-m"]
    # Trajectories alone are asked of it.
    twin = [*module, "delta_dynamics.node", "--ros-args", "-r", f"{TWIN}_ff:={INPUT}"]
    twin += ["-r", "joint_states:=/delta_dynamics/joint_states", "-p", f"mechanism:={ROBOT}"]
    machine = [*module, "delta_dynamics.sim_node", "--ros-args", "-p", f"mechanism:={ROBOT}"]
    machine += ["-p", "clock:=simulated", "-p", f"period:={PERIOD}"]
    # A loaded computer catches up in bursts.
    machine += ["-p", f"spread:={spread}", "-p", f"{QUEUE}:={DEPTH}"]
    console.print(f"machine_sim at {100 * spread:g} % spread: PD, then with feedforward")
    with process(machine) as first, process(twin) as second:

        def await_that(condition: Callable[[], bool], what: str) -> None:
            wait_for(executor, condition, what, first)

        await_that(lambda: watch.newest > 0, "machine_sim")
        wait_for(executor, lambda: _matched(node, topics), "delta_dynamics", second)
        for publisher in topics.values():
            await_that(reset.service_is_ready, "machine_sim's reset")
            done = reset.call_async(Trigger.Request())
            await_that(done.done, "machine_sim's reset")
            watch.since = watch.newest
            await_that(lambda: watch.since is None, "the machine at its start")
            publisher.publish(_trajectory())
            await_that(lambda: watch.done, "the path's end")
    # What the recorder has not taken yet.
    drain(executor, recorder)
    recorder.stop()
    node.destroy_subscription(states)
    node.destroy_client(reset)
    for publisher in topics.values():
        node.destroy_publisher(publisher)


def _matched(node: Any, topics: Mapping[str, Any]) -> bool:
    """Every trajectory has its way: to the machine and the recorder from here and from the twin."""
    heard = [publisher.get_subscription_count() for publisher in topics.values()]
    return bool(heard[0] >= 2 and heard[1] >= 1 and node.count_publishers(INPUT) >= 2)


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
