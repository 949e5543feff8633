# SPDX-License-Identifier: Apache-2.0
"""docs/contact.md: simulated contacts with machines that depart from their models.

``make contact-table``. Results are kept in out/contact_table.jsonl; a second run continues there.
Arguments: the page, how many contacts, and how many processes.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import chi2

from delta_dynamics import ContactMonitor
from delta_dynamics.estimates.isolation import CLAMPING, PLATFORM, UNKNOWN
from pkm_twin import Robot
from test.laws.contacts import Stream, Strike, measured, moves, pushed, strike
from test.support.robots import load

ROBOTS: Final = ("delta_cu", "linear_delta", "rps3", "prru", "upr_rpu", "five_bar", "stewart")
KINDS: Final = (PLATFORM, "limb", PLATFORM, "limb", CLAMPING)
"""In turn, as often as the prior probabilities have them."""
TRIES: Final = 200
LATEST: Final = 0.3
"""A contact that is not detected within this time is missed, s."""
LATER: Final = 0.03
"""Time from detection to the class in the table, s."""
FREE: Final = 15.0
"""Length of a motion without a contact, s; there is one for five contacts."""
MEASURED: Final = ("delta_cu", "stewart", "examples/machines/rss6.yaml")
KEPT: Final = Path("out/contact_table.jsonl")


def departed(robot: Robot, rng: np.random.Generator, motion: Any, hit: Strike | None) -> Stream:
    """The machine: each mass within 3 %, 3 % of the peak effort as friction, noise."""
    external = None if hit is None else hit.external
    return measured(robot, rng, motion, each=0.03, friction=0.03, external=external)


def contact(robot: Robot, seed: int) -> dict[str, Any]:
    """One contact: what came of it."""
    rng = np.random.default_rng([seed, *robot.name.encode()])
    kind = KINDS[seed % len(KINDS)]
    hit, tries = None, 0
    while hit is None:
        tries += 1
        # Some machines have no limbs that come close to each other.
        kind = "limb" if kind == CLAMPING and tries > 3 else kind
        motion = moves(robot, rng, 3, 0.7, 0.3)
        hits = (strike(robot, rng, motion, kind) for _ in range(TRIES))
        hit = next((one for one in hits if one is not None), None)
    stream = departed(robot, rng, motion, hit)
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
        if late > LATEST or (first is not None and late >= first + LATER):
            break
    row |= {"seconds": hit.begin, "delay": first}
    if first is not None:
        named = CLAMPING if place.where.startswith(CLAMPING) else place.where
        likely = max(place.classes, key=lambda name: place.classes[name])
        row |= {
            "named": named, "likely": likely, "confidence": place.confidence,
            "body": sorted(place.body.split(" and ")) == sorted(hit.bodies),
            "miss": float(np.linalg.norm(place.point - hit.point[k])),
            "deviation": place.deviation, "size": robot.graph.size,
        }  # fmt: skip
    return row


def free(robot: Robot, seed: int) -> dict[str, Any]:
    """A motion without a contact: how often there is one all the same."""
    rng = np.random.default_rng([seed, *robot.name.encode(), 1])
    motion = moves(robot, rng, round(FREE / 0.4), 0.7, 0.5)
    touching = departed(robot, rng, motion, None).watched(robot)
    onsets = int((touching[1:] & ~touching[:-1]).sum())
    return {"robot": robot.name, "kind": "free", "false": onsets, "seconds": float(motion[0][-1])}


def made(task: tuple[str, int, bool]) -> dict[str, Any]:
    """One row, in a process of its own."""
    name, seed, without = task
    row = (free if without else contact)(load(name), seed)
    return row | {"seed": seed}


def collected(count: int, jobs: int | None) -> list[dict[str, Any]]:
    """All rows: those that are kept, and those that are missing."""
    KEPT.parent.mkdir(exist_ok=True)
    rows = [json.loads(line) for line in KEPT.read_text().splitlines()] if KEPT.exists() else []
    known = {(row["robot"], row["seed"], row["kind"] == "free") for row in rows}
    tasks = [(ROBOTS[k % len(ROBOTS)], k // len(ROBOTS), False) for k in range(count)]
    tasks += [(name, seed, True) for name, seed, _ in tasks if seed % 5 == 0]
    missing = sorted((task for task in tasks if task not in known), key=lambda task: task[2])
    with multiprocessing.Pool(jobs) as pool, KEPT.open("a") as kept:
        for row in pool.imap_unordered(made, missing):
            rows.append(row)
            kept.write(json.dumps(row) + "\n")
            kept.flush()
    return rows


def line(name: str, rows: list[dict[str, Any]]) -> str:
    """One robot's row of the table."""
    hits = [row for row in rows if row["kind"] != "free"]
    seen = [row for row in hits if row["delay"] is not None]
    delays = 1e3 * np.array([row["delay"] for row in seen])
    hours = sum(row["seconds"] for row in rows) / 3600.0
    false = sum(row["false"] for row in rows)
    named = [row for row in seen if row["named"] != UNKNOWN]

    def share(rows: list[dict[str, Any]], key: str = "named") -> str:
        if not rows:
            return "-"
        return f"{100 * np.mean([row[key] == row['where'] for row in rows]):.0f} %"

    cells = [
        f"{len(hits)}", f"{len(seen)}",
        f"{np.median(delays):.0f}, {np.quantile(delays, 0.95):.0f}",
        f"{false} in {hours:.2f} h", share(seen, "likely"), share(named),
        f"{100 * (1 - len(named) / len(seen)):.0f} %",
    ]  # fmt: skip
    return f"| {name} | " + " | ".join(cells) + " |"


