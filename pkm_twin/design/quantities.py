# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute the quantities that a design is optimised for, and their derivatives.

A quantity is the largest (for the singularity index the smallest) of several smooth components,
for example of the efforts of all joints in all samples.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Indices
from pkm_twin.design.pose_path import PathMotion
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.robot.numbers import FileNumbers
from pkm_twin.robot.robot import Robot


@dataclass(frozen=True)
class Quantity:
    """Define one of :data:`QUANTITIES`.

    ``evaluate``: returns the components of k machines, shape (k, t, c) if ``sampled``, else (k, c).
    ``differentiate``: returns the derivatives of one machine's components, given by their indices
    along c, with respect to its numbers, shape (components, d); if ``sampled``, the machine's path
    has one sample per component. ``least``: True if the quantity is the smallest component, not the
    largest.
    """

    name: str
    meaning: str
    evaluate: Callable[[PathMotion], Array]
    differentiate: Callable[[PathMotion, Indices], Array]
    sampled: bool = False
    least: bool = False

    def component_values(self, followed: PathMotion) -> Array:
        """Return the components (of joints, samples or both) of k machines, shape (k, components)."""
        found = self.evaluate(followed)
        return found.reshape(len(found), -1)

    def worst(self, components: Array) -> Array:
        """Return the quantity from components (k, p), shape (k,)."""
        return np.asarray(components.min(-1) if self.least else components.max(-1), np.float64)

    def unit(self, robot: Robot) -> str:
        """Return the unit of the values; empty for plain numbers."""
        if self.name in ("peak-effort", "rms-effort"):
            units = set(robot.effort_units)
            return units.pop() if len(units) == 1 else "of the limit"
        others = {"motor-torque": "N m", "energy": "J", "deflection": "m", "mass": "kg"}
        return others.get(self.name, "")


@dataclass(frozen=True)
class Constraint:
    """Bound a quantity from above (the singularity index from below)."""

    quantity: Quantity
    bound: float

    @classmethod
    def parse(cls, text: str) -> Constraint:
        """Parse ``singularity>=0.1`` or ``peak-effort<=20``.

        :raises ParameterError: another form, an unknown quantity, or a bound on the wrong side.
        """
        match = re.fullmatch(r"\s*([\w-]+)\s*(<=|>=)\s*(\S+)\s*", text)
        try:
            bound = float(match[3]) if match else math.nan
        except ValueError:
            bound = math.nan
        if match is None or not math.isfinite(bound):
            raise ParameterError("subject-to", text, "NAME<=NUMBER or singularity>=NUMBER")
        quantity = find_quantity(match[1], "subject-to")
        if (match[2] == ">=") != quantity.least:
            side = ">=" if quantity.least else "<="
            raise ParameterError("subject-to", text, f"{quantity.name}{side}{match[3]}")
        return cls(quantity, bound)

    @property
    def scale(self) -> float:
        """Scale that makes the excess dimensionless."""
        return max(abs(self.bound), 1e-12)

    def excess(self, components: Array) -> Array:
        """Return the components' excess over the bound, relative to it: positive if violated."""
        side = -1.0 if self.quantity.least else 1.0
        return side * (components - self.bound) / self.scale

    def __str__(self) -> str:
        return f"{self.quantity.name}{'>=' if self.quantity.least else '<='}{self.bound:g}"


def effort_scales(robot: Robot) -> Array:
    """Return the factors that make efforts comparable, (n,).

    They are 1, or 1 / effort limit if the machine has both rotary and sliding joints.

    :raises ParameterError: rotary and sliding joints without effort limits.
    """
    if len(set(robot.effort_units)) == 1:
        return np.ones(robot.joints_count)
    limit = robot.limits.effort
    if limit is None:
        raise ParameterError("limits.effort", None, "limits, to compare efforts in N and N m")
    return 1.0 / np.asarray(limit, np.float64)


def _peak_derivatives(f: PathMotion, joints: Indices) -> Array:
    """Return the derivatives of peak efforts; ``joints``: the joint with the peak at each sample."""
    rows = np.arange(len(joints))
    weights = np.zeros(f.efforts.shape[1:])
    scale = effort_scales(f.machines.robot)[joints]
    weights[rows, joints] = np.sign(f.efforts[0, rows, joints]) * scale
    return f.effort_derivatives(weights)


def _rms_over_time(f: PathMotion, values: Array) -> Array:
    """Return the root mean square over time of values (k, t, n), shape (k, n)."""
    squares = (f.path.weights[:, None] * values**2).sum(1) / f.path.duration
    return np.asarray(np.sqrt(squares), np.float64)


def _rms_gradient(f: PathMotion, values: Array, place: int) -> Array:
    """Return the derivatives of one RMS by one machine's values, shape (t,)."""
    root = _rms_over_time(f, values)[0, place] * f.path.duration
    return np.asarray(f.path.weights * values[0, :, place] / max(root, 1e-300), np.float64)


def _rms_derivatives(f: PathMotion, places: Indices) -> Array:
    scales, rows = effort_scales(f.machines.robot), []
    for place in places:
        weights = np.zeros(f.efforts.shape[1:])
        weights[:, place] = scales[place] * _rms_gradient(f, f.efforts, place)
        rows.append(f.effort_derivatives(weights).sum(0))
    return np.array(rows)


def _list_gear_numbers(robot: Robot) -> list[Any]:
    """Return transmission ratios, rotor inertias and efficiencies of the drives.

    :raises ParameterError: a joint has no section ``drive``.
    """
    drives = [drive for drive in robot.drives if drive is not None]
    if len(drives) < robot.joints_count:
        raise ParameterError("drive", None, "a section drive for each joint, for motor-torque")
    found: list[Any] = [drive.turns for drive in drives]
    return [*found, *(drive.inertia for drive in drives), *(drive.efficiency for drive in drives)]


