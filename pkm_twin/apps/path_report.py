# SPDX-License-Identifier: Apache-2.0
"""What a planned path is written and shown as: table, trajectory, picture, text and JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pkm_twin.paths import Samples, ShapedPath, TimedPath
from pkm_twin.recordings import Load, write_table
from pkm_twin.recordings.payload import payload_columns

Array = NDArray[np.float64]

SHOWN = 0.3
"""Greatest used part of a limit from which on the picture has its line."""


def columns_of(motion: TimedPath, samples: Samples) -> dict[str, Array]:
    """Columns of the table: time, the joints' motion and efforts, the pose and its rates."""
    columns = {"time": samples.time}
    words = {"position": samples.q, "velocity": samples.qd, "acceleration": samples.qdd}
    if samples.effort is not None:
        words["effort"] = samples.effort
    for i, joint in enumerate(motion.robot.joint_names):
        for word, values in words.items():
            columns[f"{joint}.{word}"] = values[:, i]
    robot = motion.robot
    rate = (robot.jacobian(samples.q) @ samples.qd[..., None])[..., 0]
    change = robot.pose_acceleration(samples.q, samples.qd, samples.qdd)
    for word, values in (("", samples.pose), (".velocity", rate), (".acceleration", change)):
        for i, name in enumerate(robot.pose_names):
            columns.setdefault(f"{name}{word}", values[:, i])
    return columns


def write(
    motion: TimedPath, samples: Samples, carried: Load | None, out: Path, overwrite: bool
) -> None:
    """The motion as a table or as a bag with one JointTrajectory."""
    if out.suffix != ".mcap":
        write_table(columns_of(motion, samples) | payload_columns(carried, samples.time), out)
        return
    from pkm_twin.recordings.trajectories import write_trajectory

    facts: dict[str, Any] = {
        "robot": motion.robot.name, "source": "pkm-twin path", "law": motion.law,
    }  # fmt: skip
    if carried is not None:
        facts |= {
            "payload_mass_kg": carried.mass, "payload_picked_s": 0.0,
            "payload_released_s": motion.duration + 1.0,
        }  # fmt: skip
        if carried.com is not None:
            facts["payload_com_m"] = " ".join(map(repr, carried.com))
    own = (samples.q, samples.qd, samples.qdd)
    write_trajectory(out, motion.robot, samples.time, own, samples.effort, facts, overwrite)


def report(
    motion: TimedPath, carried: Load | None, out: Path | None, drawing: Path | None
) -> tuple[dict[str, Any], str]:
    """The result as plain data and as text."""
    robot, fine = motion.robot, motion.fine
    peaks = {}
    for i, joint in enumerate(robot.joint_names):
        unit, force = robot.joint_units[i], robot.effort_units[i]
        values = {
            "velocity": (np.abs(fine.qd[:, i]).max(), f"{unit}/s"),
            "acceleration": (np.abs(fine.qdd[:, i]).max(), f"{unit}/s2"),
        }
        if fine.effort is not None:
            values["effort"] = (np.abs(fine.effort[:, i]).max(), force)
        peaks[joint] = values
    stops = [round(begin, 9) for begin in motion.begins]
    data: dict[str, Any] = {
        "robot": robot.name, "path": motion.path.kind, "law": motion.law,
        "duration_s": motion.duration, "length_m": motion.path.length,
        "stretches": [
            {"begin_s": begin, "duration_s": run.duration, "length_m": stretch.length,
             "dwell_s": stretch.dwell}
            for begin, run, stretch in zip(
                stops, motion.runs, motion.path.stretches, strict=True
            )
        ],
        "payload": None if carried is None else carried.as_json(),
        "limits": [bound.as_json() for bound in motion.bounds],
        "used": motion.worst,
        "peaks": {
            joint: {word: {"value": float(v), "unit": unit} for word, (v, unit) in values.items()}
            for joint, values in peaks.items()
        },
        "greatest_speed_m_s": float(fine.speed.max()),
        "out": None if out is None else str(out),
        "picture": None if drawing is None else str(drawing),
    }  # fmt: skip
    note = ""
    if isinstance(motion, ShapedPath):
        low, high = motion.frequencies
        data["shaper"] = {
            "kind": motion.shaper, "added_s": motion.added, "lowest_hz": low, "highest_hz": high,
        }  # fmt: skip
        note = (
            f", of which the {motion.shaper} shaper for {low:.4g} to {high:.4g} Hz takes "
            f"{motion.added:.4g} s"
        )
    count = len(motion.runs)
    lines = [
        f"{robot.name}: {motion.path.kind}, {motion.path.length:.4g} m, "
        f"{count} segment{'' if count == 1 else 's'} from stop to stop, motion law {motion.law}",
        f"duration {motion.duration:.6g} s{note}; payload: {carried or 'as in the robot file'}",
        "limits that bind:",
    ]
    for bound in motion.bounds:
        what = bound.what or f"none (largest fraction of a limit: {100 * bound.used:.0f} %)"
        lines.append(f"  {bound.begin:8.4f} to {bound.end:8.4f} s  {what}")
    lines.append("peak values:")
    for joint, values in peaks.items():
        words = ", ".join(f"{word} {v:.4g} {unit}" for word, (v, unit) in values.items())
        lines.append(f"  {joint}: {words}")
    lines.append(f"  tool point: speed {fine.speed.max():.4g} m/s")
    worst = sorted(motion.worst.items(), key=lambda item: -item[1])
    shown = ", ".join(f"{name} {100 * value:.4g} %" for name, value in worst[:6])
    lines.append(f"largest fractions of the limits: {shown or 'no limits in the robot file'}")
    lines += [str(target) for target in (out, drawing) if target is not None]
    return data, "\n".join(lines)


def draw_limits(motion: TimedPath, path: Path) -> None:
    """Draw how much of each limit is used when, coloured by the one that binds."""
    from pkm_twin.paths.constraints import names_of
    from pkm_twin.report import plots

    figure, axes = plots.columns(1, 2)
    used, time = motion.used, motion.fine.time
    top, low = axes[0]
    names = names_of(motion.robot)
    shown = [i for i in np.argsort(-used.max(0)) if used[:, i].max() > SHOWN][:8]
    colours = {names[i]: plots.COLOURS[k] for k, i in enumerate(shown)}
    for i in shown:
        top.plot(time, 100 * used[:, i], color=colours[names[i]], lw=1.2, label=names[i])
    for bound in motion.bounds:
        colour = colours.get(bound.what)
        if colour is not None:
            for ax in (top, low):
                ax.axvspan(bound.begin, bound.end, color=colour, alpha=0.15, lw=0)
    title = f"{motion.robot.name}: which limit binds when ({motion.law}, {motion.duration:.4g} s)"
    plots.label(top, "time (s)", "fraction of the limit (%)", title)
    top.set_ylim(0, 105)
    if shown:
        top.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    low.plot(time, motion.fine.speed, color="black", lw=1.2)
    title = "speed of the tool point; colours are those of the limit that binds"
    plots.label(low, "time (s)", "speed (m/s)", title)
    low.set_ylim(bottom=0)
    plots.save(figure, path)
