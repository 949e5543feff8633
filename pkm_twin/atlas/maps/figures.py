# SPDX-License-Identifier: Apache-2.0
"""The picture and page of a map: planes through its worst pose, its answer in the title."""

from __future__ import annotations

import json
import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from pkm_twin.atlas import figures, planes
from pkm_twin.atlas.planes import Label
from pkm_twin.atlas.sweep import Kind

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import Dataset

WIDE: float = 9.0
"""Of a picture, inches."""
LETTERS: int = 110
"""In a line of a picture's title."""


def answers(atlas: Dataset) -> list[dict[str, Any]]:
    """The worst of each case as plain data: case, value, unit, pose, direction, element."""
    names = [str(name) for name in atlas.coordinate.values]
    found = []
    for k, case in enumerate(atlas.case.values):
        part = atlas.isel(case=k)
        found.append(
            {
                "case": str(case),
                "value": float(part.worst_value),
                "unit": str(part.case_unit.values),
                "pose": dict(zip(names, part.worst_pose.values.tolist(), strict=True)),
                "direction": part.worst_direction.values.tolist(),
                "element": str(atlas.element.values[int(part.worst_element)]),
            }
        )
    return found


def sentence(answer: dict[str, Any]) -> str:
    """One case's worst in words."""
    # Zero is not printed as rounding.
    pose = ", ".join(f"{k} {round(value, 12) + 0.0:.4g}" for k, value in answer["pose"].items())
    way = ", ".join(f"{round(value, 12) + 0.0:.3g}" for value in answer["direction"])
    shown = f"0 {answer['unit']}"
    if answer["value"]:
        value, unit = figures.prefixed(np.array(answer["value"]), answer["unit"])
        shown = f"{float(value):.4g} {unit}"
    return f"{answer['case']}: {shown} at {pose}; direction ({way}), due to {answer['element']}"


def question(atlas: Dataset) -> str:
    """What the map answers."""
    return f"{atlas.attrs['robot']}: {json.loads(atlas.attrs['settings'])['question']}"


def _by_case(atlas: Dataset) -> tuple[Dataset, dict[str, Label]]:
    """An atlas with a field for each case, and how these are shown."""
    labels, fields = {}, {}
    name = str(atlas.attrs["kind"]).replace("-", " ")
    for k, case in enumerate(atlas.case.values):
        values = atlas.value.isel(case=k)
        greatest = np.nanmax(np.abs(values.values), initial=0.0)
        scaled, unit = figures.prefixed(np.array(greatest or 1.0), str(atlas.case_unit.values[k]))
        text = name if len(atlas.case) == 1 else f"{name}, {case}"
        labels[f"value {k}"] = Label(
            f"{text} ({unit})", name, unit, float(scaled) / (greatest or 1.0)
        )
        fields[f"value {k}"] = values
    return atlas.assign(fields), labels


def _planes(atlas: Dataset) -> Figure:
    by_case, labels = _by_case(atlas)
    rows = []
    for k, answer in enumerate(answers(atlas)):
        rows.append(planes.planes(by_case, [f"value {k}"], answer["pose"]))
    columns = min(len(rows[0]), 3 if len(rows[0]) > 4 else 2)
    lines = math.ceil(len(rows[0]) / columns)
    high = max(0.8 * WIDE / columns, 3.0)
    figure, axes = figures.subplots(
        lines * len(rows), columns, figsize=(WIDE, min(high, 4.5) * lines * len(rows)),
        layout="constrained", squeeze=False,
    )  # fmt: skip
    for ax in axes.ravel():
        ax.set_visible(False)
    for k, (shown, answer) in enumerate(zip(rows, answers(atlas), strict=True)):
        label = labels[f"value {k}"]
        values = label.scale * by_case[f"value {k}"].values
        low, high = (float(f(values)) for f in (np.nanmin, np.nanmax))
        whole = "slice" not in atlas.dims
        for one, ax in zip(shown, axes[k * lines : (k + 1) * lines].ravel(), strict=False):
            ax.set_visible(True)
            planes.draw(one, f"value {k}", label, low, high if high > low else low + 1.0, ax)
            if whole and len(one.ticks[1]) > 1:
                turns = [math.degrees if unit == "deg" else float for unit in one.units]
                at = [turn(answer["pose"][n]) for turn, n in zip(turns, one.names, strict=True)]
                ax.plot(*at, "*", color="red", mec="white", ms=13)
    star = "slice" not in atlas.dims
    text = [f"{question(atlas)} (star: worst pose)" if star else question(atlas)]
    for answer in answers(atlas):
        text += textwrap.wrap(sentence(answer), LETTERS)
    figure.suptitle("\n".join(text), fontsize=11)
    return figure


def _page(atlas: Dataset) -> Any:
    by_case, labels = _by_case(atlas)
    return planes.page(question(atlas), by_case, labels)


KIND = Kind(
    "map",
    figures={"planes": _planes},
    page=_page,
    title=question,
    help="Poses that count: joints within their limits, limbs apart, clear of singularities. The "
    "menu chooses the load case, the slider one layer alone.",
)
