# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A URDF with loop closures as a description: against Pinocchio."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.mechanisms.machine import Machine
from pkm_twin.robot.urdf_read import read_urdf
from test.support.robots import partly_long

pytest.importorskip("pinocchio")


from .sketches import SKETCHES, Tree, closure_rows

pytestmark = pytest.mark.usefixtures("quickly_compiled")
NEAR = ("rrr3",)
"""Sketches that have no assembly with their actuated joints at zero."""


@pytest.fixture(params=partly_long(sorted(SKETCHES), "delta", "five_bar"), scope="module")
def sketch(request):
    return SKETCHES[request.param]()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("sketches")


@pytest.fixture(scope="module")
def described(sketch, folder):
    """A sketch's description, read once."""
    return read_urdf(sketch.save(folder))


def values(model, data):
    """The joint values of a description in the order of Pinocchio's model."""
    joints = data["joints"]
    return np.array([joints[name].get("home", 0.0) for name in model.names[1:]])


def test_home_is_a_closed_assembly_with_the_actuated_joints_at_zero(sketch, described):
    data = described
    model, state, ends = sketch.model()
    residual, _ = closure_rows(model, state, ends, values(model, data))
    assert np.abs(residual).max() < 1e-11
    zero = not any(data["joints"][name].get("home") for name in sketch.actuated)
    assert zero == (sketch.seed not in [SKETCHES[name]().seed for name in NEAR])
    assert any("home" in joint for joint in data["joints"].values())


def test_every_body_and_joint_stands_where_pinocchio_has_it(sketch, described):
    data = described
    model, state, ends = sketch.model()
    closure_rows(model, state, ends, values(model, data))
    for name in sketch.links:
        frame = model.frames[model.getFrameId(name)]
        place, inertia = state.oMi[frame.parentJoint], model.inertias[frame.parentJoint]
        body = data["bodies"][name]
        assert body["mass"] == pytest.approx(inertia.mass, abs=1e-12)
        matrix = np.array(body["inertia"])
        matrix = np.diag(matrix) if matrix.ndim == 1 else matrix
        expected = place.rotation @ inertia.inertia @ place.rotation.T
        np.testing.assert_allclose(matrix, expected, atol=1e-12)
        if inertia.mass > 0.0:
            np.testing.assert_allclose(body["com"], place.act(inertia.lever), atol=1e-12)
    for name, kind, parent, child, _, axis, _ in sketch.joints:
        joint = data["joints"][name]
        frame = state.oMf[model.getFrameId(child)]
        assert joint["type"] == kind
        ground = {"ground": "base"}
        assert joint["between"] == [ground.get(parent, parent), child]
        if kind == "revolute":
            np.testing.assert_allclose(joint["at"], frame.translation, atol=1e-12)
        turned = frame.rotation @ sketch.frames()[child].rotation.T @ axis
        np.testing.assert_allclose(joint["axis"], turned, atol=1e-12)
        assert joint.get("actuated", False) == (name in sketch.actuated)
    for (kind, a, b, axis), (name, *_) in zip(ends, sketch.closures, strict=True):
        joint = data["joints"][name]
        assert joint["type"] == kind
        np.testing.assert_allclose(joint["at"], state.oMf[b].translation, atol=1e-11)
        if kind == "revolute":
            np.testing.assert_allclose(joint["axis"], state.oMf[a].rotation @ axis, atol=1e-11)
    np.testing.assert_allclose(data["origin"], state.oMf[model.getFrameId("platform")].translation, atol=1e-12)


def test_the_three_dialects_say_the_same(sketch, described, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loop, beside = (read_urdf(sketch.save(tmp_path, dialect)) for dialect in ("loop", "yaml"))
    constraint = described
    assert loop == constraint
    closures = [name for name, *_ in sketch.closures]
    assert [n for n, j in beside["joints"].items() if j.get("actuated")] == sketch.actuated
    kinds = {n: j["type"] for n, j in beside["joints"].items() if n.startswith(tuple(closures))}
    revolute = any(kind == "revolute" for _, kind, *_ in sketch.closures)
    assert set(kinds.values()) == ({"fixed", "revolute"} if revolute else {"spherical"})
    # The zeros of more joints count, so that the assembly may be another one of the same machine.
    assert set(beside["bodies"]) >= set(constraint["bodies"])
    for name, body in constraint["bodies"].items():
        assert beside["bodies"][name]["mass"] == body["mass"]


def test_torques_are_pinocchios_constrained_solution(sketch, described):
    robot = Machine.from_data(described, "sketch")
    model, _, ends = sketch.model()
    tree = Tree(model, ends, robot.joint_names)
    q = values(model, described)
    rng = np.random.default_rng(0)
    for qd, qdd in rng.normal(size=(5, 2, len(tree.driven))):
        found = inverse_dynamics(robot, q[tree.driven], qd, qdd)
        np.testing.assert_allclose(found, tree.torques(q, qd, qdd), rtol=1e-6, atol=1e-6)


def test_passive_joints_have_the_values_of_the_urdf(sketch, described):
    """With the robot's passive values Pinocchio closes the loops, away from home as well."""
    robot = Machine.from_data(described, "sketch")
    model, data, ends = sketch.model()
    assert {*robot.joint_names, *robot.passive_joints} == set(model.names[1:])
    rng = np.random.default_rng(0)
    home = robot.inverse(robot.home())
    states = home + np.vstack([0.0 * home, rng.uniform(-0.03, 0.03, (5, len(home)))])
    # The home of a sketch without an assembly at zero is near the edge of its workspace.
    states = states[robot.try_forward(states)[1]]
    assert len(states) > 3
    for q in states:
        known = dict(zip(robot.joint_names, q, strict=True))
        known |= dict(zip(robot.passive_joints, robot.passive(q), strict=True))
        full = np.array([known[name] for name in model.names[1:]])
        residual, _ = closure_rows(model, data, ends, full)
        assert np.abs(residual).max() < 1e-9
        position, rotation = robot.platform(q)
        platform = data.oMf[model.getFrameId("platform")]
        if (q == home).all():
            back = platform.rotation.T.copy()
        np.testing.assert_allclose(rotation, platform.rotation @ back, atol=1e-9)
        np.testing.assert_allclose(position, platform.translation, atol=1e-9)
