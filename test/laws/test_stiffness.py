# SPDX-License-Identifier: Apache-2.0
"""Laws of compliance and strain energy, over random machines, poses and loads."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pkm_twin.errors import ParameterError, SingularityError
from pkm_twin.machine import schema
from pkm_twin.machine.strict_yaml import read_yaml
from pkm_twin.mechanisms.upr_rpu import UprRpu
from pkm_twin.robot.catalogue import config_folder
from pkm_twin.robot.workspace import regular_workspace
from stiffness_monitor import compliance, stiffness, strain_energy
from test.support.robots import load
from test.support.upr_rpu import closed_form

ROBOT = load("upr_rpu")
FILE = read_yaml(config_folder() / "upr_rpu.yaml")
HOME = np.array([-0.6, 0.0, 0.0])
SWAPPED = [3, 4, 5, 0, 1, 2, 6, 7, 8]


def random_machine(rng):
    """Another size, other bars, other joints: compliances over two decades."""

    def joint(free):
        values = 10.0 ** rng.uniform([-10.5] * 3 + [-11.5] * 3, [-8.5] * 3 + [-9.5] * 3)
        return [math.inf if i in free else v for i, v in enumerate(values.tolist())]

    return schema.build(
        UprRpu,
        {
            "mechanism": "upr_rpu",
            "geometry": {
                "base_radius": float(rng.uniform(0.2, 0.6)),
                "platform_radius": float(rng.uniform(0.1, 0.5)),
            },
            "members": {
                "youngs_modulus": float(rng.uniform(50e9, 250e9)),
                "shear_modulus": float(rng.uniform(20e9, 90e9)),
                "diameter": rng.uniform(0.02, 0.15, 3).tolist(),
                "shear_factor": float(rng.uniform(0.5, 2.0)),
            },
            "joints_compliance": {
                "upr_revolute": joint((4,)),
                "upr_universal": joint((3, 4)),
                "rpu_universal": joint((3, 4)),
                "rpu_revolute": joint((3,)),
            },
        },
    )


def random_poses(rng, count):
    """Tilts up to 25 degrees at heights where no machine above is singular."""
    return rng.uniform((-1.2, -0.44, -0.44), (-0.55, 0.44, 0.44), (count, 3))


CASES = [(ROBOT, random_poses(np.random.default_rng(1), 20))] + [
    (random_machine(np.random.default_rng(seed)), random_poses(np.random.default_rng(seed), 20))
    for seed in range(2, 22)
]
EACH = [*CASES[:7], *(pytest.param(*case, marks=pytest.mark.long) for case in CASES[7:])]


def loads(count, seed):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 6)) * [50, 50, 50, 20, 20, 20]


# --- The second route: minimum complementary energy, written from internal forces alone.


def limb_frames(robot, pose):
    """Per limb: unit wrenches at o (6, 3), its two ends, and its elements' axes."""
    z, beta, _ = pose
    o = np.array([0.0, -z * np.tan(beta), z])
    rotation = robot.rotation(pose)
    pattern = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    upper = o + robot.geometry.platform_radius * pattern @ rotation.T
    lower = robot.geometry.base_radius * pattern
    x, y = np.array([1.0, 0, 0]), rotation[:, 1]
    tau = np.cross(x, y)
    for i in range(3):
        at, line = (lower[i], y) if i < 2 else (upper[i], x)
        along = upper[i] - lower[i] if i < 2 else lower[i] - upper[i]
        along = along / np.linalg.norm(along)
        wrenches = np.zeros((6, 3))
        wrenches[:3, 0], wrenches[3:, 0] = along, np.cross(upper[i] - o, along)
        wrenches[:3, 1], wrenches[3:, 1] = line, np.cross(at - o, line)
        wrenches[3:, 2] = tau
        down = (lower[i] - upper[i]) / np.linalg.norm(lower[i] - upper[i])
        universal = np.column_stack((x, y, tau))
        if i < 2:
            revolute = np.column_stack((np.cross(y, down), y, down))
        else:
            revolute = np.column_stack((x, np.cross(down, x), down))
        yield o, wrenches, upper[i], lower[i], revolute, universal


