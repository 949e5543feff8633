# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Deviations of torques and compliance, against machines drawn at random; a stream's noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, mass_matrix, torque_deviation
from delta_dynamics.torques.derivatives import torque_effects
from delta_dynamics.torques.uncertainty import NOISE_AVERAGING_TIME, Noise, effort_parts
from pkm_twin import Robot, variants
from pkm_twin.codegen.arrays import Array
from pkm_twin.design.variants import Variants
from pkm_twin.errors import ParameterError
from pkm_twin.machine.places import drop_missing
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.derivatives import position_errors_by_source
from stiffness_monitor import compliance, compliance_deviation, strain_energy
from stiffness_monitor.derivatives import compliance_effects, energy_effects
from test.support.robots import joint_range, load, massive, random_joints, unsure

DELTA = {
    "inertia.platform_mass": {"deviation": 0.01},
    "inertia.arm_mass": {"deviation": 0.005},
    "friction": {"relative": 0.1},
    "gravity[2]": {"deviation": 0.05},
}
FULL = ((120, 0.25), (10_000, 0.03))
"""Draws, and by how much the spread may differ from what is said."""
HEAD = {"members.youngs_modulus": {"relative": 0.02}, "joints_compliance": {"relative": 0.04}}


def drawn(robot: Robot, count: int) -> Variants:
    """Machines that the file allows, every cause by a normal deviate of its own."""
    rng = np.random.default_rng(2)
    known = {path: value for path, (value, _) in robot.file_numbers().items()}
    values = {}
    for name, entry in robot.uncertainty.items():
        deviate = rng.normal(size=count)
        for path, value in known.items():
            if path == name or path.startswith((f"{name}.", f"{name}[")):
                if entry.deviation is None:
                    values[path] = value * (1.0 + deviate * entry.relative)
                else:
                    values[path] = value + deviate * entry.deviation
    return variants(robot, values)


def delta() -> tuple[Robot, Array, Array, Array]:
    friction = {"viscous": [0.05, 0.06, 0.07], "coulomb": [0.1, 0.2, 0.1]}
    robot = unsure(load("delta_cu").changed(friction=friction), DELTA)
    middle, half = joint_range(robot)
    rng = np.random.default_rng(4)
    return robot, middle + 0.5 * half * rng.uniform(-1, 1, (5, 3)), *rng.normal(size=(2, 5, 3))


def check(count: int, tolerance: float) -> None:
    """Of a standard deviation over k draws the relative error is 1 / sqrt(2 k)."""
    robot, q, qd, qdd = delta()
    found = torque_deviation(robot, q, qd, qdd)
    expected = np.std(drawn(robot, count).inverse_dynamics(q, qd, qdd), axis=0)
    np.testing.assert_allclose(found, expected, rtol=tolerance)
    head = unsure(load("upr_rpu"), HEAD)
    pose = [-0.6, 0.1, 0.05]
    found = compliance_deviation(head, pose)
    expected = np.std(drawn(head, count).compliance(pose), axis=0)
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=1e-3 * expected.max())


@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    ("count", "tolerance"),
    [(24, 0.5), *(pytest.param(*case, marks=pytest.mark.long) for case in FULL)],
)
def test_random_machines_spread_as_is_said(count: int, tolerance: float) -> None:
    check(count, tolerance)


def test_effects_are_differences_of_machines_with_other_numbers() -> None:
    geometry = {"geometry.arm_length": {"deviation": 1e-4}, "inertia": {"relative": 0.1}}
    robot = unsure(load("delta"), {**geometry, "members": {"relative": 0.02}})
    q, still = robot.graph.home + np.array([0.1, -0.1, 0.2]), np.ones(3)
    loads = np.diag(np.repeat([1.0, 5.0], 3))
    pose = robot.forward(q)

    def effect(cause: dict[str, float], call: Callable[[Robot], Array]) -> Array:
        low, high = (
            robot.with_file_values({p: robot.number(p) + step * d for p, d in cause.items()}) for step in (-0.01, 0.01)
        )
        return (call(high) - call(low)) / 0.02

    for found, call in (
        (position_errors_by_source(robot, q), lambda r: r.platform(q)[0]),
        (torque_effects(robot, q, still, still, loads[0]), lambda r: inverse_dynamics(r, q, still, still, loads[0])),
        (compliance_effects(robot, pose), lambda r: compliance(r, pose)),
        (energy_effects(robot, pose, loads), lambda r: strain_energy(r, pose, loads).energies),
    ):
        expected = np.stack([effect(cause, call) for cause in robot.uncertainty_changes.values()], -1)
        assert expected.any()
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["delta", "five_bar"])
def test_a_drive_s_friction_is_unsure_by_its_place(name: str) -> None:
    robot = load(name).changed(uncertainty={"friction.viscous[1]": {"deviation": 0.1}})
    rate = np.linspace(1.0, 2.0, robot.joints_count)
    found = torque_deviation(robot, robot.graph.home, rate, rate)
    np.testing.assert_allclose(found, np.where(np.arange(len(rate)) == 1, 0.1 * rate, 0.0))


