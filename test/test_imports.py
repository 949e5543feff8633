# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Who may import whom, read from the sources; imports for types alone count."""

import ast
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from importlib.util import find_spec
from xml.etree import ElementTree

import pytest

from pkm_twin.apps.groups import command_module, commands
from test.support.sources import ROOT, arrows, imports, nodes, room, sources, within
from tools.pages import architecture

OWN = {
    "pkm_twin.errors",
    "pkm_twin.extensions",
    "pkm_twin.files",
    "pkm_twin.threads",
    "pkm_twin.settings",
}
"""Modules without a folder that all may import."""
GRAPH = {"pkm_twin.codegen", "pkm_twin.machine", "pkm_twin.kinematics"}
CORE = GRAPH | {"pkm_twin.robot"}
STREAMS = CORE | {"pkm_twin.messages", "pkm_twin.streams"}
RECORDINGS = STREAMS | {"pkm_twin.bags", "pkm_twin.mechanisms"}
NODE = RECORDINGS | {"pkm_twin", "pkm_twin.ros"}
TWINS = {"delta_dynamics", "stiffness_monitor"}
MAY = {
    "pkm_twin": {"pkm_twin.robot", "pkm_twin.mechanisms", "pkm_twin.design", "delta_dynamics"},
    "pkm_twin.errors": set(),
    "pkm_twin.extensions": set(),
    "pkm_twin.files": set(),
    "pkm_twin.threads": set(),
    "pkm_twin.settings": set(),
    "pkm_twin.console": set(),
    "pkm_twin.report": {"pkm_twin.console"},
    "pkm_twin.codegen": set(),
    "pkm_twin.bags": set(),
    "pkm_twin.machine": {"pkm_twin.codegen"},
    "pkm_twin.kinematics": GRAPH,
    "pkm_twin.robot": GRAPH,
    "pkm_twin.mechanisms": CORE | {"delta_dynamics"},
    "pkm_twin.export": CORE | TWINS,
    "pkm_twin.design": CORE | TWINS,
    "pkm_twin.identification": RECORDINGS | TWINS | {"pkm_twin.design", "pkm_twin.recordings", "pkm_twin.report"},
    "pkm_twin.messages": CORE | {"pkm_twin.bags"},
    "pkm_twin.streams": CORE | {"pkm_twin.messages"},
    "pkm_twin.recordings": RECORDINGS,
    "pkm_twin.state": STREAMS,
    "delta_dynamics": STREAMS,
    "stiffness_monitor": STREAMS,
    "pkm_twin.paths": RECORDINGS | TWINS | {"pkm_twin.recordings"},
    "pkm_twin.ros": RECORDINGS,
    "delta_dynamics.node": NODE | {"delta_dynamics"},
    "stiffness_monitor.node": NODE | {"stiffness_monitor"},
    "pkm_twin.state.node": NODE | {"pkm_twin.state", "stiffness_monitor"},
    "pkm_twin.maps": NODE | TWINS | {"pkm_twin.console", "pkm_twin.report"},
    "pkm_twin.certify": CORE | {"delta_dynamics"},
    "pkm_twin.view": NODE | TWINS | {"pkm_twin.recordings", "pkm_twin.maps", "pkm_twin.report", "pkm_twin.paths"},
    "pkm_twin.demo": NODE | TWINS | {"pkm_twin.recordings", "pkm_twin.report"},
    "pkm_twin.apps": NODE
    | TWINS
    | {"pkm_twin.console", "pkm_twin.maps", "pkm_twin.export", "pkm_twin.identification"}
    | {"pkm_twin.paths", "pkm_twin.design", "pkm_twin.report"}
    | {"pkm_twin.recordings", "pkm_twin.certify", "pkm_twin.view"},
}
"""Rooms that each may import, beside itself and :data:`OWN`; so nobody imports apps or a node."""
ROS = re.compile(r"rclpy|\w+_(msgs|interfaces|srvs)")
WITHOUT_ROS = {"pkm_twin.ros.arguments", "pkm_twin.ros.signals"}
"""Of the folder that is about ROS."""
WITH_ROS = {
    "pkm_twin.demo.run",
    "pkm_twin.demo.recorder",
    "pkm_twin.demo.tracking",
    "pkm_twin.apps.commands.monitor_torques",
}


def test_every_room_has_its_row():
    assert {room(module) for module in sources()} == set(MAY)


