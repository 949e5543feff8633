# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Elements that change a machine's motion in a simulator: read, warned of or rejected by name."""

import re
import warnings

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import ParameterError
from pkm_twin.robot.robot_urdf import robot_mjcf, robot_sdf, robot_urdf
from test.support.robots import load

pytestmark = pytest.mark.usefixtures("quickly_compiled")
WRITERS = {"urdf": robot_urdf, "sdf": robot_sdf, "xml": robot_mjcf}
FIVE_BAR = load("five_bar")
FIRST = FIVE_BAR.joint_names[0]
PASSIVE = FIVE_BAR.passive_joints[0]
PLUGIN = '<plugin name="{}" filename="x"/>'

URDF = {
    '<gazebo reference="platform"><turnGravityOff>true</turnGravityOff></gazebo>': "read",
    '<gazebo reference="arm_left"><turnGravityOff>true</turnGravityOff></gazebo>': "left.gravity",
    '<gazebo reference="arm_left"><gravity>0</gravity></gazebo>': "left.gravity",
    '<gazebo reference="arm_left"><turnGravityOff>no</turnGravityOff></gazebo>': "turnGravityOff",
    f'<gazebo reference="{PASSIVE}"><springStiffness>3</springStiffness></gazebo>': "spring",
    f'<gazebo reference="{PASSIVE}"><springStiffness>0</springStiffness></gazebo>': "read",
    '<gazebo reference="arm_left"><dampingFactor>0.1</dampingFactor></gazebo>': "damping",
    '<gazebo reference="arm_left"><kinematic>true</kinematic></gazebo>': "kinematic",
    f"<gazebo>{PLUGIN.format('libgazebo_mimic_joint_plugin.so')}</gazebo>": "mimic",
    f"<gazebo>{PLUGIN.format('gz::sim::systems::Buoyancy')}</gazebo>": "Buoyancy",
    '<drake:ball_constraint name="b"/>': "drake:ball_constraint",
    "<drake:linear_bushing_rpy/>": "drake:linear_bushing_rpy",
    '<drake:joint name="j" type="planar"><drake:parent_frame/></drake:joint>': "drake:joint",
    '<force_element name="f"><torsional_spring/></force_element>': "force_element",
    '<coupling name="c"/>': "coupling",
    f'<transmission name="t"><joint name="{FIRST}"/><actuator name="a">'
    '<drake:rotor_inertia value="0.1"/></actuator></transmission>': "rotor",
    '<loop_joint name="l" type="gear"/>': "loop_joint.l.type",
    '<loop_joint name="l" type="spherical"><link1 link="arm_left"/></loop_joint>': "l.link2",
    "<wormhole/>": "wormhole",
    "<gazebo><gravity>0 0 0</gravity></gazebo>": "gazebo.gravity",
    '<joint name="j" type="fixed"><parent link="arm_left"/><child link="l"/><safety_controller/></joint>'
    '<link name="l"/>': "joint.safety_controller",
    '<joint name="j" type="fixed"><parent link="arm_left"/><child link="l"/><dynamics spring_stiffness="1"/></joint>'
    '<link name="l"/>': "joint.dynamics.spring_stiffness",
    '<joint name="j" type="fixed"><parent link="arm_left"/><child link="l"/><drake:mimic joint="x"/></joint>'
    '<link name="l"/>': "drake:mimic",
    '<joint name="j" type="fixed"><parent link="arm_left"/><child link="l"/><origin xyz="0 0 0"/></joint>'
    '<link name="l"><visual><drake:x/></visual><contact/></link>': "read",
}
SDF = {
    "<link><gravity>false</gravity></link>": "gravity",
    "<link><kinematic>true</kinematic></link>": "kinematic",
    "<link><velocity_decay><linear>0.1</linear></velocity_decay></link>": "damping",
    "<link><velocity_decay><linear>0</linear></velocity_decay></link>": "read",
    "<link><enable_wind>true</enable_wind></link>": "wind",
    "<axis><dynamics><spring_stiffness>2</spring_stiffness></dynamics></axis>": "spring",
    '<axis><mimic joint="x"/></axis>': "mimic",
    "<joint><gearbox_ratio>2</gearbox_ratio></joint>": "gearbox_ratio",
    "<joint><drake:rotor_inertia>0.1</drake:rotor_inertia></joint>": "rotor",
    '<joint><drake:mimic joint="x"/></joint>': "drake:mimic",
    '<model><drake:joint name="j"/></model>': "drake:joint",
    "<model><drake:ball_constraint/></model>": "drake:ball_constraint",
    f"<model>{PLUGIN.format('gz::sim::systems::Hydrodynamics')}</model>": "Hydrodynamics",
    f"<model>{PLUGIN.format('MimicJointSystem')}</model>": "Mimic",
    '<model><drake:tendon_constraint name="t"/></model>': "drake:tendon_constraint",
    "<link><collision name='c'><drake:proximity_properties/></collision></link>": "read",
}
MJCF = {
    '<option><flag gravity="disable"/></option>': "gravity",
    '<option><flag equality="disable"/></option>': "equality",
    '<option density="1.2"/>': "fluid",
    '<default><joint stiffness="2"/></default>': "spring",
    '<worldbody><body gravcomp="1"><geom size="0.1" mass="1"/></body></worldbody>': "gravcomp",
    '<worldbody><body name="ball"><freejoint/><inertial pos="0 0 0" mass="1" '
    'diaginertia="1 1 1"/></body></worldbody>': "link.ball",
    f'<actuator><motor name="none" joint="{FIRST}" gear="0"/></actuator>': "actuator.none.gear",
}


