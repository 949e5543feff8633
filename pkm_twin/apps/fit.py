# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin fit``: a robot's file from recordings of its motion and efforts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
import typer
from numpy.typing import NDArray

from pkm_twin.apps.options import (
    Accept,
    BagTopics,
    BeyondLimits,
    Json,
    LoadTimes,
    Payload,
    Platform,
    read_options,
)
from pkm_twin.console import print_json, progress, refuse_existing, writing
from pkm_twin.errors import BagError, ParameterError, PkmTwinError, UnknownNameError, one_line
from pkm_twin.files import replace_file
from pkm_twin.machine.strict_yaml import parse_yaml
from pkm_twin.options import OptionalText, file_name
from pkm_twin.robot.catalogue import robot_of_data
from pkm_twin.robot.limits import beyond_limits as find_beyond
from pkm_twin.robot.limits import refuse_beyond

if TYPE_CHECKING:
    from pkm_twin.apps.fit_report import Report
    from pkm_twin.identification.deflections import Deflected
    from pkm_twin.recordings import ReadOptions, Recording

Array = NDArray[np.float64]

RobotFile = Annotated[
    str,
    typer.Argument(help="a robot's name (see `pkm-twin robots`) or file: the values to start from"),
]
COMPLIANCE: Final = "compliance"
"""What is fitted to deflections, not to efforts."""


def fit(
    robot: RobotFile,
    recordings: Annotated[list[Path], typer.Argument(help="bags, or CSV files with a header row")],
    what: Annotated[
        str,
        typer.Option(
            help="what to fit: friction,rotor,payload,inertia or some of them; or compliance"
        ),
    ] = "friction,rotor,payload,inertia",
    out: Annotated[
        Path,
        typer.Option(
            help="YAML to write; the report has the same name with .html", callback=file_name
        ),
    ] = Path("fitted.yaml"),
    report: Annotated[bool, typer.Option(help="write the report with pictures")] = True,
    per_copy: Annotated[
        bool,
        typer.Option("--per-copy", help="fit each copy of a limb by itself, and write all of them"),
    ] = False,
    friction: Annotated[
        str,
        typer.Option(
            help="friction laws of the drives in addition to the file's: auto, coulomb (no other), "
            "stribeck, load-dependent, periodic, several with commas"
        ),
    ] = "auto",
    torque_constant: Annotated[
        OptionalText,
        typer.Option(
            help="efforts are motor currents, A: N m or N per ampere at the joint, one number or "
            "one per joint with commas; `fit` takes it from the masses of the file"
        ),
    ] = None,
    topic: BagTopics = [],  # noqa: B006  typer copies it
    payload: Payload = None,
    load_times: LoadTimes = None,
    platform: Platform = None,
    beyond_limits: BeyondLimits = False,
    accept: Accept = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="replace the YAML and the report")
    ] = False,
    json_output: Json = False,
) -> None:
    """Fit friction, masses or compliance to recordings.

    Fits friction, rotors, payload and masses to recorded efforts, or compliance to measured
    deflections. Positions and efforts are enough: velocities and accelerations are differentiated
    without delay, and regressor and efforts pass the same filter. CSV columns: time (s);
    JOINT.position and JOINT.effort for every actuated joint; optionally the wrench fx fy fz mx my
    mz. The last third of each recording is held out for validation.

    The YAML is the robot's file with the fitted values, each with its standard deviation in a
    comment. The command lists the parameters that the motion does not excite; they keep the file's
    value. A recording that this machine cannot have produced is rejected with the reason; --accept
    fits it nevertheless and marks the files. The verdict reports whether the model explains the
    recordings, what does not fit and which error is likely. If the model does not explain them,
    standard deviations are widened or withheld.

    Where Coulomb and viscous friction leave something unexplained, `fit` tries the other friction
    laws and takes one that predicts the held-out part better; a line gives the evidence.
    `--friction coulomb` keeps the law of the file, `--friction LAW` takes a law in any case.

    With --torque-constant the efforts of the recordings are motor currents in A; in a CSV they may
    be in columns JOINT.current.

    --payload and --load-times give a known payload. When `payload` is fitted, they give the times
    at which it is held.

    `--what compliance` fits a factor on the compliance of every elastic element (member or joint)
    to measured loads and deflections. A bag needs the wrench and a TransformStamped; a CSV needs
    the columns JOINT.position, fx fy fz mx my mz, and those of dx dy dz (m) rx ry rz (rad) that
    were measured, all at the platform's reference point in base axes.
    """
    page = out.with_suffix(".html") if report else None
    if out.suffix not in (".yaml", ".yml"):
        raise ParameterError("out", str(out), "a name that ends in .yaml or .yml")
    for target in (out, page):
        if target is not None:
            refuse_existing(target, overwrite)
    _check_topics(topic, recordings)
    if COMPLIANCE in [word.strip() for word in what.split(",")]:
        if per_copy or payload is not None or load_times is not None:
            raise ParameterError(
                "what", what, "no --per-copy, --payload or --load-times, which are for efforts"
            )
        _fit_compliance(
            robot, platform, recordings, what, topic, out, page, json_output, beyond_limits, accept
        )
        return
    from pkm_twin.apps.fit_files import robot_text
    from pkm_twin.apps.fit_report import effort_report
    from pkm_twin.identification.friction_laws import laws_of

    kinds, laws = kinds_of(what), laws_of(friction)
    text, machine = robot_text(robot, platform=platform, per_copy=per_copy)
    how = read_options(topic, payload, load_times)
    with progress("fit", 2 * len(recordings)) as update:
        result, beyond, choices = fit_recordings(
            machine, recordings, kinds, how, update, limited=not beyond_limits,
            accept=accept, laws=laws, constant=torque_constant,
        )  # fmt: skip
    marks = [
        *(str(choice) for choice in choices),
        *(f"accepted by --accept: {line}" for line in result.accepted),
        *beyond,
    ]
    told = [dataclasses.asdict(choice) for choice in choices]
    more = {"beyond_limits": beyond, "friction_laws": told}
    _finish(effort_report(result, _named(recordings)), text, marks, out, page, json_output, more)


