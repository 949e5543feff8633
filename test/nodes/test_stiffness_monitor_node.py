# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The node stiffness_monitor over the real middleware, as a process of its own."""

import math
import signal

import numpy as np
import pytest

from stiffness_monitor import compliance, setpoint_correction, strain_energy
from stiffness_monitor.modes import natural_frequencies
from test.nodes.harness import (
    SECOND,
    Maker,
    Ros,
    Running,
    counts_of,
    stamp_of,
    text_of,
    values_of,
)
from test.support.robots import load, massless, partly_long

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped, WrenchStamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String

MODULE = "stiffness_monitor.node"
ROBOT = load("upr_rpu")
NAMES = ROBOT.joint_names
POSE = np.array([-0.7, 0.2, -0.15])
Q = ROBOT.inverse(POSE)
WRENCH = (30.0, -20.0, -100.0, 3.0, -2.0, 1.0)
MAKE = Maker(Ros())
STEP = SECOND // 1000
RATE = 5.0
OUTPUTS = {
    "compliance": Float64MultiArray,
    "strain_energy": DiagnosticArray,
    "dominant_element": String,
    "deflection": TransformStamped,
}
STAMPED = ("compliance_stamped", "strain_energy_stamped", "natural_frequencies_stamped")
ALL = OUTPUTS | {"natural_frequencies": Float64MultiArray} | dict.fromkeys(STAMPED, JointState)


class Monitor(Running):
    """A running node and its topics, seen from this side."""

    def __init__(self, peer, launch, name, *parameters, robot=ROBOT, q=Q, heard=OUTPUTS, **options):
        own = {"joint_states": "states", "wrench": "wrench"}
        own |= {topic: topic for topic in ("setpoint", "torques")}
        talk = {"states": JointState, "wrench": WrenchStamped}
        super().__init__(peer, launch, MODULE, name, *parameters, remaps=own, talk=talk, hear=heard, **options)
        self.robot, self.q, self._heard = robot, q, heard

    def joints(self, q, stamp=None, **fields):
        """A joint state in another order than the robot's."""
        order = np.roll(np.arange(len(q)), 1)
        names, values = [self.robot.joint_names[i] for i in order], [float(q[i]) for i in order]
        stamp = self.stamp() if stamp is None else stamp
        return MAKE.joint_state(names, values, stamp=stamp, **fields)

    def send_state(self, stamp=None):
        assert self.process.alive(), self.process.output
        self.send("states", self.joints(self.q, stamp))

    def send_wrench(self, values=WRENCH, frame="platform", stamp=None):
        stamp = self.stamp() if stamp is None else stamp
        self.send("wrench", MAKE.wrench(map(float, values), stamp, frame))
        return stamp

    def send_both(self):
        self.send_state()
        self.send_wrench()

    def run(self, seconds, send=True):
        end = self.peer.now() + round(seconds * SECOND)
        repeat = self.send_both if send else None
        self.peer.until(lambda: self.peer.now() > end, seconds + 30.0, repeat)

    def ready(self):
        self.peer.until(lambda: all(map(self.received, self._heard)), repeat=self.send_both)
        return self

    def last(self, topic):
        return self.received(topic)[-1]

    def answer(self, *arguments, **options):
        """Send a state and a wrench: the four messages that answer this wrench, by topic."""

        def ask():
            # Again until answered: state and wrench come on two topics, in any order.
            for topic in OUTPUTS:
                self.received(topic).clear()
            self.send_state()
            stamps.append(self.send_wrench(*arguments, **options))

        def by_stamp(topic):
            return {stamp_of(m): m for m in self.received(topic)}

        def answered():
            energies, deflections = by_stamp("strain_energy"), by_stamp("deflection")
            both = energies.keys() & deflections.keys() & set(stamps)
            if not both or not all(map(self.received, OUTPUTS)):
                return None
            answers = {topic: self.last(topic) for topic in OUTPUTS}
            stamp = max(both)
            return answers | {"strain_energy": energies[stamp], "deflection": deflections[stamp]}

        stamps = []
        return self.peer.until(answered, repeat=ask)

    def rejects(self):
        return counts_of(self.diagnostics(), "wrenches rejected")


@pytest.fixture(scope="module")
def fleet(peer, launch, tmp_path_factory):
    """The node with its defaults; one without masses takes wrenches in the base frame."""
    heard = OUTPUTS | {"natural_frequencies": Float64MultiArray}
    light = massless(tmp_path_factory.mktemp("light") / "upr_rpu.yaml")
    fixed = (f"mechanism:={light}", "wrench_frame:=base_link", "accept_empty_frame:=true")
    options = {"defaults": (f"frequencies_rate:={RATE}",), "fixed": fixed}
    monitors = {
        name: Monitor(peer, launch, name, "max_state_age:=1.0", *given, heard=heard, fresh=True)
        for name, given in options.items()
    }
    assert monitors["defaults"].ready()
    # The other one expects another frame.
    monitors["fixed"].answer(WRENCH, "base_link")
    return monitors


