# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Laws of natural frequencies and shapes, over all robots that have data for them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import ParameterError, SingularityError
from stiffness_monitor import compliance
from stiffness_monitor.modes import assemble, modes, natural_frequencies
from stiffness_monitor.structure import Carried, Member, structural_model
from test.support.robots import elastic, load, parameters_of, random_joints

DELTAS = ("delta", "delta_cu")


def random_poses(robot, rng, count):
    if robot.mechanism == "upr_rpu":
        return rng.uniform([-0.8, -0.35, -0.35], [-0.45, 0.35, 0.35], (count, 3))
    return robot.forward(random_joints(robot, rng, count))


def frame_compliance(robot, poses, elements):
    """Of the platform, by finite elements with mass, shape (k, 6, 6)."""
    found = []
    for q in robot.inverse(poses):
        system = assemble(structural_model(robot, q), elements)
        found.append(np.linalg.inv(system.stiffness)[:6, :6])
    return np.array(found)


def tubes(name, **changes):
    """The members section of a delta with every tube changed."""
    members = parameters_of(name)["members"]
    for key in ("arm", "forearm", "rcu_forearm"):
        if key in members:
            members[key] |= changes
    return members


# ------------------------------------------------------------------ against other models


def test_static_compliance_is_that_of_the_compiled_frame(variant, rng):
    """Members of one and of more beams: other bars and joints each time."""
    for _ in range(4):
        joints = {}
        for key, values in parameters_of("upr_rpu")["joints_compliance"].items():
            joints[key] = [v * float(10 ** rng.uniform(-1, 3)) for v in values]
        robot, _ = variant(
            "upr_rpu",
            members={"diameter": rng.uniform(0.03, 0.2, 3).tolist(), "shear_factor": 1.2},
            joints_compliance=joints,
        )
        poses = random_poses(robot, rng, 4)
        for elements in (1, 3):
            found = frame_compliance(robot, poses, elements)
            expected = compliance(robot, poses)
            scale = np.sqrt(np.einsum("...ii->...i", expected))
            difference = (found - expected) / (scale[..., None] * scale[..., None, :])
            assert np.abs(difference).max() < 1e-9


@pytest.fixture
def on_springs(with_members):
    """A delta of stiff members whose drives have a compliance, rad/(N m)."""

    def make(name, value):
        slim = {"youngs_modulus": 1e14, "shear_modulus": 1e14, "outer_diameter": 0.004}
        members = tubes(name, **slim, inner_diameter=0.0)
        for key in ("arm", "forearm", "rcu_forearm"):
            members.get(key, {}).pop("density", None)
        return with_members(name, members | {"drive_compliance": value})

    return make


@pytest.mark.parametrize("name", DELTAS)
def test_stiff_members_on_soft_drives_are_the_rigid_body_model_on_springs(name, on_springs, rng):
    """J c J' for the compliance, and M(q) of the virtual work for the frequencies."""
    drive = 1.0
    robot = on_springs(name, drive)
    q = random_joints(robot, rng, 6)
    poses = robot.forward(q)
    jacobian = robot.jacobian(q)
    soft = compliance(robot, poses)[:, :3, :3]
    expected = drive * jacobian @ jacobian.swapaxes(-1, -2)
    size = np.linalg.norm(expected, axis=(-2, -1))[:, None, None]
    assert np.abs((soft - expected) / size).max() < 1e-3
    weightless = robot.changed(gravity=[0.0, 0.0, 0.0])
    inertia = inverse_dynamics(weightless, q[:, None], np.zeros(3), np.eye(3))
    rigid = np.sqrt(1 / (drive * np.linalg.eigvalsh(inertia)[:, ::-1])) / (2 * np.pi)
    assert natural_frequencies(robot, poses, 3) == pytest.approx(rigid, rel=1e-3)


@pytest.mark.parametrize("name", ["delta", "delta_cu", "prru", "upr_rpu"])
def test_locked_drives_carry_what_virtual_work_says(name, rng):
    """Their efforts under a wrench on the platform: end forces of beams against J' P."""
    robot = load(name)
    for pose in random_poses(robot, rng, 4):
        wrench = rng.normal(size=6)
        frame = structural_model(robot, robot.inverse(pose))
        system = assemble(frame, 2)
        load_vector = np.zeros(len(system.mass))
        load_vector[:6] = wrench
        shape = np.linalg.solve(system.stiffness, load_vector)
        q = robot.inverse(pose)
        expected = -robot.platform_jacobian(q).T @ wrench
        standing = {"base", *(part.name for part in frame.parts if isinstance(part, Carried))}
        members = [part for part in frame.parts if isinstance(part, Member)]
        driven = [k for k, member in enumerate(members) if name == "upr_rpu" or member.inner.body in standing]
        assert len(driven) == len(robot.joint_names)
        for i, k in enumerate(driven):
            index, _, axes = system.members[k]
            part = system.parts[index]
            # What the drive does to the member's start.
            effort = (part.stiffness @ part.map @ shape[part.own])[:6]
            force, moment = axes @ effort[:3], axes @ effort[3:]
            if name == "prru":
                found = force[2]
            elif name == "upr_rpu":
                # Along the limb, from B to A.
                found = force @ axes[:, 0]
            else:
                angle = robot.geometry.azimuths[i]
                found = moment @ np.array([-math.sin(angle), math.cos(angle), 0.0])
            assert found == pytest.approx(expected[i], rel=1e-6, abs=1e-6)


