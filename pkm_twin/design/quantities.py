# SPDX-License-Identifier: Apache-2.0
"""What a design is judged by: quantities of machines on a path, and their derivatives.

A quantity is the greatest (of the singularity index the least) of several smooth pieces: of the
efforts of all joints in all samples, say, or of one number.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.design.pose_path import Followed
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.robot.numbers import FileNumbers
from pkm_twin.robot.robot import Robot

Index = NDArray[np.intp]

CONSTRAINT: Final = re.compile(r"\s*([\w-]+)\s*(<=|>=)\s*(\S+)\s*")


@dataclass(frozen=True)
class Quantity:
    """One of :data:`QUANTITIES`.

    ``of``: of k machines, pieces of shape (k, t, c) where ``sampled``, else (k, c). ``slopes``: of
    one machine and places of c, derivatives by its numbers, shape (pieces, d); where sampled, the
    machine's path has one sample a piece. ``least``: the least piece counts.
    """

    name: str
    meaning: str
    of: Callable[[Followed], Array]
    slopes: Callable[[Followed, Index], Array]
    sampled: bool = False
    least: bool = False

    def pieces(self, followed: Followed) -> Array:
        """Of k machines, shape (k, pieces)."""
        found = self.of(followed)
        return found.reshape(len(found), -1)

    def width(self, robot: Robot) -> int:
        """Pieces a sample."""
        return robot.joints_count if self.name == "peak-effort" else 1

    def worst(self, pieces: Array) -> Array:
        """The quantity of pieces (k, p), shape (k,)."""
        return np.asarray(pieces.min(-1) if self.least else pieces.max(-1), np.float64)

    def unit(self, robot: Robot) -> str:
        """Of its values; empty for plain numbers."""
        if self.name in ("peak-effort", "rms-effort"):
            units = set(robot.effort_units)
            return units.pop() if len(units) == 1 else "of the limit"
        return {"energy": "J", "deflection": "m", "mass": "kg"}.get(self.name, "")


@dataclass(frozen=True)
class Constraint:
    """A quantity at most (of the singularity index at least) a bound."""

    quantity: Quantity
    bound: float

    @classmethod
    def of(cls, text: str) -> Constraint:
        """``singularity>=0.1`` or ``peak-effort<=20``.

        :raises ParameterError: another form, quantity, or side.
        """
        match = CONSTRAINT.fullmatch(text)
        try:
            bound = float(match[3]) if match else math.nan
        except ValueError:
            bound = math.nan
        if match is None or not math.isfinite(bound):
            raise ParameterError("subject-to", text, "NAME<=NUMBER or singularity>=NUMBER")
        quantity = quantity_of(match[1], "subject-to")
        if (match[2] == ">=") != quantity.least:
            side = ">=" if quantity.least else "<="
            raise ParameterError("subject-to", text, f"{quantity.name}{side}{match[3]}")
        return cls(quantity, bound)

    @property
    def scale(self) -> float:
        """What makes misses of unit one."""
        return max(abs(self.bound), 1e-12)

    def misses(self, pieces: Array) -> Array:
        """By how much pieces miss the bound, over it: above zero where they do."""
        side = -1.0 if self.quantity.least else 1.0
        return side * (pieces - self.bound) / self.scale

    def __str__(self) -> str:
        return f"{self.quantity.name}{'>=' if self.quantity.least else '<='}{self.bound:g}"


def effort_scales(robot: Robot) -> Array:
    """What efforts are multiplied by, shape (n,): one, or one over the limits of mixed joints.

    :raises ParameterError: joints of two kinds without limits of their efforts.
    """
    if len(set(robot.effort_units)) == 1:
        return np.ones(robot.joints_count)
    limit = robot.limits.effort
    if limit is None:
        raise ParameterError("limits.effort", None, "limits, to compare efforts in N and N m")
    return 1.0 / np.asarray(limit, np.float64)


def _peak(f: Followed) -> Array:
    return np.abs(f.efforts) * effort_scales(f.many.robot)


def _peak_slopes(f: Followed, places: Index) -> Array:
    rows = np.arange(len(places))
    weights = np.zeros(f.efforts.shape[1:])
    scale = effort_scales(f.many.robot)[places]
    weights[rows, places] = np.sign(f.efforts[0, rows, places]) * scale
    return f.effort_slopes(weights)


def _rms(f: Followed) -> Array:
    squares = (f.path.weights[:, None] * f.efforts**2).sum(1) / f.path.duration
    return np.asarray(np.sqrt(squares) * effort_scales(f.many.robot), np.float64)


def _rms_slopes(f: Followed, places: Index) -> Array:
    scales, rms, rows = effort_scales(f.many.robot), _rms(f)[0], []
    for place in places:
        weights = np.zeros(f.efforts.shape[1:])
        share = scales[place] ** 2 / max(rms[place] * f.path.duration, 1e-300)
        weights[:, place] = f.path.weights * f.efforts[0, :, place] * share
        rows.append(f.effort_slopes(weights).sum(0))
    return np.array(rows)


def _energy(f: Followed) -> Array:
    power = np.maximum(f.efforts * f.qd, 0.0)
    return np.asarray((f.path.weights[:, None] * power).sum((1, 2))[:, None], np.float64)


def _energy_slopes(f: Followed, places: Index) -> Array:
    given = (f.efforts * f.qd > 0.0)[0] * f.path.weights[:, None]
    rows = f.effort_slopes(given * f.qd[0], given * f.efforts[0])
    return np.repeat(rows.sum(0)[None], len(places), 0)


def _deflection(f: Followed) -> Array:
    return np.asarray(np.linalg.norm(f.deflection[..., :3], axis=-1)[..., None], np.float64)


def _deflection_slopes(f: Followed, places: Index) -> Array:
    del places
    moved = f.deflection[0, :, :3]
    size = np.linalg.norm(moved, axis=-1, keepdims=True)
    way = np.zeros((len(moved), 6))
    way[:, :3] = moved / np.maximum(size, 1e-300)
    return f.compliance_slopes(way[:, :, None] * f.path.wrench[:, None, :])


def _moving_masses(robot: Robot) -> list[Any]:
    graph = robot.make_graph()
    parts = [body.mass for body in graph.bodies.values()]
    return [sum((rod.mass for rod in graph.rods.values()), sum(parts, 0.0))]


def _masses(f: Followed) -> FileNumbers:
    functions = f.many.functions
    found = vars(functions).get("moving masses")
    if found is None:
        found = FileNumbers(functions.robot, functions.paths, _moving_masses)
        vars(functions)["moving masses"] = found
    return found


def _mass(f: Followed) -> Array:
    return _masses(f)(f.many.values)


def _mass_slopes(f: Followed, places: Index) -> Array:
    return np.repeat(_masses(f).slopes_at(f.many.values)[0], len(places), 0)


QUANTITIES: Final = {
    quantity.name: quantity
    for quantity in (
        Quantity("peak-effort", "greatest effort of any joint", _peak, _peak_slopes, True),
        Quantity("rms-effort", "greatest RMS effort of a joint", _rms, _rms_slopes),
        Quantity("energy", "energy that the drives give, nothing regenerated", _energy,
                 _energy_slopes),
        Quantity("deflection", "greatest translation of the reference point under the wrench",
                 _deflection, _deflection_slopes, True),
        Quantity("mass", "mass of all bodies and rods without payload", _mass, _mass_slopes),
        Quantity("singularity", "least singularity index",
                 lambda f: f.singularity[..., None], lambda f, _: f.singularity_slopes(), True,
                 True),
    )
}  # fmt: skip


def quantity_of(name: str, field: str) -> Quantity:
    """The quantity of a name.

    :raises UnknownNameError: there is none.
    """
    if name not in QUANTITIES:
        raise UnknownNameError(field, name, QUANTITIES)
    return QUANTITIES[name]
