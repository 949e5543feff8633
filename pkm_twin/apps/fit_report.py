# SPDX-License-Identifier: Apache-2.0
"""The report of a fit: one HTML page with its pictures in it."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from pkm_twin.atlas.plots import COLOURS, columns, rendered
from pkm_twin.identification.fit import Fit, Number
from pkm_twin.identification.verdict import Verdict

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
WORDS: Final = {
    "fitted": "",
    "combination": "known only in combination with others",
    "not excited": "",
}


def fit_page(result: Fit, recordings: Sequence[str], notes: Sequence[str] = ()) -> str:
    """The whole page.

    :param notes: lines of warning, which come first.
    """
    title = f"{html.escape(result.robot.name)}: fitted from {html.escape(', '.join(recordings))}"
    e = result.estimate
    parts = [
        HEAD_OF_PAGE.format(title=title),
        *(f"<p>{html.escape(line)}</p>" for line in notes),
        "<h2>Does the model explain the recordings?</h2>",
        verdict_section(
            result.verdict,
            result.robot.effort_units,
            result.verdict.blind_lines(result.parameters.names, result.parameters.units),
        ),
        "<h2>What was fitted</h2>",
        numbers_table(_shown(result)),
    ]
    parts.append(
        f"<p>{result.samples} filtered samples identify {e.directions} combinations of parameters; "
        f"condition number {e.condition:.3g}. +- is one standard deviation. It includes noise, "
        "differentiation and the file's prior values.</p>"
    )
    if e.bound:
        parts.append(
            "<p>The data alone want negative friction, or masses and inertias that no body has; "
            "these are the nearest possible ones.</p>"
        )
    idle = result.of("not excited")
    if idle:
        names = ", ".join(html.escape(n.name) for n in idle)
        parts.append(f"<p>Not excited by the motion, the file's value stays: {names}.</p>")
    parts += ["<h2>Numbers, before and now</h2>", picture(changes_figure(_shown(result)))]
    parts += ["<h2>Held out: the last third of each recording</h2>", _residuals(result)]
    parts.append(
        "<p>The band is two standard deviations of the model's own torques, by what the fit does "
        "not know of its numbers; noise of the measured efforts is not in it.</p>"
    )
    parts += [picture(_efforts(result, k)) for k in range(len(result.judged))]
    parts += ["<h2>What was done to the signals</h2>", _signals(result, recordings)]
    return "\n".join([*parts, "</body>", "</html>", ""])


def verdict_section(verdict: Verdict, units: tuple[str, ...], more: Sequence[str]) -> str:
    """The verdict's sentences, and the residual by channel.

    :param units: of the channels. ``more``: further sentences.
    """
    lines = [*verdict.lines(units), *more]
    text = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
    rows = [
        (
            c.name, f"{c.residual:.3g}", f"{c.noise:.3g}", unit, f"{100 * c.left:.2g} %",
            f"{c.held_out:.3g}",
        )
        for c, unit in zip(verdict.channels, units, strict=True)
    ]  # fmt: skip
    header = (
        "", "residual in the band of the motion (rms)", "noise there (rms)", "unit",
        "variation without a known cause", "held out over fitted",
    )  # fmt: skip
    return f"<ul>{text}</ul>{html_table(header, rows)}"


def html_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of plain texts."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def numbers_table(numbers: Sequence[Number]) -> str:
    """Numbers of a file, before and now."""
    return html_table(
        ("number", "before", "now", "+-", "unit", ""),
        [
            (n.name, f"{n.before:.6g}", f"{n.after:.6g}", n.spread, n.unit,
             WORDS[n.status])
            for n in numbers
        ],
    )  # fmt: skip


def _shown(result: Fit) -> list[Number]:
    return [n for n in result.numbers if n.status != "not excited"]


def _residuals(result: Fit) -> str:
    rows = []
    for judged in result.judged:
        before, after = judged.rms(judged.before), judged.rms(judged.after)
        peak = np.abs(judged.measured).max(0)
        for k, joint in enumerate(result.robot.joint_names):
            unit = result.robot.effort_units[k]
            rows.append(
                (judged.name, joint, f"{before[k]:.4g}", f"{after[k]:.4g}", f"{peak[k]:.4g}", unit)
            )
    return html_table(("recording", "joint", "rms before", "rms now", "peak effort", "unit"), rows)


def _signals(result: Fit, recordings: Sequence[str]) -> str:
    rows = [
        (
            name, f"{how.window}", "none" if how.cutoff is None else f"{how.cutoff:.3g}",
            f"{how.keep_every}", f"{1e3 * delay:.3g}",
        )
        for name, how, delay in zip(recordings, result.filtering, result.delays, strict=True)
    ]  # fmt: skip
    header = (
        "recording", "window of the differentiation (samples)", "low-pass (Hz)",
        "every so many samples kept", "efforts late (ms)",
    )  # fmt: skip
    return html_table(header, rows) + f"<p>{result.outliers} efforts were outliers.</p>"


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


def _efforts(result: Fit, number: int) -> Any:
    judged = result.judged[number]
    step = max(1, len(judged.time) // MOST_SAMPLES)
    joints = result.robot.joint_names
    figure, ((*axes,),) = columns(1, len(joints))
    for k, (ax, joint) in enumerate(zip(axes, joints, strict=True)):
        time = judged.time[::step]
        for values, colour, label in (
            (judged.before, COLOURS[1], "before"), (judged.after, COLOURS[0], "now"),
        ):  # fmt: skip
            ax.plot(time, (judged.measured - values)[::step, k], color=colour, lw=0.8, label=label)
        band = 2.0 * judged.deviation[::step, k]
        ax.fill_between(
            time,
            -band,
            band,
            color=COLOURS[0],
            alpha=0.25,
            lw=0,
            label="now, two standard deviations",
        )
        ax.set_title(f"{judged.name}, {joint}: measured minus predicted effort, held out")
        ax.set_xlabel("time (s)")
        ax.set_ylabel(f"effort ({result.robot.effort_units[k]})")
        ax.legend(loc="upper right", fontsize=8)
        ax.grid(alpha=0.3)
    return figure


def picture(figure: Any) -> str:
    """A figure as an image in a page; it is closed."""
    data = base64.b64encode(rendered(figure, 90)).decode()
    return f'<img alt="" src="data:image/png;base64,{data}">'
