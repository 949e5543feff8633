# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What the elements of a URDF, and of the YAML file next to it, become in the description."""

from __future__ import annotations

import re

import numpy as np
import pytest

from pkm_twin.errors import ParameterError, RobotWarning
from pkm_twin.machine import urdf_file, urdf_xml
from pkm_twin.robot.urdf_read import read_urdf

pytest.importorskip("pinocchio")


from .sketches import Z, five_bar
from .small_urdf import small

pytestmark = pytest.mark.usefixtures("quickly_compiled")


def test_limits_and_friction_are_read(tmp_path):
    joints = read_urdf(five_bar().save(tmp_path))["joints"]
    assert list(joints) == ["m2", "m1", "e1", "e2", "tip"]
    # Nine radians either way are no limit.
    assert joints["m1"]["limits"] == {"velocity": 7.0, "effort": 50.0}
    assert "limits" not in joints["e1"]
    assert joints["m1"]["friction"] == joints["e1"]["friction"] == {"viscous": 0.1, "coulomb": 0.2}
    assert "friction" not in joints["tip"]


def test_links_that_are_fixed_together_are_one_body(tmp_path):
    data = read_urdf(small(tmp_path))
    assert data["platform"] == "tool"
    np.testing.assert_allclose(data["origin"], [0.5, 0.0, 0.5], atol=1e-14)
    assert list(data["bodies"]) == ["tool"]
    body = data["bodies"]["tool"]
    assert body["mass"] == 4.0
    np.testing.assert_allclose(body["com"], [(0.1 + 3 * 0.3) / 4, 0.0, 0.5], atol=1e-14)
    # Two parts 0.2 m apart along x; the second one's x and z are the body's z and x.
    across = 0.75 * 0.2**2
    np.testing.assert_allclose(body["inertia"], [0.2, 0.2 + across, 0.3 + across], atol=1e-12)
    assert data["joints"]["motor"] == {
        "type": "revolute",
        "between": ["base", "tool"],
        "at": [0.0, 0.0, 0.5],
        "axis": [0.0, 0.0, 1.0],
        "actuated": True,
        "limits": {"position": [-1.0, 1.0], "velocity": 4.0, "effort": 3.0},
    }


def test_another_link_can_be_the_ground(tmp_path):
    data = read_urdf(small(tmp_path), platform="world", base="bob")
    assert data["platform"] == "world"
    np.testing.assert_allclose(data["origin"], [0.5, 0.0, -0.2], atol=1e-14)
    assert data["bodies"]["world"]["mass"] == 2.0
    assert data["joints"]["motor"]["between"] == ["world", "base"]
    np.testing.assert_allclose(data["joints"]["motor"]["axis"], [-1.0, 0.0, 0.0], atol=1e-14)


def test_a_moving_link_may_be_called_like_the_ground(tmp_path):
    path = small(tmp_path, '"bob"', '"x"')
    path.write_text(path.read_text().replace('"crank"', '"base"').replace('"tool"', '"end"'))
    data = read_urdf(path, platform="base")
    assert data["platform"] == "base_" and list(data["bodies"]) == ["base_"]


def test_what_hangs_loose_is_no_spin(tmp_path):
    path = five_bar().save(tmp_path)
    loose = (
        '<link name="charm"><inertial><mass value="0.1"/>'
        '<inertia ixx="1e-4" iyy="1e-4" izz="1e-4"/></inertial></link>'
        '<joint name="chain" type="continuous"><parent link="arm_1"/><child link="charm"/>'
        '<axis xyz="0 1 0"/></joint></robot>'
    )
    path.write_text(path.read_text().replace("</robot>", loose))
    assert read_urdf(path)["joints"]["chain"]["type"] == "revolute"