@pytest.fixture
def platform(fleet):
    return fleet["defaults"]


@pytest.fixture
def fixed(fleet):
    return fleet["fixed"]


def turned(wrench=WRENCH, robot=ROBOT, pose=POSE):
    """A wrench in the platform's axes, told in fixed ones."""
    rotation = robot.rotation(pose)
    return np.concatenate((rotation @ wrench[:3], rotation @ wrench[3:]))


class TestAnswers:
    def test_the_compliance_is_labelled_and_row_major(self, platform):
        message = platform.answer()["compliance"]
        assert [d.label for d in message.layout.dim] == ["row", "col"]
        assert [d.size for d in message.layout.dim] == [6, 6]
        assert [d.stride for d in message.layout.dim] == [36, 6]
        assert message.layout.data_offset == 0
        matrix = np.array(message.data).reshape(6, 6)
        assert np.allclose(matrix, compliance(ROBOT, POSE), rtol=1e-9, atol=0.0)

    @pytest.mark.parametrize("name", ["defaults", "fixed"])
    def test_energy_and_deflection_name_their_elements_pose_and_frames(self, fleet, name):
        frame = "platform" if name == "defaults" else "base_link"
        wrench = turned() if name == "defaults" else np.array(WRENCH)
        answers = fleet[name].answer(WRENCH, frame)
        (status,) = answers["strain_energy"].status
        expected = strain_energy(ROBOT, POSE, wrench)
        values = {pair.key: pair.value for pair in status.values}
        assert set(values) == {
            *ROBOT.element_names,
            *ROBOT.pose_names,
            "total_energy",
            "tie",
            "frame",
        }
        factors = [float(values[element]) for element in ROBOT.element_names]
        assert np.allclose(factors, expected.factors, rtol=1e-9)
        assert sum(factors) == pytest.approx(1.0, abs=1e-12)
        assert float(values["total_energy"]) == pytest.approx(expected.total, rel=1e-9)
        pose = [float(values[key]) for key in ("z", "beta", "gamma")]
        assert np.allclose(pose, POSE, atol=1e-12)
        assert (values["frame"], values["tie"]) == ("base_link", "false")
        assert answers["strain_energy"].header.frame_id == "base_link"
        assert status.message == answers["dominant_element"].data == expected.dominant
        assert status.hardware_id == "upr_rpu"
        # The deflection is a transform in the platform's axes.
        message = answers["deflection"]
        assert message.header.frame_id == "platform"
        assert message.child_frame_id == "platform_deflected"
        deflection = compliance(ROBOT, POSE) @ wrench
        back = ROBOT.rotation(POSE).T
        move, turn = message.transform.translation, message.transform.rotation
        shift, angles = back @ deflection[:3], back @ deflection[3:]
        assert np.allclose([move.x, move.y, move.z], shift, rtol=1e-9, atol=1e-18)
        assert turn.x**2 + turn.y**2 + turn.z**2 + turn.w**2 == pytest.approx(1.0, abs=1e-12)
        # For so small an angle the vector part is half the rotation vector.
        assert np.allclose([turn.x, turn.y, turn.z], angles / 2, rtol=1e-6, atol=1e-18)
        assert np.linalg.norm(shift) > 1e-7 and np.linalg.norm(angles) > 1e-7

    def test_a_zero_wrench_has_no_dominant_element_and_no_factors(self, platform):
        answers = platform.answer([0.0] * 6)
        assert answers["dominant_element"].data == "none"
        (status,) = answers["strain_energy"].status
        assert status.message == "none"
        values = {pair.key: pair.value for pair in status.values}
        assert not set(values) & set(ROBOT.element_names)
        assert float(values["total_energy"]) == 0.0
        move = answers["deflection"].transform
        assert (move.translation.x, move.translation.y, move.translation.z) == (0.0, 0.0, 0.0)
        assert move.rotation.w == 1.0
        assert np.isfinite(answers["compliance"].data).all()


