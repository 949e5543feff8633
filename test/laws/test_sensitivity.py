# SPDX-License-Identifier: Apache-2.0
"""How the platform moves with the geometry: against machines of another geometry."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pkm_twin import Robot
from pkm_twin.apps.calibration import geometric
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.maximal import GraphChange, Placement, assembled
from pkm_twin.kinematics.sensitivity import platform_twists
from pkm_twin.machine.entries import changed_graph, entries, put, with_entries
from test.support.robots import joint_range, load

Array = NDArray[np.float64]

STEP = 1e-5
SAMPLES = [
    ("delta_cu", "geometry.forearm_length"),
    ("prru", "geometry.azimuths[0]"),
    ("upr_rpu", "geometry.base_radius"),
    ("five_bar", "joints.left.home"),
    ("five_bar", "joints.elbow_right.at[2]"),
]
"""A number of every kind: lengths, azimuths, home values, points."""
LONG = [
    ("delta_cu", "geometry.azimuths[1]"),
    ("prru", "geometry.platform_radius"),
    ("five_bar", "origin[2]"),
    ("stewart", "joints.leg_a_1.home"),
    ("stewart", "joints.ball_a_1.at[1]"),
    ("stewart", "joints.foot_b_2.at[0]"),
    ("rps3", "joints.ball_1.at[2]"),
    ("rps3", "joints.hinge_1.axis[0]"),
    ("linear_delta", "joints.rail_1.axis[0]"),
    ("linear_delta", "rods.left_1.ends[0][0]"),
]
"""More of them."""
MORE = [*SAMPLES[1:-1], *LONG]


def difference(robot: Robot, path: str, q: Array) -> Array:
    """Displacement by machines whose number is a little smaller and greater, shape (..., 6)."""
    value = entries(robot)[path][0]
    low, high = (with_entries(robot, {path: value + s * STEP}) for s in (-1, 1))
    (p0, r0), (p1, r1) = low.platform(q), high.platform(q)
    turn = (r1 - r0) @ np.swapaxes(robot.platform(q)[1], -1, -2)
    turned = [turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]]
    return np.concatenate((p1 - p0, np.stack(turned, -1)), -1) / (2 * STEP)


def change(robot: Robot, path: str) -> GraphChange:
    value = entries(robot)[path][0]
    graphs = [changed_graph(robot, path, value + s * STEP) for s in (-1, 1)]
    return GraphChange.between(*graphs, 2 * STEP)


def check(name: str, path: str) -> None:
    """A number's derivative beside two machines."""
    robot = load(name)
    middle, half = joint_range(robot)
    rng = np.random.default_rng(1)
    q = middle + half * rng.uniform(-0.6, 0.6, (6, len(middle)))
    expected = difference(robot, path, q)
    assert np.abs(expected).max() > 1e-3
    changes = [change(robot, path)]
    found, possible = platform_twists(robot.graph, q, Placement.of(robot, q), changes)
    assert possible.all()
    np.testing.assert_allclose(found[..., 0], expected, atol=3e-8)


@pytest.mark.parametrize(("name", "path"), SAMPLES)
def test_the_derivative_is_that_of_machines_of_another_geometry(name: str, path: str) -> None:
    check(name, path)


@pytest.mark.long
@pytest.mark.parametrize(("name", "path"), LONG)
def test_it_is_so_for_every_kind_of_number(name: str, path: str) -> None:
    check(name, path)


@pytest.mark.parametrize(
    ("name", "path"),
    [SAMPLES[0], SAMPLES[-1], *(pytest.param(*s, marks=pytest.mark.long) for s in MORE)],
)
def test_a_graph_with_another_number_is_assembled_as_that_machine(name: str, path: str) -> None:
    """The same place of the platform as of the loaded machine, which is another engine."""
    robot = load(name)
    middle, half = joint_range(robot)
    q = middle + half * np.random.default_rng(2).uniform(-0.6, 0.6, (6, len(middle)))
    value = entries(robot)[path][0] + 3e-3
    graph = changed_graph(robot, path, value)
    far = q + 1e-2 * half
    placement = assembled(graph, far, Placement.of(robot, q))
    position, rotation = with_entries(robot, {path: value}).platform(far)
    place = placement.point(graph.platform, graph.origin)
    np.testing.assert_allclose(place, position, atol=1e-13)
    np.testing.assert_allclose(placement.rotation[graph.platform], rotation, atol=1e-12)


def test_what_cannot_be_assembled_is_refused() -> None:
    robot = load("five_bar")
    q = robot.graph.home[None]
    graph = changed_graph(robot, "joints.elbow_right.at[2]", 0.3)
    with pytest.raises(ParameterError, match="can be assembled"):
        assembled(graph, q + np.array([1.2, -1.2]), Placement.of(robot, q))


def test_joints_move_the_platform_by_its_jacobian() -> None:
    for name in ("delta_cu", "five_bar"):
        robot = load(name)
        middle, half = joint_range(robot)
        q = middle + 0.3 * half
        changes = [GraphChange.of_joint(robot.graph, joint) for joint in robot.joint_names]
        found, possible = platform_twists(robot.graph, q, Placement.of(robot, q), changes)
        assert possible.all()
        np.testing.assert_allclose(found, robot.platform_jacobian(q), atol=1e-12)


def test_numbers_that_an_overconstrained_machine_cannot_change_are_none_of_its_geometry() -> None:
    robot = load("five_bar")
    middle, half = joint_range(robot)
    q = middle + half * np.random.default_rng(3).uniform(-0.6, 0.6, (10, 2))
    found = geometric(robot, q)
    assert "joints.tip.at[0]" in found
    # Tilted axes jam it; along its axes it may be put together anywhere.
    assert not any(".axis" in path or path.endswith("at[1]") for path in found)


def test_masses_change_no_geometry() -> None:
    assert change(load("delta_cu"), "inertia.arm_mass").nothing(1e-12)
    assert not change(load("delta_cu"), "geometry.arm_length").nothing(1e-12)


def test_a_path_that_there_is_not_is_named() -> None:
    with pytest.raises(ParameterError, match=r"geometry\.arm_lenght"):
        put({"geometry": {"arm_length": 1.0}}, "geometry.arm_lenght", 2.0)
