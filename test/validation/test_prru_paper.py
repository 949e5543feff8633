# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Zhang, Wang, Wu: dynamic isotropy of a 3-PRRU manipulator (J. Tsinghua Univ. 57, 2017).

The paper prints no numbers, so its equations themselves are the reference: written here in numpy in
the paper's own variables, differentiated by complex steps, and solved for the driving forces in the
paper's way (equation 41).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from delta_dynamics import (
    energy_matrices,
    energy_transfer,
    inverse_dynamics,
    max_driving_force,
    sphere_directions,
    tilted_pose,
)
from pkm_twin.mechanisms.prru import LIMBS, Prru
from test.support.bodies import bodies
from test.support.robots import load, partly_long

Array = NDArray[Any]

LOWER = (0.11, 0.02)
UPPER = (0.08, 0.03)
INERTIA = ((0.6, 0.05, -0.02), (0.05, 0.5, 0.03), (-0.02, 0.03, 0.8))


def machine(branch: str, link_com: float, platform_com: tuple[float, ...] = (0, 0, 0)) -> Prru:
    inertia = {
        "link_com": link_com,
        "lower_link_inertia": list(LOWER),
        "upper_link_inertia": list(UPPER),
        "platform_com": list(platform_com),
        "platform_inertia": [list(row) for row in INERTIA],
    }
    robot = load("prru").changed(geometry={"branch": branch}, inertia=inertia)
    assert isinstance(robot, Prru)
    return robot


def turn(axis: int, angle: Any) -> Array:
    """Rotation matrix about x, y or z (0, 1, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3, dtype=np.result_type(c))
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


@dataclasses.dataclass
class Position:
    """All that the paper derives from X = (z, alpha, beta); analytic, so X may be complex."""

    q: Array
    centre: Array
    rotation: Array
    swing: Array
    spin: Array
    links: list[tuple[Array, Array]]
    """Rotations of the lower and the upper link, one pair a limb (equations 2 and 4)."""


def paper(robot: Prru, pose: Array) -> Position:
    """Equations 1 to 17, equation 17 with the tangential vector of equation 13."""
    g = robot.geometry
    z, a, b = pose
    sa, ca, sb, cb = np.sin(a), np.cos(a), np.sin(b), np.cos(b)
    gamma = -np.arctan(sa * sb / (ca + cb))
    sg, cg = np.sin(gamma), np.cos(gamma)
    r = g.platform_radius
    x = r * (cb * cg - ca * cg + sa * sb * sg) / 2
    y = -r * (ca * sg + sa * sb * cg)
    centre = np.array([x, y, z])
    rotation = turn(0, a) @ turn(1, b) @ turn(2, gamma)
    q, swing, spin, links = [], [], [], []
    for phi in g.azimuths:
        c, s = math.cos(phi), math.sin(phi)
        u = centre + rotation @ np.array([-r * c, -r * s, 0])
        root = np.sqrt(g.limb_length**2 - (u[0] + g.base_radius * c) ** 2 - (u[1] + g.base_radius * s) ** 2)
        below = g.branch == "below"
        q.append(u[2] - root if below else u[2] + root)
        # Equation 12 has the arc cosine, which loses the sign of an inward swing.
        lean = np.arcsin((u[0] * c + u[1] * s + g.base_radius) / g.limb_length)
        swing.append(lean if below else math.pi - lean)
        frame = turn(2, phi) @ turn(1, swing[-1])
        v = frame.T @ rotation @ np.array([-r * s, r * c, 0])
        spin.append(np.arctan(-v[0] / v[1]))
        links.append((frame, frame @ turn(2, spin[-1])))
    return Position(np.array(q), centre, rotation, np.array(swing), np.array(spin), links)


def columns(function: Any, pose: Array) -> Array:
    """Derivative of an analytic function by the pose, on a new last axis; complex steps."""
    step = 1e-30
    return np.stack([function(pose + 1j * step * unit).imag / step for unit in np.eye(3)], axis=-1)


def spins(frame: Any, pose: Array) -> Array:
    """Angular velocity per pose rate, shape (3, 3), of the rotation frame(pose)."""
    w = np.einsum("ijk,lj->ilk", columns(frame, pose), np.asarray(frame(pose)).real)
    return np.stack([w[2, 1], w[0, 2], w[1, 0]])


@dataclasses.dataclass
class Maps:
    """Velocity maps of a pose, each body's shape (3 or 1, 3 pose rates)."""

    slider: Array
    centre: Array
    platform: Array
    links: list[Array]
    """Angular velocity maps in the order of limb and level (equations 27 and 29)."""

    def flat(self) -> Array:
        return np.concatenate([self.slider, self.centre, self.platform, *self.links])


