# SPDX-License-Identifier: Apache-2.0
"""check and recover: no bag that is damaged or that the model contradicts passes."""

import json
import os
import random
import re

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from pkm_twin.apps.columns import read_columns
from pkm_twin.apps.topics import JOINT_STATE, WRENCH
from pkm_twin.bags.reader import BagWriter, inspect, open_bag, read_messages
from test.bags.folders import make_folder
from test.commands.conftest import DELTA, MILLING, STIFFNESS, rewrite
from test.support.command import forked
from test.support.mapped import sides
from test.support.robots import massless, often, partly_long

JOINTS = "/joint_states"


def scaled_efforts(topic, message, time):
    if topic == JOINTS:
        message.effort = [1.2 * value for value in message.effort]
    return message


def one_effort_reversed(topic, message, time):
    if topic == JOINTS:
        message.effort = [message.effort[0], -message.effort[1], message.effort[2]]
    return message


def hole(topic, message, time):
    return None if topic == JOINTS and 1.0005 < time < 1.0195 else message


def stamps_backwards(topic, message, time):
    if topic == JOINTS and 1.0005 < time < 1.0025:
        message.header.stamp.sec -= 1
    return message


def not_a_number(topic, message, time):
    if topic == JOINTS and 0.9995 < time < 1.0005:
        message.position = [float("nan"), *message.position[1:]]
    return message


def beyond_a_limit(topic, message, time):
    if topic == JOINTS and 0.9995 < time < 1.0005:
        message.position = [1.31, *message.position[1:]]
    return message


def beyond_an_effort_limit(topic, message, time):
    if topic == JOINTS and 0.9995 < time < 1.0005:
        message.effort = [*message.effort[:2], -20.5]
    return message


def doubled_joint(topic, message, time):
    if topic == JOINTS and 0.9995 < time < 1.0005:
        message.name = [message.name[0], *message.name[:2]]
    return message


def items_of(result):
    data = json.loads(result.out)
    return {item["what"]: item for item in data["items"]}


# The lines of the documents check the others.
@pytest.mark.parametrize(
    "bag", partly_long([DELTA, MILLING, STIFFNESS], STIFFNESS), ids=lambda path: path.stem
)
def test_recordings_are_good(twin, bag):
    result = twin("check", bag)
    assert (result.code, result.err) == (0, "")
    assert result.out.splitlines()[-1].startswith("good")
    assert ("not judged: torque residual" in result.out) == (bag == STIFFNESS)


def test_a_cut_out_part_is_good(twin, sample):
    result = twin("check", sample, "--json")
    assert (result.code, result.err) == (0, "")
    data = json.loads(result.out)
    assert data["good"]
    assert data["robot"] == "delta_cu"
    assert {item["verdict"] for item in data["items"]} == {"good"}
    assert sum(item["what"].startswith("torque residual of arm_") for item in data["items"]) == 3


@pytest.mark.parametrize(
    ("change", "what", "value"),
    [
        (scaled_efforts, "torque residual of arm_1", "% of"),
        (one_effort_reversed, "torque residual of arm_2", "N m"),
        (hole, "longest gap", " ms at 1.0"),
        (stamps_backwards, "messages that a node rejects", "stamp order"),
        (not_a_number, "messages that a node rejects", "position of arm_1 is nan"),
        (beyond_a_limit, "messages that a node rejects", "allowed -0.9 to 1.3"),
        (beyond_an_effort_limit, "effort limits", "-0.5 N m"),
        (doubled_joint, "messages that a node rejects", "arm_1"),
    ],
)
def test_a_fault_is_bad_and_named(twin, tmp_path, change, what, value):
    bag = rewrite(DELTA, tmp_path / "bad.mcap", change)
    result = twin("check", bag, "--json")
    assert (result.code, result.err) == (1, "")
    item = items_of(result)[what]
    assert item["verdict"] == "bad"
    assert value in item["value"]


