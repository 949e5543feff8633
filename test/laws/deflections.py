# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings of loads and deflections, for tests: of the independent frame, and of the twin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pkm_twin.recordings import ReadOptions, Recording, read
from stiffness_monitor.response import ElementResponse, element_response
from test.support.robots import load

BAGS = Path(__file__).resolve().parents[2] / "bags"


@cache
def frame_recording(factors: tuple[tuple[str, float], ...] = (), count: int = 200) -> Recording:
    """The milling bag's motion and loads on PyNite's frame with softer elements, without noise."""
    pytest.importorskip("Pynite")
    from bags.recording.capture import machine_parameters
    from bags.recording.frame_model import UprRpuFrame
    from bags.recording.record_upr_rpu import CUTTER, pose

    frame = UprRpuFrame(machine_parameters("upr_rpu") | {"element_compliance": dict(factors)})
    rows = []
    for time in np.linspace(0.0, 20.0, count, endpoint=False):
        here, wrench = pose(time), CUTTER.wrench(time)
        axes = frame.placement(here)[1]
        fixed = np.concatenate((axes @ wrench[:3], axes @ wrench[3:]))
        rows.append((time, frame.limb_lengths(here), fixed, frame.solve(here, fixed).deflection))
    time, q, wrench, moved = (np.array(column) for column in zip(*rows, strict=True))
    return Recording(load("upr_rpu"), time, q, wrench=wrench, deflection=moved, source="frame")


@cache
def bag_recording() -> tuple[Recording, ElementResponse]:
    """What the bag of a soft joint has, and the sound twin in its poses."""
    robot = load("upr_rpu")
    recording = read(BAGS / "upr_rpu_soft_joint.mcap", robot, ReadOptions(deflected=True))
    return recording, element_response(robot, robot.forward(recording.q))


def twin_recording(factors: Mapping[str, float]) -> Recording:
    """The bag's poses and loads, and what they do to the twin with softer elements."""
    recording, response = bag_recording()
    each = [factors.get(name, 1.0) for name in response.names]
    moved, _ = response.deflection(recording.wrench, each)
    return replace(recording, deflection=moved)


def noisy(clean: Recording, rng: np.random.Generator, sizes: Mapping[str, float]) -> Recording:
    """With noise of the sensors: lengths, forces, moments, shifts and turns, SI."""
    n = rng.normal

    def pairs(values: np.ndarray, first: str, second: str) -> np.ndarray:
        return values + n(size=values.shape) * np.repeat([sizes[first], sizes[second]], 3)

    q = clean.q + n(size=clean.q.shape) * sizes["length"]
    wrench = pairs(clean.wrench, "force", "moment")
    return replace(clean, q=q, wrench=wrench, deflection=pairs(clean.deflection, "shift", "turn"))


SENSORS = {"length": 0.5e-6, "force": 0.5, "moment": 0.02, "shift": 0.1e-6, "turn": 0.2e-6}