def rate(rows: list[dict[str, Any]]) -> str:
    """The rate of false alarms, with what its small number allows."""
    hours = sum(row["seconds"] for row in rows) / 3600.0
    count = sum(row["false"] for row in rows)
    most = chi2.ppf(0.95, 2 * count + 2) / (2.0 * hours)
    return f"{count} in {hours:.2f} hours of motion: below {most:.1f} per hour with 95 % confidence"


def kinds(rows: list[dict[str, Any]]) -> str:
    """What each kind of contact is named, in Markdown."""
    lines = []
    seen = [row for row in rows if row["kind"] != "free" and row["delay"] is not None]
    for kind in (PLATFORM, "limb", CLAMPING):
        own = [row for row in seen if row["kind"] == kind]
        counts = [
            sum(row["named"] == row["where"] for row in own),
            *(
                sum(row["named"] == name != row["where"] for row in own)
                for name in (PLATFORM, CLAMPING, UNKNOWN)
            ),
        ]
        rest = len(own) - sum(counts)
        cells = [f"{100 * count / max(len(own), 1):.0f} %" for count in (*counts[:2], rest,
                                                                         *counts[2:])]  # fmt: skip
        lines.append(f"| {kind} | {len(own)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def places(rows: list[dict[str, Any]]) -> str:
    """How far off the places are, where the body is right."""
    good = [row for row in rows if row.get("body") and row["named"] == row["where"]]
    near = [row for row in good if row["deviation"] < 0.1 * row["size"]]
    if not near:
        return "no place is determined"
    miss = 100 * np.array([row["miss"] / row["size"] for row in near])
    return (
        f"in {len(near)} of {len(good)} contacts the standard deviation of the place is below 10 % "
        f"of the machine's size; there it is {np.median(miss):.1f} % off (median; 95 %: "
        f"{np.quantile(miss, 0.95):.0f} %)"
    )


def cost(name: str) -> float:
    """Processor time of samples during a contact over that of the same samples without one."""
    robot, rng = load(name), np.random.default_rng(0)
    motion = moves(robot, rng, 6, 0.5, 0.5)
    wrench = pushed(robot, rng, motion, 1.0, 0.7)
    streams = [measured(robot, rng, motion, wrench=one) for one in (None, wrench)]
    monitors = [ContactMonitor(robot), ContactMonitor(robot)]
    monitors[1].prepare()
    spent = np.zeros(2)
    for k, t in enumerate(motion[0].tolist()):
        once = np.zeros(2)
        for i, (stream, monitor) in enumerate(zip(streams, monitors, strict=True)):
            begin = time.process_time()
            found = monitor.push(t, (stream.q[k], stream.qd[k], stream.qdd[k]), stream.effort[k])
            once[i] = time.process_time() - begin
        if found is not None and found.touching:
            spent += once
    return float(spent[1] / spent[0])


def costs() -> str:
    """The same of machines with three and six joints, in words."""
    three, six, many = (f"{cost(name):.1f}" for name in MEASURED)
    return f"{three} (`delta_cu`), {six} (`stewart`) and {many} (`rss6` of `examples/machines`)"


def page(rows: list[dict[str, Any]]) -> str:
    """The page."""
    table = [line(name, [r for r in rows if r["robot"] == name]) for name in ROBOTS]
    return PAGE.format(
        contacts=sum(row["kind"] != "free" for row in rows),
        table="\n".join([*table, line("all", rows)]),
        kinds=kinds(rows),
        false=rate(rows),
        places=places(rows),
        cost=costs(),
    )


PAGE: Final = """# Contacts

`delta_dynamics` with `observe_wrench` detects contacts from measured efforts, and estimates which
body is struck and where. `make contact-table` writes this page. All figures are simulated: no
contact with a real machine has been measured with pkm_twin.

## Detect and locate

A momentum observer estimates the external joint efforts; a contact is an effort beyond its bound
([nodes](nodes.md#delta_dynamics)). A force F at a point p of a body causes the efforts J(p)' F.
From the first sample of a contact on, places on all bodies are compared by their likelihood: one
force of unknown size and direction, at one place, explains all samples of the last 0.1 s. Limbs
are thin bars that feel little force along themselves. `~/contact_body` has the class:

| class | meaning |
|---|---|
| `platform` | a force on the platform |
| the limb's name | a force on a body or rod between base and platform |
| `clamping A and B` | opposite forces on bodies of two limbs, or of a limb and the platform, that approach each other; only with four joints or more |
| `unknown` | no class has a probability of 0.5, or no single cause explains the efforts |

`~/contact_point` has the most likely place. The diagnostic status has the probability of the
class, the body, and the standard deviation of the place along it. In Python:

```python
import numpy as np
from pkm_twin import load
from delta_dynamics.estimates.isolation import ContactLocator

robot = load("delta_cu")
q = robot.inverse(robot.home())
locator = ContactLocator(robot)
locator.push(0.01, q, np.zeros(3), external=np.array([0.0, 3.0, 0.0]), deviation=np.full(3, 0.02))
place = locator.place()
print(place.where, round(place.confidence, 2), place.body)
```

prints `limb II 1.0 arm II`: only motor 2 feels the contact, which of all forces on the platform
one direction alone would cause.

n joint efforts have n - 1 numbers for the direction. The platform of a machine with three
freedoms can explain every direction, and a rod can explain most of them: with three joints or
fewer, platform and rods are confused, and the probability says so. Clamping then looks like a
collision and is not a class. Six joint efforts separate them all. An effort of one joint alone
does not determine where on its arm the force acts: the standard deviation is then about 0.29 of
the arm's length. While the machine moves, more samples with one force at one place narrow both.
In the recorded collision of another engine (`bags/`) more than 95 % of the samples have the right
class. A load that the model does not know is a force on the platform.

Each sample is checked for a contact. The place is computed every 4 ms, and every 10 ms from 40 ms
after the beginning on. At 500 Hz a sample during a contact takes
{cost}
times the processor time of one without.

## {contacts} simulated contacts

Each mass is wrong by up to 3 %, 3 % of the peak effort are friction that the model does not have,
and efforts and velocities are noisy. The machine follows its path and compresses a spring of
30 N/mm, up to 1.5 times the peak effort or 500 N, with a friction coefficient of 0.2. Places and
times are random; platform, limb and clamping are struck as often as 2 : 2 : 1, where limbs come
close enough to clamp. The bounds are the default ones. The class is that of 30 ms after detection.

| robot | contacts | detected in 0.3 s | after, ms (median, 95 %) | false alarms | most likely class right | named class right | unknown |
|---|---|---|---|---|---|---|---|
{table}

False alarms: {false}.
The default bound grows with the largest effort shown so far, and friction that is not modelled is
learnt from motion in both directions. Until a joint has moved both ways, the bound contains what
opposes it in one direction, up to 20 % of the largest effort: a push against the motion that is
there from its beginning, and is not larger, is reported when the joint turns round. In the first
0.1 s of motion the bound contains all of the 20 %. A bound from the `uncertainty` section of the
robot file does not depend on the motion so far.

Contacts that are not detected cause too little effort at the joints: a rod pushed near its fixed
end, or a force that the structure carries.

| struck | contacts | right | platform | another limb | clamping | unknown |
|---|---|---|---|---|---|---|
{kinds}

Where the body is right, {places}.

## Published figures of real machines

| source | machine | figure |
|---|---|---|
| [Mohammad, Schappler, Ortmaier 2023][isolation] | planar 3-RRR, joint sensors, neural network | 84 % of the struck bodies right |
| [Mohammad et al. 2025][fusion] | planar parallel robot, encoders and one IMU | collisions and clamping detected in 3 to 39 ms |
| [SafePR, 2025][safepr] | planar parallel robot, joint sensors | 72 contacts detected and ended in 25 to 275 ms |

The figures are those of the abstracts. They are measured and ours are simulated, of other machines
and other contacts; they are no comparison of methods.

[isolation]: https://arxiv.org/abs/2308.09650
[fusion]: https://arxiv.org/abs/2505.08334
[safepr]: https://arxiv.org/abs/2501.17773
"""  # noqa: E501


if __name__ == "__main__":
    asked = [int(one) for one in sys.argv[2:4]]
    found = collected(asked[0] if asked else 1000, asked[1] if asked[1:] else None)
    Path(sys.argv[1]).write_text(page(found), encoding="utf-8")
