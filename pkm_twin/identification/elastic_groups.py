# SPDX-License-Identifier: Apache-2.0
"""Elastic elements that a fit cannot distinguish, and what it determines of them together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.identification.fit import SURE

PRIOR: Final = 1.0
"""An element's compliance may be off by all of its value."""
SHOWN: Final = 0.1
"""Part of the greatest weight below which an element is no part of a combination."""


@dataclass(frozen=True)
class Combination:
    """A weighted sum of elements' factors, of weights with squares that sum to 1."""

    weights: dict[str, float]
    value: float
    deviation: float


@dataclass(frozen=True)
class Group:
    """Elements that the loads do not distinguish, and what is known of them together."""

    elements: tuple[str, ...]
    known: tuple[Combination, ...]


def groups_of(
    names: Sequence[str], factors: Array, covariance: Array, wide: Array | None = None
) -> tuple[Group, ...]:
    """Elements that share a direction that is not known, and the directions that are.

    :param factors: shape (elements,). ``covariance``: of them by the noise alone, and of more
        behind them. ``wide``: with what the model does not explain; default the same.
    """
    count = len(names)
    own = covariance[:count, :count] / PRIOR**2
    full = own if wide is None else wide[:count, :count] / PRIOR**2
    values, vectors = np.linalg.eigh(own)
    unknown = vectors[:, values > SURE**2]
    shared = np.abs(unknown @ unknown.T)
    left, groups = set(np.flatnonzero(np.diag(shared) > SHOWN**2).tolist()), []
    while left:
        group, edge = set(), {min(left)}
        while edge:
            group |= edge
            edge = {j for i in edge for j in left - group if shared[i, j] > SHOWN}
        left -= group
        if len(group) > 1:
            groups.append(_group(sorted(group), names, factors, (own, full)))
    return tuple(groups)


def _group(
    members: list[int], names: Sequence[str], factors: Array, covariances: tuple[Array, Array]
) -> Group:
    own, wide = covariances
    values, vectors = np.linalg.eigh(own[np.ix_(members, members)])
    told = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value > SURE**2:
            continue
        weights = vector * np.sign(vector[np.argmax(np.abs(vector))])
        weights[np.abs(weights) < SHOWN * np.abs(weights).max()] = 0.0
        weights /= np.linalg.norm(weights)
        deviation = float(np.sqrt(weights @ wide[np.ix_(members, members)] @ weights)) * PRIOR
        told.append(
            Combination(
                {names[k]: float(w) for k, w in zip(members, weights, strict=True) if w},
                float(weights @ factors[members]), deviation,
            )
        )  # fmt: skip
    return Group(tuple(names[k] for k in members), tuple(told))
