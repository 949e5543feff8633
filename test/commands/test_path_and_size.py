# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""`pkm-twin path` as a user runs it."""

import numpy as np
import pytest
import yaml

from delta_dynamics import inverse_dynamics
from pkm_twin.paths import cycle, fastest, timed
from pkm_twin.recordings import write_table
from test.commands.conftest import CYCLE, checked
from test.support.robots import load, parameters_of, partly_long
from test.support.tables import joined, read_columns


def test_a_cycle_as_a_table_that_torques_reads(twin, tmp_path):
    out = tmp_path / "cycle.csv"
    data = twin.told(*CYCLE, "--out", out)
    assert out.with_suffix(".png").read_bytes()[:4] == b"\x89PNG"
    robot = load("delta")
    assert data["duration_s"] == pytest.approx(fastest(robot, cycle(robot, 0.025, 0.305, 0.025)).duration)
    assert data["length_m"] == pytest.approx(0.71)
    ends = [limit["to_s"] for limit in data["limits"]]
    assert ends == sorted(ends)
    assert {"effort arm_1", "velocity arm_1"} <= {limit["limit"] for limit in data["limits"]}
    assert max(data["used"].values()) == pytest.approx(1.0, abs=1e-3)
    columns = read_columns(out)
    words = ("position", "velocity", "acceleration", "effort")
    joints = [f"{joint}.{word}" for joint in robot.joint_names for word in words]
    pose = [f"{name}{word}" for word in ("", ".velocity", ".acceleration") for name in "xyz"]
    origin = ["computed_with.delta", *(f"gravity.{axis}" for axis in "xyz")]
    assert list(columns) == ["time", *joints, *pose, *origin]
    q, qd, qdd, effort = (joined(columns, robot, word) for word in words)
    assert (np.abs(effort) <= robot.limits.effort).all()
    np.testing.assert_allclose(robot.inverse(np.stack([columns[n] for n in "xyz"], -1)), q)
    again = tmp_path / "torques.csv"
    twin.good("torques", "delta", out, "--out", again, "--no-picture")
    np.testing.assert_allclose(joined(read_columns(again), robot, "effort"), effort, atol=1e-9)
    np.testing.assert_allclose(inverse_dynamics(robot, q, qd, qdd), effort, atol=1e-9)


def test_a_planned_table_is_checked_and_one_with_other_efforts_is_bad(twin, tmp_path):
    out = tmp_path / "cycle.csv"
    robot = "linear_delta"
    twin.good("path", robot, "--cycle", "25,100,25", "--fastest", "--out", out, "--no-picture")
    assert "none is measured" in twin.good("check", out, "--robot", robot).out
    assert checked(out, robot=robot, payload="1.0").code == 1
    twin.refused("check", out)


def test_the_table_of_another_machine_is_rejected_or_its_pose_planned_again(twin, tmp_path):
    """A table's pose and its joint positions have to be those of the machine."""
    motion, out = tmp_path / "motion.csv", tmp_path / "torques.csv"
    line = ("--cycle", "25,200,25", "--duration", "0.8", "--rate", "200", "--payload", "0.3")
    twin.good("path", "delta", *line, "--no-picture", "--out", motion)
    other = tmp_path / "other.yaml"
    data = parameters_of("delta")
    data["geometry"]["arm_length"] += 0.002
    other.write_text(yaml.safe_dump(data))
    for command in ("torques", "size", "loads"):
        assert "mm" in twin.refused(command, other, motion)
    twin.good("torques", other, motion, "--follow", "pose", "--out", out, "--no-picture")
    # The same path of the platform, each machine by its own inverse kinematics.
    planned = timed(
        load(other).changed(payload={"mass": 0.3}),
        cycle(load("delta"), 0.025, 0.2, 0.025),
        "quintic",
        duration=0.8,
    ).uniform(200)
    columns, robot = read_columns(out), load(other)
    np.testing.assert_allclose(joined(columns, robot, "position"), planned.q, atol=1e-9)
    scale = np.abs(planned.effort).max()
    np.testing.assert_allclose(joined(columns, robot, "effort"), planned.effort, atol=1e-3 * scale)
    # The payload is that of the table.
    np.testing.assert_allclose(columns["payload.mass"], 0.3)
    other_joints = twin.told("size", other, motion, "--follow", "joints")
    assert other_joints["payload"]["mass_kg"] == 0.3


