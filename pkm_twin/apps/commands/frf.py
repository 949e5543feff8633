# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin frf``: the frequency response of the tool point at a pose."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import OutputOption, PictureOptions, PoseOption, ToolOptions
from pkm_twin.recordings.tables import WRITABLE_SUFFIXES, write_table
from pkm_twin.report import Fact, Report, plots
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pkm_twin.codegen.arrays import Array
    from pkm_twin.robot.robot import Robot
    from stiffness_monitor.vibration import ToolModes, ToolResponse


@dataclass(frozen=True, kw_only=True)
class FrequencyResponse(PoseOption, ToolOptions, OutputOption, PictureOptions):
    """Compute the frequency response of the tool point at a pose.

    The response is the displacement per harmonic force (receptance), actuators locked, of the
    elastic frame with its masses and modal damping. The command prints natural frequencies, and the
    frequency and direction in which the tool point responds most. Without damping it prints natural
    frequencies only.

    The table has the columns frequency (Hz) and, for each pair of directions in base axes,
    real and imaginary part (m/N): xx.real, xx.imag, xy.real, ... xy is the displacement along x per
    force along y.
    """

    frequencies: tuple[float, ...] | None = setting(
        None, "range of the table, Hz; default: 0 to above the sixth mode", count=2, metavar="LOW,HIGH"
    )
    points: int = setting(2001, "rows of the table", low=2, high=10**6)
    out: Path | None = setting(None, "table to write, .csv, .parquet or .mat", writes=True, endings=WRITABLE_SUFFIXES)


@command("Stiffness, workspace and vibration")
def frf(given: FrequencyResponse) -> Report:
    """Compute the modes and the frequency response at the tool point."""
    from stiffness_monitor.modes import natural_frequencies
    from stiffness_monitor.vibration import tool_modes

    machine = given.machine()
    pose = given.pose(machine)
    damped = given.damping is not None or machine.modal_damping.size
    if not damped and given.out is None and given.picture is None:
        frequencies = natural_frequencies(machine, pose)
        return Report(
            f"{machine.name}: lowest natural frequency {frequencies[0]:.4g} Hz",
            report_modes(machine, pose, frequencies),
            notes=["the response needs --damping, or modal_damping in the robot file"],
        )
    modes = tool_modes(machine, pose, damping=given.damping, tool=given.tool)
    low, high = given.frequencies or (0.0, 1.2 * float(modes.frequencies[:6][-1]))
    found = modes.respond(low, high, given.points)
    along = ", ".join(f"{v:.3g}" for v in found.direction.round(3) + 0.0)
    answer = (
        f"{machine.name}: the tool point responds most at {found.peak_frequency:.4g} Hz along ({along}): "
        f"{1e6 * found.peak:.4g} µm/N, {found.amplification:.3g} times the static compliance"
    )
    if given.out is not None:
        write_table(found.columns(), given.out)
    most = {"frequency_hz": found.peak_frequency, "compliance_m_per_n": found.peak, "direction": found.direction}
    return Report(
        answer,
        [
            *report_modes(machine, pose, modes.frequencies, modes.damping),
            Fact("static_compliance_m_per_n", found.static),
            Fact("most", most),
        ],
        figures={"": lambda: draw(found, modes, answer)},
        files={"out": given.out},
    )


def report_modes(machine: Robot, pose: list[float], frequencies: Array, damping: Array | None = None) -> list[Fact]:
    """Report the robot, the pose, and its six lowest modes."""
    found = [{"frequency_hz": f} for f in frequencies[:6].tolist()]
    texts = [f"{f:.4g} Hz" for f in frequencies[:6].tolist()]
    for k, ratio in enumerate([] if damping is None else damping[:6].tolist()):
        found[k]["damping"] = ratio
        texts[k] += f" ({100 * ratio:.3g} %)"
    what = "modes" if damping is None else "modes (damping)"
    return [
        Fact("robot", machine.name),
        Fact("pose", dict(zip(machine.pose_names, pose, strict=True))),
        Fact("modes", found, text=what, shown=", ".join(texts)),
    ]


def draw(found: ToolResponse, modes: ToolModes, title: str) -> Figure:
    """Draw magnitude and phase of the response along each axis over the frequency."""
    figure, axes = plots.make_subplots(1, 2)
    size, phase = axes[0]
    grid = found.frequencies
    for k, name in enumerate("xyz"):
        one = found.response[:, k, k]
        style: dict[str, Any] = {"color": plots.COLOURS[k], "ls": plots.LINE_STYLES[k]}
        size.semilogy(grid, 1e6 * np.abs(one), label=f"along {name}", **style)
        phase.plot(grid, np.degrees(np.angle(one)), **style)
    for frequency in modes.frequencies[modes.frequencies <= grid[-1]]:
        size.axvline(frequency, color="0.8", lw=0.8, zorder=0)
    plots.write_title(figure, title)
    plots.label(size, "frequency (Hz)", "displacement per force (µm/N)")
    plots.legend(size)
    plots.label(phase, "frequency (Hz)", "phase (deg)")
    return figure
