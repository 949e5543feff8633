# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Drives: torque constants from motor currents, and friction from weights that hang from a drive.

With the masses known, current = (load + friction) / constant is linear in one over the constant and
in the friction in amperes, and the noise is in the current alone.

A weight is moved up and down slowly. At a steady speed the current is that of the load, plus
friction up, less friction down: half of the difference of both is friction, half of their sum the
load, by which the torque constant follows. Friction laws have the terms that the runs determine,
and are compared by what they leave of runs that they were not fitted to. Drives of one kind may be
fitted together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for
from numpy.typing import ArrayLike, NDArray

from delta_dynamics import inverse_dynamics
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.identification.compare import evaluate_loaded
from pkm_twin.identification.samples import WINDOWS, low_pass, resample_recording
from pkm_twin.machine.friction import list_friction_keys
from pkm_twin.recordings import Recording, Table
from pkm_twin.robot.robot import Robot

FIT: Final = "fit"
GRAVITY: Final = 9.80665
"""Standard gravity, m/s2."""


@dataclass(frozen=True, eq=False)
class TorqueConstants:
    """N m or N per ampere, at the joints, (n,), and their standard deviations, 0 where given."""

    values: Array
    deviations: Array

    def convert(self, recorded: Recording) -> Recording:
        """Convert a recording whose efforts are currents, A, to efforts."""
        return replace(recorded, effort=recorded.measured * self.values)

    def lines(self, robot: Robot) -> list[str]:
        """Write a line for each fitted constant."""
        rows = zip(robot.joint_names, self.values, self.deviations, robot.effort_units, strict=True)
        return [
            f"torque constant of {joint}: {value:.4g} +- {deviation:.2g} {unit}/A, from the masses of the file"
            for joint, value, deviation, unit in rows
            if deviation
        ]


def parse_constants(robot: Robot, words: str) -> TorqueConstants:
    """Parse one number, or one number a joint, separated by commas.

    :raises ParameterError: other words, or a number that is zero or not finite.
    """
    n = robot.joints_count
    try:
        values = np.array([float(word) for word in words.split(",")])
    except ValueError:
        values = np.zeros(0)
    if values.shape not in ((1,), (n,)) or not (np.isfinite(values) & (values != 0.0)).all():
        raise ParameterError("--torque-constant", words, f"{FIT}, one number, or {n} with commas")
    return TorqueConstants(np.broadcast_to(values, (n,)).copy(), np.zeros(n))


def fit_constants(robot: Robot, recordings: Sequence[Recording]) -> TorqueConstants:
    """Fit torque constants to recordings of currents, A, by the masses of the file.

    Viscous, Coulomb and load-dependent friction and an offset of the current are free beside.

    :raises PkmTwinError: recordings that do not show a constant.
    """
    values, deviations, windows = _fit_constants(robot, recordings, None)
    # The difference to the next shorter differentiation window counts as uncertainty.
    other, _, _ = _fit_constants(robot, recordings, [WINDOWS[abs(WINDOWS.index(window) - 1)] for window in windows])
    return TorqueConstants(values, np.hypot(deviations, other - values))


