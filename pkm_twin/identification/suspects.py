# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Errors that a fit of efforts does not fit: what each would change in the measured efforts.

Errors of the drives and the recording (a gain, a delay, an offset, an elastic drive, another
friction law, another rate of time), and lengths and angles of the robot's file, which a fit takes
for certain.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from delta_dynamics.torques.derivatives import differentiate_numbers, torques_by_numbers
from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import ParameterError
from pkm_twin.identification.judge import (
    ALL_JOINTS,
    ALTERNATIVE_LOG_ODDS,
    FOUND_LOG_ODDS,
    GEOMETRY,
    SIGMAS,
    Case,
    Finding,
    Fitted,
    Suspect,
    Verdict,
    fit_and_judge,
    make_basis,
)
from pkm_twin.identification.parameters import FileParameters
from pkm_twin.identification.rows import BLOCK_ROWS, Problem, Rows
from pkm_twin.identification.samples import MIN_RELATIVE_NOISE, evaluate_blocks
from pkm_twin.machine.friction import list_reversal_keys
from pkm_twin.machine.places import join_path
from pkm_twin.machine.uncertainty import match_numbers
from pkm_twin.robot.robot import Robot

GAIN: Final = "gain of the efforts"
LATE: Final = "efforts late"
LOAD: Final = "friction that grows with the load"
SQUARE: Final = "friction that grows with the square of the speed"
STATIC: Final = "static friction above Coulomb friction"
OFFSET: Final = "sensor offset"
ELASTIC: Final = "elastic drive"
SPEED: Final = "time at another rate"
LINE: Final = "line in the spectrum"
GAIN_DEVIATION: Final = 0.05
"""Prior deviation of a gain: constants of drives and current sensors are known to some per cent."""
DELAY_DEVIATION: Final = 0.02
"""Prior deviation of the efforts' delay, s: buffers of buses and controllers."""
DIFFERENCE_STEP: Final = 1e-4
"""Step of difference quotients, rad or machine sizes."""
DEFAULT_GEOMETRY_DEVIATION: Final = 5e-3
"""Default standard deviation of a length, as a fraction of the machine's extent, and of an angle, rad.

Parts made to a drawing and assembled without calibration are within 1 %, two standard deviations."""
_PLACES: Final = re.compile(r"geometry\.|origin\[|(joints|rods)\.[^.]+\.(at|ends)\[")


Errors = list[tuple[Suspect, Array]]
"""Each with the derivative of the measured efforts by its size, (k, n)."""


def list_errors(rows: Rows, values: Array) -> tuple[Errors, Array]:
    """List the errors that every robot and recording may have, at a recording's rows.

    And what the differentiation misses, joint by joint, (k, n, n).

    :param values: of all parameters of the file.
    """
    robot, s = rows.model.robot, rows.signals
    names, efforts, motion = robot.joint_names, robot.effort_units, s.motion
    pairs = list(zip(robot.joint_units, efforts, strict=True))
    # A radian for joints that turn, the machine's size for those that slide.
    eye, lengths = np.eye(len(names)), np.array([robot.size if u == "m" else 1.0 for u in robot.joint_units])
    # Dry friction is left out: it has no derivative where a rate changes sign.
    dry = list_reversal_keys()
    own = [name.rpartition(".")[2] for name in rows.model.parameters.names]
    smooth = np.where([word in dry for word in own], 0.0, values)

    def need(q: Array | float = 0.0, qd: Array | float = 0.0, qdd: Array | float = 0.0) -> Array:
        """Compute the efforts of a motion that differs by these amounts."""
        q, qd, qdd = motion.q + q, motion.qd + qd, motion.qdd + qdd
        return rows.model.efforts(replace(motion, q=q, qd=qd, qdd=qdd), smooth)

    here, told, change = need(), s.effort, rows.change
    load, square, *static = np.moveaxis(s.own, -1, 0)
    # A law that the robot has is fitted and no error.
    share = None if "load-dependent" in robot.laws else 0.05
    found: Errors = []
    for kind, units, usual, column in (
        (GAIN, [""] * len(names), GAIN_DEVIATION, told),
        (LATE, ["s"] * len(names), 2e-3, -change),
        (LOAD, [""] * len(names), share, load),
        (SQUARE, [f"{e} s2/{u}2" for u, e in pairs], None, square),
        *((STATIC, efforts, None, law) for law in static),
    ):
        each = zip(names, units, eye, strict=True)
        found += [(Suspect(kind, name, unit, usual), column * e) for name, unit, e in each]
    for name, (unit, _), length, e in zip(names, pairs, lengths, eye, strict=True):
        step = DIFFERENCE_STEP * length * e
        apart = (need(-step) - need(step)) / (2.0 * DIFFERENCE_STEP * length)
        found.append((Suspect(OFFSET, name, unit, 0.01 * float(length)), apart))
    for j, (name, (u, effort)) in enumerate(zip(names, pairs, strict=True)):
        # The load turns the drive's outer side back by so much.
        size = DIFFERENCE_STEP * lengths[j] / max(float(np.abs(s.load[0][:, j]).max()), 1e-300)
        back = (-size * one[:, [j]] * eye[j] for one in s.load)
        unit = f"{u}/({effort})" if " " in effort else f"{u}/{effort}"
        found.append((Suspect(ELASTIC, name, unit, positive=True), (need(*back) - here) / size))
    fast, slow = (need(0.0, h * motion.qd, (2.0 * h + h**2) * motion.qdd) for h in (DIFFERENCE_STEP, -DIFFERENCE_STEP))
    found += [
        (Suspect(GAIN, ALL_JOINTS, usual=GAIN_DEVIATION), told),
        (Suspect(LOAD, ALL_JOINTS, usual=share), load),
        (Suspect(SPEED, ALL_JOINTS), (fast - slow) / (2.0 * DIFFERENCE_STEP)),
    ]
    return found, (need(0.0, *s.missed) - here)[..., None] * eye


