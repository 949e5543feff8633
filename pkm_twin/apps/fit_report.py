# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Report a fit: its answer, parameters, verdict, held-out residuals, and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.identification.compare import describe_delay
from pkm_twin.identification.deflections import ElasticFit
from pkm_twin.identification.drives import DriveFriction, Law
from pkm_twin.identification.fit import Fit, Judged, Result
from pkm_twin.identification.hypotheses import Explanation
from pkm_twin.identification.parameters import Number
from pkm_twin.report import Column, Fact, Report, Table, plots

if TYPE_CHECKING:
    from matplotlib.figure import Figure


COMBINED_TEXT: Final = "known only in combination with others"
DEFLECTION_UNITS: Final = "m_m_m_rad_rad_rad"
"""Units of a deflection's six components, at the end of keys in JSON."""


def report_fit(result: Result, marks: Sequence[str] = ()) -> tuple[Report, list[Table]]:
    """Return a fit's report, and tables for its page alone.

    :param marks: notes that come first.
    """
    verdict, e, elastic = result.verdict, result.estimate, isinstance(result, ElasticFit)
    label = _element_name if elastic else attrgetter("name")
    units = dict(zip(result.channels, result.units, strict=True))
    own = tuple(units[channel.name] for channel in verdict.channels)
    shown = [n for n in result.numbers if n.status != "not excited"]
    idle = [label(n) for n in result.list_numbers("not excited")]
    # RMS residuals before and after the fit, measured peak, and unit of each measured channel.
    held = {}
    for judged in result.judged:
        sizes = judged.rms(judged.before), judged.rms(judged.after), np.abs(judged.measured).max(0)
        for name, unit, *row in zip(result.channels, result.units, *sizes, strict=True):
            if np.isfinite(row).all():
                before, after, peak = map(float, row)
                held[f"{judged.name}, {name}"] = before, after, peak, unit
    if isinstance(result, Fit):
        names, facts = result.problem.parameters.names, _report_efforts(result)
        # Describe how the signals of each recording were filtered.
        more = []
        for made, delay in zip(result.problem.whole, result.delays, strict=True):
            how, late = made.how, describe_delay(delay, made.period)
            cutoff = "no low-pass" if how.cutoff is None else f"low-pass at {how.cutoff:.3g} Hz"
            more.append(
                f"{made.recording.name}: efforts are {late or 'on time'}; "
                f"differentiated over {how.window} samples, {cutoff}, "
                f"one of every {how.keep_every} samples used"
            )
        more += [f"efforts replaced as outliers: {result.outliers}"] if result.outliers else []
    elif isinstance(result, ElasticFit):
        names = tuple(map(_element_name, result.numbers))
        facts = _report_elastic(result)
        more = []
        for group in result.groups:
            sums = []
            for one in group.known:
                terms = " + ".join(f"{w:.2f} x {name}" for name, w in one.weights.items())
                sums.append(f"{terms.replace('+ -', '- ')} = {one.value:.4g} +- {one.deviation:.2g}")
            combinations = "; ".join(sums) or "nothing"
            more.append(f"Loads do not distinguish {' and '.join(group.elements)}; they identify {combinations}")
    notes = [*marks, *verdict.list_sentences(own), *more]
    if idle:
        notes.append(f"not excited, the file's value stays: {', '.join(idle)}")
    if e.bound:
        what = "a negative compliance" if elastic else "negative friction or an impossible body"
        # A physical bound concerns several numbers of a body, so name the body.
        which = ", ".join(dict.fromkeys(names[k] if not more else names[k].rpartition(".")[0] for k, *more in e.bound))
        notes.append(f"at a physical bound, without which the fit would give {what}: {which}")
    parameters = [
        {
            "key": n.name,
            **({"element": _element_name(n), "unit": "of the file's compliance"} if elastic else {"unit": n.unit}),
            "before": n.before,
            "value": n.after,
            "standard_deviation": n.deviation,
            "status": n.status,
        }
        for n in result.numbers
    ]
    columns = [
        Column("", text="RMS with the file's values", form=".3g"),
        Column("", text="with the fitted ones", form=".3g"),
        Column("", text="measured peak", form=".3g"),
        Column("", text="unit"),
    ]
    numbers = {label(n): n for n in shown}
    number_columns = [
        Column("", text="in the file", form=".6g"),
        Column("", text="fitted", form=".6g"),
        Column("", text="standard deviation"),
        Column("", text="unit"),
        Column("", text=" "),
    ]
    number_rows = {
        name: (n.before, n.after, n.spread, n.unit, COMBINED_TEXT if n.status == "combination" else "")
        for name, n in numbers.items()
    }
    channel_columns = [
        Column("", text=text)
        for text in (
            "RMS residual in the band of the motion",
            "RMS noise there",
            "unit",
            "variation without a known cause (%)",
            "held out over fitted",
        )
    ]
    channel_rows = {
        c.name: (c.residual, c.noise, unit, 100.0 * c.left, c.held_out)
        for c, unit in zip(result.verdict.channels, own, strict=True)
    }
    explained = result.explained if isinstance(result, Fit) else ()
    worst, (before, after, peak, unit) = max(held.items(), key=lambda row: row[1][1] / max(row[1][2], 1e-300))
    return Report(
        f"{result.robot.name}: {verdict}; the worst held-out residual is {after:.3g} {unit} ({worst}), "
        f"{100 * after / peak:.2g} % of the peak ({before:.3g} {unit} with the file's values)",
        [
            Fact("robot", result.robot.name),
            Fact("verdict", verdict.as_json(own)),
            Fact("accepted", result.accepted),
            Fact("condition", e.condition, text="condition number"),
            Fact("combinations_determined", result.estimate.directions, text="combinations identified"),
            Fact("held_by_a_physical_bound", bool(e.bound)),
            Fact("samples_fitted", result.samples),
            Fact("parameters", parameters),
            Fact("not_excited", idle),
            *facts,
        ],
        [
            Table("", number_columns, number_rows, "parameters", "parameter"),
            *tabulate_causes(explained, [judged.name for judged in result.judged]),
            Table("", columns, held, "residual of the last third, which was held out", "recording"),
        ],
        {"": partial(_draw_changes, {label(n): n for n in shown})}
        | {f"_{k}": partial(_draw_residuals, one, units) for k, one in enumerate(result.judged)},
        notes,
    ), [Table("", channel_columns, channel_rows, "verdict", "channel")]


