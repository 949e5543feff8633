# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Numerical closures, rank and mobility of a graph at home and near it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final
from weakref import WeakValueDictionary

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import Numbers
from pkm_twin.kinematics.iterations import RELATIVE_RANK_TOLERANCE, newton
from pkm_twin.kinematics.motion import Motion, Row, closure_jacobians, to_floats
from pkm_twin.machine.graph import Graph
from pkm_twin.machine.tree import Tree

SAMPLES: Final = 6
"""Number of states near home, in addition to home, in which pivots must not be small."""
SAMPLE_RADIUS: Final = 0.6
"""Largest distance of samples from home, rad or halves of the machine's size, so that pivots that
vanish near home are found."""


@dataclass(frozen=True)
class Mobility:
    """Degrees of freedom of a graph at home, and its closures.

    ``freedoms``: of the whole machine. ``rank``: of all closures. ``redundant``: number of closures
    minus their rank. ``parts``: cut joints and rods with dependent closures. ``unknowns``: number
    of the tree's unknown rates.
    """

    freedoms: int
    closures: int
    rank: int
    redundant: int
    parts: tuple[str, ...]
    unknowns: int


class Linkage:
    """Evaluate a graph's spanning tree and closures numerically (``Traced``: symbolically)."""

    def __init__(self, graph: Graph, first: tuple[str, ...] = ()) -> None:
        self.graph, self.tree = graph, Tree(graph, first=first)

    @property
    def joints(self) -> int:
        """Number of actuated joints that lead: all, unless drives are redundant."""
        return len(self.graph.leads)

    def evaluate_state(self, x: Numbers, q: Numbers) -> tuple[Motion, list[Row]]:
        """Return the motion and the closures in a state, evaluated numerically."""
        motion = Motion(self.tree, x, q)
        return motion, motion.closures()

    def scaled_jacobians(self, rows: Sequence[Row]) -> tuple[Array, Array]:
        """Return the dimensionless derivatives of closures by u and by qd."""
        ju, jq = (to_floats(m) for m in closure_jacobians(self.tree, rows))
        left = np.array([row.scale for row in rows]).reshape(-1, 1)
        drives = np.array([self.drive_scale(name) for name in self.graph.leads])
        return left * ju / np.array(self.tree.scales), left * jq / drives

    def drive_scale(self, name: str) -> float:
        """Return the factor that makes a joint's rate dimensionless."""
        return 1.0 / self.tree.size if self.graph.joints[name].slides else 1.0

    def close(self, q: Numbers, start: Numbers | None = None) -> Array | None:
        """Solve for the unknowns of a state near a known one; None if they are not found."""
        scales = np.array(self.tree.scales)

        def evaluate_closures(x: Numbers) -> tuple[Array, Array]:
            _, rows = self.evaluate_state(x, q)
            values = np.array([row.scale * float(row.value) for row in rows])
            return values, self.scaled_jacobians(rows)[0]

        def move(x: Numbers, step: Array) -> Array:
            return np.array(Motion(self.tree, x, q).retract(x, step / scales), float)

        x = np.array(self.tree.home if start is None else start, float)
        if not self.evaluate_state(x, q)[1]:
            return x
        x, closed = newton(x, evaluate_closures, move)
        return x if closed else None

    @cached_property
    def samples(self) -> list[tuple[Array, Array]]:
        """States (x, q) at home and near it, the same for all machines of a geometry, in every run."""
        graph, home = self.graph, self.graph.lead_home
        first = _firsts.setdefault(graph.key, self)
        if first is not self:
            return first.samples
        # Loading a machine builds a second linkage after the choice of pose coordinates.
        keep_linkage(self)
        states = [(np.array(self.tree.home, float), home)]
        random = np.random.default_rng(0)
        slides = np.array([graph.joints[name].slides for name in graph.leads])
        reach = np.where(slides, self.tree.size / 2, 1.0) * SAMPLE_RADIUS
        for _ in range(4 * SAMPLES):
            if len(states) > SAMPLES:
                break
            way = random.uniform(-1.0, 1.0, len(home)) * reach
            x: Array | None = states[0][0]
            for part in (0.5, 1.0):
                x = None if x is None else self.close(home + part * way, x)
            if x is not None:
                states.append((x, home + way))
            else:
                reach = reach * 0.8
        return states

    @cached_property
    def _sampled_jacobians(self) -> tuple[Array, Array]:
        """Dimensionless derivatives of closures by u and qd at the samples, (k, rows, ...)."""
        pairs = [self.scaled_jacobians(self.evaluate_state(x, q)[1]) for x, q in self.samples]
        return np.array([a for a, _ in pairs]), np.array([b for _, b in pairs])

    @cached_property
    def parts(self) -> list[str]:
        """The joint or rod of every closure."""
        return [row.part for row in self.evaluate_state(self.tree.home, self.graph.lead_home)[1]]

    def scaled_at_home(self) -> tuple[Array, Array]:
        """Return the scaled derivatives of the closures at home by u and by qd."""
        return self.scaled_jacobians(self.evaluate_state(self.tree.home, self.graph.lead_home)[1])

    def regular_state(self) -> tuple[Motion, Array]:
        """Return a sampled state of the highest rank, with the scaled derivatives by u."""
        k = int(np.argmax([count_rank(ju) for ju in self._sampled_jacobians[0]]))
        return self.evaluate_state(*self.samples[k])[0], np.asarray(self._sampled_jacobians[0][k], np.float64)

    @cached_property
    def mobility(self) -> Mobility:
        """Freedoms, rank and redundancy at home."""
        _, rows = self.evaluate_state(self.tree.home, self.graph.lead_home)
        both = np.hstack(self.scaled_jacobians(rows))
        rank = count_rank(both)
        parts: tuple[str, ...] = ()
        if rank < len(rows):
            left = np.linalg.svd(both)[0][:, rank:]
            used = np.abs(left).max(1) > 1e-6
            parts = tuple(dict.fromkeys(r.part for r, u in zip(rows, used, strict=True) if u))
        unknowns = self.tree.unknown_rates
        return Mobility(unknowns + self.joints - rank, len(rows), rank, len(rows) - rank, parts, unknowns)


def count_rank(matrix: Array) -> int:
    """Return the number of singular values above :data:`RELATIVE_RANK_TOLERANCE`."""
    if not matrix.size:
        return 0
    s = np.linalg.svd(matrix, compute_uv=False)
    return int((s > RELATIVE_RANK_TOLERANCE * max(1.0, float(s[0]))).sum())


_firsts: Final[WeakValueDictionary[str, Linkage]] = WeakValueDictionary()
"""The first linkage of each graph that is still referenced."""
_recent: Final[deque[Linkage]] = deque(maxlen=16)
"""Linkages kept alive, so that a file that is loaded again uses the same engine."""


def keep_linkage(linkage: Linkage) -> None:
    """Keep a linkage alive until 16 others were used."""
    if linkage not in _recent:
        _recent.append(linkage)
