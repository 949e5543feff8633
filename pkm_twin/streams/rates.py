# SPDX-License-Identifier: Apache-2.0
"""Whether joints move as far as their measured velocities say.

Positions of a wrong scale, unit or sign pass every limit, and so do velocities: their sum over time
does not agree. Both are compared over short blocks, so that noise, late velocities and lost samples
make no difference. Pure.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from pkm_twin.codegen.arrays import Array
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.robot import Robot

BLOCK: Final = 0.05
"""Shortest time over which both are compared, s."""
STEPS: Final = 5
"""Fewest steps of a block."""
BLOCKS: Final = 20
"""Blocks that are judged together."""
LEAST: Final = 0.01
"""Root of the sum of squares of the moves in all blocks below which nothing is said, rad; of a
sliding joint this part of the machine's size."""
MAX_ERROR: Final = 0.4
"""Difference of both over the larger one, root of the sum of squares, that velocities which are
late may have."""


class RateAgreement:
    """Compares the positions of a stream with its velocities.

    ``fault``: the joint that disagrees most in the last blocks that moved, in words; else empty.
    """

    def __init__(self, robot: Robot) -> None:
        self._names, self._units = robot.joint_names, robot.joint_units
        self._least = [LEAST * (robot.size if unit == "m" else 1.0) for unit in self._units]
        self.reset()

    def reset(self) -> None:
        """Forget the stream."""
        self.fault = ""
        self._blocks: deque[tuple[float, list[tuple[float, float]]]] = deque(maxlen=BLOCKS)
        self._begin: tuple[int, list[float]] | None = None

    def push(self, stamp: int, q: Array, qd: Array) -> None:
        """Take a sample, shape (n,) each; the stamp, ns, is later than the last one's."""
        rates = qd.tolist()
        if self._begin is None:
            self._start(stamp, q)
        else:
            half = 0.5 * (stamp - self._last) / SECOND
            pairs = zip(self._sums, self._rates, rates, strict=True)
            self._sums = [total + half * (a + b) for total, a, b in pairs]
            self._steps += 1
            first, before = self._begin
            span = (stamp - first) / SECOND
            if self._steps >= STEPS and span >= BLOCK:
                moves = [now - then for now, then in zip(q.tolist(), before, strict=True)]
                self._blocks.append((span, list(zip(moves, self._sums, strict=True))))
                if len(self._blocks) == BLOCKS:
                    self._judge()
                self._start(stamp, q)
        self._last, self._rates = stamp, rates

    def _start(self, stamp: int, q: Array) -> None:
        self._begin = stamp, q.tolist()
        self._sums, self._steps = [0.0] * len(q), 0

    def _judge(self) -> None:
        worst, fault, moved = MAX_ERROR, "", False
        for j, least in enumerate(self._least):
            pairs = [block[j] for _, block in self._blocks]
            by_q, by_qd = (math.hypot(*column) for column in zip(*pairs, strict=True))
            size = max(by_q, by_qd)
            if size < least:
                continue
            moved = True
            error = math.hypot(*(a - b for a, b in pairs)) / size
            if error > worst:
                worst, unit = error, self._units[j]
                paths = [sum(map(abs, column)) for column in zip(*pairs, strict=True)]
                span = sum(span for span, _ in self._blocks)
                fault = (
                    f"{self._names[j]} moved by {paths[0]:.3g} {unit} in {span:.2g} s, by its "
                    f"velocities {paths[1]:.3g} {unit}: check scales and units of both"
                )
        if moved:
            self.fault = fault
