# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin trend``: what of a machine drifts from night to night."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer
from numpy.typing import NDArray

from pkm_twin.apps.history import Series, read_history
from pkm_twin.apps.options import Json
from pkm_twin.console import finite, print_json, refuse_existing, writing
from pkm_twin.errors import ParameterError
from pkm_twin.options import OptionalPath, OptionalText, file_name

Array = NDArray[np.float64]

DRIFT: Final = 1
"""Exit code where something drifts."""
FEWEST: Final = 6
"""Recordings below which nothing is judged."""
SHOWN: Final = 4
"""Most series in a picture."""


@dataclass(frozen=True, eq=False)
class Judged:
    """A series with its control limits.

    ``centre``, ``low``, ``high``: of the first ``baseline`` recordings, NaN where these are too
    few. ``beyond``: which recordings are outside, (k,). ``change``: index of the first recording
    after the most likely change of the mean, or None; ``chance`` that there is such a one without
    any; ``before`` and ``after``: means on its sides.
    """

    series: Series
    baseline: int
    centre: float
    low: float
    high: float
    beyond: NDArray[np.bool_]
    change: int | None
    chance: float
    before: float
    after: float

    @property
    def drifts(self) -> bool:
        """The mean has changed, or the last recording is outside the limits."""
        return self.change is not None or bool(self.beyond[-1])

    def as_json(self) -> dict[str, Any]:
        """Plain data for a script; null is not known."""
        s = self.series
        when = None if self.change is None else _day(s.time[self.change])
        return {
            "machine": s.machine, "quantity": s.quantity, "part": s.part, "unit": s.unit,
            "recordings": len(s.value), "last": float(s.value[-1]), "centre": finite(self.centre),
            "low": finite(self.low), "high": finite(self.high),
            "beyond": int(self.beyond.sum()), "last_beyond": bool(self.beyond[-1]),
            "changed": when, "chance": finite(self.chance), "before": finite(self.before),
            "after": finite(self.after), "drifts": self.drifts,
        }  # fmt: skip


def judged(series: Series, baseline: int, alarm: float) -> Judged:
    """Control limits and a change of the mean of one series.

    Limits: where a single further recording lies but for the chance ``alarm``, by mean and standard
    deviation of the first ``baseline`` recordings (Student's t). The change: of all splits with two
    recordings or more on each side the one with the greatest Student's t of the means; the chance
    is that of any split (Bonferroni), for errors that are normal and independent.

    :param alarm: chance of a false alarm of this series.
    """
    from scipy import stats  # type: ignore[import-untyped]

    y, k = series.value, len(series.value)
    if k < FEWEST:
        none = math.nan
        return Judged(series, 0, none, none, none, np.zeros(k, bool), None, none, none, none)
    first = min(baseline, k)
    mean, spread = float(y[:first].mean()), float(y[:first].std(ddof=1))
    reach = stats.t.ppf(1.0 - alarm / 2.0, first - 1) * spread * math.sqrt(1.0 + 1.0 / first)
    beyond = np.abs(y - mean) > reach
    beyond[:first] = False
    splits = np.arange(2, k - 1)
    sums, squares = np.cumsum(y - mean), np.cumsum((y - mean) ** 2)
    left = sums[splits - 1] / splits
    right = (sums[-1] - sums[splits - 1]) / (k - splits)
    within = squares[-1] - splits * left**2 - (k - splits) * right**2
    # What rounding leaves of a constant is no spread.
    least = (1e-12 * (abs(mean) + float(np.abs(y).max()))) ** 2
    noise = np.sqrt(np.maximum(within, k * least) / (k - 2))
    apart = np.abs(right - left) / np.sqrt(1.0 / splits + 1.0 / (k - splits))
    scores = np.divide(apart, noise, out=np.zeros(len(splits)), where=noise > 0.0)
    best = int(scores.argmax())
    chance = min(1.0, 2.0 * float(stats.t.sf(scores[best], k - 2)) * len(splits))
    change = int(splits[best]) if chance < alarm else None
    return Judged(
        series, first, mean, mean - reach, mean + reach, beyond, change, chance,
        float(mean + left[best]), float(mean + right[best]),
    )  # fmt: skip


