# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""SDF models with loops: every way of writing one drawing is the same machine."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import ParameterError
from pkm_twin.machine.urdf_xml import UNLIMITED
from pkm_twin.mechanisms.machine import Machine
from pkm_twin.robot.robot_urdf import robot_sdf
from pkm_twin.robot.urdf_read import read_urdf
from test.machine.random_machines import variant
from test.machine.test_helical import driven
from test.support.robots import load, random_motion

pytestmark = pytest.mark.usefixtures("quickly_compiled")

TURN = UNLIMITED["revolute"]
FIVE_BAR = """<sdf version="1.9"><world name="w"><gravity>0 -9.81 0</gravity>
<model name="ground"><static>1</static></model>
<model name="five_bar">
{left}{right}{tip}{motors}
</model></world></sdf>"""
INERTIAL = """<inertial><pose>{x} 0 0 0 0 0</pose><mass>0.4</mass>
<inertia><ixx>1e-4</ixx><iyy>2e-3</iyy><izz>2e-3</izz></inertia></inertial>"""
LIMB = """<link name="arm_{k}"><pose relative_to="__model__">{x} 0 0 0 0 {a}</pose>{heavy}</link>
<link name="fore_{k}"><pose relative_to="arm_{k}">0.2 0 0 0 0 {b}</pose>{heavy}</link>
<joint name="m{k}" type="revolute"><parent>world</parent><child>arm_{k}</child>
 <axis><xyz>0 0 1</xyz></axis></joint>
<joint name="e{k}" type="continuous"><parent>arm_{k}</parent><child>fore_{k}</child>
 <axis><xyz>0 0 1</xyz><dynamics><damping>0.1</damping></dynamics></axis></joint>"""
TIP = """<frame name="tool" attached_to="fore_1"><pose>0.3 0 0 0 0 0</pose></frame>
<joint name="tip" type="revolute"><pose>0.3 0 0 0 0 0</pose>
 <parent>fore_1</parent><child>fore_2</child></joint>"""
PIN = """<link name="pin"><pose relative_to="fore_2">0.3 0 0 0 0 0.3</pose>{heavy}</link>
<frame name="tool" attached_to="fore_1"><pose>0.3 0 0 0 0 0</pose></frame>
<joint name="tip" type="revolute"><parent>fore_2</parent><child>pin</child></joint>
<plugin name="gz::sim::systems::DetachableJoint"><parent_link>fore_1</parent_link>
 <child_model>{model}</child_model><child_link>pin</child_link></plugin>"""
MOTORS = """<plugin name="gz::sim::systems::JointPositionController">
<joint_name>m2</joint_name></plugin>
<plugin name="ignition::gazebo::systems::ApplyJointForce"><joint_name>m1</joint_name></plugin>
<plugin name="gz::sim::systems::JointStatePublisher"><joint_name>e1</joint_name></plugin>"""


def five_bar(tmp_path, old="", new="", tip=TIP, motors=MOTORS):
    """Two limbs of 0.2 m and 0.3 m from feet at -0.1 m and 0.1 m that meet at (0, y)."""
    heavy = INERTIAL.format(x=0.1)
    # The elbow of each limb is 0.15 m outwards of the foot's vertical: arm and forearm meet in x=0.
    first = np.arccos(0.05 / 0.2)
    elbow = np.array([-0.15, 0.2 * np.sin(np.pi - first)])
    top = elbow[1] + np.sqrt(0.3**2 - 0.15**2)
    fore = np.arctan2(top - elbow[1], 0.15)
    left = LIMB.format(k=1, x=-0.1, a=np.pi - first, b=fore - (np.pi - first), heavy=heavy)
    right = LIMB.format(k=2, x=0.1, a=first, b=np.pi - fore - first, heavy=heavy)
    tip = tip.format(heavy=heavy, model="five_bar")
    text = FIVE_BAR.format(left=left, right=right, tip=tip, motors=motors)
    assert old in text
    path = tmp_path / "five_bar.sdf"
    path.write_text(text.replace(old, new) if old else text)
    return path


def text_of(values):
    return " ".join(map(repr, np.asarray(values, float).tolist()))


