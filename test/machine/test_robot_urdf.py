# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Shipped robots as URDFs: Pinocchio puts platform and loops where the robot says."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import yaml

from delta_dynamics import inverse_dynamics
from pkm_twin import robot_names
from pkm_twin.errors import ParameterError
from pkm_twin.machine import urdf_file, urdf_xml
from pkm_twin.machine.names import plain_name
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.mechanisms.machine import Machine
from pkm_twin.robot import robot_urdf as writing
from pkm_twin.robot.robot_urdf import (
    joint_names,
    robot_description,
    robot_mjcf,
    robot_sdf,
    robot_urdf,
)
from pkm_twin.robot.urdf_read import read_urdf
from test.machine.random_machines import plain
from test.support.mapped import sides
from test.support.robots import load, partly_long, random_joints

pytest.importorskip("pinocchio")

import pinocchio as pin

from .sketches import closure_rows

STATES = 50


CELLS = ("delta_cu", "five_bar", "linear_delta", "rps3", "upr_rpu")


@pytest.fixture(params=partly_long(CELLS, *CELLS[:3]), scope="module")
def cell(request):
    """A robot on both sides of a joint map: some joints have the controller's name of another."""
    both = sides(request.param)
    joint_map = dict(both.data["joint_map"])
    first, second, *_ = both.plain.joint_names
    joint_map[first] = joint_map[first] | {"name": second}
    joint_map[second] = {k: v for k, v in joint_map[second].items() if k != "name"}
    joint_map[second] |= {"name": both.plain.passive_joints[0]}
    mapped = robot_of_data(both.data | {"joint_map": joint_map}, "cell")
    return dataclasses.replace(both, mapped=mapped, names=list(mapped.controller.names))


@pytest.fixture(params=partly_long(robot_names(), "delta_cu", "rps3"), scope="module")
def robot(request):
    return load(request.param).changed(payload={"mass": 0.3, "com": [0.01, 0.02, -0.05]})


@pytest.fixture(scope="module")
def states(robot):
    """Joint positions about home, shape (STATES, n)."""
    home = robot.inverse(robot.home())
    rng = np.random.default_rng(4)
    return home + rng.uniform(-0.05, 0.05, (STATES, len(home))) * robot.graph.size


def configuration(model, robot, q, passive):
    found = np.zeros(model.nq)
    names = (*robot.joint_names, *robot.passive_joints)
    for name, value in zip(names, (*q, *passive), strict=True):
        found[model.joints[model.getJointId(name)].idx_q] = value
    return found


