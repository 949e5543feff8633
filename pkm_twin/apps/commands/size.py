# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin size``: what drives must give for a recorded or planned motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import typer

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import (
    AwayFromSingular,
    CarriesAtTimes,
    Draws,
    ReadsMotions,
    payload_fact,
)
from pkm_twin.errors import LEAST_LIMIT, check_limit
from pkm_twin.report import Column, Fact, Report, Table, plots
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from pkm_twin.paths.along import Compared
    from pkm_twin.paths.sizing import DriveDuty, Fit

MOST_PERCENT: Final = 1000.0
"""A used part of more is printed as more."""
SAME: Final = 1e-6
"""Relative difference of two computations of the same efforts."""
DRAWN: Final = 4
"""Most drives in a picture."""


@dataclass(frozen=True, kw_only=True)
class Size(CarriesAtTimes, ReadsMotions, AwayFromSingular, Draws):
    """Size the drives for a motion.

    Prints for each drive: peak and RMS effort (RMS heats the motor), speed, power, net energy
    (supplied minus regenerated), and the machine's inertia at the joint. If the robot's file has a
    section drive (inertia, ratio or lead, efficiency), or with --ratio or --lead, it prints the
    same at the motor, and the inertia ratio. The shipped robots have no gear in their files.

    --drives compares each motor of a file with the needs of each drive, in percent of what the
    motor can do: peak torque against its torque curve, RMS torque against its continuous torque,
    and speed. The inertia ratio is that of load to rotor. The motor's rotor replaces the one in the
    robot's file. The last line names the smallest motor that fits all drives.

    The motion is a table of `pkm-twin path` or `pkm-twin torques`, a recording of joint states, or
    a bag with a JointTrajectory.
    """

    motion: Path | None = setting(
        None, "a recording or a path: MCAP, rosbag2 folder or table", argument=True
    )
    drives: Path | None = setting(
        None, "YAML of motors to compare, or `shipped` for the motors in config/drives"
    )
    motor: tuple[str, ...] = setting(
        (), "compare only this motor of the drives file; may be repeated"
    )
    ratio: float | None = setting(
        None, "gear of the joints that turn, where the file has no drive: turns of the motor per "
        "turn of the joint", low=1e-6, high=1e6,
    )  # fmt: skip
    lead: float | None = setting(
        None, "screw or belt of the joints that slide, where the file has no drive: m per turn of "
        "the motor", low=1e-6, high=1e6,
    )  # fmt: skip
    efficiency: float = setting(1.0, "efficiency of --ratio and --lead", low=1e-3, high=1.0)
    over_workspace: tuple[float, ...] | None = setting(
        None, "in place of a motion: speed and acceleration of the tool point (m/s, m/s2), in the "
        "worst direction at the worst pose", count=2, metavar="SPEED,ACCELERATION",
    )  # fmt: skip
    efforts: str | None = setting(
        None, "efforts to use; default: the file's, with --payload only if measured and near the "
        "model's", choices=("file", "model"),
    )  # fmt: skip


def size(given: Size) -> Report:
    """What each drive must give, and which motors can."""
    from pkm_twin.paths.along import compared
    from pkm_twin.paths.sizing import Gear, read_motors, size_drives

    geared = given.ratio is not None or given.lead is not None
    if (given.motion is None) == (given.over_workspace is None):
        raise typer.BadParameter("give a recording or path, or --over-workspace")
    if given.motor and given.drives is None:
        raise typer.BadParameter("--motor selects from a drives file; give --drives too")
    if given.over_workspace is not None and (geared or given.drives is not None):
        raise typer.BadParameter(
            "--over-workspace reports joints; leave out --drives, --ratio and --lead"
        )
    if given.motion is None:
        return over_workspace(given)
    motors = {} if given.drives is None else read_motors(given.drives, given.motor)
    gear = Gear(given.ratio, given.lead, given.efficiency) if geared else None
    motion = given.read(given.motion, given.machine(), planned=True).with_rates()
    taken, notes = compared(motion, given.efforts or "file"), list(motion.notes)
    doubted = taken.unlike or motion.efforts != "measured"
    if given.payload is not None and given.efforts is None and doubted:
        if taken.difference.max() > SAME:
            notes.append(
                f"the file's efforts are not those of {motion.load}: the model's are used; "
                "--efforts file uses the file's"
            )
        taken = compared(motion, "model")
    duties = size_drives(motion, taken.effort, motors, gear)
    duration = float(motion.time[-1] - motion.time[0])
    energy = sum(d.at_joint.energy for d in duties)
    returned = sum(d.at_joint.returned for d in duties)
    net = round(energy, 9) + 0.0  # A cycle gives back all but rounding.
    worst = max(duties, key=lambda d: (d.slides == duties[0].slides, d.at_joint.peak))
    unit = "N" if worst.slides else "N m"
    answer = (
        f"{motion.robot.name}: largest effort {worst.at_joint.peak:.4g} {unit} on {worst.joint}, "
        f"RMS {worst.at_joint.rms:.4g} {unit}; net energy of all drives {net:.4g} J"
    )
    at_motors = [d.at_motor.energy for d in duties if d.at_motor is not None]
    motors_energy = sum(at_motors) if len(at_motors) == len(duties) else None
    if motors_energy is not None:
        answer += f" at the joints, {motors_energy:.4g} J at the motors"
    facts = [
        Fact("robot", motion.robot.name),
        Fact("samples", len(motion.time), text="samples"),
        Fact("duration_s", duration, "s", "duration"),
        Fact("efforts", taken.source, text="efforts"),
        payload_fact(motion.load),
        Fact("difference_from_model", taken.difference),
        Fact("drives", {d.joint: d.as_json() for d in duties}),
        Fact("energy_J", energy), Fact("motors_energy_J", motors_energy),
        Fact("regenerated_J", returned, "J", "regenerated energy"),
        Fact("mean_power_W", energy / duration, "W", "mean power"),
    ]  # fmt: skip
    title = answer
    if taken.unlike:
        notes.append(f"{taken.unlike}; --efforts model uses the model's")
    if motors:
        best = smallest(duties)
        facts.append(Fact("smallest_motor", best))
        notes.append(f"smallest motor for all drives: {best or f'none of {len(motors)}'}")
        title += f"; {notes[-1]}"
    return Report(
        answer, facts, _tables(duties), {"": lambda: draw(taken, duties, title)}, notes,
    )  # fmt: skip


