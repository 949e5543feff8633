# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The tables of topics and parameters, and docs/nodes.md by them, are those of running nodes."""

import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import pytest

from pkm_twin.apps.nodes import MODULES
from test.nodes.harness import REPOSITORY
from tools.pages.nodes import GROUPS, class_of

pytest.importorskip("rclpy", exc_type=ImportError)

from rcl_interfaces.srv import ListParameters

PAGE = (REPOSITORY / "docs" / "nodes.md").read_text(encoding="utf-8")
OPTIONAL = ("clock", "parameter_events")
"""What a node may listen to, and does not always."""
TF = find_spec("tf2_msgs") is not None
MIDDLEWARE = re.compile(r"qos_overrides\..*|use_sim_time|start_type_description_service")


def section(node):
    return PAGE.split(f"\n## {node}\n")[1].split("\n## ")[0]


def rows(node):
    """Way, name and type of the topics in the node's section."""
    return re.findall(r"^\* (in|out|service) `(.*?)` \((.*?)\)", section(node), re.MULTILINE)


def parameters(text):
    return set(re.findall(r"^\* `([\w.]+)` \(", text, re.MULTILINE))


@pytest.fixture(scope="module", params=list(MODULES))
def node(request, peer, launch):
    """The node's name, with all topics that parameters can ask for, once it is found."""
    name = request.param
    options = {
        "delta_dynamics": (
            "publish_commands:=true",
            "on_stop:=nothing",
            "publish_reactions:=true",
            "use_wrench:=true",
            "estimate_payload:=true",
            "observe_wrench:=true",
        ),
        "command_gate": ("on_stop:=gravity",),
        # The robot in whose file the masses are.
        "stiffness_monitor": (
            "mechanism:=delta_cu",
            "correct_setpoint:=true",
            "pair_torques:=true",
        ),
        "machine_state": (),
        "machine_sim": (),
    }
    process = launch(MODULES[name], *options[name], "max_wait:=0.05")

    def found():
        assert process.alive(), process.output
        return (name, "/") in peer.node.get_node_names_and_namespaces()

    peer.until(found)
    peer.until(lambda: "joints" in process.output)
    return name


def names(node, found):
    """Types of topics by short names, reactions as one."""
    short = {}
    for topic, (kind, *_) in found:
        name = topic.replace(f"/{node}/", "~/").removeprefix("/")
        name = re.sub("reactions/.*", "reactions/<joint>", name)
        short[name] = re.sub("/(msg|srv)/", "/", kind)
    return short


def test_topics_and_services(node, peer):
    """Those of the node's own table, and those that the security policy allows every node."""
    table = class_of(node).topics.values()
    ask = peer.node
    asked = {
        "in": ask.get_subscriber_names_and_types_by_node,
        "out": ask.get_publisher_names_and_types_by_node,
        "service": ask.get_service_names_and_types_by_node,
    }
    common = ElementTree.parse(REPOSITORY / "docs" / "security" / "node.xml").getroot()

    def agree(way):
        what, how = GROUPS[way].split()
        found = names(node, asked[way](node, "/"))
        # With base_imu the estimates above are rejected, see test_base_imu.py.
        rows = [row for row in table if row.direction == way and row.name != "base_imu"]
        own = {row.name.removeprefix("/"): row.kind for row in rows}
        # Transforms where tf2 is installed.
        own = {name: kind for name, kind in own.items() if TF or not name.startswith("tf")}
        allowed = {element.text.removeprefix("/") for element in common.iterfind(f"{what}[@{how}]/*")}
        listened = set(OPTIONAL) if way == "in" else set()
        return found.items() >= own.items() and found.keys() | listened == own.keys() | allowed

    peer.until(lambda: all(map(agree, asked)))


def test_parameters(node, peer):
    request = ListParameters.Request()
    found = peer.call(ListParameters, f"/{node}/list_parameters", request).result.names
    known = {name for name in found if not MIDDLEWARE.fullmatch(name)}
    own, _, others = section(node).partition("\nAlso, as [other nodes]")
    shared = set(re.findall(r"`([\w.]+)`", others.split("\n")[0]))
    common, some = map(parameters, section("All nodes").split("\nSome nodes also have:\n"))
    assert shared <= some
    assert parameters(own) | common | shared == known


def test_page_and_policy_are_those_of_the_nodes(tmp_path):
    pages = [REPOSITORY / "docs" / "nodes.md", REPOSITORY / "docs" / "security" / "policy.xml"]
    copies = [shutil.copy(page, tmp_path) for page in pages]
    # In a process of its own: it makes every node for a moment.
    subprocess.run([sys.executable, "-m", "tools.pages.nodes", *copies], check=True, cwd=REPOSITORY)
    for page, copy in zip(pages, copies, strict=True):
        assert Path(copy).read_text() == page.read_text()
