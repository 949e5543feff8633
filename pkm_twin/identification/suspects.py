# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
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
from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import ParameterError
from pkm_twin.identification.identifiable import KINDS
from pkm_twin.identification.judge import (
    ALL,
    HINT,
    NEAR,
    SIGMAS,
    VALUES,
    Evidence,
    Finding,
    Suspect,
    Verdict,
    basis_of,
    judge,
)
from pkm_twin.identification.parameters import FileParameters
from pkm_twin.identification.plausible import MASSES, scale_text
from pkm_twin.identification.rows import BLOCK, Problem, Rows
from pkm_twin.identification.samples import Resonance, by_blocks
from pkm_twin.machine.friction import turning_keys
from pkm_twin.machine.places import path_of
from pkm_twin.machine.uncertainty import numbers_below
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
OFF: Final = 0.05
"""Usual size of a gain: constants of drives and current sensors are known to some per cent."""
CLEAR: Final = 0.1
"""Standard deviation of a factor on the file's numbers from which it is known."""
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
        (GAIN, [""] * len(names), OFF, told), (LATE, ["s"] * len(names), 2e-3, -change),
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
        (Suspect(GAIN, ALL, usual=OFF), told),
        (Suspect(LATE, ALL, "s"), -change),
        (Suspect(LOAD, ALL, usual=share), load),
        (Suspect(SPEED, ALL), (fast - slow) / (2.0 * STEP)),
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
        known = robot.file_numbers()
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


OF_THE_FILE: Final = {
    "friction": "friction other than the file's",
    "rotor": "rotor inertia other than the file's",
    "payload": "payload other than the file's",
    "inertia": "mass or inertia other than the file's",
}
"""Suspects that were not fitted, by the kind of the file's numbers."""
OF_INERTIA: Final = ("rotor", "payload", "inertia")
"""Kinds of numbers that only an accelerated motion tells."""
RATE: Final = 8.0 / 3.0 * SIGMAS
"""Deviations by which the rate of time has to show. Twice the rate takes three quarters of the
efforts of inertia, 3/8 of their derivative by the rate: that is a finding's."""
INERTIA: Final = 0.1
"""And the part of the efforts' variation that is inertia: of less, other masses and offsets of the
sensors, within their priors, take up three quarters."""


def verdict_of(problem: Problem) -> Verdict:
    """Whether the fitted model explains its recordings."""
    chosen, lengths = problem.chosen, Lengths.of(problem.robot)
    court = _Court(problem, lengths)
    verdict = court.judged(chosen)
    masses = court.kinds == "inertia"
    if (chosen & masses).any():
        verdict = _simpler(verdict, court.judged(chosen & ~masses))
    if (chosen & np.isin(court.kinds, OF_INERTIA)).any() and not court.inertia_shown():
        answer = "explains partly" if verdict.answer == "explains" else verdict.answer
        verdict = replace(verdict, answer=answer, slow=True)
    named = {one.suspect.kind for one in verdict.findings}
    either = None if named & {ELASTIC, LATE} else court.late_or_elastic(chosen)
    if either is not None:
        finding, change = either
        unseen = np.concatenate([verdict.unseen, change[None]])
        verdict = replace(verdict, hints=(*verdict.hints, finding), unseen=unseen)
    rings = _resonances(problem)
    if rings:
        answer = "explains partly" if verdict.answer == "explains" else verdict.answer
        verdict = replace(verdict, answer=answer, findings=(*verdict.findings, *rings))
    return verdict


def _resonances(problem: Problem) -> tuple[Finding, ...]:
    """Of each joint the clearest of all recordings: above the band, so that no number changes."""
    robot, best = problem.robot, dict[int, Resonance]()
    for one in (ring for made in problem.whole for ring in made.signals.resonances):
        if one.joint not in best or one.sigmas > best[one.joint].sigmas:
            best[one.joint] = one
    found = []
    for j, ring in sorted(best.items()):
        where = f"{robot.joint_names[j]}, {ring.rms:.2g} {robot.effort_units[j]} rms"
        other = (Suspect(INTERFERENCE, robot.joint_names[j], "Hz"),) if ring.line else ()
        suspect = Suspect(RESONANCE, where, "Hz")
        found.append(Finding(suspect, ring.frequency, ring.width, ring.sigmas, other))
    return tuple(found)


