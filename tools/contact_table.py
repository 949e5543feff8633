# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write the table of docs/nodes.md: simulated contacts with machines that differ from their models.

``make contact-table``. Results are kept in out/contact_table.jsonl; a second run continues there.
Arguments: the page, how many contacts, and how many processes.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import chi2

from delta_dynamics import ContactMonitor
from delta_dynamics.estimates.isolation import CLAMPING, PLATFORM, UNKNOWN
from pkm_twin import Robot
from test.laws.contacts import Stream, Strike, measured, moves, strike
from test.support.pages import write_section
from test.support.robots import load

ROBOTS: Final = ("delta_cu", "linear_delta", "rps3", "prru", "upr_rpu", "five_bar", "stewart")
KINDS: Final = (PLATFORM, "limb", PLATFORM, "limb", CLAMPING)
"""Kinds in turn, as often as in the prior probabilities."""
MAX_TRIES: Final = 200
DETECTION_TIMEOUT: Final = 0.3
"""A contact that is not detected within this time is missed, s."""
CLASSIFICATION_DELAY: Final = 0.03
"""Time from detection to the class in the table, s."""
FREE_MOTION_TIME: Final = 15.0
"""Length of a motion without a contact, s; there is one for five contacts."""
RESULTS_FILE: Final = Path("out/contact_table.jsonl")


def measure_other_machine(robot: Robot, rng: np.random.Generator, motion: Any, hit: Strike | None) -> Stream:
    """Measure a machine with masses within 3 %, friction of 3 % of the peak effort, and noise."""
    external = None if hit is None else hit.external
    return measured(robot, rng, motion, each=0.03, friction=0.03, external=external)


def simulate_contact(robot: Robot, seed: int) -> dict[str, Any]:
    """Simulate a contact, and return the estimates."""
    rng = np.random.default_rng([seed, *robot.name.encode()])
    kind = KINDS[seed % len(KINDS)]
    hit, tries = None, 0
    while hit is None:
        tries += 1
        # Some machines have no limbs that come close to each other.
        kind = "limb" if kind == CLAMPING and tries > 3 else kind
        motion = moves(robot, rng, 3, 0.7, 0.3)
        hits = (strike(robot, rng, motion, kind) for _ in range(MAX_TRIES))
        hit = next((one for one in hits if one is not None), None)
    stream = measure_other_machine(robot, rng, motion, hit)
    row: dict[str, Any] = {"robot": robot.name, "kind": kind, "where": hit.where, "false": 0}
    monitor, was, first = ContactMonitor(robot), False, None
    for k, t in enumerate(stream.time.tolist()):
        sample = (stream.q[k], stream.qd[k], stream.qdd[k])
        found = monitor.push(t, sample, stream.effort[k])
        late = t - hit.begin
        if found is None:
            continue
        if late < 0.0:
            row["false"] += found.touching and not was
        elif found.touching and first is None:
            first = late
        if found.place is not None and first is not None:
            place = found.place
        was = found.touching
        if late > DETECTION_TIMEOUT or (first is not None and late >= first + CLASSIFICATION_DELAY):
            break
    row |= {"seconds": hit.begin, "delay": first}
    if first is not None:
        named = CLAMPING if place.where.startswith(CLAMPING) else place.where
        row |= {
            "named": named,
            "confidence": place.confidence,
            "body": sorted(place.body.split(" and ")) == sorted(hit.bodies),
            "miss": float(np.linalg.norm(place.point - hit.point[k])),
            "deviation": place.deviation,
            "size": robot.graph.size,
        }
    return row


def count_false_contacts(robot: Robot, seed: int) -> dict[str, Any]:
    """Count the false contacts of a motion without a contact."""
    rng = np.random.default_rng([seed, *robot.name.encode(), 1])
    motion = moves(robot, rng, round(FREE_MOTION_TIME / 0.4), 0.7, 0.5)
    touching = measure_other_machine(robot, rng, motion, None).watched(robot)
    onsets = int((touching[1:] & ~touching[:-1]).sum())
    return {"robot": robot.name, "kind": "free", "false": onsets, "seconds": float(motion[0][-1])}


