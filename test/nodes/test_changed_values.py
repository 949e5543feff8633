# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Values of the robot that change while a node runs."""

import warnings

import pytest

from pkm_twin.errors import RobotWarning
from test.support.robots import load

pytest.importorskip("rclpy", exc_type=ImportError)


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"gravity": [0.0, 0.0, -9810.0]}, "gravity 9810"),
        ({"payload.mass": 5000.0}, "payload 5000"),
        ({"gravity": [0.0, 0.0, -1.62], "payload.mass": 0.1, "friction.coulomb": [0.1, 0.1]}, None),
    ],
)
def test_an_implausible_value_is_named_as_in_a_file(values, named):
    from delta_dynamics.nodes.parameters import change_robot

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        made = change_robot(load("five_bar"), values)
    assert list(made.gravity) == values.get("gravity", [0.0, 0.0, -9.81])
    about = [str(one.message) for one in told if one.category is RobotWarning]
    assert about == [] if named is None else len(about) == 1 and named in about[0]
