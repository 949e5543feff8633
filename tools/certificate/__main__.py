# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compare the twin with other engines at length and write a part of docs/validation.md.

Fails where a bound is exceeded; the part is written then too and says so.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from tools.calculix import CCX
from tools.certificate.compare import Figures, compare
from tools.certificate.links import POSES, Links, compare_links, paper_rows
from tools.certificate.machines import ROBOTS
from tools.certificate.report import conclude, document
from tools.certificate.swing import Swing, run, starts


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.certificate", description=__doc__)
    parser.add_argument("--machines", type=int, default=50, help="random machines a robot")
    parser.add_argument("--states", type=int, default=20, help="random states a machine")
    parser.add_argument("--exact", type=int, default=10, help="of these by the slow routes too")
    parser.add_argument("--seed", type=int, default=20261121)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--no-swing", action="store_true", help="leave the free swings out")
    parser.add_argument("--output", type=Path, default=Path("docs/validation.md"))
    options = parser.parse_args()
    exact = min(options.exact, options.states)

    figures = {name: Figures() for name in ROBOTS}
    results: dict[tuple[int, int], Figures] = {}
    swings: dict[int, list[Swing]] = {}
    links: dict[str, Links] = {}
    begun = [] if options.no_swing else starts()
    # Without CalculiX the document says so.
    names = [] if CCX is None else list(POSES)
    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    context = multiprocessing.get_context("spawn")
    with (
        Progress(*columns, TimeElapsedColumn(), console=console) as progress,
        ProcessPoolExecutor(options.jobs, mp_context=context) as pool,
    ):
        machines = progress.add_task("random machines", total=len(ROBOTS) * options.machines)
        swinging = progress.add_task("free swings", total=len(begun))
        bending = progress.add_task("platform compliance", total=len(names))
        # The long ones first.
        work = {pool.submit(run, start): ("swing", k, 0) for k, start in enumerate(begun)}
        for k, name in enumerate(names):
            work[pool.submit(compare_links, name)] = ("links", k, 0)
        for number in range(options.machines):
            for k, name in enumerate(ROBOTS):
                seed = options.seed, k, number
                job = pool.submit(compare, name, seed, options.states, exact)
                work[job] = ("machine", k, number)
        for job in as_completed(work):
            kind, k, number = work[job]
            if job.exception() is not None:
                pool.shutdown(wait=False, cancel_futures=True)
            if kind == "swing":
                swings[k] = job.result()
                progress.advance(swinging)
            elif kind == "links":
                links[names[k]] = job.result()
                progress.advance(bending)
            else:
                results[k, number] = job.result()
                progress.advance(machines)
    for (k, _), found in sorted(results.items()):
        figures[ROBOTS[k]].add(found)
    runs = [swing for k in sorted(swings) for swing in swings[k]]
    ordered = {name: links[name] for name in names}
    text, failures = document(figures, runs, ordered, paper_rows(), options.seed)
    return conclude(options.output, text, failures, console)


if __name__ == "__main__":
    raise SystemExit(main())
