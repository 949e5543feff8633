# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""`pkm-twin fit` and `pkm-twin excite` as a user runs them."""

import functools
from pathlib import Path

import numpy as np
import pytest
import yaml

from delta_dynamics import inverse_dynamics
from pkm_twin.apps.commands.excite import MAX_CONDITION_NUMBER, Excite, excite
from pkm_twin.bags.reader import open_bag
from pkm_twin.identification.identifiable import identifiable
from pkm_twin.identification.samples import Filtering, find_lines
from pkm_twin.mechanisms.entries import load_with_text
from stiffness_monitor import compliance
from test.commands.conftest import DELTA, MILLING, STIFFNESS, rewrite
from test.laws.recordings import smooth_motion
from test.support.robots import load, often, parameters_of
from test.support.tables import of_joints, read_columns, write_columns

LONG = functools.partial(pytest.param, marks=pytest.mark.long)


def table(path, robot, seconds=6.0, efforts=True):
    """A CSV of a motion, with what the robot needs for it."""
    time, q, qd, qdd = smooth_motion(robot, np.random.default_rng(1), seconds, 200.0)
    columns = {"time": time} | of_joints(robot, "position", q)
    if efforts:
        columns |= of_joints(robot, "effort", inverse_dynamics(robot, q, qd, qdd))
    return write_columns(path, columns)


def test_fit_of_a_table_writes_a_robot_with_deviations_and_a_report(twin, tmp_path):
    pytest.importorskip("cvxpy")
    true = load("five_bar").changed(
        friction={"viscous": [0.03, 0.05], "coulomb": [0.2, 0.15]},
        payload={"mass": 0.2, "com": [0.03, 0.0, 0.01], "inertia": [1e-4, 1e-4, 1e-4]},
    )
    source = table(tmp_path / "motion.csv", true)
    out = tmp_path / "fitted.yaml"
    data = twin.told("fit", "five_bar", source, "--what", "friction,payload", "--out", out)
    fitted = load(str(out))
    assert fitted.friction.viscous == pytest.approx([0.03, 0.05], rel=0.02)
    assert fitted.friction.coulomb == pytest.approx([0.2, 0.15], rel=0.02)
    assert fitted.payload.mass == pytest.approx(0.2, rel=0.01)
    assert fitted.payload.com[[0, 2]] == pytest.approx([0.03, 0.01], abs=2e-3)
    assert "payload.com[1]" in data["not_excited"]
    text = out.read_text()
    assert "fitted from motion.csv, +- " in text
    assert "Residual rms held out" in text
    page = (tmp_path / "fitted.html").read_text()
    assert page.count("data:image/png;base64,") == 2
    (held,) = data["held_out"]
    assert max(held["residual_rms_after"]) < 0.01 * max(held["residual_rms_before"])
    assert "exists" in twin.refused("fit", "five_bar", source, "--out", out)


def test_fit_of_a_recorded_bag_finds_the_payload(twin, tmp_path):
    bag = rewrite(DELTA, tmp_path / "held.mcap", seconds=8.0, begin=6.5)
    out = tmp_path / "fitted.yaml"
    data = twin.told(
        "fit",
        "delta_cu",
        bag,
        "--what",
        "payload",
        "--payload",
        "0",
        "--load-times",
        "1.775,8",
        "--out",
        out,
        "--no-report",
    )
    found = {p["key"]: p for p in data["parameters"]}
    mass = found["payload.mass"]
    assert mass["value"] == pytest.approx(0.15, rel=0.01)
    assert abs(mass["value"] - 0.15) < 3 * mass["standard_deviation"] + 1e-3
    assert found["payload.com[0]"]["status"] == "not excited"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("upr_rpu", STIFFNESS), "no efforts on /joint_states"),
        (("five_bar", "without.csv"), "left.effort"),
        (("five_bar", "short.csv"), "too short to fit"),
        (("five_bar", "with.csv", "--what", "frction"), "did you mean 'friction'"),
        (("five_bar", "with.csv", "--out", "fitted.json"), ".yaml"),
    ],
)
def test_refusals(twin, tmp_path, monkeypatch, arguments, text):
    robot = load("five_bar")
    table(tmp_path / "with.csv", robot, 2.0)
    table(tmp_path / "without.csv", robot, 2.0, efforts=False)
    table(tmp_path / "short.csv", robot, 0.5)
    monkeypatch.chdir(tmp_path)
    assert text in twin.refused("fit", *arguments, code=2 if "--what" in arguments else 1)


