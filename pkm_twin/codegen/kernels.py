# SPDX-License-Identifier: Apache-2.0
"""Programs that run over leading batch axes, by the best back end that the machine has.

May import: numpy, llvmlite if present, this package, the standard library.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from functools import cache as remembered
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen import cache
from pkm_twin.codegen.arrays import doubles
from pkm_twin.codegen.plain import PlainCode
from pkm_twin.codegen.program import Program

Array = NDArray[np.float64]

SWITCH: Final = "PKM_TWIN_PLAIN"
"""Set to 1: plain Python, as on a machine without llvmlite."""
STEPS: Final = (4, 16, 64, 256, 1024)
"""Steps in which samples are tried again that one step does not reach."""

GOOD: Final = 0.0
REFUSED: Final = 1.0
NOT_FINITE: Final = 2.0

MOST: Final = 1_000_000
"""Upper limit of the numbers in an input, an output or the parameters."""
_WRITERS: Final = ("codegen", "machine", "kinematics", "mechanisms", "streams")
"""Folders beside this one whose sources write programs."""
_F8: Final = np.dtype(np.float64)


@remembered
def _llvm() -> ModuleType | None:
    if os.environ.get(SWITCH, "0") not in ("", "0"):
        return None
    try:
        from pkm_twin.codegen import llvm
    except ImportError:
        return None
    return llvm


def compiled() -> bool:
    """Whether programs are compiled; else they run as plain Python."""
    return _llvm() is not None


@remembered
def _sources() -> str:
    """What the package's formulas hang on: a changed file compiles anew."""
    root = Path(__file__).resolve().parents[1]
    folders = [root / name for name in _WRITERS]
    folders += [root.parent / name for name in ("delta_dynamics", "stiffness_monitor")]
    paths = sorted(path for place in folders for path in place.glob("*.py"))
    return cache.digest(*(path.read_text(encoding="utf-8") for path in paths))


class _Space:
    """Room for one sample of a kernel, with everything where the code looks for it."""

    def __init__(self, inputs: Sequence[int], outputs: Sequence[int]) -> None:
        sizes = [*inputs, *outputs, 2]
        ends = np.cumsum([0, *sizes])
        self.numbers = np.zeros(ends[-1])
        views = [self.numbers[a:b] for a, b in pairwise(ends)]
        self.inputs = views[: len(inputs)]
        # A memory view takes doubles of exactly its length and nothing else.
        self.takers = [memoryview(view.data) for view in self.inputs]
        self.outputs = views[len(inputs) : -1]
        self.status = views[-1]
        words = [1, 1, 0]
        for view in self.inputs:
            words += [view.ctypes.data, 0]
        words += [view.ctypes.data for view in [*self.outputs, self.status]]
        self.words = np.array(words, np.int64)
        self.address = self.words.ctypes.data
        self.parameters: Array | None = None

    def point_at(self, p: Array) -> None:
        """Use these parameters; kept, so that their address stays theirs."""
        self.parameters = p
        self.words[2] = p.ctypes.data


def _take_none(*_: Any) -> Array | None:
    """On plain Python every sample goes the way of a batch."""
    return None


@remembered
def _caller(inputs: int) -> Callable[..., Any]:
    """Makes the fast call of a number of inputs, without a loop over them.

    A call takes its room from those that are free, so that threads do not share one.
    """
    names = [f"a{k}" for k in range(inputs)]
    takers = ", ".join(f"t{k}" for k in range(inputs))
    lines = [
        "def make(code, room, array):",
        "    free = []",
        "    take, give = free.pop, free.append",
        f"    def call({', '.join(names)}):",
        # A masked array is no array here: its buffer tells nothing of the mask.
        f"        if not ({' is '.join(['array', *(f'type({name})' for name in names)])}):",
        "            raise TypeError",
        "        try:",
        "            place = take()",
        "        except IndexError:",
        "            place = room()",
        f"        {takers}, address, copy, _ = place",
        *(f"        t{k}[:] = a{k}" for k in range(inputs)),
        "        result = None if code(address) else copy()",
        "        give(place)",
        "        return result",
        "    return call",
    ]
    space: dict[str, Any] = {}
    exec("\n".join(lines), space)  # noqa: S102
    make: Callable[..., Any] = space["make"]
    return make


