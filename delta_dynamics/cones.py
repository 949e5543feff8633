# SPDX-License-Identifier: Apache-2.0
"""The least of the largest of several quadratic forms over all directions, by branch and bound.

A cone of directions y = V' w, w >= 0, is spanned by m unit vectors, the rows of V. With weights u,
sum |u_a| <= 1, the matrix P = V (sum u_a G_a - t) V' bounds: where no entry of it is below zero,
max_a |y' G_a y| >= y' (sum u_a G_a) y >= t y' y in the whole cone (the Bernstein form of a
quadratic over a simplex). Which weights do is a small linear program, solved for thousands of cones
at once by an interior point method (Mehrotra, SIAM J. Optim. 2(4), 1992); whatever it gives is
checked by the entries themselves. A cone that none do for is halved across its longest edge.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import SearchError

RESOLUTION: Final = 1e-6
"""How much lower, of itself, a value may be that is not looked for."""
FLOOR: Final = 1e-12
"""The same of the forms' greatest entry: rounding."""
MOST: Final = 300_000
"""Cones that are looked at before the search is given up."""
_ROUND: Final = 2000
"""Cones that are bounded at once."""
_TURNS: Final = 30
"""Most steps of the interior point method; it ends in 10 to 20."""
_NEAR: Final = 1.3
"""A descent begins from values up to so many times the least known one."""


def largest(forms: Array, y: Array) -> Array:
    """max_a |y' G_a y|, shape (...); forms (..., n, m, m), y (..., m)."""
    return np.asarray(np.abs(np.einsum("...i,...aij,...j->...a", y, forms, y)).max(-1), np.float64)


def lowest(forms: Array, best: Array, descend: Callable[[Array], Array]) -> Array:
    """Unit y, shape (m,), with the least max_a |y' G_a y| of symmetric forms G, shape (n, m, m).

    Proven: no direction's value is lower by more than RESOLUTION of it and FLOOR of the forms'
    greatest entry.

    :param best: the lowest direction that is known; ``descend``: to a local minimum below one.
    :raises SearchError: not proven within MOST cones.
    """
    size = forms.shape[-1]
    unit = forms / max(float(np.abs(forms).max()), 1e-300)
    least = float(largest(unit, best))
    # Both ends of a line are one direction: half of the orthants.
    turns = itertools.product((1.0, -1.0), repeat=size - 1)
    cones = np.array([np.diag([1.0, *signs]) for signs in turns])
    seen = 0
    if _is_lowest(unit, best, _goal(least)):
        return best
    while len(cones):
        if seen > MOST:
            raise SearchError("the least over all directions", seen, MOST)
        part, cones = cones[-_ROUND:], cones[:-_ROUND]
        seen += len(part)
        middle = part.sum(1)
        middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
        values = largest(unit, middle)
        if values.min() < _NEAR * least:
            y = descend(middle[values.argmin()])
            value = float(largest(unit, y))
            if value < least:
                best, least = y, value
        goal = _goal(least)
        if goal <= 0.0:
            break
        cones = np.concatenate([cones, _halved(part[_open(unit, part, goal)])])
    return best


def _goal(least: float) -> float:
    return (1.0 - RESOLUTION) * least - FLOOR


def _is_lowest(forms: Array, y: Array, goal: float) -> bool:
    """Whether a minimum's own multipliers prove it in all directions at once.

    sum u_a G_a y = t y there; no eigenvalue of that sum below the goal is proof. There is such
    proof for one form and for two (Brickman, Proc. Amer. Math. Soc. 12, 1961), for more often.
    """
    # Here, as it is half of what a node's start would take.
    from scipy.optimize import nnls  # type: ignore[import-untyped]

    values = np.einsum("i,aij,j->a", y, forms, y)
    active = np.abs(values) >= (1.0 - RESOLUTION) * np.abs(values).max()
    signed = np.sign(values[active])[:, None, None] * forms[active]
    across = signed @ y - np.abs(values[active])[:, None] * y
    # The last row, that they sum to one, is met by scaling.
    weights, _ = nnls(np.vstack([across.T, np.ones(len(signed))]), np.append(0.0 * y, 1.0))
    total = weights.sum()
    if not total > 0.0:
        return goal <= 0.0
    return bool(np.linalg.eigvalsh(np.tensordot(weights / total, signed, 1))[0] >= goal)


def _halved(cones: Array) -> Array:
    """Each cone, shape (k, m, m), as two, across its longest edge."""
    rows, size = np.arange(len(cones)), cones.shape[-1]
    # The least cosine is that of the longest edge; those of a vertex with itself are one.
    i, j = np.divmod((cones @ cones.swapaxes(-1, -2)).reshape(-1, size * size).argmin(-1), size)
    middle = cones[rows, i] + cones[rows, j]
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    halves = np.stack([cones, cones])
    halves[0, rows, i] = middle
    halves[1, rows, j] = middle
    return np.asarray(halves.reshape(-1, size, size), np.float64)