def compute_row(task: tuple[str, int, bool]) -> dict[str, Any]:
    """Compute one row, in a process of its own."""
    name, seed, without = task
    row = (count_false_contacts if without else simulate_contact)(load(name), seed)
    return row | {"seed": seed}


def collect_rows(count: int, jobs: int | None) -> list[dict[str, Any]]:
    """Return all rows: stored ones, and missing ones that are computed now."""
    RESULTS_FILE.parent.mkdir(exist_ok=True)
    rows = [json.loads(line) for line in RESULTS_FILE.read_text().splitlines()] if RESULTS_FILE.exists() else []
    known = {(row["robot"], row["seed"], row["kind"] == "free") for row in rows}
    tasks = [(ROBOTS[k % len(ROBOTS)], k // len(ROBOTS), False) for k in range(count)]
    tasks += [(name, seed, True) for name, seed, _ in tasks if seed % 5 == 0]
    missing = sorted((task for task in tasks if task not in known), key=lambda task: task[2])
    with multiprocessing.Pool(jobs) as pool, RESULTS_FILE.open("a") as kept:
        for row in pool.imap_unordered(compute_row, missing):
            rows.append(row)
            kept.write(json.dumps(row) + "\n")
            kept.flush()
    return rows


def write_line(name: str, rows: list[dict[str, Any]]) -> str:
    """Write a robot's row of the table."""
    hits = [row for row in rows if row["kind"] != "free"]
    seen = [row for row in hits if row["delay"] is not None]
    delays = 1e3 * np.array([row["delay"] for row in seen])
    named = [row for row in seen if row["named"] != UNKNOWN]
    right = [row["named"] == row["where"] for row in named]
    cells = [
        f"{len(seen)} of {len(hits)}",
        f"{np.median(delays):.0f}, {np.quantile(delays, 0.95):.0f}",
        f"{100 * (1 - len(named) / len(seen)):.0f} %",
        f"{100 * np.mean(right):.0f} %" if right else "-",
    ]
    return f"| {name} | " + " | ".join(cells) + " |"


def write_rate(rows: list[dict[str, Any]]) -> str:
    """Write the rate of false alarms, with its 95 % bound."""
    hours = sum(row["seconds"] for row in rows) / 3600.0
    count = sum(row["false"] for row in rows)
    most = chi2.ppf(0.95, 2 * count + 2) / (2.0 * hours)
    return f"{count} in {hours:.2f} hours of motion: below {most:.1f} per hour with 95 % confidence"


def write_place_errors(rows: list[dict[str, Any]]) -> str:
    """Write the errors of the contact points where the body is right."""
    good = [row for row in rows if row.get("body") and row["named"] == row["where"]]
    near = [row for row in good if row["deviation"] < 0.1 * row["size"]]
    if not near:
        return "no place is determined"
    miss = 100 * np.array([row["miss"] / row["size"] for row in near])
    return (
        f"in {len(good)} contacts class and body are right. In {len(near)} of these the node's "
        f"standard deviation of the place is below 10 % of the machine's size; the place is "
        f"{np.median(miss):.1f} % of the size off (median; 95 %: {np.quantile(miss, 0.95):.0f} %)"
    )


def section(rows: list[dict[str, Any]]) -> str:
    """Write the part of docs/nodes.md."""
    table = [write_line(name, [r for r in rows if r["robot"] == name]) for name in ROBOTS]
    return SECTION.format(
        contacts=sum(row["kind"] != "free" for row in rows),
        table="\n".join([*table, write_line("all", rows)]),
        false=write_rate(rows),
        places=write_place_errors(rows),
    )


SECTION: Final = """{contacts} simulated contacts (`make contact-table`); the class is as estimated 30 ms after detection:

| robot | detected in 0.3 s | after, ms (median, 95 %) | class unknown | class right, of the known |
|---|---|---|---|---|
{table}

False alarms: {false}.
Place: {places}.
"""  # noqa: E501


if __name__ == "__main__":
    asked = [int(one) for one in sys.argv[2:4]]
    found = collect_rows(asked[0] if asked else 1000, asked[1] if asked[1:] else None)
    write_section("contacts", section(found), Path(sys.argv[1]))
