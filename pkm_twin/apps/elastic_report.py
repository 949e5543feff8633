# SPDX-License-Identifier: Apache-2.0
"""What a fit of elastic elements says: numbers, lines, and one HTML page with its pictures."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table

from pkm_twin.apps.fit_report import (
    HEAD_OF_PAGE,
    MOST_SAMPLES,
    changes_figure,
    html_table,
    numbers_table,
    picture,
    verdict_section,
)
from pkm_twin.atlas.plots import COLOURS, columns
from pkm_twin.console import table_console
from pkm_twin.identification.elastic_fit import AXES, Combination, ElasticFit, Group
from pkm_twin.identification.fit import Number

Array = NDArray[np.float64]

UNITS = ("m",) * 3 + ("rad",) * 3
"""Of a deflection's directions."""


def as_json(result: ElasticFit) -> dict[str, Any]:
    """Plain data, units in the keys or beside the numbers; null for what was not measured."""
    e = result.estimate
    names = tuple(str(n.key[-1]) for n in result.numbers)
    return {
        "robot": result.robot.name,
        "verdict": result.verdict.as_json(_units(result), names),
        "accepted": list(result.accepted),
        "condition": e.condition if np.isfinite(e.condition) else None,
        "combinations_determined": result.told,
        "held_by_a_physical_bound": e.bound,
        "samples_fitted": result.samples,
        "parameters": [
            {
                "key": number.name, "element": number.key[-1], "unit": "of the file's compliance",
                "before": number.before, "value": number.after,
                "standard_deviation": number.deviation if np.isfinite(number.deviation) else None,
                "status": number.status,
            }
            for number in result.numbers
        ],
        "not_excited": [number.key[-1] for number in result.of("not excited")],
        "not_told_apart": [
            {
                "elements": list(group.elements),
                "known": [
                    {
                        "weights": one.weights, "value": one.value,
                        "standard_deviation": one.deviation,
                    }
                    for one in group.known
                ],
            }
            for group in result.groups
        ],
        "deflection_noise_m_m_m_rad_rad_rad": _listed(
            np.where(result.measured.any(0), e.noise, np.nan)
        ),
        "held_out": [
            {
                "recording": judged.name,
                "from_s": float(judged.time[0]), "to_s": float(judged.time[-1]),
                "zero_m_m_m_rad_rad_rad": _listed(np.where(measured, zero, np.nan)),
                "residual_rms_before_m_m_m_rad_rad_rad": _listed(judged.rms(judged.before)),
                "residual_rms_after_m_m_m_rad_rad_rad": _listed(judged.rms(judged.after)),
            }
            for judged, zero, measured in zip(
                result.judged, result.zeros, result.measured, strict=True
            )
        ],
    }  # fmt: skip


def _units(result: ElasticFit) -> tuple[str, ...]:
    """Of the directions that were measured."""
    return tuple(UNITS[AXES.index(one.name)] for one in result.verdict.channels)


def verdict_lines(result: ElasticFit) -> list[str]:
    """Whether elastic elements explain the deflections, in sentences."""
    names = tuple(f"the factor of {n.key[-1]}" for n in result.numbers)
    verdict = result.verdict
    told = verdict.blind_lines(names, ("",) * len(names))
    return [*verdict.lines(_units(result)), *told]


def _listed(values: Array) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def yaml_head(result: ElasticFit, recordings: Sequence[str]) -> list[str]:
    """Lines for the head of the file: from what, how well, and what stays open."""
    lines = [
        f"Elastic elements fitted from {', '.join(recordings)}: {result.told} combinations, "
        f"condition number {result.estimate.condition:.3g}."
    ]
    lines += [f"Verdict: {line}." for line in result.verdict.lines(_units(result))]
    lines += [f"{text}." for text in map(group_text, result.groups)]
    for judged in result.judged:
        before, after = (
            ", ".join(f"{v:.3g}" for v in judged.rms(which) if np.isfinite(v))
            for which in (judged.before, judged.after)
        )
        lines.append(f"Residual rms held out of {judged.name}: {before} before, {after} now.")
    return lines


def group_text(group: Group) -> str:
    """One line on elements that the loads do not distinguish."""
    told = "; ".join(_sum_text(one) for one in group.known) or "nothing"
    return f"Loads do not distinguish {' and '.join(group.elements)}; they identify {told}"


def _sum_text(one: Combination) -> str:
    terms = " ".join(f"{w:+.2f} {name}" for name, w in one.weights.items())
    return f"{terms.removeprefix('+')} = {one.value:.4g} +- {one.deviation:.2g}"


def _shown(result: ElasticFit) -> list[Number]:
    return [n for n in result.numbers if n.status != "not excited"]


