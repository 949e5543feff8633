# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Record upr_rpu_milling.mcap: a 2UPR-RPU head that mills while its platform moves slowly.

Deflection and strain energy come from the finite-element frame, quasi-static and linear, at the
true pose under the true load; the sensors see both with their steps and noise.

May import: numpy, the standard library, its neighbours in this package.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bags.recording.capture import (
    Capture,
    Progress,
    WrenchSensor,
    header,
    machine_parameters,
    require_within,
    smooth,
    steps,
    vector3,
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
"""Resolution and standard deviation of the limbs' lengths, m."""


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


def mill(
    name: str,
    topics: tuple[str, ...],
    seed: int,
    period_ns: int,
    stride: int,
    tell: Callable[[Capture, int, FrameSolution, np.random.Generator], None],
    softer: Mapping[str, float],
    before: Mapping[str, Any],
    after: Mapping[str, Any],
    progress: Progress | None,
) -> Capture:
    """Return a recording of the cut: lengths and wrenches, and what the frame does now and then.

    :param tell: writes a solution of the frame, every ``stride`` periods.
    :param softer: factors on the compliance of elements.
    :param before, after: what the metadata say before and after the sensors.
    """
    parameters = machine_parameters("upr_rpu")
    frame = UprRpuFrame({**parameters, "element_compliance": softer} if softer else parameters)
    count = round(DURATION * 1e9) // period_ns
    path_lengths = np.array([frame.limb_lengths(pose(k * period_ns * 1e-9)) for k in range(count)])
    limits = parameters.get("limits") or {}
    require_within(path_lengths, limits.get("limb_length"), "the limbs' length")
    sensor, rng = WrenchSensor(), np.random.default_rng(seed)
    facts = {
        **before,
        "limb_length_step_m": LENGTH_STEP,
        "limb_length_noise_m": LENGTH_NOISE,
        **sensor.facts(),
        **after,
    }
    engine = ("PyNite 3D frame, linear static", "PyNiteFEA")
    topics = ("/joint_states", "/wrench", *topics)
    capture = Capture(name, "upr_rpu", parameters, engine, seed, DURATION, topics, facts)
    for k in range(count):
        now = k * period_ns
        here, wrench = pose(now * 1e-9), CUTTER.wrench(now * 1e-9)
        noise = LENGTH_NOISE * rng.normal(size=3)
        capture.joint_state(now, steps(path_lengths[k] + noise, LENGTH_STEP))
        capture.wrench("/wrench", now, "platform", sensor.read(wrench, rng))
        if k % stride == 0:
            axes = frame.placement(here)[1]
            fixed = np.concatenate((axes @ wrench[:3], axes @ wrench[3:]))
            tell(capture, now, frame.solve(here, fixed), rng)
        if progress is not None and k % 100 == 99:
            progress((k + 1) / count)
    return capture


def truth(capture: Capture, now: int, solution: FrameSolution, _: np.random.Generator) -> None:
    """Write a solution of the frame as it is."""
    capture.write("/ground_truth/deflection", now, deflection_message(now, solution))
    capture.write("/ground_truth/strain_energy", now, energy_message(now, solution))


def record(path: Path, seed: int = 20250102, progress: Progress | None = None) -> None:
    """Simulate and write the bag."""
    topics = ("/ground_truth/deflection", "/ground_truth/strain_energy")
    facts = {"spindle_Hz": CUTTER.spindle_hz, "tooth_passing_Hz": CUTTER.tooth_hz}
    capture = mill("record_upr_rpu", topics, seed, PERIOD_NS, TRUTH_STRIDE, truth, {}, facts, {}, progress)
    capture.save(path)
