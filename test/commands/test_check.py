# SPDX-License-Identifier: Apache-2.0
"""check: recordings that the model contradicts, and what cannot be judged."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mcap")
from mcap.writer import CompressionType, Writer

from delta_dynamics import inverse_dynamics
from pkm_twin.bags.reader import inspect, read_messages
from pkm_twin.identification.check import MEASURED, check
from pkm_twin.recordings import Recording
from pkm_twin.recordings.topics import JOINT_STATE
from test.bags.folders import make_folder
from test.commands.conftest import COLLISION, DELTA, JOINTS, MILLING, STIFFNESS, rewrite
from test.identification.machines import machine
from test.support.robots import load, massless, partly_long


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


def glitch(topic, message, time):
    if topic == JOINTS and 0.9995 < time < 1.0015:
        message.position = [message.position[0], message.position[1] + 0.3, message.position[2]]
    return message


def other_publisher(topic, message, time):
    if topic == JOINTS and round(1e3 * time) % 2:
        message.position, message.velocity = [0.3] * 3, [0.0] * 3
        message.effort = [0.0] * 3
    return message


def lost(topic, message, time):
    return None if topic == JOINTS and round(1e3 * time) % 20 == 7 else message


def velocity_negated(topic, message, time):
    if topic == JOINTS:
        message.velocity = [-message.velocity[0], *message.velocity[1:]]
    return message


def stuck(topic, message, time):
    if topic == JOINTS and 0.5 < time < 0.7:
        message.position = [stuck.at, *message.position[1:]]
    elif topic == JOINTS:
        stuck.at = message.position[0]
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
    assert result.out.startswith("good")
    assert ("not judged: torque residual" in result.out) == (bag == STIFFNESS)


def test_a_cut_out_part_is_good(twin, sample):
    result = twin("check", sample, "--json")
    assert (result.code, result.err) == (0, "")
    data = json.loads(result.out)
    assert data["good"]
    assert data["robot"] == "delta_cu"
    assert data["units"]["delay_s"] == "s"
    for one in data["residuals"].values():
        assert 0.0 < one["rms"] <= one["limit"] and one["limit"] >= 0.05 * one["peak"]
        assert one["unit"] == "N m"
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
        (glitch, "position steps", "at 1.000 s"),
        (other_publisher, "position steps", "two publishers interleaved, 600 and 600 samples"),
        (lost, "missing samples", "60 of 1200"),
        (velocity_negated, "velocities", "arm_1 200 % (wrong sign?)"),
        (stuck, "velocities", "arm_1 stands still from 0.500 s to 0.69"),
    ],
)
def test_a_fault_is_bad_and_named(twin, tmp_path, change, what, value):
    bag = rewrite(DELTA, tmp_path / "bad.mcap", change)
    result = twin("check", bag, "--json")
    assert (result.code, result.err) == (1, "")
    item = items_of(result)[what]
    assert item["verdict"] == "bad"
    assert value in item["value"]


def test_a_collision_is_bad_with_its_time(twin):
    """Also without knowing the contact's wrench, which no sensor measures."""
    result = twin("check", COLLISION, "--json")
    data = json.loads(result.out)
    began = float(inspect(COLLISION).metadata["pkm_twin"]["contact_begins_s"])
    assert (result.code, data["answer"]) == (1, "bad")
    for joint in (1, 2, 3):
        item = items_of(result)[f"torque residual of arm_{joint}"]
        assert item["verdict"] == "bad"
        found = float(re.search(r"begins at ([\d.]+) s", item["value"]).group(1))
        assert abs(found - began) < 0.02
    (cause,) = data["causes"]
    assert f"before {found:.3f} s" in cause


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
    # Without a share of the recording to compare there is no verdict.
    assert (result.code, json.loads(result.out)["answer"]) == (1, "not judged")
    items = items_of(result)
    assert items["drives off or braked"]["verdict"] == "unknown"
    assert not any("torque residual" in what for what in items)


def test_only_the_contradicted_joint_is_bad(twin, tmp_path):
    bag = rewrite(DELTA, tmp_path / "b.mcap", one_effort_reversed)
    shown = twin("check", bag)
    assert shown.code == 1
    assert shown.out.splitlines()[0].endswith("bad: torque residual of arm_2")


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