def _simpler(verdict: Verdict, frozen: Verdict) -> Verdict:
    """Other masses, or the file's and one error? What explains as much with less is a finding too.

    :param frozen: with the file's masses.
    """
    kinds = {one.suspect.kind for one in frozen.findings}
    if verdict.findings or OF_THE_FILE["inertia"] in kinds or len(kinds) != 1:
        return verdict
    if kinds == {GEOMETRY} and len(frozen.findings) > 1:
        return verdict
    if frozen.answer != "explains partly" or any(c.left_ratio > 1.0 for c in frozen.channels):
        return verdict
    other = Suspect("the masses that were fitted", "all of them")
    findings = tuple(replace(one, others=(*one.others, other)) for one in frozen.findings)
    return replace(
        verdict, answer="explains partly", findings=findings,
        unseen=np.concatenate([verdict.unseen, frozen.shift[None] - verdict.shift]),
    )  # fmt: skip


def scaled_efforts(problem: Problem, verdict: Verdict) -> str | None:
    """Efforts that are scaled beyond what a drive's constant may be off by, in words; or None.

    A heavier machine has the friction of its file, efforts of another scale do not. Without
    friction in the file both look alike.
    """
    gains = [one for one in verdict.findings if one.suspect.kind == GAIN and one.size < 1.0]
    gains = [g for g in gains if abs(g.size) > SIGMAS * np.hypot(OFF, g.deviation)]
    if not gains:
        return None
    if set(problem.what) != set(KINDS):
        # A payload, or other masses, may be what is there.
        whole = replace(problem, what=KINDS)
        return scaled_efforts(whole, verdict_of(whole))
    factor, where = 1.0 / (1.0 - gains[0].size), gains[0].suspect.where
    if where != ALL:
        return scale_text(where, factor)
    rubs = _friction(problem)
    if rubs is not None and abs(rubs - 1.0) < abs(rubs - factor):
        return None
    others = () if rubs is not None else (MASSES.format(factor),)
    return scale_text("all joints", factor, *others)


def _friction(problem: Problem) -> float | None:
    """How many times the file's the fitted friction is; None where the recordings do not tell."""
    file, e, chosen = problem.everything.values, problem.estimate, problem.chosen
    kinds = np.array([g.kind for g in problem.everything.groups for _ in g.names])
    some = (kinds == "friction") & (file != 0.0) & chosen
    rows = np.flatnonzero(some[chosen])
    known = np.linalg.pinv(e.covariance[np.ix_(rows, rows)], hermitian=True) @ file[some]
    sure = float(known @ file[some])
    return float(known @ problem.values[some]) / sure if sure > CLEAR**-2 else None


@dataclass(frozen=True, eq=False)
class _Recording:
    """A recording at its rows: (k, n, ...) each."""

    rows: Rows
    delay: float
    columns: Array
    """By the suspects' sizes."""
    missed: Array
    calm: Array
    """All parameters' columns, without noise."""


