# SPDX-License-Identifier: Apache-2.0
"""Record delta_cu_pick_and_place.mcap: a Delta-CU that picks and places under its controller.

The plant is Pinocchio's constrained forward dynamics. The controller is an ordinary one: joint
PID at 1 kHz with the torque held between samples, and a feedforward that knows one constant
inertia and roughly the arms' own weight, nothing of the payload.

May import: numpy, the standard library, its neighbours in this package.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bags.recording.capture import (
    Capture,
    Progress,
    engine_version,
    joint_state,
    joint_trajectory,
    machine_parameters,
    parameters_digest,
    require_within,
    smooth,
    steps,
)
from bags.recording.pinocchio_delta import DeltaEngine

Array = NDArray[np.float64]

NAME: Final = "delta_cu_pick_and_place"
DURATION: Final = 20.0
"""Length of the recording, s."""
PERIOD_NS: Final = 1_000_000
"""Control and measurement period."""
SUBSTEPS: Final = 2
"""Runge-Kutta steps of the plant in one period."""
TRAJECTORY_STRIDE: Final = 10
"""Control periods between two points of a commanded trajectory."""
JOINT_STATE_LATENCY_NS: Final = 200_000
TRAJECTORY_LEAD_NS: Final = 50_000_000
"""How long before its start a trajectory is sent."""

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
VELOCITY_NOISE: Final = 0.002
VELOCITY_STEP: Final = 1e-4
EFFORT_NOISE: Final = 0.006
EFFORT_STEP: Final = 1e-3
"""Standard deviations and resolutions of the drive's signals, rad/s and N m."""

STIFFNESS: Final = 130.0
DAMPING: Final = 1.7
INTEGRAL: Final = 1500.0
NOMINAL_INERTIA: Final = 0.0085
NOMINAL_WEIGHT: Final = 0.42
"""The controller's gains, N m/rad, N m s/rad and N m/(rad s), and its idea of the machine:
inertia at an arm, kg m2, and the torque that holds a level arm up, N m."""


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


def reference(
    engine: DeltaEngine, moves: list[Move], duration: float = DURATION
) -> tuple[Array, Array, Array]:
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


def trajectory(
    move: Move, names: list[str], motion: tuple[Array, Array, Array]
) -> tuple[int, dict[str, Any]]:
    """Return a movement's start, ns, and its trajectory_msgs/JointTrajectory."""
    first = round(move.start * 1e9) // PERIOD_NS
    length = round(move.duration * 1e9) // PERIOD_NS
    picked = slice(first, first + length + 1, TRAJECTORY_STRIDE)
    samples = tuple(part[picked] for part in motion)
    start = first * PERIOD_NS
    return start, joint_trajectory(start, TRAJECTORY_STRIDE * PERIOD_NS, names, samples)


def standstill(moves: list[Move], after: float, *, picks: bool) -> float:
    """Return the middle of the first standstill at a pick or place point from a time on, s."""
    for move in moves:
        middle = move.start + move.duration + DWELL / 2.0
        if move.picks is picks and middle >= after:
            return middle
    raise ValueError(f"no standstill after {after} s")


def sensors() -> dict[str, float]:
    """Return what the metadata say of the drives' signals."""
    return {
        "encoder_counts_per_revolution": ENCODER_COUNTS,
        "velocity_noise_rad_s": VELOCITY_NOISE,
        "velocity_step_rad_s": VELOCITY_STEP,
        "effort_noise_N_m": EFFORT_NOISE,
        "effort_step_N_m": EFFORT_STEP,
    }


def simulate(
    capture: Capture,
    motion: tuple[Array, Array, Array],
    plant: Callable[[float], DeltaEngine],
    rng: np.random.Generator,
    *,
    push: Callable[[float, Array, Array], Array | None] = lambda *_: None,
    progress: Progress | None = None,
) -> None:
    """Run the machine along a reference under its controller and keep its joint states.

    :param motion: of :func:`reference`.
    :param plant: the machine as it is at a time, s.
    :param push: wrench on the platform, world axes, at a time and a state of the tree.
    """
    begin = plant(0.0)
    names: list[str] = list(begin.params["joints"])
    limits = begin.params.get("limits") or {}
    peak = np.asarray(limits.get("effort", np.inf), dtype=float)
    configuration = begin.assemble(motion[0][0])
    velocity = np.zeros_like(configuration)
    torque = begin.inverse_dynamics(motion[0][0], np.zeros(3), np.zeros(3))
    integral = torque - NOMINAL_WEIGHT * -np.cos(motion[0][0])
    count = len(motion[0])
    period = PERIOD_NS * 1e-9
    for k in range(count):
        engine = plant(k * period)
        q = steps(configuration[engine.actuated], 2.0 * math.pi / ENCODER_COUNTS)
        noise = rng.normal(size=(2, 3))
        qd = steps(velocity[engine.actuated] + VELOCITY_NOISE * noise[0], VELOCITY_STEP)
        effort = steps(torque + EFFORT_NOISE * noise[1], EFFORT_STEP)
        time = k * PERIOD_NS
        capture.write(
            "/joint_states",
            joint_state(time, names, q, qd, effort),
            time + JOINT_STATE_LATENCY_NS,
        )
        error = motion[0][k] - q
        integral = integral + INTEGRAL * error * period
        feedforward = NOMINAL_INERTIA * motion[2][k] - NOMINAL_WEIGHT * np.cos(motion[0][k])
        torque = feedforward + STIFFNESS * error + DAMPING * (motion[1][k] - qd) + integral
        torque = np.clip(torque, -peak, peak)
        for _ in range(SUBSTEPS):
            wrench = push(k * period, configuration, velocity)
            configuration, velocity = engine.step(
                configuration, velocity, torque, wrench, period / SUBSTEPS
            )
        if progress is not None and k % 100 == 99:
            progress((k + 1) / count)


def record(path: Path, seed: int = 20250101, progress: Progress | None = None) -> None:
    """Simulate and write the bag."""
    parameters = machine_parameters("delta_cu")
    names: list[str] = parameters["joints"]
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
    capture = Capture(
        {
            "robot": "delta_cu",
            "source": "simulated",
            "engine": "pinocchio constrained forward dynamics",
            "engine_version": engine_version("pin"),
            "recorder": "bags.recording.record_delta_cu",
            "parameters_sha256": parameters_digest(parameters),
            "seed": seed,
            "duration_s": DURATION,
            "payload_mass_kg": PAYLOAD_MASS,
            "payload_com_m": " ".join(map(str, PAYLOAD_COM)),
            "payload_picked_s": f"{pick:.3f}",
            "payload_released_s": f"{release:.3f}",
            **sensors(),
        }
    )
    capture.add_topic("/joint_states", "sensor_msgs/msg/JointState")
    capture.add_topic("/delta_dynamics/joint_trajectory", "trajectory_msgs/msg/JointTrajectory")
    for move in moves:
        start, message = trajectory(move, names, motion)
        capture.write("/delta_dynamics/joint_trajectory", message, start - TRAJECTORY_LEAD_NS)

    simulate(
        capture,
        motion,
        lambda time: laden if pick <= time < release else empty,
        np.random.default_rng(seed),
        progress=progress,
    )
    capture.save(path)
