# SPDX-License-Identifier: Apache-2.0
"""What a fit says: on a terminal, as data, in the head of its file, and as one HTML page."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import typer
from rich.table import Table

from pkm_twin.console import finite, table_console
from pkm_twin.identification.fit import Fit
from pkm_twin.identification.parameters import Number
from pkm_twin.report.plots import COLOURS, columns, label, rendered
from pkm_twin.robot.robot import Robot

HEAD_OF_PAGE: Final = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{title}</title>
<style>
body {{ font: 15px/1.5 sans-serif; margin: 2em auto; max-width: 70em; padding: 0 1em; }}
table {{ border-collapse: collapse; margin: 1em 0; }}
td, th {{ border-bottom: 1px solid #ccc; padding: 0.2em 0.8em; text-align: right; }}
td:first-child, th:first-child, td.word {{ text-align: left; }}
img {{ max-width: 100%; }}
</style>
</head>
<body>
<h1>{title}</h1>
"""
MOST_SAMPLES: Final = 4000
"""Drawn of each recording."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Report:
    """A fit in words; what differs between fits, and what is made of it for all.

    ``result``: with numbers of a file, a verdict and what was held out. ``recordings``: names of
    what it was fitted to. ``label``: a number's name in lists. ``number_data``: data of a number
    behind its key, ``data_before`` and ``data_after``: around that of the numbers. ``units``: of
    the verdict's channels, ``names``: of the fitted numbers in its data, ``blind``: what the fit
    cannot see. ``groups``: what is known of several numbers together. ``residuals``: by recording
    and channel name, channel, rms before and after, peak, unit; ``late``: a line before them by
    recording. ``figure``: the residuals of a recording. ``held_out``: HTML between their table and
    their figures, ``signals``: at the end.
    """

    result: Any
    recordings: Sequence[str]
    combinations: int
    units: Sequence[str]
    names: Sequence[str]
    blind: Sequence[str]
    label: Callable[[Number], str]
    number_data: Callable[[Number], dict[str, Any]]
    data_before: Mapping[str, Any]
    data_after: Mapping[str, Any]
    table: Table
    residuals: Sequence[Sequence[tuple[str, ...]]]
    residuals_header: Sequence[str]
    figure: Callable[[int], Any]
    fitted: str
    heading: str
    excited_by: str
    counted: str
    about: str
    bound: str
    """What a bound means, on a terminal; ``bound_of_page``: on the page."""
    bound_of_page: str
    groups: Sequence[str] = ()
    late: Sequence[str] = ()
    held_out: str = ""
    signals: str = ""

    @property
    def shown(self) -> list[Number]:
        """Numbers that the recordings say something of."""
        return [n for n in self.result.numbers if n.status != "not excited"]

    @property
    def idle(self) -> list[str]:
        """Names of the others."""
        return [self.label(n) for n in self.result.of("not excited")]

    def as_json(self) -> dict[str, Any]:
        """Plain data, units in the keys or beside the numbers; null for what was not measured."""
        result, e = self.result, self.result.estimate
        return {
            "robot": result.robot.name,
            "verdict": result.verdict.as_json(self.units, self.names),
            "accepted": list(result.accepted),
            "condition": finite(e.condition),
            "combinations_determined": self.combinations,
            "held_by_a_physical_bound": e.bound,
            "samples_fitted": result.samples,
            **self.data_before,
            "parameters": [
                {
                    "key": n.name, **self.number_data(n), "before": n.before, "value": n.after,
                    "standard_deviation": finite(n.deviation),
                    "status": n.status,
                }
                for n in result.numbers
            ],
            "not_excited": self.idle,
            **self.data_after,
        }  # fmt: skip

    def head(self) -> list[str]:
        """Lines for the head of the file: from what, how well, and what stays open."""
        result = self.result
        lines = [
            f"{self.fitted} from {', '.join(self.recordings)}: {self.combinations} combinations, "
            f"condition number {result.estimate.condition:.3g}."
        ]
        lines += [f"Verdict: {line}." for line in result.verdict.lines(self.units)]
        lines += [f"{text}." for text in self.groups]
        for judged in result.judged:
            before, after = (
                ", ".join(f"{v:.3g}" for v in judged.rms(which) if np.isfinite(v))
                for which in (judged.before, judged.after)
            )
            lines.append(f"Residual rms held out of {judged.name}: {before} before, {after} now.")
        return lines

    def echo(self) -> None:
        """Print all of it."""
        result, e = self.result, self.result.estimate
        table_console().print(self.table)
        if self.idle:
            names = ", ".join(self.idle)
            typer.echo(f"not excited by the {self.excited_by}, the file's value stays: {names}")
        for line in self.groups:
            typer.echo(line)
        typer.echo(self.counted)
        if e.bound:
            typer.echo(self.bound)
        for line in [*result.verdict.lines(self.units), *self.blind]:
            typer.echo(line)
        for k, rows in enumerate(self.residuals):
            for line in self.late[k : k + 1]:
                typer.echo(line)
            for name, channel, before, after, _, unit in rows:
                typer.echo(
                    f"{name}, held out, {channel}: RMS residual {before} {unit} with the file's "
                    f"values, {after} {unit} with the fitted ones"
                )

    def page(self, notes: Sequence[str] = ()) -> str:
        """The whole page.

        :param notes: lines of warning, which come first.
        """
        result = self.result
        names = html.escape(", ".join(self.recordings))
        title = f"{html.escape(result.robot.name)}: fitted from {names}"
        parts = [
            HEAD_OF_PAGE.format(title=title),
            *(f"<p>{html.escape(line)}</p>" for line in notes),
            "<h2>Does the model explain the recordings?</h2>",
            self._verdict(),
            f"<h2>{self.heading}</h2>",
            html_table(
                ("parameter", "in the file", "fitted", "standard deviation", "unit", ""),
                [
                    (n.name, f"{n.before:.6g}", f"{n.after:.6g}", n.spread, n.unit, note_of(n))
                    for n in self.shown
                ],
            ),
            f"<p>{self.about}</p>",
        ]
        if result.estimate.bound:
            parts.append(f"<p>{self.bound_of_page}</p>")
        if self.idle:
            idle = html.escape(", ".join(self.idle))
            parts.append(
                f"<p>Not excited by the {self.excited_by}, the file's value stays: {idle}.</p>"
            )
        parts += [f"<p>{html.escape(text)}.</p>" for text in self.groups]
        parts += [
            "<h2>Parameters, in the file and fitted</h2>",
            picture(changes_figure(self.shown)),
        ]
        parts.append("<h2>Held out: the last third of each recording</h2>")
        parts.append(html_table(self.residuals_header, [row for k in self.residuals for row in k]))
        parts += [self.held_out] if self.held_out else []
        parts += [picture(self.figure(k)) for k in range(len(result.judged))]
        parts += [self.signals] if self.signals else []
        return "\n".join([*parts, "</body>", "</html>", ""])

    def _verdict(self) -> str:
        """The verdict's sentences, and the residual by channel."""
        verdict = self.result.verdict
        lines = [*verdict.lines(self.units), *self.blind]
        text = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
        rows = [
            (
                c.name, f"{c.residual:.3g}", f"{c.noise:.3g}", unit, f"{100 * c.left:.2g} %",
                f"{c.held_out:.3g}",
            )
            for c, unit in zip(verdict.channels, self.units, strict=True)
        ]  # fmt: skip
        header = (
            "", "RMS residual in the band of the motion", "RMS noise there", "unit",
            "variation without a known cause", "held out over fitted",
        )  # fmt: skip
        return f"<ul>{text}</ul>{html_table(header, rows)}"


