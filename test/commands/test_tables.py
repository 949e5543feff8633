# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Tables as other programs write them are the same motion, and what is not certain is refused."""

import json
import math
import os
import re
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.io import loadmat

from pkm_twin.bags.definitions import JOINT_STATE
from pkm_twin.bags.reader import BagWriter
from pkm_twin.errors import ParameterError
from pkm_twin.recordings import Dialect, ReadOptions, read, write_table
from pkm_twin.recordings.tables import UNITS, map_column_quantities, read_table
from pkm_twin.recordings.topics import DEFINITIONS
from test.bags.folders import make_folder
from test.support.robots import load, parameters_of
from test.support.tables import read_columns

ROOT = Path(__file__).parents[2]


@pytest.fixture
def motion(tmp_path, monkeypatch):
    """A robot, and times and positions of a motion of it."""
    monkeypatch.chdir(tmp_path)
    robot = load("five_bar")
    time = np.linspace(0.0, 0.4, 21)
    q = robot.graph.home + 0.1 * np.sin(np.outer(time, [5.0, 7.0]))
    return robot, time, q


def written(header, columns, separator=",", point="."):
    rows = [separator.join(header)]
    for row in zip(*columns, strict=True):
        rows.append(separator.join(repr(float(value)).replace(".", point) for value in row))
    return "\n".join(rows) + "\n"


def plain(robot, time, q):
    return written(["time", *(f"{j}.position" for j in robot.joint_names)], [time, *q.T])


def bag(path, robot, time, q):
    """The motion as joint states of an MCAP file."""
    with BagWriter(path, flush_period=None) as writer:
        writer.add_topic("/joint_states", JOINT_STATE, definition=DEFINITIONS[JOINT_STATE])
        for t, row in zip(time.tolist(), q.tolist(), strict=True):
            stamp = round(1e9 * t) + 1
            header = {"stamp": {"sec": 0, "nanosec": stamp}, "frame_id": ""}
            names = {"name": list(robot.joint_names), "position": row}
            writer.write("/joint_states", {"header": header} | names, stamp)
    return path


def saved(kind, robot, time, q):
    """The motion as a file of a kind, and the dialect that it needs."""
    joints = [f"{joint}.position" for joint in robot.joint_names]
    deg, path = np.degrees(q.T), Path("a.csv")
    text = {
        "comma": lambda: written(["time", *joints], [time, *q.T]),
        "semicolon": lambda: written(["time", *joints], [time, *q.T], ";"),
        "decimal comma": lambda: written(["time", *joints], [time, *q.T], ";", ","),
        "tabs": lambda: written(["time", *joints], [time, *q.T], "\t", ","),
        "units in headers": lambda: written(["time (ms)", *(f"{joint} [deg]" for joint in joints)], [1e3 * time, *deg]),
        "other names": lambda: "# of a logger\n" + written(["t", "q1", "q2"], [1e3 * time, *deg]),
    }
    if kind in text:
        path.write_text(text[kind]())
        names = f"{joints[0]}=q1,{joints[1]}=q2"
        other = Dialect.from_options(columns=names, units="deg,ms", time="t")
        return path, other if kind == "other names" else Dialect()
    if kind == "Parquet":
        pytest.importorskip("pyarrow")
        write_table(dict(zip(["time", *joints], [time, *q.T], strict=True)), Path("a.parquet"))
        return Path("a.parquet"), Dialect()
    path = bag(Path("a.mcap"), robot, time, q)
    return path if kind == "MCAP" else make_folder(Path("bag"), path), Dialect()


