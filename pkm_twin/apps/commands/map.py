# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin map ROBOT KIND``: a quantity over the workspace or along a path."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, get_type_hints

import click

from pkm_twin.apps.frame import Command, Group, command
from pkm_twin.apps.options import (
    DrawingOptions,
    MillingOptions,
    OutputOption,
    OverwriteOption,
    PayloadOption,
    PictureOptions,
    ProcessesOption,
    ToolOptions,
    payload_fact,
)
from pkm_twin.console import draw_progress, parse_count_of_numbers, reject_existing
from pkm_twin.errors import ParameterError
from pkm_twin.extensions import Extensible
from pkm_twin.files import replace_file
from pkm_twin.maps.kind import Kind
from pkm_twin.maps.kinds import BUILTIN_KINDS, KINDS
from pkm_twin.maps.kinds.cutting_depth import CuttingDepth
from pkm_twin.report import Fact, Report
from pkm_twin.ros.signals import INTERRUPTED, first_signal
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from pkm_twin.maps.kind import Case
    from pkm_twin.robot.robot import Robot

WRENCH_HELP: Final = "six numbers separated by commas, N and N m; or NAME=six numbers"


@dataclass(frozen=True, kw_only=True)
class PageOption:
    """Option of an interactive page of the result."""

    html: bool = setting(False, "also an offline interactive HTML page")


@dataclass(frozen=True, kw_only=True)
class MapOptions(PayloadOption, PageOption, OutputOption, PictureOptions, ProcessesOption):
    """Options that all kinds of maps have."""

    kind: str = ""
    points: int | None = setting(None, "approximate number of poses; default: by kind", low=1, high=10**11)
    at: str | None = setting(None, "pose that the planes go through; default: the worst")
    along: Path | None = setting(None, "a motion in place of the workspace; --out FILE.csv writes the values")
    singularity: float | None = setting(
        None, "singularity index below which a pose does not count; default: 0.05, for `workspace` 0"
    )
    least_clearance: float = setting(0.0, "distance between limbs (m) below which a pose does not count")
    regular: bool = setting(
        False, "count only poses inside the largest circles about the axis (2UPR-RPU paper, figure 5)"
    )
    out: Path | None = setting(
        None, "file to write; default: ROBOT_KIND.nc; .npz: also arrays of the poses that count", writes=True
    )
    scheduler: str | None = setting(None, "address of a Dask scheduler: tcp://HOST:8786")

    @property
    def target(self) -> Path:
        """File that the map is written to."""
        return self.out or Path(f"{Path(self.robot).stem}_{self.kind}.nc")

    def drawing(self, command: str) -> Path | None:
        """Return the pictures' common name, next to the map's file."""
        if self.along is not None and self.out is None and self.picture is None:
            return None
        beside = dataclasses.replace(self, out=self.target)
        return super(MapOptions, beside).drawing(command)

    def cases(self, kind: Kind, machine: Robot) -> list[Case]:
        """Return the load cases, if the kind has any.

        :raises ParameterError: two of one name, or a wrench that is none.
        """
        found: dict[str, Case] = {}
        for text in getattr(self, "wrench", ()):
            name, given, values = text.rpartition("=")
            name = name.strip() if given else text
            if name in found:
                raise ParameterError("wrench", text, "another name for each load case")
            found[name] = kind.loaded(machine, name, parse_count_of_numbers(values, 6, WRENCH_HELP))
        return list(found.values())


@dataclass(frozen=True, kw_only=True)
class Loads:
    """Option of the kinds that take a wrench: the load cases."""

    wrench: tuple[str, ...] = setting(
        (),
        f"force and moment on the platform, base axes: {WRENCH_HELP}; several times for several load "
        "cases; default with --along: the path's, if it has one",
    )


@dataclass(frozen=True, kw_only=True)
class Show(PageOption, OverwriteOption, DrawingOptions):
    """Plot a stored map: PNGs, and with --html an offline interactive HTML page."""

    file: Path = setting(..., "a file that `pkm-twin map` wrote", argument=True)
    out: Path | None = setting(None, "stem of the PNGs; default: that of the file", writes=True)

    def drawing(self, command: str) -> Path:
        """Return the pictures' common name."""
        return (self.out or self.file).with_suffix(".png")