def _fit_constants(
    robot: Robot, recordings: Sequence[Recording], windows: Sequence[int] | None
) -> tuple[Array, Array, list[int]]:
    """Return constants, standard deviations, and the windows of the differentiation."""
    tables: list[list[Array]] = [[] for _ in robot.joint_names]
    currents: list[list[Array]] = [[] for _ in robot.joint_names]
    used = []
    for i, r in enumerate(recordings):
        window = None if windows is None else windows[i]
        pieces, how = resample_recording(r.time, r.q, r.measured, r.wrench, window=window)
        used.append(how.window)
        smooth = replace(r, robot=robot.changed(friction=dict.fromkeys(list_friction_keys(), 0.0)))
        for track in pieces:
            motion = track.q, track.qd, track.qdd, track.wrench
            load = evaluate_loaded(smooth, inverse_dynamics, track.time, *motion)
            way = np.sign(track.qd)
            columns = [load, track.qd, way, np.ones_like(load), np.abs(load) * way, track.effort]
            flat = low_pass(np.concatenate(columns, 1), track.period, how)
            parts = flat.reshape(len(flat), len(columns), -1)
            for j in range(parts.shape[2]):
                tables[j].append(parts[:, :-1, j])
                currents[j].append(parts[:, -1, j])
    found = np.zeros((2, robot.joints_count))
    for j, name in enumerate(robot.joint_names):
        if not tables[j]:
            raise PkmTwinError("the recordings are too short for a torque constant")
        table, current = np.concatenate(tables[j]), np.concatenate(currents[j])
        scale = np.maximum(np.linalg.norm(table, axis=0), 1e-300)
        inverse = np.linalg.pinv(table / scale, rcond=1e-9) / scale[:, None]
        sizes = inverse @ current
        left = current - table @ sizes
        # Neighbouring rows are not independent, so the variance is estimated by 30 blocks.
        ends = np.linspace(0, len(left), 31).astype(int).tolist()
        blocks = np.array([inverse[0, a:b] @ left[a:b] for a, b in pairwise(ends)])
        deviation = float(np.sqrt(np.sum(blocks**2)))
        if not deviation < 0.1 * abs(sizes[0]):
            raise PkmTwinError(
                f"the current of {name} does not follow the load ({sizes[0]:.3g} +- "
                f"{deviation:.2g} A per unit of it): move a known payload, or give "
                "--torque-constant"
            )
        found[:, j] = 1.0 / sizes[0], deviation / sizes[0] ** 2
    return found[0], found[1], used


@dataclass(frozen=True, eq=False)
class Law:
    """A friction law as fitted: its terms with values and standard deviations, A.

    ``residual`` and ``held_out``: rms, A, of all runs and of each run by a fit of the others.
    ``other_drives``: of each drive by a fit of the others, NaN where they do not determine it.
    """

    name: str
    terms: tuple[str, ...]
    values: Array
    deviations: Array
    residual: float
    held_out: float
    other_drives: float


@dataclass(frozen=True, eq=False)
class DriveFriction:
    """Torque constant and friction law of a drive, identified with hanging weights.

    ``torque_constant``: N m/A, with its standard deviation; ``zero``: current without load, A (an
    offset of the sensor or a preload). ``laws``: all fitted friction laws, the simplest first.
    ``chosen``: the simplest law that no additional term improves significantly. ``chance``: p-value
    of the last F test of an additional term, NaN if there was none. ``viscous_told``: True if the
    speeds differ enough to separate viscous from Coulomb friction.
    """

    torque_constant: float
    torque_constant_deviation: float
    zero: float
    laws: tuple[Law, ...]
    chosen: Law
    chance: float
    viscous_told: bool


Runs = tuple[Array, Array, Array, Array | None, Array | None]


def list_runs(table: Table, lever: float | None = None) -> Runs:
    """List torques, currents up and down, speeds and drives of a table, for :func:`drive_friction`.

    :param lever: travel per radian of the motor, m, for masses.
    :raises ParameterError: a column or the lever is missing.
    """
    table.require(["iq_up_A", "iq_down_A"])
    torque = table.get("torque_nm")
    if torque is None and "mass_kg" not in table:
        raise ParameterError(str(table.path), ", ".join(table), "a column 'mass_kg' or 'torque_nm'")
    if torque is None:
        if lever is None:
            raise ParameterError("--spool-radius", None, "m per rad, above 0, for a column mass_kg")
        torque = GRAVITY * lever * table["mass_kg"]
    return torque, table["iq_up_A"], table["iq_down_A"], table.get("speed"), table.get("drive")


