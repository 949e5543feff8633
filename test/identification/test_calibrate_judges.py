# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Measured poses that are judged: outliers, other frames, other machines, and what stays open."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pkm_twin import Robot
from pkm_twin.apps.commands.calibrate import Calibrate
from pkm_twin.apps.commands.calibrate import calibrate as command
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.calibration import calibrate, list_geometric_paths
from pkm_twin.identification.calibration_state import Poses
from pkm_twin.identification.measurements import select_poses
from pkm_twin.identification.undetermined import MAX_SENTENCES, undetermined
from test.support.robots import data_of, load, random_joints
from test.support.tables import write_columns

NOISE = 2e-5
QUARTER = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()


@cache
def sound(seed: int) -> tuple[Robot, tuple[str, ...], Poses]:
    """A Delta whose lengths are a few millimetres off, and its sensors by a few degrees."""
    robot, rng = load("delta_cu"), np.random.default_rng([seed, 31])
    q = random_joints(robot, rng, 60, 0.02)
    paths = list_geometric_paths(robot, q)
    known = {p: robot.file_numbers()[p] for p in paths}
    size = {"m": 3e-3, "rad": 0.03, "": 0.03}
    truth = robot.with_file_values({p: v + size[u] * rng.normal() for p, (v, u) in known.items()})
    position = truth.platform(q)[0] + NOISE * rng.normal(size=(60, 3))
    return robot, paths, Poses(q + 0.03 * rng.normal(size=3), position)


@pytest.mark.parametrize("seed", [0, 1])
def test_one_wrong_pose_of_sixty_moves_nothing_and_is_named(seed: int) -> None:
    robot, paths, poses = sound(seed)
    plain = calibrate(robot, poses, paths)
    assert not plain.outliers and not plain.faults
    moved = {p.name: (p.value - p.before) / p.prior for p in plain.parameters}
    for weights in plain.unobserved:
        assert abs(sum(w * moved[name] for name, w in weights.items())) < 1e-6
        assert max(abs(moved[name]) for name in weights) > 1e-3
    rng = np.random.default_rng(seed)
    for row in (8, 11):  # learnt from, and held out
        position = poses.position.copy()
        position[row] += 0.05 * Rotation.random(random_state=rng).as_matrix()[0]
        found = calibrate(robot, Poses(poses.joints, position), paths)
        assert [one.line for one in found.outliers] == [row + 2]
        assert found.outliers[0].size("m") == pytest.approx(0.05, rel=0.01)
        assert found.agreements[0].held_out[1].rms < 2.0 * NOISE * np.sqrt(3.0)
        for one, before in zip(found.parameters, plain.parameters, strict=True):
            assert abs(one.value - before.value) < 1.5 * before.deviation, one.name
            assert one.deviation < 1.5 * before.deviation


def test_poses_in_another_frame_are_proposed_a_frame() -> None:
    robot, paths, poses = sound(0)
    moved = Poses(poses.joints, poses.position + 0.05 * np.array([0.6, -0.5, 0.6]))
    with pytest.raises(PkmTwinError, match="--frame"):
        calibrate(robot, moved, paths)
    for turn in (QUARTER, Rotation.from_euler("x", 90.0, degrees=True).as_matrix()):
        with pytest.raises(PkmTwinError, match="--frame"):
            calibrate(robot, Poses(poses.joints, poses.position @ turn.T), paths)
    shifted = Poses(poses.joints, poses.position @ QUARTER.T + [0.05, -0.3, 0.1])
    found = calibrate(robot, shifted, paths, frame=True)
    assert found.agreements[0].held_out[1].rms < 2.0 * NOISE * np.sqrt(3.0) and not found.faults


def test_an_offset_that_no_number_takes_up_is_a_frame_too() -> None:
    """It then looks like noise, which is below what another machine would leave."""
    robot, _, poses = sound(1)
    moved = Poses(poses.joints, poses.position + np.array([-0.008, 0.0, 0.0]))
    with pytest.raises(PkmTwinError, match="--frame"):
        calibrate(robot, moved, ["geometry.arm_length", "geometry.forearm_length"], offsets=True)


def test_changes_beyond_their_prior_are_rejected_or_marked(tmp_path: Path) -> None:
    robot, _, poses = sound(0)
    far = robot.with_file_values({"geometry.forearm_length": 0.1 + _forearm(robot)})
    there = Poses(poses.joints, far.platform(poses.joints)[0])
    only = ("geometry.arm_length", "geometry.forearm_length")
    with pytest.raises(PkmTwinError, match=r"geometry.forearm_length changes by 0.1 m"):
        calibrate(robot, there, only, offsets=False)
    assert not calibrate(robot, there, only, offsets=False, prior=0.1).faults
    names = [*(f"{j}.position" for j in robot.controller.names), "x", "y", "z"]
    table, out = tmp_path / "poses.csv", tmp_path / "mine.yaml"
    rows = np.hstack([there.joints, there.position])
    write_columns(table, dict(zip(names, rows.T, strict=True)))
    given = Calibrate(robot="delta_cu", poses=table, out=out, only=only, no_offsets=True, accept=True)
    (reason,) = command.run(given).data["accepted"]
    assert "geometry.forearm_length" in reason
    assert "accepted anyway" in out.read_text()