@pytest.mark.parametrize("payload", ["0.7", "0.7,0.01,0.0,-0.02"])
@pytest.mark.parametrize("ending", ["csv", "mcap"])
def test_a_planned_payload_is_read_again(twin, tmp_path, ending, payload):
    out = tmp_path / f"heavy.{ending}"
    line = ("path", "delta", "--circle", "0.04", "--duration", "1", "--rate", "100")
    twin.good(*line, "--no-picture", "--payload", payload, "--out", out)
    data = twin.told("size", "delta", out)
    assert max(data["difference_from_model"]) < 1e-6
    peak = max(drive["joint"]["peak_effort_N_m"] for drive in data["drives"].values())
    line = ("design", "delta", "--vary", "geometry.arm_length=0.18:0.2", "--path", out)
    found = twin.told(*line, "--minimise", "peak-effort", "--starts", "2")
    assert found["quantities"]["peak-effort"]["before"] == pytest.approx(peak)


def test_torques_takes_the_pose_in_place_of_the_joints(twin, tmp_path):
    robot = load("delta")
    time = np.linspace(0.0, 1.0, 400)
    pose = robot.home() + 0.03 * np.stack([np.sin(3 * time), np.cos(2 * time), 0 * time], -1)
    given, out = tmp_path / "poses.csv", tmp_path / "torques.csv"
    rows = np.column_stack([time, pose])
    given.write_text("time,x,y,z\n" + "\n".join(",".join(map(repr, r)) for r in rows.tolist()))
    twin.good("torques", "delta", given, "--out", out, "--no-picture")
    columns = read_columns(out)
    np.testing.assert_allclose(joined(columns, robot, "position"), robot.inverse(pose))
    given.write_text("time,x,y\n0,0,0\n1,0,0\n2,0,0\n")
    twin.refused("torques", "delta", given, "--out", tmp_path / "none.csv")


WAYPOINTS = "x,y,z,blend,dwell\n-0.05,0,-0.38,0,0\n-0.05,0,-0.35,0.02,0\n0.05,0,-0.35,0,0.1\n"


def test_way_points_are_lines_or_a_smooth_curve(twin, tmp_path):
    path = tmp_path / "points.csv"
    path.write_text(WAYPOINTS)
    data = twin.told("path", "delta", path, "--fastest")
    assert data["path"] == "lines"
    assert [s["dwell_s"] for s in data["stretches"]] == [0.1]
    path.write_text("x,y,z\n-0.05,0,-0.38\n-0.05,0,-0.35\n0.05,0,-0.35\n")
    data = twin.told("path", "delta", path, "--fastest")
    assert data["path"] == "smooth curve"
    stops = twin.told("path", "delta", path, "--blend", "0")
    assert len(stops["stretches"]) == 2
    joints = ",".join(f"{joint}.position" for joint in load("delta").joint_names)
    path.write_text(f"{joints}\n0.1,0.1,0.1\n0.2,0.3,0.1\n")
    data = twin.told("path", "delta", path, "--law", "s-curve")
    assert data["law"] == "s-curve"
    # The table of a motion is a path too, with its payload.
    out = tmp_path / "circle.csv"
    line = ("path", "delta", "--circle", "0.04", "--duration", "1", "--payload", "0.2")
    twin.good(*line, "--rate", "50", "--out", out, "--no-picture")
    line = ("path", "delta", out, "--fastest")
    own, told = (twin.told(*line, *options) for options in ((), ("--payload", "0.2")))
    assert own["payload"]["mass_kg"] == 0.2
    assert own["duration_s"] == told["duration_s"]


@pytest.mark.parametrize("payload", ["1e9", "900", "-1", ""])
def test_a_payload_that_cannot_be_is_named_by_its_line_and_column(twin, tmp_path, payload):
    path = tmp_path / "points.csv"
    path.write_text(f"x,y,z,payload\n0,0,-0.35,0\n0,0,-0.4,{payload}\n0,0,-0.35,0\n")
    assert f"{path}: line 3, column payload: " in twin.refused("path", "delta", path)


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("x,y\n0,0\n0,1\n", ()),
        ("x,y,z,blnd\n0,0,-0.3,0\n0,0,-0.4,0\n", ()),
        ("x,y,z\n0,0,-0.3\n0,0,-9\n", ()),
        ("x,y,z,arc\n0,0,-0.3,1\n0,0,-0.4,0\n", ()),
        ("x,y,z\n0,0,-0.35\n0,0,-0.35\n", ()),
        ("x,y,z\n0,0,-0.35\n", ()),
        ("x,y,z\n0,0,-0.35\n0,0,-0.4\n", ("--duration", "0.001")),
        ("x,y,z\n0,0,-0.35\n0,0,-0.4\n", ("--law", "cubic")),
        ("x,y,z\n0,0,-0.35\n0,0,-0.4\n", ("--out", "a.txt")),
    ],
)
def test_what_is_no_path_is_one_line(twin, tmp_path, text, options):
    path = tmp_path / "points.csv"
    path.write_text(text)
    said = twin.refused("path", "delta", path, *options, code=2 if "--law" in options else 1)
    # An error of the table names the file.
    assert options or text.endswith("-9\n") or f"{path}: " in said


