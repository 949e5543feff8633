# SPDX-License-Identifier: Apache-2.0
"""Output and picture of docs/trend.md: ``python -m tools.pages.trend docs/trend.md``."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

from examples.nights import record

SHOWN: Final = 5
"""Lines of the output on the page, besides the last."""


def printed(history, picture):
    """Lines that the command prints for a history; it draws the picture."""
    command = [sys.executable, "-m", "pkm_twin.apps.cli", "trend", str(history)]
    command += ["--picture", str(picture), "--overwrite"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    # 1: something drifts.
    assert done.returncode == 1, done.stderr
    return [line for line in done.stdout.splitlines() if line != str(picture)]


def rewritten(text, picture):
    """The page with today's output; the picture is drawn."""
    with tempfile.TemporaryDirectory() as folder:
        history = Path(folder) / "nights.db"
        record(history)
        lines = printed(history, picture)
    block = "\n".join(["```text", *lines[:SHOWN], "...", lines[-1], "```"])
    return re.sub(r"```text\n.*?```", lambda _: block, text, count=1, flags=re.DOTALL)


if __name__ == "__main__":
    page = Path(sys.argv[1])
    text = rewritten(page.read_text(encoding="utf-8"), page.with_suffix(".png"))
    page.write_text(text, encoding="utf-8")
