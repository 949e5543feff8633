# SPDX-License-Identifier: Apache-2.0
"""What the demonstration found: figures, verdicts and a picture, read from its recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import inverse_dynamics
from pkm_twin import load
from pkm_twin.bags.reader import inspect, read_messages
from pkm_twin.codegen.arrays import Array
from pkm_twin.messages.stamps import stamp_of
from pkm_twin.recordings import ReadOptions, Recording, read
from pkm_twin.recordings.recording import differentiated
from pkm_twin.report import Fact, plots
from pkm_twin.report import judged as judge
from pkm_twin.robot.robot import Robot

MAX_RESIDUAL = 0.05
"""Largest residual RMS without payload, part of the joint's peak effort."""

MAX_CUTTING_RESIDUAL = 0.01
"""Largest residual RMS while cutting, likewise: without the wrench it is 0.15."""

MIN_ANSWERED = 0.95
"""Least part of the samples that has to be answered."""

MAX_DEFLECTION_ERROR = 0.02
"""Largest RMS difference to the frame's deflection, part of its RMS: noise of wrench and encoders
makes 0.4 %; a wrench left unturned, 8 %."""


@dataclass(frozen=True)
class DynamicsSeries:
    """A recorded joint-state stream and the twin's answer, on common times."""

    title: str
    joints: tuple[str, ...]
    unit: str
    time: Array
    measured: Array
    predicted: Array
    residual: Array
    free: NDArray[np.bool_]
    """Where neither payload nor cutting force is on the platform."""
    loaded: tuple[float, float] | None

    def draw(self, ax: Any) -> None:
        """Recorded and predicted effort of the first joint over two seconds."""
        middle = float(self.time[len(self.time) // 8]) if len(self.time) else 0.0
        near = (self.time >= middle) & (self.time <= middle + 2.0)
        ax.plot(self.time[near], self.measured[near, 0], color="0.6", lw=2.5, label="recorded")
        ax.plot(
            self.time[near], self.predicted[near, 0], color=plots.COLOURS[1], lw=1, label="twin"
        )
        ax.set_title(f"{self.title}: effort of {self.joints[0]}")
        ax.set_ylabel(f"effort ({self.unit})")


@dataclass(frozen=True)
class StiffnessSeries:
    """Deflection over time, and the frame's ground truth."""

    title: str
    time: Array
    deflection: Array
    truth_time: Array
    truth: Array

    def draw(self, ax: Any) -> None:
        """Deflection of the platform and that of a finite-element frame over 0.6 seconds."""
        begin = float(self.time[len(self.time) // 8]) if len(self.time) else 0.0
        part, true = (
            (time >= begin) & (time <= begin + 0.6) for time in (self.time, self.truth_time)
        )
        for i, axis in enumerate("xyz"):
            ax.plot(
                self.time[part], 1e6 * self.deflection[part, i],
                color=plots.COLOURS[i], lw=0.8, label=axis,
            )  # fmt: skip
            ax.plot(
                self.truth_time[true], 1e6 * self.truth[true, i], "o",
                color=plots.COLOURS[i], ms=4, mec="black", mew=0.4,
            )  # fmt: skip
        ax.set_title(f"{self.title}: deflection (dots: finite elements)")
        ax.set_ylabel("deflection (µm)")


def report_dynamics(bag: Path, recording: Path, prefix: str) -> tuple[list[Fact], DynamicsSeries]:
    """Compare recorded efforts with the answered ones."""
    r = read(bag, how=ReadOptions(limited=True))
    robot, unit = r.robot, " or ".join(dict.fromkeys(r.robot.effort_units))
    torques = _by_stamp(recording, f"/{prefix}/delta_dynamics/joint_torques")
    residuals = _by_stamp(recording, f"/{prefix}/delta_dynamics/torque_residual")
    answered = [i for i, s in enumerate(r.stamps.tolist()) if s in torques and s in residuals]
    stamps = r.stamps[answered].tolist()
    measured = (
        np.zeros((len(stamps), len(robot.joint_names))) if r.effort is None else r.effort[answered]
    )
    series = DynamicsSeries(
        prefix,
        robot.joint_names,
        unit,
        r.time[answered],
        measured,
        _efforts(torques, stamps, robot),
        _efforts(residuals, stamps, robot),
        _free(r)[answered],
        _loaded(r),
    )
    sent = sum(1 for _ in read_messages(bag, ["/delta_dynamics/joint_trajectory"]))
    filled = read_messages(recording, [f"/{prefix}/delta_dynamics/joint_trajectory_ff"])
    findings = [
        share(prefix, "joint states answered", len(stamps), len(r.stamps)),
        share(prefix, "trajectories answered", sum(1 for _ in filled), sent),
    ]
    if not stamps:
        return findings, series
    peak = np.abs(series.predicted).max(0)
    findings.append(told(prefix, "peak effort", _listed(peak, unit)))
    rms = np.sqrt(np.mean(series.predicted**2, 0))
    findings.append(told(prefix, "RMS effort", _listed(rms, unit)))
    free = series.free
    part = np.sqrt(np.mean(series.residual[free] ** 2, 0)) / np.abs(series.measured).max(0)
    findings.append(
        judge(
            f"{prefix}: residual RMS without load",
            _listed(100 * part, "% of peak"),
            f"below {100 * MAX_RESIDUAL:g} %",
            bool((part < MAX_RESIDUAL).all()),
        )
    )
    if r.wrench is not None:
        findings.append(_cutting(prefix, series))
    if series.loaded is not None:
        findings += _payload(prefix, r, answered, series)
    return findings, series


def _cutting(prefix: str, series: DynamicsSeries) -> Fact:
    """The residual where a force acts, which the node was told."""
    cut = series.residual[~series.free]
    part = np.sqrt(np.mean(cut**2, 0)) / np.abs(series.measured).max(0)
    return judge(
        f"{prefix}: residual RMS while cutting",
        _listed(100 * part, "% of peak"),
        f"below {100 * MAX_CUTTING_RESIDUAL:g} %",
        bool((part < MAX_CUTTING_RESIDUAL).all()),
    )


def _loaded(r: Recording) -> tuple[float, float] | None:
    """From when to when a payload is held, s: one span in these recordings."""
    return r.load.times[0] if r.load is not None and r.load.times else None


def _free(r: Recording) -> NDArray[np.bool_]:
    """Where nothing is held and nothing cut; half a second around either counts for neither."""
    if r.load is not None:
        loaded = r.load.held(r.time)
    elif r.wrench is not None:
        force = np.linalg.norm(r.wrench[:, :3], axis=1)
        loaded = force > 0.1 * force.max()
    else:
        loaded = np.zeros(len(r.time), bool)
    edge = r.time[loaded]
    if not len(edge):
        return ~loaded
    after = np.minimum(np.searchsorted(edge, r.time), len(edge) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.minimum(np.abs(edge[after] - r.time), np.abs(edge[before] - r.time))
    return np.asarray(nearest > 0.5, np.bool_)


def _payload(prefix: str, r: Recording, answered: list[int], series: DynamicsSeries) -> list[Fact]:
    """The step that the payload makes in the residual, and the mass that it means."""
    assert series.loaded is not None and r.load is not None  # noqa: S101
    free = series.free
    held = (series.time > series.loaded[0] + 0.5) & (series.time < series.loaded[1] - 0.5)
    step = np.linalg.norm(series.residual[held].mean(0) - series.residual[free].mean(0))
    scatter = np.linalg.norm(np.std(series.residual[free], 0))
    # What one kilogram would need, along the recorded motion.
    qd, qdd, _ = differentiated(r)
    state = [values[answered][held] for values in (r.q, qd, qdd)]
    kilogram = inverse_dynamics(r.robot.changed(payload={"mass": 1.0}), *state)
    kilogram -= inverse_dynamics(r.robot, *state)
    change = series.residual[held] - series.residual[free].mean(0)
    mass = float(np.sum(kilogram * change) / np.sum(kilogram**2))
    return [
        judge(
            f"{prefix}: step of the residual at the pick",
            f"{step:.3f} {series.unit}, {step / scatter:.1f} times its scatter",
            "above 3 times",
            bool(step > 3 * scatter),
        ),
        judge(
            f"{prefix}: payload mass seen in the residual",
            f"{mass:.3f} kg (recorded with {r.load.mass:.3f} kg)",
            "within 10 %",
            abs(mass - r.load.mass) < 0.1 * r.load.mass,
        ),
    ]


def report_stiffness(bag: Path, recording: Path, prefix: str) -> tuple[list[Fact], StiffnessSeries]:
    """Compare answered deflections with the frame's, and say what dominated."""
    wrenches = _by_stamp(bag, "/wrench")
    energies = _by_stamp(recording, f"/{prefix}/stiffness_monitor/strain_energy")
    moved = _by_stamp(recording, f"/{prefix}/stiffness_monitor/deflection")
    truth = _by_stamp(bag, "/ground_truth/deflection")
    robot = load(inspect(bag).metadata["pkm_twin"]["robot"])
    start = min(wrenches)
    common = sorted(set(wrenches) & set(energies) & set(moved))
    values = {stamp: {v.key: v.value for v in energies[stamp].status[0].values} for stamp in common}
    pose = np.array([[float(values[s][name]) for name in robot.pose_names] for s in common])
    local = np.array([_xyz(moved[s].transform.translation) for s in common]).reshape(-1, 3)
    fixed = np.einsum("nij,nj->ni", robot.rotation(pose.reshape(-1, len(robot.pose_names))), local)
    judged = [s for s in common if s in truth]
    true = np.array([_xyz(truth[s].transform.translation) for s in judged]).reshape(-1, 3)
    series = StiffnessSeries(
        prefix,
        (np.array(common) - start) / 1e9,
        fixed,
        (np.array(judged) - start) / 1e9,
        true,
    )
    findings = [share(prefix, "wrenches answered", len(common), len(wrenches))]
    if not common:
        return findings, series
    dominant = Counter(energies[s].status[0].message for s in common)
    findings.append(
        told(
            prefix,
            "dominant element over time",
            ", ".join(f"{e} {100 * n / len(common):.0f} %" for e, n in dominant.most_common(4)),
        )
    )
    largest = np.linalg.norm(fixed, axis=1).max()
    findings.append(told(prefix, "largest deflection", f"{1e6 * largest:.2f} µm"))
    findings.append(share(prefix, "deflections with ground truth", len(judged), len(truth)))
    if judged:
        place = np.searchsorted(common, judged)
        greatest = 1e6 * np.linalg.norm(true, axis=1).max()
        error = np.sqrt(
            np.mean(np.sum((fixed[place] - true) ** 2, 1)) / np.mean(np.sum(true**2, 1))
        )
        findings.append(
            judge(
                f"{prefix}: RMS difference to the frame's deflection",
                f"{100 * error:.1f} % (frame's largest {greatest:.2f} µm)",
                f"below {100 * MAX_DEFLECTION_ERROR:g} %",
                bool(error < MAX_DEFLECTION_ERROR),
            )
        )
    return findings, series


Reports = Callable[[Path, Path, str], tuple[list[Fact], Any]]
REPORTS: dict[str, Reports] = {
    "delta_cu_pick_and_place": report_dynamics,
    "prru_milling": report_dynamics,
    "upr_rpu_milling": report_stiffness,
}


def _by_stamp(bag: Path, topic: str) -> dict[int, Any]:
    return {stamp_of(m.message.header): m.message for m in read_messages(bag, [topic])}


def _efforts(messages: Mapping[int, Any], stamps: list[int], robot: Robot) -> Array:
    """Efforts in the order that the node publishes, the robot's, shape (samples, n)."""
    efforts = [messages[stamp].effort for stamp in stamps]
    return np.array(efforts).reshape(-1, len(robot.joint_names))


def share(bag: str, what: str, count: int, total: int) -> Fact:
    """How many of so many there are, judged by :data:`MIN_ANSWERED`."""
    return judge(
        f"{bag}: {what}",
        f"{count} of {total}",
        f"{100 * MIN_ANSWERED:g} % or more",
        total > 0 and count >= MIN_ANSWERED * total,
    )


def told(bag: str, what: str, words: str) -> Fact:
    """A figure that is not judged."""
    return Fact("", words, text=f"{bag}: {what}")


def _listed(values: Array, unit: str) -> str:
    return ", ".join(f"{v:.3g}" for v in values) + f" {unit}"


def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def draw(series: Mapping[str, Any], path: Path) -> Path:
    """One picture of all stages: a panel each."""
    figure, columns = plots.columns(2, 2)
    panels = [columns[k % 2][k // 2] for k in range(4)]
    for ax, data in zip(panels, series.values(), strict=False):
        data.draw(ax)
        ax.set_xlabel("time (s)")
        ax.legend(loc="best")
        ax.grid(alpha=0.3)
    for ax in panels[len(series) :]:
        ax.set_visible(False)
    return plots.save(figure, path)
