# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""MJCF, SDF and URDF: there and back with the same torques, and MuJoCo's motion of the MJCF."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
import warnings
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from delta_dynamics.simulation.plant import Plant
from pkm_twin import robot_names
from pkm_twin.apps.cli import main
from pkm_twin.mechanisms.machine import Machine
from pkm_twin.robot.robot_urdf import robot_description, robot_mjcf, robot_sdf, robot_urdf
from test.machine.random_machines import variant
from test.support.robots import load, loaded, partly_long, random_motion

mujoco = pytest.importorskip("mujoco")

RANDOM = {"random hinged_platform": 3, "random prru3": 6, "random bolted": 1}
"""Redundant closures, joints that count from elsewhere, universal joints not at a right angle."""
NAMES = (*robot_names(), *RANDOM)
FREEDOMS = {
    "fixed": 0,
    "revolute": 1,
    "prismatic": 1,
    "screw": 1,
    "universal": 2,
    "ball": 3,
}


FALL, ROTOR = "gravity [0.0, 3.0, 0.0]", "the rotor inertia of left"


@functools.cache
def robot_of(name):
    """Also with limits, friction of every kind and rotors."""
    if name not in RANDOM:
        return loaded(name)
    data = variant(name.split()[1], np.random.default_rng(RANDOM[name]))
    return Machine.from_data(data | {"mechanism": "machine"}, name)


@pytest.mark.parametrize("name", partly_long(NAMES, "five_bar"))
@pytest.mark.parametrize("kind", ["mjcf", "urdf"])
def test_a_robot_there_and_back_has_its_torques(name, kind, tmp_path):
    robot = robot_of(name).changed(gravity=[0.0, 0.0, -9.81])
    path = tmp_path / f"robot.{'urdf' if kind == 'urdf' else 'xml'}"
    path.write_text(robot_mjcf(robot) if kind == "mjcf" else robot_urdf(robot))
    back = load(path)
    assert back.joint_names == robot.joint_names
    np.testing.assert_allclose(back.graph.home, robot.graph.home, 0.0, 1e-12)
    motion = random_motion(robot, np.random.default_rng(0), 20)
    right, found = (inverse_dynamics(one, *motion) for one in (robot, back))
    assert np.abs(found - right).max() <= 1e-10 * np.abs(right).max()
    for limits in ("position", "effort"):
        own = getattr(robot.limits, limits)
        if own is not None:
            np.testing.assert_allclose(getattr(back.limits, limits), own, 1e-12, 1e-12)


@pytest.mark.parametrize(
    ("write", "lost"),
    [(robot_urdf, {FALL}), (robot_mjcf, set()), (robot_sdf, {FALL, ROTOR})],
)
def test_a_format_names_what_efforts_need_and_it_has_no_place_for(write, lost):
    robot = loaded("five_bar").changed(gravity=[0.0, 3.0, 0.0])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        write(robot)
    text = "".join(str(one.message) for one in told)
    assert {word for word in (FALL, ROTOR) if word in text} == lost


@pytest.mark.parametrize("name", partly_long(NAMES, "delta_cu"))
def test_an_sdf_there_and_back_has_the_torques(name, tmp_path):
    """Joints count from home there; rotors have no place, and what has no mass gets a little."""
    data = robot_description(robot_of(name)) | {"gravity": [0.0, 0.0, -9.81]}
    for joint in data["joints"].values():
        for key in ("rotor_inertia", "drive"):
            joint.pop(key, None)
        for key in set(joint.get("friction", {})) - {"viscous", "coulomb"}:
            del joint["friction"][key]
    robot = Machine.from_data(data, name)
    path = tmp_path / "robot.sdf"
    path.write_text(robot_sdf(robot))
    back = load(path)
    assert back.joint_names == robot.joint_names
    q, *rates = random_motion(robot, np.random.default_rng(0), 20)
    right = inverse_dynamics(robot, q, *rates)
    found = inverse_dynamics(back, q - robot.graph.home, *rates)
    assert np.abs(found - right).max() <= 1e-4 * np.abs(right).max()
    if robot.limits.position is not None:
        own = robot.limits.position - robot.graph.home[:, None]
        np.testing.assert_allclose(back.limits.position, own, 0.0, 1e-12)