@command()
def show(given: Show) -> Report:
    """Report the results of a stored map, with its pictures."""
    return report_stored_map(given.file, given.drawing(""), given.html, given.overwrite)


def compute(given: MapOptions) -> Report:
    """Compute a map, or values along a path.

    :raises PkmTwinError: what the kind or the file rejects.
    """
    from pkm_twin.maps.run import run
    from pkm_twin.maps.store import write_arrays
    from pkm_twin.maps.sweep import plan_map

    kind: Kind
    if isinstance(given, MillingOptions) and isinstance(given, ToolOptions):
        kind = CuttingDepth(given.milling, given.damping, given.tool)
    else:
        fields = dataclasses.fields(KINDS[given.kind])
        kind = KINDS[given.kind](**{field.name: getattr(given, field.name) for field in fields})
    machine = given.machine()
    cases = given.cases(kind, machine)
    if given.along is not None:
        # Evaluate the kind along a path; report the worst of each case.
        path = given.along
        from pkm_twin.maps.along import along
        from pkm_twin.paths.along import check_efforts, zero_resting_motion
        from pkm_twin.recordings import ReadOptions, read
        from pkm_twin.recordings.payload import split_by_load

        if given.out is not None and given.out.suffix != ".csv":
            raise ParameterError("out", str(given.out), "a name that ends in .csv")
        motion = read(path, machine, ReadOptions(planned=True, load=given.load))
        if given.payload is None and (motion.computed is not None or (motion.effort is not None and len(motion.q) > 2)):
            effort_warning = check_efforts(zero_resting_motion(motion.with_rates())).effort_warning
            motion = replace(motion, effort_warning=effort_warning)
        else:
            motion.check_rates()
        found = along(
            kind,
            machine,
            motion.clock,
            motion.q,
            cases=cases,
            wrench=motion.wrench,
            parts=split_by_load(machine, motion.load, motion.time, len(motion.q)),
            least=given.singularity,
            least_clearance=given.least_clearance,
        )
        if given.out is not None:
            replace_file(given.out, found.table().encode())
        beyond, least, low = int((~found.counted).sum()), found.least, found.near_singular
        first, *rest = found.sentences
        bound = f", singularity index {least:g} or more" if least > 0.0 else ""
        under = ["under the wrench of the path"] if found.loaded else []
        notes = [*rest, *under, f"{len(found.time)} samples of {path}{bound if not beyond else ''}"]
        if beyond:
            alone = f"{low} have a singularity index below {least:g}"
            reason = alone if low == beyond else f"{alone}; others are beyond limits or limbs interfere"
            notes.append(f"{beyond} of {len(found.time)} samples would not count, but are included: {reason}")
        return Report(
            motion.with_effort_warning(first),
            [
                Fact("robot", machine.name),
                Fact("kind", kind.name),
                Fact("samples", len(found.time)),
                Fact("samples_that_do_not_count", beyond),
                Fact("singularity_bound", least if least > 0.0 else None),
                payload_fact(motion.load),
                Fact("worst", found.worst),
                Fact("files", [str(path) for path in (given.out, given.drawing("")) if path]),
            ],
            figures={"": found.draw},
            notes=notes,
            files={"out": given.out},
        )
    names = machine.pose_names
    sweep = plan_map(
        machine,
        kind,
        given.points,
        cases=cases,
        at=None if given.at is None else parse_count_of_numbers(given.at, len(names), f"a pose {','.join(names)}"),
        least_singularity=given.singularity,
        least_clearance=given.least_clearance,
        regular=given.regular,
    )
    arrays = given.target if given.target.suffix == ".npz" else None
    if arrays is not None:
        reject_existing(arrays, given.overwrite)
    target = given.target.with_suffix(".nc") if arrays else given.target
    with first_signal(KeyboardInterrupt), draw_progress(f"{kind.name} of {machine.name}", sweep.points) as update:
        try:
            run(
                sweep, target, workers=given.jobs, scheduler=given.scheduler, overwrite=given.overwrite, progress=update
            )
        except KeyboardInterrupt:
            kept = f"stopped; finished parts are in {target}.parts, the same command continues"
            return Report(error=f"{kept} from there", code=INTERRUPTED)
    report = report_stored_map(target, given.drawing(""), given.html, given.overwrite)
    if arrays is not None:
        write_arrays(arrays, target, kind, machine)
        report = dataclasses.replace(report, files={**report.files, "arrays": arrays})
    return report