@pytest.mark.parametrize("effort", [0.0, 0.1])
def test_drives_that_are_off_or_braked_are_left_out(twin, tmp_path, effort):
    """The machine stands for 0.41 s; a part of it without efforts, then all that is judged."""

    def braked(topic, message, time):
        if topic == JOINTS and time < 0.3:
            message.effort = [effort] * 3
        return message

    result = twin("check", rewrite(DELTA, tmp_path / "braked.mcap", braked), "--json")
    assert (result.code, result.err) == (0, "")
    items = items_of(result)
    item = items["drives off or braked"]
    assert item["verdict"] == "good"
    assert 0.28 < float(item["value"].split()[0]) < 0.45
    assert sum("torque residual of" in what for what in items) == 3
    bag = rewrite(DELTA, tmp_path / "off.mcap", braked, seconds=0.29)
    result = twin("check", bag, "--json")
    assert (result.code, result.err) == (0, "")
    items = items_of(result)
    assert items["drives off or braked"]["verdict"] == "unknown"
    assert not any("torque residual" in what for what in items)


def test_only_the_contradicted_joint_is_bad(twin, tmp_path):
    bag = rewrite(DELTA, tmp_path / "b.mcap", one_effort_reversed)
    items = items_of(twin("check", bag, "--json"))
    bad = "torque residual of arm_2"
    assert [what for what, item in items.items() if item["verdict"] == "bad"] == [bad]
    shown = twin("check", bag)
    assert shown.code == 1
    assert bad in shown.out.splitlines()[-1]


def test_a_bad_wrench_is_bad(twin, tmp_path):
    def nameless(topic, message, time):
        if topic == "/wrench":
            message.header.frame_id = ""
        return message

    bag = rewrite(STIFFNESS, tmp_path / "w.mcap", nameless, seconds=0.2)
    item = items_of(twin("check", bag, "--json"))["messages that a node rejects"]
    assert item["verdict"] == "bad"
    assert item["value"].startswith("100 of 200 ")
    assert "frame" in item["value"]


def test_the_payload_is_part_of_the_model_only_where_the_bag_tells_of_it(twin, tmp_path):
    held = {"begin": 9.0, "seconds": 2.0}
    facts = inspect(DELTA).metadata["pkm_twin"]
    untold = {k: v for k, v in facts.items() if not k.startswith("payload")}
    silent = rewrite(DELTA, tmp_path / "silent.mcap", metadata={"pkm_twin": untold}, **held)
    assert twin("check", silent).code == 1
    # Times count from the bag's beginning, and this one begins 9 s later.
    told = facts | {"payload_picked_s": "-1.0", "payload_released_s": "5.0"}
    loaded = rewrite(DELTA, tmp_path / "loaded.mcap", metadata={"pkm_twin": told}, **held)
    assert twin("check", loaded).code == 0


def test_the_allowed_residual_is_an_option(twin, tmp_path, sample):
    assert twin("check", sample, "--residual", "0.001").code == 1
    scaled = rewrite(DELTA, tmp_path / "scaled.mcap", scaled_efforts)
    assert twin("check", scaled, "--residual", "0.5").code == 0
    # A part, not percent.
    assert twin("check", sample, "--residual", "-1").code == 2
    assert twin("check", sample, "--residual", "5").code == 2


class TestRobot:
    def test_a_bag_without_a_name_needs_the_option(self, twin, tmp_path):
        bag = rewrite(DELTA, tmp_path / "nameless.mcap", metadata={}, seconds=0.5)
        result = twin("check", bag)
        assert (result.code, result.out) == (1, "")
        assert "--robot" in result.one_line_error()
        assert twin("check", bag, "--robot", "delta_cu").code == 0

    def test_another_robot_is_refused_with_the_joint(self, twin, sample):
        result = twin("check", sample, "--robot", "prru")
        assert result.code == 1
        assert "'slider_1' is missing" in result.one_line_error()

    def test_another_robot_of_the_same_joints_is_bad(self, twin, sample, variant, tmp_path):
        heavy, _ = variant("delta_cu", inertia={"platform_mass": 0.5})
        assert heavy.name == "delta_cu_variant"
        result = twin("check", sample, "--robot", tmp_path / "delta_cu_variant.yaml")
        assert result.code == 1
        assert "torque residual of arm_1" in result.out.splitlines()[-1]

    def test_a_wrong_name_tells_the_closest(self, twin, sample):
        result = twin("check", sample, "--robot", "delta_kuh")
        assert result.code == 1
        assert "did you mean 'delta_cu'" in result.one_line_error()


