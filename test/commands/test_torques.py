# SPDX-License-Identifier: Apache-2.0
"""torques: the table and picture of a recorded or a written-down motion."""

import csv
import importlib.util
import os

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, reactions
from test.commands.conftest import DELTA, MILLING, STIFFNESS, rewrite
from test.support.command import forked
from test.support.robots import load, massless

TERMS = ("gravity", "inertia", "velocity", "payload", "friction", "external")
AXES = ("fx", "fy", "fz", "mx", "my", "mz")
TABLE = "torques", "--no-picture"
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


def test_process_on_a_bag(sample, tmp_path):
    result = forked(tmp_path, "torques", "delta_cu", sample)
    assert (result.code, result.err) == (0, "")
    table = columns_of(tmp_path / "torques.csv")
    largest = max(np.abs(table[f"arm_{i}.effort"]).max() for i in (1, 2, 3))
    assert f"{largest:.4g} N m" in result.out.splitlines()[0]
    assert (tmp_path / "torques.png").read_bytes().startswith(PNG)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["torques.csv", "torques.png"]
    assert 1400 < len(table["time"]) < 1500
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
        (lambda c: c["time"].reverse(), "rising times"),
        (lambda c: c["time"].__setitem__(3, c["time"][2]), "rising times"),
        (lambda c: c["time"].__setitem__(3, c["time"][2] + 1e-12), "1e-09 s or more apart"),
        (lambda c: c["arm_1.position"].__setitem__(2, "0,5"), "line 4"),
        (
            lambda c: c["arm_1.position"].__setitem__(2, 3.0),
            "arm_1.position at sample 2: 3.0; expected -0.9 to 1.3 rad",
        ),
        (lambda c: c["arm_1.velocity"].__setitem__(2, 1e300), "expected -15 to 15 rad/s"),
        (lambda c: [values.clear() for values in c.values()], "a header row and rows"),
    ],
)
def test_bad_csv(twin, tmp_path, change, text):
    source = write(tmp_path / "bad.csv", spoiled(change))
    result = twin("torques", "delta", source, "--out", tmp_path / "t.csv")
    assert (result.code, result.out) == (1, "")
    assert text in result.one_line_error()
    assert [path.name for path in tmp_path.iterdir()] == ["bad.csv"]


def test_differences_that_overflow_are_one_line(process, tmp_path):
    columns = motion("delta")
    for joint in (1, 2, 3):
        del columns[f"arm_{joint}.velocity"], columns[f"arm_{joint}.acceleration"]
    columns["arm_1.position"][:3] = -1e300, 0.0, 1e300
    source = write(tmp_path / "fast.csv", columns)
    result = process("torques", "delta", source, "--beyond-limits", "--out", tmp_path / "t.csv")
    assert result.code == 1
    assert "Warning" not in result.one_line_error()


def test_an_unreachable_sample_is_counted_from_the_motions_beginning(twin, tmp_path):
    columns = motion("delta", 5000)
    columns["arm_1.position"][4321] = 3.0
    source = write(tmp_path / "long.csv", columns)
    result = twin("torques", "delta", source, "--out", tmp_path / "t.csv", "--beyond-limits")
    assert "at sample 4321 is unreachable" in result.one_line_error()


def test_a_result_that_is_not_finite_is_one_line(twin, tmp_path):
    columns = motion("delta")
    columns["arm_1.velocity"][2] = 1e300
    source = write(tmp_path / "fast.csv", columns)
    result = twin("torques", "delta", source, "--out", tmp_path / "t.csv", "--beyond-limits")
    assert result.code == 1 and "finite" in result.one_line_error()


class TestBeyondLimits:
    """One rule for nodes and commands: refused, or computed and marked."""

    def test_a_motion_is_refused_or_marked(self, twin, tmp_path):
        columns = motion("delta")
        columns["arm_2.position"] = columns["arm_2.position"] + 1.095
        low, high = load("delta").limits.position[1]
        outside = (columns["arm_2.position"] > high) | (columns["arm_2.position"] < low)
        assert 0 < outside.sum() < len(outside)
        command = (
            *TABLE,
            "delta",
            write(tmp_path / "m.csv", columns),
            "--out",
            tmp_path / "t.csv",
        )
        assert f"{low:g} to {high:g} rad" in twin(*command).one_line_error()
        result = twin(*command, "--beyond-limits")
        assert (result.code, result.err) == (0, "")
        assert "beyond limits: arm_2.position is" in result.out
        assert np.array_equal(columns_of(tmp_path / "t.csv")["beyond_limits"], outside)

    def test_a_motion_within_has_no_column(self, twin, tmp_path):
        source = write(tmp_path / "m.csv", motion("delta"))
        out = tmp_path / "t.csv"
        assert twin(*TABLE, "delta", source, "--out", out, "--beyond-limits").code == 0
        assert "beyond_limits" not in columns_of(out)

    def test_a_bags_samples_are_not_dropped_in_silence(self, twin, tmp_path):
        def far(topic, message, time):
            if topic == "/joint_states" and 0.0995 < time < 0.1005:
                message.position = [1.31, *message.position[1:]]
            return message

        bag = rewrite(DELTA, tmp_path / "far.mcap", far, seconds=0.2)
        command = *TABLE, "delta_cu", bag, "--out", tmp_path / "t.csv"
        assert "arm_1.position" in twin(*command).one_line_error()
        assert twin(*command, "--beyond-limits").code == 0
        assert columns_of(tmp_path / "t.csv")["beyond_limits"].sum() == 1


