# SPDX-License-Identifier: Apache-2.0
"""torques: the table and picture of a recorded or a written-down motion."""

import csv
import importlib.util

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, reactions
from pkm_twin import load
from test.commands.conftest import DELTA, MILLING, STIFFNESS, rewrite

TERMS = ("gravity", "inertia", "velocity", "payload", "friction", "external")
AXES = ("fx", "fy", "fz", "mx", "my", "mz")
PNG = b"\x89PNG"


def columns_of(path):
    """The table's columns as arrays; an empty cell is NaN."""
    with path.open(newline="") as file:
        head, *rows = csv.reader(file)
    assert len(set(head)) == len(head)
    values = np.array([[float(cell or "nan") for cell in row] for row in rows])
    return dict(zip(head, values.T, strict=True))


def motion(name, count=50):
    """A smooth motion about the home pose: columns of a CSV, rates and accelerations exact."""
    robot = load(name)
    time = np.linspace(0.0, 1.0, count)
    home = robot.inverse(robot.home())
    size = 0.02
    columns = {"time": time}
    for i, joint in enumerate(robot.joint_names):
        w = 3.0 + i
        columns[f"{joint}.position"] = home[i] + size * np.sin(w * time)
        columns[f"{joint}.velocity"] = size * w * np.cos(w * time)
        columns[f"{joint}.acceleration"] = -size * w * w * np.sin(w * time)
    return columns


def write(path, columns, encoding="utf-8"):
    with path.open("w", newline="", encoding=encoding) as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
    return path


def joined(columns, name, what):
    return np.stack([columns[f"{joint}.{what}"] for joint in load(name).joint_names], -1)


def agree(table, name):
    """Terms sum to the effort, the effort is the model's, reactions are there."""
    robot = load(name)
    effort = joined(table, name, "effort")
    total = sum(joined(table, name, f"effort_{term}") for term in TERMS)
    scale = np.abs(effort).max()
    assert np.abs(total - effort).max() < 1e-9 * scale
    state = [joined(table, name, what) for what in ("position", "velocity", "acceleration")]
    react = reactions(robot, *state)
    for k, joint in enumerate(react.names):
        found = np.stack([table[f"{joint}.{axis}"] for axis in AXES], -1)
        assert found.shape == react.wrenches[:, k].shape
        assert np.array_equal(np.isnan(found), np.isnan(react.wrenches[:, k]))
    return state, effort


def test_process_on_a_bag(process, sample, tmp_path):
    result = process("torques", "delta_cu", sample, folder=tmp_path)
    assert (result.code, result.err) == (0, "")
    table = columns_of(tmp_path / "torques.csv")
    assert result.out.splitlines()[0] == (
        f"torques.csv: {len(table['time'])} rows, {len(table)} columns"
    )
    assert (tmp_path / "torques.png").read_bytes().startswith(PNG)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["torques.csv", "torques.png"]
    assert 1900 < len(table["time"]) < 2000
    state, effort = agree(table, "delta_cu")
    assert np.allclose(effort, inverse_dynamics(load("delta_cu"), *state))
    measured = joined(table, "delta_cu", "measured")
    assert np.abs(measured - effort).max() < 0.2 * np.abs(measured).max()


def test_a_recorded_wrench_is_the_external_term(twin, tmp_path):
    # From 3 s the tool is in the work.
    bag = rewrite(MILLING, tmp_path / "milling.mcap", begin=3.0, seconds=0.5)
    assert twin("torques", "prru", bag, "--out", tmp_path / "t.csv", "--no-picture").code == 0
    table = columns_of(tmp_path / "t.csv")
    agree(table, "prru")
    assert np.abs(joined(table, "prru", "effort_external")).max() > 10.0
    assert not (tmp_path / "t.png").exists()


@pytest.mark.parametrize("name", ["delta", "prru"])
def test_csv(twin, tmp_path, name):
    source = write(tmp_path / "motion.csv", motion(name), encoding="utf-8-sig")
    assert twin("torques", name, source, "--out", tmp_path / "t.csv").code == 0
    table = columns_of(tmp_path / "t.csv")
    for column, values in motion(name).items():
        assert np.array_equal(table[column], values)
    agree(table, name)
    assert (tmp_path / "t.png").read_bytes().startswith(PNG)


def test_absent_rates_are_differentiated_and_columns_come_in_any_order(twin, tmp_path):
    whole = motion("delta", 400)
    short = {name: whole[name] for name in reversed(whole) if not name.endswith("ion")}
    short |= {name: whole[name] for name in whole if name.endswith(".position")}
    short |= {"remark": whole["time"] * 0, "fz": whole["time"] * 0 - 2.0}
    for source, columns in (("whole", whole), ("short", short)):
        path = write(tmp_path / f"{source}.csv", columns)
        out = tmp_path / f"{source}_t.csv"
        assert twin("torques", "delta", path, "--no-picture", "--out", out).code == 0
    exact, found = (columns_of(tmp_path / f"{name}_t.csv") for name in ("whole", "short"))
    own = joined(found, "delta", "effort") - joined(found, "delta", "effort_external")
    wanted = joined(exact, "delta", "effort")
    assert np.abs(own - wanted).max() < 2e-3 * np.abs(wanted).max()
    assert np.abs(joined(found, "delta", "effort_external")).min() > 0.0


def test_its_own_table_is_a_motion_again(twin, tmp_path):
    write(tmp_path / "a.csv", motion("delta"))
    for source, target in (("a", "b"), ("b", "c")):
        paths = tmp_path / f"{source}.csv", "--out", tmp_path / f"{target}.csv"
        assert twin("torques", "delta", *paths, "--no-picture").code == 0
    assert (tmp_path / "b.csv").read_bytes() == (tmp_path / "c.csv").read_bytes()


