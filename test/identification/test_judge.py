# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Errors of usual size that a residual shows in part: how far the fitted numbers may be off."""

from __future__ import annotations

import numpy as np
import pytest

from pkm_twin.identification.judge import Case, fit_and_judge
from pkm_twin.identification.verdict import Suspect, Verdict
from test.support.robots import partly_long

ROWS, CHANNELS, FITTED, ERRORS = 300, 2, 3, 12


def judged(
    explained: np.ndarray, columns: np.ndarray, usual: np.ndarray, measured: np.ndarray
) -> tuple[Verdict, np.ndarray, np.ndarray]:
    """A fit with noise of deviation 1: its verdict, and least squares without the errors."""
    inverse = np.linalg.pinv(explained.reshape(-1, explained.shape[-1]))
    found, covariance = inverse @ measured.ravel(), inverse @ inverse.T
    both, ones = np.concatenate([explained, columns], -1), np.ones((ROWS, CHANNELS))
    case = Case(0.0 * measured, both, measured, ones, np.ones(CHANNELS), 1.0, np.zeros(0), ROWS)
    suspects = [Suspect("length", str(k), "m", float(u), known=True) for k, u in enumerate(usual)]
    verdict, _ = fit_and_judge(["a", "b"], suspects, [case], np.full(explained.shape[-1], 1e3))
    return verdict, covariance, found


def drawn(rng, scale: float) -> tuple[Verdict, np.ndarray, np.ndarray]:
    """A fit of numbers that are zero, from measurements with errors.

    :param scale: of what the errors do over the noise.
    """
    explained = rng.normal(size=(ROWS, CHANNELS, FITTED))
    # Of the errors some look like what is fitted, some are seen, and some are alike.
    columns = scale * rng.normal(size=(ROWS, CHANNELS, ERRORS))
    columns[..., :4] = explained @ rng.normal(size=(FITTED, 4)) + 0.02 * columns[..., :4]
    columns[..., 4] = columns[..., 5] + 0.01 * columns[..., 6]
    usual = rng.uniform(0.5, 2.0, ERRORS)
    noise = rng.normal(size=(ROWS, CHANNELS))
    return judged(explained, columns, usual, noise + columns @ (usual * rng.normal(size=ERRORS)))


@pytest.mark.parametrize("scale", partly_long([0.01, 0.1, 1.0], 1.0))
def test_what_errors_of_usual_size_do_is_within_the_deviations(scale: float) -> None:
    errors, plain = [], []
    for seed in range(60):
        verdict, covariance, off = drawn(np.random.default_rng([seed, 3]), scale)
        errors.append(np.abs(verdict.change) / np.sqrt(np.diag(verdict.covariance)))
        plain.append(np.abs(off) / np.sqrt(np.diag(covariance)))
    assert np.mean(np.array(errors) < 3.0) > 0.98
    # And not wider than they have to be.
    assert np.median(errors) > 0.1
    assert np.median(plain) > 3.0 or scale < 1.0


def test_an_error_far_beyond_its_usual_size_is_no_explanation() -> None:
    """Of two that look alike, the one that would have to be a thousand times as large is not it."""
    rng = np.random.default_rng(4)
    one, explained = rng.normal(size=(ROWS, CHANNELS)), rng.normal(size=(ROWS, CHANNELS, 1))
    columns = np.stack([one, 1e-3 * one], -1)
    measured = rng.normal(size=(ROWS, CHANNELS)) + one
    verdict, *_ = judged(explained, columns, np.ones(2), measured)
    (finding,) = verdict.findings
    assert finding.suspect.where == "0" and not finding.others
    assert abs(finding.size - 1.0) < 4.0 * finding.deviation
