# SPDX-License-Identifier: Apache-2.0
"""The table of commands by task: where each is, loaded when it is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Final

import typer
from typer.core import TyperGroup
from typer.main import get_command

from pkm_twin.options import Commands

WIDE: Final = 200
"""Characters of a command's purpose, never cut."""


@dataclass(frozen=True)
class Entry:
    """A command's module below ``pkm_twin.apps``, and its function or group there.

    ``tables``: it reads tables and takes the options of their dialect. ``wrenches``: it reads
    wrenches of bags and takes the options of their frames. ``settings``: of typer.
    """

    place: str
    tables: bool = False
    wrenches: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)

    def app(self, name: str) -> typer.Typer:
        """The command under its name, or the group."""
        module, _, attribute = self.place.partition(":")
        found = getattr(import_module(f"pkm_twin.apps.{module}"), attribute)
        if isinstance(found, typer.Typer):
            return found
        if self.wrenches:
            from pkm_twin.apps.wrench_frames import wrench_frames

            found = wrench_frames(found)
        if self.tables:
            from pkm_twin.apps.tables import tables

            found = tables(found)
        app = Commands()
        app.command(name, **self.settings)(found)
        return app


TASKS: Final[Mapping[str, Mapping[str, Entry]]] = {
    "Robots": {
        "robots": Entry("robots:robots"),
        "info": Entry("robots:info"),
        "view": Entry("view.command:view"),
        "certify": Entry("certify_command:certify"),
        "urdf": Entry("robots:urdf"),
        "convert": Entry("robots:convert"),
    },
    "Torques, paths and drives": {
        "torques": Entry("torques_command:torques", tables=True, wrenches=True),
        "path": Entry("path:path_command", tables=True),
        "feed": Entry("feed:feed", tables=True),
        "size": Entry("size:size", tables=True, wrenches=True),
        "loads": Entry("joint_loads:loads", tables=True, wrenches=True),
    },
    "Stiffness, workspace and vibration": {
        # A negative number is no option.
        "compliance": Entry(
            "compliance:compliance",
            settings={"context_settings": {"ignore_unknown_options": True}},
        ),
        "map": Entry("maps:app"),
        "frf": Entry("vibration:frf"),
        "lobes": Entry("vibration:lobes"),
    },
    "Recordings": {
        "check": Entry("check_command:check", tables=True, wrenches=True),
        "trend": Entry("trend:trend"),
        "recover": Entry("replay:recover"),
        "play": Entry("replay:play"),
        "monitor-torques": Entry("guard_check:guard_check"),
        "guard-check": Entry(
            "guard_check:guard_check",
            settings={"hidden": True, "help": "The older name of `monitor-torques`."},
        ),
    },
    "Identification and calibration": {
        "record-kit": Entry("record_kit:record_kit"),
        "excite": Entry("excite:excite"),
        "fit": Entry("fit:fit", tables=True, wrenches=True),
        "drive-friction": Entry("drive_friction:drive_friction_command"),
        "calibrate": Entry("calibrate:calibrate_command"),
        "printer": Entry("printer:printer_command"),
    },
    "Design and export": {
        "design": Entry("design:design_command"),
        "export": Entry("export:app"),
    },
}
"""Commands in the order in which tasks need them."""
OLDER: Final = {"atlas": "map"}
"""Older names of commands, which help does not list."""
GREETING: Final = """pkm-twin: torques, stiffness and recordings of parallel robots. Try

  pkm-twin view delta_cu                       look at a robot in the browser
  pkm-twin compliance five_bar 0 0.36 --wrench 30,0,0,0,0,0
                                               find the weak part under a load
  pkm-twin path delta --cycle 25,305,25 --fastest --out cycle.csv
                                               plan a motion, with its torques

pkm-twin --help lists all commands."""


class _Loaded(Mapping[str, Any]):
    """The table's commands, each built when it is first taken."""

    def __init__(self) -> None:
        self._entries = {name: e for names in TASKS.values() for name, e in names.items()}
        self._built: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._built:
            self._built[name] = get_command(self._entries[name].app(name))
            self._built[name].name = name
        return self._built[name]

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)


class Tasks(TyperGroup):
    """A group that lists its commands by task, and loads a command's module with the command."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands: Any = _Loaded()

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A command, by its name or an older one."""
        return super().get_command(ctx, OLDER.get(cmd_name, cmd_name))

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """A section for each task."""
        longest = max(len(name) for name in self.commands)
        for title, names in TASKS.items():
            found = [(name, self.commands[name]) for name in names]
            rows = [
                (f"{name:{longest}}", command.get_short_help_str(WIDE))
                for name, command in found
                if not command.hidden
            ]
            with formatter.section(title):
                formatter.write_dl(rows)


def greet(ctx: typer.Context) -> None:
    """Three things to try, where no command is given: wrong usage, as scripts see it."""
    if ctx.invoked_subcommand is None:
        typer.echo(GREETING)
        raise typer.Exit(2)
