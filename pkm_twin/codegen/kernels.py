# SPDX-License-Identifier: Apache-2.0
"""Scalar formulas, written once in plain floats, run over any batch of samples.

A mechanism writes each formula as a function of flat sequences (``p[i]``, ``q[0]`` ...) that uses
only ``math``. With numba it is compiled, cached on disk and broadcast over leading axes;
without numba the same function runs as Python on lists, with the same results, slower.

May import: numpy, numba if present, the standard library.
"""

from __future__ import annotations

import os
import types
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

try:
    if os.environ.get("PKM_TWIN_NO_NUMBA", "0") not in ("", "0"):
        raise ImportError("numba is switched off by PKM_TWIN_NO_NUMBA")
    import numba
except ImportError:
    numba = None

COMPILED: Final = numba is not None
"""True where kernels are compiled by numba; PKM_TWIN_NO_NUMBA=1 switches that off."""

OK: Final = 0.0
UNREACHABLE: Final = 1.0
SINGULAR: Final = 2.0
NOT_FINITE: Final = 3.0
FAULT_SIZE: Final = 3
"""A fault is three floats: code, limb index, and the miss (m) or the singularity measure."""


def _drop_stale_caches() -> None:
    """Remove compiled kernels older than any formula.

    numba looks at the outermost function's file only, and kernels call into others.
    """
    formulas = Path(__file__).parents[1] / "mechanisms"
    newest = max(path.stat().st_mtime for path in (*formulas.glob("*.py"), Path(__file__)))
    for index in (formulas / "__pycache__").glob("*.nbi"):
        with suppress(OSError):
            if index.stat().st_mtime < newest:
                index.unlink()


if COMPILED:
    _drop_stale_caches()

_F8: Final = np.dtype(np.float64)

Array = NDArray[np.float64]


def scalar(function: Callable[..., Any]) -> Callable[..., Any]:
    """Mark a helper that kernels call.

    It is not cached by itself but within each kernel that calls it: numba's cache of a function
    with several signatures can mix them up when two processes write it at once.
    """
    if numba is None:
        return function
    compiled: Callable[..., Any] = numba.njit(error_model="numpy")(function)
    return compiled


# What guvectorize wraps, by number of arrays; each kernel gets a copy with its own ``kernel``.
_ROWS: Final[dict[int, Any]] = {
    5: lambda a, b, c, d, e: kernel(a, b, c, d, e),  # type: ignore[name-defined]  # noqa: F821
    6: lambda a, b, c, d, e, f: kernel(a, b, c, d, e, f),  # type: ignore[name-defined]  # noqa: F821
    7: lambda a, b, c, d, e, f, g: kernel(a, b, c, d, e, f, g),  # type: ignore[name-defined]  # noqa: F821
    8: lambda a, b, c, d, e, f, g, h: kernel(a, b, c, d, e, f, g, h),  # type: ignore[name-defined]  # noqa: F821
    9: lambda a, b, c, d, e, f, g, h, i: kernel(a, b, c, d, e, f, g, h, i),  # type: ignore[name-defined]  # noqa: F821
    10: lambda a, b, c, d, e, f, g, h, i, j: kernel(a, b, c, d, e, f, g, h, i, j),  # type: ignore[name-defined]  # noqa: F821
}


def _row_of(kernel: Callable[..., None], arrays: int) -> Callable[..., None]:
    """What guvectorize wraps to run ``kernel``; a copy of the row with its own globals."""
    row = _ROWS[arrays]
    return types.FunctionType(row.__code__, {"kernel": kernel}, kernel.__name__)


