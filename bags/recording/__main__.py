# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Record the bags anew: ``python -m bags.recording [--out DIRECTORY] [NAME ...]``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from bags.recording import (
    record_collision,
    record_delta_cu,
    record_poses,
    record_prru,
    record_soft_joint,
    record_upr_rpu,
)

RECORDERS: Final[dict[str, Callable[..., None]]] = {
    module.NAME: module.record
    for module in (
        record_delta_cu,
        record_collision,
        record_prru,
        record_upr_rpu,
        record_soft_joint,
        record_poses,
    )
}
"""Recorders by the name of the file they write."""
ENDINGS: Final = {record_poses.NAME: ".csv"}
"""Of those that are no bags."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Record the named bags, or all of them."""
    parser = argparse.ArgumentParser(
        prog="python -m bags.recording",
        description="Simulate the machines with independent engines and write the bags. "
        "Needs the packages pin and PyNiteFEA.",
    )
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help=f"which bags, by default all: {', '.join(RECORDERS)}",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(__file__).resolve().parents[1],
        metavar="DIRECTORY",
        help="where the bags go; by default bags/, over the older ones",
    )
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in RECORDERS]
    if unknown:
        parser.error(f"no bag {unknown[0]!r}; there are {', '.join(RECORDERS)}")
    options.out.mkdir(parents=True, exist_ok=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as bars:
        tasks = {name: bars.add_task(name, total=1.0) for name in options.names or RECORDERS}
        for name, task in tasks.items():
            path = options.out / (name + ENDINGS.get(name, ".mcap"))
            RECORDERS[name](path, progress=lambda done, task=task: bars.update(task, completed=done))
            bars.update(task, completed=1.0, description=f"{path} {path.stat().st_size / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
