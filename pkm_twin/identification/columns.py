# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Columns of a recording's model: the numbers of the robot's file, and errors that may be present.

Errors of the drives and the recording (a gain, a delay, an offset, an elastic drive, another
friction law, another rate of time), and lengths and angles of the robot's file, which a fit takes
for certain. The search for a recording's cause and the judgement of a fit have the same columns.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from delta_dynamics.torques.derivatives import differentiate_numbers, torques_by_numbers
from pkm_twin.codegen.arrays import Array, Indices, Mask
from pkm_twin.errors import ParameterError
from pkm_twin.identification.evidence import Signals, Spectra
from pkm_twin.identification.parameters import FileParameters
from pkm_twin.identification.rows import BLOCK_ROWS, Rows
from pkm_twin.identification.samples import MIN_RELATIVE_NOISE, Motion, evaluate_blocks
from pkm_twin.identification.verdict import ALL_JOINTS, GEOMETRY, USUAL_SCALE, Suspect
from pkm_twin.machine.friction import list_reversal_keys
from pkm_twin.machine.places import join_path
from pkm_twin.machine.uncertainty import match_numbers
from pkm_twin.robot.robot import Robot

GAIN: Final = "gain of the efforts"
DELAYED_EFFORTS: Final = "efforts late"
LOAD: Final = "friction that grows with the load"
SQUARE: Final = "friction that grows with the square of the speed"
STATIC: Final = "static friction above Coulomb friction"
OFFSET: Final = "sensor offset"
ELASTIC: Final = "elastic drive"
SPEED: Final = "time at another rate"
DELAY: Final = "delay of all efforts"
CURRENT_OFFSET: Final = "offset of the efforts"
MASS: Final = "mass or rotor inertia"
FRICTION: Final = "friction"
OTHER: Final = "other errors"
PRIOR_DEVIATIONS: Final = {
    GAIN: 0.05,  # constants of drives and current sensors are known to some per cent
    DELAY: 0.02,  # s: buffers of buses and controllers
    DELAYED_EFFORTS: 2e-3,  # s: one drive against the others
    LOAD: 0.05,  # gears and screws
    OFFSET: 0.01,  # rad or machine sizes: homing
    GEOMETRY: 5e-3,  # rad or machine sizes: parts made to a drawing are within 1 %, two deviations
    MASS: 0.3,  # as a fraction of itself
    FRICTION: 0.3,  # as a fraction of a joint's efforts
    CURRENT_OFFSET: 0.1,  # as a fraction of a joint's efforts
    OTHER: 0.03,  # as a fraction of the efforts
}
"""Prior standard deviations of errors and of the file's numbers; ``docs/fit.md`` has the same."""
DIFFERENCE_STEP: Final = 1e-4
"""Step of difference quotients, rad or machine sizes."""
_PLACES: Final = re.compile(r"geometry\.|origin\[|(joints|rods)\.[^.]+\.(at|ends)\[")


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors that a robot and a recording may have: s of them, at k rows of n joints.

    ``columns``: derivatives of the measured efforts by the errors' sizes, (k, n, s). ``missed``:
    what the differentiation of the positions misses, joint by joint, (k, n, n).
    """

    suspects: tuple[Suspect, ...]
    columns: Array
    missed: Array

    @classmethod
    def from_rows(cls, rows: Rows, values: Array) -> Errors:
        """Differentiate the measured efforts at a recording's rows.

        :param values: of all parameters of the file, at which the efforts are linearised.
        """
        robot, s = rows.model.robot, rows.signals
        names, efforts, motion = robot.joint_names, robot.effort_units, s.motion
        pairs = list(zip(robot.joint_units, efforts, strict=True))
        # A radian for joints that turn, the machine's size for those that slide.
        eye, lengths = np.eye(len(names)), np.array([robot.size if u == "m" else 1.0 for u in robot.joint_units])
        # Dry friction is left out: it has no derivative where a rate changes sign.
        own = [name.rpartition(".")[2] for name in rows.model.parameters.names]
        smooth = np.where([word in list_reversal_keys() for word in own], 0.0, values)

        def compute_efforts(q: Array | float = 0.0, qd: Array | float = 0.0, qdd: Array | float = 0.0) -> Array:
            """Compute the efforts of a motion that differs by these amounts."""
            q, qd, qdd = motion.q + q, motion.qd + qd, motion.qdd + qdd
            return rows.model.efforts(replace(motion, q=q, qd=qd, qdd=qdd), smooth)

        here, measured = compute_efforts(), s.effort
        load, square, *static = np.moveaxis(s.own, -1, 0)
        # A law that the robot has is fitted and no error.
        share = None if "load-dependent" in robot.laws else PRIOR_DEVIATIONS[LOAD]
        found: list[tuple[Suspect, Array]] = []
        for kind, units, usual, column in (
            (GAIN, [""] * len(names), PRIOR_DEVIATIONS[GAIN], measured),
            (DELAYED_EFFORTS, ["s"] * len(names), PRIOR_DEVIATIONS[DELAYED_EFFORTS], -rows.change),
            (LOAD, [""] * len(names), share, load),
            (SQUARE, [f"{e} s2/{u}2" for u, e in pairs], None, square),
            *((STATIC, efforts, None, law) for law in static),
        ):
            each = zip(names, units, eye, strict=True)
            found += [(Suspect(kind, name, unit, usual), column * e) for name, unit, e in each]
        for name, (unit, _), length, e in zip(names, pairs, lengths, eye, strict=True):
            step = DIFFERENCE_STEP * length * e
            slope = (compute_efforts(-step) - compute_efforts(step)) / (2.0 * DIFFERENCE_STEP * length)
            found.append((Suspect(OFFSET, name, unit, PRIOR_DEVIATIONS[OFFSET] * float(length)), slope))
        for j, (name, (u, effort)) in enumerate(zip(names, pairs, strict=True)):
            # The load turns the drive's outer side back by so much.
            size = DIFFERENCE_STEP * lengths[j] / max(float(np.abs(s.load[0][:, j]).max()), 1e-300)
            back = (-size * one[:, [j]] * eye[j] for one in s.load)
            unit = f"{u}/({effort})" if " " in effort else f"{u}/{effort}"
            found.append((Suspect(ELASTIC, name, unit, positive=True), (compute_efforts(*back) - here) / size))
        fast, slow = (
            compute_efforts(0.0, h * motion.qd, (2.0 * h + h**2) * motion.qdd)
            for h in (DIFFERENCE_STEP, -DIFFERENCE_STEP)
        )
        found += [
            (Suspect(GAIN, ALL_JOINTS, usual=PRIOR_DEVIATIONS[GAIN]), measured),
            (Suspect(LOAD, ALL_JOINTS, usual=share), load),
            (Suspect(SPEED, ALL_JOINTS), (fast - slow) / (2.0 * DIFFERENCE_STEP)),
        ]
        geometry = Lengths.from_robot(robot)
        return cls(
            (*(one for one, _ in found), *geometry.suspects),
            np.concatenate([np.stack([c for _, c in found], -1), geometry.columns(rows, values)], -1),
            (compute_efforts(0.0, *s.missed) - here)[..., None] * eye,
        )


def find_deviation(error: Suspect, rms: Array, size: Array) -> float:
    """Return the prior deviation of an error; one without a usual size makes up 3 % of the efforts.

    :param rms: of the error's column, (n,); ``size``: RMS of the measured efforts, (n,).
    """
    j = int(np.argmax(rms / np.maximum(size, 1e-300)))
    other = PRIOR_DEVIATIONS[OTHER] * float(size[j] / rms[j]) if rms[j] > 0.0 else 0.0
    return error.usual or other


@dataclass(frozen=True, eq=False)
class Lengths:
    """Lengths and angles of a file as suspects, by how much the file's numbers change with each.

    ``paths``: of the numbers. ``mixing``: shape (paths, suspects).
    """

    suspects: tuple[Suspect, ...]
    paths: tuple[str, ...]
    mixing: Array

    @classmethod
    def from_robot(cls, robot: Robot) -> Lengths:
        """List the file's lengths and angles; an entry of its ``uncertainty`` is one suspect."""
        known = robot.file_numbers()
        units = {p: unit for p, (_, unit) in known.items() if _PLACES.match(p)}
        paths = tuple(path for path, unit in units.items() if unit in ("m", "rad"))
        causes: list[tuple[Suspect, Mapping[str, float]]] = []
        listed = set[str]()
        for name, entry in robot.uncertainty.items():
            below = {p: v for p, v in match_numbers(name, entry, known).items() if p in paths}
            listed |= set(below)
            if below and entry.deviation is None:
                causes.append((Suspect(GEOMETRY, name, "", entry.relative, known=True), below))
            elif below:
                (path,) = below
                causes.append((Suspect(GEOMETRY, path, units[path], entry.deviation, known=True), {path: 1.0}))
        for path in paths:
            if path not in listed:
                usual = PRIOR_DEVIATIONS[GEOMETRY] * (robot.graph.size if units[path] == "m" else 1.0)
                causes.append((Suspect(GEOMETRY, path, units[path], usual, known=True), {path: 1.0}))
        mixing = np.zeros((len(paths), len(causes)))
        for k, (_, weights) in enumerate(causes):
            for path, weight in weights.items():
                mixing[paths.index(path), k] = weight
        return cls(tuple(one for one, _ in causes), paths, mixing)

    def columns(self, rows: Rows, values: Array) -> Array:
        """Differentiate the measured efforts at a recording's rows, shape (k, n, suspects).

        :param values: of all parameters of the file.
        """
        model, motion = rows.model, rows.signals.motion
        machine = _set_masses(model.robot, model.parameters, values, "inertia")
        if model.carried is None:
            machine = _set_masses(machine, model.parameters, values, "payload")
        else:
            machine = machine.numbered(_list_payload_numbers(model.carried))
        bare = machine.numbered(dict.fromkeys(_list_payload_numbers(machine), 0.0))
        held = motion.payload_fraction[:, None, None]
        away = bool((np.abs(held - 1.0) > MIN_RELATIVE_NOISE).any())
        slopes, of_bare = (
            differentiate_numbers(one, self.paths) @ self.mixing if needed else np.zeros(0)
            for one, needed in ((machine, True), (bare, away))
        )

        def block(some: slice) -> Array:
            part = motion.part(some)
            whole = torques_by_numbers(machine, *part.joints, part.wrench, slopes)
            if away:
                less = torques_by_numbers(bare, *part.joints, part.wrench, of_bare)
                whole = less + held[some] * (whole - less)
            return whole

        return evaluate_blocks(len(held), BLOCK_ROWS, block)


