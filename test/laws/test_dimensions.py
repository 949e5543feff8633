# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Deltas, 3-PRRUs and 2UPR-RPUs of any dimensions: lengths of their limbs, assemblies, misses."""

import itertools

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import SingularityError, UnreachableError
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.support.robots import load, parameters_of, partly_long, random_motion

THIRDS = np.pi * np.array([1.0, 5.0 / 3.0, 1.0 / 3.0])
CLOSURES = {"rods": ["rod"] * 3} | {f"rcu {k}": ["rod"] * k + ["rcu"] + ["rod"] * (2 - k) for k in range(3)}
KINDS = [*CLOSURES, "below", "above", "upr_rpu"]


def machine(kind, **geometry):
    """A shipped robot with closures or a branch of its own and other dimensions."""
    name = "delta" if kind in CLOSURES else "prru" if kind in ("below", "above") else kind
    data = parameters_of(name)
    data["geometry"] |= {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in geometry.items()}
    if kind in CLOSURES:
        data["geometry"]["closures"] = CLOSURES[kind]
    elif kind != name:
        data["geometry"]["branch"] = kind
    return robot_of_data(data, kind)


def drawn(kind, rng):
    """A machine of any dimensions and joint states all over its reach, shape (count, 3)."""
    if kind == "upr_rpu":
        base, platform = rng.uniform(0.1, 0.6, 2)
        robot = machine(kind, base_radius=base, platform_radius=platform)
        return robot, (base + platform) * rng.uniform(0.4, 2.5, (4000, 3))
    if kind in CLOSURES:
        arm = rng.uniform(0.1, 0.5)
        robot = machine(
            kind,
            base_radius=rng.uniform(0.05, 0.3),
            platform_radius=rng.uniform(0.03, 0.2),
            arm_length=arm,
            forearm_length=arm * rng.uniform(1.6, 3.0),
            azimuths=np.array([0.0, 2.1, 4.2]) + rng.uniform(-0.3, 0.3, 3),
        )
        return robot, rng.uniform(-0.5, 0.9, (400, 3))
    base = rng.uniform(0.2, 0.6)
    robot = machine(
        kind,
        base_radius=base,
        platform_radius=base * rng.uniform(0.4, 1.1),
        limb_length=base * rng.uniform(0.8, 3.0),
        azimuths=rng.uniform(-3, 3) + THIRDS[rng.permutation(3)] + rng.uniform(-0.2, 0.2, 3),
    )
    return robot, rng.uniform(-1.0, 1.0) + base * rng.uniform(-0.7, 0.7, (2000, 3))


def upr_rpu_points(robot, pose):
    """Rotation of the platform, and the limbs' ends on it and on the base, (3, 3) each."""
    z, beta, gamma = pose
    rx = np.array([[1, 0, 0], [0, np.cos(beta), -np.sin(beta)], [0, np.sin(beta), np.cos(beta)]])
    ry = np.array([[np.cos(gamma), 0, np.sin(gamma)], [0, 1, 0], [-np.sin(gamma), 0, np.cos(gamma)]])
    pattern = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    g, origin = robot.geometry, np.array([0.0, -z * np.tan(beta), z])
    rotation = rx @ ry
    return rotation, origin + g.platform_radius * pattern @ rotation.T, g.base_radius * pattern


def errors(robot, kind, pose, q):
    """What is wrong with a pose of joints, by plain vector algebra: lengths, m, or joints."""
    g = robot.geometry
    if kind == "upr_rpu":
        rotation, upper, lower = upr_rpu_points(robot, pose)
        limb = upper - lower
        # Limbs 1 and 2 stay normal to the platform's y, limb 3 to X.
        held = [*limb[:2] @ rotation[:, 1], limb[2, 0]]
        assert pose[0] < 0.0
        return [*np.linalg.norm(limb, axis=1) - q, *held]
    if kind in ("below", "above"):
        (z, alpha, beta), (centre, turned) = pose, robot.platform(q)
        upright = [np.sin(beta), -np.sin(alpha) * np.cos(beta), np.cos(alpha) * np.cos(beta)]
        radial = np.stack([np.cos(g.azimuths), np.sin(g.azimuths), 0.0 * q], -1)
        ends = centre - g.platform_radius * radial @ turned.T
        limb = ends + g.base_radius * radial - q[:, None] * [0.0, 0.0, 1.0]
        assert ((limb[:, 2] > 0.0) == (kind == "below")).all()
        # Each limb stays in its upright plane.
        across = ends[:, 0] * radial[:, 1] - ends[:, 1] * radial[:, 0]
        lengths = np.linalg.norm(limb, axis=1) - g.limb_length
        return [*lengths, *across, *(turned[:, 2] - upright), centre[2] - z]
    found, forearms = [], []
    for azimuth, closure, angle in zip(g.azimuths, g.closures, q, strict=True):
        radial = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        down = np.array([0.0, 0.0, -1.0])
        arm = g.arm_length * (np.cos(angle) * radial + np.sin(angle) * down)
        forearm = pose + (g.platform_radius - g.base_radius) * radial - arm
        if closure == "rcu":
            tangent = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
            forearm = forearm - (forearm @ tangent) * tangent
        forearms.append(forearm)
        found.append(np.linalg.norm(forearm) - g.forearm_length)
    # Of both assemblies the one below: zero in between, where the forearms lie in one plane.
    assert np.linalg.det(forearms) < 0.0
    return found


