# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A robot's MoveIt configuration: what it names is in its URDF, and its limits are the model's."""

from xml.etree import ElementTree as ET

import numpy as np
import pytest
import yaml

from delta_dynamics import inverse_dynamics
from pkm_twin import robot_names
from pkm_twin.apps.cli import main
from pkm_twin.errors import ParameterError
from pkm_twin.export.moveit import LIMB_GROUP, PLANNING_GROUP, moveit_package
from test.support.robots import load, parameters_of, partly_long


@pytest.fixture(params=partly_long(robot_names(), "delta_cu", "five_bar"), scope="module")
def exported(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("moveit") / "package"
    with pytest.raises(SystemExit) as ended:
        main(["export", "moveit", request.param, "--out", str(folder)])
    assert not ended.value.code
    return load(request.param), folder


def settings(folder, name):
    return yaml.safe_load((folder / f"config/{name}.yaml").read_text())


def test_every_name_of_the_srdf_is_in_the_urdf(exported):
    robot, folder = exported
    urdf = ET.parse(folder / f"config/{robot.name}.urdf").getroot()
    srdf = ET.parse(folder / f"config/{robot.name}.srdf").getroot()
    assert urdf.find("ros2_control") is None
    assert srdf.get("name") == urdf.get("name") == robot.name
    links = {link.get("name") for link in urdf.findall("link")}
    moving = {j.get("name"): j for j in urdf.findall("joint") if j.get("type") != "fixed"}
    group = [joint.get("name") for joint in srdf.find(f"group[@name='{PLANNING_GROUP}']")]
    assert group == list(robot.joint_names)
    passive = [joint.get("name") for joint in srdf.findall("passive_joint")]
    # MoveIt waits for the state of every joint that is neither.
    assert sorted([*group, *passive]) == sorted(moving)
    pairs = [(e.get("link1"), e.get("link2")) for e in srdf.findall("disable_collisions")]
    assert {link for pair in pairs for link in pair} <= links
    for joint in urdf.findall("joint"):
        ends = sorted(joint.find(tag).get("link") for tag in ("parent", "child"))
        assert tuple(ends) in pairs
    home = {j.get("name"): float(j.get("value")) for j in srdf.find("group_state")}
    assert [home[name] for name in group] == pytest.approx(robot.inverse(robot.home()), abs=1e-9)
    assert srdf.find("virtual_joint").get("child_link") in links


def test_bars_collide_as_they_are_seen_and_neighbours_are_left_out(exported):
    """Of Pinocchio's collision library: nothing at home, and what crosses in a drawn posture."""
    pin = pytest.importorskip("pinocchio")
    robot, folder = exported
    urdf = (folder / f"config/{robot.name}.urdf").read_text()
    model = pin.buildModelFromXML(urdf)
    kinds = (pin.VISUAL, pin.COLLISION)
    seen, solid = (pin.buildGeomFromUrdfString(model, urdf, kind) for kind in kinds)
    shapes = [
        [(g.parentFrame, str(g.placement), type(g.geometry)) for g in one.geometryObjects] for one in (seen, solid)
    ]
    assert shapes[0] == shapes[1] and shapes[0]
    solid.addAllCollisionPairs()
    everything = len(solid.collisionPairs)
    pin.removeCollisionPairsFromXML(model, solid, (folder / f"config/{robot.name}.srdf").read_text(), False)
    assert len(solid.collisionPairs) < everything
    data, pairs = model.createData(), solid.createData()

    joints = dict(zip(list(model.names)[1:], list(model.joints)[1:], strict=True))

    def collides(q, turned=0.0):
        states = dict(zip(robot.joint_names, q, strict=True))
        states |= dict(zip(robot.passive_joints, robot.passive(q), strict=True))
        at = np.zeros(model.nq)
        for name, joint in joints.items():
            turns = joint.shortname().startswith("JointModelR")
            at[joint.idx_q] = states[name] + rng.uniform(-turned, turned) * turns
        return pin.computeCollisions(model, data, solid, pairs, at, True)

    home, rng = robot.inverse(robot.home()), np.random.default_rng(3)
    assert not collides(home)
    assert not any(collides(home + rng.uniform(-0.02, 0.02, len(home))) for _ in range(5))
    # Without its loops the tree can cross its limbs.
    assert any(collides(home, 2.0) for _ in range(100))


def test_a_numeric_solver_is_offered_where_its_chain_has_a_drive(exported):
    robot, folder = exported
    urdf = ET.parse(folder / f"config/{robot.name}.urdf").getroot()
    above = {j.find("child").get("link"): j for j in urdf.findall("joint")}
    link, chain = "platform", []
    while link in above:
        chain.append(above[link].get("name"))
        link = above[link].find("parent").get("link")
    assert link == "base_link"
    driven = bool(set(chain) & set(robot.joint_names))
    solvers = settings(folder, "kinematics")
    assert set(solvers) == {PLANNING_GROUP} | ({LIMB_GROUP} if driven else set())
    library = ET.parse(folder / "kinematics.xml").getroot()
    assert solvers[PLANNING_GROUP]["kinematics_solver"] == library.find("class").get("name")
    package = ET.parse(folder / "package.xml").find("name").text
    assert library.get("path") == f"{package}_kinematics"
    srdf = ET.parse(folder / f"config/{robot.name}.srdf").getroot()
    assert (srdf.find(f"group[@name='{LIMB_GROUP}']") is not None) is driven
    files = moveit_package(robot, "mine/Kinematics")
    solver = yaml.safe_load(files["config/kinematics.yaml"])[PLANNING_GROUP]["kinematics_solver"]
    assert solver == "mine/Kinematics"


def test_limits_are_the_robots_and_what_its_drives_can_do(exported):
    robot, folder = exported
    limits = settings(folder, "joint_limits")["joint_limits"]
    assert list(limits) == list(robot.joint_names)
    q = robot.inverse(robot.home())
    for k, limit in enumerate(limits.values()):
        bounds = robot.limits.velocity
        assert limit["has_velocity_limits"] is (bounds is not None)
        if bounds is not None:
            assert limit["max_velocity"] == bounds[k]
        assert limit["has_acceleration_limits"] is (robot.limits.effort is not None)
        if robot.limits.effort is not None:
            push = np.zeros_like(q)
            for sign in (1.0, -1.0):
                push[k] = sign * limit["max_acceleration"]
                effort = inverse_dynamics(robot, q, 0 * q, push)[k]
                assert abs(effort) <= robot.limits.effort[k]
            assert limit["max_acceleration"] > 0.0


def test_the_controller_is_the_twins_action(exported):
    robot, folder = exported
    manager = settings(folder, "moveit_controllers")["moveit_simple_controller_manager"]
    (name,) = manager["controller_names"]
    assert (name, manager[name]["action_ns"]) == ("delta_dynamics", "follow_joint_trajectory")
    assert manager[name]["joints"] == list(robot.joint_names)
    launch = (folder / "launch/move_group.launch.py").read_text()
    compile(launch, "launch", "exec")
    for file in (folder / "config").iterdir():
        assert file.name == "ompl_planning.yaml" or f"config/{file.name}" in launch
    package = ET.parse(folder / "package.xml").find("name").text
    assert f'package_name="{package}"' in launch
    assert f"project({package} " in (folder / "CMakeLists.txt").read_text()


def test_files_that_are_there_are_kept_unless_told_otherwise(tmp_path, capsys):
    for words, code in (([], 0), ([], 1), (["--overwrite"], 0)):
        with pytest.raises(SystemExit) as ended:
            main(["export", "moveit", "five_bar", "--out", str(tmp_path), *words])
        assert (ended.value.code or 0) == code
    assert "--overwrite" in capsys.readouterr().err


def test_a_robot_whose_controller_has_other_numbers_is_refused(tmp_path):
    data = parameters_of("delta_cu") | {"joint_map": {"arm_1": {"sign": -1.0}}}
    path = tmp_path / "mapped.yaml"
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(ParameterError, match="joint_map"):
        moveit_package(load(path))
