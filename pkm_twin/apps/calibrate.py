# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin calibrate``: the geometry of one's own machine from measured platform poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from pkm_twin.apps.calibration import (
    HELD_OUT,
    STEPS,
    Calibration,
    Parameter,
    calibrate,
    geometric,
)
from pkm_twin.apps.calibration_faults import Outlier
from pkm_twin.apps.calibration_state import FRAME, TARGET, Errors, Poses, rotations
from pkm_twin.apps.columns import read_columns
from pkm_twin.apps.limits import beyond_limits as find_beyond
from pkm_twin.apps.limits import refuse_beyond
from pkm_twin.apps.options import Accept, BeyondLimits, Json, RobotName
from pkm_twin.console import file_name, print_json, progress, refuse_existing, table_console
from pkm_twin.errors import ParameterError, UnknownNameError, one_line
from pkm_twin.machine.edited import Fitted, edited_yaml, write_edited
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

ANGLES = ("roll", "pitch", "yaw")
MOST_SHOWN = 10
"""Outliers that are printed."""
FARTHEST = 1e4
"""No instrument stands farther from what it measures, m."""
QUATERNION = ("qx", "qy", "qz", "qw")


def read_poses(path: Path, robot: Robot) -> Poses:
    """Measured poses of a CSV.

    Columns, in any order: ``JOINT.position`` of every joint, in the controller's names and numbers;
    ``x y z``, m; and, where measured, ``roll pitch yaw``, rad, or ``qx qy qz qw``, of the platform
    relative to home.

    :raises ParameterError: a column is missing, or a value is no finite number.
    """
    columns = read_columns(path)
    joints = [f"{name}.position" for name in robot.controller.names]
    known = [*joints, "x", "y", "z", *ANGLES, *QUATERNION]
    for name in columns:
        if name.endswith(".position") and name not in known:
            raise UnknownNameError(f"{path}: column", name, known)

    def stack(names: Sequence[str]) -> Array:
        missing = [name for name in names if name not in columns]
        if missing:
            raise ParameterError(str(path), ", ".join(columns), f"a column {missing[0]!r}")
        return np.stack([columns[name] for name in names], -1)

    def stack_some(names: Sequence[str]) -> Array | None:
        return stack(names) if any(name in columns for name in names) else None

    q, position = stack(joints), stack("xyz")
    for names, bound, unit in ((("x", "y", "z"), FARTHEST, "m"), (ANGLES, 2.0 * np.pi, "rad")):
        for name in names:
            values = columns.get(name, np.zeros(1))
            if np.abs(values).max() > bound:
                worst = int(np.abs(values).argmax())
                raise ParameterError(
                    f"{path}: line {worst + 2}: {name}",
                    float(values[worst]),
                    f"{unit}, up to {bound:.3g} in size",
                )
    angles, quaternion = stack_some(ANGLES), stack_some(QUATERNION)
    rotation = None
    if quaternion is not None:
        if not (np.linalg.norm(quaternion, axis=1) > 1e-6).all():
            raise ParameterError(f"{path}: qx qy qz qw", 0.0, "quaternions of length one")
        rotation = rotations().from_quat(quaternion).as_matrix()
    elif angles is not None:
        rotation = rotations().from_euler("xyz", angles).as_matrix()
    return Poses(q, position, rotation)


def calibrate_command(
    robot: RobotName,
    poses: Annotated[
        Path,
        typer.Argument(
            help="CSV: JOINT.position columns, x y z (m), perhaps roll pitch yaw (rad) or "
            "qx qy qz qw",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="the calibrated robot, a YAML", callback=file_name)
    ] = Path("calibrated.yaml"),
    only: Annotated[
        list[str], typer.Option(help="fit only numbers whose path begins so; may be repeated")
    ] = [],  # noqa: B006  typer copies it
    offsets: Annotated[
        bool, typer.Option("--offsets/--no-offsets", help="fit the joints' sensor offsets")
    ] = True,
    frame: Annotated[
        bool, typer.Option("--frame", help="fit where the instrument stands: its six numbers")
    ] = False,
    target: Annotated[
        bool,
        typer.Option("--target", help="fit where the target is on the platform: three numbers"),
    ] = False,
    prior: Annotated[
        float,
        typer.Option(
            min=1e-6, max=1.0, help="how well lengths are known before, m (standard deviation)"
        ),
    ] = 0.01,
    beyond_limits: BeyondLimits = False,
    accept: Accept = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the file")] = False,
    as_json: Json = False,
) -> None:
    """Fit a robot's geometry and joint offsets to poses that an instrument measured.

    Robust least squares on the machine's own closures, by their exact derivatives. A pose that does
    not fit the others hardly counts and is named by its line. What the poses do not determine stays
    as the file has it and is named. Every fourth pose is held out: the error there, before and
    after, is the calibration's accuracy.

    Poses that this machine cannot have been in are rejected with the reason, and so are poses in
    another frame than the base's without --frame; --accept calibrates all the same and marks the
    file.
    """
    from pkm_twin import load

    if out.suffix not in (".yaml", ".yml"):
        raise ParameterError("out", str(out), "a name that ends in .yaml or .yml")
    refuse_existing(out, overwrite, poses)
    machine = load(robot)
    measured = read_poses(poses, machine)
    q = machine.controller.positions(measured.joints)
    _, beyond = find_beyond(machine, q)
    if not beyond_limits:
        refuse_beyond(beyond)
    notes = [f"beyond limits: {item}" for item in beyond]
    paths = geometric(machine, q, only)
    with progress("steps", 2 * STEPS) as update:
        done = 0

        def step(count: int) -> None:
            nonlocal done
            done += count
            update(done)

        result = calibrate(
            machine, measured, paths, offsets=offsets, frame=frame, target=target, prior=prior,
            accept=accept, progress=step,
        )  # fmt: skip
    marks = [*(f"accepted all the same: {fault}" for fault in result.faults), *notes]
    source = f"calibrated with {one_line(poses.name, 100)}"
    values = {
        p.name: Fitted(p.value, p.deviation, p.unit, source)
        for p in result.parameters
        if p.name not in (*FRAME, *TARGET)
    }
    head = [f"{machine.name}, {source}: {len(measured.joints)} poses."]
    head += [f"Outlier, hardly counted: {_outlier_text(one)}." for one in result.outliers]
    write_edited(out, [*head, *marks], edited_yaml(machine, robot, values))
    if as_json:
        named = {
            "robot": machine.name, "out": str(out), "beyond_limits": notes,
            "accepted": [str(fault) for fault in result.faults],
        }  # fmt: skip
        print_json({**named, **as_data(result)})
        return
    _print(result)
    for line in marks:
        typer.echo(line)
    typer.echo(f"{out}: {len(values)} numbers")


