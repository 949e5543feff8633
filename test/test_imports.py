# SPDX-License-Identifier: Apache-2.0
"""The arrows between the packages: who may import whom, read from the sources."""

import re
from graphlib import TopologicalSorter

import pytest

from test.support.sources import PURE, arrows, imports, room, sources, within

OWN = {"pkm_twin.errors", "pkm_twin.files", "pkm_twin.threads"}
"""Modules without a folder that all may import."""
CORE = {"pkm_twin.codegen", "pkm_twin.machine", "pkm_twin.kinematics"}
STREAMS = CORE | {PURE, "pkm_twin.streams"}
NODE = STREAMS | {"pkm_twin", "pkm_twin.bags", "pkm_twin.ros"}
TWINS = {"delta_dynamics", "stiffness_monitor"}
MAY = {
    "pkm_twin": {"pkm_twin.machine"},
    "pkm_twin.errors": set(),
    "pkm_twin.files": set(),
    "pkm_twin.threads": set(),
    "pkm_twin.console": set(),
    "pkm_twin.codegen": set(),
    "pkm_twin.bags": set(),
    "pkm_twin.machine": CORE,
    "pkm_twin.kinematics": CORE,
    "pkm_twin.mechanisms": CORE,
    "pkm_twin.export": CORE | TWINS,
    "pkm_twin.design": CORE | TWINS,
    "pkm_twin.identification": CORE,
    PURE: {"pkm_twin.machine"},
    "pkm_twin.streams": CORE | {PURE},
    "pkm_twin.state": STREAMS,
    "delta_dynamics": STREAMS | {"pkm_twin.identification"},
    "stiffness_monitor": STREAMS,
    "pkm_twin.paths": CORE | {"delta_dynamics"},
    "pkm_twin.ros": STREAMS | {"pkm_twin.bags"},
    "delta_dynamics.node": NODE | {"delta_dynamics"},
    "stiffness_monitor.node": NODE | {"stiffness_monitor"},
    "pkm_twin.state.node": NODE | {"pkm_twin.state", "stiffness_monitor"},
    "pkm_twin.atlas": NODE | TWINS | {"pkm_twin.console"},
    "pkm_twin.apps": NODE
    | TWINS
    | {"pkm_twin.console", "pkm_twin.atlas", "pkm_twin.export", "pkm_twin.identification"}
    | {"pkm_twin.paths", "pkm_twin.design"},
}
"""Rooms that each may import, beside itself and :data:`OWN`; so nobody imports apps or a node."""
CIRCLES = {frozenset({"pkm_twin.machine", "pkm_twin.kinematics"})}
"""Rooms that import each other."""
ROS = re.compile(r"rclpy|\w+_msgs|\w+_interfaces")
WITHOUT_ROS = {f"pkm_twin.ros.{name}" for name in ("arguments", "intake", "messages", "signals")}
"""Of the folder that is about ROS."""
APPS_WITH_ROS = {
    f"pkm_twin.apps.{name}" for name in ("demo", "demo_recorder", "demo_tracking", "guard_check")
}


def test_every_room_has_its_row():
    assert {room(module) for module in sources()} == set(MAY)


@pytest.mark.parametrize("importing", MAY)
def test_packages_import_only_what_they_stand_on(importing):
    found = {there for here, there in arrows() if here == importing}
    assert found <= MAY[importing] | OWN
    if importing in ("pkm_twin.codegen", "pkm_twin.bags"):
        assert found <= {"pkm_twin.errors", "pkm_twin.files"}


def test_nobody_imports_in_a_circle():
    """But those that are known."""
    beside = {here: set(there) for here, there in MAY.items()}
    for pair in CIRCLES:
        first, second = pair
        beside[first] -= pair
        beside[second] -= pair
    for here, there in beside.items():
        there.discard(here)
    assert list(TopologicalSorter(beside).static_order())


def test_only_nodes_and_the_ros_package_import_ros():
    for module in sources():
        own = within(module, "pkm_twin.ros") and module not in WITHOUT_ROS
        if not (module.endswith("node") or own or module in APPS_WITH_ROS):
            for name in imports(module):
                assert not ROS.fullmatch(name.split(".")[0]), f"{module} imports {name}"
