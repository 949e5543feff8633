# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin calibrate``: a machine's geometry from measurements of its platform."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any, Final

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import AcceptOption, BeyondLimitsOption, OverwriteOption, RobotArgument, TableOptions
from pkm_twin.console import draw_progress
from pkm_twin.errors import ParameterError, one_line
from pkm_twin.files import replace_file
from pkm_twin.identification.calibration import Calibration, Estimate, list_geometric_paths
from pkm_twin.identification.calibration import calibrate as calibrated
from pkm_twin.identification.calibration_fit import MAX_STEPS
from pkm_twin.identification.calibration_state import Transmission
from pkm_twin.identification.measurements import (
    MEASUREMENT_KINDS,
    Kind,
    Measured,
    parse_kinds,
    parse_noise,
    read_measured,
    read_poses,
)
from pkm_twin.identification.plan import MAX_MEASUREMENTS, Plan, parse_within
from pkm_twin.identification.plan import plan as plan_of
from pkm_twin.mechanisms.entries import edit_robot_text, write_edited
from pkm_twin.report import Column, Fact, Report, Table
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from pkm_twin.robot.robot import Robot

WIDTH: Final = 100
"""Characters of a printed line."""
MAX_PRINTED_OUTLIERS: Final = 10
"""Largest number of outliers that are printed."""


@dataclass(frozen=True, kw_only=True)
class Calibrate(RobotArgument, TableOptions, BeyondLimitsOption, AcceptOption, OverwriteOption):
    """Fit a robot's geometry and joint offsets to poses that an instrument measured.

    A robust least-squares fit with the machine's closures. A pose that does not fit the others gets
    a small weight, and the report names its line. Combinations of numbers that the poses do not
    determine are listed and keep the file's value; a single number of one can still change. The fit
    does not use every fourth pose: the error there, before and after, is the calibration's
    accuracy.

    Poses that this machine cannot reach are rejected with the reason, and without --frame so are
    poses that are not in base axes. --accept calibrates anyway and marks the file.

    With --measure, parts of the poses are enough, and cells may be empty. Each measurement is then
    compared with the fit to all others, and the report says whether the scale is determined.
    --plan chooses the most informative poses.
    """

    poses: Path | None = setting(
        None,
        "CSV of JOINT.position, x y z (m), perhaps roll pitch yaw (rad) or qx qy qz qw; or as --measure names",
        argument=True,
    )
    out: Path | None = setting(
        None, "the calibrated robot, a YAML; default: calibrated.yaml", writes=True, endings=(".yaml", ".yml")
    )
    only: tuple[str, ...] = setting((), "fit only numbers whose path begins so; may be repeated")
    no_offsets: bool = setting(False, "do not fit joint offsets")
    frame: bool = setting(False, "also fit the instrument's pose")
    target: bool = setting(False, "also fit the target's position on the platform")
    prior: float = setting(0.01, "standard deviation of lengths before the fit, m", low=1e-6, high=1.0)
    transmission: Transmission = setting(
        Transmission.AUTO,
        "ratios of joint_map to fit: each; shared: one factor; travel: each and its change over "
        "travel; file: none; auto: those of sliding joints that are not 1",
        choices={str(how): how for how in Transmission},
    )
    measure: tuple[str, ...] = setting(
        (),
        "what was measured, if not poses: height, distance, radius, range, plane, tilt, or some of "
        "x, y, z, roll, pitch, yaw",
    )
    noise: tuple[str, ...] = setting((), "KIND=VALUE: known standard deviation of a measurement, m or rad")
    plan: Path | None = setting(
        None, "only write the poses to measure next, a CSV, with predicted accuracy", writes=True, endings=(".csv",)
    )
    count: int | None = setting(None, "poses of a plan", low=1, high=MAX_MEASUREMENTS)
    accuracy: float | None = setting(None, "standard deviation of the position that ends a plan, m", low=1e-9)
    within: str | None = setting(None, "where a plan measures: x=-0.1:0.1,z=0 (m, rad); default: everywhere")

    @property
    def files(self) -> dict[str, Path]:
        """Files that a calibration writes, by key; none for a plan, which names its own file."""
        read = self.plan is None and self.poses is not None
        return {"out": self.out or Path("calibrated.yaml")} if read else {}

    def parse_options(self) -> tuple[tuple[Kind, ...], dict[str, float], dict[str, tuple[float, float]]]:
        """Return the kinds of measurements, their known noise, and the bounds of a plan's poses.

        :raises ParameterError: other words, or the noise of what is not measured.
        """
        kinds = parse_kinds(self.measure or (["position"] if self.plan else []))
        noise = parse_noise(self.noise)
        for name in noise.keys() - {kind.name for kind in kinds}:
            measured = ", ".join(kind.name for kind in kinds) or "none: whole poses have their own"
            raise ParameterError("--noise", name, f"a kind that --measure names ({measured})")
        return kinds, noise, parse_within(self.within)

    def check_options(self) -> None:
        """Raise the error of wrong options, then that of the robot."""
        self.parse_options()
        super().check_options()

    @property
    def fit_options(self) -> dict[str, Any]:
        """Keyword arguments of the fit: offsets and frames to fit, noise, and prior."""
        return {
            "offsets": not self.no_offsets,
            "frame": self.frame,
            "target": self.target,
            "prior": self.prior,
            "transmission": self.transmission,
            "only": self.only,
        }


