# SPDX-License-Identifier: Apache-2.0
"""An MJCF file as a description, against MuJoCo's own positions, masses and inertias."""

from __future__ import annotations

import os
import sys

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import ParameterError
from pkm_twin.mechanisms.machine import Machine
from pkm_twin.robot.urdf_read import read_urdf

mujoco = pytest.importorskip("mujoco")

pytestmark = pytest.mark.usefixtures("quickly_compiled")
FIVE_BAR = """<mujoco model="five_bar">
<option gravity="0 -9.81 0"/>
<worldbody>
  <body name="arm_1" pos="-0.1 0 0" euler="0 0 127">
    <joint name="m1" axis="0 0 2" range="-60 60" damping="0.1" frictionloss="0.2" armature="0.01"/>
    <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.01" mass="0.3"/>
    <body name="fore_1" pos="0.2 0 0" euler="0 0 -80">
      <joint name="e1" axis="0 0 1"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.01" mass="0.2"/>
      <site name="tool" pos="0.3 0 0"/>
    </body>
  </body>
  <body name="arm_2" pos="0.1 0 0" euler="0 0 53">
    <joint name="m2" axis="0 0 1" pos="0 0 0.01" actuatorfrcrange="-4 4"/>
    <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.01" mass="0.3"/>
    <body name="fore_2" pos="0.2 0 0" euler="0 0 80">
      <joint name="e2" axis="0 0 1" pos="0.001 0 0"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.01" mass="0.2"/>
      <site name="end" pos="0.3 0 0"/>
    </body>
  </body>
</worldbody>
<equality>CLOSURE</equality>
<actuator><motor name="a2" joint="m2"/><motor name="a1" joint="m1" gear="3"/></actuator>
</mujoco>"""
CONNECT = '<connect name="tip" site1="tool" site2="end"/>'