class Scrambled:
    """The SDF of a drawing with every pose in a frame of its own, and joints either way round."""

    def __init__(self, plain, rng):
        self.rng, self.top = rng, ET.fromstring(plain)
        self.model = self.top.find("model")
        for frame in self.model.findall("frame"):
            frame.find("pose").set("relative_to", "__model__")
        self.places = {
            part.get("name"): np.array(part.findtext("pose").split(), float)[:3]
            for part in [*self.model.findall("link"), *self.model.findall("frame")]
        }
        self.turns = {name: np.eye(3) for name in self.places}
        self.at = {"__model__": (np.zeros(3), np.eye(3))}
        for link in self.model.findall("link"):
            self._link(link)
        fixed = {plugin.findtext("joint_name") for plugin in self.model.findall("plugin")}
        for joint in self.model.findall("joint"):
            self._joint(joint, joint.get("name") in fixed)

    def text(self):
        return ET.tostring(self.top, encoding="unicode")

    def _pose(self, element, place, turn, frame):
        """Write a pose that is ``place`` and ``turn`` in the model as one relative to a frame."""
        origin, axes = self.at[frame]
        element.set("relative_to", frame)
        position, rotation = axes.T @ (place - origin), Rotation.from_matrix(axes.T @ turn)
        if self.rng.random() < 0.3:
            element.set("rotation_format", "quat_xyzw")
            element.text = text_of([*position, *rotation.as_quat()])
        elif self.rng.random() < 0.5:
            element.set("degrees", self.rng.choice(["true", "1", "True"]))
            element.text = text_of([*position, *rotation.as_euler("xyz", degrees=True)])
        else:
            element.text = text_of([*position, *rotation.as_euler("xyz")])

    def _link(self, link):
        name, place = link.get("name"), self.places[link.get("name")]
        turn = Rotation.random(random_state=int(self.rng.integers(1e6))).as_matrix()
        com = np.array(link.findtext("inertial/pose").split(), float)[:3]
        back = Rotation.from_matrix(turn.T)
        link.find("inertial/pose").text = text_of([*turn.T @ com, *back.as_euler("xyz")])
        self._pose(link.find("pose"), place, turn, str(self.rng.choice(list(self.at))))
        self.at[name] = place, turn

    def _joint(self, joint, driven):
        ends = [joint.find("parent"), joint.find("child")]
        row = np.array((joint.findtext("pose") or "0 0 0").split(), float)[:3]
        if not driven and self.rng.random() < 0.5 and joint.find("axis2") is None:
            ends[0].text, ends[1].text = ends[1].text, ends[0].text
        turn = Rotation.random(random_state=int(self.rng.integers(1e6))).as_matrix()
        pose = joint.find("pose")
        if pose is None:
            pose = ET.SubElement(joint, "pose")
        self._pose(pose, row, turn, str(self.rng.choice(list(self.at))))
        for tag in ("axis/xyz", "axis2/xyz"):
            xyz = joint.find(tag)
            if xyz is not None:
                frame = str(self.rng.choice(["", *self.at]))
                seen = self.at[frame][1] if frame else turn
                xyz.text = text_of(seen.T @ np.array(xyz.text.split(), float))
                if frame:
                    xyz.set("expressed_in", frame)
        for end in ends:
            if end.text in self.at and self.rng.random() < 0.5:
                name = f"{joint.get('name')}_{end.tag}"
                frame = ET.SubElement(self.model, "frame", name=name, attached_to=end.text)
                self._pose(ET.SubElement(frame, "pose"), row, turn, end.text)
                end.text = name


def torques(path, motion):
    return inverse_dynamics(load(path), *motion)


def same(found, right):
    """Whether two machines are one, by their places and efforts."""
    motion = random_motion(right, np.random.default_rng(8), 5)
    np.testing.assert_allclose(found.platform(motion[0])[0], right.platform(motion[0])[0], 1e-9)
    np.testing.assert_allclose(inverse_dynamics(found, *motion), inverse_dynamics(right, *motion), 1e-8, 1e-10)


