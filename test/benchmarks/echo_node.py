# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The bare echo that the feedforward node is measured against: the same message back.

Its one argument is the executor: ``single`` or ``events``.
"""

import sys

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from sensor_msgs.msg import JointState


def main():
    events = sys.argv[1] == "events"
    rclpy.init()
    node = rclpy.create_node("echo")
    publisher = node.create_publisher(JointState, "~/joint_torques", 10)
    node.create_subscription(JointState, "joint_states", publisher.publish, 10)
    executor = EventsExecutor() if events else SingleThreadedExecutor()
    executor.add_node(node)
    try:
        while rclpy.ok():
            executor.spin_once(timeout_sec=0.5 if events else None)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
