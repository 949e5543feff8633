# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin trend``: values of a machine that drift from recording to recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import PictureOptions
from pkm_twin.report import Fact, Report, Verdict
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pkm_twin.identification.history import Judged


@dataclass(frozen=True, kw_only=True)
class Trend(PictureOptions):
    """Report which values of a machine drift from night to night.

    Compares residuals, friction, payload, compliance factors and frequencies of all recordings of a
    history with control limits from its first recordings, and tests each for a change of its mean.

    Exit code 0: nothing drifts. 1: something does, or the file is not a history.
    """

    history: Path = setting(..., "a file that `pkm-twin check --history` wrote", argument=True)
    machine: str | None = setting(None, "report this machine only")
    baseline: int = setting(15, "number of first recordings that set the control limits", low=3)
    false_alarm: float = setting(0.01, "probability of a false alarm without drift", low=1e-9, high=0.5)


@command("Recordings")
def trend(given: Trend) -> Report:
    """Find the series of a history that drift.

    :raises ParameterError: no history, or one without numbers of this machine.
    """
    from pkm_twin.identification.history import MIN_RECORDINGS, judge_history

    results = judge_history(given.history, given.machine, given.baseline, given.false_alarm)
    drifting = sum(one.drifts for one in results)
    few = sum(not one.known for one in results)
    answer = f"no drift in {len(results) - few} series"
    if drifting:
        answer = f"drift in {drifting} of {len(results)} series"
    elif few == len(results):
        answer = "drift unknown: too few recordings"
    notes = [one.line for one in results]
    if few:
        notes.append(f"not judged: {few} series with fewer than {MIN_RECORDINGS} recordings")
    return Report(
        answer=answer,
        facts=[
            Fact("history", str(given.history)),
            Fact("drifts", bool(drifting)),
            Fact("judged", len(results) - few),
            Fact("series", [one.as_json() for one in results]),
        ],
        figures={"": lambda: draw(results, answer)},
        notes=notes,
        verdict=Verdict.BAD if drifting else Verdict.UNKNOWN if few == len(results) else None,
    )


def draw(results: Sequence[Judged], answer: str) -> Figure:
    """Draw the series with their control limits, those that drift first."""
    import numpy as np

    from pkm_twin.report import plots

    order = sorted(results, key=lambda one: (not one.drifts, -len(one.series.value)))[:4]
    width = min(2, len(order))
    figure, by_column = plots.make_subplots(width, math.ceil(len(order) / width))
    axes = np.array(by_column).T.ravel()
    for ax in axes[len(order) :]:
        ax.set_visible(False)
    for one, ax in zip(order, axes, strict=False):
        s, days = one.series, np.array(one.series.days)
        known = np.nan_to_num(s.deviation)
        ax.errorbar(days, s.value, known, fmt=".-", ms=5, lw=0.8, color=plots.COLOURS[0])
        ax.plot(days[one.beyond], s.value[one.beyond], "o", mfc="none", ms=9, color=plots.COLOURS[1])
        if math.isfinite(one.centre):
            ax.axhline(one.centre, color="0.4", lw=0.8)
            ax.axhspan(one.low, one.high, color=plots.COLOURS[2], alpha=0.15, lw=0)
        if one.change is not None:
            ax.axvline(days[one.change], color=plots.COLOURS[1], ls="--", lw=1.2)
        plots.label(ax, "", s.unit, s.label)
        ax.tick_params(axis="x", labelrotation=30)
    shown = "" if len(order) == len(results) else f"; {len(order)} shown"
    marks = "band: control limits; ring: outside them; dashed: the mean changed"
    plots.write_title(figure, f"Is it getting worse? {answer}{shown}\n{marks}")
    return figure
