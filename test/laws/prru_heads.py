# SPDX-License-Identifier: Apache-2.0
"""3-PRRU heads of several dimensions, their motions, and where their joints are by vector loops."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine import schema
from pkm_twin.mechanisms.prru import Prru

THIRDS = (math.pi, 5 * math.pi / 3, math.pi / 3)
MACHINES: dict[str, dict[str, Any]] = {
    "paper": {"azimuths": THIRDS, "branch": "below"},
    "hanging": {"azimuths": THIRDS, "branch": "above"},
    "turned": {"azimuths": (0.4 + 2 * math.pi / 3, 0.4, 0.4 - 2 * math.pi / 3), "branch": "below"},
    "uneven": {"azimuths": (0.2, 1.9, 4.4), "branch": "above"},
    "wide": {
        "azimuths": THIRDS,
        "branch": "below",
        "base_radius": 0.3,
        "platform_radius": 0.4,
        "limb_length": 0.7,
    },
}
LENGTHS = {"base_radius": 0.35, "platform_radius": 0.25, "limb_length": 0.6}
MASSES = {
    "slider_mass": 8.0,
    "lower_link_mass": 3.5,
    "upper_link_mass": 2.5,
    "platform_mass": 25.0,
}
TILTED_INERTIA = ((0.6, 0.05, -0.02), (0.05, 0.5, 0.03), (-0.02, 0.03, 0.8))


def machine(
    name: str, symmetric: bool = False, geometry: Mapping[str, Any] = {}, **inertia: Any
) -> Prru:
    """A machine with all masses and inertias; ``symmetric``: equal for all three limbs."""
    details = {
        "link_com": 0.4,
        "lower_link_inertia": [0.11, 0.02],
        "upper_link_inertia": [0.08, 0.03],
        "platform_com": [0, 0, 0.03] if symmetric else [0.02, -0.03, 0.05],
        "platform_inertia": [0.5, 0.5, 0.8] if symmetric else [list(r) for r in TILTED_INERTIA],
    }
    payload = {"mass": 3.0, "com": [0.05, 0.02, 0.1], "inertia": [0.02, 0.03, 0.04]}
    return schema.build(
        Prru,
        {
            "mechanism": "prru",
            "geometry": LENGTHS | MACHINES[name] | dict(geometry),
            "inertia": MASSES | details | inertia,
            "payload": {} if symmetric else payload,
        },
    )


def poses(count: int, tilt: float, seed: int = 0) -> Array:
    """Poses of any azimuth, tilted up to ``tilt`` (degrees), shape (count, 3)."""
    rng = np.random.default_rng(seed)
    lean = np.radians(tilt) * np.sqrt(rng.random(count))
    azimuth = rng.uniform(0, 2 * math.pi, count)
    x, y, z = np.sin(lean) * np.cos(azimuth), np.sin(lean) * np.sin(azimuth), np.cos(lean)
    return np.stack([rng.uniform(-1, 1, count), np.arctan2(-y, z), np.arcsin(x)], axis=-1)


def rotations(alpha: Array, beta: Array, gamma: Array) -> Array:
    """Rx(alpha) Ry(beta) Rz(gamma), shape (..., 3, 3)."""
    one, nil = np.ones_like(alpha), np.zeros_like(alpha)

    def stack(rows: list[list[Array]]) -> Array:
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    ca, sa, cb, sb, cg, sg = (f(x) for x in (alpha, beta, gamma) for f in (np.cos, np.sin))
    rx = stack([[one, nil, nil], [nil, ca, -sa], [nil, sa, ca]])
    ry = stack([[cb, nil, sb], [nil, one, nil], [-sb, nil, cb]])
    rz = stack([[cg, -sg, nil], [sg, cg, nil], [nil, nil, one]])
    return rx @ ry @ rz


def place(robot: Prru, pose: Array) -> tuple[Array, Array, Array]:
    """Centre, rotation and limb axes' ends of poses, by Newton's method on the three planes.

    Shapes (n, 3), (n, 3, 3) and (n, 3 limbs, 3): nothing of the twin's formulas.
    """
    g = robot.geometry
    e = np.stack([np.cos(g.azimuths), np.sin(g.azimuths), np.zeros(3)], axis=-1)
    t = np.stack([-e[:, 1], e[:, 0], np.zeros(3)], axis=-1)
    unknown = np.zeros((len(pose), 3))

    def joints(u: Array) -> tuple[Array, Array, Array]:
        rotation = rotations(pose[:, 1], pose[:, 2], u[:, 2])
        centre = np.concatenate([u[:, :2], pose[:, :1]], axis=-1)
        arms = -g.platform_radius * np.einsum("nij,kj->nki", rotation, e)
        return centre, rotation, centre[:, None] + arms

    for _ in range(20):
        centre, rotation, ends = joints(unknown)
        error = np.einsum("nki,ki->nk", ends, t)
        slope = np.empty((len(pose), 3, 3))
        slope[..., 0], slope[..., 1] = t[:, 0], t[:, 1]
        turned = np.cross(rotation[:, None, :, 2], ends - centre[:, None])
        slope[..., 2] = np.einsum("nki,ki->nk", turned, t)
        unknown = unknown - np.linalg.solve(slope, error[..., None])[..., 0]
    return joints(unknown)


def sliders(robot: Prru, q: Array) -> Array:
    """Slider joints C_i, shape (n, 3 limbs, 3)."""
    g = robot.geometry
    flat = -g.base_radius * np.stack([np.cos(g.azimuths), np.sin(g.azimuths)], axis=-1)
    return np.concatenate([np.broadcast_to(flat, (*q.shape, 2)), q[..., None]], axis=-1)


class Motion:
    """A smooth motion of the sliders about a tilted pose."""

    def __init__(self, robot: Prru, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.start = robot.inverse(poses(1, 25, seed)[0])
        self.size = rng.uniform(0.03, 0.06, 3)
        self.rate = rng.uniform(2.0, 5.0, 3)
        self.phase = rng.uniform(0, 2 * math.pi, 3)

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        angle = self.rate * t[..., None] + self.phase
        return (
            self.start + self.size * np.sin(angle),
            self.size * self.rate * np.cos(angle),
            -self.size * self.rate**2 * np.sin(angle),
        )


TIMES = np.linspace(0.0, 2.0, 25)
