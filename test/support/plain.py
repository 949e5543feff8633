# SPDX-License-Identifier: Apache-2.0
"""Programs without parameters of their own on the plain back end, whatever is installed."""

from __future__ import annotations

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.plain import PlainCode
from pkm_twin.codegen.program import Program


class PlainKernel:
    """A program with the numbers of one machine's geometry, as plain Python."""

    def __init__(self, program: Program, geometry: Array | None = None) -> None:
        self._code = PlainCode(program)
        numbers = np.zeros(0) if geometry is None else geometry
        self._prepared = self._code.prepare(numbers[None])[0]

    def run(self, inputs: list[Array], steps: int = 1) -> tuple[list[Array], Array]:
        """Outputs (k, size) of inputs (k, size), and the status (k, 2)."""
        return self._code.run(self._prepared, inputs, len(inputs[0]), steps)
