# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The recordings in bags/: what bags/README.md says of them, and what the cores make of them.

The replay here is the nodes' own cores fed with the recorded messages, without a middleware.
"""

import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml

from bags.recording import residuals
from bags.recording.capture import machine_parameters, parameters_digest
from delta_dynamics import inverse_dynamics
from delta_dynamics.feedforward import Feedforward
from pkm_twin.bags.reader import open_bag
from pkm_twin.errors import MessageError
from pkm_twin.messages.stamps import stamp_of
from stiffness_monitor.monitor import Monitor
from test.support.robots import load

FOLDER = Path(__file__).resolve().parents[2] / "bags"
EPOCH = 1_700_000_000_000_000_000
SECOND = 10**9
STATES, WRENCH, TRUE_WRENCH = "/joint_states", "/wrench", "/ground_truth/wrench"
TRAJECTORY = "/delta_dynamics/joint_trajectory"
# Topics with their types, rates in Hz or counts, and log times less stamps in ms, as in the README.
EXPECTED = {
    "delta_cu_collision": {
        STATES: ("sensor_msgs/msg/JointState", 4000, 0.2),
        TRUE_WRENCH: ("geometry_msgs/msg/WrenchStamped", 2000, 0.4),
    },
    "delta_cu_pick_and_place": {
        STATES: ("sensor_msgs/msg/JointState", 20000, 0.2),
        TRAJECTORY: ("trajectory_msgs/msg/JointTrajectory", 31, -50.0),
    },
    "prru_milling": {
        STATES: ("sensor_msgs/msg/JointState", 20000, 0.2),
        WRENCH: ("geometry_msgs/msg/WrenchStamped", 10000, 0.3),
        TRAJECTORY: ("trajectory_msgs/msg/JointTrajectory", 4, -50.0),
    },
    "upr_rpu_soft_joint": {
        STATES: ("sensor_msgs/msg/JointState", 2000, 0.2),
        WRENCH: ("geometry_msgs/msg/WrenchStamped", 2000, 0.3),
        "/measured_deflection": ("geometry_msgs/msg/TransformStamped", 400, 0.4),
    },
    "upr_rpu_milling": {
        STATES: ("sensor_msgs/msg/JointState", 10000, 0.2),
        WRENCH: ("geometry_msgs/msg/WrenchStamped", 10000, 0.3),
        "/ground_truth/deflection": ("geometry_msgs/msg/TransformStamped", 400, 0.4),
        "/ground_truth/strain_energy": ("diagnostic_msgs/msg/DiagnosticArray", 400, 0.4),
    },
}
NAMES = sorted(EXPECTED)
DURATIONS = {"delta_cu_collision": 4.0}
"""Lengths that are not the usual one, s."""


@pytest.fixture(scope="module")
def bags():
    return {name: open_bag(FOLDER / f"{name}.mcap") for name in NAMES}


def facts_of(bag):
    return bag.report.metadata["pkm_twin"]


def seconds(stamps):
    return (np.array(stamps) - EPOCH) / SECOND


def test_every_recording_is_known_here():
    assert sorted(path.stem for path in FOLDER.glob("*.mcap")) == NAMES


@pytest.mark.parametrize("name", NAMES)
class TestFile:
    def test_is_sound_and_small(self, bags, name):
        report = bags[name].report
        assert report.warnings == ()
        assert report.has_crc
        assert report.has_index
        assert report.has_summary
        assert report.out_of_order == 0
        assert report.profile == "ros2"
        assert report.path.stat().st_size < 5_000_000

    def test_topics_types_and_counts(self, bags, name):
        topics = bags[name].report.topics
        found = {topic: (info.type, info.count) for topic, info in topics.items()}
        assert found == {topic: row[:2] for topic, row in EXPECTED[name].items()}

    def test_qos_is_a_yaml_sequence_as_rosbag2_reads_it(self, bags, name):
        for info in bags[name].report.topics.values():
            profiles = yaml.safe_load(info.offered_qos)
            assert isinstance(profiles, list)
            assert [(p["history"], p["depth"], p["reliability"]) for p in profiles] == [("keep_last", 10, "reliable")]
            assert profiles[0]["durability"] == "volatile"

    def test_joints_stamps_and_log_times(self, bags, name):
        robot = load(facts_of(bags[name])["robot"])
        stamps = {topic: [] for topic in EXPECTED[name]}
        for m in bags[name].messages():
            stamp = stamp_of(m.message.header)
            stamps[m.topic].append(stamp)
            # A trajectory is logged before its start, but not before the recording's own.
            assert m.log_time - stamp == round(EXPECTED[name][m.topic][2] * 1e6)
            if m.topic == STATES:
                assert tuple(m.message.name) == robot.joint_names
            elif m.topic == TRAJECTORY:
                assert tuple(m.message.joint_names) == robot.joint_names
        duration = float(facts_of(bags[name])["duration_s"])
        assert duration == DURATIONS.get(name, 20.0)
        for topic, times in stamps.items():
            if topic != TRAJECTORY:
                steps = np.diff(times)
                assert times[0] == EPOCH
                assert (steps == steps[0]).all()
                assert times[-1] + steps[0] == EPOCH + round(duration * SECOND)

    def test_parameters_are_todays(self, bags, name):
        """The machine that was simulated is the one in config/; if not, record the bag again."""
        facts = facts_of(bags[name])
        assert facts["source"] == "simulated"
        assert facts["parameters_sha256"] == parameters_digest(machine_parameters(facts["robot"]))


def replay(bag):
    """Feed the node's core: it, times, residuals, measured efforts, efforts of trajectories."""
    core = Feedforward(load(facts_of(bag)["robot"]))
    stamps, residuals, measured, efforts = [], [], [], []
    for m in bag.messages([STATES, TRAJECTORY]):
        if m.topic == TRAJECTORY:
            efforts.append(core.trajectory(m.message, m.log_time))
            continue
        torques = core.joint_state(m.message, m.log_time)
        if torques is not None:
            stamps.append(torques.stamp)
            residuals.append(torques.residual)
            measured.append(m.message.effort)
    return core, seconds(stamps), np.array(residuals), np.array(measured), efforts