def edited(tmp_path, changes, **options):
    """The five-bar's file with all that is old replaced."""
    path = five_bar(tmp_path, **options)
    text = path.read_text()
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "name",
    [
        "five_bar",
        *(
            pytest.param(n, marks=pytest.mark.long)
            for n in ("rps3", "delta_cu", "stewart", "random prru3", "random bolted")
        ),
    ],
)
def test_every_way_to_write_a_drawing_is_the_same_machine(name, tmp_path):
    if name.startswith("random"):
        data = variant(name.split()[1], np.random.default_rng(5))
        robot = Machine.from_data(data | {"mechanism": "machine"}, name)
    else:
        robot = load(name)
    plain = robot_sdf(robot)
    (tmp_path / "plain.sdf").write_text(plain)
    motion = random_motion(robot, np.random.default_rng(1), 5)
    motion = (motion[0] - robot.graph.home, *motion[1:])
    right = torques(tmp_path / "plain.sdf", motion)
    for seed in range(3):
        path = tmp_path / f"scrambled_{seed}.sdf"
        path.write_text(Scrambled(plain, np.random.default_rng(seed)).text())
        found = torques(path, motion)
        assert np.abs(found - right).max() < 1e-8 * np.abs(right).max()


def test_a_model_in_a_world_with_a_loop(tmp_path):
    data = read_urdf(five_bar(tmp_path))
    assert data["gravity"] == [0.0, -9.81, 0.0]
    assert [n for n, j in data["joints"].items() if j.get("actuated")] == ["m2", "m1"]
    assert data["joints"]["e1"]["friction"]["viscous"] == 0.1
    np.testing.assert_allclose(data["origin"][0], 0.0, atol=1e-12)
    robot = load(five_bar(tmp_path))
    # Mirrored limbs carry the same weight with opposite efforts.
    effort = inverse_dynamics(robot, *np.zeros((3, 2)))
    assert effort[0] == pytest.approx(-effort[1], rel=1e-9) and abs(effort[0]) > 0.1


@pytest.mark.parametrize("way", ["placement_frame", "pose"])
def test_a_limb_in_a_nested_model_is_the_same_machine(way, tmp_path):
    robot = load(five_bar(tmp_path), platform="tool")
    path = five_bar(tmp_path)
    head, _, tail = path.read_text().partition('<link name="arm_1">')
    limb, joint, tail = tail.partition('<link name="arm_2">')
    pose = re.search(r"<pose relative_to=\"__model__\">([^<]*)</pose>", limb)
    model = f'<model name="limb"><pose>{pose[1]}</pose><link name="arm_1">'
    inner = "<pose/>"
    if way == "placement_frame":
        model = model.replace('"limb"', '"limb" placement_frame="arm_1"')
        inner = "<pose>0.7 0.2 -0.3 0.4 0.5 0.6</pose>"
    for name in ("fore_1", "m1"):
        tail = tail.replace(f">{name}<", f">limb::{name}<")
    tail = tail.replace('attached_to="fore_1"', 'attached_to="limb::fore_1"')
    path.write_text(head + model + limb.replace(pose[0], inner) + "</model>" + joint + tail)
    nested = load(path, platform="tool")
    assert nested.joint_names == ("m2", "limb::m1")
    same(nested, robot)


def test_a_joint_may_have_a_link_s_name_until_1_6(tmp_path):
    path = five_bar(tmp_path)
    text = path.read_text().replace('name="e1"', 'name="arm_1"')
    at = text.index('<joint name="arm_1"')
    end = text.index("</joint>", at) + len("</joint>")
    # Before the link, which it must not hide.
    joint, text = text[at:end], text[:at] + text[end:]
    text = text.replace('<link name="arm_1">', f'{joint}<link name="arm_1">')
    right = inverse_dynamics(load(path), *np.zeros((3, 2)))
    path.write_text(text.replace('version="1.9"', 'version="1.6"'))
    np.testing.assert_allclose(inverse_dynamics(load(path), *np.zeros((3, 2))), right, rtol=1e-9)
    path.write_text(text)
    with pytest.raises(ParameterError) as error:
        read_urdf(path)
    assert error.value.value == "arm_1"


