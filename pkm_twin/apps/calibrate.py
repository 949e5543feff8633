# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin calibrate``: the geometry of one's own machine from measured platform poses."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from textwrap import fill
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from pkm_twin.apps.limits import beyond_limits as find_beyond
from pkm_twin.apps.limits import refuse_beyond
from pkm_twin.apps.options import Accept, BeyondLimits, Json, Platform, RobotName
from pkm_twin.apps.partial_report import (
    WIDTH,
    outlier_texts,
    parse_noise,
    parse_within,
    partial_data,
    plan_data,
    plan_table,
    print_partial,
    print_plan,
    scale_text,
)
from pkm_twin.apps.pose_table import LENGTHS, parse_columns, read_partial, read_poses
from pkm_twin.console import print_json, progress, refuse_existing, table_console
from pkm_twin.errors import ParameterError, one_line
from pkm_twin.files import replace_file
from pkm_twin.identification.calibration import (
    HELD_OUT,
    Calibration,
    Estimate,
    calibrate,
    geometric,
)
from pkm_twin.identification.calibration_faults import Outlier
from pkm_twin.identification.calibration_fit import STEPS, Parameter
from pkm_twin.identification.calibration_state import BESIDE, Errors, Poses
from pkm_twin.identification.measurements import Partial, kinds_of
from pkm_twin.identification.partial import PartialCalibration, calibrate_partial
from pkm_twin.identification.plan import MOST
from pkm_twin.identification.plan import plan as plan_poses
from pkm_twin.identification.transmission import Transmission, written
from pkm_twin.options import OptionalFloat, OptionalInt, OptionalPath, OptionalText, file_name
from pkm_twin.robot.edited import Fitted, edited_yaml, write_edited

Array = NDArray[np.float64]

UNKNOWN = "; not determined by these measurements"
MOST_SHOWN = 10
"""Outliers that are printed."""