def outcome(folder, ending, text):
    """Warnings and the error of a file, as one text; and the robot, if it is read."""
    path = folder / f"machine.{ending}"
    path.write_text(text)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            robot, error = load(path, platform="platform"), None
        except ParameterError as raised:
            robot, error = None, raised
    about = [str(one.message) for one in told if str(one.filename) == str(path)]
    return " ".join([*about, str(error or "")]), robot


def judge(found, robot, wanted, plain):
    """An element that is read leaves no word more; any other is named."""
    if wanted == "read":
        assert robot is not None
    else:
        assert wanted in found and wanted not in plain


@pytest.mark.parametrize("element", URDF)
def test_an_element_of_a_urdf(element, tmp_path):
    text = robot_urdf(FIVE_BAR)
    (tmp_path / "plain").mkdir()
    plain, _ = outcome(tmp_path / "plain", "urdf", text)
    found, robot = outcome(tmp_path, "urdf", text.replace("</robot>", f"{element}</robot>"))
    judge(found, robot, URDF[element], plain)


@pytest.mark.parametrize("element", SDF)
def test_an_element_of_an_sdf(element, tmp_path):
    text = robot_sdf(FIVE_BAR)
    (tmp_path / "plain").mkdir()
    plain, _ = outcome(tmp_path / "plain", "sdf", text)
    tag, inside = element[1 : element.index(">")], element[element.index(">") + 1 :]
    inside = inside[: inside.rindex("</")]
    before, end, after = text.rpartition(f"</{tag}>")
    found, robot = outcome(tmp_path, "sdf", before + inside + end + after)
    judge(found, robot, SDF[element], plain)


@pytest.mark.parametrize("element", MJCF)
def test_an_element_of_an_mjcf(element, tmp_path):
    pytest.importorskip("mujoco")
    text = robot_mjcf(FIVE_BAR)
    (tmp_path / "plain").mkdir()
    plain, _ = outcome(tmp_path / "plain", "xml", text)
    found, robot = outcome(tmp_path, "xml", text.replace("</mujoco>", f"{element}</mujoco>"))
    judge(found, robot, MJCF[element], plain)


@pytest.mark.parametrize("ending", WRITERS)
def test_a_machine_without_gravity_carries_no_weight(ending, tmp_path):
    text = WRITERS[ending](FIVE_BAR.changed(friction={"coulomb": [0.0, 0.0]}))
    links = re.findall(r'<link name="([^"]+)"', text)
    off = {
        "urdf": "".join(f'<gazebo reference="{name}"><turnGravityOff>1</turnGravityOff></gazebo>' for name in links)
        + "</robot>",
        "sdf": "<gravity>0</gravity></link>",
        "xml": '<option><flag gravity="disable"/></option></mujoco>',
    }[ending]
    words, robot = outcome(tmp_path, ending, text.replace(off[off.rindex("<") :], off))
    assert robot is not None, words
    assert "gravity is switched off" in words and not robot.gravity.any()
    q = robot.inverse(robot.home())
    np.testing.assert_allclose(inverse_dynamics(robot, q, 0.0 * q, 0.0 * q), 0.0, atol=1e-12)


@pytest.mark.parametrize(("kind", "axis"), [("spherical", ""), ("revolute", '<axis xyz="0 1 0"/>')])
def test_a_loop_joint_closes_a_loop(kind, axis, tmp_path):
    """As Isaac Sim writes it: the same machine as with the project's own element."""
    text = re.sub(r'<dynamics damping="0.002".*/>', "", robot_urdf(FIVE_BAR))
    start, end = text.index("<constraint"), text.index("</constraint>") + len("</constraint>")
    loop = (
        f'<loop_joint name="tip" type="{kind}"><link1 link="forearm_left" xyz="0.16 0 0.22"/>'
        f'<link2 link="forearm_right" xyz="-0.16 0 0.22"/>{axis}</loop_joint>'
    )
    _, exact = outcome(tmp_path, "urdf", text)
    words, robot = outcome(tmp_path, "urdf", text[:start] + loop + text[end:])
    assert robot is not None, words
    q = np.array([0.05, -0.03]) + exact.inverse(exact.home())
    found, expected = (inverse_dynamics(one, q, np.array([0.3, -0.2]), np.array([1.0, 2.0])) for one in (robot, exact))
    np.testing.assert_allclose(found, expected, 1e-9)


def test_a_loop_whose_joints_are_all_motors_asks_which_are(tmp_path):
    """An effort limit of every joint, as Gazebo's examples have it."""
    text = robot_sdf(FIVE_BAR)
    text = re.sub(r"<plugin.*?</plugin>", "", text, flags=re.DOTALL)
    none, _ = outcome(tmp_path, "sdf", re.sub(r"<effort>.*?</effort>", "", text))
    assert "no joint is marked as actuated" in none and "<effort>" in none
    every = re.sub(r"<limit>.*?</limit>", "", text, flags=re.DOTALL)
    every = every.replace("</axis>", "<limit><effort>9</effort></limit></axis>")
    words, robot = outcome(tmp_path, "sdf", every)
    assert robot is None
    assert "5 actuated joints" in words and "(2)" in words and "limit.effort" in words
