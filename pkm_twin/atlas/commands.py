# SPDX-License-Identifier: Apache-2.0
"""The commands ``pkm-twin atlas ROBOT KIND``, each kind with options of its own, and ``show``."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Protocol

import typer
from rich.console import Console
from rich.table import Table
from typer.core import TyperGroup

from pkm_twin.console import print_json, progress
from pkm_twin.errors import UnknownNameError
from pkm_twin.options import (
    Commands,
    OptionalFloat,
    OptionalInt,
    OptionalPath,
    OptionalText,
    file_name,
    options_of,
    take_options,
)
from pkm_twin.ros.signals import INTERRUPTED, first_signal
from pkm_twin.threads import one_blas_thread

if TYPE_CHECKING:
    from xarray import Dataset

    from pkm_twin.atlas.sweep import Sweep
    from pkm_twin.robot.robot import Robot

MOST: Final = 10**11
"""Samples beyond which a number is a slip."""

Html = Annotated[bool, typer.Option("--html", help="also an offline interactive HTML page")]
Json = Annotated[bool, typer.Option("--json", help="machine-readable output")]


class _Kinds(TyperGroup):
    """The kinds as commands after the robot; an unknown one is a name like any other."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args[0] in ctx.help_option_names:
            # After the robot, options are those of a kind.
            typer.echo(ctx.get_help())
            ctx.exit()
        if args[0] not in self.commands:
            raise UnknownNameError("map", args[0], tuple(self.commands))
        return super().resolve_command(ctx, args)


app = Commands(
    cls=_Kinds,
    no_args_is_help=True,
    subcommand_metavar="KIND [OPTIONS]",
)


@app.callback()
def atlas(
    context: typer.Context,
    robot: Annotated[
        str, typer.Argument(help="a robot's name (see `pkm-twin robots`) or a YAML file")
    ],
) -> None:
    """Compute a workspace map: a NetCDF file and its pictures.

    Ctrl-C stops it. Finished parts stay in FILE.nc.parts, and the same command continues from there
    with the same result. Only one run at a time can write a file. docs/scale.md has the cost.

    For the options of a kind use `pkm-twin atlas ROBOT KIND --help`.
    """
    context.obj = robot


def show(
    file: Annotated[Path, typer.Argument(help="a file that `pkm-twin atlas` wrote")],
    out: Annotated[
        OptionalPath,
        typer.Option(help="stem of the PNGs; default: that of the file", callback=file_name),
    ] = None,
    html: Html = False,
    as_json: Json = False,
) -> None:
    """Plot a stored map: PNGs, and with --html an offline interactive HTML page."""
    _present(file, True, html, as_json, out)


class Alone(Protocol):
    """What a kind does in place of a sweep."""

    def present(self, out: Path | None, picture: bool, overwrite: bool, as_json: bool) -> None:
        """Compute, write and print it."""


def kind(sweep: Callable[..., Sweep | Alone]) -> Callable[..., Sweep | Alone]:
    """Make a function of a robot, a number of points and a kind's own options a command.

    Its name is the kind; the options of :func:`_compute` come with all kinds.
    """
    name = sweep.__name__.replace("_", "-")

    def command(**options: Any) -> None:
        shared = {key: options.pop(key) for key in common}
        _compute(name, functools.partial(sweep, **options), **shared)

    # What only the checker imports is no option's type.
    common = options_of(_compute, "kind", "sweep", Sweep=Any, Robot=Any)
    own = options_of(sweep, "machine", "points", Sweep=Any, Alone=Alone, Robot=Any)
    first, *rest = common.values()
    take_options(command, [first, *own.values(), *rest])
    command.__doc__ = sweep.__doc__
    app.command(name)(command)
    return sweep


def _compute(
    kind: str,
    sweep: Callable[[Robot, int | None], Sweep | Alone],
    *,
    context: typer.Context,
    points: Annotated[
        OptionalInt, typer.Option(max=MOST, help="approximate number of samples; default: by kind")
    ] = None,
    out: Annotated[
        OptionalPath, typer.Option(help="file to write; default: ROBOT_KIND.nc", callback=file_name)
    ] = None,
    workers: Annotated[
        OptionalInt, typer.Option(help="processes on this computer; default: one per core")
    ] = None,
    scheduler: Annotated[
        OptionalText, typer.Option(help="address of a Dask scheduler: tcp://HOST:8786")
    ] = None,
    picture: Annotated[bool, typer.Option(help="also PNGs next to the file")] = True,
    html: Html = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the target")] = False,
    as_json: Json = False,
) -> None:
    """Compute one kind of atlas of the context's robot, and draw it."""
    from pkm_twin import load
    from pkm_twin.atlas.run import run
    from pkm_twin.atlas.sweep import Sweep

    machine = load(context.obj)
    target = out or Path(f"{machine.name}_{kind}.nc")
    work = sweep(machine, points)
    one_blas_thread()
    if not isinstance(work, Sweep):
        work.present(out, picture, overwrite, as_json)
        return
    with (
        first_signal(KeyboardInterrupt),
        progress(f"{kind} of {machine.name}", work.points) as update,
    ):
        try:
            run(
                work,
                target,
                workers=workers,
                scheduler=scheduler,
                overwrite=overwrite,
                progress=update,
            )
        except KeyboardInterrupt:
            typer.echo(
                f"pkm-twin: stopped; finished parts are in {target}.parts, "
                "the same command continues from there",
                err=True,
            )
            raise typer.Exit(INTERRUPTED) from None
    _present(target, picture, html, as_json)