def calibrate_command(
    robot: RobotName,
    poses: Annotated[
        OptionalPath,
        typer.Argument(
            help="CSV: JOINT.position columns, x y z (m), perhaps roll pitch yaw (rad) or "
            "qx qy qz qw; or what --measure names"
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option(help="the calibrated robot, a YAML", callback=file_name)
    ] = Path("calibrated.yaml"),
    only: Annotated[
        list[str],
        typer.Option(help="fit only numbers whose path begins with this; may be repeated"),
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
    transmission: Annotated[
        Transmission,
        typer.Option(
            help="ratios of joint_map to fit: each joint's, one factor shared by all, each and its "
            "change with travel (a spool), or none (file); auto: each of sliding joints that have "
            "a ratio"
        ),
    ] = Transmission.AUTO,
    columns: Annotated[
        list[str],
        typer.Option(
            help="NAME=HEADER of columns with other headers, separated by commas: "
            "'leg_*.position=motor_*, x=pos_x [mm]'; may be repeated"
        ),
    ] = [],  # noqa: B006  typer copies it
    unit: Annotated[
        str, typer.Option(help="of x, y and z where their headers have none: m, cm, mm or µm (um)")
    ] = "m",
    measure: Annotated[
        list[str],
        typer.Option(
            help="what was measured, where not whole poses, separated by commas: height, distance "
            "(of two poses), radius (ball bar), plane (contact), tilt (roll, pitch), or of x, y, "
            "z, roll, pitch, yaw"
        ),
    ] = [],  # noqa: B006  typer copies it
    noise: Annotated[
        list[str],
        typer.Option(help="KIND=VALUE: known standard deviation of a measurement, m or rad"),
    ] = [],  # noqa: B006  typer copies it
    plan: Annotated[
        OptionalPath,
        typer.Option(
            help="write the poses to measure next, a CSV, and predict how well the machine will "
            "be known; calibrate nothing",
            callback=file_name,
        ),
    ] = None,
    count: Annotated[OptionalInt, typer.Option(min=1, max=MOST, help="poses of a plan")] = None,
    accuracy: Annotated[
        OptionalFloat,
        typer.Option(min=1e-9, help="position's standard deviation that a plan is to reach, m"),
    ] = None,
    within: Annotated[
        OptionalText,
        typer.Option(help="where a plan measures: x=-0.1:0.1,z=0 (m, rad); default: everywhere"),
    ] = None,
    platform: Platform = None,
    beyond_limits: BeyondLimits = False,
    accept: Accept = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the file")] = False,
    as_json: Json = False,
) -> None:
    """Fit a robot's geometry and joint offsets to poses that an instrument measured.

    A robust least-squares fit with the machine's closures. A pose that does not fit the others gets
    a small weight, and the report names its line. Numbers that the poses do not determine keep the
    file's values and are listed. The fit does not use every fourth pose: the error there, before
    and after, is the calibration's accuracy.

    Poses that this machine cannot reach are rejected with the reason, and without --frame so are
    poses in another frame than the base's. --accept calibrates anyway and marks the file.

    With --measure, parts of the poses are enough, and cells may be empty. Each measurement is then
    compared with the fit to all others, and the report says whether the scale is determined.
    --plan chooses the most informative poses.
    """
    from pkm_twin import load

    if out.suffix not in (".yaml", ".yml"):
        raise ParameterError("out", str(out), "a name that ends in .yaml or .yml")
    if unit not in LENGTHS:
        raise ParameterError("unit", unit, f"one of {', '.join(LENGTHS)}")
    if plan is not None and plan.suffix != ".csv":
        raise ParameterError("plan", str(plan), "a name that ends in .csv")
    refuse_existing(plan or out, overwrite, poses)
    machine = load(robot, platform=platform)
    kinds = kinds_of(measure or (["position"] if plan else []))
    known, named = parse_noise(noise), parse_columns(columns)
    measured: Poses | Partial | None = None
    if poses is not None and kinds:
        measured = read_partial(poses, machine, kinds, known, named, unit)
    elif poses is not None:
        measured = read_poses(poses, machine, named, unit)
    notes = []
    if measured is not None:
        q = machine.controller.positions(measured.joints)
        _, beyond = find_beyond(machine, q)
        if not beyond_limits:
            refuse_beyond(beyond)
        notes = [f"beyond limits: {item}" for item in beyond]
    options: dict[str, Any] = {
        "offsets": offsets, "frame": frame, "target": target, "prior": prior,
        "transmission": transmission,
    }  # fmt: skip
    if plan is not None:
        some = measured if isinstance(measured, Partial) else None
        chosen = plan_poses(
            machine, kinds, only, measured=some, within=parse_within(within), count=count,
            accuracy=accuracy, noise=known, **options,
        )  # fmt: skip
        replace_file(plan, ("\n".join([*plan_table(machine, chosen), ""])).encode())
        if as_json:
            print_json({"robot": machine.name, "out": str(plan), **plan_data(chosen, accuracy)})
            return
        print_plan(chosen, accuracy)
        _print_open(chosen.known)
        typer.echo(f"{plan}: {len(chosen.joints)} poses")
        return
    if poses is None or measured is None:
        raise ParameterError("poses", None, "a CSV of measured poses, or --plan FILE.csv")
    paths = geometric(machine, q, only)
    result: Calibration | PartialCalibration
    with progress("steps", 2 * STEPS) as update:
        done = 0

        def step(count: int) -> None:
            nonlocal done
            done += count
            update(done)

        options |= {"accept": accept, "progress": step}
        if isinstance(measured, Partial):
            result = calibrate_partial(machine, measured, paths, **options)
        else:
            result = calibrate(machine, measured, paths, **options)
    marks = [*(f"accepted anyway: {fault}" for fault in result.faults), *notes]
    source = f"calibrated with {one_line(poses.name, 100)}"
    own = measured.own if isinstance(measured, Partial) else {}
    values = {
        p.name: Fitted(p.value, p.deviation, p.unit, source + ("" if p.observed else UNKNOWN))
        for p in result.parameters
        if not p.name.startswith(BESIDE) and p.name not in own
    }
    mapped = {p.name: (p.value, p.deviation) for p in result.parameters}
    values |= {
        path: Fitted(*number, source)
        for path, number in written(machine, result.joint_map, mapped).items()
    }
    head = [f"{machine.name}, {source}: {len(measured.joints)} poses."]
    if isinstance(result, PartialCalibration):
        head += [f"Measured: {', '.join(f'{a.rows} {a.name}' for a in result.agreements)}."]
        if result.scale is not None:
            head.append(f"{scale_text(result.scale)}.")
        outliers = outlier_texts(result)
    else:
        outliers = [_outlier_text(one) for one in result.outliers]
    head += [f"Outlier, with a small weight: {line}." for line in outliers]
    write_edited(out, [*head, *marks], edited_yaml(machine, robot, values))
    if as_json:
        about = {
            "robot": machine.name, "out": str(out), "beyond_limits": notes,
            "accepted": [str(fault) for fault in result.faults],
        }  # fmt: skip
        print_json({**about, **as_data(result)})
        return
    _print(result)
    for line in marks:
        typer.echo(line)
    typer.echo(f"{out}: {len(values)} numbers")


def as_data(result: Calibration | PartialCalibration) -> dict[str, Any]:
    """Plain numbers for a script, SI units."""
    listed = {
        "parameters": {
            p.name: {
                "unit": p.unit,
                "before": p.before,
                "value": p.value,
                "standard_deviation": p.deviation,
                "observed": p.observed,
            }
            for p in result.parameters
        }
    }
    if isinstance(result, PartialCalibration):
        return {**listed, **partial_data(result)}
    pairs = {"fitted": result.fitted, "held_out": result.held_out}
    return {
        **listed,
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


def _print(result: Calibration | PartialCalibration) -> None:
    table = Table(title=Text("calibrated parameters"))
    for column in ("parameter", "before", "after", "standard deviation", "unit", "determined"):
        table.add_column(column)
    for p in result.parameters:
        table.add_row(Text(p.name), *_row(p))
    table_console().print(table)
    if isinstance(result, PartialCalibration):
        print_partial(result)
    else:
        _print_errors(result)
    _print_open(result)


def _print_errors(result: Calibration) -> None:
    errors = Table(title=Text("distance between measured and computed poses"))
    for column in ("poses", "RMS before", "RMS after", "worst before", "worst after"):
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
    typer.echo(f"remaining noise per axis: {noise}; condition number {result.condition:.3g}")
    for one in result.outliers[:MOST_SHOWN]:
        typer.echo(f"outlier, with a small weight: {_outlier_text(one)}")
    if len(result.outliers) > MOST_SHOWN:
        typer.echo(f"{len(result.outliers) - MOST_SHOWN} more outliers: see --json")


def _print_open(result: Estimate) -> None:
    open_lines = result.undetermined
    if open_lines:
        typer.echo("the poses do not determine these parameters, which keep the file's values:")
    for line in open_lines:
        typer.echo(fill(line, WIDTH, initial_indent="  ", subsequent_indent="    "))


def _outlier_text(one: Outlier) -> str:
    angle = "" if one.angle is None else f", {1e3 * one.angle:.3g} mrad"
    return (
        f"row {one.index + 1} (line {one.line}) is off by {1e3 * one.distance:.3g} mm{angle}, "
        f"{one.sigmas:.3g} sigma"
    )


def _row(p: Parameter) -> tuple[str, ...]:
    numbers = (f"{value:.6g}" for value in (p.before, p.value))
    return (*numbers, f"{p.deviation:.2g}", p.unit, "yes" if p.observed else "no")
