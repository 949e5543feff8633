# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Ten seconds of free swing: the twin's forward dynamics beside Pinocchio's.

The actuators hold constant efforts, those that balance the weight at a stable equilibrium, and the
machine is let go beside it. Constant efforts have a potential, so the sum of the bodies' energy
less effort times position stays. The energy is the one of the Lagrange route, which shares no
code with either engine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from bags.recording.pinocchio_delta import DeltaEngine
from bags.recording.pinocchio_loops import LoopEngine
from bags.recording.pinocchio_prru import PrruEngine
from delta_dynamics import inverse_dynamics
from delta_dynamics.torques.virtual_work import forward_dynamics
from pkm_twin import Robot
from test.support.robots import parameters_of
from tools.certificate.lagrange_machines import energies
from tools.certificate.machines import build

DURATION = 10.0
SAMPLES = 20
"""Number of instants at which energy and closure are checked."""
TOLERANCE = 1e-13
STEP = 1e-3
"""Step of Pinocchio's own integrator (RK4), s."""

DELTA_REST = 0.8
"""All arms in the Deltas' equilibrium, rad."""
DELTA_DEVIATION = (0.35, -0.25, 0.15)
"""Deviation of the arms from equilibrium at the start, rad."""
PRRU_REST = 0.25
"""All sliders in the PRRU's equilibrium, m."""
PRRU_RATES = (0.4, -0.1, -0.3)
"""Rates of the PRRU's sliders at the start, m/s."""
TOOL = {"mass": 10.0, "com": [0.02, 0.01, -0.4], "inertia": np.diag([0.2, 0.2, 0.05]).tolist()}
"""Tool on the PRRU's platform."""

STILL = np.zeros(3)


@dataclass(frozen=True)
class Start:
    """The start of a swing."""

    title: str
    data: dict[str, Any]
    rest: np.ndarray
    q: np.ndarray
    qd: np.ndarray


@dataclass(frozen=True)
class Swing:
    """The result of a run; states at the samples, shape (samples + 1, 3)."""

    machine: str
    route: str
    q: np.ndarray
    qd: np.ndarray
    closure: float
    """Worst opening of a loop, m."""
    drift: float
    """Greatest change of the energy over the greatest kinetic energy."""


def starts() -> list[Start]:
    """Return the machines of the parameter files; the PRRU hangs and has a long tool."""
    result = []
    rest = np.full(3, DELTA_REST)
    for name in ("delta", "delta_cu"):
        result.append(Start(name, parameters_of(name), rest, rest + DELTA_DEVIATION, STILL))
    data = parameters_of("prru")
    data["geometry"]["branch"] = "above"
    data["payload"] = TOOL
    rest = np.full(3, PRRU_REST)
    result.append(Start("prru", data, rest, rest, np.array(PRRU_RATES)))
    return result


def find_engine(data: dict[str, Any]) -> LoopEngine:
    """Return Pinocchio's engine of a parameter mapping."""
    return PrruEngine(data) if data["mechanism"] == "prru" else DeltaEngine(data)


def closure_error(data: dict[str, Any], q: np.ndarray, centre: np.ndarray, axes: np.ndarray) -> float:
    """Return the largest closure error of the limbs, m."""
    g = data["geometry"]
    worst = 0.0
    for i, azimuth in enumerate(g["azimuths"]):
        r = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        t = np.array([-r[1], r[0], 0.0])
        if data["mechanism"] == "prru":
            corner = centre - g["platform_radius"] * axes @ r
            rod = corner - np.array([0.0, 0.0, q[i]]) + g["base_radius"] * r
            worst = max(worst, abs(np.linalg.norm(rod) - g["limb_length"]), abs(corner @ t))
            continue
        arm = math.cos(q[i]) * r - np.array([0.0, 0.0, math.sin(q[i])])
        rod = centre + (g["platform_radius"] - g["base_radius"]) * r - g["arm_length"] * arm
        if g["closures"][i] == "rcu":
            rod = rod - (rod @ t) * t
        worst = max(worst, abs(np.linalg.norm(rod) - g["forearm_length"]))
    return float(worst)


def run(start: Start) -> list[Swing]:
    """Run one machine in three ways."""
    robot = build(start.data)
    effort = inverse_dynamics(robot, start.rest, STILL, STILL)
    engine = find_engine(start.data)
    tree = engine.state(start.q, start.qd, STILL)
    result = [_summary(start, "pkm_twin, DOP853", effort, *_twin(robot, start, effort))]
    for route, integrate in (("DOP853", _pinocchio), ("its own step", _pinocchio_steps)):
        states = integrate(engine, tree.q, tree.v, effort)
        result.append(_summary(start, f"Pinocchio, {route}", effort, *states))
    return result


def _integrate(function: Any, first: np.ndarray) -> np.ndarray:
    states = [first]
    for k in range(SAMPLES):
        span = DURATION * k / SAMPLES, DURATION * (k + 1) / SAMPLES
        solution = solve_ivp(function, span, states[-1], "DOP853", rtol=TOLERANCE, atol=TOLERANCE, t_eval=span[1:])
        states.append(solution.y[:, -1])
    return np.array(states)


def _twin(
    robot: Robot, start: Start, effort: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    def rates(_: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[3:], forward_dynamics(robot, y[:3], y[3:], effort)])

    states = _integrate(rates, np.concatenate([start.q, start.qd]))
    places = list(zip(*robot.platform(states[:, :3]), strict=True))
    return states[:, :3], states[:, 3:], places


def _pinocchio(
    engine: LoopEngine, q: np.ndarray, v: np.ndarray, effort: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    size = len(q)

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        change = engine.forward_dynamics(y[:size], y[size:], effort)
        return np.concatenate([y[size:], change])

    states = _integrate(rates, np.concatenate([q, v]))
    return _read(engine, states[:, :size], states[:, size:])


def _pinocchio_steps(
    engine: LoopEngine, q: np.ndarray, v: np.ndarray, effort: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    states = [(q, v)]
    for _ in range(SAMPLES):
        for _ in range(round(DURATION / SAMPLES / STEP)):
            q, v = engine.step(q, v, effort, None, STEP)
        states.append((q, v))
    return _read(engine, np.array([s[0] for s in states]), np.array([s[1] for s in states]))


def _read(
    engine: LoopEngine, q: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    places = []
    for configuration in q:
        placement = engine.platform_placement(configuration)
        places.append((placement.translation.copy(), placement.rotation.copy()))
    return q[:, engine.actuated], v[:, engine.actuated], places


def _summary(
    start: Start,
    route: str,
    effort: np.ndarray,
    q: np.ndarray,
    qd: np.ndarray,
    places: list[tuple[np.ndarray, np.ndarray]],
) -> Swing:
    source = energies(start.data)
    total = np.array([source.state_energy(*state) for state in zip(q, qd, strict=True)])
    resting = np.array([source.state_energy(place, STILL) for place in q])
    constant = total - q @ effort
    kinetic = float((total - resting).max())
    closure = max(closure_error(start.data, at, *place) for at, place in zip(q, places, strict=True))
    drift = float(np.abs(constant - constant[0]).max()) / kinetic
    return Swing(start.title, route, q, qd, closure, drift)