def _open(forms: Array, cones: Array, goal: float) -> Mask:
    """In which cones a value below the goal cannot be ruled out, shape (k,)."""
    upper = np.triu_indices(cones.shape[-1])
    # Entries of V G V' by form, and of V V' times the goal, by pair of vertices.
    bent = cones[:, None] @ forms @ cones[:, None].swapaxes(-1, -2)
    entries = bent[..., upper[0], upper[1]]
    floor = goal * (cones @ cones.swapaxes(-1, -2))[:, upper[0], upper[1]]
    single = np.maximum(
        (entries - floor[:, None]).min(-1), (-entries - floor[:, None]).min(-1)
    ).max(-1)
    undecided = single < 0.0
    undecided[undecided] = _without_weights(entries[undecided], floor[undecided])
    return np.asarray(undecided, np.bool_)


class _Program:
    """Many small linear programs: the greatest v with entries' u - floor >= v and sum |u| <= 1.

    Unknowns x = (u, v), rows M x + s = h, multipliers z; s and z above zero, M x + s = h from the
    start on.
    """

    def __init__(self, entries: Array, floor: Array) -> None:
        count, forms, pairs = entries.shape
        signs = np.array(list(itertools.product((1.0, -1.0), repeat=forms)))
        self.entries, self.floor, self.pairs = entries, floor, pairs
        self.rows = np.zeros((count, pairs + len(signs), forms + 1))
        self.rows[:, :pairs, :forms] = -entries.swapaxes(-1, -2)
        self.rows[:, :pairs, forms] = 1.0
        self.rows[:, pairs:, :forms] = signs
        self.x = np.zeros((count, forms + 1))
        self.x[:, forms] = -floor.max(-1) - 1.0
        limits = np.concatenate([-floor, np.ones((count, len(signs)))], -1)
        self.s = limits - np.einsum("kij,kj->ki", self.rows, self.x)
        self.z = np.full_like(self.s, 1.0 / self.s.shape[-1])

    def keep(self, which: Mask) -> None:
        """Go on with these alone."""
        for name in ("entries", "floor", "rows", "x", "s", "z"):
            setattr(self, name, getattr(self, name)[which])

    def turn(self) -> None:
        """One step, predicted and corrected."""
        rows, s, z = self.rows, self.s, self.z
        wanted = np.zeros(rows.shape[-1])
        wanted[-1] = 1.0
        slack = np.einsum("kij,ki->kj", rows, z) - wanted
        matrix = (rows * (z / s)[..., None]).swapaxes(-1, -2) @ rows
        diagonal = np.einsum("kii->ki", matrix)
        diagonal *= 1.0 + 1e-14

        def step(target: Array) -> tuple[Array, Array, Array]:
            right = -slack - np.einsum("kij,ki->kj", rows, target / s - z)
            dx = np.linalg.solve(matrix, right[..., None])[..., 0]
            ds = -np.einsum("kij,kj->ki", rows, dx)
            return dx, ds, (target - z * ds) / s - z

        dx, ds, dz = step(np.zeros_like(s))
        gap = (s * z).mean(-1, keepdims=True)
        left = ((s + _length(s, ds) * ds) * (z + _length(z, dz) * dz)).mean(-1, keepdims=True)
        dx, ds, dz = step((left / gap) ** 3 * gap - ds * dz)
        along, across = _length(s, ds), _length(z, dz)
        self.x, self.s, self.z = self.x + along * dx, s + along * ds, z + across * dz

    def verdicts(self) -> tuple[Mask, Mask]:
        """Whose weights do, and for whom there are none."""
        u = self.x[:, :-1]
        u = u / np.maximum(1.0, np.abs(u).sum(-1, keepdims=True))
        least = (np.einsum("kap,ka->kp", self.entries, u) - self.floor).min(-1)
        # Any mixture of the pairs bounds what weights can reach.
        mixture = self.z[:, : self.pairs]
        reach = np.abs(np.einsum("kap,kp->ka", self.entries, mixture)).max(-1)
        return least >= 0.0, reach < np.einsum("kp,kp->k", self.floor, mixture)


def _length(values: Array, steps: Array) -> Array:
    """How far values may go along steps and stay above zero, shape (k, 1), at most one."""
    with np.errstate(all="ignore"):
        room = np.where(steps < 0.0, -values / steps, np.inf).min(-1, keepdims=True)
    return np.asarray(np.minimum(1.0, 0.99 * room), np.float64)


def _without_weights(entries: Array, floor: Array) -> Mask:
    """For which cones no weights are found, shape (k,): entries (k, n, pairs), floor (k, pairs)."""
    found = np.zeros(len(entries), np.bool_)
    left = np.arange(len(entries))
    program = _Program(entries, floor)
    for _ in range(_TURNS):
        if not len(left):
            break
        program.turn()
        good, hopeless = program.verdicts()
        found[left[good]] = True
        more = ~(good | hopeless) & np.isfinite(program.x).all(-1)
        program.keep(more)
        left = left[more]
    return np.asarray(~found, np.bool_)
