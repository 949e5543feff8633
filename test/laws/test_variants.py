# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Many machines at once give what each of them gives as a robot of its own file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, mass_matrix, reactions, torque_derivatives
from pkm_twin import Robot, robot_names, variants
from pkm_twin.certify.description import expand
from pkm_twin.codegen.expressions import references
from pkm_twin.codegen.lu import pivot_order
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.kinematics.motion import Motion
from pkm_twin.machine import places, schema
from pkm_twin.machine.places import split_path
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.numbers import geometry_and_masses
from stiffness_monitor import compliance, derivatives
from stiffness_monitor.programs import Elastic, solve_dependents
from test.machine.random_machines import plain
from test.support.robots import (
    elastic,
    has,
    load,
    often,
    parameters_of,
    partly_long,
    some_robots,
)

MACHINES = Path(__file__).parents[2] / "examples" / "machines"
SHARED = MACHINES / "rrr3_point.yaml"

ASIDE = ("limits", "joint_map", "uncertainty", "member", "section", "compliance", "radius")
"""Words in paths of numbers that no program of these reads."""


def numbers_of(robot: Robot) -> dict[str, float]:
    """Numbers of geometry, masses and friction that are not zero."""
    found = {path: value for path, (value, _) in robot.file_numbers().items() if value != 0.0}
    return {p: v for p, v in found.items() if not any(word in p for word in ASIDE)}


def motion(robot: Robot, rng, count):
    """Joint states near home."""
    units = np.array([robot.graph.size if u == "m" else 1.0 for u in robot.joint_units])
    q = robot.graph.home + 0.04 * rng.uniform(-1.0, 1.0, (count, robot.joints_count)) * units
    return q, *rng.normal(size=(2, count, robot.joints_count))


def judge(robot: Robot, numbers, rng, reacting=False, tolerance=1e-12):
    """Compare all that is asked of many with each machine by itself; how many could be built."""
    many = variants(robot, numbers)
    q, qd, qdd = motion(robot, rng, 5)
    wrench = rng.normal(size=6)
    tau, masses = many.inverse_dynamics(q, qd, qdd, wrench), many.mass_matrix(q)
    pose, (place, turn) = many.forward(q), many.platform(q)
    measure = many.singularity(q)
    joints = many.reactions(q, qd, qdd, wrench) if reacting else None
    built = 0
    for k in range(len(many)):
        try:
            own = many[k]
            expected = inverse_dynamics(own, q, qd, qdd, wrench)
        except PkmTwinError:
            assert np.isnan(tau[k]).any() and np.isnan(pose[k]).any()
            assert joints is None or not joints.determinate[k].all()
            continue
        built += 1
        assert many.valid[k] and many.reason(k) == ""
        pairs = [
            (tau[k], expected),
            (masses[k], mass_matrix(own, q)),
            (pose[k], own.forward(q)),
            (place[k], own.platform(q)[0]),
            (turn[k], own.platform(q)[1]),
            (measure[k], own.singularity(q)),
            (many.inverse(pose[k])[k], own.inverse(pose[k])),
        ]
        if joints is not None:
            alone = reactions(own, q, qd, qdd, wrench)
            assert (joints.names, joints.bodies) == (alone.names, alone.bodies)
            np.testing.assert_array_equal(joints.determinate[k], alone.determinate)
            parts = ("points", "wrenches", "efforts")
            pairs += [(getattr(joints, part)[k], getattr(alone, part)) for part in parts]
        for found, own_value in pairs:
            scale = max(1.0, np.nanmax(np.abs(own_value)))
            np.testing.assert_allclose(found, own_value, rtol=0, atol=tolerance * scale)
    return built


@some_robots
def test_variants_are_the_robots_of_their_files(name, rng):
    robot = load(name)
    known = numbers_of(robot)
    picked = rng.permutation([p for p in known if "inertia[" not in p and "axis" not in p])[:12]
    numbers = {p: known[p] * (1 + 0.2 * rng.uniform(-1, 1, 3)) for p in picked}
    assert judge(robot, numbers, rng, True) > 0 or "azimuth" in str(list(numbers))
    mass = next(p for p in known if p.endswith("mass"))
    assert judge(robot, {mass: [known[mass], -1.0]}, rng, True) == 1


