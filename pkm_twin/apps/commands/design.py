# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin design``: numbers of a robot's file that are best for a path; sweeps, tolerances."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
import numpy as np

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import MotionOptions, OutputOption, PayloadOption, PictureOptions, SeedOption
from pkm_twin.console import convert_write_errors, draw_progress
from pkm_twin.errors import ParameterError, UnknownNameError, warn_of_file
from pkm_twin.report import Column, Fact, Report, Table, make_judged_fact, plots
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pkm_twin.design import Design as Found
    from pkm_twin.design import PosePath
    from pkm_twin.robot.robot import Robot

SWEEPS: Final = ("grid", "sobol")
FILE_VALUE: Final = "file"
"""Word that stands for the tolerances of the robot's file."""
Box = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class Design(PayloadOption, MotionOptions, OutputOption, PictureOptions, SeedOption):
    """Optimise values of a robot's file for a path.

    The platform of every machine follows the same path. Machines that cannot follow it are
    rejected. peak-effort is the greatest effort of any joint, rms-effort the greatest RMS effort of
    a joint, motor-torque the greatest RMS torque of a motor (files with drives). energy is what the
    drives supply without regeneration, deflection the greatest translation of the reference point
    under the wrench, mass the mass of all bodies and rods without payload. singularity is the least
    singularity index on the path. The search uses exact gradients from several starts and ends in a
    local optimum.

    --sweep writes all quantities of machines within the bounds to a NetCDF file. With --scheduler a
    Dask cluster computes it. --tolerance prints the standard deviations of the platform's position
    and rotation, the worst case, and the share of each part, at the joint positions of the path or,
    without --path, of the workspace. Parts are rods.NAME.length, bodies.NAME.length and joints.NAME
    with at[0..2], axis[0..1], offset, backlash or clearance. * stands for any text. All copies of a
    limb share the error of a part with limbs. in front; parts with commas between share one too.
    """

    vary: tuple[str, ...] = setting(
        (),
        "KEY=LOW:HIGH: bounds of a value, e.g. geometry.arm_length=0.15:0.3; KEY,KEY,-KEY=LOW:HIGH "
        "changes several by the same amount",
    )
    path: Path | None = setting(None, "motion of the robot: CSV or MCAP of `pkm-twin path`, or a recording")
    minimise: tuple[str, ...] = setting(
        (), "peak-effort, rms-effort, motor-torque, energy, deflection or mass; two of them give a Pareto front"
    )
    subject_to: tuple[str, ...] = setting((), "bound on a quantity, e.g. 'singularity>=0.1' or 'peak-effort<=20'")
    tolerance: tuple[str, ...] = setting(
        (), "print the pose error budget: KEY=SIGMA or KEY=+-BOUND, e.g. rods.*.length=2e-5; file: the robot file's"
    )
    monte_carlo: int = setting(0, "with --tolerance: also assemble this many random machines", low=0)
    sweep: str | None = setting(None, "grid or sobol: compute machines within the bounds into --out FILE.nc")
    samples: int = setting(20, "machines of a sweep: per axis of a grid, or in total", low=1)
    scheduler: str | None = setting(None, "with --sweep: address of a Dask scheduler, tcp://HOST:8786")
    wrench: tuple[float, ...] | None = setting(
        None, "wrench on the platform, N and N m, base axes; added to the path's", count=6, metavar="fx,fy,fz,mx,my,mz"
    )
    starts: int = setting(64, "machines to try first; the best are optimised", low=1)
    points: int = setting(9, "points of a Pareto front", low=3)
    out: Path | None = setting(None, "the robot's file with the new values, .yaml; of a sweep .nc", writes=True)


