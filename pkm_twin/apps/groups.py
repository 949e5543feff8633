# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The commands: one file each in ``pkm_twin.apps.commands``, or entry points of other packages."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import click

from pkm_twin.apps.frame import Group
from pkm_twin.apps.options import USAGE
from pkm_twin.console import print_message
from pkm_twin.errors import PkmTwinError
from pkm_twin.extensions import Extensible

MAX_HELP_WIDTH: Final = 200
"""Characters allowed for a command's summary: more than any has, so that none is cut."""

TASKS: Final = (
    "Robots",
    "Torques, paths and drives",
    "Stiffness, workspace and vibration",
    "Recordings",
    "Identification and calibration",
    "Design and export",
)
"""Headings of the list of commands: each command names one of them, or its own."""
OLDER_NAMES: Final[Mapping[str, tuple[str, ...]]] = {
    "atlas": ("map",),
    "feed": ("path", "--slow-where-soft"),
    "guard-check": ("monitor-torques",),
    "printer": ("convert",),
    "urdf": ("export", "urdf"),
    "drive-friction": ("fit", "--drive"),
}
"""Older names of commands, which help does not list, with the words in their place."""
GREETING: Final = """pkm-twin: torques, stiffness and recordings of parallel robots. Try

  pkm-twin view delta_cu                       look at a robot in the browser
  pkm-twin compliance five_bar 0 0.36 --wrench 30,0,0,0,0,0
                                               find the weak part under a load
  pkm-twin path delta --cycle 25,305,25 --fastest --out cycle.csv
                                               plan a motion, with its torques

pkm-twin --help lists all commands."""


@cache
def commands() -> Extensible[click.Command]:
    """Return all commands of ``pkm-twin``, each loaded at its first use."""
    files = sorted((Path(__file__).parent / "commands").glob("[a-z]*.py"))
    names = [file.stem.replace("_", "-") for file in files]
    return Extensible("pkm_twin.commands", click.Command, names, _load_command)


def _load_command(name: str) -> click.Command:
    found = vars(import_module(command_module(name))).values()
    return next(one for one in found if isinstance(one, click.Command) and one.name == name)


def command_module(name: str) -> str:
    """Return the module of a command of this package."""
    return f"pkm_twin.apps.commands.{name.replace('-', '_')}"


def group_by_task() -> dict[str, list[str]]:
    """Return the commands' names by task; this loads every command."""
    tasks: dict[str, list[str]] = {task: [] for task in TASKS}
    for name in commands():
        try:
            task = getattr(commands()[name], "task", "Others")
        except PkmTwinError as error:
            print_message(f"warning: {error}")
        else:
            tasks.setdefault(task, []).append(name)
    return tasks


class Tasks(Group):
    """All commands, listed by task."""

    noun = "command"

    def main(self, *args: Any, **extra: Any) -> Any:
        """Run the program as click does, but report wrong usage in one line."""
        try:
            code = super().main(*args, **{**extra, "standalone_mode": False})
        except click.UsageError as error:
            text, context = error.format_message().rstrip("."), error.ctx
            command = None if context is None else context.command
            if isinstance(error, click.NoSuchOption):
                near = ", ".join(sorted(error.possibilities or ()))
                text = f"No such option: {error.option_name}"
                text += f" (Possible options: {near})" if near else ""
            elif text == "Missing command" and isinstance(command, Group):
                text = f"give one of {', '.join(command.commands)}"
            where = f"; see {context.command_path} --help" if context is not None else ""
            print_message(f"{text}{where}")
            sys.exit(USAGE)
        sys.exit(code if isinstance(code, int) else 0)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse a command's name, replacing an older name; without words, print the greeting."""
        if not args and not ctx.resilient_parsing:
            click.echo(GREETING)
            ctx.exit(USAGE)
        return super().parse_args(ctx, [*OLDER_NAMES.get(args[0], args[:1]), *args[1:]] if args else [])

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write a section for each task."""
        longest = max(len(name) for name in self.commands)
        for task, names in group_by_task().items():
            purposes = [self.commands[name].get_short_help_str(MAX_HELP_WIDTH) for name in names]
            with formatter.section(task):
                rows = zip((f"{name:{longest}}" for name in names), purposes, strict=True)
                formatter.write_dl(list(rows))
