# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What holds for the whole tree: licences, sizes, and that the README is true."""

import json
import os
import re
import subprocess
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

from pkm_twin import robot_names

REPOSITORY = Path(__file__).resolve().parents[1]
README = (REPOSITORY / "README.md").read_text(encoding="utf-8")


@cache
def files():
    """Names of the files that a clone has."""
    try:
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, check=True).stdout
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


def test_source_files_name_holder_and_licence():
    line = r"Copyright 20\d\d pkm_twin maintainers\. SPDX-License-Identifier: Apache-2\.0"
    for name in files():
        if name.suffix in (".py", ".c", ".cpp", ".hpp") and (REPOSITORY / name).stat().st_size:
            head = (REPOSITORY / name).read_text(encoding="utf-8")[:100]
            assert re.search(line, head), name


def section(title):
    return README.split(f"\n## {title}\n")[1].split("\n## ")[0]


def pages():
    """The README and the pages of docs/, by name."""
    names = [name for name in files() if name.suffix == ".md" and len(name.parts) <= 2]
    return {str(name): (REPOSITORY / name).read_text(encoding="utf-8") for name in names}


def first_cells(text, row):
    """Names in backquotes in the table column ``row``."""
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.split("|")]
        if len(cells) > row + 1:
            yield from re.findall(r"`([^`]+)`", cells[row])


def test_make_targets_exist():
    makefile = (REPOSITORY / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([\w-]+):", makefile, re.MULTILINE))
    for name, text in pages().items():
        # In the lines to type, and in the text between backquotes.
        named = set(re.findall(r"^    make ([\w-]+)|`make ([\w-]+)`", text, re.MULTILINE))
        assert {word for pair in named for word in pair if word} <= targets, name
    assert {"demo", "test"} <= set(re.findall(r"^    make (\w+)", README, re.MULTILINE))
    assert set(re.findall(r'"make ([\w-]+)', makefile)) <= targets


def test_hooks_workflow_and_container_call_what_exists():
    read = {
        path: (REPOSITORY / path).read_text(encoding="utf-8")
        for path in (
            ".github/workflows/ci.yml",
            ".pre-commit-config.yaml",
            "Dockerfile",
            "Makefile",
            ".devcontainer/devcontainer.json",
        )
    }
    jobs = yaml.safe_load(read[".github/workflows/ci.yml"])["jobs"]
    lines = [step.get("run", "") for job in jobs.values() for step in job["steps"]]
    (hooks,) = yaml.safe_load(read[".pre-commit-config.yaml"])["repos"]
    container = json.loads(read[".devcontainer/devcontainer.json"])
    calls = [*lines, container["postCreateCommand"], *(hook["entry"] for hook in hooks["hooks"])]
    targets = set(re.findall(r"\bmake ([\w-]+)", "\n".join(calls)))
    assert targets and targets <= set(re.findall(r"^([\w-]+):", read["Makefile"], re.MULTILINE))
    paths = re.findall(r"(?<![\w/])(?:\.ci|test|bags)/\w*", "\n".join([*calls, read["Dockerfile"]]))
    assert {".ci/run", "test/nodes"} <= set(paths)
    assert all((REPOSITORY / path).exists() for path in paths)
    assert f" AS {container['build']['target']}\n" in read["Dockerfile"]
    (module,) = re.findall(r"python3 -m ([\w.]+)", read["Dockerfile"])
    assert find_spec(module)


def test_the_page_of_commands_has_all():
    """Else `make pages` writes it anew."""
    from pkm_twin.apps.cli import app
    from tools.pages.commands import USUAL

    text = (REPOSITORY / "docs" / "commands.md").read_text(encoding="utf-8")
    written = dict(re.findall(r"^## `pkm-twin ([\w-]+)`\n(.*?)(?=^## |\Z)", text, re.M | re.S))
    commands = app.commands
    assert set(written) == set(commands)
    groups = re.findall(r"^\*\*(\w+ options)\*\*\n\n((?:\* .*\n)+)", text, re.M)
    for name, command in commands.items():
        inner = getattr(command, "commands", {}).values()
        params = [p for c in (command, *inner) for p in c.params]
        options = {o for p in params for o in p.opts if o[:2] == "--"}
        told = written[name]
        told += "".join(those for group, those in groups if re.search(group, told, re.I))
        assert options <= {*re.findall(r"--[\w-]+", told), "--json", *USUAL}, name
        robot = {"ROBOT", "SOURCE", "--robot"} & {
            *options,
            *(p.human_readable_name for p in params),
        }
        assert ("--platform" in options) == bool(robot), name


def anchor(title):
    """The name that a heading is linked by."""
    return re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-")


def test_links_lead_somewhere():
    found = pages()
    anchors = {
        name: {anchor(title) for title in re.findall(r"^#+ (.+)$", text, re.MULTILINE)} for name, text in found.items()
    }
    for name, text in found.items():
        for link in re.findall(r"\]\(([^)\s]+)\)", text):
            path, _, place = link.partition("#")
            if "://" in link:
                continue
            target = (REPOSITORY / name).parent / path if path else REPOSITORY / name
            assert target.exists(), f"{name}: {link}"
            if place:
                assert place in anchors[str(target.resolve().relative_to(REPOSITORY))], link


def test_the_readme_lists_every_robot_and_every_page():
    assert set(first_cells(section("Machines"), 1)) == set(robot_names())
    linked = set(re.findall(r"\]\((docs/\w+\.md)", README))
    assert linked == {name for name in pages() if name.startswith("docs/")}


@pytest.mark.parametrize(("failing", "again", "code"), [(0, 0, 0), (2, 0, 0), (2, 1, 1), (3, 0, 1)])
def test_the_run_names_tests_that_failed_once_and_fails_for_more_than_two(failing, again, code, tmp_path):
    """With programs in place of make and pytest that fail so many tests."""
    names = [f"test/test_x.py::test_{k}" for k in range(failing)]
    first = [f"FAILED {name} - assert 0" for name in names]
    first.append(f"==== {failing} failed, 5 passed in 1.20s (0:00:01) ====")
    words = ["FAILED"] * again + ["PASSED"] * (failing - again)
    second = [f"{word} {name}" for word, name in zip(words, names, strict=True)]
    second.append(f"==== {again} failed, {failing - again} passed in 0.10s ====")
    stubs = {
        "bin/make": (first, failing and '[ "$1" != test ] || exit 2'),
        ".venv/bin/python": (second, again and "exit 1"),
        "bin/ccx": ([], ""),
        "bin/chromium": ([], ""),
    }
    for path, (lines, end) in stubs.items():
        stub = tmp_path / path
        stub.parent.mkdir(parents=True, exist_ok=True)
        text = "\n".join(lines)
        stub.write_text(f"#!/bin/sh\n[ \"$1\" = lint ] || cat <<'END'\n{text}\nEND\n{end or ''}\n")
        stub.chmod(0o755)
    (tmp_path / ".ci").mkdir()
    (tmp_path / ".ci/run").write_text((REPOSITORY / ".ci/run").read_text())
    environment = os.environ | {"PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}"}
    done = subprocess.run(["bash", tmp_path / ".ci/run"], env=environment, capture_output=True, text=True, check=False)
    lines = done.stdout.splitlines()
    assert done.returncode == code, done.stderr
    tried = 0 < failing <= 2
    assert lines[-1] == (second if tried else first)[-1]
    last = lines[-1 - failing : -1]
    if tried:
        passed = [f"failed once, passed alone: {name}" for name in names[again:]]
        assert last[again:] == passed
    elif failing:
        assert last == first[:-1]
