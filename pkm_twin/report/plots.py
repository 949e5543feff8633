# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Draw pictures with matplotlib, which is imported on first use."""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.console import convert_write_errors
from pkm_twin.files import replace_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colours of Okabe and Ito (2008), which colour-blind readers can distinguish.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442", "#000000")
TERMS: Final = ("gravity", "inertia", "velocity", "payload", "friction", "external")
"""Terms of an effort, in the order of the plots."""
MAX_SINGLE_COLUMN_TIME: Final = 5.0
"""Longest motion with one column of plots, s; a longer one has a second column at its largest effort."""
LINE_STYLES: Final = ("-", "--", ":", "-.")
"""Line styles of curves that may coincide."""
WIDTH: Final = 9.0
"""Width of every figure, inches: on a page of 900 pixels, letters of 8 points are 11 pixels high."""
DPI: Final = 200
STYLE: Final[Any] = {"font.size": 10, "axes.titlesize": 11, "legend.fontsize": 9, "figure.titlesize": 12}


def pyplot() -> Any:
    """Return matplotlib's pyplot, configured to draw into files only."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams.update(STYLE)
    from matplotlib import pyplot

    return pyplot


def make_subplots(
    columns: int, rows: int, height: float | None = None, **options: Any
) -> tuple[Figure, list[list[Axes]]]:
    """Make a figure with ``columns`` columns of ``rows`` axes each; ``height`` in inches."""
    figure, axes = pyplot().subplots(
        rows, columns, figsize=(WIDTH, height or max(3 * rows, 4.2)), squeeze=False, layout="constrained", **options
    )
    return figure, axes.T.tolist()


def label(ax: Axes, x: str, y: str, title: str = "", size: float | None = None) -> None:
    """Label the axes and draw a grid; ``size``: font size of the title, points."""
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    if title:
        ax.set_title(title, fontsize=size or STYLE["axes.titlesize"])
    ax.grid(alpha=0.3)


def render(figure: Figure, dpi: int, form: str = "png") -> bytes:
    """Render a figure as an image and close it.

    Texts are not parsed as formulas: names of files and joints may contain a dollar sign.
    """
    texts: list[Any] = [title for title in (vars(figure)["_suptitle"],) if title is not None]
    for ax in figure.axes:
        legend = ax.get_legend()
        texts += [ax.title, ax.xaxis.label, ax.yaxis.label, *ax.texts]
        texts += [] if legend is None else legend.get_texts()
    for text in texts:
        text.set_parse_math(False)
    data = io.BytesIO()
    figure.savefig(data, dpi=dpi, format=form)
    pyplot().close(figure)
    return data.getvalue()


def write_title(figure: Figure, text: str, size: float = STYLE["figure.titlesize"]) -> int:
    """Write the figure's title, wrapped; return the number of lines."""
    # A no-break space keeps a value and its unit on one line.
    tied = re.sub(r"(?<=\d) (?=[^\W\d])|(?<=\bN) (?=m\b)", "\xa0", text)
    rows = [row for line in tied.splitlines() for row in textwrap.wrap(line, int(1050 / size))]
    figure.suptitle("\n".join(rows).replace("\xa0", " "), fontsize=size)
    return len(rows)


def legend(ax: Axes, below: bool = False) -> None:
    """Place the legend to the right of the data, or below; none where no curve has a label."""
    if not ax.get_legend_handles_labels()[0]:
        return
    if below:
        ax.legend(ncol=2, loc="upper center", bbox_to_anchor=(0.5, -0.16))
    else:
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def save(figure: Figure, path: Path, dpi: int = DPI) -> Path:
    """Write a figure as PNG, SVG or PDF, to stdout as PNG, atomically, and close it.

    :raises PkmTwinError: the file cannot be written.
    """
    data = render(figure, dpi, path.suffix[1:] or "png")
    with convert_write_errors(path):
        replace_file(path, data)
    return path


def draw_torques(units: Mapping[str, str], table: Mapping[str, NDArray[np.float64]], title: str) -> Figure:
    """Draw efforts and their terms, one row per actuated joint; grey where beyond the limits.

    For a motion longer than MAX_SINGLE_COLUMN_TIME the terms are drawn in a second column, one
    second before and after the largest effort.

    :param units: unit of the effort of each joint, by name.
    """
    time = np.asarray(table["time"])
    whole = time[-1] - time[0] <= MAX_SINGLE_COLUMN_TIME
    figure, columns = make_subplots(1 if whole else 2, len(units), sharey="row")
    efforts = np.array([table[f"{joint}.effort"] for joint in units])
    for k, (joint, unit) in enumerate(units.items()):
        peak = int(np.abs(efforts[k]).argmax())
        for column in columns:
            ax, effort, measured = column[k], efforts[k], table.get(f"{joint}.measured")
            if measured is not None:
                ax.plot(time, measured, color="0.7", lw=3, label="measured")
                ax.plot(time, measured - effort, color="#882255", lw=1, label="measured - sum")
            ax.plot(time, effort, color="black", lw=1, label="sum")
            if f"{joint}.effort_deviation" in table:
                band = 2.0 * table[f"{joint}.effort_deviation"]
                ax.fill_between(
                    time, effort - band, effort + band, label="two deviations", color="0.3", alpha=0.25, lw=0
                )
            for colour, term in zip(COLOURS, TERMS, strict=False):
                values = table[f"{joint}.effort_{term}"]
                if column is columns[-1] and np.any(values != 0.0):
                    ax.plot(time, values, color=colour, lw=0.8, label=term)
            if "beyond_limits" in table:
                beyond, whole_height = np.asarray(table["beyond_limits"]) > 0, ax.get_xaxis_transform()
                ax.fill_between(
                    time, 0, 1, where=beyond, color="0.85", zorder=0, transform=whole_height, label="beyond limits"
                )
            label(ax, "time (s)", f"effort ({unit})")
        ax.set_title(f"{joint}: {efforts[k, peak]:.4g} {unit} at {time[peak]:.4g} s")
        if not whole:
            ax.set_xlim(time[peak] - 1.0, time[peak] + 1.0)
        legend(ax)
    write_title(figure, title)
    return figure
