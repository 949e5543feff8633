# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Natural frequencies and a response against CalculiX, whose beams are solids with a round hole.

CalculiX expands a B32R beam into quadratic bricks: no beam theory, no shear factor, another mass
matrix and another solver. One brick spans the whole section, which cannot warp as a thin tube's
does, so shear comes out too stiff: nothing for metals, 1.6 % in frequency for carbon rods whose
Young's modulus is 24 times the shear modulus. The comparison is made with isotropic materials
without lateral contraction, which clamped sections would hinder.
"""

from __future__ import annotations

import numpy as np
import pytest

from stiffness_monitor.modes import natural_frequencies
from stiffness_monitor.structure import structural_model
from stiffness_monitor.vibration import frequency_response, tool_modes
from test.support.pages import numbers
from test.support.robots import parameters_of, partly_long
from tools.calculix import ABSENT, CCX, frequencies, harmonic

CLOSE, CONTRACTED = numbers(
    "docs/validation.md",
    r"isotropic: within (\S+) % with a Poisson's ratio of 0, (\S+) % with 0.3",
)

ANGLES = [(0.22, 0.22, 0.22), (0.5, -0.2, 0.1), (0.0, 0.6, 0.3)]

pytestmark = pytest.mark.skipif(CCX is None, reason=ABSENT)


@pytest.fixture
def isotropic(variant):
    """A shipped robot with its moduli for a Poisson's ratio."""

    def make(name, poisson):
        members = parameters_of(name)["members"]
        for key in ("arm", "forearm", "rcu_forearm"):
            if key in members:
                members[key]["shear_modulus"] = members[key]["youngs_modulus"] / (2 + 2 * poisson)
        return variant(name, members=members)[0]

    return make


@pytest.mark.parametrize("angles", partly_long(ANGLES, ANGLES[1]))
@pytest.mark.parametrize("name", ["delta", "delta_cu"])
def test_first_six_frequencies_of_the_robot(name, angles, isotropic, tmp_path):
    robot = isotropic(name, 0.0)
    pose = robot.forward(angles)
    ours = natural_frequencies(robot, pose, elements=8)
    theirs = frequencies(structural_model(robot, robot.inverse(pose)), 6, tmp_path)
    # CalculiX is the higher. pytest -rP shows the figure that the README has.
    print(f"{name}: frequencies differ by {100 * np.abs(ours / theirs - 1).max():.2f} % at most")
    assert ours == pytest.approx(theirs, rel=CLOSE / 100)


def test_lateral_contraction_moves_them_by_less_than_the_rest(isotropic, tmp_path):
    robot = isotropic("delta_cu", 0.3)
    pose = robot.forward([0.22] * 3)
    ours = natural_frequencies(robot, pose, elements=8)
    theirs = frequencies(structural_model(robot, robot.inverse(pose)), 6, tmp_path)
    assert ours == pytest.approx(theirs, rel=CONTRACTED / 100)


def test_the_deck_tells_other_robots_apart(isotropic, tmp_path):
    """The comparison sees what it should: a rod on ball joints in place of the R-C-U limb."""
    robot, other = isotropic("delta_cu", 0.0), isotropic("delta", 0.0)
    pose = robot.forward([0.22] * 3)
    ours = natural_frequencies(other, pose, elements=8)
    assert np.abs(ours / frequencies(structural_model(robot, robot.inverse(pose)), 6, tmp_path) - 1).max() > 0.5


def test_the_tool_s_response_is_calculix_up_to_the_third_mode(isotropic, tmp_path):
    """At frequencies that are apart as the natural ones are, which differ by up to 0.3 %."""
    robot, damping = isotropic("delta_cu", 0.0), 0.03
    pose = robot.forward([0.5, -0.2, 0.1])
    ours = tool_modes(robot, pose, damping=damping).frequencies
    model = structural_model(robot, robot.inverse(pose))
    own, at, theirs = harmonic(model, damping, 1.1 * ours[2], tmp_path, modes=16, divisions=4)
    same = np.interp(at, [0.0, *own[:4]], [0.0, *ours[:4]])
    found = frequency_response(robot, pose, same, damping=damping)[:, :3, 0]
    apart = np.linalg.norm(found - theirs, axis=1) / np.linalg.norm(theirs, axis=1)
    assert apart.max() < 0.02
    assert (np.abs(at[:, None] / own[:3] - 1.0).min(0) < 1e-6).all()
