# SPDX-License-Identifier: Apache-2.0
"""Laws of the 3-PRRU head that hold for any dimensions: closure, assemblies, symmetry."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.mechanisms.prru import Prru
from test.laws.prru_heads import (
    MACHINES,
    THIRDS,
    TIMES,
    Motion,
    machine,
    place,
    poses,
    rotations,
    sliders,
)
from test.support.bodies import bodies
from test.support.robots import partly_long


@pytest.fixture(params=partly_long(MACHINES, "paper", "turned", "uneven"))
def robot(request: pytest.FixtureRequest) -> Prru:
    return machine(request.param)


def reach(robot: Prru) -> float:
    """Tilt (degrees) that the machine keeps at every azimuth; less with uneven limbs."""
    uneven = abs(np.exp(1j * robot.geometry.azimuths).sum()) > 1e-9
    return 40.0 if uneven else 60.0


@pytest.mark.parametrize("tilt", partly_long([5, 30, 55], 5, 55))
def test_closure(robot: Prru, tilt: float) -> None:
    pose = poses(200, min(tilt, reach(robot)))
    q = robot.inverse(pose)
    centre, rotation, ends = place(robot, pose)
    np.testing.assert_allclose(robot.rotation(pose), rotation, atol=1e-13)
    limbs = ends - sliders(robot, q)
    assert np.linalg.norm(limbs, axis=-1) == pytest.approx(robot.geometry.limb_length, abs=1e-13)
    up = limbs[..., 2] if robot.geometry.branch == "below" else -limbs[..., 2]
    assert (up > 0).all()
    found = bodies(robot, q, np.zeros(3), np.zeros(3)).com
    com = centre + rotation @ robot.inertia.platform_com
    np.testing.assert_allclose(found[:, 9], com, atol=1e-13)
    payload = centre + rotation @ robot.payload.com
    np.testing.assert_allclose(found[:, 10], payload, atol=1e-13)


@pytest.mark.parametrize("branch", ["below", "above"])
@pytest.mark.parametrize("seed", partly_long(range(3), 0))
def test_forward_undoes_inverse_for_any_size(branch: str, seed: int) -> None:
    """Over all that inverse accepts, up to the singularity, where the platform is not the wider."""
    rng = np.random.default_rng(seed)
    base = rng.uniform(0.2, 0.6)
    geometry = {
        "base_radius": base,
        "platform_radius": base * rng.uniform(0.4, 1.1),
        "limb_length": base * rng.uniform(0.8, 3.0),
        "azimuths": rng.uniform(-3, 3) + np.array(THIRDS)[rng.permutation(3)],
        "branch": branch,
    }
    robot = machine("paper", geometry=geometry)
    pose = poses(5000, 85, seed)
    q, kept = robot.try_inverse(pose)
    assert kept.sum() > 300
    again, found = robot.try_forward(q[kept])
    # Within a hair of the singularity there is nothing that can be told from its far side.
    assert (~found).sum() <= 2
    again, pose, q = again[found], pose[kept][found], q[kept][found]
    # At the singularity the pose turns without the sliders: the bound is on the sliders.
    np.testing.assert_allclose(robot.inverse(again), q, atol=1e-13)
    np.testing.assert_allclose(again, pose, atol=1e-7)


@pytest.mark.parametrize(
    "geometry",
    [
        {"base_radius": 0.36, "platform_radius": 0.58, "limb_length": 0.46},
        {"base_radius": 0.2, "platform_radius": 0.53, "azimuths": [0.0, 0.6, 5.6]},
    ],
)
def test_forward_follows_the_level_platform(geometry: dict[str, Any]) -> None:
    """Where many assemblies stand side by side, the one that a fine walk from level leads to."""
    robot = machine("paper", geometry=geometry)
    q, good = robot.try_inverse(poses(3000, 85))
    q = q[good]
    q = q[robot.try_forward(q)[1]][:40]
    assert len(q) == 40
    way = np.linspace(0.0, 1.0, 2001)[:, None, None]
    level = q.mean(axis=-1, keepdims=True)
    walked = robot.rotation(robot.forward(level + way * (q - level)))
    # The last step may end next to a singularity; another assembly is farther away.
    assert np.abs(np.diff(walked, axis=0)).max() < 0.2


@pytest.mark.parametrize("name", ["paper", "hanging", "turned"])
def test_a_third_of_a_turn_permutes_the_limbs(name: str) -> None:
    robot = machine(name, symmetric=True)
    q, qd, qdd = Motion(robot, 5)(TIMES)
    force = inverse_dynamics(robot, q, qd, qdd)
    rolled = inverse_dynamics(robot, *(np.roll(x, 1, axis=-1) for x in (q, qd, qdd)))
    np.testing.assert_allclose(rolled, np.roll(force, 1, axis=-1), rtol=1e-11, atol=1e-9)
    step = robot.geometry.azimuths[1] - robot.geometry.azimuths[0]
    turn = rotations(np.zeros(1), np.zeros(1), np.array([step]))[0]
    centre, rotation, _ = place(robot, robot.forward(q))
    other, tilted, _ = place(robot, robot.forward(np.roll(q, 1, axis=-1)))
    np.testing.assert_allclose(other, centre @ turn.T, atol=1e-12)
    np.testing.assert_allclose(tilted, turn @ rotation @ turn.T, atol=1e-12)


def test_limbs_in_any_order() -> None:
    order = [2, 0, 1]
    robot = machine("uneven")
    other = machine("uneven", geometry={"azimuths": robot.geometry.azimuths[order].tolist()})
    q, qd, qdd = Motion(robot, 6)(TIMES)
    force = inverse_dynamics(robot, q, qd, qdd)
    again = inverse_dynamics(other, q[:, order], qd[:, order], qdd[:, order])
    np.testing.assert_allclose(again, force[:, order], rtol=1e-11, atol=1e-9)


def test_hanging_is_the_mirror_of_standing() -> None:
    below = machine("paper", symmetric=True)
    above = machine("hanging", symmetric=True, platform_com=[0.0, 0.0, -0.03])
    above = above.changed(gravity=[0.0, 0.0, 9.81])
    q, qd, qdd = Motion(below, 7)(TIMES)
    force = inverse_dynamics(below, q, qd, qdd)
    mirrored = inverse_dynamics(above, -q, -qd, -qdd)
    np.testing.assert_allclose(mirrored, -force, rtol=1e-11, atol=1e-9)


def test_level_platform_shares_the_weight() -> None:
    robot = machine("paper", symmetric=True)
    q = robot.inverse([0.7, 0.0, 0.0])
    total = 9.81 * (3 * (8.0 + 3.5 + 2.5) + 25.0)
    force = inverse_dynamics(robot, q, np.zeros(3), np.zeros(3))
    assert force == pytest.approx([total / 3] * 3, rel=1e-12)


def test_lifting_all_sliders_lifts_the_platform(robot: Prru) -> None:
    q = robot.inverse(poses(50, 40))
    lifted = robot.forward(q) + np.array([0.3, 0.0, 0.0])
    np.testing.assert_allclose(robot.forward(q + 0.3), lifted, atol=1e-12)
    rate = robot.platform_jacobian(q).sum(axis=-1)
    np.testing.assert_allclose(rate, np.tile([0, 0, 1.0, 0, 0, 0], (50, 1)), atol=1e-12)
