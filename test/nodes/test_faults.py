# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What the node delta_dynamics does about clocks, silence, bursts, and nodes that do not fit."""

import contextlib
import itertools
import re
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from test.nodes.harness import (
    SECOND,
    Domain,
    Peer,
    counts_of,
    silence_of,
    stamp_of,
    text_of,
    values_of,
)

pytest.importorskip("rclpy", exc_type=ImportError)

import rclpy
from rclpy.duration import Duration
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from trajectory_msgs.msg import JointTrajectory

from test.nodes.twin import (
    MAKE,
    MODULE,
    NAMES,
    ROBOT,
    STEP,
    WINDOW,
    Q,
    count_of,
    launched,
    state,
    trajectory,
)

QUICK = 0.015
"""stale_after of a node that has to stop within 20 ms, s."""
STRICT = "qos_overrides./strict/states.subscription.reliability:=reliable"
OFFER = "qos_overrides./late/joint_torques.publisher.deadline:=7000000000"
LATE = """
import os
import signal
import time
import numpy as np
import delta_dynamics.nodes.twin as node
from delta_dynamics import feedforward
solve = feedforward.inverse_dynamics
def late(robot, q, *rest, **more):
    if q.ndim > 1:
        return np.full(q.shape, np.inf)
    if q[0] == 0.125:
        time.sleep(0.02)
    if q[0] == 0.1125:
        os.kill(os.getpid(), signal.SIGSTOP)
    return solve(robot, q, *rest, **more)
feedforward.inverse_dynamics = late
raise SystemExit(node.run(node.NODE))
"""
SETTINGS = {
    "quick": (f"stale_after:={QUICK}", "on_stop:=zeros"),
    "timed": ("use_sim_time:=true", "stale_after:=5.0", "on_stop:=zeros"),
    "late": ("stale_after:=5.0", "on_stop:=zeros", "acceleration:=differentiate", OFFER),
    "strict": ("stale_after:=1.0", "queue_depth:=10", STRICT),
}


def started(peer, launch, *names):
    """Nodes by name, started at once, each with settings of its own."""
    codes = dict.fromkeys(("late", "strict"), LATE)
    return {name: launched(peer, launch, name, *SETTINGS[name], code=codes.get(name)) for name in names}


def at_pace(twin, count, period=1e-3, **fields):
    """Send joint states one period apart, on time: the stamp of the last, and when it left."""
    begin = time.perf_counter()
    for i in range(count):
        while time.perf_counter() < begin + i * period:
            pass
        stamp = twin.stamp(1)
        twin.send_state(state(stamp, **fields))
    return stamp, time.monotonic()


def is_zeros(message):
    return list(message.effort) == [0.0, 0.0, 0.0]


def running(twin):
    """Wait until a stream of this node is answered."""
    torques = twin.received("joint_torques")
    torques.clear()

    def send():
        assert twin.process.alive(), twin.process.output
        at_pace(twin, 12)

    twin.peer.until(lambda: any(not is_zeros(m) for m in torques), repeat=send)
    return twin


def count_at_rest(quick):
    """The count once the stream has stopped, and nothing more waits."""
    quick.peer.until(lambda: is_zeros(quick.received("joint_torques")[-1]))
    return count_of(quick.at_rest())


AGAIN = WINDOW + 1
"""Samples of a stopped stream that are not answered: the window, then recovery_count is 2."""
SHARED = 1.0
"""How long a process may stand still: shared memory is not kept much longer for it, s."""
LISTENER = """
import rclpy
from sensor_msgs.msg import JointState
rclpy.init()
node = rclpy.create_node("listener")
node.create_subscription(JointState, "/late/joint_torques", lambda message: None, 10)
rclpy.spin(node)
"""


SENDER = """
import rclpy
from test.nodes.harness import Maker, Ros
from test.nodes.twin import Q, state
from sensor_msgs.msg import JointState
rclpy.init()
node = rclpy.create_node("sender")
publisher = node.create_publisher(JointState, "/quick/states", 10)
node.create_timer(1e-3, lambda: publisher.publish(state(node.get_clock().now().nanoseconds)))
rclpy.spin(node)
"""


