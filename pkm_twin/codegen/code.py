# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Run a program over batches of samples, for one machine or many: compiled, or as plain Python."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache as remembered
from functools import cached_property
from itertools import pairwise
from types import ModuleType
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen import cache
from pkm_twin.codegen.arrays import Array, common_batch, doubles
from pkm_twin.codegen.key import ProgramKey
from pkm_twin.codegen.plain import PlainCode
from pkm_twin.codegen.program import Program
from pkm_twin.errors import ParameterError

PLAIN_PYTHON_VARIABLE: Final = "PKM_TWIN_PLAIN"
"""Environment variable: 1 runs programs as plain Python, as on a computer without llvmlite."""
STEPS: Final = (3, 9, 27, 81, 243, 1024)
"""Numbers of steps in which samples that a single step does not reach are tried again."""


VALID: Final = 0.0
REJECTED: Final = 1.0
NOT_FINITE: Final = 2.0
"""Status of a sample: 1 if no assembly was found, 2 if an input or a result is not finite."""
MAX_NUMBERS: Final = 1_000_000
"""Upper limit of the numbers in an input, an output or the parameters."""
MAX_BUFFERED_SAMPLES: Final = 4096
"""Largest batch, samples, that is copied into a preallocated buffer."""
MAX_BUFFER_SIZES: Final = 16
"""Number of batch sizes whose buffers are kept."""


_F8: Final = np.dtype(np.float64)
_NO_INPUT: Final = np.zeros(0)


@remembered
def _import_llvm() -> ModuleType | None:
    if os.environ.get(PLAIN_PYTHON_VARIABLE, "0") not in ("", "0"):
        return None
    try:
        from pkm_twin.codegen import llvm
    except ImportError:
        return None
    return llvm


def compiled() -> bool:
    """Return whether programs are compiled; otherwise they run as plain Python."""
    return _import_llvm() is not None


def slowness() -> str:
    """Return why programs run as plain Python and what to do; empty if they are compiled."""
    if compiled():
        return ""
    if os.environ.get(PLAIN_PYTHON_VARIABLE, "0") not in ("", "0"):
        return f"{PLAIN_PYTHON_VARIABLE} is set: torques take about a thousand times longer"
    return (
        "llvmlite is not installed: torques take about a thousand times longer, too long for "
        "1 kHz; install it with 'sudo apt install python3-llvmlite' or 'pip install llvmlite'"
    )


class KernelBuffers:
    """Preallocated inputs, outputs and status of a kernel, with their addresses for compiled code.

    Each has shape (size,), or (samples, size) for several samples. ``words``: the argument of the
    kernel, see :func:`.llvm.emit`.
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
        """Use prepared parameters; keep a reference, so that their memory stays allocated."""
        self.prepared = prepared
        self.words[3] = prepared.ctypes.data

    def input_views(self) -> list[memoryview]:
        """Return views of one sample's inputs; they accept only doubles of the exact length."""
        return [memoryview(view.data) for view in self.inputs]


