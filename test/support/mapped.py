# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Robots whose controller has other names and numbers for the joints than the model."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pkm_twin import Robot
from pkm_twin.codegen.arrays import Array
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.support.robots import load, parameters_of


@dataclasses.dataclass(frozen=True)
class Sides:
    """A robot on both sides of a joint map: ``plain`` has none, ``mapped`` has one on every joint.

    What the controller has is written out here once more: controller = offset + factor model.
    """

    plain: Robot
    mapped: Robot
    data: dict[str, Any]
    names: list[str]
    factors: Array
    offsets: Array

    def positions(self, model: Any) -> Array:
        return np.asarray(self.offsets + self.factors * np.asarray(model), np.float64)

    def rates(self, model: Any) -> Array:
        return np.asarray(self.factors * np.asarray(model), np.float64)

    def efforts(self, model: Any) -> Array:
        return np.asarray(np.asarray(model) / self.factors, np.float64)

    def write(self, folder: Path) -> Path:
        """The mapped robot's file."""
        path = folder / f"{self.plain.name}_mapped.yaml"
        path.write_text(yaml.safe_dump(self.data))
        return path


def sides(robot: str | Path, seed: int = 1) -> Sides:
    """A robot with a drawn sign, offset, ratio and name for each of its joints.

    :param robot: a shipped robot's name, or a file.
    """
    plain, rng = load(robot), np.random.default_rng(seed)
    n = plain.joints_count
    signs = rng.choice([-1.0, 1.0], n)
    # Both signs are there, whatever is drawn.
    signs[:2] = (-1.0, 1.0)[:n]
    ratios, offsets = np.exp(rng.uniform(-3.0, 5.0, n)), rng.normal(0.0, 10.0, n)
    names = [f"axis_{k}" for k in rng.permutation(n).tolist()]
    rows = zip(names, signs.tolist(), ratios.tolist(), offsets.tolist(), strict=True)
    joint_map = {
        joint: {"name": own, "sign": sign, "ratio": ratio, "offset": offset}
        for joint, (own, sign, ratio, offset) in zip(plain.joint_names, rows, strict=True)
    }
    given = parameters_of(robot) if isinstance(robot, str) else yaml.safe_load(robot.read_text())
    data = {**given, "joint_map": joint_map}
    mapped = robot_of_data(data, f"{plain.name}_mapped")
    return Sides(plain, mapped, data, names, signs * ratios, offsets)
