# SPDX-License-Identifier: Apache-2.0
"""What ``pkm-twin calibrate`` reports of partial measurements and of plans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Final

import numpy as np
import typer
from rich.table import Table
from rich.text import Text

from pkm_twin.console import table_console
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.identification.calibration import Scale
from pkm_twin.identification.measurements import KINDS
from pkm_twin.identification.plan import Plan
from pkm_twin.robot.robot import Robot

SIZES: Final = {"m": ("mm", 1e3), "rad": ("mrad", 1e3)}
WIDTH: Final = 100
"""Columns of a line of text."""
STEPS_SHOWN: Final = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)


def parse_noise(texts: Sequence[str]) -> dict[str, float]:
    """Of ``KIND=VALUE`` separated by commas, m or rad.

    :raises ParameterError: no number above zero, or no such kind.
    """
    found = {}
    for text in ",".join(texts).split(",") if texts else ():
        name, _, value = (part.strip() for part in text.partition("="))
        if name not in KINDS:
            raise UnknownNameError("--noise", name, list(KINDS))
        try:
            found[name] = float(value)
        except ValueError:
            found[name] = np.nan
        if not 0.0 < found[name] < 1.0:
            raise ParameterError("--noise", text, "KIND=VALUE, m or rad, as height=0.00002")
    return found


def parse_within(text: str | None) -> dict[str, tuple[float, float]]:
    """Of ``x=-0.1:0.1, z=0``: least and greatest values, m or rad.

    :raises ParameterError: anything else.
    """
    found = {}
    for part in (text or "").split(",") if text else ():
        name, _, ends = (one.strip() for one in part.partition("="))
        try:
            values = [float(end) for end in ends.split(":")]
        except ValueError:
            values = []
        if len(values) not in (1, 2) or not np.isfinite(values).all() or values[0] > values[-1]:
            raise ParameterError("--within", part, "COORDINATE=LEAST:GREATEST, as x=-0.1:0.1")
        found[name] = values[0], values[-1]
    return found


def scale_text(scale: Scale) -> str:
    """How well distances are known, in a sentence."""
    ends = f"{100.0 * scale.after:.2g} mm in 100 mm"
    if scale.determined:
        return f"scale: determined; distances are known to {ends} (standard deviation)"
    return (
        f"the scale is not determined: distances may be wrong by {ends} (standard deviation, "
        f"{100.0 * scale.before:.2g} mm before). Numbers that depend on it are marked no, and "
        "stay near the file's values. Measure distances as well (--measure height,distance)"
    )


def plan_table(robot: Robot, plan: Plan) -> list[str]:
    """The CSV of a plan: joints, poses and an empty column for each quantity."""
    names = [f"{name}.position" for name in robot.controller.names]
    columns = [plan.joints]
    if plan.second is not None:
        names += [f"{name}_2" for name in names]
        columns.append(plan.second)
    poses = [name for name in robot.pose_names if name not in plan.quantity]
    shown = [robot.pose_names.index(name) for name in poses]
    rows = np.hstack([*columns, plan.poses[:, shown]])
    head = [*names, *(f"planned_{name}" for name in poses), *plan.quantity]
    empty = [""] * len(plan.quantity)
    return [",".join(head), *(",".join([*(f"{v:.9g}" for v in row), *empty]) for row in rows)]


def plan_data(plan: Plan, accuracy: float | None) -> dict[str, Any]:
    """Plain numbers for a script, m and rad; lists are by number of measurements, from 0."""
    return {
        "count": len(plan.joints),
        "needed": None if accuracy is None else plan.needed(accuracy),
        "position_deviation_m": plan.position.tolist(),
        "scale_relative_deviation": plan.scale.tolist(),
        "quantity_deviation": {name: values.tolist() for name, values in plan.quantity.items()},
        "parameters": {
            p.name: {**{k: v for k, v in asdict(p).items() if k in ("unit", "prior")},
                     "standard_deviation": p.deviation, "observed": p.observed}
            for p in plan.known.parameters
        },
    }  # fmt: skip


def print_plan(plan: Plan, accuracy: float | None) -> None:
    """How well the machine will be known after so many measurements."""
    table = Table(
        title=Text("predicted standard deviations over the workspace, by number of measurements")
    )
    table.add_column("measurements")
    table.add_column("position*, worst axis, mm")
    table.add_column("distances, mm per 100 mm")
    for name in plan.quantity:
        unit, _ = SIZES[KINDS[name].unit]
        table.add_column(f"{name}, {unit}")
    last = len(plan.position) - 1
    for k in sorted({*(k for k in STEPS_SHOWN if k < last), last}):
        quantities = (
            f"{SIZES[KINDS[name].unit][1] * values[k]:.4f}"
            for name, values in plan.quantity.items()
        )
        row = (str(k), f"{1e3 * plan.position[k]:.4f}", f"{100 * plan.scale[k]:.4f}")
        table.add_row(*row, *quantities)
    table_console().print(table)
    typer.echo("* apart from a rigid motion of the whole workspace")
    if accuracy is not None:
        needed = plan.needed(accuracy)
        goal = f"{1e3 * accuracy:g} mm"
        typer.echo(
            f"{needed} measurements give the position to {goal}" if needed is not None else
            f"the position is not known to {goal} after {last} measurements: it stays at "
            f"{1e3 * plan.position[-1]:.3g} mm"
        )  # fmt: skip
