# SPDX-License-Identifier: Apache-2.0
"""What holds for the whole tree: where ROS may be imported, and that the README is true."""

import ast
import re
import shlex
import subprocess
from functools import cache
from pathlib import Path

import pytest

from pkm_twin import robot_names

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = ("pkm_twin", "delta_dynamics", "stiffness_monitor")
ROS = re.compile(r"rclpy|\w+_msgs|\w+_interfaces")
MAY_IMPORT_ROS = {
    "delta_dynamics/action_node.py",
    "delta_dynamics/estimates_node.py",
    "delta_dynamics/gate_node.py",
    "delta_dynamics/node.py",
    "delta_dynamics/sim_node.py",
    "stiffness_monitor/alarm_node.py",
    "stiffness_monitor/correction_node.py",
    "stiffness_monitor/node.py",
    "pkm_twin/ros/changes.py",
    "pkm_twin/ros/context.py",
    "pkm_twin/ros/listener.py",
    "pkm_twin/ros/node.py",
    "pkm_twin/ros/parameters.py",
    "pkm_twin/ros/qos.py",
    "pkm_twin/ros/run.py",
    "pkm_twin/ros/outputs.py",
    "pkm_twin/ros/player.py",
    "pkm_twin/ros/transforms.py",
    "pkm_twin/state/node.py",
    "pkm_twin/apps/demo.py",
    "pkm_twin/apps/demo_recorder.py",
    "pkm_twin/apps/demo_tracking.py",
    "pkm_twin/apps/guard_check.py",
}
README = (REPOSITORY / "README.md").read_text(encoding="utf-8")


@cache
def files():
    """Names of the files that a clone has."""
    try:
        listed = subprocess.run(
            ["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, check=True
        ).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    names = [Path(name) for name in listed.decode().split("\0") if name]
    return [name for name in names if (REPOSITORY / name).is_file()]


def imports(path):
    """Top-level names that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield node.module.split(".")[0]


def test_only_nodes_player_and_demonstration_import_ros():
    sources = [path for package in PACKAGES for path in (REPOSITORY / package).rglob("*.py")]
    found = {
        path.relative_to(REPOSITORY).as_posix()
        for path in sources
        if any(ROS.fullmatch(name) for name in imports(path))
    }
    assert found == MAY_IMPORT_ROS


def test_dynamics_does_not_stand_on_stiffness():
    for path in (REPOSITORY / "delta_dynamics").rglob("*.py"):
        assert "stiffness_monitor" not in set(imports(path)), path


def test_files_are_small_and_name_no_machines_folder():
    home = re.compile(r"(?<![\w.])/(home|root|Users|work|tmp)/\w")
    for name in files():
        data = (REPOSITORY / name).read_bytes()
        assert len(data) <= 5 * 1024**2, name
        if name.suffix not in (".mcap", ".png"):
            found = home.search(data.decode("utf-8", errors="replace"))
            assert found is None, f"{name}: {found}"


def test_python_files_carry_the_licence():
    for name in files():
        if name.suffix == ".py" and (REPOSITORY / name).stat().st_size:
            head = (REPOSITORY / name).read_text(encoding="utf-8")[:100]
            assert "SPDX-License-Identifier: Apache-2.0" in head, name


def section(title):
    return README.split(f"\n## {title}\n")[1].split("\n## ")[0]


def first_cells(text, row):
    """Names in backquotes in the table column ``row``."""
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.split("|")]
        if len(cells) > row + 1:
            yield from re.findall(r"`([^`]+)`", cells[row])


def test_commands_and_make_targets_exist():
    from typer.main import get_command

    from pkm_twin.apps.cli import app

    typed = re.findall(r"^    ((?:pkm-twin|make) .*)$", README, re.MULTILINE)
    lines = [shlex.split(line, comments=True) for line in typed]
    twin = [line for line in lines if line[0] == "pkm-twin"]
    commands = get_command(app).commands
    assert {line[1] for line in twin} == set(commands)
    for _, name, *words in twin:
        command = commands[name]
        inner = getattr(command, "commands", {})
        parts = [command, *(inner[word] for word in words if word in inner)]
        options = {o for part in parts for parameter in part.params for o in parameter.opts}
        named = {word.strip("[]") for word in words if word.strip("[").startswith("--")} - {"--"}
        assert named <= options, name
    makefile = (REPOSITORY / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([\w-]+):", makefile, re.MULTILINE))
    # In the lines to type, and in the text between backquotes.
    named = {line[1] for line in lines if line[0] == "make"}
    named |= set(re.findall(r"`make ([\w-]+)`", README))
    assert named >= {"demo", "test"}
    assert named <= targets
    helped = re.findall(r'"make ([\w-]+)', makefile)
    assert set(helped) <= targets


def test_readme_lists_every_robot_and_its_links_lead_somewhere():
    assert set(first_cells(section("Mechanisms"), 1)) == set(robot_names())
    for link in re.findall(r"\]\(([^)#]+)\)", README):
        if "://" not in link:
            assert (REPOSITORY / link).exists(), link