def effort_report(result: Fit, recordings: Sequence[str]) -> Report:
    """Of a fit to efforts."""
    joints, units = result.robot.joint_names, result.robot.effort_units
    parameters, e = result.problem.parameters, result.estimate
    table = Table(box=None)
    table.add_column("parameter")
    for name in ("in the file", "fitted", "standard deviation"):
        table.add_column(name, justify="right")
    table.add_column("unit")
    table.add_column("")
    for n in result.numbers:
        if n.status != "not excited":
            cells = f"{n.before:.6g}", f"{n.after:.6g}", n.spread, n.unit, note_of(n)
            table.add_row(n.name, *cells)
    filters = [
        (
            name, f"{how.window}", "none" if how.cutoff is None else f"{how.cutoff:.3g}",
            f"{how.keep_every}", f"{1e3 * delay:.3g}",
        )
        for name, how, delay in zip(recordings, result.filtering, result.delays, strict=True)
    ]  # fmt: skip
    filters_header = (
        "recording", "window of the differentiation (samples)", "low-pass (Hz)",
        "every so many samples kept", "efforts late (ms)",
    )  # fmt: skip
    return Report(
        result=result, recordings=recordings, combinations=e.directions, units=units,
        names=parameters.names,
        blind=result.verdict.blind_lines(parameters.names, parameters.units),
        label=lambda n: n.name, number_data=lambda n: {"unit": n.unit},
        data_before={"outliers_replaced": result.outliers, "efforts_late_s": list(result.delays)},
        data_after={
            "effort_noise": dict(zip(joints, e.noise.tolist(), strict=True)),
            "effort_units": dict(zip(joints, units, strict=True)),
            "held_out": [
                {
                    "recording": judged.name,
                    "from_s": float(judged.time[0]), "to_s": float(judged.time[-1]),
                    "residual_rms_before": judged.rms(judged.before).tolist(),
                    "residual_rms_after": judged.rms(judged.after).tolist(),
                    "effort_deviation_rms_after": np.sqrt(np.mean(judged.deviation**2, 0)).tolist(),
                    "peak_effort": np.abs(judged.measured).max(0).tolist(),
                }
                for judged in result.judged
            ],
            "filtering": [
                {
                    "window_samples": how.window, "cutoff_Hz": how.cutoff,
                    "kept_every": how.keep_every, "position_noise": list(how.position_noise),
                }
                for how in result.filtering
            ],
        },
        table=table, residuals=[_joint_residuals(judged, result.robot) for judged in result.judged],
        residuals_header=("recording", "joint", "RMS before", "RMS now", "peak effort", "unit"),
        figure=lambda k: _efforts(result.judged[k], result.robot),
        late=[
            f"{judged.name}: efforts are {1e3 * delay:.3g} ms later than the positions"
            for judged, delay in zip(result.judged, result.delays, strict=True)
        ],
        fitted="Fitted", heading="What was fitted", excited_by="motion",
        counted=f"condition number {e.condition:.3g} of {e.directions} identifiable combinations",
        about=f"{result.samples} filtered samples identify {e.directions} combinations of "
        f"parameters; condition number {e.condition:.3g}. The standard deviation "
        "includes noise, differentiation and the file's prior values.",
        bound="some values are at a physical bound: without it the fit would give negative "
        "friction or an impossible body",
        bound_of_page="Without physical bounds the fit would give negative friction, or masses and "
        "inertias that no body has; these are the nearest possible ones.",
        held_out="<p>The band is two standard deviations of the model's own torques, by what the "
        "fit does not know of its numbers; noise of the measured efforts is not in it.</p>",
        signals="<h2>What was done to the signals</h2>\n" + html_table(filters_header, filters)
        + f"<p>{result.outliers} efforts were outliers.</p>",
    )  # fmt: skip


