# SPDX-License-Identifier: Apache-2.0
"""The bare echo that the feedforward node is measured against: the same message back."""

import rclpy
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import JointState


def main():
    rclpy.init()
    node = rclpy.create_node("echo")
    publisher = node.create_publisher(JointState, "~/joint_torques", 10)
    node.create_subscription(JointState, "joint_states", publisher.publish, 10)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
