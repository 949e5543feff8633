# SPDX-License-Identifier: Apache-2.0
"""What the pictures of all kinds of atlas share: axes, colours, units, thinning."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

MAP: Final = "viridis"
OTHER_MAP: Final = "cividis"
FINEST: Final = 200
"""Most samples along one axis of a picture; denser atlases are thinned."""
LEVELS: Final = 30
"""Steps of a map of colours, about: few enough to follow one around, and a small file."""
LINES: Final = tuple(colour for colour in plots.COLOURS if colour != "#F0E442")
"""Colours of lines on white, where yellow is hard to see."""
PREFIXES: Final = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}


def subplots(*shape: int, **options: Any) -> tuple[Figure, Any]:
    """A new figure and its axes, as ``pyplot.subplots`` has them."""
    figure, axes = plots.pyplot().subplots(*shape, **options)
    return figure, axes


def new_figure(**options: Any) -> Figure:
    """A new figure without axes."""
    figure: Figure = plots.pyplot().figure(**options)
    return figure


def axes_or_new(ax: Axes | None, size: tuple[float, float] = (7, 5.5)) -> Axes:
    """The axes given, or those of a new figure of a size (inches)."""
    if ax is not None:
        return ax
    drawn: Axes = subplots(figsize=size, layout="constrained")[1]
    return drawn


def contours(ax: Axes, x: Array, y: Array, values: Array, label: str, **options: Any) -> None:
    """A field as steps of colour on axes of equal scale, with its colour bar."""
    from matplotlib import ticker

    least = float(np.nanmin(values)) if "least" not in options else options.pop("least")
    greatest = float(np.nanmax(values)) if "greatest" not in options else options.pop("greatest")
    if "levels" not in options:
        if not greatest > least:
            least, greatest = least - 0.5, least + 0.5
        ticks = ticker.MaxNLocator(LEVELS, steps=[1, 2, 2.5, 5, 10])
        options["levels"] = ticks.tick_values(least, greatest)
    drawn = ax.contourf(x, y, np.ma.masked_invalid(values), **{"cmap": MAP, **options})
    ax.set_aspect("equal")
    bar(ax, drawn, label, ticks=ticker.MaxNLocator(8, steps=[1, 2, 5, 10]))


def bar(ax: Axes, drawn: Any, label: str, **options: Any) -> Any:
    """A colour bar as high as its axes, which the figure's own would not be at equal scale."""
    bar = ax.figure.colorbar(drawn, cax=ax.inset_axes((1.04, 0.0, 0.045, 1.0)), **options)
    bar.set_label(label)
    return bar


def plain_ticks(bar: Any) -> None:
    """Numbers without powers of ten on a logarithmic colour bar."""
    from matplotlib import ticker

    axis = bar.ax.yaxis
    axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 3.0, 5.0, 7.0)))
    axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(ticker.NullLocator())


def prefixed(values: Array, unit: str) -> tuple[Array, str]:
    """Values in a unit whose prefix leaves numbers between 1 and 1000, and that unit."""
    power = 3 * math.floor(math.log10(float(np.nanmax(np.abs(values)))) / 3)
    power = min(max(power, min(PREFIXES)), max(PREFIXES))
    return values / 10.0**power, PREFIXES[power] + unit


def around(azimuth: Array, values: Array, least: int = 0) -> tuple[Array, Array]:
    """Azimuths and a field (n, azimuth) with the first again at the end: the circle is closed.

    :param least: azimuths wanted; between the field's own the values are on straight lines.
    """
    turn = np.append(azimuth, azimuth[0] + 2 * np.pi)
    closed = np.concatenate([values, values[:, :1]], 1)
    finer = math.ceil(least / len(azimuth))
    if finer <= 1:
        return turn, closed
    ticks = np.linspace(turn[0], turn[-1], finer * len(azimuth) + 1)
    return ticks, np.array([np.interp(ticks, turn, row) for row in closed])


def colours(norm: Any, values: Array) -> Any:
    """Colours of values, RGBA."""
    from matplotlib import cm

    return cm.ScalarMappable(norm, MAP).to_rgba(values)


def every(count: int) -> int:
    """Every how many samples of so many are drawn."""
    return max(1, math.ceil(count / FINEST))


def thin(ticks: Array) -> Array:
    """The ticks that are drawn."""
    return ticks[:: every(len(ticks))]


def unit_of(variable: Any) -> str:
    """The unit of a stored field, for a label."""
    unit = str(variable.attrs["units"])
    return "dimensionless" if unit == "1" else unit


def in_degrees(coordinate: Any) -> tuple[Array, str]:
    """Ticks in degrees where they are angles, and the unit."""
    unit = coordinate.attrs["units"]
    if unit == "rad":
        return np.degrees(coordinate.values), "deg"
    return np.asarray(coordinate.values, np.float64), unit
