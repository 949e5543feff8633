# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""`pkm-twin fit --what compliance` as a user runs it."""

import numpy as np
import pytest

from pkm_twin.bags.reader import BagWriter, open_bag
from stiffness_monitor import compliance
from test.bags.test_recordings import FOLDER
from test.laws.deflections import SENSORS, noisy, twin_recording
from test.support.robots import load, rigid
from test.support.tables import of_joints, read_columns, write_columns

SOFT = FOLDER / "upr_rpu_soft_joint.mcap"
COLLISION = FOLDER / "delta_cu_collision.mcap"
WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")
DEFLECTION = ("dx", "dy", "dz", "rx", "ry", "rz")
THIRD = slice(None, None, 3)
"""Samples of all loads: what those of a few leave open is searched for faults, which takes long."""


def table(path, *, wrench=WRENCH, deflection=DEFLECTION, rows=slice(None)):
    """A CSV of loads and deflections of a machine whose joint 3U is three times softer."""
    recording = noisy(twin_recording({"3U": 3.0}), np.random.default_rng(1), SENSORS)
    columns = {"time": recording.time} | of_joints(load("upr_rpu"), "position", recording.q)
    columns |= {name: recording.wrench[:, WRENCH.index(name)] for name in wrench}
    columns |= {name: recording.deflection[:, DEFLECTION.index(name)] for name in deflection}
    return write_columns(path, {name: values[rows] for name, values in columns.items()})


def test_fit_of_the_recorded_bag_writes_a_robot_with_a_softer_joint_and_a_report(twin, tmp_path):
    out = tmp_path / "fitted.yaml"
    line = ("fit", "upr_rpu", SOFT, "--what", "compliance", "--out", out)
    data = twin.told(*line)
    found = {p["element"]: p for p in data["parameters"]}
    for element, number in found.items():
        true = {"3U": 3.0}.get(element, 1.0)
        assert abs(number["value"] - true) <= 3.0 * number["standard_deviation"]
    assert found["3B"]["status"] == "fitted"
    assert found["3R"]["status"] == "combination"
    apart = {tuple(group["elements"]): group["known"] for group in data["not_told_apart"]}
    (known,) = apart["3R", "3U"]
    weights = known["weights"]
    assert abs(known["value"] - weights["3R"] - 3.0 * weights["3U"]) < (3.0 * known["standard_deviation"])
    (held,) = data["held_out"]
    before, after = (held[f"residual_rms_{k}_m_m_m_rad_rad_rad"] for k in ("before", "after"))
    assert before[3] > 2.0 * after[3]
    assert data["deflection_noise_m_m_m_rad_rad_rad"][0] == pytest.approx(1e-7, rel=0.3)
    fitted, pose = load(str(out)), [-0.6, 0.0, 0.0]
    expected = load("upr_rpu").changed(element_compliance={"3U": 3.0})
    assert fitted.element_compliance["3U"] == pytest.approx(3.0, abs=0.7)
    np.testing.assert_allclose(np.diag(compliance(fitted, pose)), np.diag(compliance(expected, pose)), rtol=0.03)
    text = out.read_text()
    assert "element_compliance.3U: fitted from upr_rpu_soft_joint.mcap, +- " in text
    assert "# Loads do not distinguish 3R and 3U" in text
    page = (tmp_path / "fitted.html").read_text()
    assert page.count("data:image/png;base64,") == 2
    assert "Loads do not distinguish 3R and 3U" in page
    assert "exists" in twin.refused(*line)


