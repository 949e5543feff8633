# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A linkage that is cut out of a whole robot's file is MuJoCo's, of the whole file."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin import load, transmission
from pkm_twin.errors import MobilityError, ParameterError, UnknownNameError
from pkm_twin.machine.cut_out import find_loop_joints
from pkm_twin.machine.strict_yaml import read_yaml
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.support.mujoco_judge import Judge, mujoco
from test.support.robots import partly_long

pytestmark = pytest.mark.usefixtures("quickly_compiled")
HUMANOID = Path(__file__).resolve().parents[2] / "examples/humanoid.xml"
LINKAGES = {
    "ankle": {"base": "shank", "platform": "foot"},
    "knee": {"base": "thigh", "platform": "shank"},
    "leg": {"base": "pelvis", "platform": "foot"},
}
ANKLE = ("ankle_roll", "ankle_pitch")


def linkage(name, path=HUMANOID, **more):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load(path, **LINKAGES[name], **more)


def judge(robot, given=None, path=HUMANOID):
    """MuJoCo with all that is not in the robot held."""
    model = mujoco.MjModel.from_xml_path(str(path))
    every = [model.joint(k).name for k in range(model.njnt)]
    held = [name for name in every if name and name not in robot.graph.joints]
    made = Judge(path, given or robot.joint_names, held)
    # The free joint of the pelvis has no name.
    made.rest = np.setdiff1d(made.rest, np.arange(6))
    return made


@pytest.mark.parametrize("name", partly_long(sorted(LINKAGES), "ankle", "knee"))
def test_efforts_are_those_of_the_whole_robot_in_mujoco(name):
    robot = linkage(name, carry=True)
    right = judge(robot)
    rng, n = np.random.default_rng(3), robot.joints_count
    for _ in range(3):
        q = robot.graph.home + rng.uniform(-0.15, 0.15, n)
        qd, qdd = rng.normal(size=(2, n))
        efforts = right.efforts(q, qd, qdd)
        error = np.abs(inverse_dynamics(robot, q, qd, qdd) - efforts).max()
        assert error < 1e-8 * np.abs(efforts).max()


def test_an_ankle_s_transmission_is_mujoco_s():
    robot = linkage("ankle")
    assert robot.pose_names == ("roll", "pitch")
    right, t = judge(robot, ANKLE), transmission(robot)
    motors = [int(right.model.joint(name).dofadr[0]) for name in robot.joint_names]
    rng = np.random.default_rng(1)
    for _ in range(5):
        x = rng.uniform(-0.35, 0.35, 2)
        right.data.qpos[:] = right.model.qpos0
        for part in np.linspace(0.2, 1.0, 5):
            right.close(part * x)
        found = [right.data.joint(name).qpos[0] for name in robot.joint_names]
        np.testing.assert_allclose(t.joint_to_actuator(x).position, found, atol=1e-10)
        np.testing.assert_allclose(t.ratio(x), right.motion()[motors], atol=1e-9)


def test_what_is_left_out_is_told_with_its_mass():
    with pytest.warns(match=r"left out, though it moves: toes, 0.15 kg, on foot") as told:
        load(HUMANOID, base="shank", platform="foot")
    texts = [str(one.message) for one in told]
    model = mujoco.MjModel.from_xml_path(str(HUMANOID))
    behind = ("pelvis", "trunk", "arm", "finger", "thumb", "thigh", "knee_crank", "knee_rod")
    mass = sum(model.body(name).mass[0] for name in behind)
    assert any(f"{mass:.4g} kg, on shank" in text for text in texts)
    assert any("motors: waist, shoulder, hip, knee_motor" in text for text in texts)
    bare, whole = linkage("ankle"), linkage("ankle", carry=True)
    assert bare.payload.mass == 0.0
    assert whole.payload.mass == pytest.approx(0.15)
    np.testing.assert_allclose(whole.payload.com, [0.16, 0.0, -0.04], atol=1e-12)


def test_options_of_the_command_line_are_those_of_load(twin, tmp_path):
    out = tmp_path / "ankle.yaml"
    given = ["--base", "shank", "--platform", "foot", "--actuated", "ankle_right,ankle_left"]
    twin.good("convert", HUMANOID, *given, "--pose", "pitch,roll", "--carry", "--out", out)
    robot = robot_of_data(read_yaml(out), "ankle")
    assert robot.joint_names == ("ankle_right", "ankle_left")
    assert robot.pose_names == ("pitch", "roll")
    same = linkage("ankle", carry=True)
    x = np.array([0.2, -0.1])
    np.testing.assert_allclose(robot.inverse(x), same.inverse(x[::-1])[::-1], atol=1e-12)
    told = twin.told("info", HUMANOID, *given, "--pose", "x,roll")
    assert ["roll", "pitch"] in told["other_poses"] and list(told["pose"]) == ["x", "roll"]


def ways(pairs, at, end, passed=()):
    """Joints of every way from one body to another that passes no body twice."""
    if at == end:
        yield ()
        return
    for name, (a, b) in pairs.items():
        if at in (a, b) and (new := b if at == a else a) not in (*passed, at):
            yield from ((name, *rest) for rest in ways(pairs, new, end, (*passed, at)))


def test_joints_on_circles_are_those_of_all_ways_from_base_to_platform():
    rng = np.random.default_rng(0)
    for _ in range(60):
        count = int(rng.integers(4, 11))
        pairs = {f"j{k}": tuple(rng.choice(list("abcdefg"), 2, replace=False).tolist()) for k in range(count)}
        expected = {name for way in ways(pairs, "a", "b") for name in way}
        assert set(find_loop_joints(pairs, "a", "b")) == expected