def test_a_command_line_needs_one_path(twin, tmp_path):
    for words in (
        "path delta",
        "path delta --cycle 0.025,0.305",
        "path delta --cycle 25,305 --circle 0.1",
        "path delta --circle 0.1 --direction 45",
        "path delta --cycle 25,305 --effort 1,2",
        "size delta",
    ):
        twin.good(*words.split(), code=2)


LOADED = (
    "x,y,z,blend,dwell,payload\n-0.10,0,-0.42,0,0,0\n-0.10,0,-0.36,0.03,0,0.5\n"
    "0.08,0.06,-0.36,0.03,0,0.5\n0.08,0.06,-0.42,0,0.1,0.2\n"
    "0.08,0.06,-0.42,0,0.1,0\n0,0,-0.4,0,0,0\n"
)


@pytest.mark.parametrize("ending", partly_long(["csv", "mcap"], "mcap"))
def test_payloads_of_waypoints_go_with_the_motion(twin, tmp_path, ending):
    points, out = tmp_path / "points.csv", tmp_path / f"motion.{ending}"
    points.write_text(LOADED)
    line = ("path", "delta", points, "--duration", "4", "--no-picture")
    plan = twin.told(*line, "--out", out)["payload"]
    assert plan["masses_kg"] == [0.5, 0.2]
    data = twin.told("size", "delta", out)
    assert max(data["difference_from_model"]) < 1e-9
    assert data["payload"]["masses_kg"] == [0.5, 0.2]
    period = 1e-3 if ending == "csv" else 1e-9
    np.testing.assert_allclose(data["payload"]["held_s"], plan["held_s"], atol=period)
    inertia = data["drives"]["arm_1"]["load_inertia_kg_m2"]
    assert inertia[1] > 1.5 * inertia[0]
    twin.good("loads", "delta", out)
    assert "delta computes, none is measured" in twin.good("check", out, "--robot", "delta").out
    twin.good("check", out, "--robot", "delta", "--payload", "0", code=1)
    if ending == "csv":
        # As waypoints again, and as poses alone under the short name.
        rows = read_columns(out)
        columns = {name: rows[name][::50] for name in ("x", "y", "z")}
        columns["payload"] = rows["payload.mass"][::50]
        write_table(columns, points)
        again = twin.told("path", "delta", points)["payload"]
        assert again["mass_kg"] == 0.5
        write_table({"time": np.arange(len(columns["x"])) * 0.1} | columns, points)
        posed = twin.told("size", "delta", points)["payload"]
        assert posed["masses_kg"] == [0.5, 0.2]


def test_a_payload_between_two_waypoints_of_a_cycle(twin, tmp_path):
    line = ("path", "delta", "--cycle", "25,305,25")
    data = twin.told(*line, "--load", "0.5@0:3")
    ((begin, end),) = data["payload"]["held_s"]
    assert (begin, end) == (0.0, pytest.approx(data["stretches"][1]["begin_s"], abs=1e-9))
    # A cycle of a quarter of a second can be checked between the changes of its payload.
    out = tmp_path / "cycle.csv"
    twin.good(*line, "--fastest", "--load", "0.5@0:3", "--out", out, "--no-picture")
    assert checked(out, robot="delta").code == 0
    assert checked(out, robot="delta", payload="0.5").code == 1
    for wrong in ("0.5@3:3", "0.5@0:7", "x@0:1", "0.5", "500@0:3", "0.5@\u0660:3"):
        twin(*line, "--load", wrong).one_line_error()
    twin.good(*line, "--load", "0.5@0:3", "--payload", "1", code=2)
    points = tmp_path / "points.csv"
    points.write_text(LOADED)
    for option in (("--load", "0.5@0:3"), ("--payload", "1")):
        twin.good("path", "delta", points, *option, code=2)
    twin.good(*line, "--load", "0.5@0:3", "--load", "0.5@2:4", code=2)
