# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Convert joint names and numbers between a controller and the model: sign, offset and ratio.

controller = offset + sign * ratio * model. ``offset`` is the controller's position where the model's
joint is at zero, and ``ratio`` the controller's units per unit of the model: revolutions of a motor
per revolution of the joint, millimetres per metre. Power is the same on both sides.

The effective radius of a spool changes with the length wound on it: the ratio is then
``ratio * (1 + ratio_change * (model - ratio_at))``, and controller = offset + sign * ratio *
(model + ratio_change / 2 * (model - ratio_at)^2). Such a map converts positions only: velocities and
efforts also depend on the position, so nodes, bags and trajectories reject it.

Messages and bags have the controller's numbers; all computations use the model's. Joint numbers enter
through :class:`pkm_twin.messages.reading.JointReader` and leave as :data:`ControllerNumbers`, which
publishers require and only this module makes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NewType

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.machine import schema

ControllerNumbers = NewType("ControllerNumbers", np.ndarray[Any, np.dtype[np.float64]])
"""Joint numbers of a controller, shape (..., n), in the robot's order."""


@dataclass(frozen=True, eq=False)
class JointMapEntry:
    """The conversion of one joint's name and numbers from the model to the controller.

    Positions: controller = offset + sign * ratio * model; velocities and accelerations without the
    offset; efforts are divided by sign * ratio, so that power is the same. ``ratio_change``: the
    ratio is ratio * (1 + ratio_change * (model - ratio_at)), as of a spool; only ``calibrate`` and
    ``robot.controller.positions`` convert such a joint. ``unit``: the controller's, for tables.
    """

    name: str | None = schema.text(default=None)
    sign: float = schema.number(text="1 or -1", default=1.0)
    offset: float = schema.number(unit="controller units", default=0.0)
    ratio: float = schema.number(low=1e-6, high=1e6, unit="controller units per rad or m of the model", default=1.0)
    ratio_change: float = schema.number(low=-1e3, high=1e3, unit="per rad or m", default=0.0)
    ratio_at: float = schema.number(unit="rad or m of the model", default=0.0)
    unit: str | None = schema.text(default=None)

    def verify(self, path: str) -> None:
        """Check that a sign is 1 or -1."""
        if abs(self.sign) != 1.0:
            raise ParameterError(f"{path}.sign", self.sign, "1 or -1")


@dataclass(frozen=True, eq=False)
class JointMap:
    """The controller's names, and factors and offsets of its positions, shape (n,) each.

    ``changes``: relative changes of the ratios per unit of the model's position from ``centres``.
    ``units``: names of the controller's units, None where the file states none.
    """

    names: tuple[str, ...]
    factors: Array
    offsets: Array
    changes: Array
    centres: Array
    units: tuple[str | None, ...]

    @classmethod
    def of(cls, joints: Sequence[str], entries: Mapping[str, JointMapEntry]) -> JointMap:
        """Return the map of a robot's joints; joints without an entry are the same on both sides.

        :raises ParameterError: an entry of an unknown joint, or two joints of one name.
        """
        for name in entries:
            if name not in joints:
                raise UnknownNameError(f"joint_map.{name}", name, joints)
        rows = [entries.get(name, JointMapEntry()) for name in joints]
        names = tuple(row.name or name for row, name in zip(rows, joints, strict=True))
        if len(set(names)) < len(names):
            raise ParameterError("joint_map", list(names), "different names")
        numbers = np.array([(row.sign * row.ratio, row.offset, row.ratio_change, row.ratio_at) for row in rows])
        factors, offsets, changes, centres = numbers.T.copy()
        return cls(names, factors, offsets, changes, centres, tuple(row.unit for row in rows))

    @property
    def is_identity(self) -> bool:
        """True if the joint map changes neither positions nor efforts."""
        return bool((self.factors == 1.0).all() and (self.offsets == 0.0).all() and self.has_constant_ratios)

    @property
    def has_constant_ratios(self) -> bool:
        """True if no ratio depends on the position."""
        return bool((self.changes == 0.0).all())

    def check_constant_ratios(self) -> None:
        """Reject a map whose velocities and efforts depend on the position.

        :raises ParameterError: a ratio changes with travel.
        """
        if not self.has_constant_ratios:
            worst = int(np.abs(self.changes).argmax())
            raise ParameterError(
                f"joint_map.{self.names[worst]}.ratio_change",
                float(self.changes[worst]),
                "0: only positions can be converted where the ratio changes with travel",
            )

    def shown(self, joint: int, quantity: str, value: float, low: float, high: float) -> tuple[float, float, float]:
        """Convert a value of the model and its bounds to the controller's, for a message.

        :param quantity: position, velocity, acceleration or effort.
        """
        numbers = np.array([value, low, high])
        factor, offset = float(self.factors[joint]), float(self.offsets[joint])
        if quantity == "effort":
            numbers /= factor
        else:
            numbers = factor * numbers + (offset if quantity == "position" else 0.0)
        found, *ends = numbers.tolist()
        return found, min(ends), max(ends)

    def positions(self, controller: Array) -> Array:
        """Convert the controller's positions to the model's, shape (..., n).

        NaN beyond the position where a changing ratio falls to zero.
        """
        model = np.asarray((controller - self.offsets) / self.factors, np.float64)
        if self.has_constant_ratios:
            return model
        away = model - self.centres
        with np.errstate(invalid="ignore"):
            root = np.sqrt(1.0 + 2.0 * self.changes * away)
        return np.asarray(self.centres + 2.0 * away / (1.0 + root), np.float64)

    def slopes(self, model: Array) -> Array:
        """Return the controller's units per the model's at these positions, shape (..., n)."""
        return np.asarray(self.factors * (1.0 + self.changes * (model - self.centres)), np.float64)

    def rates(self, controller: Array) -> Array:
        """Convert the controller's velocities or accelerations to the model's, shape (..., n)."""
        self.check_constant_ratios()
        return np.asarray(controller / self.factors, np.float64)

    def efforts(self, controller: Array) -> Array:
        """Convert the controller's efforts to the model's, shape (..., n)."""
        self.check_constant_ratios()
        return np.asarray(controller * self.factors, np.float64)

    def controller_positions(self, model: Array) -> ControllerNumbers:
        """Convert the model's positions to the controller's, shape (..., n)."""
        away = model - self.centres
        return ControllerNumbers(self.offsets + self.factors * (model + 0.5 * self.changes * away * away))

    def controller_rates(self, model: Array) -> ControllerNumbers:
        """Convert rates or position differences to the controller's, shape (..., n)."""
        self.check_constant_ratios()
        return ControllerNumbers(self.factors * model)

    def controller_efforts(self, model: Array) -> ControllerNumbers:
        """Convert the model's efforts to the controller's, shape (..., n)."""
        self.check_constant_ratios()
        return ControllerNumbers(model / self.factors)
