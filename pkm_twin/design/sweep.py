# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute all quantities of many machines in a box of numbers: grid or Sobol points."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, Literal
from uuid import uuid4

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.design.pose_path import PosePath
from pkm_twin.design.quantities import QUANTITIES, find_quantity
from pkm_twin.design.search import Problem, sobol
from pkm_twin.design.variables import Variables
from pkm_twin.errors import ParameterError
from pkm_twin.robot.robot import Robot

MAX_MACHINES: Final = 10_000_000
"""Largest number of machines of a sweep."""
MACHINES_PER_PART: Final = 256
"""Machines that are computed together, between two reports of progress."""


@dataclass(frozen=True)
class Sweep:
    """Hold the machines of a sweep: ``shape`` of the grid, or (k,).

    ``variables``: by name, shape ``shape``; ``quantities`` likewise, NaN for machines that cannot
    follow the path.
    """

    shape: tuple[int, ...]
    variables: Mapping[str, Array]
    quantities: Mapping[str, Array]

    def dataset(self, robot: Robot, path: str, kind: str) -> Any:
        """Return an xarray data set: a grid with the variables as axes, or a list of machines.

        :param path: description of the path. ``kind``: grid or sobol.
        """
        from xarray import Dataset

        names = tuple(self.variables)
        dims = names if kind == "grid" else ("machine",)
        coordinates: dict[str, Any] = {}
        for k, (name, values) in enumerate(self.variables.items()):
            units = {"units": robot.file_numbers().get(name, (0.0, ""))[1]}
            along = np.moveaxis(values, k, 0).reshape(len(values), -1)[:, 0]
            coordinates[name] = ((name,), along, units) if kind == "grid" else (dims, values, units)
        fields = {
            name: (dims, values, {"units": QUANTITIES[name].unit(robot) or "1", "long_name": QUANTITIES[name].meaning})
            for name, values in self.quantities.items()
        }
        return Dataset(fields, coordinates, {"robot": robot.name, "path": path, "sweep": kind})


@dataclass(frozen=True, eq=False)
class Box:
    """Hold a box of machines and the wanted quantities; workers receive it with their points."""

    robot: Robot
    vary: Mapping[str, tuple[float, float]]
    path: PosePath
    quantities: tuple[str, ...]
    fingerprint: str = field(default_factory=lambda: uuid4().hex)
    """Identifier of this object and its copies."""

    @cached_property
    def problem(self) -> Problem:
        """Evaluation of the box's machines on the path; each process creates its own."""
        return Problem(self.robot, Variables.of(self.robot, self.vary), self.path)

    def evaluate(self, points: Array) -> dict[str, Array]:
        """Return quantities of points (k, d) of the box, each 0 to 1, by name: shape (k,)."""
        wanted = [find_quantity(name, "quantities") for name in self.quantities]
        found = self.problem.component_values(points, wanted)
        return {q.name: q.worst(components) for q, components in zip(wanted, found, strict=True)}

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without data that each process computes once."""
        return {key: value for key, value in vars(self).items() if key != "problem"}


Work = Sequence[tuple[int, Array]]
"""Numbered points."""


def compute_serially(box: Box, work: Work) -> Iterator[tuple[int, dict[str, Array]]]:
    """Evaluate points part by part in this process."""
    for index, points in work:
        yield index, box.evaluate(points)


def sweep(
    robot: Robot,
    vary: Mapping[str, tuple[float, float]],
    path: PosePath,
    quantities: Sequence[str] | None,
    samples: int,
    kind: Literal["grid", "sobol"] = "grid",
    *,
    seed: int = 0,
    progress: Callable[[int], None] = lambda _: None,
    compute: Callable[[Box, Work], Iterable[tuple[int, Mapping[str, Array]]]] = compute_serially,
) -> Sweep:
    """Compute quantities of many machines whose numbers are within bounds.

    :param vary, path: as of :func:`pkm_twin.design.design`.
    :param quantities: names; None: all that the robot's file and the path have data for.
    :param samples: machines along each variable of a grid, or in all.
    :param progress: called with the number of machines done.
    :param compute: evaluates the parts, in any order.
    :raises ParameterError: an unknown path or quantity, or an invalid count.
    """
    wanted = quantities
    if wanted is None:
        try:
            elastic = bool(robot.element_names)
        except ParameterError:
            elastic = False
        known = {"deflection": elastic and path.wrench.any(), "motor-torque": None not in robot.drives}
        wanted = [name for name in QUANTITIES if known.get(name, True)]
    names = tuple(find_quantity(name, "quantities").name for name in wanted)
    box = Box(robot, vary, path, names)
    variables = box.problem.variables
    d = len(variables)
    count = samples**d if kind == "grid" else samples
    if samples < 1 or count > MAX_MACHINES:
        raise ParameterError("samples", samples, f"1 or more, at most {MAX_MACHINES} machines in all")
    if kind == "grid":
        axes = np.meshgrid(*[np.linspace(0.0, 1.0, samples)] * d, indexing="ij")
        shape: tuple[int, ...] = (samples,) * d
        points = np.stack([axis.ravel() for axis in axes], -1)
    else:
        points, shape = sobol(d, samples, seed), (samples,)
    table = {name: np.empty(count) for name in names}
    done = 0
    work = [(k, points[k : k + MACHINES_PER_PART]) for k in range(0, count, MACHINES_PER_PART)]
    for first, found in compute(box, work):
        size = len(points[first : first + MACHINES_PER_PART])
        for name, values in found.items():
            table[name][first : first + size] = values
        done += size
        progress(done)
    named = np.array([variables.values_by_name(y) for y in points])
    return Sweep(
        shape,
        {n: named[:, i].reshape(shape) for i, n in enumerate(variables.names)},
        {name: values.reshape(shape) for name, values in table.items()},
    )