@command("Identification and calibration")
def calibrate(given: Calibrate) -> Report:
    """Calibrate a robot's numbers, or plan the poses to measure.

    :raises ParameterError: poses of another machine, or too few; see
        :func:`pkm_twin.identification.calibration.calibrate`.
    """
    kinds, known_noise, within = given.parse_options()
    machine, measured = given.machine(), None
    if given.poses is not None:
        read = partial(read_measured, kinds=kinds, noise=known_noise) if kinds else read_poses
        measured = read(given.poses, machine, dialect=given.dialect)
    notes = []
    if measured is not None:
        q = machine.controller.positions(measured.joints)
        notes = [f"beyond limits: {item}" for item in given.list_beyond_limits(machine, q)]
    if given.plan is not None:
        known_measurements = measured if isinstance(measured, Measured) else None
        chosen = plan_of(
            machine,
            kinds,
            measured=known_measurements,
            within=within,
            count=given.count,
            accuracy=given.accuracy,
            noise=known_noise,
            **given.fit_options,
        )
        replace_file(given.plan, chosen.table(machine).encode())
        return report_plan(machine, chosen, given.accuracy, given.plan)
    if given.poses is None or measured is None:
        raise ParameterError("poses", None, "a CSV of measured poses, or --plan FILE.csv")
    paths = list_geometric_paths(machine, q, given.only)
    with draw_progress("steps", 2 * MAX_STEPS) as update:
        done = 0

        def add_steps(count: int) -> None:
            nonlocal done
            done += count
            update(done)

        result = calibrated(machine, measured, paths, accept=given.accept, progress=add_steps, **given.fit_options)
    source = f"calibrated with {one_line(given.poses.name, 100)}"
    marks = [*(f"accepted anyway: {fault}" for fault in result.faults), *notes]
    head = [f"{machine.name}, {source}: {len(measured.joints)} poses."]
    head += [f"Measured: {', '.join(f'{a.count} {a.name}' for a in result.agreements)}."]
    head += [f"{result.scale}."] if result.scale is not None else []
    head += [f"Outlier, with a small weight: {one}." for one in result.outliers]
    out = given.files["out"]
    text = edit_robot_text(machine, given.robot, result.fitted(machine, source))
    marks += write_edited(out, [*head, *marks], text, machine)
    return report_calibration(machine, source, result, notes, marks, out)


