# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A recorded bag as a time line: poses, measured efforts and the torques of the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError
from pkm_twin.paths.along import model_efforts
from pkm_twin.recordings import Recording
from pkm_twin.robot.plausibility import why_no_torques

POINTS: Final = 800
"""Points of a curve that are drawn."""


@dataclass(frozen=True, eq=False)
class Instant:
    """One sample: q (n,); twin and measured effort and their difference (n,), N m or N.

    ``None`` is not known: no masses, no efforts in the bag, or a window that is not full here.
    """

    index: int
    time: float
    q: Array
    wrench: Array | None
    twin: Array | None
    measured: Array | None

    @property
    def residual(self) -> Array | None:
        """Measured less the twin's, shape (n,)."""
        if self.twin is None or self.measured is None:
            return None
        return self.measured - self.twin


@dataclass(frozen=True, eq=False)
class Timeline:
    """time (k,) s since the first sample; q (k, n); twin (k, n), NaN where it is not known.

    ``measured`` (k, n) and ``wrench`` (k, 6, base axes) where the bag has them. ``why``: why there
    are no torques of the twin; empty where there are.
    """

    time: Array
    q: Array
    twin: Array | None
    measured: Array | None
    wrench: Array | None
    why: str

    @classmethod
    def of(cls, recording: Recording) -> Timeline:
        """Return the time line of a recording.

        :raises UnreachableError: a joint state that the machine cannot be assembled in.
        :raises SingularityError: one in a singularity.
        """
        why = why_no_torques(recording.robot)
        twin: Array | None = None
        try:
            motion = None if why else recording.with_rates()
        except PkmTwinError as error:
            motion, why = None, str(error)
        if motion is not None:
            twin = np.full_like(recording.q, np.nan)
            twin[np.isin(recording.time, motion.time)] = model_efforts(motion)
        return cls(recording.time, recording.q, twin, recording.effort, recording.wrench, why)

    @property
    def end(self) -> float:
        """Time of the last sample, s."""
        return float(self.time[-1])

    def at(self, time: float) -> Instant:
        """Return the sample that is nearest to a time, s."""
        right = int(np.clip(np.searchsorted(self.time, time), 0, len(self.time) - 1))
        left = max(0, right - 1)
        k = left if time - self.time[left] < self.time[right] - time else right
        twin = None if self.twin is None or np.isnan(self.twin[k]).any() else self.twin[k]
        return Instant(
            k,
            float(self.time[k]),
            self.q[k],
            None if self.wrench is None else self.wrench[k],
            twin,
            None if self.measured is None else self.measured[k],
        )

    def curves(self) -> tuple[Array, Array, Array | None]:
        """Return times (j,), the twin's and the measured efforts (j, n) where the twin has any.

        No more than POINTS of them, evenly taken.
        """
        if self.twin is None:
            return np.zeros(0), np.zeros((0, self.q.shape[1])), None
        known = np.flatnonzero(~np.isnan(self.twin).any(1))
        rows = known[:: max(1, -(-len(known) // POINTS))]
        return (self.time[rows], self.twin[rows], None if self.measured is None else self.measured[rows])
