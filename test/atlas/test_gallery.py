# SPDX-License-Identifier: Apache-2.0
"""What docs/gallery.md says in numbers is so."""

from __future__ import annotations

import numpy as np
import pytest

from delta_dynamics import energy_transfer_range, max_driving_force_range, tilted_pose
from test.support.pages import numbers
from test.support.robots import load

PAGE = "docs/gallery.md"
AZIMUTHS = np.radians(np.arange(0, 360, 30))


def poses(robot, degrees):
    height = robot.home()[robot.pose_names.index("z")]
    return tilted_pose(height, AZIMUTHS, np.radians(degrees))


def test_the_range_of_eta_repeats_and_that_of_force_does_not():
    robot = load("prru")
    tilt, first, other = numbers(
        PAGE,
        r"at a tilt of (\S+) degrees its greatest value is (\S+) N at azimuth 0 and (\S+) N at 120 "
        "and 240 degrees",
    )
    third = len(AZIMUTHS) // 3
    eta = energy_transfer_range(robot, poses(robot, tilt))
    for values in (eta.least, eta.greatest):
        assert np.roll(values, third) == pytest.approx(values, rel=1e-9)
    force = max_driving_force_range(robot, poses(robot, tilt)).greatest
    assert force[0] == pytest.approx(first, abs=0.05)
    assert force[third] == pytest.approx(other, abs=0.05)
    assert force[2 * third] == pytest.approx(other, abs=0.05)


def test_the_spread_of_eta_falls_before_it_grows():
    robot = load("prru")
    least, most, tilt = numbers(PAGE, r"falls by (\S+) to (\S+) % up to a tilt of (\S+) degrees")
    upright, there, beyond = (
        energy_transfer_range(robot, poses(robot, degrees)).spread for degrees in (0, tilt, 45)
    )
    falls = 100 * (1 - there / upright)
    assert falls.min() == pytest.approx(least, abs=0.5)
    assert falls.max() == pytest.approx(most, abs=0.5)
    assert (beyond > upright).all()
