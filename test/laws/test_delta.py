# SPDX-License-Identifier: Apache-2.0
"""What holds for Delta robots in particular."""

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import UnreachableError
from test.support.robots import load, random_joints

ROBOTS = ["delta", "delta_cu"]


def closure_errors(robot, pose, q):
    """Forearm lengths less their nominal value, m, from points alone."""
    g = robot.geometry
    errors = []
    for i, (azimuth, closure) in enumerate(zip(g.azimuths, g.closures, strict=True)):
        radial = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        tangent = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        elbow = g.base_radius * radial + g.arm_length * (
            np.cos(q[..., i : i + 1]) * radial - np.sin(q[..., i : i + 1]) * np.array([0, 0, 1.0])
        )
        forearm = pose + g.platform_radius * radial - elbow
        if closure == "rcu":
            forearm = forearm - (forearm @ tangent)[..., None] * tangent
        errors.append(np.linalg.norm(forearm, axis=-1) - g.forearm_length)
    return np.stack(errors, -1)


@pytest.mark.parametrize("rcu", [None, 0, 1, 2])
def test_assembly_over_random_dimensions(variant, rng, rcu):
    """forward(inverse(x)) = x for machines of other dimensions, wherever x hangs below."""
    for _ in range(5):
        closures = ["rod"] * 3
        if rcu is not None:
            closures[rcu] = "rcu"
        arm = rng.uniform(0.1, 0.5)
        robot, _ = variant(
            "delta",
            geometry={
                "base_radius": float(rng.uniform(0.05, 0.3)),
                "platform_radius": float(rng.uniform(0.03, 0.2)),
                "arm_length": float(arm),
                "forearm_length": float(arm * rng.uniform(1.6, 3.0)),
                "azimuths": (np.array([0.0, 2.1, 4.2]) + rng.uniform(-0.3, 0.3, 3)).tolist(),
                "closures": closures,
            },
        )
        q = rng.uniform(-0.5, 0.9, (50, 3))
        pose, good = robot.try_forward(q)
        # A machine whose joints reach nothing would hold the law for nothing.
        assert good.mean() > 0.5
        q, pose = q[good], pose[good]
        assert np.abs(closure_errors(robot, pose, q)).max() < 1e-12
        np.testing.assert_allclose(robot.forward(robot.inverse(pose)), pose, atol=1e-9)


@pytest.mark.parametrize("name", ROBOTS)
def test_platform_hangs_below_the_elbows(name, rng):
    robot = load(name)
    q = random_joints(robot, rng, 500)
    elbows = -robot.geometry.arm_length * np.sin(q)
    assert (robot.forward(q)[:, 2] < elbows.min(-1)).all()


def test_permuting_limbs_permutes_torques(variant, rng):
    name, order = "delta_cu", [2, 0, 1]
    robot = load(name)
    g = robot.geometry
    turned, _ = variant(
        name,
        geometry={
            "azimuths": g.azimuths[order].tolist(),
            "closures": [g.closures[i] for i in order],
        },
    )
    q, qd, qdd = (random_joints(robot, rng, 100) * scale for scale in (1, 3, 30))
    wrench = rng.normal(size=(100, 6))
    np.testing.assert_allclose(
        inverse_dynamics(turned, q[:, order], qd[:, order], qdd[:, order], wrench),
        inverse_dynamics(robot, q, qd, qdd, wrench)[:, order],
        rtol=1e-10,
        atol=1e-10,
    )


def test_the_two_closures_agree_where_the_slide_is_zero(rng):
    """On limb III's own plane an rcu is a rod: same kinematics, other inertia sideways."""
    rod, rcu = load("delta"), load("delta_cu")
    azimuth = rod.geometry.azimuths[2]
    out = rng.uniform(-0.05, 0.05, 50)
    pose = np.stack(
        [out * np.cos(azimuth), out * np.sin(azimuth), rng.uniform(-0.45, -0.3, 50)], -1
    )
    np.testing.assert_allclose(rod.inverse(pose), rcu.inverse(pose), atol=1e-13)


def test_rcu_forward_finds_assemblies_that_no_rod_reaches(variant, rng):
    """Sideways of limb III an rcu reaches where a rod of the same length does not."""
    rod, _ = variant("delta", geometry={"base_radius": 0.33})
    rcu, _ = variant("delta_cu", geometry={"base_radius": 0.33})
    q = rng.uniform(-1.2, 1.5, (20000, 3))
    pose, good = rcu.try_forward(q)
    gained = good & ~rod.try_forward(q)[1]
    assert gained.any()
    assert np.abs(closure_errors(rcu, pose[gained], q[gained])).max() < 1e-12


@pytest.mark.parametrize("name", ROBOTS)
def test_miss_is_the_distance_to_the_reach(name):
    """Straight below, lowered beyond the stretched limb: the miss is exact geometry."""
    robot = load(name)
    g = robot.geometry
    depth = -0.7
    stretch = np.hypot(g.platform_radius - g.base_radius, depth)
    with pytest.raises(UnreachableError) as caught:
        robot.inverse([0.0, 0.0, depth])
    assert caught.value.miss == pytest.approx(stretch - g.arm_length - g.forearm_length)
    assert caught.value.limb == "limb I"


def test_forward_out_of_reach_names_the_limb_apart(variant):
    robot, _ = variant(
        "delta",
        geometry={"base_radius": 0.4, "arm_length": 0.1, "forearm_length": 0.4},
    )
    with pytest.raises(UnreachableError) as caught:
        robot.forward([0.0, 0.0, 0.0])
    # Equal arms: the elbows' circumcircle is the base circle and an arm, less the platform's.
    assert caught.value.miss == pytest.approx(0.4 + 0.1 - 0.051 - 0.4)
