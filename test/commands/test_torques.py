# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""torques: the table and picture of a recorded or a written-down motion."""

import importlib.util
import itertools

import numpy as np
import pytest
import yaml

from delta_dynamics import inverse_dynamics, reactions
from test.commands.conftest import DELTA, MILLING, STIFFNESS, checked, rewrite
from test.support.command import forked
from test.support.robots import SHIPPED, load, massless, parameters_of, partly_long
from test.support.tables import joined, of_joints, read_columns, write_columns

TERMS = ("gravity", "inertia", "velocity", "payload", "friction", "external")
AXES = ("fx", "fy", "fz", "mx", "my", "mz")
TABLE = "torques", "--no-picture"
PNG = b"\x89PNG"


def motion(name, count=50):
    """A smooth motion about the home pose: columns of a CSV, rates and accelerations exact."""
    robot = load(name)
    time = np.linspace(0.0, 1.0, count)
    home = robot.inverse(robot.home())
    count = np.arange(3.0, 3.0 + robot.joints_count)
    wave = np.outer(time, count)
    q, qd, qdd = home + 0.02 * np.sin(wave), 0.02 * count * np.cos(wave), -0.02 * np.sin(wave)
    columns = {"time": time} | of_joints(robot, "position", q) | of_joints(robot, "velocity", qd)
    return columns | of_joints(robot, "acceleration", count**2 * qdd)


def agree(table, name):
    """Terms sum to the effort, the effort is the model's, reactions are there."""
    robot = load(name)
    effort = joined(table, robot, "effort")
    total = sum(joined(table, robot, f"effort_{term}") for term in TERMS)
    assert np.abs(total - effort).max() < 1e-9 * np.abs(effort).max()
    state = [joined(table, robot, what) for what in ("position", "velocity", "acceleration")]
    react = reactions(robot, *state)
    for k, joint in enumerate(react.names):
        found = np.stack([table[f"{joint}.{axis}"] for axis in AXES], -1)
        assert found.shape == react.wrenches[:, k].shape
        assert np.array_equal(np.isnan(found), np.isnan(react.wrenches[:, k]))
    return state, effort


def test_process_on_a_bag(sample, tmp_path):
    result = forked(tmp_path, "torques", "delta_cu", sample)
    assert (result.code, result.err) == (0, "")
    table = read_columns(tmp_path / "torques.csv")
    largest = max(np.abs(table[f"arm_{i}.effort"]).max() for i in (1, 2, 3))
    assert f"{largest:.4g} N m" in result.out.splitlines()[0]
    assert (tmp_path / "torques.png").read_bytes().startswith(PNG)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["torques.csv", "torques.png"]
    assert 1400 < len(table["time"]) < 1500
    state, effort = agree(table, "delta_cu")
    assert np.allclose(effort, inverse_dynamics(load("delta_cu"), *state))
    measured = joined(table, load("delta_cu"), "measured")
    assert np.abs(measured - effort).max() < 0.2 * np.abs(measured).max()


def test_a_recorded_wrench_is_the_external_term(twin, tmp_path):
    # From 3 s the tool is in the work.
    bag = rewrite(MILLING, tmp_path / "milling.mcap", begin=3.0, seconds=0.5)
    twin.good(*TABLE, "prru", bag, "--out", tmp_path / "t.csv")
    table = read_columns(tmp_path / "t.csv")
    agree(table, "prru")
    assert np.abs(joined(table, load("prru"), "effort_external")).max() > 10.0
    assert not (tmp_path / "t.png").exists()


@pytest.mark.parametrize("name", ["delta", "prru"])
def test_csv(twin, tmp_path, name):
    source = write_columns(tmp_path / "motion.csv", motion(name))
    source.write_text(source.read_text(), encoding="utf-8-sig")
    twin.good("torques", name, source, "--out", tmp_path / "t.csv")
    table = read_columns(tmp_path / "t.csv")
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
        path = write_columns(tmp_path / f"{source}.csv", columns)
        twin.good(*TABLE, "delta", path, "--out", tmp_path / f"{source}_t.csv")
    exact, found = (read_columns(tmp_path / f"{name}_t.csv") for name in ("whole", "short"))
    own = joined(found, load("delta"), "effort") - joined(found, load("delta"), "effort_external")
    wanted = joined(exact, load("delta"), "effort")
    assert np.abs(own - wanted).max() < 2e-3 * np.abs(wanted).max()
    assert np.abs(joined(found, load("delta"), "effort_external")).min() > 0.0


