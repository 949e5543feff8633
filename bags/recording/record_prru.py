# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Record prru_milling.mcap: a 3-PRRU head that mills along a tilting path under its controller.

The plant is Pinocchio's constrained forward dynamics with the cutter's load on the platform. The
controller is a PID in each slider at 1 kHz with the force held between samples, and a feedforward
that knows one constant mass and the weight on a slider, nothing of the cut.

May import: numpy, scipy, the standard library, its neighbours in this package.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from bags.recording.capture import (
    Capture,
    Progress,
    WrenchSensor,
    machine_parameters,
    require_within,
    smooth,
)
from bags.recording.control import ENGINE, PERIOD_NS, Drives, simulate
from bags.recording.milling import Milling
from bags.recording.pinocchio_prru import PrruEngine

Array = NDArray[np.float64]

NAME: Final = "prru_milling"
DURATION: Final = 20.0
"""Length of the recording, s."""
WRENCH_STRIDE: Final = 2
"""Control periods between two wrenches."""
PLAN_STRIDE: Final = 20
"""Control periods between two points of the commanded path."""
BLOCK: Final = 5.0
"""Length of one commanded trajectory, s."""

CUTTER: Final = Milling(
    spindle_hz=47.0,
    teeth=2,
    tool_tip=(0.0, 0.0, 0.12),
    mean_force=(140.0, 80.0, -100.0),
    cutting_moment=2.0,
    passes=((2.0, 9.0), (11.5, 18.5)),
)
"""Two passes at 2,820 rpm; between them the head draws back."""
TILT: Final = math.radians(14.0)
ORBIT_HZ: Final = 0.35
RETRACT: Final = 0.08
"""Tilt of the path, its turns a second, and how far the head draws back, m."""

DRIVES: Final = Drives(
    position_step=1e-7,
    velocity_noise=2e-4,
    velocity_step=1e-5,
    effort_noise=1.5,
    effort_step=0.1,
    stiffness=2.2e5,
    damping=3500.0,
    integral=2.0e6,
)
MASS_SHARE: Final = 0.9
"""The controller's idea of a slider's share of all masses, as a fraction of the true one."""


def pose(time: float, height: float) -> Array:
    """Return the platform's z, m, alpha and beta, rad: an orbit of the tilt, and the retraction."""
    grow = smooth((time - 0.5) / 2.0)[0] - smooth((time - DURATION + 1.3) / 1.0)[0]
    back = smooth((time - 9.6) / 0.5)[0] - smooth((time - 10.6) / 0.6)[0]
    turn = 2.0 * math.pi * ORBIT_HZ * time
    tilt = TILT * grow * (1.0 + 0.25 * math.sin(0.23 * turn))
    bob = 0.01 * grow * math.sin(2.0 * math.pi * 0.5 * time)
    away = -RETRACT * back * math.copysign(1.0, CUTTER.tool_tip[2])
    return np.array([height + bob + away, tilt * math.cos(turn), tilt * math.sin(turn)])


def home_height(engine: PrruEngine, parameters: Mapping[str, Any]) -> float:
    """Return the platform's z with all sliders in the middle of their travel, m."""
    limits = parameters.get("limits") or {}
    middle = float(np.mean(np.asarray(limits.get("position", (0.0, 0.8)), dtype=float)))
    return float(engine.pose(np.full(3, middle))[0])


def reference(engine: PrruEngine, height: float) -> tuple[Array, Array, Array]:
    """Return commanded slider heights, speeds and accelerations, each of shape (samples + 1, 3).

    The path is planned at every `PLAN_STRIDE` and a quintic spline runs through it.
    """
    count = round(DURATION * 1e9) // PERIOD_NS
    knots = np.arange(0, count + 1, PLAN_STRIDE) * PERIOD_NS * 1e-9
    near, heights = None, []
    for time in knots:
        near = engine.assemble_pose(pose(time, height), near)
        heights.append(near[engine.actuated])
    spline = make_interp_spline(knots, np.array(heights), k=5)
    times = np.arange(count + 1) * PERIOD_NS * 1e-9
    return spline(times), spline.derivative(1)(times), spline.derivative(2)(times)


class Cut:
    """The cutter's load, which a sensor reads every few periods."""

    def __init__(self, engine: PrruEngine, capture: Capture, rng: np.random.Generator) -> None:
        self._engine, self._capture, self._rng = engine, capture, rng
        self._time, self._fixed = -1.0, np.zeros(6)

    def __call__(self, time: float, configuration: Array, velocity: Array) -> Array:
        """Load on the platform, world axes, (6,), the same all over a period."""
        if time != self._time:
            now = round(time * 1e9)
            load = CUTTER.wrench(now * 1e-9)
            if now // PERIOD_NS % WRENCH_STRIDE == 0:
                measured = WrenchSensor().read(load, self._rng)
                self._capture.wrench("/wrench", now, "platform", measured)
            rotation = self._engine.platform_placement(configuration).rotation
            self._time = time
            self._fixed = np.concatenate((rotation @ load[:3], rotation @ load[3:]))
        return self._fixed


def record(path: Path, seed: int = 20250103, progress: Progress | None = None) -> None:
    """Simulate and write the bag."""
    parameters = machine_parameters("prru")
    engine = PrruEngine(parameters)
    engine.friction_band = 1e-3
    motion = reference(engine, home_height(engine, parameters))
    limits = parameters.get("limits") or {}
    require_within(motion[0], limits.get("position"), "the sliders' path")
    count = len(motion[0]) - 1
    facts = {
        "spindle_Hz": CUTTER.spindle_hz,
        "tooth_passing_Hz": CUTTER.tooth_hz,
        "position_step_m": DRIVES.position_step,
        **DRIVES.facts("m_s", "N"),
        **WrenchSensor().facts(),
    }
    topics = ("/joint_states", "/wrench", "/delta_dynamics/joint_trajectory")
    capture = Capture("record_prru", "prru", parameters, ENGINE, seed, DURATION, topics, facts)
    block = round(BLOCK * 1e9) // PERIOD_NS
    for first in range(0, count, block):
        samples = [part[first : first + block + 1 : PLAN_STRIDE] for part in motion]
        capture.trajectory(first * PERIOD_NS, PLAN_STRIDE * PERIOD_NS, samples)

    gravity = float(np.linalg.norm(parameters.get("gravity", (0.0, 0.0, -9.81))))
    force = engine.inverse_dynamics(motion[0][0], np.zeros(3), np.zeros(3))
    weight = MASS_SHARE * float(np.mean(force))
    mass = abs(weight) / gravity if gravity else 0.0
    rng = np.random.default_rng(seed)
    simulate(
        capture,
        (motion[0][:count], motion[1][:count], motion[2][:count]),
        lambda _: engine,
        DRIVES,
        lambda _, qdd: weight + mass * qdd,
        rng,
        Cut(engine, capture, rng),
        progress,
    )
    capture.save(path)
