# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The player over the real middleware: a process of its own publishes, this one subscribes."""

from __future__ import annotations

import re
import signal
import sys
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from pkm_twin.bags.reader import BagWriter, inspect, open_bag
from pkm_twin.errors import BagError, ParameterError
from pkm_twin.ros import player as player_module
from pkm_twin.ros.player import play
from test.bags.folders import make_folder
from test.nodes.harness import DEADLINE, Command, Domain, Forked, Peer, Process

COUNT = 100
PERIOD = 0.005
FIRST = 1_700_000_000 * 10**9
PROGRAM = "import sys; from pkm_twin.ros.player import play; print(play(sys.argv[1], **eval(sys.argv[2])))"
MANY = QoSProfile(depth=1000)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second of joint states at 200 Hz, every tenth with a note, and a latched note."""
    path = tmp_path_factory.mktemp("bags") / "second.mcap"
    with BagWriter(path) as writer:
        writer.add_topic("/joint_states", "sensor_msgs/msg/JointState")
        writer.add_topic("/note", "std_msgs/msg/String", reliability="best_effort", depth=100)
        writer.add_topic("/latched", "std_msgs/msg/String", durability="transient_local", depth=1)
        writer.write("/latched", String(data="latched"), FIRST)
        for index in range(COUNT):
            now = FIRST + round(index * PERIOD * 1e9)
            writer.write("/joint_states", JointState(name=["a"], position=[float(index)]), now)
            if index % 10 == 0:
                writer.write("/note", String(data=str(index)), now)
    return path


@pytest.fixture
def player(domain: Domain) -> Iterator[Callable[..., Process]]:
    """Start players; whatever still runs at the end of the test is ended."""
    started: list[Process] = []

    def start(path: Path, fresh: bool = False, **options: object) -> Process:
        options = {"wait_for_subscribers": DEADLINE, **options}
        words = ["-c", PROGRAM, str(path), repr(options)]
        started.append(Command(domain, [sys.executable, *words]) if fresh else Forked(domain, words))
        return started[-1]

    yield start
    for process in started:
        process.close()


def clocks(peer: Peer) -> list[int]:
    """Times of /clock, ns."""
    return [m.clock.sec * 10**9 + m.clock.nanosec for m in peer.received("/clock")]


def positions(peer: Peer) -> list[float]:
    return [message.position[0] for message in peer.received("/joint_states")]


def test_order_count_and_timing(bag: Path, peer: Peer, player: Callable[..., Process]) -> None:
    rate = 2.0
    peer.hear(JointState, "/joint_states", MANY)
    peer.hear(String, "/note", QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT))
    process = player(bag, rate=rate, topics=["/joint_states", "/note"])
    peer.until(lambda: not process.alive() and len(positions(peer)) == COUNT)
    assert process.wait() == 0, process.output
    assert "Traceback" not in process.output
    assert positions(peer) == [float(index) for index in range(COUNT)]
    # Best effort: some may be lost, none comes twice or late.
    notes = [int(m.data) for m in peer.received("/note")]
    assert notes == sorted(set(notes)) and set(notes) <= set(range(0, COUNT, 10))
    # No message leaves before its time.
    took = float(re.findall(r"duration=([0-9.]+)", process.output)[0])
    assert took >= (COUNT - 1) * PERIOD / rate - 1e-6
    assert f"PlayResult(messages={COUNT + COUNT // 10}, loops=1" in process.output


def test_recorded_durability_is_offered(bag: Path, peer: Peer, player: Callable[..., Process]) -> None:
    """A subscriber that asks for latched messages matches, which a volatile offer would not."""
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    peer.hear(String, "/elsewhere", latched)
    process = player(bag, remap={"/latched": "/elsewhere"}, topics=["/latched"])
    peer.until(lambda: len(peer.received("/elsewhere")) == 1)
    assert process.wait() == 0


def test_clock(bag: Path, peer: Peer, player: Callable[..., Process]) -> None:
    """/clock runs at its rate in bag time and is there before the first message."""
    peer.hear(Clock, "/clock", MANY)
    peer.hear(JointState, "/joint_states", MANY)
    process = player(bag, clock=50.0, rate=2.0, topics=["/joint_states"])
    peer.until(lambda: not process.alive() and len(positions(peer)) == COUNT)
    assert process.wait() == 0, process.output
    times = clocks(peer)
    assert times[0] == FIRST
    assert all(abs(after - before - 40_000_000) <= 1 for before, after in pairwise(times))
    assert len(times) == pytest.approx(13, abs=2)


def test_loop_ends_by_sigint(bag: Path, peer: Peer, player: Callable[..., Process]) -> None:
    peer.hear(JointState, "/joint_states", MANY)
    peer.hear(Clock, "/clock", MANY)
    process = player(bag, fresh=True, loop=True, rate=4.0, clock=100.0, topics=["/joint_states"])
    peer.until(lambda: len(positions(peer)) > 2 * COUNT + 10)
    assert process.stop() == 0
    out = process.output
    assert "interrupted=True" in out and "Traceback" not in out
    # A busy machine has the signal some loops later.
    loops = int(out.partition("loops=")[2].partition(",")[0])
    assert loops >= 2
    # A listener that is held up misses some; what it has is in order, loop by loop.
    found = positions(peer)
    assert set(found) <= set(map(float, range(COUNT)))
    assert 1 <= sum(after <= before for before, after in pairwise(found)) <= loops
    assert 3 <= clocks(peer).count(FIRST) <= loops + 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_during_a_long_pause(
    tmp_path: Path, peer: Peer, player: Callable[..., Process], number: signal.Signals
) -> None:
    path = tmp_path / "pause.mcap"
    with BagWriter(path) as writer:
        writer.add_topic("/pause", "std_msgs/msg/String")
        writer.write("/pause", String(data="first"), FIRST)
        writer.write("/pause", String(data="an hour later"), FIRST + 3600 * 10**9)
    peer.hear(String, "/pause")
    process = player(path, fresh=True)
    peer.until(lambda: peer.received("/pause"))
    # An impatient person, or a terminal and a launcher both: handlers interrupt each other.
    assert process.stop(number, times=5) == 0
    assert "Traceback" not in process.output


def test_missing_subscribers_are_named(bag: Path, player: Callable[..., Process]) -> None:
    process = player(
        bag, rate=100.0, wait_for_subscribers=0.2, topics=["/note"], progress=False, remap={"/note": "/nobody"}
    )
    assert process.wait() == 0, process.output
    assert "no subscriber after 0.2 s: /nobody\n" in process.output
    assert f"messages={COUNT // 10}" in process.output


def test_refusals(bag: Path, tmp_path: Path) -> None:
    for options in ({"rate": 0.0}, {"rate": float("nan")}, {"clock": -1.0}):
        with pytest.raises(ParameterError):
            play(bag, **options)  # type: ignore[arg-type]
    with pytest.raises(BagError, match=r"no topic /x; topics: /joint_states"):
        play(bag, topics=["/x"])
    with pytest.raises(BagError, match="cannot remap /x"):
        play(bag, remap={"/x": "/y"})


@pytest.mark.parametrize(
    ("kind", "definition", "text"),
    [
        ("std_msgs/msg/String", "string text", "recorded with other fields"),
        ("nobody_msgs/msg/Nothing", "string data", "is not installed"),
    ],
)
def test_types_that_do_not_fit(tmp_path: Path, kind: str, definition: str, text: str) -> None:
    with BagWriter(tmp_path / "t.mcap") as writer:
        writer.add_topic("/a", kind, definition=definition)
    with pytest.raises(BagError, match=text) as caught:
        play(tmp_path / "t.mcap")
    assert caught.value.reason == "type"


def test_log_times_that_no_clock_can_tell_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "late.mcap"
    with BagWriter(path) as writer:
        writer.add_topic("/note", "std_msgs/msg/String")
        writer.write("/note", String(data="late"), 2**31 * 10**9)
    with pytest.raises(BagError, match="do not fit a /clock"):
        play(path, clock=100.0, progress=False)


@pytest.mark.parametrize("mode", ["", "MESSAGE", "FILE"])
def test_a_folder_is_played_whole(
    bag: Path, tmp_path: Path, domain: Domain, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain.number))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    folder = make_folder(tmp_path / "rec", bag, mode=mode)
    found = play(folder, rate=100.0, wait_for_subscribers=0.0, progress=False)
    assert found.messages == inspect(bag).message_count


@pytest.mark.parametrize("lockstep", [True, False])
def test_in_lockstep_a_topics_first_message_is_acknowledged_before_the_next_goes_out(
    bag: Path, monkeypatch: pytest.MonkeyPatch, lockstep: bool
) -> None:
    events: list[tuple[str, str]] = []

    class Recorded:
        def __init__(self, name: str) -> None:
            self.name = name

        def publish(self, _: bytes) -> None:
            events.append(("sent", self.name))

    monkeypatch.setattr(
        player_module,
        "_await_acknowledged",
        lambda publisher, _: events.append(("acknowledged", publisher.name)),
    )
    opened = open_bag(bag)
    publishers = {name: Recorded(name) for name in opened.report.topics}
    pace = (lambda _: None) if lockstep else None
    replay = player_module._Replay(opened, publishers, 1e3, player_module._StopFlag(), pace)
    replay.run(loop=False, update=lambda _seconds, _messages: None)
    sent = [name for what, name in events if what == "sent"]
    assert len(sent) == len(list(opened.messages(list(publishers))))
    for name in publishers:
        first = events.index(("sent", name))
        count = events.count(("acknowledged", name))
        assert count == lockstep
        if lockstep:
            assert events[first + 1] == ("acknowledged", name)