def _joint_residuals(judged: Any, robot: Robot) -> list[tuple[str, ...]]:
    sizes = judged.rms(judged.before), judged.rms(judged.after), np.abs(judged.measured).max(0)
    texts = ([f"{value:.4g}" for value in column] for column in sizes)
    rows = zip(robot.joint_names, *texts, robot.effort_units, strict=True)
    return [(judged.name, *row) for row in rows]


def _efforts(judged: Any, robot: Robot) -> Any:
    """Residuals of each joint before and now, with the model's own deviation."""
    step = max(1, len(judged.time) // MOST_SAMPLES)
    time = judged.time[::step]
    figure, ((*axes,),) = columns(1, len(robot.joint_names))
    for k, (ax, joint) in enumerate(zip(axes, robot.joint_names, strict=True)):
        for values, colour, name in (
            (judged.before, COLOURS[1], "before"), (judged.after, COLOURS[0], "now"),
        ):  # fmt: skip
            ax.plot(time, (judged.measured - values)[::step, k], color=colour, lw=0.8, label=name)
        band, name = 2.0 * judged.deviation[::step, k], "now, two standard deviations"
        ax.fill_between(time, -band, band, color=COLOURS[0], alpha=0.25, lw=0, label=name)
        title = f"{judged.name}, {joint}: measured minus predicted effort, held out"
        label(ax, "time (s)", f"effort ({robot.effort_units[k]})", title)
        ax.legend(loc="upper right", fontsize=8)
    return figure


def note_of(number: Number) -> str:
    """What is to be said of a number that is shown."""
    return "known only in combination with others" if number.status == "combination" else ""


def html_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of plain texts."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def changes_figure(shown: Sequence[Number]) -> Any:
    """By how many deviations each number moved, and how sure it is."""
    figure, ((ax,),) = columns(1, 1)
    figure.set_size_inches(9, 1 + 0.25 * len(shown))
    places = np.arange(len(shown))[::-1]
    for place, n in zip(places, shown, strict=True):
        deviation = n.deviation if np.isfinite(n.deviation) else 0.0
        size = max(abs(n.before), abs(n.after), 3 * deviation, 1e-300)
        colour = COLOURS[0] if n.status == "fitted" else COLOURS[4]
        ax.errorbar(n.after / size, place, xerr=3 * deviation / size, fmt="o", color=colour)
        ax.plot(n.before / size, place, "x", color="0.4")
    ax.set_yticks(places, [n.name for n in shown], fontsize=8)
    ax.set_xlim(-2, 2)
    ax.set_xlabel(
        "relative to the larger value; cross: before, dot: now, bar: 3 standard deviations"
    )
    ax.grid(alpha=0.3)
    return figure


def picture(figure: Any) -> str:
    """A figure as an image in a page; it is closed."""
    data = base64.b64encode(rendered(figure, 90)).decode()
    return f'<img alt="" src="data:image/png;base64,{data}">'