def report_stored_map(file: Path, drawing: Path | None, html: bool, overwrite: bool) -> Report:
    """Report what a stored map answers.

    :param drawing: the pictures' common name; None for none.
    :raises PkmTwinError: the page exists and ``overwrite`` is false.
    """
    from pkm_twin.maps import figures
    from pkm_twin.maps.page import write_page
    from pkm_twin.maps.store import convert_read_errors, open_map

    with open_map(file) as data:
        with convert_read_errors(file):
            first, *rest = figures.write_lines(data)
            facts = [
                Fact("robot", data.attrs["robot"]),
                Fact("kind", data.attrs["kind"]),
                Fact("sizes", {str(name): size for name, size in data.sizes.items()}),
                Fact("worst", figures.list_answers(data)),
                Fact(
                    "facts",
                    (
                        {
                            str(name): {"value": float(variable), "unit": variable.attrs.get("units", "")}
                            for name, variable in data.data_vars.items()
                            if not variable.dims and math.isfinite(float(variable))
                        }
                    ),
                ),
            ]
        drawn = {} if drawing is None else figures.draw(data)
        page = None
        if html:
            page = (drawing or file).with_suffix(".html")
            reject_existing(page, overwrite)
            write_page(data, page)
        pictures = {name: lambda one=one: one for name, one in drawn.items()}
        return Report(first, facts, figures=pictures, notes=rest, files={"file": file, "page": page})


def make_kind_command(kind: type[Kind]) -> Command:
    """Make the command that computes a kind, with its own options and those of all maps."""
    milling = kind is CuttingDepth
    own = [] if milling else [(f.name, get_type_hints(kind)[f.name], f) for f in dataclasses.fields(kind)]
    more: list[type[Any]] = [Loads] if kind.takes_wrench else []
    more += [MillingOptions, ToolOptions] if milling else []
    given = dataclasses.make_dataclass(
        kind.__name__,
        [*own, ("kind", str, kind.name)],
        bases=(*more, MapOptions),
        namespace={"__doc__": kind.__doc__, "__module__": __name__},
        frozen=True,
        kw_only=True,
    )
    return Command(given, compute)


class RobotFirstGroup(Group):
    """Group whose commands (kinds) follow the robot: ``map ROBOT KIND``; ``show`` comes first."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse ``ROBOT KIND``: swap both words, so that the kind is the command's name."""
        if args and args[0] not in self.commands:
            alone = len(args) == 1 or args[1].startswith("-")
            options = [word for word in args if word.startswith("-")]
            args = options if alone else [args[1], args[0], *args[2:]]
        return super().parse_args(ctx, args)

    def spell_command(self, name: str) -> str:
        """Return the command's name with the robot's before it."""
        return name if name == "show" else f"ROBOT {name}"


map_ = RobotFirstGroup(
    "map",
    """Map a quantity over the workspace, find its worst pose, and draw planes through it.

    `pkm-twin map ROBOT KIND` computes a map, `pkm-twin map show FILE` plots a stored one again.

    Ctrl-C stops it. Finished parts stay in FILE.nc.parts, and the same command continues from there
    with the same result. Only one run at a time can write a file.

    For the options of a kind use `pkm-twin map ROBOT KIND --help`.
    """,
    Extensible(
        "pkm_twin.maps",
        Kind,
        ["show", *BUILTIN_KINDS],
        lambda name: show if name == "show" else make_kind_command(BUILTIN_KINDS[name]),
        make_kind_command,
    ),
    "Stiffness, workspace and vibration",
    "ROBOT KIND [OPTIONS]",
)
