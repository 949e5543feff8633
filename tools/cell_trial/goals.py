# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Measure joint_trajectory_controller's effort at the end of goals, and how long the end takes.

    python3 tools/cell_trial/goals.py [--robot delta_cu] [--update-rate 500] [CASE ...]

ros2_control on mock hardware, delta_dynamics between client and controller. Needs a sourced Jazzy
workspace with pkm_twin, controller_manager, joint_trajectory_controller and mock hardware. The
effort is compared with that of the weight where the machine stands: mock hardware does not move.
"""

from __future__ import annotations

import argparse
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration
from cell import Peer, Process, node, peer
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTolerance, JointTrajectoryControllerState
from rclpy.action import ActionClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from delta_dynamics import inverse_dynamics
from pkm_twin import load
from pkm_twin.robot.robot_urdf import robot_urdf

CONTROLLER = "joint_trajectory_controller"
STATUS = {
    value: name.removeprefix("STATUS_").lower()
    for name, value in vars(GoalStatus).items()
    if name.startswith("STATUS_")
}


class Cell:
    """Controller and twin of one robot, and a client of the twin's action."""

    def __init__(self, other: Peer, robot: str, update_rate: int) -> None:
        self.other, self.robot, self.rate = other, load(robot), update_rate
        self.names = list(self.robot.joint_names)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.description = other.node.create_publisher(String, "/robot_description", latched)
        text = robot_urdf(self.robot)
        self.description.publish(String(data=text))
        # The position of mock hardware.
        joints = ElementTree.fromstring(text).findall("ros2_control/joint")
        self.q = np.array([float(j.find("state_interface/param").text) for j in joints])
        self.states = other.hear(JointTrajectoryControllerState, f"/{CONTROLLER}/controller_state", 5000)
        self.client = ActionClient(other.node, FollowJointTrajectory, "/delta_dynamics/follow_joint_trajectory")
        zero = 0.0 * self.q
        self.weight = inverse_dynamics(self.robot, self.q, zero, zero)
        self.peak = 0.0
        self.manager = self.twin = self.spawner = None
        self._file = Path(tempfile.mkdtemp()) / "controllers.yaml"
        zeros = {"p": 0.0, "i": 0.0, "d": 0.0, "i_clamp": 0.0}
        self._file.write_text(
            yaml.safe_dump(
                {
                    "controller_manager": {
                        "ros__parameters": {
                            "update_rate": update_rate,
                            "joint_state_broadcaster": {"type": "joint_state_broadcaster/JointStateBroadcaster"},
                            CONTROLLER: {"type": "joint_trajectory_controller/JointTrajectoryController"},
                        }
                    },
                    CONTROLLER: {
                        "ros__parameters": {
                            "joints": self.names,
                            "command_interfaces": ["effort"],
                            "state_interfaces": ["position", "velocity"],
                            "gains": {name: dict(zeros) for name in self.names},
                        }
                    },
                }
            )
        )

    def start_controller(self) -> None:
        """Start controller_manager and wait until its two controllers are active."""
        self.manager = Process(
            "ros2",
            "run",
            "controller_manager",
            "ros2_control_node",
            "--ros-args",
            "--params-file",
            str(self._file),
        )
        self.spawner = Process(
            "ros2",
            "run",
            "controller_manager",
            "spawner",
            "joint_state_broadcaster",
            CONTROLLER,
            "--param-file",
            str(self._file),
        )
        self.states.clear()
        self.other.until(lambda: self.states, lambda: f"the controller\n{self.manager.output}")

    def start_twin(self) -> None:
        """Start delta_dynamics between the client and the controller."""
        self.twin = node(
            "delta_dynamics",
            parameters=(
                f"mechanism:={self.robot.name}",
                f"controller_action:=/{CONTROLLER}/follow_joint_trajectory",
            ),
        )
        self.other.until(self.client.server_is_ready, lambda: f"the twin's action\n{self.twin.output}")

    def stop(self) -> None:
        """Stop all processes."""
        for process in (self.twin, self.spawner, self.manager):
            if process is not None:
                process.close()
        self.twin = self.spawner = self.manager = None

    def goal(self, seconds: float = 3.0, *, braking: float = 0.0, tolerance: float = 0.0) -> Any:
        """Make a goal there and back by a twentieth of the range; braking: the last point's acceleration."""
        steps = 200
        s = np.linspace(0.0, 1.0, steps + 1)
        limits = self.robot.limits.position
        size = 0.05 * (1.0 if limits is None else float(np.ptp(limits, axis=1).min()))
        shape = size * (1 - np.cos(2 * np.pi * s)) / 2
        rate = size * np.pi * np.sin(2 * np.pi * s) / seconds
        push = size * 2 * np.pi**2 * np.cos(2 * np.pi * s) / seconds**2
        ones = np.sign(self.robot.limits.position.mean(1) - self.q) if limits is not None else 1.0
        ones = np.where(np.asarray(ones) == 0.0, 1.0, ones) * np.ones(len(self.q))
        push[-1] = braking
        rate[-1] = 0.0
        trajectory = JointTrajectory(joint_names=self.names)
        for k, time_ in enumerate(s * seconds):
            sec, nanosec = divmod(round((time_ + 0.01) * 1e9), 10**9)
            trajectory.points.append(
                JointTrajectoryPoint(
                    positions=(self.q + shape[k] * ones).tolist(),
                    velocities=(rate[k] * ones).tolist(),
                    accelerations=(push[k] * ones).tolist(),
                    time_from_start=Duration(sec=sec, nanosec=nanosec),
                )
            )
        goal = FollowJointTrajectory.Goal(trajectory=trajectory)
        if tolerance:
            goal.path_tolerance = [JointTolerance(name=n, position=tolerance) for n in self.names]
        return goal

    def send(self, goal: Any) -> Any:
        """Send a goal; return its accepted handle and the future of its result."""
        future = self.client.send_goal_async(goal)
        self.other.until(future.done, "the twin's answer to a goal")
        handle = future.result()
        return handle, handle.get_result_async()

    def until_moving(self) -> None:
        """Wait until the controller follows the trajectory."""
        self.states.clear()
        self.other.until(lambda: self.states and any(self.states[-1].reference.velocities), "motion")

    def least_share(self, since: float) -> float:
        """Return the least share of the gravity effort since a stamp, moving or not."""
        stamps, share = self._compute_shares()
        return float(share[stamps > since].min())

    def _compute_shares(self) -> tuple[Any, Any]:
        """Return stamps, s, and the ratio of effort to gravity effort of the joint with the largest one."""
        joint = int(np.abs(self.weight).argmax())
        efforts = np.array([m.output.effort[joint] for m in self.states])
        stamps = np.array([_seconds(m.header.stamp) for m in self.states])
        return stamps, efforts / self.weight[joint]

    def pass_by(self, seconds: float) -> None:
        """Wait until the controller's states are stamped ``seconds`` after now."""
        until = _now(self) + seconds
        self.other.until(
            lambda: self.states and _seconds(self.states[-1].header.stamp) > until,
            "states of the controller",
        )

    def ended(self, result: Any, timeout: float = 60.0) -> tuple[str, str, float]:
        """Return how a goal ended, its error text, and its duration, s."""
        began = time.monotonic()
        self.other.until(result.done, "the end of a goal", timeout)
        answer = result.result()
        return STATUS[answer.status], answer.result.error_string, time.monotonic() - began

    def weight_lost(self, since: float) -> tuple[float, float, float]:
        """Compare the efforts after a stop with the gravity effort.

        :returns: the last effort's share of it; time below nine tenths of it, s; the largest
            relative error of the last effort.
        """
        efforts = np.array([m.output.effort for m in self.states])
        moving = np.array([any(m.reference.velocities) for m in self.states])
        stamps, share = self._compute_shares()
        after = (stamps > since) & ~moving
        if not after.any():
            return np.nan, np.nan, np.nan
        lost = float((after & (share < 0.9)).sum()) / self.rate
        miss = np.abs(efforts[-1] - self.weight).max() / np.abs(self.weight).max()
        return float(share[-1]), lost, float(miss)


