# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""check: which topics of a recording are judged, and which are left out."""

import numpy as np
import pytest
import yaml

pytest.importorskip("mcap")
from mcap.writer import Writer

from pkm_twin.bags.definitions import JOINT_STATE, WRENCH
from pkm_twin.bags.reader import BagWriter, open_bag
from pkm_twin.errors import BagError
from pkm_twin.recordings import ReadOptions, read, read_table
from pkm_twin.recordings.origin import is_effort_model_column
from test.commands.conftest import COLLISION, DELTA, JOINTS, MILLING, checked, items_of, rewrite
from test.support.mapped import sides


def with_others(source, target, seconds=0.5):
    """A recording of everything: the machine, a gripper, and what the twin made of it."""
    bag = open_bag(source)
    definition = bag.report.topics[JOINTS].definition
    first = bag.report.start_time
    others = {
        "/gripper/joint_states": {"name": ["finger"], "position": [0.1]},
        "/delta_dynamics/joint_torques": {"effort": [1.0, 1.0, 1.0]},
        "/cell/delta_dynamics/torque_residual": {"effort": [9.0, 9.0, 9.0]},
        "/machine_state/joint_states": {"position": [9.0, 9.0, 9.0]},
    }
    with BagWriter(target, metadata=bag.report.metadata, flush_period=None) as writer:
        for topic in (JOINTS, *others):
            writer.add_topic(topic, JOINT_STATE, definition=definition)
        for m in bag.messages(JOINTS):
            if m.log_time - first > seconds * 1e9:
                break
            header, names = m.message.header, m.message.name
            for topic, fields in others.items():
                writer.write(topic, {"name": names, "header": header} | fields, m.log_time)
            writer.write(JOINTS, m.data, m.log_time)
    return target


class TestTopics:
    """Chosen by joint names, the twin's own left out, the choice told."""

    def test_a_recording_of_everything_is_good(self, twin, tmp_path):
        bag = with_others(DELTA, tmp_path / "all.mcap")
        result = twin.good("check", bag)
        (line,) = [x for x in result.out.splitlines() if x.startswith("topics: ")]
        assert f"joint states {JOINTS}, wrench none" in line
        assert "/gripper/joint_states (joints finger)" in line
        topics = checked(bag).data["topics"]
        assert topics["joint_states"] == JOINTS
        assert len(topics["left_out"]) == 4
        twin.good("torques", "delta_cu", bag, "--no-picture", "--out", tmp_path / "t.csv")

    def test_joints_are_those_of_the_controller(self, twin, tmp_path, variant):
        """By name and number: the verdict and the table are those of the model's numbers."""
        both = sides("delta_cu")
        robot = tmp_path / "mapped.yaml"
        changed = variant("delta_cu", joint_map=both.data["joint_map"])[1]
        robot.write_text(yaml.safe_dump(changed))

        def plain(topic, message, time):
            return message if topic == JOINTS else None

        def mapped(topic, message, time):
            if topic != JOINTS:
                return None
            order = [both.plain.joint_names.index(name) for name in message.name]
            back = np.argsort(order)
            message.name = [both.names[k] for k in order]
            for field, turn in (("position", both.positions), ("velocity", both.rates), ("effort", both.efforts)):
                values = np.array(getattr(message, field))[back]
                setattr(message, field, turn(values)[order].tolist())
            return message

        one = rewrite(DELTA, tmp_path / "plain.mcap", plain, seconds=0.3)
        bag = rewrite(DELTA, tmp_path / "mapped.mcap", mapped, seconds=0.3)
        result, expected = checked(bag, robot=str(robot)), checked(one)
        assert result.code == expected.code == 0
        kept = {what: x for what, x in items_of(expected).items() if "torque residual" in what}
        found = items_of(result)
        assert kept
        for what, item in kept.items():
            near = {k: pytest.approx(item[k], rel=1e-9) for k in ("number", "limit")}
            assert found[what] == {**item, **near}
        assert "'arm_1' is missing" in twin.refused("check", bag)
        tables = []
        for name, source in (("delta_cu", one), (robot, bag)):
            out = tmp_path / f"{source.stem}.csv"
            twin.good("torques", name, source, "--no-picture", "--out", out)
            table = read_table(out)
            tables.append({n: v for n, v in table.items() if not is_effort_model_column(n)})
        assert list(tables[1]) == list(tables[0])
        for name, values in tables[0].items():
            np.testing.assert_allclose(tables[1][name], values, rtol=1e-6, atol=1e-6)

    def test_a_topic_can_be_named(self, twin, tmp_path):
        bag = with_others(DELTA, tmp_path / "all.mcap")
        twin.good("check", bag, "--topic", JOINTS)
        for topics, text in (
            (["/delta_dynamics/joint_torques"], "no positions"),
            (["/gripper/joint_states"], "'arm_1' is missing"),
            (["/nope"], "is not in the bag"),
            ([JOINTS, "/gripper/joint_states"], "choose one"),
        ):
            words = [word for topic in topics for word in ("--topic", topic)]
            assert text in twin.refused("check", bag, *words)

    def test_two_that_fit_are_a_question(self, twin, tmp_path):
        bag = open_bag(DELTA)
        definition = bag.report.topics[JOINTS].definition
        for names, code in ((("/a", "/b"), 1), (("/a", "/cell/joint_states"), 0)):
            path = tmp_path / f"{code}.mcap"
            with BagWriter(path, metadata=bag.report.metadata, flush_period=None) as writer:
                for name in names:
                    writer.add_topic(name, JOINT_STATE, definition=definition)
                for index, m in enumerate(bag.messages(JOINTS)):
                    if index == 100:
                        break
                    for name in names:
                        writer.write(name, m.data, m.log_time)
            if code:
                assert "/a, /b; choose one with --topic" in twin.refused("check", path)
                assert checked(path, topic=("/b",)).code == 0
            else:
                assert checked(path).code == 0

    def test_of_several_wrenches_the_twins_reactions_are_left_out(self, twin, tmp_path):
        bag = open_bag(MILLING)
        path = tmp_path / "w.mcap"
        info = bag.report.topics["/wrench"]
        own = "/delta_dynamics/reactions/foot_I"
        with BagWriter(path, metadata=bag.report.metadata, flush_period=None) as writer:
            for name, kind in ((JOINTS, JOINTS), ("/wrench", "/wrench"), (own, "/wrench")):
                found = bag.report.topics[kind]
                writer.add_topic(name, found.type, definition=found.definition)
            for index, m in enumerate(bag.messages([JOINTS, "/wrench"])):
                if index == 300:
                    break
                writer.write(m.topic, m.data, m.log_time)
                if m.topic == "/wrench":
                    writer.write(own, m.data, m.log_time)
        assert info.type == WRENCH
        topics = checked(path).data["topics"]
        assert (topics["wrench"], set(topics["left_out"])) == ("/wrench", {own})


