# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Calibration on poses that another engine computed for another geometry."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bags.recording.capture import machine_parameters
from bags.recording.record_poses import NOISE, OFFSETS, SHIFTS, TURNS, record
from pkm_twin import Robot
from pkm_twin.apps.commands.calibrate import Calibrate
from pkm_twin.apps.commands.calibrate import calibrate as command
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.identification.calibration import calibrate, list_geometric_paths
from pkm_twin.identification.calibration_state import Poses
from pkm_twin.identification.measurements import read_poses
from test.support.command import Commands
from test.support.robots import load, random_joints
from test.support.tables import write_columns


def measured(path: Path, noise: float = NOISE, count: int = 60) -> None:
    """Poses of a Delta-CU that is not built as drawn, by Pinocchio's closed loops."""
    pytest.importorskip("pinocchio")
    record(path, noise=noise, count=count)


def test_a_machine_is_found_that_was_not_built_as_drawn(twin: Commands, tmp_path: Path) -> None:
    poses, out = tmp_path / "poses.csv", tmp_path / "mine.yaml"
    measured(poses)
    data = twin.told("calibrate", "delta_cu", poses, "--out", out)
    held = data["held_out"]
    assert held["before"]["rms_m"] > 4e-3
    # The measurement's own noise along three axes is in it.
    assert held["after"]["rms_m"] < 2.0 * NOISE * np.sqrt(3.0)
    assert 0.7 * NOISE < data["noise_m"] < 1.4 * NOISE
    found, drawn = data["parameters"], machine_parameters("delta_cu")["geometry"]
    truth = {f"geometry.{k}": drawn[k] + v for k, v in SHIFTS.items() if k != "base_radius"}
    truth |= {f"geometry.azimuths[{k}]": drawn["azimuths"][k] + t for k, t in enumerate(TURNS)}
    truth |= {f"joint_map.arm_{k + 1}.offset": o for k, o in enumerate(OFFSETS)}
    for path, value in truth.items():
        assert found[path]["observed"], path
        assert abs(found[path]["value"] - value) < 4.0 * found[path]["standard_deviation"], path
    # A Delta feels only the difference of its radii.
    (combination,) = data["not_observed"]
    assert set(combination) == {"geometry.base_radius", "geometry.platform_radius"}
    assert combination["geometry.base_radius"] == pytest.approx(combination["geometry.platform_radius"], rel=1e-3)
    radii = [found[f"geometry.{name}_radius"]["value"] for name in ("base", "platform")]
    true = drawn["base_radius"] + SHIFTS["base_radius"] - drawn["platform_radius"]
    assert radii[0] - radii[1] == pytest.approx(true, abs=1e-4)
    # The file is a robot that computes what was measured, from the sensors' own numbers.
    robot = load(out)
    told = read_poses(poses, robot)
    places = robot.platform(robot.controller.positions(told.joints))[0]
    assert np.sqrt(((places - told.position) ** 2).mean()) < 1.5 * NOISE
    text = out.read_text()
    assert "# -30, 90, 210 degrees" in text
    assert "(standard deviation), calibrated with poses.csv" in text