def test_the_platform_stands_where_the_robot_says_and_all_loops_are_closed(robot, states, tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text(robot_urdf(robot))
    model = pin.buildModelFromUrdf(str(path))
    assert model.nq == model.nv == len(robot.joint_names) + len(robot.passive_joints)
    ends = []
    tree = urdf_file.read(path, urdf_xml.parse_xml(path))
    for closure in tree.closures:
        pair = []
        for link, drawn in zip((closure.inner, closure.outer), closure.frames, strict=True):
            at = tree.links[link].frame.inverse() @ drawn
            body = model.frames[model.getFrameId(link, pin.BODY)]
            place = body.placement * pin.SE3(at.rotation, at.position)
            frame = pin.Frame(f"{closure.name}_{link}", body.parentJoint, place, pin.OP_FRAME)
            pair.append(model.addFrame(frame))
        axis = closure.frames[0].rotation.T @ closure.axes[0] if len(closure.axes) else None
        ends.append((closure.kind, *pair, axis))
    assert ends
    data = model.createData()
    position, rotation = robot.platform(states)
    for q, passive, at, turned in zip(states, robot.passive(states), position, rotation, strict=True):
        residual, _ = closure_rows(model, data, ends, configuration(model, robot, q, passive))
        assert np.abs(residual).max() < 1e-9
        platform = data.oMf[model.getFrameId("platform", pin.BODY)]
        np.testing.assert_allclose(platform.translation, at, atol=1e-9)
        np.testing.assert_allclose(platform.rotation, turned, atol=1e-9)


@pytest.mark.parametrize("name", robot_names())
def test_no_passive_joint_has_a_space_and_the_files_have_the_same_names(name):
    robot = load(name)
    names = {*robot.joint_names, *robot.passive_joints}
    for text in (robot_urdf(robot, hardware=""), robot_mjcf(robot), robot_sdf(robot)):
        root = ET.fromstring(text)
        found = [element.get("name") for element in root.iter("joint") if element.get("name")]
        found += [element.get("name") for element in root.iter("constraint")]
        assert len(set(found)) == len(found)
        assert not any(re.search(r"\s", name) for name in found)
    moving = [j for j in ET.fromstring(robot_urdf(robot)).findall("joint") if j.get("type") != "fixed"]
    assert {joint.get("name") for joint in moving} == names


def test_names_that_differ_only_by_spaces_or_parts_stay_apart():
    original = load("stewart")
    text = yaml.safe_dump(robot_description(original), sort_keys=False)
    names = {"a_1": "foot", "b_1": "foot_1", "a_2": "foot 1", "b_2": "foot I", "a_3": "foot_1_1"}
    for old, new in names.items():
        assert f"foot_{old}" in text
        text = text.replace(f"foot_{old}", new)
    robot = robot_of_data(yaml.safe_load(text), "names")
    names = [*robot.joint_names, *robot.passive_joints]
    assert len(set(names)) == len(names) and not any(" " in name for name in names)
    assert set(pin.buildModelFromXML(robot_urdf(robot)).names[1:]) == set(names)
    q = original.inverse(original.home()) + 0.01 * np.arange(6)
    np.testing.assert_allclose(robot.passive(q), original.passive(q), atol=1e-12)


def test_masses_sum_to_the_robot_s(robot):
    model = pin.buildModelFromXML(robot_urdf(robot))
    graph = robot.graph
    parts = [*graph.bodies.values(), *graph.rods.values()]
    expected = sum(part.mass for part in parts) + 0.3
    assert sum(i.mass for i in model.inertias) == pytest.approx(expected, rel=1e-13)


def test_mock_hardware_begins_inside_the_limits(robot):
    root = ET.fromstring(robot_urdf(robot))
    joints = root.find("ros2_control").findall("joint")
    assert [joint.get("name") for joint in joints] == list(robot.joint_names)
    for joint, most in zip(joints, np.broadcast_to(robot.limits.effort, len(joints)), strict=True):
        for kind, count in (("command_interface", 2), ("state_interface", 3)):
            found = {interface.get("name") for interface in joint.findall(kind)}
            assert len(found) == count and {"position", "effort"} <= found
        limit = root.find(f"joint[@name='{joint.get('name')}']/limit")
        assert most is None or float(limit.get("effort")) == pytest.approx(most, rel=1e-13)
    start = np.array([float(joint.find("state_interface/param").text) for joint in joints])
    limits = robot.limits.position
    if limits is not None:
        assert (limits[:, 0] <= start).all()
        assert (start <= limits[:, 1]).all()


def numbers(element, *names):
    return [float(element.get(name)) for name in names]


def test_a_cell_s_drives_have_the_controller_s_names_and_numbers(cell):
    robot, tree = cell.mapped, ET.fromstring(robot_urdf(cell.mapped))
    joints = {joint.get("name"): joint for joint in tree.findall("joint")}
    controlled = tree.findall("ros2_control/joint")
    assert [joint.get("name") for joint in controlled] == cell.names
    start = np.array([float(j.find("state_interface/param").text) for j in controlled])
    np.testing.assert_allclose(start, cell.positions(robot.graph.home), rtol=1e-12)
    limits, effort = robot.limits, robot.limits.effort
    for k, name in enumerate(cell.names):
        low, high, most = numbers(joints[name].find("limit"), "lower", "upper", "effort")
        assert low <= start[k] <= high
        if limits.position is not None:
            ends = cell.offsets[k] + cell.factors[k] * limits.position[k]
            np.testing.assert_allclose([low, high], np.sort(ends), rtol=1e-12)
        if effort is not None:
            assert most == pytest.approx(effort[k] / abs(cell.factors[k]), rel=1e-12)


def test_a_cell_s_links_follow_the_controller_s_numbers(cell):
    """As robot_state_publisher has it, which knows the joint states of the broadcaster alone."""
    robot, text = cell.mapped, robot_urdf(cell.mapped)
    follows = {
        joint.get("name"): (mimic.get("joint"), *numbers(mimic, "multiplier", "offset"))
        for joint in ET.fromstring(text).findall("joint")
        if (mimic := joint.find("mimic")) is not None
    }
    model = pin.buildModelFromXML(text)
    names = joint_names(robot, "some/Hardware")
    data, n = model.createData(), robot.joints_count
    q = random_joints(robot, np.random.default_rng(5), 20)
    for given, passive, at, turned in zip(cell.positions(q), robot.passive(q), *robot.platform(q), strict=True):
        states = dict(zip(cell.names, given, strict=True))
        states |= dict(zip(names[n:], passive, strict=True))
        for name, (drive, factor, offset) in follows.items():
            states[name] = offset + factor * states[drive]
        found = np.array([states[name] for name in list(model.names)[1:]])
        order = np.argsort([joint.idx_q for joint in list(model.joints)[1:]])
        pin.framesForwardKinematics(model, data, found[order])
        platform = data.oMf[model.getFrameId("platform", pin.BODY)]
        np.testing.assert_allclose(platform.translation, at, atol=1e-9)
        np.testing.assert_allclose(platform.rotation, turned, atol=1e-9)


def test_a_cell_s_description_is_read_back_with_its_joint_map(cell, tmp_path):
    path = tmp_path / "cell.urdf"
    path.write_text(robot_urdf(cell.mapped))
    again = Machine.from_data(read_urdf(path), "again")
    assert again.joint_names == cell.mapped.joint_names
    assert list(again.controller.names) == cell.names
    np.testing.assert_allclose(again.controller.factors, cell.factors, 1e-14)
    np.testing.assert_allclose(again.controller.offsets, cell.offsets, 1e-13)
    q = random_joints(cell.mapped, np.random.default_rng(6), 5)
    expected = inverse_dynamics(cell.mapped, q, 0.0 * q, 1.0 + 0.0 * q)
    found = inverse_dynamics(again, q, 0.0 * q, 1.0 + 0.0 * q)
    np.testing.assert_allclose(found, expected, 0.0, 1e-9 * np.abs(expected).max())
    # Without hardware the description is the model's.
    model, plain = (ET.fromstring(robot_urdf(r, hardware="")) for r in (cell.mapped, cell.plain))
    assert [ET.tostring(e) for e in model] == [ET.tostring(e) for e in plain]


def test_a_cell_s_command_bounds_are_limits_by_its_joint_map(cell, tmp_path):
    path = tmp_path / "cell.urdf"
    path.write_text(robot_urdf(cell.mapped))
    own = Machine.from_data(read_urdf(path), "own").limits
    root = ET.fromstring(path.read_text())
    narrow = own.position @ np.array([[0.75, 0.25], [0.25, 0.75]])
    for k, joint in enumerate(root.findall("ros2_control/joint")):
        size, effort, speed = abs(cell.factors[k]), 0.5 * own.effort[k], 0.5 * own.velocity[k]
        bounds = {
            "position": sorted((cell.offsets[k] + cell.factors[k] * narrow[k]).tolist()),
            "effort": (-effort / size, effort / size),
            "velocity": (-speed * size, 9.0 * speed * size),
        }
        for kind, ends in bounds.items():
            interface = ET.SubElement(joint, "command_interface", name=kind)
            for key, value in zip(("min", "max"), ends, strict=True):
                ET.SubElement(interface, "param", name=key).text = repr(float(value))
    path.write_text(ET.tostring(root, "unicode"))
    limits = Machine.from_data(read_urdf(path), "bounded").limits
    np.testing.assert_allclose(limits.effort, 0.5 * own.effort, 1e-12)
    np.testing.assert_allclose(limits.velocity, 0.5 * own.velocity, 1e-12)
    np.testing.assert_allclose(limits.position, narrow, 1e-9, 1e-12)


def test_a_ratio_that_changes_with_travel_has_no_description_for_a_controller():
    robot = robot_of_data(
        sides("linear_delta").data | {"joint_map": {"rail_1": {"ratio": 40.0, "ratio_change": 0.1}}},
        "winch",
    )
    with pytest.raises(ParameterError, match="ratio_change"):
        robot_urdf(robot)
    assert robot_urdf(robot, hardware="")


def test_links_need_no_quoting_and_their_old_names_are_found(robot, tmp_path):
    root = ET.fromstring(robot_urdf(robot))
    links = [link.get("name") for link in root.findall("link")]
    assert len(set(links)) == len(links)
    assert all(re.fullmatch(r"\w+", link) for link in links)
    assert not any(re.search(r"_I+(_|$)", link) for link in links)
    path = tmp_path / "robot.urdf"
    path.write_text(robot_urdf(robot))
    body = next(body for body in robot.graph.bodies if body != "platform")
    assert read_urdf(path, platform=body)["platform"] == plain_name(body)


@pytest.mark.parametrize(
    ("names", "links"),
    [
        (("arm I", "arm IV b", "a\tb"), ("arm_1", "arm_4_b", "a_b")),
        (("arm Iota", "I", "V"), ("arm_Iota", "I", "V")),
        (("arm 1", "arm I", "arm_1"), ("arm_1_body", "arm_1_body_body", "arm_1")),
    ],
)
def test_a_link_s_name_is_plain_and_its_own(names, links):
    found = writing._choose_link_names(names)
    assert tuple(found[name] for name in names) == links


def test_a_description_has_hardware_as_it_is_asked_for(robot):
    plain = ET.fromstring(robot_urdf(robot, hardware=""))
    assert plain.find("ros2_control") is None
    mine = ET.fromstring(robot_urdf(robot, "mine/Hardware"))
    assert mine.find("ros2_control/hardware/plugin").text == "mine/Hardware"
    mine.remove(mine.find("ros2_control"))
    assert [element.tag for element in mine] == [element.tag for element in plain]


def test_a_prefix_stands_before_every_name_of_links_and_joints(robot):
    plain, prefixed = (ET.fromstring(robot_urdf(robot, prefix=p)) for p in ("", "left/"))
    names = 0
    for one, other in zip(plain.iter(), prefixed.iter(), strict=True):
        named = one.tag in ("link", "joint", "constraint", "ros2_control")
        for key, value in one.attrib.items():
            changed = key == "link" or (key == "name" and named)
            assert other.get(key) == ("left/" + value if changed else value)
            names += changed
    assert names > 2 * len(robot.passive_joints)
    # Whatever names something in there names something that is there.
    defined = {element.get("name") for element in prefixed.iter() if element.tag == "link"}
    assert {e.get("link") for e in prefixed.iter() if e.get("link")} <= defined


def test_the_text_is_the_same_byte_for_byte_on_any_machine():
    assert robot_urdf(load("five_bar")) == Path(__file__).with_name("five_bar.urdf").read_text()
    rng = np.random.default_rng(5)

    def shaken(value):
        """In the last bit."""
        if isinstance(value, dict):
            return {key: shaken(item) for key, item in value.items()}
        if isinstance(value, list):
            return [shaken(item) for item in value]
        return value * (1.0 + 1e-16 * rng.integers(-1, 2)) if isinstance(value, float) else value

    data = plain("linear_delta")
    one, other = (robot_of_data(numbers, "x") for numbers in (data, shaken(data)))
    assert robot_urdf(one) == robot_urdf(other)


def test_other_parsers_read_it(robot, tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text(robot_urdf(robot))
    tool = Path(sys.executable).with_name("check_urdf")
    if tool.exists():
        done = subprocess.run([tool, path], capture_output=True, text=True, check=False, timeout=60)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "root Link: base_link" in done.stdout
    yourdfpy = pytest.importorskip("yourdfpy")
    tree, q = yourdfpy.URDF.load(str(path)), robot.graph.home
    assert tree.validate() and tree.base_link == "base_link"
    names = (*robot.joint_names, *robot.passive_joints)
    tree.update_cfg(dict(zip(names, (*q, *robot.passive(q)), strict=True)))
    place = tree.get_transform("platform")
    np.testing.assert_allclose(place[:3, 3], robot.graph.origin, atol=1e-7)
    np.testing.assert_allclose(place[:3, :3], np.eye(3), atol=1e-7)


def test_read_back_or_described_it_needs_the_same_efforts(robot, states, tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text(robot_urdf(robot))
    rng = np.random.default_rng(6)
    qd, qdd = rng.normal(size=(2, *states.shape))
    wrench = rng.normal(size=(len(states), 6))
    expected = inverse_dynamics(robot, states, qd, qdd, wrench)
    described = Machine.from_data(robot_description(robot), "again")
    for again in (Machine.from_data(read_urdf(path), "again"), described):
        assert again.joint_names == robot.joint_names
        found = inverse_dynamics(again, states, qd, qdd, wrench)
        np.testing.assert_allclose(found, expected, 0.0, 1e-10 * np.abs(expected).max())
        np.testing.assert_allclose(again.platform(states)[0], robot.platform(states)[0], atol=1e-9)
    for parts in ("bodies", "joints", "rods"):
        assert list(getattr(described.graph, parts)) == list(getattr(robot.graph, parts))
    np.testing.assert_equal(described.limits.position, robot.limits.position)