def test_the_payload_of_the_bag_is_part_of_the_model(twin, tmp_path):
    held = {"begin": 9.0, "seconds": 2.0}
    facts = inspect(DELTA).metadata["pkm_twin"]
    # Times count from the bag's beginning, and this one begins 9 s later.
    told = facts | {"payload_picked_s": "-1.0", "payload_released_s": "5.0"}
    loaded = rewrite(DELTA, tmp_path / "loaded.mcap", metadata={"pkm_twin": told}, **held)
    assert twin("check", loaded).code == 0


def test_the_allowed_residual_is_an_option(twin, tmp_path, sample):
    scaled = rewrite(DELTA, tmp_path / "scaled.mcap", scaled_efforts)
    assert twin("check", scaled, "--residual", "0.5").code == 0
    # A part, not percent.
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
        assert "torque residual of arm_1" in result.out.splitlines()[0]


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
        assert (result.code, json.loads(result.out)["answer"]) == (1, "not judged")
        assert items["rate"]["verdict"] == items["compared efforts"]["verdict"] == "unknown"
        assert twin("check", bag).out.startswith("not judged")

    def test_no_crc(self, twin, tmp_path, sample):
        bag = without_crcs(sample, tmp_path / "plain.mcap")
        result = twin("check", bag, "--robot", "delta_cu", "--json")
        item = items_of(result)["file"]
        assert (result.code, item["verdict"]) == (0, "unknown")
        assert "no CRC" in item["value"]

    @pytest.mark.parametrize("topics", [["/delta_dynamics/joint_trajectory"], []])
    def test_no_joint_states_at_all_is_refused(self, twin, tmp_path, topics):
        bag = rewrite(DELTA, tmp_path / "t.mcap", topics=topics)
        error = twin("check", bag).one_line_error()
        assert "no joint states" in error
        assert ("planned trajectory" in error) == bool(topics)


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


