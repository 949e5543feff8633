# SPDX-License-Identifier: Apache-2.0
"""The commands ``pkm-twin atlas`` and ``pkm-twin show``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Optional

import typer
from rich.console import Console
from rich.table import Table

from pkm_twin.console import numbers, progress
from pkm_twin.errors import PkmTwinError, UnknownNameError
from pkm_twin.ros.signals import INTERRUPTED, first_signal
from pkm_twin.threads import one_blas_thread

WRENCH = "P1, P2, P3 or six numbers with commas between"
KINDS = ("workspace", "strain-energy", "isotropy", "modes")

# typer of Ubuntu 24.04 reads no unions.
_Number = Optional[int]  # noqa: UP045
_Real = Optional[float]  # noqa: UP045
_Text = Optional[str]  # noqa: UP045
_File = Optional[Path]  # noqa: UP045

Html = Annotated[bool, typer.Option("--html", help="also one page to turn and zoom, no network")]


def atlas(
    robot: Annotated[
        str, typer.Argument(help="a robot's name (see `pkm-twin robots`) or a YAML file")
    ],
    kind: Annotated[str, typer.Argument(help=f"what to compute: {', '.join(KINDS)}")],
    points: Annotated[
        _Number, typer.Option(help="samples, about; default: the kind's own grid")
    ] = None,
    wrench: Annotated[
        str, typer.Option(help="strain-energy: P1, P2, P3 of the paper or six numbers, N and N m")
    ] = "P1",
    height: Annotated[
        _Real, typer.Option(help="isotropy: z of the poses (m); default the home pose's")
    ] = None,
    energy: Annotated[
        float, typer.Option(help="isotropy: the platform's kinetic energy for F_max (J)")
    ] = 100.0,
    least_singularity: Annotated[
        float, typer.Option(help="workspace: distance to a singularity (0 to 1) that is too little")
    ] = 0.0,
    least_clearance: Annotated[
        float, typer.Option(help="workspace: distance between limbs (m) that is too little")
    ] = 0.0,
    out: Annotated[
        _File, typer.Option(help="file to write; default ROBOT_KIND.nc", show_default=False)
    ] = None,
    workers: Annotated[
        _Number, typer.Option(help="processes on this machine; default one a core")
    ] = None,
    scheduler: Annotated[
        _Text, typer.Option(help="address of a Dask scheduler, tcp://HOST:8786, that does the work")
    ] = None,
    picture: Annotated[bool, typer.Option(help="also PNGs beside the file")] = True,
    html: Html = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the target")] = False,
) -> None:
    """Compute a quantity over a robot's whole workspace: a NetCDF file and its pictures.

    workspace: reach, singularities, limb interference, regular part. strain-energy: where a wrench
    stores its energy (upr_rpu). isotropy: kinetic energy and driving force over directions (prru,
    delta). modes: the six lowest natural frequencies.

    Ctrl-C stops it; finished parts stay in FILE.nc.parts, and the same command goes on from there,
    with the same result. Machines and memory: docs/scale.md.
    """
    from pkm_twin import load
    from pkm_twin.atlas.run import run

    machine = load(robot)
    target = out or Path(f"{machine.name}_{kind}.nc")
    options = {
        "points": points,
        "wrench": wrench,
        "height": height,
        "energy": energy,
        "least_singularity": least_singularity,
        "least_clearance": least_clearance,
    }
    sweep = sweep_of(machine, kind, options)
    one_blas_thread()
    with (
        first_signal(KeyboardInterrupt),
        progress(f"{kind} of {machine.name}", sweep.points) as update,
    ):
        try:
            run(
                sweep,
                target,
                workers=workers,
                scheduler=scheduler,
                overwrite=overwrite,
                progress=update,
            )
        except KeyboardInterrupt:
            typer.echo(
                f"pkm-twin: stopped; finished parts are in {target}.parts, "
                "the same command goes on from there",
                err=True,
            )
            raise typer.Exit(INTERRUPTED) from None
    _present(target, picture, html)


def show(
    file: Annotated[Path, typer.Argument(help="a file that `pkm-twin atlas` wrote")],
    out: Annotated[
        _File, typer.Option(help="stem of the PNGs; default the file's", show_default=False)
    ] = None,
    html: Html = False,
) -> None:
    """Draw a stored atlas again: PNGs, and with --html a page to turn and zoom."""
    _present(file, True, html, out)


def sweep_of(machine: Any, kind: str, options: dict[str, Any]) -> Any:
    """The sweep that a command line asks for.

    :raises UnknownNameError: no such kind.
    """
    points = options["points"]
    if kind == "strain-energy":
        from pkm_twin.atlas.strain_energy import WRENCHES, strain_energy_sweep

        text = options["wrench"]
        return strain_energy_sweep(
            machine, text if text in WRENCHES else numbers(text, 6, WRENCH), points
        )
    if kind == "isotropy":
        from pkm_twin.atlas.isotropy import isotropy_sweep

        return isotropy_sweep(machine, points, height=options["height"], energy=options["energy"])
    if kind == "workspace":
        from pkm_twin.atlas.workspace import workspace_sweep

        return workspace_sweep(
            machine,
            points,
            least_singularity=options["least_singularity"],
            least_clearance=options["least_clearance"],
        )
    if kind == "modes":
        from pkm_twin.atlas.modes import modes_sweep

        return modes_sweep(machine, points)
    raise UnknownNameError("kind", kind, KINDS)


def _present(file: Path, picture: bool, html: bool, out: Path | None = None) -> None:
    from pkm_twin.atlas import kinds
    from pkm_twin.atlas.store import open_atlas

    with open_atlas(file) as data:
        typer.echo(f"{file}: {data.attrs['title']}, {dict(data.sizes)}")
        if data.attrs["kind"] == "strain-energy":
            Console().print(_factors(data))
        target = out or file
        if picture:
            for path in kinds.save_all(data, target):
                typer.echo(str(path))
        if html:
            typer.echo(str(kinds.write_page(data, target.with_suffix(".html"))))


def _factors(data: Any) -> Table:
    """Global factors beside the paper's table 2."""
    from pkm_twin.atlas.strain_energy import table_2, wrench_of

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


def main() -> None:
    """Both commands alone: ``python -m pkm_twin.atlas.commands``."""
    import sys

    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.command()(atlas)
    app.command()(show)
    try:
        app()
    except PkmTwinError as error:
        print(f"pkm-twin: {error}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
