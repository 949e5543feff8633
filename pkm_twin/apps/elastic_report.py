# SPDX-License-Identifier: Apache-2.0
"""What a fit of elastic elements says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from pkm_twin.apps.fit_report import MOST_SAMPLES, Report, note_of
from pkm_twin.console import finite
from pkm_twin.identification.deflections import AXES, ElasticFit
from pkm_twin.identification.parameters import Combination, Group
from pkm_twin.report.plots import COLOURS, columns, label

Array = NDArray[np.float64]

UNITS = ("m",) * 3 + ("rad",) * 3
"""Of a deflection's directions."""


def elastic_report(result: ElasticFit, recordings: Sequence[str]) -> Report:
    """Of a fit to deflections."""
    e, verdict = result.estimate, result.verdict
    names = [str(n.key[-1]) for n in result.numbers]
    factors = tuple(f"the factor of {name}" for name in names)
    table = Table(box=None)
    for name in ("factor on the compliance of", "in the file", "fitted", "standard deviation"):
        table.add_column(name, justify="right")
    table.add_column("")
    for name, n in zip(names, result.numbers, strict=True):
        if n.status != "not excited":
            table.add_row(name, f"{n.before:.6g}", f"{n.after:.6g}", n.spread, note_of(n))
    return Report(
        result=result, recordings=recordings, combinations=result.told,
        units=tuple(UNITS[AXES.index(one.name)] for one in verdict.channels), names=tuple(names),
        blind=verdict.blind_lines(factors, ("",) * len(names)), label=lambda n: str(n.key[-1]),
        number_data=lambda n: {"element": n.key[-1], "unit": "of the file's compliance"},
        data_before={}, data_after=_data(result), table=table,
        residuals=[_residuals(result, k) for k in range(len(result.judged))],
        residuals_header=(
            "recording", "direction", "RMS before", "RMS now", "peak deflection", "unit",
        ),
        figure=lambda k: _deflections(result, k), groups=list(map(_group_text, result.groups)),
        fitted="Elastic elements fitted", heading="Compliance of the elements", excited_by="loads",
        counted=f"condition number {e.condition:.3g} of {result.told} identifiable combinations",
        about=f"Each factor multiplies the compliance that the file gives an element. "
        f"{result.samples} deflections identify {result.told} combinations; condition number "
        f"{e.condition:.3g}. The standard deviation includes noise and the file's prior values.",
        bound="some factors are at a bound: without it the fit would give a negative compliance",
        bound_of_page="Without bounds the fit would give a negative compliance; the nearest "
        "possible values are shown.",
    )  # fmt: skip


def _data(result: ElasticFit) -> dict[str, Any]:
    """Groups, noise and what was held out; null for what was not measured."""
    noise = np.where(result.measured.any(0), result.estimate.noise, np.nan)
    return {
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
        "deflection_noise_m_m_m_rad_rad_rad": _listed(noise),
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


def _listed(values: Array) -> list[float | None]:
    return list(map(finite, values))


def _group_text(group: Group) -> str:
    """One line on elements that the loads do not distinguish."""
    told = "; ".join(_sum_text(one) for one in group.known) or "nothing"
    return f"Loads do not distinguish {' and '.join(group.elements)}; they identify {told}"


def _sum_text(one: Combination) -> str:
    terms = " ".join(f"{w:+.2f} {name}" for name, w in one.weights.items())
    return f"{terms.removeprefix('+')} = {one.value:.4g} +- {one.deviation:.2g}"


def _residuals(result: ElasticFit, number: int) -> list[tuple[str, ...]]:
    """Of the directions that were measured."""
    judged = result.judged[number]
    peak = np.abs(judged.measured)
    before, after = judged.rms(judged.before), judged.rms(judged.after)
    return [
        (judged.name, AXES[k], f"{before[k]:.3g}", f"{after[k]:.3g}",
         f"{float(np.nanmax(peak[:, k])):.3g}", UNITS[k])
        for k in np.flatnonzero(result.measured[number]).tolist()
    ]  # fmt: skip


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
        title = f"{judged.name}: measured minus predicted, held out"
        label(ax, "time (s)", f"deflection (u{UNITS[int(kind[0])]})", title)
        ax.legend(loc="upper right", fontsize=8)
    return figure
