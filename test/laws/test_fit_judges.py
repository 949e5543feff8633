# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Fits of machines whose friction and payload are drawn at random, by maximal coordinates."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest

from pkm_twin import Robot
from pkm_twin.certify.maximal import Maximal, State
from pkm_twin.codegen.arrays import Array
from pkm_twin.identification.fit import fit
from pkm_twin.recordings import Recording
from pkm_twin.robot.robot_urdf import robot_description
from test.identification.machines import machine, noisy
from test.laws.recordings import engine_efforts
from test.laws.test_fit import truths
from test.support.robots import load

KINDS: Any = ("friction", "payload")
ROBOTS = ["delta", "delta_cu", "prru", "upr_rpu", "five_bar", "rps3"]


class Walking(Maximal):
    """The judge, each state assembled from the one before."""

    def assemble(self, q: Array) -> State:
        here: Any = self.__dict__.get("_here")
        if here is None:
            state: State | None = self._follow(q - self.machine.home)
        else:
            state, _ = self._close(here, q - self.machine.home, 0.5)
        assert state is not None
        self._state = dataclasses.replace(state, velocity=np.zeros_like(state.velocity))
        self.__dict__["_here"] = self._state
        return self._state


@cache
def drawn(name: str) -> tuple[Robot, Robot, Recording]:
    """The robot as its file has it and in truth, and a recording."""
    rng = np.random.default_rng([7, *name.encode()])
    robot = load(name)
    m = machine(robot, rng)
    efforts = engine_efforts(Walking(robot_description(m.truth)), m.q, m.qd, m.qdd)
    return robot, m.truth, Recording(robot, m.time, m.q, effort=efforts)


@pytest.mark.long
@pytest.mark.parametrize("name", ROBOTS)
def test_clean_efforts_give_what_was_drawn(name: str) -> None:
    robot, truth, recorded = drawn(name)
    true = truths(truth, KINDS)
    for number in fit(robot, [recorded], KINDS).numbers:
        error = abs(number.after - true[number.name])
        if number.status == "not excited":
            assert number.after == number.before, number.name
        elif number.name == "payload.mass":
            assert error < 0.01 * true[number.name]
        elif number.name.startswith("payload.com"):
            assert number.status == "fitted" and error < 2e-3, number.name
        elif true[number.name] > number.deviation and number.status == "fitted":
            assert error < 0.02 * true[number.name], number.name
        assert error <= 3.0 * number.deviation, number.name


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", ROBOTS)
def test_noisy_efforts_keep_every_truth_within_three_deviations(name: str) -> None:
    """In 95 of 100: 1 % noise of the efforts, an encoder with 1e5 steps a span."""
    robot, truth, recorded = drawn(name)
    true, good = truths(truth, KINDS), 0
    for seed in range(100):
        one = noisy(recorded, np.random.default_rng([seed, 5]))
        numbers = fit(robot, [one], KINDS).numbers
        good += all(abs(n.after - true[n.name]) <= 3.0 * n.deviation for n in numbers)
    assert good >= 95