def spoiled(change):
    columns = {name: values.tolist() for name, values in motion("delta").items()}
    change(columns)
    return columns


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda c: c.pop("time"), "columns time, arm_1.position"),
        (lambda c: [c.pop(f"arm_{i}.position") for i in (1, 2, 3)], "arm_1.position"),
        (lambda c: c.pop("arm_2.velocity"), "'arm_2.velocity'"),
        (lambda c: c.update({"arm_1.velocty": c.pop("arm_1.velocity")}), "did you mean"),
        (lambda c: c["time"].reverse(), "strictly rising"),
        (lambda c: c["time"].__setitem__(3, c["time"][2]), "strictly rising"),
        (lambda c: c["arm_1.position"].__setitem__(2, float("nan")), "line 4"),
        (lambda c: c["arm_1.position"].__setitem__(2, ""), "line 4"),
        (lambda c: c["arm_1.position"].__setitem__(2, "0,5"), "line 4"),
        (lambda c: c["arm_1.position"].__setitem__(2, 3.0), "at sample 2 is unreachable"),
        (lambda c: c["arm_1.velocity"].__setitem__(2, 1e300), "finite"),
        (lambda c: [values.clear() for values in c.values()], "a head line and rows"),
    ],
)
def test_bad_csv(twin, tmp_path, change, text):
    source = write(tmp_path / "bad.csv", spoiled(change))
    result = twin("torques", "delta", source, "--out", tmp_path / "t.csv")
    assert (result.code, result.out) == (1, "")
    assert text in result.one_line_error()
    assert [path.name for path in tmp_path.iterdir()] == ["bad.csv"]


def test_an_unreachable_sample_is_counted_from_the_motions_beginning(twin, tmp_path):
    columns = motion("delta", 5000)
    columns["arm_1.position"][4321] = 3.0
    source = write(tmp_path / "long.csv", columns)
    result = twin("torques", "delta", source, "--out", tmp_path / "t.csv")
    assert "at sample 4321 " in result.one_line_error()


@pytest.mark.parametrize(
    "content", [b"", b"time\n", b"\xff\xfe\x00", b"time,time\n1,2\n", b"a\n1,2"]
)
def test_what_is_no_table(twin, tmp_path, content):
    source = tmp_path / "bad.csv"
    source.write_bytes(content)
    result = twin("torques", "delta", source, "--out", tmp_path / "t.csv")
    assert result.code == 1
    assert "bad.csv" in result.one_line_error()


def test_too_few_rows_to_differentiate(twin, tmp_path):
    columns = {name: values[:2] for name, values in motion("delta").items()}
    short = {name: values for name, values in columns.items() if not name.endswith("acceleration")}
    for given, code in ((columns, 0), (short, 1)):
        source = write(tmp_path / "two.csv", given)
        out = "--out", tmp_path / f"{code}.csv"
        assert twin("torques", "delta", source, *out, "--no-picture").code == code


@pytest.mark.parametrize("there", ["t.csv", "t.png"])
def test_a_target_that_exists_is_refused_and_left_alone(twin, tmp_path, there):
    source = write(tmp_path / "motion.csv", motion("delta"))
    (tmp_path / there).write_text("mine")
    command = "torques", "delta", source, "--out", tmp_path / "t.csv"
    result = twin(*command)
    assert result.code == 1
    assert "--overwrite" in result.one_line_error()
    assert (tmp_path / there).read_text() == "mine"
    assert twin(*command, "--overwrite").code == 0
    assert (tmp_path / "t.png").read_bytes().startswith(PNG)
    assert len(columns_of(tmp_path / "t.csv")["time"]) == 50


def test_parquet_has_the_same_columns(twin, tmp_path):
    source = write(tmp_path / "motion.csv", motion("delta"))
    result = twin("torques", "delta", source, "--out", tmp_path / "t.parquet", "--no-picture")
    if importlib.util.find_spec("pyarrow") is None:
        assert "pyarrow" in result.one_line_error()
        assert not (tmp_path / "t.parquet").exists()
    else:
        from pyarrow import parquet

        assert result.code == 0
        assert "arm_1.effort" in parquet.read_table(tmp_path / "t.parquet").column_names


@pytest.mark.parametrize(
    ("robot", "motion_file", "out", "text"),
    [
        ("delta_cuu", DELTA, "t.csv", "did you mean 'delta_cu'"),
        ("delta_cu", DELTA, "t.txt", ".csv or .parquet"),
        ("delta_cu", DELTA, "absent/t.csv", "cannot write"),
        ("delta_cu", "absent.csv", "t.csv", "absent.csv"),
        ("delta_cu", "absent.mcap", "t.csv", "does not exist"),
        ("prru", DELTA, "t.csv", "slider_1"),
        ("upr_rpu", STIFFNESS, "t.csv", "masses"),
    ],
)
def test_refusals(twin, tmp_path, sample, robot, motion_file, out, text):
    if motion_file == DELTA:
        motion_file = sample
    elif motion_file == STIFFNESS:
        motion_file = rewrite(STIFFNESS, tmp_path / "stiff.mcap", seconds=0.1)
    result = twin("torques", robot, motion_file, "--out", tmp_path / out)
    assert (result.code, result.out) == (1, "")
    assert text in result.one_line_error()
    assert not (tmp_path / out).exists()


def test_a_bag_too_short_to_differentiate(twin, tmp_path):
    bag = rewrite(DELTA, tmp_path / "short.mcap", seconds=0.004)
    result = twin("torques", "delta_cu", bag, "--out", tmp_path / "t.csv")
    assert result.code == 1
    assert "too few joint states" in result.one_line_error()
