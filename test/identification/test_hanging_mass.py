# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A drive's torque constant and friction law by weights: simulated drives, and a measured one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from pkm_twin.apps.cli import app
from pkm_twin.errors import ParameterError
from pkm_twin.identification.drives import drive_friction

MEASURED = Path(__file__).parents[2] / "examples/machines/hexapod/leg_currents.csv"


def test_the_measured_drive_has_friction_that_grows_with_the_load(tmp_path, monkeypatch) -> None:
    """The owner's torque constant; 1.07 A + 0.10 |load current| is what the runs fit."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fitted.yaml").touch()  # of a fit; this one writes none
    result = CliRunner().invoke(app, ["fit", "--drive", str(MEASURED), "--lever", "0.011391", "--json"])
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    assert data["torque_constant_nm_per_a"] == pytest.approx(0.0577, abs=1e-4)
    simple, richer = data["laws"].values()
    assert data["chosen"] in data["laws"] and data["laws"][data["chosen"]] == richer
    assert data["chance"] < 0.05 and not data["viscous_distinguished"]
    assert richer["load-dependent"]["value"] == pytest.approx(0.10, abs=0.005)
    assert richer["Coulomb"]["value"] == pytest.approx(1.07, abs=0.01)
    assert richer["residual_a"] < 0.02 and simple["residual_a"] == pytest.approx(0.13, abs=0.01)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("loaded", [0.0, 0.15])
def test_the_law_that_made_the_currents_is_chosen(sign: float, loaded: float) -> None:
    """Of 40 drives a law with one term too many is chosen in 5 % of cases, one too few never."""
    rng, right = np.random.default_rng([round(sign) + 1, round(100 * loaded)]), 0
    torque, rate = np.repeat([0.05, 0.1, 0.2, 0.3], 3), np.tile([0.2, 0.6, 1.2], 4)
    for _ in range(40):
        constant, coulomb, viscous = rng.uniform([0.03, 0.3, 0.0], [0.2, 1.5, 0.5])
        load = torque / constant
        friction = coulomb + viscous * rate + loaded * load
        up, down = sign * (load + friction), sign * (load - friction)
        noise = 0.02 * rng.normal(size=(2, 12))
        found = drive_friction(torque, up + noise[0], down + noise[1], rate)
        right += ("load-dependent" in found.chosen.terms) == (loaded > 0.0)
        away = abs(found.torque_constant - constant) / found.torque_constant_deviation
        assert away < 6.0 and found.viscous_told
        values = dict(zip(found.chosen.terms, found.chosen.values, strict=True))
        assert values.get("viscous", 0.0) == pytest.approx(viscous, abs=0.1)
    assert right >= (40 if loaded else 34)


@pytest.mark.parametrize("loaded", [0.0, 0.1])
def test_two_weights_and_some_drives_determine_the_law(loaded: float) -> None:
    """Only one drive lifts both weights; drives differ a little from each other."""
    rng, right = np.random.default_rng(round(100 * loaded)), 0
    drive = np.repeat([2.0, 0.0, 1.0, 2.0, 3.0], 3)
    torque, rate = np.repeat([0.2, 1.0, 1.0, 1.0, 1.0], 3), np.tile([0.5, 1.0, 2.5], 5)
    for _ in range(40):
        constant, coulomb = rng.uniform([0.03, 0.3], [0.2, 1.5])
        load = torque / constant
        friction = coulomb + loaded * load + 0.02 * rng.normal(size=4)[drive.astype(int)]
        noise = 0.02 * rng.normal(size=(2, 15))
        up, down = load + friction + noise[0], load - friction + noise[1]
        found = drive_friction(torque, up, down, rate, drive)
        right += ("load-dependent" in found.chosen.terms) == (loaded > 0.0)
        assert abs(found.torque_constant - constant) < 6.0 * found.torque_constant_deviation
        assert found.viscous_told and 0.0 < found.chosen.other_drives < 0.2
        assert found.chosen.residual <= found.chosen.held_out
        one, *_ = drive_friction(torque[:6], up[:6], down[:6]).laws
        assert one.terms == ("Coulomb",) and one.held_out > 0.0
    # Runs of a drive share its difference: an F test takes it for evidence a little too often.
    assert right >= (40 if loaded else 30)


@pytest.mark.parametrize("case", ["few", "one weight", "unrelated", "nan"])
def test_runs_of_no_use_are_rejected(case: str) -> None:
    torque, up = np.array([0.1, 0.2, 0.3, 0.4]), np.array([1.0, 1.0, 1.0, 1.0])
    count = 2 if case == "few" else 4
    if case == "one weight":
        torque[:] = 0.1
    if case == "nan":
        up[1] = np.nan
    rng = np.random.default_rng(3)
    with pytest.raises(ParameterError):
        drive_friction(torque[:count], up[:count] + 1e-3 * rng.normal(size=count), -up[:count])
