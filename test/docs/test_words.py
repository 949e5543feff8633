# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Texts that users read keep to the field's terms: no banned word in pages, help and messages."""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path

import pytest

import delta_dynamics
import stiffness_monitor
from pkm_twin import Robot, design, load, paths, robot_names
from pkm_twin.apps.cli import app

PACKAGES = (delta_dynamics, stiffness_monitor, paths, design)
ROOT = Path(__file__).parents[2]
BANNED = {
    r"refus(e|es|ed|ing|als?)": "reject (a message); invalid (a value)",
    r"tells?|told|telling": "report, identify, estimate, publish",
    r"beside": "compared with; next to; in addition to",
    r"(?<!standard )deviations?": "standard deviation; difference",
    r"(go|goes) (a|the) path": "follow a path",
    r"distances? (to|from) (a |the )?singularit(y|ies)": "singularity index",
    r"regular (workspace|part)": "largest inscribed cylinder",
    r"both nodes": "all nodes",
    r"at o|the platform's origin": "at the platform's reference point",
    r"fixed axes": "base axes",
    r"is refused; allowed|; allowed:": "what was found; what is expected",
    r"anew|whoever|nobody|for ever|all the same": "again; who; no process; indefinitely; anyway",
    r"hangs? on": "depends on",
    r"say how sure|tell how sure": "return the standard deviation",
    r"looked (after|at)|is felt|is told of": "checked; identifiable; known",
    r"no number\b(?! \d)": "NaN",
    r"something pushes|who pushes": "contact detected; external wrench",
    r"the twin (says|refuses|tells|has ended)": "the model, or the node's name",
    r"(one|two|three|N|m|turns) a (joint|sample|turn|limb|wrench|second)": "per",
    r"way-points?|time line": "waypoint; timeline",
    r"certif(y|ies|ied)": "cross-check",
}
"""Regular expressions of whole words, and what to write."""
SHOWN = {"declare", "echo", "log_throttled", "warn", "warning", "info", "error", "BadParameter"}
"""Functions whose texts users see, beside errors."""


def banned(text: str) -> list[str]:
    """Each banned word of a text, with what to write; code in backquotes is no text."""
    code = r"```.*?```|^ {4}\S.*?$|`[^`]*`|\]\([^)]*\)|<!--.*?-->"
    text = re.sub(code, " ", text, flags=re.DOTALL | re.MULTILINE)
    text = " ".join(text.split())
    return [
        f"{found[0]!r} in '...{text[max(0, found.start() - 30) : found.end() + 20]}...': {right}"
        for word, right in BANNED.items()
        for found in re.finditer(rf"(?<![\w/.~-])({word})(?![\w=])", text, re.IGNORECASE)
    ]


def pages() -> list[str]:
    docs = sorted((ROOT / "docs").glob("*.md"))
    names = (
        "README.md",
        "CONTRIBUTING.md",
        "QUALITY_DECLARATION.md",
        "SECURITY.md",
        "bags/README.md",
        "examples/README.md",
    )
    return [*names, *(f"docs/{p.name}" for p in docs)]


@pytest.mark.parametrize("page", pages())
def test_pages(page):
    assert banned((ROOT / page).read_text(encoding="utf-8")) == []


def test_the_newest_changes():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert banned(text.split("\n## ")[1]) == []


def helps(command):
    """Help of a command, of its options and of the commands in it."""
    yield command.help or ""
    for parameter in command.params:
        yield parameter.row.text if hasattr(parameter, "row") else parameter.help or ""
    for inner in getattr(command, "commands", {}).values():
        yield from helps(inner)


def test_help_of_the_commands():
    top = app
    texts = [top.help or ""]
    for command in top.commands.values():
        texts += helps(command)
    assert [line for text in texts for line in banned(text)] == []


def strings(node: ast.AST):
    """Texts in an expression."""
    for inner in ast.walk(node):
        if isinstance(inner, ast.Constant) and isinstance(inner.value, str):
            yield inner.value


def shown(source: str) -> set[str]:
    """Texts of a module that users see: of errors, logs, printed lines, parameters, arguments."""
    texts: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Raise) and node.exc is not None:
            texts.update(strings(node.exc))
        elif isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if name in SHOWN or name.endswith("Error"):
                texts.update(text for argument in node.args for text in strings(argument))
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "ARGUMENTS":
            texts.update(strings(node.value))
    return texts


def sources() -> list[Path]:
    found = []
    for folder in ("pkm_twin", "delta_dynamics", "stiffness_monitor", "launch"):
        found += sorted((ROOT / folder).rglob("*.py"))
    return found


def test_messages():
    found = [
        f"{path.relative_to(ROOT)}: {line}"
        for path in sources()
        for text in sorted(shown(path.read_text(encoding="utf-8")))
        # A word alone is a key or a choice.
        if " " in text
        for line in banned(text)
    ]
    assert found == []


ROOMS = ("bags", "demo", "messages", "paths", "ros", "state", "streams")
"""Folders of ``pkm_twin`` whose docstrings are in the field's terms; and the twins' packages."""


def docstrings(node: ast.AST):
    """Of a module and its public classes and functions; without names, which are code."""
    for inner in ast.walk(node):
        kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
        if isinstance(inner, kinds) and not getattr(inner, "name", "").startswith("_"):
            text = ast.get_docstring(inner) or ""
            yield re.sub(r"``[^`]*``|:param [^:]*:", " ", text)


def test_public_docstrings():
    found = [
        f"{path.relative_to(ROOT)}: {line}"
        for path in sources()
        if path.parent.relative_to(ROOT).parts[0] not in ("pkm_twin", "launch") or path.parent.name in ROOMS
        for text in docstrings(ast.parse(path.read_text(encoding="utf-8")))
        for line in banned(text)
    ]
    assert found == []


def test_errors_are_described():
    tree = ast.parse((ROOT / "pkm_twin/errors.py").read_text(encoding="utf-8"))
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    texts = [text for node in classes for text in strings(node)]
    assert len(classes) > 5
    assert [line for text in texts for line in banned(text)] == []


def test_docstrings_of_the_python_page():
    """Of the functions and classes that packages export, and of Robot."""
    public = [getattr(package, name) for package in PACKAGES for name in package.__all__]
    public += [inner for one in (*public, Robot) if inspect.isclass(one) for inner in _members(one)]
    texts = {inspect.getdoc(one) or "" for one in (*public, Robot, load, robot_names)}
    plain = [re.sub(r"``.*?``", "", text) for text in sorted(texts)]
    assert [line for text in plain for line in banned(text)] == []


def _members(kind):
    """Methods and properties with names of their own."""
    for name in dir(kind):
        if not name.startswith("_"):
            one = inspect.getattr_static(kind, name)
            yield getattr(one, "func", None) or getattr(one, "fget", None) or one


@pytest.mark.parametrize(
    "text",
    [
        "a value that is refused",
        "what the motion tells",
        "the bag is drawn beside it",
        "6 deviations of the model",
        "the distance to a singularity",
        "a page is made anew",
    ],
)
def test_a_banned_word_is_found(text):
    assert len(banned(f"Good text.\n\nHere {text}\nstands.")) == 1
    assert banned("The key `refuse`, ```\ntold\n``` and a standard\ndeviation.") == []
    assert shown(f"raise ValueError('{text}')") == {text}