@command("Design and export")
def design(given: Design) -> Report:
    """Optimise a machine, sweep its numbers, or compute its budget of pose errors.

    :raises PkmTwinError: the options contradict each other, or the machine cannot be computed.
    """
    if given.tolerance:
        others = (given.vary, given.minimise, given.sweep, given.subject_to, given.out)
        if any(others) or given.picture:
            raise click.UsageError(
                "--tolerance can only be combined with --path, --wrench, --monte-carlo, --seed and --json"
            )
        return report_budget(given)
    if given.monte_carlo:
        raise click.UsageError("--monte-carlo needs --tolerance")
    if given.path is None:
        raise click.UsageError("give the motion with --path, see `pkm-twin path`")
    if given.sweep is not None:
        return report_sweep(given, given.path, given.sweep)
    if given.scheduler is not None:
        raise click.UsageError("--scheduler needs --sweep")
    if not given.minimise:
        raise click.UsageError("give --minimise, --sweep or --tolerance")
    if given.out is not None and given.out.suffix not in (".yaml", ".yml"):
        raise ParameterError("out", str(given.out), "a name that ends in .yaml or .yml")
    return report_optimum(given, given.path)


def read_path(given: Design, path: Path, *, efforts: bool = True) -> tuple[Robot, PosePath]:
    """Return the robot with the motion's payload, and the platform's path.

    :param efforts: whether they, and so the payload, matter.
    :raises ParameterError: a table that is no motion, or a payload that is held part of the time.
    :raises BagError: a bag without a motion.
    """
    from pkm_twin.design import PosePath

    robot = given.machine()
    motion = given.read_motion(path, robot)
    if motion.load is not None and efforts:
        if motion.load.masses or not motion.load.is_on_platform(motion.time).all():
            bound = "one that is held throughout; --payload gives one"
            raise ParameterError(f"{path}: payload", str(motion.load), bound)
        robot = motion.load.apply_to(robot)
    if efforts and motion.effort_warning:
        warn_of_file(path, motion.effort_warning)
    q, qd, qdd, load = motion.motion
    load = load + np.asarray(given.wrench or np.zeros(6))
    return robot, PosePath.of_joints(robot, motion.time, q, qd, qdd, load)


def report_optimum(given: Design, path: Path) -> Report:
    """Find the machine that is best for a path."""
    from pkm_twin.design import QUANTITIES
    from pkm_twin.design import design as find
    from pkm_twin.design.search import searches
    from pkm_twin.design.variables import parse_vary
    from pkm_twin.robot.limits import beyond_limits

    robot, way = read_path(given, path)
    box = parse_vary(given.vary)
    with draw_progress("searches", searches(len(given.minimise), given.points)) as update:
        found = find(
            robot,
            box,
            way,
            given.minimise,
            given.subject_to,
            starts=given.starts,
            points=given.points,
            seed=given.seed,
            progress=update,
        )
    lost = [] if given.out is None else write_robot(robot, given.robot, found, path, given.out)
    before, best = found.before, found.best
    units = {name: robot.file_numbers().get(name, (0.0, ""))[1] for name in best.numbers}
    bounds = dict(zip(best.variables, box.values(), strict=True))
    _, beyond = beyond_limits(found.robot, found.robot.inverse(way.pose))
    limits = [one.joint for one in beyond]
    both = [Column("before", form=".5g"), Column("after", form=".5g")]
    unit = Column("unit", text=" ")
    tables = [
        Table(
            "variables",
            [*both, Column("low", text=None), Column("high", text=None), unit, Column("", text=" ")],
            {
                name: [
                    before.variables[name],
                    value,
                    *bounds[name],
                    units.get(name, ""),
                    describe_bound(value, bounds[name]),
                ]
                for name, value in best.variables.items()
            },
        ),
        Table(
            "quantities",
            [*both, unit],
            {
                name: [before.quantities.get(name), value, QUANTITIES[name].unit(robot)]
                for name, value in best.quantities.items()
            },
        ),
    ]
    if found.front:
        names = [*found.minimise, *best.variables]
        rows = {
            str(k): [*(point.quantities[n] for n in found.minimise), *point.variables.values()]
            for k, point in enumerate(found.front, 1)
        }
        columns = [Column("", text=name, form=".5g") for name in names]
        tables.append(Table("", columns, rows, "Pareto front"))
    changes = []
    for name in found.minimise:
        was, unit_of = before.quantities.get(name, np.nan), QUANTITIES[name].unit(robot)
        words = f"{name} {best.quantities[name]:.5g} {unit_of}".rstrip()
        changes.append(f"{words} ({was:.5g} before)" if np.isfinite(was) else words)
    notes = [f"{joint} leaves its position limits on the path" for joint in limits]
    notes += lost
    if not before.feasible:
        notes.insert(0, "before: the file's machine cannot follow the path or does not keep the bounds")
    answer = f"{robot.name}: {' and '.join(changes)} on a path of {way.duration:.4g} s"
    return Report(
        f"{answer}; {found.machines} machines computed",
        [
            Fact("robot", robot.name),
            Fact("minimise", list(found.minimise)),
            Fact("subject_to", [str(bound) for bound in found.constraints]),
            Fact("numbers", dict(best.numbers)),
            Fact("before_feasible", before.feasible),
            Fact(
                "front",
                [{"variables": dict(point.variables), "quantities": dict(point.quantities)} for point in found.front],
            ),
            Fact("machines", found.machines),
            Fact("rejected_starts", found.rejected),
            Fact("beyond_position_limits", limits),
            *judge_limits(found, way),
        ],
        tables,
        {"": lambda: draw_design(robot, found, way, answer)},
        notes,
        {"out": given.out},
    )


