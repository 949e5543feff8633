# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin calibrate``: the geometry of one's own machine from measured platform poses."""

from __future__ import annotations

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
    SIZES,
    WIDTH,
    parse_noise,
    parse_within,
    plan_data,
    plan_table,
    print_plan,
    scale_text,
)
from pkm_twin.apps.pose_table import LENGTHS, parse_columns, read_measured, read_poses
from pkm_twin.console import print_json, progress, refuse_existing, table_console
from pkm_twin.errors import ParameterError, one_line
from pkm_twin.files import replace_file
from pkm_twin.identification.calibration import (
    Agreement,
    Calibration,
    Estimate,
    calibrate,
    geometric,
)
from pkm_twin.identification.calibration_fit import STEPS
from pkm_twin.identification.calibration_state import BESIDE, Poses
from pkm_twin.identification.measurements import Measured, kinds_of
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
            "(of two poses), radius (ball bar), range (laser tracker), plane (contact), tilt, or of x, y, "
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
    a small weight, and the report names its line. Changes of numbers that the poses do not
    determine are listed and not made; a number in one may still change with others. The fit does
    not use every fourth pose: the error there, before and after, is the calibration's accuracy.

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
    measured: Poses | Measured | None = None
    if poses is not None and kinds:
        measured = read_measured(poses, machine, kinds, known, named, unit)
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
        some = measured if isinstance(measured, Measured) else None
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
    with progress("steps", 2 * STEPS) as update:
        done = 0

        def step(count: int) -> None:
            nonlocal done
            done += count
            update(done)

        result = calibrate(machine, measured, paths, accept=accept, progress=step, **options)
    marks = [*(f"accepted anyway: {fault}" for fault in result.faults), *notes]
    source = f"calibrated with {one_line(poses.name, 100)}"
    values = {
        p.name: Fitted(p.value, p.deviation, p.unit, source + ("" if p.observed else UNKNOWN))
        for p in result.parameters
        if not p.name.startswith(BESIDE) and p.name not in result.instrument.own
    }
    mapped = {p.name: (p.value, p.deviation) for p in result.parameters}
    values |= {
        path: Fitted(*number, source)
        for path, number in written(machine, result.joint_map, mapped).items()
    }
    counts = ", ".join(f"{a.count} {a.name}" for a in result.agreements)
    head = [f"{machine.name}, {source}: {len(measured.joints)} poses.", f"Measured: {counts}."]
    if result.scale is not None:
        head.append(f"{scale_text(result.scale)}.")
    head += [f"Outlier, with a small weight: {one}." for one in result.outliers]
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


def as_data(result: Calibration) -> dict[str, Any]:
    """Plain numbers for a script, SI units."""
    whole = {a.unit: a for a in result.agreements if a.name in ("position", "rotation")}
    scale = result.scale
    data: dict[str, Any] = {
        "parameters": {
            p.name: {
                "unit": p.unit, "before": p.before, "value": p.value,
                "standard_deviation": p.deviation, "observed": p.observed,
            }
            for p in result.parameters
        },
        "measurements": {
            a.name: {
                "unit": a.unit, "count": a.count, "before": a.fitted[0]._asdict(),
                "after": a.fitted[1]._asdict(), "held_out": a.held_out[1]._asdict(),
                "noise": a.noise,
            }
            for a in result.agreements
        },
        "not_observed": list(result.unobserved),
        "outliers": [
            {
                "row": one.line - 1, "line": one.line, "kind": one.worst.kind,
                "size": one.worst.size, "sigmas": one.worst.sigmas,
                **{f"distance_{unit}": one.size(unit) for unit in SIZES},
            }
            for one in result.outliers
        ],
        "scale": None if scale is None else {
            "relative_deviation_before": scale.before, "relative_deviation": scale.after,
            "determined": scale.determined,
        },
        "condition": result.condition,
        "steps": result.steps,
    }  # fmt: skip
    if not whole:
        return data
    data |= {f"noise_{unit}": whole[unit].noise if unit in whole else None for unit in SIZES}
    for name in ("fitted", "held_out"):
        pairs = {unit: getattr(a, name) for unit, a in whole.items()}
        data[name] = {
            when: {f"{key}_{unit}": v for unit, pair in pairs.items()
                   for key, v in pair[k]._asdict().items()}
            for k, when in enumerate(("before", "after"))
        }  # fmt: skip
    return data


def _print(result: Calibration) -> None:
    table = Table(title=Text("calibrated parameters"))
    for column in ("parameter", "before", "after", "standard deviation", "unit", "determined"):
        table.add_column(column)
    for p in result.parameters:
        numbers = (f"{value:.6g}" for value in (p.before, p.value))
        known = "yes" if p.observed else "no"
        table.add_row(Text(p.name), *numbers, f"{p.deviation:.2g}", p.unit, known)
    table_console().print(table)
    errors = Table(title=Text("measured minus computed, RMS and worst"))
    for column in (
        "measurement",
        "count",
        "before",
        "after",
        "held out before",
        "held out",
        "unit",
    ):
        errors.add_column(column)
    for a in result.agreements:
        errors.add_row(a.name, str(a.count), *_errors(a))
    table_console().print(errors)
    typer.echo("held out: every fourth whole pose, or each measurement against a fit to all others")
    noise = ", ".join(f"{a.name} {a.noise * 1e3:.4f} m{a.unit}" for a in result.agreements)
    condition = result.condition or np.inf
    typer.echo(f"remaining noise per axis: {noise}; condition number {condition:.3g}")
    if result.scale is not None:
        typer.echo(fill(scale_text(result.scale), WIDTH))
    for one in result.outliers[:MOST_SHOWN]:
        typer.echo(f"outlier, with a small weight: {one}")
    if len(result.outliers) > MOST_SHOWN:
        typer.echo(f"{len(result.outliers) - MOST_SHOWN} more outliers: see --json")
    _print_open(result)


def _errors(a: Agreement) -> list[str]:
    unit, factor = SIZES[a.unit]
    pairs = (*a.fitted, *a.held_out)
    return [*(f"{factor * rms:.4f}, {factor * worst:.4f}" for rms, worst in pairs), unit]


def _print_open(result: Estimate) -> None:
    open_lines = result.undetermined
    if open_lines:
        typer.echo(
            "the poses do not determine these changes, and the calibration makes none of them; a "
            "number in one may still change with others:"
        )
    for line in open_lines:
        typer.echo(fill(line, WIDTH, initial_indent="  ", subsequent_indent="    "))
