# SPDX-License-Identifier: Apache-2.0
"""All quantities of many machines in a box of numbers: on a grid, or on points that fill it evenly.

May import: numpy, pkm_twin's core, this package, the standard library.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from pkm_twin.design.optimise import Problem, sobol
from pkm_twin.design.pose_path import PosePath
from pkm_twin.design.quantities import quantity_of
from pkm_twin.design.variables import Variables
from pkm_twin.errors import ParameterError
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

MOST: Final = 10_000_000
"""Machines of a sweep."""
STEP: Final = 256
"""Machines between two reports of progress."""


@dataclass(frozen=True)
class Sweep:
    """Machines of a sweep: ``shape`` of the grid, or (k,).

    ``variables``: by name, shape ``shape``; ``quantities`` likewise, NaN of machines that cannot
    follow the path.
    """

    shape: tuple[int, ...]
    variables: Mapping[str, Array]
    quantities: Mapping[str, Array]


def sweep(
    robot: Robot, vary: Mapping[str, tuple[float, float]], path: PosePath,
    quantities: Sequence[str], samples: int, kind: Literal["grid", "sobol"] = "grid", *,
    seed: int = 0, progress: Callable[[int], None] = lambda _: None,
) -> Sweep:  # fmt: skip
    """Quantities of machines of a box.

    :param vary: as of :func:`pkm_twin.design.design`; also of the path.
    :param samples: machines along each variable of a grid, or in all.
    :param progress: called with how many machines are done.
    :raises ParameterError: a path, a quantity or a count that there is not.
    """
    wanted = [quantity_of(name, "quantities") for name in quantities]
    problem = Problem(robot, Variables.of(robot, vary), path)
    d = len(problem.variables)
    count = samples**d if kind == "grid" else samples
    if samples < 1 or count > MOST:
        raise ParameterError("samples", samples, f"1 or more, at most {MOST} machines in all")
    if kind == "grid":
        axes = np.meshgrid(*[np.linspace(0.0, 1.0, samples)] * d, indexing="ij")
        shape: tuple[int, ...] = (samples,) * d
        points = np.stack([axis.ravel() for axis in axes], -1)
    else:
        points, shape = sobol(d, samples, seed), (samples,)
    rows: list[list[Array]] = []
    for k in range(0, count, STEP):
        part = points[k : k + STEP]
        found = problem.pieces(part, wanted)
        rows.append([q.worst(pieces) for q, pieces in zip(wanted, found, strict=True)])
        progress(k + len(part))
    named = np.array([problem.variables.named(y) for y in points])
    return Sweep(
        shape,
        {n: named[:, i].reshape(shape) for i, n in enumerate(problem.variables.names)},
        {
            q.name: np.concatenate([row[i] for row in rows]).reshape(shape)
            for i, q in enumerate(wanted)
        },
    )
