# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin size``: what drives must give for a recorded or planned motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
import numpy as np

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import MotionOptions, PictureOptions, SingularityOption, TimedPayloadOptions, payload_fact
from pkm_twin.errors import MIN_LIMIT, ParameterError, check_limit
from pkm_twin.report import Column, Fact, Report, Table, plots
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pkm_twin.paths.along import EffortComparison
    from pkm_twin.paths.sizing import DriveDuty, Fit, Gear, Gears
    from pkm_twin.robot.robot import Robot

MAX_PERCENT: Final = 1000.0
"""Percentage of a motor's limit above which only `over 1000 %` is printed."""


@dataclass(frozen=True, kw_only=True)
class Size(TimedPayloadOptions, MotionOptions, SingularityOption, PictureOptions):
    """Size the drives for a motion.

    Prints for each drive: peak and RMS effort (RMS heats the motor), speed, power, net energy
    (supplied minus regenerated), and the machine's inertia at the joint. If the robot's file has a
    section drive (inertia, ratio or lead, efficiency), or with --ratio or --lead, it prints the
    same at the motor, and the inertia ratio. The shipped robots have no gear in their files.

    --drives compares each motor of a file with the needs of each drive, in percent of what the
    motor can do: peak torque against its torque curve, RMS torque against its continuous torque,
    and speed. The inertia ratio is that of load to rotor. The motor's rotor replaces the one in the
    robot's file. With --ratios, --leads, or gears in the drives file, each motor gets the
    gear that leaves the most margin. The last lines name the smallest motor for all drives, with
    one gear, and for each.

    The motion is a table of `pkm-twin path` or `pkm-twin torques`, a recording of joint states, or
    a bag with a JointTrajectory.
    """

    motion: Path | None = setting(None, "a recording or a path: MCAP, rosbag2 folder or table", argument=True)
    drives: Path | None = setting(None, "YAML of motors to compare, or `shipped`")
    motor: tuple[str, ...] = setting((), "compare only this motor; may be repeated")
    ratio: float | None = setting(None, "gear ratio of turning joints without a drive in the file", low=1e-6, high=1e6)
    lead: float | None = setting(
        None, "lead of sliding joints without a drive in the file, m per turn of the motor", low=1e-6, high=1e6
    )
    ratios: str | None = setting(None, "gear ratios to choose from: LOW:HIGH, or numbers with commas")
    leads: str | None = setting(None, "leads to choose from, likewise")
    efficiency: float | None = setting(
        None, "efficiency of the gears; default: the robot file's, or 1", low=1e-3, high=1.0
    )
    over_workspace: tuple[float, ...] | None = setting(
        None,
        "in place of a motion: speed and acceleration of the tool point (m/s, m/s2) in the worst direction and pose",
        count=2,
        metavar="SPEED,ACCELERATION",
    )
    lever: float = setting(
        0.3,
        "leaves out poses whose ratio of tool to joint speed is below this fraction of the largest",
        low=0.0,
        high=1.0,
    )
    efforts: str | None = setting(
        None,
        "efforts to use; default: the file's, with --payload the model's unless the file's agree",
        choices=("file", "model"),
    )