@pytest.mark.parametrize("name", partly_long(list(SHIPPED), "delta", "linear_delta"))
def test_its_own_table_is_a_motion_again(twin, tmp_path, name):
    write_columns(tmp_path / "a.csv", motion(name))
    for source, target in (("a", "b"), ("b", "c")):
        paths = tmp_path / f"{source}.csv", "--out", tmp_path / f"{target}.csv"
        twin.good(*TABLE, name, *paths)
    assert (tmp_path / "b.csv").read_bytes() == (tmp_path / "c.csv").read_bytes()
    for command in ("size", "loads"):
        twin.good(command, name, tmp_path / "b.csv")


@pytest.mark.parametrize(
    ("word", "factor"), [("effort", 1.2), pytest.param("measured", 1.2, marks=pytest.mark.long), ("effort", 1.0)]
)
def test_measured_efforts_stay_and_the_models_are_not_judged(twin, tmp_path, word, factor):
    """The model against itself is no evidence; efforts of a table may be a plan's."""
    robot, columns = load("linear_delta"), motion("linear_delta", 200)
    states = [joined(columns, robot, what) for what in ("position", "velocity", "acceleration")]
    efforts = factor * inverse_dynamics(robot, *states)
    paths = [tmp_path / f"{name}.csv" for name in "abc"]
    write_columns(paths[0], columns | of_joints(robot, word, efforts))
    for source, target in itertools.pairwise(paths):
        twin.good(*TABLE, robot.name, source, "--out", target)
        table = read_columns(target)
        if factor == 1.0:
            assert "rail_1.measured" not in table
        else:
            assert np.array_equal(joined(table, robot, "measured"), efforts)
        report = checked(target, robot=robot.name)
        told = (report.code, report.data["answer"])
        assert told == ((4, "not judged") if factor == 1.0 else (1, "bad"))


