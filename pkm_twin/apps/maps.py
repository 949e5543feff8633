# SPDX-License-Identifier: Apache-2.0
"""The maps of ``pkm-twin atlas``: one quantity over the workspace, or along a path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

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
from pkm_twin.atlas.commands import Alone, app, kind, show
from pkm_twin.console import numbers, print_json, refuse_existing
from pkm_twin.errors import ParameterError
from pkm_twin.options import OptionalPath, OptionalText, options_of, take_options

if TYPE_CHECKING:
    from pkm_twin.atlas.maps.milling import Process
    from pkm_twin.atlas.maps.quantity import Case, Found, Quantity
    from pkm_twin.atlas.sweep import Sweep
    from pkm_twin.robot.robot import Robot

__all__ = ["app", "show"]

Array = NDArray[np.float64]

_SINGULARITY = 0.05
_NAMES = "P1, P2, P3 or six numbers separated by commas, N and N m; or NAME=six numbers"

Along = Annotated[
    OptionalPath,
    typer.Option(
        help="instead of the workspace: a CSV of `pkm-twin path`, or any motion that `pkm-twin "
        "torques` reads; --out FILE.csv writes the values"
    ),
]
Wrench = Annotated[
    list[str],
    typer.Option(
        help=f"force and moment on the platform, base axes: {_NAMES}; several times for several "
        "load cases"
    ),
]
LoadOf = Annotated[
    OptionalText,
    typer.Option(help="MASS[,x,y,z] on the platform instead of the file's payload, kg and m"),
]
Singularity = Annotated[
    float, typer.Option(help="singularity index (0 to 1) below which a pose does not count")
]
Clearance = Annotated[
    float, typer.Option(help="distance between limbs (m) below which a pose does not count")
]


def _cases(texts: Sequence[str]) -> list[Case]:
    """Load cases of a command line.

    :raises ParameterError: two of one name, or a wrench that is none.
    """
    from pkm_twin.atlas.maps.quantity import Case
    from pkm_twin.atlas.strain_energy.sweep import WRENCHES, checked_wrench

    found: dict[str, Case] = {}
    for text in texts:
        name, given, values = text.rpartition("=")
        name = name.strip() if given else text
        if name in found:
            raise ParameterError("wrench", text, "another name for each load case")
        wrench = WRENCHES[text] if text in WRENCHES else checked_wrench(numbers(values, 6, _NAMES))
        found[name] = Case(name, wrench)
    return list(found.values())


@dataclass(frozen=True, eq=False)
class PathMap:
    """A quantity along a path: ``time`` (k,), s, joint positions ``q`` (k, n)."""

    robot: Robot
    quantity: Quantity
    cases: tuple[Case, ...]
    source: Path
    time: Array
    q: Array
    least: float
    least_clearance: float

    def present(self, out: Path | None, picture: bool, overwrite: bool, as_json: bool) -> None:
        """Print the worst of each case, and write table and picture where a name is given."""
        from pkm_twin.atlas.maps.figures import sentence
        from pkm_twin.atlas.maps.sweep import counts, found_of

        if out is not None:
            if out.suffix != ".csv":
                raise ParameterError("out", str(out), "a name that ends in .csv")
            for target in (out, out.with_suffix(".png")):
                refuse_existing(target, overwrite, self.source)
        robot, quantity = self.robot, self.quantity
        pose = robot.forward(self.q)
        inside = counts(
            robot, self.q, pose, np.ones(len(self.q), bool), self.least, self.least_clearance
        )
        found = [found_of(quantity, robot, self.q, case) for case in self.cases]
        worst = []
        for case, one in zip(self.cases, found, strict=True):
            k = int(np.argmax(one.value if quantity.largest else -one.value))
            worst.append(
                {
                    "case": case.name,
                    "value": float(one.value[k]),
                    "unit": quantity.unit(robot, case),
                    "time_s": float(self.time[k]),
                    "pose": dict(zip(robot.pose_names, pose[k].tolist(), strict=True)),
                    "direction": one.direction[k].tolist(),
                    "element": quantity.elements(robot)[int(one.element[k])],
                }
            )
        files = [] if out is None else self._write(out, picture, pose, inside, found)
        beyond = int((~inside).sum())
        if as_json:
            print_json(
                {
                    "robot": robot.name, "kind": quantity.name, "samples": len(self.q),
                    "samples_that_do_not_count": beyond, "worst": worst, "files": files,
                }
            )  # fmt: skip
            return
        typer.echo(f"{robot.name}: {quantity.question} {len(self.q)} samples of {self.source}")
        for answer in worst:
            typer.echo(f"worst pose, {sentence(answer)}; at {answer['time_s']:.4g} s")
        if beyond:
            typer.echo(f"{beyond} samples are beyond limits, near a singularity or limbs meet")
        for name in files:
            typer.echo(name)

    def _write(
        self, out: Path, picture: bool, pose: Array, inside: NDArray[np.bool_], found: list[Found]
    ) -> list[str]:
        import csv
        import io

        from pkm_twin.files import replace_file

        robot, names = self.robot, self.quantity.elements(self.robot)
        header = ["time", *robot.pose_names, "counts"]
        columns: list[list[Any]] = [
            self.time.tolist(),
            *pose.T.tolist(),
            inside.astype(int).tolist(),
        ]
        for case, one in zip(self.cases, found, strict=True):
            before = "" if len(self.cases) == 1 else f"{case.name}."
            header += [f"{before}{w}" for w in ("value", "x", "y", "z", "element")]
            columns += [one.value.tolist(), *one.direction.T.tolist()]
            columns.append([names[k] for k in one.element])
        text = io.StringIO()
        csv.writer(text).writerows([header, *zip(*columns, strict=True)])
        replace_file(out, text.getvalue().encode())
        return [str(out), *([str(self._draw(out.with_suffix(".png"), found))] if picture else [])]

    def _draw(self, path: Path, found: list[Found]) -> Path:
        from pkm_twin.atlas import figures, plots

        figure, axes = figures.subplots(
            len(found), 1, figsize=(9, 3.5 * len(found)), layout="constrained", squeeze=False
        )
        names = self.quantity.elements(self.robot)
        for ax, case, one in zip(axes[:, 0], self.cases, found, strict=True):
            values, unit = figures.prefixed(one.value, self.quantity.unit(self.robot, case))
            ax.plot(self.time, values, color="0.7", lw=1)
            for n, element in enumerate(np.unique(one.element)):
                own = one.element == element
                colour = plots.COLOURS[n % len(plots.COLOURS)]
                ax.plot(self.time[own], values[own], ".", ms=4, color=colour, label=names[element])
            what = f"{self.quantity.name.replace('-', ' ')} ({unit})"
            plots.label(ax, "time (s)", what, case.name, 9)
            title = self.quantity.element
            ax.legend(title=title, loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
        figure.suptitle(f"{self.robot.name}: {self.quantity.question}")
        return plots.save(figure, path)


def _made(
    name: str | Process,
    machine: Robot,
    points: int | None,
    wrench: Sequence[str] = (),
    *,
    payload: str | None,
    along: Path | None,
    least_singularity: float,
    least_clearance: float,
) -> Sweep | Alone:
    """The map of a command line, over the workspace or along a path."""
    from pkm_twin.apps.options import load_of
    from pkm_twin.atlas.maps.sweep import QUANTITIES, check, map_sweep
    from pkm_twin.atlas.strain_energy.sweep import has_paper_elements, strain_energy_sweep

    carried = load_of(payload, None)
    if carried is not None:
        machine = carried.on(machine)
    cases = _cases(wrench)
    plain = (payload, along, least_singularity, least_clearance) == (None, None, _SINGULARITY, 0.0)
    if name == "strain-energy" and plain and len(cases) < 2 and has_paper_elements(machine):
        return strain_energy_sweep(machine, cases[0].wrench or "P1" if cases else "P1", points)
    if along is None:
        return map_sweep(
            machine, name, points, cases=cases, least_singularity=least_singularity,
            least_clearance=least_clearance,
        )  # fmt: skip
    from pkm_twin.apps.torques import motion_of

    quantity = QUANTITIES[name] if isinstance(name, str) else name.quantity
    check(machine, quantity, cases)
    motion = motion_of(along, machine)
    return PathMap(
        machine, quantity, tuple(cases) or (quantity.default,), along, motion.time, motion.q,
        least_singularity, least_clearance,
    )  # fmt: skip


def _loads(wrench: Wrench = []) -> None:  # noqa: B006  typer copies it
    """The option of maps with load cases."""


def _poses(
    payload: LoadOf = None,
    along: Along = None,
    least_singularity: Singularity = _SINGULARITY,
    least_clearance: Clearance = 0.0,
) -> None:
    """The options of all maps."""


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


def _offer(name: str, doc: str, own: Callable[..., None] | None = _loads) -> None:
    """Make a map a command with the options of a function and those of all maps."""
    process = options_of(_milling) if own is _milling else {}

    def made(machine: Robot, points: int | None, **given: Any) -> Sweep | Alone:
        cut = {key: given.pop(key) for key in process}
        return _made(process_of(**cut) if cut else name, machine, points, **given)

    made.__name__, made.__doc__ = name, doc
    options = [] if own is None else options_of(own).values()
    take_options(made, [*options, *options_of(_poses).values()])
    kind(made)


_offer("compliance", "The softest pose: compliance and its direction, or deflections under loads.")
_offer("payload", "The largest mass that the drives hold at rest.")
_offer("acceleration", "The acceleration from rest that the drives reach in every direction.")
_offer("frequency", "The first natural frequency, actuators locked.", None)
_offer(
    "pose-error",
    "The standard deviation of the position, from the file's `uncertainty`.",
    None,
)
_offer(
    "strain-energy",
    """The strain energy of loads, and each element's share.

    For upr_rpu with at most one wrench and no other option, the map covers the largest inscribed
    circle of each height, and the command compares the result with table 2 of the 2UPR-RPU paper.
    """,
)
_offer(
    "cutting-depth",
    "The axial depth of cut that mills without chatter at every spindle speed (zero-order).",
    _milling,
)
