# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Transmissions by measured poses: ratios, their change with travel; tables as recorded."""

from __future__ import annotations

from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from pkm_twin import Robot
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.identification.calibration import HELD_OUT_INTERVAL, calibrate, list_geometric_paths
from pkm_twin.identification.calibration_state import Poses, Transmission
from pkm_twin.identification.measurements import read_poses
from pkm_twin.machine.joint_map import JointMap, JointMapEntry
from pkm_twin.messages.reading import JointReader
from pkm_twin.recordings import Dialect
from test.support.command import Commands
from test.support.robots import data_of, load, partly_long, random_joints
from test.support.tables import write_columns
from tools.reality import BALL, FOOT, fit_a_leg, leg_poses

NOISE = 2e-5
RATIOS = (13.2, 14.1, 13.8)
EXAMPLES = Path(__file__).parents[2] / "examples/machines/hexapod"


@cache
def spools() -> tuple[Robot, Array]:
    """A linear Delta whose carriages are moved by spools, signs mixed, and joint positions."""
    entries = {
        f"rail_{k + 1}": {"ratio": ratio, "sign": (-1.0) ** k, "offset": 3.0 * k, "unit": "rev"}
        for k, ratio in enumerate(RATIOS)
    }
    plain = load("linear_delta")
    robot = type(plain).from_data({**data_of(plain), "joint_map": entries}, plain.name)
    return robot, random_joints(robot, np.random.default_rng(5), 48, 0.01)


def measured(changes: Array, factors: Array) -> Poses:
    """Poses of a machine with other ratios, which change with travel from 0.3 m on."""
    robot, q = spools()
    own = robot.controller
    true = JointMap(own.names, own.factors * factors, own.offsets + 0.05, changes, np.full(3, 0.3), own.units)
    noise = NOISE * np.random.default_rng(8).normal(size=q.shape)
    return Poses(np.asarray(true.controller_positions(q)), robot.platform(q)[0] + noise)


@pytest.mark.parametrize("how", ["auto", "shared", "travel"])
def test_ratios_are_found_within_their_deviations(how: str) -> None:
    robot, _ = spools()
    factors = np.full(3, 1.02) if how == "shared" else np.array([1.02, 0.98, 1.01])
    changes = np.array([0.3, -0.2, 0.1]) if how == "travel" else np.zeros(3)
    poses = measured(changes, factors)
    found = calibrate(robot, poses, (), transmission=Transmission(how))
    away = found.agreements[0].held_out
    assert away[1].rms < 2.0 * NOISE * np.sqrt(3.0) < away[0].rms
    by = {p.name: p for p in found.parameters}
    for k, joint in enumerate(robot.joint_names):
        path, centre = f"joint_map.{joint}", float(found.joint_map.centres[k])
        one = by["joint_map.*.ratio" if how == "shared" else f"{path}.ratio"]
        at_centre = 1.0 + changes[k] * (centre - 0.3)
        true = factors[k] * at_centre * (1.0 if how == "shared" else RATIOS[k])
        assert one.observed and abs(one.value - true) < 4.0 * one.deviation < 0.01 * true
        if how == "travel":
            change = by[f"{path}.ratio_change"]
            assert abs(change.value - changes[k] / at_centre) < 4.0 * change.deviation < 0.2
            assert by[f"{path}.ratio"].unit == "rev/m"


@pytest.mark.parametrize(
    "case",
    partly_long([(60, 0), (108, 0), (108, 5)], (60, 0)),
    ids=lambda case: f"{case[0]}, {case[1]} wrong",
)
def test_a_measured_hexapod_is_predicted_as_well_as_by_a_fit_of_each_leg(
    case: tuple[int, int],
) -> None:
    """Nodes, zeros and transmissions of the example are off; motion capture has noise."""
    (count, wrong), rng = case, np.random.default_rng(1)
    robot = load(EXAMPLES / "hexapod.yaml")
    nodes = [f"joints.{end}_{k}.at[{i}]" for end, k, i in product((FOOT, BALL), range(1, 7), range(3))]
    real = robot.with_file_values({n: robot.number(n) + 4e-3 * rng.normal() for n in nodes})
    box = np.array([0.12, 0.12, 0.09, 0.15, 0.15, 0.15])
    q = real.inverse(robot.home() + [0, 0, 0.1, 0, 0, 0] + box * rng.uniform(-1, 1, (count, 6)))
    factors = robot.controller.factors * rng.uniform(0.93, 0.99, 6)
    position, rotation = real.platform(q)
    position = position + 2.5e-4 * rng.normal(size=position.shape)
    rotation = (Rotation.from_rotvec(5e-4 * rng.normal(size=(count, 3))) * Rotation.from_matrix(rotation)).as_matrix()
    learnt = np.arange(count) % HELD_OUT_INTERVAL != HELD_OUT_INTERVAL - 1
    position[rng.choice(np.flatnonzero(learnt), wrong, replace=False)] += 0.02
    motors = q * factors + robot.controller.offsets + 0.2 * rng.normal(size=6)
    poses = Poses(motors, position, rotation)
    found = calibrate(robot, poses, list_geometric_paths(robot, robot.controller.positions(motors)))
    legs = fit_a_leg(robot, poses.part(learnt))
    away = np.sqrt(np.mean(leg_poses(legs, poses.part(~learnt)) ** 2))
    assert found.agreements[0].held_out[1].rms < 1.02 * away
    by = {p.name: p for p in found.parameters}
    for joint, factor in zip(robot.joint_names, factors, strict=True):
        ratio = by[f"joint_map.{joint}.ratio"]
        assert abs(ratio.value - factor) < 4.0 * ratio.deviation < 0.02 * factor