class TestNoEvidence:
    """What cannot be judged is neither good nor bad."""

    def test_no_efforts(self, twin, tmp_path):
        def mute(topic, message, time):
            if topic == JOINTS:
                message.effort = []
            return message

        result = twin("check", rewrite(DELTA, tmp_path / "m.mcap", mute, seconds=0.5), "--json")
        assert result.code == 0
        items = items_of(result)
        assert items["torque residual"]["verdict"] == "unknown"
        assert "no efforts" in items["torque residual"]["value"]
        assert "effort limits" not in items

    def test_no_masses(self, twin, tmp_path):
        bag = rewrite(STIFFNESS, tmp_path / "s.mcap", seconds=0.2)
        robot = massless(tmp_path / "light.yaml")
        item = items_of(twin("check", bag, "--robot", robot, "--json"))["torque residual"]
        assert item["verdict"] == "unknown"
        assert item["value"].startswith("inertia")
        # With masses, what is missing is the measurement.
        item = items_of(twin("check", bag, "--json"))["torque residual"]
        assert (item["verdict"], item["value"]) == ("unknown", "the bag carries no efforts")

    def test_too_short(self, twin, tmp_path):
        bag = rewrite(DELTA, tmp_path / "s.mcap", seconds=0.002, topics=[JOINTS])
        result = twin("check", bag, "--json")
        items = items_of(result)
        assert result.code == 0
        assert items["rate"]["verdict"] == items["torque residual"]["verdict"] == "unknown"
        assert twin("check", bag).out.splitlines()[-1] == "good; not judged: rate, torque residual"

    def test_no_crc(self, twin, tmp_path, sample):
        bag = without_crcs(sample, tmp_path / "plain.mcap")
        result = twin("check", bag, "--robot", "delta_cu", "--json")
        item = items_of(result)["file"]
        assert (result.code, item["verdict"]) == (0, "unknown")
        assert "no CRC" in item["value"]

    @pytest.mark.parametrize("topics", [["/delta_dynamics/joint_trajectory"], []])
    def test_no_joint_states_at_all_is_refused(self, twin, tmp_path, topics):
        bag = rewrite(DELTA, tmp_path / "t.mcap", topics=topics)
        assert "joint state" in twin("check", bag).one_line_error()


