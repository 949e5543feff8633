# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What delta_dynamics tells beside the torques: load, push, reactions, and what a wrench needs."""

from __future__ import annotations

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, reactions
from test.nodes.harness import SECOND, Maker, Ros, Running, counts_of, stamp_of, values_of
from test.support.robots import load

pytest.importorskip("rclpy")

from geometry_msgs.msg import InertiaStamped, PointStamped, WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, String

from delta_dynamics.feedforward import Torques
from delta_dynamics.nodes.estimates import Estimates
from test.support.robots import often, unsure

ROBOT = load("delta_cu")
PARAMETERS = ("estimate_payload:=true", "observe_wrench:=true", "stale_after:=600.0")
MAKE = Maker(Ros())
REST = np.zeros(3)
OUTPUTS = {
    "/delta_dynamics/payload": InertiaStamped,
    "/delta_dynamics/payload_deviation": InertiaStamped,
    "/delta_dynamics/external_wrench": WrenchStamped,
    "/delta_dynamics/external_effort": JointState,
    "/delta_dynamics/contact": Bool,
    "/delta_dynamics/contact_body": String,
    "/delta_dynamics/contact_point": PointStamped,
}


class Swing:
    """A slow swing at 1 kHz of a machine that carries a load and may be pushed, sent in parts."""

    def __init__(self, peer, mass):
        self.push = 0.0
        self._peer, self._sent = peer, 0
        # No later than the clock, as no more is sent than time goes by.
        self._begin = peer.now() - 10**9
        self._laden = ROBOT.changed(payload={"mass": mass})
        self._middle = ROBOT.inverse(ROBOT.home())
        self._noise = np.random.default_rng(1)

    def send(self):
        """The next 50 ms."""
        ticks = self._sent + np.arange(50)
        time = 1e-3 * ticks
        q = self._middle + 0.05 * np.sin(3.0 * time)[:, None]
        qd = np.broadcast_to(0.15 * np.cos(3.0 * time)[:, None], q.shape)
        qdd = np.broadcast_to(-0.45 * np.sin(3.0 * time)[:, None], q.shape)
        wrench = np.array([self.push, 0.0, 0.0, 0.0, 0.0, 0.0])
        effort = inverse_dynamics(self._laden, q, qd, qdd, wrench)
        effort += 1e-3 * self._noise.normal(size=q.shape)
        for tick, *sample in zip(ticks.tolist(), q, qd, effort, strict=True):
            position, velocity, measured = (values.tolist() for values in sample)
            stamp = self._begin + 1_000_000 * tick
            message = MAKE.joint_state(ROBOT.joint_names, position, velocity, measured, stamp)
            self._peer.send("/joint_states", message)
        self._sent += len(ticks)


