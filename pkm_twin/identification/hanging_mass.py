# SPDX-License-Identifier: Apache-2.0
"""A drive's torque constant and friction by weights that hang from it, moved up and down slowly.

At a steady speed the current is that of the load, plus friction up, less friction down: half of the
difference of both is friction, half of their sum the load, by which the torque constant follows.
Friction laws have the terms that the runs determine, and are compared by what they leave of runs
that they were not fitted to. Drives of one kind may be fitted together.
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
SEEN: Final = 0.02
"""Part of a term that no other term has, below which the runs do not determine it."""


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
    """What weights say of a drive.

    ``torque_constant``: N m/A, with its standard deviation; ``zero``: A, current at no load (an
    offset of the sensor or a preload). ``laws``: the simplest first. ``chosen``: the simplest that
    no law with one more term is better than by evidence. ``chance``: probability that the simpler
    of the two laws that were compared last would leave so much more if it were true, NaN for none.
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
                    "held_out_drive_a": (
                        law.other_drives if np.isfinite(law.other_drives) else None
                    ),
                }
                for law in self.laws
            },
        }


def drive_friction(
    torque: ArrayLike, up: ArrayLike, down: ArrayLike, speed: ArrayLike | None = None,
    drive: ArrayLike | None = None,
) -> DriveFriction:  # fmt: skip
    """Torque constant and friction law of a drive, or of several alike.

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
    if count < 3 or not np.isfinite(every).all() or not _determined(both):
        raise ParameterError("runs", count, "3 or more with finite currents, at 2 weights or more")
    middle, half = 0.5 * (rise + fall), 0.5 * (rise - fall)
    (slope, zero), covariance = _line(both, middle)
    if not abs(slope) > 3.0 * np.sqrt(covariance[0, 0]):
        raise ParameterError(
            "torque constant", f"{slope:.3g} +- {np.sqrt(covariance[0, 0]):.2g} A/(N m)",
            "currents that grow with the weights: are the columns up and down of the same run?",
        )  # fmt: skip
    constant = 1.0 / slope
    # A drive whose current falls with the load counts it the other way round.
    friction = half * np.sign(np.mean(half))
    columns = {"viscous": rate, "load-dependent": np.abs(load * slope)}
    terms = {"Coulomb": np.ones(count)}
    told = _determined(np.stack([terms["Coulomb"], rate], -1))
    laws, chance = [_law(terms, friction, which, told)], np.nan
    chosen = laws[0]
    while True:
        richer = []
        for name in columns.keys() - terms.keys():
            more = {**terms, name: columns[name]}
            if count > len(more) and _determined(np.stack(list(more.values()), -1)):
                law = _law(more, friction, which, told)
                richer.append((_chance(chosen, law, count), law))
        if not richer:
            break
        chance, law = min(richer, key=lambda one: one[0])
        laws.append(law)
        if not (chance < LEVEL and law.held_out < chosen.held_out):
            break
        chosen, terms = law, {name: columns.get(name, terms["Coulomb"]) for name in law.terms}
    deviation = float(np.sqrt(covariance[0, 0]) * constant**2)
    return DriveFriction(
        float(abs(constant)), deviation, float(zero), tuple(laws), chosen, float(chance), told
    )


def _determined(table: Array) -> bool:
    """Whether no column is nearly a combination of the others, and there are runs enough."""
    norms = np.linalg.norm(table, axis=0)
    if len(table) < table.shape[1] or not norms.all():
        return False
    return bool(np.linalg.svd(table / norms, compute_uv=False)[-1] > SEEN)


def _line(table: Array, values: Array) -> tuple[Array, Array]:
    """Least squares: numbers, and their covariance by what is left."""
    found, *_ = np.linalg.lstsq(table, values, rcond=None)
    left = values - table @ found
    freedoms = max(1, len(values) - table.shape[1])
    variance = float(left @ left) / freedoms
    return np.asarray(found, np.float64), np.asarray(variance * np.linalg.pinv(table.T @ table))


def _law(terms: dict[str, Array], friction: Array, drive: Array, told: bool) -> Law:
    table = np.stack(list(terms.values()), -1)
    found, covariance = _line(table, friction)

    def missed(groups: Array) -> float:
        """Of runs that a fit without their group predicts."""
        left = []
        for one in np.unique(groups):
            out = groups == one
            if _determined(table[~out]):
                left.append(friction[out] - table[out] @ _line(table[~out], friction[~out])[0])
        return float(np.sqrt(np.mean(np.concatenate(left) ** 2))) if left else np.nan

    names = ["Coulomb" if told else "Coulomb or viscous", *list(terms)[1:]]
    return Law(
        ", ".join(names), tuple(terms), found, np.sqrt(np.diag(covariance)),
        float(np.sqrt(np.mean((friction - table @ found) ** 2))), missed(np.arange(len(friction))),
        missed(drive),
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
        line = f"{law.name}: {', '.join(each)}; residual {law.residual:.3f} A"
        line += f", held-out runs {law.held_out:.3f} A"
        if np.isfinite(law.other_drives):
            line += f", held-out drives {law.other_drives:.3f} A"
        told.append(line)
    if not found.viscous_told:
        told.append("one speed: Coulomb and viscous friction cannot be distinguished")
    if len(found.laws) > 1:
        verdict = "rejected" if found.chosen is found.laws[-1] else "not rejected"
        simpler = found.laws[-2].name if found.chosen is found.laws[-1] else found.chosen.name
        told.append(f"{simpler} alone: {verdict} (p = {found.chance:.2g})")
    return told
