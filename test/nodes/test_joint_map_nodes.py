# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""All nodes of a machine whose controller has other names and numbers for every joint."""

import numpy as np
import pytest

pytest.importorskip("rclpy", exc_type=ImportError)

from geometry_msgs.msg import PoseStamped, WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from delta_dynamics import inverse_dynamics
from stiffness_monitor import setpoint_correction, strain_energy
from test.nodes.harness import SECOND, Maker, Ros
from test.support.mapped import sides
from test.support.robots import partly_long

MAKE = Maker(Ros())
FORCE = np.array([15.0, -10.0, 20.0])
TOPICS = {
    "/joint_states": JointState,
    "/delta_dynamics/joint_torques": JointState,
    "/delta_dynamics/torque_residual": JointState,
    "/delta_dynamics/commands": Float64MultiArray,
    "/delta_dynamics/joint_trajectory_ff": JointTrajectory,
    "/command_gate/commands": Float64MultiArray,
    "/command_gate/commands_stamped": JointState,
    "/machine_state/joint_states": JointState,
    "/machine_state/pose": PoseStamped,
    "/stiffness_monitor/setpoint_offset": JointState,
    "/stiffness_monitor/corrected_setpoint": JointState,
}
LONG = 600.0
"""Longer than a loaded machine keeps a message waiting, s."""


@pytest.fixture(scope="module", params=partly_long(["delta_cu", "upr_rpu"], "upr_rpu"))
def cell(request, tmp_path_factory, peer, launch):
    """A machine that stands at home under its brakes, and every node beside it."""
    both = sides(request.param)
    path = both.write(tmp_path_factory.mktemp(request.param))
    robot = f"mechanism:={path}"
    for topic, kind in TOPICS.items():
        peer.hear(kind, topic)
        peer.received(topic).clear()
    nodes = {
        "sim": launch(
            "delta_dynamics.nodes.simulation",
            robot,
            "period:=0.01",
            arguments=("-r", "wrench:=/sim/wrench"),
        ),
        "twin": launch(
            "delta_dynamics.nodes.twin",
            robot,
            "differentiator.window:=4",
            "publish_commands:=true",
            "on_stop:=gravity",
            f"stale_after:={LONG}",
        ),
        "gate": launch("delta_dynamics.nodes.gate", robot, "on_stop:=gravity", "deadline:=600.0"),
        "state": launch("pkm_twin.state.node", robot, "publish_tf:=none"),
        "stiffness": launch(
            "stiffness_monitor.node",
            robot,
            "correct_setpoint:=true",
            "correction_bound:=1.0",
            f"max_state_age:={LONG}",
            f"correction_age:={LONG}",
        ),
    }
    for kind, topic in (
        (JointTrajectory, "/delta_dynamics/joint_trajectory"),
        (WrenchStamped, "/wrench"),
        (JointState, "/setpoint"),
    ):
        peer.talk(kind, topic)
    yield both, nodes
    for process in nodes.values():
        process.close()


def test_every_joint_number_is_the_controllers(cell, peer):
    both, nodes = cell
    robot, n = both.plain, both.plain.joints_count
    home, still = robot.inverse(robot.home()), np.zeros(n)
    held = inverse_dynamics(robot, home, still, still)
    near = home + 1e-3
    push = np.concatenate([FORCE, np.zeros(3)])

    def send():
        now = peer.now()
        rows = [both.positions(near)], [both.rates(still)], [both.rates(still)]
        peer.send(
            "/delta_dynamics/joint_trajectory",
            MAKE.trajectory(both.names, [SECOND], *(np.array(r).tolist() for r in rows), now + 60 * SECOND),
        )
        peer.send("/wrench", MAKE.wrench(push, now))
        peer.send("/setpoint", MAKE.joint_state(both.names, both.positions(near), (), (), now))

    def answered():
        gate = peer.received("/command_gate/commands_stamped")
        # It begins with zeros.
        return all(peer.received(topic) for topic in TOPICS) and any(gate[-1].effort)

    peer.until(answered, repeat=send)
    last = {topic: peer.received(topic)[-1] for topic in TOPICS}

    def close(topic, field, expected, scale):
        message = last[topic]
        assert list(message.name) == both.names
        np.testing.assert_allclose(getattr(message, field), expected, rtol=0, atol=1e-6 * scale)

    efforts = np.abs(both.efforts(held)).max()
    state = last["/joint_states"]
    assert list(state.name) == both.names
    np.testing.assert_allclose(state.position, both.positions(home), rtol=1e-12)
    assert list(state.effort) == [0.0] * n
    close("/delta_dynamics/joint_torques", "effort", both.efforts(held), efforts)
    close("/delta_dynamics/torque_residual", "effort", both.efforts(-held), efforts)
    np.testing.assert_allclose(last["/delta_dynamics/commands"].data, both.efforts(held), atol=1e-6 * efforts)
    filled = last["/delta_dynamics/joint_trajectory_ff"].points[0].effort
    bent = both.efforts(inverse_dynamics(robot, near, still, still))
    np.testing.assert_allclose(filled, bent, atol=1e-9 * efforts)
    # The gate forwards the twin's torques as they are.
    close("/command_gate/commands_stamped", "effort", both.efforts(held), efforts)
    sent = {tuple(m.effort) for m in peer.received("/delta_dynamics/joint_torques")}
    forwarded = {tuple(m.data) for m in peer.received("/command_gate/commands") if any(m.data)}
    assert forwarded & sent
    own = dict(
        zip(
            last["/machine_state/joint_states"].name,
            last["/machine_state/joint_states"].position,
            strict=True,
        )
    )
    np.testing.assert_allclose([own[name] for name in robot.joint_names], home, atol=1e-9)
    place = last["/machine_state/pose"].pose.position
    np.testing.assert_allclose([place.x, place.y, place.z], robot.platform(home)[0], atol=1e-9)
    moved = strain_energy(robot, robot.home(), push).deflection
    offset = setpoint_correction(robot, home, moved, bound=1.0).offset
    close(
        "/stiffness_monitor/setpoint_offset",
        "position",
        both.rates(offset),
        np.abs(both.rates(offset)).max(),
    )
    close(
        "/stiffness_monitor/corrected_setpoint",
        "position",
        both.positions(near + offset),
        1e-3 * np.abs(both.factors * offset).max(),
    )
    # Where the twin dies the gate bears the weight, in the controller's numbers too.
    commands = peer.received("/command_gate/commands")
    assert nodes["twin"].stop() == 0
    assert nodes["gate"].stop() == 0
    peer.until(lambda: not any(p.alive() for p in (nodes["twin"], nodes["gate"])))
    np.testing.assert_allclose(commands[-1].data, both.efforts(held), atol=1e-6 * efforts)
