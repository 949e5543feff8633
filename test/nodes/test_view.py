# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The layouts for RViz, Foxglove and PlotJuggler: files of their kind, with topics of the nodes."""

import json
import re
from xml.etree import ElementTree

import pytest
import yaml

from pkm_twin.apps.nodes import MODULES
from pkm_twin.state.scene import Scene
from pkm_twin.state.state import MachineState
from stiffness_monitor import strain_energy
from test.nodes.harness import REPOSITORY, SECOND, Maker, Plain
from test.nodes.test_machine_state import loaded
from test.nodes.test_tables import rows
from test.support.robots import load

VIEW = REPOSITORY / "launch" / "view"


def topics():
    """Absolute names of all topics, and their types; docs/nodes.md's tables are the nodes'."""
    found = {"/diagnostics": "diagnostic_msgs/DiagnosticArray"}
    for node in MODULES:
        for way, name, kind in rows(node):
            if way != "service":
                found["/" + name.replace("~", f"/{node}").lstrip("/")] = kind
    return found


@pytest.fixture(scope="module")
def known():
    return topics()


def test_rviz(known):
    text = (VIEW / "machine.rviz").read_text(encoding="utf-8")
    manager = yaml.safe_load(text)["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == "base_link"
    kinds = {
        "MarkerArray": "visualization_msgs",
        "Pose": "geometry_msgs",
        "Wrench": "geometry_msgs",
    }
    shown = set()
    for display in manager["Displays"]:
        kind = display["Class"].removeprefix("rviz_default_plugins/")
        topic = display.get("Topic") or display.get("Description Topic")
        if topic is None:
            continue
        assert known[topic["Value"]].startswith(kinds.get(kind, "std_msgs"))
        shown.add(kind)
    assert {*kinds, "RobotModel"} == shown
    # What the launch file puts a namespace before.
    assert len(re.findall("Value: /", text)) == len(shown)
    assert text.count("Fixed Frame: ") == text.count('TF Prefix: ""') == 1


def test_rviz_knows_every_kind_of_marker():
    """By namespaces, which it shows and hides."""
    text = (VIEW / "machine.rviz").read_text(encoding="utf-8")
    displays = yaml.safe_load(text)["Visualization Manager"]["Displays"]
    (markers,) = (d for d in displays if d["Class"].endswith("MarkerArray"))
    robot = load("upr_rpu")
    q, now = robot.inverse(robot.home()), 1_000 * SECOND
    message = Maker(Plain()).joint_state(robot.joint_names, q, stamp=now)
    state = MachineState(robot).joint_state(message, now)
    shapes = Scene(robot).shapes(state, loaded(robot, q))
    assert set(markers["Namespaces"]) == {shape.group for shape in shapes}


def test_foxglove(known):
    layout = json.loads((VIEW / "machine.foxglove.json").read_text(encoding="utf-8"))
    panels = layout["configById"]
    named = set()
    for name, panel in panels.items():
        named |= set(panel.get("topics", {}))
        named |= {re.split(r"[.\[]", path["value"])[0] for path in panel.get("paths", [])}
        named |= {panel["topicToRender"]} if "topicToRender" in panel else set()
        assert "!" in name
    assert named <= set(known) and len(named) >= 8
    # Paths by attributes of their types.
    for panel in panels.values():
        for path in panel.get("paths", []):
            topic, field = re.match(r"([^.\[]+)\.(\w+)", path["value"]).groups()
            fields = {"sensor_msgs/JointState": ("position", "effort")}
            assert field in fields.get(known[topic], ("transform",))

    def leaves(tree):
        return {tree} if isinstance(tree, str) else leaves(tree["first"]) | leaves(tree["second"])

    assert leaves(layout["layout"]) == set(panels)


def test_plotjuggler(known):
    root = ElementTree.parse(VIEW / "machine.plotjuggler.xml").getroot()
    selected = root.find("Plugins/plugin/selected_topics")
    names = [topic.get("name") for topic in selected]
    assert selected.get("value").split(";") == names
    assert set(names) <= set(known)
    robot = load("delta_cu")
    pairs = {
        "joint_torques": robot.joint_names,
        "torque_residual": robot.joint_names,
        "strain_energy_stamped": strain_energy(robot, robot.home(), [1.0] * 6).elements,
        "compliance_stamped": ("x_x", "y_y", "z_z"),
        "natural_frequencies_stamped": ("mode_1", "mode_2", "mode_3"),
    }
    curves = [curve.get("name") for curve in root.iter("curve")]
    assert len(curves) > 15
    drawn = set()
    for curve in curves:
        (topic,) = (name for name in names if curve.startswith(f"{name}/"))
        drawn.add(topic)
        rest = curve.removeprefix(f"{topic}/").split("/")
        if known[topic] == "sensor_msgs/JointState":
            assert rest[0] in pairs[topic.split("/")[-1]], curve
            assert rest[1:] in (["position"], ["effort"])
        else:
            assert rest[:-1] in (["pose", "position"], ["twist", "linear"])
    assert drawn == set(names)