def _named(recordings: Sequence[Path]) -> list[str]:
    return [one_line(path.name, 100) for path in recordings]


def _finish(
    report: Report, text: str, marks: Sequence[str], out: Path, page: Path | None, as_json: bool,
    more: dict[str, Any],
) -> None:  # fmt: skip
    """Write the robot's file and the page, and print what was found.

    :param text: of the robot's file before. ``marks``: lines that come first.
    """
    from pkm_twin.apps.fit_files import fitted_yaml
    from pkm_twin.robot.edited import write_edited

    fitted = fitted_yaml(text, report.result, report.recordings)
    _check_loads(fitted, out)
    with writing(out):
        write_edited(out, [*marks, *report.head()], fitted)
        if page is not None:
            replace_file(page, report.page(marks).encode())
    if as_json:
        files = {"out": str(out), "report": None if page is None else str(page)}
        print_json(report.as_json() | files | more)
        return
    report.echo()
    for line in marks:
        typer.echo(line)
    typer.echo(f"{out}" + (f", {page}" if page is not None else ""))


def _check_topics(topics: Sequence[str], recordings: Sequence[Path]) -> None:
    """A topic is a bag's."""
    from pkm_twin.bags.storage import is_bag

    tables = [path for path in recordings if not is_bag(path)] if topics else []
    if tables:
        raise typer.BadParameter(f"--topic is for bags; {tables[0]} is read as CSV")


def _check_loads(text: str, out: Path) -> None:
    """Refuse to write what could not be read again.

    :raises PkmTwinError: numbers that no file may have.
    """
    try:
        robot_of_data(parse_yaml(text, str(out)), out.stem)
    except ValueError as error:
        raise PkmTwinError(
            f"the fitted values are not a valid robot, so {out} is not written: {error}"
        ) from None


def _beyond(machine: Any, recordings: Sequence[tuple[str, Array]], limited: bool) -> list[str]:
    """What recordings, by name with joints (k, n), have beyond the robot's limits.

    :raises ParameterError: something, where that is refused.
    """
    lines = []
    for name, q in recordings:
        _, found = find_beyond(machine, q)
        if limited:
            refuse_beyond(found, name)
        lines += [f"beyond limits: {one_line(name, 100)}: {item}" for item in found]
    return lines


def _fit_compliance(
    robot: str, platform: str | None, recordings: Sequence[Path], what: str,
    topics: Sequence[str], out: Path, page: Path | None, json_output: bool,
    beyond_limits: bool, accept: bool,
) -> None:  # fmt: skip
    """The fit of elastic elements, its files and what it says."""
    from pkm_twin.apps.elastic_report import elastic_report
    from pkm_twin.apps.fit_files import robot_text
    from pkm_twin.identification.deflections import fit_elements
    from pkm_twin.recordings import read as read_recording

    if what.strip() != COMPLIANCE:
        raise ParameterError(
            "what", what, "only compliance, because it is fitted to other recordings"
        )
    text, machine = robot_text(robot, platform=platform)
    _ = machine.elastic
    with progress("fit", 2 * len(recordings)) as update:
        read = []
        for path in recordings:
            how = read_options(topics, deflected=True)
            read.append(deflected_of(read_recording(path, machine, how)))
            update(len(read))
        beyond = _beyond(machine, [(r.name, r.q) for r in read], not beyond_limits)
        result = fit_elements(machine, read, lambda k: update(len(recordings) + k), accept=accept)
    marks = [*(f"accepted by --accept: {line}" for line in result.accepted), *beyond]
    report = elastic_report(result, _named(recordings))
    _finish(report, text, marks, out, page, json_output, {"beyond_limits": beyond})


