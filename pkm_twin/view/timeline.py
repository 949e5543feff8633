# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A recorded bag as a time line: poses, measured efforts and the torques of the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError
from pkm_twin.paths.along import compute_model_efforts
from pkm_twin.recordings import Recording
from pkm_twin.robot.plausibility import why_no_torques

MAX_CURVE_POINTS: Final = 800
"""Largest number of drawn points per curve."""


@dataclass(frozen=True, eq=False)
class Instant:
    """One sample of a recording: q (n,); the model's (``twin``) and measured efforts (n,), N m or N.

    An effort is None if unknown: no masses, no efforts in the bag, or an incomplete window of
    differentiation.
    """

    index: int
    time: float
    q: Array
    wrench: Array | None
    twin: Array | None
    measured: Array | None

    @property
    def residual(self) -> Array | None:
        """Measured minus model efforts, shape (n,)."""
        if self.twin is None or self.measured is None:
            return None
        return self.measured - self.twin


@dataclass(frozen=True, eq=False)
class Timeline:
    """A recording with the model's efforts, ``twin``.

    ``time`` (k,), s since the first sample; ``q`` (k, n); ``twin`` (k, n), NaN where unknown;
    ``measured`` (k, n) and ``wrench`` (k, 6, base axes) if recorded. ``why``: why there are no
    model efforts; empty if there are.
    """

    time: Array
    q: Array
    twin: Array | None
    measured: Array | None
    wrench: Array | None
    why: str

    @classmethod
    def from_recording(cls, recording: Recording) -> Timeline:
        """Compute the model's efforts along a recording.

        :raises UnreachableError: a joint state in which the machine cannot be assembled.
        :raises SingularityError: a joint state at a singularity.
        """
        why = why_no_torques(recording.robot)
        twin: Array | None = None
        try:
            motion = None if why else recording.with_rates()
        except PkmTwinError as error:
            motion, why = None, str(error)
        if motion is not None:
            twin = np.full_like(recording.q, np.nan)
            twin[np.isin(recording.time, motion.time)] = compute_model_efforts(motion)
        return cls(recording.time, recording.q, twin, recording.effort, recording.wrench, why)

    @property
    def end(self) -> float:
        """Time of the last sample, s."""
        return float(self.time[-1])

    def sample_at(self, time: float) -> Instant:
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

    def sample_curves(self) -> tuple[Array, Array, Array | None]:
        """Return times (j,), model and measured efforts (j, n) of at most MAX_CURVE_POINTS samples.

        Samples without model efforts are left out.
        """
        if self.twin is None:
            return np.zeros(0), np.zeros((0, self.q.shape[1])), None
        known = np.flatnonzero(~np.isnan(self.twin).any(1))
        rows = known[:: max(1, -(-len(known) // MAX_CURVE_POINTS))]
        return (self.time[rows], self.twin[rows], None if self.measured is None else self.measured[rows])