def hexapod():
    """A free platform on six bars, each with a universal foot, a slide and a ball at its head."""
    legs, loops, motors = "", "", ""
    for i in range(6):
        a = 2.0 * np.pi * (i // 2) / 3 + (0.2, -0.2)[i % 2]
        b = 2.0 * np.pi * (i // 2) / 3 + (0.9, -0.9)[i % 2]
        foot = np.array([0.5 * np.cos(a), 0.5 * np.sin(a), 0.0])
        head = np.array([0.3 * np.cos(b), 0.3 * np.sin(b), 0.6])
        along, length = (head - foot) / np.linalg.norm(head - foot), np.linalg.norm(head - foot)
        x = np.cross([0.0, 1.0, 0.0], along)
        x /= np.linalg.norm(x)
        axes = " ".join(map(repr, [*x.tolist(), *np.cross(along, x).tolist()]))
        legs += f"""<body name="tube_{i}" pos="{foot[0]} {foot[1]} {foot[2]}" xyaxes="{axes}">
          <joint name="u{i}a" axis="1 0 0"/><joint name="u{i}b" axis="0 1 0"/>
          <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.02" mass="0.8"/>
          <body name="rod_{i}" pos="0 0 {length}"><joint name="s{i}" type="slide" axis="0 0 1"/>
            <geom type="capsule" fromto="0 0 -0.4 0 0 0" size="0.01" mass="0.4"/></body></body>"""
        loops += f'<connect name="h{i}" body1="rod_{i}" body2="platform" anchor="0 0 0"/>'
        motors += f'<motor joint="s{i}"/>'
    return f"""<mujoco><worldbody>{legs}
      <body name="platform" pos="0 0 0.6"><freejoint name="float"/>
        <geom type="cylinder" size="0.3 0.02" mass="5"/><site name="tool" pos="0 0 0.05"/></body>
      </worldbody><equality>{loops}</equality><actuator>{motors}</actuator></mujoco>"""


def save(tmp_path, content):
    path = tmp_path / "machine.xml"
    path.write_text(content)
    return path


def five_bar(tmp_path, closure=CONNECT, old="", new=""):
    return save(tmp_path, FIVE_BAR.replace("CLOSURE", closure).replace(old, new))


def at_home(path, data):
    """MuJoCo's model and state with the joints at the description's home."""
    model = mujoco.MjModel.from_xml_path(str(path))
    state = mujoco.MjData(model)
    for name, joint in data["joints"].items():
        if joint["type"] in ("revolute", "prismatic"):
            state.joint(name).qpos[0] = joint.get("home", 0.0)
    mujoco.mj_forward(model, state)
    return model, state


@pytest.mark.parametrize("name", ["five_bar", "hexapod"])
def test_bodies_and_joints_stand_where_mujoco_has_them(name, tmp_path):
    content = FIVE_BAR.replace("CLOSURE", CONNECT) if name == "five_bar" else hexapod()
    path = save(tmp_path, content)
    data = read_urdf(path, platform="tool")
    model, state = at_home(path, data)
    assert sum(b["mass"] for b in data["bodies"].values()) == pytest.approx(model.body_mass.sum())
    found = {}
    for body in range(1, model.nbody):
        place = state.ximat[body].reshape(3, 3)
        inertia = place @ np.diag(model.body_inertia[body]) @ place.T
        found[round(float(model.body_mass[body]), 9), *np.round(state.xipos[body], 9)] = inertia
    for body in data["bodies"].values():
        if body["mass"] > 0.0:
            key = (round(body["mass"], 9), *np.round(body["com"], 9))
            matrix = np.array(body["inertia"])
            matrix = np.diag(matrix) if matrix.ndim == 1 else matrix
            near = [k for k in found if np.allclose(k, key, atol=1e-8)]
            assert near, key
            np.testing.assert_allclose(matrix, found[near[0]], atol=1e-9)
    for name, joint in data["joints"].items():
        if joint["type"] in ("revolute", "prismatic"):
            own = state.joint(name)
            np.testing.assert_allclose(joint["axis"], own.xaxis, atol=1e-9)
            if joint["type"] == "revolute":
                np.testing.assert_allclose(joint["at"], own.xanchor, atol=1e-9)
    np.testing.assert_allclose(data["origin"], state.site("tool").xpos, atol=1e-9)
    assert np.abs(state.efc_pos[: state.ne]).max() < 1e-9


def test_what_is_said_of_joints_and_gravity(tmp_path):
    data = read_urdf(five_bar(tmp_path))
    assert data["gravity"] == [0.0, -9.81, 0.0]
    assert [n for n, j in data["joints"].items() if j.get("actuated")] == ["m2", "m1"]
    joint = data["joints"]["m1"]
    assert joint["limits"]["position"] == pytest.approx([-np.pi / 3, np.pi / 3])
    assert joint["friction"] == {"viscous": 0.1, "coulomb": 0.2}
    assert joint["rotor_inertia"] == 0.01
    assert data["joints"]["m2"]["limits"] == {"effort": 4.0}


def test_a_body_on_a_free_joint_is_held_by_closures_alone(tmp_path):
    data = read_urdf(save(tmp_path, hexapod()), platform="platform")
    assert "float" not in data["joints"]
    held = [n for n, j in data["joints"].items() if "platform" in j["between"]]
    assert held == [f"h{i}" for i in range(6)]
    assert {data["joints"][n]["type"] for n in held} == {"spherical"}


def test_it_is_a_machine_of_the_engine(tmp_path):
    robot = Machine.from_data(read_urdf(save(tmp_path, hexapod()), platform="tool"), "hexapod")
    assert robot.mobility == "6: x, y, z, roll, pitch, yaw"
    weight = inverse_dynamics(robot, robot.inverse(robot.home()), np.zeros(6), np.zeros(6))
    np.testing.assert_allclose(robot.forward(robot.inverse(robot.home())), robot.home(), atol=1e-12)
    # Virtual work: the rate at which gravity's work grows with each slide.
    step = 1e-6
    for k in range(6):
        q = robot.inverse(robot.home())
        up, down = (total_height(robot, q + s * step * np.eye(6)[k]) for s in (1, -1))
        assert weight[k] == pytest.approx(9.81 * (up - down) / (2 * step), abs=1e-5)


def total_height(robot, q):
    """Sum of mass times height, kg m."""
    rotations, origins = robot.placements(q)
    total = 0.0
    for name, body in robot.graph.bodies.items():
        arm = body.com - robot.engine.tree.at[name]
        total += body.mass * (origins[name] + rotations[name] @ arm)[2]
    return total


def test_a_weld_and_a_lock_hold(tmp_path):
    weld = '<weld name="tip" body1="fore_1" body2="fore_2" relpose="0.3 0 0 0.6 0 0 0.8"/>'
    # Two bars that are welded at an angle of their own: one motor must go.
    data = read_urdf(five_bar(tmp_path, weld, '<motor name="a2" joint="m2"/>', ""))
    assert data["joints"]["tip"]["type"] == "fixed"
    _, state = at_home(tmp_path / "machine.xml", data)
    assert np.abs(state.efc_pos[: state.ne]).max() < 1e-7 and state.ne == 6
    lock = CONNECT + '<joint joint1="m1" polycoef="0.3 0 0 0 0"/>'
    data = read_urdf(five_bar(tmp_path, lock, '<motor name="a1" joint="m1" gear="3"/>', ""))
    assert "m1" not in data["joints"]


REFUSED = {
    "joint": (CONNECT + '<joint joint1="m1" joint2="m2"/>', "", "", "equality.*'m1'"),
    "tendon": (CONNECT, 'joint="m1" gear', 'site="tool" gear', "actuator.a1"),
    "no motor": (
        CONNECT,
        '<motor name="a2" joint="m2"/><motor name="a1" joint="m1" gear="3"/>',
        "",
        "no actuator",
    ),
    "broken": (CONNECT, 'type="capsule"', 'type="capsul"', "MuJoCo compiles"),
}


@pytest.mark.parametrize("case", sorted(REFUSED))
def test_refused_by_name(case, tmp_path):
    closure, old, new, message = REFUSED[case]
    with pytest.raises(ParameterError, match=message):
        read_urdf(five_bar(tmp_path, closure, old, new))


def test_without_the_package_it_is_asked_for(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ParameterError, match=r"without the mujoco package.*\[mjcf\]"):
        read_urdf(five_bar(tmp_path))


def test_what_would_wait_or_count_for_ever_is_refused_by_name(tmp_path):
    os.mkfifo(tmp_path / "pipe.xml")
    os.mkfifo(tmp_path / "pipe.stl")
    mesh = '<asset><mesh name="m" file="pipe.stl"/></asset>'
    nested = '<replicate count="9000"><replicate count="9000"><body/></replicate></replicate>'
    for inside, field in {
        '<include file="pipe.xml"/>': "include.file",
        mesh: "mesh.file",
        '<worldbody><replicate count="99999999"/></worldbody>': "replicate.count",
        f"<worldbody>{nested}</worldbody>": "replicate",
        '<asset><hfield name="h" nrow="1000000" ncol="9"/></asset>': "hfield.nrow",
        '<include file="machine.xml"/>': str(tmp_path / "machine.xml"),
    }.items():
        with pytest.raises(ParameterError) as refused:
            read_urdf(save(tmp_path, f"<mujoco>{inside}</mujoco>"))
        assert refused.value.field == field


def test_included_files_are_read(tmp_path):
    (tmp_path / "part.xml").write_text('<mujoco><option gravity="0 0 -1"/></mujoco>')
    path = five_bar(tmp_path, old='<option gravity="0 -9.81 0"/>', new='<include file="part.xml"/>')
    assert read_urdf(path)["gravity"] == [0.0, 0.0, -1.0]


@pytest.mark.parametrize("value", ["nan", "NaN", "-inf", "infinity", "nan(1)"])
@pytest.mark.parametrize("place", ['damping="{}"', 'range="{} 60"', 'axis="0 {} 2"'])
def test_numbers_that_are_not_finite_are_refused_by_name(value, place, tmp_path):
    key = place.partition("=")[0]
    old = next(word for word in ('axis="0 0 2"', 'range="-60 60"', 'damping="0.1"') if key in word)
    path = five_bar(tmp_path, old=old, new=place.format(value))
    with pytest.raises(ParameterError) as error:
        read_urdf(path)
    assert error.value.field == f"joint.m1.{key}"


def test_a_part_may_be_called_like_such_a_number(tmp_path):
    path = five_bar(tmp_path)
    path.write_text(path.read_text().replace('"m1"', '"nan"'))
    assert "nan" in read_urdf(path)["joints"]
