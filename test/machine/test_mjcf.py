# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
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
from test.support.mujoco_judge import Judge

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
        "no joint is marked as actuated",
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


ROD = """<mujoco><compiler angle="radian"/><option gravity="0 -9.81 -2"/><worldbody>
  <body name="crank"><joint name="m" axis="0 0 1"/>
    <geom type="capsule" fromto="0 0 0 0.1 0.02 0" size="0.01" mass="0.5"/>
    <body name="rod" pos="0.1 0.02 0"><joint name="ball" type="ball"/>
      <geom type="capsule" fromto="0 0 0 0.3 -0.02 0" size="0.01" mass="0.3"/></body></body>
  <body name="slider" pos="0.4 0 0"><joint name="s" type="slide" axis="1 0 0.2"/>
    <geom type="sphere" size="0.02" mass="0.7"/><site name="tool"/></body>
  </worldbody>
  <tendon><fixed name="cord"><joint joint="s" coef="1"/></fixed></tendon>
  <equality><connect name="pin" body1="rod" body2="slider" anchor="0.3 -0.02 0"/></equality>
  <actuator><motor name="a" joint="m"/></actuator></mujoco>"""
ATTRIBUTES = {
    # What is read: the torques are MuJoCo's.
    "nothing": ("", "", "read"),
    "damping of a hinge": ('name="m"', 'name="m" damping="0.3"', "read"),
    "damping of a slide": ('name="s"', 'name="s" damping="3"', "read"),
    "frictionloss": ('name="m"', 'name="m" frictionloss="0.2"', "read"),
    "frictionloss of a passive joint": ('name="s"', 'name="s" frictionloss="2"', "read"),
    "armature": ('name="m"', 'name="m" armature="0.05"', "read"),
    "armature of a passive joint": ('name="s"', 'name="s" armature="0.5"', "read"),
    "armature of an actuator": ('joint="m"', 'joint="m" armature="0.002" gear="3"', "read"),
    "damping of an actuator": ('joint="m"', 'joint="m" damping="0.02" gear="-3"', "read"),
    "gravity": ("0 -9.81 -2", "3 -9.81 1", "read"),
    "ref": ('name="m"', 'name="m" ref="0.2"', "read"),
    "pos": ('name="ball"', 'name="ball" pos="0.01 0 0"', "read"),
    # Without effect on what moves exactly along its joints.
    "solref": ('name="pin"', 'name="pin" solref="0.01 0.5"', "read"),
    "solimp": ('name="pin"', 'name="pin" solimp="0.5 0.6 0.01"', "read"),
    "margin": ('name="m"', 'name="m" margin="0.1" range="-3 3"', "read"),
    "springref alone": ('name="m"', 'name="m" springref="0.3"', "read"),
    # What is left out is said by name.
    "damping of a ball": ('name="ball"', 'name="ball" damping="0.1"', "damping 0.1 of ball"),
    "frictionloss of a ball": ('name="ball"', 'name="ball" frictionloss="1"', "friction 1 of ball"),
    "armature of a ball": ('name="ball"', 'name="ball" armature="1"', "inertia 1 of ball"),
    "stiffness": ('name="m"', 'name="m" stiffness="2"', r"spring .* of joint m "),
    "stiffness of a ball": ('name="ball"', 'name="ball" stiffness="2"', "spring .* of joint ball "),
    "polynomial damping": ('name="m"', 'name="m" damping="0.1 0.2"', "not linear of dof"),
    "gravcomp": ('name="rod"', 'name="rod" gravcomp="1"', "gravcomp.* of body rod "),
    "gear": ('joint="m"/></act', 'joint="m" gear="2"/></act', r"gear of a \(2\)"),
    "stiffness of a tendon": ('name="cord"', 'name="cord" stiffness="2"', "of tendon cord "),
    "damping of a tendon": ('name="cord"', 'name="cord" damping="2"', "damping of tendon cord "),
    "frictionloss of a tendon": ('name="cord"', 'name="cord" frictionloss="2"', "of tendon cord "),
    "armature of a tendon": ('name="cord"', 'name="cord" armature="2"', "of tendon cord "),
    "fluid": ("<option", '<option density="1000"', "fluid"),
    # What would be another machine is rejected.
    "coupled joints": ("<equality>", '<equality><joint name="c" joint1="m" joint2="s"/>', ParameterError),
    "coupled tendons": ("<equality>", '<equality><tendon name="c" tendon1="cord"/>', ParameterError),
    "actuated tendon": ('joint="m"/></act', 'tendon="cord"/></act', ParameterError),
    "actuated ball": ('joint="m"/></act', 'joint="ball"/></act', ParameterError),
    "torquescale": (
        '<connect name="pin" body1="rod" body2="slider" anchor="0.3 -0.02 0"/>',
        '<weld body1="rod" body2="slider" torquescale="0"/>',
        ParameterError,
    ),
}


