# SPDX-License-Identifier: Apache-2.0
"""The engine beside other engines, over machines of every kind of joint."""

import copy
import json
import os

import numpy as np
import pytest

from delta_dynamics import forward_dynamics, inverse_dynamics, mass_matrix
from pkm_twin.certify.certificate import certify
from pkm_twin.certify.maximal import Maximal
from pkm_twin.certify.states import random_states
from pkm_twin.errors import ParameterError, PkmTwinError
from test.machine.random_machines import NAMES, plain, variant
from test.support.robots import load, partly_long

pytestmark = pytest.mark.usefixtures("quickly_compiled")
VARIANTS = int(os.environ.get("PKM_TWIN_VARIANTS", "1"))
"""Machines of other dimensions for each of the folder; hundreds for a long run."""
STATES = 2
BOUND = 1e-9


def loaded(description, folder):
    path = folder / "machine.yaml"
    # Without aliases, which a file may not have.
    path.write_text(json.dumps(description))
    return load(path)


class Case:
    """A machine, what judges it, and states of it."""

    def __init__(self, name, number, folder):
        rng = np.random.default_rng([20261121, NAMES.index(name), number])
        self.description = variant(name, rng) if number else plain(name)
        self.robot = loaded(self.description, folder)
        self.judge = Maximal(self.description)
        self.states = random_states(self.judge, rng, STATES)


CASES = [(n, k) for n in NAMES for k in range(VARIANTS + 1)]
PLAIN = ("bolted", "delta_rcu", "hinged_platform", "platform_motor", "rccc", "rrr3_spherical")
VARIED = ("five_bar", "four_bar", "gantry", "prru3", "rcuu", "rps3")
"""By default some as they are, some of other dimensions: every type of joint, of every kind."""


@pytest.fixture(
    scope="module",
    params=partly_long(CASES, *((n, 0) for n in PLAIN), *((n, 1) for n in VARIED)),
    ids=str,
)
def case(request, tmp_path_factory):
    return Case(*request.param, tmp_path_factory.mktemp("machine"))


def samples(states):
    return zip(states.q, states.qd, states.qdd, states.wrench, strict=True)


def test_names(case):
    assert tuple(case.robot.joint_names) == tuple(j.name for j in case.judge.machine.actuated)
    assert tuple(case.robot.pose_names) == case.judge.machine.pose


def test_other_engines_agree(case):
    result = certify(case.robot, case.description, states=STATES)
    assert result.good, [item for item in result.items if not item.good]
    assert all("not installed" in reason for reason in result.missing.values())


def test_poses(case):
    poses = case.robot.forward(case.states.q)
    expected = np.array([case.judge.pose(q) for q in case.states.q])
    assert poses.shape == expected.shape
    assert np.abs(poses - expected).max() < BOUND


def test_home(case):
    home = case.judge.machine.home
    position, rotation = case.robot.platform(home)
    assert np.abs(position - case.judge.machine.origin).max() < BOUND
    assert np.abs(rotation - np.eye(3)).max() < BOUND


def test_forward_dynamics_inverts(case):
    s = case.states
    tau = inverse_dynamics(case.robot, s.q, s.qd, s.qdd, s.wrench)
    back = forward_dynamics(case.robot, s.q, s.qd, tau, s.wrench)
    condition = np.linalg.cond(mass_matrix(case.robot, s.q)).max()
    assert np.abs(back - s.qdd).max() < 1e-12 * condition * max(1.0, np.abs(tau).max())


