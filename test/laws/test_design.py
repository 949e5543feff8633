# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Design for a path: gradients against differences, optima against grids of machines."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, inverse_dynamics_at_pose
from pkm_twin import variants
from pkm_twin.design import PosePath, design, sweep
from pkm_twin.design.pose_path import PathMotion
from pkm_twin.design.quantities import QUANTITIES
from pkm_twin.errors import ParameterError, PkmTwinError, UnknownNameError
from pkm_twin.paths import cycle, timed
from test.laws.test_derivatives import POINTS, WEIGHTS
from test.support.robots import load, parameters_of, partly_long

NUMBERS = {
    "delta": ["geometry.arm_length", "geometry.forearm_length", "inertia.platform_mass"],
    "delta_cu": ["geometry.arm_length", "geometry.base_radius"],
    "stewart": ["limbs.joints.foot_a.at[0]", "joints.ball_b_2.at[1]", "bodies.platform.mass"],
}
RRR4 = "examples/machines/rrr4_planar.yaml"
BOX = {"geometry.arm_length": (0.1, 0.4), "geometry.forearm_length": (0.25, 0.7)}


def wave(name, samples=7):
    """A path near home that stops nowhere, with a wrench."""
    robot, rng = load(name), np.random.default_rng(3)
    units = np.array([robot.graph.size if u == "m" else 1.0 for u in robot.joint_units])
    time, n = np.linspace(0.0, 0.4, samples), robot.joints_count
    phase, speed = rng.uniform(0.0, 6.0, n), 9.0
    angle = speed * time[:, None] + phase
    q = robot.graph.home + 0.02 * units * np.sin(angle) + 0.01 * units
    qd, qdd = 0.02 * units * speed * np.cos(angle), -0.02 * units * speed**2 * np.sin(angle)
    return (
        robot,
        (time, q, qd, qdd),
        PosePath.of_joints(robot, time, q, qd, qdd, rng.normal(size=6)),
    )


@pytest.mark.parametrize("name", partly_long(("prru", RRR4, "stewart"), "prru", RRR4))
def test_machines_follow_a_path_as_each_of_them_at_its_poses(name, rng):
    """Two programs: of many machines with their own tree, and of one by limbs."""
    robot = load(name)
    number = next(path for path in robot.file_numbers() if path.startswith(("geometry", "joints", "limbs")))
    many = variants(robot, {number: robot.number(number) + 1e-3 * robot.graph.size * np.array([-1.0, 0.5])})
    pose = robot.home() + 0.02 * rng.normal(size=(5, len(robot.pose_names)))
    rate, change = rng.normal(size=(2, *pose.shape))
    wrench = rng.normal(size=(5, 6))
    f = PathMotion(many, PosePath(np.arange(5.0), pose, rate, change, wrench))
    for k, machine in enumerate(many):
        one = inverse_dynamics_at_pose(machine, pose, rate, change, wrench)
        for found, given in ((f.q, one.q), (f.qd, one.qd), (f.qdd, one.qdd), (f.efforts, one.tau)):
            np.testing.assert_allclose(found[k], given, rtol=0, atol=1e-11 * max(1.0, np.abs(given).max()))


def pick_and_place():
    """The Delta and a path of it."""
    robot = load("delta")
    motion = timed(robot, cycle(robot, 0.025, 0.2, 0.025), duration=0.5).uniform(100.0)
    path = PosePath.of_joints(robot, motion.time, motion.q, motion.qd, motion.qdd)
    return robot, path


picking = pytest.fixture(scope="module")(pick_and_place)


