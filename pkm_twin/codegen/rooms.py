# SPDX-License-Identifier: Apache-2.0
"""Rooms that compiled code reads and writes samples in, and calls without a loop over inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache as remembered
from itertools import pairwise
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array


class Space:
    """Room for samples of a kernel, with everything where the code looks for it.

    Inputs, outputs and status have shape (size,) each, or (samples, size) for several samples.
    """

    def __init__(self, inputs: Sequence[int], outputs: Sequence[int], samples: int = 1) -> None:
        sizes = [*inputs, *outputs, 2]
        ends = samples * np.cumsum([0, *sizes])
        self.numbers = aligned(1, ends[-1])[0]
        self.numbers[:] = 0.0
        views = [self.numbers[a:b] for a, b in pairwise(ends)]
        if samples > 1:
            views = [view.reshape(samples, -1) for view in views]
        self.inputs = views[: len(inputs)]
        self.outputs = views[len(inputs) : -1]
        self.status = views[-1]
        words = [1, samples, 1, 0, 0]
        for view, size in zip(self.inputs, inputs, strict=True):
            words += [view.ctypes.data, size, 0]
        words += [view.ctypes.data for view in [*self.outputs, self.status]]
        self.words = np.array(words, np.int64)
        self.address = self.words.ctypes.data
        self.prepared: Array | None = None

    def point_at(self, prepared: Array) -> None:
        """Use what was prepared of these parameters; kept, so that its address stays its."""
        self.prepared = prepared
        self.words[3] = prepared.ctypes.data

    def takers(self) -> list[memoryview]:
        """Of one sample's inputs: each takes doubles of exactly its length and nothing else."""
        return [memoryview(view.data) for view in self.inputs]


@remembered
def caller(inputs: int, outputs: int) -> Callable[..., Any]:
    """Makes the fast call of a number of inputs, without a loop over them.

    It gives the first output, or of ``outputs`` above zero a list of all, and None for the status.

    A call takes its room from those that are free, so that threads do not share one.
    """
    names = [f"a{k}" for k in range(inputs)]
    given, takers = ", ".join(names), ", ".join(f"t{k}" for k in range(inputs))
    copies = [f"c{k}" for k in range(outputs or 1)]
    results = ", ".join(f"{copy}()" for copy in copies)
    lines = [
        "def make(code, room, array, otherwise):",
        "    free = []",
        "    take, give = free.pop, free.append",
        f"    def call({given}):",
        # A masked array is no array here: its buffer tells nothing of the mask.
        f"        if not ({' is '.join(['array', *(f'type({name})' for name in names)])})"
        " or a0.ndim != 1:",
        f"            return otherwise({given})",
        "        try:",
        "            place = take()",
        "        except IndexError:",
        "            place = room()",
        f"        {takers}, {', '.join(copies)}, address, _ = place",
        "        try:",
        *(f"            t{k}[:] = a{k}" for k in range(inputs)),
        "        except (TypeError, ValueError):",
        "            give(place)",
        f"            return otherwise({given})",
        "        if code(address):",
        "            give(place)",
        f"            return otherwise({given})",
        f"        result = {f'[{results}], None' if outputs else results}",
        "        give(place)",
        "        return result",
        "    return call",
    ]
    space: dict[str, Any] = {}
    exec("\n".join(lines), space)  # noqa: S102
    make: Callable[..., Any] = space["make"]
    return make


def aligned(rows: int, size: int) -> Array:
    """An empty array at a multiple of 64 bytes: no vector lies across two lines of the cache."""
    room = np.empty(rows * size + 8)
    start = -room.ctypes.data % 64 // 8
    return room[start : start + rows * size].reshape(rows, size)
