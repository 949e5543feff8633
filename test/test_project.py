# SPDX-License-Identifier: Apache-2.0
"""What holds for the whole tree: licences, sizes, and that the README is true."""

import re
import shlex
import subprocess
from functools import cache
from pathlib import Path

import pytest

from pkm_twin import robot_names

REPOSITORY = Path(__file__).resolve().parents[1]
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
