# SPDX-License-Identifier: Apache-2.0
"""Many machines at once give what each of them gives as a robot of its own file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, mass_matrix
from pkm_twin import Robot, variants
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.machine.entries import entries
from test.support.robots import every_robot, load

MACHINES = Path(__file__).resolve().parents[1] / "machine"
ASIDE = ("limits", "joint_map", "uncertainty", "member", "section", "compliance", "radius")
"""Words in paths of numbers that no program of these reads."""


def numbers_of(robot: Robot) -> dict[str, float]:
    """Numbers of geometry, masses and friction that are not zero."""
    found = {path: value for path, (value, _) in entries(robot).items() if value != 0.0}
    return {p: v for p, v in found.items() if not any(word in p for word in ASIDE)}


def motion(robot: Robot, rng, count):
    """Joint states near home."""
    units = np.array([robot.graph.size if u == "m" else 1.0 for u in robot.joint_units])
    q = robot.graph.home + 0.04 * rng.uniform(-1.0, 1.0, (count, robot.joints_count)) * units
    return q, *rng.normal(size=(2, count, robot.joints_count))


def judge(robot: Robot, numbers, rng, tolerance=1e-12):
    """Compare all that is asked of many with each machine by itself; how many could be built."""
    many = variants(robot, numbers)
    q, qd, qdd = motion(robot, rng, 5)
    wrench = rng.normal(size=6)
    tau, masses = many.inverse_dynamics(q, qd, qdd, wrench), many.mass_matrix(q)
    pose, (place, turn) = many.forward(q), many.platform(q)
    measure = many.singularity(q)
    built = 0
    for k in range(len(many)):
        try:
            own = many[k]
            expected = inverse_dynamics(own, q, qd, qdd, wrench)
        except PkmTwinError:
            assert np.isnan(tau[k]).any() and np.isnan(pose[k]).any()
            continue
        built += 1
        assert many.valid[k] and many.reason(k) == ""
        for found, own_value in (
            (tau[k], expected), (masses[k], mass_matrix(own, q)), (pose[k], own.forward(q)),
            (place[k], own.platform(q)[0]), (turn[k], own.platform(q)[1]),
            (measure[k], own.singularity(q)), (many.inverse(pose[k])[k], own.inverse(pose[k])),
        ):  # fmt: skip
            scale = max(1.0, np.abs(own_value).max())
            np.testing.assert_allclose(found, own_value, rtol=0, atol=tolerance * scale)
    return built


@every_robot
def test_variants_are_the_robots_of_their_files(name, rng):
    robot = load(name)
    known = numbers_of(robot)
    picked = rng.permutation([p for p in known if "inertia[" not in p and "axis" not in p])[:12]
    numbers = {p: known[p] * (1 + 0.2 * rng.uniform(-1, 1, 3)) for p in picked}
    assert judge(robot, numbers, rng) > 0 or "azimuth" in str(list(numbers))


@every_robot
def test_a_number_that_was_zero_goes_through_a_program_of_its_own(name, rng):
    """Places and axes that a program takes for zero: another structure, never a wrong answer."""
    robot = load(name)
    zeros = [
        path for path, (value, _) in entries(robot).items()
        if value == 0.0 and not any(word in path for word in ASIDE)
    ]  # fmt: skip
    for path in rng.permutation(zeros)[:4]:
        judge(robot, {path: np.array([0.0, 1e-3, -0.02])}, rng)


@pytest.mark.parametrize("name", ["five_bar", "stewart", "linear_delta", "rps3"])
def test_a_limbs_number_is_that_of_all_its_copies(name, rng):
    robot = load(name)
    paths = sorted({
        ".".join(map(str, source.path)) for source in robot.sources.values()
        if source.path[0] == "limbs" and source.path[-2] == "joints"
    })  # fmt: skip
    for path in paths[:3]:
        key = f"{path}.at[2]"
        try:
            value = robot.number(key)
        except ParameterError:
            continue
        assert judge(robot, {key: value + np.array([0.0, 0.01])}, rng) > 0
    mass = next(iter(p for p in numbers_of(robot) if p.endswith(".mass")))
    assert judge(robot, {mass: [0.5, 1.5], "payload.mass": [0.0, 0.7]}, rng) == 2


def test_each_machine_has_its_own_samples(rng):
    robot = load("delta")
    lengths = np.linspace(0.9, 1.1, 6) * robot.number("geometry.arm_length")
    many = variants(robot, {"geometry.arm_length": lengths, "inertia.platform_mass": 0.4})
    q, qd, qdd = motion(robot, rng, 6)
    alone = many.inverse_dynamics(q, qd, qdd)
    assert alone.shape == (6, 3)
    shared = many.inverse_dynamics(q[None], qd[None], qdd[None])
    assert shared.shape == (6, 6, 3)
    np.testing.assert_array_equal(alone, shared[np.arange(6), np.arange(6)])
    table = many.inverse_dynamics(np.broadcast_to(q, (6, 6, 3)), qd[None], qdd[None])
    np.testing.assert_array_equal(table, shared)


def test_a_machine_that_cannot_be_is_nan_and_says_why():
    robot = load("delta")
    arm = robot.number("geometry.arm_length")
    numbers = {"geometry.arm_length": [arm, -1.0, 50.0, np.nan], "payload.mass": [0.0, 0, 0, 0]}
    many = variants(robot, numbers)
    assert many.valid.tolist() == [True, False, False, False]
    assert not many.reason(0) and all(many.reason(k) for k in (1, 2, 3))
    tau = many.inverse_dynamics(robot.graph.home, np.zeros(3), np.zeros(3))
    assert np.isfinite(tau[0]).all() and np.isnan(tau[1:]).all()
    with pytest.raises(PkmTwinError):
        _ = many[1]


@pytest.mark.parametrize("path", ["geometry.arm", "geometry", "inertia.platform_mass[0]", "x.y"])
def test_a_path_that_there_is_not_is_rejected(path):
    with pytest.raises(ParameterError) as caught:
        variants(load("delta"), {path: [1.0, 2.0]})
    assert path in caught.value.field


def test_columns_of_several_lengths_are_rejected():
    with pytest.raises(ParameterError):
        variants(
            load("delta"), {"geometry.arm_length": [0.2, 0.3], "payload.mass": [0.1, 0.2, 0.3]}
        )
