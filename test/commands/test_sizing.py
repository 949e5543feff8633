# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""`pkm-twin size` as a user runs it, for cycles, recordings and the workspace."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.integrate import trapezoid
from scipy.spatial.transform import Rotation

from delta_dynamics import inverse_dynamics, mass_matrix
from pkm_twin.bags.reader import read_messages
from pkm_twin.errors import ParameterError
from pkm_twin.machine.sections import DriveSpec
from pkm_twin.paths import cycle, fastest
from pkm_twin.paths.sizing import Fit, Gear, read_motors
from pkm_twin.recordings import write_table
from test.commands.conftest import CYCLE, REPOSITORY, checked
from test.support.robots import load, parameters_of, without
from test.support.tables import joined, read_columns

GEAR = {"inertia": 1.73e-5, "ratio": 10.0, "efficiency": 0.9}
MOTOR = {"inertia": 1.73e-5, "continuous_torque": 9.0, "peak_torque": 9.0, "rated_speed": 3000.0}


@pytest.fixture
def geared(tmp_path):
    data = parameters_of("delta")
    data["inertia"].pop("rotor_inertia")
    path = tmp_path / "geared.yaml"
    path.write_text(yaml.safe_dump({**data, "drive": GEAR}))
    return path


def test_a_cycle_as_a_trajectory_that_size_reads(twin, tmp_path, geared):
    out = tmp_path / "cycle.mcap"
    twin.good(*CYCLE, "--out", out, "--no-picture", "--payload", "0.4")
    (message,) = (m.message for m in read_messages(out))
    robot = load("delta").changed(payload={"mass": 0.4})
    assert list(message.joint_names) == list(robot.joint_names)
    motion = fastest(robot, cycle(robot, 0.025, 0.305, 0.025)).uniform(1000)
    assert len(message.points) == len(motion.time)
    for k in (0, 17, -1):
        point = message.points[k]
        np.testing.assert_allclose(point.effort, motion.effort[k])
        np.testing.assert_allclose(point.positions, motion.q[k])
    # At the end the machine rests and is held.
    assert not any(message.points[-1].velocities)
    held = inverse_dynamics(robot, motion.q[-1], np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(message.points[-1].effort, held)
    result = twin.told("size", "delta", out)
    assert result["efforts"] == "the file's"
    assert result["payload"]["mass_kg"] == 0.4
    np.testing.assert_allclose(result["difference_from_model"], 0.0, atol=1e-6)
    # Planned without the rotors of another file.
    other = twin.told("size", geared, out)
    assert min(other["difference_from_model"]) > 0.05
    again = tmp_path / "torques.csv"
    twin.good("torques", "delta", out, "--out", again, "--no-picture")
    np.testing.assert_allclose(joined(read_columns(again), robot, "effort"), motion.effort, atol=1e-6)
    peak = result["drives"]["arm_1"]["joint"]["peak_effort_N_m"]
    assert peak == pytest.approx(np.abs(motion.effort[:, 0]).max())


def test_sizes_are_a_readers_own_sums(twin, tmp_path, geared):
    out = tmp_path / "cycle.csv"
    twin.good("path", geared, *CYCLE[2:], "--out", out, "--no-picture")
    picture = tmp_path / "speeds.png"
    result = twin.told("size", geared, out, "--drives", "shipped", "--picture", picture)
    assert picture.read_bytes()[:4] == b"\x89PNG"
    robot, columns = load(geared), read_columns(out)
    t = columns["time"]
    q, qd, qdd, tau = (joined(columns, robot, word) for word in ("position", "velocity", "acceleration", "effort"))
    whole = t[-1] - t[0]
    for i, joint in enumerate(robot.joint_names):
        side = result["drives"][joint]["joint"]
        power = tau[:, i] * qd[:, i]
        assert side["rms_effort_N_m"] == pytest.approx(np.sqrt(trapezoid(tau[:, i] ** 2, t) / whole))
        assert side["peak_speed_rad_s"] == pytest.approx(np.abs(qd[:, i]).max())
        assert side["peak_power_W"] == pytest.approx(power.max())
        assert side["peak_regenerated_power_W"] == pytest.approx(-power.min())
        # Trapezoids miss where the acceleration steps between two samples.
        near = 0.02 * trapezoid(np.abs(power), t)
        assert side["energy_J"] == pytest.approx(trapezoid(power, t), abs=near)
        assert side["regenerated_J"] == pytest.approx(-trapezoid(np.minimum(power, 0), t), abs=near)
        n, rotor, share = GEAR["ratio"], GEAR["inertia"], GEAR["efficiency"]
        load_torque = tau[:, i] - rotor * n**2 * qdd[:, i]
        driven = load_torque * qd[:, i] >= 0
        at_shaft = np.where(driven, load_torque / (n * share), load_torque * share / n)
        motor = rotor * n * qdd[:, i] + at_shaft
        side = result["drives"][joint]["motor"]
        assert side["peak_effort_N_m"] == pytest.approx(np.abs(motor).max())
        assert side["rms_effort_N_m"] == pytest.approx(np.sqrt(trapezoid(motor**2, t) / whole))
        assert side["peak_speed_rad_s"] == pytest.approx(n * np.abs(qd[:, i]).max())
        seen = mass_matrix(robot, q)[:, i, i] - rotor * n**2
        assert result["drives"][joint]["inertia_ratio"] == pytest.approx(seen.max() / n**2 / rotor)
        own = next(d for d in result["drives"][joint]["drives"] if d["motor"] == "SGMAH-04A")
        assert own["used_continuous_torque"] == pytest.approx(side["rms_effort_N_m"] / 1.27)
        assert own["used_torque"] == pytest.approx(side["peak_effort_N_m"] / 3.82)
        assert own["good"]
        small = next(d for d in result["drives"][joint]["drives"] if d["motor"] == "SGMAH-A5A")
        assert not small["good"]
    motors = sum(one["motor"]["energy_J"] for one in result["drives"].values())
    assert result["motors_energy_J"] == pytest.approx(motors) and motors > result["energy_J"]


@pytest.mark.parametrize(
    ("name", "motion", "option"),
    [("five_bar", ("--cycle", "30,100"), {"ratio": 10.0}), ("linear_delta", ("--cycle", "20,80"), {"lead": 0.04})],
)
def test_a_gear_on_the_command_line_is_the_files_drive(twin, tmp_path, name, motion, option):
    data, share = parameters_of(name), 0.9
    section = data["joints"] if name == "five_bar" else data["limbs"]["joints"]
    for joint in section.values():
        if joint.get("actuated"):
            given = DriveSpec(1.0, **option)
            rotor = joint.pop("rotor_inertia") / given.turns**2
            joint["drive"] = {"inertia": rotor, "efficiency": share, **option}
    path, out = tmp_path / f"{name}.yaml", tmp_path / "cycle.csv"
    path.write_text(yaml.safe_dump(data))
    twin.good("path", name, *motion, "--out", out, "--no-picture")
    ((key, value),) = option.items()
    given = (f"--{key}", value, "--efficiency", share)
    own = twin.told("size", path, out, "--drives", "shipped")["drives"]
    same = twin.told("size", name, out, *given, "--drives", "shipped")["drives"]
    assert own.keys() == same.keys()
    for joint, entry in own.items():
        assert same[joint]["motor"] == pytest.approx(entry["motor"])
        assert same[joint]["inertia_ratio"] == pytest.approx(entry["inertia_ratio"])
        for one, other in zip(entry["drives"], same[joint]["drives"], strict=True):
            assert other == pytest.approx(one)
    # A file's drive is not replaced; a gear does not fit a joint of the other type.
    assert twin("size", path, out, *given).code == 1
    other = {"ratio": "--lead", "lead": "--ratio"}[key]
    assert twin("size", name, out, other, value).code == 1
    # Leads in mm are refused with the unit.
    for words in (("--lead", 5), ("--drives", "shipped", "--leads", "5:40")):
        assert "1 m per turn" in twin("size", name, out, *words).err


def motor_side(columns, robot, i, rotor, ratio, motor, share):
    """A reader's own motor: torque and speed of a ratio, and the greatest used part."""
    t = columns["time"]
    qd, qdd, tau = (joined(columns, robot, word)[:, i] for word in ("velocity", "acceleration", "effort"))
    load = tau - rotor * qdd
    shaft = np.where(load * qd < 0, load * share / ratio, load / (ratio * share))
    torque, speed = motor["inertia"] * ratio * qdd + shaft, ratio * qd
    rated, most = (motor[f"{word}_speed"] * np.pi / 30 for word in ("rated", "max"))
    peak, held = motor["peak_torque"], motor["continuous_torque"]
    curve = np.interp(np.abs(speed), [0.0, rated, most], [peak, peak, held])
    rms = np.sqrt(trapezoid(torque**2, t) / (t[-1] - t[0]))
    beyond = np.inf if np.abs(speed).max() > most else (np.abs(torque) / curve).max()
    return torque, rms, max(beyond, rms / held, np.abs(speed).max() / most)


def test_the_ratio_is_that_of_a_search_by_brute_force(twin, tmp_path, geared):
    """All ratios of a fine grid, for each motor: of one drive, and of all drives alike."""
    out, drives = tmp_path / "cycle.csv", tmp_path / "drives.yaml"
    twin.good("path", geared, "--cycle", "25,200,25", "--duration", "0.5", "--out", out, "--no-picture")
    base = {"rated_speed": 3000.0, "max_speed": 5000.0}
    motors = {
        "small": {"inertia": 4e-6, "continuous_torque": 0.12, "peak_torque": 0.4, **base},
        "middle": {"inertia": 1.1e-5, "continuous_torque": 0.3, "peak_torque": 0.9, **base},
        "large": {"inertia": 7e-5, "continuous_torque": 1.3, "peak_torque": 4.0, **base},
    }
    drives.write_text(yaml.safe_dump({"drives": motors}))
    data = twin.told("size", geared, out, "--drives", drives, "--ratios", "5:80")
    robot, columns = load(geared), read_columns(out)
    rotor, share = GEAR["inertia"] * GEAR["ratio"] ** 2, GEAR["efficiency"]
    ratios, names = np.arange(5.0, 80.001, 0.25), robot.joint_names
    used = {
        name: np.array([[motor_side(columns, robot, i, rotor, n, motor, share)[2] for n in ratios] for i in range(3)])
        for name, motor in motors.items()
    }
    for i, joint in enumerate(names):
        for entry in data["drives"][joint]["drives"]:
            name = entry["motor"]
            best = used[name][i].min()
            torque, rms, own = motor_side(columns, robot, i, rotor, entry["ratio"], motors[name], share)
            assert own <= best * (1 + 1e-9) and own >= 0.98 * best
            assert entry["good"] == (own <= 1.0)
            assert entry["rms_torque_N_m"] == pytest.approx(rms)
            assert entry["peak_torque_N_m"] == pytest.approx(np.abs(torque).max())
        fitting = [name for name in motors if used[name][i].min() <= 1.0]
        assert data["smallest_for_each"][joint]["motor"] == fitting[0]
    alike = {name: table.max(0) for name, table in used.items()}
    (best,) = {tuple(one.items()) for one in data["smallest_for_all"].values()}
    best = dict(best)
    assert best["motor"] == data["smallest_motor"] == next(n for n in motors if alike[n].min() <= 1)
    assert best["ratio"] == pytest.approx(ratios[alike[best["motor"]].argmin()], abs=0.25)
    # Of a list, one of it.
    some = twin.told("size", geared, out, "--drives", drives, "--ratios", "7,20,33")
    listed = {name: table[np.isin(ratios, [7, 20, 33])] for name, table in alike.items()}
    first = next(name for name in motors if listed[name].min() <= 1.0)
    assert some["smallest_motor"] == first
    chosen = {one["ratio"] for one in some["smallest_for_all"].values()}
    assert chosen == {[7.0, 20.0, 33.0][listed[first].argmin()]}
    for wrong in ("50:5", "5:x", "0:3", "1:2:3"):
        twin("size", geared, out, "--drives", drives, "--ratios", wrong).one_line_error()


def test_listed_gears_have_inertia_limits_and_cost(twin, tmp_path, geared):
    out, drives = tmp_path / "cycle.csv", tmp_path / "drives.yaml"
    twin.good("path", geared, "--cycle", "25,200", "--out", out, "--no-picture")
    motor = MOTOR | {"cost": 100.0, "max_speed": 9000.0}
    gears = {
        "weak": {"ratio": 20.0, "peak_torque": 1.0},
        "tight": {
            "ratio": 10.0,
            "inertia": 4e-5,
            "efficiency": 0.8,
            "continuous_torque": 50.0,
            "backlash": 3e-4,
            "cost": 40.0,
        },
    }
    text = yaml.safe_dump({"drives": {"one": motor}, "gears": gears})
    drives.write_text(text.replace("4.0e-05", "4e-5"))
    data = twin.told("size", geared, out, "--drives", drives)
    robot, columns = load(geared), read_columns(out)
    (entry,) = data["drives"]["arm_2"]["drives"]
    rotor = GEAR["inertia"] * GEAR["ratio"] ** 2
    _, rms, _ = motor_side(columns, robot, 1, rotor, 10.0, motor | {"inertia": 5.73e-5}, 0.8)
    assert entry["rms_torque_N_m"] == pytest.approx(rms)
    assert (entry["gear"], entry["cost"], entry["backlash"]) == ("tight", 140.0, 3e-4)
    qdd, tau = (joined(columns, robot, word)[:, 1] for word in ("acceleration", "effort"))
    t, through = columns["time"], tau - rotor * qdd
    assert entry["used_gear_torque"] == pytest.approx(np.sqrt(trapezoid(through**2, t) / (t[-1] - t[0])) / 50.0)
    seen = data["drives"]["arm_2"]["load_inertia_kg_m2"][1] / 100.0 + 4e-5
    assert entry["inertia_ratio"] == pytest.approx(seen / 1.73e-5)
    gears.pop("tight")
    drives.write_text(yaml.safe_dump({"drives": {"one": motor}, "gears": gears}))
    weak = twin.told("size", geared, out, "--drives", drives)
    assert weak["smallest_motor"] is None
    used = weak["drives"]["arm_2"]["drives"][0]["used_gear_torque"]
    assert used == pytest.approx(np.abs(through).max())
    drives.write_text(yaml.safe_dump({"drives": {"one": motor}, "gears": {"none": {"cost": 1.0}}}))
    assert "gears.none" in twin.refused("size", geared, out, "--drives", drives)


def test_a_motor_is_limited_by_its_curve(twin, tmp_path, geared):
    out, drives = tmp_path / "cycle.csv", tmp_path / "drives.yaml"
    twin.good("path", geared, "--cycle", "25,200", "--out", out, "--no-picture")
    motor = MOTOR | {"max_speed": 5000.0}
    drives.write_text(
        yaml.safe_dump({"drives": {"flat": motor, "slow": {**motor, "curve": [[0.0, 9.0], [200.0, 9.0]]}}})
    )
    result = twin.told("size", geared, out, "--drives", drives)
    flat, slow = result["drives"]["arm_1"]["drives"]
    assert flat["good"]
    assert not slow["good"]
    assert slow["used_speed"] > 1.0
    (one,) = read_motors(drives, ["flat"]).values()
    fit = Fit(
        "flat",
        one,
        Gear(ratio=1.0),
        torque=np.inf,
        thermal=0.5,
        speed=1.2,
        geared=0.0,
        inertia_ratio=1.0,
        rms=1.0,
        torques=np.ones(2),
        speeds=np.ones(2),
    )
    assert fit.answer == "too slow" and replace(fit, thermal=1.1).answer == "too small and too slow"
    assert [replace(fit, speed=0.9, torque=t).answer for t in (0.9, 1.1)] == ["fits", "too small"]
    text = twin.good("size", geared, out, "--drives", drives).out
    assert all(float(part) <= 1000.0 for part in re.findall(r"([\d.e+]+) %", text))
    drives.write_text("drives: {one: {inertia: 1.0}}")
    assert twin("size", geared, out, "--drives", drives).code == 1
    assert twin("size", "delta", out, "--drives", "shipped").code == 1
    assert twin("size", geared, out, "--drives", "shipped", "--motor", "none").code == 1


@pytest.mark.parametrize(
    "change",
    [
        {"curve": [[0.0, 9.0], [200.0]]},
        {"curve": [[10.0, 9.0], [200.0, 8.0]]},
        {"curve": [[0.0, 0.0], [200.0, 0.0]]},
        {"curve": [[0.0, 9.0], [200.0, float("nan")]]},
        {"curve": [[0.0, 5.0], [200.0, 4.0]]},
        {"curve": "flat"},
        {"continuous_torque": 9.1},
        {"rated_speed": 6000.0},
        {"peak_torque": 1e300},
        {"inertia": 0.0},
    ],
)
def test_a_motor_that_cannot_be_is_rejected_by_its_field(tmp_path, change):
    motor = {
        "inertia": 1.73e-5,
        "continuous_torque": 6.0,
        "peak_torque": 9.0,
        "rated_speed": 3000.0,
        "max_speed": 5000.0,
    }
    path = tmp_path / "drives.yaml"
    path.write_text(yaml.safe_dump({"drives": {"one": motor}}))
    assert len(read_motors(path)) == 1
    path.write_text(yaml.safe_dump({"drives": {"one": {**motor, **change}}}))
    with pytest.raises(ParameterError) as error:
        read_motors(path)
    assert "drives.one" in error.value.field


@pytest.mark.parametrize("column", ["arm_2.effort", "fx"])
def test_efforts_that_no_drive_has_are_rejected(twin, tmp_path, column):
    out = tmp_path / "cycle.csv"
    twin.good(*CYCLE, "--out", out, "--no-picture")
    columns = read_columns(out)
    columns[column] = columns.get(column, 0.0 * columns["time"])
    columns[column][3] = 1e300
    write_table(columns, out)
    for command in ("size", "loads"):
        assert "line 5" in twin.refused(command, "delta", out)


def test_a_recording_is_sized_by_its_measured_efforts(twin, sample):
    measured, model = (twin.told("size", "delta_cu", sample, "--efforts", what) for what in ("file", "model"))
    for joint in measured["drives"]:
        one, other = (r["drives"][joint]["joint"]["rms_effort_N_m"] for r in (measured, model))
        assert one == pytest.approx(other, rel=0.05)


@pytest.mark.parametrize("name", ["delta", "five_bar", "linear_delta"])
def test_the_worst_of_the_workspace_is_that_of_many_tries(twin, name):
    speed, change = 0.8, 9.0
    result = twin.told("size", name, "--over-workspace", f"{speed},{change}")
    robot = load(name)
    rng = np.random.default_rng(5)
    places = [i for i, n in enumerate(robot.pose_names) if n in "xyz"]
    for joint, entry in result["drives"].items():
        i = robot.joint_names.index(joint)
        key = next(k for k in entry if k.startswith("effort_N"))
        q = robot.inverse(list(entry["effort_pose"].values()))
        count = 3000
        directions = rng.normal(size=(2, count, len(places)))
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        v, a = np.zeros((count, len(robot.pose_names))), np.zeros((count, len(robot.pose_names)))
        v[:, places], a[:, places] = speed * directions[0], change * directions[1]
        qs = np.tile(q, (count, 1))
        j = robot.jacobian(qs)
        qd = np.linalg.solve(j, v[..., None])[..., 0]
        own = robot.pose_acceleration(qs, qd, 0 * qd)
        qdd = np.linalg.solve(j, (a - own)[..., None])[..., 0]
        tried = np.abs(inverse_dynamics(robot, qs, qd, qdd)[:, i]).max()
        assert tried <= entry[key] * (1.0 + 0.01)
        assert tried >= entry[key] * 0.93


def test_the_workspace_ends_before_a_limb_is_stretched(twin):
    """A drive's lever, 0 where arm and forearm lie in line, is at most the arm's length."""
    name, speed = "examples/machines/delta_1130.yaml", 2.0
    kept, all_ = (twin.told("size", name, "--over-workspace", f"{speed},50", "--lever", least) for least in (0.4, 0.0))
    assert kept["least_lever"] == 0.4
    robot, length = load(REPOSITORY / name), 0.35
    for data, bounded in ((kept, True), (all_, False)):
        for i, entry in enumerate(data["drives"].values()):
            q = robot.inverse(list(entry["speed_pose"].values()))
            lever = 1.0 / np.linalg.norm(np.linalg.inv(robot.jacobian(q))[i])
            assert entry["speed_rad_s"] == pytest.approx(speed / lever)
            assert (lever >= 0.399 * length) == bounded


def test_a_machine_that_only_turns_is_sized_by_its_turns(twin):
    """Against turns of constant rate and growing rate, followed by differences in time."""
    name, (speed, change) = "examples/machines/agile_eye.yaml", (15.0, 20.0)
    result = twin.told("size", name, "--over-workspace", f"{speed},{change}")
    robot, rng, step, count = load(REPOSITORY / name), np.random.default_rng(3), 1e-3, 2000
    ways = rng.normal(size=(2, count, 3))
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    time = step * np.arange(-1.0, 2.0)[:, None, None]
    turn = Rotation.from_rotvec((speed * ways[0] * time).reshape(-1, 3)) * Rotation.from_rotvec(
        (0.5 * change * ways[1] * time**2).reshape(-1, 3)
    )
    for i, entry in enumerate(result["drives"].values()):
        at = Rotation.from_euler("ZYX", list(entry["effort_pose"].values())[::-1])
        poses = (turn * at).as_euler("ZYX")[:, ::-1].reshape(3, count, 3)
        before, q, after = robot.inverse(poses)
        rates, changes = (after - before) / (2 * step), (after - 2 * q + before) / step**2
        tried = np.abs(inverse_dynamics(robot, q, rates, changes)[:, i]).max()
        assert 0.9 * entry["effort_N_m"] <= tried <= 1.003 * entry["effort_N_m"]


def test_a_machine_that_only_turns_plans_and_is_sized_like_others(twin, tmp_path):
    """A circle of roll and pitch, its speed that of the platform's turn."""
    name, out = REPOSITORY / "examples/machines/agile_eye.yaml", tmp_path / "circle.csv"
    line = ("path", name, "--circle", "0.15", "--at", "0.05,0,0.1", "--fastest", "--speed", "2")
    assert f"circle, {2 * np.pi * 0.15:.4g} rad in" in twin.good(*line, "--no-picture").out
    data = twin.told(*line, "--out", out, "--no-picture")
    assert data["greatest_speed_rad_s"] == pytest.approx(2.0, rel=1e-3)
    columns = read_columns(out)
    angles = np.stack([columns[n] for n in ("roll", "pitch", "yaw")], -1)
    np.testing.assert_allclose(np.hypot(angles[:, 0] - 0.05, angles[:, 1]), 0.15, atol=1e-6)
    np.testing.assert_allclose(angles[:, 2], 0.1, atol=1e-9)
    turn = Rotation.from_euler("ZYX", angles[:, ::-1])
    speed = (turn[2:] * turn[:-2].inv()).magnitude() / (columns["time"][2:] - columns["time"][:-2])
    assert speed.max() == pytest.approx(2.0, rel=2e-3)
    assert checked(out, robot=name).code == 0
    assert max(twin.told("size", name, out)["difference_from_model"]) < 1e-6
    soft = ("--slow-where-soft", "--force", "1", "--deflection", "1e-3")
    twin.refused(*line, *soft)


def test_size_takes_the_models_efforts_for_another_payload(twin, tmp_path):
    """The file's efforts carry 0.5 kg."""
    out, plain = tmp_path / "cycle.csv", tmp_path / "plain.csv"
    twin.good(*CYCLE, "--payload", "0.5", "--out", out, "--no-picture")
    columns = read_columns(out)
    write_table({k: v for k, v in columns.items() if not k.endswith("effort")}, plain)
    line = ("size", "delta", out, "--payload", "3")
    given = twin.told(*line)
    expected = twin.told("size", "delta", plain, "--payload", "3")
    assert given["efforts"] == "the model's" and given["payload"]["mass_kg"] == 3.0
    assert given["drives"]["arm_1"]["joint"] == pytest.approx(expected["drives"]["arm_1"]["joint"])
    assert twin.told(*line, "--efforts", "file")["efforts"] == "the file's"
    assert twin.told("size", "delta", out)["efforts"] == "the file's"


@pytest.mark.parametrize("fast", [True, False])
def test_a_closed_cycle_without_friction_takes_no_energy(twin, tmp_path, fast):
    """Accelerations of a fastest motion step between its samples."""
    file = tmp_path / "delta.yaml"
    file.write_text(yaml.safe_dump(without(parameters_of("delta"), "friction")))
    law = ["--fastest"] if fast else ["--duration", "0.5"]
    twin("path", file, "--cycle", "25,200,25", *law, "--out", tmp_path / "cycle.csv")
    line = ("size", file, tmp_path / "cycle.csv")
    told = json.loads(twin(*line, "--json").out)
    assert told["regenerated_J"] > 1.0
    assert abs(told["energy_J"]) < 1e-5 * told["regenerated_J"]
    # It goes there and back alike, so that no drive takes energy from another.
    rows = [row.split() for row in twin(*line).out.splitlines() if row.startswith("arm_")]
    assert [row[7] for row in rows] == ["0"] * 3
    assert sum(d["joint"]["energy_J"] for d in told["drives"].values()) == pytest.approx(told["energy_J"], abs=1e-9)
