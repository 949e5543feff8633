# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Platform compliance of the 2UPR-RPU: against CalculiX, and beside the paper's finite elements."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pkm_twin import load
from pkm_twin.robot.robot import Robot
from stiffness_monitor import compliance
from stiffness_monitor.structure import structural_model
from test.support.robots import parameters_of
from test.validation.test_upr_rpu_paper import LOAD, TABLE_1
from tools.calculix_solids import Mesh, solid_compliance

POSES = {
    "configuration 1": TABLE_1[0][0],
    "configuration 2": TABLE_1[1][0],
    "oblique": (-0.7, math.radians(-12), math.radians(15)),
}
"""Both configurations of the paper's table 1, and one further out: z (m), beta, gamma (rad)."""
BOUND = 0.01
"""Greatest relative difference from CalculiX that passes."""
PAPER_BOUND = 0.078
"""Greatest difference of theory and finite elements that the paper states, over the latter."""
MESH, FINE = Mesh(3, 1, 6), Mesh(3, 2, 16)
FINITE_ELEMENTS = np.array([row[2] for row in TABLE_1])
"""Deflections under the table's load, um and urad, shape (2, 6)."""
RESOLVED = np.abs(FINITE_ELEMENTS) >= 0.1
"""Entries that are printed with three digits or more."""
FACTORS = np.linspace(0.5, 2.0, 301)
"""Factors tried on the compliance of all bars and on that of all joints."""


def rigid_joints() -> dict[str, list[float]]:
    """Return the shipped joint compliances with 0 for every finite entry."""
    joints = parameters_of("upr_rpu")["joints_compliance"]
    return {name: [math.inf if value == math.inf else 0.0 for value in entries] for name, entries in joints.items()}


def with_rigid_joints() -> Robot:
    return load("upr_rpu").changed(joints_compliance=rigid_joints())


def round_bar(robot: Robot) -> float:
    """Return A / A_shear of a round bar (Cowper 1966) at the robot's Poisson's ratio."""
    members = robot.members
    poisson = members.youngs_modulus / members.shear_modulus / 2 - 1
    return (7 + 6 * poisson) / (6 + 6 * poisson)


@dataclass(frozen=True, eq=False)
class Difference:
    """The relative differences of two compliances.

    ``entries``: the worst of all 36, over sqrt(C_ii C_jj). ``diagonal``: shape (6,).
    ``deflection``: under the load of table 1, shape (6,). Positive is softer than the other.
    """

    entries: float
    diagonal: np.ndarray
    deflection: np.ndarray

    @property
    def worst(self) -> float:
        """The largest difference of entries and diagonal."""
        return max(self.entries, float(np.abs(self.diagonal).max()))


def difference(ours: np.ndarray, theirs: np.ndarray) -> Difference:
    """Compare two compliances, shape (6, 6) each, relative to ``theirs``."""
    scale = np.sqrt(np.diag(theirs))
    return Difference(
        float(np.abs((ours - theirs) / np.outer(scale, scale)).max()),
        np.diag(ours) / np.diag(theirs) - 1,
        (ours @ LOAD) / (theirs @ LOAD) - 1,
    )


@dataclass(frozen=True, eq=False)
class Links:
    """Differences at a pose from solid bars, by mesh and shear factor."""

    shipped: Difference
    """With the shipped shear factor."""
    shear_area_ratio: Difference
    """With a round bar's shear factor."""
    refinement: Difference
    """The coarser mesh from the finer one."""


def compare_links(name: str) -> Links:
    """Compare one pose, by its name, with solid bars in all variants."""
    robot = with_rigid_joints()
    pose = np.array(POSES[name])
    frame = structural_model(robot, robot.inverse(pose))
    with tempfile.TemporaryDirectory() as folder:
        coarse, fine = (solid_compliance(frame, Path(folder), mesh) for mesh in (MESH, FINE))
    ours = compliance(robot, pose)
    other = compliance(robot.changed(members={"shear_factor": round_bar(robot)}), pose)
    return Links(difference(ours, fine), difference(other, fine), difference(coarse, fine))


def deflections(bars: float = 1.0, joints: float = 1.0, base: Robot | None = None) -> np.ndarray:
    """Compute table 1 with factors on the compliances, um and urad, shape (2, 6)."""
    robot = base or load("upr_rpu")
    members = robot.members
    changes: Mapping[str, Any] = {
        "members": {
            "youngs_modulus": members.youngs_modulus / bars,
            "shear_modulus": members.shear_modulus / bars,
        },
        "joints_compliance": {
            name: (joints * getattr(robot.joints_compliance, name)).tolist() for name in rigid_joints()
        },
    }
    changed = robot.changed(**changes)
    return 1e6 * compliance(changed, [pose for pose, *_ in TABLE_1]) @ LOAD


@dataclass(frozen=True, eq=False)
class PaperRows:
    """The paper's finite elements compared with the twin with the shipped joints.

    ``twin``: um and urad, shape (2, 6). ``rigid``: the same with rigid joints. ``excess``: finite
    elements over the twin, less 1. ``bars``, ``joints``: the one factor on all bars' or on all
    joints' compliances that brings the twin nearest, and the worst difference over the finite
    elements that it leaves.
    """

    twin: np.ndarray
    rigid: np.ndarray
    excess: np.ndarray
    bars: tuple[float, float]
    joints: tuple[float, float]


def paper_rows(factors: np.ndarray = FACTORS) -> PaperRows:
    """Compare the paper's configurations; ``factors`` on the compliances are tried."""
    twin = deflections()
    robot = load("upr_rpu")
    best = []
    for name in ("bars", "joints"):
        left = [(error(deflections(base=robot, **{name: factor})), float(factor)) for factor in factors]
        best.append(min(left)[::-1])
    held = with_rigid_joints()
    rigid = 1e6 * np.array([compliance(held, pose) @ LOAD for pose, *_ in TABLE_1])
    return PaperRows(twin, rigid, FINITE_ELEMENTS / twin - 1, *best)


def error(rows: np.ndarray) -> float:
    """Return the worst relative difference of the resolved entries from the finite elements."""
    return float(np.abs(rows / FINITE_ELEMENTS - 1)[RESOLVED].max())