class Kernel:
    """One program over batches.

    :param build: writes the program; called only where no compiled one is stored.
    :param key: text that the program's content hangs on, beside the package's own sources.
    """

    def __init__(self, build: Callable[[], Program], key: str) -> None:
        self._build, self._key = build, key
        self._lock = threading.Lock()
        self._spaces: list[_Space] = []

    @cached_property
    def program(self) -> Program:
        """The program itself."""
        return self._build()

    @cached_property
    def _loaded(self) -> tuple[dict[str, Any], Any, Any]:
        """Sizes, then the code for batches and for one sample."""
        llvm = _llvm()
        with self._lock:
            if llvm is None:
                return _header(self.program), PlainCode(self.program), None
            name = cache.digest(self._key, _sources(), llvm.IDENTITY)
            stored = cache.read(name)
            if stored and _sound(stored[0]) and cache.is_object(stored[1], llvm.SYMBOL):
                header, code = stored
            else:
                header, code = _header(self.program), llvm.compile_object(llvm.emit(self.program))
                cache.write(name, header, code)
            address = llvm.load_object(code)
            return header, llvm.PROTOTYPE(address), llvm.LOCKED(address)

    @cached_property
    def sizes(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Sizes of inputs and outputs."""
        header = self._loaded[0]
        return tuple(header["inputs"]), tuple(header["outputs"])

    @cached_property
    def _stepped(self) -> bool:
        return bool(self._loaded[0]["stepped"])

    def warm_up(self) -> None:
        """Compile, or load what is stored, before the first sample is due."""
        self.run_one(np.zeros(self._loaded[0]["parameters"]), [np.zeros(n) for n in self.sizes[0]])

    def __call__(self, p: Array, *inputs: ArrayLike) -> tuple[list[Array], Array | None]:
        """Evaluate over leading batch axes.

        :param p: parameters, shape (k,), contiguous.
        :param inputs: one array an input, shape (..., size), broadcast against each other.
        :returns: outputs, shape (..., size) each, NaN in refused samples; and the status, None
            if all samples are good, else shape (..., 2): 0 good, 1 refused, 2 not finite; and the
            part of the way from home that was reached.
        :raises ValueError: an input that is no real numbers, or whose last axis has another size.
        """
        arrays = [doubles(value) for value in inputs]
        for array, size in zip(arrays, self.sizes[0], strict=True):
            if array.ndim == 0 or array.shape[-1] != size:
                raise ValueError(f"the last axis has to be {size}, the shape is {array.shape}")
        if all(array.ndim == 1 for array in arrays):
            return self.run_one(p, arrays)
        batch = np.broadcast_shapes(*(array.shape[:-1] for array in arrays))
        count = int(np.prod(batch, dtype=np.int64))
        if count == 0:
            return [np.empty((*batch, size)) for size in self.sizes[1]], None
        rows = []
        for array in arrays:
            size = array.shape[-1]
            one = array.size == size
            whole = array.reshape(size) if one else np.broadcast_to(array, (*batch, size))
            # The code reads doubles side by side, which a column of a table is not.
            rows.append(np.ascontiguousarray(whole).reshape(1 if one else count, size))
        outputs, status = self._run(p, rows, count, 1)
        if status is not None and self._stepped:
            self._try_again(p, rows, outputs, status)
            if not status[:, 0].any():
                status = None
        shaped = [output.reshape(*batch, output.shape[-1]) for output in outputs]
        return shaped, None if status is None else status.reshape(*batch, 2)

    def run_one(self, p: Array, inputs: Sequence[Any]) -> tuple[list[Array], Array | None]:
        """One sample of checked shapes, (size,) each; results as the call's."""
        code = self._loaded[2]
        if code is None:
            rows = [np.asarray(value, _F8).reshape(1, -1) for value in inputs]
            outputs, status = self._run(p, rows, 1, 1)
        else:
            try:
                space = self._spaces.pop()
            except IndexError:
                space = _Space(*self.sizes)
            if p is not space.parameters:
                space.point_at(p)
            for view, value in zip(space.inputs, inputs, strict=True):
                view[:] = value
            if not code(space.address):
                results = [view.copy() for view in space.outputs]
                self._spaces.append(space)
                return results, None
            rows = [view.reshape(1, -1).copy() for view in space.inputs]
            outputs = [view.reshape(1, -1).copy() for view in space.outputs]
            status = space.status.reshape(1, 2).copy()
            self._spaces.append(space)
        if status is not None and self._stepped:
            self._try_again(p, rows, outputs, status)
            if not status[0, 0]:
                status = None
        return [output[0] for output in outputs], None if status is None else status[0]

    def first_of_one(self, p: Array) -> Callable[..., Array | None]:
        """The first output of one sample, as fast as can be; on plain Python always None.

        The function takes arrays of doubles of exactly the inputs' shapes, (size,) each, else it
        raises TypeError or ValueError; it gives None where a sample is not good at once.
        """
        code = self._loaded[2]
        if code is None:
            return _take_none
        sizes = self.sizes

        def room() -> tuple[Any, ...]:
            space = _Space(*sizes)
            space.point_at(p)
            return (*space.takers, space.address, space.outputs[0].copy, space)

        result: Callable[..., Array | None] = _caller(len(sizes[0]))(code, room, np.ndarray)
        return result

    def _try_again(
        self, p: Array, rows: Sequence[Array], outputs: Sequence[Array], status: Array
    ) -> None:
        """Samples that one step did not reach, in more and more steps; written in place."""
        for steps in STEPS:
            left = np.flatnonzero(status[:, 0] == REFUSED)
            if not len(left):
                return
            picked = [row if len(row) == 1 else row[left] for row in rows]
            found, again = self._run(p, picked, len(left), steps)
            for output, values in zip(outputs, found, strict=True):
                output[left] = values
            status[left] = np.array([GOOD, 1.0]) if again is None else again

    def _run(
        self, p: Array, rows: Sequence[Array], count: int, steps: int
    ) -> tuple[list[Array], Array | None]:
        header, code, locked = self._loaded
        if locked is None:
            outputs, status = code.run(p, rows, count, steps)
            return outputs, status if status[:, 0].any() else None
        outputs = [np.empty((count, size)) for size in header["outputs"]]
        status = np.empty((count, 2))
        words = [count, steps, p.ctypes.data]
        for row in rows:
            words += [row.ctypes.data, 0 if len(row) == 1 else row.shape[1]]
        words += [output.ctypes.data for output in [*outputs, status]]
        block = np.array(words, np.int64)
        return outputs, status if code(block.ctypes.data) else None


def _header(program: Program) -> dict[str, Any]:
    return {
        "inputs": list(program.inputs.values()),
        "outputs": [len(row) for row in program.outputs.values()],
        "parameters": program.parameters,
        "stepped": program.equations is not None,
    }


def _sound(header: dict[str, Any]) -> bool:
    """Whether a stored header is one that `_header` can have written."""
    match header:
        case {"inputs": [*taken], "outputs": [*given], "parameters": count, "stepped": bool()}:
            return all(type(k) is int and 0 <= k < MOST for k in (*taken, *given, count))
    return False