@pytest.mark.parametrize("attribute", ATTRIBUTES)
def test_every_attribute_is_read_or_warned_of_or_rejected(attribute, tmp_path):
    old, new, kind = ATTRIBUTES[attribute]
    assert old in ROD
    path = save(tmp_path, ROD.replace(old, new, 1) if old else ROD)
    if kind is ParameterError:
        with pytest.raises(ParameterError, match=r"equality\.|actuator\."):
            read_urdf(path)
        return
    if kind != "read":
        with pytest.warns(UserWarning, match=kind):
            data = read_urdf(path, platform="tool")
        # And the rest is as it is without the attribute.
        joint = data["joints"]["m"]
        assert "rotor_inertia" not in joint
        return
    robot = Machine.from_data(read_urdf(path, platform="tool"), "rod")
    judge = Judge(path, robot.joint_names)
    rng = np.random.default_rng(6)
    for q in robot.graph.home + rng.uniform(-0.3, 0.3, (3, 1)):
        qd, qdd = rng.normal(size=(2, 1))
        right = judge.efforts(q, qd, qdd)
        np.testing.assert_allclose(inverse_dynamics(robot, q, qd, qdd), right, 1e-6, 1e-7)


SLIDE = '<joint name="e1" axis="0 0 1"/><joint name="x" type="slide" axis="1 0 0" ref="0.02"/>'
BOX = '<body name="tool" pos="0.1 0.02 0"><geom type="sphere" size="0.02" mass="0.1"/></body>'
END = '<site name="end" pos="0.3 0 0"/>'
HAND = """<body name="hand" pos="0.3 0 0" euler="0 0 -86"><joint name="h" axis="0 0 1"/>
  <geom type="sphere" pos="0.02 0 0" size="0.02" mass="0.1"/><site name="end"/></body>"""
VARIANTS = {
    "five_bar": {},
    "locked at a ref": {
        '<joint name="e1" axis="0 0 1"/>': SLIDE,
        CONNECT: CONNECT + '<joint joint1="x" polycoef="0.05 0 0 0 0"/>',
    },
    "sites with names of bodies": {
        END: BOX + '<site name="fore_2" pos="0.3 0 0"/>',
        'site2="end"': 'site2="fore_2"',
    },
    "names as this reader makes them": {
        '<joint name="e1" axis="0 0 1"/>': SLIDE.replace('"x"', '"tool_frame"'),
        '"fore_2"': '"e1_link"',
        END: BOX.replace('"tool"', '"box"') + "<site/>" + END,
        '"end"': '"site_1"',
        '"e2"': '"box_body"',
        '"tip"': '"m1"',
        CONNECT: CONNECT + '<joint joint1="tool_frame"/>',
    },
    "weld of sites": {END: HAND, "<connect": "<weld"},
}


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("name", [*VARIANTS, "hexapod"])
def test_torques_are_mujoco_s_projected(name, tmp_path):
    content = hexapod() if name == "hexapod" else FIVE_BAR.replace("CLOSURE", CONNECT)
    for old, new in sorted(VARIANTS.get(name, {}).items(), key=lambda pair: -len(pair[0])):
        assert old in content
        content = content.replace(old, new)
    path = save(tmp_path, content)
    robot = Machine.from_data(read_urdf(path, platform="tool"), name)
    judge = Judge(path, robot.joint_names)
    rng, count = np.random.default_rng(7), len(robot.joint_names)
    for _ in range(3):
        q = robot.graph.home + rng.uniform(-0.05, 0.05, count)
        qd, qdd = rng.normal(size=(2, count))
        right = judge.efforts(q, qd, qdd)
        error = np.abs(inverse_dynamics(robot, q, qd, qdd) - right).max()
        assert error < 1e-6 * np.abs(right).max()
        judge.close(q)
        place = judge.data.site("tool").xpos
        np.testing.assert_allclose(robot.platform(q)[0], place, atol=1e-9)


def test_effort_limits_are_those_of_joint_and_actuators_together(tmp_path):
    for limits, right in {
        'forcerange="-2 3" gear="4"': 12.0,
        'ctrlrange="-2 1" gear="5"': 10.0,
        'ctrlrange="-2 1" forcerange="-1 1" gear="-5"': 5.0,
    }.items():
        path = save(tmp_path, ROD.replace('joint="m"/></act', f'joint="m" {limits}/></act'))
        assert read_urdf(path)["joints"]["m"]["limits"]["effort"] == right


def test_meshes_that_are_missing_are_not_needed_where_inertias_are_given(tmp_path):
    mesh = '<asset><mesh name="shell" file="none.stl"/></asset><worldbody>'
    old = '<joint name="m" axis="0 0 1"/>'
    inertial = '<inertial pos="0.05 0.01 0" mass="0.5" diaginertia="1e-4 1e-3 1e-3"/>'
    geom = '<geom type="mesh" mesh="shell"/>'
    text = ROD.replace("<worldbody>", mesh)
    right = read_urdf(save(tmp_path, ROD.replace(old, old + inertial)))
    with pytest.warns(UserWarning, match="without its meshes"):
        assert read_urdf(save(tmp_path, text.replace(old, old + inertial + geom))) == right
    with pytest.raises(ParameterError, match=r"none\.stl"):
        read_urdf(save(tmp_path, text.replace(old, old + geom)))


@pytest.mark.parametrize("file", ["/etc/passwd", "../outside.xml", "link.xml"])
def test_only_files_below_the_model_are_included(file, tmp_path):
    (tmp_path / "outside.xml").write_text("<mujoco/>")
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "link.xml").symlink_to(tmp_path / "outside.xml")
    with pytest.raises(ParameterError) as error:
        read_urdf(save(folder, f'<mujoco><include file="{file}"/></mujoco>'))
    assert error.value.field == "include.file"
