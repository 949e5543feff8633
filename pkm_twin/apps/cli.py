# SPDX-License-Identifier: Apache-2.0
"""The command ``pkm-twin``. Exit codes: 0 good, 1 refused, 2 usage, 3 salvaged with loss."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Optional

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from pkm_twin.apps.guard_check import guard_check
from pkm_twin.atlas import commands as atlases
from pkm_twin.errors import PkmTwinError
from pkm_twin.ros.signals import INTERRUPTED, first_signal, ignore_signals

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

REFUSED, SALVAGED = 1, 3

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
    """Digital twin of parallel kinematic machines, without ROS but for `play`.

    SI units, world z up. Begin with `pkm-twin robots`, then `pkm-twin info delta_cu`, or
    judge a recording with `pkm-twin check BAG`.

    Exit codes: 0 good, 1 refused or bad, 2 usage, 3 salvaged with loss. An error is one line on
    stderr; stdout is for results, and with --json for JSON alone.
    """


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
    """Replay a bag onto ROS topics.

    What `ros2 bag play` does, for machines without it.

    The bag is checked whole before anything is published. Messages go out ordered by log time, as
    the bytes that were recorded. Stamps are old: give the nodes use_sim_time and this command
    --clock 200.
    """
    from pkm_twin.ros.player import play as play_bag

    pairs = dict(_pair(text) for text in remap)
    result = play_bag(
        bag,
        rate=rate,
        loop=loop,
        clock=clock,
        wait_for_subscribers=wait,
        topics=topic or None,
        remap=pairs,
        progress=not quiet,
    )
    if result.interrupted:
        ignore_signals()


@app.command()
def robots() -> None:
    """List the robots that can be named."""
    from pkm_twin import load, robot_names
    from pkm_twin.apps.describe import summary

    for name in robot_names():
        typer.echo(f"{name:12} {summary(load(name))}")


@app.command()
def info(robot: RobotName, as_json: Json = False) -> None:
    """Print all of a robot, with units.

    Dimensions, masses, limits, home pose, mobility, and which reactions rigid bodies do not
    determine because the mechanism is overconstrained.
    """
    from pkm_twin import load
    from pkm_twin.apps.describe import describe, lines

    data = describe(load(robot))
    if as_json:
        # JSON has no infinity: a free axis is null.
        _print_json(_finite(data))
        return
    table = Table(show_header=False)
    for what, value in lines(data):
        table.add_row(what, Text(value))
    _console().print(table)


@app.command()
def torques(
    robot: RobotName,
    motion: Annotated[
        Path, typer.Argument(help="a bag (.mcap), or a CSV with a head line", show_default=False)
    ],
    out: Annotated[
        Path, typer.Option(help="table to write, .csv or .parquet; the picture goes beside it")
    ] = Path("torques.csv"),
    picture: Annotated[bool, typer.Option(help="draw efforts and terms as a PNG")] = True,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="replace the table and the picture")
    ] = False,
) -> None:
    """Torques, terms and joint reactions of a motion.

    CSV columns: time (s); JOINT.position for every actuated joint, and, where known,
    JOINT.velocity and JOINT.acceleration (rad or m), else differentiated; and a
    wrench on the platform, fx fy fz mx my mz (N, N m, fixed axes). Joint names: `pkm-twin info`.

    The table has, by sample, each joint's effort (N m or N) and the terms that sum to it
    (JOINT.effort_gravity, _inertia, _velocity, _payload, _friction, _external), a bag's measured
    effort, and force and moment in every joint; empty where rigid bodies do not determine it.
    """
    from pkm_twin.apps.torques import check_target, motion_of_bag, motion_of_csv, table, write_table
    from pkm_twin.atlas import plots

    check_target(out)
    drawing = out.with_suffix(".png")
    for target in (out, drawing) if picture else (out,):
        _refuse_existing(target, overwrite)
    bag = motion.suffix == ".mcap"
    data = motion_of_bag(motion, robot) if bag else motion_of_csv(motion, robot)
    with _progress("torques", len(data.time)) as update:
        columns = table(data, update)
    try:
        write_table(columns, out)
        typer.echo(f"{out}: {len(data.time)} rows, {len(columns)} columns")
        if picture:
            typer.echo(f"{plots.save(plots.torques(data, columns), drawing)}")
    except OSError as error:
        raise PkmTwinError(f"cannot write {error.filename or out}: {error.strerror}") from None


# A negative number is no option.
@app.command(context_settings={"ignore_unknown_options": True})
def compliance(
    robot: RobotName,
    pose: Annotated[
        list[float],
        typer.Argument(
            help="the pose's three numbers, of upr_rpu z (m), beta, gamma (rad)",
            show_default=False,
        ),
    ],
    wrench: Annotated[
        str,
        typer.Option(
            help="load case, six numbers with commas: force (N), moment (N m), fixed axes"
        ),
    ] = "0,0,1,0,0,0",
    as_json: Json = False,
) -> None:
    """Platform compliance at a pose, and a wrench's strain energy.

    For example `pkm-twin compliance upr_rpu -0.6 0 0 --wrench 30,-50,-40,10,-20,50`.

    The elements of the strain energy are, of upr_rpu, the limb's number and R (revolute joint), B
    (bar) or U (universal joint), of the others the members and elastic joints of their frame; the
    dominant one is where stiffening pays.
    """
    from pkm_twin import load
    from stiffness_monitor import compliance as matrix
    from stiffness_monitor import strain_energy

    machine = load(robot)
    names = ", ".join(
        f"{name} ({unit})"
        for name, unit in zip(machine.pose_names, machine.pose_units, strict=True)
    )
    if len(pose) != 3 or not np.isfinite(pose).all():
        given = " ".join(f"{number:g}" for number in pose)
        raise typer.BadParameter(f"a pose of {machine.name} is {names}, not {given}")
    load_case = _numbers(wrench, 6)
    try:
        c, energy = matrix(machine, pose), strain_energy(machine, pose, load_case)
    except PkmTwinError:
        raise
    except ValueError as error:  # finite numbers, but so large that the result is not
        raise PkmTwinError(str(error)) from None
    if as_json:
        result = {
            "robot": machine.name,
            "pose": dict(zip(machine.pose_names, pose, strict=True)),
            "wrench": load_case,
            "compliance": c.tolist(),
            "deflection": energy.deflection.tolist(),
            "total_energy": float(energy.total),
            "factors": dict(zip(energy.elements, energy.factors.tolist(), strict=True)),
            "dominant": str(energy.dominant),
        }
        _print_json(result)
        return
    axes = ("x", "y", "z", "rx", "ry", "rz")
    typer.echo(f"compliance of {machine.name} at o, fixed axes: rows m and rad, per N and N m")
    typer.echo(" " * 4 + "".join(f"{name:>11}" for name in ("fx", "fy", "fz", "mx", "my", "mz")))
    size = np.sqrt(np.diag(c))
    for name, row, scale in zip(axes, c, np.outer(size, size), strict=True):
        # What is zero by symmetry is printed so, not as rounding.
        cells = ("0" if abs(v) < 1e-9 * s else f"{v:.3e}" for v, s in zip(row, scale, strict=True))
        typer.echo(f"{name:>4}" + "".join(f"{cell:>11}" for cell in cells))
    least = 1e-12 * np.abs(energy.deflection).max()
    moved = (
        f"{name} {1e6 * v if abs(v) > least else 0.0:.4g}"
        for name, v in zip(axes, energy.deflection, strict=True)
    )
    typer.echo(f"\nunder the wrench {wrench} (N, N m)")
    typer.echo(f"deflection (um, urad): {', '.join(moved)}")
    shares = sorted(zip(energy.factors, energy.elements, strict=True), key=lambda pair: -pair[0])
    typer.echo(f"strain energy {energy.total:.4g} J, dominant element {energy.dominant}")
    if energy.dominant != "none":
        typer.echo("shares: " + ", ".join(f"{name} {100 * part:.1f} %" for part, name in shares))


@app.command()
def check(
    bag: BagPath,
    robot: OptionalRobot = None,
    residual: Annotated[
        float, typer.Option(min=0.0, help="allowed RMS of the torque residual, part of the peak")
    ] = 0.05,
    as_json: Json = False,
) -> None:
    """Judge a recorded bag against the twin.

    Are the file's bytes whole, would a node take every joint state and wrench, are there gaps, are
    limits kept, is it far from singularities, and are the measured efforts what the model says? An
    item without evidence (no CRCs, no efforts, a robot without masses) is unknown, not good; it
    does not make the bag bad.

    Exit code 0: nothing is bad. 1: something is, or it is no bag. 3: the file is damaged, but part
    of it can be saved with `pkm-twin recover`.
    """
    from pkm_twin.apps.check import Bounds, check_bag
    from pkm_twin.apps.verdict import Verdict
    from pkm_twin.bags.reader import DamagedBagError

    try:
        with _progress("reading", None) as update:
            report = check_bag(bag, robot, Bounds(residual=residual), update)
    except PkmTwinError as error:
        salvageable = error.salvageable if isinstance(error, DamagedBagError) else 0
        if as_json:
            facts = {"bag": str(bag), "good": False, "error": str(error)}
            _print_json({**facts, "salvageable": salvageable})
        print(f"pkm-twin: {error}", file=sys.stderr)
        raise typer.Exit(SALVAGED if salvageable else REFUSED) from None
    if as_json:
        _print_json(report.as_json())
    else:
        table = Table(title=Text(f"{report.bag}: {report.robot}"))
        for column in ("what", "value", "has to be", "verdict"):
            table.add_column(column)
        colours = {Verdict.GOOD: "green", Verdict.BAD: "red", Verdict.UNKNOWN: "yellow"}
        for item in report.items:
            verdict = Text(item.verdict, style=colours[item.verdict])
            table.add_row(item.what, Text(item.value), Text(item.bound), verdict)
        _console().print(table)
        bad, unknown = report.named(Verdict.BAD), report.named(Verdict.UNKNOWN)
        text = f"bad: {', '.join(bad)}" if bad else "good"
        typer.echo(text + (f"; not judged: {', '.join(unknown)}" if unknown else ""))
    if not report.good:
        raise typer.Exit(REFUSED)


@app.command()
def recover(
    bag: BagPath,
    out: Annotated[Path, typer.Argument(help="the new bag")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the target")] = False,
    as_json: Json = False,
) -> None:
    """Save what is whole of a damaged bag.

    Every whole message of a damaged or cut bag goes into a new one. The old one stays as it is.

    Exit code 0: nothing was lost. 3: saved with loss. 1: nothing could be saved.
    """
    from dataclasses import asdict

    from pkm_twin.bags.reader import recover as recover_bag

    result = recover_bag(bag, out, overwrite=overwrite)
    if as_json:
        _print_json({**asdict(result), "lossless": result.lossless})
    else:
        lost = (
            "nothing lost"
            if result.lossless
            else f"{result.bytes_lost} bytes lost: {result.reason}"
        )
        typer.echo(f"{out}: {result.messages} messages saved, {lost}")
    if not result.lossless:
        raise typer.Exit(SALVAGED)


app.command()(guard_check)
app.command()(atlases.atlas)
app.command()(atlases.show)


@contextmanager
def _progress(what: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """A progress bar on stderr that a count moves."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as drawing:
        task = drawing.add_task(what, total=total)

        def update(count: int) -> None:
            # The bar redraws ten times a second anyway.
            if count % 256 == 0 or count == total:
                drawing.update(task, completed=count)

        yield update


def _console() -> Console:
    """Stdout; where it is no terminal, as wide as a table here needs."""
    console = Console()
    return console if console.is_terminal else Console(width=140)


def _print_json(data: Any) -> None:
    """JSON proper: a number that is not finite is a mistake here."""
    typer.echo(json.dumps(data, indent=2, allow_nan=False))


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


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point: typed errors are one line on stderr and exit code 1, Ctrl-C is code 130."""
    try:
        with first_signal(lambda: SystemExit(INTERRUPTED)):
            app(arguments, prog_name="pkm-twin")
    except PkmTwinError as error:
        print(f"pkm-twin: {error}", file=sys.stderr)
        sys.exit(REFUSED)


if __name__ == "__main__":
    main()