def test_a_chosen_type_of_the_yaml_file_replaces_a_joint(tmp_path):
    beside = "name_mot: [motor]\njoint_name: [weld]\njoint_type: [SPHERICAL]\n"
    path = small(tmp_path, beside=beside)
    with pytest.raises(ParameterError, match="no loop closure, and passive joints: weld"):
        read_urdf(path)
    closed = beside.replace("SPHERICAL", "UJOINT_XZ") + "closed_loop: [[tip, world]]\ntype: [3d]\n"
    path = small(tmp_path, 'xyz="0 0 0.3"', 'xyz="0 0 0.3"', closed)
    path.write_text(path.read_text().replace('xyz="0 0 0.5"', 'xyz="0.5 0 0"'))
    joints = read_urdf(path)["joints"]
    assert joints["weld"]["type"] == "universal"
    first, second = joints["weld"]["axes"]
    assert abs(np.dot(first, second)) < 1e-12
    assert joints["tip_world"]["type"] == "spherical" and joints["tip_world"]["at"] == [0, 0, 0]


def test_an_empty_or_foreign_yaml_file_is_passed_over(tmp_path):
    expected = read_urdf(small(tmp_path))
    for content in ("", "mechanism: machine\nbodies: {}\n"):
        assert read_urdf(small(tmp_path, beside=content)) == expected


def test_what_looks_like_millimetres_or_degrees_is_asked(tmp_path):
    with pytest.warns(UserWarning, match=r"joint.weld.origin: .* 200 m; .* millimetres\?"):
        read_urdf(small(tmp_path, 'xyz="0.2 0 0"', 'xyz="200 0 0"'))
    with pytest.warns(UserWarning, match=r"joint.weld.rpy: .*degrees\?"):
        read_urdf(small(tmp_path, "1.5707963267948966", "90"))


def test_a_quaternion_serves_as_well_as_angles(tmp_path):
    expected = read_urdf(small(tmp_path))
    half = repr(float(np.sqrt(0.5)))
    turned = read_urdf(small(tmp_path, 'rpy="0 1.5707963267948966 0"', f'quat_xyzw="0 {half} 0 {half}"'))
    np.testing.assert_allclose(turned["bodies"]["tool"]["inertia"], expected["bodies"]["tool"]["inertia"])
    np.testing.assert_allclose(turned["origin"], expected["origin"], atol=1e-14)


def test_a_tree_whose_joints_are_all_driven_needs_no_closure(tmp_path):
    assert np.allclose(read_urdf(small(tmp_path))["joints"]["motor"]["axis"], Z)


MARKS = {
    "transmission": (
        '<transmission name="t"><type>transmission_interface/SimpleTransmission</type>'
        '<joint name="motor"/><actuator name="a"/></transmission>'
    ),
    "plugin": (
        '<gazebo><plugin name="gz::sim::systems::JointPositionController">'
        "<joint_name>motor</joint_name></plugin></gazebo>"
    ),
}


@pytest.mark.parametrize("mark", [*MARKS, "true", "True", "1", "TRUE", " true "])
def test_what_marks_a_motor(mark, tmp_path):
    path = small(tmp_path)
    head, _, _ = path.read_text().partition("<ros2_control")
    path.write_text(head + MARKS.get(mark, "") + "</robot>")
    if mark not in MARKS:
        old = '<joint name="motor" type="revolute"'
        path.write_text(path.read_text().replace(old, f'{old} independent="{mark}"'))
    assert read_urdf(path)["joints"]["motor"]["actuated"]


def bounded(kind, **bounds):
    """A joint of ros2_control with bounds of one command interface."""
    params = "".join(f'<param name="{key}">{value}</param>' for key, value in bounds.items())
    return f'<joint name="motor"><command_interface name="{kind}">{params}</command_interface>'


@pytest.mark.parametrize(
    ("kind", "bounds", "limits"),
    [
        ("position", {"min": -0.5, "max": 9.0}, {"position": [-0.5, 1.0]}),
        ("position", {"max": 0.25}, {"position": [-1.0, 0.25]}),
        ("velocity", {"min": -2.5, "max": 3.5}, {"velocity": 2.5}),
        ("effort", {"max": 2.0}, {"effort": 2.0}),
        ("effort", {"min": -9.0, "max": 9.0}, {}),
        ("position", {"min": "inf"}, "ros2_control.motor.position"),
        ("position", {"min": 1.5}, "ros2_control.motor.position"),
        ("velocity", {"max": "fast"}, "ros2_control.motor.velocity"),
    ],
)
def test_the_bounds_of_a_command_interface_are_limits(kind, bounds, limits, tmp_path):
    path = small(tmp_path, '<joint name="motor">\n  <command_interface name="effort"/>', bounded(kind, **bounds))
    if isinstance(limits, str):
        with pytest.raises(ParameterError, match=limits):
            read_urdf(path)
        return
    stated = {"position": [-1.0, 1.0], "velocity": 4.0, "effort": 3.0}
    assert read_urdf(path)["joints"]["motor"]["limits"] == stated | limits
    path.write_text(path.read_text().replace("</command_interface>", '<limits enable="false"/></command_interface>'))
    assert read_urdf(path)["joints"]["motor"]["limits"] == stated


