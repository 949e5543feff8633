# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute a machine as a Pinocchio tree with loops closed without Pinocchio's constraints.

The tree consists of the actuated joints and those with the fewest freedoms.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from pkm_twin.certify.description import BASE, Array, Body, Description
from pkm_twin.certify.rows import Frame
from pkm_twin.certify.trees import Steps, Tree


class PinocchioTree(Tree):
    """A machine as a Pinocchio tree with loop constraints.

    :raises UnfitError: the description cannot be read.
    """

    name = "Pinocchio"
    widest = False

    def __init__(self, description: Description) -> None:
        self.model = pin.Model()
        self._carriers: dict[str, tuple[int, Array]] = {BASE: (0, np.zeros(3))}
        """Joint that moves each body, and the position of its frame at home, m."""
        super().__init__(description)

    def add_body(self, name: str, parent: str, at: Array, steps: Steps | None, body: Body) -> None:
        """Add a body to the tree; three rotations are a ball joint."""
        carrier, origin = self._carriers[parent]
        if steps is None:
            models = [pin.JointModelFreeFlyer()]
        elif [turns for turns, _ in steps] == [True] * 3:
            models = [pin.JointModelSpherical()]
        else:
            models = [
                (pin.JointModelRevoluteUnaligned if turns else pin.JointModelPrismaticUnaligned)(a)
                for turns, a in steps
            ]
        for number, model in enumerate(models):
            offset = pin.SE3(np.eye(3), np.asarray(at - origin, dtype=float))
            carrier = self.model.addJoint(carrier, model, offset, f"{name}.{number}")
            origin = at
        self._carriers[name] = carrier, origin
        if carrier:
            inertia = pin.Inertia(body.mass, body.com - origin, body.inertia)
            self.model.appendBodyToJoint(carrier, inertia, pin.SE3.Identity())

    def finish(self) -> int:
        """Complete the model; return its number of velocities."""
        self.model.gravity.linear = self.machine.gravity
        self.data = self.model.createData()
        return int(self.model.nv)

    def neutral(self) -> Array:
        """Return the configuration at home."""
        return np.asarray(pin.neutral(self.model))

    def set_state(self, full: Array, rates: Array) -> None:
        """Set the tree's configuration and velocities, shape (size,)."""
        self._frames: dict[str, Frame] = {}
        self._state = full, rates
        pin.forwardKinematics(self.model, self.data, full, rates, np.zeros(self.size))
        pin.computeJointJacobians(self.model, self.data, full)

    def step_from(self, full: Array, step: Array) -> Array:
        """Return the configuration after a small motion, shape (size,)."""
        return np.asarray(pin.integrate(self.model, full, step))

    def frame(self, body: str) -> Frame:
        """Return the frame of the joint that moves a body."""
        if body not in self._frames:
            carrier, origin = self._carriers[body]
            given = self.model, self.data, carrier
            world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            place = self.data.oMi[carrier]
            columns = np.array(pin.getJointJacobian(*given, world))
            bias = pin.getClassicalAcceleration(*given, world).vector
            self._frames[body] = Frame(
                origin, place.translation.copy(), place.rotation.copy(), columns, columns @ self._state[1], bias
            )
        return self._frames[body]

    def forces(self, change: Array) -> Array:
        """Compute the tree's inverse dynamics by recursive Newton-Euler, shape (size,)."""
        return np.array(pin.rnea(self.model, self.data, *self._state, change))
