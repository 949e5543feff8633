# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin design``: numbers of a robot's file that are best for a path; sweeps, tolerances."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Final

import typer

from pkm_twin.apps.options import Json, Payload, Platform, RobotName, loaded, read_options
from pkm_twin.console import answer, numbers, progress, refuse_existing
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.options import OptionalPath, OptionalText, file_name

SWEEPS: Final = ("grid", "sobol")


def design_command(
    robot: RobotName,
    vary: Annotated[
        list[str],
        typer.Option(
            help="PATH=LOW:HIGH: a value of the robot's file and its bounds, e.g. "
            "geometry.arm_length=0.15:0.3; PATH,PATH,-PATH=LOW:HIGH changes several by the same "
            "amount",
            show_default=False,
        ),
    ] = [],  # noqa: B006  typer copies it
    path: Annotated[
        OptionalPath,
        typer.Option(help="motion of the robot: CSV or MCAP of `pkm-twin path`, or a recording"),
    ] = None,
    minimise: Annotated[
        list[str],
        typer.Option(
            help="peak-effort, rms-effort, energy, deflection or mass; two of them give a Pareto "
            "front",
            show_default=False,
        ),
    ] = [],  # noqa: B006
    subject_to: Annotated[
        list[str],
        typer.Option(help="bound on a quantity, e.g. 'singularity>=0.1' or 'peak-effort<=20'"),
    ] = [],  # noqa: B006
    tolerance: Annotated[
        list[str],
        typer.Option(
            help="PATH=SIGMA: the standard deviation of a part's error, e.g. "
            "rods.left_1.length=2e-5; prints the pose error budget"
        ),
    ] = [],  # noqa: B006
    monte_carlo: Annotated[
        int,
        typer.Option(help="of --tolerance: machines to draw and assemble exactly as well", min=0),
    ] = 0,
    sweep: Annotated[
        OptionalText,
        typer.Option(help="grid or sobol: compute machines within the bounds into --out FILE.nc"),
    ] = None,
    samples: Annotated[
        int,
        typer.Option(help="machines of a sweep: per axis of a grid, or in total with sobol", min=1),
    ] = 20,
    scheduler: Annotated[
        OptionalText, typer.Option(help="of a sweep: address of a Dask scheduler: tcp://HOST:8786")
    ] = None,
    wrench: Annotated[
        OptionalText,
        typer.Option(
            help="fx,fy,fz,mx,my,mz on the platform, N and N m, base axes; added to the path's"
        ),
    ] = None,
    payload: Payload = None,
    platform: Platform = None,
    starts: Annotated[
        int, typer.Option(help="machines to start from; the best are optimised", min=1)
    ] = 64,
    points: Annotated[int, typer.Option(help="points of a Pareto front", min=3)] = 9,
    seed: Annotated[int, typer.Option(help="seed of starts and samples", min=0)] = 0,
    out: Annotated[
        OptionalPath,
        typer.Option(
            help="FILE.yaml: the robot's file with the new values; for a sweep FILE.nc",
            callback=file_name,
        ),
    ] = None,
    picture: Annotated[
        OptionalPath,
        typer.Option(help="PNG: efforts before and after, or the Pareto front", callback=file_name),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the files")] = False,
    as_json: Json = False,
) -> None:
    """Optimise values of a robot's file for a path.

    The platform of every machine follows the same path; machines that cannot follow it are
    rejected. peak-effort is the greatest effort of any joint, rms-effort the greatest RMS effort of
    a joint, energy what the drives supply without regeneration, deflection the greatest translation
    of the reference point under the wrench, mass that of all bodies and rods without payload;
    singularity is the least singularity index on the path. The search uses exact gradients from
    several starts and ends in a local optimum.

    --sweep writes all quantities of machines within the bounds to a NetCDF file, with --scheduler
    computed by a Dask cluster. --tolerance prints
    the standard deviations of the platform's position and rotation, with the share of each part,
    on the path or, without --path, over the workspace. The actuated joints keep their positions.
    Parts are rods.NAME.length, bodies.NAME.length, joints.NAME.at[0..2], joints.NAME.axis[0..1] and
    joints.NAME.offset; with limbs. in front all copies are alike.
    """
    from pkm_twin.apps import design_report as report
    from pkm_twin.apps.tolerances import budget, parse_tolerances
    from pkm_twin.design import design as find
    from pkm_twin.design import sweep as sweep_box
    from pkm_twin.design.optimise import searches
    from pkm_twin.design.sweep import here
    from pkm_twin.design.variables import parse_vary
    from pkm_twin.maps.run import on_cluster

    for target in (out, picture):
        if target is not None:
            refuse_existing(target, overwrite, path)
    machine, _ = loaded(robot, platform, payload)
    load_on = None if wrench is None else numbers(wrench, 6, "fx,fy,fz,mx,my,mz")
    if tolerance:
        if vary or minimise or sweep or subject_to or out or picture:
            raise typer.BadParameter(
                "--tolerance can only be combined with --path, --wrench, --monte-carlo, --seed and "
                "--json"
            )
        sigma = parse_tolerances(tolerance)
        answer(*budget(machine, sigma, path, load_on, monte_carlo, seed), as_json)
        return
    if monte_carlo:
        raise typer.BadParameter("--monte-carlo needs --tolerance")
    if path is None:
        raise typer.BadParameter("give the motion with --path, see `pkm-twin path`")
    machine, way = report.read_path(path, machine, load_on, read_options((), payload))
    box = parse_vary(vary)
    if sweep is not None:
        if sweep not in SWEEPS:
            raise UnknownNameError("sweep", sweep, SWEEPS)
        if minimise or subject_to or picture:
            raise typer.BadParameter(
                "--sweep computes all quantities; leave out --minimise and --subject-to"
            )
        if out is None or out.suffix != ".nc":
            raise ParameterError("out", str(out), "a name that ends in .nc, for --sweep")
        count = samples ** len(box) if sweep == "grid" else samples
        compute = here if scheduler is None else partial(on_cluster, scheduler=scheduler)
        with progress("machines", count) as update:
            table = sweep_box(
                machine, box, way, report.known_quantities(machine, way), samples,
                "grid" if sweep == "grid" else "sobol", seed=seed, progress=update,
                compute=compute,
            )  # fmt: skip
        answer(*report.write_sweep(machine, table, sweep, path, out), as_json)
        return
    if scheduler is not None:
        raise typer.BadParameter("--scheduler needs --sweep")
    if not minimise:
        raise typer.BadParameter("give --minimise, --sweep or --tolerance")
    if out is not None and out.suffix not in (".yaml", ".yml"):
        raise ParameterError("out", str(out), "a name that ends in .yaml or .yml")
    with progress("searches", searches(len(minimise), points)) as update:
        result = find(
            machine, box, way, minimise, subject_to, starts=starts, points=points, seed=seed,
            progress=update,
        )  # fmt: skip
    if out is not None:
        report.write_robot(machine, robot, result, path, out)
    if picture is not None:
        report.draw(machine, result, way, picture)
    answer(*report.told(machine, box, result, way, out, picture), as_json)
