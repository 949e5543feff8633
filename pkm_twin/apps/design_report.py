# SPDX-License-Identifier: Apache-2.0
"""What ``pkm-twin design`` reads, prints, draws and writes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.console import finite
from pkm_twin.design import QUANTITIES, Design, DesignPoint, PosePath, Sweep
from pkm_twin.design.pose_path import Followed
from pkm_twin.design.variants import Variants
from pkm_twin.errors import ParameterError, warn
from pkm_twin.maps.extras import require
from pkm_twin.maps.store import writing
from pkm_twin.paths.along import compared
from pkm_twin.recordings import ReadOptions, read
from pkm_twin.report import plots
from pkm_twin.robot.edited import Chosen, edited_yaml, write_edited
from pkm_twin.robot.entries import entries
from pkm_twin.robot.robot import Robot

Array = NDArray[np.float64]

FILE_DIGITS: Final = 12
"""Significant digits of a number that is written."""


def read_path(
    path: Path, robot: Robot, wrench: Sequence[float] | None, how: ReadOptions
) -> tuple[Robot, PosePath]:
    """The robot with the motion's payload, and the platform's path.

    :raises ParameterError: a table that is no motion, or a payload that is held part of the time.
    :raises BagError: a bag without a motion.
    """
    motion = read(path, robot, replace(how, planned=True)).with_rates()
    if motion.load is not None:
        held = motion.load.held(motion.time)
        if not held.all():
            raise ParameterError(
                f"{path}: payload", str(motion.load), "one that is held throughout"
            )
        robot = motion.load.on(robot)
    if robot.has_masses and (unlike := compared(motion, "file").unlike):
        warn(path, unlike)
    q, qd, qdd, load = motion.motion
    load = load + (np.zeros(6) if wrench is None else np.asarray(wrench))
    way = PosePath.of_joints(robot, motion.time, q, qd, qdd, load)
    return robot, way


def known_quantities(robot: Robot, path: PosePath) -> list[str]:
    """Quantities that the robot's file and the path have data for."""
    names = list(QUANTITIES)
    if not (path.wrench.any() and robot_is_elastic(robot)):
        names.remove("deflection")
    return names


def robot_is_elastic(robot: Robot) -> bool:
    """Whether the robot's file has data for elasticity."""
    try:
        return bool(robot.element_names)
    except ParameterError:
        return False


def told(
    robot: Robot, box: Mapping[str, tuple[float, float]], result: Design, path: PosePath,
    out: Path | None, picture: Path | None,
) -> tuple[dict[str, Any], str]:  # fmt: skip
    """The result as plain data and as text."""
    units = {name: entries(robot).get(name, (0.0, ""))[1] for name in result.best.numbers}
    before, best = result.before, result.best
    bounds = dict(zip(best.variables, box.values(), strict=True))
    limits = used_limits(result.robot, path)
    data = {
        "robot": robot.name, "minimise": list(result.minimise),
        "subject_to": [str(bound) for bound in result.constraints],
        "variables": {
            name: {
                "before": before.variables[name], "after": value, "low": bounds[name][0],
                "high": bounds[name][1], "unit": units.get(name, ""),
            }
            for name, value in best.variables.items()
        },
        "numbers": dict(best.numbers),
        "quantities": {
            name: {
                "before": finite(before.quantities.get(name)), "after": value,
                "unit": QUANTITIES[name].unit(robot),
            }
            for name, value in best.quantities.items()
        },
        "before_feasible": before.feasible,
        "front": [_point(point) for point in result.front],
        "machines": result.machines, "rejected_starts": result.rejected,
        "beyond_position_limits": limits,
        "out": None if out is None else str(out),
        "picture": None if picture is None else str(picture),
    }  # fmt: skip
    title = " and ".join(result.minimise)
    lines = [
        f"{robot.name}: least {title} on a path of {path.duration:.4g} s, "
        f"{len(path.time)} samples; {result.machines} machines computed",
        f"{'':34}{'before':>12}{'after':>12}",
    ]
    for name, value in best.variables.items():
        at = _at_bound(value, bounds[name])
        lines.append(
            f"{name:34}{before.variables[name]:12.5g}{value:12.5g} {units.get(name, '')}{at}"
        )
    for name, value in best.quantities.items():
        old = before.quantities.get(name, math.nan)
        lines.append(f"{name:34}{old:12.5g}{value:12.5g} {QUANTITIES[name].unit(robot)}")
    if not before.feasible:
        lines.append(
            "before: the file's machine cannot follow the path or does not keep the bounds"
        )
    if result.front:
        lines += ["Pareto front:", _row([*result.minimise, *best.variables])]
        lines += [
            _row([*(point.quantities[n] for n in result.minimise), *point.variables.values()])
            for point in result.front
        ]
    lines += [f"{joint} leaves its position limits on the path" for joint in limits]
    lines += [str(target) for target in (out, picture) if target is not None]
    return data, "\n".join(lines)


def _row(cells: Sequence[Any]) -> str:
    texts = [cell if isinstance(cell, str) else f"{cell:.5g}" for cell in cells]
    return "  " + " ".join(f"{text:>14}" for text in texts)


