# SPDX-License-Identifier: Apache-2.0
"""A description as a URDF: what parsers of trees make of it, and what is read back from it."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from pkm_twin.machine import urdf_file, urdf_xml
from pkm_twin.machine.assembly import Assembly
from pkm_twin.machine.urdf_write import write_urdf
from pkm_twin.robot.urdf_read import read_urdf

pytest.importorskip("pinocchio")

import pinocchio as pin

from .descriptions import DESCRIPTIONS, five_bar, rod_delta, tree_of

GOLDEN = Path(__file__).with_name("five_bar.urdf")


@pytest.fixture(params=sorted(DESCRIPTIONS))
def description(request):
    return DESCRIPTIONS[request.param]()


def text(description):
    return write_urdf(tree_of(description)[0])


def total(description):
    parts = [*description["bodies"].values(), *description.get("rods", {}).values()]
    return sum(p["mass"] for p in parts) + description.get("payload", {}).get("mass", 0.0)


def pinocchio(content):
    model = pin.buildModelFromXML(content)
    return model, model.createData()


def configuration(model, names, values):
    q = np.zeros(model.nq)
    for name, value in zip(names, values, strict=True):
        q[model.joints[model.getJointId(name)].idx_q] = value
    return q


def frames(model, data, names, values):
    """Placements of all links with the joints at these values."""
    pin.framesForwardKinematics(model, data, configuration(model, names, values))
    return {f.name: data.oMf[i] for i, f in enumerate(model.frames) if f.type == pin.BODY}


def test_pinocchio_reads_the_tree_and_its_whole_mass(description):
    _, names, _ = tree_of(description)
    model, _ = pinocchio(text(description))
    assert model.nq == model.nv == len(names)
    assert sum(i.mass for i in model.inertias) == pytest.approx(total(description), rel=1e-13)


def test_at_home_every_link_is_parallel_to_the_base_and_every_body_in_place(description):
    _, names, homes = tree_of(description)
    model, data = pinocchio(text(description))
    at = frames(model, data, names, homes)
    for place in at.values():
        np.testing.assert_allclose(place.rotation, np.eye(3), atol=1e-11)
    platform = description["bodies"][description["platform"]]
    origin = description.get("origin", platform["com"])
    np.testing.assert_allclose(at["platform"].translation, origin, atol=1e-11)
    com = pin.centerOfMass(model, data, configuration(model, names, homes))
    parts = [(b["mass"], b["com"]) for b in description["bodies"].values()]
    parts += [(r["mass"], np.mean(r["ends"], axis=0)) for r in description.get("rods", {}).values()]
    if "payload" in description:
        load = description["payload"]
        parts.append((load["mass"], np.add(load["com"], origin)))
    expected = sum(m * np.array(c) for m, c in parts) / total(description)
    np.testing.assert_allclose(com, expected, atol=1e-11)


START = {f"rail_{i}": 0.6 for i in range(3)} | {f"leg_{i}": 0.7 for i in range(6)}
START |= {"left": 0.4, "elbow_2": -0.3}


def test_the_loops_close_about_home(description, tmp_path):
    path = tmp_path / "machine.urdf"
    path.write_text(text(description))
    urdf = urdf_file.read(path, urdf_xml.elements(path))
    assembly = Assembly(urdf)
    start = np.array([START.get(name, 0.0) for name in assembly.steps])
    assembly.place(start)
    assert np.abs(assembly.residuals()[0]).max() < 1e-11
    rng = np.random.default_rng(3)
    for _ in range(3):
        _, miss = assembly.close(start + rng.uniform(-0.1, 0.1, len(start)))
        assert miss < 1e-12


def test_what_is_read_back_is_the_same_machine(description, tmp_path):
    path = tmp_path / "machine.urdf"
    path.write_text(text(description))
    # The initial values of the file's controllers are those of home.
    data = read_urdf(path)
    origin = description.get("origin", description["bodies"][description["platform"]]["com"])
    np.testing.assert_allclose(data["origin"], origin, atol=1e-11)
    driven = [n for n, j in description["joints"].items() if j.get("actuated")]
    assert sorted(n for n, j in data["joints"].items() if j.get("actuated")) == sorted(driven)
    assert sum(b["mass"] for b in data["bodies"].values()) == pytest.approx(total(description))
    names = {"base_link": "base_link_body", description["platform"]: "platform"}
    for name, body in description["bodies"].items():
        if name in ("tool", "block") or ("payload" in description and name == "platform"):
            continue  # merged with what is fixed to it
        back = data["bodies"][names.get(name, name)]
        np.testing.assert_allclose(back["com"], body["com"], atol=1e-11)
        np.testing.assert_allclose(back["inertia"], body["inertia"], rtol=1e-11)
    for name in driven:
        joint, back = description["joints"][name], data["joints"][name]
        sign = -1.0 if joint["between"][1] == "base" else 1.0
        np.testing.assert_allclose(back["axis"], sign * np.array(joint["axis"]), atol=1e-11)
        for key in ("limits", "friction"):
            if name not in START or key == "friction":
                assert back.get(key) == joint.get(key)


def test_limits_friction_and_interfaces_stand_in_the_file():
    robot = ET.fromstring(text(five_bar()))
    left = robot.find("joint[@name='left']")
    assert left.find("limit").attrib == {
        "lower": "-1",
        "upper": "1.5",
        "velocity": "20",
        "effort": "5",
    }
    assert left.find("dynamics").attrib == {"damping": "0.02", "friction": "0.1"}
    control = robot.find("ros2_control")
    assert [j.get("name") for j in control.findall("joint")] == ["left", "right"]
    joint = control.find("joint")
    assert [i.get("name") for i in joint.findall("command_interface")] == ["position", "effort"]
    states = [i.get("name") for i in joint.findall("state_interface")]
    assert states == ["position", "velocity", "effort"]
    assert robot.find("link[@name='base_link']").find("inertial") is None


def test_the_text_is_the_same_byte_for_byte():
    assert text(five_bar()) == GOLDEN.read_text()


def test_rounding_in_the_last_bit_does_not_show():
    rng = np.random.default_rng(5)

    def shaken(value):
        if isinstance(value, dict):
            return {key: shaken(item) for key, item in value.items()}
        if isinstance(value, list):
            return [shaken(item) for item in value]
        return value * (1.0 + 1e-16 * rng.integers(-1, 2)) if isinstance(value, float) else value

    assert text(shaken(rod_delta(False))) == text(rod_delta(False))


def test_yourdfpy_reads_it(description, tmp_path):
    yourdfpy = pytest.importorskip("yourdfpy")
    path = tmp_path / "machine.urdf"
    path.write_text(text(description))
    robot = yourdfpy.URDF.load(str(path))
    assert robot.validate()
    assert robot.base_link == "base_link"
    _, names, homes = tree_of(description)
    robot.update_cfg(dict(zip(names, homes, strict=True)))
    origin = description.get("origin", description["bodies"][description["platform"]]["com"])
    place = robot.get_transform("platform")
    np.testing.assert_allclose(place[:3, 3], origin, atol=1e-7)
    np.testing.assert_allclose(place[:3, :3], np.eye(3), atol=1e-7)


def test_urdfdom_reads_it(description, tmp_path):
    tool = Path(sys.executable).with_name("check_urdf")
    if not tool.exists():
        pytest.skip("no check_urdf beside the interpreter")
    path = tmp_path / "machine.urdf"
    path.write_text(text(description))
    done = subprocess.run([tool, path], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "root Link: base_link" in done.stdout
