# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute a robot's geometry and masses as functions of numbers of its file.

The functions that derive a robot's graph and masses from its file run once on expressions of the
numbers. Arrays of numbers then take microseconds each, without building a robot.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import GEOMETRY, Expression, Tape, tangents
from pkm_twin.codegen.plain import compile_functions
from pkm_twin.machine.geometry import list_geometry
from pkm_twin.machine.inertia import Layout
from pkm_twin.machine.tree import Tree
from pkm_twin.robot.robot import Robot


class FileNumbers:
    """A function from numbers of a robot's file to results.

    :param paths: dotted paths of the numbers, as in :meth:`Robot.numbered`.
    :param compute: returns the results of a robot, numbers or expressions.
    :raises ParameterError: an unknown path.
    """

    def __init__(self, robot: Robot, paths: Sequence[str], compute: Callable[[Robot], Sequence[Any]]) -> None:
        tape = Tape([robot.number(path) for path in paths])
        given = tape.inputs(GEOMETRY, len(paths))
        made = robot.numbered(dict(zip(paths, given, strict=True)))
        self._given = list(given)
        self._results: list[Expression] = [tape.lift(value) for value in compute(made)]
        _, self._run = compile_functions(self._results, {GEOMETRY: len(paths)})

    @cached_property
    def slopes(self) -> Array:
        """Derivatives of the results by the numbers, at the file's values, shape (results, paths)."""
        table = tangents(self._results, self._given, at_reference=True)
        return np.array(table, np.float64).reshape(len(self._results), len(self._given))

    @cached_property
    def _slopes_function(self) -> tuple[list[tuple[int, int]], Callable[..., tuple[Any, ...]]]:
        """Indices of the nonzero derivatives, and the function that computes them."""
        tape = Tape() if not self._results else self._results[0].tape
        found = [
            (i, k, tape.lift(value))
            for i, row in enumerate(tangents(self._results, self._given))
            for k, value in enumerate(row)
            if isinstance(value, Expression) or value
        ]
        run = compile_functions([e for _, _, e in found], {GEOMETRY: len(self._given)})[1]
        return [(i, k) for i, k, _ in found], run

    def slopes_at(self, values: Array) -> Array:
        """Compute the derivatives at values, shape (k, paths); shape (k, results, paths)."""
        places, run = self._slopes_function
        table = np.zeros((len(values), len(self._results), len(self._given)))
        with np.errstate(all="ignore"):
            for (i, k), value in zip(places, run(**{GEOMETRY: list(values.T)}), strict=True):
                table[:, i, k] = value
        return table

    def __call__(self, values: Array) -> Array:
        """Compute results for values (k, paths), shape (k, results); NaN for an impossible machine."""
        with np.errstate(all="ignore"):
            rows = self._run(**{GEOMETRY: list(values.T)})
        table = np.empty((len(values), len(rows)))
        for column, row in zip(table.T, rows, strict=True):
            column[:] = row
        return table


class CauseSlopes:
    """The change of each result per standard deviation of each uncertainty of a robot's file.

    ``chosen``: indices of the results that change; ``slopes``: shape (chosen, causes).

    :param compute: as in :class:`FileNumbers`.
    """

    def __init__(self, robot: Robot, compute: Callable[[Robot], Sequence[Any]]) -> None:
        causes = robot.uncertainty_changes.values()
        paths = tuple(dict.fromkeys(path for cause in causes for path in cause))
        steps = np.array([[cause.get(path, 0.0) for cause in causes] for path in paths])
        table = FileNumbers(robot, paths, compute).slopes @ steps.reshape(len(paths), len(causes))
        chosen = np.flatnonzero(table.any(1))
        self.chosen: tuple[int, ...] = tuple(chosen.tolist())
        self.slopes: Array = table[chosen]


def geometry_and_masses(robot: Robot) -> list[Any]:
    """Return the numbers of ``Engine.geometry``, then those of ``Robot.inertial``."""
    graph, load = robot.with_friction_laws(robot.graph), robot.payload
    layout = Layout(Tree(graph))
    inertial = layout.pack(graph, robot.gravity, robot.friction)
    inertial = inertial + layout.payload(load.mass, load.com, load.inertia)
    return [*list_geometry(graph), *inertial]