def test_batch_axes_and_bits(case):
    s, n = case.states, len(case.robot.joint_names)
    m = len(case.robot.pose_names)
    batch = inverse_dynamics(case.robot, s.q, s.qd, s.qdd, s.wrench)
    single = [inverse_dynamics(case.robot, *sample) for sample in samples(s)]
    assert np.array_equal(batch, single)
    assert np.array_equal(case.robot.forward(s.q), [case.robot.forward(q) for q in s.q])
    grid = [x.reshape(2, STATES // 2, -1) for x in (s.q, s.qd, s.qdd, s.wrench)]
    assert np.array_equal(inverse_dynamics(case.robot, *grid), batch.reshape(2, -1, n))
    assert case.robot.forward(grid[0]).shape == (2, STATES // 2, m)
    position, rotation = case.robot.platform(grid[0])
    assert position.shape == (2, STATES // 2, 3)
    assert rotation.shape == (2, STATES // 2, 3, 3)
    assert mass_matrix(case.robot, grid[0]).shape == (2, STATES // 2, n, n)


def test_no_wrench_is_none(case):
    s = case.states
    none = inverse_dynamics(case.robot, s.q, s.qd, s.qdd)
    assert np.array_equal(none, inverse_dynamics(case.robot, s.q, s.qd, s.qdd, np.zeros(6)))


def test_out_of_reach_is_told(tmp_path):
    robot = loaded(plain("rps3"), tmp_path)
    with pytest.raises(PkmTwinError):
        robot.forward([0.3, 1.3, 0.3])


def test_a_singularity_on_the_way_is_told(tmp_path):
    """The five-bar's elbows meet on the way: behind it all loops close, in no assembly of ours."""
    robot = loaded(plain("five_bar"), tmp_path)
    with pytest.raises(PkmTwinError):
        robot.forward([0.9, -0.9])


# What a file is refused for, and by which field


def broken_connection(data):
    data["bodies"]["island"] = {"mass": 1.0, "com": [1, 0, 0], "inertia": [1e-3, 1e-3, 1e-3]}


def missing_motor(data):
    data["joints"]["right"].pop("actuated")


def pendulum(data):
    """A body that swings as it likes."""
    data["bodies"]["bob"] = {"mass": 0.1, "com": [-0.1, 0, 0], "inertia": [1e-4, 1e-4, 1e-4]}
    data["joints"]["pivot"] = {
        "type": "revolute",
        "between": ["arm_left", "bob"],
        "at": [-0.1, 0, 0.1],
        "axis": [0, 1, 0],
    }


def motor_too_many(data):
    data["joints"]["tip"]["actuated"] = True


def idle_motor(data):
    """Three motors for three freedoms, but two of them hold the third and the head is free."""
    data["joints"]["elbow_left"]["actuated"] = True
    data["bodies"]["head"] = {"mass": 0.2, "com": [0, 0, 0.4], "inertia": [1e-4, 1e-4, 1e-4]}
    data["joints"]["neck"] = {
        "type": "revolute",
        "between": ["forearm_right", "head"],
        "at": [0, 0, 0.36],
        "axis": [0, 1, 0],
    }
    data["platform"], data["pose"] = "head", ["x", "z", "pitch"]


def pose_out_of_plane(data):
    data["pose"] = ["x", "y"]


def pose_too_short(data):
    data["pose"] = ["x"]


def feather(data):
    """The second motor of a serial arm moves nothing that has mass."""
    data["bodies"]["link_2"] = {}
    data["origin"] = [0.5, 0, 0.1]


def unknown_body(data):
    data["joints"]["tip"]["between"] = ["forearm_lef", "forearm_right"]


def unknown_type(data):
    data["joints"]["tip"]["type"] = "revolut"


def two_axes(data):
    data["joints"]["tip"].update(type="universal")


def zero_axis(data):
    data["joints"]["tip"]["axis"] = [0, 0, 0]


def actuated_ball(data):
    data["joints"]["tip"].update(type="spherical", actuated=True)


def parallel_axes(data):
    data["joints"]["tip"].pop("axis")
    data["joints"]["tip"].pop("friction")
    data["joints"]["tip"].update(type="universal", axes=[[0, 1, 0], [0, 2, 0]])


def negative_mass(data):
    data["bodies"]["arm_left"]["mass"] = -0.1


def broken_triangle(data):
    data["bodies"]["arm_left"]["inertia"] = [1e-3, 1e-3, 9e-3]


def no_platform(data):
    data["platform"] = "forearm_rigth"


def unknown_pose(data):
    data["pose"] = ["x", "zz"]


REFUSALS = [
    ("five_bar", broken_connection, ("bodies.island", "bodies"), "island"),
    ("five_bar", missing_motor, ("joints",), ""),
    ("five_bar", pendulum, ("joints", "joints.pivot"), "pivot"),
    ("five_bar", motor_too_many, ("joints", "joints.tip"), ""),
    ("five_bar", idle_motor, ("joints", "joints.neck", "platform"), "neck"),
    ("five_bar", pose_out_of_plane, ("pose",), "y"),
    ("five_bar", pose_too_short, ("pose",), ""),
    ("arm_2r", feather, ("bodies.link_2", "bodies.link_2.mass"), "link_2"),
    ("five_bar", unknown_body, ("joints.tip.between",), "forearm_left"),
    ("five_bar", unknown_type, ("joints.tip.type",), "revolute"),
    ("five_bar", two_axes, ("joints.tip.axes", "joints.tip.axis"), ""),
    ("five_bar", zero_axis, ("joints.tip.axis",), ""),
    ("five_bar", actuated_ball, ("joints.tip.actuated", "joints.tip.type", "joints.tip.axis"), ""),
    ("five_bar", parallel_axes, ("joints.tip.axes",), ""),
    ("five_bar", negative_mass, ("bodies.arm_left.mass",), ""),
    ("five_bar", broken_triangle, ("bodies.arm_left.inertia",), ""),
    ("five_bar", no_platform, ("platform",), "forearm_right"),
    ("five_bar", unknown_pose, ("pose", "pose[1]", "pose.1"), ""),
]


@pytest.mark.parametrize(("name", "breaks", "fields", "text"), REFUSALS)
def test_refusals_name_the_field(name, breaks, fields, text, tmp_path):
    data = copy.deepcopy(plain(name))
    breaks(data)
    with pytest.raises(ParameterError) as refused:
        loaded(data, tmp_path)
    assert refused.value.field in fields
    assert text in str(refused.value)
    assert "\n" not in str(refused.value)