def taken(robot: Robot) -> tuple[list[float], str]:
    """What programs, nodes and commands take of a robot."""
    rows = derivatives.elastic_numbers(robot) if has(robot, "structure") else []
    rest = (
        robot.limits,
        robot.passive_limits,
        robot.controller,
        robot.drives,
        robot.modal_damping,
        [beam.outer for beam in robot.beams],
    )
    return references([*geometry_and_masses(robot), *rows]).tolist(), repr(rest)


@pytest.mark.parametrize(
    "name",
    partly_long(
        [*robot_names(), *sorted(map(str, MACHINES.glob("*.yaml")))],
        "delta",
        "five_bar",
        str(SHARED),
    ),
    ids=lambda name: Path(name).stem,
)
def test_a_number_has_an_effect_or_is_refused(name):
    """Those that the file lists, and the drives' of other names."""
    robot = load(name)
    carried = {"mass": 0.3, "com": [0.01, 0.02, 0.03], "inertia": [0.01, 0.02, 0.02]}
    robot = robot.changed(payload=carried)
    own = taken(robot)
    drives = {key: schema.plain(getattr(robot, key)) for key in ("friction", "limits")}
    for path in robot.file_numbers() | places.list_file_numbers(drives, {}):
        try:
            value = robot.number(path)
            other = 1.07 * value + 0.011 if np.isfinite(value) else 3.0
            made = robot.numbered({path: other})
            effect = taken(made)
        except ParameterError:
            continue
        assert made.number(path) == pytest.approx(other), path
        # A direction has no length.
        assert effect != own or (".ax" in path and abs(value) == 1.0), path


def test_a_drive_s_number_is_the_same_by_both_names(rng):
    robot = load("five_bar")
    states, both = motion(robot, rng, 3), ("friction.viscous[1]", "joints.right.friction.viscous")
    values = np.array([0.0, 2.0])
    first, second = (variants(robot, {p: values}).inverse_dynamics(*states) for p in both)
    np.testing.assert_array_equal(first, second)
    assert first[1, :, 1] - first[0, :, 1] == pytest.approx(2.0 * states[1][:, 1])
    for p in both:
        assert torque_derivatives(robot, *states, by=[p]).by[p][:, 1] == pytest.approx(states[1][:, 1])
    with pytest.raises(ParameterError, match="each number once"):
        variants(robot, dict.fromkeys(both, 1.0))


def test_limits_by_either_name_share_efforts():
    robot, efforts = load(SHARED), np.array([4.0, 1.0, 0.1])
    home, still, wrench = robot.graph.home, np.zeros(3), np.array([3.0, 5.0, 0, 0, 0, 0])
    expected = []
    for effort in efforts:
        own = robot.changed(limits={"effort": [effort, *robot.limits.effort[1:]]})
        expected.append(inverse_dynamics(own, home, still, still, wrench))
    assert np.ptp(expected, axis=0).max() > 0.1
    for path in ("limits.effort[0]", f"joints.{robot.joint_names[0]}.limits.effort"):
        found = variants(robot, {path: efforts}).inverse_dynamics(home, still, still, wrench)
        np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("count", often(2, 4))
@some_robots
def test_a_number_that_was_zero_goes_through_a_program_of_its_own(name, count, rng):
    """Places and axes that a program takes for zero: another structure, never a wrong answer."""
    robot = load(name)
    zeros = [
        path
        for path, (value, _) in robot.file_numbers().items()
        if value == 0.0 and not any(word in path for word in ASIDE)
    ]
    for path in rng.permutation(zeros)[:count]:
        judge(robot, {path: np.array([0.0, 1e-3, -0.02])}, rng)