@command("Torques, paths and drives")
def size(given: Size) -> Report:
    """Compute the duty of each drive, and the motors that suffice."""
    from pkm_twin.paths.along import EFFORT_TOLERANCE, compare_efforts, zero_resting_motion
    from pkm_twin.paths.sizing import compute_net_energy, find_smallest, read_motors, size_drives

    if (given.motion is None) == (given.over_workspace is None):
        raise click.UsageError("give a recording or path, or --over-workspace")
    searched = given.ratios is not None or given.leads is not None
    geared = searched or given.ratio is not None or given.lead is not None
    if given.drives is None and (given.motor or searched):
        raise click.UsageError("--motor, --ratios and --leads need a drives file; give --drives")
    if searched and (given.ratio is not None or given.lead is not None):
        raise click.UsageError("--ratio and --lead give one gear; leave out --ratios and --leads")
    if given.over_workspace is not None and (geared or given.drives is not None):
        raise click.UsageError("--over-workspace reports joints; leave out --drives, --ratio and --lead")
    if given.motion is None:
        return report_workspace(given)
    motors = {} if given.drives is None else read_motors(given.drives, given.motor)
    motion = zero_resting_motion(given.read(given.motion, given.machine(), planned=True).with_rates())
    taken = compare_efforts(motion)
    if given.payload is None:
        taken = taken.check_source()
    motion, notes = taken.motion, list(taken.motion.notes)
    replaced = given.efforts is None and given.payload is not None
    replaced = replaced and (bool(taken.mismatch_warning) or motion.efforts != "measured")
    if replaced and taken.difference.max() > EFFORT_TOLERANCE:
        notes.append(
            f"the file's efforts are not those of {motion.load}: the model's are used; --efforts file uses the file's"
        )
    if replaced or given.efforts == "model":
        taken = replace(taken, effort=taken.model, source="the model's")
    duties = size_drives(motion, taken.effort, motors, *read_gear_options(given, motion.robot))
    duration = float(motion.time[-1] - motion.time[0])
    energy = sum(d.at_joint.energy for d in duties)
    returned = sum(d.at_joint.returned for d in duties)
    net = compute_net_energy([d.at_joint for d in duties])
    worst = max(duties, key=lambda d: (d.slides == duties[0].slides, d.at_joint.peak))
    unit = "N" if worst.slides else "N m"
    answer = (
        f"{motion.robot.name}: largest effort {worst.at_joint.peak:.4g} {unit} on {worst.joint}, "
        f"RMS {worst.at_joint.rms:.4g} {unit}; net energy of all drives {net:.4g} J"
    )
    at_motors = [d.at_motor for d in duties if d.at_motor is not None]
    motors_energy = compute_net_energy(at_motors) if len(at_motors) == len(duties) else None
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
        Fact("energy_J", energy),
        Fact("motors_energy_J", motors_energy),
        Fact("regenerated_J", returned, "J", "regenerated energy"),
        Fact("mean_power_W", net / duration, "W", "mean power"),
    ]
    title = answer
    if effort_warning := motion.effort_warning or taken.mismatch_warning:
        answer += f"; {effort_warning}"
        answer += "; --efforts model uses the model's" if taken.mismatch_warning else ""
    if motors:
        none = f"none of {len(duties[0].fits)}"
        alike = find_smallest([duty.alike for duty in duties])
        shared = [] if alike is None else [duty.alike[alike] for duty in duties]
        each: dict[str, Fit | None] = {}
        for duty in duties:
            k = find_smallest([duty.fits])
            each[duty.joint] = None if k is None else duty.fits[k]
        for_all = dict(zip(each, [fit.choice for fit in shared], strict=True)) if shared else None
        facts += [
            Fact("smallest_motor", shared[0].name if shared else None),
            Fact("smallest_for_all", for_all),
            Fact("smallest_for_each", {name: fit and fit.choice for name, fit in each.items()}),
        ]
        best = f"smallest motor for all drives: {' and '.join(dict.fromkeys(map(str, shared))) or none}"
        own = ", ".join(f"{name} {fit or none}" for name, fit in each.items())
        notes += [best, f"smallest for each drive: {own}"]
        title = f"{title}; {best}"
    return Report(answer, facts, _tabulate_drive_duties(duties), {"": lambda: draw(taken, duties, title)}, notes)


def read_gear_options(given: Size, robot: Robot) -> tuple[list[Gear], list[Gears]]:
    """Return the gears of the joints, and those to choose from.

    :raises ParameterError: a ratio, inertia or efficiency is out of range.
    """
    from pkm_twin.machine.sections import MAX_LEAD
    from pkm_twin.paths.sizing import Gear, Gears, read_gears

    if given.lead is not None and given.lead > MAX_LEAD:
        raise ParameterError("--lead", given.lead, f"at most {MAX_LEAD:g} m per turn")
    shares = {drive.efficiency for drive in robot.drives if drive is not None}
    if given.efficiency is None and len(shares) > 1 and (given.ratios or given.leads):
        raise click.UsageError("drives of the file have several efficiencies; give --efficiency")
    share = given.efficiency or next(iter(shares), 1.0)
    one, choices = [], []
    for key, value, values in (("ratio", given.ratio, given.ratios), ("lead", given.lead, given.leads)):
        if value is not None:
            one.append(Gear(efficiency=share).with_size(key, value))
        if values is not None:
            choices.append(Gears.parse(key, values, share))
    if not (one or choices) and given.drives is not None:
        listed = read_gears(given.drives)
        for slides in (False, True):
            if some := tuple(gear for gear in listed if (gear.lead is not None) == slides):
                choices.append(Gears(some))
    return one, choices


