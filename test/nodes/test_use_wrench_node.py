# SPDX-License-Identifier: Apache-2.0
"""delta_dynamics with a measured wrench, as a process of its own."""

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from test.nodes.harness import SECOND, Maker, Ros, counts_of, stamp_of, values_of
from test.support.robots import load

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState

MAKE = Maker(Ros())
ROBOT = load("prru")
Q = ROBOT.inverse(ROBOT.home())
REST = np.zeros(3)
WRENCH = [30.0, -20.0, -100.0, 3.0, -2.0, 1.0]
MEASURED = [100.0, 110.0, 120.0]


def test_torque_residual_and_stop(peer, launch):
    """At rest the wrench is borne exactly; without it the stream stops."""
    remap = ("joint_states:=/bearing/states", "wrench:=/bearing/wrench", "__node:=bearing")
    arguments = [word for pair in remap for word in ("-r", pair)]
    process = launch(
        "delta_dynamics.node", "mechanism:=prru", "use_wrench:=true", "no_wrench:=stop",
        "max_wrench_age:=1.0", "stale_after:=5.0", "differentiator.window:=4", "recovery_count:=1",
        arguments=arguments,
    )  # fmt: skip
    peer.hear(DiagnosticArray, "/diagnostics")
    for topic in ("joint_torques", "torque_residual"):
        peer.hear(JointState, f"/bearing/{topic}")
    peer.talk(JointState, "/bearing/states")
    peer.talk(WrenchStamped, "/bearing/wrench")
    peer.until(peer.matched)
    torques, residuals = (
        peer.received(f"/bearing/{name}") for name in ("joint_torques", "torque_residual")
    )

    def send(wrench=True):
        assert process.alive(), process.output
        stamp = peer.now()
        if wrench:
            peer.send("/bearing/wrench", MAKE.wrench(WRENCH, stamp))
        names = ROBOT.joint_names
        peer.send("/bearing/states", MAKE.joint_state(names, Q, REST, MEASURED, stamp))

    rotation = ROBOT.platform(Q)[1]
    fixed = np.concatenate((rotation @ WRENCH[:3], rotation @ WRENCH[3:]))
    exact = inverse_dynamics(ROBOT, Q, REST, REST, fixed)
    assert np.abs(exact - inverse_dynamics(ROBOT, Q, REST, REST)).max() > 10.0

    def borne():
        """The torque that bears the wrench, and the residual of its stamp."""
        right = {stamp_of(m) for m in torques if np.allclose(m.effort, exact, atol=1e-6)}
        return next((m for m in residuals if stamp_of(m) in right), None)

    residual = peer.until(borne, repeat=send)
    assert np.allclose(residual.effort, MEASURED - exact, atol=1e-6)

    def stopped():
        # A state that was heard before the first wrench is a warning of the same name.
        array = peer.diagnostics("/bearing")
        status = array.status[0]
        return array if status.level == b"\x02" and "no wrench" in status.message else None

    array = peer.until(stopped, repeat=lambda: send(wrench=False))
    assert counts_of(array, "stopped")["no wrench"] >= 1
    assert int(values_of(array)["wrenches accepted"]) > 3
    # What is refused is counted, and no wrench.
    peer.until(
        lambda: counts_of(peer.diagnostics("/bearing"), "wrenches rejected").get("future stamp"),
        repeat=lambda: peer.send("/bearing/wrench", MAKE.wrench(WRENCH, peer.now() + 600 * SECOND)),
    )
    torques.clear()
    peer.until(lambda: torques, repeat=send)
