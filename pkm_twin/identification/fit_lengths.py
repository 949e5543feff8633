# SPDX-License-Identifier: Apache-2.0
"""Lengths and angles of a robot's file that a fit takes for certain, and what they are off by."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from delta_dynamics.derivatives import numbers_slopes, torques_by_numbers
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.identification.file_parameters import FileParameters
from pkm_twin.identification.fit_rows import BLOCK
from pkm_twin.identification.fit_signals import Signals
from pkm_twin.identification.samples import by_blocks
from pkm_twin.identification.verdict import Suspect
from pkm_twin.machine.places import path_of
from pkm_twin.machine.uncertainty import numbers_below
from pkm_twin.robot.entries import entries
from pkm_twin.robot.robot import Robot

GEOMETRY: Final = "geometry"
USUAL: Final = 5e-3
"""Standard deviation of a length of which the file does not say it, as a part of the machine's
extent, and of an angle, rad: parts made to a drawing and assembled without calibration are within
1 %, which is two of it."""
_PLACES: Final = re.compile(r"geometry\.|origin\[|(joints|rods)\.[^.]+\.(at|ends)\[")


@dataclass(frozen=True, eq=False)
class Lengths:
    """Suspects, by how much the numbers of the file change with each.

    ``paths``: of the numbers. ``mixing``: shape (paths, suspects).
    """

    suspects: tuple[Suspect, ...]
    paths: tuple[str, ...]
    mixing: Array

    @classmethod
    def of(cls, robot: Robot) -> Lengths:
        """All that the robot's file gives; an entry of its ``uncertainty`` is one suspect."""
        known = entries(robot)
        units = {p: unit for p, (_, unit) in known.items() if _PLACES.match(p)}
        paths = tuple(path for path, unit in units.items() if unit in ("m", "rad"))
        causes: list[tuple[Suspect, Mapping[str, float]]] = []
        told = set()
        for name, entry in robot.uncertainty.items():
            below = {p: v for p, v in numbers_below(name, entry, known).items() if p in paths}
            told |= set(below)
            if not below:
                continue
            if entry.deviation is None:
                causes.append((Suspect(GEOMETRY, name, "", entry.relative, known=True), below))
                continue
            (path,) = below
            own = Suspect(GEOMETRY, path, units[path], entry.deviation, known=True)
            causes.append((own, {path: 1.0}))
        extent = robot.graph.size
        for path in paths:
            if path not in told:
                usual = USUAL * (extent if units[path] == "m" else 1.0)
                causes.append(
                    (Suspect(GEOMETRY, path, units[path], usual, known=True), {path: 1.0})
                )
        mixing = np.zeros((len(paths), len(causes)))
        for k, (_, weights) in enumerate(causes):
            for path, weight in weights.items():
                mixing[paths.index(path), k] = weight
        return cls(tuple(one for one, _ in causes), paths, mixing)

    def columns(
        self, robot: Robot, parameters: FileParameters, carried: Robot | None, values: Array,
        signals: Signals,
    ) -> Array:  # fmt: skip
        """Derivatives of the measured efforts at a recording's rows, shape (k, n, suspects).

        :param parameters: all of the file, with their ``values``; others as of ``efforts_of``.
        """
        machine = _weighing(robot, parameters, values, loaded=carried is None)
        if carried is not None:
            machine = machine.numbered(_payload(carried))
        bare = machine.numbered(dict.fromkeys(_payload(machine), 0.0))
        held = signals.held[:, None, None]
        away = bool((held != 1.0).any())
        slopes, of_bare = (
            numbers_slopes(one, self.paths) @ self.mixing if needed else np.zeros(0)
            for one, needed in ((machine, True), (bare, away))
        )

        def block(rows: slice) -> Array:
            q, qd, qdd = (one[rows] for one in signals.motion)
            motion = q, qd, qdd, signals.wrench[rows]
            told = torques_by_numbers(machine, *motion, slopes)
            if away:
                less = torques_by_numbers(bare, *motion, of_bare)
                told = less + held[rows] * (told - less)
            return told

        return by_blocks(len(held), BLOCK, block)


def _weighing(robot: Robot, parameters: FileParameters, values: Array, *, loaded: bool) -> Robot:
    """The robot with fitted masses, its geometry as it is."""
    numbers: dict[str, float] = {}
    for where, group in zip(parameters.slices, parameters.groups, strict=True):
        if group.kind == "inertia" or (loaded and group.kind == "payload"):
            new = group.keys(values[where])
            numbers |= {path_of(key): value for key, value in new.items()}
            numbers |= {
                path_of((*key[:-2], key[-1], key[-2])): value
                for key, value in new.items()
                if isinstance(key[-1], int) and isinstance(key[-2], int)
            }
    return robot.numbered({path: v for path, v in numbers.items() if _given(robot, path)})


def _given(robot: Robot, path: str) -> bool:
    """Whether the file has the number, and it is not derived of others."""
    try:
        robot.number(path)
    except ParameterError:
        return False
    return True


def _payload(robot: Robot) -> dict[str, float]:
    load = robot.payload
    numbers = {"payload.mass": float(load.mass)}
    numbers |= {f"payload.com[{i}]": float(v) for i, v in enumerate(load.com)}
    inertia = np.ndenumerate(np.asarray(load.inertia))
    return numbers | {f"payload.inertia[{i}][{j}]": float(v) for (i, j), v in inertia}
