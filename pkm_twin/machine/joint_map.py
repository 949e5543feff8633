# SPDX-License-Identifier: Apache-2.0
"""Between a controller's joint numbers and the model's: name, sign, offset and ratio a joint.

controller = offset + sign * ratio * model. So ``offset`` is what the controller reads where the
model's joint is at zero, and ``ratio`` how many of the controller's units are one of the model's:
turns of a motor a turn of the joint, millimetres a metre. Power is the same on both sides.

Messages and bags carry the controller's numbers, everything else computes with the model's. A joint
number enters through :class:`pkm_twin.ros.messages.JointReader` and leaves as
:data:`ControllerNumbers`, which only this module makes and which the publishers ask for.

May import: numpy, this package's schema, the standard library.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NewType

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.machine import schema

Array = NDArray[np.float64]
ControllerNumbers = NewType("ControllerNumbers", np.ndarray[Any, np.dtype[np.float64]])
"""Joint numbers as a controller has them, shape (..., n), in the robot's order."""


@dataclass(frozen=True, eq=False)
class JointMapEntry:
    """One joint: the controller's name for it, and its numbers."""

    name: str | None = schema.text(default=None)
    sign: float = schema.number(at_least=-1.0, at_most=1.0, default=1.0)
    offset: float = schema.number(unit="the controller's", default=0.0)
    ratio: float = schema.number(
        at_least=1e-6, at_most=1e6, unit="the controller's per the model's", default=1.0
    )

    def verify(self, path: str) -> None:
        """A sign is 1 or -1."""
        if abs(self.sign) != 1.0:
            raise ParameterError(f"{path}.sign", self.sign, "1 or -1")


@dataclass(frozen=True, eq=False)
class JointMap:
    """The controller's names, and factors and offsets of its positions, shape (n,) each."""

    names: tuple[str, ...]
    factors: Array
    offsets: Array

    @classmethod
    def of(cls, joints: Sequence[str], entries: Mapping[str, JointMapEntry]) -> JointMap:
        """The map of a robot's joints; what has no entry is the same on both sides.

        :raises ParameterError: an entry of a joint that there is not, or two joints of one name.
        """
        for name in entries:
            if name not in joints:
                raise UnknownNameError(f"joint_map.{name}", name, joints)
        rows = [entries.get(name, JointMapEntry()) for name in joints]
        names = tuple(row.name or name for row, name in zip(rows, joints, strict=True))
        if len(set(names)) < len(names):
            raise ParameterError("joint_map", list(names), "different names")
        return cls(
            names,
            np.array([row.sign * row.ratio for row in rows]),
            np.array([row.offset for row in rows]),
        )

    @property
    def plain(self) -> bool:
        """Whether numbers are the same on both sides."""
        return bool((self.factors == 1.0).all() and (self.offsets == 0.0).all())

    def positions(self, controller: Array) -> Array:
        """The model's positions of the controller's, shape (..., n)."""
        return np.asarray((controller - self.offsets) / self.factors, np.float64)

    def rates(self, controller: Array) -> Array:
        """The model's velocities or accelerations of the controller's, shape (..., n)."""
        return np.asarray(controller / self.factors, np.float64)

    def efforts(self, controller: Array) -> Array:
        """The model's efforts of the controller's, shape (..., n)."""
        return np.asarray(controller * self.factors, np.float64)

    def controller_positions(self, model: Array) -> ControllerNumbers:
        """The controller's positions of the model's, shape (..., n)."""
        return ControllerNumbers(self.offsets + self.factors * model)

    def controller_rates(self, model: Array) -> ControllerNumbers:
        """The controller's velocities, accelerations or position differences, shape (..., n)."""
        return ControllerNumbers(self.factors * model)

    def controller_efforts(self, model: Array) -> ControllerNumbers:
        """The controller's efforts of the model's, shape (..., n)."""
        return ControllerNumbers(model / self.factors)
