# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Laws of compliance and strain energy, over all robots with elastic members."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pkm_twin.errors import ParameterError, SingularityError
from pkm_twin.maps.search import find_workspace_box
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.clearance import clearance, has_clearance
from pkm_twin.robot.workspace import reachable
from stiffness_monitor import compliance, platform_response, stiffness, strain_energy
from stiffness_monitor.compliance import kernels, member_deflections
from test.support.robots import ELASTIC, elastic, load, parameters_of, partly_long, random_joints, random_poses


def random_wrenches(rng, *shape):
    return rng.normal(size=(*shape, 6)) * [50, 50, 50, 5, 5, 5]


@elastic
class TestEveryRobot:
    def test_compliance_is_symmetric_positive_definite_and_the_deflection_of_unit_wrenches(self, name, rng):
        robot = load(name)
        poses = random_poses(robot, rng, 6)
        matrix = compliance(robot, poses)
        assert matrix.shape == (6, 6, 6)
        assert (matrix == matrix.swapaxes(-1, -2)).all()
        assert (np.linalg.eigvalsh(matrix) > 0.0).all()
        wrench = random_wrenches(rng, 6)
        found = strain_energy(robot, poses, wrench)
        expected = np.einsum("nij,nj->ni", matrix, wrench)
        assert found.deflection == pytest.approx(expected, rel=1e-8, abs=1e-15)
        assert np.eye(6) == pytest.approx(stiffness(robot, poses[0]) @ matrix[0], abs=1e-6)

    def test_energy_is_half_the_wrench_s_work_and_the_factors_share_it(self, name, rng):
        robot = load(name)
        poses, wrench = random_poses(robot, rng, 6), random_wrenches(rng, 6)
        found = strain_energy(robot, poses, wrench)
        work = np.einsum("ni,nij,nj->n", wrench, compliance(robot, poses), wrench) / 2
        assert found.total == pytest.approx(work, rel=1e-8)
        assert found.energies.sum(-1) == pytest.approx(found.total, rel=1e-12)
        assert found.factors.sum(-1) == pytest.approx(1.0, rel=1e-12)
        assert (found.factors >= 0.0).all()
        assert found.factors.shape == (6, len(found.elements))
        best = found.factors.argmax(-1)
        alone = ~found.tie
        assert [found.elements[k] for k in best[alone]] == found.dominant[alone].tolist()

    @pytest.mark.parametrize("size", [1e-160, 1e-30, 1e140])
    def test_factors_do_not_hang_on_the_wrench_s_size(self, name, size, rng):
        robot = load(name)
        pose, wrench = robot.home(), random_wrenches(rng, 1)[0]
        usual, other = (strain_energy(robot, pose, s * wrench) for s in (1.0, size))
        assert other.factors == pytest.approx(usual.factors, rel=1e-9)
        assert other.dominant == usual.dominant
        assert other.deflection == pytest.approx(size * usual.deflection, rel=1e-9)

    def test_no_load_has_no_dominant_element(self, name, rng):
        robot = load(name)
        found = strain_energy(robot, random_poses(robot, rng, 2), np.zeros((2, 6)))
        assert found.dominant.tolist() == ["none", "none"]
        assert not found.tie.any()
        assert not found.factors.any()
        assert not found.total.any()
        one = strain_energy(robot, robot.home(), np.zeros(6))
        assert (one.dominant, one.tie, one.total) == ("none", False, 0.0)
        assert [type(value) for value in (one.dominant, one.tie, one.total)] == [str, bool, float]

    def test_poses_and_joints_are_answered_alike(self, name, rng):
        """And q has batch axes of its own, beside the wrench's."""
        robot = load(name)
        q, wrench = random_joints(robot, rng, 3), random_wrenches(rng, 2)
        found = platform_response(robot, q[:, None], wrench)
        expected = strain_energy(robot, robot.forward(q)[:, None], wrench)
        assert found.compliance.shape == (3, 2, 6, 6)
        assert found.energies.shape == (3, 2, len(found.elements))
        assert found.deflection == pytest.approx(expected.deflection, rel=1e-9, abs=1e-16)
        assert found.factors == pytest.approx(expected.factors, abs=1e-10)
        assert (found.compliance[:, 0] == found.compliance[:, 1]).all()
        assert not found.compliance.flags.writeable
        matrix = compliance(robot, robot.forward(q))
        assert matrix.flags.writeable
        assert matrix == pytest.approx(found.compliance[:, 0], rel=1e-8, abs=1e-12 * matrix.max())

    def test_members_bend_from_end_to_end(self, name, rng):
        """Their ends go with what they stand on; a batch is a loop."""
        robot = load(name)
        q, wrench = random_joints(robot, rng, 2), random_wrenches(rng, 2)
        many = member_deflections(robot, q, wrench)
        moved = platform_response(robot, q, wrench).deflection
        place, _ = robot.platform(q)
        if name not in ("upr_rpu", "five_bar"):  # their joints at the platform give
            for k in range(2):
                rigid = [
                    (points[k, -1], shifts[k, -1])
                    for points, shifts in many.values()
                    if np.allclose(
                        shifts[k, -1],
                        moved[k, :3] + np.cross(moved[k, 3:], points[k, -1] - place[k]),
                        rtol=1e-9,
                        atol=1e-15,
                    )
                ]
                assert len(rigid) >= len(robot.joint_names)
        for member, (points, shifts) in many.items():
            one = member_deflections(robot, q[1], wrench[1])[member]
            assert (points[1] == one[0]).all()
            assert (shifts[1] == one[1]).all()

    def test_kernels_are_there_to_warm_up(self, name):
        made = kernels(load(name))
        assert made
        for kernel in made:
            kernel.warm_up()
            parameters, sizes = np.zeros(kernel.program.parameters), kernel.sizes[0]
            outputs, _ = kernel(parameters, *(np.zeros(size) for size in sizes))
            assert [len(row) for row in outputs] == list(kernel.sizes[1])


