# SPDX-License-Identifier: Apache-2.0
"""A drive's torque constant and friction by weights that hang from it, moved up and down slowly.

At a steady speed the current is that of the load, plus friction up, less friction down: half of the
difference of both is friction, half of their sum the load, by which the torque constant follows.
Friction laws are compared by what they leave of runs that they were not fitted to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError

LEVEL: Final = 0.05
"""Probability by chance below which a law with one number more is accepted."""
STEADY: Final = 0.02
"""Relative difference of speeds below which viscous friction cannot be told from Coulomb's."""


@dataclass(frozen=True, eq=False)
class Law:
    """A friction law as fitted: its terms with values and standard deviations, A.

    ``residual`` and ``held_out``: rms, A, of all runs and of each run by a fit of the others.
    """

    name: str
    terms: tuple[str, ...]
    values: Array
    deviations: Array
    residual: float
    held_out: float


@dataclass(frozen=True, eq=False)
class DriveFriction:
    """What weights say of a drive.

    ``torque_constant``: N m/A, with its standard deviation; ``zero``: A, current at no load (an
    offset of the sensor or a preload). ``laws``: the simplest first. ``chosen``: the simplest that
    no law with one more term is better than by evidence. ``chance``: probability that the law
    before would leave so much more than the chosen one if it were true, NaN for the simplest.
    """

    torque_constant: float
    torque_constant_deviation: float
    zero: float
    laws: tuple[Law, ...]
    chosen: Law
    chance: float
    viscous_told: bool

    def as_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "torque_constant_nm_per_a": self.torque_constant,
            "torque_constant_deviation_nm_per_a": self.torque_constant_deviation,
            "zero_current_a": self.zero,
            "chosen": self.chosen.name,
            "chance": None if np.isnan(self.chance) else self.chance,
            "viscous_distinguished": self.viscous_told,
            "laws": {
                law.name: {
                    **{
                        term: {"value": float(v), "standard_deviation": float(d)}
                        for term, v, d in zip(law.terms, law.values, law.deviations, strict=True)
                    },
                    "residual_a": law.residual,
                    "held_out_a": law.held_out,
                }
                for law in self.laws
            },
        }


def drive_friction(
    torque: ArrayLike, up: ArrayLike, down: ArrayLike, speed: ArrayLike | None = None
) -> DriveFriction:
    """Torque constant and friction law of a drive.

    :param torque: of the weights at the motor, N m, shape (k,), three different ones or more.
    :param up: mean current while they are lifted, A; ``down``: while they are lowered. Signs as
        the drive has them.
    :param speed: of the motor, any unit; absent: the same in all runs.
    :raises ParameterError: too few runs, or currents that do not follow the weights.
    """
    load, rise, fall = (np.asarray(one, np.float64) for one in (torque, up, down))
    count = len(load)
    rate = np.ones(count) if speed is None else np.abs(np.asarray(speed, np.float64))
    if not (load.shape == rise.shape == fall.shape == rate.shape == (count,)):
        raise ParameterError("runs", count, "as many torques as currents up and down, and speeds")
    if count < 3 or len(np.unique(load)) < 3 or not np.isfinite([load, rise, fall, rate]).all():
        raise ParameterError("runs", count, "finite currents at three different weights or more")
    middle, half = 0.5 * (rise + fall), 0.5 * (rise - fall)
    (slope, zero), covariance = _line(np.stack([load, np.ones(count)], -1), middle)
    if not abs(slope) > 3.0 * np.sqrt(covariance[0, 0]):
        raise ParameterError(
            "torque constant", f"{slope:.3g} +- {np.sqrt(covariance[0, 0]):.2g} A/(N m)",
            "currents that grow with the weights: are the columns up and down of the same run?",
        )  # fmt: skip
    constant = 1.0 / slope
    # A drive whose current falls with the load counts it the other way round.
    friction = half * np.sign(np.mean(half))
    current = np.abs(load * slope)
    told = float(np.ptp(rate)) > STEADY * float(rate.max())
    terms = {"Coulomb": np.ones(count)}
    if told and count > 3:
        terms["viscous"] = rate
    laws = [_law("Coulomb and viscous" if told else "Coulomb or viscous", terms, friction)]
    if count > len(terms) + 1:
        terms = {**terms, "load-dependent": current}
        laws.append(_law(f"{laws[0].name}, load-dependent", terms, friction))
    chosen, chance = laws[0], np.nan
    if len(laws) > 1:
        chance = _chance(laws[0], laws[1], count)
        if chance < LEVEL and laws[1].held_out < laws[0].held_out:
            chosen = laws[1]
    deviation = float(np.sqrt(covariance[0, 0]) * constant**2)
    return DriveFriction(
        float(abs(constant)), deviation, float(zero), tuple(laws), chosen, float(chance), told
    )


def _line(table: Array, values: Array) -> tuple[Array, Array]:
    """Least squares: numbers, and their covariance by what is left."""
    found, *_ = np.linalg.lstsq(table, values, rcond=None)
    left = values - table @ found
    freedoms = max(1, len(values) - table.shape[1])
    variance = float(left @ left) / freedoms
    return np.asarray(found, np.float64), np.asarray(variance * np.linalg.pinv(table.T @ table))


def _law(name: str, terms: dict[str, Array], friction: Array) -> Law:
    table = np.stack(list(terms.values()), -1)
    found, covariance = _line(table, friction)
    left = friction - table @ found
    others = []
    for k in range(len(friction)):
        kept = np.arange(len(friction)) != k
        others.append(friction[k] - table[k] @ _line(table[kept], friction[kept])[0])
    return Law(
        name, tuple(terms), found, np.sqrt(np.diag(covariance)),
        float(np.sqrt(np.mean(left**2))), float(np.sqrt(np.mean(np.square(others)))),
    )  # fmt: skip


def _chance(simple: Law, richer: Law, count: int) -> float:
    """Of the F test of one more term."""
    from scipy.stats import f  # type: ignore[import-untyped]

    freedoms = count - len(richer.terms)
    more = simple.residual**2 - richer.residual**2
    ratio = freedoms * more / max(richer.residual**2, 1e-300)
    return float(f.sf(ratio, len(richer.terms) - len(simple.terms), freedoms))


def lines(found: DriveFriction) -> Sequence[str]:
    """The result in plain sentences."""
    told = [
        f"torque constant {found.torque_constant:.4f} +- "
        f"{found.torque_constant_deviation:.4f} N m/A; zero current {found.zero:.3f} A"
    ]
    for law in found.laws:
        each = [
            f"{term} {value:.3f} +- {deviation:.3f}" + (" A" if term != "load-dependent" else "")
            for term, value, deviation in zip(law.terms, law.values, law.deviations, strict=True)
        ]
        told.append(
            f"{law.name}: {', '.join(each)}; residual {law.residual:.3f} A, held out "
            f"{law.held_out:.3f} A"
        )
    if not found.viscous_told:
        told.append("one speed: Coulomb and viscous friction cannot be distinguished")
    if len(found.laws) > 1:
        name = found.laws[0].name
        verdict = "rejected" if found.chosen is not found.laws[0] else "not rejected"
        told.append(f"{name} alone: {verdict} (p = {found.chance:.2g})")
    return told