def drive_friction(
    torque: ArrayLike, up: ArrayLike, down: ArrayLike, speed: ArrayLike | None = None, drive: ArrayLike | None = None
) -> DriveFriction:
    """Estimate the torque constant and the friction law of a drive, or common ones of identical drives.

    :param torque: of the weights at the motor, N m, shape (k,), at least two different ones.
    :param up: mean current while they are lifted, A; ``down``: while they are lowered. Signs as
        the drive has them.
    :param speed: of the motor, any unit; absent: the same in all runs.
    :param drive: numbers of the drives, by run; absent: the same in all runs.
    :raises ParameterError: too few runs, or currents that do not follow the weights.
    """
    load, rise, fall = (np.asarray(one, np.float64) for one in (torque, up, down))
    count = len(load)
    rate = np.ones(count) if speed is None else np.abs(np.asarray(speed, np.float64))
    which = np.zeros(count) if drive is None else np.asarray(drive, np.float64)
    every = load, rise, fall, rate, which
    if any(one.shape != (count,) for one in every):
        raise ParameterError("runs", count, "as many torques as currents up and down, and speeds")
    both = np.stack([load, np.ones(count)], -1)
    if count < 3 or not np.isfinite(every).all() or not _is_determined(both):
        raise ParameterError("runs", count, "3 or more with finite currents, at 2 weights or more")
    middle, half = 0.5 * (rise + fall), 0.5 * (rise - fall)
    (slope, zero), covariance = _solve_line(both, middle)
    if not abs(slope) > 3.0 * np.sqrt(covariance[0, 0]):
        raise ParameterError(
            "torque constant",
            f"{slope:.3g} +- {np.sqrt(covariance[0, 0]):.2g} A/(N m)",
            "currents that grow with the weights: are the columns up and down of the same run?",
        )
    constant = 1.0 / slope
    # If the current falls with the load, the drive counts it with the opposite sign.
    friction = half * np.sign(np.mean(half))
    columns = {"viscous": rate, "load-dependent": np.abs(load * slope)}
    terms = {"Coulomb": np.ones(count)}
    separable = _is_determined(np.stack([terms["Coulomb"], rate], -1))
    laws, chance = [_fit_law(terms, friction, which, separable)], np.nan
    chosen = laws[0]
    while True:
        richer = []
        for name in columns.keys() - terms.keys():
            more = {**terms, name: columns[name]}
            if count > len(more) and _is_determined(np.stack(list(more.values()), -1)):
                law = _fit_law(more, friction, which, separable)
                # The F test of one more term.
                freedoms, square = count - len(more), max(law.residual**2, 1e-300)
                ratio = freedoms * (chosen.residual**2 - law.residual**2) / square
                richer.append((float(scipy.stats.f.sf(ratio, len(more) - len(terms), freedoms)), law))
        if not richer:
            break
        chance, law = min(richer, key=lambda one: one[0])
        laws.append(law)
        if not (chance < 0.05 and law.held_out < chosen.held_out):
            break
        chosen, terms = law, {name: columns.get(name, terms["Coulomb"]) for name in law.terms}
    deviation = float(np.sqrt(covariance[0, 0]) * constant**2)
    return DriveFriction(float(abs(constant)), deviation, float(zero), tuple(laws), chosen, float(chance), separable)


def _is_determined(table: Array) -> bool:
    """Return whether the runs determine all columns' coefficients."""
    norms = np.linalg.norm(table, axis=0)
    if len(table) < table.shape[1] or not norms.all():
        return False
    return bool(np.linalg.svd(table / norms, compute_uv=False)[-1] > 0.02)


def _solve_line(table: Array, values: Array) -> tuple[Array, Array]:
    """Solve least squares; return the coefficients and their covariance from the residuals."""
    found, *_ = np.linalg.lstsq(table, values, rcond=None)
    left = values - table @ found
    freedoms = max(1, len(values) - table.shape[1])
    variance = float(left @ left) / freedoms
    return np.asarray(found, np.float64), np.asarray(variance * np.linalg.pinv(table.T @ table))


def _fit_law(terms: dict[str, Array], friction: Array, drive: Array, separable: bool) -> Law:
    table = np.stack(list(terms.values()), -1)
    found, covariance = _solve_line(table, friction)

    def missed(groups: NDArray[Any]) -> float:
        """Return the RMS error of runs as predicted by a fit without their group."""
        left = []
        for one in np.unique(groups):
            out = groups == one
            if _is_determined(table[~out]):
                left.append(friction[out] - table[out] @ _solve_line(table[~out], friction[~out])[0])
        return float(np.sqrt(np.mean(np.concatenate(left) ** 2))) if left else np.nan

    names = ["Coulomb" if separable else "Coulomb or viscous", *list(terms)[1:]]
    return Law(
        ", ".join(names),
        tuple(terms),
        found,
        np.sqrt(np.diag(covariance)),
        float(np.sqrt(np.mean((friction - table @ found) ** 2))),
        missed(np.arange(len(friction))),
        missed(drive),
    )