@pytest.mark.parametrize("name", partly_long(("delta", "delta_cu", "stewart"), "delta"))
def test_joints_follow_and_gradients_are_those_of_differences(name):
    robot, (_, q, qd, qdd), path = wave(name)
    own = {number: robot.number(number) for number in NUMBERS[name]}
    many = variants(robot, own)
    f = PathMotion(many, path)
    for found, given in ((f.q, q), (f.qd, qd), (f.qdd, qdd)):
        np.testing.assert_allclose(found[0], given, rtol=0, atol=1e-11)
    rng = np.random.default_rng(0)
    weights, rates = rng.normal(size=(2, *q.shape))
    table = rng.normal(size=(len(q), 6, 6))
    slopes = [f.effort_derivatives(weights, rates), f.singularity_derivatives()]
    elastic = name != "stewart"
    if elastic:
        slopes.append(f.compliance_derivatives(table))
    for k, number in enumerate(own):
        step = 1e-3 * abs(own[number])
        values = np.tile(list(own.values()), (len(POINTS), 1))
        values[:, k] += step * POINTS
        near = PathMotion(many.with_values(values), path)
        sums = [(near.efforts * weights + near.qd * rates).sum(-1), near.singularity]
        if elastic:
            sums.append((near.compliance * table).sum((-1, -2)))
        told_of = ("effort", "index", "compliance") if elastic else ("effort", "index")
        for found, of, told in zip(slopes, sums, told_of, strict=True):
            if told == "index" and name == "stewart":
                continue  # the farthest of several joints as far as each other: a kink
            expected = WEIGHTS @ of / step
            size = max(np.abs(expected).max(), 1e-6 * np.abs(of).max() / step)
            np.testing.assert_allclose(found[:, k], expected, rtol=0, atol=1e-8 * size)


def test_quantities_are_those_of_each_machine_by_itself(picking):
    robot, path = picking
    many = variants(robot, {"geometry.arm_length": [0.19, 0.24], "inertia.platform_mass": 0.3})
    f = PathMotion(many, path)
    peak, rms, energy, mass = (
        q.worst(q.component_values(f)) for q in map(QUANTITIES.get, ("peak-effort", "rms-effort", "energy", "mass"))
    )
    for k, machine in enumerate(many):
        q = machine.inverse(path.pose)
        qd = np.linalg.solve(machine.jacobian(q), path.rate[..., None])[..., 0]
        # Accelerations from rates alone, by differences of positions half a sample away.
        h = 1e-5
        ahead = path.pose + h * path.rate + 0.5 * h * h * path.acceleration
        behind = path.pose - h * path.rate + 0.5 * h * h * path.acceleration
        qdd = (machine.inverse(ahead) - 2.0 * q + machine.inverse(behind)) / h**2
        tau = inverse_dynamics(machine, q, qd, qdd)
        assert peak[k] == pytest.approx(np.abs(tau).max(), rel=1e-4)
        whole = path.time[-1] - path.time[0]
        squares = np.trapezoid if hasattr(np, "trapezoid") else np.trapz
        assert rms[k] == pytest.approx(np.sqrt(squares(tau**2, path.time, axis=0) / whole).max(), rel=1e-4)
        power = np.maximum(tau * qd, 0.0)
        assert energy[k] == pytest.approx(squares(power, path.time, axis=0).sum(), rel=1e-4)
        bodies = [body.mass for body in machine.graph.bodies.values()]
        assert mass[k] == pytest.approx(sum(bodies) + sum(r.mass for r in machine.graph.rods.values()))


def test_the_ratio_of_least_motor_torque_is_that_of_brute_force(picking):
    """Every ratio a machine of its own; torques at the motor as a reader writes them."""
    _, path = picking
    data = parameters_of("delta")
    data["inertia"].pop("rotor_inertia")
    data["drive"] = {"inertia": 9e-6, "ratio": 20.0, "efficiency": 0.8}
    robot = type(load("delta")).from_data(copy.deepcopy(data), "geared")
    squares = np.trapezoid if hasattr(np, "trapezoid") else np.trapz

    length = robot.number("geometry.arm_length")

    def torque(ratio, length=length):
        data["drive"]["ratio"], data["geometry"]["arm_length"] = ratio, length
        machine = robot.from_data(copy.deepcopy(data), "geared")
        q = machine.inverse(path.pose)
        qd = np.linalg.solve(machine.jacobian(q), path.rate[..., None])[..., 0]
        own = path.acceleration - machine.pose_acceleration(q, qd, 0.0 * qd)
        qdd = np.linalg.solve(machine.jacobian(q), own[..., None])[..., 0]
        load = inverse_dynamics(machine, q, qd, qdd) - 9e-6 * ratio**2 * qdd
        shaft = np.where(load * qd < 0, load * 0.8, load / 0.8) / ratio + 9e-6 * ratio * qdd
        whole = path.time[-1] - path.time[0]
        return np.sqrt(squares(shaft**2, path.time, axis=0) / whole)

    best = min((torque(ratio, length).max(), ratio) for ratio in np.arange(5.0, 60.0, 0.5))
    result = design(robot, {"drive.ratio": (5.0, 60.0)}, path, "motor-torque", starts=4)
    assert result.best.quantities["motor-torque"] == pytest.approx(best[0], rel=3e-4)
    assert result.best.numbers["drive.ratio"] == pytest.approx(best[1], abs=0.5)
    # Its derivatives, by the ratio and by a length that moves the joints otherwise.
    quantity, f = (
        QUANTITIES["motor-torque"],
        PathMotion(
            variants(
                robot,
                {"drive.ratio": 20.0, "geometry.arm_length": length, "drive.efficiency": 0.8, "drive.inertia": 9e-6},
            ),
            path,
        ),
    )
    slopes = quantity.differentiate(f, np.arange(3))
    for k, step in enumerate((1e-3, 1e-6)):
        ahead, behind = (torque(20.0 + s * (k == 0), length + s * (k == 1)) for s in (step, -step))
        np.testing.assert_allclose(slopes[:, k], (ahead - behind) / (2 * step), rtol=1e-5)
    for k, step in ((2, 1e-5), (3, 1e-10)):
        values = np.tile([20.0, length, 0.8, 9e-6], (2, 1))
        values[:, k] += [step, -step]
        ahead, behind = quantity.component_values(PathMotion(f.machines.with_values(values), path))
        np.testing.assert_allclose(slopes[:, k], (ahead - behind) / (2 * step), rtol=1e-5)
    with pytest.raises(ParameterError, match="drive"):
        design(load("delta"), BOX, path, "motor-torque", starts=4)