def smallest(duties: Sequence[DriveDuty]) -> str | None:
    """The motor of the least continuous torque that fits all drives."""
    fitting = [{fit.name for fit in duty.fits if fit.good} for duty in duties]
    good = [fit for fit in duties[0].fits if all(fit.name in names for names in fitting)]
    best = min(good, key=lambda fit: fit.motor.continuous_torque, default=None)
    return None if best is None else best.name


def _tables(duties: Sequence[DriveDuty]) -> list[Table]:
    """Joints, motors and the comparisons, as the terminal shows them."""
    tables = []
    sides = [("joint", True), ("joint", False), ("motor", False)]
    for side, slides in sides:
        rows: dict[str, list[Any]] = {}
        for d in duties:
            duty = d.at_joint if side == "joint" else d.at_motor
            if duty is None or (side == "joint" and d.slides != slides):
                continue
            span = " to ".join(f"{v:.4g}" for v in d.load_inertia)
            rows[d.joint] = [
                duty.peak, duty.rms, duty.speed, duty.mean_speed, duty.power, duty.braking,
                duty.energy, duty.returned,
                span if side == "joint" else d.inertia_ratio or "",
            ]  # fmt: skip
        force, rate, mass = ("N", "m/s", "kg") if slides else ("N m", "rad/s", "kg m2")
        last = Column("", mass, "load inertia") if side == "joint" else Column("", "", "load/rotor")
        columns = [
            Column("", force, "effort peak"), Column("", force, "RMS"),
            Column("", rate, "speed peak"), Column("", rate, "mean"),
            Column("", "W", "power peak"), Column("", "W", "regenerated peak"),
            Column("", "J", "net energy"), Column("", "J", "regenerated"), last,
        ]  # fmt: skip
        if rows:
            tables.append(Table("", columns, rows, head=side))
    for d in duties:
        fits = sorted(d.fits, key=lambda fit: (not fit.good, fit.motor.continuous_torque))
        columns = [
            Column("", "", name) for name in ("", "peak torque", "RMS torque", "speed")
        ]  # fmt: skip
        columns.append(Column("", "", "inertia ratio", form=".3g"))
        rows = {
            fit.name: [
                fit.answer, "-" if fit.speed > 1.0 else _percent(fit.torque),
                _percent(fit.thermal), _percent(fit.speed), fit.inertia_ratio,
            ]
            for fit in fits
        }  # fmt: skip
        if fits:
            tables.append(Table("", columns, rows, f"used of each motor by {d.joint}:", "motor"))
    return tables


def _percent(part: float) -> str:
    value = 100.0 * part
    return f"{value:.4g} %" if value <= MOST_PERCENT else f"over {MOST_PERCENT:.0f} %"


