# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Rotation matrices and frames; REP 103's rpy is Rz(yaw) Ry(pitch) Rx(roll)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array


@dataclass(frozen=True, eq=False)
class Pose:
    """A frame in another: ``rotation`` (3, 3), ``position`` (3,), m."""

    rotation: Array = field(default_factory=lambda: np.eye(3))
    position: Array = field(default_factory=lambda: np.zeros(3))

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.rotation @ other.rotation, self.point(other.position))

    def point(self, at: Array) -> Array:
        """Transform a point of this frame into the other one, (3,) m."""
        return np.asarray(self.rotation @ at + self.position, np.float64)

    def inverse(self) -> Pose:
        """Return the other frame in this one."""
        return Pose(self.rotation.T, -self.rotation.T @ self.position)


def axis_rotation(axis: Array, angle: ArrayLike) -> Array:
    """Return rotations by angles (...,), rad, about a unit vector (3,), shape (..., 3, 3)."""
    across = skew(np.asarray(axis, np.float64))
    sine, rest = np.sin(angle)[..., None, None], 1.0 - np.cos(angle)[..., None, None]
    rotation: Array = np.eye(3) + sine * across + rest * (across @ across)
    return rotation


def rotation_about(vectors: Array) -> Array:
    """Return the rotations about vectors (..., 3) by their lengths, rad, shape (..., 3, 3)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    across, half = skew(vectors), np.sinc(angle / (2.0 * np.pi))
    rotation: Array = np.eye(3) + np.sinc(angle / np.pi) * across + 0.5 * half**2 * across @ across
    return rotation


def rotation_vector(rotation: Array) -> Array:
    """Return the vector of :func:`rotation_about` for less than half a turn, (..., 3)."""
    r = rotation
    twice = np.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1)
    sine = 0.5 * np.linalg.norm(twice, axis=-1)
    angle = np.arctan2(sine, 0.5 * (np.trace(r, axis1=-2, axis2=-1) - 1.0))
    return np.asarray(twice * 0.5 / np.sinc(angle / np.pi)[..., None], np.float64)


def skew(vectors: Array) -> Array:
    """Return the cross product matrices (..., 3, 3) of vectors (..., 3)."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    none = np.zeros_like(x)
    rows = ((none, -z, y), (z, none, -x), (-y, x, none))
    return np.stack([np.stack(row, -1) for row in rows], -2)


def from_rpy(angles: Array) -> Array:
    """Return the rotation of roll, pitch and yaw (3,), rad."""
    roll, pitch, yaw = angles
    x, y, z = np.eye(3)
    rotation: Array = axis_rotation(z, yaw) @ axis_rotation(y, pitch) @ axis_rotation(x, roll)
    return rotation


def to_rpy(rotation: Array) -> Array:
    """Return roll, pitch and yaw (3,), rad; yaw is zero if the x axis is vertical."""
    level = math.hypot(rotation[0, 0], rotation[1, 0])
    pitch = math.atan2(-rotation[2, 0], level)
    if level < 1e-9:
        return np.array([math.atan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])
    roll = math.atan2(rotation[2, 1], rotation[2, 2])
    return np.array([roll, pitch, math.atan2(rotation[1, 0], rotation[0, 0])])


def from_quaternion(x: float, y: float, z: float, w: float) -> Array:
    """Return the rotation of a quaternion, of unit length or not."""
    n = x * x + y * y + z * z + w * w
    v = np.array([x, y, z])
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Array = ((w * w - v @ v) * np.eye(3) + 2.0 * np.outer(v, v) + 2.0 * w * skew) / n
    return rotation


def to_quaternion(rotation: Array) -> Array:
    """Return the unit quaternion x, y, z, w (4,) of a rotation, w >= 0 (Bar-Itzhack 2000, method 1).

    It is the eigenvector of the largest eigenvalue, which is well separated for every rotation.
    """
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
        ]
    )
    quaternion: Array = np.linalg.eigh(k / 3.0)[1][:, -1]
    return -quaternion if quaternion[3] < 0.0 else quaternion
