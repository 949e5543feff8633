# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The same machine as a Pinocchio tree, its loops closed without Pinocchio's constraints.

The tree is made of the actuated joints and of those that leave least freedom.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from pkm_twin.certify.description import BASE, Array, Body, Description
from pkm_twin.certify.rows import Frame
from pkm_twin.certify.trees import Steps, Tree


class PinocchioTree(Tree):
    """A machine as a tree of Pinocchio's with loop constraints.

    :raises UnfitError: a description that cannot be read.
    """

    name = "Pinocchio"
    widest = False

    def __init__(self, description: Description) -> None:
        self.model = pin.Model()
        self._carriers: dict[str, tuple[int, Array]] = {BASE: (0, np.zeros(3))}
        """The joint that each body moves with, and where its frame is at home."""
        super().__init__(description)

    def hang(self, name: str, parent: str, at: Array, steps: Steps | None, body: Body) -> None:
        """Add a body; three turns are a ball."""
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
            carrier = self.model.addJoint(carrier, model, _shift(at - origin), f"{name}.{number}")
            origin = at
        self._carriers[name] = carrier, origin
        if carrier:
            inertia = pin.Inertia(body.mass, body.com - origin, body.inertia)
            self.model.appendBodyToJoint(carrier, inertia, pin.SE3.Identity())

    def finish(self) -> int:
        """Make the data."""
        self.model.gravity.linear = self.machine.gravity
        self.data = self.model.createData()
        return int(self.model.nv)

    def neutral(self) -> Array:
        """The configuration at home."""
        return np.asarray(pin.neutral(self.model))

    def place(self, full: Array, rates: Array) -> None:
        """Put the tree's configuration and rates, shape (size,)."""
        self._frames: dict[str, Frame] = {}
        self._state = full, rates
        pin.forwardKinematics(self.model, self.data, full, rates, np.zeros(self.size))
        pin.computeJointJacobians(self.model, self.data, full)

    def stepped(self, full: Array, step: Array) -> Array:
        """The configuration that a small motion leads to, shape (size,)."""
        return np.asarray(pin.integrate(self.model, full, step))

    def frame(self, body: str) -> Frame:
        """The frame of the joint that carries a body."""
        if body not in self._frames:
            carrier, origin = self._carriers[body]
            given = self.model, self.data, carrier
            world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            place = self.data.oMi[carrier]
            columns = np.array(pin.getJointJacobian(*given, world))
            bias = pin.getClassicalAcceleration(*given, world).vector
            self._frames[body] = Frame(
                origin, place.translation.copy(), place.rotation.copy(), columns,
                columns @ self._state[1], bias,
            )  # fmt: skip
        return self._frames[body]

    def forces(self, change: Array) -> Array:
        """Recursive Newton-Euler of the tree, shape (size,)."""
        return np.array(pin.rnea(self.model, self.data, *self._state, change))


def _shift(offset: Array) -> Any:
    return pin.SE3(np.eye(3), np.asarray(offset, dtype=float))