class TestCauses:
    """What explains a bad residual is said, and nothing else."""

    def cause(self, recording):
        report = check(recording, thorough=False)
        assert report.answer == "bad"
        return report.causes

    def test_a_payload_with_its_times(self, rng):
        robot, mass = load("delta"), float(rng.uniform(0.1, 0.3))
        m = machine(robot, rng, 8.0, 500.0)
        carried = robot.changed(payload={"mass": mass})
        held = (m.time > 2.0) & (m.time < 6.0)
        efforts = np.where(
            held[:, None], inverse_dynamics(carried, m.q, m.qd, m.qdd),
            inverse_dynamics(robot, m.q, m.qd, m.qdd),
        )  # fmt: skip
        (text,) = self.cause(recording_of(robot, m, efforts))
        found = [float(x) for x in re.findall(r"[\d.]+(?=[, ]|$)", text.partition("--payload")[2])]
        assert found == pytest.approx([mass, 2.0, 6.0], rel=0.15)

    def test_a_wrench_in_other_axes_or_of_the_other_sign(self, rng):
        robot = load("stewart")
        m = machine(robot, rng, 4.0, 250.0)
        wrench = rng.normal(0.0, 200.0, 6) * np.sin(np.outer(m.time, rng.uniform(1.0, 3.0, 6)))
        wrench[:, 3:] *= 0.1
        efforts = inverse_dynamics(robot, m.q, m.qd, m.qdd, wrench)
        rotation = robot.rotation(robot.forward(m.q))
        wrong = np.concatenate(
            [np.einsum("kji,kj->ki", rotation, wrench[:, k : k + 3]) for k in (0, 3)], 1
        )
        made = recording_of(robot, m, efforts)
        assert check(replace(made, wrench=wrench)).answer == "good"
        for given, word in ((-wrench, "opposite sign"), (wrong, "axes")):
            (text,) = self.cause(replace(made, wrench=given))
            assert word in text

    def test_a_saturated_sensor(self, rng):
        robot, m, efforts = drawn(rng, 6.0, 250.0)
        made, most = recording_of(robot, m, efforts), 0.7 * np.abs(efforts[:, 1]).max()
        made.effort[:, 1] = np.clip(made.effort[:, 1], -most, most)
        (text,) = self.cause(made)
        assert robot.joint_names[1] in text and f"{most:.4g}" in text

    def test_efforts_of_the_other_sign(self, rng):
        robot, m, efforts = drawn(rng, 6.0, 250.0)
        made = recording_of(robot, m, efforts)
        made.effort[:, 2] *= -1.0
        (text,) = self.cause(made)
        assert [name in text for name in robot.joint_names] == [False, False, True]

    @pytest.mark.parametrize("joints", [[1], [0, 1, 2]])
    def test_efforts_that_are_stuck_are_named(self, rng, joints):
        """No payload of that time is: it would leave the stuck samples out."""
        robot, m, efforts = drawn(rng, 8.0, 500.0)
        made = recording_of(robot, m, efforts)
        assert check(made, thorough=False).answer == "good"
        begin = 1500
        while np.any(np.abs(made.effort[begin]) >= np.abs(made.effort).max(0)):
            begin += 1
        made.effort[begin : begin + 500, joints] = made.effort[begin, joints]
        report = check(made, thorough=False)
        assert report.answer == "bad" and report.causes == ()
        (found,) = (item.value for item in report.items if item.text == MEASURED)
        named = [name in found for name in robot.joint_names]
        assert named == [k in joints for k in range(3)]
        assert f"{m.time[begin] - m.time[0]:.3f} s to" in found

    @pytest.mark.parametrize("level", [0.0, 0.3])
    def test_efforts_that_never_change_were_not_measured(self, rng, level):
        robot, m, efforts = drawn(rng, 4.0, 250.0)
        made = recording_of(robot, m, efforts)
        made.effort[:, 1] = level
        report = check(made, thorough=False)
        assert report.answer == "bad" and report.causes == ()
        (found,) = (item.value for item in report.items if item.text == MEASURED)
        assert robot.joint_names[1] in found and "nothing was measured" in found

    def test_a_payload_that_only_leaves_bad_samples_out_explains_nothing(self, rng):
        robot, m, efforts = drawn(rng, 8.0, 500.0)
        short = (m.time > 4.0) & (m.time < 4.3)
        efforts = efforts + 0.3 * short[:, None] * np.abs(efforts).max(0)
        assert not any("payload" in text for text in self.cause(recording_of(robot, m, efforts)))

    @pytest.mark.long
    def test_what_fit_finds_is_no_explanation_where_the_efforts_do_not_agree(self, rng):
        robot, m, efforts = drawn(rng, 8.0, 200.0)
        noise = np.abs(efforts).max() * rng.normal(size=efforts.shape)
        spike = efforts + 10.0 * np.abs(efforts).max() * (np.arange(len(efforts)) == 700)[:, None]
        for wrong in (noise, spike):
            report = check(recording_of(robot, m, wrong))
            assert report.answer == "bad" and report.causes == ()
            assert not any("-0." in text.partition("elastic")[2][:9] for text in report.findings)

    @pytest.mark.long
    def test_friction_that_the_file_has_not(self, rng):
        robot = load("delta")
        m = machine(robot, rng, 8.0, 200.0)
        true = robot.changed(friction={"viscous": [0.1] * 3, "coulomb": [0.2] * 3})
        efforts = inverse_dynamics(true, m.q, m.qd, m.qdd)
        report = check(recording_of(robot, m, efforts))
        assert report.answer == "bad" and "friction" in report.causes[0]

    def test_what_nothing_explains_has_no_cause(self, rng):
        robot, m, efforts = drawn(rng, 6.0, 250.0)
        wave = np.abs(efforts).max(0) * np.sin(np.outer(m.time, [3.1, 4.3, 5.7]))
        assert self.cause(recording_of(robot, m, efforts + wave)) == ()


def drawn(rng, seconds, rate):
    """A Delta with a motion and the efforts that it needs."""
    robot = load("delta")
    m = machine(robot, rng, seconds, rate)
    return robot, m, inverse_dynamics(robot, m.q, m.qd, m.qdd)


def recording_of(robot, m, efforts):
    """A recording of a drawn motion, with efforts (samples, n) of 0.5 % noise."""
    noise = np.random.default_rng(3).normal(size=efforts.shape)
    efforts = efforts + 0.005 * np.sqrt(np.mean(efforts**2, 0)) * noise
    return Recording(robot, m.time, m.q, m.qd, effort=efforts)