class TestRejects:
    def test_each_bad_wrench_is_counted_and_the_next_good_one_is_answered(self, platform):
        bad = [
            ("frame", {"frame": ""}),
            ("not finite", {"values": (math.nan, 0, 0, 0, 0, 0)}),
            ("bounds", {"values": (0, 5e-324, 0, 0, 0, 0)}),
            ("future stamp", {"stamp": platform.peer.now() + 600 * SECOND}),
            ("no pose", {"stamp": platform.peer.now() - 600 * SECOND}),
        ]
        before = platform.rejects()
        deflections = platform.received("deflection")
        expected = dict(before)
        for reason, options in bad:
            platform.answer()
            for topic in OUTPUTS:
                platform.received(topic).clear()
            refused = platform.send_wrench(**options)
            good = platform.send_wrench()
            # Answers to what was asked again above may still come.
            stamps = platform.peer.until(
                lambda good=good: good in (found := list(map(stamp_of, deflections))) and found
            )
            assert refused not in stamps, reason
            expected[reason] = expected.get(reason, 0) + 1
        array = platform.diagnostics(
            lambda a: sum(counts_of(a, "wrenches rejected").values()) >= sum(before.values()) + len(bad)
        )
        assert counts_of(array, "wrenches rejected") == expected
        assert array.status[0].level == b"\x01"
        assert "last reject: no pose: the nearest joint state" in text_of(array)
        assert "allowed 1 s" in text_of(array)


class TestFrequencies:
    def test_of_the_latest_pose_at_most_at_their_rate(self, platform):
        told = platform.received("natural_frequencies")
        platform.peer.until(lambda: told, repeat=platform.send_both)
        (dim,) = told[-1].layout.dim
        assert (dim.label, dim.size, dim.stride) == ("frequency", 6, 6)
        assert np.allclose(told[-1].data, natural_frequencies(ROBOT, POSE), rtol=1e-9)
        told.clear()
        platform.run(1.0)
        assert 1 <= len(told) <= RATE + 2
        # No new pose, no new frequencies.
        platform.run(0.5, send=False)
        told.clear()
        platform.run(0.5, send=False)
        assert not told

    @pytest.mark.parametrize("name", partly_long(["delta_cu", "prru"], "delta_cu"))
    def test_a_machine_solved_as_a_frame(self, name, peer, launch):
        """Frequencies from joint states alone, every answer to a wrench, and what plots draw."""
        robot = load(name)
        pose = robot.home() + (np.array([0.02, -0.03, 0.01]) if name == "delta_cu" else 0.02)
        given = (f"mechanism:={name}", "max_state_age:=1.0")
        q = robot.inverse(pose)
        talk = Monitor(peer, launch, f"frame_{name}", *given, robot=robot, q=q, heard=ALL)
        peer.until(lambda: talk.received("natural_frequencies_stamped"), repeat=talk.send_state)
        found = talk.last("natural_frequencies").data
        assert np.allclose(found, natural_frequencies(robot, pose), rtol=1e-6)
        message = talk.last("natural_frequencies_stamped")
        assert message.name == [f"mode_{k}" for k in range(1, 7)]
        assert np.allclose(message.position, found, rtol=1e-6)
        assert not talk.received("compliance")
        talk.ready()
        matrix = np.reshape(talk.last("compliance").data, (6, 6))
        expected = compliance(robot, pose)
        assert matrix == pytest.approx(expected, rel=1e-6, abs=1e-9 * expected.max())
        message = talk.last("compliance_stamped")
        assert stamp_of(message) > 0 and message.header.frame_id == "base_link"
        assert message.name[:7] == ["x_x", "x_y", "x_z", "x_rx", "x_ry", "x_rz", "y_y"]
        assert np.allclose(message.position, matrix[np.triu_indices(6)], rtol=1e-9)
        energy = strain_energy(robot, pose, turned(WRENCH, robot, pose))
        assert talk.last("dominant_element").data == energy.dominant
        message = talk.last("strain_energy_stamped")
        assert tuple(message.name) == energy.elements
        assert np.allclose(message.position, energy.factors, rtol=1e-6, atol=1e-12)
        assert np.allclose(message.effort, energy.energies, rtol=1e-6, atol=1e-15)

    def test_none_without_masses(self, fixed):
        fixed.run(0.5)
        assert not fixed.received("natural_frequencies")


FORCE = (160.0, 90.0, 120.0)
TOOL = [0.0, 0.0, -0.15]
OFFSETS = dict.fromkeys(("setpoint_offset", "corrected_setpoint", "setpoint_with_torques"), JointState)
SINGULAR = """
import stiffness_monitor.node as node
from pkm_twin.errors import SingularityError
def singular(self, answer):
    raise SingularityError("correction", (), 0.0, 1e-9)
node.SetpointCorrection.update = node.StiffnessAlarmTopics.update = singular
raise SystemExit(node.run(node.NODE))
"""