def _at_bound(value: float, bound: tuple[float, float]) -> str:
    near = 1e-6 * (bound[1] - bound[0])
    low, high = abs(value - bound[0]) < near, abs(value - bound[1]) < near
    return " (at its lower bound)" if low else " (at its upper bound)" if high else ""


def _point(point: DesignPoint) -> dict[str, Any]:
    return {"variables": dict(point.variables), "quantities": dict(point.quantities)}


def used_limits(robot: Robot, path: PosePath) -> list[str]:
    """Joints whose limits of position the robot leaves on the path."""
    limits = robot.limits.position
    if limits is None:
        return []
    q = robot.inverse(path.pose)
    beyond = np.asarray(((q < limits[:, 0]) | (q > limits[:, 1])).any(0))
    return [name for name, out in zip(robot.joint_names, beyond, strict=True) if out]


def write_robot(robot: Robot, source: str, result: Design, path: Path, out: Path) -> None:
    """Write the robot's file with the new numbers.

    :raises PkmTwinError: not writable.
    """
    kept = "".join(f", {bound}" for bound in result.constraints)
    aim = " and ".join(result.minimise)
    values = {
        name: Chosen(float(f"{value:.{FILE_DIGITS}g}"), f"{name}: was {robot.number(name):.6g}")
        for name, value in result.best.numbers.items()
    }
    head = [f"{robot.name}, designed for {path.name}: least {aim}{kept}."]
    write_edited(out, head, edited_yaml(robot, source, values))


def draw(robot: Robot, result: Design, path: PosePath, picture: Path) -> None:
    """Draw the Pareto front, or the efforts before and after.

    :raises MapError: not writable.
    """
    if result.front:
        figure, ((ax,),) = plots.columns(1, 1)
        first, second = result.minimise
        table = np.array([[p.quantities[first], p.quantities[second]] for p in result.front])
        ax.plot(*table.T, "o-", color=plots.COLOURS[0], label="Pareto front")
        best, old = result.best.quantities, result.before.quantities
        ax.plot(best[first], best[second], "D", color=plots.COLOURS[2], label="chosen")
        if result.before.feasible:
            ax.plot(old[first], old[second], "s", color=plots.COLOURS[1], label="before")
        x, y = (f"{aim} ({QUANTITIES[aim].unit(robot)})" for aim in result.minimise)
        plots.label(ax, x, y, f"{robot.name}: {first} against {second}")
        ax.legend()
    else:
        numbers = result.best.numbers
        both = [{n: [robot.number(n)] for n in numbers}, {n: [v] for n, v in numbers.items()}]
        efforts = [Followed(Variants(robot, one), path).efforts[0] for one in both]
        figure, axes = plots.columns(1, 2)
        for ax, table, title in zip(axes[0], efforts, ("before", "after"), strict=True):
            for k, joint in enumerate(robot.joint_names):
                colour = plots.COLOURS[k % len(plots.COLOURS)]
                ax.plot(path.time, table[:, k], color=colour, lw=1.2, label=joint)
            unit = " or ".join(sorted(set(robot.effort_units)))
            head = f"{robot.name} {title}: efforts on the path"
            plots.label(ax, "time (s)", f"effort ({unit})", head)
        most = np.nanmax(np.abs(efforts)) * 1.05
        for ax in axes[0]:
            ax.set_ylim(-most, most)
        axes[0][0].legend(fontsize=8)
    plots.save(figure, picture)


def write_sweep(
    robot: Robot, table: Sweep, kind: str, path: Path, out: Path
) -> tuple[dict[str, Any], str]:
    """Write a sweep as NetCDF and tell what is in it.

    :raises MissingExtraError: h5netcdf or xarray is not installed.
    :raises MapError: not writable.
    """
    require("h5netcdf", "atlas")
    xarray = require("xarray", "atlas")
    names = list(table.variables)
    units = {name: entries(robot).get(name, (0.0, ""))[1] for name in names}
    dims = tuple(names) if kind == "grid" else ("machine",)
    coordinates = {
        name: (
            (name,), np.moveaxis(values, k, 0).reshape(len(values), -1)[:, 0],
            {"units": units[name]},
        )
        if kind == "grid" else (dims, values, {"units": units[name]})
        for k, (name, values) in enumerate(table.variables.items())
    }  # fmt: skip
    fields = {
        name: (dims, values, {"units": QUANTITIES[name].unit(robot) or "1",
                              "long_name": QUANTITIES[name].meaning})
        for name, values in table.quantities.items()
    }  # fmt: skip
    about = {"robot": robot.name, "path": path.name, "sweep": kind}
    data = xarray.Dataset(fields, coordinates, about)
    with writing(out):
        data.to_netcdf(out, engine="h5netcdf")
    lost = int(np.isnan(table.quantities["peak-effort"]).sum())
    count = int(np.prod(table.shape))
    result = {"robot": robot.name, "machines": count, "rejected": lost, "out": str(out)}
    text = f"{robot.name}: {count} machines, {lost} cannot follow the path\n{out}"
    return result, text