@pytest.mark.parametrize(
    "kind",
    [
        "comma",
        "semicolon",
        "decimal comma",
        "tabs",
        "units in headers",
        "other names",
        "Parquet",
        "MCAP",
        "rosbag2 folder",
    ],
)
def test_a_recording_is_the_same_in_all_kinds_of_files(kind, motion):
    robot, time, q = motion
    path, dialect = saved(kind, robot, time, q)
    r = read(path, robot, ReadOptions(dialect=dialect))
    np.testing.assert_allclose(r.time, time, atol=1e-9)
    np.testing.assert_allclose(r.q, q, rtol=1e-12)
    assert (r.qd, r.effort, r.wrench, r.load) == (None, None, None, None)
    found = r.with_rates()
    inner = slice(8, -8)
    exact = 0.1 * np.array([5.0, 7.0]) * np.cos(np.outer(found.time, [5.0, 7.0]))
    np.testing.assert_allclose(found.qd[inner], exact[inner], atol=0.01)


@pytest.mark.parametrize(
    "options",
    [
        {"separator": "|"},
        {"decimal": ";"},
        {"units": "inch"},
        {"units": "deg,rad"},
        {"columns": "time"},
        {"columns": "time=nothing"},
        {"time": "nothing"},
        {"time": "t", "columns": "time=u"},
        {"columns": "elbow=t"},
    ],
)
def test_what_cannot_be_is_refused(options, motion):
    Path("a.csv").write_text(plain(*motion).replace("time", "t"))
    with pytest.raises(ParameterError):
        read("a.csv", motion[0], ReadOptions(dialect=Dialect.from_options(**options)))


@pytest.mark.parametrize("header", ["time [mm]", "time_ms,time"])
def test_a_header_with_a_wrong_unit_or_twice_is_refused(header, motion):
    robot, time, q = motion
    text = plain(robot, time, q)
    Path("a.csv").write_text(text.replace("time", header.partition(",")[0]))
    if "," in header:
        columns = [header.split(",")[0], "time", *(f"{j}.position" for j in robot.joint_names)]
        Path("a.csv").write_text(written(columns, [time, time, *q.T]))
    with pytest.raises(ParameterError, match=r"unit|different names"):
        read("a.csv", robot)


def test_an_ambiguous_table_is_refused(motion):
    """Commas between columns and a decimal comma: nobody can tell."""
    robot, time, q = motion
    header = ["time", *(f"{j}.position" for j in robot.joint_names)]
    Path("a.csv").write_text(written(header, [time, *q.T], ",", ","))
    with pytest.raises(ParameterError):
        read("a.csv", robot)


@example(values=[1234], separator=";", marks=".,", end="\n", quote=False, other="")
@given(
    values=st.lists(st.integers(-(10**6), 10**6) | st.floats(-1e6, 1e6).map(lambda x: round(x, 3)), max_size=8),
    separator=st.sampled_from([",", ";", "\t"]),
    marks=st.sampled_from([".", ",", ".,", ",."]),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    quote=st.booleans(),
    other=st.sampled_from(["", "a, b", "1.5"]),
)
def test_marks_of_numbers_are_read_as_meant_or_the_table_is_refused(values, separator, marks, end, quote, other):
    """A decimal mark, and a second one between thousands; a fraction in the file tells one from the other."""
    values = [*values, 0.5]

    def told(value):
        text = f"{value:,.12g}" if len(marks) == 2 else f"{value:.12g}"
        text = text.translate(str.maketrans(".,", marks if len(marks) == 2 else marks + "'"))
        return f'"{text}"' if quote or separator in text else text

    word = f'"{other}"' if other else ""
    rows = [separator.join((str(k), told(value), word)) for k, value in enumerate(values)]
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder) / "a.csv"
        path.write_bytes((separator.join(("time", "x", "note")) + "\n" + end.join(rows) + 3 * end).encode())
        try:
            found = read_table(path, {"time": "time", "x": "length"})
        except ParameterError:
            assert len(marks) == 2 or (separator, marks) == (",", ",")  # A plain table is read.
            return
    assert found["x"].tolist() == values