@dataclass(frozen=True, eq=False)
class Lengths:
    """Suspects, by how much the numbers of the file change with each.

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
        told = set()
        for name, entry in robot.uncertainty.items():
            below = {p: v for p, v in match_numbers(name, entry, known).items() if p in paths}
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
                usual = DEFAULT_GEOMETRY_DEVIATION * (extent if units[path] == "m" else 1.0)
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
        held = motion.held[:, None, None]
        away = bool((np.abs(held - 1.0) > MIN_RELATIVE_NOISE).any())
        slopes, of_bare = (
            differentiate_numbers(one, self.paths) @ self.mixing if needed else np.zeros(0)
            for one, needed in ((machine, True), (bare, away))
        )

        def block(some: slice) -> Array:
            part = motion.part(some)
            told = torques_by_numbers(machine, *part.joints, part.wrench, slopes)
            if away:
                less = torques_by_numbers(bare, *part.joints, part.wrench, of_bare)
                told = less + held[some] * (told - less)
            return told

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
    if not numbers:
        return robot
    return robot.numbered({path: v for path, v in numbers.items() if _is_given(robot, path)})


def _is_given(robot: Robot, path: str) -> bool:
    """Return whether the file has the number and does not derive it from others."""
    try:
        robot.number(path)
    except ParameterError:
        return False
    return True


def _list_payload_numbers(robot: Robot) -> dict[str, float]:
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


def judge_problem(problem: Problem) -> Verdict:
    """Fit the chosen numbers of a problem, and judge whether the model explains its recordings."""
    robot, everything, values = problem.robot, problem.everything, problem.values
    chosen, lengths = problem.chosen, Lengths.from_robot(robot)
    kinds = np.array([g.kind for g in everything.groups for _ in g.names])
    cases, errors = list[Case](), list[Suspect]()
    for rows in problem.whole:
        usual, missed = list_errors(rows, values)
        # The columns of numbers that are not fitted are those of a motion without noise; the sign
        # of a velocity is filtered as the efforts are.
        calm, _ = rows.model.columns(rows.signals.motion)
        others = np.where(kinds == "friction", rows.table, calm)[..., ~chosen]
        own = np.stack([column for _, column in usual], -1)
        errors = [*(error for error, _ in usual), *lengths.suspects]
        columns = np.concatenate([own, lengths.columns(rows, values), others], -1)
        delay = np.concatenate([-rows.change[..., None], missed], -1)
        sizes = np.append(DELAY_DEVIATION, np.ones(missed.shape[-1]))
        cases.append(
            Case(
                rows.effort - rows.rest - rows.table @ everything.values,
                rows.table[..., chosen],
                delay,
                sizes,
                columns,
                rows.effort,
                rows.counts,
                rows.signals.noise,
                rows.signals.band,
                rows.held_from,
            )
        )
    errors += [
        Suspect(OF_THE_FILE[kinds[k]], everything.names[k], everything.units[k]) for k in np.flatnonzero(~chosen)
    ]
    verdict, fitted = fit_and_judge(robot.joint_names, errors, cases, problem.both.prior[: chosen.sum()])
    slow = bool((chosen & np.isin(kinds, ("rotor", "payload", "inertia"))).any()) and not _shows_inertia(
        cases, errors, kinds[chosen] == "friction"
    )
    verdict = replace(verdict, slow=slow)
    if (chosen & (kinds == "inertia")).any() and not verdict.findings:
        verdict = _compare_file_masses(verdict, fitted, kinds[chosen] == "inertia")
    if not {one.suspect.kind for one in verdict.findings} & {ELASTIC, LATE}:
        verdict = _compare_elastic_drives(verdict, fitted)
    # Of each joint the clearest line: above the band, so that no number changes.
    lines = sorted((one for rows in problem.whole for one in rows.signals.lines), key=lambda one: one.sigmas)
    told = []
    for j, line in sorted({one.joint: one for one in lines}.items()):
        where = f"{robot.joint_names[j]}, {line.rms:.2g} {robot.effort_units[j]} rms"
        told.append(Finding(Suspect(LINE, where, "Hz"), line.frequency, line.resolution, line.sigmas))
    verdict = replace(verdict, findings=(*verdict.findings, *told))
    if (slow or told) and verdict.answer == "explains":
        verdict = replace(verdict, answer="explains partly")
    return verdict


def _compare_file_masses(verdict: Verdict, fitted: Fitted, masses: Mask) -> Verdict:
    """Name one error beside the fitted masses where it explains as much with the file's masses.

    Any scale of the efforts is one of them.
    """
    certain = fitted.certain.copy()
    certain[: fitted.count][masses] = False
    other = copy(fitted)
    scale = [one.kind == GAIN and one.where == ALL_JOINTS for one in fitted.errors].index(True)
    factors = np.ones(len(certain))
    factors[fitted.count + scale] = 1.0 / GAIN_DEVIATION
    other.whole = fitted.whole.widened(factors)
    selected, used = other.select(certain)
    if len(selected) != 1 or selected[0].odds < FOUND_LOG_ODDS:
        return verdict
    log = other.whole.log_evidence(used) - FOUND_LOG_ODDS
    if log < fitted.whole.log_evidence(fitted.used) - ALTERNATIVE_LOG_ODDS:
        return verdict
    found = fitted.describe(other.whole.posterior(used), selected[0])
    alike = Suspect("the masses that were fitted", "all of them")
    change = fitted.model.posterior(used).mean[: fitted.count] - verdict.change
    return replace(
        verdict,
        answer="explains partly",
        findings=(replace(found, others=(*found.others, alike)),),
        covariance=verdict.covariance + np.outer(change, change),
    )


def _compare_elastic_drives(verdict: Verdict, fitted: Fitted) -> Verdict:
    """Name elastic drives beside a delay of all efforts where they explain as much."""
    delays = [place[fitted.count + len(fitted.errors)] for place in fitted.places]
    elastic = [fitted.count + k for k, one in enumerate(fitted.errors) if one.kind == ELASTIC]
    late = fitted.used
    stiff = late.copy()
    stiff[delays] = False
    other = fitted.with_columns(stiff, elastic)
    logs = [fitted.whole.log_evidence(one) for one in (late, other, stiff)]
    if logs[1] < max(logs[0] - ALTERNATIVE_LOG_ODDS, logs[2]):
        return verdict
    one, two = (fitted.whole.posterior(used) for used in (late, other))
    gives, errors = two.mean[elastic], np.sqrt(np.diag(two.covariance)[elastic])
    if (gives < -2.0 * errors).any():
        return verdict
    sizes = ", ".join(
        f"{fitted.errors[k - fitted.count].where} {give:.2g} {fitted.errors[k - fitted.count].unit}"
        for k, give in zip(elastic, gives.tolist(), strict=True)
        if give > 0.0
    )
    place = max(delays, key=lambda k: abs(one.mean[k]))
    size, deviation = float(one.mean[place]), float(np.sqrt(one.covariance[place, place]))
    hint = Finding(Suspect(LATE, ALL_JOINTS, "s"), size, deviation, abs(size) / deviation, (Suspect(ELASTIC, sizes),))
    change = (two.mean - one.mean)[: fitted.count]
    return replace(
        verdict,
        hints=(*verdict.hints, hint),
        covariance=verdict.covariance + np.outer(change, change),
    )


def _shows_inertia(cases: Sequence[Case], errors: Sequence[Suspect], friction: Mask) -> bool:
    """Return whether the recordings show time at twice or half its rate, friction being any."""
    which = [one.kind for one in errors].index(SPEED)
    square, part, count = 0.0, 0.0, 0.0
    for case in cases:
        floor = np.maximum(case.noise, MIN_RELATIVE_NOISE * np.sqrt(np.mean(case.measured**2, 0)))
        weight = case.counts[..., None] / np.maximum(floor, 1e-300)[:, None]
        table = np.concatenate([case.fitted[..., friction], case.own], -1) * weight
        basis = make_basis(table.reshape(-1, table.shape[-1]))
        column = (case.errors[..., which] * weight[..., 0]).ravel()
        left = column - basis @ (basis.T @ column)
        square += float(left @ left)
        # The derivative by the rate is twice the efforts of inertia.
        own = 0.5 * left.reshape(case.target.shape) * floor
        part += float(np.sum((own / np.maximum(np.std(case.measured, 0), 1e-300)) ** 2))
        count += float(case.counts.sum())
    # Twice the rate takes three quarters of the efforts of inertia, 3/8 of their derivative by the
    # rate. Of less than a tenth of the efforts other masses and offsets take that up.
    return square > (8.0 / 3.0 * SIGMAS) ** 2 and part > 0.1**2 * count
