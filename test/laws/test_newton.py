# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Newton's method and its verdict, on one equation x x = q: the rules of docs/engine.md."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
import pytest

from pkm_twin.codegen import expressions as ex
from pkm_twin.codegen.program import STATE, Equations, Program, previous_input_name
from pkm_twin.errors import PkmTwinError
from pkm_twin.kinematics.iterations import newton, solve_damped
from test.support.bodies import PlainKernel

INPUTS = ("q", "start", "near", "foreseen", "pace", "scale", "gap", "side")
STEPPED, ALIVE = 2, 5
"""Places of the step's length and of the verdict in the state of Newton's method."""


@dataclass(frozen=True)
class Kind:
    """Where the first step begins: at home, at a closed form, at a guess; or at a stream's last."""

    start: str
    stream: bool


def program(kind):
    """The equation; its corrections, determinant, residual and branch can be spoilt by inputs."""
    tape = ex.Tape()
    given = {name: tape.input(name, 0) for name in INPUTS}
    x, q = tape.input("x", 0), given["q"]
    correction = given["pace"] * (x * x - q) / (x + x)
    onward = x + (x - tape.input(previous_input_name("x"), 0)) * tape.input(STATE, STEPPED)
    miss = x * x - q + given["gap"]
    equations = Equations(
        target="q",
        home=[tape.constant(1.0)],
        origin=[tape.constant(1.0)],
        start=None if kind.start == "home" else [given["start"]],
        guessed=kind.start == "guess",
        onward=[onward],
        corrected=[x - correction],
        size=correction * correction,
        determinant=x * given["scale"],
        residual=miss * miss,
        branch=[given["side"]],
        near=given["near"] if kind.stream else None,
        foreseen=[given["foreseen"]] if kind.stream else (),
    )
    return PlainKernel(Program(dict.fromkeys(INPUTS, 1), 0, {"y": [x]}, [equations]))


def solved(kind, steps, q, start, near, foreseen, pace, scale, gap, side):
    """By the rules: x, or NaN; and the part of the way that is sound."""
    ways = [1.0 - (1.0 - k / steps) ** 3 for k in range(steps + 1)]
    margin = 0.0 if steps > 1 or kind.start == "form" else 5.0
    x, before, first = 1.0, 1.0, inf
    for k in range(1, steps + 1):
        target = q if k == steps else 1.0 + ways[k] * (q - 1.0)
        if k > 1:
            ratio = (ways[k] - ways[k - 1]) / (ways[k - 1] - ways[k - 2])
            x, before = x + ratio * (x - before), x
        elif kind.stream and near:
            x, first = foreseen, 0.01
        else:
            if kind.start == "guess" or (kind.start == "form" and steps == 1):
                x = start
            if kind.start != "form" and steps == 1:
                first = 0.3
            elif kind.start == "guess":
                first = 0.1
        longest = first
        for _ in range(12):
            correction = pace * (x * x - target) / (2.0 * x)
            least = max(1e-8, margin * abs(correction))
            if not (abs(correction) < longest and x * scale > least):
                return np.nan, ways[k - 1]
            x, longest = x - correction, 0.25 * abs(correction)
            if abs(correction) <= 1e-8:
                break
        else:
            return np.nan, ways[k - 1]
    held = abs(x * x - q + gap) < 1e-10 and side > 0.0
    return (x if held else np.nan), 1.0


def drawn(rng, count):
    """Near and far targets, starts about the root or about its negative, on both sides of rules."""
    q = np.where(rng.random(count) < 0.7, 10.0 ** rng.uniform(-1.0, 1.0, count), rng.normal(size=count))
    q = np.where(rng.random(count) < 0.1, 10.0 ** rng.uniform(-17.0, -1.0, count), q)
    root = np.sqrt(np.abs(q))
    about = [root * (1.0 + rng.normal(size=count) * 10.0 ** rng.uniform(-4, 0, count)) for _ in "12"]
    usual = rng.random((5, count)) < 0.8
    pace = np.where(usual[0], 1.0, 1.0 + rng.choice([-1.0, 1.0], count) * rng.uniform(0.1, 0.35, count))
    scale = np.where(usual[1], 1.0, 10.0 ** rng.uniform(-10.0, 0.0, count))
    gap = np.where(usual[2], 0.0, 10.0 ** rng.uniform(-11.0, -9.0, count))
    side = np.where(usual[3], 1.0, rng.choice([-1.0, 0.0, 1e-12], count))
    near = (rng.random(count) < 0.5).astype(float)
    return np.column_stack([q, about[0], near, about[1], pace, scale, gap, side])


@pytest.mark.parametrize("steps", [1, 4, 16])
@pytest.mark.parametrize("start", ["home", "form", "guess"])
@pytest.mark.parametrize("stream", [False, True])
def test_a_sample_is_valid_by_the_rules_alone(start, stream, steps, rng):
    kind = Kind(start, stream)
    rows = drawn(rng, 1500)
    (found,), status = program(kind).run([column[:, None] for column in rows.T], steps)
    right = np.array([solved(kind, steps, *row) for row in rows.tolist()])
    np.testing.assert_array_equal(status[:, 0], np.isnan(right[:, 0]))
    np.testing.assert_allclose(found[:, 0], right[:, 0], 1e-12)
    np.testing.assert_allclose(status[:, 1], right[:, 1], 1e-15)
    # Many of both.
    good = status[:, 0] == 0.0
    assert 0.02 < good.mean() < 0.98


@pytest.mark.parametrize(("name", "index"), [("z", 0), ("q", 1)])
def test_a_program_reads_inputs_of_its_own_alone(name, index):
    tape = ex.Tape()
    with pytest.raises(PkmTwinError, match=rf"reads {name}\[{index}\]"):
        Program({"q": 1}, 0, {"y": [tape.input("q", 0) + tape.input(name, index)]})


@pytest.mark.parametrize(
    ("values", "closed"),
    [
        pytest.param(lambda x: x * x - 2.0, True, id="a simple root"),
        pytest.param(lambda x: (x - 1.5) ** 2, False, id="a double root, where steps halve at best"),
        pytest.param(lambda x: x * x + 1.0, False, id="no root"),
        pytest.param(lambda x: x / 0.0, False, id="values that are not finite"),
    ],
)
def test_newton_on_numbers_accepts_a_simple_root_alone(values, closed):
    def look(x):
        with np.errstate(all="ignore"):
            return values(x), np.diag((values(x + 1e-7) - values(x - 1e-7)) / 2e-7)

    x, found = newton(np.array([1.0]), look, np.add, iterations=60)
    assert found == closed
    if closed:
        assert abs(values(x)[0]) < 1e-12


def test_damped_steps_end_in_the_least_squares_of_equations_that_contradict_each_other(rng):
    table, values = rng.normal(size=(5, 3)), rng.normal(size=5)
    x, closed = newton(
        np.zeros(3), lambda x: (table @ x - values, table), np.add, solve_damped, iterations=60, gain=inf, tolerance=0.0
    )
    assert not closed
    np.testing.assert_allclose(x, np.linalg.lstsq(table, values, rcond=None)[0], atol=1e-9)