class Arrivals:
    """Messages of a topic with what the middleware says of each."""

    def __init__(self, peer, topic):
        self.heard = []
        # As deep as anything here is long, and a lifespan so long that none is lost.
        peer.node.create_subscription(
            JointState, topic, lambda m, info: self.heard.append((m, info)), QoSProfile(depth=5000)
        )

    def ages(self):
        """From a state's stamp to the torque's publication, s."""
        stamps = [info["source_timestamp"] - stamp_of(m) for m, info in self.heard]
        return np.array(stamps) / SECOND


@pytest.fixture(scope="module")
def fleet(peer, launch):
    return started(peer, launch, "quick", "timed", "late", "strict")


def lost_of(array):
    return int(values_of(array)["lost: joint_states"])


def lost_while_it_stands(twin, count):
    """How many of so many samples are lost that come while the node stands still, and its time."""
    before = twin.even()
    at_pace(twin, 1)
    began = time.monotonic()
    twin.process.process.send_signal(signal.SIGSTOP)
    try:
        at_pace(twin, count)
    finally:
        twin.process.process.send_signal(signal.SIGCONT)
    stood = time.monotonic() - began
    told = twin.balance(count_of(before) + 1 + count)
    lost = lost_of(told[-1]) - lost_of(before)
    lines = [re.search(r"(\d+) messages lost in the last second", text_of(a)) for a in told]
    assert sum(int(line[1]) for line in lines if line) == lost
    return lost, stood


@pytest.fixture
def quick(fleet):
    return running(fleet["quick"])


class TestSilence:
    def test_a_silent_stream_stops_and_not_before_its_time(self, quick):
        torques = quick.received("joint_torques")
        for _ in range(5):
            running(quick)
            quick.peer.until(lambda: is_zeros(torques[-1]))
            last = next(m for m in reversed(torques) if not is_zeros(m))
            # A stop carries the time at which it is sent.
            assert stamp_of(torques[-1]) - stamp_of(last) > QUICK * SECOND

    def test_joint_states_of_another_machine_do_not_keep_a_stream_alive(self, fleet):
        """And while it is stopped, the status has the reason of the stop and of the rejects."""
        twin = running(fleet["strict"])

        def foreign():
            twin.send_state(MAKE.joint_state(("a", "b", "c"), Q, Q, stamp=twin.stamp()))

        with twin.changed(stale_after=0.3, trip_count=1000):
            twin.peer.clear_topic("/diagnostics")
            (status,) = twin.peer.until(
                lambda: [
                    array.status[0]
                    for array in twin.peer.told("/strict")[-1:]
                    if "rejected since then" in array.status[0].message
                ],
                repeat=foreign,
                every=0.02,
            )
        assert status.level == b"\x02"
        assert status.message.startswith("stopped: stale input")
        assert "missing joint: joint 'arm_1' is missing" in status.message


