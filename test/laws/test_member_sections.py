# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The section `members` of a robot file: tubes, what follows from their masses, what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import ParameterError
from stiffness_monitor.modes import has_modes, natural_frequencies
from stiffness_monitor.structure import structural_model
from test.support.robots import ELASTIC, load, parameters_of


@pytest.mark.parametrize(("name", "section"), [("delta", "members"), ("prru", "members"), ("upr_rpu", "inertia")])
def test_a_file_without_the_section_loads_and_is_refused_by_name(name, section, load_data):
    data = parameters_of(name)
    del data[section]
    robot = load_data(data)
    with pytest.raises(ParameterError) as caught:
        natural_frequencies(robot, robot.home())
    assert caught.value.field == section


def test_the_wall_of_a_tube_follows_from_its_mass():
    members = structural_model(load("delta_cu"), load("delta_cu").graph.home).parts
    inner = {m.name: m.section.inner_diameter for m in members}
    assert inner["arm I"] == pytest.approx(0.02732, abs=1e-5)
    assert inner["forearm II a"] == pytest.approx(0.01389, abs=1e-5)
    assert inner["forearm I"] == pytest.approx(0.01918, abs=1e-5)
    masses = [m.section.mass_per_length * np.linalg.norm(m.end - m.start) for m in members]
    assert sum(masses) == pytest.approx(3 * (0.2548 + 0.0771))


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"inner_diameter": 0.01}, "members.arm"),
        ({"density": 0.0}, "members.arm.density"),
        ({"outer_diameter": 0.0}, "members.arm.outer_diameter"),
        ({"youngs_modulus": 10.0}, "members.arm.youngs_modulus"),
        ({"wall": 0.01}, "members.arm.wall"),
    ],
)
def test_tubes_that_cannot_be_are_refused(changes, field, variant):
    members = parameters_of("delta")["members"]
    members["arm"] |= changes
    with pytest.raises(ParameterError) as caught:
        variant("delta", members=members)
    assert caught.value.field == field


def test_an_inner_diameter_can_stand_for_the_density(with_members):
    robot = load("delta")
    members = parameters_of("delta")["members"]
    del members["arm"]["density"]
    members["arm"]["inner_diameter"] = structural_model(robot, robot.graph.home).parts[0].section.inner_diameter
    other = with_members("delta", members)
    assert natural_frequencies(other, robot.home()) == pytest.approx(natural_frequencies(robot, robot.home()))
    members["arm"]["inner_diameter"] = 0.04
    with pytest.raises(ParameterError) as caught:
        with_members("delta", members)
    assert caught.value.field == "members.arm.inner_diameter"
    del members["arm"]["inner_diameter"]
    with pytest.raises(ParameterError) as caught:
        with_members("delta", members)
    assert caught.value.value == "neither"


def test_a_robot_whose_sections_do_not_fit_still_loads_and_has_no_modes(variant):
    """Its dynamics need none of them."""
    for name, changes, field in (
        ("delta", {"geometry": {"closures": ["rod", "rod", "rcu"]}}, "members.rcu_forearm"),
        ("delta", {"inertia": {"arm_mass": 3.0}}, "members.arm.density"),
        ("delta", {"inertia": {"forearm_mass": 0.0}}, "members.forearm"),
    ):
        robot, _ = variant(name, **changes)
        assert np.isfinite(inverse_dynamics(robot, np.zeros(3), np.zeros(3), np.ones(3))).all()
        assert not has_modes(robot)
        with pytest.raises(ParameterError) as caught:
            natural_frequencies(robot, robot.home())
        assert caught.value.field == field
    assert {"delta", "delta_cu", "prru", "upr_rpu"} <= set(ELASTIC)