def fit_recordings(
    machine: Any,
    recordings: Sequence[Path],
    kinds: Sequence[Any],
    how: Any = None,
    update: Callable[[int], None] | None = None,
    limited: bool = True,
    accept: bool = False,
    laws: Sequence[str] | None = (),
    constant: str | None = None,
) -> tuple[Any, list[str], Any]:
    """The fit of recordings, read as ``pkm-twin fit`` reads them.

    :param how: as :class:`pkm_twin.recordings.ReadOptions`.
    :param limited: refuse what is beyond the robot's limits.
    :param accept: fit recordings that the machine cannot have made, too.
    :param laws: of friction beside the file's, see
        :func:`~pkm_twin.identification.friction_laws.fit_with_laws`.
    :param constant: as of ``--torque-constant``.
    :returns: a :class:`~pkm_twin.identification.fit.Fit`, a line on each joint beyond its limits,
        and the friction laws that were tried.
    :raises PkmTwinError: a recording without efforts, too short, or that shows nothing.
    """
    from pkm_twin.apps.check import recorded_of, step_fault
    from pkm_twin.identification.fit import refuse_faults
    from pkm_twin.identification.friction_laws import fit_with_laws
    from pkm_twin.recordings import ReadOptions

    how = dataclasses.replace(how or ReadOptions(), currents=constant is not None)
    read = [_read(path, machine, how) for path in recordings]
    beyond = _beyond(
        machine,
        [(one_line(p.name, 100), r.q) for p, r in zip(recordings, read, strict=True)],
        limited,
    )
    faults = [
        f"{one_line(path.name, 100)}: position steps that are no motion: {fault}"
        for path, r in zip(recordings, read, strict=True)
        if (fault := step_fault(r))
    ]
    refuse_faults(faults, accept)
    beyond = [*beyond, *(f"accepted by --accept: {fault}" for fault in faults)]
    base = machine
    if "payload" in kinds:
        loads = [r.load for r in read if r.load is not None]
        # Two payloads are not one section of a file.
        if len({(load.mass, load.com) for load in loads}) > 1:
            masses = ", ".join(f"{load.mass:g}" for load in loads)
            raise PkmTwinError(f"recordings with payloads of {masses} kg: fit one at a time")
        base = loads[0].on(machine) if loads else machine
    made = [recorded_of(r) for r in read]
    if "payload" in kinds:
        made = [dataclasses.replace(one, carried=None) for one in made]
    if constant is not None:
        made, told = _with_efforts(base, made, constant, kinds)
        beyond = [*told, *beyond]
    result, choices = fit_with_laws(base, made, kinds, laws, accept=accept, progress=update)
    return result, beyond, choices


def _with_efforts(
    machine: Any, recordings: Sequence[Any], constant: str, kinds: Sequence[Any]
) -> tuple[list[Any], list[str]]:
    """Recordings of currents with efforts, and a line on each torque constant that was fitted."""
    from pkm_twin.identification.torque_constant import FIT, fitted_constants, given_constants

    if constant != FIT:
        found = given_constants(machine, constant)
    elif {"payload", "inertia"} & set(kinds):
        raise ParameterError(
            "torque-constant", FIT, "--what friction,rotor: the masses of the file are its scale"
        )
    else:
        found = fitted_constants(machine, recordings)
    return [found.applied(one) for one in recordings], found.lines(machine)


def kinds_of(what: str) -> tuple[Any, ...]:
    """The kinds of numbers in words with commas between.

    :raises UnknownNameError: another word.
    """
    from pkm_twin.machine.shared import KINDS

    words = tuple(word.strip() for word in what.split(","))
    for word in words:
        if word not in KINDS:
            raise UnknownNameError("what", word, (*KINDS, COMPLIANCE))
    return tuple(kind for kind in KINDS if kind in words)


def deflected_of(r: Recording) -> Deflected:
    """A recording with deflections, as the fit of compliance takes it."""
    from pkm_twin.identification.deflections import Deflected

    assert r.wrench is not None and r.deflection is not None  # noqa: S101  asked for
    return Deflected(r.name, r.time, r.q, r.wrench, r.deflection)


def _read(path: Path, machine: Any, how: ReadOptions) -> Recording:
    """A recording with efforts.

    :raises PkmTwinError: there are none, or no wrench is accepted.
    """
    from pkm_twin.recordings import read

    r = read(path, machine, how)
    if r.effort is None and r.bag is None:
        joint = machine.joint_names[0]
        raise ParameterError(
            str(path), "no efforts", f"columns {joint}.effort ... of the drives, or "
            f"{joint}.current ... with --torque-constant"
        )  # fmt: skip
    if r.effort is None:
        raise BagError(
            f"no efforts on {r.topics.joint_states}: a fit needs the efforts of the drives",
            path=path, reason="no efforts",
        )  # fmt: skip
    if r.topics.wrench is not None and r.wrench is None:
        raise BagError(
            f"no wrench on {r.topics.wrench} is accepted: {r.first_reject}", path=path,
            reason="frames",
        )  # fmt: skip
    return r