def test_units_of_headers_are_those_of_the_column_or_refused(tmp_path):
    kinds = map_column_quantities(load("delta_cu"))
    for kind, name in {kind: name for name, kind in kinds.items()}.items():
        for unit, (quantity, size) in UNITS.items():
            for header in (f"{name} [{unit}]", f"{name}_{unit}", f"{name} ({unit}/s^2)"):
                path = tmp_path / "a.csv"
                path.write_text(f"{header}\n2.0\n")
                if quantity in kind.split():
                    assert read_table(path, kinds)[name].tolist() == [2.0 * size]
                else:
                    with pytest.raises(ParameterError, match="unit"):
                        read_table(path, kinds)
        for header in (name.upper(), f"{name} [furlong]"):
            path.write_text(f"{header}\n2.0\n")
            with pytest.raises(ParameterError):
                read_table(path, kinds)


def test_options_of_a_command_are_the_dialect(motion, twin):
    robot, time, q = motion
    Path("a.csv").write_text(plain(robot, time, q))
    Path("b.csv").write_text(written(["t", "q1", "q2"], [1e3 * time, *np.degrees(q.T)], ";", ","))
    names = f"{robot.joint_names[0]}.position=q1,{robot.joint_names[1]}.position=q2"
    given = ("--time", "t", "--columns", names, "--units", "deg,ms", "--decimal", ",")
    told = []
    for words in (("a.csv",), ("b.csv", "--separator", ";", *given)):
        told.append(twin.told("size", "five_bar", *words)["energy_J"])
    assert told[1] == pytest.approx(told[0], rel=1e-6)
    assert twin("check", "a.csv", "--robot", "five_bar", "--units", "inch").code == 2


@pytest.mark.parametrize("name", ["five_bar", "linear_delta"])
def test_values_of_the_controller_and_of_the_motor_are_made_the_joints(name, tmp_path, rng):
    """By joint_map, and by the drive's gear or screw; efforts in per cent of the rated torque."""
    data = parameters_of(name)
    joints = data["joints"] if name == "five_bar" else data["limbs"]["joints"]
    gear = {"ratio": 20.0} if name == "five_bar" else {"lead": 0.01}
    for joint in joints.values():
        if joint.pop("rotor_inertia", None) is not None or joint.get("actuated"):
            joint["drive"] = {"inertia": 1e-5, "rated_torque": 1.5, **gear}
    names = load(name).joint_names
    data["joint_map"] = {
        joint: {"name": f"axis_{k}", "sign": (-1) ** k, "offset": 3.0, "ratio": 50.0} for k, joint in enumerate(names)
    }
    path, out = tmp_path / f"{name}.yaml", tmp_path / "a.csv"
    path.write_text(yaml.safe_dump(data))
    robot = load(path)
    time = np.linspace(0.0, 0.4, 21)
    q = robot.graph.home + 0.05 * np.sin(np.outer(time, rng.uniform(2.0, 8.0, len(names))))
    qd, effort = np.gradient(q, time, axis=0), rng.normal(size=q.shape)
    turns = np.array([(-1) ** k * drive.turns for k, drive in enumerate(robot.drives)])
    own = robot.controller
    motor = (turns * q / math.tau, turns * qd / math.tau, 100.0 * effort / turns / 1.5)
    controller = (own.controller_positions(q), own.controller_rates(qd), own.controller_efforts(effort))
    header = [f"axis_{k}.{word}" for word in ("position", "velocity", "effort") for k in range(len(names))]
    for side, units, values in (
        ("motor", "rev,ms,percent", motor),
        ("controller", "ms", controller),
    ):
        out.write_text(written(["time", *header], [1e3 * time, *np.hstack(values).T]))
        r = read(out, robot, ReadOptions(dialect=Dialect.from_options(units=units), side=side))
        for found, expected in ((r.q, q), (r.qd, qd), (r.effort, effort)):
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    with pytest.raises(ParameterError, match="side motor"):
        read(out, robot, ReadOptions(dialect=Dialect.from_options(units="percent"), side="controller"))
    pose = robot.forward(q)
    words = [*(f"{joint}.position" for joint in names), *robot.pose_names]
    out.write_text(written(["time", *words], [time, *q.T, *pose.T]))
    assert read(out, robot, ReadOptions()).q == pytest.approx(q)
    with pytest.raises(ParameterError, match="no --side"):
        read(out, robot, ReadOptions(side="controller"))
    out.write_text(written(["time", *header], [time, *np.hstack(motor).T]).replace("axis", "leg"))
    with pytest.raises(ParameterError, match=r"axis_0\.position"):
        read(out, robot, ReadOptions(side="motor"))


