# SPDX-License-Identifier: Apache-2.0
"""The noise of a stream's errors: learnt, and not by what stands out."""

from __future__ import annotations

import numpy as np
import pytest

from delta_dynamics.torques.uncertainty import AVERAGED, Noise

STEP = 1e-3


def learnt(errors: np.ndarray, learning: float = 0.2, clipped: float = 9.0) -> Noise:
    noise = Noise(np.zeros(errors.shape[1]), learning, clipped)
    for error in errors:
        noise.advance(STEP)
        noise.learn(error, 0.0)
    return noise


def test_the_variance_is_that_of_the_errors() -> None:
    rng = np.random.default_rng(1)
    noise = learnt(rng.normal(size=(4000, 3)) * [0.1, 1.0, 10.0])
    np.testing.assert_allclose(np.sqrt(noise.variance), [0.1, 1.0, 10.0], rtol=0.1)
    assert noise.settled


def test_what_stands_out_is_clipped_once_it_is_settled() -> None:
    """A push of hundred deviations for a tenth of a second makes little of it noise."""
    rng = np.random.default_rng(2)
    noise = learnt(rng.normal(size=(2000, 1)))
    for _ in range(100):
        noise.advance(STEP)
        noise.learn(np.array([100.0]), 0.0)
    # Each counts as at most nine times the average, over a second.
    assert noise.variance[0] < 1.3 * np.exp(8.0 * 100 * STEP / AVERAGED)
    # Before, all is noise.
    assert learnt(np.full((100, 1), 100.0)).variance[0] == pytest.approx(1e4)


def test_it_is_settled_after_its_time_and_never_below_the_least() -> None:
    noise = Noise(np.zeros(2), 0.2, 9.0)
    told = []
    for _ in range(300):
        noise.advance(STEP)
        noise.learn(np.zeros(2), 0.25)
        told.append(noise.settled)
    assert told.index(True) == pytest.approx(0.2 / STEP, abs=1)
    np.testing.assert_array_equal(noise.variance, 0.25)