@kind
def workspace(
    machine: Robot,
    points: int | None,
    least_singularity: Annotated[
        float, typer.Option(help="singularity index (0 to 1) below which a pose does not count")
    ] = 0.0,
    least_clearance: Annotated[
        float, typer.Option(help="distance between limbs (m) below which a pose does not count")
    ] = 0.0,
) -> Sweep:
    """Reach, singularities, limb interference, largest inscribed cylinder."""
    from pkm_twin.atlas.workspace.sweep import workspace_sweep

    return workspace_sweep(
        machine, points, least_singularity=least_singularity, least_clearance=least_clearance
    )


@kind
def isotropy(
    machine: Robot,
    points: int | None,
    height: Annotated[
        OptionalFloat, typer.Option(help="z of the poses (m); default: that of the home pose")
    ] = None,
    energy: Annotated[
        float, typer.Option(help="the platform's kinetic energy for F_max (J)")
    ] = 100.0,
    beyond_limits: Annotated[
        bool, typer.Option("--beyond-limits", help="also poses beyond the limits, marked as such")
    ] = False,
) -> Sweep:
    """Kinetic energy and driving force by direction, for three pose coordinates."""
    from pkm_twin.atlas.isotropy.sweep import isotropy_sweep

    return isotropy_sweep(
        machine, points, height=height, energy=energy, beyond_limits=beyond_limits
    )


@kind
def modes(machine: Robot, points: int | None) -> Sweep:
    """The six lowest natural frequencies and their mode shapes."""
    from pkm_twin.atlas.modes.sweep import modes_sweep

    return modes_sweep(machine, points)


def _present(file: Path, picture: bool, html: bool, as_json: bool, out: Path | None = None) -> None:
    from pkm_twin.atlas import kinds
    from pkm_twin.atlas.maps.figures import answers, sentence
    from pkm_twin.atlas.store import open_atlas, reading

    with open_atlas(file) as data:
        with reading(file):
            about = f"{file}: {data.attrs['title']}; {_extent(data)}"
            worst = answers(data) if "worst_value" in data else []
            table = _factors(data) if "global_factor" in data else None
        target = out or file
        drawn = kinds.save_all(data, target) if picture else []
        if html:
            drawn.append(kinds.write_page(data, target.with_suffix(".html")))
        if as_json:
            told = {"robot": data.attrs["robot"], "kind": data.attrs["kind"], "file": str(file)}
            sizes = {str(name): size for name, size in data.sizes.items()}
            files = [str(path) for path in drawn]
            print_json(told | {"sizes": sizes, "worst": worst, "pictures": files})
            return
        typer.echo(about)
        if table is not None:
            Console().print(table)
        for line in [*(f"worst pose, {sentence(one)}" for one in worst), *map(str, drawn)]:
            typer.echo(line)


def _extent(data: Dataset) -> str:
    """How many samples a map has of what it is over, in words."""
    if data.sizes.keys() >= {"slice", "row", "column"}:
        return f"{data.sizes['slice']} planes of {data.sizes['row']} x {data.sizes['column']} poses"
    # Cases, nodes and the like are no samples; heights are those of the inscribed circles.
    over = [n for n in data.sizes if n != "height" and "units" in data.get(n, data).attrs]
    counts = " x ".join(str(data.sizes[n]) for n in over)
    return f"{counts} samples over {', '.join(map(str, over))}"


def _factors(data: Dataset) -> Table:
    """Global factors compared with the paper's table 2."""
    from pkm_twin.atlas.strain_energy.stored import wrench_of
    from pkm_twin.atlas.strain_energy.sweep import table_2

    printed = table_2(wrench_of(data))
    table = Table(title="global strain-energy factors")
    names = ["element", "points", "volume"]
    for name in names if printed is None else [*names, "paper, table 2", "difference"]:
        table.add_column(name, justify="right")
    columns = (data.element.values, data.global_factor.values, data.volume_factor.values)
    for k, (element, mean, volume) in enumerate(zip(*columns, strict=True)):
        row = [str(element), f"{mean:.3g}", f"{volume:.3g}"]
        if printed is not None:
            row += [f"{printed[k]:.3g}", f"{mean - printed[k]:+.1e}"]
        table.add_row(*row)
    return table
