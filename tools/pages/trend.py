# SPDX-License-Identifier: Apache-2.0
"""Output and picture of docs/trend.md: ``python -m tools.pages.trend docs/trend.md``.

Both are of 24 simulated nights. After 17 of them the dry friction of the first drive grows.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

import numpy as np

from pkm_twin import load
from pkm_twin.apps.history import append, measure
from pkm_twin.apps.recorded import read_recording
from test.support.nights import night

NIGHTS: Final = 24
WORN: Final = 17
DAY: Final = 86400.0
FIRST: Final = 1.7621e9
"""The first night, s since 1970."""
SHOWN: Final = 5
"""Lines of the output on the page, besides the last."""


def record(history):
    """Write the nights into a history."""
    robot, rng = load("delta_cu"), np.random.default_rng(5)
    with tempfile.TemporaryDirectory() as folder:
        for k in range(NIGHTS):
            dry = [0.16 if k >= WORN else 0.10, 0.10, 0.10]
            # From night to night the friction of a healthy drive differs too.
            viscous, coulomb = (0.05, 0.05, 0.05), np.array(dry) + rng.normal(0.0, 0.003, 3)
            path = night(Path(folder) / f"{k}.csv", robot, rng, viscous, tuple(coulomb))
            numbers = measure(read_recording(path, robot))
            when = FIRST + DAY * k
            append(history, "cell 3", robot.name, path, when, True, numbers)


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