def joint_compliance(wrenches, o, centre, axes, diagonal):
    """Energy of a joint under unit wrenches, moved to its centre and into its axes."""
    force = axes.T @ wrenches[:3]
    moment = axes.T @ (wrenches[3:] - np.cross(centre - o, wrenches[:3], axisb=0).T)
    load = np.vstack((force, moment))
    free = np.isinf(diagonal)
    assert np.abs(load[free]).max() < 1e-12, "a free axis carries load"
    return load.T @ np.diag(np.where(free, 0.0, diagonal)) @ load


def bar_compliance(wrenches, o, upper, lower, members, diameter):
    """Energy of a beam by Gauss quadrature of its internal forces."""
    length = np.linalg.norm(lower - upper)
    along = (lower - upper) / length
    area, second = math.pi * diameter**2 / 4, math.pi * diameter**4 / 64
    across = np.eye(3) - np.outer(along, along)
    line = np.outer(along, along)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    force = wrenches[:3]
    result = np.zeros((3, 3))
    for node, weight in zip(nodes, weights, strict=True):
        point = upper + along * length * (node + 1) / 2
        moment = wrenches[3:] - np.cross(point - o, force, axisb=0).T
        dv = weight * length / 2
        result += dv * force.T @ line @ force / (members.youngs_modulus * area)
        result += (
            dv * members.shear_factor * force.T @ across @ force / (members.shear_modulus * area)
        )
        result += dv * moment.T @ across @ moment / (members.youngs_modulus * second)
        result += dv * moment.T @ line @ moment / (members.shear_modulus * 2 * second)
    return result


