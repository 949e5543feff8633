# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The demonstration on a machine that leaves its processes waiting."""

import dataclasses
import os
import signal
import threading
import time
from contextlib import contextmanager

import pytest

from test.nodes.harness import REPOSITORY

pytest.importorskip("rclpy", exc_type=ImportError)

from rich.console import Console

from pkm_twin.bags.reader import BagWriter, inspect, read_messages
from pkm_twin.demo import recorder as demo_recorder
from pkm_twin.demo import run as demo
from pkm_twin.errors import PkmTwinError
from pkm_twin.messages.stamps import stamp_of

SAMPLES = 1500
FILLING = 30
"""Samples until the differentiation has its window full."""


@pytest.fixture
def executor(peer, domain, monkeypatch):
    """Of a node in a domain which the demonstration's processes join."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain.number))
    return peer.executor


@pytest.fixture
def beginning(tmp_path):
    """The first samples of a recorded bag."""
    source = REPOSITORY / "bags" / "delta_cu_pick_and_place.mcap"
    path = tmp_path / "beginning.mcap"
    topics = inspect(source).topics
    with BagWriter(path) as writer:
        for name in ("/joint_states", "/delta_dynamics/joint_trajectory"):
            writer.add_topic(name, topics[name].type)
        count = 0
        for message in read_messages(source, list(demo.STAGES[0].inputs)):
            writer.write(message.topic, message.data, message.log_time)
            count += message.topic == "/joint_states"
            if count == SAMPLES:
                break
    return path


# Long: stopped inside the middleware, a process can hold what others of the machine need.
@pytest.mark.long
def test_a_node_that_waits_for_its_turn_answers_everything(executor, beginning, tmp_path, monkeypatch):
    starved = []
    stage = dataclasses.replace(demo.STAGES[0], bag="beginning")
    node, topic = executor.get_nodes()[0], stage.answer

    @contextmanager
    def process(command):
        """As the demonstration's, and once it answers stopped for a while again and again.

        Before, it can hold what every new process on this machine needs, or miss its discovery.
        """
        with demo_recorder.run_process(command) as child:
            ended = threading.Event()

            def starve():
                while not (recorder.newest or ended.wait(0.01)):
                    pass
                while not ended.wait(0.2):
                    os.kill(child.pid, signal.SIGSTOP)
                    time.sleep(0.4)
                    os.kill(child.pid, signal.SIGCONT)
                    starved.append(time.monotonic())

            thread = threading.Thread(target=starve)
            thread.start()
            try:
                yield child
            finally:
                ended.set()
                thread.join()

    monkeypatch.setattr(demo, "run_process", process)
    recording = tmp_path / "demo.mcap"
    with BagWriter(recording) as writer:
        recorder = demo_recorder.Recorder(node, writer)
        demo.run_stage(stage, beginning, recorder, executor, Console(quiet=True))
    assert starved
    sent = [stamp_of(m.message.header) for m in read_messages(beginning, ["/joint_states"])]
    recorded = read_messages(recording, [f"/beginning{topic}"])
    answered = [stamp_of(m.message.header) for m in recorded]
    # All but the window's first, and none of these out of turn.
    assert len(answered) > SAMPLES - FILLING
    assert answered == sent[SAMPLES - len(answered) :]


def test_a_node_that_never_answers_is_told_of(executor, beginning, tmp_path, monkeypatch):
    monkeypatch.setattr(demo_recorder, "MAX_WAIT", 1.0)

    class Silent:
        """A process that runs and does nothing."""

        returncode = None

        def poll(self):
            return None

    with pytest.raises(PkmTwinError, match="too slow or too busy"):
        demo_recorder.wait_for(executor, lambda: False, "an answer", Silent())


@pytest.mark.parametrize("little", [True, False])
def test_stamps_of_encoded_messages(little):
    order, mark = ("little", b"\0\1\0\0") if little else ("big", b"\0\0\0\0")
    data = mark + (17).to_bytes(4, order) + (5).to_bytes(4, order)
    assert demo_recorder.read_stamp(data) == 17_000_000_005
