# SPDX-License-Identifier: Apache-2.0
"""Write docs/commands.md from the commands: ``python -m tools.pages.commands docs/commands.md``."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from typer.main import get_command

from pkm_twin.apps.cli import app

WIDE = 200


def page() -> str:
    """The page, by typer's own writer."""
    words = [sys.executable, "-m", "typer", "pkm_twin.apps.cli", "utils", "docs"]
    written = subprocess.run(
        [*words, "--name", "pkm-twin"], check=True, capture_output=True, text=True
    ).stdout
    lines = {
        name: command.get_short_help_str(WIDE)
        for name, command in get_command(app).commands.items()
    }
    for name, line in lines.items():
        # The writer cuts one-line helps at 45 characters.
        written = re.sub(rf"^\* `{name}`: .*$", f"* `{name}`: {line}", written, count=1, flags=re.M)
    return written.replace("# `pkm-twin`", "# Commands", 1).rstrip() + "\n"


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(page(), encoding="utf-8")