def judge_limits(found: Found, path: PosePath) -> Iterator[Fact]:
    """Judge the best machine's efforts and singularity index on the path by their limits."""
    from pkm_twin.design.tolerance import MIN_SINGULARITY_INDEX

    robot, limit = found.robot, found.robot.limits.effort
    if limit is not None and "peak-effort" in found.best.quantities:
        peaks = found.peak_efforts(path)
        k = int((peaks / limit).argmax())
        unit, good = robot.effort_units[k], bool(peaks[k] <= limit[k])
        what = f"effort of {robot.joint_names[k]} on the path"
        numbers = {"number": float(peaks[k]), "limit": float(limit[k]), "unit": unit}
        yield make_judged_fact(what, f"{peaks[k]:.4g} {unit}", f"{limit[k]:g} {unit}", good, **numbers)
    index = found.least_singularity(path)
    what = "singularity index on the path"
    numbers = {"number": index, "limit": MIN_SINGULARITY_INDEX, "unit": ""}
    yield make_judged_fact(
        what, f"{index:.4g}", f"{MIN_SINGULARITY_INDEX:g} or more", index >= MIN_SINGULARITY_INDEX, **numbers
    )


def describe_bound(value: float, bound: tuple[float, float]) -> str:
    """Describe the bound that a value is at; empty if it is at none."""
    near = 1e-6 * (bound[1] - bound[0])
    low, high = abs(value - bound[0]) < near, abs(value - bound[1]) < near
    return "at its lower bound" if low else "at its upper bound" if high else ""


def write_robot(robot: Robot, source: str, found: Found, path: Path, out: Path) -> list[str]:
    """Write the robot's file with the new numbers; return the lost expressions, a line each.

    :raises PkmTwinError: not writable.
    """
    from pkm_twin.mechanisms.entries import Chosen, edit_robot_text, write_edited

    kept = "".join(f", {bound}" for bound in found.constraints)
    values = {
        name: Chosen(
            float(f"{value:.12g}"), f"was {' = '.join([*([text] if text else []), f'{robot.number(name):.6g}'])}"
        )
        for name, value in found.best.numbers.items()
        for text in [robot.book.text(name)]
    }
    aim = " and ".join(found.minimise)
    head = [f"{robot.name}, designed for {path}: least {aim}{kept}."]
    return write_edited(out, head, edit_robot_text(robot, source, values), robot)


