# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Everything at random for as long as asked: ``python -m test.fuzz --seconds 60 --seed 1``.

A kind holds when nothing but the package's own errors comes back, each of them one short printable
line, and nothing is answered, or read, that should not be. Every kind leaves its figures in a
folder; ``--page`` puts those that are there into docs/errors.md, whose other rows stay.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from test.fuzz.bags import DamagedBags, DamagedSplits, NonsenseBags
from test.fuzz.commands import Commands
from test.fuzz.definitions import Cdr
from test.fuzz.files import Csv, Metadata, Urdf, Yaml
from test.fuzz.messages import Messages
from test.fuzz.tally import Kind, run
from test.support.pages import FAULTS, read_section, write_section

KINDS: tuple[type[Kind], ...] = (
    Messages,
    DamagedBags,
    DamagedSplits,
    NonsenseBags,
    Cdr,
    Metadata,
    Yaml,
    Urdf,
    Csv,
    Commands,
)
NODES = "nodes.json"
"""What test_nodes.py leaves there."""
INTRODUCTION = """## Fuzzing

Printed by `make fuzz`: {total:,} random examples, after the inputs that failed in the past
(`test/fuzz/corpus`). A kind passes if only the package's own one-line errors occur, nothing is read
that was not written, and a torque, command or deflection is published only for a valid message (by
the independent rules of `test/fuzz/messages.py`) and equals that of the model.
"""
HEAD = "| kind | examples | accepted | failed |\n" + "|---" * 4 + "|"
NODES_TEXT = """

Real nodes over DDS, {seconds:.0f} s of random messages, requests and clocks ({sent:,}): all nodes
alive; {torques:,} torques received, each finite and with the stamp of a valid message.
"""


def row(found: dict[str, Any]) -> str:
    """A kind's figures as a row of the table."""
    return f"| {found['kind']} | {found['examples']:,} | {found['taken']:,} | {len(found['failures'])} |"


def section(figures: list[dict[str, Any]], nodes: dict[str, Any] | None, before: str) -> str:
    """The figures as a part of the page; of what was not run, what stood there before."""
    old = {line.split("|")[1].strip(): line for line in before.splitlines() if line[:1] == "|"}
    old |= {found["kind"]: row(found) for found in figures}
    rows = [old[kind.name] for kind in KINDS if kind.name in old]
    total = sum(int(line.split("|")[2].replace(",", "")) for line in rows)
    text = f"{INTRODUCTION.format(total=total)}\n{HEAD}\n" + "\n".join(rows)
    if nodes is not None:
        return text + NODES_TEXT.format(**nodes | {"sent": sum(nodes["sent"].values())})
    _, begin, rest = before.partition(NODES_TEXT.strip().partition(",")[0])
    return f"{text}\n\n{begin}{rest}"


def main() -> int:
    """Run from a command line; 0 where everything held."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="for all kinds together")
    parser.add_argument("--seed", type=int, default=1, help="another seed, other examples")
    parser.add_argument("--only", default="", help="kinds with this text in their name, by commas")
    parser.add_argument("--count", type=int, default=0, help="examples a kind, instead of seconds")
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"), help="folder for the figures")
    parser.add_argument("--page", action="store_true", help="only write what is there into the page")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    files = [options.out / f"{kind.__name__}.json" for kind in KINDS]
    if options.page:
        nodes = options.out / NODES
        figures = [json.loads(path.read_text()) for path in files if path.exists()]
        found = json.loads(nodes.read_text()) if nodes.exists() else None
        write_section("fuzz", section(figures, found, read_section("fuzz", FAULTS)), FAULTS)
        return 0
    asked = options.only.split(",")
    kinds = [kind for kind in KINDS if any(word in kind.name for word in asked)]
    failed = False
    for kind in kinds:
        target = options.out / f"{kind.__name__}.json"
        with tempfile.TemporaryDirectory() as folder:
            tally = run(
                kind(Path(folder)),
                options.seed,
                seconds=options.seconds / len(kinds),
                count=options.count,
                keep=lambda tally, target=target: target.write_text(tally.as_json() + "\n"),
            )
        print(
            f"{kind.name}: {tally.examples:,} in {tally.spent:.0f} s, {tally.good:,} taken, "
            f"{dict(tally.refused.most_common(6))}",
            flush=True,
        )
        for failure in tally.failures:
            print(f"  FAILED {failure}", flush=True)
        failed |= bool(tally.failures)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
