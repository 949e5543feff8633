# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Mass matrix and accelerations at a pose are those of Pinocchio and MuJoCo."""

from __future__ import annotations

import numpy as np
import pytest

from delta_dynamics import forward_dynamics_at_pose, mass_matrix_at_pose
from pkm_twin.certify.maximal import Maximal, random_states
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.machine.random_machines import plain, variant
from test.machine.test_moving_base import ENGINES, engine
from test.support.robots import load, partly_long

BOUND = 1e-9
"""Of differences, relative to the largest entry."""
pytestmark = pytest.mark.usefixtures("quickly_compiled")


@pytest.mark.parametrize("name", partly_long(["stewart", "rps3", "upr_rpu", "delta_rcu", "rrr3_spherical"], "stewart"))
@pytest.mark.parametrize("judge", ENGINES)
def test_mass_matrix_and_accelerations_at_a_pose_are_those_of_engines(name, judge):
    """Of random masses, friction and gravity, but for the shipped hexapod."""
    rng = np.random.default_rng(7)
    description = plain(name) if name == "stewart" else variant(name, rng)
    robot = load(name) if name == "stewart" else robot_of_data(description, "machine")
    own, judged = random_states(Maximal(description), rng, 2), engine(judge)(description)
    pose = robot.forward(own.q)
    mass = mass_matrix_at_pose(robot, pose)
    rate = np.einsum("kij,kj->ki", robot.jacobian(own.q), own.qd)
    tau = rng.normal(size=own.q.shape) * np.abs(np.diagonal(mass, axis1=1, axis2=2))
    found = forward_dynamics_at_pose(robot, pose, rate, tau, own.wrench)
    n, still = robot.joints_count, np.zeros(robot.joints_count)
    for k, (q, qd) in enumerate(zip(own.q, own.qd, strict=True)):
        given = judged.inverse_dynamics(q, qd, found.qdd[k], own.wrench[k])
        rest = judged.inverse_dynamics(q, qd, still, own.wrench[k])
        np.testing.assert_allclose(given, tau[k], atol=BOUND * np.abs([*given, *rest]).max())
        columns = [judged.inverse_dynamics(q, still, unit, np.zeros(6)) for unit in np.eye(n)]
        matrix = np.transpose(columns) - judged.inverse_dynamics(q, still, still, np.zeros(6))[:, None]
        np.testing.assert_allclose(mass[k], matrix, atol=BOUND * np.abs(matrix).max())
