# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The kit for a recording, and a recording without names and dates."""

import shlex

import numpy as np
import pytest

from pkm_twin.apps.commands.record_kit import readme
from pkm_twin.bags.reader import BagWriter, open_bag
from pkm_twin.recordings import read
from pkm_twin.recordings.bags import read_trajectory
from test.commands.conftest import DELTA, MILLING
from test.support.robots import load
from test.support.tables import read_columns

SECRET = "acme"


def test_a_kit_has_motions_notes_and_commands(twin, tmp_path):
    out = tmp_path / "kit"
    options = ("--duration", "4", "--friction-duration", "12", "--trials", "10")
    twin.good("record-kit", "five_bar", "--out", out, *options)
    robot = load("five_bar")
    lengths = {}
    for name in ("excitation", "friction"):
        motion = read_trajectory(open_bag(out / f"{name}.mcap"), robot)
        assert motion is not None
        lengths[name] = motion.time[-1]
        table = read_columns(out / f"{name}.csv")
        np.testing.assert_allclose(table["time"], motion.time, atol=1e-6)
    assert lengths["friction"] > lengths["excitation"]
    for name in ("README.md", "NOTES.md"):
        text = (out / name).read_text()
        assert all(joint in text for joint in robot.joint_names)
    twin.refused("record-kit", "five_bar", "--out", out, *options)


def test_a_robot_or_a_bag_is_needed(twin, tmp_path):
    twin.good("record-kit", "--out", tmp_path / "kit", code=2)
    twin.refused("anonymise", DELTA, "--out", tmp_path / "kit")
    assert not (tmp_path / "kit").exists()


def private(source, target, robot, word=f"{SECRET}_"):
    """The same recording as another firm has it: names, dates, frames, a further topic."""
    bag = open_bag(source)
    names = {name: f"{word}{name}" for name in robot.controller.names}
    definitions = {info.type: info.definition for info in bag.report.topics.values()}
    wanted = [n for n, i in bag.report.topics.items() if i.type.endswith(("JointState", "Stamped"))]
    with BagWriter(target, metadata={SECRET: {"host": SECRET}}, flush_period=None) as writer:
        for name in wanted:
            kind = bag.report.topics[name].type
            text = f"# {SECRET}\n{definitions[kind]}"
            writer.add_topic(f"/{SECRET}{name}", kind, definition=text)
        writer.add_topic(f"/{SECRET}/diary", "std_msgs/msg/String", definition="string data\n")
        writer.write(f"/{SECRET}/diary", {"data": SECRET}, 5)
        for count, message in enumerate(bag.messages(wanted)):
            if count > 200:
                break
            content = message.message
            if hasattr(content, "name"):
                content.name[:] = [names.get(one, one) for one in content.name]
                content.header.frame_id = SECRET
            writer.write(f"/{SECRET}{message.topic}", content, message.log_time)
    return names


@pytest.mark.parametrize(("source", "name"), [(DELTA, "delta_cu"), (MILLING, "prru")])
def test_an_anonymised_bag_has_the_same_numbers_and_no_name(source, name, twin, tmp_path):
    robot = load(name)
    given, out = tmp_path / f"{SECRET}.mcap", tmp_path / "out.mcap"
    private(source, given, robot)
    told = twin.told("anonymise", given, "--out", out)
    assert f"/{SECRET}/diary" in told["left_out"]
    bag = open_bag(out)
    assert "/joint_states" in bag.report.topics
    assert set(bag.report.topics) <= {"/joint_states", "/wrench"}
    messages = list(bag.messages())
    before = [m for m in open_bag(given).messages() if not m.topic.endswith("diary")]
    assert len(messages) == len(before) == sum(told["messages"].values())
    # No chunk is compressed in this copy: what a reader of the bytes would find.
    plain = repr(bag.report.metadata).encode() + b"".join(m.data for m in messages)
    plain += "".join(i.definition for i in bag.report.topics.values()).encode()
    assert SECRET.encode() not in plain and SECRET.encode() not in out.read_bytes()
    first = min(
        [m.log_time for m in messages]
        + [m.message.header.stamp.sec * 10**9 + m.message.header.stamp.nanosec for m in messages]
    )
    assert first == 1
    for one, other in zip(messages, before, strict=True):
        shift = before[0].log_time - messages[0].log_time
        assert other.log_time - one.log_time == shift
        if one.topic == "/joint_states":
            assert list(one.message.name) == [
                f"joint_{k + 1}" for k in range(len(one.message.name))
            ]
            for field in ("position", "velocity", "effort"):
                assert list(getattr(one.message, field)) == list(getattr(other.message, field))
        else:
            assert repr(one.message.wrench) == repr(other.message.wrench)


def test_kept_names_can_be_judged_and_other_joints_go(twin, tmp_path):
    robot, given, out = load("delta_cu"), tmp_path / "given.mcap", tmp_path / "out.mcap"
    private(DELTA, given, robot, word="")
    # The older spelling.
    older = ("record-kit", "delta_cu", "--anonymise", given)
    twin.good(*older, "--out", out, "--keep-names")
    one, other = read(out), read(given, robot)
    assert one.robot.name == "delta_cu"
    np.testing.assert_array_equal(one.q, other.q)
    np.testing.assert_array_equal(one.effort, other.effort)
    np.testing.assert_array_equal(np.diff(one.stamps), np.diff(other.stamps))
    private(DELTA, tmp_path / "others.mcap", robot)
    small = tmp_path / "small.mcap"
    twin.refused("anonymise", tmp_path / "others.mcap", "--robot", "delta_cu", "--out", small)
    assert not small.exists()


def test_no_clock_keeps_a_date(twin, tmp_path):
    """A controller whose clock is set while it records, and a recorder in simulated time."""
    date, step = 1_700_000_000 * 10**9, 10**6
    bag = open_bag(DELTA)
    (topic,) = (n for n, i in bag.report.topics.items() if i.type.endswith("JointState"))
    info, given, out = bag.report.topics[topic], tmp_path / "given.mcap", tmp_path / "out.mcap"
    with BagWriter(given, flush_period=None) as writer:
        writer.add_topic("/states", info.type, definition=info.definition)
        for k, message in zip(range(20), bag.messages([topic]), strict=False):
            stamp = message.message.header.stamp
            time = k * step + (date if k >= 10 else 5 * 10**9)
            stamp.sec, stamp.nanosec = divmod(time, 10**9)
            writer.write("/states", message.message, 5 * 10**9 + k * step, date + k * step)
    twin.good("anonymise", given, "--out", out)
    found = list(open_bag(out).messages())
    stamps = [m.message.header.stamp.sec * 10**9 + m.message.header.stamp.nanosec for m in found]
    assert stamps == [1 + step * (k % 10) for k in range(20)]
    assert [m.log_time for m in found] == [m.publish_time for m in found]
    assert [m.log_time for m in found] == [1 + step * k for k in range(20)]


def test_commands_of_a_kit_take_any_path_of_a_robot_file():
    text = readme(load("delta_cu"), "my machine's.yaml")
    (line,) = (line for line in text.splitlines() if "pkm-twin fit" in line)
    assert shlex.split(line)[2] == "my machine's.yaml"