class TestLoad:
    def test_a_burst_leaves_nothing_old_and_every_loss_is_counted(self, quick):
        arrivals = Arrivals(quick.peer, "/quick/joint_torques")
        quick.peer.until(lambda: quick.peer.node.count_subscribers("/quick/joint_torques") >= 2)
        running(quick)
        before = count_at_rest(quick)
        arrivals.heard.clear()
        torques = quick.received("joint_torques")
        sent = 0
        for _ in range(3):
            last, _ = at_pace(quick, 2000, 1e-4)
            sent += 2000

            def again():
                nonlocal sent
                sent += 12
                at_pace(quick, 12)

            quick.peer.until(
                lambda last=last: any(stamp_of(m) > last and not is_zeros(m) for m in torques),
                repeat=again,
            )
        quick.balance(before + sent)
        ages = arrivals.ages()
        assert len(ages) > 0
        # Age is checked just before; a machine that does other things too is late now and then.
        assert np.median(ages) <= QUICK
        # Every torque has the middleware's sequence number.
        numbers = [info["publication_sequence_number"] for _, info in arrivals.heard]
        assert (np.diff(numbers) > 0).all()

    @pytest.mark.parametrize(("name", "sent", "least", "most"), [("late", 100, 0, 0), ("strict", 400, 300, 400)])
    def test_a_queue_holds_what_came_while_the_node_stood(self, fleet, name, sent, least, most):
        """By default a tenth of a second at 1 kHz and more; what it does not hold is counted.

        A queue of ten loses nearly all of 400.
        """
        twin = running(fleet[name])
        # A busy machine makes it stand longer than it was asked to, and nothing shall expire.
        lost, stood = 0, SHARED
        with twin.changed(stale_after=60.0):
            while stood >= SHARED:
                lost, stood = lost_while_it_stands(twin, sent)
        assert least <= lost <= most

    def test_a_subscriber_that_stands_still_holds_nobody_up(self, fleet, launch):
        twin = running(fleet["late"])
        node = twin.peer.node
        heard = node.count_subscribers("/late/joint_torques")
        listener = launch(None, code=LISTENER)
        twin.peer.until(lambda: node.count_subscribers("/late/joint_torques") > heard)
        listener.process.send_signal(signal.SIGSTOP)
        try:
            # Ten times as many as the queue of the one that stands still holds.
            torques = twin.received("joint_torques")
            torques.clear()
            twin.peer.until(lambda: len(torques) > 100, repeat=lambda: at_pace(twin, 5))
        finally:
            listener.process.send_signal(signal.SIGCONT)

    def test_no_torque_leaves_that_is_older_than_its_stream_may_be(self, fleet):
        """The process stands still between a state and its torque."""
        strict = running(fleet["strict"])
        torques = strict.received("joint_torques")
        stamp, _ = at_pace(strict, 1, position=(0.1125, 0.2, 0.3))
        folder = Path(f"/proc/{strict.process.process.pid}/stat")
        strict.peer.until(lambda: folder.read_text().rsplit(")", 1)[1].split()[0] == "T")
        strict.peer.until(lambda: strict.peer.now() > stamp + 1.1 * SECOND)
        strict.process.process.send_signal(signal.SIGCONT)
        strict.diagnostics(lambda a: "late answer" in counts_of(a, "joint states rejected"))
        assert stamp not in map(stamp_of, torques)

    def test_torques_expire_when_their_stream_would_be_stale(self, quick):
        node = quick.peer.node

        def offered(topic):
            quick.peer.until(lambda: node.count_publishers(topic) == 1)
            profile = node.get_publishers_info_by_topic(topic)[0].qos_profile
            return profile.lifespan.nanoseconds, profile.deadline.nanoseconds

        for topic in ("joint_torques", "commands"):
            assert offered(f"/quick/{topic}") == (QUICK * SECOND, QUICK * SECOND)
        assert offered("/late/joint_torques") == (5 * SECOND, 7 * SECOND)

    def test_answers_slower_than_the_stream_are_told(self, fleet):
        late = running(fleet["late"])
        line = "callbacks took longer than their period"

        def told():
            return any(
                line in text_of(array) and float(values_of(array)["longest callback (ms): joint_states"]) >= 20.0
                for array in late.peer.received("/diagnostics")
                if array.status[0].name == "/late"
            )

        # One right after the other: their period is short however slow this machine is.
        late.peer.until(told, repeat=lambda: late.stream(4, position=(0.125, 0.2, 0.3)))

    def test_a_trajectory_that_overflows_the_model_stops_the_stream(self, fleet):
        late = fleet["late"]
        # Silence shall not stop the stream first, nor good samples that wait end the stop.
        with late.changed(stale_after=60.0):
            running(late)
            assert late.set(recovery_count=1000).successful
            before = counts_of(late.diagnostics(), "stopped")
            torques = late.received("joint_torques")
            torques.clear()
            rows = [tuple(Q)] * 3
            at_pace(late, 50, position=(0.125, 0.2, 0.3))
            late.peer.send(
                "/late/joint_trajectory",
                MAKE.trajectory(NAMES, [0, STEP, SECOND], rows, stamp=late.begin()),
            )
            late.peer.until(lambda: any(map(is_zeros, torques)))
            array = late.at_rest()
        assert late.set(recovery_count=2).successful
        assert array.status[0].level == b"\x02"
        assert array.status[0].message.startswith("stopped: non-finite result")
        assert counts_of(array, "stopped") == before | {"non-finite result": 1}
        # Nothing after it, however many samples waited.
        assert [is_zeros(m) for m in torques].index(True) == len(torques) - 1
        assert late.received("joint_trajectory_ff") == []