def maps(robot: Prru, pose: Array) -> Maps:
    """Velocity maps of equations 18 to 30 (angular velocities from equations 19 and 27)."""
    swing = columns(lambda x: paper(robot, x).swing, pose)
    spin = columns(lambda x: paper(robot, x).spin, pose)
    here = paper(robot, pose)
    links = []
    for i, phi in enumerate(robot.geometry.azimuths):
        across = np.array([-math.sin(phi), math.cos(phi), 0.0])
        links.append(np.outer(across, swing[i]))
        links.append(links[-1] + np.outer(here.links[i][0][:, 2], spin[i]))
    return Maps(
        columns(lambda x: paper(robot, x).q, pose),
        columns(lambda x: paper(robot, x).centre, pose),
        spins(lambda x: paper(robot, x).rotation, pose),
        links,
    )


STENCIL = (np.array([-3, -2, -1, 1, 2, 3]), np.array([-1, 9, -45, 45, -9, 1]) / 60)


def along(function: Any, pose: Array, rate: Array, step: float = 1e-3) -> Array:
    """Derivative of a function of the pose in the direction ``rate``, sixth order."""
    values = [weight * function(pose + k * step * rate) for k, weight in zip(*STENCIL, strict=True)]
    total: Array = np.sum(values, axis=0) / step
    return total


def states(count: int, seed: int) -> list[tuple[Array, Array, Array]]:
    rng = np.random.default_rng(seed)
    return [
        (
            np.array([0.7, *rng.uniform(-0.5, 0.5, 2)]),
            rng.uniform(-2, 2, 3),
            rng.uniform(-10, 10, 3),
        )
        for _ in range(count)
    ]


def sliders(robot: Prru, pose: Array, rate: Array, twice: Array) -> tuple[Array, Array, Array]:
    """q, its rate and acceleration (equations 24 and 25)."""

    def jacobian(x: Array) -> Array:
        return columns(lambda c: paper(robot, c).q, x)

    j = jacobian(pose)
    return paper(robot, pose).q, j @ rate, j @ twice + along(jacobian, pose, rate) @ rate


@pytest.mark.parametrize("branch", ["below", "above"])
def test_position(branch: str) -> None:
    """Equations 9, 11 and 12 against the twin's own closed form."""
    robot = machine(branch, 0.3)
    for pose, _, _ in states(50, 0):
        here = paper(robot, pose)
        np.testing.assert_allclose(robot.inverse(pose), here.q, atol=1e-14)
        com = bodies(robot, here.q, np.zeros(3), np.zeros(3)).com
        np.testing.assert_allclose(com[9], here.centre, atol=1e-13)
        for i in range(3):
            lever = com[3 * i + 1] - com[3 * i]
            direction = lever / (0.3 * robot.geometry.limb_length)
            np.testing.assert_allclose(direction, here.links[i][1][:, 2], atol=1e-12)
            assert direction[2] == pytest.approx(math.cos(here.swing[i]), abs=1e-12)


def test_upper_link_follows_the_platform() -> None:
    """Equations 13 to 17: the link's x axis stays at a right angle to the tangential axis."""
    robot = machine("below", 0.5)
    for pose, _, _ in states(20, 1):
        here = paper(robot, pose)
        for i, phi in enumerate(robot.geometry.azimuths):
            tangent = here.rotation @ np.array([-math.sin(phi), math.cos(phi), 0.0])
            assert here.links[i][1][:, 0] @ tangent == pytest.approx(0.0, abs=1e-14)


