# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Record delta_cu_collision.mcap: the Delta-CU runs into a padded wall that it does not know of.

The same machine, engine, controller and sensors as in the pick-and-place recording. From a time on
an obstacle stands in the way: a wall across the path, a spring and a damper that push back only.

May import: numpy, the standard library, its neighbours in this package.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bags.recording.capture import Capture, Progress, machine_parameters, require_within
from bags.recording.control import ENGINE, PERIOD_NS, simulate
from bags.recording.pinocchio_delta import DeltaEngine
from bags.recording.record_delta_cu import (
    APPROACH,
    DRIVES,
    DWELL,
    HOME,
    LEVEL,
    LIFT,
    MOVE,
    PICK_X,
    PLACE_X,
    SENSORS,
    Move,
    known,
    reference,
)

Array = NDArray[np.float64]

NAME: Final = "delta_cu_collision"
DURATION: Final = 4.0
"""Length of the recording, s."""
WALL: Final = -0.06
"""Where the obstacle begins, m along x; what is at a smaller x is in it."""
APPEARS: Final = 2.3
VANISHES: Final = 3.4
"""When it stands there, s: the third crossing runs into it, the first does not."""
HARDNESS: Final = 4000.0
SOFTNESS: Final = 25.0
"""Spring, N/m, and damper, N s/m, of the obstacle: a padded wall."""
WRENCH_STRIDE: Final = 2
"""Periods between two of the recorded true pushes."""


def plan() -> list[Move]:
    """Return the movements: out, to and fro across the place of the obstacle."""
    moves = []
    time, place = 0.4, np.array(HOME)
    goal = np.array([PLACE_X, 0.0, LEVEL])
    moves.append(Move(time, APPROACH, place, goal, 0.0, True))
    time, place = time + APPROACH + DWELL, goal
    for leg in range(4):
        goal = np.array([PICK_X if leg % 2 == 0 else PLACE_X, 0.0, LEVEL])
        moves.append(Move(time, MOVE, place, goal, LIFT, leg % 2 == 1))
        time, place = time + MOVE + DWELL, goal
    return moves


class Obstacle:
    """The wall, which writes into a bag what it does to the platform every few periods."""

    def __init__(self, engine: DeltaEngine, capture: Capture) -> None:
        self._places, self._capture, self._next = engine.pose_places, capture, 0
        self.first: float | None = None
        self.greatest = 0.0

    def __call__(self, time: float, configuration: Array, velocity: Array) -> Array | None:
        """Force against the way in, world axes, (6,), None where they do not touch."""
        wrench = None
        depth = WALL - configuration[self._places][0]
        if APPEARS <= time < VANISHES and depth > 0.0:
            push = HARDNESS * depth - SOFTNESS * velocity[self._places][0]
            wrench = np.array([max(push, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0])
            self.first = time if self.first is None else self.first
            self.greatest = max(self.greatest, float(np.abs(wrench).max()))
        now = round(time * 1e9)
        if now >= self._next:
            self._next = now + WRENCH_STRIDE * PERIOD_NS
            load = np.zeros(6) if wrench is None else wrench
            self._capture.wrench("/ground_truth/wrench", now, "base_link", load)
        return wrench


def record(path: Path, seed: int = 20250104, progress: Progress | None = None) -> None:
    """Simulate and write the bag."""
    parameters = machine_parameters("delta_cu")
    engine = DeltaEngine(parameters)
    engine.friction_band = 0.01
    motion = reference(engine, plan(), DURATION)
    limits = parameters.get("limits") or {}
    require_within(motion[0], limits.get("position"), "the arms' path")
    topics = ("/joint_states", "/ground_truth/wrench")
    capture = Capture("record_collision", "delta_cu", parameters, ENGINE, seed, DURATION, topics, {})
    wall, rng = Obstacle(engine, capture), np.random.default_rng(seed)
    simulate(capture, motion, lambda _: engine, DRIVES, known, rng, wall, progress)
    facts = {
        "contact_begins_s": f"{wall.first:.4f}",
        "contact_force_N": f"{wall.greatest:.1f}",
        "contact_stiffness_N_m": HARDNESS,
        "contact_damping_N_s_m": SOFTNESS,
    }
    capture.facts.update({name: str(value) for name, value in (facts | SENSORS).items()})
    capture.save(path)