def over_workspace(given: Size) -> Report:
    """The worst efforts and speeds over the workspace."""
    from pkm_twin.paths.worst import worst_over_workspace

    speed, change = given.over_workspace or (0.0, 0.0)
    for value in (speed, change):
        # The other alone may be asked for.
        check_limit("over-workspace", value or LEAST_LIMIT)
    robot, held = given.machine(), given.load
    robot = robot if held is None else held.on(robot)
    worst = worst_over_workspace(robot, speed, change, singularity=given.singularity)
    names = robot.pose_names
    data: dict[str, dict[str, Any]] = {}
    rows: dict[str, list[Any]] = {}
    for i, joint in enumerate(robot.joint_names):
        slides = robot.joint_units[i] == "m"
        force, rate = ("N", "m_s") if slides else ("N_m", "rad_s")
        entry = data.setdefault(joint, {})
        for what, unit, value, pose in (
            ("effort", force, worst.effort[i], worst.effort_pose[i]),
            ("holding_effort", force, worst.holding[i], worst.holding_pose[i]),
            ("speed", rate, worst.speed[i], worst.speed_pose[i]),
        ):
            entry[f"{what}_{unit}"] = float(value)
            entry[f"{what.split('_')[0]}_pose"] = dict(zip(names, pose.tolist(), strict=True))
            at = (pose.round(9) + 0.0).tolist()  # No rounding of a zero, nor its sign.
            where = ", ".join(f"{n} {v:.4g}" for n, v in zip(names, at, strict=True))
            words = unit.replace("_m", " m").replace("m_s", "m/s").replace("rad_s", "rad/s")
            rows[f"{joint} {what.replace('_', ' ')}"] = [float(value), words, where]
    k = int(worst.effort.argmax())
    answer = (
        f"{robot.name}: {robot.joint_names[k]} needs up to {worst.effort[k]:.4g} "
        f"{robot.effort_units[k]} where the tool point moves at {speed:g} m/s and {change:g} m/s2"
    )
    columns = [Column("", "", "largest"), Column("", "", " "), Column("", "", "pose (m, rad)")]
    return Report(
        answer,
        [
            Fact("robot", robot.name), Fact("speed_m_s", speed),
            Fact("acceleration_m_s2", change),
            Fact("poses", worst.poses, text="poses of the workspace"), Fact("drives", data),
        ],
        [Table("", columns, rows, head="joint")],
    )  # fmt: skip


def near(duty: DriveDuty) -> list[Fit]:
    """The motors to draw: the smallest that fits, or the largest, and the three below it."""
    fits = sorted(duty.fits, key=lambda fit: fit.motor.continuous_torque)
    first = next((k for k, fit in enumerate(fits) if fit.good), len(fits) - 1)
    return fits[max(first - 3, 0) : first + 1]


def draw(taken: Compared, duties: Sequence[DriveDuty], answer: str) -> Any:
    """Torque against speed, an axes for each drive, with the curves of motors or the limits."""
    from pkm_twin.paths.sizing import RPM

    shown = duties[:DRAWN]
    figure, axes = plots.columns(1, len(shown))
    m = taken.motion
    for k, (ax, d) in enumerate(zip(axes[0], shown, strict=True)):
        if d.torques is not None and d.speeds is not None:
            speeds, torques, words = d.speeds / RPM, d.torques, "motor"
            labels = "speed of the motor (1/min)", "torque (N m)"
        else:
            speeds, torques = m.motion[1][:, k], taken.effort[:, k]
            unit = m.robot.joint_units[k]
            labels = f"speed of the joint ({unit}/s)", f"effort ({m.robot.effort_units[k]})"
            own, dashed = m.robot.limits, {"color": "0.5", "ls": "--", "lw": 1}
            used = []
            for what, limits, draw, values in (
                ("speed", own.velocity, ax.axvline, speeds),
                ("effort", own.effort, ax.axhline, torques),
            ):
                if limits is not None and np.isfinite(limits[k]):
                    used.append(f"{_percent(np.abs(values).max() / limits[k])} of {what}")
                    for sign in (1.0, -1.0):
                        draw(sign * limits[k], **dashed)
            words = f"uses {', '.join(used)} (dashed: limits of the file)" if used else "no limits"
        ax.plot(speeds, torques, color="black", lw=1.5, label="motion")
        most = float(np.abs(torques).max())
        for colour, fit in zip(plots.COLOURS, near(d), strict=False):
            speed, torque = fit.motor.limits
            most = max(most, float(torque.max()))
            for sign in (1.0, -1.0):
                for way in (1.0, -1.0):
                    label = fit.name if sign == way == 1.0 else None
                    ax.plot(way * speed / RPM, sign * torque, color=colour, lw=1, label=label)
        if d.fits:
            fit = near(d)[-1]
            parts = tuple(map(_percent, (fit.torque, fit.thermal, fit.speed)))
            words = (
                f"{fit.name} {'' if fit.good else 'is '}{fit.answer}: "
                "torque {}, RMS torque {}, speed {}".format(*parts)
            )
            fastest = 1.3 * float(np.abs(speeds).max())
            ax.set(xlim=(-fastest, fastest), ylim=(-1.1 * most, 1.1 * most))
        plots.label(ax, *labels, f"{d.joint}: {words}")
        plots.legend(ax)
    plots.head(figure, answer)
    return figure


COMMAND = command(size, "Torques, paths and drives")
