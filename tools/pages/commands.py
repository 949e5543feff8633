# SPDX-License-Identifier: Apache-2.0
"""Write docs/commands.md from the commands: ``python -m tools.pages.commands docs/commands.md``."""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from typer.main import get_command

from pkm_twin.apps.cli import app
from pkm_twin.apps.groups import WIDE, commands

SEVERAL = 3
"""Commands that an option has to have with one meaning to be explained once for all."""
SHARED = "Options of several commands"


@dataclass(frozen=True)
class Word:
    """An option or an argument, as help explains it."""

    name: str
    metavar: str
    text: str
    default: str
    argument: bool

    def __str__(self) -> str:
        value = f" {self.metavar}" if self.metavar and not self.argument else ""
        default = f" [default: {self.default}]" if self.default else ""
        return f"* `{self.name}{value}`: {self.text}{default}"


def words_of(command: Any) -> list[Word]:
    """Options and arguments of a command, but for ``--json``."""
    found = []
    for one in command.params:
        argument = one.param_type_name == "argument"
        shown = one.show_default and one.default not in (None, False)
        default = str(one.default) if shown else ""
        name = one.metavar if argument else one.opts[0]
        found.append(Word(name, one.metavar or "", one.help or "", default, argument))
    return [word for word in found if word.name != "--json"]


def leaves(name: str, command: Any) -> dict[str, Any]:
    """The commands of a name, with their words."""
    inner = getattr(command, "commands", None)
    return {name: command} if inner is None else {f"{name} {k}": one for k, one in inner.items()}


def page() -> str:
    """The page, with the commands ordered by task."""
    every, tasks = get_command(app), commands().tasks()
    found = {name: leaves(name, command) for name, command in every.commands.items()}
    users: dict[Word, list[str]] = defaultdict(list)
    for inner in found.values():
        for words, command in inner.items():
            for word in words_of(command):
                users[word].append(words)
    often = [word for word, those in users.items() if len(those) >= SEVERAL]
    shared = [w for w in often if len({words.split()[0] for words in users[w]}) > 1]
    lines = ["# Commands", "", every.help, ""]
    for task, listed in tasks.items():
        lines += [f"**{task}**", ""]
        for name in listed:
            purpose = every.commands[name].get_short_help_str(WIDE)
            lines.append(f"* [`{name}`](#pkm-twin-{name}): {purpose}")
        lines.append("")
    lines += [
        f"## {SHARED}",
        "",
        "Every command has `--json`, which prints JSON, and `--help`.",
        "",
    ]
    lines += [*map(str, sorted(shared, key=lambda word: word.name)), ""]
    for listed in tasks.values():
        for name in listed:
            lines += section(name, every.commands[name], found[name], often, shared)
    return "\n".join(lines).rstrip() + "\n"


def section(
    name: str, command: Any, inner: dict[str, Any], often: Sequence[Word], shared: Sequence[Word]
) -> list[str]:
    """A command, or the commands of a group after what they have in common."""
    lines, own, alone = [f"## `pkm-twin {name}`", ""], set[Word](), command in inner.values()
    if not alone:
        within = [word for one in inner.values() for word in words_of(one)]
        most = len(inner) / 2
        common = [w for w in often if within.count(w) > most and w not in shared]
        own = set(common)
        lines += [command.help, "", *map(str, common), *([""] if common else [])]
        lines += [by_name(shared, within), ""]
    for words, one in inner.items():
        every = words_of(one)
        group = commands().declared(name)
        typed = words if alone else f"{name} {group.shown(words.split()[-1])}"
        usage = " ".join(w.name for w in every if w.argument and w.name not in typed.split())
        lines += [] if alone else [f"### `pkm-twin {words}`", ""]
        lines += [one.help, "", "```console", f"$ pkm-twin {typed} [OPTIONS] {usage}".rstrip()]
        lines += ["```", ""]
        told = [str(word) for word in every if word not in shared and word not in own]
        lines += [*told, ""] if told else []
        lines += [by_name(shared, every), ""] if alone else []
    return lines


def by_name(shared: Sequence[Word], there: Sequence[Word]) -> str:
    """The options that are explained once, by name."""
    found = [f"`{word.name}`" for word in shared if word in there]
    link = f"[options of several commands](#{SHARED.lower().replace(' ', '-')})"
    return f"And of the {link}: {', '.join([*found, '`--json`'])}."


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(page(), encoding="utf-8")