@pytest.mark.parametrize(
    "name",
    partly_long([n for n in ELASTIC if n != "upr_rpu" and "members" in parameters_of(n)], "delta"),
)
def test_without_members_nothing_is_known_of_them_and_all_else_holds(name, rng):
    data = parameters_of(name)
    del data["members"]
    robot = robot_of_data(data, "rigid")
    for ask in (
        lambda: compliance(robot, robot.home()),
        lambda: strain_energy(robot, robot.home(), np.ones(6)),
        lambda: kernels(robot),
        lambda: clearance(robot, robot.home()),
    ):
        with pytest.raises(ParameterError) as caught:
            ask()
        assert caught.value.field == "members"
    assert robot.beams == () and not has_clearance(robot)
    low, high = np.transpose(find_workspace_box(robot))
    poses = rng.uniform(low, high, (1000, len(low)))
    expected = reachable(load(name), poses, -math.inf)
    assert 0 < expected.sum() < 1000
    for bound in (0.0, 1e3):
        assert (reachable(robot, poses, bound) == expected).all()


def test_a_frame_that_is_a_mechanism_is_refused_by_its_sample(variant):
    """Parallelograms without width let the platform turn."""
    robot, _ = variant("delta", members={"parallelogram_width": 1e-6})
    q = np.tile(robot.graph.home, (2, 1))
    with pytest.raises(SingularityError) as caught:
        platform_response(robot, q, np.zeros(6))
    assert caught.value.index == (0,)
    with pytest.raises(SingularityError):
        member_deflections(robot, q[0], np.zeros(6))


def test_other_numbers_take_the_same_program():
    """Lengths, moduli, diameters and compliances are inputs; what is rigid is not."""
    robot = load("upr_rpu")
    joints = {k: (np.multiply(3.0, v)).tolist() for k, v in parameters_of("upr_rpu")["joints_compliance"].items()}
    other = robot.changed(members={"diameter": [0.07, 0.08, 0.09]}, joints_compliance=joints)
    other = other.with_file_values({"geometry.base_radius": 1.03 * robot.geometry.base_radius})
    program = kernels(robot)[1].code
    assert kernels(other)[1].code is program
    joints["rpu_universal"][0] = 0.0
    assert kernels(robot.changed(joints_compliance=joints))[1].code is not program


def test_equal_limbs_tie_under_an_axial_load():
    robot = load("delta")
    found = strain_energy(robot, robot.home(), [0, 0, -10.0, 0, 0, 0])
    assert found.tie
    limbs = [k for k, name in enumerate(found.elements) if name.startswith("arm ")]
    assert found.factors[limbs] == pytest.approx(found.factors[limbs[0]], rel=1e-9)
