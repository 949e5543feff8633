# SPDX-License-Identifier: Apache-2.0
"""The arrows between the packages: who may import whom, read from the sources."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("pkm_twin", "delta_dynamics", "stiffness_monitor")
SOURCES = sorted(p for name in PACKAGES for p in (ROOT / name).rglob("*.py"))
CORE = {
    "pkm_twin.machine", "pkm_twin.mechanisms", "pkm_twin.codegen", "pkm_twin.kinematics",
    "pkm_twin.errors", "pkm_twin.files", "pkm_twin.threads",
}  # fmt: skip
MESSAGES = {"pkm_twin.ros.messages"}
"""Messages to arrays: reads attributes alone, without ROS."""
MAY = {
    "pkm_twin.codegen": {"pkm_twin.errors"},
    "pkm_twin.bags": {"pkm_twin.errors", "pkm_twin.files"},
    "pkm_twin.machine": CORE,
    "pkm_twin.mechanisms": CORE,
    "pkm_twin.kinematics": CORE,
    "pkm_twin.export": CORE,
    "pkm_twin.identification": CORE,
    "pkm_twin.streams": CORE | MESSAGES,
    "pkm_twin.state": CORE | MESSAGES | {"pkm_twin.streams"},
    "delta_dynamics": CORE | MESSAGES | {"pkm_twin.streams", "pkm_twin.identification"},
    "stiffness_monitor": CORE | MESSAGES | {"pkm_twin.streams"},
}
"""Of the project, beside themselves; nodes and cores of nodes may import streams and ros."""
NODES = {
    "delta_dynamics.node",
    "delta_dynamics.action_node",
    "delta_dynamics.estimates_node",
    "stiffness_monitor.alarm_node",
    "stiffness_monitor.correction_node",
    "delta_dynamics.gate_node",
    "delta_dynamics.sim_node",
    "stiffness_monitor.node",
    "pkm_twin.state.node",
}
APPS_WITH_ROS = {
    "pkm_twin.apps.demo",
    "pkm_twin.apps.demo_recorder",
    "pkm_twin.apps.demo_tracking",
    "pkm_twin.apps.guard_check",
}
WITH_ROS = {"rclpy", "rcl_interfaces", "lifecycle_msgs"}


def module_of(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(path):
    """Every module that a source imports when it runs, wherever in it; types alone do not."""
    found = set()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    named = {
        id(inner) for node in ast.walk(tree)
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }  # fmt: skip
    for node in ast.walk(tree):
        if id(node) in named:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def within(module, package):
    return module == package or module.startswith(package + ".")


@pytest.mark.parametrize("package", MAY)
def test_packages_import_only_what_they_stand_on(package):
    allowed = MAY[package] | {package}
    for path in SOURCES:
        module = module_of(path)
        if not within(module, package) or module in NODES:
            continue
        for name in imports(path):
            if name.split(".")[0] in PACKAGES and name not in PACKAGES:
                assert any(within(name, a) for a in allowed), f"{module} imports {name}"


def test_nobody_but_apps_atlas_and_nodes_imports_dynamics_and_elasticity():
    for path in SOURCES:
        module = module_of(path)
        if within(module, "pkm_twin.apps") or within(module, "pkm_twin.atlas") or module in NODES:
            continue
        own = module.split(".")[0]
        for name in imports(path):
            for package in ("delta_dynamics", "stiffness_monitor"):
                assert own == package or not within(name, package), f"{module} imports {name}"


def test_nobody_imports_apps():
    for path in SOURCES:
        module = module_of(path)
        if not within(module, "pkm_twin.apps"):
            for name in imports(path):
                assert not within(name, "pkm_twin.apps"), f"{module} imports {name}"


def test_only_nodes_and_the_ros_package_import_ros():
    for path in SOURCES:
        module = module_of(path)
        if module.endswith("node") or within(module, "pkm_twin.ros") or module in APPS_WITH_ROS:
            continue
        for name in imports(path):
            assert name.split(".")[0] not in WITH_ROS, f"{module} imports {name}"
