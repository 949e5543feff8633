# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""check: recordings that the model contradicts, and what cannot be judged."""

import re
from dataclasses import replace

import numpy as np
import pytest
import yaml

pytest.importorskip("mcap")
from mcap.writer import Writer

from delta_dynamics import inverse_dynamics, null_efforts
from pkm_twin.bags.definitions import JOINT_STATE
from pkm_twin.bags.reader import inspect, read_messages
from pkm_twin.identification.check import MEASURED, check
from pkm_twin.identification.hypotheses import explain
from pkm_twin.identification.parameters import file_parameters
from pkm_twin.identification.rows import make_rows
from pkm_twin.paths import cycle, timed
from pkm_twin.recordings import Recording
from pkm_twin.robot.derivatives import nearest_motion
from pkm_twin.streams.steps import find_backlash
from test.bags.folders import make_folder, write_split
from test.commands.conftest import (
    COLLISION,
    DELTA,
    JOINTS,
    MILLING,
    STIFFNESS,
    checked,
    items_of,
    rewrite,
)
from test.identification.machines import machine
from test.support.robots import load, massless, partly_long


def of_joints(change, begin=0.0, end=9.0):
    """Joint states between two times through a function of the message: None leaves them out."""

    def changed(topic, message, time):
        return change(message) if topic == JOINTS and begin < time < end else message

    return changed


def put(field, how, begin=0.0, end=9.0):
    """A field of them through a function of its list."""

    def change(message):
        setattr(message, field, how(list(getattr(message, field))))
        return message

    return of_joints(change, begin, end)


SCALED = put("effort", lambda e: [1.2 * value for value in e])


def planned(name):
    """A recording of three seconds with exact efforts whose parts turn often, and its positions."""
    robot = load(name)
    time = np.arange(0.0, 3.0, 0.004)
    n = robot.joints_count
    w, step = 2.0 * np.pi * np.linspace(2.0, 3.0, n), 0.01 * robot.size
    x = np.outer(time, w)
    home = robot.inverse(robot.home())
    q, qd, qdd = home + step * (1 - np.cos(x)), step * w * np.sin(x), step * w**2 * np.cos(x)
    qd, qdd = nearest_motion(robot, q, qd, qdd)
    return Recording(robot, time, q, qd, qdd, inverse_dynamics(robot, q, qd, qdd)), q


REJECTED = "messages that a node rejects"
ONCE = 0.9995, 1.0005
"""When one sample is."""


def a_second_back(message):
    message.header.stamp.sec -= 1
    return message


def other_publisher(topic, message, time):
    if topic == JOINTS and round(1e3 * time) % 2:
        message.position, message.velocity = [0.3] * 3, [0.0] * 3
        message.effort = [0.0] * 3
    return message


def lost(topic, message, time):
    return None if topic == JOINTS and round(1e3 * time) % 20 == 7 else message


def stuck(topic, message, time):
    if topic == JOINTS and 0.5 < time < 0.7:
        message.position = [stuck.at, *message.position[1:]]
    elif topic == JOINTS:
        stuck.at = message.position[0]
    return message


# The lines of the documents check the others.
@pytest.mark.parametrize("bag", partly_long([DELTA, MILLING, STIFFNESS], STIFFNESS), ids=lambda path: path.stem)
def test_recordings_are_good(twin, bag):
    result, mute = twin("check", bag), bag == STIFFNESS
    assert (result.code, result.err) == (4 if mute else 0, "")
    assert result.out.startswith("not judged: joint states without efforts" if mute else "good")


def test_a_cut_out_part_is_good(twin, sample):
    data = twin.told("check", sample)
    assert data["good"]
    assert data["robot"] == "delta_cu"
    assert data["units"]["delay_s"] == "s"
    for one in data["residuals"].values():
        assert 0.0 < one["rms"] <= one["limit"] and one["limit"] >= 0.05 * one["peak"]
        assert one["unit"] == "N m"
    assert {item["verdict"] for item in data["items"]} == {"good"}
    left = [i for i in data["items"] if i["what"].startswith("torque residual of arm_")]
    assert len(left) == 3 and all(i["number"] <= i["limit"] and i["unit"] == "N m" for i in left)


