# SPDX-License-Identifier: Apache-2.0
"""Poses that no machine like the file's was in, and poses that do not fit the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, one_line
from pkm_twin.identification.calibration_state import FRAME, TARGET
from pkm_twin.identification.noise import OUTLIER, Weighed, distances

WRONG: Final = 0.02
"""Part of the machine's size that no fit may leave over: such poses are not its own."""
TWISTED: Final = 0.05
"""Angle an axis that no fit may leave over, rad: those are other angles, or other units."""
FAR: Final = 5.0
"""Prior standard deviations by which no number changes."""
MOVED: Final = 14.0
"""Squares of prior standard deviations, summed over all numbers, that another place of the
instrument must save: with sound priors six free numbers save so much in 3 of 100 cases."""
HALF: Final = 0.5
"""And the part of all squares below which they then are: an error of the model saves a few too."""
EXPLAINED: Final = 0.8
"""Part of the sum of squares below which another place of the instrument is tried."""
MOST: Final = 0.25
"""Part of the poses that may be outliers."""


class Fault(NamedTuple):
    """What is wrong with the poses, and what would be right."""

    what: str
    right: str

    def __str__(self) -> str:
        return f"poses: {self.what}; {self.right}"


class RejectedPosesError(ParameterError):
    """Poses that this machine was not in."""

    def __init__(self, fault: Fault) -> None:
        Exception.__init__(self, one_line(f"{fault}; --accept calibrates anyway", 2000))
        self.field, self.value, self.bound = "poses", fault.what, fault.right


@dataclass(frozen=True)
class Outlier:
    """A pose that does not fit the others.

    ``index``: among all poses, from 0. ``distance``: m; ``angle``: rad, None where no rotation was
    measured; ``sigmas``: over the noise.
    """

    index: int
    distance: float
    angle: float | None
    sigmas: float

    @property
    def line(self) -> int:
        """Of a table with a header line, from 1."""
        return self.index + 2


def outliers_of(parts: Sequence[Array], noise: Sequence[float]) -> tuple[Outlier, ...]:
    """Outliers among residuals (k, 3) of positions and perhaps rotations, the worst first."""
    away = distances(parts, noise)
    sizes = [np.linalg.norm(part, axis=1) for part in parts]
    found = [
        Outlier(
            k, float(sizes[0][k]), float(sizes[1][k]) if len(sizes) > 1 else None, float(away[k])
        )
        for k in np.flatnonzero(away > OUTLIER).tolist()
    ]
    return tuple(sorted(found, key=lambda one: -one.sigmas))


def faults_of(
    weighed: Weighed, outliers: Sequence[Outlier], count: int,
    changes: Sequence[tuple[str, str, float, float]], prior: float, size: float,
) -> list[Fault]:  # fmt: skip
    """Why a machine like the file's was not in so many poses.

    :param changes: of the fitted numbers: name, unit, change and prior standard deviation.
    :param prior: of lengths, m. ``size``: of the machine, m.
    """
    faults = []
    noise = weighed.noise
    most = max(prior, WRONG * size)
    if noise[0] > most:
        faults.append(
            Fault(
                f"RMS residual {noise[0]:.3g} m per axis after the fit",
                f"expected at most {most:.3g} m for poses of this machine in m and rad",
            )
        )
    steepest = max(prior / size, TWISTED)
    if len(noise) > 1 and noise[1] > steepest:
        faults.append(
            Fault(
                f"RMS residual {noise[1]:.3g} rad per axis after the fit",
                f"expected at most {steepest:.3g} rad for rotations of this machine from its "
                "home, in rad and in the order and axes of the columns",
            )
        )
    if len(outliers) > MOST * count:
        worst = outliers[0]
        faults.append(
            Fault(
                f"{len(outliers)} of {count} do not fit the others (line {worst.line} by "
                f"{1e3 * worst.distance:.3g} mm)",
                f"at most {100 * MOST:.0f} % may be outliers",
            )
        )
    machine = [one for one in changes if one[0] not in (*FRAME, *TARGET)]
    if machine:
        name, unit, change, usual = max(machine, key=lambda one: abs(one[2]) / one[3])
        if abs(change) > FAR * usual:
            faults.append(
                Fault(
                    f"{name} changes by {f'{change:.3g} {unit}'.rstrip()}, "
                    f"{abs(change) / usual:.2g} times its prior standard deviation",
                    f"at most {FAR:g} times is likely: are the poses in the base's axes and in "
                    "the file's units? A greater --prior allows more",
                )
            )
    return faults


def cost_of(changes: Sequence[tuple[str, str, float, float]]) -> float:
    """Squares of the machine's changes over their prior standard deviations, summed."""
    return sum(
        (change / usual) ** 2 for name, _, change, usual in changes if name not in (*FRAME, *TARGET)
    )


def looks_placed(table: Array, columns: Array, target: Array) -> bool:
    """Whether another place of the instrument would explain a part of what a fit leaves.

    :param table: derivatives by the fitted numbers in units of their priors, (rows, p), and by the
        instrument's place and turn, ``columns``, (rows, 6). ``target``: what is left, then what the
        priors still ask for, (rows + p,).
    """
    p = table.shape[1]
    own = np.vstack([table, np.eye(p)])
    both = np.hstack([own, np.vstack([columns, np.zeros((p, columns.shape[1]))])])
    left = [target - one @ np.linalg.lstsq(one, target, rcond=None)[0] for one in (own, both)]
    return float(left[1] @ left[1]) < EXPLAINED * float(left[0] @ left[0])


def place_fault(place: Array, turn: Array) -> Fault:
    """The poses fit where the instrument stands elsewhere: place (3,), m, and turn (3,), rad."""
    shift, angles = (
        ", ".join(f"{value + 0.0:.4f}" for value in np.round(one, 4)) for one in (place, turn)
    )
    return Fault(
        f"they fit in an instrument's frame at ({shift}) m, turned by ({angles}) rad, and not in "
        "the base's",
        "use --frame to fit the instrument's frame",
    )
