# SPDX-License-Identifier: Apache-2.0
"""Slider forces against Pinocchio: a tree with loop constraints, a model of its own."""

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from test.support.robots import partly_long

pytest.importorskip("pinocchio")
from bags.recording.pinocchio_prru import PrruEngine
from tools.certificate.machines import random_case

MACHINES = 10
STATES = 200


@pytest.mark.parametrize("machine", partly_long(range(MACHINES), 0, 1, 2))
def test_forces_of_random_machines_and_states(machine):
    rng = np.random.default_rng((20240229, machine))
    case = random_case("prru", rng, STATES // MACHINES)
    got = inverse_dynamics(case.robot, case.q, case.qd, case.qdd, case.wrench)
    engine = PrruEngine(case.data)
    for k, load in enumerate(case.wrench):
        expected = engine.inverse_dynamics(case.q[k], case.qd[k], case.qdd[k], load)
        assert np.abs(got[k] - expected).max() < 1e-9 * np.abs(expected).max()
        pose = case.robot.forward(case.q[k])
        assert pose == pytest.approx(engine.pose(case.q[k]), abs=1e-10)