def test_a_load_and_a_push_are_told(peer, launch):
    launch("delta_dynamics.nodes.twin", *PARAMETERS)
    peer.talk(JointState, "/joint_states")
    for topic, kind in OUTPUTS.items():
        peer.hear(kind, topic)
    peer.until(peer.matched)
    swing = Swing(peer, 0.4)
    loads, deviations, pushed, events = (
        peer.received(f"/delta_dynamics/{name}")
        for name in ("payload", "payload_deviation", "external_wrench", "contact")
    )
    peer.until(lambda: len(loads) >= 150 and deviations, repeat=swing.send)
    assert loads[-1].inertia.m == pytest.approx(0.4, rel=0.03)
    assert loads[-1].header.frame_id == "platform"
    assert 0.0 < deviations[-1].inertia.m < 0.02
    assert np.isinf(deviations[-1].inertia.com.x)
    turns = 0

    def by_turns():
        """Three seconds with a push, three without: after lost samples it has to learn anew."""
        nonlocal turns
        swing.push = 60.0 * (turns // 60 % 2 == 0)
        turns += 1
        swing.send()

    bodies, points = (peer.received(f"/delta_dynamics/contact_{name}") for name in ("body", "point"))

    def told():
        seen = any(m.wrench.force.x > 50.0 for m in pushed) and any(m.data for m in events)
        return seen and points and any(m.data for m in bodies)

    events.clear()
    peer.until(told, repeat=by_turns)
    known = {"", "platform", "limb I", "limb II", "limb III", "unknown"}
    assert {m.data for m in bodies} <= known
    assert points[-1].header.frame_id == "base_link"
    assert pushed[-1].header.frame_id == "base_link"


class Topics:
    """A node for the estimates alone: everything is wanted, what is published is kept."""

    def __init__(self):
        self.published = {}

    def declare(self, name, default, *_, **__):
        return default if name.startswith("observer") else True

    def create_guarded_publisher(self, topic, *_, **__):
        self.published[topic] = []
        return type("Publisher", (), {"publish": staticmethod(self.published[topic].append)})

    def create_trigger(self, *_):
        pass


@pytest.mark.parametrize("back", often(3600 * SECOND, 1_500_000_000))
def test_a_stream_that_begins_anew_at_earlier_stamps_is_estimated_as_before(back):
    """A bag that loops; steps of time below zero are none."""
    node, rest = Topics(), np.zeros(3)
    estimates = Estimates(node, lambda: ROBOT, ("base_link", "platform"))
    wave = np.array([3.0, 4.0, 5.0])
    counts = []
    t = 1e-3 * np.arange(1500)[:, None]
    away = (
        0.05 * np.sin(wave * t),
        0.05 * wave * np.cos(wave * t),
        -0.05 * wave**2 * np.sin(wave * t),
    )
    moved = ROBOT.inverse(ROBOT.home()) + away[0], *away[1:]
    efforts = inverse_dynamics(ROBOT, *moved)
    for begin in (back + SECOND, SECOND):
        for topic in node.published.values():
            topic.clear()
        for tick, (*motion, effort) in enumerate(zip(*moved, efforts, strict=True)):
            estimates.update(Torques(begin + 1_000_000 * tick, tuple(motion), effort, effort, effort + rest, False))
        counts.append({topic: len(told) for topic, told in node.published.items()})
        assert not node.published["~/contact"]
        pushed = [m.wrench.force.x for m in node.published["~/external_wrench"]]
        assert np.abs(pushed).max() < 1.0
        last = node.published["~/payload"][-1].inertia.m
        assert last == pytest.approx(ROBOT.payload.mass, abs=1e-3)
    # Whether a sum of steps has reached a time hangs on rounding.
    assert counts[1] == pytest.approx(counts[0], abs=1)
    assert counts[0]["~/payload"] > 300
    assert counts[0]["~/external_wrench"] > 1200


def stood(estimates, begin, seconds, effort):
    """A machine at home: samples of these measured efforts, and their end, ns."""
    home, still = ROBOT.inverse(ROBOT.home()), np.zeros(3)
    held = inverse_dynamics(ROBOT, home, still, still)
    rng = np.random.default_rng(2)
    stamps = begin + 1_000_000 * np.arange(round(1000 * seconds))
    for stamp in stamps.tolist():
        measured = held + 1e-3 * rng.normal(size=3) if effort is None else np.array(effort)
        motion = home, still, still
        estimates.update(Torques(stamp, motion, held, held, measured, False, None, still))
    return int(stamps[-1]) + 1_000_000


def test_drives_that_are_off_are_told_and_left_out():
    node = Topics()
    estimates = Estimates(node, lambda: ROBOT, ("base_link", "platform"))
    begin = stood(estimates, stood(estimates, SECOND, 0.5, None), 0.15, (0.0, 0.0, 0.0))
    counts = {topic: len(told) for topic, told in node.published.items()}
    assert estimates.idle
    end = stood(estimates, begin, 0.2, (0.0, 0.0, 0.0))
    assert estimates.diagnose()["drives off or braked"] is True
    assert {topic: len(told) for topic, told in node.published.items()} == counts
    stood(estimates, end, 1.0, None)
    assert not estimates.idle and not estimates.touching
    assert len(node.published["~/external_wrench"]) > counts["~/external_wrench"] + 400


def test_a_file_that_says_nothing_of_its_efforts_is_warned_of():
    told = []
    for name in ("delta_cu", "upr_rpu"):
        estimates = Estimates(Topics(), lambda name=name: load(name), ("base_link", "platform"))
        told.append(estimates.warning())
        assert estimates.diagnose()["model uncertainty"] == "default"
    # One has no uncertainty, the other one of elastic parts alone.
    assert all(told)
    sure = unsure(ROBOT, {"inertia": {"relative": 0.02}})
    estimates = Estimates(Topics(), lambda: sure, ("base_link", "platform"))
    assert not estimates.warning()
    assert estimates.diagnose()["model uncertainty"] == "robot file"


Q = [0.2, 0.3, 0.1]
SINGULAR = """
import delta_dynamics.nodes.twin as node
from pkm_twin.errors import SingularityError
solve = node.reactions
def singular(robot, q, *rest):
    if q[0] == 0.125:
        raise SingularityError("constraints", (), 0.0, 1e-9)
    return solve(robot, q, *rest)
node.reactions = singular
raise SystemExit(node.run(node.NODE))
"""


def test_every_joint_has_its_wrench_and_a_state_without_one_has_its_torque(peer, launch):
    """Of statics, under each joint's name; in a constraint singularity reactions are none."""
    expected = reactions(ROBOT, Q, REST, REST)
    topics = [f"reactions/{name.replace(' ', '_')}" for name in expected.names]
    node = Running(
        peer,
        launch,
        None,
        "reacting",
        "publish_reactions:=true",
        "reactions_rate:=1000.0",
        "recovery_count:=1",
        "base_frame:=floor",
        code=SINGULAR,
        remaps={"joint_states": "states"},
        talk={"states": JointState},
        hear=dict.fromkeys(topics, WrenchStamped) | {"joint_torques": JointState},
    )

    def send(q):
        for _ in range(30):
            node.send("states", MAKE.joint_state(ROBOT.joint_names, q, REST, stamp=node.stamp()))

    node.until(lambda: all(map(node.received, topics)), repeat=lambda: send(Q))
    for topic, wrench in zip(topics, expected.wrenches, strict=True):
        message = node.received(topic)[-1]
        assert message.header.frame_id == "floor" and stamp_of(message)
        force, torque = message.wrench.force, message.wrench.torque
        got = [force.x, force.y, force.z, torque.x, torque.y, torque.z]
        np.testing.assert_allclose(got, wrench, atol=1e-9)
    torques = node.received("joint_torques")
    node.until(
        lambda: "no reactions or estimates: " in node.process.output,
        repeat=lambda: send([0.125, *Q[1:]]),
    )
    torques.clear()
    node.until(lambda: len(torques) > 5, repeat=lambda: send([0.125, *Q[1:]]))
    values = values_of(node.diagnostics())
    assert values["exceptions"] == "0"
    assert "stopped: exception" not in values


HEAD = load("prru")
HEAD_Q = HEAD.inverse(HEAD.home())
WRENCH = [30.0, -20.0, -100.0, 3.0, -2.0, 1.0]
MEASURED = [100.0, 110.0, 120.0]


def test_torque_residual_and_stop(peer, launch):
    """At rest the wrench is borne exactly; without it the stream stops."""
    node = Running(
        peer,
        launch,
        "delta_dynamics.nodes.twin",
        "bearing",
        "mechanism:=prru",
        "use_wrench:=true",
        "missing_wrench_policy:=stop",
        "max_wrench_age:=1.0",
        "stale_after:=5.0",
        "differentiator.window:=4",
        "recovery_count:=1",
        remaps={"joint_states": "states", "wrench": "wrench"},
        talk={"states": JointState, "wrench": WrenchStamped},
        hear=dict.fromkeys(("joint_torques", "torque_residual"), JointState),
    )
    peer.until(peer.matched)
    torques, residuals = map(node.received, ("joint_torques", "torque_residual"))

    def send(wrench=True):
        stamp = peer.now()
        if wrench:
            node.send("wrench", MAKE.wrench(WRENCH, stamp))
        names = HEAD.joint_names
        node.send("states", MAKE.joint_state(names, HEAD_Q, REST, MEASURED, stamp))

    rotation = HEAD.platform(HEAD_Q)[1]
    fixed = np.concatenate((rotation @ WRENCH[:3], rotation @ WRENCH[3:]))
    exact = inverse_dynamics(HEAD, HEAD_Q, REST, REST, fixed)
    assert np.abs(exact - inverse_dynamics(HEAD, HEAD_Q, REST, REST)).max() > 10.0

    def borne():
        """The torque that bears the wrench, and the residual of its stamp."""
        right = {stamp_of(m) for m in torques if np.allclose(m.effort, exact, atol=1e-6)}
        return next((m for m in residuals if stamp_of(m) in right), None)

    residual = node.until(borne, repeat=send)
    assert np.allclose(residual.effort, MEASURED - exact, atol=1e-6)

    def accepted():
        return int(values_of(node.diagnostics())["wrenches accepted"])

    node.until(lambda: accepted() > 3, repeat=send)

    def stopped():
        # A state that was heard before the first wrench is a warning of the same name.
        array = node.diagnostics()
        status = array.status[0]
        return array if status.level == b"\x02" and "no wrench" in status.message else None

    array = node.until(stopped, repeat=lambda: send(wrench=False))
    assert counts_of(array, "stopped")["no wrench"] >= 1
    assert int(values_of(array)["wrenches accepted"]) > 3
    # What is refused is counted, and no wrench.
    node.until(
        lambda: counts_of(node.diagnostics(), "wrenches rejected").get("future stamp"),
        repeat=lambda: node.send("wrench", MAKE.wrench(WRENCH, peer.now() + 600 * SECOND)),
    )
    torques.clear()
    node.until(lambda: torques, repeat=send)
