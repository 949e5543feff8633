# SPDX-License-Identifier: Apache-2.0
"""What the demonstration's closed loop found: PD against PD with feedforward on the same path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pkm_twin import load
from pkm_twin.apps.demo_report import Finding, share
from pkm_twin.bags.reader import read_messages
from pkm_twin.errors import BagError
from pkm_twin.messages.reading import JointReader
from pkm_twin.messages.stamps import SECOND, stamp_of
from pkm_twin.streams.path import JointPath

Array = NDArray[np.float64]

TIMES_BETTER = 5.0
"""How much smaller feedforward has to make the tracking error at the smallest spread."""
ROBOT = "delta_cu"
PERIOD = 2e-3
"""Of the machine's joint states, s: what a loaded computer can still record."""


@dataclass(frozen=True)
class Run:
    """One way along the path: its duration and times, s; errors (rad) and efforts (N m), (p, n)."""

    duration: float
    time: Array
    error: Array
    effort: Array

    @property
    def rms(self) -> float:
        """Root mean square of the tracking error over all joints."""
        return float(np.sqrt(np.mean(self.error**2)))


@dataclass(frozen=True)
class TrackingSeries:
    """By spread the run by PD alone and the one with feedforward."""

    joints: tuple[str, ...]
    runs: Mapping[float, tuple[Run, Run]]


def prefix(spread: float) -> str:
    """Under what a spread's topics stand in the recording."""
    return f"machine_sim_{100 * spread:g}_percent"


def report_tracking(
    recording: Path, spreads: Sequence[float]
) -> tuple[list[Finding], TrackingSeries]:
    """Tracking error and torque of every spread's two runs."""
    findings: list[Finding] = []
    runs = {}
    robot = load(ROBOT)
    for spread in spreads:
        name = prefix(spread)
        plain, ahead = runs[spread] = _runs(recording, name)
        findings.append(share(name, "joint states recorded", *_whole(plain, ahead)))
        ratio = plain.rms / ahead.rms
        bound = f"{TIMES_BETTER:g} or more" if spread == min(spreads) else ""
        for what, way in (("PD", plain), ("PD and feedforward", ahead)):
            peaks = ", ".join(f"{peak:.3g}" for peak in np.abs(way.effort).max(0))
            value = f"{1e3 * way.rms:.3f} mrad RMS, {1e3 * np.abs(way.error).max():.3f} worst"
            findings.append(Finding(name, f"tracking error, {what}", value))
            unit = robot.effort_unit
            findings.append(Finding(name, f"peak effort, {what}", f"{peaks} {unit}"))
        findings.append(
            Finding(
                name,
                f"feedforward at {100 * spread:g} % parameter error",
                f"{ratio:.1f} times better",
                bound,
                ratio >= TIMES_BETTER,
            )
        )
    return findings, TrackingSeries(robot.joint_names, runs)


def _whole(*runs: Run) -> tuple[int, int]:
    """How many of the runs' periods are there, and how many they had."""
    there = sum(len(run.time) for run in runs)
    return there, sum(round(run.duration / PERIOD) for run in runs)


def _runs(recording: Path, name: str) -> tuple[Run, Run]:
    """The two trajectories that the machine got, and the joint states while it went them."""
    reader = JointReader(load(ROBOT), with_effort=True)
    messages = read_messages(recording, [f"/{name}/joint_states"])
    states = {stamp_of(m.message.header): m.message for m in messages}
    stamps = np.array(sorted(states))
    moving = np.array([any(states[stamp].velocity) for stamp in stamps.tolist()])
    # A trajectory begins with the last joint state that stands still.
    starts = stamps[:-1][~moving[:-1] & moving[1:]]
    topic = f"/{name}/machine_sim/joint_trajectory"
    trajectories = [reader.trajectory(m.message, 0) for m in read_messages(recording, [topic])]
    found: dict[bool, Run] = {}
    for trajectory, start in zip(trajectories, starts.tolist(), strict=False):
        path = JointPath(trajectory)
        end = start + round(path.duration * SECOND)
        during = stamps[(stamps > start) & (stamps <= end)].tolist()
        # In the machine's order of joints, the robot's.
        q = np.array([states[s].position for s in during])
        times = (np.array(during) - start) / SECOND
        wanted = np.array([path.at(t).q for t in times.tolist()])
        effort = np.array([states[s].effort for s in during])
        found[trajectory.effort is not None] = Run(path.duration, times, q - wanted, effort)
    if len(found) != 2 or len(starts) != 2:
        raise BagError(f"{name}: {len(found)} of two runs were recorded", path=recording)
    return found[False], found[True]