@pytest.mark.parametrize("name", partly_long(["five_bar", "stewart", "linear_delta", "rps3"], "linear_delta"))
def test_a_limbs_number_is_that_of_all_its_copies(name, rng):
    robot = load(name)
    paths = sorted(
        {
            ".".join(map(str, source.path))
            for source in robot.sources.values()
            if source.path[0] == "limbs" and source.path[-2] == "joints"
        }
    )
    for path in paths[:3]:
        key = f"{path}.at[2]"
        try:
            value = robot.number(key)
        except ParameterError:
            continue
        assert judge(robot, {key: value + np.array([0.0, 0.01])}, rng) > 0
    mass = next(iter(p for p in numbers_of(robot) if p.endswith(".mass")))
    assert judge(robot, {mass: [0.5, 1.5], "payload.mass": [0.05, 0.7]}, rng) == 2


def test_numbers_of_one_limb_s_entry_vary_together(rng):
    """In the order limb, azimuth, copy, whatever the order they are given in."""
    data = plain("stewart")
    robot = robot_of_data(data, "stewart")
    foot = data["limbs"]["joints"]["foot_a"]
    own = {
        **{f"limbs.joints.foot_a.at[{k}]": foot["at"][k] for k in range(3)},
        **{f"limbs.joints.foot_a.axes[1][{k}]": foot["axes"][1][k] for k in range(2)},
        "limbs.azimuths[1]": data["limbs"]["azimuths"][1],
    }
    values = {path: value + rng.uniform(-0.02, 0.02, 2) for path, value in own.items()}
    paths = rng.permutation(list(own)).tolist()
    many = variants(robot, {path: values[path] for path in paths})
    q, *_ = motion(robot, rng, 3)
    for k, pose in enumerate(many.forward(q)):
        made = plain("stewart")
        for path, value in values.items():
            *way, last = split_path(path)
            holder = made
            for key in way:
                holder = holder[key]
            holder[last] = float(value[k])
        np.testing.assert_allclose(pose, robot_of_data(made, "made").forward(q), rtol=0, atol=1e-12)


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


@pytest.mark.parametrize("name", ["delta_cu", "five_bar", "linear_delta"])
def test_what_was_changed_stays_when_another_number_changes(name, rng):
    robot = load(name)
    n = robot.joints_count
    friction = {key: rng.uniform(1.0, 2.0, n).tolist() for key in ("viscous", "coulomb")}
    changed = robot.changed(friction=friction, payload={"mass": 0.3}, limits={"velocity": 7.0})
    path = next(path for path, (_, unit) in changed.file_numbers().items() if unit == "kg")
    again = changed.with_file_values({path: changed.file_numbers()[path][0]})
    state = motion(robot, rng, 3)
    expected = inverse_dynamics(changed, *state)
    np.testing.assert_allclose(inverse_dynamics(again, *state), expected, rtol=1e-12)
    many = variants(changed, {path: changed.number(path)})
    np.testing.assert_allclose(many.inverse_dynamics(*state)[0], expected, rtol=1e-12)
    for robot in (again, many[0]):
        assert (np.asarray(robot.limits.velocity) == 7.0).all()


@pytest.mark.parametrize(
    "numbers",
    [{"": 0.2}, {5: 0.2}, {None: 0.2}, *({"payload.mass": v} for v in ("a", None, True, [[1.0]]))],
)
def test_what_is_no_number_or_path_is_rejected(numbers):
    with pytest.raises(ParameterError):
        variants(load("delta"), numbers)


def test_no_machines_have_empty_answers():
    robot = load("five_bar")
    many, q = variants(robot, {"payload.mass": []}), robot.graph.home
    assert len(many) == 0 and many.valid.shape == (0,)
    assert many.inverse_dynamics(q, q, q).shape == many.inverse(many.forward(q)).shape == (0, 2)
    assert many.jacobian(q).shape == many.mass_matrix(q).shape == (0, 2, 2)
    assert many.reactions(q, q, q).wrenches.shape[0] == 0


