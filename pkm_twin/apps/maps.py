# SPDX-License-Identifier: Apache-2.0
"""The commands ``pkm-twin map ROBOT KIND``, over the workspace or along a path."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from inspect import Parameter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, get_type_hints

import numpy as np
import typer
from numpy.typing import NDArray
from typer.core import TyperGroup

from pkm_twin.apps.options import Json, Platform
from pkm_twin.apps.vibration import (
    Damping,
    Feed,
    Immersion,
    Radial,
    Tangential,
    Teeth,
    Tool,
    Up,
    process_of,
)
from pkm_twin.console import numbers, print_json, progress, refuse_existing
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.maps.kinds import KINDS
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

    from pkm_twin.maps.kind import Case, Found, Kind
    from pkm_twin.robot.robot import Robot

Array = NDArray[np.float64]

MOST: Final = 10**11
"""Poses beyond which a number is a slip."""
_SIX: Final = "six numbers separated by commas, N and N m; or NAME=six numbers"

Html = Annotated[bool, typer.Option("--html", help="also an offline interactive HTML page")]


class _Kinds(TyperGroup):
    """The kinds as commands after the robot; and ``show``, which stands in its place."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, ["show", *args] if args[:1] == ["show"] else args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args[0] in ctx.help_option_names:
            # After the robot, options are those of a kind.
            typer.echo(ctx.get_help())
            ctx.exit()
        if args[0] not in self.commands or (args[0] == "show") != (ctx.params["robot"] == "show"):
            raise UnknownNameError("map", args[0], tuple(KINDS))
        return super().resolve_command(ctx, args)


app = Commands(
    cls=_Kinds,
    no_args_is_help=True,
    subcommand_metavar="KIND [OPTIONS]",
)


@app.callback()
def maps(
    context: typer.Context,
    robot: Annotated[
        str, typer.Argument(help="a robot's name (see `pkm-twin robots`) or file; or `show`")
    ],
) -> None:
    """Map a quantity over the workspace, find its worst pose, and draw planes through it.

    `pkm-twin map show FILE` plots a stored map again.

    Ctrl-C stops it. Finished parts stay in FILE.nc.parts, and the same command continues from there
    with the same result. Only one run at a time can write a file. docs/benchmarks.md has the cost.

    For the options of a kind use `pkm-twin map ROBOT KIND --help`.
    """
    context.obj = robot


@app.command()
def show(
    file: Annotated[Path, typer.Argument(help="a file that `pkm-twin map` wrote")],
    out: Annotated[
        OptionalPath,
        typer.Option(help="stem of the PNGs; default: that of the file", callback=file_name),
    ] = None,
    html: Html = False,
    as_json: Json = False,
) -> None:
    """Plot a stored map: PNGs, and with --html an offline interactive HTML page."""
    _present(file, True, html, as_json, out)


def _loads(
    wrench: Annotated[
        list[str],
        typer.Option(
            help=f"force and moment on the platform, base axes: {_SIX}; several times for several "
            "load cases"
        ),
    ] = [],  # noqa: B006  typer copies it
) -> None:
    """The option of maps with load cases."""


def _milling(
    teeth: Teeth,
    tangential: Tangential,
    radial: Radial,
    immersion: Immersion = 1.0,
    up: Up = False,
    feed: Feed = 0.0,
    tool: Tool = "0,0,0",
    damping: Damping = None,
) -> None:
    """The options of a milling process."""


@dataclass(frozen=True)
class _Options:
    """The options of all maps."""

    context: typer.Context
    points: Annotated[
        OptionalInt, typer.Option(max=MOST, help="approximate number of poses; default: by kind")
    ] = None
    payload: Annotated[
        OptionalText,
        typer.Option(help="MASS[,x,y,z] on the platform instead of the file's payload, kg and m"),
    ] = None
    at: Annotated[
        OptionalText,
        typer.Option(help="pose that the planes go through: numbers separated by commas; default: "
                     "the worst"),
    ] = None  # fmt: skip
    along: Annotated[
        OptionalPath,
        typer.Option(
            help="instead of the workspace: a CSV of `pkm-twin path`, or any motion that `pkm-twin "
            "torques` reads; --out FILE.csv writes the values"
        ),
    ] = None
    singularity: Annotated[
        OptionalFloat,
        typer.Option(help="singularity index (0 to 1) below which a pose does not count; default: "
                     "0.05, of `workspace` 0"),
    ] = None  # fmt: skip
    least_clearance: Annotated[
        float, typer.Option(help="distance between limbs (m) below which a pose does not count")
    ] = 0.0
    platform: Platform = None
    out: Annotated[
        OptionalPath,
        typer.Option(help="file to write; default: ROBOT_KIND.nc", callback=file_name),
    ] = None
    jobs: Annotated[
        OptionalInt, typer.Option(help="processes on this computer; default: one per core")
    ] = None
    scheduler: Annotated[
        OptionalText, typer.Option(help="address of a Dask scheduler: tcp://HOST:8786")
    ] = None
    picture: Annotated[bool, typer.Option(help="also PNGs next to the file")] = True
    html: Html = False
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the target")] = False
    as_json: Json = False


