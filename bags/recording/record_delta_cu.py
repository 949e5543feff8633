# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Record delta_cu_pick_and_place.mcap: a Delta-CU that picks and places under its controller.

The plant is Pinocchio's constrained forward dynamics. The controller is an ordinary one: joint
PID at 1 kHz with the torque held between samples, and a feedforward that knows one constant
inertia and roughly the arms' own weight, nothing of the payload.

May import: numpy, the standard library, its neighbours in this package.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bags.recording.capture import Capture, Progress, machine_parameters, require_within, smooth
from bags.recording.control import ENGINE, PERIOD_NS, Drives, simulate
from bags.recording.pinocchio_delta import DeltaEngine

Array = NDArray[np.float64]

NAME: Final = "delta_cu_pick_and_place"
DURATION: Final = 20.0
"""Length of the recording, s."""
TRAJECTORY_STRIDE: Final = 10
"""Control periods between two points of a commanded trajectory."""

PAYLOAD_MASS: Final = 0.15
PAYLOAD_COM: Final = (0.0, 0.0, -0.02)
PICK_AFTER: Final = 8.0
RELEASE_AFTER: Final = 14.0
"""The payload comes and goes in the middle of the first suitable standstill from here on, s."""

HOME: Final = (0.0, 0.0, -0.362)
PICK_X: Final = -0.10
PLACE_X: Final = 0.10
ROWS: Final = (-0.03, 0.0, 0.03, 0.015)
LEVEL: Final = -0.400
LIFT: Final = 0.025
"""Pick and place points and the lift between them, m."""
MOVE: Final = 0.45
DWELL: Final = 0.15
APPROACH: Final = 0.60

ENCODER_COUNTS: Final = 1 << 20
"""Encoder counts a revolution of the arm."""
DRIVES: Final = Drives(
    position_step=2.0 * math.pi / ENCODER_COUNTS,
    velocity_noise=0.002,
    velocity_step=1e-4,
    effort_noise=0.006,
    effort_step=1e-3,
    stiffness=130.0,
    damping=1.7,
    integral=1500.0,
)
SENSORS: Final = {
    "encoder_counts_per_revolution": ENCODER_COUNTS,
    **DRIVES.facts("rad_s", "N_m"),
}
"""What the metadata say of the drives' signals."""
NOMINAL_INERTIA: Final = 0.0085
NOMINAL_WEIGHT: Final = 0.42
"""The controller's idea of the machine: inertia at an arm, kg m2, and the torque that holds a
level arm up, N m."""


def known(q: Array, qdd: Array) -> Array:
    """Return the torques that the controller expects, N m."""
    torques: Array = NOMINAL_INERTIA * qdd - NOMINAL_WEIGHT * np.cos(q)
    return torques


class Move(NamedTuple):
    """One commanded movement between two standstills."""

    start: float
    duration: float
    begin: Array
    end: Array
    lift: float
    picks: bool


def plan() -> list[Move]:
    """Return the movements of the recording: out, to and fro over the lift, and home."""
    moves = []
    time, place = 0.4, np.array(HOME)
    goal = np.array([PICK_X, ROWS[0], LEVEL])
    moves.append(Move(time, APPROACH, place, goal, 0.0, True))
    time, place, leg = time + APPROACH + DWELL, goal, 0
    while time + MOVE + DWELL + APPROACH < DURATION - 0.3:
        leg += 1
        picks = leg % 2 == 0
        goal = np.array([PICK_X if picks else PLACE_X, ROWS[leg % len(ROWS)], LEVEL])
        moves.append(Move(time, MOVE, place, goal, LIFT, picks))
        time, place = time + MOVE + DWELL, goal
    moves.append(Move(time, APPROACH, place, np.array(HOME), 0.0, False))
    return moves


