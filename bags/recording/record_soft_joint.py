# SPDX-License-Identifier: Apache-2.0
"""Record upr_rpu_soft_joint.mcap: the milling head with one joint three times softer.

The same motion and cuts as in upr_rpu_milling.mcap, on the same frame engine; beside the sensors
of that bag an instrument measures the platform's deflection.

May import: numpy, the standard library, its neighbours in this package.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from bags.recording.capture import (
    Capture,
    Progress,
    engine_version,
    joint_state,
    machine_parameters,
    parameters_digest,
    require_within,
    steps,
    wrench_stamped,
)
from bags.recording.frame_model import FrameSolution, UprRpuFrame
from bags.recording.record_upr_rpu import (
    CUTTER,
    FORCE_NOISE,
    FORCE_STEP,
    JOINT_STATE_LATENCY_NS,
    LENGTH_NOISE,
    LENGTH_STEP,
    MOMENT_NOISE,
    MOMENT_STEP,
    TRUTH_LATENCY_NS,
    WRENCH_LATENCY_NS,
    deflection_message,
    pose,
)

NAME: Final = "upr_rpu_soft_joint"
DURATION: Final = 20.0
"""Length of the recording, s."""
PERIOD_NS: Final = 10_000_000
"""Measurement period of wrench and limb lengths."""
DEFLECTION_STRIDE: Final = 5
"""Measurement periods between two measured deflections."""
SOFT: Final = {"3U": 3.0}
"""Factors on the compliance of elements."""
SHIFT_NOISE: Final = 0.1e-6
TURN_NOISE: Final = 0.2e-6
"""Standard deviations of the measured deflection, m and rad."""


def record(path: Path, seed: int = 20261122, progress: Progress | None = None) -> None:
    """Simulate and write the bag."""
    parameters = machine_parameters("upr_rpu")
    names: list[str] = parameters.get("joints") or ["limb_1", "limb_2", "limb_3"]
    frame = UprRpuFrame(parameters | {"element_compliance": SOFT})
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
            "recorder": "bags.recording.record_soft_joint",
            "parameters_sha256": parameters_digest(parameters),
            "seed": seed,
            "duration_s": DURATION,
            "softer_elements": ", ".join(f"{k} by {v:g}" for k, v in SOFT.items()),
            "limb_length_step_m": LENGTH_STEP,
            "limb_length_noise_m": LENGTH_NOISE,
            "force_noise_N": FORCE_NOISE,
            "force_step_N": FORCE_STEP,
            "moment_noise_N_m": MOMENT_NOISE,
            "moment_step_N_m": MOMENT_STEP,
            "deflection_noise_m": SHIFT_NOISE,
            "deflection_noise_rad": TURN_NOISE,
        }
    )
    capture.add_topic("/joint_states", "sensor_msgs/msg/JointState")
    capture.add_topic("/wrench", "geometry_msgs/msg/WrenchStamped")
    capture.add_topic("/measured_deflection", "geometry_msgs/msg/TransformStamped")
    rng = np.random.default_rng(seed)
    spread = np.repeat((FORCE_NOISE, MOMENT_NOISE), 3)
    grain = np.repeat((FORCE_STEP, MOMENT_STEP), 3)
    unsure = np.repeat((SHIFT_NOISE, TURN_NOISE), 3)
    for k in range(count):
        time_ns = k * PERIOD_NS
        here, wrench = pose(time_ns * 1e-9), CUTTER.wrench(time_ns * 1e-9)
        lengths = steps(path_lengths[k] + LENGTH_NOISE * rng.normal(size=3), LENGTH_STEP)
        measured = steps(wrench + spread * rng.normal(size=6), grain)
        capture.write(
            "/joint_states",
            joint_state(time_ns, names, lengths),
            time_ns + JOINT_STATE_LATENCY_NS,
        )
        capture.write(
            "/wrench", wrench_stamped(time_ns, "platform", measured), time_ns + WRENCH_LATENCY_NS
        )
        if k % DEFLECTION_STRIDE == 0:
            axes = frame.placement(here)[1]
            fixed = np.concatenate((axes @ wrench[:3], axes @ wrench[3:]))
            moved = frame.solve(here, fixed).deflection + unsure * rng.normal(size=6)
            capture.write(
                "/measured_deflection",
                deflection_message(time_ns, FrameSolution(moved, {})),
                time_ns + TRUTH_LATENCY_NS,
            )
        if progress is not None and k % 100 == 99:
            progress((k + 1) / count)
    capture.save(path)