def _offer(kind: type[Kind]) -> None:
    """Make a kind a command, with its own options and those of all maps."""
    make: Callable[..., Kind] = kind
    hints = get_type_hints(kind, include_extras=True)
    own = [
        Parameter(
            field.name, Parameter.KEYWORD_ONLY, default=field.default,
            annotation=Annotated[hints[field.name].__origin__,
                                 typer.Option(help=hints[field.name].__metadata__[0])],
        )
        for field in dataclasses.fields(kind)
    ] if kind.name != "cutting-depth" else list(options_of(_milling).values())  # fmt: skip
    if kind.name == "cutting-depth":
        make = process_of
    load = list(options_of(_loads).values()) if kind.takes_wrench else []

    def command(**given: Any) -> None:
        made = make(**{option.name: given.pop(option.name) for option in own})
        _compute(made, given.pop("wrench", []), _Options(**given))

    context, *rest = options_of(_Options).values()
    take_options(command, [context, *own, *load, *rest])
    command.__doc__ = kind.__doc__
    app.command(kind.name)(command)


def _compute(kind: Kind, wrenches: Sequence[str], options: _Options) -> None:
    """Compute a kind of map of the context's robot, and draw it."""
    from pkm_twin import load
    from pkm_twin.apps.options import load_of
    from pkm_twin.maps.run import run
    from pkm_twin.maps.sweep import map_of

    machine = load(options.context.obj, platform=options.platform)
    carried = load_of(options.payload, None)
    machine = machine if carried is None else carried.on(machine)
    cases = _cases(kind, machine, wrenches)
    one_blas_thread()
    if options.along is not None:
        _along(kind, machine, cases, options.along, options)
        return
    names = machine.pose_names
    at = None if options.at is None else numbers(options.at, len(names), f"a pose: {names}")
    sweep = map_of(
        machine, kind, options.points, cases=cases, at=at,
        least_singularity=options.singularity, least_clearance=options.least_clearance,
    )  # fmt: skip
    target = options.out or Path(f"{machine.name}_{kind.name}.nc")
    with (
        first_signal(KeyboardInterrupt),
        progress(f"{kind.name} of {machine.name}", sweep.points) as update,
    ):
        try:
            run(
                sweep, target, workers=options.jobs, scheduler=options.scheduler,
                overwrite=options.overwrite, progress=update,
            )  # fmt: skip
        except KeyboardInterrupt:
            typer.echo(
                f"pkm-twin: stopped; finished parts are in {target}.parts, "
                "the same command continues from there",
                err=True,
            )
            raise typer.Exit(INTERRUPTED) from None
    _present(target, options.picture, options.html, options.as_json)


def _cases(kind: Kind, machine: Robot, texts: Sequence[str]) -> list[Case]:
    """Load cases of a command line.

    :raises ParameterError: two of one name, or a wrench that is none.
    """
    found: dict[str, Case] = {}
    for text in texts:
        name, given, values = text.rpartition("=")
        name = name.strip() if given else text
        if name in found:
            raise ParameterError("wrench", text, "another name for each load case")
        found[name] = kind.loaded(machine, name, numbers(values, 6, _SIX))
    return list(found.values())


def _present(file: Path, picture: bool, html: bool, as_json: bool, out: Path | None = None) -> None:
    """Print what a stored map answers, and draw it."""
    from pkm_twin.maps import figures
    from pkm_twin.maps.page import write_page
    from pkm_twin.maps.store import open_map, reading

    with open_map(file) as data:
        with reading(file):
            lines, worst = figures.lines(data), figures.answers(data)
        target = out or file
        drawn = figures.save_all(data, target) if picture else []
        if html:
            drawn.append(write_page(data, target.with_suffix(".html")))
        if as_json:
            print_json(
                {
                    "robot": data.attrs["robot"], "kind": data.attrs["kind"], "file": str(file),
                    "sizes": {str(name): size for name, size in data.sizes.items()},
                    "worst": worst, "facts": _scalars(data),
                    "pictures": [str(path) for path in drawn],
                }
            )  # fmt: skip
            return
        for line in [*lines, str(file), *map(str, drawn)]:
            typer.echo(line)


def _scalars(data: Dataset) -> dict[str, Any]:
    """Single numbers of a map, with their units."""
    return {
        str(name): {"value": float(variable), "unit": variable.attrs.get("units", "")}
        for name, variable in data.data_vars.items()
        if not variable.dims and math.isfinite(float(variable))
    }