def at_point(matrix, lever):
    """Translations per force of a point of the platform, shape (..., 3, 3)."""
    carried = np.zeros((*lever.shape[:-1], 3, 6))
    carried[..., :3] = np.eye(3)
    for k in range(3):
        carried[..., 3 + k] = np.cross(np.eye(3)[k], lever)
    return carried @ matrix @ carried.swapaxes(-1, -2)


@elastic
def test_a_heavy_point_load_has_the_frequencies_of_the_static_compliance(name, variant, rng):
    mass, com = 5e4, [0.02, -0.03, -0.08]
    if name == "upr_rpu":
        point = {"platform_mass": mass, "platform_com": com, "platform_inertia": [1e-6] * 3}
        robot, _ = variant(name, inertia=point)
    else:
        robot, _ = variant(name, payload={"mass": mass, "com": com})
    poses = random_poses(robot, rng, 3)
    lever = robot.rotation(poses) @ np.array(com)
    soft = np.linalg.eigvalsh(at_point(compliance(robot, poses), lever))[:, ::-1]
    expected = 1 / (2 * np.pi * np.sqrt(mass * soft))
    assert natural_frequencies(robot, poses, 3) == pytest.approx(expected, rel=1e-3)


# ------------------------------------------------------------------ symmetry and scale


@pytest.mark.parametrize("name", DELTAS)
def test_frequencies_go_with_the_root_of_stiffness_over_mass(name, variant, rng):
    robot = load(name)
    poses = random_poses(robot, rng, 3)
    expected = natural_frequencies(robot, poses)
    members = tubes(name)
    for key in ("arm", "forearm", "rcu_forearm"):
        for modulus in ("youngs_modulus", "shear_modulus"):
            if key in members:
                members[key][modulus] *= 4
    assert natural_frequencies(variant(name, members=members)[0], poses) == pytest.approx(2 * expected, rel=1e-8)
    members = tubes(name)
    for key in ("arm", "forearm", "rcu_forearm"):
        if key in members:
            members[key]["density"] *= 4
    inertia = {key: 4 * parameters_of(name)["inertia"][key] for key in ("platform_mass", "arm_mass", "forearm_mass")}
    heavy = variant(name, members=members, inertia=inertia)[0]
    assert natural_frequencies(heavy, poses) == pytest.approx(expected / 2, rel=1e-8)


def test_a_symmetric_delta_has_pairs_of_lateral_modes(rng):
    robot = load("delta")
    for angle in (-0.3, 0.22, 0.8):
        pose = robot.forward([angle] * 3)
        found = modes(robot, pose, 6)
        f = found.frequencies
        assert f[0] == pytest.approx(f[1], rel=1e-9)
        # Three limbs in a ring: a mode is alone or one of two, never of three.
        assert f[2] > f[1] * (1 + 1e-3)
        # The two lateral ones move the platform sideways, the same energy altogether.
        platform = found.shapes[:2, 0, :3]
        assert np.abs(platform[:, 2]).max() < 1e-9 * np.abs(platform).max()


# ------------------------------------------------------------------ modes


@elastic
def test_locked_drives_leave_no_mechanism(name, rng):
    robot = load(name)
    found = natural_frequencies(robot, random_poses(robot, rng, 20), 1, elements=2)
    assert found.min() > 5.0


def test_rods_that_touch_hold_no_rotation(variant):
    """Such a file is refused; and the nearer they are, the softer is what they hold."""
    with pytest.raises(ParameterError, match="parallelogram_width"):
        variant("delta", members={"parallelogram_width": 1e-9})
    # The model itself refuses what would come past the file.
    sound = load("delta")
    touching = dataclasses.replace(sound.members, parallelogram_width=1e-9)
    robot = dataclasses.replace(sound, members=touching)
    with pytest.raises(SingularityError, match="elastic frame") as caught:
        natural_frequencies(robot, robot.home()[None])
    assert caught.value.index == (0,)
    lowest = []
    for width in (1e-2, 1e-4):
        robot = variant("delta", members={"parallelogram_width": width})[0]
        lowest.append(float(natural_frequencies(robot, robot.home()[None]).min()))
    assert lowest[1] < 0.1 * lowest[0]