@pytest.mark.parametrize("seed", partly_long(range(6), 0))
@pytest.mark.parametrize("kind", KINDS)
def test_limbs_have_their_lengths(kind, seed):
    """Of whatever forward assembles; inverse takes it back, but for an arm that has passed its fold."""
    robot, q = drawn(kind, np.random.default_rng(seed))
    pose, good = robot.try_forward(q)
    assert good.sum() > 100
    q, pose = q[good], pose[good]
    for one, joints in zip(pose[:200], q, strict=False):
        np.testing.assert_allclose(errors(robot, kind, one, joints), 0.0, atol=1e-10)
    back, taken = robot.try_inverse(pose)
    assert taken.mean() > 0.99
    same = np.isclose(back, q, 0.0, 1e-11).all(-1)[taken]
    assert same.mean() > 0.99
    np.testing.assert_allclose(robot.forward(back[taken]), pose[taken], rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("kind", "geometry"),
    [
        ("below", {"base_radius": 0.36, "platform_radius": 0.58, "limb_length": 0.46}),
        ("below", {"base_radius": 0.2, "platform_radius": 0.53, "azimuths": [0.0, 0.6, 5.6]}),
        ("upr_rpu", {}),
        ("rcu 2", {"base_radius": 0.33}),
    ],
)
def test_forward_gives_the_assembly_that_a_fine_walk_from_home_leads_to(kind, geometry, rng):
    """Also where many assemblies stand side by side."""
    robot = machine(kind, **geometry)
    home = robot.inverse(robot.home())
    spread = 0.6 * (1.0 if kind in CLOSURES else robot.size)
    ends = home + rng.uniform(-spread, spread, (400, 3))
    ends = ends[robot.try_forward(ends)[1]][:40]
    walks = home + np.linspace(0.0, 1.0, 1001)[:, None, None] * (ends - home)
    walks = walks[:, robot.try_forward(walks)[1].all(0)]
    assert walks.shape[1] > 20
    turned = robot.platform(walks)[1]
    # The last step may end next to a singularity; another assembly is farther away.
    assert np.abs(np.diff(turned, axis=0)).max() < 0.2
    assert np.abs(np.diff(robot.forward(walks), axis=0)).max() < 0.2


@pytest.mark.parametrize("kind", ["rcu 2", "below"])
def test_permuting_limbs_permutes_torques(kind, rng):
    order = [2, 0, 1]
    given = machine(kind, azimuths=np.array([0.2, 1.9, 4.4]))
    data = parameters_of("delta" if kind in CLOSURES else "prru")
    data["geometry"]["azimuths"] = given.geometry.azimuths[order].tolist()
    if kind in CLOSURES:
        data["geometry"]["closures"] = [CLOSURES[kind][k] for k in order]
    *motion, wrench = random_motion(given, rng, 50)
    there = inverse_dynamics(robot_of_data(data, "permuted"), *(x[:, order] for x in motion), wrench)
    here = inverse_dynamics(given, *motion, wrench)
    np.testing.assert_allclose(there, here[:, order], rtol=1e-10, atol=1e-9)


MISSES = [
    ("upr_rpu", (0.1, 0.6, 0.6), "limb 1"),
    ("upr_rpu", (0.6, 0.1, 0.6), "limb 2"),
    ("upr_rpu", (0.614, 0.614, 2.0), "limb 3"),
    ("upr_rpu", (0.614, 0.614, 0.05), "limb 3"),
    ("prru", (-0.35, 0.15, 0.1), "limb I"),
    ("prru", (0.1, -0.35, 0.15), "limb II"),
]


