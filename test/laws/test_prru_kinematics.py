# SPDX-License-Identifier: Apache-2.0
"""Laws of the 3-PRRU head that hold for any dimensions: closure, derivatives, power, symmetry."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from delta_dynamics.virtual_work import energy
from pkm_twin.mechanisms.prru import Prru
from test.laws.prru_heads import (
    MACHINES,
    THIRDS,
    TIMES,
    Array,
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


STEP = 2e-3


def in_time(values: Array, step: float = STEP) -> Array:
    """Derivative of seven samples on the first axis, sixth order."""
    weights = np.array([-1, 9, -45, 0, 45, -9, 1]) / (60 * step)
    result: Array = np.tensordot(weights, values, axes=1)
    return result


def around(step: float = STEP) -> Array:
    return TIMES + step * np.arange(-3, 4)[:, None]


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


def test_parasitic_motions_at_thirds() -> None:
    robot = machine("paper", platform_com=[0.0, 0.0, 0.0])
    pose = poses(200, 60)
    a, b = pose[:, 1], pose[:, 2]
    gamma = np.arctan2(-np.sin(a) * np.sin(b), np.cos(a) + np.cos(b))
    _, rotation, _ = place(robot, pose)
    np.testing.assert_allclose(rotation, rotations(a, b, gamma), atol=1e-13)
    x, y, _ = bodies(robot, robot.inverse(pose), np.zeros(3), np.zeros(3)).com[:, 9].T
    r = robot.geometry.platform_radius
    m, n, o = rotation[:, 0, 0], rotation[:, 1, 1], rotation[:, 1, 0]
    np.testing.assert_allclose(x, r * (m - n) / 2, atol=1e-13)
    np.testing.assert_allclose(y, -r * o, atol=1e-13)


def test_jacobians(robot: Prru) -> None:
    pose = poses(80, 40)
    q = robot.inverse(pose)
    rates, twist = robot.jacobian(q), robot.platform_jacobian(q)
    steps = 1e-3 * np.arange(-3, 4)[:, None]
    for j in range(3):
        near = robot.forward(q + (steps * np.eye(3)[j])[:, None])
        np.testing.assert_allclose(rates[..., j], in_time(near, 1e-3), rtol=1e-8, atol=1e-8)
        placed = [place(robot, p) for p in near]
        centres = np.array([c for c, _, _ in placed])
        frames = np.array([r for _, r, _ in placed])
        np.testing.assert_allclose(twist[:, :3, j], in_time(centres, 1e-3), atol=1e-8)
        np.testing.assert_allclose(twist[:, 3:, j], spins(frames, 1e-3), atol=1e-7)


def spins(frames: Array, step: float = STEP) -> Array:
    """Angular velocity in the middle of seven rotation matrices, world axes."""
    w = in_time(frames, step) @ frames[3].swapaxes(-1, -2)
    return np.stack([w[..., 2, 1], w[..., 0, 2], w[..., 1, 0]], axis=-1)


def frames_of_bodies(robot: Prru, q: Array) -> Array:
    """Rotation of all bodies, shape (n, 11, 3, 3), from the limbs' lines and hinges alone."""
    flat = q.reshape(-1, 3)
    _, rotation, ends = place(robot, robot.forward(flat))
    e = np.stack([np.cos(robot.geometry.azimuths), np.sin(robot.geometry.azimuths)], axis=-1)
    result = np.empty((len(flat), 11, 3, 3))
    limbs = ends - sliders(robot, flat)
    for i in range(3):
        d = limbs[:, i] / np.linalg.norm(limbs[:, i], axis=-1, keepdims=True)
        t = np.broadcast_to([-e[i, 1], e[i, 0], 0.0], d.shape)
        hinge = rotation @ t[0]
        fixed = np.cross(hinge, d)
        fixed /= np.linalg.norm(fixed, axis=-1, keepdims=True)
        result[:, 3 * i] = np.eye(3)
        result[:, 3 * i + 1] = np.stack([np.cross(t, d), t, d], axis=-1)
        result[:, 3 * i + 2] = np.stack([fixed, np.cross(d, fixed), d], axis=-1)
    result[:, 9:] = rotation[:, None]
    return result.reshape(*q.shape[:-1], 11, 3, 3)