def framed(tmp_path, name):
    """The milling with its wrenches in another frame, all of them or by a function of time."""

    def change(topic, message, time):
        if topic == "/wrench":
            message.header.frame_id = name(time) if callable(name) else name
        return message

    return rewrite(MILLING, tmp_path / f"{id(change)}.mcap", change, begin=3.0, seconds=0.4)


class TestFrames:
    """Wrenches of one frame are accepted: the platform or base frame, others on request."""

    @pytest.mark.parametrize(
        ("name", "options", "rejected"),
        [
            ("platform", {}, 0),
            ("base_link", {}, 0),
            ("world", {}, 200),
            ("world", {"base_frame": "world"}, 0),
            ("tool", {"wrench_frame": "tool"}, 0),
            ("platform", {"wrench_frame": "tool"}, 200),
            (lambda time: "platform" if time < 3.2 else "base_link", {}, 100),
        ],
    )
    def test_what_a_node_rejects_is_rejected(self, tmp_path, name, options, rejected):
        report = checked(framed(tmp_path, name), **options)
        item = items_of(report)["messages that a node rejects"]
        assert item["value"].startswith(f"{rejected} of 600")
        assert item["verdict"] == ("bad" if rejected else "good")
        accepted = "platform" if callable(name) else "" if rejected else name
        assert report.data["topics"]["frame"] == accepted

    def test_axes_are_those_of_the_frame(self, tmp_path):
        turned = read(framed(tmp_path, "platform"))
        fixed = read(framed(tmp_path, "base_link"))
        rotation = turned.robot.platform(turned.q)[1]
        force = np.einsum("kij,kj->ki", rotation, fixed.wrench[:, :3])
        np.testing.assert_allclose(turned.wrench[:, :3], force, atol=1e-9)


def test_what_no_sensor_publishes_is_read_on_request(twin):
    bag = COLLISION
    chosen = read(bag)
    assert chosen.wrench is None and "/ground_truth/wrench" in chosen.topics.left_out
    truth = read(bag, how=ReadOptions(("/ground_truth/wrench",)))
    assert (truth.topics.wrench, truth.topics.frame) == ("/ground_truth/wrench", "base_link")
    assert np.abs(truth.wrench).max() > 10.0
    assert read(MILLING, how=ReadOptions((JOINTS,))).wrench is None


@pytest.mark.parametrize("kind", ["sensor_msgs/JointState", JOINT_STATE])
def test_another_encoding_is_named(tmp_path, kind):
    path = tmp_path / "j.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(kind, "jsonschema", b"{}")
        channel = writer.register_channel(JOINTS, "json", schema)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(BagError, match="encoding is json"):
        read(path, "delta")


def test_messages_of_other_joints_on_the_same_topic_are_left_alone(tmp_path):
    """Wheels or a gripper publish on /joint_states, too, between the machine's own."""
    bag, target = open_bag(DELTA), tmp_path / "wheels.mcap"
    first = bag.report.start_time
    with BagWriter(target, metadata=bag.report.metadata, flush_period=None) as writer:
        writer.add_topic(JOINTS, JOINT_STATE, definition=bag.report.topics[JOINTS].definition)
        for m in bag.messages(JOINTS):
            if m.log_time - first > 5e8:
                break
            writer.write(JOINTS, m.data, m.log_time)
            wheel = {"header": m.message.header, "name": ["wheel"], "position": [1.0]}
            writer.write(JOINTS, wheel, m.log_time)
    report = checked(target)
    assert (report.code, report.data["answer"]) == (0, "good")
    r = read(target)
    assert not r.rejected and "of other joints" in r.notes[-1]


@pytest.mark.parametrize("command", [("check",), ("torques", "delta_cu")])
def test_a_bag_without_stamps_says_what_to_do(command, twin, tmp_path):
    def unstamped(topic, message, time):
        message.header.stamp.sec = message.header.stamp.nanosec = 0
        return message

    bag = rewrite(DELTA, tmp_path / "zero.mcap", unstamped, seconds=0.1, topics=[JOINTS])
    line = twin.refused(*command, bag)
    assert "accept_zero_stamp" not in line and "header.stamp" in line and "column time" in line
