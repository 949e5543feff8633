# SPDX-License-Identifier: Apache-2.0
"""Write docs/commands.md from the commands: ``python -m tools.pages.commands docs/commands.md``."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from typer.main import get_command

from pkm_twin.apps.cli import app
from pkm_twin.apps.groups import commands as loaded

WIDE = 200


def page() -> str:
    """The page, by typer's own writer, with the commands ordered by task."""
    words = [sys.executable, "-m", "typer", "pkm_twin.apps.cli", "utils", "docs"]
    written = subprocess.run(
        [*words, "--name", "pkm-twin"], check=True, capture_output=True, text=True
    ).stdout
    head, *sections = re.split(r"^(?=## `pkm-twin )", written.rstrip() + "\n\n", flags=re.M)
    head = head.replace("# `pkm-twin`", "# Commands", 1).partition("**Commands**:")[0]
    commands = get_command(app).commands
    by_name = {
        name: whole(section, command)
        for section in sections
        for name, command in commands.items()
        if section.startswith(f"## `pkm-twin {name}`")
    }
    tasks = loaded().tasks()
    listed = [
        f"**{task}**\n\n" + "".join(
            f"* [`{name}`](#pkm-twin-{name}): {commands[name].get_short_help_str(WIDE)}\n"
            for name in names
        )
        for task, names in tasks.items()
    ]  # fmt: skip
    ordered = [by_name[name] for names in tasks.values() for name in names]
    return (head + "\n".join(listed) + "\n" + "".join(ordered)).rstrip() + "\n"


def whole(section: str, command: Any) -> str:
    """A section whose list of commands has their one-line helps uncut."""
    for name, inner in getattr(command, "commands", {}).items():
        # The writer cuts them at 45 characters.
        line = f"* `{name}`: {inner.get_short_help_str(WIDE)}"
        section = re.sub(
            rf"^\* `{name}`: .*$", lambda _, line=line: line, section, count=1, flags=re.M
        )
    return section


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(page(), encoding="utf-8")
