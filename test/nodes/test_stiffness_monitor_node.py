# SPDX-License-Identifier: Apache-2.0
"""The node stiffness_monitor over the real middleware, as a process of its own."""

import math
import signal

import numpy as np
import pytest

from stiffness_monitor import compliance, strain_energy
from test.nodes.harness import (
    SECOND,
    Maker,
    Ros,
    counts_of,
    one_line_refusal,
    stamp_of,
    text_of,
    values_of,
)
from test.support.robots import load

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped, WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String

MODULE = "stiffness_monitor.node"
ROBOT = load("upr_rpu")
NAMES = ROBOT.joint_names
POSE = np.array([-0.7, 0.2, -0.15])
Q = ROBOT.inverse(POSE)
WRENCH = (300.0, -200.0, -1000.0, 30.0, -20.0, 10.0)
MAKE = Maker(Ros())
STEP = SECOND // 1000
OUTPUTS = {
    "compliance": Float64MultiArray,
    "strain_energy": DiagnosticArray,
    "dominant_element": String,
    "deflection": TransformStamped,
}


class Monitor:
    """A running node and its topics, seen from this side."""

    def __init__(self, peer, process, name):
        self.peer, self.process, self.name = peer, process, name
        peer.talk(JointState, f"/{name}/states")
        peer.talk(WrenchStamped, f"/{name}/wrench")
        for topic, kind in OUTPUTS.items():
            peer.hear(kind, f"/{name}/{topic}")
        self._last = 0

    def received(self, topic):
        return self.peer.received(f"/{self.name}/{topic}")

    def stamp(self):
        """The present, and later than every stamp before."""
        self._last = max(self.peer.now(), self._last + STEP)
        return self._last

    def send_state(self, q=Q, stamp=None):
        stamp = self.stamp() if stamp is None else stamp
        order = [2, 0, 1]
        names, values = [NAMES[i] for i in order], [float(q[i]) for i in order]
        self.peer.send(f"/{self.name}/states", MAKE.joint_state(names, values, stamp=stamp))
        return stamp

    def send_wrench(self, values=WRENCH, frame="platform", stamp=None):
        stamp = self.stamp() if stamp is None else stamp
        self.peer.send(f"/{self.name}/wrench", MAKE.wrench(map(float, values), stamp, frame))
        return stamp

    def ready(self):
        def repeat():
            assert self.process.alive(), self.process.output
            self.send_state()
            self.send_wrench()

        self.peer.until(lambda: all(self.received(t) for t in OUTPUTS), repeat=repeat)
        return self

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
            if not both or not all(self.received(topic) for topic in OUTPUTS):
                return None
            answers = {topic: self.received(topic)[-1] for topic in OUTPUTS}
            stamp = max(both)
            return answers | {"strain_energy": energies[stamp], "deflection": deflections[stamp]}

        stamps = []
        return self.peer.until(answered, repeat=ask)

    def diagnostics(self, condition=lambda array: True):
        return self.peer.diagnostics(f"/{self.name}", condition)

    def rejects(self):
        return counts_of(self.diagnostics(), "wrenches rejected")


@pytest.fixture(scope="module")
def fleet(peer, launch):
    """The node with its defaults, and one that takes wrenches in the base frame."""
    peer.hear(DiagnosticArray, "/diagnostics")
    options = {
        "defaults": ("max_state_age:=1.0",),
        "fixed": ("wrench_frame:=base_link", "accept_empty_frame:=true", "max_state_age:=1.0"),
    }
    monitors = {}
    for name, parameters in options.items():
        pairs = {
            "__node": name,
            "joint_states": f"/{name}/states",
            "wrench": f"/{name}/wrench",
        }
        remap = [part for pair in pairs.items() for part in ("-r", ":=".join(pair))]
        process = launch(MODULE, *parameters, arguments=remap, fresh=True)
        monitors[name] = Monitor(peer, process, name)
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


