# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The commands: one file each in ``pkm_twin.apps.commands``, loaded when it is asked for."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import typer
from typer.core import TyperGroup
from typer.main import get_command

from pkm_twin.apps.options import USAGE
from pkm_twin.console import tell
from pkm_twin.errors import UnknownNameError

if TYPE_CHECKING:
    from pkm_twin.apps.frame import Command, Group

UsageError: Any = typer.BadParameter.__mro__[1]
"""Of the click that this typer has."""
WIDE: Final = 200
"""Characters of a command's purpose, never cut."""


TASKS: Final = (
    "Robots", "Torques, paths and drives", "Stiffness, workspace and vibration", "Recordings",
    "Identification and calibration", "Design and export",
)  # fmt: skip
"""Headings of the list of commands, each command names its own."""
OLDER: Final[Mapping[str, tuple[str, ...]]] = {
    "atlas": ("map",), "feed": ("path", "--slow-where-soft"), "guard-check": ("monitor-torques",),
    "printer": ("convert",), "urdf": ("export", "urdf"), "drive-friction": ("fit", "--drive"),
}  # fmt: skip
"""Older names of commands, which help does not list, with the words in their place."""
GREETING: Final = """pkm-twin: torques, stiffness and recordings of parallel robots. Try

  pkm-twin view delta_cu                       look at a robot in the browser
  pkm-twin compliance five_bar 0 0.36 --wrench 30,0,0,0,0,0
                                               find the weak part under a load
  pkm-twin path delta --cycle 25,305,25 --fastest --out cycle.csv
                                               plan a motion, with its torques

pkm-twin --help lists all commands."""


class Loaded(Mapping[str, Any]):
    """Every command by its name, each built when it is first taken."""

    def __init__(self) -> None:
        folder = Path(__file__).parent / "commands"
        self.names = sorted(path.stem.replace("_", "-") for path in folder.glob("[a-z]*.py"))
        self._built: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._built:
            self._built[name] = get_command(self.declared(name).app(name))
            self._built[name].name = name
        return self._built[name]

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def declared(self, name: str) -> Command | Group:
        """What the file of a command declares; its ``app`` is the command as a program."""
        if name not in self.names:
            raise KeyError(name)
        found: Command | Group = import_module(module_of(name)).COMMAND
        return found

    def tasks(self) -> dict[str, list[str]]:
        """Names by task; this loads every command."""
        tasks = {name: self.declared(name).task for name in self.names}
        return {title: [name for name, task in tasks.items() if task == title] for title in TASKS}


@cache
def commands() -> Loaded:
    """All commands of ``pkm-twin``."""
    return Loaded()


def module_of(name: str) -> str:
    """The module of a command."""
    return f"pkm_twin.apps.commands.{name.replace('-', '_')}"


class Tasks(TyperGroup):
    """A group that lists its commands by task, and loads a command's module with the command."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands: Any = commands()

    def main(self, *args: Any, **extra: Any) -> Any:
        """As typer's for a program; what is wrong is one line."""
        try:
            code = super().main(*args, **{**extra, "standalone_mode": False})
        except UsageError as error:
            text = error.format_message().rstrip(".").removeprefix("Invalid value: ")
            context: Any = getattr(error, "ctx", None)
            if text == "Missing command" and context is not None:
                text = f"give one of {', '.join(context.command.list_commands(context))}"
            where = f"; see {context.command_path} --help" if context is not None else ""
            tell(f"{text}{where}")
            sys.exit(USAGE)
        sys.exit(code if isinstance(code, int) else 0)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """A command, by its name or an older one."""
        if args and args[0] in OLDER:
            args = [*OLDER[args[0]], *args[1:]]
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """As click's; a name that is none comes with the closest one."""
        if args[0] not in self.commands and not args[0].startswith("-"):
            names = [name for name in self.commands if not self.commands[name].hidden]
            raise UsageError(str(UnknownNameError("command", args[0], names)), ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """A section for each task."""
        longest = max(len(name) for name in self.commands)
        for title, names in self.commands.tasks().items():
            rows = [
                (f"{name:{longest}}", self.commands[name].get_short_help_str(WIDE))
                for name in names
                if not self.commands[name].hidden
            ]
            with formatter.section(title):
                formatter.write_dl(rows)


def greet(ctx: typer.Context) -> None:
    """Three things to try, where no command is given: wrong usage, as scripts see it."""
    if ctx.invoked_subcommand is None:
        typer.echo(GREETING)
        raise typer.Exit(USAGE)