def _seconds(stamp: Any) -> float:
    return stamp.sec + 1e-9 * stamp.nanosec


def _now(cell: Cell) -> float:
    return _seconds(cell.other.node.get_clock().now().to_msg())


def _print_result(cell: Cell, case: str, ended: tuple[str, str, float] | None, since: float | None) -> None:
    words = [f"{case}:"]
    if ended is not None:
        words.append(f"{ended[0]} after {ended[2]:.2f} s, {ended[1]!r};")
    if since is not None:
        cell.pass_by(0.7)
        share, lost, miss = cell.weight_lost(since)
        words.append(
            f"effort at the end {share:.4f} of the weight (miss {miss:.1e}), below 0.9 of it for {1e3 * lost:.0f} ms"
        )
    print(" ".join(words), flush=True)


def trial_cancel(cell: Cell) -> None:
    """Cancel a goal in the middle of the motion, the first goal and a later one."""
    for case in ("cancel of the first goal", "cancel after a goal that succeeded"):
        if case.startswith("cancel after"):
            # The last effort of this goal does not carry the weight.
            _, result = cell.send(cell.goal(0.5, braking=-20.0))
            cell.ended(result)
        handle, result = cell.send(cell.goal())
        cell.until_moving()
        cell.other.spin(0.8)
        since = _now(cell)
        handle.cancel_goal_async()
        _print_result(cell, case, cell.ended(result), since)