def test_fit_of_a_table_with_three_gauges_says_what_it_found(twin, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = table(tmp_path / "static.csv", deflection=("dx", "dy", "dz"))
    done = twin.good("fit", "upr_rpu", path, "--what", "compliance", "--no-report")
    assert "do not distinguish" in done.out
    assert "static.csv, dz" in done.out and "static.csv, rx" not in done.out
    assert load(str(tmp_path / "fitted.yaml")).element_compliance["1B"] == pytest.approx(1.0, abs=0.36)


@pytest.fixture
def without_wrench(tmp_path):
    path = tmp_path / "no_wrench.mcap"
    with BagWriter(path) as bag:
        bag.add_topic("/joint_states", "sensor_msgs/msg/JointState")
        bag.add_topic("/measured_deflection", "geometry_msgs/msg/TransformStamped")
        for message in open_bag(SOFT).messages(["/joint_states", "/measured_deflection"]):
            bag.write(message.topic, message.message, message.log_time)
            if message.log_time > 1_700_000_001 * 10**9:
                break
    return path


def test_refusals(twin, tmp_path, monkeypatch, without_wrench):
    monkeypatch.chdir(tmp_path)
    plain = table(tmp_path / "with.csv", rows=slice(0, 60))
    for arguments, text in (
        (("upr_rpu", without_wrench), "no wrench in the bag"),
        (("upr_rpu", SOFT, "--topic", "/wrnch"), "is not in the bag"),
        (("delta_cu", COLLISION), "no deflection in the bag"),
        ((rigid("stewart", tmp_path / "rigid.yaml"), plain), "nothing is elastic"),
        (("upr_rpu", table(tmp_path / "a.csv", wrench=(), rows=slice(60))), "no wrench"),
        (("upr_rpu", table(tmp_path / "b.csv", deflection=(), rows=slice(60))), "no deflection"),
        (("upr_rpu", table(tmp_path / "c.csv", rows=slice(0, 9))), "too short to fit"),
    ):
        assert text in twin.refused("fit", *arguments, "--what", "compliance")
    for what, text in (
        (("compliance,friction",), "only compliance"),
        (("compliance", "--payload", "1"), "no --per-copy, --payload"),
        (("complience",), "did you mean 'compliance'"),
    ):
        assert text in twin("fit", "upr_rpu", plain, "--what", *what).one_line_error()
    assert [path.name for path in tmp_path.glob("*.yaml")] == ["rigid.yaml"]


@pytest.mark.parametrize(
    ("columns", "text"),
    [
        (dict.fromkeys(WRENCH, lambda v: v * 1e250), "line 2: fx"),
        (dict.fromkeys(WRENCH, lambda v: v * 1e-311), "line 2: fx"),
        (dict.fromkeys(DEFLECTION, lambda v: v * 1e300), "line 2: dx"),
        ({"limb_2.position": lambda v: 0.0 * v}, "limb_2.position at sample 0"),
    ],
)
def test_numbers_that_are_no_recording_of_this_machine(twin, tmp_path, monkeypatch, columns, text):
    monkeypatch.chdir(tmp_path)
    found = read_columns(table(tmp_path / "plain.csv", rows=THIRD))
    found |= {name: how(found[name]) for name, how in columns.items()}
    path = write_columns(tmp_path / "changed.csv", found)
    assert text in twin.refused("fit", "upr_rpu", path, "--what", "compliance")
    assert not list(tmp_path.glob("fitted*"))


def test_columns_and_topics_that_nothing_reads(twin, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plain = table(tmp_path / "plain.csv", rows=slice(0, 60))
    text = plain.read_text()
    for wrong, right in (("dX", "dx"), ("Fz", "fz"), ("limb_1.postion", "limb_1.position")):
        path = tmp_path / "misspelt.csv"
        path.write_text(text.replace(right, wrong, 1))
        assert right in twin.refused("fit", "upr_rpu", path, "--what", "compliance")
    for what in ("compliance", "friction"):
        line = ("fit", "upr_rpu", plain, "--what", what, "--topic", "/wrench")
        assert "--topic is for bags" in twin.good(*line, code=2).err


def test_beyond_limits_is_refused_or_marked_everywhere(twin, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot = tmp_path / "short.yaml"
    source = (FOLDER.parent / "config" / "upr_rpu.yaml").read_text()
    robot.write_text(source.replace("limb_length: [0.300, 1.000]", "limb_length: [0.62, 1.0]"))
    plain = table(tmp_path / "plain.csv", rows=THIRD)
    arguments = ("fit", robot, plain, "--what", "compliance")
    assert "--beyond-limits" in twin.refused(*arguments)
    (line, *_) = twin.told(*arguments, "--beyond-limits")["beyond_limits"]
    assert line.startswith("beyond limits: plain.csv: limb_")
    assert f"# {line}" in (tmp_path / "fitted.yaml").read_text()
    assert line in (tmp_path / "fitted.html").read_text()


def test_an_element_that_a_bound_holds_stays_a_compliance(twin, tmp_path, monkeypatch):
    """The written file can be read: zero is no compliance."""
    monkeypatch.chdir(tmp_path)
    recording = noisy(twin_recording({"1B": 0.02, "2B": 0.02}), np.random.default_rng(3), SENSORS)
    data = np.concatenate([recording.q, recording.wrench, recording.deflection], -1)[::3]
    names = [f"{name}.position" for name in load("upr_rpu").joint_names]
    names += [*WRENCH, *DEFLECTION]
    write_columns(tmp_path / "stiff.csv", dict(zip(names, data.T, strict=True)))
    twin.good("fit", "upr_rpu", "stiff.csv", "--what", "compliance", "--no-report")
    assert min(load("fitted.yaml").element_compliance.values()) > 0.0


def test_a_deflection_type_without_its_fields(twin, tmp_path, monkeypatch):
    """A definition of one's own below the right type's name, its messages sound."""
    monkeypatch.chdir(tmp_path)
    topics = {"/joint_states": "JointState", "/wrench": "WrenchStamped"}
    with BagWriter("bag.mcap") as bag:
        for topic, kind in topics.items():
            package = "sensor_msgs" if kind == "JointState" else "geometry_msgs"
            bag.add_topic(topic, f"{package}/msg/{kind}")
        bag.add_topic("/measured_deflection", "geometry_msgs/msg/TransformStamped", definition="float64 x")
        for k, message in enumerate(open_bag(SOFT).messages(list(topics))):
            if k == 100:
                break
            bag.write(message.topic, message.message, message.log_time)
            bag.write("/measured_deflection", {"x": 1.0}, message.log_time)
    error = twin.refused("fit", "upr_rpu", "bag.mcap", "--what", "compliance")
    assert "/measured_deflection: the bag's definition" in error
    assert "differs at the field 'header'" in error


def test_wrenches_in_two_frames_have_no_middle(twin, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with BagWriter("bag.mcap") as bag:
        bag.add_topic("/joint_states", "sensor_msgs/msg/JointState")
        bag.add_topic("/wrench", "geometry_msgs/msg/WrenchStamped")
        bag.add_topic("/measured_deflection", "geometry_msgs/msg/TransformStamped")
        topics = ["/joint_states", "/wrench", "/measured_deflection"]
        for k, message in enumerate(open_bag(SOFT).messages(topics)):
            if k == 300:
                break
            if message.topic == "/wrench" and k > 150:
                message.message.header.frame_id = "base_link"
            bag.write(message.topic, message.message, message.log_time)
    error = twin.refused("fit", "upr_rpu", "bag.mcap", "--what", "compliance")
    assert "frame is 'base_link', expected 'platform'" in error


def test_a_robots_own_numbers_are_read_as_the_twin_reads_them(twin, tmp_path, monkeypatch):
    """1e-01 is a word for other readers of YAML; below a millionth no element is elastic."""
    monkeypatch.chdir(tmp_path)
    source = (FOLDER.parent / "config" / "upr_rpu.yaml").read_text()
    plain = table(tmp_path / "plain.csv", rows=THIRD)
    for value, code in (("9e-1", 0), ("1e-300", 1), ("1e7", 1)):
        (tmp_path / "mine.yaml").write_text(f"{source}element_compliance: {{3R: {value}}}\n")
        line = ("fit", "mine.yaml", plain, "--what", "compliance", "--overwrite", "--no-report")
        done = twin.good(*line, code=code)
        if code:
            assert "element_compliance.3R" in done.one_line_error()
