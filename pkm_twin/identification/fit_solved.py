# SPDX-License-Identifier: Apache-2.0
"""The least-squares problem of a fit: parameters of all recordings, and a delay of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.identification.estimation import Estimate, estimate
from pkm_twin.identification.file_parameters import FileParameters
from pkm_twin.identification.fit_rows import LATE, Rows, prior_scales

HELD_OUT: Final = 1 / 3
"""Part of each recording, its end, that is judged and not fitted."""


def held_from(rows: Rows) -> int:
    """The first row that is held out."""
    return round((1.0 - HELD_OUT) * len(rows.time))


@dataclass(frozen=True, eq=False)
class Solved:
    """An estimate of the parameters, and how late the efforts of each recording are, s.

    ``whole``: of parameters and delays; ``table``: their columns, (samples, n, parameters and
    delays), the fitted rows of all recordings one after the other, ``counts`` of each.
    """

    whole: Estimate
    table: Array
    counts: tuple[int, ...]

    @property
    def estimate(self) -> Estimate:
        """Of the parameters alone."""
        e, k = self.whole, self.table.shape[-1] - len(self.counts)
        return replace(
            e, values=e.values[:k], covariance=e.covariance[:k, :k], prior=e.prior[:k],
            inverse=e.inverse[:k, :k],
        )  # fmt: skip

    @property
    def delays(self) -> tuple[float, ...]:
        """Of the recordings, s."""
        return tuple(self.whole.values[self.table.shape[-1] - len(self.counts) :].tolist())

    def response(self, signals: Sequence[Array]) -> Array:
        """What signals (k, n, m) beside the efforts change in the parameters, (p, m)."""
        used = [one[:count] for one, count in zip(signals, self.counts, strict=True)]
        moved = self.whole.response(self.table, np.concatenate(used))
        return moved[: self.table.shape[-1] - len(self.counts)]


def solve(parameters: FileParameters, rows: Sequence[Rows]) -> Solved:
    """Of the parameters, and how late the efforts of each recording are."""
    used = [made.part(slice(0, held_from(made))) for made in rows]
    table, target, rest, counts = (
        np.concatenate([getattr(made, name) for made in used])
        for name in ("table", "target", "rest", "counts")
    )
    scales = prior_scales(parameters, table, target + rest)
    # Late by a delay is less the delay times the change.
    late = [
        np.concatenate(
            [-made.change if i == j else 0.0 * made.change for j, made in enumerate(used)]
        )
        for i in range(len(used))
    ]
    whole = np.concatenate([table, np.stack(late, -1)], -1)
    found = estimate(
        whole, target, np.append(parameters.values, np.zeros(len(used))),
        np.append(scales, [LATE * made.period for made in used]), parameters.cones, counts,
    )  # fmt: skip
    return Solved(found, whole, tuple(len(made.time) for made in used))
