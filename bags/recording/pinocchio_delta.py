# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The Delta on Pinocchio: a tree of platform, arms and forearms, and the loops that close it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from bags.recording.pinocchio_loops import Array, AssemblyError, LoopEngine, PointLoop, cross


class DeltaEngine(LoopEngine):
    """A Delta: three prismatic joints carry the platform, three arms and forearms hold it.

    Closure ``rod``: two rotations between arm and forearm, the forearm's end on the platform's
    point. Closure ``rcu``: the forearm slides along the elbow's axis, turns about it and stays at
    a right angle to it. Both rods of a parallelogram move alike, so one thin rod of their mass in
    the middle stands for them; it has no inertia about itself, and its spin no meaning.
    """

    def _build(self) -> None:
        geometry = self.params["geometry"]
        inertia = self.params["inertia"]
        arm_length = float(geometry["arm_length"])
        forearm_length = float(geometry["forearm_length"])
        arm_mass = float(inertia["arm_mass"])
        arm_com = float(inertia.get("arm_com", 0.5))
        across = inertia.get("arm_inertia")
        arm_inertia = arm_mass * arm_length**2 / 12.0 if across is None else float(across)
        forearm_mass = float(inertia["forearm_mass"])
        forearm_inertia = forearm_mass * forearm_length**2 / 12.0
        closures: Sequence[str] = geometry.get("closures", ["rod"] * 3)

        joint = 0
        for name, kind in (
            ("x", pin.JointModelPX()),
            ("y", pin.JointModelPY()),
            ("z", pin.JointModelPZ()),
        ):
            joint = self.model.addJoint(joint, kind, pin.SE3.Identity(), f"platform_{name}")
            self._pose_joints.append(joint)
        self._platform_joint = joint
        self._body(joint, float(inertia["platform_mass"]), np.zeros(3), np.zeros((3, 3)))
        self._payload(joint)

        for limb, (azimuth, closure) in enumerate(zip(geometry["azimuths"], closures, strict=True), start=1):
            turn = pin.utils.rpyToMatrix(0.0, 0.0, float(azimuth))
            base = pin.SE3(turn, turn @ np.array([float(geometry["base_radius"]), 0.0, 0.0]))
            arm = self.model.addJoint(0, pin.JointModelRY(), base, f"arm_{limb}")
            self._actuated_joints.append(arm)
            self._set_armature(arm, float(inertia.get("rotor_inertia", 0.0)))
            self._body(
                arm,
                arm_mass,
                (arm_com * arm_length, 0.0, 0.0),
                np.diag((0.0, arm_inertia, arm_inertia)),
            )
            elbow = pin.SE3(np.eye(3), np.array([arm_length, 0.0, 0.0]))
            if closure == "rod":
                first = self.model.addJoint(arm, pin.JointModelRY(), elbow, f"elbow_{limb}_swing")
                forearm = self.model.addJoint(first, pin.JointModelRX(), pin.SE3.Identity(), f"elbow_{limb}_lean")
            elif closure == "rcu":
                first = self.model.addJoint(arm, pin.JointModelPY(), elbow, f"elbow_{limb}_slide")
                forearm = self.model.addJoint(first, pin.JointModelRY(), pin.SE3.Identity(), f"elbow_{limb}_swing")
            else:
                raise ValueError(f"closure {closure!r} is neither 'rod' nor 'rcu'")
            self._body(
                forearm,
                forearm_mass,
                (0.0, 0.0, -forearm_length / 2.0),
                np.diag((forearm_inertia, forearm_inertia, 0.0)),
            )
            end = self._frame(f"forearm_{limb}_end", forearm, (0.0, 0.0, -forearm_length))
            hold = turn @ np.array([float(geometry["platform_radius"]), 0.0, 0.0])
            corner = self._frame(f"platform_{limb}", self._platform_joint, hold)
            self._points.append(PointLoop(end, corner))

    def _guess(self, q: Array) -> Array:
        """Put the platform where three spheres about the elbows meet, below them."""
        geometry = self.params["geometry"]
        azimuths = np.asarray(geometry["azimuths"], dtype=float)
        length = float(geometry["forearm_length"])
        reach = (
            float(geometry["base_radius"])
            - float(geometry["platform_radius"])
            + float(geometry["arm_length"]) * np.cos(q)
        )
        centres = np.column_stack(
            (
                reach * np.cos(azimuths),
                reach * np.sin(azimuths),
                -float(geometry["arm_length"]) * np.sin(q),
            )
        )
        side, other = centres[1] - centres[0], centres[2] - centres[0]
        normal = cross(side, other)
        scale = normal @ normal
        offset = ((other @ other) * cross(normal, -side) + (side @ side) * cross(normal, other)) / (-2.0 * scale)
        height = length**2 - offset @ offset
        if height <= 0.0:
            raise AssemblyError(f"the forearms do not reach each other at arm angles {q}")
        downward = -normal / math.sqrt(scale) if normal[2] > 0.0 else normal / math.sqrt(scale)
        position = centres[0] + offset + math.sqrt(height) * downward

        configuration: Array = pin.neutral(self.model)
        configuration[:3] = position
        for limb, azimuth in enumerate(azimuths):
            to_arm = pin.utils.rpyToMatrix(0.0, -q[limb], 0.0) @ pin.utils.rpyToMatrix(0.0, 0.0, -azimuth)
            local = to_arm @ (position - centres[limb]) / length
            swing = math.atan2(-local[0], -local[2])
            joint = self._actuated_joints[limb] + 1
            first, second = (self._place(joint + k) for k in (0, 1))
            if self.model.joints[joint].shortname() == "JointModelPY":
                configuration[first] = length * local[1]
                configuration[second] = swing
            else:
                configuration[first] = swing
                configuration[second] = math.asin(max(-1.0, min(1.0, float(local[1]))))
        return configuration

    def _home(self, pose: Array) -> Array:
        """Start from level arms, or the nearest common angle that lets the forearms meet."""
        for angle in np.linspace(0.0, 1.5, 16):
            try:
                return self._guess(np.full(3, angle))
            except AssemblyError:
                continue
        raise AssemblyError(f"no symmetric assembly to reach {pose} from")

    def _check_assembly(self, configuration: Array) -> None:
        heights = []
        pin.forwardKinematics(self.model, self.data, configuration)
        for joint in self._actuated_joints:
            heights.append(self.data.oMi[joint + 1].translation[2])
        if not configuration[2] < float(np.mean(heights)):
            raise AssemblyError("the loops closed with the platform above the elbows")

    def platform_position(self, q: ArrayLike) -> Array:
        """Return the platform's centre for arm angles ``q``, shape (3,), m."""
        position: Array = self.assemble(q)[:3].copy()
        return position
