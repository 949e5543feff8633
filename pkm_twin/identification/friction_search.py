# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Search what efforts are not linear in: a Stribeck speed, a cogging's period, a presliding distance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.judge import SIGMAS, make_basis
from pkm_twin.identification.rows import Problem
from pkm_twin.identification.samples import filtered
from pkm_twin.machine.friction import KNOWN_FRACTION, LAWS, Dahl

STRIBECK_SPEEDS: Final = np.geomspace(0.01, 1.0, 17)
"""Candidate Stribeck speeds, as multiples of the RMS speed."""
MIN_PERIODS: Final = 3.0
"""Smallest number of periods within the travel: a slower effort may be another gravity or load."""
PRESLIDING_DISTANCES: Final = np.geomspace(1e-4, 0.1, 24)
"""Candidate presliding distances, as fractions of the travel."""


@dataclass(frozen=True)
class Searched:
    """A nonlinear parameter of a friction law, with its standard deviation, (n,) each.

    ``others``: the standard deviations that it causes in the law's other parameters, by key, (n,).
    The phase of a cogging, for example, follows its period at the far end of the travel.
    """

    value: Array
    deviation: Array
    others: dict[str, Array]


class LawSearch:
    """Search a law's nonlinear parameter in the residual of a fit without the law.

    :param name: of a law, which has one nonlinear parameter, ``key``, or none.
    """

    def __init__(self, before: Problem, name: str) -> None:
        self.robot, self.law = before.robot, LAWS[name]
        self.key = next((key for key, one in self.law.parameters.items() if not one.linear), "")
        self._linear = {key: one for key, one in self.law.parameters.items() if one.linear}
        self._rows = before.rows
        parts = [rows.fitted for rows in self._rows]
        pieces = [t for rows in self._rows for t in rows.tracks]
        q, qd = (np.concatenate([getattr(t, word) for t in pieces]) for word in ("q", "qd"))
        self._speed, self._travel = np.sqrt(np.mean(qd**2, 0)), np.ptp(q, axis=0)
        counts = np.concatenate([some.counts for some in parts])
        if self.law.memory:
            # Hysteresis shows after reversals; samples whose friction state is unknown are left out.
            most = PRESLIDING_DISTANCES[-1] * self._travel
            unknown = self._filter(lambda q, rates: Dahl.states(q, rates, most).unknown)
            counts = (unknown < KNOWN_FRACTION).astype(np.float64)
        noise = [np.broadcast_to(some.signals.noise, some.target.shape) for some in parts]
        self._weight = counts / np.maximum(np.concatenate(noise), 1e-300)
        self._left = np.concatenate([some.target for some in parts]) * self._weight
        self._basic = []
        for j, joint in enumerate(self.robot.joint_names):
            # The parameters fitted before may have absorbed a part of the law's efforts.
            own = before.columns[:, j] * self._weight[:, j, None]
            if self.law.memory:
                own = np.delete(own, before.parameters.names.index(f"{joint}.coulomb"), -1)
            self._basic.append(make_basis(own))
        cutoffs = [rows.how.cutoff for rows in self._rows if rows.how.cutoff is not None]
        fastest = self._travel * min(cutoffs, default=np.inf) / np.maximum(self._speed, 1e-300)
        self._waves = np.minimum(200.0, fastest)

    def _filter(self, columns: Callable[[Array, Array], Array], *, whole: bool = False) -> Array:
        """Evaluate columns, (samples, n, c), along the tracks and filter them to the rows.

        :param whole: all rows, else those that are fitted.
        """
        made = []
        for rows in self._rows:
            parts = [{"": columns(t.q, t.find_certain_rates(rows.how))} for t in rows.tracks]
            made.append(filtered(parts, rows.period, rows.how)[""][: None if whole else rows.held_from])
        return np.concatenate(made)

    def _evaluate(self, grid: Array, q: Array, rates: Array) -> Array:
        """Return a unit of each linear parameter at values of the nonlinear one, (samples, n, values x linear)."""
        made = []
        for values in grid:
            for word in self._linear:
                given = {self.key: values} | {k: np.full(len(values), float(k == word)) for k in self._linear}
                made.append(self.law.along(given, q, rates))
        return np.stack(made, -1)

    def columns(self, value: Array) -> Array:
        """Return the efforts of a unit of each linear parameter, at all rows, shape (k, n, linear).

        :param value: nonlinear parameter of each joint, (n,).
        """
        return self._filter(lambda q, rates: self._evaluate(value[None], q, rates), whole=True)

    def list_candidates(self) -> Array:
        """List values of the nonlinear parameter that are compared, shape (candidates, n)."""
        factors, scale = (
            1.0 / np.linspace(MIN_PERIODS, max(float(self._waves.max()), 2.0 * MIN_PERIODS), 800),
            self._travel,
        )
        if self.law.memory:
            factors = PRESLIDING_DISTANCES
        elif self.law.parameters[self.key].unit.endswith("/s"):
            factors, scale = STRIBECK_SPEEDS, self._speed
        return np.asarray(np.outer(factors, np.maximum(scale, 1e-12)), np.float64)

    def find(self, *, judged: bool = False) -> dict[str, Searched]:
        """Return the nonlinear parameter by its key; none if the law is linear.

        :param judged: whether a memory has to be clear, joint by joint.
        :raises PkmTwinError: the residual shows no value.
        """
        if not self.key:
            return {}
        grid = self.list_candidates()
        gains = np.concatenate([self._compute_gains(grid[a : a + 24])[0] for a in range(0, len(grid), 24)])
        best = gains.argmax(0)
        joints = np.arange(gains.shape[1])
        seen = gains[best, joints] > 0.0
        if judged:
            # Coulomb friction without one is the other hypothesis.
            without = self._compute_gains(np.zeros((1, len(joints))))[0][0]
            seen = gains[best, joints] - without > SIGMAS**2
        if not seen.any():
            where = " at reversals: slow ones show it" if judged else ""
            raise PkmTwinError(f"no sign of {self.law.name} friction{where}")
        low = np.log(grid[np.maximum(best - 1, 0), joints])
        high = np.log(grid[np.minimum(best + 1, len(grid) - 1), joints])
        low, high = np.minimum(low, high), np.maximum(low, high)
        part = (np.sqrt(5.0) - 1.0) / 2.0
        for _ in range(14):
            pair = np.stack([high - part * (high - low), low + part * (high - low)])
            left, right = self._compute_gains(np.exp(pair))[0]
            high = np.where(left > right, pair[1], high)
            low = np.where(left > right, low, pair[0])
        middle = 0.5 * (low + high)
        step = np.full(len(middle), 0.02)
        if not self.law.turns:
            # A phase change of at most 15 % of a period at the far end of the travel.
            step = np.minimum(step, 0.15 * np.exp(middle) / np.maximum(self._travel, 1e-12))
        gains, sizes = self._compute_gains(np.exp(middle + step * np.array([[0.0], [1.0], [-1.0]])))
        here, up, down = gains
        bend = np.maximum(2.0 * here - up - down, 1e-300) / step**2
        value = np.exp(middle)
        if judged:
            value = np.where(seen, value, getattr(self.robot.friction, self.key))
        relative = np.minimum(np.sqrt(2.0 / bend), 10.0)
        slopes = np.abs(sizes[1] - sizes[2]) * (relative / (2.0 * step))[:, None]
        return {self.key: Searched(value, value * relative, dict(zip(self._linear, slopes.T, strict=True)))}

    def _compute_gains(self, grid: Array) -> tuple[Array, Array]:
        """Return how far each value of the nonlinear parameter, (g, n), reduces chi square, (g, n).

        Also the law's linear parameters fitted with each value, (g, n, linear).
        """
        n, linear = self.robot.joints_count, [*self._linear.values()]
        table = self._filter(lambda q, rates: self._evaluate(grid, q, rates)) * self._weight[..., None]
        table = table.reshape(*table.shape[:2], len(grid), len(linear))
        gains, sizes = np.zeros((len(grid), n)), np.zeros((len(grid), n, len(linear)))
        for j in range(n):
            basis, left = self._basic[j], self._left[:, j]
            left = left - basis @ (basis.T @ left)
            for g in range(len(grid)):
                own = table[:, j, g] - basis @ (basis.T @ table[:, j, g])
                size, *_ = np.linalg.lstsq(own, left, rcond=1e-9)
                good = all(one.low is None or s >= 0.0 for s, one in zip(size, linear, strict=True))
                sizes[g, j] = size
                gains[g, j] = float(left @ (own @ size)) if good else 0.0
        return gains, sizes