@pytest.fixture(scope="module")
def pick_and_place(bags):
    return replay(bags["delta_cu_pick_and_place"])


@pytest.fixture(scope="module")
def milling(bags):
    return replay(bags["prru_milling"])


def rms(values):
    return np.sqrt(np.mean(values**2, 0))


@pytest.mark.parametrize("name", ["pick_and_place", "milling"])
def test_everything_is_answered(request, name):
    core, time, residuals, _, efforts = request.getfixturevalue(name)
    assert not core.stream.rejected
    assert not core.trajectories.rejected
    assert core.saturations == 0
    # All but the first window.
    assert len(time) == 20000 - (core.settings.window - 1)
    assert np.isfinite(residuals).all()
    assert all(np.isfinite(rows).all() for rows in efforts)


class TestPickAndPlace:
    def phases(self, bags, time):
        facts = facts_of(bags["delta_cu_pick_and_place"])
        picked, released = float(facts["payload_picked_s"]), float(facts["payload_released_s"])
        assert (picked, released) == (8.275, 14.875)
        free = (time < picked - 0.5) | (time > released + 0.5)
        return free, (time > picked + 0.5) & (time < released - 0.5)

    def test_residual_without_payload(self, bags, pick_and_place):
        _, time, residuals, measured, _ = pick_and_place
        free, _ = self.phases(bags, time)
        peak = np.abs(measured).max(0)
        assert (peak > 1.0).all()
        assert (rms(residuals[free]) < 0.02 * peak).all()

    def test_the_step_at_the_pick_is_the_payloads_weight(self, bags, pick_and_place):
        _, time, residuals, _, _ = pick_and_place
        free, held = self.phases(bags, time)
        step = residuals[held].mean(0) - residuals[free].mean(0)
        scatter = np.linalg.norm(residuals[free].std(0))
        assert np.linalg.norm(step) > 3 * scatter
        # It comes within a quarter of a second, at a standstill: the window is 25 ms long.
        before = residuals[(time > 8.0) & (time < 8.25)].mean(0)
        after = residuals[(time > 8.31) & (time < 8.35)].mean(0)
        assert np.linalg.norm(after - before) > 0.7 * np.linalg.norm(step)

    def test_the_recorded_mass_takes_the_step_away(self, bags, pick_and_place):
        """The payload of the metadata, in the model, at the poses where it was held."""
        _, time, residuals, _, _ = pick_and_place
        bag = bags["delta_cu_pick_and_place"]
        _, held = self.phases(bags, time)
        bare = load("delta_cu")
        loaded = bare.changed(payload={"mass": float(facts_of(bag)["payload_mass_kg"])})
        still = np.zeros(len(bare.joint_names))
        q = {stamp_of(m.message.header): m.message.position for m in bag.messages([STATES])}
        at = EPOCH + np.round(time[held] * SECOND).astype(np.int64)
        q = np.array([q[1_000_000 * round(stamp / 1_000_000)] for stamp in at.tolist()])
        weight = inverse_dynamics(loaded, q, still, still) - inverse_dynamics(bare, q, still, still)
        rest = residuals[held].mean(0) - weight.mean(0)
        assert np.linalg.norm(rest) < 0.1 * np.linalg.norm(weight.mean(0))