def trial_abort(cell: Cell) -> None:
    """Let the controller abort: mock hardware does not follow, and the path has a tolerance."""
    _, result = cell.send(cell.goal(tolerance=0.005))
    since = _now(cell)
    _print_result(cell, "abort by path tolerance", cell.ended(result), since)


def trial_end_in_acceleration(cell: Cell) -> None:
    """End a goal with a last point at rest that has an acceleration."""
    _, result = cell.send(cell.goal(0.5, braking=-20.0))
    ended = cell.ended(result)
    _print_result(cell, "success whose last point accelerates", ended, _now(cell))


def trial_replacement(cell: Cell) -> None:
    """Replace a goal by a second one, which the first must not disturb."""
    _, first = cell.send(cell.goal())
    cell.until_moving()
    cell.other.spin(0.3)
    since = _now(cell)
    _, second = cell.send(cell.goal(1.0))
    _print_result(cell, "replaced by another goal, the first", cell.ended(first), None)
    _print_result(cell, "replaced by another goal, the second", cell.ended(second), _now(cell))
    print(f"  least effort since the second was sent: {cell.least_share(since):.2f} of the weight")


def trial_twin_end(cell: Cell) -> None:
    """Send SIGINT to the twin in the middle of the motion."""
    _, result = cell.send(cell.goal())
    cell.until_moving()
    cell.other.spin(0.8)
    since = _now(cell)
    cell.twin.signal(signal.SIGINT)
    try:
        ended = cell.ended(result, 30.0)
    except TimeoutError:
        ended = ("no end", "", 30.0)
    _print_result(cell, "SIGINT of the twin", ended, since)
    cell.other.until(lambda: not cell.twin.alive(), "the twin's end")
    print(f"  exit code {cell.twin.process.returncode}")
    cell.twin.close()
    cell.start_twin()
    cell.other.spin(2.0)


def trial_killed_controller(cell: Cell) -> None:
    """Kill the controller manager by SIGKILL."""
    _, result = cell.send(cell.goal())
    cell.until_moving()
    cell.other.spin(0.8)
    cell.manager.signal(signal.SIGKILL, group=True)
    _print_result(cell, "kill -9 of the controller", cell.ended(result, 60.0), None)
    cell.spawner.close()
    cell.manager.close()
    cell.start_controller()


def trial_first_goal(cell: Cell) -> None:
    """Send a goal immediately after the start of delta_dynamics."""
    for _ in range(5):
        cell.twin.close()
        cell.start_twin()
        _, result = cell.send(cell.goal(0.3))
        _print_result(cell, "goal at once after the twin's start", cell.ended(result), None)


CASES: dict[str, Callable[[Cell], None]] = {
    "cancelled": trial_cancel,
    "aborted": trial_abort,
    "accelerating": trial_end_in_acceleration,
    "replaced": trial_replacement,
    "first": trial_first_goal,
    "twin": trial_twin_end,
    "controller": trial_killed_controller,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("cases", nargs="*", default=list(CASES), help=", ".join(CASES))
    parser.add_argument("--robot", default="delta_cu")
    parser.add_argument("--update-rate", type=int, default=500)
    given = parser.parse_args()
    with peer() as other:
        cell = Cell(other, given.robot, given.update_rate)
        try:
            cell.start_controller()
            cell.start_twin()
            other.spin(3.0)
            for name in given.cases:
                CASES[name](cell)
        finally:
            cell.stop()


if __name__ == "__main__":
    main()