@pytest.mark.parametrize("branch", ["below", "above"])
def test_velocity_maps(branch: str) -> None:
    """Equations 22, 24, 26 and 30 against the twin's maps on joint rates."""
    robot = machine(branch, 0.5)
    for pose, _, _ in states(20, 2):
        j = maps(robot, pose)
        back = np.linalg.inv(j.slider)
        q = robot.inverse(pose)
        np.testing.assert_allclose(robot.jacobian(q), back, atol=1e-12)
        twist = np.concatenate([j.centre, j.platform]) @ back
        np.testing.assert_allclose(robot.platform_jacobian(q), twist, atol=1e-11)
        found = robot.body_jacobians(q)
        names = [f"{level} link {limb}" for limb in LIMBS for level in ("lower", "upper")]
        for k, body in enumerate(names):
            lift = np.outer([0.0, 0.0, 1.0], j.slider[k // 2])
            expected = np.concatenate([lift, j.links[k]]) @ back
            np.testing.assert_allclose(found[body], expected, atol=1e-11)


def driving_forces(
    robot: Prru, pose: Array, rate: Array, twice: Array, wrench: Array
) -> tuple[Array, tuple[Array, Array, Array]]:
    """Equation 41: F_d = -J^-T (J_M' Q_M + sum J_Hij' Q_Hij) - Q_S; and q with derivatives."""
    gravity = robot.gravity
    m = robot.inertia
    q, qd, qdd = sliders(robot, pose, rate, twice)
    here, j = paper(robot, pose), maps(robot, pose)
    bias = along(lambda x: maps(robot, x).flat(), pose, rate) @ rate
    # Equations 32 and 33.
    inertia = here.rotation @ np.array(INERTIA) @ here.rotation.T
    w = j.platform @ rate
    alpha = j.platform @ twice + bias[6:9]
    force = wrench[:3] + m.platform_mass * (gravity - j.centre @ twice - bias[3:6])
    couple = wrench[3:] - inertia @ alpha - np.cross(w, inertia @ w)
    total = j.centre.T @ force + j.platform.T @ couple
    # Equations 36 and 37, linear velocity of both links that of the slider (equation 26).
    for k in range(6):
        i, level = divmod(k, 2)
        inertia = link_inertia(here, k)
        w = j.links[k] @ rate
        alpha = j.links[k] @ twice + bias[9 + 3 * k : 12 + 3 * k]
        weight = (m.lower_link_mass, m.upper_link_mass)[level]
        total += j.slider[i] * weight * (gravity[2] - qdd[i])
        total += j.links[k].T @ (-inertia @ alpha - np.cross(w, inertia @ w))
    # Equation 34, its g being the amount of gravity.
    q_s = m.slider_mass * (gravity[2] - qdd)
    return -np.linalg.solve(j.slider.T, total) - q_s, (q, qd, qdd)


def link_inertia(here: Position, k: int) -> Array:
    """Inertia of a link in base axes (equation 37)."""
    i, level = divmod(k, 2)
    moments, link = (LOWER, UPPER)[level], here.links[i][level]
    return np.asarray(link @ np.diag([moments[0], moments[0], moments[1]]) @ link.T)


@pytest.mark.parametrize("branch", ["below", "above"])
@pytest.mark.parametrize("count", partly_long([5, 25], 5))
def test_driving_forces_with_the_links_at_the_sliders(branch: str, count: int) -> None:
    """Equations 32 to 41, every term as printed."""
    robot = machine(branch, link_com=0.0)
    rng = np.random.default_rng(3)
    for pose, rate, twice in states(count, 3):
        wrench = rng.normal(size=6) * 200
        force, motion = driving_forces(robot, pose, rate, twice, wrench)
        twin = inverse_dynamics(robot, *motion, wrench)
        np.testing.assert_allclose(twin, force, rtol=1e-10, atol=1e-9 * np.abs(force).max())


def energies(robot: Prru, pose: Array) -> tuple[Array, Array]:
    """Forms of E_M and E_all on the pose rates (equations 42 and 43), shape (3, 3) each."""
    m, here, j = robot.inertia, paper(robot, pose), maps(robot, pose)
    inertia = here.rotation @ np.array(INERTIA) @ here.rotation.T
    own = m.platform_mass * j.centre.T @ j.centre + j.platform.T @ inertia @ j.platform
    every = own + m.slider_mass * j.slider.T @ j.slider
    for k in range(6):
        weight = (m.lower_link_mass, m.upper_link_mass)[k % 2]
        every += weight * np.outer(j.slider[k // 2], j.slider[k // 2])
        every += j.links[k].T @ link_inertia(here, k) @ j.links[k]
    return own, every


def test_indices_of_isotropy() -> None:
    """eta_KE (equations 42 to 46), and F_max at 100 J without acceleration (47 and 48)."""
    robot = machine("below", link_com=0.0)
    for pose, x, _ in states(5, 7):
        own, every = energies(robot, pose)
        for found, expected in zip(energy_matrices(robot, pose), (own, every), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-11 * every.max())
        eta = (x @ own @ x) / (x @ every @ x)
        assert float(energy_transfer(robot, pose, x)) == pytest.approx(eta, rel=1e-11)
        rate = np.sqrt(2 * 100.0 / (x @ own @ x)) * x
        force, _ = driving_forces(robot, pose, rate, np.zeros(3), np.zeros(6))
        assert float(max_driving_force(robot, pose, x)) == pytest.approx(np.abs(force).max())


def carried(robot: Prru, one: Array, other: Array, turn_by: float) -> Array:
    """Pose rates at one pose to those of the same motion turned about the vertical at another."""
    twists = []
    for pose in (one, other):
        q = robot.inverse(pose)
        twists.append(robot.platform_jacobian(q) @ np.linalg.inv(robot.jacobian(q)))
    turned = np.kron(np.eye(2), turn(2, turn_by)) @ twists[0]
    found = np.linalg.pinv(twists[1]) @ turned
    np.testing.assert_allclose(twists[1] @ found, turned, atol=1e-12)
    return np.asarray(found)


@pytest.mark.parametrize("azimuth", [20, 60])
@pytest.mark.parametrize("tilt", [15, 45])
def test_spheres_repeat_every_120_degrees(azimuth: float, tilt: float) -> None:
    """Section 2.4: as at azimuth 60, 180 and 300 degrees; each direction turned with the pose."""
    robot = load("prru")
    assert isinstance(robot, Prru)
    ways = sphere_directions(500)
    poses = tilted_pose(0.85, np.radians(azimuth + np.array([0, 120, 240])), np.radians(tilt))
    eta = energy_transfer(robot, poses[0], ways)
    assert np.ptp(eta) > 0.05
    for k in (1, 2):
        turned = ways @ carried(robot, poses[0], poses[k], k * 2 * math.pi / 3).T
        np.testing.assert_allclose(energy_transfer(robot, poses[k], turned), eta, rtol=1e-11)


def test_spheres_become_uneven_with_the_tilt() -> None:
    """Section 2.4: both indices differ more over the directions, the more the platform tilts.

    With the shipped masses, as the paper prints none, at tilts of 30 and 45 degrees compared with
    the level pose, at every azimuth.
    """
    robot, ways = load("prru"), sphere_directions(500)
    azimuths = np.radians(np.arange(0, 360, 30))
    for index in (energy_transfer, max_driving_force):
        level, *tilted = (
            np.ptp(index(robot, tilted_pose(0.85, azimuths, tilt)[:, None], ways), axis=-1)
            for tilt in np.radians([0, 30, 45])
        )
        assert (tilted[1] > tilted[0]).all()
        assert (tilted[1] > 1.3 * level).all()


def test_forces_do_not_depend_on_the_height() -> None:
    """Section 2.3: q shifts with z, and nothing else does."""
    robot = machine("below", 0.5)
    for pose, rate, twice in states(10, 5):
        q, qd, qdd = sliders(robot, pose, rate, twice)
        force = inverse_dynamics(robot, q, qd, qdd)
        np.testing.assert_allclose(inverse_dynamics(robot, q + 0.4, qd, qdd), force, rtol=1e-10)


def test_equation_4_is_a_rotation_once_its_entry_is_corrected() -> None:
    f, t, p = 0.3, -0.4, 0.7
    c, s = np.cos, np.sin
    right = turn(2, f) @ turn(1, t) @ turn(2, p)
    assert right[0, 1] == pytest.approx(-c(f) * c(t) * s(p) - s(f) * c(p))
    printed = right.copy()
    printed[0, 1] = -c(f) * c(t) * c(p) - s(f) * c(p)
    assert np.abs(right @ right.T - np.eye(3)).max() < 1e-15
    assert np.abs(printed @ printed.T - np.eye(3)).max() > 0.1


def test_equation_11_holds_as_it_is_printed() -> None:
    """Every joint U is in its limb's vertical plane (equation 10); with y halved it is not."""
    robot = machine("below", 0.5)
    g = robot.geometry
    for pose in ((-0.5, 0.3, -0.4), (-0.5, 0.5, 0.45), (-0.4, -0.2, 0.6)):
        here = paper(robot, np.array(pose))
        for half, most in ((1.0, 1e-15), (0.5, np.inf)):
            centre = here.centre * [1.0, half, 1.0]
            off = [
                np.array([-np.sin(phi), np.cos(phi), 0.0])
                @ (centre - here.rotation @ (g.platform_radius * turn(2, phi)[:, 0]))
                for phi in g.azimuths
            ]
            assert np.abs(off).max() < most
            assert half == 1.0 or np.abs(off).max() > 1e-3


def test_the_vector_of_equation_17_is_the_tangential_one() -> None:
    """At the level pose a limb does not turn about itself."""
    robot = machine("below", 0.5)
    level = paper(robot, np.array([-0.5, 0.0, 0.0]))
    np.testing.assert_allclose(level.spin, 0.0, atol=1e-15)
    for phi, swing in zip(robot.geometry.azimuths, level.swing, strict=True):
        radial = (turn(2, phi) @ turn(1, swing)).T @ -turn(2, phi)[:, 0]
        assert abs(np.arctan2(-radial[0], radial[1])) == pytest.approx(np.pi / 2)
