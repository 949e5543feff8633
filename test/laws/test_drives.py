# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Drives that are off or braked are known by efforts that are zero or constant at standstill."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.streams.drives import DriveWatch, find_idle_samples

Flags = NDArray[np.bool_]

PERIOD = 2e-3
HELD = np.array([2.0, -1.0])


def phases(*parts: tuple[float, bool, Array | None]) -> tuple[Array, Flags, Array, list[slice]]:
    """Time, what stands still, efforts, and where each part is.

    :param parts: seconds, whether the joints stand, and the efforts; None is a live drive's.
    """
    rng = np.random.default_rng(1)
    still, effort, where = [], [], []
    for seconds, stands, given in parts:
        count = round(seconds / PERIOD)
        where.append(slice(len(effort), len(effort) + count))
        live = HELD + 0.01 * rng.normal(size=(count, 2))
        effort += list(live if given is None else np.broadcast_to(given, (count, 2)))
        still += count * [2 * [stands]]
    time = PERIOD * np.arange(len(effort))
    return time, np.array(still), np.array(effort), where


def followed(time: Array, still: Flags, effort: Array) -> Flags:
    watch = DriveWatch()
    return np.array([watch.push(*row, HELD) for row in zip(time, still, effort, strict=True)], bool)


ZERO = np.zeros(2)


@pytest.mark.parametrize("braked", [ZERO, np.array([0.3, 0.1]), np.array([2.0, 0.0])])
def test_efforts_that_are_zero_or_constant_at_standstill(braked: Array) -> None:
    time, still, effort, (before, during, after) = phases((1.0, False, None), (2.0, True, braked), (1.0, False, None))
    found = followed(time, still, effort)
    assert not found[before].any()
    # Zeros at once, anything else once it has been so for a tenth of a second.
    begin = 0.05 if not braked.any() else 0.13
    assert found[during][round(begin / PERIOD) :].all()
    assert not found[after][round(0.05 / PERIOD) :].any()
    whole = find_idle_samples(time, still, effort, np.broadcast_to(HELD, effort.shape))
    assert whole[during].all()
    assert whole[before].mean() < 0.05 > whole[after].mean()


def test_a_drive_that_is_on_is_on() -> None:
    """At standstill with noise; constant where it bears the weight; zero or constant in motion."""
    for part in (
        (3.0, True, None),
        (3.0, True, HELD),
        (3.0, False, ZERO),
        (3.0, False, 3.0 * HELD),
    ):
        time, still, effort, _ = phases(part)
        assert not followed(time, still, effort).any()
        assert not find_idle_samples(time, still, effort, np.broadcast_to(HELD, effort.shape)).any()


def test_noise_that_moves_a_joint_now_and_then_is_no_motion() -> None:
    time, still, effort, _ = phases((3.0, True, ZERO))
    still[50::100] = False
    assert followed(time, still, effort).all()


def test_a_brake_that_opens_or_closes_bears_a_part() -> None:
    """The drive's effort comes back, or goes, before the machine moves: left out both ways."""
    ramp = HELD * np.linspace(0.0, 1.0, round(0.2 / PERIOD))[:, None]
    time, still, effort, (_, closing, _, opening, _) = phases(
        (1.0, True, None),
        (0.2, True, ramp[::-1]),
        (1.0, True, ZERO),
        (0.2, True, ramp),
        (1.0, True, None),
    )
    inner = slice(5, -10)
    found = followed(time, still, effort)
    assert found[opening][inner].all()
    whole = find_idle_samples(time, still, effort, np.broadcast_to(HELD, effort.shape))
    assert whole[opening][inner].all()
    assert whole[closing][10:-5].all()


def test_the_beginnings_are_counted() -> None:
    time, still, effort, _ = phases((0.5, True, ZERO), (1.0, False, None), (0.5, True, ZERO), (1.0, False, None))
    watch = DriveWatch()
    for row in zip(time, still, effort, strict=True):
        watch.push(*row, HELD)
    assert watch.changes == 2