def test_excite_writes_a_trajectory_within_the_limits_that_rests_at_both_ends(twin, tmp_path):
    out = tmp_path / "excite.mcap"
    data = twin.told(
        "excite",
        "delta_cu",
        "--trials",
        "20",
        "--compare",
        DELTA,
        "--acceleration",
        "60",
        "--out",
        out,
    )
    assert 1.0 < data["condition"] < data["condition_compared"]
    (message,) = open_bag(out).messages()
    points = message.message.points
    robot = load("delta_cu")
    q, qd, qdd = (np.array([list(getattr(p, k)) for p in points]) for k in ("positions", "velocities", "accelerations"))
    assert list(message.message.joint_names) == list(robot.joint_names)
    for end in (0, -1):
        assert np.abs(qd[end]).max() < 1e-9
        assert np.abs(qdd[end]).max() < 1e-6
    assert (q >= robot.limits.position[:, 0]).all() and (q <= robot.limits.position[:, 1]).all()
    assert np.abs(qd).max() <= robot.limits.velocity.max()
    assert np.abs(qdd).max() <= 60.0
    assert (np.abs(inverse_dynamics(robot, q, qd, qdd)) <= robot.limits.effort).all()
    assert (robot.singularity(q) > 0.05 * 0.99).all()
    assert len(read_columns(out.with_suffix(".csv"))["time"]) == len(points)


@pytest.mark.parametrize("trials", [10, 60])
def test_excite_says_what_to_change_where_a_fit_would_know_little(tmp_path, trials):
    """Ten slow tries in a second are no excitation; sixty in ten seconds are."""
    short = {"duration": 1.0, "harmonics": 3, "acceleration": 0.1} if trials == 10 else {}
    out = tmp_path / "excite.mcap"
    report = excite.run(Excite(robot="five_bar", what="friction", trials=trials, out=out, **short))
    assert bool(report.notes) == (report.data["condition"] > MAX_CONDITION_NUMBER) == bool(short)


def elastic_machine(path):
    """A 3-RPS head with elastic parts in its limbs, and a controller that counts otherwise."""
    data = parameters_of("rps3")
    (section,) = data["limbs"] if isinstance(data["limbs"], list) else [data["limbs"]]
    names = load("rps3").joint_names
    for k, (name, joint) in enumerate(section["joints"].items()):
        joint["compliance"] = [1e-8, 1e-8, 1e-8, 1e-6, 2e-6 * (k + 1), 1e-6]
        assert name
    data["joint_map"] = {names[0]: {"sign": -1, "offset": 0.02}}
    path.write_text(yaml.safe_dump(data))
    return load(str(path))


def test_copies_of_a_limb_keep_elastic_parts_and_the_joint_map(tmp_path):
    source = tmp_path / "elastic.yaml"
    robot = elastic_machine(source)
    text, written = load_with_text(str(source), per_copy=True)
    out = tmp_path / "written.yaml"
    out.write_text(text)
    for other in (written, load(str(out))):
        assert other.controller.offsets == pytest.approx(robot.controller.offsets)
        assert other.controller.factors == pytest.approx(robot.controller.factors)
        assert len(identifiable(other)) > len(identifiable(robot))
        expected = compliance(robot, robot.home())
        assert compliance(other, other.home()) == pytest.approx(expected, rel=1e-9)
    again = robot.with_file_values({"origin[2]": robot.file_numbers()["origin[2]"][0]})
    assert again.structure().compliances == robot.structure().compliances
    assert [beam.radius for beam in again.beams] == [beam.radius for beam in robot.beams]


