# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Evaluate a program for one machine over leading batch axes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.code import NOT_FINITE, Code, KernelBuffers
from pkm_twin.codegen.program import Program

MAX_GEOMETRY_MISMATCH: Final = 1e-24
"""Largest sum of squared differences between a geometry and the constants that a program assumes:
rounding errors of 1e-12."""
_NO_GEOMETRY: Final = np.zeros(0)


class Kernel:
    """A program with one machine's geometry; expressions of parameters are computed once."""

    def __init__(self, code: Code, geometry: Array = _NO_GEOMETRY) -> None:
        self.code, self.geometry = code, geometry
        self._last: tuple[Array | None, Callable[..., Any]] = None, self.code.run

    @property
    def program(self) -> Program:
        """The program's expressions."""
        return self.code.program

    @property
    def sizes(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Sizes of inputs and outputs."""
        return self.code.sizes

    @property
    def matches_geometry(self) -> bool:
        """True if the geometry agrees with the constants that the program assumes."""
        p = np.zeros(self.code.parameters - len(self.geometry))
        return bool(self.code.prepare(np.concatenate([p, self.geometry]))[-1] <= MAX_GEOMETRY_MISMATCH)

    def prepare(self, p: Array) -> Array:
        """Compute the expressions of parameters and geometry alone, for all samples to use."""
        return self.code.prepare(np.concatenate([p, self.geometry]))

    def warm_up(self) -> None:
        """Compile the program, or load it from the cache, before the first sample is due."""
        p = np.zeros(self.code.parameters - len(self.geometry))
        self(p, *[np.zeros(n) for n in self.sizes[0]])

    def __call__(self, p: Array, *inputs: ArrayLike) -> tuple[list[Array], Array | None]:
        """Evaluate over leading batch axes, see :meth:`Code.run`; one sample by :meth:`Code.bound`.

        :param p: the program's own parameters, shape (k,); not changed afterwards.
        """
        last, call = self._last
        if last is not p:
            prepared = self.prepare(p)
            run = partial(self.code.run, prepared)
            call = self.code.bound(prepared, run, len(self.sizes[1]))
            self._last = p, call
        result: tuple[list[Array], Array | None] = call(*inputs)
        return result

    def bound(self, p: Array, otherwise: Callable[..., Any] | None = None) -> Callable[..., Any]:
        """Return a fast function from the inputs to the first output, see :meth:`Code.bound`.

        :param p: the program's own parameters, shape (k,); not changed afterwards.
        :param otherwise: function for all but good single samples; default: the program, without
            a check of its status.
        """
        return self.code.bound(self.prepare(p), otherwise or (lambda *inputs: self(p, *inputs)[0][0]))


class BoundCall:
    """A kernel with preallocated arrays: shape (size,), or (samples, size) for several samples.

    :param p: the program's own parameters, shape (k,).
    """

    def __init__(self, kernel: Kernel, p: Array, samples: int = 1) -> None:
        self._kernel, self._p = kernel, p
        self._space = space = KernelBuffers(*kernel.sizes, samples)
        space.point_at(kernel.prepare(p))
        self.inputs, self.outputs, self._address = space.inputs, space.outputs, space.address
        # Release the interpreter lock for batches only: for one sample that takes longer than the sample.
        code = kernel.code.functions
        self._code = None if code is None else code[samples == 1]

    def __call__(self) -> int:
        """Compute the outputs; return 0 if all samples are good, else the largest status."""
        if self._code is not None and not self._code(self._address):
            return 0
        outputs, status = self._kernel(self._p, *self.inputs)
        for array, values in zip(self.outputs, outputs, strict=True):
            array[...] = values
        if status is None:
            return 0
        known = all(np.isfinite(array).all() for array in self.inputs)
        return int(status[..., 0].max()) if known else int(NOT_FINITE)
