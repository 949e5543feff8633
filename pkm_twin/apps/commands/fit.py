# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin fit``: a robot's file from recordings of its motion, efforts or deflections."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import typer

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import (
    ROBOT_HELP,
    Accepts,
    BeyondLimitsToo,
    CarriesAtTimes,
    ReadsRecordings,
)
from pkm_twin.console import progress, refuse_existing, writing
from pkm_twin.errors import BagError, ParameterError, one_line
from pkm_twin.files import replace_file
from pkm_twin.report import Fact, Report
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from pkm_twin.codegen.arrays import Array
    from pkm_twin.identification.fit import Result
    from pkm_twin.identification.friction_laws import Choice
    from pkm_twin.recordings import Recording
    from pkm_twin.robot.robot import Robot

COMPLIANCE: Final = "compliance"
"""What is fitted to deflections, not to efforts."""
GRAVITY: Final = 9.80665
"""Standard gravity, m/s2."""


@dataclass(frozen=True, kw_only=True)
class Fit(CarriesAtTimes, ReadsRecordings, BeyondLimitsToo, Accepts):
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

    `fit --drive TABLE` needs no robot: it fits a drive's torque constant and friction to slow
    traverses with weights, up and down. The CSV has one row per run: mass_kg or torque_nm,
    iq_up_A, iq_down_A; optionally speed, drive (a number). At least two weights are needed. A
    friction law has the terms that the runs determine: Coulomb, viscous (two speeds or more),
    load-dependent. A term is accepted if an F test at 5 % rejects the law without it, and if the
    law predicts left-out runs better. Each run is left out once. Several drives of one kind share
    their numbers; each drive is left out once, too.
    """

    robot: str = setting("", f"{ROBOT_HELP}: the values to start from", argument=True)
    recordings: tuple[Path, ...] = setting(
        (), "bags, or CSV files with a header row", argument=True
    )
    what: str = setting(
        "friction,rotor,payload,inertia",
        "what to fit: friction,rotor,payload,inertia or some of them; or compliance",
    )
    out: Path | None = setting(
        None, "YAML to write; the report has the same name with .html; default: fitted.yaml",
        writes=True, endings=(".yaml", ".yml"),
    )  # fmt: skip
    no_report: bool = setting(False, "write no report with pictures")
    per_copy: bool = setting(False, "fit each copy of a limb by itself, and write all of them")
    friction: str = setting(
        "auto",
        "friction laws of the drives in addition to the file's: auto, coulomb (no other), "
        "stribeck, load-dependent, periodic, several with commas",
    )
    torque_constant: str | None = setting(
        None,
        "efforts are motor currents, A: N m or N per ampere at the joint, one number or one per "
        "joint with commas; `fit` takes it from the masses of the file",
    )
    drive: Path | None = setting(None, "CSV of traverses with weights, one row per run")
    lever: float | None = setting(
        None, "with --drive, for mass_kg: travel per radian of the motor (spool radius), m",
        low=1e-6, high=1e3,
    )  # fmt: skip
    overwrite: bool = setting(False, "replace the YAML and the report")

    @property
    def files(self) -> dict[str, Path | None]:
        """What is written."""
        out = self.out or Path("fitted.yaml")
        return {"out": out, "report": None if self.no_report else out.with_suffix(".html")}


def fit(given: Fit) -> Report:
    """What the recordings say, with the files that are written.

    :raises PkmTwinError: recordings that show nothing, or that the machine cannot have made.
    """
    from pkm_twin.robot.entries import robot_text

    if given.drive is not None:
        return _of_drive(given, given.drive)
    if not given.robot or not given.recordings:
        raise typer.BadParameter("a robot and recordings are missing; give both, or --drive TABLE")
    for target in filter(None, given.files.values()):
        refuse_existing(target, given.overwrite)
    compliant = COMPLIANCE in [word.strip() for word in given.what.split(",")]
    if compliant and (given.per_copy or given.payload is not None or given.load_times is not None):
        raise ParameterError(
            "what", given.what, "no --per-copy, --payload or --load-times, which are for efforts"
        )
    text, machine = robot_text(given.robot, platform=given.platform, per_copy=given.per_copy)
    with progress("fit", 2 * len(given.recordings)) as update:
        made = _of_deflections if compliant else _of_efforts
        result, choices, beyond = made(given, machine, update)
    marks = [
        *(str(choice) for choice in choices),
        *(f"accepted by --accept: {line}" for line in result.accepted),
        *beyond,
    ]
    names = [one_line(path.name, 100) for path in given.recordings]
    return _written(given, result, names, text, marks, choices, beyond)


def _beyond(given: Fit, machine: Robot, recordings: Sequence[Array]) -> list[str]:
    """What joints (k, n) of recordings have beyond the robot's limits.

    :raises ParameterError: something, where that is refused.
    """
    from pkm_twin.robot.limits import beyond_limits, refuse_beyond

    lines = []
    for path, q in zip(given.recordings, recordings, strict=True):
        name = one_line(path.name, 100)
        _, found = beyond_limits(machine, q)
        if not given.beyond_limits:
            refuse_beyond(found, name)
        lines += [f"beyond limits: {name}: {item}" for item in found]
    return lines


def _of_deflections(
    given: Fit, machine: Robot, update: Any
) -> tuple[Result, Sequence[Choice], list[str]]:
    """The fit of elastic elements."""
    from pkm_twin.identification.deflections import fit_elements

    if given.what.strip() != COMPLIANCE:
        raise ParameterError(
            "what", given.what, "only compliance, because it is fitted to other recordings"
        )
    _ = machine.elastic
    read = []
    for path in given.recordings:
        read.append(given.read(path, machine, deflected=True))
        update(len(read))
    beyond = _beyond(given, machine, [r.q for r in read])
    result = fit_elements(machine, read, lambda k: update(len(read) + k), accept=given.accept)
    return result, (), beyond


def _of_efforts(
    given: Fit, machine: Robot, update: Any
) -> tuple[Result, Sequence[Choice], list[str]]:
    """The fit of efforts."""
    from pkm_twin.identification.friction_laws import fit_recordings, laws_of
    from pkm_twin.identification.parameters import kinds_of

    kinds, laws = kinds_of(given.what), laws_of(given.friction)
    read = [_read(given, path, machine) for path in given.recordings]
    beyond = _beyond(given, machine, [r.q for r in read])
    result, choices, notes = fit_recordings(
        machine, read, kinds, laws, constant=given.torque_constant, accept=given.accept,
        progress=update,
    )  # fmt: skip
    return result, choices, [*notes, *beyond]


def _read(given: Fit, path: Path, machine: Robot) -> Recording:
    """A recording with efforts.

    :raises PkmTwinError: there are none, or no wrench is accepted.
    """
    r = given.read(path, machine, currents=given.torque_constant is not None)
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


def _written(
    given: Fit, result: Result, names: Sequence[str], text: str, marks: Sequence[str],
    choices: Sequence[Choice], beyond: Sequence[str],
) -> Report:  # fmt: skip
    """The report, after the robot's file and the page are written.

    :param names: of the recordings. ``text``: of the robot's file before.
    """
    from pkm_twin.apps.fit_report import report_of
    from pkm_twin.identification.parameters import fitted_yaml
    from pkm_twin.report.page import page
    from pkm_twin.robot.entries import write_edited

    report, more = report_of(result, names, marks)
    facts = [
        Fact("beyond_limits", beyond),
        Fact("friction_laws", [dataclasses.asdict(choice) for choice in choices]),
    ]
    out, html = given.files.values()
    assert out is not None  # noqa: S101
    fitted = fitted_yaml(text, result.numbers, names, out)
    head = [
        *marks, f"{report.answer}.", f"Fitted from {', '.join(names)}.",
        *(f"{note}." for note in report.notes[len(marks) :]),
    ]  # fmt: skip
    head += [
        f"Residual rms held out of {name}: {before:.3g} before, {after:.3g} now, {unit}."
        for name, (before, after, _, unit) in report.tables[-1].rows.items()
    ]
    with writing(out):
        write_edited(out, head, fitted)
        if html is not None:
            title = f"{result.robot.name}: fitted from {', '.join(names)}"
            replace_file(html, page(title, report, more).encode())
    return dataclasses.replace(report, facts=[*report.facts, *facts], files=given.files)


def _of_drive(given: Fit, path: Path) -> Report:
    """A drive's torque constant and friction by weights."""
    from pkm_twin.apps.fit_report import drive_report
    from pkm_twin.identification.drives import drive_friction
    from pkm_twin.recordings import read_table

    columns = read_table(path, dialect=given.dialect)
    columns.require(["iq_up_A", "iq_down_A"])
    if "torque_nm" in columns:
        torque = columns["torque_nm"]
    elif "mass_kg" in columns:
        if given.lever is None:
            raise ParameterError("--lever", None, "m per rad, above 0, for a column mass_kg")
        torque = GRAVITY * given.lever * columns["mass_kg"]
    else:
        raise ParameterError(str(path), ", ".join(columns), "a column 'mass_kg' or 'torque_nm'")
    return drive_report(
        drive_friction(
            torque, columns["iq_up_A"], columns["iq_down_A"], columns.get("speed"),
            columns.get("drive"),
        )
    )  # fmt: skip


COMMAND = command(fit, "Identification and calibration")
