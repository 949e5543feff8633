# SPDX-License-Identifier: Apache-2.0
"""Errors that a fit of efforts does not fit: what each would change in the measured efforts.

Errors of the drives and the recording (a gain, a delay, an offset, an elastic drive, another
friction law, another rate of time), and lengths and angles of the robot's file, which a fit takes
for certain.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from delta_dynamics.torques.derivatives import numbers_slopes, torques_by_numbers
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.identification.judge import Suspect
from pkm_twin.identification.parameters import FileParameters
from pkm_twin.identification.rows import BLOCK, Rows
from pkm_twin.identification.samples import by_blocks
from pkm_twin.machine.friction import turning_keys
from pkm_twin.machine.places import path_of
from pkm_twin.machine.uncertainty import numbers_below
from pkm_twin.robot.entries import entries
from pkm_twin.robot.robot import Robot

GAIN: Final = "gain of the efforts"
LATE: Final = "efforts late"
LOAD: Final = "friction that grows with the load"
SQUARE: Final = "friction that grows with the square of the speed"
STATIC: Final = "static friction above Coulomb friction"
OFFSET: Final = "sensor offset"
ELASTIC: Final = "elastic drive"
SPEED: Final = "time at another rate"
RESONANCE: Final = "drive resonance"
INTERFERENCE: Final = "interference at one frequency"
GEOMETRY: Final = "geometry"
STEP: Final = 1e-4
"""Of difference quotients by an offset or a give, rad or machine sizes."""
USUAL: Final = 5e-3
"""Standard deviation of a length of which the file does not say it, as a part of the machine's
extent, and of an angle, rad: parts made to a drawing and assembled without calibration are within
1 %, which is two of it."""
_PLACES: Final = re.compile(r"geometry\.|origin\[|(joints|rods)\.[^.]+\.(at|ends)\[")


Errors = list[tuple[Suspect, Array]]
"""Each with the derivative of the measured efforts by its size, (k, n)."""


def errors_of(rows: Rows, values: Array) -> tuple[Errors, Array]:
    """The errors that every robot and recording may have, at a recording's rows.

    And what the differentiation misses, joint by joint, (k, n, n).

    :param values: of all parameters of the file.
    """
    robot, s = rows.model.robot, rows.signals
    names, efforts, motion = robot.joint_names, robot.effort_units, s.motion
    pairs = list(zip(robot.joint_units, efforts, strict=True))
    eye, lengths = np.eye(len(names)), lengths_of(robot)
    # Without dry friction: its sign has no derivative, and turns where a rate is near zero.
    dry = turning_keys()
    own = [name.rpartition(".")[2] for name in rows.model.parameters.names]
    smooth = np.where([word in dry for word in own], 0.0, values)

    def need(q: Array | float = 0.0, qd: Array | float = 0.0, qdd: Array | float = 0.0) -> Array:
        """Efforts of a motion that differs by so much."""
        q, qd, qdd = motion.q + q, motion.qd + qd, motion.qdd + qdd
        return rows.model.efforts(replace(motion, q=q, qd=qd, qdd=qdd), smooth)

    here, told, change = need(), s.effort, rows.change
    load, square, *static = np.moveaxis(s.own, -1, 0)
    # A law of the robot is fitted.
    share = None if "load-dependent" in robot.laws else 0.05
    found: Errors = []
    for kind, units, usual, column in (
        (GAIN, [""] * len(names), 0.05, told), (LATE, ["s"] * len(names), 2e-3, -change),
        (LOAD, [""] * len(names), share, load),
        (SQUARE, [f"{e} s2/{u}2" for u, e in pairs], None, square),
        *((STATIC, efforts, None, law) for law in static),
    ):  # fmt: skip
        each = zip(names, units, eye, strict=True)
        found += [(Suspect(kind, name, unit, usual), column * e) for name, unit, e in each]
    for name, (unit, _), length, e in zip(names, pairs, lengths, eye, strict=True):
        step = STEP * length * e
        apart = (need(-step) - need(step)) / (2.0 * STEP * length)
        found.append((Suspect(OFFSET, name, unit, 0.01 * float(length)), apart))
    for j, (name, (u, effort)) in enumerate(zip(names, pairs, strict=True)):
        # The load turns the drive's outer side back by so much.
        size = STEP * lengths[j] / max(float(np.abs(s.load[0][:, j]).max()), 1e-300)
        back = (-size * one[:, [j]] * eye[j] for one in s.load)
        unit = f"{u}/({effort})" if " " in effort else f"{u}/{effort}"
        found.append((Suspect(ELASTIC, name, unit, positive=True), (need(*back) - here) / size))
    fast, slow = (need(0.0, h * motion.qd, (2.0 * h + h**2) * motion.qdd) for h in (STEP, -STEP))
    found += [
        (Suspect(GAIN, "all joints", usual=0.05), told),
        (Suspect(LATE, "all joints", "s"), -change),
        (Suspect(LOAD, "all joints", usual=share), load),
        (Suspect(SPEED, "all joints"), (fast - slow) / (2.0 * STEP)),
    ]
    return found, (need(0.0, *s.missed) - here)[..., None] * eye


def lengths_of(robot: Robot) -> Array:
    """A radian of the joints that turn, the machine's size of those that slide, (n,)."""
    return np.array([robot.size if unit == "m" else 1.0 for unit in robot.joint_units])


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

    def columns(self, rows: Rows, values: Array) -> Array:
        """Derivatives of the measured efforts at a recording's rows, shape (k, n, suspects).

        :param values: of all parameters of the file.
        """
        carried, motion = rows.model.carried, rows.signals.motion
        machine = _weighing(rows.model.robot, rows.model.parameters, values, carried is None)
        if carried is not None:
            machine = machine.numbered(_payload(carried))
        bare = machine.numbered(dict.fromkeys(_payload(machine), 0.0))
        held = motion.held[:, None, None]
        away = bool((held != 1.0).any())
        slopes, of_bare = (
            numbers_slopes(one, self.paths) @ self.mixing if needed else np.zeros(0)
            for one, needed in ((machine, True), (bare, away))
        )

        def block(some: slice) -> Array:
            part = motion.part(some)
            told = torques_by_numbers(machine, *part.joints, part.wrench, slopes)
            if away:
                less = torques_by_numbers(bare, *part.joints, part.wrench, of_bare)
                told = less + held[some] * (told - less)
            return told

        return by_blocks(len(held), BLOCK, block)


def _weighing(robot: Robot, parameters: FileParameters, values: Array, loaded: bool) -> Robot:
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
