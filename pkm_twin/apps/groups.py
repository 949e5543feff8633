# SPDX-License-Identifier: Apache-2.0
"""The list of commands by task, and what ``pkm-twin`` alone prints."""

from __future__ import annotations

from typing import Any, Final

import typer
from typer.core import TyperGroup

WIDE: Final = 200
"""Characters of a command's purpose, never cut."""
TASKS: Final = {
    "Robots": ("robots", "info", "view", "certify", "urdf", "convert"),
    "Torques, paths and drives": ("torques", "path", "feed", "size", "loads"),
    "Stiffness, workspace and vibration": ("compliance", "map", "frf", "lobes"),
    "Recordings": ("check", "trend", "recover", "play", "monitor-torques"),
    "Identification and calibration": (
        "record-kit", "excite", "fit", "drive-friction", "calibrate", "printer",
    ),
    "Design and export": ("design", "export"),
}  # fmt: skip
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


class Tasks(TyperGroup):
    """A group that lists its commands by task."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A command, by its name or an older one."""
        return super().get_command(ctx, OLDER.get(cmd_name, cmd_name))

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """A section for each task; a command that none names is in the last one."""
        named = {name for names in TASKS.values() for name in names}
        others = {"Others": tuple(name for name in self.list_commands(ctx) if name not in named)}
        longest = max(len(name) for name in self.commands)
        for title, names in (TASKS | others).items():
            found = [(name, self.get_command(ctx, name)) for name in names]
            rows = [
                (f"{name:{longest}}", command.get_short_help_str(WIDE))
                for name, command in found
                if command is not None and not command.hidden
            ]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


def greet(ctx: typer.Context) -> None:
    """Three things to try, where no command is given: wrong usage, as scripts see it."""
    if ctx.invoked_subcommand is None:
        typer.echo(GREETING)
        raise typer.Exit(2)
