# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What a command writes and another reads gives the answers of the source, or is rejected."""

import csv
import importlib.util
import json

import numpy as np
import pytest
import yaml

from delta_dynamics import inverse_dynamics
from pkm_twin.recordings import ReadOptions, read
from pkm_twin.recordings.origin import COMPUTED_WITH, GRAVITY
from pkm_twin.recordings.tables import PAYLOAD, WRENCH
from test.support.command import REPOSITORY
from test.support.robots import load, parameters_of, partly_long
from test.support.tables import of_joints, read_columns, write_columns

ENDINGS = ("csv", *(["parquet"] if importlib.util.find_spec("pyarrow") else []))
READERS = (
    ("loads",),
    ("size",),
    ("size", "--efforts", "model"),
    ("map", "--along"),
    ("torques", "--out", "-"),
)


def answers(twin, robot, path):
    """What each reader prints of a motion, without the name of its file."""
    told = []
    for command, *more in READERS:
        words = [path, *more]
        if command == "map":
            driven = load(robot).limits.effort is not None
            words = ["acceleration" if driven else "compliance", *more, path]
        out = twin.good(command, robot, *words, *(() if more[-1:] == ["-"] else ("--json",)))
        told.append(out.out if more[-1:] == ["-"] else json.loads(out.out))
    return told


