# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Laws of compliance and strain energy, over random machines, poses and loads."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pkm_twin.errors import ParameterError, SingularityError
from pkm_twin.robot.workspace import regular_workspace
from stiffness_monitor import compliance, stiffness, strain_energy
from test.support.robots import load
from test.support.upr_rpu import closed_form

ROBOT = load("upr_rpu")
HOME = np.array([-0.6, 0.0, 0.0])
SWAPPED = [3, 4, 5, 0, 1, 2, 6, 7, 8]


def random_machine(rng):
    """Another size, other bars, other joints: compliances over two decades."""

    def joint(free):
        values = 10.0 ** rng.uniform([-10.5] * 3 + [-11.5] * 3, [-8.5] * 3 + [-9.5] * 3)
        return [math.inf if i in free else v for i, v in enumerate(values.tolist())]

    radii, moduli = rng.uniform((0.2, 0.1), (0.6, 0.5)), rng.uniform((50e9, 20e9), (250e9, 90e9))
    return ROBOT.changed(
        geometry=dict(zip(("base_radius", "platform_radius"), radii, strict=True)),
        members={
            "youngs_modulus": moduli[0],
            "shear_modulus": moduli[1],
            "diameter": rng.uniform(0.02, 0.15, 3).tolist(),
            "shear_factor": rng.uniform(0.5, 2.0),
        },
        joints_compliance={
            "upr_revolute": joint((4,)),
            "upr_universal": joint((3, 4)),
            "rpu_universal": joint((3, 4)),
            "rpu_revolute": joint((3,)),
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