def test_at_rest_at_a_pose(twin, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pose, wrench = (0.05, 0.02, -0.3), (3.0, 0.0, -10.0, 0.0, 0.2, 0.0)
    words = ["--at", ",".join(map(str, pose)), "--wrench", ",".join(map(str, wrench))]
    data = twin.told("torques", "delta", *words, "--payload", "0.5")
    assert not list(tmp_path.iterdir())
    robot = load("delta").changed(payload={"mass": 0.5})
    q, still = robot.inverse(pose), np.zeros(3)
    wanted = inverse_dynamics(robot, q, still, still, wrench)
    efforts = data["efforts"].values()
    np.testing.assert_allclose([one["effort"] for one in efforts], wanted)
    sums = [sum(v for k, v in one.items() if k not in ("effort", "unit")) for one in efforts]
    np.testing.assert_allclose(sums, wanted)
    largest = wanted[np.abs(wanted).argmax()]
    out = twin.good("torques", "delta", *words, "--payload", "0.5").out
    assert f"{largest:.4g} N m" in out.splitlines()[0]
    assert twin("torques", "delta").code == twin("torques", "delta", "a.csv", *words).code == 2


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
    columns = spoiled(change)
    rows = [",".join(columns)]
    rows += [
        ",".join(f'"{v}"' if "," in str(v) else str(v) for v in row) for row in zip(*columns.values(), strict=True)
    ]
    source = tmp_path / "bad.csv"
    source.write_text("\n".join(rows) + "\n")
    assert text in twin.refused("torques", "delta", source, "--out", tmp_path / "t.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["bad.csv"]


def test_differences_that_overflow_are_one_line(process, tmp_path):
    columns = motion("delta")
    for joint in (1, 2, 3):
        del columns[f"arm_{joint}.velocity"], columns[f"arm_{joint}.acceleration"]
    columns["arm_1.position"][:3] = -1e300, 0.0, 1e300
    source = write_columns(tmp_path / "fast.csv", columns)
    result = process("torques", "delta", source, "--beyond-limits", "--out", tmp_path / "t.csv")
    assert result.code == 1
    assert "Warning" not in result.one_line_error()


def test_an_unreachable_sample_is_counted_from_the_motions_beginning(twin, tmp_path):
    columns = motion("delta", 5000)
    columns["arm_1.position"][4321] = 3.0
    source = write_columns(tmp_path / "long.csv", columns)
    line = ("torques", "delta", source, "--out", tmp_path / "t.csv", "--beyond-limits")
    assert "at sample 4321 is unreachable" in twin.refused(*line)


def test_a_result_that_is_not_finite_is_one_line(twin, tmp_path):
    columns = motion("delta")
    columns["arm_1.velocity"][2] = 1e300
    source = write_columns(tmp_path / "fast.csv", columns)
    line = ("torques", "delta", source, "--out", tmp_path / "t.csv", "--beyond-limits")
    assert "finite" in twin.refused(*line)


class TestBeyondLimits:
    """One rule for nodes and commands: refused, or computed and marked."""

    def test_a_motion_is_refused_or_marked(self, twin, tmp_path):
        columns = motion("delta")
        columns["arm_2.position"] = columns["arm_2.position"] + 1.095
        low, high = load("delta").limits.position[1]
        outside = (columns["arm_2.position"] > high) | (columns["arm_2.position"] < low)
        assert 0 < outside.sum() < len(outside)
        source, out = write_columns(tmp_path / "m.csv", columns), tmp_path / "t.csv"
        command = *TABLE, "delta", source, "--out", out
        assert f"{low:g} to {high:g} rad" in twin.refused(*command)
        result = twin.good(*command, "--beyond-limits")
        assert "beyond limits: arm_2.position is" in result.out
        assert np.array_equal(read_columns(out)["beyond_limits"], outside)
        # A motion within has no column of them.
        write_columns(source, motion("delta"))
        twin.good(*command, "--beyond-limits", "--overwrite")
        assert "beyond_limits" not in read_columns(out)

    def test_a_bags_samples_are_not_dropped_in_silence(self, twin, tmp_path):
        def far(topic, message, time):
            if topic == "/joint_states" and 0.0995 < time < 0.1005:
                message.position = [1.31, *message.position[1:]]
            return message

        bag = rewrite(DELTA, tmp_path / "far.mcap", far, seconds=0.2)
        command = *TABLE, "delta_cu", bag, "--out", tmp_path / "t.csv"
        assert "arm_1.position" in twin.refused(*command)
        twin.good(*command, "--beyond-limits")
        assert read_columns(tmp_path / "t.csv")["beyond_limits"].sum() == 1


class TestPayload:
    def test_it_is_held_when_told(self, twin, tmp_path):
        source = write_columns(tmp_path / "m.csv", motion("delta"))
        tables = {}
        for name, options in {
            "bare": (),
            "always": ("--payload", "0.3"),
            "later": ("--payload", "0.3", "--load-times", "0.5,2"),
        }.items():
            out = tmp_path / f"{name}.csv"
            twin.good(*TABLE, "delta", source, "--out", out, *options)
            tables[name] = read_columns(out)
        bare, always, later = (joined(t, load("delta"), "effort") for t in tables.values())
        held = tables["bare"]["time"] >= 0.5
        assert np.allclose(later[held], always[held]) and np.allclose(later[~held], bare[~held])
        assert np.abs(always - bare).max() > 0.1

    def test_a_bags_own_is_part_of_the_table(self, twin, tmp_path):
        bag = rewrite(DELTA, tmp_path / "b.mcap", begin=8.0, seconds=0.6)
        # In this part the pick, at 8.275 s, is behind.
        for name, options in (("told", ()), ("none", ("--payload", "0"))):
            out = tmp_path / f"{name}.csv"
            times = ("--load-times", "0,1") if options else ()
            twin.good(*TABLE, "delta_cu", bag, "--out", out, *options, *times)
        told, none = (read_columns(tmp_path / f"{name}.csv") for name in ("told", "none"))
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
        source = write_columns(tmp_path / "m.csv", motion("delta"))
        result = twin("torques", "delta", source, "--out", tmp_path / "t.csv", *options)
        assert (result.code, result.out) == (2, "")


def test_sizes_are_looked_at_first(twin, tmp_path):
    huge = tmp_path / "huge.csv"
    with huge.open("wb") as file:
        file.truncate(2 * 1024**3)
    long = tmp_path / "long.csv"
    long.write_text("time" + "," * 3_000_000)
    for path in (huge, long):
        assert "at most" in twin.refused("torques", "delta", path, "--out", tmp_path / "t.csv")


def test_parquet_without_pyarrow_is_refused_before_the_work(twin, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    source = write_columns(tmp_path / "motion.csv", motion("delta"))
    target = tmp_path / "p.parquet"
    text = twin.refused("torques", "delta", source, "--out", target)
    assert "pyarrow" in text and ".part" not in text


@pytest.mark.parametrize("content", [b"", b"time\n", b"\xff\xfe\x00", b"time,time\n1,2\n", b"a\n1,2"])
def test_what_is_no_table(twin, tmp_path, content):
    source = tmp_path / "bad.csv"
    source.write_bytes(content)
    assert "bad.csv" in twin.refused("torques", "delta", source, "--out", tmp_path / "t.csv")


def test_too_few_rows_to_differentiate(twin, tmp_path):
    columns = {name: values[:2] for name, values in motion("delta").items()}
    short = {name: values for name, values in columns.items() if not name.endswith("acceleration")}
    for given, code in ((columns, 0), (short, 1)):
        source = write_columns(tmp_path / "two.csv", given)
        twin.good(*TABLE, "delta", source, "--out", tmp_path / f"{code}.csv", code=code)


@pytest.mark.parametrize(
    ("robot", "bag", "text"),
    [
        ("delta_cu", "absent.mcap", "no such file"),
        ("prru", DELTA, "slider_1"),
        ("massless", STIFFNESS, "inertia"),
    ],
)
def test_refusals(twin, tmp_path, robot, bag, text):
    if robot == "massless":
        robot = massless(tmp_path / "light.yaml")
    if bag != "absent.mcap":
        bag = rewrite(bag, tmp_path / "part.mcap", seconds=0.1)
    assert text in twin.refused("torques", robot, bag, "--out", tmp_path / "t.csv")
    assert not (tmp_path / "t.csv").exists()


def test_a_bag_too_short_to_differentiate(twin, tmp_path):
    bag = rewrite(DELTA, tmp_path / "short.mcap", seconds=0.004)
    line = ("torques", "delta_cu", bag, "--out", tmp_path / "t.csv")
    assert "too few joint states" in twin.refused(*line)


def test_efforts_beyond_the_file_s_limits_are_in_the_answer(twin, tmp_path):
    """In the first line, and in JSON, of the joints that are beyond; the table is written."""
    data = parameters_of("delta")
    robot, columns = load("delta"), motion("delta")
    states = [joined(columns, robot, what) for what in ("position", "velocity", "acceleration")]
    peaks = np.abs(inverse_dynamics(robot, *states)).max(0)
    data["limits"]["effort"] = (peaks * [0.5, 2.0, 0.9]).tolist()
    (tmp_path / "weak.yaml").write_text(yaml.safe_dump(data))
    write_columns(tmp_path / "a.csv", columns)
    line = "torques", tmp_path / "weak.yaml", tmp_path / "a.csv", "--no-picture"
    found = twin.told(*line, "--out", tmp_path / "b.csv")["beyond_limits"]
    assert [one.split(".")[0] for one in found] == [robot.joint_names[k] for k in (0, 2)]
    answer = twin.good(*line, "--out", tmp_path / "c.csv").out.splitlines()[0]
    for k, named in enumerate((True, False, True)):
        assert (f"{robot.joint_names[k]} {peaks[k]:.4g} of" in answer) == named
    strong = twin.told("torques", "delta", tmp_path / "a.csv", "--out", tmp_path / "d.csv")
    assert strong["beyond_limits"] == []
