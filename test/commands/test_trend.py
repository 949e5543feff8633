# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""History and trend: many writers, what a night's recording tells, and what drifts."""

import math
import multiprocessing
import runpy
import sqlite3
from dataclasses import replace

import numpy as np
import pytest

from pkm_twin.errors import ParameterError
from pkm_twin.identification.history import Measured, Series, append, judge_series, measure, read_history
from pkm_twin.recordings import read
from test.commands.conftest import REPOSITORY
from test.support.robots import load, often

DAY = 86400.0
write_night = runpy.run_path(str(REPOSITORY / "examples/nights.py"))["write_night"]
"""A recording of one motion, as the example makes it."""


def series(values):
    values = np.asarray(values, float)
    nan = np.full(len(values), np.nan)
    return Series("m", "residual", "j", "N m", DAY * np.arange(len(values)), values, nan)


@pytest.mark.parametrize("count", often(300, 5000))
def test_false_alarms_are_as_rare_as_asked_for(count, rng):
    """Of series without drift; a rate that is fifty times too high is far outside the noise."""
    alarms = [judge_series(series(rng.normal(5.0, 0.3, 30)), 15, 0.05).drifts for _ in range(count)]
    # Two ways to be wrong, each at most as often.
    assert np.mean(alarms) < 0.1 + 4 * np.sqrt(0.1 / count)


@pytest.mark.parametrize("step", [8.0, -8.0])
def test_a_step_is_found_where_it_is(step, rng):
    values = rng.normal(0.0, 1.0, 40)
    values[25:] += step
    found = judge_series(series(values), 15, 1e-3)
    assert found.drifts
    assert found.change == 25
    assert found.after - found.before == pytest.approx(step, abs=1.5)
    calm = judge_series(series(values[:25]), 15, 1e-3)
    assert calm.change is None


def test_limits_are_those_of_a_further_recording(rng):
    """Student's interval of prediction, judged by the share of further ones inside it."""
    inside = []
    for _ in range(2000):
        found = judge_series(series(rng.normal(size=9)), 8, 0.1)
        inside.append(not found.beyond[-1])
    assert np.mean(inside) == pytest.approx(0.9, abs=0.03)


def _write(arguments):
    path, k = arguments
    numbers = [Measured("residual", "j", float(k), np.nan, "N m")]
    append(path, f"machine {k % 3}", "delta", f"{k}.mcap", DAY * k, True, numbers)


def test_many_write_at_once_and_none_is_lost(tmp_path):
    path = tmp_path / "nights.db"
    with multiprocessing.get_context("fork").Pool(2) as pool:
        pool.map(_write, [(path, k) for k in range(24)], chunksize=1)
    # The same once more takes the place of the first.
    _write((path, 7))
    found = read_history(path)
    assert sorted(one.machine for one in found) == ["machine 0", "machine 1", "machine 2"]
    assert sorted(np.concatenate([one.value for one in found])) == list(range(24))
    assert len(read_history(path, "machine 1")) == 1
    with sqlite3.connect(path) as base:
        assert base.execute("SELECT count(*) FROM checks").fetchone() == (24,)


def test_a_recording_tells_friction_and_payload(tmp_path, rng):
    robot = load("delta")
    viscous, coulomb = (0.05, 0.1, 0.2), (0.1, 0.3, 0.2)
    path = write_night(tmp_path / "night.csv", robot, rng, viscous, coulomb, 0.12)
    found = {(m.quantity, m.part): m for m in measure(read(path, robot))}
    for k, name in enumerate(robot.joint_names):
        for what, true in (("viscous", viscous), ("coulomb", coulomb)):
            one = found[f"friction {what}", name]
            assert abs(one.value - true[k]) < 5 * one.deviation
            assert one.deviation < 0.02
    load_ = found["payload beyond the load", "platform"]
    assert abs(load_.value - 0.12) < 5 * load_.deviation
    # With what errors of lengths and sensors may do to it.
    assert load_.deviation < 0.03