def test_a_limb_s_number_and_that_of_one_copy_vary_together(rng):
    """The copy's own stands after that of all copies."""
    robot = load("linear_delta")
    one = next(n for n, s in robot.sources.items() if n[0] == "joints" and s.copy == 1)
    alike, own = ".".join(map(str, robot.sources[one].path)), ".".join(one)
    numbers = {f"{alike}.at[0]": 0.01, f"{own}.at[0]": -0.02}
    numbers = {p: robot.number(p) + step * np.array([1.0, 0.5]) for p, step in numbers.items()}
    assert judge(robot, numbers, rng) == 2


def test_columns_of_several_lengths_are_rejected():
    with pytest.raises(ParameterError):
        variants(load("delta"), {"geometry.arm_length": [0.2, 0.3], "payload.mass": [0.1, 0.2, 0.3]})


TUBE = {
    "youngs_modulus": 7e10,
    "shear_modulus": 2.6e10,
    "density": 2700.0,
    "outer_diameter": 0.02,
}
SOFT = (
    "arm_2r",
    "bolted",
    "delta_rcu",
    "elbow_motors",
    "five_bar",
    "four_bar",
    "linear_delta",
    "prru3",
    "rcuu",
    "rps3",
    "rrr3_planar",
    "rrr3_spherical",
    "stewart",
    "upr_rpu",
)
"""Machines whose platform moves by elastic joints, some of their directions rigid."""
RIGID = ("limits", "joint_map", "uncertainty", "azimuth", "inertia", "axis", "axes")


def soft(name: str, rng, rigid=0.3) -> Robot:
    """A machine of elastic joints and rods, and of bars where a body is between two joints."""
    data = expand(plain(name))
    for key, body in data["bodies"].items():
        joints = [j for j in data["joints"].values() if key in j["between"]]
        ends = [j["at"] for j in joints if "at" in j]
        passive = not any(j.get("actuated") and j["type"] == "prismatic" for j in joints)
        outside = key == data.get("platform", "platform") or not body.get("mass")
        if passive and not outside and len(ends) == 2 and np.ptp(ends, axis=0).max() > 1e-3:
            section = TUBE | {"inner_diameter": 0.015}
            del section["density"]
            body["member"] = {"from": ends[0], "to": ends[1], "section": section}
    for rod in data.get("rods", {}).values():
        rod |= {"section": TUBE, "mass": 0.4 * np.linalg.norm(np.subtract(*rod["ends"]))}
    while True:
        for joint in data["joints"].values():
            values = rng.uniform(0.1, 1.0, 6) * np.repeat([1e-7, 1e-5], 3)
            joint["compliance"] = np.where(rng.uniform(size=6) < rigid, 0.0, values).tolist()
        robot = robot_of_data(data, name)
        try:
            compliance(robot, robot.home())
        except (PkmTwinError, ValueError):
            continue
        return robot


def judge_compliance(robot: Robot, numbers, rng):
    """Compare the compliance of many with each machine's own; how many could be built."""
    many = variants(robot, numbers)
    assert len(many) != 3  # or poses would be by machine
    units = np.array([robot.graph.size if u == "m" else 1.0 for u in robot.joint_units])
    away = 0.03 * rng.uniform(-1.0, 1.0, (3, robot.joints_count)) * units
    pose = robot.forward(robot.graph.home + away)
    found = many.compliance(pose)
    assert found.shape == (len(many), 3, 6, 6)
    built = 0
    for k in range(len(many)):
        for i, there in enumerate(pose):
            try:
                own = compliance(many[k], there)
            except (PkmTwinError, ValueError):
                assert np.isnan(found[k, i]).all()
                continue
            built += 1
            scale = np.abs(own.reshape(2, 3, 2, 3)).max((1, 3))
            apart = np.abs(found[k, i] - own).reshape(2, 3, 2, 3).max((1, 3))
            assert (apart <= 1e-10 * scale).all()
    return built


def elastic_numbers(robot: Robot) -> dict[str, float]:
    """Numbers that a compliance hangs on, and that are not zero."""
    found = {path: value for path, (value, _) in robot.file_numbers().items() if value != 0.0}
    return {p: v for p, v in found.items() if not any(word in p for word in RIGID)}


