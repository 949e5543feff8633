# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Verdict on a model and its recordings: what a fit found, in numbers and in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import one_line

Answer = Literal["explains", "explains partly", "does not explain"]
Deviations = Literal["as estimated", "widened", "withheld"]
MAX_NOISE_RATIO: Final = 1.5
"""Largest ratio of residual to noise, in the band of the motion, that noise alone explains."""
ALL_JOINTS: Final = "all joints"
"""Place of an error that all joints share."""
GEOMETRY: Final = "geometry"
"""Kind of the errors of lengths and angles."""
LINE: Final = "line in the spectrum"
"""Kind of the findings above the band of the motion."""
USUAL_SCALE: Final = 1.22
"""Scale, or its inverse, up to which a drive's constant is usual: 4.5 deviations of 5 %."""
MAX_DELAY: Final = 0.05
"""Delay of efforts that a recording may have, s: buffers of a bus and a filter."""
EFFORT_UNITS: Final = {"N mm or mN m": 1e3, "kgf or kgf m": 1.0 / 9.80665}
"""Units of efforts that messages name: how many of each are a newton or a newton metre."""


@dataclass(frozen=True)
class Suspect:
    """An error that a machine or a recording may have.

    ``kind``: in words; ``where``: a joint, a direction, or a number of the file; ``unit``: of its
    size, empty for a ratio; ``usual``: its prior standard deviation, None where there is none;
    ``known``: every machine has it, as no length is exact. ``positive``: no size below zero is
    possible.
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

    ``sigmas``: of the residual; no more than of the size, which other findings make less sure.
    ``others``: suspects that explain the residual nearly as well.
    """

    suspect: Suspect
    size: float
    deviation: float
    sigmas: float
    others: tuple[Suspect, ...] = ()

    def __str__(self) -> str:
        unit, both = self.suspect.unit, (self.size, self.deviation)
        size, deviation = (f"{one:.3g} {unit}" if unit else f"{100 * one:.2g} %" for one in both)
        others = "".join(f", or {other}" for other in self.others)
        return f"{self.suspect} {size} +- {deviation}, {self.sigmas:.3g} sigma{others}"

    def as_json(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "kind": self.suspect.kind,
            "where": self.suspect.where,
            "size": self.size,
            "unit": self.suspect.unit,
            "standard_deviation": self.deviation,
            "sigmas": self.sigmas,
            "or": [{"kind": other.kind, "where": other.where} for other in self.others],
        }


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
    """Answer whether a model explains its recordings, with the posterior of the fitted numbers.

    ``hints``: errors that are as likely as not. ``change``: posterior mean of the numbers less the
    prior's mean, (p,). ``plain``: their covariance by noise alone, with the errors that were found;
    ``covariance``: with all errors that may be present, (p, p). ``slow``: the motion is too slow to
    show any inertia.
    """

    answer: Answer
    channels: tuple[Channel, ...]
    findings: tuple[Finding, ...]
    hints: tuple[Finding, ...]
    change: Array
    plain: Array
    covariance: Array
    slow: bool = False

    @property
    def deviations(self) -> Deviations:
        """Report of the standard deviations: as estimated, widened, or withheld."""
        if self.answer == "does not explain":
            return "withheld"
        loud = any(channel.left_ratio > MAX_NOISE_RATIO for channel in self.channels)
        return "widened" if self.findings or self.hints or loud else "as estimated"

    def __str__(self) -> str:
        words = "partly explains" if self.answer == "explains partly" else self.answer
        return f"the model {words} the recordings"

    def list_sentences(self, units: tuple[str, ...]) -> list[str]:
        """List the sentences that explain the answer: causes, residuals and what is not excluded.

        :param units: units of the channels' measurements.
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

    def as_json(self, units: tuple[str, ...]) -> dict[str, Any]:
        """Return plain data for JSON.

        :param units: of the channels' measurements.
        """
        return {
            "model": self.answer,
            "standard_deviations": self.deviations,
            "too_slow_for_inertia": self.slow,
            "findings": [one.as_json() for one in self.findings],
            "not_excluded": [one.as_json() for one in self.hints],
            "channels": [
                {
                    "name": channel.name,
                    "unit": unit,
                    "residual_in_band": channel.residual,
                    "noise_in_band": channel.noise,
                    "unexplained_part": channel.left,
                    "held_out_over_fitted": channel.held_out,
                }
                for channel, unit in zip(self.channels, units, strict=True)
            ],
        }


def is_usual_scale(scale: float) -> bool:
    """Return whether efforts of a scale can be a machine's: it is nearly right."""
    return 1.0 / USUAL_SCALE < scale < USUAL_SCALE


def write_unreachable(error: Exception) -> str:
    """Describe positions that the machine cannot take, by its error."""
    return one_line(f"{error} (positions of this machine, in rad and m?)")


def write_late(names: str, late: float) -> str:
    """Describe efforts that are late or early against the positions."""
    return f"efforts of {names} are {abs(late):.2g} s {'late' if late > 0 else 'early'}"


def write_scale(names: str, scale: float, *others: str) -> str:
    """Describe efforts that are a constant factor off, and the other causes that would explain it."""
    sign = " and of the wrong sign" if scale < 0.0 else ""
    alike = "".join(f"; or {other}" for other in others)
    alike += ", the recording cannot tell" if others else ""
    unit = "".join(f" ({name}?)" for name, size in EFFORT_UNITS.items() if 0.9 < abs(scale) / size < 1.1)
    return (
        f"efforts of {names} are {abs(scale):.3g} times what the robot's file makes of the motion"
        f"{sign}: units? N m and N{unit}" + alike
    )


def join_names(names: Sequence[str], count: int) -> str:
    """Return joint names as text: "all joints" if they are all ``count`` of them."""
    return "all joints" if len(names) == count > 1 else " and ".join(names)
