# SPDX-License-Identifier: Apache-2.0
"""Machines of one to six pose coordinates without an axis, for what asks nothing else of a robot.

pose = M sinh(q): everywhere invertible, and the poses of a box of joints are no box.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pkm_twin.machine.robot import Limits, Robot

NAMES = ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True, eq=False)
class Skew(Robot):
    """As many joints as pose coordinates; ``bounded``: whether joints have limits."""

    mechanism: str = "skew"
    size: int = 2
    bounded: bool = True
    limits: Limits = field(init=False)

    description = "test machine"
    joint_unit = "m"
    effort_unit = "N"

    def __post_init__(self):
        bounds = np.tile([-0.5, 0.8], (self.size, 1)) if self.bounded else None
        object.__setattr__(self, "limits", Limits(bounds, None, None))

    @property
    def pose_names(self):
        return NAMES[: self.size] if self.size != 3 else ("x", "y", "yaw")

    @property
    def pose_units(self):
        return tuple("rad" if name in NAMES[3:] else "m" for name in self.pose_names)

    @property
    def joint_names(self):
        return tuple(f"joint_{k}" for k in range(self.size))

    @property
    def matrix(self):
        return np.eye(self.size) + 0.3 * np.eye(self.size, k=1) - 0.2 * np.eye(self.size, k=-1)

    def _pack(self):
        return [float(self.size)]

    def inverse_kernel(self, parameters, pose):
        q = np.arcsinh(np.asarray(pose) @ np.linalg.inv(self.matrix).T)
        return q, np.zeros((*q.shape[:-1], 3))

    def forward_kernel(self, parameters, q):
        pose = np.sinh(np.asarray(q)) @ self.matrix.T
        return pose, np.zeros((*pose.shape[:-1], 3))

    def jacobian_kernel(self, parameters, q):
        rates = self.matrix * np.cosh(q)[..., None, :]
        return rates, rates, np.zeros((*rates.shape[:-2], 3))

    def singularity(self, q):
        values = np.linalg.svd(self.jacobian_kernel(None, q)[0], compute_uv=False)
        return values[..., -1] / values[..., 0]

    def home(self):
        return self.forward_kernel(None, self.limits.position.mean(1))[0]

    def search_box(self):
        return np.tile([-2.0, 2.0], (self.size, 1))
