# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Report line and branch coverage of the core folders, and what the tests do not reach."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

CORES = (
    "delta_dynamics",
    "pkm_twin/bags",
    "pkm_twin/codegen",
    "pkm_twin/kinematics",
    "pkm_twin/machine",
    "pkm_twin/messages",
    "pkm_twin/streams",
    "stiffness_monitor",
)
BOUND = 95.0
"""Smallest coverage of a folder, per cent."""


def measured() -> dict[str, Any]:
    """Return files and their coverage in the last run."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "coverage", "json", "-q", "-o", str(report)]
        subprocess.run(command, check=True)
        found: dict[str, Any] = json.loads(report.read_text(encoding="utf-8"))["files"]
    return found


def main() -> int:
    """Print the tables; return 1 if a folder is below its bound."""
    folders = defaultdict(list)
    for name, file in measured().items():
        for core in CORES:
            if name.startswith(f"{core}/"):
                folders[core].append((name, file))
    missed = []
    for core, files in sorted(folders.items()):
        totals = [file["summary"] for _, file in files]
        all_of = sum(t["num_statements"] + t["num_branches"] for t in totals)
        reached = sum(t["covered_lines"] + t["covered_branches"] for t in totals)
        share = 100.0 * reached / all_of
        missed += [core] * (share < BOUND)
        print(f"{core:22} {share:5.1f} % of {all_of} lines and branches")
        for name, file in files:
            lines = [str(line) for line in file["missing_lines"]]
            jumps = [f"{a}->{max(b, 0) or 'end'}" for a, b in file["missing_branches"]]
            alone = [j for j in jumps if not {*j.split("->")} & {*lines}]
            if lines or alone:
                own = file["summary"]["percent_covered"]
                print(f"    {name} {own:.1f} %: {', '.join([*lines, *alone])}")
    print(f"below {BOUND:g} %: {', '.join(missed) or 'none'}")
    return bool(missed)


if __name__ == "__main__":
    raise SystemExit(main())