def test_a_joint_from_the_moving_link_to_the_ground_counts_the_other_way(tmp_path):
    old = "<parent>world</parent><child>arm_1</child>"
    new = '<pose relative_to="arm_1"/><parent>arm_1</parent><child>world</child>'
    flip = np.array([1.0, -1.0])
    robot, turned = load(five_bar(tmp_path)), load(five_bar(tmp_path, old, new))
    q, qd, qdd = random_motion(robot, np.random.default_rng(3), 5)[:3]
    right = inverse_dynamics(robot, q, qd, qdd)
    found = inverse_dynamics(turned, flip * q, flip * qd, flip * qdd)
    np.testing.assert_allclose(flip * found, right, rtol=1e-9)


@pytest.mark.parametrize("lead", [0.005, -0.02])
@pytest.mark.parametrize("tag", ["thread_pitch", "screw_thread_pitch"])
def test_a_screw_there_and_back(lead, tag, tmp_path):
    robot = driven(lead, [0.02, 0.0, 0.1])
    text = robot_sdf(robot)
    if tag == "screw_thread_pitch":
        start, end = text.index("<thread_pitch>"), text.index("</thread_pitch>")
        text = f"{text[:start]}<{tag}>{lead}</{tag}>{text[end + len('</thread_pitch>') :]}"
    path = tmp_path / "quill.sdf"
    path.write_text(text)
    motion = random_motion(robot, np.random.default_rng(4), 5)
    right = inverse_dynamics(robot, *motion)
    found = torques(path, (motion[0] - robot.graph.home, *motion[1:]))
    np.testing.assert_allclose(found, right, atol=1e-4 * np.abs(right).max())


def test_a_weld_of_a_plugin_closes_a_loop_as_a_joint_does(tmp_path):
    found = load(five_bar(tmp_path, tip=PIN), platform="tool")
    # The same with the pin as a part of the forearm.
    weld = '<joint name="weld" type="fixed"><parent>fore_1</parent><child>pin</child></joint>'
    own = PIN[: PIN.index("<plugin")] + weld
    same(found, load(five_bar(tmp_path, tip=own), platform="tool"))


def test_links_without_weight_are_a_machine_without_gravity_and_said(tmp_path):
    path = edited(tmp_path, {"<inertial>": "<gravity>0</gravity><inertial>"})
    with pytest.warns(UserWarning, match="gravity is switched off"):
        assert read_urdf(path)["gravity"] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("mark", ["effort", "name_mot"])
def test_motors_without_a_plugin(mark, tmp_path):
    path = five_bar(tmp_path, motors="")
    if mark == "name_mot":
        path.with_suffix(".yaml").write_text("name_mot: [m2, m1]\n")
    else:
        axis = "<axis><xyz>0 0 1</xyz></axis>"
        text, limit = path.read_text(), "<limit><effort>5</effort><velocity>-1</velocity></limit>"
        path.write_text(text.replace(axis, axis.replace("</axis>", f"{limit}</axis>")))
    joints = read_urdf(path)["joints"]
    assert {n for n, joint in joints.items() if joint.get("actuated")} == {"m1", "m2"}
    assert joints["m1"].get("limits", {"effort": 5.0}) == {"effort": 5.0}


def test_a_model_without_motors_is_rejected(tmp_path):
    with pytest.raises(ParameterError, match="no joint is marked as actuated"):
        read_urdf(five_bar(tmp_path, motors=""))


LEFT_OUT = {
    "inertial": (r"<inertial>.*?</inertial>", "mass, ixx, iyy, izz", 1.0, [1.0, 1.0, 1.0]),
    "mass": (r"<mass>.*?</mass>", "mass:", 1.0, [1e-4, 2e-3, 2e-3]),
    "misspelt": (r"mass>", "mass:", 1.0, [1e-4, 2e-3, 2e-3]),
    "inertia": (r"<inertia>.*?</inertia>", "ixx, iyy, izz", 0.4, [1.0, 1.0, 1.0]),
    "ixx": (r"<ixx>.*?</ixx>", "ixx:", 0.4, [1.0, 2e-3, 2e-3]),
}


