# SPDX-License-Identifier: Apache-2.0
"""The demonstration's closed loop: a path gone by PD alone, then with the twin's feedforward.

machine_sim, whose parameters are drawn about the twin's, keeps simulated time; the trajectories
carry stamps in it, so that the machine does the same on every computer.
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any, Final

import numpy as np
from builtin_interfaces.msg import Time
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rich.console import Console
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from pkm_twin import load
from pkm_twin.apps.demo_recorder import (
    MATCH_SECONDS,
    STATE,
    TRAJECTORY,
    Recorder,
    process,
    wait_for,
)
from pkm_twin.apps.tracking_report import prefix
from pkm_twin.ros.messages import SECOND, stamp_of

SPREADS: Final = (0.01, 0.2)
ROBOT: Final = "delta_cu"
FACTOR: Final = 2.0
"""Of simulated time: two seconds in one."""
AMPLITUDES: Final = (0.5, -0.4, 0.6)
"""How far the joints go and come back, rad."""
DURATION: Final = 0.8
POINTS: Final = 81
AHEAD: Final = SECOND // 2
"""From what the clock shows to a trajectory's start, ns."""
INPUT: Final = "/machine_sim/joint_trajectory"
TWIN: Final = "/delta_dynamics/joint_trajectory"


def run(
    spread: float, recorder: Recorder, executor: SingleThreadedExecutor, console: Console
) -> None:
    """Both runs on a machine of this spread, recorded."""
    node = executor.get_nodes()[0]
    recorder.listen(prefix(spread), {"/joint_states": STATE, INPUT: TRAJECTORY})
    newest: list[int] = [0]
    states = node.create_subscription(
        JointState, "/joint_states", lambda m: newest.__setitem__(0, stamp_of(m.header)), 10
    )
    depth = QoSProfile(depth=1)
    topics = {
        topic: node.create_publisher(JointTrajectory, topic, depth) for topic in (INPUT, TWIN)
    }
    reset = node.create_client(Trigger, "/machine_sim/reset")
    command = [sys.executable, "-m"]
    # Played faster than the wall's time: nobody is pushed by a late torque here.
    twin = [*command, "delta_dynamics.node", "--ros-args", "-r", f"{TWIN}_ff:={INPUT}"]
    twin += ["-p", f"mechanism:={ROBOT}", "-p", "use_sim_time:=true"]
    machine = [*command, "delta_dynamics.sim_node", "--ros-args", "-p", f"mechanism:={ROBOT}"]
    machine += ["-p", "clock:=simulated", "-p", f"real_time_factor:={FACTOR}"]
    machine += ["-p", f"spread:={spread}"]
    console.print(f"machine_sim at {100 * spread:g} % spread: PD, then with feedforward")
    with process(machine) as first, process(twin) as second:
        _both_there(executor, (first, second), lambda: newest[0] > 0 and _matched(topics))
        for topic in (INPUT, TWIN):
            wait_for(executor, reset.service_is_ready, MATCH_SECONDS, "the reset", first)
            done = reset.call_async(Trigger.Request())
            wait_for(executor, done.done, MATCH_SECONDS, "the reset", first)
            start = newest[0] + AHEAD
            topics[topic].publish(_trajectory(start))
            end = start + round(1.1 * DURATION * SECOND)
            wait_for(
                executor,
                lambda end=end: newest[0] > end,  # type: ignore[misc]
                MATCH_SECONDS,
                "the path's end",
                first,
            )
    recorder.stop()
    node.destroy_subscription(states)
    node.destroy_client(reset)
    for publisher in topics.values():
        node.destroy_publisher(publisher)


def _both_there(
    executor: SingleThreadedExecutor, children: tuple[subprocess.Popen[bytes], ...], there: Any
) -> None:
    for child in children:
        wait_for(executor, there, MATCH_SECONDS, "machine_sim and delta_dynamics", child)


def _matched(topics: dict[str, Any]) -> bool:
    """Every trajectory has its way: to the machine from here and from the twin."""
    counts = [publisher.get_subscription_count() for publisher in topics.values()]
    # The recorder hears what the machine hears.
    return bool(counts[0] >= 2 and counts[1] >= 1)


def _trajectory(start: int) -> JointTrajectory:
    """There and back from home, at rest at both ends; the joints apart."""
    robot = load(ROBOT)
    home = robot.inverse(robot.home())
    x = np.linspace(0.0, 1.0, POINTS)
    # 64 (x - x^2)^3, which is 1 in the middle.
    blend = 64.0 * np.array([-1.0, 3.0, -3.0, 1.0, 0.0, 0.0, 0.0])
    rows = [
        np.outer(np.polyval(np.polyder(blend, k), x) / DURATION**k, AMPLITUDES) for k in range(3)
    ]
    message = JointTrajectory(joint_names=list(robot.joint_names))
    message.header.stamp = Time(sec=start // SECOND, nanosec=start % SECOND)
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