@elastic
def test_compliances_are_those_of_the_robots(name, rng):
    robot = load(name)
    known = {**elastic_numbers(robot)}
    members = [p for p in known if "member" in p or "compliance" in p]
    others = [p for p in known if "geometry" in p]
    picked = [*rng.permutation(members)[:8], *rng.permutation(others)[:4]]
    numbers = {p: known[p] * (1 + 0.05 * rng.uniform(-1, 1, 4)) for p in picked}
    assert judge_compliance(robot, numbers, rng) > 0
    masses = [p for p, (v, _) in robot.file_numbers().items() if p.endswith("mass") and v > 0.0]
    for path in masses[:2]:
        # The wall of a tube follows from mass and density: twenty times the mass has no room.
        values = robot.number(path) * np.array([0.9, 1.1, 20.0, 0.0])
        assert judge_compliance(robot, {path: values}, rng) >= 2


@pytest.mark.parametrize("name", partly_long(SOFT, "rcuu"))
def test_compliances_of_any_machine_are_those_of_the_robots(name, rng):
    robot = soft(name, rng)
    known = elastic_numbers(robot)
    for part in ("compliance", "at", "rods", "from", "section"):
        paths = rng.permutation([p for p in known if part in p.split("[")[0].split(".")])[:2]
        if len(paths):
            numbers = {p: known[p] * np.array([1.0, 1.02]) for p in paths}
            assert judge_compliance(robot, numbers, rng) > 0


@pytest.mark.parametrize("name", partly_long(SOFT, "five_bar"))
def test_a_compliance_that_appears_or_vanishes_is_another_structure(name, rng):
    robot = soft(name, rng)
    paths = [p for p in robot.file_numbers() if p.split("[")[0].endswith("compliance")]
    for path in rng.permutation(paths)[:2]:
        judge_compliance(robot, {path: [0.0, 2e-8, 1e-7, np.inf]}, rng)


def test_a_frame_that_is_singular_at_home_has_programs_of_its_own(rng):
    data = expand(plain("four_bar"))
    rigid = {"motor": [2, 4], "crank_pin": [1, 2, 3, 4], "rocker_foot": [], "rocker_pin": [2, 5]}
    for name, held in rigid.items():
        values = np.repeat([2e-8, 6e-6], 3)
        values[held] = 0.0
        data["joints"][name]["compliance"] = values.tolist()
    robot = robot_of_data(data, "four_bar")
    with pytest.raises(PkmTwinError):
        compliance(robot, robot.home())
    at = robot.number("joints.rocker_pin.at[0]")
    numbers = {"joints.rocker_pin.at[0]": [at, at + 0.01], "joints.motor.compliance[0]": 3e-8}
    assert judge_compliance(robot, numbers, rng) == 6


def test_closures_that_are_left_out_follow_from_the_others():
    robot = soft("bolted", np.random.default_rng(7), 0.6)
    elastic, engine = robot.cached(Elastic), robot.engine
    chosen = elastic.dependent_coordinates
    assert chosen is not None
    for x, q in engine.samples:
        frame = elastic._build_frame(Motion(engine.tree, x, q))
        assert len(chosen.rows) < len(frame.constraints)
        assert np.abs(np.array(solve_dependents(frame, chosen)[2], float)).max() < 1e-12
        fewer = replace(chosen, rows=chosen.rows[1:], chosen=chosen.chosen[1:])
        square = frame.build_constraint_matrix()[list(fewer.rows)][:, list(fewer.chosen)].astype(float)
        fewer = replace(fewer, pivots=pivot_order(square[None]))
        assert np.abs(np.array(solve_dependents(frame, fewer)[2], float)).max() > 1e-3


def test_a_robot_that_is_rigid_has_no_compliance():
    data = parameters_of("five_bar")
    for entry in [*data["bodies"].values(), *data["joints"].values()]:
        entry.pop("member", None)
        entry.pop("compliance", None)
    robot = robot_of_data(data, "rigid")
    with pytest.raises(ParameterError):
        variants(robot, {"payload.mass": [0.0, 1.0]}).compliance(robot.home())