def alike(found, expected):
    """Compare what readers print; a table has the times of a payload as sampled."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for key in expected.keys() - {"efforts", "notes", "held_s", "source", "bag", "history"}:
            alike(found[key], expected[key])
    elif isinstance(expected, list):
        assert len(found) == len(expected)
        for pair in zip(found, expected, strict=True):
            alike(*pair)
    elif isinstance(expected, float):
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-6)
    else:
        assert found == expected


def swings(robot, rng, count=101):
    """Times and joint positions of a motion from home and back."""
    time = np.linspace(0.0, 0.5, count)
    step = 0.05 * robot.size * np.sin(np.pi * time / time[-1]) ** 4
    return time, robot.inverse(robot.home()) + step[:, None] * rng.uniform(0.5, 1.0, robot.joints_count)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("name", partly_long(["delta", "five_bar", "upr_rpu", "stewart"], "delta", "upr_rpu"))
def test_a_table_of_torques_gives_the_answers_of_its_source(name, ending, twin, tmp_path, rng):
    """Of positions under a wrench, with a payload for a part of the time."""
    robot, source, out = load(name), tmp_path / "source.csv", tmp_path / f"written.{ending}"
    time, q = swings(robot, rng)
    held = ((time > 0.1) & (time < 0.3)).astype(float)
    load_columns = dict(zip(PAYLOAD, np.outer([0.7, 0.01, 0.0, -0.02], held), strict=True))
    wrench = np.outer([3.0, -5.0, -40.0, 0.2, 0.1, 0.3], 1.0 + time)
    columns = {"time": time} | of_joints(robot, "position", q)
    write_columns(source, columns | dict(zip(WRENCH, wrench, strict=True)) | load_columns)
    twin.good("torques", name, source, "--out", out, "--no-picture")
    *first, table = answers(twin, name, source)
    *again, same = answers(twin, name, out)
    alike(again, first)
    assert same == table
    r = read(out, name, ReadOptions(planned=True))
    np.testing.assert_allclose(r.wrench, wrench.T)
    carried = r.load.mass_at(r.time)
    np.testing.assert_allclose(np.where(np.isnan(carried), robot.payload.mass, carried), 0.7 * held)


@pytest.mark.parametrize("ending", partly_long([*ENDINGS, "mcap"], "csv", "mcap"))
@pytest.mark.parametrize("name", partly_long(["delta", "linear_delta"], "linear_delta"))
def test_a_planned_cycle_gives_the_same_answers_in_every_format(name, ending, twin, tmp_path):
    first, out = tmp_path / "first.csv", tmp_path / f"again.{ending}"
    for path in (first, out):
        twin.good(
            "path",
            name,
            "--cycle",
            "25,200,25",
            "--load",
            "0.5@0:3",
            "--fastest",
            "--out",
            path,
            "--no-picture",
        )
    *expected, table = answers(twin, name, first)
    *found, same = answers(twin, name, out)
    alike(found, expected)
    assert ending == "mcap" or same == table
    judged = twin.told("check", out, "--robot", name)
    assert judged["good"] and "none is measured" in twin.good("check", out, "--robot", name).out


@pytest.mark.parametrize("name", partly_long(["delta", "upr_rpu"], "upr_rpu"))
def test_an_exciting_motion_is_the_same_in_its_bag_its_table_and_a_recovered_bag(name, twin, tmp_path):
    bag, again = tmp_path / "motion.mcap", tmp_path / "again.mcap"
    twin.good("excite", name, "--out", bag, "--duration", "2", "--harmonics", "3", "--trials", "10", "--rate", "50")
    twin.good("recover", bag, again)
    first, *others = (bag.with_suffix(".csv"), bag, again)
    vary = {"delta": "geometry.arm_length=0.18:0.22", "upr_rpu": "geometry.platform_radius=0.25:0.27"}[name]
    design = ("design", name, "--minimise", "peak-effort", "--vary", vary, "--starts", "1", "--path")

    def told(path):
        *found, _ = answers(twin, name, path)
        return [*found, twin.told(*design, path)]

    expected = told(first)
    verdict = twin("check", first, "--robot", name, "--json")
    for path in others:
        alike(told(path), expected)
        judged = twin("check", path, "--robot", name, "--json")
        assert judged.code == verdict.code
        assert json.loads(judged.out)["good"] == json.loads(verdict.out)["good"]


@pytest.mark.long
@pytest.mark.parametrize("bag, robot", [("delta_cu_pick_and_place", "delta_cu"), ("prru_milling", "prru")])
def test_a_recovered_recording_gives_the_verdicts_and_numbers_of_its_source(bag, robot, twin, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source, again = REPOSITORY / "bags" / f"{bag}.mcap", tmp_path / f"{bag}.mcap"
    twin.good("recover", source, again)
    found = []
    for number, path in enumerate((source, again)):
        judged = twin("check", path, "--json", "--history", f"{number}.db", "--machine", robot)
        fitted = twin("fit", robot, path, "--what", "friction,payload", "--json", "--overwrite", "--no-report")
        drift = twin.told("trend", f"{number}.db")
        found.append([judged.code, json.loads(judged.out), fitted.code, fitted.out and json.loads(fitted.out), drift])
    alike(*found[::-1])


@pytest.mark.parametrize(
    "words",
    [
        ("loads",),
        ("size",),
        ("size", "--efforts", "model"),
        ("torques",),
        ("map", "acceleration", "--along"),
        ("design", "--minimise", "peak-effort", "--vary", "geometry.arm_length=0.14:0.3", "--starts", "2", "--path"),
    ],
    ids=" ".join,
)
def test_efforts_that_the_machine_cannot_explain_are_said_in_the_first_line(words, twin, tmp_path, rng):
    """Of a table of another program, computed under a wrench that the table does not have."""
    robot, path, (command, *options) = load("delta"), tmp_path / "foreign.csv", words
    time, q = swings(robot, rng)
    qd = np.gradient(q, time, axis=0)
    qdd = np.gradient(qd, time, axis=0)
    wrench = np.outer(1.0 + time, [0.0, 0.0, -200.0, 0.0, 0.0, 0.0])
    for load_there in (0.0, 1.0):
        effort = inverse_dynamics(robot, q, qd, qdd, load_there * wrench)
        columns = {"time": time}
        for word, values in (("position", q), ("velocity", qd), ("acceleration", qdd), ("effort", effort)):
            columns |= of_joints(robot, word, values)
        write_columns(path, columns)
        more = ["--out", tmp_path / "out.csv", "--overwrite"] if command == "torques" else []
        out = twin.good(command, "delta", *options, path, *more)
        first = out.err if command == "design" else out.out.splitlines()[0]
        assert ("differ from the model's" in first) == bool(load_there)


def spoilt(path, leave_out=(), change=()):
    """Rewrite a table without some columns, or with other values of a column."""
    columns = {k: v for k, v in read_columns(path).items() if k not in leave_out}
    columns |= {k: np.full_like(columns[k], v) for k, v in change}
    full = {k: v for k, v in columns.items() if not np.isnan(v).any()}
    return write_columns(path.with_name("spoilt.csv"), full)


@pytest.mark.parametrize("command", ["loads", "size", "torques"])
def test_computed_efforts_without_what_they_rest_on_are_rejected(command, twin, tmp_path, rng):
    robot, source, out = load("delta"), tmp_path / "source.csv", tmp_path / "written.csv"
    time, q = swings(robot, rng)
    forces = dict(zip(WRENCH, np.outer([0.0, 0.0, -200.0, 0.0, 0.0, 0.0], 1.0 + 0 * time), strict=True))
    write_columns(source, {"time": time} | of_joints(robot, "position", q) | forces)
    twin.good("torques", "delta", source, "--payload", "0.5", "--out", out, "--no-picture")
    names = list(read_columns(out))
    terms = [name for name in names if ".effort_" in name]
    more = ("--out", tmp_path / "again.csv", "--overwrite") if command == "torques" else ()
    for lost in (WRENCH, PAYLOAD, (*WRENCH, *terms), (*PAYLOAD, *terms)):
        twin.refused(command, "delta", spoilt(out, lost), *more)
    origin = [name for name in names if name.startswith(COMPUTED_WITH)]
    twin.refused(command, "delta", spoilt(out, (*WRENCH, *origin, *GRAVITY)), *more)
    # Another robot's file is a motion all the same, and the answer says whose efforts it has.
    upside = parameters_of("delta")
    upside["gravity"] = [0.0, 0.0, 9.81]
    (tmp_path / "upside.yaml").write_text(yaml.safe_dump(upside))
    found = twin.good(command, tmp_path / "upside.yaml", out, *more)
    assert "computed with gravity 0, 0, -9.81" in found.out
    two = spoilt(out, change=[(GRAVITY[2], np.where(time < 0.2, -9.81, 9.81))])
    assert "gravity.z" in twin.refused(command, "delta", two, *more)


def test_a_table_stays_plain(twin, tmp_path):
    """One header row, numbers and empty cells below."""
    out = tmp_path / "at.csv"
    twin.good("torques", "delta", "--at", "0,0,-0.4", "--payload", "0.5", "--out", out)
    with out.open(newline="") as file:
        header, *rows = csv.reader(file)
    assert len(set(header)) == len(header) and not header[0].startswith("#")
    for row in rows:
        assert len(row) == len(header)
        assert all(cell == "" or np.isfinite(float(cell)) for cell in row)