@remembered
def make_fast_call_factory(inputs: int, outputs: int) -> Callable[..., Any]:
    """Return a function that makes fast calls for this number of inputs, without a loop over the inputs.

    A call returns the first output; with ``outputs`` above zero a list of all outputs, and None for
    the status. Each call takes a free buffer, so that threads do not share one.
    """
    names = [f"a{k}" for k in range(inputs)]
    arguments, input_views = ", ".join(names), ", ".join(f"t{k}" for k in range(inputs))
    copies = [f"c{k}" for k in range(outputs or 1)]
    results = ", ".join(f"{copy}()" for copy in copies)
    lines = [
        "def make(code, room, array, otherwise):",
        "    free = []",
        "    take, give = free.pop, free.append",
        f"    def call({arguments}):",
        # Masked arrays are excluded: their buffer does not show the mask.
        f"        if not ({' is '.join(['array', *(f'type({name})' for name in names)])}) or a0.ndim != 1:",
        f"            return otherwise({arguments})",
        "        try:",
        "            place = take()",
        "        except IndexError:",
        "            place = room()",
        f"        {input_views}, {', '.join(copies)}, address, _ = place",
        "        try:",
        *(f"            t{k}[:] = a{k}" for k in range(inputs)),
        "        except (TypeError, ValueError):",
        "            give(place)",
        f"            return otherwise({arguments})",
        "        if code(address):",
        "            give(place)",
        f"            return otherwise({arguments})",
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
    """Allocate an array aligned to 64 bytes, so that no vector straddles two cache lines."""
    memory = np.empty(rows * size + 8)
    start = -memory.ctypes.data % 64 // 8
    return memory[start : start + rows * size].reshape(rows, size)


class Code:
    """A program that runs over batches of samples, for one machine or many.

    Expressions of parameters are computed once per machine, see :meth:`prepare`.

    :param build: writes the program; called only if no compiled program is cached.
    :param key: the program's identity.
    """

    def __init__(self, build: Callable[[], Program], key: ProgramKey) -> None:
        self.build, self.key = build, key
        self._lock = threading.Lock()
        self._free_buffers: dict[int, list[KernelBuffers]] = {}
        """Free buffers by their number of samples."""

    @cached_property
    def program(self) -> Program:
        """The program's expressions."""
        return self.build()

    @cached_property
    def _loaded(self) -> tuple[dict[str, Any], Any, Any, Any]:
        """Sizes, then the functions that prepare parameters, run batches and run one sample."""
        llvm = _import_llvm()
        with self._lock:
            if llvm is None:
                plain = PlainCode(self.program)
                return _make_header(self.program, 1), plain.prepare, plain, None
            from pkm_twin.codegen import native

            header, code = self._load_or_compile(llvm, native)
            prepare, address = native.load_object(code)
            prepare = native.LOCK_KEEPING_PROTOTYPE(prepare)
            return header, prepare, native.LOCK_RELEASING_PROTOTYPE(address), native.LOCK_KEEPING_PROTOTYPE(address)

    def _load_or_compile(self, llvm: ModuleType, native: ModuleType) -> tuple[dict[str, Any], bytes]:
        """Return sizes and object code from the cache, or compile them.

        The key's digest leads to the digest of the LLVM assembly, and that to the object code: a
        change of a source file that leaves the assembly unchanged compiles nothing.
        """
        source = self.key.digest(llvm.IDENTITY)
        match cache.read(source):
            case ({"program": str(name), **more}, b"") if not more:
                stored = _read_cached(name, native.SYMBOL)
                if stored is not None:
                    return stored
        header = _make_header(self.program, llvm.LANES)
        level = native.QUICK if self.program.quick else native.OPTIMISATION
        text = llvm.emit(self.program)
        name = cache.digest(text, repr(header), str(level), llvm.IDENTITY)
        with cache.lock_program(name):
            stored = _read_cached(name, native.SYMBOL)
            if stored is None:
                stored = header, native.compile_object(text, level)
                cache.write(name, *stored)
        cache.write(source, {"program": name}, b"")
        return stored

    @cached_property
    def sizes(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Sizes of inputs and outputs."""
        header = self._loaded[0]
        return tuple(header["inputs"]), tuple(header["outputs"])

    def prepare(self, p: Array) -> Array:
        """Compute the expressions of parameters for later samples.

        :param p: parameters of k machines, shape (k, parameters), contiguous, or of one machine,
            (parameters,).
        :returns: shape (k, prepared) or (prepared,); the last entry is :attr:`.Program.missed`.
        """
        header, prepare, _, locked = self._loaded
        if p.shape[-1] != header["parameters"]:
            raise ValueError(f"{header['parameters']} parameters, the shape is {p.shape}")
        rows = np.ascontiguousarray(np.atleast_2d(p), np.float64)
        if locked is None:
            return np.asarray(prepare(rows).reshape(*p.shape[:-1], -1), np.float64)
        result = aligned(len(rows), header["prepared"])
        words = np.array([len(rows), rows.ctypes.data, rows.shape[1], result.ctypes.data], np.int64)
        prepare(words.ctypes.data)
        return result.reshape(*p.shape[:-1], -1)

    @property
    def functions(self) -> tuple[Any, Any] | None:
        """The function for batches and that for one sample, which keeps the interpreter lock."""
        return None if self._loaded[3] is None else self._loaded[2:]

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return int(self._loaded[0]["parameters"])

    def run(self, prepared: Array, *inputs: ArrayLike) -> tuple[list[Array], Array | None]:
        """Evaluate the program over leading batch axes.

        :param prepared: prepared parameters of one machine, contiguous.
        :param inputs: one array per input, shape (..., size), broadcast against each other.
        :returns: outputs, shape (..., size) each, NaN in refused samples; and the status: None if
            all samples are good, else shape (..., 2): 0 good, 1 refused or 2 not finite, and the
            fraction of the motion from home that was reached.
        :raises ValueError: an input is not real numbers, its last axis has another size, or batches differ.
        """
        arrays = self.checked(inputs)
        shape = max(arrays, key=lambda array: array.ndim, default=_NO_INPUT).shape[:-1]
        if shape and not all([a.ndim == 1 or a.shape[:-1] == shape for a in arrays]):
            shape = common_batch(*(a.shape[:-1] for a in arrays))
            arrays = [
                a.reshape(-1) if a.size == a.shape[-1] else np.broadcast_to(a, (*shape, a.shape[-1])) for a in arrays
            ]
        count = math.prod(shape)
        if count == 0:
            return [np.empty((*shape, size)) for size in self.sizes[1]], None
        _, _, code, locked = self._loaded
        if locked is not None and count <= MAX_BUFFERED_SAMPLES:
            # For few samples, copying into a buffer takes less time than reading the arrays' addresses.
            space = self._take_buffers(prepared, count)
            for view, a in zip(space.inputs, arrays, strict=True):
                view[...] = a if a.ndim <= 2 else a.reshape(count, -1)
            bad = (locked if count == 1 else code)(space.address)
            outputs = [view.copy() for view in space.outputs]
            status = space.status.reshape(count, 2).copy() if bad else None
            self._release_buffers(space, count)
        else:
            outputs, status = self._run(prepared[None], _make_rows(arrays, count), count, 1)
        if status is not None:
            flat = [output.reshape(count, -1) for output in outputs]
            status = self._retry_in_steps(prepared[None], _make_rows(arrays, count), flat, status, count)
        if locked is None or len(shape) != (count > 1):
            outputs = [output.reshape(*shape, -1) for output in outputs]
        return outputs, None if status is None else status.reshape(*shape, 2)

    def _take_buffers(self, prepared: Array, count: int) -> KernelBuffers:
        """Take a buffer for ``count`` samples; :meth:`_release_buffers` returns it to the pool."""
        free = self._free_buffers.get(count)
        if free is None:
            if len(self._free_buffers) >= MAX_BUFFER_SIZES:
                self._free_buffers = {}
            free = self._free_buffers[count] = []
        try:
            space = free.pop()
        except IndexError:
            space = KernelBuffers(*self.sizes, count)
        if prepared is not space.prepared:
            space.point_at(prepared)
        return space

    def _release_buffers(self, space: KernelBuffers, count: int) -> None:
        """Return a buffer to the pool; drop it if the pool no longer keeps this size."""
        free = self._free_buffers.get(count)
        if free is not None:
            free.append(space)

    def run_machines(self, prepared: Array, *inputs: Array) -> tuple[list[Array], Array | None]:
        """Evaluate the program for k machines, each with its own parameters.

        :param prepared: shape (k, prepared).
        :param inputs: shape (k, samples, size); the first axis may be 1 for equal inputs of all
            machines, the second 1 for equal inputs of all samples.
        :returns: outputs, shape (k, samples, size) each, and the status, None or (k, samples, 2).
        """
        arrays = self.checked(inputs)
        machines, count = len(prepared), max(array.shape[1] for array in arrays)
        if machines * count == 0:
            return [np.empty((machines, count, size)) for size in self.sizes[1]], None
        rows = [np.ascontiguousarray(array) for array in arrays]
        prepared = np.ascontiguousarray(prepared)
        outputs, status = self._run(prepared, rows, count, 1)
        if status is not None:
            status = self._retry_in_steps(prepared, rows, outputs, status, count)
        shaped = [output.reshape(machines, count, -1) for output in outputs]
        return shaped, None if status is None else status.reshape(machines, count, 2)

    def checked(self, inputs: Sequence[ArrayLike]) -> list[Array]:
        """Convert inputs to doubles of the right sizes; raise the errors of :meth:`run`."""
        arrays = [doubles(value) for value in inputs]
        for array, size in zip(arrays, self.sizes[0], strict=True):
            if array.ndim == 0 or array.shape[-1] != size:
                raise ValueError(f"the last axis has to be {size}, the shape is {array.shape}")
        return arrays

    def bound(self, prepared: Array, otherwise: Callable[..., Any], outputs: int = 0) -> Callable[..., Any]:
        """Return a fast function of the inputs for one machine.

        It is fast for a single sample that is good in the first attempt, with arrays of doubles of
        exactly the inputs' shapes, (size,) each. All other calls go to ``otherwise``.

        :param outputs: number of outputs, to return all of them as :meth:`run` does; by default
            only the first output is returned.
        """
        code = self._loaded[3]
        if code is None:
            return otherwise
        sizes = self.sizes

        def make_buffers() -> tuple[Any, ...]:
            space = KernelBuffers(*sizes)
            space.point_at(prepared)
            copies = (view.copy for view in space.outputs[: outputs or 1])
            return (*space.input_views(), *copies, space.address, space)

        make = make_fast_call_factory(len(sizes[0]), outputs)
        call: Callable[..., Any] = make(code, make_buffers, np.ndarray, otherwise)
        return call

    def _retry_in_steps(
        self,
        prepared: Array,
        rows: Sequence[Array],
        outputs: Sequence[Array],
        status: Array,
        count: int,
    ) -> Array | None:
        """Solve rejected samples again, each time in more steps; return the final status.

        Outputs are replaced in place; the status is None if all samples are good.
        """
        for steps in STEPS:
            rejected = np.flatnonzero(status[:, 0] == REJECTED)
            if not len(rejected) or not self._loaded[0]["stepped"]:
                break
            machines, samples = np.divmod(rejected, count)
            for machine in np.unique(machines) if len(prepared) > 1 else [0]:
                indices = rejected[machines == machine] if len(prepared) > 1 else rejected
                at = samples[machines == machine] if len(prepared) > 1 else samples
                inputs = [row[machine if len(row) > 1 else 0][at if row.shape[1] > 1 else [0]][None] for row in rows]
                parameters = prepared[machine : machine + 1]
                values_found, again = self._run(parameters, inputs, len(indices), steps)
                for output, values in zip(outputs, values_found, strict=True):
                    output[indices] = values
                status[indices] = np.array([VALID, 1.0]) if again is None else again
        return status if status[:, 0].any() else None

    def _run(self, prepared: Array, rows: Sequence[Array], count: int, steps: int) -> tuple[list[Array], Array | None]:
        header, _, code, locked = self._loaded
        machines = len(prepared)
        if locked is None:
            parts = [
                code.run(one, [row[k if len(row) > 1 else 0] for row in rows], count, steps)
                for k, one in enumerate(prepared)
            ]
            status = np.concatenate([run_part[1] for run_part in parts])
            outputs = [np.concatenate([run_part[0][k] for run_part in parts]) for k in range(len(header["outputs"]))]
            return outputs, status if status[:, 0].any() else None
        outputs = [np.empty((machines * count, size)) for size in header["outputs"]]
        status = np.empty((machines * count, 2))

        def run_part(begin: int, end: int) -> bool:
            """Compute some machines, or samples of a single one; return whether one failed."""
            many = machines > 1
            size = (end - begin, count) if many else (1, end - begin)
            own = prepared[begin:] if many else prepared
            words = [*size, steps, own.ctypes.data, prepared.shape[1]]
            for row in rows:
                # Stride 0: the same input for all samples, or for all machines.
                machine_stride, sample_stride = (row.strides[k] // 8 if row.shape[k] > 1 else 0 for k in (0, 1))
                at = begin * (machine_stride if many else sample_stride)
                words += [row.ctypes.data + 8 * at, sample_stride, machine_stride]
            at = begin * count if many else begin
            words += [array[at:].ctypes.data for array in [*outputs, status]]
            # The name keeps the array alive while the compiled code reads it.
            argument = np.array(words, np.int64)
            return bool(code(argument.ctypes.data))

        count_of_parts = machines if machines > 1 else count
        bad = run_in_threads(run_part, count_of_parts, machines * count)
        return outputs, status if bad else None


def _make_rows(arrays: Sequence[Array], count: int) -> list[Array]:
    """Convert arrays to contiguous rows, shape (1, 1 or count, size)."""
    return [np.ascontiguousarray(a).reshape(1, 1 if a.ndim == 1 else count, a.shape[-1]) for a in arrays]


def _make_header(program: Program, lanes: int) -> dict[str, Any]:
    return {
        "inputs": list(program.inputs.values()),
        "outputs": [len(row) for row in program.outputs.values()],
        "parameters": program.parameters + program.geometry_count,
        "prepared": lanes * (len(program.prepared) + 1),
        "stepped": bool(program.equations) and not program.single,
    }


def _read_cached(name: str, symbol: str) -> tuple[dict[str, Any], bytes] | None:
    """Read a cached program's sizes and object code; None if there is none that can run."""
    stored = cache.read(name)
    good = stored is not None and _is_valid_header(stored[0]) and cache.is_object(stored[1], symbol)
    return stored if good else None


def _is_valid_header(header: dict[str, Any]) -> bool:
    """Return whether a cached header has the form that :func:`_make_header` writes."""
    match header:
        case {
            "inputs": [*taken],
            "outputs": [*given],
            "parameters": p,
            "prepared": k,
            "stepped": s,
        }:
            sizes = (*taken, *given, p, k)
            return type(s) is bool and all(type(n) is int and 0 <= n < MAX_NUMBERS for n in sizes)
    return False


THREADS_VARIABLE: Final = "PKM_TWIN_THREADS"
"""Environment variable: threads for a large batch; 1 unless set, 0 for all cores."""
MIN_SAMPLES_PER_THREAD: Final = 4096
"""Smallest number of samples per thread for which starting it saves time."""


def read_thread_count() -> int:
    """Read the number of threads from the environment, at every large batch.

    :raises ParameterError: the variable is not a number of threads.
    """
    text = os.environ.get(THREADS_VARIABLE, "").strip() or "1"
    if not text.isascii() or not text.isdigit() or int(text) > 1024:
        raise ParameterError(THREADS_VARIABLE, text, "a number of threads, 0 for all cores")
    return int(text) or len(os.sched_getaffinity(0))


def run_in_threads(part: Callable[[int, int], bool], size: int, samples: int) -> bool:
    """Compute ``part(begin, end)`` over range ``size`` in threads; return whether any is True.

    :param samples: total number of samples, which decides the number of threads.
    """
    count = min(size, samples // MIN_SAMPLES_PER_THREAD)
    if count > 1:
        count = min(count, read_thread_count())
    if count <= 1:
        return part(0, size)
    ends = [size * k // count for k in range(count + 1)]
    # A lasting pool would not exist in a forked process, so each call starts its own threads.
    with ThreadPoolExecutor(count - 1) as pool:
        futures = [pool.submit(part, *pair) for pair in pairwise(ends[1:])]
        bad = part(0, ends[1])
        return any([one.result() for one in futures]) or bad