def trend(
    history: Annotated[
        Path,
        typer.Argument(help="a file that `pkm-twin check --history` wrote")
    ],
    machine: Annotated[
        OptionalText,
        typer.Option(help="report this machine only")
    ] = None,
    baseline: Annotated[
        int, typer.Option(help="number of first recordings that set the control limits", min=3)
    ] = 15,
    false_alarm: Annotated[
        float,
        typer.Option(
            help="probability of a false alarm for a history without drift", min=1e-9, max=0.5
        ),
    ] = 0.01,
    picture: Annotated[
        OptionalPath,
        typer.Option(
            help="PNG of the series with their control limits", callback=file_name
        )
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the picture")] = False,
    as_json: Json = False,
) -> None:  # fmt: skip
    """Report which values of a machine drift from night to night.

    Residuals, friction, payload, compliance factors and frequencies of all recordings of a history,
    each against control limits from its first recordings, and for a change of its mean.

    Exit code 0: nothing drifts. 1: something does, or the file is not a history.
    """
    if picture is not None:
        refuse_existing(picture, overwrite, history)
    found = read_history(history, machine)
    if not found:
        wanted = f" of a machine {machine!r}" if machine else ""
        raise ParameterError(str(history), "no numbers", f"recordings with efforts{wanted}")
    results = [judged(series, baseline, false_alarm / len(found)) for series in found]
    drifting = [one for one in results if one.drifts]
    if picture is not None:
        with writing(picture):
            draw(results, picture)
    few = sum(len(one.series.value) < FEWEST for one in results)
    if as_json:
        print_json(
            {
                "history": str(history), "drifts": bool(drifting), "judged": len(results) - few,
                "series": [one.as_json() for one in results],
            }
        )  # fmt: skip
    else:
        for one in results:
            typer.echo(_line(one))
        if few:
            typer.echo(f"not judged: {few} series with fewer than {FEWEST} recordings")
        if drifting:
            typer.echo(f"drift in {len(drifting)} of {len(results)} series")
        elif few < len(results):
            typer.echo(f"no drift in {len(results) - few} series")
        else:
            typer.echo("drift unknown: too few recordings")
        if picture is not None:
            typer.echo(str(picture))
    if drifting:
        raise typer.Exit(DRIFT)


def _line(one: Judged) -> str:
    s = one.series
    name = s.label
    last = f"{s.value[-1]:.4g} {s.unit}"
    if len(s.value) < FEWEST:
        return f"{name}: {last}, not judged"
    text = f"{name}: {last}, control limits {one.low:.4g} to {one.high:.4g}"
    if one.change is not None:
        when = _day(s.time[one.change])
        text += f"; DRIFT: from {one.before:.4g} to {one.after:.4g} {s.unit} on {when}"
    elif one.drifts:
        text += "; DRIFT: the last recording is outside the control limits"
    return text


def draw(results: Sequence[Judged], path: Path) -> None:
    """Series with their control limits, those that drift first."""
    from pkm_twin.maps import figures
    from pkm_twin.report import plots

    order = sorted(results, key=lambda one: (not one.drifts, -len(one.series.value)))[:SHOWN]
    drifting = sum(one.drifts for one in results)
    columns = min(2, len(order))
    rows = math.ceil(len(order) / columns)
    figure, axes = figures.subplots(
        rows, columns, figsize=(4.5 * columns, 3.2 * rows), layout="constrained", squeeze=False
    )
    for ax in axes.ravel()[len(order) :]:
        ax.set_visible(False)
    for one, ax in zip(order, axes.ravel(), strict=False):
        s = one.series
        days = [datetime.fromtimestamp(t, UTC) for t in s.time]
        known = np.nan_to_num(s.deviation)
        ax.errorbar(days, s.value, known, fmt=".-", ms=5, lw=0.8, color=plots.COLOURS[0])
        ax.plot(
            [d for d, out in zip(days, one.beyond, strict=True) if out], s.value[one.beyond], "o",
            mfc="none", ms=9, color=plots.COLOURS[1], label="outside",
        )  # fmt: skip
        if math.isfinite(one.centre):
            ax.axhline(one.centre, color="0.4", lw=0.8)
            ax.axhspan(one.low, one.high, color=plots.COLOURS[2], alpha=0.15, lw=0)
        if one.change is not None:
            ax.axvline(days[one.change], color=plots.COLOURS[1], ls="--", lw=1.2)
        ax.set_title(s.label, fontsize=11)
        ax.set_ylabel(s.unit)
        ax.tick_params(axis="x", labelrotation=30, labelsize=9)
        ax.grid(alpha=0.3)
    answer = f"drift in {drifting} of {len(results)} series" if drifting else "no drift"
    shown = "" if len(order) == len(results) else f"; {len(order)} shown"
    figure.suptitle(f"Is it getting worse? {answer}{shown}")
    plots.save(figure, path)


def _day(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).isoformat(timespec="minutes")
