# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Waiting: a condition's last word counts, whatever the clock says."""

import pytest

from test.support import waiting
from test.support.waiting import wait_until


def test_what_is_true_after_the_time_is_true(monkeypatch):
    """As where the machine held the process up: the clock jumps far beyond the end."""
    clock = iter((0.0, 1.0, 1e6))
    monkeypatch.setattr(waiting.time, "monotonic", lambda: next(clock))
    looks = iter((0, "so"))
    assert wait_until(lambda: next(looks), lambda: None, 10.0, "x") == "so"


def test_what_never_comes_is_a_failure_that_names_it(monkeypatch):
    clock = iter((0.0, 1.0, 11.0))
    monkeypatch.setattr(waiting.time, "monotonic", lambda: next(clock))
    with pytest.raises(AssertionError, match="not within 10 s: the answer"):
        wait_until(lambda: False, lambda: None, 10.0, "the answer")
