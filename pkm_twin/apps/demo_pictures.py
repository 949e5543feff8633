# SPDX-License-Identifier: Apache-2.0
"""The demonstration's picture: a panel for each of its stages."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pkm_twin.apps.demo_report import DynamicsSeries, StiffnessSeries
from pkm_twin.maps import figures
from pkm_twin.report import plots

if TYPE_CHECKING:
    from pkm_twin.apps.demo_tracking import TrackingSeries


def draw(
    series: Mapping[str, DynamicsSeries | StiffnessSeries | TrackingSeries], path: Path
) -> Path:
    """One picture of all stages: a panel each."""
    figure, axes = figures.subplots(2, 2, figsize=(9, 6.6), layout="constrained")
    for ax, data in zip(axes.ravel(), series.values(), strict=False):
        if isinstance(data, DynamicsSeries):
            _efforts(ax, data)
        elif isinstance(data, StiffnessSeries):
            _deflections(ax, data)
        else:
            _tracking(ax, data)
        ax.set_xlabel("time (s)")
        ax.legend(loc="best")
        ax.grid(alpha=0.3)
    for ax in axes.ravel()[len(series) :]:
        ax.set_visible(False)
    return plots.save(figure, path)


def _efforts(ax: Any, data: DynamicsSeries) -> None:
    """Recorded and predicted effort of the first joint over two seconds."""
    middle = float(data.time[len(data.time) // 8]) if len(data.time) else 0.0
    near = (data.time >= middle) & (data.time <= middle + 2.0)
    ax.plot(data.time[near], data.measured[near, 0], color="0.6", lw=2.5, label="recorded")
    ax.plot(data.time[near], data.predicted[near, 0], color=plots.COLOURS[1], lw=1, label="twin")
    ax.set_title(f"{data.title}: effort of {data.joints[0]}")
    ax.set_ylabel(f"effort ({data.unit})")


def _deflections(ax: Any, data: StiffnessSeries) -> None:
    """Deflection of the platform and that of a finite-element frame over 0.6 seconds."""
    begin = float(data.time[len(data.time) // 8]) if len(data.time) else 0.0
    part, true = ((time >= begin) & (time <= begin + 0.6) for time in (data.time, data.truth_time))
    for i, axis in enumerate("xyz"):
        ax.plot(
            data.time[part], 1e6 * data.deflection[part, i],
            color=plots.COLOURS[i], lw=0.8, label=axis,
        )  # fmt: skip
        ax.plot(
            data.truth_time[true], 1e6 * data.truth[true, i], "o",
            color=plots.COLOURS[i], ms=4, mec="black", mew=0.4,
        )  # fmt: skip
    ax.set_title(f"{data.title}: deflection (dots: finite elements)")
    ax.set_ylabel("deflection (µm)")


def _tracking(ax: Any, data: TrackingSeries) -> None:
    """Tracking errors of PD alone and with feedforward, by the error of the model."""
    for i, (perturbation, runs) in enumerate(data.runs.items()):
        for run, what, line in zip(runs, ("PD", "with feedforward"), ("-", "--"), strict=True):
            size = 1e3 * np.linalg.norm(run.error, axis=1)
            label = f"{what}, {100 * perturbation:g} %"
            ax.plot(run.time, size, line, color=plots.COLOURS[i], lw=1.2, label=label)
    ax.set_title("machine_sim: tracking error by model error")
    ax.set_ylabel("error, all joints (mrad)")
