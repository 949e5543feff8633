# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Sends a trajectory to delta_dynamics, forwards the answer with effort, and checks its end.

    ros2 run pkm_twin machine_sim --ros-args -p mechanism:=delta_cu
    ros2 run pkm_twin delta_dynamics --ros-args -p mechanism:=delta_cu
    python3 trajectory_client.py --robot delta_cu

To connect a controller directly, no client is needed: remap ~/joint_trajectory_ff of
delta_dynamics to the controller's topic.
"""

import argparse
import functools
import sys
import time

import numpy as np
import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from pkm_twin import load
from pkm_twin.errors import PkmTwinError


def blend(points=101, seconds=1.0):
    """Times and a smooth way from 0 to 1 with two derivatives, at rest at both ends."""
    x = np.linspace(0.0, 1.0, points)
    way = np.array([6.0, -15.0, 10.0, 0.0, 0.0, 0.0])
    return x * seconds, [np.polyval(np.polyder(way, k), x) / seconds**k for k in range(3)]


def trajectory(names, times, q, qd, qdd):
    """A message with a zero stamp: it starts on receipt."""
    rows = zip(times, q.tolist(), qd.tolist(), qdd.tolist(), strict=True)
    points = [
        JointTrajectoryPoint(positions=p, velocities=v, accelerations=a, time_from_start=Duration(seconds=t).to_msg())
        for t, p, v, a in rows
    ]
    return JointTrajectory(joint_names=list(names), points=points)


class Client(Node):
    """Sends a trajectory to the twin and what comes back to the controller."""

    def __init__(self, controller="machine_sim/joint_trajectory", twin="delta_dynamics"):
        super().__init__("trajectory_client")
        self.answers, self.states = [], []
        self._to_twin = self.create_publisher(JointTrajectory, f"{twin}/joint_trajectory", 1)
        self._to_controller = self.create_publisher(JointTrajectory, controller, 1)
        topic = f"{twin}/joint_trajectory_ff"
        self.create_subscription(JointTrajectory, topic, self.answers.append, 1)
        self.create_subscription(JointState, "joint_states", self.states.append, 1000)

    def go(self, message, patience=60.0):
        """Joint states until the trajectory's end, and the efforts of its points.

        :raises TimeoutError: something that is awaited does not come.
        """
        ends = (self._to_twin, self._to_controller)
        self.until(lambda: all(p.get_subscription_count() for p in ends), patience, "both nodes")
        self.until(lambda: self.states, patience, "joint_states")
        # Again until it is heard: a node may find a publisher later than that finds the node.
        ask = functools.partial(self._to_twin.publish, message)
        self.until(lambda: self.filled(message), patience, "the efforts", again=ask)
        filled = self.filled(message)[-1]
        efforts = np.array([point.effort for point in filled.points])
        if efforts.shape != (len(message.points), len(message.joint_names)):
            raise RuntimeError(f"the answer has efforts of shape {efforts.shape}")
        if not np.isfinite(efforts).all():
            raise RuntimeError("an effort is not finite")
        self.states.clear()
        self._to_controller.publish(filled)
        goal = np.array(filled.points[-1].positions)
        self.until(lambda: self.at_rest(goal, filled.joint_names), patience, "the end")
        return list(self.states), efforts

    def filled(self, message):
        """Answers to this trajectory, not to one before it."""
        wanted = [list(point.positions) for point in message.points]
        return [a for a in self.answers if [list(p.positions) for p in a.points] == wanted]

    def at_rest(self, goal, names):
        """Whether the newest joint state is at the goal, within a percent of the path."""
        if not self.states:
            return False
        q, first = (positions(self.states[i], names) for i in (-1, 0))
        return abs(q - goal).max() < 0.01 * max(abs(goal - first).max(), 1e-6) and (
            len(self.states) > 20 and abs(q - positions(self.states[-20], names)).max() < 1e-4 * abs(goal - first).max()
        )

    def until(self, condition, patience, what, again=None):
        """Spin until it is so; ``again`` is called at once and every second."""
        end, due = time.monotonic() + patience, 0.0
        while not condition():
            if again is not None and time.monotonic() >= due:
                again()
                due = time.monotonic() + 1.0
            rclpy.spin_once(self, timeout_sec=0.1)
            if time.monotonic() > end:
                raise TimeoutError(f"{what}: nothing within {patience:g} s")


def positions(state, names):
    """Joint positions of a state in the order of the names."""
    return np.array([state.position[state.name.index(name)] for name in names])


def reaches(robot, share):
    """A share of every joint's range; of one without limits, of 1 rad or of the platform's size."""
    whole = np.where([unit == "m" for unit in robot.joint_units], robot.size, 1.0)
    if robot.limits.position is not None:
        low, high = robot.limits.position.T
        whole = np.where(np.isfinite(high - low), high - low, whole)
    return share * whole


def main():
    """Move every joint by a fraction of its range, from the position at the start."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="delta_cu")
    parser.add_argument("--controller", default="machine_sim/joint_trajectory")
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--reach", type=float, default=0.1, help="fraction of the joints' range")
    options = parser.parse_args(rclpy.utilities.remove_ros_args()[1:])
    rclpy.init()
    client = Client(options.controller)
    try:
        robot = load(options.robot)
        client.until(lambda: client.states, 60.0, "joint_states")
        # Messages carry the controller's names and numbers of the joints.
        joints = robot.controller
        start = positions(client.states[-1], joints.names)
        times, ways = blend(seconds=options.seconds)
        way = joints.controller_rates(reaches(robot, options.reach))
        rows = [np.outer(share, way) for share in ways]
        message = trajectory(joints.names, times, start + rows[0], *rows[1:])
        states, efforts = client.go(message)
    except (TimeoutError, RuntimeError, PkmTwinError) as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    finally:
        client.destroy_node()
        rclpy.try_shutdown()
    miss = abs(positions(states[-1], joints.names) - start - rows[0][-1]).max()
    peak = ", ".join(f"{value:.3g}" for value in abs(efforts).max(0))
    print(f"{len(efforts)} points, peak efforts {peak}, position error at the end {miss:.2e}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