def report_calibration(
    machine: Robot, source: str, result: Calibration, notes: Sequence[str], marks: Sequence[str], out: Path | None
) -> Report:
    """Report the parameters, the errors by kind of measurement, and the undetermined changes."""
    first, scale = result.agreements[0], result.scale
    whole = {a.unit: a for a in result.agreements if a.name in ("position", "rotation")}
    before, after = (f"{1e3 * one.rms:.4f} m{first.unit}" for one in first.held_out)
    outliers = [
        {
            "row": one.line - 1,
            "line": one.line,
            "kind": one.worst.kind,
            "size": one.worst.size,
            "sigmas": one.worst.sigmas,
            "distance_m": one.size("m"),
            "distance_rad": one.size("rad"),
        }
        for one in result.outliers
    ]
    facts = [
        Fact("robot", machine.name),
        Fact("condition", result.condition, text="condition number"),
        Fact("steps", result.steps),
        Fact("beyond_limits", notes),
        Fact("accepted", [str(fault) for fault in result.faults]),
        Fact("not_observed", result.unobserved),
        Fact("outliers", outliers),
        Fact(
            "scale",
            None
            if scale is None
            else {
                "relative_deviation_before": scale.before,
                "relative_deviation": scale.after,
                "determined": scale.determined,
                "distance_deviation": scale.distance,
                "angle_deviation_rad": scale.angle,
            },
        ),
    ]
    for unit in ("m", "rad") if whole else ():
        facts.append(Fact(f"noise_{unit}", whole[unit].noise if unit in whole else None, unit))
    for name in ("fitted", "held_out") if whole else ():
        pairs = {unit: getattr(a, name) for unit, a in whole.items()}
        errors = {
            when: {f"{key}_{unit}": value for unit, pair in pairs.items() for key, value in pair[k]._asdict().items()}
            for k, when in enumerate(("before", "after"))
        }
        facts.append(Fact(name, errors))
    columns = [
        Column("before", form=".6g"),
        Column("value", text="after", form=".6g"),
        Column("standard_deviation", text="standard deviation", form=".2g"),
        Column("unit"),
        Column("observed", text="determined"),
    ]
    rows = {p.name: [p.before, p.value, p.deviation, p.unit, p.observed] for p in result.parameters}
    kinds = [Column("unit", text=None), Column("count")]
    kinds += [Column(name, text=None) for name in ("before", "after", "held_out", "noise")]
    shown = ("before", "after", "held out before", "held out after", "noise per axis", "unit")
    kinds += [Column("", text=name) for name in shown]
    agreements = {}
    for a in result.agreements:
        ends = (*a.fitted, *a.held_out)
        told = [f"{1e3 * one.rms:.4f} ({1e3 * one.worst:.4f})" for one in ends]
        stored = [ends[0]._asdict(), ends[1]._asdict(), ends[3]._asdict(), a.noise]
        last = f"{1e3 * a.noise:.4f}", f"m{a.unit}"
        agreements[a.name] = [a.unit, a.count, *stored, *told, *last]
    found = sum(p.observed for p in result.parameters)
    pairs = {}
    for one in result.pairs:
        p, other = result.parameters[one.first], result.parameters[one.second]
        name = f"{p.name} {'+' if one.sign > 0 else '-'} {other.name}"
        sums = p.before + one.sign * other.before, p.value + one.sign * other.value
        pairs[name] = [*sums, one.deviation, p.unit]
    lines = [] if scale is None else [fill(str(scale), WIDTH)]
    lines += [f"outlier, with a small weight: {one}" for one in result.outliers[:MAX_PRINTED_OUTLIERS]]
    if len(result.outliers) > MAX_PRINTED_OUTLIERS:
        lines.append(f"{len(result.outliers) - MAX_PRINTED_OUTLIERS} more outliers: see --json")
    return Report(
        f"{machine.name}, {source}: held-out {first.name} error {after} RMS "
        f"({before} before); {found} of {len(rows)} numbers determined",
        facts,
        [
            Table("parameters", columns, rows, "calibrated parameters"),
            *(
                [
                    Table(
                        "determined_pairs",
                        columns[:4],
                        pairs,
                        "sums and differences that are determined, of numbers that are not",
                    )
                ]
                if pairs
                else []
            ),
            Table(
                "measurements",
                kinds,
                agreements,
                "measured minus computed, RMS (worst); held out: "
                "every fourth whole pose, else each measurement against a fit to all others",
            ),
        ],
        notes=[*lines, *_list_undetermined(result), *marks],
        files={"out": out},
    )


def _list_undetermined(result: Estimate) -> list[str]:
    lines = [fill(line, WIDTH, initial_indent="  ", subsequent_indent="    ") for line in result.undetermined]
    told = "the poses do not determine these changes, and the calibration makes none of them; a "
    return [f"{told}number in one may still change with others:", *lines] if lines else []


def report_plan(robot: Robot, plan: Plan, accuracy: float | None, out: Path) -> Report:
    """Report the predicted standard deviations by the number of measurements of a plan."""
    last, needed = len(plan.position) - 1, None if accuracy is None else plan.needed(accuracy)
    known = f"{1e3 * plan.position[-1]:.3g} mm*"
    reached = f"the position is known to {known} after {last} measurements"
    if accuracy is not None:
        goal = f"{1e3 * accuracy:g} mm"
        reached = (
            f"{needed} measurements give the position to {goal}*"
            if needed is not None
            else f"the position is not known to {goal} after {last} measurements: it stays at {known}"
        )
    columns = [
        Column("", text="position*, worst axis", scale=1e3, shown="mm"),
        Column("", text="distances", scale=100.0, shown="mm per 100 mm"),
        Column("", text="angles between", scale=1e3, shown="mrad"),
        *(Column("", text=n, scale=1e3, shown=f"m{MEASUREMENT_KINDS[n].unit}") for n in plan.quantity),
    ]
    each = [
        plan.position.tolist(),
        plan.distance.tolist(),
        plan.angle.tolist(),
        *(v.tolist() for v in plan.quantity.values()),
    ]
    rows = {
        str(k): [values[k] for values in each]
        for k in sorted({*(k for k in (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128) if k < last), last})
    }
    title = "predicted standard deviations over the workspace, by number of measurements"
    names = [Column(n) for n in ("unit", "prior", "standard_deviation", "observed")]
    return Report(
        reached,
        [
            Fact("robot", robot.name),
            Fact("count", len(plan.joints)),
            Fact("needed", needed),
            Fact("position_deviation_m", plan.position, "m"),
            Fact("distance_deviation", plan.distance),
            Fact("angle_deviation_rad", plan.angle, "rad"),
            Fact("quantity_deviation", plan.quantity),
            Fact(
                "parameters",
                Table(
                    "", names, {p.name: [p.unit, p.prior, p.deviation, p.observed] for p in plan.known.parameters}
                ).data,
            ),
        ],
        [Table("", columns, rows, title, "measurements")],
        notes=["* apart from a rigid motion of the whole workspace", *_list_undetermined(plan.known)],
        files={"out": out},
    )