def without_crcs(source, target):
    """The same messages as rosbag2's default storage settings write them."""
    with target.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, enable_crcs=False)
        writer.start(profile="ros2", library="test")
        channels = {}
        for topic, info in inspect(source).topics.items():
            schema = writer.register_schema(info.type, "ros2msg", info.definition.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for m in read_messages(source):
            writer.add_message(channels[m.topic], m.log_time, m.data, m.publish_time)
        writer.finish()
    return target


class TestDamage:
    @pytest.mark.parametrize("count", often(24, 200))
    def test_flips_never_pass(self, twin, tiny, tmp_path, count):
        whole = tiny.read_bytes()
        assert twin("check", tiny).code == 0
        draw = random.Random(20240229)
        path = tmp_path / "flipped.mcap"
        codes = []
        for _ in range(count):
            data = bytearray(whole)
            bit = draw.randrange(8 * len(data))
            data[bit // 8] ^= 1 << bit % 8
            path.write_bytes(data)
            result = twin("check", path, "--json")
            assert not json.loads(result.out)["good"]
            result.one_line_error()
            codes.append(result.code)
        assert set(codes) <= {1, 3}
        assert codes.count(3) > count / 4

    @pytest.mark.parametrize("step", often(503, 37))
    def test_cuts_never_pass(self, twin, tiny, tmp_path, step):
        whole = tiny.read_bytes()
        path = tmp_path / "cut.mcap"
        codes = set()
        for size in [*range(0, len(whole), step), len(whole) - 1]:
            path.write_bytes(whole[:size])
            result = twin("check", path)
            assert result.out == ""
            result.one_line_error()
            codes.add(result.code)
        assert codes == {1, 3}

    @pytest.mark.parametrize("content", [b"", b"no bag at all", b"\x89MCAP0\r\n"])
    def test_what_is_no_bag(self, twin, tmp_path, content):
        path = tmp_path / "bad.mcap"
        path.write_bytes(content)
        result = twin("check", path, "--json")
        data = json.loads(result.out)
        assert result.code == 1
        assert (data["good"], data["salvageable"]) == (False, 0)
        assert data["error"] in result.one_line_error()

    def test_missing_file(self, twin, tmp_path):
        assert "no such file" in twin("check", tmp_path / "absent.mcap").one_line_error()
        assert twin("check").code == 2


class TestRecover:
    def test_then_check(self, twin, sample, tmp_path):
        whole = sample.read_bytes()
        cut, saved = tmp_path / "cut.mcap", tmp_path / "saved.mcap"
        cut.write_bytes(whole[: len(whole) * 3 // 4])
        refused = forked(tmp_path, "check", cut)
        assert refused.code == 3
        promised = int(re.search(r"(\d+) intact messages", refused.one_line_error())[1])
        done = forked(tmp_path, "recover", cut, saved, "--json")
        assert (done.code, done.err) == (3, "")
        facts = json.loads(done.out)
        assert not facts["lossless"]
        assert facts["messages"] == promised == inspect(saved).message_count
        assert promised > 800
        assert cut.read_bytes() == whole[: len(whole) * 3 // 4]
        assert twin("check", saved).code == 0

    def test_a_sound_bag_loses_nothing(self, twin, tiny, tmp_path):
        result = twin("recover", tiny, tmp_path / "copy.mcap")
        assert (result.code, result.err) == (0, "")
        assert "60 messages saved, nothing lost" in result.out
        assert twin("check", tmp_path / "copy.mcap").code == 0

    def test_loss_is_told_in_words(self, twin, tiny, tmp_path):
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(tiny.read_bytes()[:-10])
        result = twin("recover", cut, tmp_path / "saved.mcap")
        assert result.code == 3
        assert "messages saved, " in result.out
        assert "lost" in result.out

    def test_refusals(self, twin, tiny, tmp_path):
        target = tmp_path / "target.mcap"
        target.write_text("mine")
        assert "exists" in twin("recover", tiny, target).one_line_error()
        assert target.read_text() == "mine"
        assert twin("recover", tiny, target, "--overwrite").code == 0
        assert inspect(target).message_count == 60
        (tmp_path / "text").write_text("no bag")
        for source in (tmp_path / "text", tmp_path / "absent"):
            assert twin("recover", source, tmp_path / "new.mcap").code == 1
            assert not (tmp_path / "new.mcap").exists()
        assert twin("recover", tiny).code == 2


class TestPlay:
    """The player itself is tested over the middleware; here only what the command refuses."""

    @pytest.mark.parametrize(
        ("arguments", "code", "text"),
        [
            (("--remap", "no pair"), 2, "FROM:=TO"),
            (("--rate", "fast"), 2, "rate"),
            (("--rate", "0"), 1, "rate"),
            (("--rate", "nan"), 1, "rate"),
            (("--topic", "/absent"), 1, "/absent"),
        ],
    )
    def test_refusals(self, twin, tiny, arguments, code, text):
        result = twin("play", tiny, *arguments)
        assert (result.code, result.out) == (code, "")
        assert text in result.err
        assert "Traceback" not in result.err

    def test_a_damaged_bag_is_not_played(self, twin, tiny, tmp_path):
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(tiny.read_bytes()[:-10])
        assert "recovered" in twin("play", cut).one_line_error()


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
        result = twin("check", bag)
        assert (result.code, result.err) == (0, "")
        first = result.out.splitlines()[0]
        assert f"joint states {JOINTS}, wrench none" in first
        assert "/gripper/joint_states (joints finger)" in first
        data = json.loads(twin("check", bag, "--json").out)
        assert data["topics"]["joint_states"] == JOINTS
        assert len(data["topics"]["left_out"]) == 4
        out = tmp_path / "t.csv"
        assert twin("torques", "delta_cu", bag, "--no-picture", "--out", out).code == 0

    def test_joints_are_those_of_the_controller(self, twin, tmp_path, variant):
        """By name and number: the verdict and the table are those of the model's numbers."""
        both = sides("delta_cu")
        variant("delta_cu", joint_map=both.data["joint_map"])

        def plain(topic, message, time):
            return message if topic == JOINTS else None

        def mapped(topic, message, time):
            if topic != JOINTS:
                return None
            order = [both.plain.joint_names.index(name) for name in message.name]
            back = np.argsort(order)
            message.name = [both.names[k] for k in order]
            for field, turn in (
                ("position", both.positions), ("velocity", both.rates), ("effort", both.efforts)
            ):  # fmt: skip
                values = np.array(getattr(message, field))[back]
                setattr(message, field, turn(values)[order].tolist())
            return message

        one = rewrite(DELTA, tmp_path / "plain.mcap", plain, seconds=0.3)
        bag = rewrite(DELTA, tmp_path / "mapped.mcap", mapped, seconds=0.3)
        robot = tmp_path / "delta_cu_variant.yaml"
        result, expected = twin("check", bag, "--robot", robot), twin("check", one)
        assert result.code == expected.code == 0
        kept = [line for line in expected.out.splitlines() if "residual" in line]
        assert kept and [line for line in result.out.splitlines() if "residual" in line] == kept
        assert "'arm_1' is missing" in twin("check", bag).one_line_error()
        tables = []
        for name, source in (("delta_cu", one), (robot, bag)):
            out = tmp_path / f"{source.stem}.csv"
            assert twin("torques", name, source, "--no-picture", "--out", out).code == 0
            tables.append(read_columns(out))
        assert list(tables[1]) == list(tables[0])
        for name, values in tables[0].items():
            np.testing.assert_allclose(tables[1][name], values, rtol=1e-6, atol=1e-6)

    def test_a_topic_can_be_named(self, twin, tmp_path):
        bag = with_others(DELTA, tmp_path / "all.mcap")
        assert twin("check", bag, "--topic", JOINTS).code == 0
        named = twin("check", bag, "--topic", "/delta_dynamics/joint_torques")
        assert "no positions" in named.one_line_error()
        other = twin("check", bag, "--topic", "/gripper/joint_states").one_line_error()
        assert "'arm_1' is missing" in other
        assert "is not in the bag" in twin("check", bag, "--topic", "/nope").one_line_error()
        both = twin("check", bag, "--topic", JOINTS, "--topic", "/gripper/joint_states")
        assert "choose one" in both.one_line_error()

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
            result = twin("check", path)
            assert result.code == code
            if code:
                assert "/a, /b; choose one with --topic" in result.one_line_error()
                assert twin("check", path, "--topic", "/b").code == 0

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
        data = json.loads(twin("check", path, "--json").out)
        assert data["topics"]["wrench"] == "/wrench"
        assert set(data["topics"]["left_out"]) == {own}


class TestPayload:
    """A bag that tells of no payload is judged with the one that the caller tells of."""

    @pytest.fixture
    def silent(self, tmp_path):
        facts = inspect(DELTA).metadata["pkm_twin"]
        untold = {k: v for k, v in facts.items() if not k.startswith("payload")}
        metadata = {"pkm_twin": untold}
        return rewrite(
            DELTA, tmp_path / "s.mcap", metadata=metadata, begin=7.0, seconds=3.0, topics=[JOINTS]
        )

    def test_by_option(self, twin, silent):
        hint = twin("check", silent)
        assert hint.code == 1 and "--payload" in hint.out
        result = twin("check", silent, "--payload", "0.15", "--load-times", "1.275,9", "--json")
        assert result.code == 0
        assert json.loads(result.out)["payload"] == {
            "mass_kg": 0.15,
            "com_m": None,
            "held_s": [[1.275, 9.0]],
            "source": "option",
        }
        assert twin("check", silent, "--payload", "0.15").code == 1
        assert twin("check", silent, "--payload", "0.6", "--load-times", "1.275,9").code == 1

    def test_the_option_goes_before_the_bag(self, twin, sample):
        text = twin("check", sample, "--payload", "0").out
        assert "payload: 0 kg, throughout, from --payload" in text

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("payload_mass_kg", "nan"),
            ("payload_mass_kg", None),
            ("payload_picked_s", "1e400"),
            ("payload_released_s", "0"),
            ("robot", "/dev/zero"),
            *(
                pytest.param(*case, marks=pytest.mark.long)
                for case in (
                    ("payload_mass_kg", "heavy"),
                    ("payload_mass_kg", "-1"),
                    ("payload_picked_s", ""),
                    ("payload_released_s", None),
                    ("robot", "../config/delta_cu.yaml"),
                    ("robot", "nobody"),
                )
            ),
        ],
    )
    def test_metadata_that_are_no_numbers(self, twin, tmp_path, name, value):
        facts = dict(inspect(DELTA).metadata["pkm_twin"])
        facts.pop(name)
        if value is not None:
            facts[name] = value
        bag = rewrite(DELTA, tmp_path / "m.mcap", metadata={"pkm_twin": facts}, seconds=0.05)
        assert f"{name} is {value!r}" in twin("check", bag).one_line_error()


@pytest.mark.parametrize(
    "definition",
    ["float64 x", "", "string[] name\nfloat64[] position", "string[] name\nfloat32[] position"],
)
def test_a_type_without_its_fields(twin, tmp_path, definition):
    path = tmp_path / "f.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(JOINT_STATE, "ros2msg", definition.encode())
        channel = writer.register_channel(JOINTS, "cdr", schema)
        writer.add_message(channel, 1, b"\0\1\0\0" + bytes(64), 1)
        writer.finish()
    error = twin("check", path, "--robot", "delta_cu").one_line_error()
    assert f"topic {JOINTS}: the bag's definition of sensor_msgs/JointState differs" in error
    assert "'header'" in error or "'x'" in error or "'name'" in error


@pytest.mark.parametrize("mode", ["", "MESSAGE", "FILE"])
def test_rosbag2_folders_go_straight_in(twin, tmp_path, mode):
    moving = rewrite(DELTA, tmp_path / "moving.mcap", begin=1.0, seconds=0.3)
    folder = make_folder(tmp_path / "rec", moving, mode=mode)
    result = twin("check", folder, "--robot", "delta_cu", "--json")
    assert result.code == 0
    assert items_of(result)["file"]["verdict"] == "unknown"
    out = tmp_path / "t.csv"
    assert twin("torques", "delta_cu", folder, "--out", out, "--no-picture").code == 0
    assert twin("recover", folder, tmp_path / "saved.mcap").code == 0
    assert twin("check", tmp_path / "saved.mcap", "--robot", "delta_cu").code == 0


def test_only_regular_files(twin, tmp_path):
    os.mkfifo(tmp_path / "x.mcap")
    for path, kind in ((tmp_path / "x.mcap", "FIFO"), ("/dev/zero", "device")):
        assert kind in twin("check", path).one_line_error()
        assert kind in twin("recover", path, tmp_path / "new.mcap").one_line_error()
