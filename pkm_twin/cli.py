# SPDX-License-Identifier: Apache-2.0
"""The command ``pkm-twin``. Exit codes: 0 good, 1 refused, 2 usage, 3 salvaged with loss."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Optional

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from pkm_twin.errors import PkmTwinError

app = typer.Typer(
    help=__doc__,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

REFUSED, USAGE, SALVAGED = 1, 2, 3

RobotName = Annotated[
    str, typer.Argument(help="a robot's name (see `pkm-twin robots`) or a YAML file")
]
Json = Annotated[bool, typer.Option("--json", help="machine-readable output")]
OptionalRobot = Annotated[
    Optional[str],  # noqa: UP045  typer of Ubuntu 24.04 reads no unions
    typer.Option("--robot", help="name or YAML file; default: the one that the bag names"),
]
BagPath = Annotated[Path, typer.Argument(help="a bag: one MCAP file", show_default=False)]


@app.callback()
def _application() -> None:
    """Digital twin of parallel kinematic machines."""


@app.command()
def play(
    bag: BagPath,
    rate: Annotated[float, typer.Option(help="speed, 1 is the recorded one")] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="begin again at the end")] = False,
    clock: Annotated[
        Optional[float],  # noqa: UP045  typer of Ubuntu 24.04 reads no unions
        typer.Option(help="publish /clock at this many Hz, for nodes with use_sim_time"),
    ] = None,
    wait: Annotated[
        float, typer.Option(help="longest wait (s) for a subscriber on every topic")
    ] = 3.0,
    topic: Annotated[list[str], typer.Option(help="play only these topics")] = [],  # noqa: B006
    remap: Annotated[
        list[str], typer.Option(help="FROM:=TO, play a topic under another name")
    ] = [],  # noqa: B006  typer copies it
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bar")] = False,
) -> None:
    """Replay a bag onto ROS topics, as `ros2 bag play` does.

    The bag is checked whole before anything is published. Messages go out ordered by log time, as
    the bytes that were recorded. Stamps are old: give the nodes use_sim_time and this command
    --clock 200.
    """
    from pkm_twin.player import play as play_bag

    pairs = dict(_pair(text) for text in remap)
    play_bag(
        bag,
        rate=rate,
        loop=loop,
        clock=clock,
        wait_for_subscribers=wait,
        topics=topic or None,
        remap=pairs,
        progress=not quiet,
    )


@app.command()
def robots() -> None:
    """List the robots that can be named."""
    from pkm_twin import load, robot_names

    for name in robot_names():
        typer.echo(f"{name:12} {load(name).description}")


@app.command()
def info(robot: RobotName, as_json: Json = False) -> None:
    """Print a robot: dimensions, masses, mobility, what is overconstrained, limits, home pose."""
    from pkm_twin import load
    from pkm_twin.describe import describe, lines

    data = describe(load(robot))
    if as_json:
        # JSON has no infinity: a free axis is null.
        typer.echo(json.dumps(_finite(data), indent=2))
        return
    table = Table(show_header=False, title=f"robot {data['name']}")
    for what, value in lines(data):
        table.add_row(what, value)
    Console().print(table)


@app.command()
def torques(
    robot: RobotName,
    motion: Annotated[
        Path, typer.Argument(help="a bag (.mcap), or a CSV: time, NAME.position ...")
    ],
    out: Annotated[Path, typer.Option(help="table to write, .csv or .parquet")] = Path(
        "torques.csv"
    ),
    picture: Annotated[bool, typer.Option(help="also a PNG beside the table")] = True,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the target")] = False,
) -> None:
    """Torques, their terms and all joint reactions of a motion, as a table and a picture."""
    from pkm_twin import plots
    from pkm_twin.torques import motion_of_bag, motion_of_csv, table, write_table

    _refuse_existing(out, overwrite)
    bag = motion.suffix == ".mcap"
    data = motion_of_bag(motion, robot) if bag else motion_of_csv(motion, robot)
    with _progress("torques", len(data.time)) as update:
        columns = table(data, update)
    write_table(columns, out)
    typer.echo(f"{out}: {len(data.time)} rows, {len(columns)} columns")
    if picture:
        typer.echo(f"{plots.save(plots.torques(data, columns), out.with_suffix('.png'))}")


@app.command()
def compliance(
    robot: RobotName,
    pose: Annotated[list[float], typer.Argument(help="the pose's three numbers")],
    wrench: Annotated[
        str, typer.Option(help="six numbers, comma-separated: force (N) and moment (N m) at o")
    ] = "0,0,1,0,0,0",
    as_json: Json = False,
) -> None:
    """Platform compliance at a pose, and where a wrench stores its strain energy.

    A negative first number needs two dashes before it: `pkm-twin compliance upr_rpu -- -0.6 0 0`.
    """
    from pkm_twin import load
    from stiffness_monitor import compliance as matrix
    from stiffness_monitor import strain_energy

    machine = load(robot)
    if len(pose) != 3:
        raise typer.BadParameter(
            f"a pose is {', '.join(machine.pose_names)}, not {len(pose)} numbers"
        )
    load_case = _numbers(wrench, 6)
    c, energy = matrix(machine, pose), strain_energy(machine, pose, load_case)
    if as_json:
        result = {
            "compliance": c.tolist(),
            "deflection": energy.deflection.tolist(),
            "total_energy": float(energy.total),
            "factors": dict(zip(energy.elements, energy.factors.tolist(), strict=True)),
            "dominant": str(energy.dominant),
        }
        typer.echo(json.dumps(result, indent=2))
        return
    console = Console()
    console.print(f"compliance of {machine.name} at o, fixed axes; m and rad per N and N m")
    console.print(" " * 4 + "".join(f"{name:>11}" for name in ("fx", "fy", "fz", "mx", "my", "mz")))
    size = np.sqrt(np.diag(c))
    for name, row in zip(("x", "y", "z", "rx", "ry", "rz"), c / np.outer(size, size), strict=True):
        k = ("x", "y", "z", "rx", "ry", "rz").index(name)
        # What is zero by symmetry is printed so, not as rounding.
        cells = (
            "0" if abs(v) < 1e-9 else f"{v * size[k] * s:.3e}"
            for v, s in zip(row, size, strict=True)
        )
        console.print(f"{name:>4}" + "".join(f"{cell:>11}" for cell in cells))
    shares = ", ".join(
        f"{e} {100 * f:.1f} %" for e, f in zip(energy.elements, energy.factors, strict=True)
    )
    console.print(f"strain energy {energy.total:.4g} J, dominant {energy.dominant}: {shares}")


@app.command()
def check(
    bag: BagPath,
    robot: OptionalRobot = None,
    residual: Annotated[float, typer.Option(help="allowed residual RMS, part of peak")] = 0.05,
    as_json: Json = False,
) -> None:
    """Judge a recorded bag against the twin: file, stamps, gaps, limits, torque residual.

    Exit code 0: good. 1: bad, or not a bag. 3: the file is damaged, but part of it can be
    saved with `pkm-twin recover`.
    """
    from pkm_twin.bags import DamagedBagError
    from pkm_twin.check import Bounds, Verdict, check_bag

    try:
        with _progress("reading", None) as update:
            report = check_bag(bag, robot, Bounds(residual=residual), update)
    except DamagedBagError as error:
        if as_json:
            typer.echo(json.dumps({"bag": str(bag), "good": False, "damaged": str(error)}))
        print(f"pkm-twin: {error}", file=sys.stderr)
        raise typer.Exit(SALVAGED if error.salvageable else REFUSED) from None
    if as_json:
        typer.echo(json.dumps(report.as_json(), indent=2))
    else:
        table = Table(title=f"{report.bag}: {report.robot}")
        for column in ("what", "value", "has to be", "verdict"):
            table.add_column(column)
        colours = {Verdict.GOOD: "green", Verdict.BAD: "red", Verdict.UNKNOWN: "yellow"}
        for item in report.items:
            colour = colours[item.verdict]
            table.add_row(item.what, item.value, item.bound, f"[{colour}]{item.verdict}[/{colour}]")
        Console().print(table)
        typer.echo("good" if report.good else "bad")
    if not report.good:
        raise typer.Exit(REFUSED)


@app.command()
def recover(
    bag: BagPath,
    out: Annotated[Path, typer.Argument(help="the new bag")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the target")] = False,
    as_json: Json = False,
) -> None:
    """Save every whole message of a damaged or cut bag into a new one.

    Exit code 0: nothing was lost. 3: saved with loss. 1: nothing could be saved.
    """
    from dataclasses import asdict

    from pkm_twin.bags import recover as recover_bag

    result = recover_bag(bag, out, overwrite=overwrite)
    if as_json:
        typer.echo(json.dumps({**asdict(result), "lossless": result.lossless}))
    else:
        lost = (
            "nothing lost"
            if result.lossless
            else f"{result.bytes_lost} bytes lost: {result.reason}"
        )
        typer.echo(f"{out}: {result.messages} messages saved, {lost}")
    if not result.lossless:
        raise typer.Exit(SALVAGED)


@contextmanager
def _progress(what: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """A progress bar on stderr that a count moves."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as drawing:
        task = drawing.add_task(what, total=total)

        def update(count: int) -> None:
            # The bar redraws ten times a second anyway.
            if count % 256 == 0 or count == total:
                drawing.update(task, completed=count)

        yield update


def _refuse_existing(path: Path, overwrite: bool) -> None:
    if path.exists() and not overwrite:
        raise PkmTwinError(f"{path} exists; give --overwrite to replace it")


def _numbers(text: str, count: int) -> list[float]:
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise typer.BadParameter(f"{text!r} is not {count} numbers with commas between")
    return values


def _finite(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_finite(value) for value in data]
    return None if isinstance(data, float) and not np.isfinite(data) else data


def _pair(text: str) -> tuple[str, str]:
    source, sign, target = text.partition(":=")
    if not sign or not source or not target:
        raise typer.BadParameter(f"{text!r} is not of the form FROM:=TO")
    return source, target


def main() -> None:
    """Entry point: typed errors are one line on stderr and exit code 1."""
    try:
        app()
    except PkmTwinError as error:
        print(f"pkm-twin: {error}", file=sys.stderr)
        sys.exit(REFUSED)


if __name__ == "__main__":
    main()