def print_fit(result: ElasticFit) -> None:
    """The same on a terminal."""
    table = Table(box=None)
    for name in ("compliance over the file's", "before", "now", "+-"):
        table.add_column(name, justify="right")
    table.add_column("")
    for n in _shown(result):
        note = "known only in combination with others" if n.status == "combination" else ""
        table.add_row(str(n.key[-1]), f"{n.before:.6g}", f"{n.after:.6g}", n.spread, note)
    table_console().print(table)
    idle = result.of("not excited")
    if idle:
        names = ", ".join(str(n.key[-1]) for n in idle)
        typer.echo(f"not excited by the loads, the file's value stays: {names}")
    for group in result.groups:
        typer.echo(group_text(group))
    e = result.estimate
    typer.echo(f"condition number {e.condition:.3g}, {result.told} combinations")
    if e.bound:
        typer.echo("held by a bound: the data alone want a negative compliance")
    for line in verdict_lines(result):
        typer.echo(line)
    for row in _residual_rows(result):
        name, axis, before, after, _, unit = row
        typer.echo(f"{name}, held out, {axis}: residual {before} before, {after} {unit} now")


def _residual_rows(result: ElasticFit) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for judged, measured in zip(result.judged, result.measured, strict=True):
        before, after = judged.rms(judged.before), judged.rms(judged.after)
        for k in np.flatnonzero(measured).tolist():
            peak = float(np.nanmax(np.abs(judged.measured[:, k])))
            rows.append(
                (judged.name, AXES[k], f"{before[k]:.3g}", f"{after[k]:.3g}", f"{peak:.3g}",
                 UNITS[k])
            )  # fmt: skip
    return rows


def elastic_page(result: ElasticFit, recordings: Sequence[str], notes: Sequence[str] = ()) -> str:
    """The whole page.

    :param notes: lines of warning, which come first.
    """
    title = f"{html.escape(result.robot.name)}: fitted from {html.escape(', '.join(recordings))}"
    e = result.estimate
    shown = _shown(result)
    parts = [HEAD_OF_PAGE.format(title=title)]
    parts += [f"<p>{html.escape(line)}</p>" for line in notes]
    told = verdict_lines(result)[len(result.verdict.lines(_units(result))) :]
    parts.append("<h2>Does the model explain the recordings?</h2>")
    parts.append(verdict_section(result.verdict, _units(result), told))
    parts += ["<h2>Compliance of the elements</h2>", numbers_table(shown)]
    parts.append(
        "<p>Each number multiplies what the file says of an element's compliance. "
        f"{result.told} combinations are told by {result.samples} deflections; condition number "
        f"{e.condition:.3g}. +- is one standard deviation, of the noise and of what the file said "
        "before.</p>"
    )
    if e.bound:
        parts.append("<p>The data alone want a negative compliance; the nearest are shown.</p>")
    idle = result.of("not excited")
    if idle:
        names = ", ".join(html.escape(str(n.key[-1])) for n in idle)
        parts.append(f"<p>Not excited by the loads, the file's value stays: {names}.</p>")
    parts += [f"<p>{html.escape(group_text(group))}.</p>" for group in result.groups]
    parts += ["<h2>Numbers, before and now</h2>", picture(changes_figure(shown))]
    parts.append("<h2>Held out: the last third of each recording</h2>")
    parts.append(
        html_table(
            ("recording", "direction", "rms before", "rms now", "peak deflection", "unit"),
            _residual_rows(result),
        )
    )
    parts += [picture(_deflections(result, k)) for k in range(len(result.judged))]
    return "\n".join([*parts, "</body>", "</html>", ""])


def _deflections(result: ElasticFit, number: int) -> Any:
    judged = result.judged[number]
    step = max(1, len(judged.time) // MOST_SAMPLES)
    kinds = [np.arange(3), np.arange(3, 6)]
    kinds = [kind[result.measured[number][kind]] for kind in kinds]
    kinds = [kind for kind in kinds if len(kind)]
    figure, ((*axes,),) = columns(1, len(kinds))
    for ax, kind in zip(axes, kinds, strict=True):
        for k in kind.tolist():
            for values, style in ((judged.before, ":"), (judged.after, "-")):
                ax.plot(
                    judged.time[::step], 1e6 * (judged.measured - values)[::step, k], style,
                    color=COLOURS[k % 3], lw=0.8,
                    label=f"{AXES[k]}, {'before' if style == ':' else 'now'}",
                )  # fmt: skip
        ax.set_title(f"{judged.name}: measured minus predicted, held out")
        ax.set_xlabel("time (s)")
        ax.set_ylabel(f"deflection (u{UNITS[int(kind[0])]})")
        ax.legend(loc="upper right", fontsize=8)
        ax.grid(alpha=0.3)
    return figure