def _along(
    kind: Kind, machine: Robot, cases: Sequence[Case], path: Path, options: _Options
) -> None:
    """Print the worst of each case along a path; write table and picture where asked."""
    from pkm_twin.apps.options import read_options
    from pkm_twin.maps import figures
    from pkm_twin.maps.kind import counts, found_of
    from pkm_twin.maps.sweep import check
    from pkm_twin.recordings import read

    out = options.out
    drawing = out.with_suffix(".png") if out is not None and options.picture else None
    if out is not None and out.suffix != ".csv":
        raise ParameterError("out", str(out), "a name that ends in .csv")
    for target in (out, drawing):
        if target is not None:
            refuse_existing(target, options.overwrite, path)
    cases = tuple(cases) or kind.cases(machine)
    check(machine, kind, cases)
    motion = read(path, machine, read_options(planned=True))
    pose, elements = machine.forward(motion.q), kind.elements(machine)
    least = kind.least if options.singularity is None else options.singularity
    known = np.ones(len(pose), bool)
    inside = counts(machine, motion.q, pose, known, least, options.least_clearance)
    found = found_of(kind, machine, motion.q, cases)
    worst, axes = [], kind.axes(machine)
    for case, one in zip(cases, found, strict=True):
        k = int(np.nanargmax(one.value if case.largest else -one.value))
        answer: dict[str, Any] = {
            "case": case.name, "what": case.what, "answer": case.answer,
            "value": float(one.value[k]), "unit": case.unit, "time_s": float(motion.clock[k]),
            "pose": dict(zip(machine.pose_names, pose[k].tolist(), strict=True)),
        }  # fmt: skip
        if one.direction is not None and axes:
            answer |= {"direction": one.direction[k].tolist(), "axes": list(axes)}
        if one.element is not None and elements:
            answer["element"] = elements[int(one.element[k])]
        worst.append(answer)
    files = [str(target) for target in (out, drawing) if target is not None]
    if out is not None:
        _write(out, machine, motion.clock, pose, inside, cases, found, elements)
    units = dict(zip(machine.pose_names, machine.pose_units, strict=True))
    texts = [
        ("" if len(cases) == 1 else f"{one['case']}: ")
        + f"{figures.sentence(one, units)}; at {one['time_s']:.4g} s"
        for one in worst
    ]
    if drawing is not None:
        head = f"{machine.name}: {kind.question}"
        _draw(drawing, head, kind.element, texts, motion.clock, cases, found, elements)
    beyond = int((~inside).sum())
    if options.as_json:
        print_json(
            {
                "robot": machine.name, "kind": kind.name, "samples": len(pose),
                "samples_that_do_not_count": beyond, "worst": worst, "files": files,
            }
        )  # fmt: skip
        return
    for text in texts:
        typer.echo(text)
    typer.echo(f"{len(pose)} samples of {path}")
    if beyond:
        typer.echo(f"{beyond} samples are beyond limits, near a singularity, or limbs interfere")
    for name in files:
        typer.echo(name)


def _write(
    out: Path, machine: Robot, time: Array, pose: Array, inside: NDArray[np.bool_],
    cases: Sequence[Case], found: Sequence[Found], elements: Sequence[str],
) -> None:  # fmt: skip
    """The table of a path: each case's value, direction and element."""
    import csv
    import io

    from pkm_twin.files import replace_file

    header = ["time", *machine.pose_names, "counts"]
    columns: list[list[Any]] = [time.tolist(), *pose.T.tolist(), inside.astype(int).tolist()]
    for case, one in zip(cases, found, strict=True):
        before = "" if len(cases) == 1 else f"{case.name}."
        header.append(f"{before}value")
        columns.append(one.value.tolist())
        if one.direction is not None and one.direction.shape[-1] == 3:
            header += [f"{before}{axis}" for axis in "xyz"]
            columns += one.direction.T.tolist()
        if one.element is not None and elements:
            header.append(f"{before}element")
            columns.append([elements[k] for k in one.element])
    text = io.StringIO()
    csv.writer(text).writerows([header, *zip(*columns, strict=True)])
    replace_file(out, text.getvalue().encode())


def _draw(
    path: Path, head: str, element_is: str, texts: Sequence[str], time: Array,
    cases: Sequence[Case], found: Sequence[Found], elements: Sequence[str],
) -> None:  # fmt: skip
    """The values of each case over time, in the colours of the elements to blame."""
    from pkm_twin.maps import figures
    from pkm_twin.report import plots

    count = len(found)
    indices = [one.element for one in found if one.element is not None and elements]
    # An element has one colour in all panels.
    blamed = np.unique(np.concatenate(indices)).tolist() if indices else []
    figure, axes = figures.subplots(
        count, 1, figsize=(9, 3.2 * count), layout="constrained", squeeze=False
    )
    for ax, case, one, text in zip(axes[:, 0], cases, found, texts, strict=True):
        scale, unit = figures.scale_of(float(np.nanmax(np.abs(one.value))), case.unit)
        values = scale * one.value
        ax.plot(time, values, color="0.7", lw=1)
        for n, element in enumerate(blamed):
            own = one.element == element
            colour = plots.COLOURS[n % len(plots.COLOURS)]
            if np.any(own):
                dots = ax.plot(time[own], values[own], ".", ms=4, color=colour)
                dots[0].set_label(elements[element])
        plots.label(ax, "time (s)", f"{case.what} ({unit})", text, 9)
        if blamed:
            ax.legend(title=element_is, loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=9)
    figure.suptitle(head, fontsize=10)
    plots.save(figure, path, figures.FINE)


for _kind in KINDS.values():
    _offer(_kind)
