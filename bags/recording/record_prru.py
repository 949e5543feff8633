# SPDX-License-Identifier: Apache-2.0
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
    engine_version,
    joint_state,
    joint_trajectory,
    machine_parameters,
    parameters_digest,
    require_within,
    smooth,
    steps,
    wrench_stamped,
)
from bags.recording.milling import Milling
from bags.recording.pinocchio_prru import PrruEngine

Array = NDArray[np.float64]

NAME: Final = "prru_milling"
DURATION: Final = 20.0
"""Length of the recording, s."""
PERIOD_NS: Final = 1_000_000
"""Control and measurement period."""
SUBSTEPS: Final = 2
"""Runge-Kutta steps of the plant in one period."""
WRENCH_STRIDE: Final = 2
"""Control periods between two wrenches."""
PLAN_STRIDE: Final = 20
"""Control periods between two points of the commanded path."""
BLOCK: Final = 5.0
"""Length of one commanded trajectory, s."""
JOINT_STATE_LATENCY_NS: Final = 200_000
WRENCH_LATENCY_NS: Final = 300_000
TRAJECTORY_LEAD_NS: Final = 50_000_000
"""How long before its start a trajectory is sent."""

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

POSITION_STEP: Final = 1e-7
VELOCITY_NOISE: Final = 2e-4
VELOCITY_STEP: Final = 1e-5
EFFORT_NOISE: Final = 1.5
EFFORT_STEP: Final = 0.1
FORCE_NOISE: Final = 0.5
FORCE_STEP: Final = 0.05
MOMENT_NOISE: Final = 0.02
MOMENT_STEP: Final = 0.001
"""Standard deviations and resolutions of the sensors, m, m/s, N and N m."""

STIFFNESS: Final = 2.2e5
DAMPING: Final = 3500.0
INTEGRAL: Final = 2.0e6
MASS_SHARE: Final = 0.9
"""The controller's gains, N/m, N s/m and N/(m s), and its idea of a slider's share of all masses,
as a fraction of the true one."""


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


def record(path: Path, seed: int = 20250103, progress: Progress | None = None) -> None:
    """Simulate and write the bag."""
    parameters = machine_parameters("prru")
    names: list[str] = parameters.get("joints") or ["slider_1", "slider_2", "slider_3"]
    engine = PrruEngine(parameters)
    engine.friction_band = 1e-3
    motion = reference(engine, home_height(engine, parameters))
    limits = parameters.get("limits") or {}
    require_within(motion[0], limits.get("position"), "the sliders' path")
    count = len(motion[0]) - 1
    capture = Capture(
        {
            "robot": "prru",
            "source": "simulated",
            "engine": "pinocchio constrained forward dynamics",
            "engine_version": engine_version("pin"),
            "recorder": "bags.recording.record_prru",
            "parameters_sha256": parameters_digest(parameters),
            "seed": seed,
            "duration_s": DURATION,
            "spindle_Hz": CUTTER.spindle_hz,
            "tooth_passing_Hz": CUTTER.tooth_hz,
            "position_step_m": POSITION_STEP,
            "velocity_noise_m_s": VELOCITY_NOISE,
            "velocity_step_m_s": VELOCITY_STEP,
            "effort_noise_N": EFFORT_NOISE,
            "effort_step_N": EFFORT_STEP,
            "force_noise_N": FORCE_NOISE,
            "force_step_N": FORCE_STEP,
            "moment_noise_N_m": MOMENT_NOISE,
            "moment_step_N_m": MOMENT_STEP,
        }
    )
    capture.add_topic("/joint_states", "sensor_msgs/msg/JointState")
    capture.add_topic("/wrench", "geometry_msgs/msg/WrenchStamped")
    capture.add_topic("/delta_dynamics/joint_trajectory", "trajectory_msgs/msg/JointTrajectory")
    block = round(BLOCK * 1e9) // PERIOD_NS
    for first in range(0, count, block):
        start = first * PERIOD_NS
        samples = tuple(part[first : first + block + 1 : PLAN_STRIDE] for part in motion)
        message = joint_trajectory(start, PLAN_STRIDE * PERIOD_NS, names, samples)
        capture.write("/delta_dynamics/joint_trajectory", message, start - TRAJECTORY_LEAD_NS)

    rng = np.random.default_rng(seed)
    spread = np.repeat((FORCE_NOISE, MOMENT_NOISE), 3)
    grain = np.repeat((FORCE_STEP, MOMENT_STEP), 3)
    gravity = float(np.linalg.norm(parameters.get("gravity", (0.0, 0.0, -9.81))))
    force = engine.inverse_dynamics(motion[0][0], np.zeros(3), np.zeros(3))
    weight = MASS_SHARE * float(np.mean(force))
    mass = abs(weight) / gravity if gravity else 0.0
    integral = force - weight
    configuration = engine.assemble(motion[0][0])
    velocity = np.zeros_like(configuration)
    period = PERIOD_NS * 1e-9
    for k in range(count):
        q = steps(configuration[engine.actuated], POSITION_STEP)
        noise = rng.normal(size=(2, 3))
        qd = steps(velocity[engine.actuated] + VELOCITY_NOISE * noise[0], VELOCITY_STEP)
        effort = steps(force + EFFORT_NOISE * noise[1], EFFORT_STEP)
        time_ns = k * PERIOD_NS
        capture.write(
            "/joint_states",
            joint_state(time_ns, names, q, qd, effort),
            time_ns + JOINT_STATE_LATENCY_NS,
        )
        load = CUTTER.wrench(time_ns * 1e-9)
        if k % WRENCH_STRIDE == 0:
            measured = steps(load + spread * rng.normal(size=6), grain)
            capture.write(
                "/wrench",
                wrench_stamped(time_ns, "platform", measured),
                time_ns + WRENCH_LATENCY_NS,
            )
        error = motion[0][k] - q
        integral = integral + INTEGRAL * error * period
        force = weight + mass * motion[2][k] + STIFFNESS * error + DAMPING * (motion[1][k] - qd)
        force = force + integral
        rotation = engine.platform_placement(configuration).rotation
        fixed = np.concatenate((rotation @ load[:3], rotation @ load[3:]))
        for _ in range(SUBSTEPS):
            configuration, velocity = engine.step(
                configuration, velocity, force, fixed, period / SUBSTEPS
            )
        if progress is not None and k % 100 == 99:
            progress((k + 1) / count)
    capture.save(path)