@pytest.mark.parametrize("aim", partly_long(("peak-effort", "energy"), "peak-effort"))
def test_the_optimum_is_that_of_a_grid_of_machines(picking, aim):
    robot, path = picking
    result = design(robot, BOX, path, aim, ["singularity>=0.1"], starts=8)
    table = sweep(robot, BOX, path, [aim, "singularity"], 25)
    kept = np.where(table.quantities["singularity"] >= 0.1, table.quantities[aim], np.inf)
    found = result.best.quantities[aim]
    assert 0.95 * np.nanmin(kept) < found < 1.0002 * np.nanmin(kept)
    assert result.best.feasible and result.best.quantities["singularity"] >= 0.1 - 1e-6
    assert result.rejected > 0 and np.isnan(table.quantities[aim]).any()
    for number, value in result.best.numbers.items():
        assert result.robot.number(number) == value
        assert BOX[number][0] <= value <= BOX[number][1]


@pytest.mark.long
def test_a_pareto_front_falls(picking):
    robot, path = picking
    aims = ("peak-effort", "energy")
    result = design(robot, BOX, path, aims, ["singularity>=0.1"], starts=16, points=4)
    table = np.array([[point.quantities[aim] for aim in aims] for point in result.front])
    assert len(table) == 4 and all(point.feasible for point in result.front)
    assert (np.diff(table[:, 0]) > 0.0).all() and (np.diff(table[:, 1]) < 0.0).all()


def test_several_numbers_change_together(picking):
    robot, path = picking
    name = "inertia.arm_mass, -inertia.platform_mass"
    low = robot.number("inertia.arm_mass")
    result = design(robot, {name: (low, low + 0.05)}, path, "mass")
    both = result.best.numbers
    moved = both["inertia.arm_mass"] - low
    rest = robot.number("inertia.platform_mass") - both["inertia.platform_mass"]
    assert moved == pytest.approx(rest, abs=1e-12)


@pytest.mark.parametrize(
    ("vary", "aim", "bounds", "error"),
    [
        ({"geometry.arm": (0.1, 0.2)}, "mass", [], ParameterError),
        ({"geometry.arm_length": (0.2, 0.1)}, "mass", [], ParameterError),
        ({"geometry.arm_length": (0.0, 1e308)}, "mass", [], ParameterError),
        (BOX, "torque", [], UnknownNameError),
        (BOX, "singularity", [], ParameterError),
        (BOX, "deflection", [], ParameterError),
        (BOX, "mass", ["singularity<=0.1"], ParameterError),
        (BOX, "mass", ["mass"], ParameterError),
        pytest.param(BOX, "mass", ["singularity>=0.99"], PkmTwinError, marks=pytest.mark.long),
        ({"geometry.forearm_length": (0.05, 0.1)}, "mass", [], PkmTwinError),
    ],
)
def test_what_cannot_be_designed_is_rejected(picking, vary, aim, bounds, error):
    robot, path = picking
    with pytest.raises(error):
        design(robot, vary, path, aim, bounds, starts=4)