def test_a_file_that_names_none_is_sure() -> None:
    robot = load("delta")
    q = robot.inverse(robot.home())
    np.testing.assert_array_equal(torque_deviation(robot, q, q, q), 0.0)


def test_what_scales_all_scales_the_answer() -> None:
    """All that is elastic softer by a share: the compliance by the same."""
    head = unsure(load("upr_rpu"), {"joints_compliance": {"relative": 0.05}})
    pose = head.home()
    part = compliance_deviation(head, pose)
    other = unsure(load("upr_rpu"), {"members": {"relative": 0.05}})
    whole = compliance_deviation(other, pose)
    assert 0.0 < np.trace(part) < 0.05 * np.trace(compliance(head, pose)) * 1.001
    assert np.trace(whole) > 0.0


@pytest.mark.parametrize(
    ("entry", "text"),
    [
        ({"inertia.mass": {"deviation": 0.1}}, r"uncertainty\.inertia\.mass"),
        ({"inertia": {"deviation": 0.1}}, "names several numbers"),
        ({"inertia.arm_mass": {}}, "expected either"),
        ({"inertia.arm_mass": {"deviation": -1.0}}, "0 or more"),
        ({"inertia.arm_mass": {"relative": 1.5}}, "0 to 1"),
        ({"uncertainty": {"relative": 0.5}}, r"uncertainty\.uncertainty"),
    ],
)
def test_what_is_no_number_of_the_file_is_refused(entry: dict[str, Any], text: str) -> None:
    with pytest.raises(ParameterError, match=text):
        unsure(load("delta_cu"), entry)


def test_a_machine_keeps_what_its_file_says_beside_its_graph() -> None:
    robot = unsure(load("five_bar"), {"gravity": {"relative": 0.02}})
    joint = robot.joint_names[0]
    data = {**drop_missing(robot.parameter_sections()), "mechanism": "machine"}
    mapped = robot_of_data({**data, "joint_map": {joint: {"offset": 0.1}}}, "mine")
    again = mapped.with_file_values({"origin[2]": mapped.file_numbers()["origin[2]"][0]})
    assert again.controller.offsets[0] == 0.1
    q = again.inverse(again.home())
    still = np.zeros_like(q)
    share = torque_deviation(again, q, still, still) / np.abs(inverse_dynamics(again, q, still, still))
    np.testing.assert_allclose(share, 0.02, rtol=1e-6)


@massive
def test_efforts_by_what_needs_them_are_those_of_the_whole_motion(name, rng):
    robot = load(name)
    q = random_joints(robot, rng, 5)
    qd, qdd, wrench = (rng.normal(size=(5, n)) for n in (*(2 * q.shape[1:]), 6))
    for one in zip(q, qd, qdd, wrench, strict=True):
        parts = effort_parts(robot, *one, mass_matrix(robot, one[0]))
        whole = inverse_dynamics(robot, *one)
        np.testing.assert_allclose(parts.whole, whole, rtol=1e-12, atol=1e-12 * np.abs(whole).max())


STEP = 1e-3


def learnt(errors: np.ndarray, learning: float = 0.2, clipped: float = 9.0) -> Noise:
    noise = Noise(np.zeros(errors.shape[1]), learning, clipped)
    for error in errors:
        noise.advance(STEP)
        noise.learn(error, 0.0)
    return noise


def test_the_variance_is_that_of_the_errors() -> None:
    rng = np.random.default_rng(1)
    noise = learnt(rng.normal(size=(4000, 3)) * [0.1, 1.0, 10.0])
    np.testing.assert_allclose(np.sqrt(noise.variance), [0.1, 1.0, 10.0], rtol=0.1)
    assert noise.settled


def test_what_stands_out_is_clipped_once_it_is_settled() -> None:
    """A push of hundred deviations for a tenth of a second makes little of it noise."""
    rng = np.random.default_rng(2)
    noise = learnt(rng.normal(size=(2000, 1)))
    for _ in range(100):
        noise.advance(STEP)
        noise.learn(np.array([100.0]), 0.0)
    # Each counts as at most nine times the average, over a second.
    assert noise.variance[0] < 1.3 * np.exp(8.0 * 100 * STEP / NOISE_AVERAGING_TIME)
    # Before, all is noise.
    assert learnt(np.full((100, 1), 100.0)).variance[0] == pytest.approx(1e4)


def test_it_is_settled_after_its_time_and_never_below_the_least() -> None:
    noise = Noise(np.zeros(2), 0.2, 9.0)
    told = []
    for _ in range(300):
        noise.advance(STEP)
        noise.learn(np.zeros(2), 0.25)
        told.append(noise.settled)
    assert told.index(True) == pytest.approx(0.2 / STEP, abs=1)
    np.testing.assert_array_equal(noise.variance, 0.25)
