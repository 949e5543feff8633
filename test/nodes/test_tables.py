# SPDX-License-Identifier: Apache-2.0
"""The tables of docs/nodes.md of topics and parameters are those of the running nodes."""

import re
import subprocess
import sys
from importlib.util import find_spec
from xml.etree import ElementTree

import pytest

from pkm_twin.apps.nodes import MODULES
from test.nodes.harness import REPOSITORY

pytest.importorskip("rclpy", exc_type=ImportError)

from rcl_interfaces.srv import ListParameters

PAGE = (REPOSITORY / "docs" / "nodes.md").read_text(encoding="utf-8")
OTHERS = re.compile(r"/(rosout|parameter_events|diagnostics|clock)|.*/transition_event")
TF = find_spec("tf2_msgs") is not None
MIDDLEWARE = re.compile(r"qos_overrides\..*|use_sim_time|start_type_description_service")


def rows(node):
    """Cells of the tables in the node's section."""
    section = PAGE.split(f"\n## {node}\n")[1].split("\n## ")[0]
    for line in section.splitlines():
        cells = [cell.strip() for cell in line.split("|")]
        if len(cells) > 3:
            yield cells[1:-1]


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
    process = launch(MODULES[name], *options[name])

    def found():
        assert process.alive(), process.output
        return (name, "/") in peer.node.get_node_names_and_namespaces()

    peer.until(found)
    peer.until(lambda: "joints" in process.output)
    return name


def topics(node, found):
    """Topics by name, reactions as one."""
    names = {}
    for topic, kinds in found:
        if not OTHERS.fullmatch(topic):
            short = topic.replace(f"/{node}/", "~/").removeprefix("/")
            names[re.sub("reactions/.*", "reactions/<joint>", short)] = kinds[0].replace(
                "/msg/", "/"
            )
    return names


def test_topics(node, peer):
    written = {"in": {}, "out": {}}
    for cells in rows(node):
        # Transforms where tf2 is installed.
        if cells[0] in written and (TF or not cells[1].startswith("`/tf")):
            written[cells[0]][cells[1].strip("`/")] = cells[2]

    def agree():
        ask = peer.node
        return written["in"] == topics(
            node, ask.get_subscriber_names_and_types_by_node(node, "/")
        ) and written["out"] == topics(node, ask.get_publisher_names_and_types_by_node(node, "/"))

    peer.until(agree)


def test_parameters(node, peer):
    request = ListParameters.Request()
    found = peer.call(ListParameters, f"/{node}/list_parameters", request).result.names
    known = {name for name in found if not MIDDLEWARE.fullmatch(name)}
    table = [cells[0] for part in (node, "All nodes") for cells in rows(part) if len(cells) == 5]
    assert {cell.strip("`") for cell in table} - {"parameter", "---"} == known


def test_the_tables_are_those_that_nodes_declare(tmp_path):
    page = tmp_path / "nodes.md"
    page.write_text(PAGE)
    # In a process of its own: it makes every node for a moment.
    subprocess.run([sys.executable, "-m", "tools.pages.nodes", page], check=True, cwd=REPOSITORY)
    assert page.read_text() == PAGE


def allowed(node, what, how):
    """Full names that the security policy's profile of a node allows."""
    folder = REPOSITORY / "docs" / "security"
    policy = ElementTree.parse(folder / "policy.xml")
    profiles = policy.findall(f".//profile[@node='{node}']")
    assert len(profiles) == 1
    common = ElementTree.parse(folder / "node.xml").getroot()
    names = [
        name.text
        for profile in (profiles[0], common)
        for group in profile.findall(f"{what}s[@{how}='ALLOW']")
        for name in group.findall(what)
    ]
    assert len(set(names)) == len(names)
    if not TF:
        names = [name for name in names if name not in ("/tf", "/tf_static")]
    full = {n.replace("~", f"/{node}") for n in names}
    return {n if n.startswith("/") else f"/{n}" for n in full}


def test_the_security_policy_is_that_of_the_node(node, peer):
    """Not less, or the node would not work; and not more but for a clock that it may be given."""
    ask = peer.node

    def names(found):
        return {re.sub("/reactions/.*", "/reactions/*", name) for name, _ in found}

    def agree():
        published = names(ask.get_publisher_names_and_types_by_node(node, "/"))
        heard = names(ask.get_subscriber_names_and_types_by_node(node, "/"))
        served = names(ask.get_service_names_and_types_by_node(node, "/"))
        return (
            published == allowed(node, "topic", "publish")
            and heard | {"/clock", "/parameter_events"} == allowed(node, "topic", "subscribe")
            and served == allowed(node, "service", "reply")
        )

    peer.until(agree)
