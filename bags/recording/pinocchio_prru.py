# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The 3-PRRU head on Pinocchio: a tree of sliders, links and platform, and its loops."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from bags.recording.pinocchio_loops import (
    Array,
    AssemblyError,
    LoopEngine,
    PerpendicularLoop,
    PointLoop,
    matrix3,
)


class PrruEngine(LoopEngine):
    """A 3-PRRU head: sliders along z, two links on one line in each limb, a tilting platform.

    The first link swings about the limb's tangent, the second turns on the limb's own axis, and a
    universal joint ties its end to the platform: their points coincide, and the joint's one axis,
    the second link's x axis, stays at a right angle to the other, the platform's tangent. The
    platform hangs on six joints whose third to fifth are its pose: z, alpha, beta.

    Beside the keys of the parameter file, ``inertia`` takes ``lower_link_inertia`` and
    ``upper_link_inertia``, each a pair: about the centre of mass across the limb and about the
    limb, kg m2; by default a thin rod as long as the limb.
    """

    def _build(self) -> None:
        geometry = self.params["geometry"]
        inertia = self.params["inertia"]
        self._base_radius = float(geometry["base_radius"])
        self._platform_radius = float(geometry["platform_radius"])
        self._limb_length = float(geometry["limb_length"])
        self._azimuths = np.asarray(geometry["azimuths"], dtype=float)
        branch = str(geometry.get("branch", "below"))
        if branch not in ("above", "below"):
            raise ValueError(f"branch {branch!r} is neither 'above' nor 'below'")
        self._rise = 1.0 if branch == "below" else -1.0

        joint = 0
        for name, kind in (
            ("x", pin.JointModelPX()),
            ("y", pin.JointModelPY()),
            ("z", pin.JointModelPZ()),
            ("alpha", pin.JointModelRX()),
            ("beta", pin.JointModelRY()),
            ("gamma", pin.JointModelRZ()),
        ):
            joint = self.model.addJoint(joint, kind, pin.SE3.Identity(), f"platform_{name}")
            if name in ("z", "alpha", "beta"):
                self._pose_joints.append(joint)
        self._platform_joint = joint
        self._body(
            joint,
            float(inertia["platform_mass"]),
            inertia.get("platform_com", (0.0, 0.0, 0.0)),
            matrix3(inertia["platform_inertia"]),
        )
        self._payload(joint)

        centre = np.array([0.0, 0.0, float(inertia.get("link_com", 0.5)) * self._limb_length])
        for limb, azimuth in enumerate(self._azimuths, start=1):
            turn = pin.utils.rpyToMatrix(0.0, 0.0, float(azimuth))
            inward = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
            rail = pin.SE3(turn, -self._base_radius * inward)
            slider = self.model.addJoint(0, pin.JointModelPZ(), rail, f"slider_{limb}")
            self._actuated_joints.append(slider)
            self._body(slider, float(inertia["slider_mass"]), np.zeros(3), np.zeros((3, 3)))
            joint = slider
            for link, kind in (("lower", pin.JointModelRY()), ("upper", pin.JointModelRZ())):
                joint = self.model.addJoint(joint, kind, pin.SE3.Identity(), f"{link}_link_{limb}")
                mass = float(inertia[f"{link}_link_mass"])
                rod = (mass * self._limb_length**2 / 12.0, 0.0)
                across, about = inertia.get(f"{link}_link_inertia") or rod
                self._body(joint, mass, centre, np.diag((across, across, about)))
            end = self._frame(f"limb_{limb}_end", joint, (0.0, 0.0, self._limb_length))
            corner = self._frame(f"platform_{limb}", self._platform_joint, -self._platform_radius * inward)
            tangent = np.array([-inward[1], inward[0], 0.0])
            self._points.append(PointLoop(end, corner))
            self._perpendiculars.append(PerpendicularLoop(end, np.array([1.0, 0.0, 0.0]), corner, tangent))

    def _guess(self, q: Array) -> Array:
        """Lay a plane through the limbs' ends as if all limbs leaned as at rest."""
        reach = self._base_radius - self._platform_radius
        height = math.sqrt(max(self._limb_length**2 - reach**2, 0.0))
        ends = q + self._rise * height
        radius = self._platform_radius
        plane = np.column_stack((np.ones(3), -radius * np.sin(self._azimuths), radius * np.cos(self._azimuths)))
        z, alpha, beta = np.linalg.solve(plane, ends)
        configuration = self._home(np.array([z, *np.clip((alpha, beta), -0.9, 0.9)]))
        configuration[self.actuated] = q
        return configuration

    def _home(self, pose: Array) -> Array:
        z, alpha, beta = pose
        configuration: Array = pin.neutral(self.model)
        configuration[2:5] = pose
        rotation = pin.utils.rpyToMatrix(alpha, 0.0, 0.0) @ pin.utils.rpyToMatrix(0.0, beta, 0.0)
        for limb, azimuth in enumerate(self._azimuths):
            inward = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
            corner = rotation @ (-self._platform_radius * inward) + np.array([0.0, 0.0, z])
            reach = float(corner @ inward) + self._base_radius
            rest = max(self._limb_length**2 - reach**2, 0.01 * self._limb_length**2)
            rise = self._rise * math.sqrt(rest)
            place = self.actuated[limb]
            configuration[place] = corner[2] - rise
            configuration[place + 1] = math.atan2(reach, rise)
        return configuration

    def _check_assembly(self, configuration: Array) -> None:
        pin.forwardKinematics(self.model, self.data, configuration)
        pin.updateFramePlacements(self.model, self.data)
        for place, loop in zip(self.actuated, self._points, strict=True):
            rise = self.data.oMf[loop.frame_a].translation[2] - configuration[place]
            if not rise * self._rise > 0.0:
                raise AssemblyError("a slider came out on the other side of its platform joint")
        if not np.all(np.cos(configuration[3:6]) > 0.0):
            raise AssemblyError("the loops closed with the platform turned over")

    def pose(self, q: ArrayLike) -> Array:
        """Return z, m, alpha and beta, rad, for slider heights ``q``, shape (3,)."""
        pose: Array = self.assemble(q)[self.pose_places].copy()
        return pose
