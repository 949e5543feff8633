# SPDX-License-Identifier: Apache-2.0
"""Does the model explain the measurements? What a verdict on a fit says.

:mod:`pkm_twin.identification.judge` finds it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from pkm_twin.codegen.arrays import Array

Answer = Literal["explains", "explains partly", "does not explain"]
Deviations = Literal["as estimated", "widened", "withheld"]
SENTENCE: Final[dict[Answer, str]] = {
    "explains": "explains", "explains partly": "partly explains",
    "does not explain": "does not explain",
}  # fmt: skip


@dataclass(frozen=True)
class Suspect:
    """An error that a machine or a recording may have.

    ``kind``: in words; ``where``: a joint, a direction, or a number of the file; ``unit``: of its
    size, empty for a ratio; ``usual``: a size that is common, None where there is none; ``known``:
    it is the standard deviation, and much larger sizes explain nothing. ``positive``: no size below
    zero is possible.
    """

    kind: str
    where: str
    unit: str = ""
    usual: float | None = None
    known: bool = False
    positive: bool = False

    def __str__(self) -> str:
        return f"{self.kind} ({self.where})"


@dataclass(frozen=True)
class Finding:
    """A suspect that the residual shows: its size, standard deviation, and how clearly.

    ``others``: suspects that explain the residual nearly as well.
    """

    suspect: Suspect
    size: float
    deviation: float
    sigmas: float
    others: tuple[Suspect, ...] = ()

    def __str__(self) -> str:
        return (
            f"{self.suspect} {_sized(self.size, self.suspect.unit)} +- "
            f"{_sized(self.deviation, self.suspect.unit)}, {self.sigmas:.3g} sigma"
            + "".join(f", or {other}" for other in self.others)
        )


@dataclass(frozen=True)
class Blind:
    """A suspect of usual size that the recordings would not show, and what it would do.

    ``change``: of the fitted parameter ``index``, the one it moves by the most deviations.
    """

    suspect: Suspect
    index: int
    change: float


@dataclass(frozen=True)
class Channel:
    """A joint's, or a direction's, residual in the band of the motion.

    ``residual`` and ``noise``: rms, in the unit of the measurements; ``noise`` is what the signal
    has above the band, scaled to it. ``left``: the part of the measured variation that neither the
    fit nor a finding nor noise explains; ``left_ratio``: that residual over noise, less what chance
    may do. ``held_out``: residual of what was held out over that of what was fitted, or over noise.
    """

    name: str
    residual: float
    noise: float
    left: float
    left_ratio: float
    held_out: float


@dataclass(frozen=True, eq=False)
class Verdict:
    """Whether a model explains its recordings, by channel and by finding.

    ``hints``: suspects that the residual does not show clearly, but does not clear either.
    ``blind``: what the recordings would not show. ``shift``: what the suspects
    probably change in the fitted parameters, (p,), and ``unseen``: a factor of its covariance, rows
    whose squares sum to it, (rows, p). ``inflation``: factor on the covariance for what stays
    unexplained. ``slow``: the motion is too slow to show any inertia.
    """

    answer: Answer
    channels: tuple[Channel, ...]
    findings: tuple[Finding, ...]
    hints: tuple[Finding, ...]
    blind: tuple[Blind, ...]
    shift: Array
    inflation: float
    unseen: Array
    slow: bool = False

    def widened(self, covariance: Array) -> Array:
        """A covariance of corrected parameters (p, p), with what the model does not explain."""
        return np.asarray(self.inflation * covariance + self.unseen.T @ self.unseen, np.float64)

    @property
    def deviations(self) -> Deviations:
        """What becomes of the standard deviations."""
        if self.answer == "does not explain":
            return "withheld"
        return "widened" if self.findings or self.hints or self.inflation > 1.0 else "as estimated"

    def __str__(self) -> str:
        return f"the model {SENTENCE[self.answer]} the recordings"

    def lines(self, units: tuple[str, ...]) -> list[str]:
        """What it says beyond its answer, in plain sentences.

        :param units: of the channels' measurements.
        """
        told = [f"likely cause: {one}" for one in self.findings]
        if self.slow:
            told.append(
                "the motion is too slow to show inertia above the noise: inertia parameters are "
                "undetermined, and a wrong time scale would not show"
            )
        for channel, unit in zip(self.channels, units, strict=True):
            if channel.left_ratio > 1.0 or self.answer == "does not explain":
                told.append(
                    f"{channel.name}: residual {channel.residual:.3g} {unit} in the band of the "
                    f"motion, noise {channel.noise:.3g} {unit}; {100 * channel.left:.2g} % of the "
                    "variation has no known cause"
                )
        told += [f"not excluded: {one}" for one in self.hints]
        if self.deviations != "as estimated":
            told.append(f"standard deviations are {self.deviations}")
        return told

    def blind_lines(self, names: tuple[str, ...], units: tuple[str, ...]) -> list[str]:
        """What the recordings would not show.

        :param names: of the fitted parameters, with their ``units``.
        """
        told = []
        for one in self.blind:
            change = f"{abs(one.change):.2g} {units[one.index]}".rstrip()
            told.append(
                f"these recordings cannot show: {one.suspect}. "
                f"{_sized(one.suspect.usual or 0.0, one.suspect.unit)} of it would change "
                f"{names[one.index]} by {change}; the standard deviations include this"
            )
        return told

    def as_json(self, units: tuple[str, ...], names: tuple[str, ...]) -> dict[str, Any]:
        """Plain data.

        :param units: of the channels' measurements. ``names``: of the fitted parameters.
        """
        return {
            "model": self.answer,
            "standard_deviations": self.deviations,
            "too_slow_for_inertia": self.slow,
            "findings": [_as_json(one) for one in self.findings],
            "not_excluded": [_as_json(one) for one in self.hints],
            "would_not_show": [
                {
                    "kind": one.suspect.kind, "where": one.suspect.where,
                    "size": one.suspect.usual, "unit": one.suspect.unit,
                    "parameter": names[one.index], "change": one.change,
                }
                for one in self.blind
            ],
            "channels": [
                {
                    "name": channel.name, "unit": unit, "residual_in_band": channel.residual,
                    "noise_in_band": channel.noise, "unexplained_part": channel.left,
                    "held_out_over_fitted": channel.held_out,
                }
                for channel, unit in zip(self.channels, units, strict=True)
            ],
        }  # fmt: skip


def _sized(size: float, unit: str) -> str:
    return f"{size:.3g} {unit}" if unit else f"{100 * size:.2g} %"


def _as_json(one: Finding) -> dict[str, Any]:
    return {
        "kind": one.suspect.kind, "where": one.suspect.where, "size": one.size,
        "unit": one.suspect.unit, "standard_deviation": one.deviation, "sigmas": one.sigmas,
        "or": [{"kind": other.kind, "where": other.where} for other in one.others],
    }  # fmt: skip