def tabulate_causes(explained: Sequence[Explanation], names: Sequence[str]) -> list[Table]:
    """Return a table of the causes that were considered for each recording's deviations."""
    rows = {
        f"{name}: {text}" if len(explained) > 1 else text: (100.0 * part,)
        for name, one in zip(names, explained, strict=False)
        for text, part in one.considered
    }
    column = Column("probability_percent", text="probability (%)", form=".3g")
    return [Table("considered", [column], rows, "considered as the cause of deviations", "cause")] * bool(rows)


def _element_name(number: Number) -> str:
    return str(number.key[-1])


def _report_efforts(result: Fit) -> list[Fact]:
    """Report noise, delays, filters and what was held out."""
    joints, units = result.channels, result.units
    held = [
        {
            "recording": judged.name,
            "from_s": judged.time[0],
            "to_s": judged.time[-1],
            "residual_rms_before": judged.rms(judged.before),
            "residual_rms_after": judged.rms(judged.after),
            "effort_deviation_rms_after": np.sqrt(np.mean(judged.deviation**2, 0)),
            "peak_effort": np.abs(judged.measured).max(0),
        }
        for judged in result.judged
    ]
    filters = [
        {
            "window_samples": how.window,
            "cutoff_Hz": how.cutoff,
            "kept_every": how.keep_every,
            "position_noise": how.position_noise,
        }
        for how in (made.how for made in result.problem.whole)
    ]
    return [
        Fact("outliers_replaced", result.outliers),
        Fact("efforts_late_s", result.delays),
        Fact("effort_noise", dict(zip(joints, result.estimate.noise, strict=True))),
        Fact("effort_units", dict(zip(joints, units, strict=True))),
        Fact("held_out", held),
        Fact("filtering", filters),
    ]


def _report_elastic(result: ElasticFit) -> list[Fact]:
    """Report groups, noise and held-out deflections; null for what was not measured."""
    groups = [
        {
            "elements": group.elements,
            "known": [{"weights": c.weights, "value": c.value, "standard_deviation": c.deviation} for c in group.known],
        }
        for group in result.groups
    ]
    each = zip(result.judged, result.zeros, result.measured, strict=True)
    held = [
        {
            "recording": judged.name,
            "from_s": judged.time[0],
            "to_s": judged.time[-1],
            f"zero_{DEFLECTION_UNITS}": np.where(measured, zero, np.nan),
            f"residual_rms_before_{DEFLECTION_UNITS}": judged.rms(judged.before),
            f"residual_rms_after_{DEFLECTION_UNITS}": judged.rms(judged.after),
        }
        for judged, zero, measured in each
    ]
    noise = np.where(result.measured.any(0), result.estimate.noise, np.nan)
    return [Fact("not_told_apart", groups), Fact(f"deflection_noise_{DEFLECTION_UNITS}", noise), Fact("held_out", held)]


