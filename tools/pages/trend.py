# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A trend in docs/recordings.md and its picture: ``python -m tools.pages.trend PAGE``."""

from __future__ import annotations

import contextlib
import io
import re
import sys
import tempfile
from pathlib import Path
from typing import Final

from examples.nights import write_history
from pkm_twin.apps import cli

SHOWN: Final = 2
"""Lines of the output on the page, besides the first."""


def run_trend(history, picture):
    """Run the command for a history; return its printed lines."""
    out = io.StringIO()
    try:
        with contextlib.redirect_stdout(out):
            cli.main(["trend", str(history), "--picture", str(picture), "--overwrite"])
    except SystemExit as end:
        # Something drifts.
        assert end.code == 1, out.getvalue()
    return [line for line in out.getvalue().splitlines() if line != str(picture)]


def rewrite_page(text, picture):
    """Return the page with today's output, and draw the picture."""
    with tempfile.TemporaryDirectory() as folder:
        history = Path(folder) / "nights.db"
        write_history(history)
        lines = run_trend(history, picture)
    block = "\n".join(["```text", *lines[: SHOWN + 1], "...", "```"])
    before, trend, after = text.partition("## Find a trend over nights")
    after = re.sub(r"```text\n.*?```", lambda _: block, after, count=1, flags=re.DOTALL)
    return before + trend + after


if __name__ == "__main__":
    page = Path(sys.argv[1])
    text = rewrite_page(page.read_text(encoding="utf-8"), page.with_name("gallery") / "trend.png")
    page.write_text(text, encoding="utf-8")