def _motor_torques(f: PathMotion) -> tuple[Array, Array, Array, Array, Array]:
    """Return the motors' torques, losses, turns, inertias and efficiencies.

    Torques as in :mod:`pkm_twin.paths.sizing`, shape (k, t, n); numbers, shape (k, 1, n).
    """
    turns, inertia, efficiency = np.split(_cached_numbers(f, _list_gear_numbers)(f.machines.values)[:, None], 3, -1)
    transmitted = f.efforts - inertia * turns**2 * f.qdd
    losses = np.where(transmitted * f.qd < 0.0, efficiency, 1.0 / efficiency)
    return inertia * turns * f.qdd + transmitted * losses / turns, losses, turns, inertia, efficiency


def _motor_derivatives(f: PathMotion, places: Indices) -> Array:
    torques, losses, *numbers = _motor_torques(f)
    loss, tau, qdd = losses[0], f.efforts[0], f.qdd[0]
    turns, inertia, efficiency = (values[0] for values in numbers)
    transmitted = tau - inertia * turns**2 * qdd
    # Derivatives by turns, inertia and efficiency at constant effort and motion.
    by_numbers = (
        inertia * qdd * (1.0 - loss) - tau * loss / turns**2,
        turns * qdd * (1.0 - loss),
        transmitted / turns * np.where(transmitted * f.qd[0] < 0.0, 1.0, -1.0 / efficiency**2),
    )
    slopes = _cached_numbers(f, _list_gear_numbers).slopes_at(f.machines.values)[0].reshape(3, len(turns[0]), -1)
    rows = []
    for place in places:
        weights = np.zeros(tau.shape)
        weights[:, place] = _rms_gradient(f, torques, place)
        by_efforts = f.effort_derivatives(weights * loss / turns, None, weights * inertia * turns * (1.0 - loss))
        by_gear = sum((weights * by).sum(0)[place] * s[place] for by, s in zip(by_numbers, slopes, strict=True))
        rows.append(by_efforts.sum(0) + by_gear)
    return np.array(rows)


def _energy(f: PathMotion) -> Array:
    power = np.maximum(f.efforts * f.qd, 0.0)
    return np.asarray((f.path.weights[:, None] * power).sum((1, 2))[:, None], np.float64)


def _energy_derivatives(f: PathMotion, places: Indices) -> Array:
    given = (f.efforts * f.qd > 0.0)[0] * f.path.weights[:, None]
    rows = f.effort_derivatives(given * f.qd[0], given * f.efforts[0])
    return np.repeat(rows.sum(0)[None], len(places), 0)


def _deflection(f: PathMotion) -> Array:
    return np.asarray(np.linalg.norm(f.deflection[..., :3], axis=-1)[..., None], np.float64)


def _deflection_derivatives(f: PathMotion, places: Indices) -> Array:
    del places
    moved = f.deflection[0, :, :3]
    size = np.linalg.norm(moved, axis=-1, keepdims=True)
    direction = np.zeros((len(moved), 6))
    direction[:, :3] = moved / np.maximum(size, 1e-300)
    return f.compliance_derivatives(direction[:, :, None] * f.path.wrench[:, None, :])


def _moving_masses(robot: Robot) -> list[Any]:
    graph = robot.graph
    parts = [body.mass for body in graph.bodies.values()]
    return [sum((rod.mass for rod in graph.rods.values()), sum(parts, 0.0))]


def _cached_numbers(f: PathMotion, of: Callable[[Robot], list[Any]]) -> FileNumbers:
    """Return a function of the machines' numbers, created once."""
    functions = f.machines.functions
    found = vars(functions).get(of.__name__)
    if found is None:
        found = FileNumbers(functions.robot, functions.paths, of)
        vars(functions)[of.__name__] = found
    return found


QUANTITIES: Final = {
    quantity.name: quantity
    for quantity in (
        Quantity(
            "peak-effort",
            "greatest effort of any joint",
            lambda f: np.abs(f.efforts) * effort_scales(f.machines.robot),
            _peak_derivatives,
            True,
        ),
        Quantity(
            "rms-effort",
            "greatest RMS effort of a joint",
            lambda f: _rms_over_time(f, f.efforts) * effort_scales(f.machines.robot),
            _rms_derivatives,
        ),
        Quantity(
            "motor-torque",
            "greatest RMS torque of a motor, of files with drives",
            lambda f: _rms_over_time(f, _motor_torques(f)[0]),
            _motor_derivatives,
        ),
        Quantity("energy", "energy that the drives give, nothing regenerated", _energy, _energy_derivatives),
        Quantity(
            "deflection",
            "greatest translation of the reference point under the wrench",
            _deflection,
            _deflection_derivatives,
            True,
        ),
        Quantity(
            "mass",
            "mass of all bodies and rods without payload",
            lambda f: _cached_numbers(f, _moving_masses)(f.machines.values),
            lambda f, places: np.repeat(
                _cached_numbers(f, _moving_masses).slopes_at(f.machines.values)[0], len(places), 0
            ),
        ),
        Quantity(
            "singularity",
            "least singularity index",
            lambda f: f.singularity[..., None],
            lambda f, _: f.singularity_derivatives(),
            True,
            True,
        ),
    )
}


def find_quantity(name: str, field: str) -> Quantity:
    """Find a quantity by its name.

    :raises UnknownNameError: there is no such quantity.
    """
    if name not in QUANTITIES:
        raise UnknownNameError(field, name, QUANTITIES)
    return QUANTITIES[name]
