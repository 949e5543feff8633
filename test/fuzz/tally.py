# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Examples at random, what has to hold for each, and what came of them."""

from __future__ import annotations

import json
import math
import random
import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

from pkm_twin.errors import PkmTwinError

BATCH = 500
"""Examples from one seed."""
CORPUS = Path(__file__).with_name("corpus")
LONGEST = 2500
"""Characters of an error: a line, not a page."""
MAX_FAILURES = 20


@dataclass
class Tally:
    """What came of one kind."""

    kind: str
    seed: int = 0
    good: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    times: array[float] = field(default_factory=lambda: array("d"))
    """How long each example took, s."""
    failures: list[str] = field(default_factory=list)
    spent: float = 0.0

    @property
    def examples(self) -> int:
        return len(self.times)

    def note(self, ended: str, seconds: float) -> None:
        self.times.append(seconds)
        if ended == "good":
            self.good += 1
        else:
            self.refused[ended] += 1

    def fail(self, seed: int, error: BaseException, example: Any) -> None:
        lines = str(error).splitlines()
        what = f"{type(error).__name__}: {lines[0] if lines else ''}"
        if len(self.failures) < MAX_FAILURES:
            self.failures.append(f"seed {seed}: {what}: {example!r}"[:3000])

    def as_json(self) -> str:
        return json.dumps(
            {
                "kind": self.kind,
                "seed": self.seed,
                "examples": self.examples,
                "taken": self.good,
                "refused": dict(self.refused.most_common()),
                "99.9 % (s)": float(np.quantile(self.times, 0.999)),
                "failures": self.failures,
            },
            indent=2,
        )


class Kind:
    """Examples of one kind, and what has to hold for each: ``check`` says whether it was taken.

    A kind has :meth:`draw`, or :meth:`strategy` where Hypothesis makes the examples.
    """

    name = ""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def draw(self, rng: random.Random) -> Any:
        raise NotImplementedError

    def strategy(self) -> st.SearchStrategy[Any] | None:
        return None

    def begin(self, seed: int) -> None:
        """Before the examples of a seed."""

    def end(self) -> None:
        """After them: what can be judged together."""

    def check(self, example: Any) -> str:
        """Return "good" or why it was refused; anything that is raised is a failure."""
        raise NotImplementedError

    def corpus(self) -> Iterator[tuple[str, Any]]:
        """Examples that once fell, with their files' names."""
        for path in sorted((CORPUS / type(self).__name__).glob("*")):
            yield path.name, path.read_bytes()


def refusal(act: Callable[[], object]) -> str:
    """How a call ended: "good", or the kind of the package's error."""
    try:
        act()
    except PkmTwinError as error:
        text = str(error)
        assert len(text.splitlines()) == 1 and text.isprintable(), ascii(text[:300])
        assert len(text) < LONGEST, len(text)
        return str(getattr(error, "reason", type(error).__name__))
    return "good"


def damaged(rng: random.Random, data: bytes, times: int = 4) -> bytes:
    """Flip, zero, fill, cut, repeat, move or drop some bytes."""
    for _ in range(rng.randint(1, times)):
        at = rng.randrange(max(len(data), 1))
        size = rng.choice((1, 1, 1, 2, 4, 8, 64))
        other = rng.randrange(max(len(data), 1))
        what = rng.choice(("flip", "zero", "fill", "cut", "repeat", "move", "drop"))
        piece = data[at : at + size]
        if what == "flip" and piece:
            data = data[:at] + bytes((piece[0] ^ 1 << rng.randrange(8),)) + data[at + 1 :]
        elif what == "zero":
            data = data[:at] + bytes(len(piece)) + data[at + size :]
        elif what == "fill":
            data = data[:at] + b"\xff" * len(piece) + data[at + size :]
        elif what == "cut":
            data = data[:at]
        elif what == "repeat":
            data = data[:at] + piece + data[at:]
        elif what == "move":
            data = data[:other] + piece + data[other:]
        elif what == "drop":
            data = data[:at] + data[at + size :]
    return data


def batch(kind: Kind, tally: Tally, seed: int, size: int = BATCH) -> None:
    """Examples of one seed; a failure is noted with it, one of Hypothesis made small first."""
    kind.begin(seed)
    strategy = kind.strategy()
    failing: list[Any] = [None]

    def one(example: Any) -> None:
        failing[0] = example
        began = time.perf_counter()
        ended = kind.check(example)
        tally.note(ended, time.perf_counter() - began)

    def guarded(act: Callable[[], object]) -> None:
        try:
            act()
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            tally.fail(seed, error, failing[0])

    if strategy is None:
        rng = random.Random(seed)
        for _ in range(size):
            guarded(lambda: one(kind.draw(rng)))
    else:
        run = settings(
            max_examples=size,
            deadline=None,
            database=None,
            phases=(Phase.generate, Phase.shrink),
            suppress_health_check=list(HealthCheck),
        )(hypothesis.given(strategy)(one))
        guarded(hypothesis.seed(seed)(run))
    guarded(kind.end)


def run(
    kind: Kind,
    seed: int,
    *,
    seconds: float = math.inf,
    count: int = 0,
    keep: Callable[[Tally], object] = lambda tally: None,
) -> Tally:
    """Batches of seeds that follow from one, for so long, or until there are so many examples.

    What once fell comes first. ``keep`` gets what there is after every batch.
    """
    tally = Tally(kind.name, seed)
    began = time.monotonic()
    for name, example in kind.corpus():
        try:
            kind.check(example)
        except Exception as error:
            tally.fail(seed, error, name)
    chance = random.Random(f"{seed} {kind.name}")
    while True:
        batch(kind, tally, chance.randrange(2**32))
        tally.spent = time.monotonic() - began
        keep(tally)
        if (count and tally.examples >= count) or (not count and tally.spent >= seconds):
            return tally
