# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A computed-torque controller that checks its input and sends zeros when a check fails.

It holds the position of the first joint state, then follows a smooth path there and back:
tau = inverse_dynamics(q, qd, qdd_wanted + 2 w (qd_wanted - qd) + w^2 (q_wanted - q)).

    ros2 run pkm_twin machine_sim --ros-args -p mechanism:=delta_cu -p clock:=lockstep
    python3 computed_torque.py --robot delta_cu --ros-args -p use_sim_time:=true
"""

import argparse
import sys
import time

import numpy as np
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_client import choose_travel

from delta_dynamics import inverse_dynamics
from pkm_twin import load
from pkm_twin.errors import PkmTwinError

NANOSECONDS = 1e9


class Controller(Node):
    """Command a robot's efforts; stop permanently at the first fault."""

    def __init__(self, options):
        super().__init__("computed_torque")
        self.robot = load(options.robot)
        # Messages use the controller's joint names and values.
        self.controller = self.robot.controller
        self.options = options
        self.errors, self.stopped, self.done = [], "", False
        self._first = self._last = None
        self._travel = choose_travel(self.robot, options.reach)
        # Compiled before the first joint state is due.
        rest = np.zeros(self.robot.joints_count)
        inverse_dynamics(self.robot, self.robot.inverse(self.robot.home()), rest, rest)
        self._publisher = self.create_publisher(Float64MultiArray, options.commands, 1)
        self.create_subscription(JointState, "joint_states", self._on_state, 10)
        # The steady clock, so that the watch also works if the simulated clock stops.
        self._last_arrival = time.monotonic()
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._silence_timer = self.create_timer(0.05, self._on_silence, clock=steady)

    def _on_silence(self):
        silent = time.monotonic() - self._last_arrival
        if self._first is not None and silent > self.options.deadline:
            self.stop(f"no joint state for {silent:.3f} s")

    def _on_state(self, message):
        self._last_arrival = time.monotonic()
        if self.stopped or self.done:
            return
        stamp = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
        if stamp == self._last:
            return
        fault = self._find_fault(message, stamp)
        if fault:
            self.stop(fault)
            return
        index = [message.name.index(name) for name in self.controller.names]
        q = self.controller.positions(np.array(message.position)[index])
        qd = self.controller.rates(np.array(message.velocity)[index])
        if self._first is None:
            self._first, self._start = stamp, q
        self._last = stamp
        try:
            effort = self.compute_effort((stamp - self._first) / NANOSECONDS, q, qd)
            if effort is None:
                self.done = True
                return
            self.command(effort)
        except ValueError as refusal:
            self.stop(str(refusal))

    def compute_effort(self, t, q, qd):
        """Return the efforts at time ``t`` of the path for a joint state; None after its end."""
        wanted = self.plan(t)
        if wanted is None:
            return None
        w = 2.0 * np.pi * self.options.bandwidth
        error, error_rate = wanted[0] - q, wanted[1] - qd
        self.errors.append(error)
        return inverse_dynamics(self.robot, q, qd, wanted[2] + 2.0 * w * error_rate + w**2 * error)

    def _find_fault(self, message, stamp):
        """Describe what is wrong with a joint state; empty if nothing is."""
        missing = set(self.controller.names) - set(message.name)
        if missing:
            return f"no joint {', '.join(sorted(missing))}"
        if not len(message.name) == len(message.position) == len(message.velocity):
            return "positions and velocities are not as many as names"
        if not np.isfinite([*message.position, *message.velocity]).all():
            return "a position or velocity is not finite"
        age = (self.get_clock().now().nanoseconds - stamp) / NANOSECONDS
        if age > self.options.age:
            return f"the joint state is {age:.3f} s old"
        if self._last is None:
            return ""
        gap = (stamp - self._last) / NANOSECONDS
        if not 0.0 < gap <= self.options.gap:
            return f"{gap:.4f} s between two joint states, allowed {self.options.gap:g}"
        return ""

    def plan(self, t):
        """Return position, velocity and acceleration of the path at time ``t``; None after its end."""
        x = t / self.options.seconds
        if x > 1.0:
            return None
        # 64 (x - x^2)^3: rest at both ends, 1 in the middle.
        blend = 64.0 * np.array([-1.0, 3.0, -3.0, 1.0, 0.0, 0.0, 0.0])
        scale = self.options.seconds
        p, v, a = (np.polyval(np.polyder(blend, k), x) / scale**k for k in range(3))
        return self._start + p * self._travel, v * self._travel, a * self._travel

    def command(self, effort):
        """Publish efforts; stop if one is not finite or beyond the limits."""
        limits = self.robot.limits.effort
        if not np.isfinite(effort).all() or (limits is not None and (abs(effort) > limits).any()):
            self.stop(f"effort {effort.round(3).tolist()} is beyond the limits")
            return
        command = self.controller.controller_efforts(effort)
        self._publisher.publish(Float64MultiArray(data=command.tolist()))

    def stop(self, why):
        """Stop permanently for a reason, with zero efforts."""
        if not self.stopped:
            self.stopped = why
            self.get_logger().error(f"stopped: {why}")
            self.send_zeros()

    def send_zeros(self):
        """Send zeros, and wait until the controller has received them."""
        zeros = [0.0] * self.robot.joints_count
        self._publisher.publish(Float64MultiArray(data=zeros))
        self._publisher.wait_for_all_acked(Duration(seconds=0.5))


def main(kind=Controller, text=__doc__, robot="delta_cu"):
    """Run the controller; return 0 after the whole path, 1 if a check stopped it."""
    parser = argparse.ArgumentParser(description=text)
    parser.add_argument("--robot", default=robot)
    parser.add_argument("--commands", default="machine_sim/commands")
    parser.add_argument("--seconds", type=float, default=1.0, help="duration of the path")
    parser.add_argument("--reach", type=float, default=0.1, help="fraction of the joints' range")
    parser.add_argument("--bandwidth", type=float, default=8.0, help="of the control, Hz")
    parser.add_argument("--deadline", type=float, default=0.1, help="longest silence, s")
    parser.add_argument("--age", type=float, default=0.05, help="largest age of a joint state, s")
    parser.add_argument("--gap", type=float, default=0.01, help="longest time between stamps, s")
    options = parser.parse_args(rclpy.utilities.remove_ros_args()[1:])
    # Ctrl-C must leave the topics open for the zeros.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        controller = kind(options)
    except PkmTwinError as error:
        print(f"failed: {error}", file=sys.stderr)
        rclpy.try_shutdown()
        return 1
    try:
        while not (controller.stopped or controller.done):
            rclpy.spin_once(controller, timeout_sec=0.1)
    except (KeyboardInterrupt, ExternalShutdownException):
        controller.stop("interrupted")
    if controller.done:
        controller.send_zeros()
        worst = abs(np.array(controller.errors)).max()
        print(f"{len(controller.errors)} samples, largest tracking error {worst:.3e}")
    controller.destroy_node()
    rclpy.try_shutdown()
    return 0 if controller.done else 1


if __name__ == "__main__":
    sys.exit(main())
