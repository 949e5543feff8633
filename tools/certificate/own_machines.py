# SPDX-License-Identifier: Apache-2.0
"""All robots and random machines beside the judges: writes docs/certificate_machines.md.

Fails where a bound is exceeded; the page is written all the same and says so.
"""

import argparse
import datetime
import multiprocessing
import os
import tempfile
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np
import yaml
from rich.console import Console
from rich.progress import Progress

from pkm_twin import load, robot_names
from pkm_twin.certify.certificate import BOUNDS, certificate_of
from pkm_twin.errors import PkmTwinError
from pkm_twin.robot.catalogue import config_folder
from test.machine.random_machines import NAMES, plain, variant
from tools.certificate.report import conclude

WHAT = tuple(name for name in BOUNDS if name not in ("round_trip", "batch"))
TITLES = {
    "torques": "torques",
    "platform": "platform",
    "jacobian": "Jacobian",
    "mass_matrix": "mass matrix",
}

HEAD = """# Certificate of machines by their graphs

Every shipped robot, and machines of every joint type with random dimensions, masses, payload,
friction, gravity and wrench, beside engines that compute them anew from the plain description. This
page is written by a program; every number comes from its run of {date}. Make it again with

    make certificate

and a machine of your own with `pkm-twin certify FILE`. The random numbers start from {seed}. Made
with {versions}.

{verdict}

- **maximal**: every body free, every joint equations, all rows by least squares; positions along
  the straight line from home.
- **pinocchio**: a spanning tree of Pinocchio's joints, rods as bodies of their own, loops as
  relative twists; recursive Newton-Euler.
- **mujoco**: another tree, `mj_inverse`, loops closed without MuJoCo's soft constraints. Its bodies
  want some inertia, 1e-14 kg and kg m2 more than they have.

Worst differences over all states: torques over the state's greatest effort, the platform's place in
m and as entries of its rotation, Jacobian and mass matrix over their greatest entry. *Back*: from
joints to pose and back, rad or m. One sample and the batch are equal bit for bit.
"""


def judge(kind, name, number, states, seed):
    """One machine's certificate; ``number`` above zero is a random variant."""
    if kind == "robot":
        return certificate_of(load(config_folder() / f"{name}.yaml"), states=states, seed=seed)
    rng = np.random.default_rng([seed, NAMES.index(name), number])
    description = variant(name, rng) if number else plain(name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.yaml"
        path.write_text(yaml.safe_dump(description))
        return certificate_of(load(path), states=states, seed=seed + number)


def table(results):
    engines = sorted({i.engine for c in results for i in c.items if i.engine != "twin"})
    lines = [
        "| machine | machines | states | constraints, redundant | engine | "
        + " | ".join(f"{TITLES[what]}" for what in WHAT)
        + " | back |",
        "|" + "---|" * (len(WHAT) + 6),
    ]
    by_name = defaultdict(list)
    for certificate in results:
        by_name[certificate.robot].append(certificate)
    for name, group in sorted(by_name.items()):
        first = group[0]
        worst = defaultdict(float)
        for certificate in group:
            for item in certificate.items:
                key = item.engine, item.what
                worst[key] = max(worst[key], item.worst)
        count = sum(certificate.states for certificate in group)
        for engine in engines:
            cells = [f"{worst[engine, what]:.1e}" for what in WHAT if (engine, what) in worst]
            if not cells:
                continue
            lines.append(
                f"| `{name}` | {len(group)} | {count} | {first.rows}, {first.rows - first.rank} "
                f"| {engine} | {' | '.join(cells)} | {worst['twin', 'round_trip']:.1e} |"
            )
    return lines


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", type=int, default=10, help="random machines of each kind")
    parser.add_argument("--states", type=int, default=5, help="random states a machine")
    parser.add_argument("--seed", type=int, default=20261121)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--output", type=Path, default=Path("docs/certificate_machines.md"))
    options = parser.parse_args()
    tasks = [("robot", name, 0) for name in robot_names()]
    tasks += [("machine", name, n) for n in range(options.machines + 1) for name in NAMES]
    results, failures = {}, []
    console = Console(stderr=True)
    context = multiprocessing.get_context("spawn")
    with (
        Progress(console=console) as progress,
        ProcessPoolExecutor(options.jobs, mp_context=context) as pool,
    ):
        bar = progress.add_task("machines", total=len(tasks))
        jobs = {pool.submit(judge, *task, options.states, options.seed): task for task in tasks}
        for job in as_completed(jobs):
            task = jobs[job]
            try:
                results[task] = job.result()
            except PkmTwinError as error:
                failures.append(f"{task[1]}, variant {task[2]}: {error}")
            progress.advance(bar)
    for task in sorted(results):
        failures += [
            f"{task[1]}, variant {task[2]}: {item.engine}'s {item.what} {item.worst:.1e} > "
            f"{item.bound:.1e}"
            for item in results[task].items
            if not item.good
        ]
    found = list(results.values())
    versions = {k: v for certificate in found for k, v in certificate.versions.items()}
    text = HEAD.format(
        date=datetime.datetime.now(datetime.UTC).date(),
        seed=options.seed,
        versions=", ".join(f"{engine} {number}" for engine, number in sorted(versions.items())),
        verdict="All figures are within their bounds."
        if not failures
        else "**Bounds are exceeded:**\n\n" + "\n".join(f"- {line}" for line in failures),
    )
    for title, kind in (("Shipped robots", "robot"), ("Random machines", "machine")):
        rows = table([results[task] for task in sorted(results) if task[0] == kind])
        text += f"\n## {title}\n\n" + "\n".join(rows) + "\n"
    return conclude(options.output, text, failures, console)


if __name__ == "__main__":
    raise SystemExit(main())
