# SPDX-License-Identifier: Apache-2.0
"""Processor time of each node of one robot, and of all in one process, in percent of a core.

    python3 tools/cell_trial/cpu.py [--robot delta_cu] [--rate 250] [--seconds 20] [NODE ...]

Needs a sourced Jazzy workspace with pkm_twin, and for figures that mean something an idle machine.
"""

from __future__ import annotations

import argparse
import time
from array import array

import numpy as np
from cell import Process, closing, node, peer
from geometry_msgs.msg import WrenchStamped
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from delta_dynamics import inverse_dynamics
from pkm_twin import load

NODES = ("delta_dynamics", "command_gate", "stiffness_monitor", "machine_state", "machine_sim")
WARM = 3.0


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("nodes", nargs="*", default=NODES, help=", ".join(NODES))
    parser.add_argument("--robot", default="delta_cu")
    parser.add_argument(
        "--rate", type=float, default=250.0, help="of joint states and wrenches, Hz"
    )
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("-p", "--parameter", action="append", default=[], help="NAME:=VALUE")
    parser.add_argument("--composed", action="store_true", help="all in one process")
    given = parser.parse_args()
    parameters = (f"mechanism:={given.robot}", *given.parameter)
    for names in [tuple(given.nodes)] if given.composed else [(name,) for name in given.nodes]:
        extra = (f"period:={1.0 / given.rate}",) if "machine_sim" in names else ()
        process = node(*names, parameters=(*parameters, *extra))
        with closing(process):
            measured(process, names, given)


def measured(process: Process, names: tuple[str, ...], given: argparse.Namespace) -> None:
    """Stream to the node and print what it takes."""
    robot = load(given.robot)
    q = robot.inverse(robot.home())
    at_rest = inverse_dynamics(robot, q, 0.0 * q, 0.0 * q)
    size = (
        0.05 * float(np.ptp(robot.limits.position)) if robot.limits.position is not None else 0.02
    )
    with peer() as other:
        states = other.node.create_publisher(JointState, "joint_states", 10)
        wrenches = other.node.create_publisher(WrenchStamped, "wrench", 10)
        offered = QoSProfile(depth=10)
        offered.deadline = offered.lifespan = Duration(seconds=0.1)
        torques = other.node.create_publisher(JointState, "delta_dynamics/joint_torques", offered)
        own = "machine_sim" in names
        if own:
            other.node.destroy_publisher(states)
            other.node.destroy_publisher(wrenches)
            commands = other.node.create_publisher(Float64MultiArray, "machine_sim/commands", 10)
            heard = other.hear(JointState, "joint_states")
            other.until(lambda: heard, "joint states of machine_sim")
        else:
            other.until(lambda: set(names) <= set(other.node.get_node_names()), str(names))
        holding = array("d", robot.controller.controller_efforts(at_rest))
        used = began = 0.0
        sent = 0
        start = time.monotonic()
        end = start + WARM + given.seconds
        while (now := time.monotonic()) < end:
            if not used and now - start > WARM:
                used, began, sent = process.usage(), now, 0
            due = start + (sent + 1) / given.rate if not began else began + (sent + 1) / given.rate
            other.spin(max(0.0, min(due - now, 0.05)))
            if time.monotonic() < due:
                continue
            sent += 1
            t = time.monotonic() - start
            if own:
                commands.publish(Float64MultiArray(data=holding))
                continue
            stamp = other.node.get_clock().now().to_msg()
            motion = size * np.sin(3.0 * t + np.arange(len(q)))
            rates = 3.0 * size * np.cos(3.0 * t + np.arange(len(q)))
            message = JointState(name=list(robot.controller.names))
            message.header.stamp = stamp
            message.position = array("d", q + motion - size * np.sin(np.arange(len(q))))
            message.velocity = array("d", rates)
            message.effort = array("d", 0.0 * q)
            states.publish(message)
            if names == ("command_gate",):
                torques.publish(message)
            wrench = WrenchStamped()
            wrench.header.stamp, wrench.header.frame_id = stamp, "platform"
            wrench.wrench.force.z = -20.0
            wrench.wrench.force.x = 5.0
            wrenches.publish(wrench)
        share = (process.usage() - used) / (time.monotonic() - began)
        rate = f", {sent / (time.monotonic() - began):.0f} Hz sent"
        memory = f"{process.memory():.0f} MB"
        text = f"{100 * share:.1f} % of a core, {memory}{rate}"
        print(f"{'+'.join(names)} {given.robot}: {text}", flush=True)


if __name__ == "__main__":
    main()