@pytest.mark.parametrize(
    ("change", "what", "value"),
    [
        (SCALED, "torque residual of arm_1", "% of"),
        (put("effort", lambda e: [e[0], -e[1], e[2]]), "torque residual of arm_2", "N m"),
        (of_joints(lambda m: None, 1.0005, 1.0195), "longest gap", " ms at 1.0"),
        (of_joints(a_second_back, 1.0005, 1.0025), REJECTED, "stamp order"),
        (put("position", lambda q: [np.nan, *q[1:]], *ONCE), REJECTED, "position of arm_1 is nan"),
        (put("position", lambda q: [1.31, *q[1:]], *ONCE), REJECTED, "allowed -0.9 to 1.3"),
        (put("effort", lambda e: [*e[:2], -20.5], *ONCE), "effort limits", "-0.5 N m"),
        (put("name", lambda n: [n[0], *n[:2]], *ONCE), REJECTED, "arm_1"),
        (
            put("position", lambda q: [q[0], q[1] + 0.3, q[2]], 0.9995, 1.0015),
            "position steps",
            "at 1.000 s",
        ),
        (other_publisher, "position steps", "two publishers interleaved, 600 and 600 samples"),
        (lost, "missing samples", "60 of 1200"),
        (put("velocity", lambda v: [-v[0], *v[1:]]), "velocities", "arm_1 200 % (wrong sign?)"),
        (stuck, "velocities", "arm_1 stands still from 0.500 s to 0.69"),
    ],
)
def test_a_fault_is_bad_and_named(tmp_path, change, what, value):
    report = checked(rewrite(DELTA, tmp_path / "bad.mcap", change))
    item = items_of(report)[what]
    assert report.code == 1 and what in report.answer
    assert item["verdict"] == "bad"
    assert value in item["value"]
    if change is other_publisher:
        assert report.answer.startswith(f"bad: {value}") and "idle" not in report.answer
        assert value in report.data["causes"][0]
        assert items_of(report)["torque residual"]["verdict"] == "unknown"


def test_a_collision_is_bad_with_its_time(twin):
    """Also without knowing the contact's wrench, which no sensor measures."""
    data = twin.told("check", COLLISION, code=1)
    items = {item["what"]: item for item in data["items"]}
    began = float(inspect(COLLISION).metadata["pkm_twin"]["contact_begins_s"])
    assert data["answer"] == "bad"
    for joint in (1, 2, 3):
        item = items[f"torque residual of arm_{joint}"]
        assert item["verdict"] == "bad"
        found = float(re.search(r"begins at ([\d.]+) s", item["value"]).group(1))
        assert abs(found - began) < 0.02
    (cause,) = data["causes"]
    assert f"before {found:.3f} s" in cause


@pytest.mark.parametrize("effort", [0.0, 0.1])
def test_drives_that_are_off_or_braked_are_left_out(tmp_path, effort):
    """The machine stands for 0.41 s; a part of it without efforts, then all that is judged."""
    braked = put("effort", lambda e: [effort] * 3, -1.0, 0.3)
    report = checked(rewrite(DELTA, tmp_path / "braked.mcap", braked))
    items = items_of(report)
    item = items["drives off or braked"]
    assert (report.code, item["verdict"]) == (0, "good")
    assert 0.28 < float(item["value"].split()[0]) < 0.45
    assert sum("torque residual of" in what for what in items) == 3
    report = checked(rewrite(DELTA, tmp_path / "off.mcap", braked, seconds=0.29))
    # Without a share of the recording to compare there is no verdict.
    assert (report.code, report.data["answer"]) == (4, "not judged")
    share = re.search(r"verdict; ([\d.]+) % have idle drives", report.data["not_judged"])
    assert float(share.group(1)) > 50.0
    items = items_of(report)
    assert items["drives off or braked"]["verdict"] == "unknown"
    assert not any("torque residual" in what for what in items)


def test_the_payload_of_the_bag_is_part_of_the_model(tmp_path):
    held = {"begin": 9.0, "seconds": 2.0}
    facts = inspect(DELTA).metadata["pkm_twin"]
    # Times count from the bag's beginning, and this one begins 9 s later.
    told = facts | {"payload_picked_s": "-1.0", "payload_released_s": "5.0"}
    loaded = rewrite(DELTA, tmp_path / "loaded.mcap", metadata={"pkm_twin": told}, **held)
    assert checked(loaded).code == 0


