# SPDX-License-Identifier: Apache-2.0
"""The unit vector at which the largest of several quadratic forms is least.

Of up to three coordinates every point where a minimum can be is known in closed form.
"""

from __future__ import annotations

import itertools
import math
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array

MOST: Final = 3
"""Coordinates of which every minimum is known."""


def largest(forms: Array, y: Array) -> Array:
    """max_a |y' G_a y|, shape (...); forms (..., n, m, m), y (..., m)."""
    return np.asarray(np.abs(np.einsum("...i,...aij,...j->...a", y, forms, y)).max(-1), np.float64)


def least_direction(forms: Array) -> Array:
    """Unit y, shape (m,), with the least max_a |y' G_a y| of symmetric forms G, shape (n, m, m).

    For m up to 3. At a minimum one form is stationary, or two are equal but for their sign and one
    of them is stationary along the cone y' H y = 0 on which they are, or three are equal. All such
    points are known: eigenvectors; common points, in the projective plane, of the cone and the
    cubic det(y, G y, H y) = 0; common points of two cones. The best of them all is the answer, to
    rounding.
    """
    points = _candidates(forms)
    return np.asarray(points[largest(forms, points).argmin()], np.float64)


def _units(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True), np.float64)


def _candidates(forms: Array) -> Array:
    """Unit vectors, shape (k, m), among which the least one is."""
    count, size = forms.shape[:2]
    pairs = list(itertools.combinations(range(count), 2))
    cones = [(a, forms[a] - sign * forms[b]) for a, b in pairs for sign in (1.0, -1.0)]
    found = [np.eye(size), *np.linalg.eigh(forms)[1].swapaxes(-1, -2)]
    for cone in (*forms, *(cone for _, cone in cones)):
        values, vectors = np.linalg.eigh(cone)
        if values[0] < 0.0 < values[-1]:
            # Of two coordinates both lines of the cone, of three some.
            x = math.sqrt(values[-1]) * vectors[:, 0]
            z = math.sqrt(-values[0]) * vectors[:, -1]
            found.append(np.stack([x + z, x - z]))
    if size == 3:
        turned = [_TURN.T @ cone @ _TURN for _, cone in cones]
        curves = [_conic(cone) for cone in turned]
        for (a, _), cone, curve in zip(cones, turned, curves, strict=True):
            stationary = _stationary(_TURN.T @ forms[a] @ _TURN, cone)
            found.append(_common_points(curve, stationary) @ _TURN.T)
        for one, other in itertools.combinations(curves, 2):
            found.append(_common_points(one, other) @ _TURN.T)
    points = np.concatenate(found)
    # A point more does no harm: each is judged by the forms themselves.
    return _units(points[np.isfinite(points).all(-1) & points.any(-1)])


_TURN: Final = np.linalg.qr([[1.0, 0.3, -0.4], [0.2, 0.9, 0.7], [-0.5, 0.6, 1.1]])[0]
"""A rotation without meaning: planes of symmetry are then no lines u = constant, and no points
that count lie at infinity."""
_LINES: Final = np.zeros((3, 2, 2))
"""y = (1, u, v) as polynomials: entry (i, j) of each is the coefficient of u^i v^j."""
_LINES[0, 0, 0] = _LINES[1, 1, 0] = _LINES[2, 0, 1] = 1.0


def _product(p: Array, q: Array) -> Array:
    """Product of two polynomials in u and v."""
    result = np.zeros((p.shape[0] + q.shape[0] - 1, p.shape[1] + q.shape[1] - 1))
    for i, j in np.ndindex(*p.shape):
        result[i : i + q.shape[0], j : j + q.shape[1]] += p[i, j] * q
    return result


def _scaled(matrix: Array) -> Array:
    size = np.abs(matrix).max()
    return np.asarray(matrix / size if size > 0.0 else matrix, np.float64)


def _conic(h: Array) -> Array:
    """Y' H y at y = (1, u, v)."""
    rows = np.einsum("ij,juv->iuv", _scaled(h), _LINES)
    total = np.sum([_product(_LINES[i], rows[i]) for i in range(3)], axis=0)
    return np.asarray(total, np.float64)


def _stationary(g: Array, h: Array) -> Array:
    """det(y, G y, H y) at y = (1, u, v): zero where y' G y is stationary along y' H y = 0."""
    a, b = (np.einsum("ij,juv->iuv", _scaled(m), _LINES) for m in (g, h))
    result = np.zeros((4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        result += _product(_LINES[i], _product(a[j], b[k]) - _product(a[k], b[j]))
    return result


def _common_points(conic: Array, curve: Array) -> Array:
    """Points (1, u, v), shape (k, 3), of a conic, all those of another curve among them.

    u are the eigenvalues of the polynomial Sylvester matrix of both in v; v follows from the
    conic.
    """
    d, e = conic.shape[1] - 1, curve.shape[1] - 1
    n, degree = d + e, max(len(conic), len(curve)) - 1
    sylvester = np.zeros((degree + 1, n, n))
    for row in range(e):
        sylvester[: len(conic), row, row : row + d + 1] = conic[:, ::-1]
    for row in range(d):
        sylvester[: len(curve), e + row, row : row + e + 1] = curve[:, ::-1]
    first, last = np.eye(n * degree, k=n), np.eye(n * degree)
    first[-n:] = np.hstack(list(-sylvester[:-1]))
    last[-n:, -n:] = sylvester[-1]
    from scipy.linalg import eig  # type: ignore[import-untyped]

    u = eig(first, last, right=False)
    u = u[np.isfinite(u)].real
    c, b, a = (np.polynomial.polynomial.polyvander(u, len(conic) - 1) @ conic).T
    with np.errstate(all="ignore"):
        half = -(b + np.copysign(np.sqrt(np.maximum(b * b - 4 * a * c, 0.0)), b)) / 2
        v = np.concatenate([half / a, c / half])
    return np.stack([np.ones(len(v)), np.concatenate([u, u]), v], -1)
