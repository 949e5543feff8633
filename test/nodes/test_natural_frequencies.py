# SPDX-License-Identifier: Apache-2.0
"""Natural frequencies from the node stiffness_monitor, over the real middleware."""

import numpy as np
import pytest
import yaml

from stiffness_monitor import compliance, strain_energy
from stiffness_monitor.modes import natural_frequencies
from test.nodes.harness import SECOND, Maker, Ros, one_line_refusal
from test.support.robots import load, massless, parameters_of

pytest.importorskip("rclpy", exc_type=ImportError)

from geometry_msgs.msg import TransformStamped, WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String

MODULE = "stiffness_monitor.node"
ROBOT = load("upr_rpu")
POSE = np.array([-0.7, 0.2, -0.15])
Q = ROBOT.inverse(POSE)
RATE = 5.0
WRENCH = (1.0, 0.0, -50.0, 0.0, 0.0, 0.0)


class Talk:
    """A running node, and states and wrenches for it."""

    def __init__(self, peer, launch, name, *parameters, robot=ROBOT, q=Q):
        self.peer, self.name, self.make = peer, name, Maker(Ros())
        self.robot, self.q = robot, q
        peer.talk(JointState, f"/{name}/states")
        peer.talk(WrenchStamped, f"/{name}/wrench")
        peer.hear(TransformStamped, f"/{name}/deflection")
        peer.hear(Float64MultiArray, f"/{name}/compliance")
        peer.hear(String, f"/{name}/dominant_element")
        peer.hear(Float64MultiArray, f"/{name}/natural_frequencies")
        pairs = {"__node": name, "joint_states": f"/{name}/states", "wrench": f"/{name}/wrench"}
        remap = [part for pair in pairs.items() for part in ("-r", ":=".join(pair))]
        launch(MODULE, "max_state_age:=1.0", *parameters, arguments=remap)

    def received(self, topic):
        return self.peer.received(f"/{self.name}/{topic}")

    def send_state(self):
        stamp = self.peer.now()
        self.peer.send(
            f"/{self.name}/states",
            self.make.joint_state(self.robot.joint_names, self.q.tolist(), stamp=stamp),
        )
        return stamp

    def send(self):
        stamp = self.send_state()
        self.peer.send(f"/{self.name}/wrench", self.make.wrench(WRENCH, stamp))

    def run(self, seconds, send=True):
        end = self.peer.now() + round(seconds * SECOND)
        repeat = self.send if send else None
        self.peer.until(lambda: self.peer.now() > end, seconds + 30.0, repeat)


def test_frequencies_of_the_latest_pose_at_most_at_their_rate(peer, launch):
    talk = Talk(peer, launch, "modal", f"frequencies_rate:={RATE}")
    peer.until(lambda: talk.received("natural_frequencies"), repeat=talk.send)
    message = talk.received("natural_frequencies")[-1]
    (dim,) = message.layout.dim
    assert (dim.label, dim.size, dim.stride) == ("frequency", 6, 6)
    assert np.allclose(message.data, natural_frequencies(ROBOT, POSE), rtol=1e-9)
    for topic in ("natural_frequencies", "deflection"):
        talk.received(topic).clear()
    talk.run(2.0)
    assert 2 <= len(talk.received("natural_frequencies")) <= 2.0 * RATE + 2
    # No new pose, no new frequencies.
    talk.run(1.0, send=False)
    talk.received("natural_frequencies").clear()
    talk.run(1.0, send=False)
    assert not talk.received("natural_frequencies")


@pytest.mark.parametrize("name", ["delta_cu", "prru"])
def test_a_machine_solved_as_a_frame(name, peer, launch):
    """Frequencies from joint states alone, and every answer to a wrench."""
    robot = load(name)
    pose = robot.home() + (np.array([0.02, -0.03, 0.01]) if name == "delta_cu" else 0.02)
    talk = Talk(
        peer, launch, f"frame_{name}", f"mechanism:={name}", robot=robot, q=robot.inverse(pose)
    )
    peer.until(lambda: talk.received("natural_frequencies"), repeat=talk.send_state)
    found = talk.received("natural_frequencies")[-1].data
    assert np.allclose(found, natural_frequencies(robot, pose), rtol=1e-6)
    assert not talk.received("compliance")
    answers = ("compliance", "dominant_element", "deflection")
    peer.until(lambda: all(talk.received(topic) for topic in answers), repeat=talk.send)
    matrix = np.reshape(talk.received("compliance")[-1].data, (6, 6))
    expected = compliance(robot, pose)
    assert matrix == pytest.approx(expected, rel=1e-6, abs=1e-9 * expected.max())
    # In the platform's axes, as a sensor there measures it.
    turn = robot.rotation(pose)
    fixed = np.concatenate((turn @ WRENCH[:3], turn @ WRENCH[3:]))
    dominant = strain_energy(robot, pose, fixed).dominant
    assert talk.received("dominant_element")[-1].data == dominant


def test_a_machine_without_elastic_members_is_refused(launch, tmp_path):
    data = parameters_of("delta_cu")
    del data["members"]
    path = tmp_path / "rigid.yaml"
    path.write_text(yaml.safe_dump(data))
    assert "members" in one_line_refusal(launch(MODULE, f"mechanism:={path}"))


@pytest.mark.parametrize("case", ["off", "massless"])
def test_no_frequencies_when_off_or_without_masses(case, peer, launch, tmp_path):
    light = massless(tmp_path / "light.yaml")
    choice = "frequencies_rate:=0.0" if case == "off" else f"mechanism:={light}"
    talk = Talk(peer, launch, f"still_{case}", choice)
    peer.until(lambda: len(talk.received("deflection")) > 20, repeat=talk.send)
    talk.run(0.5)
    assert not talk.received("natural_frequencies")


def test_a_rate_out_of_bounds_is_refused(launch):
    process = launch(MODULE, "frequencies_rate:=-1.0")
    assert "frequencies_rate" in one_line_refusal(process)
