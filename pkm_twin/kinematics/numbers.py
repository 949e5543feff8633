# SPDX-License-Identifier: Apache-2.0
"""What programs take of a robot, as a function of some numbers of its file.

The functions that make a robot's graph and masses of its file are run once on expressions of the
numbers; arrays of numbers then take microseconds each, and no robot is built.

May import: numpy, pkm_twin's core, the standard library.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.derivatives import tangents
from pkm_twin.codegen.expressions import GEOMETRY, Expression, Tape
from pkm_twin.codegen.plain import functions
from pkm_twin.machine.geometry import geometry_of
from pkm_twin.machine.inertia import Layout
from pkm_twin.machine.robot import Robot
from pkm_twin.machine.tree import Tree

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ProgramNumbers:
    """Inputs of programs, of k machines: shape (k, geometry), (k, inertial)."""

    geometry: Array
    inertial: Array


class FileNumbers:
    """The numbers of programs as expressions of numbers of a robot's file.

    :param paths: dotted, as of :meth:`Robot.numbered`.
    :raises ParameterError: a path that there is not.
    """

    def __init__(self, robot: Robot, paths: Sequence[str]) -> None:
        self.base = np.array([robot.number(path) for path in paths])
        tape = Tape(self.base.tolist())
        given = tape.inputs(GEOMETRY, len(paths))
        made = robot.numbered(dict(zip(paths, given, strict=True)))
        graph, load = made.make_graph(), made.payload
        layout = Layout(Tree(graph))
        inertial = layout.pack(graph, made.gravity, made.friction)
        inertial = inertial + layout.payload(load.mass, load.com, load.inertia)
        geometry = [*geometry_of(graph), *made.closed_numbers]
        self._given = list(given)
        self._sizes = len(geometry), len(inertial)
        self._results: list[Expression] = [tape.lift(v) for v in (*geometry, *inertial)]
        _, self._run = functions(self._results, {GEOMETRY: len(paths)})

    @cached_property
    def slopes(self) -> tuple[Array, Array]:
        """Derivatives of geometry and inertial inputs by the file's numbers, at its own values.

        Shapes (geometry, paths) and (inertial, paths).
        """
        table = tangents(self._results, self._given)
        return table[: self._sizes[0]], table[self._sizes[0] :]

    def __call__(self, values: Array) -> ProgramNumbers:
        """Of values, shape (k, paths); NaN where a machine's numbers lead to none."""
        with np.errstate(all="ignore"):
            rows = self._run(**{GEOMETRY: list(values.T)})
        table = np.empty((len(values), len(rows)))
        for column, row in zip(table.T, rows, strict=True):
            column[:] = row
        split = self._sizes[0]
        return ProgramNumbers(table[:, :split], table[:, split:])
