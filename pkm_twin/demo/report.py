# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Evaluate the recording of the demonstration: figures, verdicts and a picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from delta_dynamics import inverse_dynamics
from pkm_twin import load
from pkm_twin.bags.reader import inspect, read_messages
from pkm_twin.codegen.arrays import Array, Indices, Mask
from pkm_twin.messages.stamps import stamp_of
from pkm_twin.recordings import ReadOptions, Recording, read
from pkm_twin.recordings.recording import differentiate_motion
from pkm_twin.report import Fact, make_judged_fact, plots
from pkm_twin.streams.rates import rms

MIN_ANSWERED = 0.95
"""Smallest fraction of the samples that must be answered."""

MAX_DEFLECTION_ERROR = 0.02
"""Largest RMS difference to the finite-element deflection, relative to its RMS. Noise of wrench and
encoders gives 0.4 %, a wrench in wrong axes 8 %."""


@dataclass(frozen=True)
class Panel:
    """A panel of the picture over time, s; ``lines``: times, values and style of each line."""

    title: str
    upright: str
    lines: list[tuple[Array, Array, dict[str, Any]]]


def _select_window(time: Array, seconds: float, all_times: Array) -> Mask:
    """Select ``seconds`` s of samples from one eighth of the recording on, after the start."""
    begin = float(all_times[len(all_times) // 8]) if len(all_times) else 0.0
    return (time >= begin) & (time <= begin + seconds)


def report_dynamics(bag: Path, recording: Path, prefix: str) -> tuple[list[Fact], Panel]:
    """Compare recorded efforts with those that the node published."""
    r = read(bag, how=ReadOptions(limited=True))
    robot, unit = r.robot, " or ".join(dict.fromkeys(r.robot.effort_units))
    torques = _read_by_stamp(recording, f"/{prefix}/delta_dynamics/joint_torques")
    residuals = _read_by_stamp(recording, f"/{prefix}/delta_dynamics/torque_residual")
    answered = [i for i, s in enumerate(r.stamps.tolist()) if s in torques and s in residuals]
    stamps, time = r.stamps[answered].tolist(), r.time[answered]
    predicted, residual = (
        np.array([found[stamp].effort for stamp in stamps]).reshape(-1, len(robot.joint_names))
        for found in (torques, residuals)
    )
    measured = np.zeros_like(predicted) if r.effort is None else r.effort[answered]
    window = _select_window(time, 2.0, time)
    size = f", residual RMS {rms(residual[window])[0]:.2g} {unit}" if window.any() else ""
    panel = Panel(
        f"{prefix}:\neffort of {robot.joint_names[0]}{size}",
        f"effort ({unit})",
        [
            (time[window], measured[window, 0], {"color": "0.6", "lw": 2.5, "label": "recorded"}),
            (time[window], predicted[window, 0], {"color": plots.COLOURS[1], "lw": 1, "label": "twin"}),
        ],
    )
    sent = sum(1 for _ in read_messages(bag, ["/delta_dynamics/joint_trajectory"]))
    filled = read_messages(recording, [f"/{prefix}/delta_dynamics/joint_trajectory_ff"])
    findings = [
        judge_share(prefix, "joint states answered", len(stamps), len(r.stamps)),
        judge_share(prefix, "trajectories answered", sum(1 for _ in filled), sent),
    ]
    if not stamps:
        return findings, panel

    def judge_residual(what: str, rows: Mask, bound: float) -> Fact:
        part = rms(residual[rows]) / np.abs(measured).max(0)
        return make_judged_fact(
            f"{prefix}: residual RMS {what}",
            _format_list(100 * part, "% of peak"),
            f"below {100 * bound:g} %",
            bool((part < bound).all()),
        )

    # Find samples without payload or cutting force, at least half a second away from either.
    if r.load is not None:
        loaded = r.load.is_on_platform(r.time)
    elif r.wrench is not None:
        force = np.linalg.norm(r.wrench[:, :3], axis=1)
        loaded = force > 0.1 * force.max()
    else:
        loaded = np.zeros(len(r.time), bool)
    edge = r.time[loaded]
    if not len(edge):
        free = ~loaded
    else:
        after = np.minimum(np.searchsorted(edge, r.time), len(edge) - 1)
        before = np.maximum(after - 1, 0)
        nearest = np.minimum(np.abs(edge[after] - r.time), np.abs(edge[before] - r.time))
        free = np.asarray(nearest > 0.5, np.bool_)
    free = free[answered]
    findings += [
        unjudged_fact(prefix, "peak effort", _format_list(np.abs(predicted).max(0), unit)),
        unjudged_fact(prefix, "RMS effort", _format_list(rms(predicted), unit)),
        judge_residual("without load", free, 0.05),
    ]
    if r.wrench is not None:
        # Samples with a cutting force, which the node received.
        # Without the wrench the residual is 15 %.
        findings.append(judge_residual("while cutting", ~free, 0.01))
    if r.load is not None and r.load.times:
        begin, end = r.load.times[0]
        held = (time > begin + 0.5) & (time < end - 0.5)
        findings += _judge_payload(prefix, r, residual, free, np.array(answered), held)
    return findings, panel


def _judge_payload(prefix: str, r: Recording, residual: Array, free: Mask, answered: Indices, held: Mask) -> list[Fact]:
    assert r.load is not None  # noqa: S101
    change = residual[held] - residual[free].mean(0)
    step = np.linalg.norm(change.mean(0))
    scatter = np.linalg.norm(np.std(residual[free], 0))
    # Efforts of one kilogram along the recorded motion.
    qd, qdd, _ = differentiate_motion(r)
    state = [values[answered[held]] for values in (r.q, qd, qdd)]
    kilogram = inverse_dynamics(r.robot.changed(payload={"mass": 1.0}), *state)
    kilogram -= inverse_dynamics(r.robot, *state)
    mass = float(np.sum(kilogram * change) / np.sum(kilogram**2))
    return [
        make_judged_fact(
            f"{prefix}: step of the residual at the pick",
            f"{step:.3f} {' or '.join(dict.fromkeys(r.robot.effort_units))}, {step / scatter:.1f} times its scatter",
            "above 3 times",
            bool(step > 3 * scatter),
        ),
        make_judged_fact(
            f"{prefix}: payload mass seen in the residual",
            f"{mass:.3f} kg (recorded with {r.load.mass:.3f} kg)",
            "within 10 %",
            abs(mass - r.load.mass) < 0.1 * r.load.mass,
        ),
    ]


def report_stiffness(bag: Path, recording: Path, prefix: str) -> tuple[list[Fact], Panel]:
    """Compare published deflections with the finite-element frame, and list dominant elements."""
    wrenches = _read_by_stamp(bag, "/wrench")
    energies = _read_by_stamp(recording, f"/{prefix}/stiffness_monitor/strain_energy")
    deflections = _read_by_stamp(recording, f"/{prefix}/stiffness_monitor/deflection")
    truth = _read_by_stamp(bag, "/ground_truth/deflection")
    robot = load(inspect(bag).metadata["pkm_twin"]["robot"])
    start = min(wrenches)
    common = sorted(set(wrenches) & set(energies) & set(deflections))
    values = {stamp: {v.key: v.value for v in energies[stamp].status[0].values} for stamp in common}
    pose = np.array([[float(values[s][name]) for name in robot.pose_names] for s in common])
    local = np.array([_xyz(deflections[s].transform.translation) for s in common]).reshape(-1, 3)
    fixed = np.einsum("nij,nj->ni", robot.rotation(pose.reshape(-1, len(robot.pose_names))), local)
    compared = [s for s in common if s in truth]
    true = np.array([_xyz(truth[s].transform.translation) for s in compared]).reshape(-1, 3)
    panel = Panel(f"{prefix}: deflection (dots: finite elements)", "deflection (µm)", [])
    times = [(np.array(stamps) - start) / 1e9 for stamps in (common, compared)]
    curves: dict[str, Any] = {"lw": 0.8}
    dots = {"marker": "o", "ls": "", "ms": 4, "mec": "black", "mew": 0.4}
    for time, moves, style in zip(times, (fixed, true), (curves, dots), strict=True):
        part = _select_window(time, 0.6, times[0])
        for i, axis in enumerate("xyz"):
            name = {} if style is dots else {"label": axis}
            line = (time[part], 1e6 * moves[part, i], {"color": plots.COLOURS[i], **style, **name})
            panel.lines.append(line)
    findings = [judge_share(prefix, "wrenches answered", len(common), len(wrenches))]
    if not common:
        return findings, panel
    dominant = Counter(energies[s].status[0].message for s in common)
    findings.append(
        unjudged_fact(
            prefix,
            "dominant element over time",
            ", ".join(f"{e} {100 * n / len(common):.0f} %" for e, n in dominant.most_common(4)),
        )
    )
    largest = np.linalg.norm(fixed, axis=1).max()
    findings.append(unjudged_fact(prefix, "largest deflection", f"{1e6 * largest:.2f} µm"))
    findings.append(judge_share(prefix, "deflections with ground truth", len(compared), len(truth)))
    if compared:
        place = np.searchsorted(common, compared)
        greatest = 1e6 * np.linalg.norm(true, axis=1).max()
        error = np.sqrt(np.mean(np.sum((fixed[place] - true) ** 2, 1)) / np.mean(np.sum(true**2, 1)))
        findings.append(
            make_judged_fact(
                f"{prefix}: RMS difference to the frame's deflection",
                f"{100 * error:.1f} % (frame's largest {greatest:.2f} µm)",
                f"below {100 * MAX_DEFLECTION_ERROR:g} %",
                bool(error < MAX_DEFLECTION_ERROR),
            )
        )
    return findings, panel


Reports = Callable[[Path, Path, str], tuple[list[Fact], Panel]]
REPORTS: dict[str, Reports] = {
    "delta_cu_pick_and_place": report_dynamics,
    "prru_milling": report_dynamics,
    "upr_rpu_milling": report_stiffness,
}


def _read_by_stamp(bag: Path, topic: str) -> dict[int, Any]:
    return {stamp_of(m.message.header): m.message for m in read_messages(bag, [topic])}


def judge_share(bag: str, what: str, count: int, total: int) -> Fact:
    """Judge a count as a fraction of a total by :data:`MIN_ANSWERED`."""
    return make_judged_fact(
        f"{bag}: {what}",
        f"{count} of {total}",
        f"{100 * MIN_ANSWERED:g} % or more",
        total > 0 and count >= MIN_ANSWERED * total,
    )


def unjudged_fact(bag: str, what: str, words: str) -> Fact:
    """Make a fact that is reported without a verdict."""
    return Fact("", words, text=f"{bag}: {what}")


def _format_list(values: Array, unit: str) -> str:
    return ", ".join(f"{v:.3g}" for v in values) + f" {unit}"


def _xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def draw(panels: Sequence[Panel], path: Path) -> Path:
    """Draw one picture with a panel for each stage."""
    figure, columns = plots.make_subplots(2, 2, 8)
    axes = [columns[k % 2][k // 2] for k in range(4)]
    for ax, panel in zip(axes, panels, strict=False):
        for time, values, style in panel.lines:
            ax.plot(time, values, **style)
        plots.label(ax, "time (s)", panel.upright, panel.title)
        plots.legend(ax, below=True)
    for ax in axes[len(panels) :]:
        ax.set_visible(False)
    return plots.save(figure, path)
