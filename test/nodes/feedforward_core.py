# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The feedforward core, and the messages of one motion for it."""

from itertools import permutations

import numpy as np

from delta_dynamics.feedforward import Feedforward, Settings
from test.nodes.harness import SECOND
from test.support.robots import load

NOW = 1_000 * SECOND
STEP = SECOND // 1000
NAMES = ("arm_1", "arm_2", "arm_3")
ROBOT = load("delta_cu")
ORDERS = list(permutations(range(3)))
UNREACHABLE = (2.0, 1.3, 0.4)
"""No assembly: limb I is too short."""
WINDOW = 5
"""Samples of the stream's differentiator in these tests."""


def motion(t):
    """A motion whose velocity is a polynomial of degree 2: q, qd, qdd, shape (..., 3)."""
    t = np.asarray(t, float)[..., None]
    a, b, c, d = np.array([[0.1, 0.3, -0.2], [1.0, -0.5, 0.7], [3.0, 2.0, -4.0], [2.0, -1.0, 1.5]])
    return a + b * t + c * t**2 + d * t**3, b + 2 * c * t + 3 * d * t**2, 2 * c + 6 * d * t


def core(robot=ROBOT, **changes):
    fields = {"window": WINDOW, "recovery_count": 3, "trip_count": 4} | changes
    return Feedforward(robot, Settings(**fields))


def trajectory(make, count=6, order=(0, 1, 2), rates=True, accelerations=True, **changes):
    times = [i * SECOND // 20 + i * i * STEP for i in range(count)]
    q, qd, qdd = (values[:, order] for values in motion(np.array(times) / SECOND))
    fields = {
        "names": [NAMES[i] for i in order],
        "times": times,
        "positions": q,
        "velocities": qd if rates else None,
        "accelerations": qdd if accelerations else None,
    }
    return make.trajectory(**(fields | changes))


def sample(make, index, order=(0, 1, 2), rates=True, measured=None, **changes):
    """One joint state of the motion, ``index`` ms after its beginning, and its arrival time."""
    q, qd, _ = (values[list(order)] for values in motion(index / 1000))
    fields = {
        "names": [NAMES[i] for i in order],
        "position": q,
        "velocity": qd if rates else (),
        "effort": () if measured is None else np.array(measured)[list(order)],
        "stamp": NOW + index * STEP,
    }
    return make.joint_state(**(fields | changes)), NOW + index * STEP


def answers(twin, make, indices, **options):
    return [twin.joint_state(*sample(make, i, **options)) for i in indices]


def running(make, **changes):
    """A core whose stream is answered; the next sample is number 10."""
    twin = core(**changes)
    answers(twin, make, range(10))
    return twin