def _tabulate_drive_duties(duties: Sequence[DriveDuty]) -> list[Table]:
    """Return the duties of rotary and sliding joints and of motors, and the use of each motor."""
    from pkm_twin.paths.sizing import compute_net_energy

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
                duty.peak,
                duty.rms,
                duty.speed,
                duty.mean_speed,
                duty.power,
                duty.braking,
                compute_net_energy([duty]),
                duty.returned,
                span if side == "joint" else d.inertia_ratio or "",
            ]
        force, rate, mass = ("N", "m/s", "kg") if slides else ("N m", "rad/s", "kg m2")
        last = Column("", mass, "load inertia") if side == "joint" else Column("", "", "load/rotor")
        columns = [
            Column("", force, "effort |peak|"),
            Column("", force, "RMS"),
            Column("", rate, "speed |peak|"),
            Column("", rate, "mean"),
            Column("", "W", "power peak"),
            Column("", "W", "regenerated peak"),
            Column("", "J", "net energy"),
            Column("", "J", "regenerated"),
            last,
        ]
        if rows:
            tables.append(Table("", columns, rows, head=side))
    for d in duties:
        fits = sorted(d.fits, key=lambda fit: (not fit.good, fit.motor.continuous_torque))
        columns = [Column("", "", name) for name in ("", "peak torque", "RMS torque", "speed")]
        columns.append(Column("", "", "inertia ratio", form=".3g"))
        rows = {
            fit.name: [
                fit.answer,
                "-" if fit.speed > 1.0 else _format_percent(fit.torque),
                _format_percent(fit.thermal),
                _format_percent(fit.speed),
                fit.inertia_ratio,
            ]
            for fit in fits
        }
        more: dict[str, list[Any]] = {
            "gear": [str(fit.gear) for fit in fits] if len({fit.gear for fit in fits}) > 1 else [],
            "cost": [fit.cost for fit in fits] if any(fit.cost is not None for fit in fits) else [],
        }
        for name, values in more.items():
            columns += [Column("", "", name)] * bool(values)
            for fit, value in zip(fits, values, strict=False):
                rows[fit.name].append(value)
        if fits:
            tables.append(Table("", columns, rows, f"used of each motor by {d.joint}:", "motor"))
    return tables


def _format_percent(part: float) -> str:
    value = 100.0 * part
    return f"{value:.4g} %" if value <= MAX_PERCENT else f"over {MAX_PERCENT:.0f} %"


def report_workspace(given: Size) -> Report:
    """Compute the largest efforts and speeds over the workspace."""
    from pkm_twin.paths.joint_path import only_turns
    from pkm_twin.paths.worst import worst_over_workspace

    speed, change = given.over_workspace or (0.0, 0.0)
    for value in (speed, change):
        # One of speed and acceleration may be 0: the search then covers the other only.
        check_limit("over-workspace", value or MIN_LIMIT)
    robot, held = given.machine(), given.load
    robot = robot if held is None else held.apply_to(robot)
    worst = worst_over_workspace(robot, speed, change, singularity=given.singularity, lever=given.lever)
    names = robot.pose_names
    turns = only_turns(robot)
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
            at = (pose.round(9) + 0.0).tolist()  # Zeros have no rounding error and no sign.
            where = ", ".join(f"{n} {v:.4g}" for n, v in zip(names, at, strict=True))
            words = unit.replace("_m", " m").replace("m_s", "m/s").replace("rad_s", "rad/s")
            rows[f"{joint} {what.replace('_', ' ')}"] = [float(value), words, where]
    k = int(worst.effort.argmax())
    answer = (
        f"{robot.name}: {robot.joint_names[k]} needs up to {worst.effort[k]:.4g} "
        f"{robot.effort_units[k]} where the "
        + (
            "platform turns at {:g} rad/s and {:g} rad/s2" if turns else "tool point moves at {:g} m/s and {:g} m/s2"
        ).format(speed, change)
    )
    pose = f"pose ({', '.join(dict.fromkeys(robot.pose_units))})"
    columns = [Column("", "", text) for text in ("largest", " ", pose)]
    return Report(
        answer,
        [
            Fact("robot", robot.name),
            Fact("speed_rad_s" if turns else "speed_m_s", speed),
            Fact("acceleration_rad_s2" if turns else "acceleration_m_s2", change),
            Fact("least_singularity", given.singularity),
            Fact("least_lever", given.lever),
            Fact(
                "poses",
                worst.poses,
                text="poses of the workspace",
                shown=(
                    f"{worst.poses}, singularity index {given.singularity:g} or more, levers {given.lever:g} or more"
                ),
            ),
            Fact("drives", data),
        ],
        [Table("", columns, rows, head="joint")],
    )