def as_data(result: Calibration) -> dict[str, Any]:
    """Plain numbers for a script, SI units."""
    pairs = {"fitted": result.fitted, "held_out": result.held_out}
    return {
        "parameters": {
            p.name: {
                "unit": p.unit,
                "before": p.before,
                "value": p.value,
                "standard_deviation": p.deviation,
                "observed": p.observed,
            }
            for p in result.parameters
        },
        "not_observed": list(result.unobserved),
        "outliers": [
            {
                "row": one.index + 1,
                "line": one.line,
                "distance_m": one.distance,
                "distance_rad": one.angle,
                "sigmas": one.sigmas,
            }
            for one in result.outliers
        ],
        "condition": result.condition,
        "noise_m": result.noise,
        "noise_rad": result.noise_angle,
        "steps": result.steps,
        **{
            name: {"before": _errors(before), "after": _errors(after)}
            for name, (before, after) in pairs.items()
        },
    }


def _errors(errors: Errors) -> dict[str, float]:
    names = {"rms": "rms_m", "worst": "worst_m", "rms_angle": "rms_rad", "worst_angle": "worst_rad"}
    return {names[key]: value for key, value in asdict(errors).items() if value is not None}


def _print(result: Calibration) -> None:
    table = Table(title=Text("calibrated numbers"))
    for column in ("number", "before", "after", "deviation", "unit", "observed"):
        table.add_column(column)
    for p in result.parameters:
        table.add_row(Text(p.name), *_row(p))
    table_console().print(table)
    errors = Table(title=Text("distance of measured and computed poses"))
    for column in ("poses", "rms before", "rms after", "worst before", "worst after"):
        errors.add_column(column)
    for name, (before, after) in (
        ("fitted", result.fitted),
        (f"held out, every {HELD_OUT}th", result.held_out),
    ):
        lengths = (before.rms, after.rms, before.worst, after.worst)
        errors.add_row(Text(f"{name}, mm"), *(f"{1e3 * value:.4f}" for value in lengths))
        angles = (before.rms_angle, after.rms_angle, before.worst_angle, after.worst_angle)
        told = [value for value in angles if value is not None]
        if told:
            errors.add_row(Text(f"{name}, mrad"), *(f"{1e3 * value:.4f}" for value in told))
    table_console().print(errors)
    noise = f"{1e3 * result.noise:.4f} mm"
    if result.noise_angle is not None:
        noise += f", {1e3 * result.noise_angle:.4f} mrad"
    typer.echo(f"noise that is left, an axis: {noise}; condition number {result.condition:.3g}")
    for one in result.outliers[:MOST_SHOWN]:
        typer.echo(f"outlier, hardly counted: {_outlier_text(one)}")
    if len(result.outliers) > MOST_SHOWN:
        typer.echo(f"{len(result.outliers) - MOST_SHOWN} more outliers: see --json")
    open_lines = result.undetermined
    if open_lines:
        typer.echo("the poses do not determine, and the file's values stay:")
    for line in open_lines:
        typer.echo(f"  {line}")


def _outlier_text(one: Outlier) -> str:
    angle = "" if one.angle is None else f", {1e3 * one.angle:.3g} mrad"
    return (
        f"row {one.index + 1} (line {one.line}) is off by {1e3 * one.distance:.3g} mm{angle}, "
        f"{one.sigmas:.3g} sigma"
    )


def _row(p: Parameter) -> tuple[str, ...]:
    numbers = (f"{value:.6g}" for value in (p.before, p.value))
    return (*numbers, f"{p.deviation:.2g}", p.unit, "yes" if p.observed else "no")
