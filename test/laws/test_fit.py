# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Fits of what another engine needs: close to the truth, honest about the rest."""

from __future__ import annotations

import dataclasses
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin import Robot
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.identification.estimation import estimate, find_violations
from pkm_twin.identification.fit import Fit, fit
from pkm_twin.identification.identifiable import make_inertia_cone
from pkm_twin.identification.parameters import file_parameters, fitted_yaml
from pkm_twin.machine.inertia import standard_parameters
from pkm_twin.mechanisms.entries import write_edited
from pkm_twin.recordings import Recording
from test.identification.machines import noisy
from test.laws.recordings import smooth_motion
from test.support.robots import load, parameters_of, partly_long

TRUTH = {
    "friction": {"viscous": [40.0, 60.0, 55.0], "coulomb": [15.0, 22.0, 9.0]},
    "payload": {"mass": 4.0, "com": [0.03, -0.02, 0.08], "inertia": np.diag([0.02, 0.03, 0.025]).tolist()},
}
"""Of a 3-PRRU whose file tells of neither."""


def pinocchio_recording() -> Recording:
    """Efforts by Pinocchio with loop constraints."""
    pytest.importorskip("pinocchio")
    from bags.recording.pinocchio_prru import PrruEngine

    engine, near = PrruEngine(parameters_of("prru") | TRUTH), None
    motion = smooth_motion(load("prru"), np.random.default_rng(5), 6.0, 100.0)
    efforts = []
    for state in zip(*motion[1:], strict=True):
        tree = engine.state(*state, near)
        near = tree.q
        efforts.append(engine.actuator_effort(tree)[0] + engine.friction(state[1]))
    return Recording(load("prru"), motion[0], motion[1], effort=np.array(efforts))


def by_name(result: Fit) -> dict[str, Any]:
    return {number.name: number for number in result.numbers}


def truths(robot: Robot, kinds: Any) -> dict[str, float]:
    """The numbers of a file by name."""
    found = {}
    for group in file_parameters(robot, kinds).groups:
        for key, value in group.keys(group.values).items():
            found["".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in key)[1:]] = value
    return found


@pytest.mark.parametrize("name", ["delta", "prru", "upr_rpu", "five_bar"])
def test_numbers_are_those_of_the_robot_and_not_of_another_with_its_geometry(name):
    robot = load(name)
    keys = [path for path, (_, unit) in robot.file_numbers().items() if unit in ("kg", "kg/m3")]
    own = [path for path in keys if not path.startswith(("payload", "members", "limits"))]
    heavier = robot.with_file_values({path: 1.5 * robot.file_numbers()[path][0] for path in own})
    before, after = (file_parameters(r, ("payload", "inertia")) for r in (robot, heavier))
    masses = [k for k, n in enumerate(after.names) if n.endswith((".mass", "density"))]
    np.testing.assert_allclose(after.values[masses], 1.5 * before.values[masses], rtol=1e-9)
    np.testing.assert_allclose(after.scales[masses], 1.5 * before.scales[masses], rtol=1e-9)


def test_clean_efforts_of_pinocchio_give_friction_and_payload():
    result = fit(load("prru"), [pinocchio_recording()], ("friction", "payload"))
    numbers = by_name(result)
    for joint in range(3):
        for what in ("viscous", "coulomb"):
            true = TRUTH["friction"][what][joint]
            assert numbers[f"friction.{what}[{joint}]"].after == pytest.approx(true, rel=0.02)
    assert numbers["payload.mass"].after == pytest.approx(4.0, rel=0.01)
    for axis in range(3):
        true = TRUTH["payload"]["com"][axis]
        assert numbers[f"payload.com[{axis}]"].after == pytest.approx(true, abs=2e-3)
    assert all(number.status == "fitted" for number in result.numbers)
    (judged,) = result.judged
    assert (judged.rms(judged.after) < 1e-3 * judged.rms(judged.before)).all()


def still_joint() -> Recording:
    """A five-bar whose right motor holds still."""
    robot = load("five_bar")
    time, q, qd, qdd = smooth_motion(robot, np.random.default_rng(2), 5.0, 100.0)
    for values, held in ((q, q[0, 1]), (qd, 0.0), (qdd, 0.0)):
        values[:, 1] = held
    changed = robot.changed(friction={"viscous": [0.05, 0.08], "coulomb": [0.2, 0.3]})
    return Recording(robot, time, q, effort=inverse_dynamics(changed, q, qd, qdd), source="still")


@pytest.mark.parametrize("name", ["q", "effort"])
def test_a_recording_of_another_number_of_joints_is_rejected(name):
    given = {"q": np.zeros((8, 2))} | {name: np.zeros((8, 3))}
    with pytest.raises(ParameterError, match="samples and joints of five_bar") as error:
        Recording(load("five_bar"), np.arange(8.0), **given)
    assert error.value.field == name


def test_what_the_motion_does_not_show_keeps_the_file_s_value_and_is_named():
    robot = load("five_bar")
    numbers = by_name(fit(robot, [still_joint()], ("friction",)))
    assert numbers["joints.left.friction.viscous"].after == pytest.approx(0.05, rel=0.02)
    assert numbers["joints.left.friction.coulomb"].after == pytest.approx(0.2, rel=0.02)
    for what in ("viscous", "coulomb"):
        number = numbers[f"joints.right.friction.{what}"]
        assert number.status == "not excited"
        assert number.after == number.before
        assert number.deviation > 0.1 * number.before