@pytest.mark.parametrize("name", partly_long(NAMES, "five_bar"))
def test_mujoco_s_free_swing_is_the_plant_s(name):
    """Within what constraints that give way and its integrator leave."""
    robot = robot_of(name)
    home = robot.graph.home
    rest = inverse_dynamics(robot, home, 0.0 * home, 0.0 * home)
    effort = 0.7 * rest + 0.02 * np.abs(rest).max() * np.arange(len(home))
    if any(joint.loaded for joint in robot.graph.joints.values()) or robot.friction.coulomb.any():
        # MuJoCo's dry friction creeps: a motion away from rest, in one direction.
        effort += 5.0 * robot.friction.coulomb + 0.1 * np.abs(rest)
    model = mujoco.MjModel.from_xml_string(robot_mjcf(robot, list(rest)))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    np.testing.assert_allclose(data.ctrl, rest, 1e-12, 1e-12)
    mujoco.mj_forward(model, data)
    assert np.abs(data.efc_pos[: data.ne]).max() < 1e-12
    position, _ = robot.platform(home)
    np.testing.assert_allclose(data.site("platform").xpos, position, 0.0, 1e-12)
    plant = Plant(robot, home)
    data.ctrl[:] = effort - robot.friction.offset
    for _ in range(100):
        plant.advance(effort, np.zeros(6), 1e-3)
        mujoco.mj_step(model, data)
    found = np.array([data.joint(name).qpos[0] for name in robot.joint_names])
    assert np.abs(plant.q - home).max() > 1e-3
    error = np.abs(found - plant.q).max()
    assert error < (1e-6 if not robot.friction.coulomb.any() else 1e-3)


@pytest.mark.parametrize("name", partly_long(NAMES, "five_bar", "delta_cu"))
def test_an_sdf_has_the_machine_s_freedoms_masses_and_names(name):
    robot = robot_of(name)
    text = robot_sdf(robot)
    model = ET.fromstring(text).find("model")
    links = {link.get("name"): link for link in model.findall("link")}
    joints = {joint.get("name"): joint for joint in model.findall("joint")}
    frames = [frame.get("name") for frame in model.findall("frame")]
    assert len({*links, *joints, *frames}) == len(links) + len(joints) + len(frames)
    assert set(robot.joint_names) <= set(joints) and "platform" in frames
    ends = [(j.findtext("parent"), j.findtext("child")) for j in joints.values()]
    assert {end for pair in ends for end in pair} == {"world", *links}
    # Freedoms less what loops take are those of the graph, however many links stand between.
    freedoms = sum(FREEDOMS[joint.get("type")] for joint in joints.values())
    graph = robot.graph
    # A rod has a universal joint and a ball.
    own = sum(len(joint.freedoms) for joint in graph.joints.values()) + 5 * len(graph.rods)
    bodies = len(graph.bodies) + len(graph.rods)
    loops = len(graph.joints) + 2 * len(graph.rods) - bodies
    assert freedoms - 6 * (len(joints) - len(links)) == own - 6 * loops
    masses = [float(link.findtext("inertial/mass")) for link in links.values()]
    parts = [*graph.bodies.values(), *graph.rods.values()]
    total = sum(part.mass for part in parts) + robot.payload.mass
    assert sum(masses) == pytest.approx(total, rel=1e-6 * len(links))


PROGRAM = """
#include <sdf/sdf.hh>
#include <iostream>
int main(int, char **words)
{
  sdf::Root root;
  const auto errors = root.Load(words[1]);
  for (const auto &error : errors) { std::cout << error << std::endl; }
  return errors.empty() && root.Model() != nullptr ? 0 : 1;
}
"""


@pytest.mark.long
def test_libsdformat_reads_every_robot(tmp_path):
    """Where its development files are installed."""
    asked = ["pkg-config", "--cflags", "--libs", "sdformat12"]
    if not shutil.which("g++") or subprocess.run(asked, capture_output=True, check=False).returncode:
        pytest.skip("no libsdformat-dev")
    flags = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.split()
    (tmp_path / "read.cpp").write_text(PROGRAM)
    program = str(tmp_path / "read")
    subprocess.run(["g++", "-std=c++17", "read.cpp", "-o", program, *flags], cwd=tmp_path, check=True)
    for name in NAMES:
        path = tmp_path / "robot.sdf"
        path.write_text(robot_sdf(robot_of(name)))
        done = subprocess.run([program, str(path)], capture_output=True, text=True, check=False)
        assert not done.returncode, done.stdout


FORMATS = ("c", "mjcf", "ros2-control", "sdf")


def written(folder):
    """The bytes of what the commands write, by format and file."""
    folder.mkdir()
    for kind in FORMATS:
        with pytest.raises(SystemExit) as ended:
            main(["export", kind, "five_bar", "--out", str(folder / kind)])
        assert not ended.value.code
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_the_commands_write_the_same_bytes_in_every_process(tmp_path):
    """Also where sets have an order of their own; never over what is there."""
    here = written(tmp_path / "here")
    program = "import sys, pathlib\nfrom test.export.test_simulators import written\nwritten(pathlib.Path(sys.argv[1]))"
    environment = os.environ | {"PYTHONHASHSEED": "3", "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", program, str(tmp_path / "there")]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    there = {name: (tmp_path / "there" / name).read_bytes() for name in here}
    assert there == here and {name.split("/")[0] for name in here} == set(FORMATS)
    for kind in FORMATS:
        with pytest.raises(SystemExit) as ended:
            main(["export", kind, "five_bar", "--out", str(tmp_path / "here" / kind)])
        assert ended.value.code