def platform_motion(move: Move, time: float) -> tuple[Array, Array, Array]:
    """Return the platform's position, velocity and acceleration in a movement.

    Quintic across, between a tenth and nine tenths of the time where there is a lift; the lift is
    (4 u (1 - u))^3, which starts and ends without acceleration.
    """
    u = (time - move.start) / move.duration
    delay = 0.1 if move.lift else 0.0
    stretch = 1.0 / (1.0 - 2.0 * delay)
    value, first, second = smooth((u - delay) * stretch)
    rate = stretch / move.duration
    span = move.end - move.begin
    position = move.begin + span * value
    velocity = span * first * rate
    acceleration = span * second * rate**2
    hump, slope = u * (1.0 - u), 1.0 - 2.0 * u
    if 0.0 < u < 1.0:
        position[2] += move.lift * 64.0 * hump**3
        velocity[2] += move.lift * 192.0 * hump**2 * slope / move.duration
        curve = 384.0 * hump * (slope**2 - hump)
        acceleration[2] += move.lift * curve / move.duration**2
    return position, velocity, acceleration


def reference(engine: DeltaEngine, moves: list[Move], duration: float = DURATION) -> tuple[Array, Array, Array]:
    """Return commanded arm angles, rates and accelerations, each of shape (samples, 3)."""
    count = round(duration * 1e9) // PERIOD_NS
    q, qd, qdd = (np.zeros((count, 3)) for _ in range(3))
    near = engine.assemble_pose(HOME)
    filled = 0
    for move in moves:
        first = round(move.start * 1e9) // PERIOD_NS
        last = first + round(move.duration * 1e9) // PERIOD_NS
        q[filled:first] = near[engine.actuated]
        for k in range(first, last + 1):
            tree = engine.pose_state(*platform_motion(move, k * PERIOD_NS * 1e-9), near)
            near = tree.q
            q[k], qd[k], qdd[k] = (part[engine.actuated] for part in tree)
        filled = last + 1
    q[filled:] = near[engine.actuated]
    return q, qd, qdd


def standstill(moves: list[Move], after: float, *, picks: bool) -> float:
    """Return the middle of the first standstill at a pick or place point from a time on, s."""
    for move in moves:
        middle = move.start + move.duration + DWELL / 2.0
        if move.picks is picks and middle >= after:
            return middle
    raise ValueError(f"no standstill after {after} s")


def record(path: Path, seed: int = 20250101, progress: Progress | None = None) -> None:
    """Simulate and write the bag."""
    parameters = machine_parameters("delta_cu")
    payload = {"mass": PAYLOAD_MASS, "com": PAYLOAD_COM}
    empty = DeltaEngine(parameters)
    laden = DeltaEngine({**parameters, "payload": payload})
    for engine in (empty, laden):
        engine.friction_band = 0.01

    moves = plan()
    motion = reference(empty, moves)
    limits = parameters.get("limits") or {}
    require_within(motion[0], limits.get("position"), "the arms' path")
    pick = standstill(moves, PICK_AFTER, picks=True)
    release = standstill(moves, RELEASE_AFTER, picks=False)
    facts = {
        "payload_mass_kg": PAYLOAD_MASS,
        "payload_com_m": " ".join(map(str, PAYLOAD_COM)),
        "payload_picked_s": f"{pick:.3f}",
        "payload_released_s": f"{release:.3f}",
    }
    topics = ("/joint_states", "/delta_dynamics/joint_trajectory")
    capture = Capture("record_delta_cu", "delta_cu", parameters, ENGINE, seed, DURATION, topics, facts | SENSORS)
    for move in moves:
        first, length = (round(t * 1e9) // PERIOD_NS for t in (move.start, move.duration))
        picked = slice(first, first + length + 1, TRAJECTORY_STRIDE)
        samples = [part[picked] for part in motion]
        capture.trajectory(first * PERIOD_NS, TRAJECTORY_STRIDE * PERIOD_NS, samples)
    simulate(
        capture,
        motion,
        lambda time: laden if pick <= time < release else empty,
        DRIVES,
        known,
        np.random.default_rng(seed),
        progress=progress,
    )
    capture.save(path)
