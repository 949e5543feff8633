# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The engine beside other engines, over machines of every kind of joint."""

import os

import numpy as np
import pytest

from delta_dynamics import forward_dynamics, inverse_dynamics, mass_matrix
from pkm_twin.certify.certificate import certify
from pkm_twin.certify.maximal import Maximal, random_states
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.laws.conftest import MISSING, changed
from test.machine.random_machines import FILES, NAMES, plain, variant
from test.support.robots import load, partly_long

pytestmark = pytest.mark.usefixtures("quickly_compiled")
VARIANTS = int(os.environ.get("PKM_TWIN_VARIANTS", "1"))
"""Machines of other dimensions for each of the folder; hundreds for a long run."""
STATES = 2
BOUND = 1e-9


class Case:
    """A machine, what judges it, and states of it."""

    def __init__(self, name, number):
        rng = np.random.default_rng([20261121, NAMES.index(name), number])
        self.description = variant(name, rng) if number else plain(name)
        self.robot = robot_of_data(self.description, "machine")
        self.judge = Maximal(self.description)
        self.states = random_states(self.judge, rng, STATES)


CASES = [(n, k) for n in NAMES for k in range(VARIANTS + 1)]
PLAIN = ("bolted", "delta_rcu", "rrr3_spherical")
VARIED = ("gantry", "prru3", "rps3")
"""By default some as they are, some of other dimensions: every type of joint, of every kind."""


@pytest.fixture(
    scope="module",
    params=partly_long(CASES, *((n, 0) for n in PLAIN), *((n, 1) for n in VARIED)),
    ids=str,
)
def case(request):
    return Case(*request.param)


def test_other_engines_agree(case):
    result = certify(case.robot, case.description, states=STATES)
    assert result.good, [item for item in result.items if not item.good]
    assert all("not installed" in reason for reason in result.missing.values())


def test_names_poses_and_home(case):
    assert tuple(case.robot.joint_names) == tuple(j.name for j in case.judge.machine.actuated)
    assert tuple(case.robot.pose_names) == case.judge.machine.pose
    poses = case.robot.forward(case.states.q)
    expected = np.array([case.judge.pose(q) for q in case.states.q])
    assert poses.shape == expected.shape
    assert np.abs(poses - expected).max() < BOUND
    position, rotation = case.robot.platform(case.judge.machine.home)
    assert np.abs(position - case.judge.machine.origin).max() < BOUND
    assert np.abs(rotation - np.eye(3)).max() < BOUND


def test_forward_dynamics_inverts(case):
    s = case.states
    tau = inverse_dynamics(case.robot, s.q, s.qd, s.qdd, s.wrench)
    back = forward_dynamics(case.robot, s.q, s.qd, tau, s.wrench)
    condition = np.linalg.cond(mass_matrix(case.robot, s.q)).max()
    assert np.abs(back - s.qdd).max() < 1e-12 * condition * max(1.0, np.abs(tau).max())


BEYOND = [
    ("rps3", [0.3, 1.3, 0.3]),
    ("five_bar", [0.9, -0.9]),
    ("delta_rcu", [1.583, 0.792, -2.177]),
]


@pytest.mark.parametrize(("name", "q"), BEYOND)
def test_what_no_way_from_home_reaches_is_told(name, q):
    """The five-bar's elbows meet on the way: behind it all loops close, in no assembly of ours.

    On the delta's way are two singularities, and its determinant has the right sign behind both.
    """
    with pytest.raises(PkmTwinError):
        load(FILES[name]).forward(q)


PENDULUM = {
    "bodies.bob": {"mass": 0.1, "com": [-0.1, 0, 0], "inertia": [1e-4, 1e-4, 1e-4]},
    "joints.pivot": {"type": "revolute", "between": ["arm_left", "bob"], "at": [-0.1, 0, 0.1], "axis": [0, 1, 0]},
}
"""A body that swings as it likes."""
IDLE = {
    "joints.elbow_left.actuated": True,
    "bodies.head": {"mass": 0.2, "com": [0, 0, 0.4], "inertia": [1e-4, 1e-4, 1e-4]},
    "joints.neck": {
        "type": "revolute",
        "between": ["forearm_right", "head"],
        "at": [0, 0, 0.36],
        "axis": [0, 1, 0],
    },
    "platform": "head",
    "pose": ["x", "z", "pitch"],
}
"""Three motors for three freedoms, but two of them hold the third and the head is free."""
PARALLEL = {
    "joints.tip.axis": MISSING,
    "joints.tip.friction": MISSING,
    "joints.tip.type": "universal",
    "joints.tip.axes": [[0, 1, 0], [0, 2, 0]],
}
BALL = {"joints.tip.type": "spherical", "joints.tip.actuated": True}
ISLAND = {"mass": 1.0, "com": [1, 0, 0], "inertia": [1e-3, 1e-3, 1e-3]}
REFUSALS = [
    ("five_bar", {"bodies.island": ISLAND}, ("bodies.island", "bodies"), "island"),
    ("five_bar", {"joints.right.actuated": MISSING}, ("joints",), ""),
    ("five_bar", PENDULUM, ("joints", "joints.pivot"), "pivot"),
    ("five_bar", {"joints.tip.actuated": True}, ("joints.tip.limits.effort",), "share"),
    ("five_bar", IDLE, ("joints", "joints.neck", "platform"), "neck"),
    ("five_bar", {"pose": ["x", "y"]}, ("pose",), "y"),
    ("five_bar", {"pose": ["x"]}, ("pose",), ""),
    # The second motor of a serial arm moves nothing that has mass.
    ("arm_2r", {"bodies.link_2": {}, "origin": [0.5, 0, 0.1]}, ("bodies.link_2", "bodies.link_2.mass"), "link_2"),
    ("five_bar", {"joints.tip.between": ["forearm_lef", "forearm_right"]}, ("joints.tip.between",), "forearm_left"),
    ("five_bar", {"joints.tip.type": "revolut"}, ("joints.tip.type",), "revolute"),
    ("five_bar", {"joints.tip.type": "universal"}, ("joints.tip.axes", "joints.tip.axis"), ""),
    ("five_bar", {"joints.tip.axis": [0, 0, 0]}, ("joints.tip.axis",), ""),
    ("five_bar", BALL, ("joints.tip.actuated", "joints.tip.type", "joints.tip.axis"), ""),
    ("five_bar", PARALLEL, ("joints.tip.axes",), ""),
    ("five_bar", {"bodies.arm_left.mass": -0.1}, ("bodies.arm_left.mass",), ""),
    ("five_bar", {"bodies.arm_left.inertia": [1e-3, 1e-3, 9e-3]}, ("bodies.arm_left.inertia",), ""),
    ("five_bar", {"platform": "forearm_rigth"}, ("platform",), "forearm_right"),
    ("five_bar", {"pose": ["x", "zz"]}, ("pose", "pose[1]", "pose.1"), ""),
]
"""What a file is refused for, and by which field."""


@pytest.mark.parametrize(("name", "changes", "fields", "text"), REFUSALS)
def test_refusals_name_the_field(name, changes, fields, text):
    data = plain(name)
    for dotted, value in changes.items():
        data = changed(data, dotted, value)
    with pytest.raises(ParameterError) as refused:
        robot_of_data(data, "machine")
    assert refused.value.field in fields
    assert text in str(refused.value)
    assert "\n" not in str(refused.value)