@pytest.mark.parametrize("cell", ["nan", "-inf", "1_0", "x", ""])
def test_a_cell_without_a_number_is_named(cell, motion, rng):
    robot, time, q = motion
    header = ["time", *(f"{j}.position" for j in robot.joint_names)]
    row, column = int(rng.integers(len(time))), int(rng.integers(len(header)))
    lines = [line.split(",") for line in plain(robot, time, q).splitlines()]
    lines[1 + row][column] = cell
    Path("a.csv").write_text("\n".join(map(",".join, lines)))
    with pytest.raises(ParameterError) as error:
        read("a.csv", robot)
    assert f"line {2 + row}, column {header[column]}" in str(error.value)


def test_columns_without_any_number_are_not_there(motion):
    """`torques` writes reactions that rigid bodies do not determine as empty cells."""
    robot, time, q = motion
    header = ["time", *(f"{name}.position" for name in robot.joint_names)]
    lines = written(header, [time, *q.T]).splitlines()
    table = "\n".join([f"{lines[0]},elbow.fx", *(f"{line}," for line in lines[1:])]) + "\n"
    Path("empty.csv").write_text(table)
    assert read("empty.csv", robot).q == pytest.approx(q, abs=1e-12)
    # As are those that it does not determine for a while.
    Path("empty.csv").write_text(table.rstrip("\n") + "1.0\n")
    assert read("empty.csv", robot).q == pytest.approx(q, abs=1e-12)
    # But of a column that is read every cell is needed.
    needed = table.replace("elbow.fx", f"{robot.joint_names[0]}.effort")
    Path("empty.csv").write_text(needed.rstrip("\n") + "1\n")
    with pytest.raises(ParameterError, match=r"line 2, column .*\.effort"):
        read("empty.csv", robot)


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_columns_that_nobody_asked_for_are_left_alone(kind, motion):
    """A state in words, another machine's joint, a value that is not finite."""
    robot, time, q = motion
    path, joints = Path(f"a.{kind}"), [f"{joint}.position" for joint in robot.joint_names]
    others = {"state": ["RUN"] * len(time), "wheel.position": [math.inf] * len(time)}
    if kind == "parquet":
        pyarrow, parquet = map(pytest.importorskip, ("pyarrow", "pyarrow.parquet"))
        columns = dict(zip(["time", *joints], [time, *q.T], strict=True)) | others
        parquet.write_table(pyarrow.table(columns), path)
    else:
        head, *lines = plain(*motion).splitlines()
        more = [",".join(map(str, row)) for row in zip(*others.values(), strict=True)]
        rows = [f"{head},{','.join(others)}", *map(",".join, zip(lines, more, strict=True))]
        path.write_text("\n".join(rows))
    assert read(path, robot).q == pytest.approx(q, abs=1e-12)
    asked = Dialect.from_options(columns=f"{robot.joint_names[0]}.effort=state")
    with pytest.raises(ParameterError, match=r"RUN|Parquet"):
        read(path, robot, ReadOptions(dialect=asked))


def test_times_in_nanoseconds_since_1970_are_read_or_named(motion):
    robot, time, q = motion
    joints = [f"{joint}.position" for joint in robot.joint_names]
    Path("a.csv").write_text(written(["time", *joints], [1.7377e18 + 1e9 * time, *q.T]))
    r = read("a.csv", robot, ReadOptions(dialect=Dialect.from_options(units="ns")))
    np.testing.assert_allclose(r.time, time, atol=1e-6)
    with pytest.raises(ParameterError, match="--units ns"):
        read("a.csv", robot)