def turned(wrench=WRENCH):
    """A wrench in the platform's axes, told in fixed ones."""
    rotation = ROBOT.rotation(POSE)
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
    def test_the_energy_names_every_element_the_pose_and_the_frame(self, fleet, name):
        frame = "platform" if name == "defaults" else "base_link"
        wrench = turned() if name == "defaults" else np.array(WRENCH)
        answers = fleet[name].answer(WRENCH, frame)
        (status,) = answers["strain_energy"].status
        expected = strain_energy(ROBOT, POSE, wrench)
        values = {pair.key: pair.value for pair in status.values}
        assert set(values) == {*ROBOT.element_names, "total_energy", "tie", "frame", "z"} | {
            "beta",
            "gamma",
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

    @pytest.mark.parametrize("name", ["defaults", "fixed"])
    def test_the_deflection_is_a_transform_in_the_platforms_axes(self, fleet, name):
        frame = "platform" if name == "defaults" else "base_link"
        wrench = turned() if name == "defaults" else np.array(WRENCH)
        message = fleet[name].answer(WRENCH, frame)["deflection"]
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

    def test_an_empty_frame_is_taken_where_allowed(self, fixed):
        named = fixed.answer(WRENCH, "base_link")["deflection"].transform
        assert fixed.answer(WRENCH, "")["deflection"].transform == named


class TestRejects:
    def test_each_bad_wrench_is_counted_and_the_next_good_one_is_answered(self, platform):
        bad = [
            ("frame", {"frame": ""}),
            ("frame", {"frame": "tool0"}),
            ("frame", {"frame": "base_link"}),
            ("not finite", {"values": (math.nan, 0, 0, 0, 0, 0)}),
            ("not finite", {"values": (0, 0, 0, 0, 0, math.inf)}),
            ("bounds", {"values": (1e300, 0, 0, 0, 0, 0)}),
            ("bounds", {"values": (0, 5e-324, 0, 0, 0, 0)}),
            ("zero stamp", {"stamp": 0}),
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
            lambda a: (
                sum(counts_of(a, "wrenches rejected").values()) >= sum(before.values()) + len(bad)
            )
        )
        assert counts_of(array, "wrenches rejected") == expected
        assert array.status[0].level == b"\x01"
        assert "last reject: no pose" in text_of(array)

    def test_no_pose_before_a_joint_state_and_too_far_from_one(self, peer, launch):
        peer.hear(DiagnosticArray, "/diagnostics")
        remap = ("-r", "__node:=young", "-r", "joint_states:=/young/states")
        process = launch(MODULE, arguments=(*remap, "-r", "wrench:=/young/wrench"))
        young = Monitor(peer, process, "young")
        peer.until(peer.matched)

        def rejected(count):
            return lambda a: counts_of(a, "wrenches rejected").get("no pose", 0) >= count

        def until_rejected(count):
            peer.until(lambda: process.output.count("no pose") >= 1, repeat=young.send_wrench)
            return young.diagnostics(rejected(count))

        array = until_rejected(1)
        assert "last reject: no pose: no joint state has arrived" in text_of(array)
        young.answer()
        far = young.peer.now() - SECOND // 2
        young.peer.send("/young/wrench", MAKE.wrench(WRENCH, far, "platform"))
        array = young.diagnostics(lambda a: "is 0." in text_of(a))
        assert "no pose: the nearest joint state" in text_of(array)
        assert "allowed 0.1 s" in text_of(array)

    @pytest.mark.parametrize(
        ("parameters", "named"),
        [
            (["wrench_fram:=tool0"], "did you mean 'wrench_frame'"),
            (["max_state_age:=.nan"], "max_state_age: nan"),
            (["wrench_frame:=''"], "wrench_frame: ''"),
            (["accept_empty_frame:=1"], "accept_empty_frame: 1"),
        ],
    )
    def test_a_bad_configuration_is_refused_in_one_line(self, refused, parameters, named):
        line = one_line_refusal(refused(MODULE, *parameters))
        assert line.startswith("cannot start: ")
        assert named in line


class TestProcess:
    def test_diagnostics_count_what_came(self, platform):
        before = int(values_of(platform.diagnostics())["wrenches answered"])
        platform.answer()
        array = platform.diagnostics(lambda a: int(values_of(a)["wrenches answered"]) > before)
        assert array.status[0].hardware_id == "upr_rpu"
        assert values_of(array)["exceptions"] == "0"

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
