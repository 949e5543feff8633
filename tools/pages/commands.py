# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write docs/commands.md from the commands: ``python -m tools.pages.commands docs/commands.md``."""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pkm_twin.apps.cli import app
from pkm_twin.apps.groups import group_by_task

SEVERAL = 2
"""Number of commands with the same option from which on it is explained once."""
SHARED = "Options of several commands"
GROUPS = {
    "--columns": "table",
    "--topic": "recording",
    "--picture": "picture",
    "--teeth": "milling",
}
"""First option of a group of options that the same commands share, and the group's name."""
PLAIN = ("", "TEXT", "NUMBER", "NUMBERS", "COUNT")
"""Metavariables that are left out, as the explanation is clear."""
USUAL = ("--platform", "--base", "--actuated", "--pose", "--carry", "--overwrite")
"""Options of every command that takes a robot, and of every command that writes a file."""


@dataclass(frozen=True)
class Word:
    """An option or an argument, as help explains it."""

    name: str
    metavar: str
    text: str
    default: str
    argument: bool

    def __str__(self) -> str:
        value = "" if self.argument or self.metavar in PLAIN else f" {self.metavar}"
        default = f" [{self.default.removesuffix('.0')}]" if self.default else ""
        return f"* `{self.name}{value}`: {self.text}{default}"


def words_of(command: Any) -> list[Word]:
    """Return options and arguments of a command, except ``--json``."""
    found = []
    for one in command.params:
        argument = one.param_type_name == "argument"
        name = one.human_readable_name if argument else one.opts[0]
        shown = getattr(one, "shown", "")
        found.append(
            Word(
                name,
                one.metavar or "",
                (one.row.text if argument else one.help) or "",
                shown,
                argument,
            )
        )
    return [word for word in found if word.name != "--json"]


def leaves(name: str, command: Any) -> dict[str, Any]:
    """Return the commands below a name, with their words."""
    inner = getattr(command, "commands", None)
    return {name: command} if inner is None else {f"{name} {k}": one for k, one in inner.items()}


def page() -> str:
    """Write the page, with the commands ordered by task."""
    every, tasks = app, group_by_task()
    found = {name: leaves(name, command) for name, command in every.commands.items()}
    users: dict[Word, list[str]] = defaultdict(list)
    for inner in found.values():
        for words, command in inner.items():
            for word in words_of(command):
                users[word].append(words)
    common = {
        name: [w for w, those in users.items() if len(set(those) & set(inner)) > len(inner) / 2]
        for name, inner in found.items()
        if len(inner) > 1
    }
    often = [word for word, those in users.items() if len(those) >= SEVERAL]
    shared = [
        word
        for word in often
        if len({words.split()[0] for words in users[word]}) > 1 or not any(word in words for words in common.values())
    ]
    # An option's name must have one meaning.
    names = [word.name for word in shared]
    groups = Groups([word for word in shared if names.count(word.name) == 1], users)
    lines = ["# Commands", "", every.help, ""]
    for task, listed in tasks.items():
        links = ", ".join(f"[`{name}`](#pkm-twin-{name})" for name in listed)
        lines += [f"* {task}: {links}"]
    lines += [
        "",
        "Every command has `--json` and `--help`, every one that takes a robot `--platform`,",
        "`--base`, `--actuated`, `--pose` and `--carry`, every one that writes a file",
        "`--overwrite`. Ranges and defaults are in brackets; `pkm-twin COMMAND --help` explains the rest.",
        "",
    ]
    lines += [f"## {SHARED}", ""]
    lines += groups.lines()
    for listed in tasks.values():
        for name in listed:
            own = [word for word in common.get(name, ()) if word not in groups.shared]
            lines += section(name, every.commands[name], found[name], own, groups)
    return "\n".join(lines).rstrip() + "\n"


class Groups:
    """Options that are explained once; some of them under one name."""

    def __init__(self, shared: Sequence[Word], users: Mapping[Word, Sequence[str]]) -> None:
        self.shared = sorted(shared, key=lambda word: word.name)
        named = {word.name: word for word in shared}
        self.groups = {
            name: [word for word in self.shared if users[word] == users[named[one]]] for one, name in GROUPS.items()
        }

    def lines(self) -> list[str]:
        """Return the explanations, groups last."""
        alone = [w for w in self.shared if not any(w in words for words in self.groups.values())]
        lines = [*map(str, alone), ""]
        for name, words in self.groups.items():
            lines += [f"**{name.capitalize()} options**", "", *map(str, words), ""]
        return lines

    def named(self, there: Sequence[Word]) -> list[str]:
        """Write the line that names a command's shared options."""
        names = []
        for word in [w for w in self.shared if w in there and w.name not in USUAL]:
            group = [name for name, words in self.groups.items() if word in words]
            name = f"{group[0]} options" if group else f"`{word.name}`"
            if name not in names and word.name[0] == "-":
                names.append(name)
        return [f"Also {', '.join(names)}.", ""] if names else []


def section(name: str, command: Any, inner: dict[str, Any], own: Sequence[Word], groups: Groups) -> list[str]:
    """Write a command, or the commands of a group after their common options."""
    lines, alone = [f"## `pkm-twin {name}`", ""], command in inner.values()
    if not alone:
        within = [word for one in inner.values() for word in words_of(one)]
        often = [word for word in within if within.count(word) > len(inner) / 2]
        lines += [first(command.help), "", *map(str, own), *([""] if own else [])]
        lines += groups.named(often)
    plain = []
    for words, one in inner.items():
        every = words_of(one)
        told = [word for word in every if word not in own and word not in groups.shared]
        names = groups.named([word for word in every if alone or word not in often])
        if not (alone or told or names):
            plain.append(f"`{words.split()[-1]}`")
            continue
        typed = words if alone else f"{name} {command.spell_command(words.split()[-1])}"
        usage = " ".join(w.name for w in every if w.argument and w.name not in typed.split())
        lines += [f"`{f'pkm-twin {typed} {usage}'.rstrip()}`: {first(one.help)}", ""]
        options = ", ".join(f"`{word.name}`" for word in told if not word.argument)
        lines += [f"Options: {options}.", ""] if options else []
        lines += names
    if plain:
        lines += [f"Without options of their own: {', '.join(plain)}.", ""]
    return lines


def first(text: str) -> str:
    """Return the first paragraph of a help text, and those on exit codes."""
    parts = text.split("\n\n")
    return "\n\n".join([parts[0], *(p for p in parts[1:] if p.startswith("Exit code"))])


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(page(), encoding="utf-8")