def select_motors(duty: DriveDuty) -> list[Fit]:
    """Return the motors to draw: the smallest that fits, or the largest, and the three below it."""
    fits = sorted(duty.fits, key=lambda fit: fit.motor.continuous_torque)
    first = next((k for k, fit in enumerate(fits) if fit.good), len(fits) - 1)
    return fits[max(first - 3, 0) : first + 1]


def draw(taken: EffortComparison, duties: Sequence[DriveDuty], answer: str) -> Figure:
    """Draw torque over speed, one axes per drive, with the curves of motors or the file's limits."""
    from pkm_twin.paths.sizing import RPM

    shown = duties[:4]
    figure, axes = plots.make_subplots(1, len(shown))
    m = taken.motion
    for k, (ax, d) in enumerate(zip(axes[0], shown, strict=True)):
        chosen = select_motors(d)[-1] if d.fits else d
        if chosen.torques is not None and chosen.speeds is not None:
            speeds, torques, words = chosen.speeds / RPM, chosen.torques, "motor"
            labels = "speed of the motor (1/min)", "torque (N m)"
        else:
            speeds, torques = m.motion[1][:, k], taken.effort[:, k]
            unit = m.robot.joint_units[k]
            labels = f"speed of the joint ({unit}/s)", f"effort ({m.robot.effort_units[k]})"
            own, used = m.robot.limits, []
            for what, limits, draw, values in (
                ("speed", own.velocity, ax.axvline, speeds),
                ("effort", own.effort, ax.axhline, torques),
            ):
                if limits is not None and np.isfinite(limits[k]):
                    used.append(f"{_format_percent(np.abs(values).max() / limits[k])} of {what}")
                    for sign in (1.0, -1.0):
                        draw(sign * limits[k], color="0.5", ls="--", lw=1)
            words = f"uses {', '.join(used)} (dashed: limits of the file)" if used else "no limits"
        ax.plot(speeds, torques, color="black", lw=1.5, label="motion")
        most = float(np.abs(torques).max())
        for colour, fit in zip(plots.COLOURS, select_motors(d), strict=False):
            speed, torque = fit.motor.limits
            most = max(most, float(torque.max()))
            for sign in (1.0, -1.0):
                for way in (1.0, -1.0):
                    label = fit.name if sign == way == 1.0 else None
                    ax.plot(way * speed / RPM, sign * torque, color=colour, lw=1, label=label)
        if d.fits:
            fit = select_motors(d)[-1]
            for sign in (1.0, -1.0):
                level = sign * fit.motor.continuous_torque
                ax.axhline(level, color="0.5", ls="--", lw=1, label="continuous" if sign > 0 else None)
            parts = tuple(map(_format_percent, (fit.torque, fit.thermal, fit.speed)))
            words = f"{fit} {'' if fit.good else 'is '}{fit.answer}: torque {{}}, RMS torque {{}}, speed {{}}".format(
                *parts
            )
            fastest = 1.3 * float(np.abs(speeds).max())
            ax.set(xlim=(-fastest, fastest), ylim=(-1.1 * most, 1.1 * most))
        plots.label(ax, *labels, f"{d.joint}: {words}")
        plots.legend(ax)
    plots.write_title(figure, answer)
    return figure