@pytest.mark.parametrize("case", partly_long(MISSES, MISSES[0], MISSES[3], MISSES[5]))
def test_a_miss_is_what_the_named_limb_lacks(case):
    """Moved by the miss and a hair more, the limb assembles; by a hair less, it does not."""
    name, q, limb = case
    robot = load(name)
    with pytest.raises(UnreachableError) as caught:
        robot.forward(q)
    assert caught.value.limb == limb and caught.value.miss > 0.0
    i = robot.limb_names.index(limb)
    mended = []
    for sign, part in itertools.product((-1, 1), (0.999, 1.001)):
        state = np.array(q)
        state[i] += sign * part * caught.value.miss
        try:
            robot.forward(state)
            mended.append(True)
        except UnreachableError as error:
            # Another limb may be what fails next.
            mended.append(error.limb != limb)
    assert mended in ([False, True, False, False], [False, False, False, True])


def test_misses_of_deltas_are_exact_geometry():
    for name in ("delta", "delta_cu"):
        robot = load(name)
        g, depth = robot.geometry, -0.7
        with pytest.raises(UnreachableError) as caught:
            robot.inverse([0.0, 0.0, depth])
        stretch = np.hypot(g.platform_radius - g.base_radius, depth)
        assert caught.value.miss == pytest.approx(stretch - g.arm_length - g.forearm_length)
        assert caught.value.limb == "limb I"
    with pytest.raises(UnreachableError) as caught:
        machine("rods", base_radius=0.4, arm_length=0.1, forearm_length=0.4).forward(np.zeros(3))
    # Equal arms: the elbows' circumcircle is the base circle and an arm, less the platform's.
    assert caught.value.miss == pytest.approx(0.4 + 0.1 - 0.051 - 0.4)


@pytest.mark.parametrize(
    ("kind", "pose"),
    [
        ("below", (0.7, 0.0, 1.3)),
        ("below", (0.7, -1.3, 0.0)),
        ("below", (0.7, np.pi, 0.0)),
        ("upr_rpu", (0.0, 0, 0)),
        ("upr_rpu", (0.3, 0, 0)),
        ("upr_rpu", (-0.6, np.pi / 2, 0)),
        ("upr_rpu", (-1e9, 0, 0)),
        # The third limb's end in the base plane: it cannot turn the platform.
        ("upr_rpu", (-0.26 * np.sin(0.5), 0.5, 0.0)),
    ],
)
def test_a_pose_beyond_a_singularity_is_refused(kind, pose):
    robot = machine(kind)
    for poses, index in ((pose, ()), ([robot.home(), pose], (1,))):
        with pytest.raises(SingularityError) as caught:
            robot.inverse(poses)
        assert caught.value.index == index
        assert caught.value.measure < caught.value.bound


@pytest.mark.parametrize("name", ["stewart", "prru", "rps3", "upr_rpu"])
def test_a_full_turn_is_the_same_pose(name):
    robot = load(name)
    for k, coordinate in enumerate(robot.pose_names):
        if coordinate not in "xyz":
            turned = robot.home()
            turned[k] += 2.0 * np.pi
            np.testing.assert_allclose(robot.inverse(turned), robot.inverse(robot.home()), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", ["below", "upr_rpu"])
@pytest.mark.parametrize("value", [-0.6, 1e9, 1e160, 1e300])
def test_joints_that_are_none_are_refused(kind, value):
    with pytest.raises(ValueError, match=r"unreachable|not finite"):
        machine(kind).forward([0.1, -value, value])


def test_angles_of_the_limbs_that_limits_are_for(rng):
    robot = load("upr_rpu")
    for pose in rng.uniform((-0.9, -0.5, -0.5), (-0.4, 0.5, 0.5), (50, 3)):
        rotation, upper, lower = upr_rpu_points(robot, pose)
        unit = (lower - upper) / np.linalg.norm(lower - upper, axis=1)[:, None]
        expected = np.arccos(np.stack((unit[:, 2], unit @ rotation[:, 2]), axis=1))
        np.testing.assert_allclose(robot.limit_angles(pose).reshape(3, 2), expected, atol=1e-7)


def test_masses_that_are_left_out_are_those_of_thin_rods_and_a_thin_disc(rng):
    data = parameters_of("prru")
    lengths, masses = data["geometry"], data["inertia"]
    for key in ("link_com", "platform_com", "platform_inertia"):
        masses.pop(key, None)
    short = robot_of_data(data, "short")
    rod, disc = lengths["limb_length"] ** 2 / 12, masses["platform_mass"] / 4
    masses |= {"link_com": 0.5, "platform_com": [0.0, 0.0, 0.0]}
    masses |= {f"{k}_link_inertia": [masses[f"{k}_link_mass"] * rod, 0.0] for k in ("lower", "upper")}
    masses["platform_inertia"] = (disc * lengths["platform_radius"] ** 2 * np.array([1.0, 1.0, 2.0])).tolist()
    motion = random_motion(short, rng, 20)
    full = inverse_dynamics(robot_of_data(data, "full"), *motion)
    np.testing.assert_allclose(inverse_dynamics(short, *motion), full, rtol=1e-12)