@pytest.mark.parametrize("name", ["five_bar", "delta", "linear_delta"])
def test_positions_in_degrees_are_noticed(name, tmp_path, rng):
    """Where all of a motion is possible in degrees, and most of it not in radians."""
    robot = load(name)
    time = np.linspace(0.0, 2.0, 201)
    wave = np.sin(np.outer(time, rng.uniform(2.0, 8.0, robot.joints_count)))
    q, path = robot.graph.home + 0.05 * robot.size * wave, tmp_path / "a.csv"
    header = ["time", *(f"{j}.position" for j in robot.joint_names)]
    glitch = q.copy()
    glitch[60, 0] += 60.0
    beyond = q + 1.0
    for values, noticed in (
        (q, 0),
        (glitch, 0),
        (beyond, 0),
        (np.degrees(q), robot.joint_units[0] == "rad"),
    ):
        path.write_text(written(header, [time, *values.T]))
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            read(path, robot)
        assert sum("--units deg" in str(one.message) for one in told) == noticed


@pytest.mark.parametrize("name", ["five_bar", "delta"])
def test_a_pose_has_to_be_that_of_the_joints(name, tmp_path, rng):
    """Of a recording as of a planned motion: a table of another machine is none of this one."""
    robot = load(name)
    time = np.linspace(0.0, 0.4, 21)
    q = robot.graph.home + 0.1 * np.sin(np.outer(time, rng.uniform(2.0, 8.0, robot.joints_count)))
    pose, path = robot.forward(q), tmp_path / "a.csv"
    header = ["time", *(f"{j}.position" for j in robot.joint_names), *robot.pose_names]
    for how in (ReadOptions(), ReadOptions(planned=True)):
        path.write_text(written(header, [time, *q.T, *pose.T]))
        assert read(path, robot, how).q == pytest.approx(q)
        wrong = pose.copy()
        wrong[7, 0] += 0.01 * robot.size
        path.write_text(written(header, [time, *q.T, *wrong.T]))
        with pytest.raises(ParameterError, match="sample 7"):
            read(path, robot, how)


def test_matlab_files_have_the_columns(motion, twin):
    Path("a.csv").write_text(plain(*motion))
    for out in ("t.csv", "t.mat"):
        twin.good("torques", "five_bar", "a.csv", "--out", out, "--no-picture")
    found = {k: v for k, v in loadmat("t.mat").items() if not k.startswith("__")}
    expected = read_columns(Path("t.csv"))
    assert list(found) == [re.sub(r"\W", "_", name) for name in expected]
    for values, column in zip(found.values(), expected.values(), strict=True):
        np.testing.assert_array_equal(values[:, 0], column)


def test_pipes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot, time = load("delta"), np.linspace(0.0, 0.4, 21)
    q = robot.graph.home + 0.1 * np.sin(np.outer(time, [5.0, 7.0, 3.0]))
    base = [sys.executable, "-m", "pkm_twin.apps.cli"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = {"capture_output": True, "text": True, "check": True, "env": environment}
    words = [*base, "torques", "delta", "-", "--out", "-"]
    first = subprocess.run(words, input=plain(robot, time, q), **run)
    assert first.stdout.startswith("time,")
    assert len(first.stdout.splitlines()) == len(time) + 1
    second = subprocess.run([*base, "size", "delta", "-", "--json"], input=first.stdout, **run)
    assert json.loads(second.stdout)["efforts"] == "the file's"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a.mat", "a.csv.gz", "a.xlsx"])
def test_a_file_that_is_no_text_is_named_with_what_to_do(name, motion, twin):
    Path(name).write_bytes(b"MATLAB 5.0 MAT-file\x00\x01\xff")
    for command in (("torques", "five_bar", name), ("check", name, "--robot", "five_bar")):
        assert "CSV" in (told := twin.refused(*command)) or "gunzip" in told
