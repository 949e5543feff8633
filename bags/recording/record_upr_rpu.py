# SPDX-License-Identifier: Apache-2.0
"""Record upr_rpu_milling.mcap: a 2UPR-RPU head that mills while its platform moves slowly.

Deflection and strain energy come from the finite-element frame, quasi-static and linear, at the
true pose under the true load; the sensors see both with their steps and noise.

May import: numpy, the standard library, its neighbours in this package.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bags.recording.capture import (
    Capture,
    Progress,
    engine_version,
    header,
    joint_state,
    machine_parameters,
    parameters_digest,
    require_within,
    smooth,
    steps,
    vector3,
    wrench_stamped,
)
from bags.recording.frame_model import FrameSolution, UprRpuFrame
from bags.recording.milling import Milling

Array = NDArray[np.float64]

NAME: Final = "upr_rpu_milling"
DURATION: Final = 20.0
"""Length of the recording, s."""
PERIOD_NS: Final = 2_000_000
"""Measurement period of wrench and limb lengths."""
TRUTH_STRIDE: Final = 25
"""Measurement periods between two solutions of the frame."""
JOINT_STATE_LATENCY_NS: Final = 200_000
WRENCH_LATENCY_NS: Final = 300_000
TRUTH_LATENCY_NS: Final = 400_000

CUTTER: Final = Milling(
    spindle_hz=47.0,
    teeth=2,
    tool_tip=(0.0, 0.0, -0.15),
    mean_force=(160.0, 90.0, 120.0),
    cutting_moment=2.5,
    passes=((2.0, 9.5), (11.5, 18.5)),
)
"""Two passes at 2,820 rpm with a way back between them."""

LENGTH_STEP: Final = 1e-6
LENGTH_NOISE: Final = 0.5e-6
FORCE_NOISE: Final = 0.5
FORCE_STEP: Final = 0.05
MOMENT_NOISE: Final = 0.02
MOMENT_STEP: Final = 0.001
"""Standard deviations and resolutions of the sensors, m, N and N m."""


def pose(time: float) -> Array:
    """Return the platform's z, m, and rotations beta and gamma, rad, at a time."""
    grow = smooth(time / 3.0)[0]
    turn = 2.0 * math.pi * time
    return np.array(
        [
            -0.60 + grow * 0.06 * math.sin(turn * 0.08),
            grow * math.radians(8.0) * math.sin(turn * 0.11),
            grow * math.radians(7.0) * math.sin(turn * 0.07 + 0.6),
        ]
    )


def deflection_message(time_ns: int, solution: FrameSolution) -> dict[str, Any]:
    """Return a geometry_msgs/TransformStamped of translation and small rotation."""
    rotation = solution.deflection[3:]
    angle = float(np.linalg.norm(rotation))
    half = 0.5 * np.sinc(angle / (2.0 * math.pi))
    return {
        "header": header(time_ns, "base_link"),
        "child_frame_id": "platform_deflected",
        "transform": {
            "translation": vector3(solution.deflection[:3]),
            "rotation": {**vector3(half * rotation), "w": math.cos(angle / 2.0)},
        },
    }


def energy_message(time_ns: int, solution: FrameSolution) -> dict[str, Any]:
    """Return a diagnostic_msgs/DiagnosticArray: dominant element, total, share of each element."""
    total = sum(solution.energies.values())
    shares = {name: energy / total if total else 0.0 for name, energy in solution.energies.items()}
    dominant = max(shares, key=shares.__getitem__) if total else "none"
    values = [{"key": "total_energy", "value": repr(total)}]
    if total:
        values += [{"key": name, "value": repr(share)} for name, share in shares.items()]
    status = {
        "level": b"\x00",
        "name": "ground_truth: strain energy",
        "message": dominant,
        "hardware_id": "upr_rpu",
        "values": values,
    }
    return {"header": header(time_ns, "base_link"), "status": [status]}


def record(path: Path, seed: int = 20250102, progress: Progress | None = None) -> None:
    """Simulate and write the bag."""
    parameters = machine_parameters("upr_rpu")
    names: list[str] = parameters.get("joints") or ["limb_1", "limb_2", "limb_3"]
    frame = UprRpuFrame(parameters)
    count = round(DURATION * 1e9) // PERIOD_NS
    path_lengths = np.array([frame.limb_lengths(pose(k * PERIOD_NS * 1e-9)) for k in range(count)])
    limits = parameters.get("limits") or {}
    require_within(path_lengths, limits.get("limb_length"), "the limbs' length")
    capture = Capture(
        {
            "robot": "upr_rpu",
            "source": "simulated",
            "engine": "PyNite 3D frame, linear static",
            "engine_version": engine_version("PyNiteFEA"),
            "recorder": "bags.recording.record_upr_rpu",
            "parameters_sha256": parameters_digest(parameters),
            "seed": seed,
            "duration_s": DURATION,
            "spindle_Hz": CUTTER.spindle_hz,
            "tooth_passing_Hz": CUTTER.tooth_hz,
            "limb_length_step_m": LENGTH_STEP,
            "limb_length_noise_m": LENGTH_NOISE,
            "force_noise_N": FORCE_NOISE,
            "force_step_N": FORCE_STEP,
            "moment_noise_N_m": MOMENT_NOISE,
            "moment_step_N_m": MOMENT_STEP,
        }
    )
    capture.add_topic("/joint_states", "sensor_msgs/msg/JointState")
    capture.add_topic("/wrench", "geometry_msgs/msg/WrenchStamped")
    capture.add_topic("/ground_truth/deflection", "geometry_msgs/msg/TransformStamped")
    capture.add_topic("/ground_truth/strain_energy", "diagnostic_msgs/msg/DiagnosticArray")

    rng = np.random.default_rng(seed)
    spread = np.repeat((FORCE_NOISE, MOMENT_NOISE), 3)
    grain = np.repeat((FORCE_STEP, MOMENT_STEP), 3)
    for k in range(count):
        time_ns = k * PERIOD_NS
        time = time_ns * 1e-9
        here, wrench = pose(time), CUTTER.wrench(time)
        noise = LENGTH_NOISE * rng.normal(size=3)
        lengths = steps(path_lengths[k] + noise, LENGTH_STEP)
        measured = steps(wrench + spread * rng.normal(size=6), grain)
        capture.write(
            "/joint_states",
            joint_state(time_ns, names, lengths),
            time_ns + JOINT_STATE_LATENCY_NS,
        )
        capture.write(
            "/wrench",
            wrench_stamped(time_ns, "platform", measured),
            time_ns + WRENCH_LATENCY_NS,
        )
        if k % TRUTH_STRIDE == 0:
            axes = frame.placement(here)[1]
            fixed = np.concatenate((axes @ wrench[:3], axes @ wrench[3:]))
            solution = frame.solve(here, fixed)
            for topic, message in (
                ("/ground_truth/deflection", deflection_message(time_ns, solution)),
                ("/ground_truth/strain_energy", energy_message(time_ns, solution)),
            ):
                capture.write(topic, message, time_ns + TRUTH_LATENCY_NS)
        if progress is not None and k % 100 == 99:
            progress((k + 1) / count)
    capture.save(path)
