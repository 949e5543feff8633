# SPDX-License-Identifier: Apache-2.0
"""play: what is not fit to be published is refused before anything is."""

import os

import pytest

pytest.importorskip("mcap")
from mcap.writer import Writer

from pkm_twin.bags.reader import inspect
from test.bags.folders import make_folder
from test.commands.conftest import DELTA, rewrite
from test.nodes.harness import Domain

pytest.importorskip("rclpy")


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    path = tmp_path_factory.mktemp("short") / "short.mcap"
    return rewrite(DELTA, path, seconds=0.05)


def offered(path, topic, qos):
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": qos})
        writer.add_message(channel, 1, b"\0\1\0\0\1\0\0\0\0", 1)
        writer.finish()
    return path


@pytest.mark.parametrize("mode", ["", "MESSAGE", "FILE"])
def test_a_folder_is_played_whole(monkeypatch, tmp_path, short, mode):
    from pkm_twin.ros.player import play

    domain = Domain()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain.number))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    folder = make_folder(tmp_path / "rec", short, mode=mode)
    assert play(folder, progress=False).messages == inspect(short).message_count
    domain.close()


@pytest.mark.parametrize(
    ("topic", "qos", "text"),
    [
        ("/t", "- {depth: .inf}", "depth is inf"),
        ("/t", "- {depth: [", "the text is"),
        ("no topic", "", "no topic name"),
        ("/a/\n", "", "no topic name"),
        ("/" + "x" * 10_000, "", "no topic name"),
    ],
)
def test_nonsense_is_one_line(twin, tmp_path, topic, qos, text):
    result = twin("play", offered(tmp_path / "b.mcap", topic, qos), "--quiet", "--wait", "0")
    assert (result.code, result.out) == (1, "")
    assert text in result.one_line_error()


def test_a_name_that_ros_refuses_can_be_remapped(twin, short):
    result = twin("play", short, "--remap", "/joint_states:=/1", "--quiet")
    assert "'/1' is no topic name" in result.one_line_error()


def test_only_regular_files(twin, tmp_path):
    os.mkfifo(tmp_path / "x.mcap")
    for path, kind in ((tmp_path / "x.mcap", "FIFO"), ("/dev/zero", "device")):
        assert kind in twin("play", path).one_line_error()
