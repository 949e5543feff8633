# SPDX-License-Identifier: Apache-2.0
"""The tool point's frequency response against CalculiX's steady state dynamics."""

from __future__ import annotations

import numpy as np
import pytest

from pkm_twin.robot.catalogue import robot_of_data
from stiffness_monitor.structure import structural_model
from stiffness_monitor.vibration import frequency_response, tool_modes
from test.support.robots import parameters_of
from tools.calculix import ABSENT, CCX, harmonic

pytestmark = pytest.mark.skipif(CCX is None, reason=ABSENT)

DAMPING = 0.03
CLOSE = 0.02


def test_the_response_is_calculix_up_to_the_third_mode(tmp_path):
    """At frequencies that are apart as the natural ones are, which differ by up to 0.3 %."""
    data = parameters_of("delta_cu")
    for key in ("arm", "forearm", "rcu_forearm"):
        part = data["members"][key]
        part["shear_modulus"] = part["youngs_modulus"] / 2
    robot = robot_of_data(data, "delta_cu")
    pose = robot.forward([0.5, -0.2, 0.1])
    ours = tool_modes(robot, pose, damping=DAMPING).frequencies
    model = structural_model(robot, robot.inverse(pose))
    own, at, theirs = harmonic(model, DAMPING, 1.1 * ours[2], tmp_path, modes=16, divisions=4)
    same = np.interp(at, [0.0, *own[:4]], [0.0, *ours[:4]])
    found = frequency_response(robot, pose, same, damping=DAMPING)[:, :3, 0]
    apart = np.linalg.norm(found - theirs, axis=1) / np.linalg.norm(theirs, axis=1)
    assert apart.max() < CLOSE
    assert (np.abs(at[:, None] / own[:3] - 1.0).min(0) < 1e-6).all()