def _set_masses(robot: Robot, parameters: FileParameters, values: Array, kind: str) -> Robot:
    """Return the robot with fitted masses, or payload, its geometry as it is."""
    numbers: dict[str, float] = {}
    for where, group in zip(parameters.slices, parameters.groups, strict=True):
        if group.kind == kind and (values[where] != group.values).any():
            new = group.keys(values[where])
            numbers |= {join_path(key): value for key, value in new.items()}
            numbers |= {
                join_path((*key[:-2], key[-1], key[-2])): value
                for key, value in new.items()
                if isinstance(key[-1], int) and isinstance(key[-2], int)
            }
    given: dict[str, float] = {}
    for path, value in numbers.items():
        # Numbers that the file derives from others follow them.
        with suppress(ParameterError):
            robot.number(path)
            given[path] = value
    return robot.numbered(given) if given else robot


def _list_payload_numbers(robot: Robot) -> dict[str, float]:
    load = robot.payload
    numbers = {"payload.mass": float(load.mass)}
    numbers |= {f"payload.com[{i}]": float(v) for i, v in enumerate(load.com)}
    inertia = np.ndenumerate(np.asarray(load.inertia))
    return numbers | {f"payload.inertia[{i}][{j}]": float(v) for (i, j), v in inertia}


@dataclass(frozen=True, eq=False)
class Columns:
    """The model of a recording around the file: k rows, n joints, c columns.

    ``certain``: efforts by the file's values, (k, n); ``columns``: derivatives, (k, n, c).
    ``fast``, ``fast_certain``: their parts that grow with the square of the rate of time.
    ``deviation``: of the prior; ``low``, ``high``: least and greatest value, less the file's;
    ``kinds``: friction, masses, payload, offset or error, (c,) each.
    """

    rows: Rows
    certain: Array
    columns: Array
    fast_certain: Array
    fast: Array
    deviation: Array
    low: Array
    high: Array
    kinds: tuple[str, ...]
    turning: Mask
    """Friction, whose sign is that of the velocity, (c,)."""
    gains: int = 0
    """Number of gain columns, which stand last: one for each joint, and one for all joints."""

    @classmethod
    def from_rows(cls, rows: Rows) -> Columns:
        """Return the model of the recorded motion, with the usual errors."""
        numbers = _differentiate(rows, rows.table, rows.rest, rows.signals.motion)
        errors, n = Errors.from_rows(rows, rows.model.parameters.values), rows.effort.shape[1]
        size = np.maximum(np.sqrt(np.mean(rows.effort**2, 0)), 1e-300)
        rms = np.sqrt(np.mean(errors.columns**2, 0))
        gains, others = list[int](), list[int]()
        for k, one in enumerate(errors.suspects):
            if one.kind == GAIN:
                gains.append(k)
            elif one.known or (one.where != ALL_JOINTS and rms[:, k].any()):
                others.append(k)
        deviation = [PRIOR_DEVIATIONS[DELAY], *(PRIOR_DEVIATIONS[CURRENT_OFFSET] * size)]
        deviation += [find_deviation(errors.suspects[k], rms[:, k], size) for k in (*others, *gains)]
        kinds = ["error", *["offset"] * n, *["error"] * (len(others) + len(gains))]
        offsets = np.broadcast_to(np.eye(n), (*rows.effort.shape, n))
        more = np.concatenate([-rows.change[..., None], offsets, errors.columns[..., [*others, *gains]]], -1)
        scales = np.arange(len(kinds)) >= len(kinds) - len(gains)
        return replace(
            numbers,
            columns=np.concatenate([numbers.columns, more], -1),
            fast=np.concatenate([numbers.fast, 0.0 * more], -1),
            deviation=np.concatenate([numbers.deviation, deviation]),
            low=np.concatenate([numbers.low, np.where(scales, 1.0 - USUAL_SCALE, -np.inf)]),
            high=np.concatenate([numbers.high, np.where(scales, 1.0 - 1.0 / USUAL_SCALE, np.inf)]),
            kinds=(*numbers.kinds, *kinds),
            turning=np.concatenate([numbers.turning, np.zeros(len(kinds), np.bool_)]),
            gains=len(gains),
        )

    def with_motion(self, motion: Motion, turned: Array, order: Indices | None) -> Columns:
        """Return the model of another motion with the same errors.

        :param turned: 1 or -1 where the joint's velocity has the other sign, (n,). ``order``: the
            joint whose friction each joint has.
        :raises PkmTwinError: a motion that the machine cannot make.
        """
        table, rest = self.rows.model.columns(motion)
        rubs = self.rows.model.parameters.kinds == "friction"
        # The sign of a velocity is filtered as the efforts are.
        own = self.rows.table[..., rubs] * turned[:, None]
        table[..., rubs] = own if order is None else own[:, order]
        made = _differentiate(self.rows, table, rest, motion)
        columns = np.concatenate([made.columns, self.columns[..., made.columns.shape[-1] :]], -1)
        return replace(self, certain=made.certain, fast_certain=made.fast_certain, columns=columns)

    def with_friction(self, units: Array) -> Columns:
        """Return the model with more friction of each drive, of its usual size.

        :param units: efforts by a unit of each parameter, (k, n, parameters).
        """
        k, n, count = units.shape
        place = [len(self.kinds) - self.gains] * (n * count)
        told = np.sqrt(np.mean(self.certain**2, 0))[:, None]
        shown = np.maximum(np.sqrt(np.mean(units**2, 0)), 1e-300)
        table = np.einsum("knl,nm->knml", units, np.eye(n)).reshape(k, n, -1)
        return replace(
            self,
            columns=np.insert(self.columns, place, table, -1),
            fast=np.insert(self.fast, place, 0.0, -1),
            deviation=np.insert(self.deviation, place, (PRIOR_DEVIATIONS[FRICTION] * told / shown).ravel()),
            low=np.insert(self.low, place, -np.inf),
            high=np.insert(self.high, place, np.inf),
            kinds=(*self.kinds[: place[0]], *["error"] * len(place), *self.kinds[place[0] :]),
            turning=np.insert(self.turning, place, False),
        )

    @property
    def payload(self) -> Mask:
        """Columns of the payload, (c,); the first is its mass."""
        return np.array([kind == "payload" for kind in self.kinds])

    def spectra(
        self, effort: Array | None = None, inner: slice = slice(None), rate: float = 1.0, order: Indices | None = None
    ) -> Spectra:
        """Return the statistics of some rows, with other efforts, or time at another rate."""
        r, s, more = self.rows, self.rows.signals, rate**2 - 1.0
        joints = slice(None) if order is None else order
        measured = (r.effort if effort is None else effort)[:, joints]
        certain, columns = self.certain + more * self.fast_certain, self.columns + more * self.fast
        return Spectra.from_signals(Signals(certain, columns, measured, r.counts, s.noise[joints], s.band), inner)