def test_the_allowed_residual_is_an_option(twin, tmp_path, sample):
    scaled = rewrite(DELTA, tmp_path / "scaled.mcap", SCALED)
    assert checked(scaled, residual=0.5).code == 0
    # A part, not percent.
    assert twin("check", sample, "--residual", "5").code == 2


class TestRobot:
    def test_a_bag_without_a_name_needs_the_option(self, twin, tmp_path):
        bag = rewrite(DELTA, tmp_path / "nameless.mcap", metadata={}, seconds=0.5)
        assert "--robot" in twin.refused("check", bag)
        twin.good("check", bag, "--robot", "delta_cu")

    def test_another_robot_is_refused_with_the_joint(self, twin, sample):
        assert "'slider_1' is missing" in twin.refused("check", sample, "--robot", "prru")

    def test_another_robot_of_the_same_joints_is_bad(self, sample, variant, tmp_path):
        other = tmp_path / "other.yaml"
        other.write_text(yaml.safe_dump(variant("delta_cu", inertia={"platform_mass": 0.5})[1]))
        report = checked(sample, robot=str(other))
        assert report.code == 1
        assert "torque residual of arm_1" in report.answer


class TestNoEvidence:
    """What cannot be judged is neither good nor bad."""

    @pytest.mark.parametrize(
        ("effort", "when"),
        [([], (-1.0, 9.0)), ([np.nan] * 3, (-1.0, 9.0)), ([np.nan] * 3, (0.2, 0.21))],
    )
    def test_no_efforts_in_some_or_all_joint_states(self, tmp_path, effort, when):
        change = put("effort", lambda e: effort, *when)
        report = checked(rewrite(DELTA, tmp_path / "m.mcap", change, seconds=0.5))
        items = items_of(report)
        assert (report.code, items["torque residual"]["verdict"]) == (4, "unknown")
        assert not report.data["good"] and report.data["answer"] == "not judged"
        assert "without efforts" in report.answer
        assert "effort limits" not in items

    def test_no_masses(self, tmp_path):
        bag = rewrite(STIFFNESS, tmp_path / "s.mcap", seconds=0.2)
        robot = str(massless(tmp_path / "light.yaml"))
        report = checked(bag, robot=robot)
        item = items_of(report)["torque residual"]
        assert (report.code, item["verdict"]) == (4, "unknown")
        assert item["value"].startswith("inertia")
        assert item["value"] == report.data["not_judged"]
        assert report.answer.startswith(f"not judged: {item['value']}")
        # With masses, what is missing is the measurement.
        item = items_of(checked(bag))["torque residual"]
        assert item["verdict"] == "unknown" and "without efforts" in item["value"]

    def test_too_short(self, twin, tmp_path):
        bag = rewrite(DELTA, tmp_path / "s.mcap", seconds=0.002, topics=[JOINTS])
        report = checked(bag)
        items = items_of(report)
        assert (report.code, report.data["answer"]) == (4, "not judged")
        assert items["rate"]["verdict"] == items["compared efforts"]["verdict"] == "unknown"
        assert twin("check", bag).out.startswith("not judged")

    def test_no_crc(self, tmp_path, sample):
        plain = tmp_path / "plain.mcap"
        write_split(plain, sample, list(read_messages(sample)))
        report = checked(plain, robot="delta_cu")
        item = items_of(report)["file"]
        assert (report.code, item["verdict"]) == (0, "unknown")
        assert "no CRC" in item["value"]

    @pytest.mark.parametrize("topics", [["/delta_dynamics/joint_trajectory"], []])
    def test_no_joint_states_at_all_is_refused(self, twin, tmp_path, topics):
        bag = rewrite(DELTA, tmp_path / "t.mcap", topics=topics)
        # A plan can be checked; of its own efforts nothing can be learnt.
        error = twin("fit", "delta_cu", bag).one_line_error()
        assert "no joint states" in error
        assert ("planned trajectory" in error) == bool(topics)
        assert topics or "no joint states" in twin.refused("check", bag)


