# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Maps of a transmission have its ratio, efforts and inertias, over the range of its joints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pkm_twin import load, transmission
from pkm_twin.maps.kinds import KINDS
from test.support.robots import loaded, partly_long

HUMANOID = Path(__file__).resolve().parents[2] / "examples/humanoid.xml"


def test_ratios_efforts_and_inertias_are_those_of_the_worst_direction(rng):
    robot = loaded("five_bar")
    q = robot.graph.home + rng.uniform(-0.2, 0.2, (5, 2))
    t, x = transmission(robot), robot.forward(q)
    kinds = {name: KINDS[name]() for name in ("ratio", "joint-effort", "joint-inertia")}
    (case,) = kinds["ratio"].cases(robot)
    ratio = kinds["ratio"].found(robot, q, case)
    ways = rng.normal(size=(200, 2))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    table = robot.inverse_jacobian(q)
    moved = np.linalg.norm(table @ ways.T, axis=1)
    assert (moved >= ratio.value[:, None] - 1e-12).all()
    own = np.einsum("kij,kj->ki", table, ratio.direction)
    np.testing.assert_allclose(np.linalg.norm(own, axis=-1), ratio.value)
    assert case.unit == "rad/m"
    for k, name in enumerate(robot.pose_names):
        cases = (kinds[kind].cases(robot)[k] for kind in ("joint-effort", "joint-inertia"))
        assert [case.name for case in kinds["joint-effort"].cases(robot)][k] == name
        effort, inertia = next(cases), next(cases)
        found = kinds["joint-effort"].found(robot, q, effort).value
        np.testing.assert_allclose(found, t.effort_limits(x)[:, k, 1])
        found = kinds["joint-inertia"].found(robot, q, inertia).value
        np.testing.assert_allclose(found, t.inertia(x)[:, k, k])
        assert (effort.unit, inertia.unit) == ("N", "kg")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", partly_long(["ratio", "joint-effort", "joint-inertia"], "ratio"))
def test_a_map_s_poses_and_arrays_are_written_for_training(kind, twin, tmp_path):
    out, part = tmp_path / "ankle.npz", {"base": "shank", "platform": "foot"}
    options = [f"--{key}={value}" for key, value in part.items()]
    small = ["--points", "200", "--jobs", "1", "--no-picture", "--out", out]
    twin.good("map", HUMANOID, kind, *options, *small)
    t = transmission(load(HUMANOID, **part))
    with np.load(out) as found:
        x = found["position"]
        assert found["names"].tolist() == ["roll", "pitch"] and len(x) > 50
        # The ranges of the file's joints hold, though no motor is on them.
        assert (np.abs(x[:, 0]) <= 0.5 + 1e-9).all()
        assert x[:, 1].min() >= -0.9 - 1e-9 and x[:, 1].max() <= 0.6 + 1e-9
        np.testing.assert_array_equal(found["actuator"], t.joint_to_actuator(x).position)
        np.testing.assert_array_equal(found["ratio"], t.ratio(x))
        if kind == "joint-effort":
            np.testing.assert_allclose(found["value"], found["effort_limits"][..., 1])
        if kind == "joint-inertia":
            np.testing.assert_array_equal(found["inertia"], t.inertia(x))
    assert "exists" in twin.refused("map", HUMANOID, kind, *options, *small)