class TestPayload:
    def test_it_is_held_when_told(self, twin, tmp_path):
        source = write(tmp_path / "m.csv", motion("delta"))
        tables = {}
        for name, options in {
            "bare": (),
            "always": ("--payload", "0.3"),
            "later": ("--payload", "0.3", "--load-times", "0.5,2"),
        }.items():
            out = tmp_path / f"{name}.csv"
            assert twin(*TABLE, "delta", source, "--out", out, *options).code == 0
            tables[name] = columns_of(out)
        bare, always, later = (joined(t, "delta", "effort") for t in tables.values())
        held = tables["bare"]["time"] >= 0.5
        assert np.allclose(later[held], always[held]) and np.allclose(later[~held], bare[~held])
        assert np.abs(always - bare).max() > 0.1

    def test_its_centre_counts(self, twin, tmp_path):
        source = write(tmp_path / "m.csv", motion("prru"))
        outs = [tmp_path / "a.csv", tmp_path / "b.csv"]
        for out, payload in zip(outs, ("3", "3,0.1,0,0"), strict=True):
            assert twin(*TABLE, "prru", source, "--out", out, "--payload", payload).code == 0
        one, other = (joined(columns_of(out), "prru", "effort") for out in outs)
        assert not np.allclose(one, other)

    def test_a_bags_own_is_part_of_the_table(self, twin, tmp_path):
        bag = rewrite(DELTA, tmp_path / "b.mcap", begin=8.0, seconds=0.6)
        # In this part the pick, at 8.275 s, is behind.
        for name, options in (("told", ()), ("none", ("--payload", "0"))):
            out = tmp_path / f"{name}.csv"
            times = ("--load-times", "0,1") if options else ()
            assert twin(*TABLE, "delta_cu", bag, "--out", out, *options, *times).code == 0
        told, none = (columns_of(tmp_path / f"{name}.csv") for name in ("told", "none"))
        assert np.allclose(told["arm_1.effort"], none["arm_1.effort"])

    @pytest.mark.parametrize(
        "options",
        [
            ("--payload", "x"),
            ("--payload", "-1"),
            ("--payload", "nan"),
            ("--payload", "1,2"),
            ("--load-times", "1,2"),
            ("--payload", "1", "--load-times", "2,1"),
            ("--payload", "1", "--load-times", "1"),
            ("--topic", "/joint_states"),
        ],
    )
    def test_usage(self, twin, tmp_path, options):
        source = write(tmp_path / "m.csv", motion("delta"))
        result = twin("torques", "delta", source, "--out", tmp_path / "t.csv", *options)
        assert (result.code, result.out) == (2, "")


def test_only_regular_files_and_sizes_first(twin, tmp_path):
    fifo = tmp_path / "m.csv"
    os.mkfifo(fifo)
    out = "--out", tmp_path / "t.csv"
    assert "FIFO" in twin("torques", "delta", fifo, *out).one_line_error()
    assert "device" in twin("torques", "delta", "/dev/zero", *out).one_line_error()
    huge = tmp_path / "huge.csv"
    with huge.open("wb") as file:
        file.truncate(2 * 1024**3)
    assert "at most" in twin("torques", "delta", huge, *out).one_line_error()
    long = tmp_path / "long.csv"
    long.write_text("time" + "," * 3_000_000)
    assert "at most" in twin("torques", "delta", long, *out).one_line_error()


def test_parquet_without_pyarrow_is_refused_before_the_work(twin, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    source = write(tmp_path / "motion.csv", motion("delta"))
    target = tmp_path / "p.parquet"
    text = twin("torques", "delta", source, "--out", target).one_line_error()
    assert "pyarrow" in text and ".part" not in text


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


def test_a_motion_is_never_replaced_by_its_own_torques(twin, tmp_path):
    source = write(tmp_path / "motion.csv", motion("delta"))
    before = source.read_bytes()
    link = tmp_path / "t.csv"
    link.symlink_to("motion.csv")
    for target in (source, link):
        result = twin("torques", "delta", source, "--out", target, "--overwrite", "--no-picture")
        assert "the same file" in result.one_line_error()
        assert source.read_bytes() == before


@pytest.mark.parametrize(
    ("robot", "motion_file", "out", "text"),
    [
        ("delta_cuu", DELTA, "t.csv", "did you mean 'delta_cu'"),
        ("delta_cu", DELTA, "t.txt", ".csv or .parquet"),
        ("delta_cu", DELTA, "absent/t.csv", "there is no folder"),
        ("delta_cu", "absent.csv", "t.csv", "absent.csv"),
        ("delta_cu", "absent.mcap", "t.csv", "no such file"),
        ("prru", DELTA, "t.csv", "slider_1"),
        ("massless", STIFFNESS, "t.csv", "inertia"),
    ],
)
def test_refusals(twin, tmp_path, sample, robot, motion_file, out, text):
    if motion_file == DELTA:
        motion_file = sample
    elif motion_file == STIFFNESS:
        motion_file = rewrite(STIFFNESS, tmp_path / "stiff.mcap", seconds=0.1)
        robot = massless(tmp_path / "light.yaml")
    result = twin("torques", robot, motion_file, "--out", tmp_path / out)
    assert (result.code, result.out) == (1, "")
    assert text in result.one_line_error()
    assert not (tmp_path / out).exists()


def test_a_bag_too_short_to_differentiate(twin, tmp_path):
    bag = rewrite(DELTA, tmp_path / "short.mcap", seconds=0.004)
    result = twin("torques", "delta_cu", bag, "--out", tmp_path / "t.csv")
    assert result.code == 1
    assert "too few joint states" in result.one_line_error()
