# SPDX-License-Identifier: Apache-2.0
"""The player over the real middleware: a process of its own publishes, this one subscribes."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from pkm_twin.bags.reader import BagWriter, inspect, open_bag
from pkm_twin.errors import BagError, ParameterError
from pkm_twin.ros import player as player_module
from pkm_twin.ros.player import play
from test.bags.folders import make_folder
from test.nodes.harness import DEADLINE, Domain, end_with_parent
from test.support.waiting import wait_until

# Held as long as this process runs.
OWN = Domain()
DOMAIN = OWN.number
COUNT = 100
PERIOD = 0.005
FIRST = 1_700_000_000 * 10**9
PROGRAM = (
    "import sys; from pkm_twin.ros.player import play; "
    "print(play(sys.argv[1], **eval(sys.argv[2])))"
)


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


class Listener:
    """Collects arrival time, topic and message in a ROS domain of this test's own."""

    def __init__(self, node: Node, executor: SingleThreadedExecutor) -> None:
        self.node = node
        self.executor = executor
        self.heard: list[tuple[float, str, Any]] = []

    def listen(self, kind: Any, topic: str, qos: QoSProfile | int = 1000) -> None:
        def take(message: Any) -> None:
            self.heard.append((time.monotonic(), topic, message))

        self.node.create_subscription(kind, topic, take, qos)

    def of(self, topic: str) -> list[Any]:
        return [message for _, name, message in self.heard if name == topic]

    def spin(self, done: Callable[[], bool], seconds: float = DEADLINE) -> None:
        """Take in messages until ``done``; then a little longer, for what should not come."""
        wait_until(
            done,
            lambda: self.executor.spin_once(timeout_sec=0.05),
            seconds,
            "the player's messages",
        )
        give_up = time.monotonic() + 0.1
        while time.monotonic() < give_up:
            self.executor.spin_once(timeout_sec=0.01)


@pytest.fixture
def listener(monkeypatch: pytest.MonkeyPatch) -> Iterator[Listener]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    node = Node("listener", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    yield Listener(node, executor)
    executor.shutdown()
    node.destroy_node()
    context.try_shutdown()


@pytest.fixture
def player() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start players; whatever still runs at the end of the test is killed."""
    started: list[subprocess.Popen[str]] = []

    def start(path: Path, **options: object) -> subprocess.Popen[str]:
        options = {"wait_for_subscribers": DEADLINE, **options}
        command = [sys.executable, "-c", PROGRAM, str(path), repr(options)]
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=end_with_parent,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def test_order_count_and_timing(bag: Path, listener: Listener, player: Callable[..., Any]) -> None:
    rate = 2.0
    listener.listen(JointState, "joint_states")
    listener.listen(
        String, "note", QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    topics = ["/joint_states", "/note"]
    process = player(bag, rate=rate, topics=topics)
    listener.spin(lambda: process.poll() is not None)
    out, err = process.communicate()
    assert process.returncode == 0, err
    assert "Traceback" not in err
    positions = [message.position[0] for message in listener.of("joint_states")]
    assert positions == [float(index) for index in range(COUNT)]
    # Best effort: some may be lost, none comes twice or late.
    notes = [int(m.data) for m in listener.of("note")]
    assert notes == sorted(set(notes)) and set(notes) <= set(range(0, COUNT, 10))
    # No message leaves before its time.
    assert float(re.findall(r"duration=([0-9.]+)", out)[0]) >= (COUNT - 1) * PERIOD / rate - 1e-6
    assert f"PlayResult(messages={COUNT + COUNT // 10}, loops=1" in out


def test_recorded_durability_is_offered(
    bag: Path, listener: Listener, player: Callable[..., Any]
) -> None:
    """A subscriber that asks for latched messages matches, which a volatile offer would not."""
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    listener.listen(String, "elsewhere", latched)
    process = player(bag, remap={"/latched": "/elsewhere"}, topics=["/latched"])
    listener.spin(lambda: len(listener.of("elsewhere")) == 1)
    assert process.wait(DEADLINE) == 0


def test_clock(bag: Path, listener: Listener, player: Callable[..., Any]) -> None:
    """/clock runs at its rate in bag time and is there before the first message."""
    listener.listen(Clock, "clock")
    listener.listen(JointState, "joint_states")
    process = player(bag, clock=50.0, rate=2.0, topics=["/joint_states"])
    listener.spin(lambda: process.poll() is not None)
    assert process.returncode == 0, process.communicate()[1]
    times = [m.clock.sec * 10**9 + m.clock.nanosec for m in listener.of("clock")]
    assert times[0] == FIRST
    steps = [after - before for before, after in pairwise(times)]
    assert all(abs(step - 40_000_000) <= 1 for step in steps)
    assert len(times) == pytest.approx(13, abs=2)


def test_loop_ends_by_sigint(bag: Path, listener: Listener, player: Callable[..., Any]) -> None:
    listener.listen(JointState, "joint_states")
    listener.listen(Clock, "clock")
    process = player(bag, loop=True, rate=4.0, clock=100.0, topics=["/joint_states"])
    listener.spin(lambda: len(listener.of("joint_states")) > 2 * COUNT + 10)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=DEADLINE)
    assert (process.returncode, "Traceback" in err) == (0, False), err
    assert "interrupted=True" in out
    # A busy machine has the signal some loops later.
    loops = int(out.partition("loops=")[2].partition(",")[0])
    assert loops >= 2
    positions = [message.position[0] for message in listener.of("joint_states")]
    # A listener that is held up misses some; what it has is in order, loop by loop.
    assert set(positions) <= set(map(float, range(COUNT)))
    assert 1 <= sum(after <= before for before, after in pairwise(positions)) <= loops
    times = [m.clock.sec * 10**9 + m.clock.nanosec for m in listener.of("clock")]
    assert 3 <= times.count(FIRST) <= loops + 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_during_a_long_pause(
    tmp_path: Path, listener: Listener, player: Callable[..., Any], number: signal.Signals
) -> None:
    path = tmp_path / "pause.mcap"
    with BagWriter(path) as writer:
        writer.add_topic("/note", "std_msgs/msg/String")
        writer.write("/note", String(data="first"), FIRST)
        writer.write("/note", String(data="an hour later"), FIRST + 3600 * 10**9)
    listener.listen(String, "note")
    process = player(path)
    listener.spin(lambda: len(listener.heard) == 1)
    # An impatient person, or a terminal and a launcher both: handlers interrupt each other.
    for _ in range(5):
        process.send_signal(number)
    _, err = process.communicate(timeout=DEADLINE)
    assert (process.returncode, "Traceback" in err) == (0, False), err


def test_missing_subscribers_are_named(bag: Path, player: Callable[..., Any]) -> None:
    process = player(bag, rate=100.0, wait_for_subscribers=0.2, topics=["/note"], progress=False)
    out, err = process.communicate(timeout=DEADLINE)
    assert process.returncode == 0
    assert err == "no subscriber after 0.2 s: /note\n" and f"messages={COUNT // 10}" in out


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
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
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
    replay = player_module._Replay(opened, publishers, 1e3, player_module._Stop(), pace)
    replay.run(loop=False, update=lambda _seconds, _messages: None)
    sent = [name for what, name in events if what == "sent"]
    assert len(sent) == len(list(opened.messages(list(publishers))))
    for name in publishers:
        first = events.index(("sent", name))
        count = events.count(("acknowledged", name))
        assert count == lockstep
        if lockstep:
            assert events[first + 1] == ("acknowledged", name)
