# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin fit``: a robot's file from recordings of its motion, efforts or deflections."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import ROBOT_HELP, AcceptOption, BeyondLimitsOption, RecordingOptions, TimedPayloadOptions
from pkm_twin.console import convert_write_errors, draw_progress
from pkm_twin.errors import ParameterError
from pkm_twin.files import replace_file
from pkm_twin.report import Fact, Report
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from pkm_twin.identification.fit import Result
    from pkm_twin.identification.friction_laws import Choice
    from pkm_twin.identification.identifiable import Kind


@dataclass(frozen=True, kw_only=True)
class Fit(TimedPayloadOptions, RecordingOptions, BeyondLimitsOption, AcceptOption):
    """Fit friction, masses or compliance to recordings.

    Fits friction, rotors, payload and masses to recorded efforts, or compliance to measured
    deflections. Positions and efforts are enough: velocities and accelerations are differentiated
    without delay, and regressor and efforts pass the same filter. CSV columns: time (s);
    JOINT.position and JOINT.effort for every actuated joint; optionally the wrench fx fy fz mx my
    mz. The last third of each recording is held out for validation.

    The YAML is the robot's file with the fitted values, each with its standard deviation in a
    comment; nothing is written where these predict the part held out worse than the file's values.
    The command lists the parameters that the motion does not excite; they keep the file's
    value. A recording that this machine cannot have produced is rejected with the reason; --accept
    fits it nevertheless and marks the files. The verdict reports whether the model explains the
    recordings, what does not fit and which error is likely. If the model does not explain them,
    standard deviations are widened or withheld.

    If Coulomb and viscous friction leave a residual, `fit` tries the other friction
    laws and takes one that predicts the held-out part better; a line gives the evidence.
    `--friction coulomb` adds no law to the file's, `--friction LAW` adds a law in any case.

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
    law predicts left-out runs better. Each run is left out once. Several drives of one kind get
    one torque constant and friction; each drive is left out once, too.
    """

    robot: str = setting("", f"{ROBOT_HELP}: the values to start from", argument=True)
    recordings: tuple[Path, ...] = setting((), "bags, or CSV files with a header row", argument=True)
    what: str = setting(
        "friction,rotor,payload,inertia", "what to fit: some of friction,rotor,payload,inertia; or compliance"
    )
    out: Path | None = setting(
        None, "YAML to write, with a report .html; default: fitted.yaml", writes=True, endings=(".yaml", ".yml")
    )
    no_report: bool = setting(False, "write no report with pictures")
    per_copy: bool = setting(False, "fit each copy of a limb by itself")
    friction: str = setting(
        "auto", "further friction laws: auto, coulomb (none), or some of stribeck, load-dependent, periodic, dahl"
    )
    torque_constant: str | None = setting(
        None, "efforts are motor currents: N m or N per ampere at the joint, one or one per joint; `fit` identifies it"
    )
    drive: Path | None = setting(None, "fit one drive: CSV of traverses with weights")
    lever: float | None = setting(
        None,
        "with --drive, for mass_kg: travel per radian of the motor, m",
        name="spool-radius",
        older=("--lever",),
        low=1e-6,
        high=1e3,
    )
    overwrite: bool = setting(False, "replace the YAML and the report")

    @property
    def files(self) -> dict[str, Path | None]:
        """Files that the command writes, by key; None for no report, empty if nothing is fitted."""
        if self.drive is not None or not self.robot or not self.recordings:
            return {}
        out = self.out or Path("fitted.yaml")
        return {"out": out, "report": None if self.no_report else out.with_suffix(".html")}

    def parse_options(self) -> tuple[tuple[Kind, ...] | None, tuple[str, ...] | None]:
        """Return the kinds of parameters (None: compliances) and the friction laws (None: automatic).

        :raises ParameterError: unknown words, or options that do not go together.
        """
        from pkm_twin.identification.friction_laws import parse_laws
        from pkm_twin.identification.parameters import COMPLIANCE, parse_kinds

        laws, _ = parse_laws(self.friction), self.load
        if COMPLIANCE not in [word.strip() for word in self.what.split(",")]:
            return parse_kinds(self.what), laws
        if self.per_copy or self.payload is not None or self.load_times is not None:
            rest = "no --per-copy, --payload or --load-times, which are for efforts"
            raise ParameterError("--what", self.what, rest)
        if self.what.strip() != COMPLIANCE:
            rest = "only compliance, because it is fitted to other recordings"
            raise ParameterError("--what", self.what, rest)
        return None, laws

    def check_options(self) -> None:
        """Raise the error of wrong options, then that of the robot."""
        self.parse_options()
        super().check_options()