@pytest.mark.parametrize("importing", MAY)
def test_packages_import_only_what_they_stand_on(importing):
    found = {there for here, there in arrows() if here == importing}
    assert found <= MAY[importing] | OWN
    if importing in ("pkm_twin.codegen", "pkm_twin.bags"):
        assert found <= {"pkm_twin.errors", "pkm_twin.files"}


def private_reads(module):
    """Attributes with one underscore of other objects, by name."""
    for node in nodes(module):
        private = isinstance(node, ast.Attribute) and re.match(r"_[a-z]", node.attr)
        if private and getattr(node.value, "id", "") not in ("self", "cls"):
            yield node.attr


def private_names(module):
    """Private functions and attributes that a module defines."""
    text = sources()[module].read_text(encoding="utf-8")
    return set(re.findall(r"(?:def |self\.|^\s*)(_[a-z]\w*)(?=\(|: | = )", text, re.M))


def test_nobody_reads_private_attributes_of_another_room():
    own = {}
    for module in sources():
        own.setdefault(room(module), set()).update(private_names(module))
    everywhere = set().union(*own.values())
    for module in sources():
        foreign = (everywhere & set(private_reads(module))) - own[room(module)]
        assert not foreign, module


def test_the_picture_of_imports_has_every_folder():
    places = architecture.places()
    assert len({*places.values()}) == len(places) > 20
    assert {name for pair in architecture.arrows() for name in pair} == set(places)
    assert all(places[here][1] > places[there][1] for here, there in architecture.arrows())


def test_codegen_names_nothing_above_it():
    above = {name.rpartition(".")[2] for name in MAY} - {"pkm_twin", "codegen", "errors", "files"}
    # As part of a name, or alone in quotation marks (a machine is also an axis of a program).
    quoted = "|".join(f"['\"]{name}['\"]" for name in above - {"machine"})
    text = re.compile(rf"pkm_twin[./]({'|'.join(above)})\b|{quoted}|{'|'.join(TWINS)}")
    for module, path in sources().items():
        if within(module, "pkm_twin.codegen"):
            assert not text.search(path.read_text(encoding="utf-8")), module


def test_nobody_imports_in_a_circle():
    rooms = {here: there - {here} for here, there in MAY.items()}
    assert list(TopologicalSorter(rooms).static_order())
    modules = {here: imports(here) & sources().keys() - {here} for here in sources()}
    assert list(TopologicalSorter(modules).static_order())


def test_only_nodes_and_the_ros_package_import_ros():
    for module in sources():
        own = within(module, "pkm_twin.ros") and module not in WITHOUT_ROS
        if not (room(module).endswith(".node") or own or module in WITH_ROS):
            for name in imports(module):
                assert not ROS.fullmatch(name.split(".")[0]), f"{module} imports {name}"


def test_the_manifest_names_every_message_package_that_is_imported():
    depends = {one.text for one in ElementTree.parse(ROOT / "package.xml").iter("depend")}
    imported = {name.split(".")[0] for module in sources() for name in imports(module)}
    ros = {name for name in imported if ROS.fullmatch(name)}
    assert ros
    assert ros <= depends


def loaded_by(code):
    code += "; import sys; print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, check=True)
    return set(done.stdout.decode().split())


def test_a_command_and_a_node_start_without_what_they_may_never_need():
    """Parts of scipy take longer to load than all the rest of a command."""
    modules = set(map(command_module, commands()))
    loaded = loaded_by(f"import {', '.join(modules)}, delta_dynamics, stiffness_monitor, pkm_twin.state")
    parts = ("linalg", "optimize", "signal", "special", "stats")
    assert not {f"scipy.{part}" for part in parts} & loaded
    # A command is loaded when it is asked for.
    assert not modules & loaded_by("import pkm_twin.apps.cli")
    assert not {"numpy", "rich"} & loaded_by("import pkm_twin.apps.cli")
    # Masked arrays are a tenth of a short command's time.
    code = "from pkm_twin.mechanisms import catalogue; catalogue.find_implausible_numbers(catalogue.load('delta'))"
    assert "numpy.ma" not in loaded_by(code)


def test_the_nodes_start_without_mcap():
    """They decode messages, but read no bag."""
    pytest.importorskip("rclpy")
    modules = [module for module in sources() if room(module).endswith(".node")]
    if find_spec("control_msgs") is None:
        modules.remove("delta_dynamics.nodes.action")
    assert len(modules) > 5
    loaded = loaded_by(f"import pkm_twin.apps.nodes, {', '.join(modules)}")
    assert "rclpy" in loaded
    assert not {name for name in loaded if name.split(".")[0] in ("mcap", "lz4", "zstandard")}