@pytest.mark.parametrize(
    ("scale", "different", "text"),
    [
        (1e3, 40, "m per axis after"),
        (1.0, 1, "1 different ones"),
        (1.0, 4, "enough for 10 numbers"),
    ],
)
def test_poses_of_no_use_are_refused(scale: float, different: int, text: str) -> None:
    robot = load("delta_cu")
    q = np.random.default_rng(1).uniform(-0.5, 0.9, (different, 3)).repeat(40 // different, 0)
    with pytest.raises(ParameterError, match=text):
        calibrate(robot, Poses(q, scale * robot.platform(q)[0]), list_geometric_paths(robot, q))


@pytest.mark.parametrize(
    ("header", "text"),
    [
        ("arm_1.position,x,y,z", "a column 'arm_2.position'"),
        ("arm_1.position,arm_2.position,arm_3.position,x,y", "a column 'z'"),
        ("arm_1.position,arm_2.position,arm_3.position,x,y,z,roll", "a column 'pitch'"),
        ("arm_1.position,arm_2.position,arm_3.position,arm_4.position,x", "arm_4.position"),
    ],
)
def test_columns_that_are_missing_are_named(tmp_path: Path, header: str, text: str) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(header + "\n0" + ",0" * header.count(","))
    with pytest.raises(PkmTwinError, match=text):
        read_poses(path, load("delta_cu"))


def crooked(seed: int, only: list[str], count: int) -> tuple[Robot, Poses]:
    """A 3-RPS head some numbers of which are not as drawn, and its poses."""
    robot, rng = load("rps3"), np.random.default_rng([seed, 77])
    q = random_joints(robot, rng, count, 0.05)
    sizes, known = {"m": 1e-3, "": 3e-3}, robot.file_numbers()
    moved = {p: known[p] for p in list_geometric_paths(robot, q, only) if not p.endswith(".home")}
    values = {p: v + sizes[unit] * rng.normal() for p, (v, unit) in moved.items()}
    position, rotation = robot.with_file_values(values).platform(q)
    turn = Rotation.from_rotvec(1e-4 * rng.normal(size=position.shape)).as_matrix()
    noisy = position + NOISE * rng.normal(size=position.shape)
    return robot, Poses(q + 1e-3 * rng.normal(size=3), noisy, turn @ rotation)


def settles(seed: int, only: list[str], count: int = 60) -> None:
    robot, poses = crooked(seed, only, count)
    result = calibrate(robot, poses, list_geometric_paths(robot, poses.joints, only))
    assert result.agreements[0].held_out[1].rms < 2.0 * NOISE * np.sqrt(3.0)
    assert 0.7 * NOISE < result.agreements[0].noise < 1.4 * NOISE


def test_directions_in_which_the_machine_turns_away_from_its_tangent_settle() -> None:
    """Tilts of the legs are told by their squares alone."""
    settles(1, ["joints.leg_3.", "joints.hinge_3."], 16)


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, *range(2, 10)])
def test_others_settle_too(seed: int) -> None:
    settles(seed, [])


def test_only_numbers_that_there_are_can_be_chosen() -> None:
    with pytest.raises(ParameterError, match="the beginning of a geometric number's path"):
        list_geometric_paths(load("delta_cu"), np.zeros((1, 3)), ["inertia"])


@pytest.mark.parametrize(
    ("names", "how", "text"),
    [
        ("x y z", lambda v: 1e300 * v, "up to 1e+04 in size"),
        ("roll pitch yaw", lambda v: 1e300 * v, "up to 6.28 in size"),
        ("roll pitch yaw", np.degrees, "up to 6.28 in size"),
        ("roll pitch yaw", lambda v: v + 3.1, "rad per axis after"),
        ("x y z", lambda v: -v, "per axis after"),
        ("limb_1 limb_2 limb_3", lambda v: v - 0.12, "--beyond-limits"),
    ],
)
@pytest.mark.parametrize("frame", [False, True])
def test_numbers_that_are_no_poses_of_this_machine(
    tmp_path: Path, names: str, how: Any, text: str, frame: bool
) -> None:
    """With the instrument's frame free too, which may take up much, but no angles of another."""
    robot = load("upr_rpu")
    rng = np.random.default_rng(11)
    q = random_joints(robot, rng, 40)
    place, rotation = robot.platform(q)
    angles = Rotation.from_matrix(rotation).as_euler("xyz")
    columns = dict(zip([f"{n}.position" for n in robot.joint_names], q.T, strict=True))
    columns |= dict(zip("xyz", place.T + 2e-5 * rng.normal(size=place.T.shape), strict=True))
    columns |= dict(zip(("roll", "pitch", "yaw"), angles.T, strict=True))
    for name in columns:
        if name.removesuffix(".position") in names.split():
            columns[name] = how(columns[name])
    path, out = tmp_path / "poses.csv", tmp_path / "mine.yaml"
    write_columns(path, columns)
    with pytest.raises(PkmTwinError, match=re.escape(text)):
        command.run(Calibrate(robot="upr_rpu", poses=path, out=out, frame=frame))
    assert not out.exists()