def _differentiate(rows: Rows, table: Array, rest: Array, motion: Motion) -> Columns:
    """Return the columns of the file's numbers, of a motion."""
    p, robot = rows.model.parameters, rows.model.robot
    standing, rest_standing = rows.model.columns(replace(motion, qd=0 * motion.qd, qdd=0 * motion.qdd))
    quick = np.where(p.kinds == "friction", 0.0, table - standing)
    effort = np.maximum(np.sqrt(np.mean((rows.rest + rows.table @ p.values) ** 2, 0)), 1e-300)
    columns, fast, deviation, low = [], [], list[float](), list[float]()
    kinds, turning = list[str](), list[bool]()
    for where, group in zip(p.slices, p.groups, strict=True):
        own, inertial, values = table[..., where], quick[..., where], group.values
        count, word = len(values), group.names[0].rpartition(".")[2]
        kind: str = group.kind
        least = np.full(count, -np.inf)
        if kind == "inertia":
            # All numbers of a body together: its mass.
            own, inertial = ((one @ values)[..., None] for one in (own, inertial))
            count, kind, spread, least = 1, "masses", np.array([PRIOR_DEVIATIONS[MASS]]), np.array([-1.0])
        elif kind == "payload":
            # A payload's centre is within 40 % of the machine's size.
            reach, most = 0.4 * robot.size, max(float(p.scales[where][0]), 1e-9)
            spread = most * np.array([1.0, *[reach] * 3, *[reach**2] * 6])
            least[0] = -values[0]
        elif kind == "rotor":
            kind, least = "masses", -values
            spread = np.where(values > 0.0, PRIOR_DEVIATIONS[MASS] * values, p.scales[where])
        else:
            shown = np.sqrt(np.mean(rows.table[..., where] ** 2, 0))
            j = int(shown.max(1).argmax())
            share = PRIOR_DEVIATIONS[CURRENT_OFFSET if word.endswith("offset") else FRICTION]
            spread = share * effort[j] / np.maximum(shown[j], 1e-12 * effort[j] + 1e-300)
            least = least if word.endswith("offset") else -values
        columns.append(own)
        fast.append(inertial)
        deviation += spread.tolist()
        low += least.tolist()
        kinds += [kind] * count
        turning += [kind == "friction" and word in {*list_reversal_keys(), "viscous"}] * count
    return Columns(
        rows,
        rest + table @ p.values,
        np.concatenate(columns, -1),
        (rest - rest_standing) + quick @ p.values,
        np.concatenate(fast, -1),
        np.array(deviation),
        np.array(low),
        np.full(len(low), np.inf),
        tuple(kinds),
        np.array(turning),
    )