class TestPrintedBounds:
    """What is good is within the bound that is printed."""

    def test_a_bound_widened_by_noise_is_printed(self, rng):
        r, _ = planned("five_bar")
        loud = replace(r, effort=r.effort + 0.4 * np.abs(r.effort).max(0) * rng.normal(size=r.q.shape))
        found = check(loud)
        seen = [i for i in found.items if str(i.text).startswith("torque residual of")]
        assert found.compared is not None and len(seen) == r.robot.joints_count
        for item, limit in zip(seen, found.compared.limit, strict=True):
            assert f"{limit:.3g}" in item.bound and "noise" in item.bound

    @pytest.mark.parametrize("name", ["five_bar", "linear_delta", "stewart"])
    @pytest.mark.parametrize("noise", [0.0, 1e-6])
    def test_play_between_joint_and_encoder_is_named_with_its_size(self, name, noise, rng):
        r, q = planned(name)
        play = 2e-3 * r.robot.size
        turning = r.effort - np.median(r.effort, 0)
        q = q + noise * r.robot.size * rng.normal(size=q.shape)
        seen = q + 0.5 * play * np.sign(turning)
        sizes, counts = find_backlash(seen)
        crossings = np.count_nonzero(np.diff(np.sign(turning), axis=0), axis=0)
        assert (crossings >= 4).any()
        np.testing.assert_allclose(sizes[counts > 0], play, rtol=0.05)
        assert (counts > 0).tolist() == (crossings >= 4).tolist()
        assert not find_backlash(q)[1].any()
        found = check(replace(r, q=seen, qd=None, qdd=None))
        assert found.answer == "bad" and "play" in found.causes[0]

    def test_motions_noise_and_coarse_encoders_are_no_play(self, rng):
        time = np.linspace(0.0, 4.0, 2001)
        cycle_ = timed(load("delta"), cycle(load("delta"), 0.025, 0.305, 0.025)).uniform(500).q
        wave = 0.3 * np.sin(np.outer(time, [5.0, 7.0, 3.0]))
        ramp = np.abs((time[:, None] * [1.0, 2.0, 0.5]) % 2.0 - 1.0)
        for q in (np.tile(cycle_, (6, 1)), wave, ramp):
            for tick in (0.0, 1e-5, 1e-3):
                coarse = q if tick == 0.0 else tick * np.round(q / tick)
                for noise in (0.0, 1e-5):
                    assert not find_backlash(coarse + noise * rng.normal(size=q.shape))[1].any()


class TestPayload:
    """A bag that tells of no payload is judged with the one that the caller tells of."""

    @pytest.fixture
    def silent(self, tmp_path):
        facts = inspect(DELTA).metadata["pkm_twin"]
        untold = {k: v for k, v in facts.items() if not k.startswith("payload")}
        metadata = {"pkm_twin": untold}
        return rewrite(DELTA, tmp_path / "s.mcap", metadata=metadata, begin=7.0, seconds=2.0, topics=[JOINTS])

    def test_by_option(self, twin, silent):
        hint = checked(silent)
        assert hint.code == 1 and any("--payload" in cause for cause in hint.data["causes"])
        data = twin.told("check", silent, "--payload", "0.15", "--load-times", "1.275,9")
        assert data["payload"] == {
            "mass_kg": 0.15,
            "com_m": None,
            "held_s": [[1.275, 9.0]],
            "source": "option",
        }
        assert checked(silent, payload="0.6", load_times="1.275,9").code == 1

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
        assert f"{name} is {value!r}" in twin.refused("check", bag)


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
    error = twin.refused("check", path, "--robot", "delta_cu")
    assert f"topic {JOINTS}: the bag's definition of sensor_msgs/JointState differs" in error
    assert "'header'" in error or "'x'" in error or "'name'" in error


def test_rosbag2_folders_go_straight_in(twin, tmp_path):
    moving = rewrite(DELTA, tmp_path / "moving.mcap", begin=1.0, seconds=0.3)
    folder = make_folder(tmp_path / "rec", moving, mode="FILE")
    report = checked(folder, robot="delta_cu")
    assert (report.code, items_of(report)["file"]["verdict"]) == (0, "unknown")
    out = tmp_path / "t.csv"
    twin.good("torques", "delta_cu", folder, "--out", out, "--no-picture")
    twin.good("recover", folder, tmp_path / "saved.mcap")
    twin.good("check", tmp_path / "saved.mcap", "--robot", "delta_cu")