def test_a_payload_of_a_delta_has_a_mass_and_no_place():
    robot = load("delta").changed(payload={"mass": 0.3, "com": [0.01, 0.02, -0.03]})
    time, q, qd, qdd = smooth_motion(robot, np.random.default_rng(3), 5.0, 100.0)
    recorded = Recording(robot, time, q, effort=inverse_dynamics(robot, q, qd, qdd))
    result = fit(load("delta"), [recorded], ("payload",))
    assert by_name(result)["payload.mass"].after == pytest.approx(0.3, rel=0.01)
    idle = {number.name for number in result.list_numbers("not excited")}
    assert {f"payload.com[{k}]" for k in range(3)} <= idle


def test_late_efforts_and_outliers_are_no_friction():
    robot = load("delta")
    time, q, qd, qdd = smooth_motion(robot, np.random.default_rng(4), 6.0, 500.0)
    true = robot.changed(friction={"viscous": 0.05, "coulomb": 0.1})
    efforts = inverse_dynamics(true, q, qd, qdd)
    late = np.array([np.interp(time - 1e-3, time, column) for column in efforts.T]).T
    late[::101] += 5.0
    result = fit(robot, [Recording(robot, time, q, effort=late)], ("friction",))
    assert result.delays[0] == pytest.approx(1e-3, abs=1e-4)
    assert result.outliers >= len(late[::101]) * 3 - 10
    for name, number in by_name(result).items():
        aim = 0.05 if "viscous" in name else 0.1 if "coulomb" in name else 0.0
        assert number.after == pytest.approx(aim, rel=0.02, abs=2e-3), name


def test_refusals_by_name():
    robot, whole = load("five_bar"), still_joint()
    short = dataclasses.replace(whole, time=whole.time[:50], q=whole.q[:50], effort=whole.effort[:50])
    with pytest.raises(PkmTwinError, match="still: too short"):
        fit(robot, [short], ("friction",))
    asleep = dataclasses.replace(whole, q=np.tile(whole.q[0], (len(whole.q), 1)))
    with pytest.raises(PkmTwinError, match="no excitation"):
        fit(robot, [asleep], ("friction",))
    # The noise of an encoder is no motion.
    rng = np.random.default_rng(7)
    trembling = dataclasses.replace(asleep, q=asleep.q + 1e-6 * rng.normal(size=asleep.q.shape))
    with pytest.raises(PkmTwinError, match="no excitation"):
        fit(robot, [trembling], ("friction",))
    silent = dataclasses.replace(whole, effort=whole.effort * np.array([1.0, 0.0]))
    with pytest.raises(PkmTwinError, match="effort of right is 0 throughout"):
        fit(robot, [silent], ("friction",))
    huge = dataclasses.replace(whole, effort=1e200 * whole.effort)
    with pytest.raises(PkmTwinError, match=r"effort of left is .*; below 1e\+09"):
        fit(robot, [huge], ("friction",))


def test_the_nearest_possible_body_takes_an_impossible_one_s_place():
    pytest.importorskip("cvxpy")
    rng = np.random.default_rng(6)
    cone = ((slice(0, 10), make_inertia_cone()),)
    true = standard_parameters(2.0, np.array([0.1, 0.0, 0.0]), np.diag([0.0, 0.02, 0.02]))
    table = rng.normal(size=(60, 3, 10))
    target = table @ true + rng.normal(0.0, 0.3, (60, 3))
    start = standard_parameters(1.0, np.zeros(3), 0.01 * np.eye(3))
    alone = estimate(table, target, start, np.ones(10))
    held = estimate(table, target, start, np.ones(10), cone)
    assert find_violations(alone.values, cone)
    assert held.bound and not find_violations(held.values, cone)
    # The nearest: not farther from the truth, which is possible.
    measure = np.linalg.inv(alone.covariance)
    apart = [v - true for v in (alone.values, held.values)]
    assert apart[1] @ measure @ apart[1] <= apart[0] @ measure @ apart[0] * 1.2


UPPER = np.triu_indices(3)
PAYLOADS = list(product(("five_bar", "delta"), range(4)))


@pytest.mark.parametrize("case", partly_long(PAYLOADS, ("five_bar", 0)))
def test_what_is_fitted_of_a_payload_is_a_robot(tmp_path: Path, case: tuple[str, int]) -> None:
    """An inertia of which some numbers keep the file's value is one that a body has."""
    name, seed = case
    robot, rng = load(name), np.random.default_rng([seed, *name.encode()])
    time, *motion = smooth_motion(robot, rng, 8.0, 100.0)
    text, out = Path(f"config/{name}.yaml").read_text(), tmp_path / "fitted.yaml"
    for mass in np.geomspace(0.05, 1.0, 3).tolist():
        efforts = inverse_dynamics(robot.changed(payload={"mass": mass}), *motion)
        drawn = Recording(robot, time, motion[0], effort=efforts)
        found = fit(robot, [noisy(drawn, rng)])
        write_edited(out, [], fitted_yaml(text, found.numbers, ["drawn"]), robot)
        told = {n.name: n.after for n in found.numbers}
        inertia = [told[f"payload.inertia[{i}][{j}]"] for i, j in zip(*UPPER, strict=True)]
        np.testing.assert_allclose(load(str(out)).payload.inertia[UPPER], inertia, atol=1e-15)


def test_a_short_recording_of_the_file_s_own_machine_is_not_another_one_s() -> None:
    """The fitted values follow its noise: worse than the file's where they were not fitted."""
    robot, rng = load("delta"), np.random.default_rng([0, *b"delta"])
    time, *motion = smooth_motion(robot, rng, 2.0, 200.0)
    drawn = Recording(robot, time, motion[0], effort=inverse_dynamics(robot, *motion))
    sound = noisy(drawn, rng)
    with pytest.raises(PkmTwinError, match="does not excite the numbers enough"):
        fit(robot, [sound])
    assert not fit(robot, [sound], ("friction",)).accepted