def draw_design(robot: Robot, found: Found, path: PosePath, answer: str) -> Figure:
    """Draw the Pareto front, or the efforts before and after."""
    from pkm_twin.design import QUANTITIES
    from pkm_twin.design.pose_path import PathMotion
    from pkm_twin.design.variants import Variants

    if found.front:
        figure, ((ax,),) = plots.make_subplots(1, 1)
        first, second = found.minimise
        table = np.array([[p.quantities[first], p.quantities[second]] for p in found.front])
        ax.plot(*table.T, "o-", color=plots.COLOURS[0], label="Pareto front")
        best, old = found.best.quantities, found.before.quantities
        ax.plot(best[first], best[second], "D", color=plots.COLOURS[2], label="chosen")
        if found.before.feasible:
            ax.plot(old[first], old[second], "s", color=plots.COLOURS[1], label="before")
        x, y = (f"{aim} ({QUANTITIES[aim].unit(robot)})" for aim in found.minimise)
        plots.label(ax, x, y)
        plots.legend(ax)
        plots.write_title(figure, answer)
        return figure
    numbers = found.best.numbers
    both = [{n: [robot.number(n)] for n in numbers}, {n: [v] for n, v in numbers.items()}]
    efforts = [PathMotion(Variants(robot, one), path).efforts[0] for one in both]
    figure, (axes,) = plots.make_subplots(1, 2)
    most = np.nanmax(np.abs(efforts)) * 1.05
    for ax, table, title in zip(axes, efforts, ("before", "after"), strict=True):
        for k, joint in enumerate(robot.joint_names):
            colour = plots.COLOURS[k % len(plots.COLOURS)]
            ax.plot(path.time, table[:, k], color=colour, lw=1.2, label=joint)
        unit = " or ".join(sorted(set(robot.effort_units)))
        words = f"{title}: up to {np.nanmax(np.abs(table)):.4g} {unit}"
        plots.label(ax, "time (s)", f"effort ({unit})", words)
        ax.set_ylim(-most, most)
    plots.legend(axes[0])
    plots.write_title(figure, answer)
    return figure


def report_sweep(given: Design, path: Path, kind: str) -> Report:
    """Compute all quantities of machines within bounds, as NetCDF.

    :raises MissingExtraError: h5netcdf or xarray is not installed.
    """
    from pkm_twin.design import sweep as sweep_box
    from pkm_twin.design.sweep import compute_serially
    from pkm_twin.design.variables import parse_vary
    from pkm_twin.errors import import_extra
    from pkm_twin.maps.run import compute_on_cluster

    out = given.out
    if kind not in SWEEPS:
        raise UnknownNameError("sweep", kind, SWEEPS)
    if given.minimise or given.subject_to or given.picture:
        raise click.UsageError("--sweep computes all quantities; leave out --minimise and --subject-to")
    if out is None or out.suffix != ".nc":
        raise ParameterError("out", str(out), "a name that ends in .nc, for --sweep")
    import_extra("h5netcdf", "maps")
    import_extra("xarray", "maps")
    robot, way = read_path(given, path)
    box = parse_vary(given.vary)
    grid = kind == "grid"
    compute = compute_serially if given.scheduler is None else partial(compute_on_cluster, scheduler=given.scheduler)
    with draw_progress("machines", given.samples ** len(box) if grid else given.samples) as update:
        table = sweep_box(
            robot,
            box,
            way,
            None,
            given.samples,
            "grid" if grid else "sobol",
            seed=given.seed,
            progress=update,
            compute=compute,
        )
    with convert_write_errors(out):
        table.dataset(robot, path.name, kind).to_netcdf(out, engine="h5netcdf")
    count, lost = int(np.prod(table.shape)), int(np.isnan(table.quantities["peak-effort"]).sum())
    return Report(
        f"{robot.name}: {count} machines, {lost} cannot follow the path",
        [Fact("robot", robot.name), Fact("machines", count), Fact("rejected", lost)],
        files={"out": out},
    )