class TestCauses:
    """What explains a bad residual is said, and nothing else."""

    def cause(self, recording):
        report = check(recording, thorough=False)
        assert report.answer == "bad"
        return report.causes

    @pytest.mark.parametrize("word", partly_long(["opposite sign", "axes"], "opposite sign"))
    def test_a_wrench_in_other_axes_or_of_the_other_sign(self, word, rng):
        robot = load("rps3")
        m = machine(robot, rng, 4.0, 100.0)
        wrench = rng.normal(0.0, 200.0, 6) * np.sin(np.outer(m.time, rng.uniform(1.0, 3.0, 6)))
        wrench[:, 3:] *= 0.1
        efforts = inverse_dynamics(robot, m.q, m.qd, m.qdd, wrench)
        rotation = robot.rotation(robot.forward(m.q))
        turned = np.concatenate([np.einsum("kji,kj->ki", rotation, wrench[:, k : k + 3]) for k in (0, 3)], 1)
        made = recording_of(robot, m, efforts)
        assert check(replace(made, wrench=wrench), thorough=False).answer == "good"
        wrong = replace(made, wrench=turned if word == "axes" else -wrench)
        (text,) = self.cause(wrong)
        assert word in text
        # So does a fit.
        fault = explain(make_rows(robot, file_parameters(robot), wrong)).text
        assert fault is not None and word in fault

    def test_a_saturated_sensor(self, rng):
        robot, m, efforts = drawn(rng, 6.0, 250.0)
        made, most = recording_of(robot, m, efforts), 0.7 * np.abs(efforts[:, 1]).max()
        made.effort[:, 1] = np.clip(made.effort[:, 1], -most, most)
        (text,) = self.cause(made)
        assert robot.joint_names[1] in text and f"{most:.4g}" in text

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

    def test_dry_friction_that_jumps_after_a_rest_is_no_stuck_sensor(self):
        """The filter spreads its jump into the rest, where the effort stays the same."""
        robot = load("delta").changed(friction={"coulomb": [2.0] * 3})
        way = cycle(robot, 0.025, 0.2, 0.025, dwell=0.4)
        s = timed(robot, way, "quintic", duration=2.8).uniform(1000.0)
        made = Recording(robot, s.time, s.q, s.qd, s.qdd, s.effort.copy())
        assert check(made, thorough=False).answer == "good"
        made.effort[300:500, 1] = made.effort[300, 1]
        (found,) = (i.value for i in check(made, thorough=False).items if i.text == MEASURED)
        assert [f"{name} stays" in found for name in robot.joint_names] == [False, True, False]

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


@pytest.mark.parametrize(
    ("inner", "factors", "cause"),
    [
        (0.0, 1.0, None),
        (0.5, 1.0, None),
        (0.0, -3.0, "all joints are 3 times"),
        (0.5, -3.0, "all joints are 3 times"),
        (0.5, 1.3, "all joints are 1.3 times"),
        (0.0, [1.0, -1.0, 1.0, 1.0], "of motor_2 have the wrong sign"),
        (0.5, [1.0, -1.0, 1.0, 1.0], None),
    ],
)
def test_drives_that_share_are_judged_by_what_moves(inner, factors, cause):
    """Inner forces, here parts of the limits, are the controller's to choose."""
    robot = load("examples/machines/rrr4_planar.yaml")
    time = np.arange(0.0, 4.0, 0.004)
    q = robot.inverse(robot.home() + 0.02 * np.sin(np.outer(time, [5.0, 7.0, 9.0])))
    qd = np.gradient(q, time, axis=0)
    q, qd, qdd = robot.project_redundant(q, qd, np.gradient(qd, time, axis=0))
    efforts = inverse_dynamics(robot, q, qd, qdd)
    efforts += inner * np.sin(2.0 * time)[:, None] * null_efforts(robot, q)[:, 0]
    report = check(Recording(robot, time, q, qd, effort=factors * efforts), thorough=False)
    assert report.answer == ("good" if factors == 1.0 else "bad")
    assert len(report.causes) == (cause is not None)
    assert all(cause in text for text in report.causes)


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