def test_a_urdf_with_meshes_and_an_arm_is_cut_too(tmp_path):
    """The arm follows a joint of its own, which would be rejected in the machine."""
    text = (HUMANOID.parents[1] / "test/machine/five_bar.urdf").read_text()
    mesh = '<visual><geometry><mesh filename="a.stl"/></geometry></visual>'
    arm = f"""<link name="arm">{mesh}</link><link name="hand"/>
      <joint name="shoulder" type="revolute"><parent link="ROOT"/><child link="arm"/>
        <axis xyz="0 0 1"/><limit effort="1" velocity="1" lower="-1" upper="1"/></joint>
      <joint name="wrist" type="revolute"><parent link="arm"/><child link="hand"/>
        <axis xyz="0 0 1"/><limit effort="1" velocity="1" lower="-1" upper="1"/>
        <mimic joint="shoulder"/></joint></robot>"""
    plain = tmp_path / "plain.urdf"
    plain.write_text(text)
    right = load(plain)
    root = ET.fromstring(text).find("joint/parent").get("link")
    path = tmp_path / "armed.urdf"
    path.write_text(text.replace("</robot>", arm.replace("ROOT", root)))
    with pytest.raises(ParameterError, match=r"wrist.mimic"):
        load(path)
    with pytest.warns(match="left out, on the base: arm, hand"):
        robot = load(path, base=root)
    x = right.home() + 0.01
    np.testing.assert_allclose(robot.inverse(x), right.inverse(x), atol=1e-9)
    path.write_text(path.read_text().replace('joint="shoulder"', f'joint="{right.joint_names[0]}"'))
    with pytest.raises(ParameterError, match=r"wrist.mimic"):
        load(path, base=root)


@pytest.mark.parametrize(
    "wrong", [{"base": 3}, {"platform": ["foot"]}, {"actuated": "ankle_left"}, {"pose": 3}, {"actuated": [1, 2]}]
)
def test_names_of_another_kind_are_rejected(wrong):
    with pytest.raises(ParameterError, match=r"expected a list of names|expected the name") as error:
        load(HUMANOID, **{**LINKAGES["ankle"], **wrong})
    assert error.value.field in wrong


def test_actuators_of_tendons_and_sites_matter_where_they_act(tmp_path):
    """A tendon bends fingers; a thruster on the trunk pushes the pelvis."""
    text = HUMANOID.read_text()
    tendon = '<tendon><fixed name="grasp"><joint joint="finger" coef="1"/></fixed></tendon>'
    motors = '<motor tendon="grasp" ctrlrange="-1 1"/><motor site="SITE" ctrlrange="-1 1"/>'
    for site, ok in (("chest", True), ("sole", False)):
        changed = text.replace("</actuator>", f"{motors}</actuator>{tendon}".replace("SITE", site))
        changed = changed.replace('<body name="arm"', '<site name="chest"/><body name="arm"')
        path = tmp_path / f"{site}.xml"
        path.write_text(changed)
        if ok:
            assert linkage("ankle", path).joint_names == ("ankle_left", "ankle_right")
            continue
        with pytest.raises(ParameterError, match=r"actuator\..*--actuated"):
            linkage("ankle", path)
        motors_named = linkage("ankle", path, actuated=["ankle_left", "ankle_right"])
        assert motors_named.joints_count == 2


WRONG = {
    "unknown base": ({"base": "shnk"}, UnknownNameError, "did you mean 'shank'"),
    "same body": ({"base": "sole"}, ParameterError, "moves relative to base 'sole'"),
    "free base": ({"base": "world"}, ParameterError, "joints connect to platform 'foot', as pelv"),
    "unknown motor": ({"base": "shank", "actuated": ["ankle"]}, UnknownNameError, "ankle_"),
    "ball": ({"base": "shank", "actuated": ["knee"]}, ParameterError, "ankle_left, ankle_right"),
    "too few": (
        {"base": "shank", "actuated": ["ankle_left"]},
        MobilityError,
        "1 actuated joint for 2 degrees of freedom.*ankle_",
    ),
    "coupled": ({"base": "arm", "platform": "thumb"}, ParameterError, "can be driven: thumb"),
    "coupled motor": (
        {"base": "arm", "platform": "thumb", "actuated": ["thumb"]},
        ParameterError,
        "equality.grip.*--base",
    ),
    "whole": ({}, ParameterError, "equality.grip.*--base"),
    "idle motor": (
        {"base": "shank", "platform": "ankle_cross"},
        ParameterError,
        "2 coordinates.*moves in pitch alone: choose another base",
    ),
    "pose": ({"base": "shank", "pose": ["x", "y"]}, ParameterError, "as roll, pitch"),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("case", sorted(WRONG))
def test_what_cannot_be_cut_out_is_told_with_the_way_out(case):
    options, kind, text = WRONG[case]
    with pytest.raises(kind, match=text):
        load(HUMANOID, **{"platform": "foot", **options})


def test_a_yaml_has_its_own_base_and_motors():
    for options in ({"base": "base"}, {"actuated": ["left"]}, {"carry": True}):
        with pytest.raises(ParameterError, match=next(iter(options))):
            load("five_bar", **options)
    assert load(HUMANOID.parent / "machines/rss6.yaml", pose=["z", "y", "x", "yaw", "roll", "pitch"])