def inertias(robot: Prru) -> Array:
    """Inertia of all bodies about their centres in their own axes, shape (11, 3, 3)."""
    m = robot.inertia
    assert m.lower_link_inertia is not None and m.upper_link_inertia is not None
    assert m.platform_inertia is not None
    lower = np.diag(m.lower_link_inertia[[0, 0, 1]])
    upper = np.diag(m.upper_link_inertia[[0, 0, 1]])
    return np.array(
        [np.zeros((3, 3)), lower, upper] * 3 + [m.platform_inertia, robot.payload.inertia]
    )


@pytest.mark.parametrize("seed", range(3))
def test_bodies_along_a_motion(robot: Prru, seed: int) -> None:
    motion = Motion(robot, seed)
    q, qd, qdd = motion(TIMES)
    now = bodies(robot, q, qd, qdd)
    velocity = np.einsum("nbij,nj->nbi", now.linear, qd)
    spin = np.einsum("nbij,nj->nbi", now.angular, qd)
    near_q, near_qd, near_qdd = motion(around())
    near = bodies(robot, near_q, near_qd, near_qdd)
    np.testing.assert_allclose(velocity, in_time(near.com), atol=1e-9)
    near_velocity = np.einsum("tnbij,tnj->tnbi", near.linear, near_qd)
    np.testing.assert_allclose(now.acceleration, in_time(near_velocity), atol=1e-7)
    frames = frames_of_bodies(robot, near_q)
    np.testing.assert_allclose(spin, spins(frames), atol=1e-8)
    near_spin = np.einsum("tnbij,tnj->tnbi", near.angular, near_qd)
    momentum = np.einsum("tnbij,bjk,tnblk,tnbl->tnbi", frames, inertias(robot), frames, near_spin)
    np.testing.assert_allclose(now.moment, in_time(momentum), atol=1e-7)
    assert np.abs(now.moment[:, [2, 5, 8]]).max() > 1e-2


@pytest.mark.parametrize("seed", partly_long(range(3), 0))
def test_power_balance(robot: Prru, seed: int) -> None:
    """The actuators' power is the rate of the energy that the bodies hold."""
    motion = Motion(robot, seed)
    q, qd, qdd = motion(TIMES)
    power = np.einsum("ni,ni->n", inverse_dynamics(robot, q, qd, qdd), qd)
    near_q, near_qd, near_qdd = motion(around())
    near = bodies(robot, near_q, near_qd, near_qdd)
    velocity = np.einsum("tnbij,tnj->tnbi", near.linear, near_qd)
    spin = np.einsum("tnbij,tnj->tnbi", near.angular, near_qd)
    frames = frames_of_bodies(robot, near_q)
    local = np.einsum("tnbji,tnbj->tnbi", frames, spin)
    kinetic = 0.5 * np.einsum("b,tnbi,tnbi->tn", near.mass, velocity, velocity)
    kinetic += 0.5 * np.einsum("tnbi,bij,tnbj->tn", local, inertias(robot), local)
    potential = -np.einsum("b,tnbi,i->tn", near.mass, near.com, robot.gravity)
    np.testing.assert_allclose(power, in_time(kinetic + potential), atol=1e-6, rtol=1e-8)
    twin = energy(robot, near_q, near_qd)
    np.testing.assert_allclose(twin.kinetic, kinetic, rtol=1e-11)
    np.testing.assert_allclose(twin.potential, potential, rtol=1e-11)


def test_wrench_works_through_the_platform(robot: Prru) -> None:
    q, qd, qdd = Motion(robot, 4)(TIMES)
    wrench = np.random.default_rng(0).normal(size=(len(q), 6)) * 100
    less = inverse_dynamics(robot, q, qd, qdd) - inverse_dynamics(robot, q, qd, qdd, wrench)
    jacobian = robot.platform_jacobian(q)
    np.testing.assert_allclose(less, np.einsum("nij,ni->nj", jacobian, wrench), atol=1e-9)


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