def test_copies_that_would_lose_elastic_members_are_refused_by_name(twin, tmp_path):
    data = parameters_of("delta")
    assert data.pop("members")
    data["joint_map"] = {load("delta").joint_names[0]: {"offset": 0.1}}
    rigid = tmp_path / "rigid.yaml"
    rigid.write_text(yaml.safe_dump(data))
    assert load_with_text(str(rigid), per_copy=True)[1].controller.offsets[0] == pytest.approx(0.1)
    out = tmp_path / "fitted.yaml"
    assert "members" in twin.refused("fit", "delta_cu", DELTA, "--per-copy", "--out", out)
    assert not out.exists()


@pytest.mark.parametrize(
    ("column", "how", "text"),
    [
        ("time", lambda v: v * 1e-300, "time: '0.0, then "),
        LONG("time", lambda v: v * 1e300, "1e+06 s in all"),
        ("effort", lambda v: v * 1e3, "times what the robot's file makes of the motion: units?"),
        LONG("effort", lambda v: v * 1e-3, "times what the robot's file makes of the motion: units?"),
        ("effort", lambda v: v * 1e-300, "nothing was measured"),
        ("position", lambda v: v + 3.0, "--beyond-limits"),
    ],
)
def test_numbers_that_are_no_recording_of_this_machine(twin, tmp_path, monkeypatch, column, how, text):
    monkeypatch.chdir(tmp_path)
    columns = read_columns(table(tmp_path / "plain.csv", load("five_bar"), 3.0))
    for name, values in columns.items():
        if name.rpartition(".")[2] == column:
            columns[name] = how(values)
    line = ("fit", "five_bar", write_columns(Path("m.csv"), columns), "--what", "friction")
    assert text in twin.refused(*line)
    assert not list(tmp_path.glob("fitted*"))
    if text.endswith("units?") and how(1.0) > 1.0:
        data = twin.told(*line, "--accept")
        (reason,) = data["accepted"]
        for marked in (Path("fitted.yaml"), Path("fitted.html")):
            assert "accepted by --accept" in marked.read_text()
        assert "units?" in reason and data["verdict"]["model"] != "explains"
        assert {p["standard_deviation"] for p in data["parameters"]} == {None}
    if column == "position":
        done = twin(*line, "--beyond-limits", "--accept", "--no-report", "--json")
        # Marked, or not reachable there at all: what moves so is no machine of this file.
        assert "beyond limits" in done.out or "unreachable" in done.err


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_a_table_of_few_rows_is_too_short_in_a_line(twin, tmp_path, rows):
    columns = read_columns(table(tmp_path / "plain.csv", load("five_bar"), 3.0))
    few = write_columns(tmp_path / "few.csv", {n: v[:rows] for n, v in columns.items()})
    assert "too short" in twin.refused("fit", "five_bar", few, "--out", tmp_path / "out.yaml")
    assert twin("check", few, "--robot", "five_bar").code == 4


@pytest.mark.parametrize("accept", often(False, True))
def test_values_that_predict_the_held_out_part_worse_are_not_written(accept, twin, tmp_path):
    """The shipped file explains the shipped recording, whose line at 47 Hz is the cutter's."""
    out = tmp_path / "out.yaml"
    line = "fit", "prru", MILLING, "--out", out, "--no-report"
    if not accept:
        assert "worse" in twin.refused(*line)
        assert not out.exists()
        return
    data = twin.told(*line, "--accept")
    assert out.exists() and "worse" in out.read_text()
    assert not [one for one in data["verdict"]["findings"] if "line" in one["kind"]]


@pytest.mark.parametrize("forced", [True, False])
def test_a_line_of_the_measured_wrench_is_not_the_machine_s(forced, rng):
    time, how = np.arange(8192) / 1000.0, Filtering(9, (), 5.0, 1)
    line = np.sin(2.0 * np.pi * 47.3 * time)
    residual = line[:, None] * [1.0, 0.0] + 0.1 * rng.normal(size=(len(time), 2))
    wrench = rng.normal(size=(len(time), 6))
    wrench[:, 1] += 30.0 * line * forced
    found = find_lines([residual], 1e-3, how, np.ones(2), wrench)
    assert [ring.joint for ring in found] == ([] if forced else [0])