class _Court:
    """All recordings of a fit, to be judged by several sets of parameters and suspects."""

    def __init__(self, problem: Problem, lengths: Lengths) -> None:
        self.problem, self.everything, self.values = problem, problem.everything, problem.values
        self.kinds = np.array([g.kind for g in self.everything.groups for _ in g.names])
        self.recordings: list[_Recording] = []
        self.suspects: tuple[Suspect, ...] = ()
        for rows, delay in zip(problem.whole, problem.delays, strict=True):
            errors, missed = errors_of(rows, self.values)
            own = np.stack([column for _, column in errors], -1)
            columns = np.concatenate([own, lengths.columns(rows, self.values)], -1)
            calm, _ = rows.model.columns(rows.signals.motion)
            self.recordings.append(_Recording(rows, delay, columns, missed, calm))
            self.suspects = (*(suspect for suspect, _ in errors), *lengths.suspects)

    def judged(self, free: Mask) -> Verdict:
        """With some parameters free to explain the residual, the others as the file has them."""
        kinds, file = self.kinds, self.everything
        suspects = [*self.suspects]
        suspects += [
            Suspect(OF_THE_FILE[kinds[k]], file.names[k], file.units[k])
            for k in np.flatnonzero(~free)
        ]
        cases = [self._evidence(i, free) for i in range(len(self.recordings))]
        e = self.problem.estimate
        values = np.where(free, self.values, file.values)
        prior = (
            (values - file.values)[free], e.prior[free[self.problem.chosen]],
            np.sqrt(np.diag(e.covariance)),
        )  # fmt: skip
        return judge(self.problem.robot.joint_names, suspects, cases, prior, self.problem.response)

    def late_or_elastic(self, free: Mask) -> tuple[Finding, Array] | None:
        """The delay of the efforts where elastic drives explain the residual nearly as well.

        And what these change in the fitted parameters, (f,).
        """
        which = [k for k, one in enumerate(self.suspects) if one.kind == ELASTIC]
        cases = [self._evidence(i, free) for i in range(len(self.recordings))]
        step = -(-sum(case.residual.size for case in cases) // VALUES)
        parts = []
        for i, (case, one) in enumerate(zip(cases, self.recordings, strict=True)):
            few = case.thinned(step)
            weight, change = few.weight[..., None], few.nuisance[..., :1]
            late = -change * (np.arange(len(cases)) == i)
            late_by = one.delay + one.rows.recording.late
            measured = few.residual[..., None] - late_by * change
            columns = few.explained, few.nuisance[..., 1:], late, few.suspects[..., which], measured
            whole = np.concatenate(columns, -1) * weight
            parts.append(whole.reshape(-1, whole.shape[-1]))
        fitted, width = cases[0].explained.shape[-1], parts[0].shape[1]
        known = np.eye(width)[fitted : fitted + len(self.problem.robot.joint_names)]
        table = np.concatenate([*parts, known])
        split = table.shape[1] - len(cases) - len(which) - 1
        basis = basis_of(table[:, :split])
        left = table[:, split:] - basis @ (basis.T @ table[:, split:])
        late, elastic, y = np.split(left, [len(cases), len(cases) + len(which)], 1)
        delays, gives = (np.linalg.lstsq(one, y[:, 0], rcond=None)[0] for one in (late, elastic))
        clear, other = np.linalg.norm(late @ delays), np.linalg.norm(elastic @ gives)
        chance = np.sqrt(HINT**2 + len(which) - 1)
        errors = np.linalg.norm(np.linalg.pinv(elastic), axis=1)
        if other < max(chance, NEAR * clear) or (gives < -2.0 * errors).any():
            return None
        place = int(np.argmax(np.abs(delays)))
        error = float(np.linalg.norm(np.linalg.pinv(late)[place]))
        sizes = ", ".join(
            f"{self.suspects[k].where} {give:.2g} {self.suspects[k].unit}"
            for k, give in zip(which, gives.tolist(), strict=True)
            if give > 0.0
        )
        finding = Finding(
            Suspect(LATE, ALL, "s"), float(delays[place]), error, float(clear),
            (Suspect(ELASTIC, sizes),),
        )  # fmt: skip
        signals = [case.suspects[..., which] @ gives.clip(0.0)[:, None] for case in cases]
        return finding, self.problem.response(signals)[:, 0]

    def inertia_shown(self) -> bool:
        """Whether the recordings would show time at twice or half its rate, friction being any."""
        friction = self.kinds == "friction"
        which = [one.kind for one in self.suspects].index(SPEED)
        square, part, count = 0.0, 0.0, 0.0
        for i in range(len(self.recordings)):
            case = self._evidence(i, friction)
            weight = case.weight[..., None]
            table = np.concatenate([case.explained, case.nuisance], -1) * weight
            table = table.reshape(-1, table.shape[-1])
            table = table / np.maximum(np.linalg.norm(table, axis=0), 1e-300)
            column = (case.suspects[..., which] * weight[..., 0]).ravel()
            left = column - table @ np.linalg.lstsq(table, column, rcond=None)[0]
            square += float(left @ left)
            # The derivative by the rate is twice the efforts of inertia.
            own = 0.5 * left.reshape(case.residual.shape) * case.floor
            part += float(np.sum((own / np.maximum(case.variation, 1e-300)) ** 2))
            count += float(case.counts.sum())
        return square > RATE**2 and part > INERTIA**2 * count

    def _evidence(self, i: int, free: Mask) -> Evidence:
        """Of one recording; the suspects' columns, then those of what is not free."""
        one = self.recordings[i]
        rows, effort = one.rows, one.rows.effort
        values = np.where(free, self.values, self.everything.values)
        # The sign of a rate is filtered as the efforts are.
        others = np.where(self.kinds == "friction", rows.table, one.calm)[..., ~free]
        return Evidence(
            effort - rows.rest - rows.table @ values + one.delay * rows.change,
            rows.table[..., free],
            np.concatenate([rows.change[..., None], one.missed], -1),
            np.concatenate([one.columns, others], -1),
            rows.signals.noise, rows.signals.band, rows.counts, rows.held_from,
            np.sqrt(np.mean(effort**2, 0)), np.std(effort, 0),
        )  # fmt: skip
