# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Tables as a user's own program writes and reads them: CSV files by their columns."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin import Robot
from pkm_twin.codegen.arrays import Array


def write_columns(path: Path, columns: Mapping[str, ArrayLike]) -> Path:
    """Write columns of one length each, by their headers."""
    rows = np.stack([np.asarray(values, float) for values in columns.values()], -1)
    np.savetxt(path, rows, "%.17g", ",", header=",".join(columns), comments="")
    return path


def read_columns(path: Path) -> dict[str, Array]:
    """Columns by their headers; an empty cell is NaN."""
    with path.open(newline="") as file:
        head, *rows = csv.reader(file)
    assert len(set(head)) == len(head)
    values = np.array([[float(cell or "nan") for cell in row] for row in rows])
    return dict(zip(head, values.T, strict=True))


def of_joints(robot: Robot, what: str, values: Array) -> dict[str, Array]:
    """Columns of the joints' positions, velocities or efforts, from values (k, n)."""
    return {f"{name}.{what}": values[:, k] for k, name in enumerate(robot.joint_names)}


def joined(columns: Mapping[str, Array], robot: Robot, what: str) -> Array:
    """Values of all joints, shape (k, n), from their columns."""
    return np.stack([columns[f"{name}.{what}"] for name in robot.joint_names], -1)