@elastic
def test_shares_sum_to_one_and_the_platforms_is_that_of_its_shape(name, rng):
    robot = load(name)
    poses = random_poses(robot, rng, 3)
    found = modes(robot, poses)
    shares = found.energies
    assert shares.strain.shape == shares.kinetic.shape == (3, 6, len(shares.elements))
    for part in (shares.strain, shares.kinetic):
        assert part.sum(-1) == pytest.approx(np.ones((3, 6)))
        assert part.min() > -1e-12
    index = shares.elements.index(robot.graph.platform)
    assert np.abs(shares.strain[..., index]).max() == 0.0
    for k, pose in enumerate(poses):
        bodies = structural_model(robot, robot.inverse(pose)).bodies
        (body,) = (b for b in bodies if b.name == robot.graph.platform)
        moved = found.shapes[k, :, found.nodes.index(body.name)]
        spin = moved[:, 3:]
        velocity = moved[:, :3] + np.cross(spin, body.at - robot.platform(robot.inverse(pose))[0])
        energy = body.mass * (velocity**2).sum(-1) + np.einsum("ki,ij,kj->k", spin, body.inertia, spin)
        # Shapes have unit generalised mass.
        assert energy == pytest.approx(shares.kinetic[k, :, index], rel=1e-9, abs=1e-12)


def test_joints_with_elasticity_are_elements_of_the_shares():
    robot = load("upr_rpu")
    found = modes(robot, robot.home())
    assert set(found.energies.elements) == {"platform", *robot.element_names}
    static = {e[1] for e, s in zip(found.energies.elements, found.energies.kinetic[0], strict=True) if s == 0.0}
    assert static == {"R", "U"}


def test_shapes_keep_what_joints_hold(rng):
    """At a ball joint the rod's end moves with the platform's point; at the base nothing moves."""
    robot = load("delta_cu")
    pose = random_poses(robot, rng, 1)[0]
    found = modes(robot, pose, elements=3)
    at = {node: k for k, node in enumerate(found.nodes)}
    platform = found.shapes[:, 0]
    for rod in ("forearm I", "forearm II a", "forearm II b", "forearm III a", "forearm III b"):
        lever = found.positions[at[f"{rod} 3/3"]] - pose
        expected = platform[:, :3] + np.cross(platform[:, 3:], lever)
        assert found.shapes[:, at[f"{rod} 3/3"], :3] == pytest.approx(expected, abs=1e-9)
    for limb in ("I", "II", "III"):
        assert not found.shapes[:, at[f"arm {limb} 0/3"]].any()
    # The cylindrical joint of limb I lets its rod slide along t, and not across.
    start, tip = at["forearm I 0/3"], at["arm I 3/3"]
    angle = robot.geometry.azimuths[0]
    r, t = np.array([[math.cos(angle), math.sin(angle), 0], [-math.sin(angle), math.cos(angle), 0]])
    lever = found.positions[start] - found.positions[tip]
    carried = found.shapes[:, tip, :3] + np.cross(found.shapes[:, tip, 3:], lever)
    gap = found.shapes[:, start, :3] - carried
    assert np.abs(gap @ r).max() < 1e-9
    assert np.abs(gap[:, 2]).max() < 1e-9
    assert np.abs(gap @ t).max() > 0.1


@elastic
def test_the_shipped_number_of_elements_is_enough(name):
    robot = load(name)
    fine = natural_frequencies(robot, robot.home(), elements=16)
    assert natural_frequencies(robot, robot.home()) == pytest.approx(fine, rel=1.5e-3)


# ------------------------------------------------------------------ interface


@elastic
def test_natural_frequencies_are_those_of_the_modes(name, rng):
    robot = load(name)
    poses = random_poses(robot, rng, 3)
    found = modes(robot, poses, 4).frequencies
    assert natural_frequencies(robot, poses, 4) == pytest.approx(found, rel=1e-10)
    assert (np.diff(found) >= 0.0).all()


def test_bad_arguments_are_refused():
    robot = load("delta")
    home = robot.home()
    with pytest.raises(ValueError, match=r"pose|shape"):
        natural_frequencies(robot, 1.0)
    for count in (0, 10_000):
        with pytest.raises(ValueError, match="count"):
            natural_frequencies(robot, home, count)
    with pytest.raises(ParameterError, match="elements"):
        natural_frequencies(robot, home, elements=0)
    with pytest.raises(ValueError, match="no pose"):
        modes(robot, np.empty((0, 3)))
