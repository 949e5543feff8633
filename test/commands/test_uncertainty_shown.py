# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Commands show how sure the model is, where the robot's file says it."""

import numpy as np
import pytest
import yaml

from delta_dynamics import inverse_dynamics, torque_deviation
from pkm_twin.identification.check import DEVIATIONS, compare_part
from pkm_twin.recordings import read
from test.commands.conftest import DELTA, rewrite
from test.support.robots import load, parameters_of
from test.support.tables import joined, of_joints, read_columns, write_columns

UNCERTAINTY = {
    "inertia.platform_mass": {"deviation": 0.004},
    "inertia.forearm_mass": {"relative": 0.05},
}


@pytest.fixture
def unsure(tmp_path):
    path = tmp_path / "unsure.yaml"
    path.write_text(yaml.safe_dump({**parameters_of("delta_cu"), "uncertainty": UNCERTAINTY}))
    return path


@pytest.fixture
def part(tmp_path):
    return rewrite(DELTA, tmp_path / "part.mcap", seconds=0.2)


def test_check_counts_the_residuals_inside_the_model_s_band(twin, unsure, part):
    data = twin.told("check", part, "--robot", unsure)
    recording = read(part, str(unsure))
    compared = compare_part(recording, np.zeros(len(recording.time), bool))
    (track,) = compared.tracks
    rows = np.isin(track.time, compared.time)
    spread = torque_deviation(recording.robot, track.q, track.qd, track.qdd)[rows]
    share = {k: np.mean(np.abs(compared.residual) <= k * spread, 0) for k in DEVIATIONS}
    assert 0.0 < share[1].min() < share[3].max() <= 1.0
    for i, joint in enumerate(recording.robot.joint_names):
        band = data["uncertainty"][joint]
        assert band["effort_unit"] == "N m"
        assert band["effort_deviation_rms"] == pytest.approx(np.sqrt(np.mean(spread[:, i] ** 2)))
        told = [band["share_within_deviations"][str(k)] for k in DEVIATIONS]
        assert told == pytest.approx([share[k][i] for k in DEVIATIONS])
        item = {item["what"]: item for item in data["items"]}[f"torque residual of {joint}"]
        size = f"(RMS {np.sqrt(np.mean(spread[:, i] ** 2)):.3g} N m)"
        assert f"% inside 1, 2, 3 standard deviations of the model {size}" in item["value"]


def test_check_says_that_a_file_tells_of_no_uncertainty(twin, part):
    data = twin.told("check", part)
    assert data["uncertainty"] is None
    assert not any("deviation" in item["value"] for item in data["items"])
    (line,) = [x for x in twin("check", part).out.splitlines() if "uncertainty" in x]
    assert line.startswith("uncertainty: none ")


def test_torques_have_a_column_of_deviations(twin, unsure, tmp_path):
    robot = load(str(unsure))
    motion = np.array([[0.1, 0.2, 0.15], [0.12, 0.2, 0.1], [0.16, 0.2, 0.06]])
    columns = {"time": np.array([0.0, 0.1, 0.2])} | of_joints(robot, "position", motion)
    source, out = write_columns(tmp_path / "motion.csv", columns), tmp_path / "table.csv"
    twin.good("torques", unsure, source, "--out", out, "--no-picture")
    table = read_columns(out)
    q, qd, qdd, told = (
        joined(table, robot, what) for what in ("position", "velocity", "acceleration", "effort_deviation")
    )
    np.testing.assert_allclose(told, torque_deviation(robot, q, qd, qdd), rtol=1e-9)
    assert (np.abs(told) < np.abs(inverse_dynamics(robot, q, qd, qdd))).all()


def test_info_and_compliance_tell_it(twin, unsure):
    shown = " ".join(twin("info", unsure).out.split())
    assert "uncertainty: inertia.platform_mass: deviation: 0.004" in shown
    assert "uncertainty: inertia.forearm_mass: relative: 0.05" in shown
    data = twin.told("compliance", "upr_rpu", "--wrench", "0,0,100,0,0,0", -0.6, 0.1, 0)
    matrix, spread = (np.array(data[k]) for k in ("compliance", "compliance_deviation"))
    part = np.diag(spread) / np.diag(matrix)
    # Three independent causes of 5 % each, and each a part of the compliance.
    assert (part > 0.05 / np.sqrt(3) * 0.999).all()
    assert (part < 0.05).all()