def _draw_residuals(judged: Judged, units: Mapping[str, str]) -> Figure:
    """Draw residuals of each channel before and after the fit, with the model's standard deviation."""
    # At most 4,000 samples of a recording are drawn.
    step = max(1, len(judged.time) // 4000)
    rows: dict[str, list[Array]] = {}
    series = (judged.measured - judged.before, judged.measured - judged.after, judged.deviation)
    for k, name in enumerate(units):
        if np.isfinite(judged.measured[:, k]).any():
            rows[name] = [one[::step, k] for one in series]
    time = judged.time[::step]
    # Break lines where samples were left out.
    gaps = 1 + np.flatnonzero(np.diff(time) > 5.0 * np.median(np.diff(time)))
    figure, ((*axes,),) = plots.make_subplots(1, len(rows))
    for ax, (name, (before, now, deviation)) in zip(axes, rows.items(), strict=True):
        for values, colour, width, word in ((before, 1, 1.6, "before"), (now, 0, 0.8, "now")):
            broken = np.where(np.isin(np.arange(len(time)), gaps), np.nan, values)
            ax.plot(time, broken, color=plots.COLOURS[colour], lw=width, label=word)
        style: dict[str, Any] = {"color": plots.COLOURS[0], "alpha": 0.25, "lw": 0}
        band = 2.0 * deviation
        ax.fill_between(time, -band, band, label="of the model: two\nstandard deviations", **style)
        was, left = (float(np.sqrt(np.nanmean(one**2))) for one in (before, now))
        words = f"{name}: RMS {left:.3g} {units[name]} now, {was:.3g} {units[name]} before"
        plots.label(ax, "time (s)", f"residual ({units[name]})", words)
        plots.legend(ax)
    plots.write_title(figure, f"{judged.name}: measured minus predicted, held out")
    return figure


def _draw_changes(shown: Mapping[str, Number]) -> Figure:
    """Draw the changes of numbers, in standard deviations where these are known."""
    known = all(np.isfinite(n.deviation) and n.deviation > 0.0 for n in shown.values())
    moved = {
        name: (n.after - n.before) / (n.deviation if known else max(abs(n.before), abs(n.after), 1e-300))
        for name, n in shown.items()
    }
    # Draw the twenty parameters that changed most.
    order = sorted(moved, key=lambda name: -abs(moved[name]))[:20]
    figure, ((ax,),) = plots.make_subplots(1, 1, 1.6 + 0.28 * len(order))
    places = np.arange(len(order))[::-1]
    colours = [plots.COLOURS[0 if shown[name].status == "fitted" else 4] for name in order]
    ax.barh(places, [moved[name] for name in order], 0.6, color=colours)
    texts = [f"{name}: {shown[name].before:.3g} to {shown[name].after:.3g} {shown[name].unit}" for name in order]
    ax.set_yticks(places, texts, fontsize=9)
    if known:
        ax.axvspan(-2.0, 2.0, color="0.9", zorder=0)
        far = sum(abs(value) > 2.0 for value in moved.values())
        title = f"{far} of {len(moved)} numbers moved by more than two standard deviations (grey)"
    else:
        title = "What changed most; standard deviations are withheld"
    # Beyond 30 standard deviations the scale is logarithmic.
    if max(map(abs, moved.values()), default=0.0) > 30.0:
        ax.set_xscale("symlog", linthresh=2.0)
    over = "standard deviation" if known else "larger value"
    plots.label(ax, f"change over the {over}; orange: {COMBINED_TEXT}", "")
    plots.write_title(figure, title)
    return figure


def _write_law(law: Law) -> str:
    each = zip(law.terms, law.values, law.deviations, strict=True)
    return ", ".join(
        f"{term} {value:.3f} +- {deviation:.3f}" + (" A" if term != "load-dependent" else "")
        for term, value, deviation in each
    )


def report_drive(found: DriveFriction) -> Report:
    """Report a drive's torque constant and friction law."""
    rows: dict[str, dict[str, Any]] = {}
    for law in found.laws:
        each = zip(law.terms, law.values, law.deviations, strict=True)
        rows[law.name] = {term: {"value": v, "standard_deviation": d} for term, v, d in each}
        rows[law.name] |= {"residual_a": law.residual, "held_out_a": law.held_out, "held_out_drive_a": law.other_drives}
    notes = []
    for law in found.laws:
        line = f"{law.name}: {_write_law(law)}; residual {law.residual:.3f} A"
        line += f", held-out runs {law.held_out:.3f} A"
        if np.isfinite(law.other_drives):
            line += f", held-out drives {law.other_drives:.3f} A"
        notes.append(line)
    if not found.viscous_told:
        notes.append("one speed: Coulomb and viscous friction cannot be distinguished")
    if len(found.laws) > 1:
        rejected = found.chosen is found.laws[-1]
        simpler = found.laws[-2].name if rejected else found.chosen.name
        verdict = "rejected" if rejected else "not rejected"
        notes.append(f"{simpler} alone: {verdict} (p = {found.chance:.2g})")
    return Report(
        f"torque constant {found.torque_constant:.4f} +- {found.torque_constant_deviation:.4f} "
        f"N m/A; friction {_write_law(found.chosen)}; zero current {found.zero:.3f} A",
        [
            Fact("torque_constant_nm_per_a", found.torque_constant),
            Fact("torque_constant_deviation_nm_per_a", found.torque_constant_deviation),
            Fact("zero_current_a", found.zero),
            Fact("chosen", found.chosen.name),
            Fact("chance", found.chance),
            Fact("viscous_distinguished", found.viscous_told),
            Fact("laws", rows),
        ],
        notes=notes,
    )
