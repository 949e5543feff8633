# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Machines of the gallery: plausible, shown on their page, and right by other engines."""

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin import load, variants
from pkm_twin.certify.certificate import certify_robot
from pkm_twin.machine.strict_yaml import read_yaml
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.outline import base_face, platform_face
from pkm_twin.robot.plausibility import find_implausible_numbers
from stiffness_monitor import compliance
from test.docs.test_docs import DOCS
from test.support.robots import partly_long
from tools.pages.robots import GALLERY, MACHINES, PICTURED

from .random_machines import written_out

pytestmark = pytest.mark.usefixtures("quickly_compiled")
NAMES = [path.name for path in GALLERY]
PAGE = (DOCS / "index.md").read_text(encoding="utf-8")
TABLE = (DOCS / "new_machine.md").read_text(encoding="utf-8")
TEMPLATES = [name for name in NAMES if f"`{name.removesuffix('.yaml')}`" in TABLE]


@pytest.mark.parametrize("name", NAMES)
def test_its_numbers_are_plausible_and_its_page_complete(name):
    robot = load(MACHINES / name)
    assert find_implausible_numbers(robot) == ()
    assert bool(robot.book.values) == (name in TEMPLATES)
    if MACHINES / name in PICTURED:
        picture = f"robot_{robot.name}.png"
        assert (DOCS / "gallery" / picture).stat().st_size and f"gallery/{picture}" in PAGE


@pytest.mark.parametrize("name", partly_long(TEMPLATES, "prs3.yaml"))
def test_each_number_of_a_template_moves_a_machine_that_assembles(name):
    robot = load(MACHINES / name)
    q = robot.inverse(robot.home())
    for parameter in robot.book.values.keys() - robot.book.own.keys():
        path = f"parameters.{parameter}"
        value = 1.01 * robot.number(path)
        made = robot.with_file_values({path: value})
        assert made.graph.key != robot.graph.key or (made.inertial != robot.inertial).any()
        state = made.project_redundant(q, q, 1.0 + q)
        expected = inverse_dynamics(made, *state)
        (found,) = variants(robot, {path: [value]}).inverse_dynamics(*state)
        np.testing.assert_allclose(found, expected, 0.0, 1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("name", TEMPLATES)
def test_its_expressions_are_those_of_python(name):
    robot, data = load(MACHINES / name), written_out(read_yaml(MACHINES / name))
    assert robot_of_data(data, "own").graph.key == robot.graph.key


@pytest.mark.parametrize("name", partly_long(NAMES, "delta_1130.yaml"))
def test_every_engine_agrees(name):
    """Of the Delta with its drives given as rotors and gears."""
    result = certify_robot(load(MACHINES / name), states=2)
    assert result.good, [item for item in result.items if not item.good]
    assert all("not installed" in reason for reason in result.missing.values())


@pytest.mark.parametrize("name", ["tricept.yaml", "delta_1130.yaml"])
def test_those_with_members_are_compliant(name):
    robot = load(MACHINES / name)
    found = compliance(robot, robot.home())
    assert (np.linalg.eigvalsh((found + found.T) / 2) > 0.0).all()


def test_the_large_delta_covers_its_circle():
    """What the head of the file claims."""
    robot, azimuth = load(MACHINES / "delta_1130.yaml"), np.linspace(0.0, 2 * np.pi, 37)
    for z in (-0.70, -0.85):
        circle = np.stack([0.565 * np.cos(azimuth), 0.565 * np.sin(azimuth), 0 * azimuth + z], -1)
        q = robot.inverse(circle)
        low, high = robot.limits.position.T
        assert (low < q).all() and (q < high).all()


def test_plates_are_convex_and_none_is_between_guides():
    tricept = load(MACHINES / "tricept.yaml").graph
    corners = base_face(tricept)  # the gimbal is amid the three feet
    assert np.linalg.norm(corners, axis=1) == pytest.approx([0.5] * 3)
    corners = platform_face(tricept)  # it slides through the gimbal, 1 m above
    assert corners[:, 2] == pytest.approx([-1.0] * 3)
