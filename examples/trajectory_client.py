# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Send a trajectory to delta_dynamics, forward the answer with effort, and check the final position.

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


def make_rest_to_rest_law(points=101, seconds=1.0):
    """Return times, and a polynomial from 0 to 1 with two derivatives, at rest at both ends."""
    x = np.linspace(0.0, 1.0, points)
    quintic = np.array([6.0, -15.0, 10.0, 0.0, 0.0, 0.0])
    return x * seconds, [np.polyval(np.polyder(quintic, k), x) / seconds**k for k in range(3)]


def make_trajectory(names, times, q, qd, qdd):
    """Make a trajectory message; its zero stamp means a start on receipt."""
    rows = zip(times, q.tolist(), qd.tolist(), qdd.tolist(), strict=True)
    points = [
        JointTrajectoryPoint(positions=p, velocities=v, accelerations=a, time_from_start=Duration(seconds=t).to_msg())
        for t, p, v, a in rows
    ]
    return JointTrajectory(joint_names=list(names), points=points)


class Client(Node):
    """Send a trajectory to the twin, and the twin's answer to the controller."""

    def __init__(self, controller="machine_sim/joint_trajectory", twin="delta_dynamics"):
        super().__init__("trajectory_client")
        self.answers, self.states = [], []
        self._to_twin = self.create_publisher(JointTrajectory, f"{twin}/joint_trajectory", 1)
        self._to_controller = self.create_publisher(JointTrajectory, controller, 1)
        topic = f"{twin}/joint_trajectory_ff"
        self.create_subscription(JointTrajectory, topic, self.answers.append, 1)
        self.create_subscription(JointState, "joint_states", self.states.append, 1000)

    def execute(self, message, patience=60.0):
        """Execute a trajectory; return the joint states until its end, and the efforts of its points.

        :raises TimeoutError: a node, a joint state or the answer is missing, or the end is not reached.
        """
        ends = (self._to_twin, self._to_controller)
        self.spin_until(lambda: all(p.get_subscription_count() for p in ends), patience, "both nodes")
        self.spin_until(lambda: self.states, patience, "joint_states")
        # Repeat until there is an answer: the node may discover this publisher later.
        ask = functools.partial(self._to_twin.publish, message)
        self.spin_until(lambda: self.find_answers(message), patience, "the efforts", again=ask)
        filled = self.find_answers(message)[-1]
        efforts = np.array([point.effort for point in filled.points])
        if efforts.shape != (len(message.points), len(message.joint_names)):
            raise RuntimeError(f"the answer has efforts of shape {efforts.shape}")
        if not np.isfinite(efforts).all():
            raise RuntimeError("an effort is not finite")
        self.states.clear()
        self._to_controller.publish(filled)
        goal = np.array(filled.points[-1].positions)
        self.spin_until(lambda: self.is_at_rest(goal, filled.joint_names), patience, "the end")
        return list(self.states), efforts

    def find_answers(self, message):
        """Return the answers to this trajectory, not to an earlier one."""
        wanted = [list(point.positions) for point in message.points]
        return [a for a in self.answers if [list(p.positions) for p in a.points] == wanted]

    def is_at_rest(self, goal, names):
        """Return whether the machine rests at the goal, within a percent of the path."""
        if not self.states:
            return False
        q, first = (read_positions(self.states[i], names) for i in (-1, 0))
        path = abs(goal - first).max()
        if len(self.states) <= 20 or abs(q - goal).max() >= 0.01 * max(path, 1e-6):
            return False
        return abs(q - read_positions(self.states[-20], names)).max() < 1e-4 * path

    def spin_until(self, condition, patience, what, again=None):
        """Spin until a condition holds; call ``again`` at once and every second."""
        end, due = time.monotonic() + patience, 0.0
        while not condition():
            if again is not None and time.monotonic() >= due:
                again()
                due = time.monotonic() + 1.0
            rclpy.spin_once(self, timeout_sec=0.1)
            if time.monotonic() > end:
                raise TimeoutError(f"{what}: nothing within {patience:g} s")


def read_positions(state, names):
    """Return the joint positions of a state in the order of the names."""
    return np.array([state.position[state.name.index(name)] for name in names])


def choose_travel(robot, share):
    """Return a fraction of every joint's range; without limits of 1 rad or the platform's size."""
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
        client.spin_until(lambda: client.states, 60.0, "joint_states")
        # Messages carry the controller's names and numbers of the joints.
        joints = robot.controller
        start = read_positions(client.states[-1], joints.names)
        times, laws = make_rest_to_rest_law(seconds=options.seconds)
        travel = joints.controller_rates(choose_travel(robot, options.reach))
        rows = [np.outer(law, travel) for law in laws]
        message = make_trajectory(joints.names, times, start + rows[0], *rows[1:])
        states, efforts = client.execute(message)
    except (TimeoutError, RuntimeError, PkmTwinError) as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    finally:
        client.destroy_node()
        rclpy.try_shutdown()
    miss = abs(read_positions(states[-1], joints.names) - start - rows[0][-1]).max()
    peak = ", ".join(f"{value:.3g}" for value in abs(efforts).max(0))
    print(f"{len(efforts)} points, peak efforts {peak}, position error at the end {miss:.2e}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