@pytest.mark.parametrize("part", LEFT_OUT)
def test_what_is_left_out_is_a_kilogram_and_said(part, tmp_path):
    pattern, words, mass, inertia = LEFT_OUT[part]
    path = five_bar(tmp_path)
    head, link, tail = path.read_text().partition('<link name="fore_2">')
    left, end, tail = tail.partition("</link>")
    left = re.sub(pattern, "mas>" if part == "misspelt" else "", left, flags=re.DOTALL)
    path.write_text(head + link + left + end + tail)
    with pytest.warns(UserWarning, match=f"fore_2 .*{words}"):
        body = read_urdf(path)["bodies"]["fore_2"]
    assert body["mass"] == mass
    matrix = np.array(body["inertia"])
    found = np.linalg.eigvalsh(np.diag(matrix) if matrix.ndim == 1 else matrix)
    np.testing.assert_allclose(found, sorted(inertia), rtol=1e-9)


MODEL = '<model name="five_bar">'
FRAME = """<frame name="F"><pose>1 0 0 0.4 0 0</pose></frame>
<frame name="G" attached_to="F"><pose>0 2 0 0 0.3 0</pose></frame>"""
M1 = """<joint name="m1" type="revolute"><parent>world</parent><child>arm_1</child>
 <axis><xyz>0 0 1</xyz></axis></joint>"""
SAME = {
    "gravity where SDF had it until 1.5": (
        {"<gravity>0 -9.81 0</gravity>": "<physics><gravity>1 2 3</gravity></physics>"},
        {"0 -9.81 0": "1 2 3"},
    ),
    "a frame of the world": (
        {MODEL: f'{FRAME}{MODEL}<pose relative_to="G">0 0 3 0 0 0.2</pose>'},
        {MODEL: f"{MODEL}<pose>{{}}</pose>"},
    ),
    "a joint of the world": (
        {
            M1: "",
            "<static>1</static>": '<static>1</static><link name="g"/>',
            MODEL: M1.replace("world", "ground::g").replace(">arm_1", ">five_bar::arm_1") + MODEL,
        },
        {},
    ),
    "names as this reader makes them": ({'"e1"': '"tool_frame"', '"e2"': '"world_fixed"'}, {}),
}


@pytest.mark.parametrize("way", SAME)
def test_what_stands_in_the_world_is_the_same_machine(way, tmp_path):
    frames = Rotation.from_euler("xyz", [0.4, 0, 0]), Rotation.from_euler("xyz", [0, 0.3, 0])
    turn = frames[0] * frames[1]
    at = frames[0].apply([0, 2, 0]) + turn.apply([0, 0, 3])
    angles = (turn * Rotation.from_euler("xyz", [0, 0, 0.2])).as_euler("xyz")
    there = text_of([at[0] + 1, *at[1:], *angles])
    robots = [
        load(edited(tmp_path, {k: v.replace("{}", there) for k, v in one.items()}), platform="tool")
        for one in SAME[way]
    ]
    same(*robots)


def test_a_joint_of_the_world_may_be_called_as_one_of_the_model(tmp_path):
    right = load(five_bar(tmp_path), platform="tool")
    old, new = "<xyz>0 0 1</xyz></axis></joint>", "<xyz>0 0 1</xyz>{}</axis></joint>"
    new = new.format("<limit><effort>5</effort></limit>")
    own = M1.replace(old, new).replace("m1", "e1")
    own = own.replace("world", "ground::g").replace(">arm", ">five_bar::arm")
    changes = {
        M1: "",
        old: new,
        "<static>1</static>": '<static>1</static><link name="g"/>',
        MODEL: own + MODEL,
    }
    found = load(edited(tmp_path, changes, motors=""), platform="tool")
    assert found.joint_names == ("m2", "e1_of_world")
    same(found, right)


@pytest.mark.parametrize(
    ("limit", "right"),
    [
        ("<lower>-1</lower>", [-1.0, TURN]),
        ("<upper>1</upper>", [-TURN, 1.0]),
        ("<lower>-1</lower><upper>2</upper>", [-1.0, 2.0]),
        ("<effort>3</effort>", None),
    ],
)
def test_a_range_may_have_one_end(limit, right, tmp_path):
    axis = "<xyz>0 0 1</xyz></axis>"
    path = five_bar(tmp_path, axis, axis.replace("</axis>", f"<limit>{limit}</limit></axis>"))
    assert read_urdf(path)["joints"]["m1"]["limits"].get("position") == right


