# SPDX-License-Identifier: Apache-2.0
"""Torques, power and energy against Euler and Lagrange's equations in 50 digits, a few states.

`make certificate` does the same over many machines.
"""

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from delta_dynamics.torques.virtual_work import energy
from test.support.robots import partly_long

pytest.importorskip("mpmath")
from tools.certificate.lagrange_machines import energies
from tools.certificate.machines import ROBOTS, friction, random_case


@pytest.mark.parametrize("machine", partly_long(range(3), 0))
@pytest.mark.parametrize("name", ROBOTS)
def test_torques_and_power_follow_from_the_energies(name, machine):
    rng = np.random.default_rng((7, ROBOTS.index(name), machine))
    case = random_case(name, rng, 2)
    tau = inverse_dynamics(case.robot, case.q, case.qd, case.qdd, case.wrench)
    tau -= friction(case.data, case.qd)
    total = energy(case.robot, case.q, case.qd).total
    source = energies(case.data)
    for k, load in enumerate(case.wrench):
        result = source.solve(case.q[k], case.qd[k], case.qdd[k], load)
        scale = np.abs(result.effort).max()
        assert np.abs(tau[k] - result.effort).max() < 1e-11 * scale
        power = tau[k] @ case.qd[k] + result.wrench_power
        assert abs(power - result.energy_rate) < 1e-11 * scale * np.abs(case.qd[k]).sum()
        assert total[k] == pytest.approx(result.energy, rel=1e-10, abs=1e-10)