class Kernel:
    """One scalar formula over batches.

    The wrapped function is called as ``f(p, *inputs, *outputs, scratch, fault)``: ``p`` the
    robot's flat parameters, inputs and outputs flat sequences of the given sizes, ``scratch``
    a work space, ``fault`` the three floats above, all zero on entry.
    """

    def __init__(
        self,
        function: Callable[..., None],
        inputs: Sequence[int | None],
        outputs: Sequence[int],
        scratch: int = 1,
        *,
        batches: bool = True,
    ) -> None:
        """Sizes of inputs (None: any) and outputs; whether :meth:`warm_up` readies batches too."""
        if inputs[0] != FAULT_SIZE:
            raise ValueError(f"a kernel's first input has {FAULT_SIZE} entries, not {inputs[0]}")
        self.function = function
        self.inputs = tuple(inputs)
        self.outputs = tuple(outputs)
        self.scratch = scratch
        self.batches = batches
        # One sample runs with the interpreter locked, so calls can share the space.
        self._space = np.empty(scratch)
        self.__doc__ = function.__doc__

    @cached_property
    def _one(self) -> Callable[..., None]:
        """The formula for one sample, compiled for exactly one array type.

        One signature a function: two processes that fill the cache at once write the same.
        """
        read = numba.types.Array(numba.float64, 1, "A", readonly=True)
        write = numba.types.Array(numba.float64, 1, "A")
        n_in = 1 + len(self.inputs)
        n_out = len(self.outputs) + 2
        signature = numba.void(*[read] * n_in, *[write] * n_out)
        compiled: Callable[..., None] = numba.njit(signature, cache=True, error_model="numpy")(
            self.function
        )
        return compiled

    @cached_property
    def _many(self) -> Callable[..., None]:
        """The formula as a generalised ufunc; results and scratch are arguments, written in place.

        Cached is the formula, not the ufunc around it: numba's cached wrapper looks for its formula
        under a symbol that another process may have replaced, and ends in a crash. numba wants the
        size of the one formal output, the fault, from an input: it takes that of the first, which
        has three entries too (joints or pose).
        """
        n_in, n_out = 1 + len(self.inputs), len(self.outputs)
        sizes = [f"(n{i})" for i in range(n_in + n_out + 1)]
        signature = numba.void(*[numba.float64[:]] * (n_in + n_out + 2))
        compiled: Callable[..., None] = numba.guvectorize(
            [signature],
            f"{','.join(sizes)}->{sizes[1]}",
            nopython=True,
            writable_args=tuple(range(n_in, n_in + n_out)),
        )(_row_of(self._one, n_in + n_out + 2))
        return compiled

    def __call__(self, p: Array, *inputs: ArrayLike) -> tuple[Array, ...]:
        """Evaluate over leading batch axes.

        :param p: flat parameters, shape (n,).
        :param inputs: one array per input, shape (..., size), broadcast against each other.
        :returns: the outputs, shape (..., size) each, then the fault, shape (..., 3).
        :raises ValueError: an input's last axis has another size.
        """
        first = inputs[0]
        if COMPILED and type(first) is np.ndarray and first.ndim == 1:
            # One sample, the fast way.
            try:
                sizes = tuple(map(len, inputs))  # type: ignore[arg-type]
                if sizes == self.inputs or self._fit(sizes):
                    results = list(map(np.empty, self.outputs))
                    fault = np.zeros(FAULT_SIZE)
                    self._one(p, *inputs, *results, self._space, fault)
                    return (*results, fault)
            except TypeError:
                pass  # a plain number, or another type of array
        arrays = [np.asarray(value, _F8) for value in inputs]
        for array, size in zip(arrays, self.inputs, strict=True):
            if array.ndim == 0 or size not in (None, array.shape[-1]):
                raise ValueError(f"the last axis has to be {size}, the shape is {array.shape}")
        batch = np.broadcast_shapes(*(array.shape[:-1] for array in arrays))
        results = [np.empty((*batch, size)) for size in self.outputs]
        results.append(np.zeros((*batch, FAULT_SIZE)))
        if COMPILED:
            # What is not finite comes back as a fault, not as a warning.
            with np.errstate(all="ignore"):
                self._many(p, *arrays, *results[:-1], np.empty(self.scratch), results[-1])
        else:
            self._interpret(p, arrays, results, batch)
        return tuple(results)

    def _fit(self, sizes: tuple[int, ...]) -> bool:
        """Whether inputs of these sizes fit, some of which may have any."""
        return (
            None in self.inputs
            and len(sizes) == len(self.inputs)
            and all(a in (None, b) for a, b in zip(self.inputs, sizes, strict=True))
        )

    def _interpret(
        self, p: Array, arrays: list[Array], results: list[Array], batch: tuple[int, ...]
    ) -> None:
        parameters = p.tolist()
        scratch = [0.0] * self.scratch
        spread = [np.broadcast_to(a, (*batch, a.shape[-1])) for a in arrays]
        for index in np.ndindex(batch):
            outputs = [[0.0] * size for size in self.outputs]
            fault = [0.0] * FAULT_SIZE
            samples = [a[index].tolist() for a in spread]
            self.function(parameters, *samples, *outputs, scratch, fault)
            for result, values in zip(results, [*outputs, fault], strict=True):
                result[index] = values

    def warm_up(self) -> None:
        """Compile, or load from the cache, before the first sample is due."""
        if COMPILED:
            _ = self._one
            if self.batches:
                _ = self._many