def test_nights_to_a_verdict(twin, tmp_path, monkeypatch, rng):
    """Two recordings of a machine, and the noise of further nights by their deviations."""
    monkeypatch.chdir(tmp_path)
    robot = load("delta")
    sound, worn = (
        measure(read(write_night(tmp_path / f"{c}.csv", robot, rng, coulomb=[c, 0.1, 0.1]), robot)) for c in (0.1, 0.5)
    )
    for k in range(8):
        numbers = [
            replace(one, value=one.value + rng.normal() * np.nan_to_num(one.deviation))
            for one in (worn if k >= 6 else sound)
        ]
        append("nights.db", "delta", "delta", f"{k}.csv", 1.7e9 + DAY * k, True, numbers)
        if k in (4, 5):
            told = twin.told("trend", "nights.db")
            assert not told["drifts"]
            assert told["judged"] == (len(told["series"]) if k == 5 else 0)
    told = {(s["quantity"], s["part"]): s for s in twin.told("trend", "nights.db", code=1)["series"]}
    worse = told["friction coulomb", robot.joint_names[0]]
    assert worse["drifts"]
    assert worse["changed"].startswith("2023-11-20")
    assert worse["after"] - worse["before"] == pytest.approx(0.4, abs=0.05)
    assert not told["friction coulomb", robot.joint_names[1]]["drifts"]
    twin.good("trend", "nights.db", "--picture", "trend.png", code=1)
    assert (tmp_path / "trend.png").stat().st_size


@pytest.mark.parametrize("jobs", often(1, 2))
def test_a_folder_is_judged_bag_by_bag(jobs, twin, tmp_path, sample):
    folder = tmp_path / "night"
    folder.mkdir()
    (folder / "good.mcap").write_bytes(sample.read_bytes())
    (folder / "bad.mcap").write_bytes(sample.read_bytes()[:5000])
    line = ("check", folder, "--jobs", jobs, "--history", tmp_path / "h.db")
    told = twin.told(*line, code=1)["recordings"]
    assert [(r["bag"].rpartition("/")[2], r["good"]) for r in told] == [("bad.mcap", False), ("good.mcap", True)]
    (folder / "bad.mcap").unlink()
    twin.good("check", folder)
    assert {one.machine for one in read_history(tmp_path / "h.db")} == {"delta_cu"}


def test_what_is_no_history(twin, tmp_path):
    other = tmp_path / "other.db"
    other.write_text("nothing of that kind, but long enough to be read as a file of a data base")
    for path in (other, tmp_path / "none.db"):
        twin.refused("trend", path)


@pytest.mark.parametrize("tables", [["photos"], ["photos", "checks", "numbers"], ["checks"]])
def test_another_program_s_database_is_rejected_and_stays_as_it_is(tables, twin, tmp_path, tiny):
    path = tmp_path / "photos.db"
    with sqlite3.connect(path) as base:
        for table in tables:
            base.execute(f"CREATE TABLE {table} (a)")
    before = path.read_bytes()
    assert tables[0] in twin.refused("trend", path)
    assert "history" in twin.refused("check", tiny, "--history", path)
    with sqlite3.connect(path) as base:
        base.execute(f"PRAGMA application_id = {0x12345678}")
    assert "history" in twin.refused("check", tiny, "--history", path)
    with sqlite3.connect(path) as base:
        base.execute("PRAGMA application_id = 0")
        assert {n for (n,) in base.execute("SELECT name FROM sqlite_master")} == {*tables}
    assert len(path.read_bytes()) == len(before)


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan, 1e300])
def test_a_number_that_no_recording_gives_is_not_written(value, tmp_path):
    path = tmp_path / "nights.db"
    for one in (Measured("residual", "j", value, 0.1, "N m"), Measured("residual", "j", 0.1, -1.0, "N m")):
        with pytest.raises(ParameterError, match="residual of j"):
            append(path, "m", "delta", "1.mcap", DAY, True, [one])
    assert not path.exists()


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("value", math.inf),
        ("value", "many"),
        ("value", b"\x01\xff"),
        ("value", 1e300),
        ("deviation", math.inf),
        ("deviation", -1.0),
        ("deviation", "few"),
        ("unit", b"\xff"),
    ],
)
def test_a_damaged_number_of_a_history_is_named(column, value, twin, tmp_path):
    path = tmp_path / "nights.db"
    for k in range(8):
        _write((path, 3 * k))
    twin.good("trend", path)
    with sqlite3.connect(path) as base:
        assert base.execute("PRAGMA application_id").fetchone()[0] != 0
        base.execute(f"UPDATE numbers SET {column} = ? WHERE check_id = 4", (value,))
    assert "residual of j" in twin.refused("trend", path)
