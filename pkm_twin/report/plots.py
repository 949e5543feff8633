# SPDX-License-Identifier: Apache-2.0
"""Pictures. matplotlib is imported on first use; every function draws on axes that it is given."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from pkm_twin.console import writing
from pkm_twin.files import replace_file

# Okabe and Ito's colours, told apart by colour-blind readers too.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442", "#000000")
WIDTH: Final = 9.0
"""Of every figure, inches: letters of 8 points are 11 pixels high where it is 900 pixels wide."""
DPI: Final = 200
STYLE: Final[Any] = {
    "font.size": 10, "axes.titlesize": 11, "legend.fontsize": 9, "figure.titlesize": 12,
}  # fmt: skip


def pyplot() -> Any:
    """Matplotlib's pyplot, drawing into files only."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams.update(STYLE)
    from matplotlib import pyplot

    return pyplot


def columns(
    count: int, rows: int, height: float | None = None, **options: Any
) -> tuple[Any, list[Any]]:
    """A figure of ``count`` columns with ``rows`` axes each; ``height``: inches."""
    figure, axes = pyplot().subplots(
        rows, count, figsize=(WIDTH, height or max(3 * rows, 4.2)), squeeze=False,
        layout="constrained", **options,
    )  # fmt: skip
    return figure, list(axes.T)


def label(ax: Any, x: str, y: str, title: str = "", size: float | None = None) -> None:
    """Name the axes, and draw a grid; ``size``: of the title's letters."""
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    if title:
        ax.set_title(title, **({} if size is None else {"fontsize": size}))
    ax.grid(alpha=0.3)


def rendered(figure: Any, dpi: int, form: str = "png") -> bytes:
    """A figure as an image; it is closed.

    Names of files and joints may have a dollar in them: no text that is set here is a formula.
    """
    texts = [] if figure._suptitle is None else [figure._suptitle]
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


def legend(ax: Any) -> None:
    """A legend beside the data, where it hides none."""
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def save(figure: Any, path: Path, dpi: int = DPI) -> Path:
    """Write a figure as PNG, SVG or PDF, to stdout as PNG, whole or not at all, and close it.

    :raises PkmTwinError: the file cannot be written.
    """
    data = rendered(figure, dpi, path.suffix[1:] or "png")
    with writing(path):
        replace_file(path, data)
    return path


def torques(motion: Any, table: Mapping[str, Any]) -> Any:
    """Efforts and their terms, an axes for each actuated joint; grey where beyond the limits."""
    robot = motion.robot
    figure, axes = columns(1, len(robot.joint_names))
    terms = ("gravity", "inertia", "velocity", "payload", "friction", "external")
    for ax, joint, unit in zip(axes[0], robot.joint_names, robot.effort_units, strict=True):
        if f"{joint}.measured" in table:
            ax.plot(table["time"], table[f"{joint}.measured"], color="0.7", lw=2, label="measured")
        ax.plot(table["time"], table[f"{joint}.effort"], color="black", lw=1, label="sum")
        if f"{joint}.effort_deviation" in table:
            band = 2.0 * table[f"{joint}.effort_deviation"]
            low, high = (table[f"{joint}.effort"] + sign * band for sign in (-1.0, 1.0))
            style: dict[str, Any] = {"color": "0.3", "alpha": 0.25, "lw": 0}
            ax.fill_between(table["time"], low, high, label="two deviations", **style)
        for colour, term in zip(COLOURS, terms, strict=False):
            values = table[f"{joint}.effort_{term}"]
            if np.any(values != 0.0):
                ax.plot(table["time"], values, color=colour, lw=0.8, label=term)
        if "beyond_limits" in table:
            ax.fill_between(
                table["time"],
                *(0, 1),
                where=np.asarray(table["beyond_limits"]) > 0,
                transform=ax.get_xaxis_transform(),
                color="0.85",
                zorder=0,
                label="beyond limits",
            )
        label(ax, "time (s)", f"effort ({unit})", f"{robot.name}: effort of {joint}")
        legend(ax)
    return figure