def second_route(robot, pose):
    """Compliance and, per unit load, energy matrices of the nine elements, shape (9, 6, 6).

    Of all internal forces with sum J_i W_i = P, those of least complementary energy: one linear
    system in W and the multipliers, which are the deflection.
    """
    elements, wrenches = [], []
    j = robot.joints_compliance
    frames = limb_frames(robot, pose)
    for i, (o, unit, upper, lower, revolute, universal) in enumerate(frames):
        if i < 2:
            r = joint_compliance(unit, o, upper, revolute, j.upr_revolute)
            u = joint_compliance(unit, o, lower, universal, j.upr_universal)
        else:
            r = joint_compliance(unit, o, lower, revolute, j.rpu_revolute)
            u = joint_compliance(unit, o, upper, universal, j.rpu_universal)
        b = bar_compliance(unit, o, upper, lower, robot.members, robot.members.diameter[i])
        wrenches.append(unit)
        elements += [(i, r), (i, b), (i, u)]
    statics = np.hstack(wrenches)
    block = np.zeros((9, 9))
    for i, matrix in elements:
        block[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += matrix
    # Units of micrometres, so that the system's two halves are of one size.
    system = np.block([[1e9 * block, statics.T], [statics, np.zeros((6, 6))]])
    solution = np.linalg.solve(system, np.vstack((np.zeros((9, 6)), np.eye(6))))
    forces, c = solution[:9], -solution[9:] / 1e9
    parts = [
        forces[3 * i : 3 * i + 3].T @ matrix @ forces[3 * i : 3 * i + 3] for i, matrix in elements
    ]
    return c, np.array(parts)


@pytest.mark.parametrize(("robot", "poses"), EACH)
def test_second_route(robot, poses):
    wrench = loads(len(poses), 3)
    c = compliance(robot, poses)
    energy = strain_energy(robot, poses, wrench)
    for k, pose in enumerate(poses):
        expected, parts = second_route(robot, pose)
        size = np.sqrt(np.diag(expected))
        assert c[k] / np.outer(size, size) == pytest.approx(
            expected / np.outer(size, size), abs=1e-9
        )
        energies = 0.5 * np.einsum("i,eij,j->e", wrench[k], parts, wrench[k])
        assert energy.energies[k] == pytest.approx(energies, abs=1e-8 * energies.sum())


@pytest.mark.parametrize(("robot", "poses"), EACH)
def test_closed_form(robot, poses):
    """The frame against the paper's equations, element by element, with factors on some."""
    softer = robot.changed(element_compliance={"1B": 3.0, "2U": 0.2, "3R": 5.0})
    wrench = loads(len(poses), 5)
    for one in (robot, softer):
        found = strain_energy(one, poses, wrench)
        for k, pose in enumerate(poses):
            expected, energies = closed_form(one, pose, wrench[k])
            size = np.sqrt(np.diag(expected))
            assert np.abs((found.compliance[k] - expected) / np.outer(size, size)).max() < 1e-10
            assert found.energies[k] == pytest.approx(energies, abs=1e-10 * energies.sum())


# --- Laws of the matrices.


def test_stiffer_parts_make_a_stiffer_machine():
    """With rigid joints the joints store nothing, and no direction gets softer."""
    zero = {
        "upr_revolute": [0, 0, 0, 0, math.inf, 0],
        "upr_universal": [0, 0, 0, math.inf, math.inf, 0],
        "rpu_universal": [0, 0, 0, math.inf, math.inf, 0],
        "rpu_revolute": [0, 0, 0, math.inf, 0, 0],
    }
    for robot, poses in CASES[:6]:
        rigid = robot.changed(joints_compliance=zero)
        gain = compliance(robot, poses) - compliance(rigid, poses)
        size = np.sqrt(np.einsum("...ii->...i", compliance(robot, poses)))
        scaled = gain / size[..., None] / size[..., None, :]
        assert np.linalg.eigvalsh(scaled).min() > -1e-11
        e = strain_energy(rigid, poses, loads(len(poses), 13))
        assert e.factors[:, [0, 2, 3, 5, 6, 8]] == pytest.approx(0, abs=0)
        assert e.factors[:, [1, 4, 7]].sum(-1) == pytest.approx(1, abs=1e-14)


# --- Interface: shapes, ties, zero loads, refusals.


def test_zero_wrench_has_no_dominant_element():
    batch = strain_energy(ROBOT, HOME, [[0.0] * 6, [0, 0, 1, 0, 0, 0], [-0.0] * 6])
    assert batch.dominant.tolist() == ["none", "1U", "none"]
    assert batch.tie.tolist() == [False, True, False]
    assert batch.factors.sum(-1) == pytest.approx([0, 1, 0], abs=1e-15)


@pytest.mark.parametrize("beta", np.linspace(-0.4, 0.4, 17))
@pytest.mark.parametrize("wrench", [(0, 0, 1, 0, 0, 0), (0, 3, -7, 0.1, 0, 0)])
def test_ties_by_symmetry(beta, wrench):
    """With gamma = 0 and a load in the plane x = 0, limbs 1 and 2 store the same."""
    e = strain_energy(ROBOT, [-0.6, beta, 0.0], wrench)
    assert e.factors[SWAPPED] == pytest.approx(e.factors, rel=1e-11, abs=1e-15)
    if e.dominant[0] != "3":
        assert e.tie
        assert e.dominant[0] == "1"
    batch = strain_energy(ROBOT, [[-0.6, beta, 0.0]] * 3, wrench)
    assert set(batch.dominant.tolist()) == {e.dominant}
    assert set(batch.tie.tolist()) == {e.tie}
    # A thousandth of a radian of gamma is no tie.
    assert not strain_energy(ROBOT, [-0.6, beta, 1e-3], wrench).tie


def test_only_a_machine_that_tilts_has_this_regular_workspace():
    with pytest.raises(ParameterError, match="upr_rpu") as caught:
        regular_workspace(load("delta"), [-0.4])
    assert caught.value.value == "delta"


def test_not_positive_definite_is_refused():
    """A3 in the base plane: with locked drives the platform is still free to turn about X."""
    beta = 0.5
    z = -ROBOT.geometry.platform_radius * math.sin(beta)
    for call in (compliance, stiffness, lambda r, p: strain_energy(r, p, np.ones(6))):
        with pytest.raises(SingularityError):
            call(ROBOT, [z, beta, 0.0])
    c = compliance(ROBOT, [z - 1e-4, beta, 0.0])
    assert c[3, 3] > 1e5 * compliance(ROBOT, HOME)[3, 3]
