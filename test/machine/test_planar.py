# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A planar joint: a puck on a table that an arm of three motors pushes."""

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, mass_matrix
from pkm_twin.errors import ParameterError
from pkm_twin.machine.joints import UNIT_VECTORS, Freedom, name_single_freedoms
from pkm_twin.mechanisms.catalogue import load, robot_of_data
from pkm_twin.robot.robot_urdf import robot_urdf

AT = [0.4, 0.1, 0.02]


def turning(inner, outer, at, **more):
    return {"type": "revolute", "between": [inner, outer], "at": at, "axis": [0, 0, 1], **more}


def body(mass, com):
    return {"mass": mass, "com": com, "inertia": [1e-3, 2e-3, 1.5e-3]}


def puck(table, elbow=True):
    """Whether the table is a joint, and whether the second motor is at the elbow."""
    joints = {
        "first": turning("base", "arm", [0, 0, 0], actuated=True),
        "second": turning("arm", "fore", [0.15, 0.25, 0], actuated=elbow),
        "third": turning("fore", "puck", AT, actuated=True),
    }
    if table:
        joints["table"] = {
            "type": "planar",
            "between": ["base", "puck"],
            "at": [0.38, 0.1, 0.03],
            "axis": [0, 0, 1],
        }
    bodies = {
        "arm": body(0.6, [0.1, 0.02, 0]),
        "fore": body(0.4, [0.3, 0.06, 0.01]),
        "puck": body(1.1, [0.42, 0.09, 0.05]),
    }
    data = {"mechanism": "machine", "platform": "puck", "pose": ["x", "y", "yaw"]}
    return robot_of_data({**data, "bodies": bodies, "joints": joints}, "puck")


@pytest.fixture
def motion(rng):
    return rng.uniform(-0.4, 0.4, (20, 3)), *rng.normal(size=(2, 20, 3)), rng.normal(size=(20, 6))


def test_a_table_carries_what_the_arm_need_not(motion):
    free, held = puck(table=False), puck(table=True)
    np.testing.assert_allclose(held.forward(motion[0]), free.forward(motion[0]), atol=1e-14)
    np.testing.assert_allclose(mass_matrix(held, motion[0]), mass_matrix(free, motion[0]))
    np.testing.assert_allclose(inverse_dynamics(held, *motion), inverse_dynamics(free, *motion))
    assert held.engine.mobility.redundant == free.engine.mobility.redundant + 3


def test_it_is_the_same_from_its_urdf(tmp_path, motion):
    path = tmp_path / "puck.urdf"
    path.write_text(robot_urdf(puck(table=True)))
    np.testing.assert_allclose(
        inverse_dynamics(load(path), *motion),
        inverse_dynamics(puck(table=True), *motion),
        1e-9,
        1e-10,
    )


def test_a_tree_of_planar_joints_has_three_freedoms_each():
    with pytest.raises(ParameterError):
        puck(table=True, elbow=False)


@pytest.mark.parametrize("count", range(7))
def test_a_type_of_joint_may_have_any_number_of_freedoms(count):
    assert len(set(name_single_freedoms("touch", [Freedom(UNIT_VECTORS[0])] * count))) == count
