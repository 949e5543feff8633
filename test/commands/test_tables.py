# SPDX-License-Identifier: Apache-2.0
"""Tables as other programs write them are the same motion, and what is not certain is refused."""

import csv
import json
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from pkm_twin.errors import ParameterError
from pkm_twin.recordings import ReadOptions, read
from test.support.command import command
from test.support.robots import load

ROOT = Path(__file__).parents[2]


@pytest.fixture
def motion(tmp_path, monkeypatch):
    """Times, positions and velocities of a motion of the linear Delta, and the robot."""
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


def sized(capsys, *words):
    done = command(capsys, "size", "five_bar", *words, "--json")
    assert done.code == 0, done.err
    return json.loads(done.out)["drives"]


def numbers_of(data):
    if isinstance(data, dict):
        return [n for value in data.values() for n in numbers_of(value)]
    if isinstance(data, list):
        return [n for value in data for n in numbers_of(value)]
    return [data] if isinstance(data, float | int) else []


def same(one, other):
    np.testing.assert_allclose(numbers_of(one), numbers_of(other), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("separator", "point", "options"),
    [
        (";", ".", ()),
        (";", ",", ()),
        ("\t", ",", ()),
        (";", ",", ("--separator", ";", "--decimal", ",")),
        ("\t", ".", ("--separator", "tab")),
    ],
)
def test_separators_and_decimal_commas(separator, point, options, motion, capsys):
    robot, time, q = motion
    Path("a.csv").write_text(plain(robot, time, q))
    header = ["time", *(f"{j}.position" for j in robot.joint_names)]
    Path("b.csv").write_text(written(header, [time, *q.T], separator, point))
    same(sized(capsys, "b.csv", *options), sized(capsys, "a.csv"))


def test_names_and_units_of_columns(motion, capsys):
    robot, time, q = motion
    Path("a.csv").write_text(plain(robot, time, q))
    Path("b.csv").write_text(written(["t", "q1", "q2"], [1e3 * time, *np.degrees(q.T)], ";", ","))
    names = f"time=t,{robot.joint_names[0]}.position=q1,{robot.joint_names[1]}.position=q2"
    same(
        sized(capsys, "b.csv", "--columns", names, "--units", "deg,ms"), sized(capsys, "a.csv")
    )  # fmt: skip
    others = names.removeprefix("time=t,")
    both = ("--time", "t", "--columns", others, "--units", "deg,ms")
    same(sized(capsys, "b.csv", *both), sized(capsys, "a.csv"))
    # Lengths stay as they are where a joint slides.
    legs = load("stewart")
    q = np.tile(legs.graph.home, (5, 1))
    Path("c.csv").write_text(plain(legs, 0.1 * np.arange(5), q))
    done = command(capsys, "size", "stewart", "c.csv", "--units", "deg", "--json")
    assert done.code == 0, done.err


@pytest.mark.parametrize(
    "options",
    [
        ("--separator", "|"), ("--decimal", ";"), ("--units", "inch"), ("--units", "deg,rad"),
        ("--columns", "time"), ("--columns", "time=nothing"), ("--time", "nothing"),
        ("--time", "t", "--columns", "time=u"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(options, motion, capsys):
    Path("a.csv").write_text(plain(*motion).replace("time", "t"))
    assert command(capsys, "size", "five_bar", "a.csv", *options).code == 1


def test_an_ambiguous_table_is_refused(motion, capsys):
    """Commas between columns and a decimal comma: nobody can tell."""
    robot, time, q = motion
    header = ["time", *(f"{j}.position" for j in robot.joint_names)]
    Path("a.csv").write_text(written(header, [time, *q.T], ",", ","))
    assert command(capsys, "size", "five_bar", "a.csv").code == 1


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
    # A cell that is empty in one row alone is an error.
    Path("empty.csv").write_text(table.rstrip("\n") + "1.0\n")
    with pytest.raises(ParameterError, match=r"line 2, column elbow\.fx"):
        read("empty.csv", robot)


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


def test_matlab_files_have_the_columns(motion, capsys):
    Path("a.csv").write_text(plain(*motion))
    for out in ("t.csv", "t.mat"):
        done = command(capsys, "torques", "five_bar", "a.csv", "--out", out, "--no-picture")
        assert done.code == 0, done.err
    found = {k: v for k, v in loadmat("t.mat").items() if not k.startswith("__")}
    with Path("t.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(found) == [re.sub(r"\W", "_", name) for name in rows[0]]
    for name, values in zip(rows[0], found.values(), strict=True):
        expected = [float(row[name] or "nan") for row in rows]
        np.testing.assert_array_equal(values[:, 0], expected)


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