def test_a_ratio_that_changes_converts_positions_both_ways_and_nothing_else() -> None:
    entry = JointMapEntry(ratio=14.0, sign=-1.0, offset=2.0, ratio_change=0.4, ratio_at=0.6)
    own = JointMap.of(["leg"], {"leg": entry})
    q = np.linspace(0.4, 0.8, 50)[:, None]
    turns = np.asarray(own.controller_positions(q))
    assert own.positions(turns) == pytest.approx(q, abs=1e-13)
    step = 1e-6
    slope = (own.controller_positions(q + step) - own.controller_positions(q - step)) / (2 * step)
    assert own.slopes(q) == pytest.approx(slope, rel=1e-7)
    assert own.slopes(np.array([[0.6]])) == pytest.approx(-14.0)
    for convert in (own.rates, own.efforts, own.controller_rates, own.controller_efforts):
        with pytest.raises(ParameterError):
            convert(q)


def recording(tmp_path: Path) -> Path:
    path = tmp_path / "poses.csv"
    path.write_text((EXAMPLES / "grid_180x180.csv").read_text())
    return path


@pytest.mark.parametrize("how", ["as recorded", "named", "headers with units"])
def test_tables_are_read_as_recordings_have_them(tmp_path: Path, how: str) -> None:
    robot = load(EXAMPLES / "hexapod.yaml")
    path = recording(tmp_path)
    raw = np.genfromtxt(path, delimiter=",", names=True)
    columns: list[str] = []
    unit = "mm"
    if how == "named":
        columns = [
            "leg_*.position=leg_length_*,x=meas_pos_x [mm],y=meas_pos_y [mm]",
            "z=meas_pos_z [mm], q*=meas_ori_*",
        ]
        unit = "m"
    elif how == "headers with units":
        head, *rows = path.read_text().splitlines()
        for old, new in (
            ("meas_pos_x", "x [mm]"),
            ("meas_pos_y", "y_mm"),
            ("meas_pos_z", "z (mm)"),
        ):
            head = head.replace(old, new)
        head = head.replace("meas_ori_", "q").replace("cmd_", "wanted_cmd_")
        path.write_text("\n".join([head, *rows]))
        unit = "m"
    poses = read_poses(path, robot, Dialect.from_options(columns=columns, units=unit))
    assert poses.joints[:, 3] == pytest.approx(raw["leg_length_4"])
    assert poses.position[:, 1] == pytest.approx(1e-3 * raw["meas_pos_y"])
    turn = Rotation.from_quat(np.stack([raw[f"meas_ori_{c}"] for c in "xyzw"], -1))
    assert poses.rotation == pytest.approx(turn.as_matrix())


@pytest.mark.parametrize("header", ["{} [µm]", "{} (um)", "{}_µm", "{}_um"])
def test_micrometres_have_two_spellings(tmp_path: Path, header: str) -> None:
    robot = load("five_bar")
    names = [*(f"{name}.position" for name in robot.joint_names), *map(header.format, "xyz")]
    path = tmp_path / "poses.csv"
    path.write_text(",".join(names) + "\n" + "0,0,1000,2000,3000\n" * 3)
    np.testing.assert_allclose(read_poses(path, robot).position, [[1e-3, 2e-3, 3e-3]] * 3)


@pytest.mark.parametrize("columns", [["x"], ["x=nothing"], ["w=meas_pos_x"], ["x=meas_pos_x [deg]"]])
def test_columns_that_there_are_not_are_rejected(tmp_path: Path, columns: list[str]) -> None:
    path = recording(tmp_path)
    with pytest.raises(ParameterError):
        read_poses(path, load(EXAMPLES / "hexapod.yaml"), Dialect.from_options(columns=columns))


@pytest.mark.parametrize("how", ["shared", "travel"])
def test_the_written_file_converts_the_controllers_numbers(twin: Commands, tmp_path: Path, how: str) -> None:
    robot, _ = spools()
    text = (EXAMPLES.parents[2] / "config/linear_delta.yaml").read_text()
    entries = yaml.safe_dump({"joint_map": data_of(robot)["joint_map"]})
    (tmp_path / "mine.yaml").write_text(text + entries)
    changes = np.array([0.3, -0.2, 0.1]) if how == "travel" else np.zeros(3)
    poses = measured(changes, np.full(3, 1.02))
    names = [*(f"{name}.position" for name in robot.controller.names), "x", "y", "z"]
    columns = dict(zip(names, np.hstack([poses.joints, poses.position]).T, strict=True))
    source = write_columns(tmp_path / "poses.csv", columns)
    result = twin.good(
        "calibrate",
        tmp_path / "mine.yaml",
        source,
        "--out",
        tmp_path / "out.yaml",
        "--transmission",
        how,
        "--only",
        "rods.left_1.ends[0]",
    )
    assert max(map(len, result.out.splitlines())) < 400 and "rev" in result.out
    found = load(tmp_path / "out.yaml")
    seen = found.platform(found.controller.positions(poses.joints))[0]
    assert np.sqrt(np.mean((seen - poses.position) ** 2)) < 1.5 * NOISE
    if how == "travel":
        with pytest.raises(ParameterError):
            JointReader(found)