def report_budget(given: Design) -> Report:
    """Report the pose error budget over a path, or over the workspace without one.

    :raises ParameterError: as :func:`~pkm_twin.design.tolerances`, or a file without limits.
    """
    from pkm_twin.design import tolerances
    from pkm_twin.design.budget import ErrorBudget, draw_machines
    from pkm_twin.design.tolerance import rms_length, workspace_states
    from pkm_twin.design.variables import parse_tolerances
    from pkm_twin.identification.calibration import calibrated_errors

    robot, where = given.machine(), "the workspace"
    sigma = parse_tolerances([text for text in given.tolerance if text != FILE_VALUE])
    if FILE_VALUE in given.tolerance:
        if not robot.tolerances:
            raise ParameterError("tolerances", None, "a section tolerances in the robot file")
        sigma = {**robot.tolerances, **sigma}
    if given.path is None:
        q = workspace_states(robot, 2000, given.seed)
    else:
        q, where = (robot.inverse(read_path(given, given.path, efforts=False)[1].pose), given.path.name)
    found = tolerances(robot, sigma, q, given.wrench)
    summary = ErrorBudget(robot, found, q, calibrated_errors(robot, found, q))
    rows: dict[str, list[Any]] = {
        name: [
            one.sigma,
            one.bound,
            one.unit,
            *one.position,
            *one.angle,
            one.calibrated,
            one.share,
            one.text,
            "" if one.moves else "moves nothing",
        ]
        for name, one in summary.contributions.items()
    }
    columns = [
        Column("sigma"),
        Column("bound", "", None),
        Column("unit", text=" "),
        Column("rms_position_m", "m", "RMS", 1e3, "mm"),
        Column("greatest_position_m", "m", "max", 1e3, "mm"),
        Column("rms_angle_rad", "rad", "RMS", 1e3, "mrad"),
        Column("greatest_angle_rad", "rad", None),
        Column("rms_calibrated_position_m", "m", "RMS calibrated", 1e3, "mm"),
        Column("share", "", "share", 100.0, "%", ".3g"),
        Column("varied", text="what varies"),
        Column("", text=" "),
    ]
    sizes = summary.sizes
    turning, (shift, bound) = found.only_turns, summary.bounds
    at, bound_at = (
        f" at {', '.join(f'{n} {value:.4g}' for n, value in zip(robot.pose_names, pose, strict=True))}"
        for pose in (summary.worst_pose, summary.bound_pose)
    )
    case = "worst case of all bounds" if found.is_exact else "upper bound of the worst case"
    facts = [
        Fact("robot", robot.name),
        Fact("states", len(q)),
        Fact("path", None if given.path is None else str(given.path)),
        _report_length("rms_position_m", sizes.rms_position),
        _report_length(
            "greatest_position_m", sizes.greatest_position, None if turning else "largest standard deviation", at
        ),
        Fact("rms_angle_rad", sizes.rms_angle, "rad", "RMS rotation", f"{1e3 * sizes.rms_angle:.4g} mrad"),
        Fact(
            "greatest_angle_rad",
            sizes.greatest_angle,
            "rad",
            "largest standard deviation" if turning else None,
            f"{1e3 * sizes.greatest_angle:.4g} mrad{at}",
        ),
        Fact("worst_pose", summary.worst_pose),
        _report_length("bound_position_m", shift, None if turning else case, bound_at),
        Fact("bound_angle_rad", bound, "rad", case if turning else None, f"{1e3 * bound:.4g} mrad{bound_at}"),
        Fact("bound_pose", summary.bound_pose),
        Fact("bound_is_reached", found.is_exact),
        _report_length(
            "rms_calibrated_position_m", summary.calibrated_position, "RMS after a calibration without noise"
        ),
    ]
    if given.monte_carlo:
        exact = draw_machines(summary, sigma, given.monte_carlo, given.seed)
        words = (
            f"RMS {1e3 * exact.rms_position_m:.4g} mm in {exact.states} of the states "
            f"({1e3 * exact.first_order_rms_position_m:.4g} mm to first order), largest error "
            f"{1e3 * exact.greatest_position_m:.4g} mm"
        )
        label = f"{given.monte_carlo} random machines, assembled exactly"
        facts.append(Fact("monte_carlo", asdict(exact), text=label, shown=words))
    if (bent := found.deflection) is not None:
        label = "deflection under the wrench, not in the table: RMS"
        facts.append(_report_length("rms_deflection_m", rms_length(bent[..., :3]), label))
    what = f"rotation {1e3 * sizes.rms_angle:.4g} mrad" if turning else f"position {1e3 * sizes.rms_position:.4g} mm"
    held = f"{', '.join(robot.graph.leads)}" if robot.redundant else "actuated joints"
    return Report(
        f"{robot.name}: standard deviation of the platform's {what} RMS over {where}, {len(q)} states, {held} held",
        facts,
        [Table("contributions", columns, rows, head="error")],
    )


def _report_length(name: str, value: float, text: str | None = None, more: str = "") -> Fact:
    return Fact(name, value, "m", text, f"{1e3 * value:.4g} mm{more}")