def _forearm(robot: Robot) -> float:
    return robot.file_numbers()["geometry.forearm_length"][0]


def test_many_wrong_poses_are_another_machine() -> None:
    robot, paths, poses = sound(0)
    rng = np.random.default_rng(5)
    position = poses.position.copy()
    wrong = rng.permutation(60)[:20]
    position[wrong] += 0.02 * rng.normal(size=(20, 3))
    with pytest.raises(PkmTwinError, match=r"\d+ of 60 do not fit the others"):
        calibrate(robot, Poses(poses.joints, position), paths)


def test_noise_is_that_of_the_good_poses() -> None:
    rng = np.random.default_rng(0)
    parts = [1e-4 * rng.normal(size=(400, 3)), 1e-3 * rng.normal(size=(400, 3))]
    parts[0][::20] += 0.1
    still = Poses(np.zeros((400, 3)), np.zeros((400, 3)), np.zeros((400, 3, 3)))
    none = [np.zeros((400, 3, 1))] * 2
    found = select_poses(still, np.arange(400)).weighed(parts, none, np.ones(1))
    assert found.noise == pytest.approx((1e-4, 1e-3), rel=0.15)
    weights = (found.noise[0] * found.scales[0]) ** 2
    assert weights[::20].max() < 0.01
    assert np.mean(weights[np.arange(400) % 20 != 0] > 1.0 - 1e-9) > 0.9


@pytest.mark.parametrize(
    ("moves", "words"),
    [
        # By names of joints, or all of a kind: a shift of `at` along x.
        ([["foot_", "ball_"]], ("the platform's joints and the base's joints", "along x")),
        ([["foot_"]], ("the base's joints moved together along x",)),
        ([["ball_", "origin"]], ("the platform's joints and the reference point", "along x")),
        (
            [["foot_a_1", "ball_a_1"], ["foot_b_2", "ball_b_2"]],
            ("limbs moved as a whole along x: foot_a_1 with ball_a_1, foot_b_2 with ball_b_2",),
        ),
        ([["foot_a_1"], ["ball_b_3"]], ("joints.foot_a_1.at[0], joints.ball_b_3.at[0] alone",)),
    ],
)
def test_directions_are_called_by_what_they_mean(moves: Any, words: tuple[str, ...]) -> None:
    graph = load("stewart").graph
    names = [f"origin[{k}]" for k in range(3)]
    names += [f"joints.{name}.at[{k}]" for name, joint in graph.joints.items() if not joint.actuated for k in range(3)]
    columns = [[float(name.endswith("[0]") and any(w in name for w in one)) for name in names] for one in moves]
    basis = np.linalg.qr(np.array(columns).T)[0]
    # Any basis of the same space is called the same.
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(len(moves),) * 2))[0]
    (line,) = undetermined(graph, names, np.full(len(names), 0.01), basis @ turn)
    for word in words:
        assert word in line


def test_whatever_stays_open_ten_lines_are_enough() -> None:
    graph, rng = load("stewart").graph, np.random.default_rng(2)
    names = [f"joints.{name}.at[{k}]" for name in graph.joints for k in range(3)]
    for count in (1, 5, 30, len(names)):
        basis = np.linalg.qr(rng.normal(size=(len(names), count)))[0]
        told = undetermined(graph, names, np.full(len(names), 0.01), basis)
        assert 1 <= len(told) <= MAX_SENTENCES
        assert max(map(len, told)) < 300
    assert undetermined(graph, names, np.ones(len(names)), np.zeros((len(names), 0))) == []


def test_an_offset_is_in_the_sensors_unit() -> None:
    robot, paths, poses = sound(0)
    data = data_of(robot) | {"joint_map": {"arm_1": {"ratio": 50.0, "sign": -1}}}
    counted = type(robot).from_data(data, "counted")
    joints = poses.joints * np.array([-50.0, 1.0, 1.0])
    found = calibrate(counted, Poses(joints, poses.position), paths)
    units = {p.name: p.unit for p in found.parameters}
    assert units["joint_map.arm_1.offset"] == "controller units"
    assert units["joint_map.arm_2.offset"] == "rad"