class TestMilling:
    def test_residual_out_of_the_cut(self, milling):
        _, time, residuals, measured, _ = milling
        free = (time < 1.5) | ((time > 9.9) & (time < 11.0)) | (time > 19.4)
        peak = np.abs(measured).max(0)
        assert (peak > 200.0).all()
        assert (rms(residuals[free]) < 0.02 * peak).all()
        # The node knows nothing of the cutting force, and the residual shows it.
        cut = ((time > 3.0) & (time < 9.0)) | ((time > 12.5) & (time < 18.0))
        assert (rms(residuals[cut]) > 2 * rms(residuals[free])).all()


@pytest.fixture(scope="module")
def answers(bags):
    """The monitor's answer to every wrench, by stamp."""
    bag = bags["upr_rpu_milling"]
    core = Monitor(load("upr_rpu"))
    answers = {}
    for m in bag.messages([STATES, WRENCH]):
        try:
            if m.topic == STATES:
                core.joint_state(m.message, m.log_time)
            else:
                answer = core.wrench(m.message, m.log_time)
                answers[answer.stamp] = answer
        except MessageError as error:
            pytest.fail(f"{m.topic} at {m.log_time}: {error}")
    return answers


class TestStiffness:
    def truth(self, bags, topic):
        messages = bags["upr_rpu_milling"].messages([topic])
        return {stamp_of(m.message.header): m.message for m in messages}

    def test_deflections_are_the_frames(self, bags, answers):
        assert len(answers) == 10000
        true, found = [], []
        for stamp, message in self.truth(bags, "/ground_truth/deflection").items():
            t = message.transform.translation
            true.append([t.x, t.y, t.z])
            found.append(answers[stamp].energy.deflection[:3])
        true, found = np.array(true), np.array(found)
        assert 25e-6 < np.linalg.norm(true, axis=1).max() < 35e-6
        error = np.sqrt(np.mean(np.sum((found - true) ** 2, 1)) / np.mean(np.sum(true**2, 1)))
        # The noise of the measured wrench is all that is left. Platform axes taken for fixed: 8 %.
        assert error < 0.02

    def test_the_dominant_element_is_the_frames(self, bags, answers):
        truth = {
            stamp: message.status[0].message
            for stamp, message in self.truth(bags, "/ground_truth/strain_energy").items()
        }
        # What the README says of the recording.
        assert Counter(truth.values()) == {"3B": 214, "1B": 55, "2B": 35, "none": 96}
        loaded = [stamp for stamp, name in truth.items() if name != "none"]
        agree = sum(answers[stamp].energy.dominant == truth[stamp] for stamp in loaded)
        assert agree >= 0.98 * len(loaded)


def test_readme_names_what_is_there():
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    for name in NAMES:
        size = (FOLDER / f"{name}.mcap").stat().st_size / 1e6
        row = next(line for line in text.splitlines() if line.startswith(f"| `{name}.mcap`"))
        assert f"{size:.2f} MB" in row
        for topic in EXPECTED[name]:
            assert f"`{topic}`" in text.split(f"## {name}")[1].split("\n## ")[0]


@pytest.mark.parametrize("name", list(residuals.SECTIONS))
def test_readme_has_the_figures_that_are_printed(name):
    """Word for word, and number for number within the last digit."""
    page = residuals.PAGE.read_text(encoding="utf-8")
    stands = page.split(f"<!-- printed: {name} -->\n")[1].split("\n<!-- end -->")[0]
    number = re.compile(r"\d+\.?\d*")
    printed = residuals.SECTIONS[name]()
    assert number.sub("#", stands) == number.sub("#", printed)
    for old, new in zip(number.findall(stands), number.findall(printed), strict=True):
        digits = len(old.partition(".")[2])
        assert abs(float(old) - float(new)) < 1.1 * 10**-digits, (name, old, new)
