# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Limbs in closed form: of random hexapods, all closures hold and nothing else is accepted."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from pkm_twin.kinematics.iterations import newton
from pkm_twin.kinematics.limbs import LimbPose
from pkm_twin.kinematics.motion import Motion, matrices, numbers
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.machine.random_machines import variant


def hexapod(seed):
    """Of other dimensions than the shipped one's; every second one has legs off the feet."""
    rng = np.random.default_rng(seed)
    data = variant("stewart", rng)
    for name, joint in data["joints"].items():
        if name.startswith("leg") and seed % 2:
            joint["at"] = (np.array(joint["at"]) + 0.03 * rng.normal(size=3)).tolist()
    return robot_of_data(data, "hexapod")


def followed(engine, q, steps=128):
    """The unknowns at q by small steps of all closures; None where they end."""
    x, home = np.array(engine.tree.home, float), engine.graph.home
    for k in range(1, steps + 1):
        there = home + k / steps * (q - home)
        x = newton(x, partial(engine._look, there), partial(engine._moved, there))
        if x is None:
            return None
    return x


@pytest.mark.parametrize("seed", [1, 2])
def test_the_platform_and_the_turns_are_those_of_all_closures(seed):
    robot = hexapod(seed)
    engine = robot.engine
    assert len(engine.limbs) == 5
    rng = np.random.default_rng(seed)
    q = engine.graph.home + rng.uniform(-0.15, 0.15, (400, 6)) * engine.tree.size
    pose, known = robot.try_forward(q)
    assert 20 < known.sum() < 400
    for k in np.flatnonzero(known)[:20]:
        x = followed(engine, q[k])
        position, _ = Motion(engine.tree, x, q[k]).platform()
        np.testing.assert_allclose(pose[k, :3], numbers(position), atol=1e-10)
        motion = Motion(engine.tree, x, q[k])
        for limb in engine.limbs:
            for place, value in LimbPose(motion, limb, q[k]).unknowns().items():
                assert value == pytest.approx(x[place], abs=1e-10)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_determinant_is_that_of_all_closures(seed):
    engine = hexapod(seed).engine
    ratios = []
    for x, q in engine.samples:
        motion, rows = engine.at(x, q)
        limbs = [LimbPose(motion, limb, q) for limb in engine.limbs]
        solved = numbers(matrices(engine.tree, engine.solved_rows(rows, limbs))[0])
        whole = numbers(matrices(engine.tree, rows)[0])[engine.independent]
        turns = np.prod([float(limb.steepness) for limb in limbs])
        part = np.linalg.det(solved[:, engine.solved[1]]) * turns
        ratios.append(np.linalg.det(whole) / part)
    assert len(ratios) > 3
    np.testing.assert_allclose(ratios, ratios[0], rtol=1e-9)
    assert abs(ratios[0]) == pytest.approx(1.0, rel=1e-9)