class TestCorrection:
    q = np.array([0.62, 0.6, 0.65])

    def test_set_points_are_corrected_by_the_measured_wrench(self, peer, launch):
        ages = [f"{name}:=600.0" for name in ("max_state_age", "correction_age")]
        node = Monitor(
            peer,
            launch,
            "correcting",
            "correct_setpoint:=true",
            f"tool.xyz:={TOOL}",
            *ages,
            "future_tolerance:=600.0",
            "pair_torques:=true",
            q=self.q,
            heard=OFFSETS,
        )
        for topic in ("setpoint", "torques"):
            peer.talk(JointState, f"/correcting/{topic}")
        peer.until(peer.matched)

        def push():
            node.send_state()
            node.send_wrench((*FORCE, 0.0, 0.0, 0.0), "base_link")
            node.send_wrench((*FORCE, 0.0, 0.0, 0.0))
            peer.send("/correcting/setpoint", node.joints(self.q + 1e-3))

        offsets, corrected, both = map(node.received, OFFSETS)
        peer.until(lambda: corrected and offsets, repeat=push)
        wrench = turned((*FORCE, 0.0, 0.0, 0.0), pose=ROBOT.forward(self.q))
        energy = strain_energy(ROBOT, ROBOT.forward(self.q), wrench)
        expected = setpoint_correction(ROBOT, self.q, energy.deflection, tool=TOOL).offset
        assert list(offsets[-1].name) == list(NAMES)
        np.testing.assert_allclose(offsets[-1].position, expected, rtol=1e-9, atol=1e-15)
        assert np.abs(expected).max() > 1e-5
        np.testing.assert_allclose(corrected[-1].position, self.q + 1e-3 + expected, atol=1e-12)
        # Torques of the same stamp are in one message with it, whichever comes first.
        for first in (0, 1):
            stamp = node.stamp()
            efforts = MAKE.joint_state(NAMES, (), effort=[1.0, -2.0, 3.0], stamp=stamp)
            sent = [("setpoint", node.joints(self.q + 2e-3, stamp)), ("torques", efforts)]
            before = len(both)
            for topic, message in sent[first:] + sent[:first]:
                peer.send(f"/correcting/{topic}", message)
            peer.until(lambda before=before: len(both) > before)
            assert stamp_of(both[-1]) == stamp and list(both[-1].name) == list(NAMES)
            np.testing.assert_allclose(both[-1].position, self.q + 2e-3 + expected, atol=1e-12)
            assert list(both[-1].effort) == [1.0, -2.0, 3.0]
        peer.send("/correcting/torques", MAKE.joint_state(NAMES, (), effort=[1.0] * 3, stamp=stamp + 1))
        # What the stamps of wrenches have to keep to holds for set points, as soon as it is set.
        request = SetParameters.Request()
        request.parameters = [Parameter("future_tolerance", value=0.1).to_parameter_msg()]
        (result,) = peer.call(SetParameters, "/correcting/set_parameters", request).results
        assert result.successful
        late = node.joints(self.q, peer.now() + 300 * SECOND)
        for bad in (late, node.joints([np.nan, 0.6, 0.65])):
            peer.send("/correcting/setpoint", bad)
        array = node.diagnostics(lambda a: len(counts_of(a, "set points rejected")) >= 2)
        told = counts_of(array, "set points rejected")
        assert told["future stamp"] == told["not finite"] == 1
        assert int(values_of(array)["set points corrected"]) >= 1
        assert len(both) == 2

    def test_a_wrench_without_a_correction_has_its_compliance(self, peer, launch):
        peer.hear(Float64MultiArray, "/loose/natural_frequencies")
        node = Monitor(
            peer,
            launch,
            "loose",
            "correct_setpoint:=true",
            "frequencies_rate:=0.0",
            q=self.q,
            heard={"compliance_stamped": JointState},
            code=SINGULAR,
        ).ready()
        peer.until(lambda: "no correction or alarm: " in node.process.output)
        assert values_of(node.diagnostics())["exceptions"] == "0"
        # Off by the parameter.
        assert not node.received("natural_frequencies")


class TestProcess:
    @pytest.mark.parametrize(("name", "number"), [("defaults", signal.SIGINT), ("fixed", 15)])
    def test_a_signal_ends_the_node(self, fleet, name, number):
        """The last test of this module: the nodes of the others end here."""
        monitor = fleet[name]
        for _ in range(10):
            monitor.send_state()
            monitor.send_wrench(frame="platform" if name == "defaults" else "base_link")
        code = monitor.process.stop(number)
        assert code == 0
        assert "Traceback" not in monitor.process.output
        assert "robot upr_rpu (upr_rpu)" in monitor.process.output
