# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What docs/validation.md says in numbers is so: computed again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin import load
from stiffness_monitor import strain_energy
from stiffness_monitor.modes import natural_frequencies
from test.support.pages import assert_printed, numbers
from test.support.robots import parameters_of, partly_long
from test.validation import test_upr_rpu_paper as upr_rpu
from tools.papers import delta_cu

PAGE = "docs/validation.md"


class TestFrequenciesOfTheDeltaCu:
    robot = load("delta_cu")
    pose = robot.forward([delta_cu.HOME_ANGLE] * 3)

    def first(self, robot):
        return natural_frequencies(robot, self.pose, 1)[0]

    def across(self):
        """The same robot, the universal joint's second axis across its forearm."""
        robot = replace(self.robot, name="across")
        graph = self.robot.graph
        joint = graph.joints["platform joint I"]
        axis = np.cross(joint.axes[0], joint.at - graph.joints["elbow I"].at)
        turned = replace(joint, axes=np.array([joint.axes[0], axis / np.linalg.norm(axis)]))
        vars(robot)["graph"] = replace(graph, joints=graph.joints | {joint.name: turned})
        return robot

    def test_what_they_depend_on(self, variant):
        members = parameters_of("delta_cu")["members"]
        carbon = {k: members["forearm"][k] for k in ("youngs_modulus", "shear_modulus", "density")}
        rod, _ = variant("delta_cu", members={"rcu_forearm": members["rcu_forearm"] | carbon})
        found = delta_cu.find_modes("delta_cu").frequencies
        pattern = (
            r"here (\S+), (\S+), (\S+), (\S+), (\S+) and (\S+) Hz, .*? across the forearm the "
            r"first would be (\d+) Hz, with a rod of carbon (\d+) Hz"
        )
        assert_printed(PAGE, pattern, *found, self.first(self.across()), self.first(rod))


class TestTablesOfTheUprRpuPaper:
    def test_finite_elements(self):
        shares = []
        for pose, _, solid in upr_rpu.TABLE_1:
            found = 1e6 * strain_energy(upr_rpu.ROBOT, pose, upr_rpu.LOAD).deflection
            shares.append((np.array(solid) / found - 1)[np.abs(solid) > 10 * upr_rpu.UNIT])
        softer = 100 * np.concatenate(shares)
        pattern = r"finite elements are (\d+) to (\d+) % softer"
        assert_printed("docs/papers.md", pattern, softer.min(), softer.max())


@pytest.mark.parametrize("machine", partly_long(range(6), 0))
@pytest.mark.parametrize("name", partly_long(["delta", "delta_cu", "prru"], "delta_cu"))
def test_torques_of_random_machines(name, machine):
    """Some of the states that `make certificate` takes are within what the page says of all."""
    for library in ("mpmath", "mujoco", "pinocchio"):
        pytest.importorskip(library)
    from tools.certificate.compare import BALANCE_BOUNDS, PLACE_BOUND, ROUTES, compare
    from tools.certificate.machines import ROBOTS

    pattern = r"digits \(\d+ states\): worst relative difference (\S+)\. MuJoCo \(\d+ states\): (\S+)\. "
    worst, mujoco = numbers(PAGE, pattern)
    found = compare(name, (20261121, ROBOTS.index(name), machine), states=20, exact=2)
    for route in ROUTES:
        assert len(found.efforts[route]) == (20 if route == "Pinocchio" else 2)
        assert max(found.efforts[route]) < 2.0 * (mujoco if route == "MuJoCo" else worst), route
        assert max(found.places[route]) < PLACE_BOUND, route
    for what, bound in BALANCE_BOUNDS.items():
        assert max(found.balances[what]) < bound, what


class TestErrataOfTheDeltaCu:
    robot = load("delta_cu")
    q, qd, qdd = delta_cu.find_motion()
    velocity = delta_cu.read_numbers(delta_cu.TABLE_2)

    def test_the_sign_is_that_of_arm_one(self):
        rms = []
        for signs in (delta_cu.SIGNS, np.array([1.0, -1.0, 1.0])):
            q, qd, _ = delta_cu.find_motion(signs=signs)
            found = delta_cu.find_velocity(load("delta"), q, qd)
            rms.append(delta_cu.measure_difference(found, self.velocity)[0])
        assert_printed(PAGE, r"from table 2 by (\S+) instead of (\d+) mm/s rms", *rms)

    def test_a_digit_of_table_2_is_lost(self):
        found = delta_cu.find_velocity(self.robot, self.q, self.qd)
        source = self.velocity.copy()
        rms = [delta_cu.measure_difference(found, source)[0]]
        used, source[3, 2] = source[3, 2], -10.80
        rms.append(delta_cu.measure_difference(found, source)[0])
        source[3, 2] = -108.0
        rms.append(delta_cu.measure_difference(found, source)[0])
        pattern = (
            r"(-10\.80) mm/s; here (\S+) mm/s, a digit is lost: the model gives (\S+); "
            r"velocities differ by (\S+) instead of (\S+) mm/s rms.*? and -108.0 is meant: (\S+) "
        )
        assert_printed(PAGE, pattern, -10.80, used, found[3, 2], *rms)

    def test_two_digits_of_table_3_are_exchanged(self):
        found = delta_cu.find_acceleration(self.robot, self.q, self.qd, self.qdd)
        source = delta_cu.read_numbers(delta_cu.TABLE_3)
        rms = [delta_cu.measure_difference(found, source)[0]]
        used, source[4, 2] = source[4, 2], 17.20
        rms.append(delta_cu.measure_difference(found, source)[0])
        pattern = (
            r"(17\.20) mm/s2; here (\S+) mm/s2, two digits are exchanged: the model gives (\S+); "
            r"accelerations differ by (\S+) instead of (\S+) mm/s2 rms"
        )
        assert_printed(PAGE, pattern, 17.20, used, found[4, 2], *rms)

    def test_symmetry(self):
        """Of arms II and III in the tables, and of the platform's motion in arm I's plane."""
        efforts = inverse_dynamics(self.robot, self.q, self.qd, self.qdd, delta_cu.LOAD)
        np.testing.assert_allclose(efforts[:, 1], efforts[:, 2], atol=1e-11)
        _, second, third = delta_cu.find_printed_torques().T
        across = np.array([0.5, np.sqrt(0.75), 0.0])
        tables = delta_cu.TABLE_2, delta_cu.TABLE_3
        away = [np.abs(delta_cu.read_numbers(t) @ across).max() for t in tables]
        pattern = (
            r"differ by up to (\S+) N m; at t = 0 they give (\S+) and (\S+) N m, where `delta_cu` "
            r"gives (\S+) N m for both\. .* leave the plane by up to (\S+) mm/s and (\S+) mm/s2"
        )
        most = np.abs(second - third).max()
        assert_printed(PAGE, pattern, most, second[0], third[0], efforts[0, 1], *away)