@command("Identification and calibration")
def fit(given: Fit) -> Report:
    """Identify the robot's parameters from recordings, and write the files.

    :raises PkmTwinError: recordings that show nothing, or that the machine cannot have made.
    """
    from pkm_twin import load
    from pkm_twin.apps.fit_report import report_fit
    from pkm_twin.identification.deflections import fit_elements
    from pkm_twin.identification.fit import find_worse, refuse_faults
    from pkm_twin.identification.friction_laws import fit_recordings
    from pkm_twin.identification.parameters import fitted_yaml
    from pkm_twin.mechanisms.entries import load_with_text, write_edited
    from pkm_twin.report.page import page
    from pkm_twin.streams.steps import find_sampling

    if given.drive is not None:
        # Fit a drive's torque constant and friction to weights that it lifts.
        from pkm_twin.apps.fit_report import report_drive
        from pkm_twin.identification.drives import drive_friction, list_runs
        from pkm_twin.recordings import read_table

        runs = list_runs(read_table(given.drive, dialect=given.dialect), given.lever)
        return report_drive(drive_friction(*runs))
    if not given.robot or not given.recordings:
        raise click.UsageError("a robot and recordings are missing; give both, or --drive TABLE")
    (kinds, laws), options = given.parse_options(), {"accept": given.accept}
    text, machine = load_with_text(given.robot, per_copy=given.per_copy, **given.part)
    elastic, currents = kinds is None, given.torque_constant is not None
    if elastic:
        _ = machine.elastic
    with draw_progress("fit", len(given.recordings)) as update:
        read = [given.read(path, machine, deflected=elastic, currents=currents) for path in given.recordings]
        beyond = [
            f"beyond limits: {r.name}: {item}"
            for r in read
            for item in given.list_beyond_limits(machine, r.q, where=r.name)
        ]
        result: Result
        choices: Sequence[Choice] = ()
        marks: list[str] = []
        if kinds is None:
            result = fit_elements(machine, read, progress=update, **options)
        else:
            result, choices, marks = fit_recordings(
                machine, read, kinds, laws, constant=given.torque_constant, progress=update, **options
            )
    worse = find_worse(result)
    refuse_faults([worse] if worse else [], given.accept)
    told = [note if len(read) == 1 else f"{r.name}: {note}" for r in read for note in r.notes]
    accepted = [f"accepted by --accept: {line}" for line in (*result.accepted, worse) if line]
    marks = [*map(str, choices), *accepted, *marks, *beyond, *told]
    report, more = report_fit(result, marks)
    facts = [
        Fact("beyond_limits", beyond),
        Fact("friction_laws", [dataclasses.asdict(choice) for choice in choices]),
        Fact("missing_samples", [find_sampling(r.time).missing for r in read]),
        Fact("topics", [dataclasses.asdict(r.topics) for r in read]),
    ]
    names, (out, html) = [r.name for r in read], given.files.values()
    assert out is not None  # noqa: S101
    fitted = fitted_yaml(text, result.numbers, names)
    head = [
        *marks,
        f"{report.answer}.",
        f"Fitted from {', '.join(names)}.",
        *(f"{note}." for note in report.notes[len(marks) :]),
    ]
    head += [
        f"Residual rms held out of {name}: {before:.3g} before, {after:.3g} now, {unit}."
        for name, (before, after, _, unit) in report.tables[-1].rows.items()
    ]
    with convert_write_errors(out):
        before = load(given.robot) if given.per_copy else machine
        lost = write_edited(out, head, fitted, before)
        report = dataclasses.replace(report, notes=[*report.notes, *lost])
        if html is not None:
            title = f"{result.robot.name}: fitted from {', '.join(names)}"
            replace_file(html, page(title, report, more).encode())
    return dataclasses.replace(report, facts=[*report.facts, *facts], files=given.files)