FINGER = """<link name="{name}"/><joint name="{name}_hinge" type="revolute"><parent>{on}</parent><child>{name}</child>
 <axis><xyz>0 0 1</xyz>{mimic}</axis></joint>"""


@pytest.mark.parametrize(("leader", "counts"), [("finger_hinge", False), ("m1", True), ("e2", True)])
def test_a_joint_that_follows_another_matters_where_one_of_both_belongs_to_the_machine(leader, counts, tmp_path):
    fingers = FINGER.format(name="finger", on="world", mimic="")
    fingers += FINGER.format(name="tip_of_it", on="finger", mimic=f'<mimic joint="{leader}"/>')
    path = five_bar(tmp_path, "</model></world>", f"{fingers}</model></world>")
    if counts:
        with pytest.raises(ParameterError, match=r"tip_of_it_hinge\.mimic"):
            load(path, platform="tool", base="world")
        return
    robot = load(path, platform="tool", base="world")
    assert "finger" not in robot.graph.bodies
    right = load(five_bar(tmp_path), platform="tool")
    np.testing.assert_array_equal(robot.inverse(right.home()), right.inverse(right.home()))


REJECTED = {
    "version": ('version="1.9"', 'version="2.0"', "sdf.version"),
    "type": ('type="continuous"', 'type="gearbox"', "joint.e1.type"),
    "circle": ('relative_to="arm_1"', 'relative_to="fore_1"', "fore_1.pose"),
    "frame": ('relative_to="arm_1"', 'relative_to="arm"', "link.fore_1.pose"),
    "parent": ("<parent>arm_1</parent>", "<parent>arm</parent>", "joint.e1.parent"),
    "one link": ("<parent>arm_1</parent>", "<parent>fore_1</parent>", "joint.e1"),
    "static": ("<static>1</static>", "<static>maybe</static>", "ground.static"),
    "two models": ("<static>1</static>", "<static>0</static>", "five_bar.sdf"),
    "mass": ("<mass>0.4</mass>", "<mass>-1</mass>", "link.arm_1.inertial.mass"),
    "auto": ("<inertial>", '<inertial auto="true">', "link.arm_1.inertial.auto"),
    "degrees": ('<pose relative_to="arm_1"', '<pose degrees="yes" relative_to="arm_1"', "link.fore_1.pose.degrees"),
    "include": ('<link name="fore_2">', '<include/><link name="fore_2">', "include"),
    "weight": ('<link name="fore_2">', '<link name="fore_2"><gravity>0</gravity>', "link.fore_2.gravity"),
    "motor": ("<joint_name>m2</joint_name>", "<joint_name>m3</joint_name>", "plugin"),
    "mimic": ("<xyz>0 0 1</xyz></axis>", '<xyz>0 0 1</xyz><mimic joint="m1"/></axis>', "joint.m1.mimic"),
    "frame of the world": (MODEL, f'{MODEL}<pose relative_to="none"/>', "model.five_bar.pose"),
    "joint of the world": (MODEL, M1.replace("m1", "j").replace("arm_1", "five_bar::none") + MODEL, "joint.j.child"),
    "no model": (MODEL, f"{MODEL}<static>1</static>", "five_bar.sdf"),
    "xacro": ("<static>1</static>", "<xacro:include/>", "five_bar.sdf"),
    "two worlds": ("</sdf>", '<world name="moon"><gravity>0 0 -1.62</gravity></world></sdf>', "five_bar.sdf"),
    "world and model": ("</sdf>", '<model name="free"><static>1</static></model></sdf>', "five_bar.sdf"),
    "world in a model": (MODEL, f'{MODEL}<world name="moon"/>', "model.five_bar.world.moon"),
}


@pytest.mark.parametrize("case", sorted(REJECTED))
def test_what_is_rejected_is_named(case, tmp_path):
    old, new, field = REJECTED[case]
    with pytest.raises(ParameterError) as error:
        read_urdf(five_bar(tmp_path, old, new))
    assert error.value.field.endswith(field)
    assert error.value.value not in ("None", [])
