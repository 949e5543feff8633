# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Far from home a state is that to which the straight way leads, and no other assembly."""

from __future__ import annotations

import numpy as np
import pytest

from pkm_twin.kinematics.motion import Motion, to_floats
from pkm_twin.kinematics.programs import newton_step_program
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.laws.test_limbs import hexapod
from test.machine.random_machines import FILES, GALLERY, variant
from test.support.robots import load, partly_long

NONE = np.zeros(0)
CLEAR = 0.05
"""Least determinant on a way that both have to find, over that at home."""


def parallelogram():
    """A four-bar whose coupler is as long as its frame: where all links lie in line it folds."""
    bodies = {
        name: {"mass": 0.1, "com": com, "inertia": [1e-4] * 3}
        for name, com in (("crank", [0, 0, 0.1]), ("rod", [0.2, 0, 0.2]), ("rocker", [0.4, 0, 0.1]))
    }
    pins = {
        "motor": ("base", "crank", [0, 0, 0]),
        "left": ("crank", "rod", [0, 0, 0.2]),
        "foot": ("base", "rocker", [0.4, 0, 0]),
        "right": ("rocker", "rod", [0.4, 0, 0.2]),
    }
    joints = {
        name: {"type": "revolute", "between": [a, b], "at": at, "axis": [0, 1, 0]} for name, (a, b, at) in pins.items()
    }
    joints["motor"]["actuated"] = True
    return robot_of_data(
        {
            "mechanism": "machine",
            "platform": "rod",
            "origin": [0.2, 0, 0.2],
            "pose": ["x"],
            "bodies": bodies,
            "joints": joints,
        },
        "parallelogram",
    )


MACHINES = {
    "agile eye": lambda: load(GALLERY / "agile_eye.yaml"),
    "parallelogram": parallelogram,
    "planar": lambda: robot_of_data(variant("rrr3_planar", np.random.default_rng(5)), "planar"),
    "spherical": lambda: robot_of_data(variant("rrr3_spherical", np.random.default_rng(6)), "ball"),
    "five-bar": lambda: load(FILES["five_bar"]),
    "hexapod": lambda: hexapod(3),
}


def led(engine, q, steps):
    """The least determinant on straight ways, shape (k,), and at their ends x and closures' misses.

    By the midpoint rule and corrections. The determinant is that of the kept closures, over that at
    home; below zero it is past a singularity.
    """
    home, kept, free = engine.graph.home, engine.independent, engine.tree.unknown_rates
    walk, count = engine.kernel("walk", newton_step_program), len(engine.parts)
    slides = np.array([engine.graph.joints[name].slides for name in engine.graph.actuated])
    step = (q - home) / steps
    drive = np.where(slides, step / engine.tree.size, step)[..., None]

    n = len(home)

    def look(x, q, move=0.0):
        moves = np.concatenate([np.broadcast_to(move, (len(q), free)), 0.0 * q], -1)
        state = np.concatenate([x, q], -1)
        values, table, moved = walk(NONE, state, engine.home_pose, moves)[0]
        table = table.reshape(*values.shape, -1)[:, :count]
        return values[:, :count, None], table[:, kept, :free], table[:, kept, free:], moved[:, :-n]

    x = np.broadcast_to(engine.tree.home, (len(q), len(engine.tree.home)))
    start = np.linalg.slogdet(look(x, home + 0.0 * q)[1])
    least = np.ones(len(q))
    for k in range(steps):
        here, there = home + k * step, home + (k + 1) * step
        _, ju, jq, _ = look(x, here)
        half = -0.5 * np.linalg.solve(ju, jq @ drive)[..., 0]
        _, ju, jq, _ = look(look(x, here, half)[3], here + 0.5 * step)
        x = look(x, here, -np.linalg.solve(ju, jq @ drive)[..., 0])[3]
        for _ in range(2):
            values, ju, _, _ = look(x, there)
            x = look(x, there, -np.linalg.solve(ju, values[:, kept])[..., 0])[3]
        values, ju, _, _ = look(x, there)
        sign, size = np.linalg.slogdet(ju)
        least = np.fmin(least, sign * start[0] * np.exp(np.minimum(size - start[1], 9.0)))
        least[~(np.abs(values).max((1, 2)) < 1e-6)] = -1.0
    return least, x


@pytest.mark.parametrize("name", partly_long(MACHINES, *(name for name in MACHINES if name != "hexapod")))
def test_far_states_are_those_that_small_steps_lead_to(name, rng):
    robot = MACHINES[name]()
    engine, home = robot.engine, robot.graph.home
    slides = np.array([engine.graph.joints[joint].slides for joint in engine.graph.actuated])
    reach = np.where(slides, 0.4 * engine.tree.size, 4.0 if len(home) < 3 else 1.5)
    q = home + rng.uniform(-1.0, 1.0, (200, len(home))) * reach
    known = robot.try_forward(q)[1]
    assert 20 < known.sum() < 198
    least, x = led(engine, q, 200)
    # Beside a singularity by shorter ones.
    doubtful = np.flatnonzero(known & ~(least > CLEAR))
    if len(doubtful):
        least[doubtful], x[doubtful] = led(engine, q[doubtful], 2000)
    assert (least[known] > 0.0).all()
    assert (least[~known] < CLEAR).all()
    for k in np.flatnonzero(known)[::4]:
        position, turn = robot.platform(q[k])
        place, rotation = Motion(engine.tree, x[k], q[k]).platform()
        np.testing.assert_allclose(position, to_floats(place), atol=1e-6)
        np.testing.assert_allclose(turn, to_floats(rotation), atol=1e-5)
