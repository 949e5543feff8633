# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Designed trajectories keep to their limits between the states that the design looks at."""

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.identification.excitation import Judge, TrajectoryLimits, optimize_excitation
from pkm_twin.identification.parameters import file_parameters
from test.support.robots import load


@pytest.mark.parametrize(
    ("name", "duration", "terms"),
    [
        ("delta_cu", 600.0, 6),
        ("five_bar", 97.0, 30),
        pytest.param("five_bar", 600.0, 50, marks=pytest.mark.long),
        pytest.param("stewart", 120.0, 10, marks=pytest.mark.long),
    ],
)
def test_limits_hold_at_any_time_of_a_long_trajectory(name, duration, terms):
    robot, rng = load(name), np.random.default_rng(3)
    judge = Judge.from_robot(robot, file_parameters(robot, ("friction", "payload")))
    # All of the limits: what is beyond them between the states shows.
    bounds = TrajectoryLimits(share=1.0, acceleration=20.0)
    found = optimize_excitation(judge, duration, terms, bounds, trials=12)
    time = np.sort(rng.uniform(0.0, duration, 40 * round(found.harmonics[-1])))
    q, qd, qdd = found.at(time)
    low, high = robot.limits.position.T
    assert (q >= low).all() and (q <= high).all()
    assert (np.abs(qd) <= robot.limits.velocity).all()
    assert (np.abs(qdd) <= 20.0).all()
    assert (robot.singularity(q) > bounds.singularity * 0.99).all()
    efforts = inverse_dynamics(robot, q, qd, qdd)
    assert (np.abs(efforts) <= robot.limits.effort).all()
    # Some limit, or the workspace, is what stops it from being larger.
    half = (high - low) / 2
    assert (np.abs(q - low - half) / half).max() > 0.3


def test_harmonics_need_points_to_show_them():
    robot = load("five_bar")
    judge = Judge.from_robot(robot, file_parameters(robot, ("friction",)))
    with pytest.raises(PkmTwinError, match="50 harmonics in 2 s reach 25 Hz"):
        optimize_excitation(judge, 2.0, 50, TrajectoryLimits(rate=100.0))
    for rate in (10.0, 100.0):
        found = optimize_excitation(judge, 30.0, 6, TrajectoryLimits(rate=rate), trials=10)
        assert found.harmonics[-1] / found.duration <= rate / 10.0


@pytest.mark.parametrize("acceleration", [0.0, -1.0, np.nan, np.inf, 1e300])
def test_an_acceleration_is_a_machines_or_rejected(acceleration):
    with pytest.raises(ParameterError) as error:
        TrajectoryLimits(acceleration=acceleration)
    assert error.value.field == "acceleration"