def test_bounds_that_are_not_limits_are_said(tmp_path):
    path = small(tmp_path, '<joint name="motor">\n  <command_interface name="effort"/>', bounded("jerk", max=3.0))
    with pytest.warns(RobotWarning, match=r"ros2_control\.motor.*jerk"):
        read_urdf(path)


@pytest.mark.parametrize("value", ["yes", "", "2", "truee"])
def test_a_truth_value_that_is_none_is_named(value, tmp_path):
    old = '<joint name="motor" type="revolute"'
    path = small(tmp_path, old, f'{old} independent="{value}"')
    head, _, _ = path.read_text().partition("<ros2_control")
    path.write_text(head + "</robot>")
    with pytest.raises(ParameterError) as error:
        read_urdf(path)
    assert error.value.field == "joint.motor.independent"


CLOSURES = {
    "plugin": (
        '<plugin name="gz::sim::systems::DetachableJoint"><parent_link>fore_1</parent_link>'
        "<child_model>ROBOT</child_model><child_link>pin</child_link></plugin>"
    ),
    "joint": '<joint name="weld" type="fixed"><parent>fore_1</parent><child>pin</child></joint>',
}


@pytest.mark.parametrize("kind", sorted(CLOSURES))
def test_gazebo_s_ways_to_close_a_loop(kind, tmp_path):
    """A pin on the second forearm that is welded to the first, as it is drawn."""
    path = five_bar().save(tmp_path)
    text = path.read_text()
    tree, _, rest = text.partition("<constraint")
    constraint, _, rest = rest.partition("</constraint>")
    origin = re.search(r"<child_origin ([^>]*)/>", constraint)[1]
    axis = re.search(r'<(?:child|parent)_axis xyz="([^"]*)"', constraint)[1]
    pin = (
        '<link name="pin"/><joint name="fore_1_pin" type="continuous"><parent link="platform"/>'
        f'<child link="pin"/><origin {origin}/><axis xyz="{axis}"/></joint>'
    )
    closure = CLOSURES[kind].replace("ROBOT", re.search(r'<robot name="([^"]*)"', text)[1])
    path.write_text(f"{tree}{pin}<gazebo>{closure}</gazebo>{rest}")
    tree = urdf_file.read(path, urdf_xml.parse_xml(path))
    (weld,) = tree.closures
    assert weld.kind == "fixed"
    first, second = weld.frames
    np.testing.assert_allclose(first.position, second.position, atol=1e-14)
    np.testing.assert_allclose(first.rotation, second.rotation, atol=1e-14)
    data = read_urdf(path, platform="platform")
    assert sum(joint.get("actuated", False) for joint in data["joints"].values()) == 2


def test_a_plugin_that_holds_another_model_is_left_out(tmp_path):
    other = (
        '<gazebo><plugin name="gz::sim::systems::DetachableJoint"><parent_link>tool</parent_link>'
        "<child_model>cube</child_model><child_link>link</child_link></plugin></gazebo></robot>"
    )
    with pytest.warns(UserWarning, match="cube"):
        assert read_urdf(small(tmp_path, "</robot>", other)) == read_urdf(small(tmp_path))


def test_a_word_in_a_place_that_nothing_reads_is_passed_over(tmp_path):
    shown = '<link name="tool"><visual><origin xyz="velocity 0 0"/></visual></link>'
    changed = read_urdf(small(tmp_path, '<link name="tool"/>', shown))
    assert changed == read_urdf(small(tmp_path))