class TestClocks:
    start = 1_000 * SECOND

    @pytest.fixture
    def timed(self, fleet):
        """The node on a clock that this side sends."""
        twin = fleet["timed"]
        if "/clock" not in twin.peer._publishers:
            twin.peer.talk(Clock, "/clock")
            twin.peer.until(twin.peer.matched, 90.0)
        return twin

    def tick(self, timed, now):
        """Bring the node's clock there, told by its next diagnostics."""
        clock, told = Clock(clock=MAKE.header(now).stamp), timed.peer.received("/diagnostics")
        before = len(told)
        timed.peer.until(
            lambda: any(stamp_of(a) == now for a in told[before:] if a.status[0].name == "/timed"),
            repeat=lambda: timed.peer.send("/clock", clock),
        )

    def stream(self, timed, begin, count):
        """States of a motion at constant acceleration: the stamps that are answered."""
        torques = timed.received("joint_torques")
        torques.clear()
        stamps = [begin + i * STEP for i in range(count)]
        for i, stamp in enumerate(stamps):
            t = i / 1000
            q, qd = Q + 0.5 * t + t * t, [0.5 + 2 * t] * 3
            timed.send_state(state(stamp, position=q, velocity=qd))
        timed.peer.until(lambda: any(stamp_of(m) == stamps[-1] for m in torques))
        last = torques[-1]
        exact = inverse_dynamics(ROBOT, q, qd, [2.0] * 3)
        assert np.abs(np.array(last.effort) - exact).max() < 1e-6
        return [(stamp_of(m) - begin) // STEP for m in torques]

    def test_no_torque_is_made_across_a_jump_of_the_clock(self, fleet):
        timed = fleet["timed"]
        timed.peer.talk(Clock, "/clock")
        timed.peer.until(timed.peer.matched)
        # What is sent before the node has found this side is lost: it is greeted, at a later time.
        later = self.start + SECOND
        self.tick(timed, later)
        greetings = (later - SECOND // 2 + i * STEP for i in itertools.count())
        timed.peer.until(
            lambda: timed.received("joint_torques"),
            repeat=lambda: timed.send_state(state(next(greetings))),
        )
        self.tick(timed, self.start)
        assert self.stream(timed, self.start, 20) == list(range(WINDOW - 1, 20))
        # Back, as when a bag begins anew: the window is filled anew. By as little as stamps may be
        # ahead, then by more.
        for back in (SECOND // 20, 100 * SECOND):
            begin = self.start - back
            self.tick(timed, begin)
            assert self.stream(timed, begin, 20) == list(range(WINDOW - 1, 20))
        assert counts_of(timed.diagnostics(), "stopped") == {}
        # Forward, as when a player seeks: a stop, its zeros, then the same and recovery_count.
        torques = timed.received("joint_torques")
        torques.clear()
        self.tick(timed, self.start)
        timed.peer.until(lambda: torques)
        assert [is_zeros(m) for m in torques] == [True]
        array = timed.diagnostics(lambda a: "/clock stands still" in text_of(a))
        assert array.status[0].message.startswith("stopped: clock jump: the clock jumped forward")
        assert counts_of(array, "stopped") == {"clock jump": 1}
        assert self.stream(timed, self.start, 20) == list(range(AGAIN - 1, 20))

    def test_a_clock_that_is_no_time_is_refused(self, timed):
        self.tick(timed, self.start + SECOND)
        for sec, nanosec in ((-1, 0), (-(2**31), 5), (5, SECOND), (5, 2**32 - 1)):
            clock = Clock()
            clock.clock.sec, clock.clock.nanosec = sec, nanosec
            timed.peer.send("/clock", clock)
        array = timed.diagnostics(lambda a: int(values_of(a)["clock messages rejected"]) >= 1)
        assert "messages of /clock had an invalid time" in text_of(array)
        assert stamp_of(array) == self.start + SECOND
        assert values_of(array)["exceptions"] == "0"

    def test_a_stream_that_ends_is_stopped_while_the_clock_stands(self, timed):
        begin = self.start + 2 * SECOND
        self.tick(timed, begin)
        with timed.changed(stale_after=0.5):
            self.stream(timed, begin, 20)
            array = timed.diagnostics(lambda a: "stale input" in counts_of(a, "stopped"))
        assert silence_of(array) >= 0.5


class TestNeighbours:
    def told(self, quick, condition):
        """Wait until the diagnostics' message is so."""
        quick.diagnostics(lambda a: condition(text_of(a)))

    @contextlib.contextmanager
    def offering(self, twin, kind, topic, reliability):
        """This side's publisher is of that reliability for a while."""
        before = twin.peer._publishers[topic]
        twin.peer.talk(kind, topic, QoSProfile(depth=10, reliability=reliability))
        try:
            yield
        finally:
            twin.peer.node.destroy_publisher(twin.peer._publishers[topic])
            twin.peer._publishers[topic] = before

    @pytest.mark.parametrize("reliability", [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT])
    def test_publishers_of_both_kinds_are_answered(self, fleet, reliability):
        with self.offering(fleet["late"], JointState, "/late/states", reliability):
            running(fleet["late"])

    def test_trajectories_of_a_best_effort_publisher_are_answered(self, fleet):
        twin, topic = fleet["quick"], "/quick/joint_trajectory"
        answers = twin.received("joint_trajectory_ff")
        answers.clear()
        with self.offering(twin, JointTrajectory, topic, ReliabilityPolicy.BEST_EFFORT):
            twin.until(
                lambda: answers,
                repeat=lambda: twin.send("joint_trajectory", trajectory(stamp=twin.begin())),
            )
        # The reliable one as before.
        assert twin.ask(trajectory(stamp=twin.begin()))

    def test_a_publisher_that_does_not_fit_is_told_while_it_is_there(self, fleet):
        strict = fleet["strict"]
        node = strict.peer.node
        worst = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        publisher = node.create_publisher(JointState, "/strict/states", worst)
        line = "another node on joint_states has an incompatible QoS: reliability"
        self.told(strict, lambda text: line in text)
        node.destroy_publisher(publisher)
        self.told(strict, lambda text: line not in text)
        assert int(values_of(strict.diagnostics())["incompatible QoS"]) == 1

    def test_a_publisher_of_another_type_is_told(self, fleet):
        strict = fleet["strict"]
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=strict.peer.context.get_domain_id())
        stranger = rclpy.create_node("stranger", context=context)
        try:
            # One participant has one type a topic.
            stranger.create_publisher(Bool, "/strict/states", QoSProfile(depth=1))
            line = "another node on joint_states has an incompatible message type: std_msgs/msg/Bool"
            self.told(strict, lambda text: line in text)
        finally:
            stranger.destroy_node()
            rclpy.try_shutdown(context=context)
        self.told(strict, lambda text: line not in text)

    def test_a_subscriber_that_does_not_fit_is_told(self, quick):
        node = quick.peer.node
        hasty = QoSProfile(depth=10, deadline=Duration(seconds=QUICK / 2))
        listener = node.create_subscription(JointState, "/quick/joint_torques", lambda message: None, hasty)
        line = "another node on ~/joint_torques has an incompatible QoS: deadline"
        self.told(quick, lambda text: line in text)
        node.destroy_subscription(listener)
        self.told(quick, lambda text: line not in text)

    def test_a_node_of_the_same_name_is_told(self, quick, launch):
        remap = ("-r", "__node:=quick", "-r", "joint_states:=/elsewhere")
        namesake = launch(MODULE, arguments=remap)
        try:
            line = "2 nodes have this name"
            quick.peer.until(lambda: line in text_of(quick.diagnostics()))
        finally:
            namesake.close()
        self.told(quick, lambda text: line not in text)

    def test_another_domain_is_another_world(self, quick):
        other = Domain()
        peers = [Peer(other), Peer(other)]
        stranger, control = peers
        try:
            stranger.talk(JointState, "/quick/states")
            control.hear(JointState, "/quick/states")
            stranger.hear(JointState, "/quick/joint_torques")

            def send():
                stranger.send("/quick/states", state(stranger.now()))

            # The same messages do come through within the other domain ...
            control.until(lambda: len(control.received("/quick/states")) >= 20, repeat=send)
            # ... while this one is alive.
            before = count_at_rest(quick)
            for _ in range(20):
                send()
            names = {name for name, _ in stranger.node.get_node_names_and_namespaces()}
            assert names == {"peer"}
            assert stranger.received("/quick/joint_torques") == []
            assert stranger._publishers["/quick/states"].get_subscription_count() == 1
            at_pace(quick, 10)
            quick.balance(before + 10)
        finally:
            for peer in peers:
                peer.close()
            other.close()

    def test_a_killed_publisher_stops_the_stream(self, quick, launch):
        torques = quick.received("joint_torques")
        sender = launch(None, code=SENDER)
        torques.clear()
        quick.peer.until(lambda: sum(not is_zeros(m) for m in torques) > 20)
        sender.process.kill()
        sender.wait()
        quick.peer.until(lambda: is_zeros(torques[-1]))
        array = quick.diagnostics(lambda a: a.status[0].message.startswith("stopped: stale"))
        assert array.status[0].level == b"\x02"
