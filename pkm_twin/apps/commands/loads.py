# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin loads``: forces and moments in the joints along a motion, cycles and bearing life."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import MotionOptions, OutputOption, PictureOptions, TimedPayloadOptions, payload_fact
from pkm_twin.console import convert_write_errors, draw_progress
from pkm_twin.files import replace_file
from pkm_twin.recordings.tables import WRENCH
from pkm_twin.report import Column, Fact, Report, Table, plots
from pkm_twin.report.report import ROUNDING
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pkm_twin.paths.joint_loads import Summary
    from pkm_twin.recordings import Recording


@dataclass(frozen=True, kw_only=True)
class Loads(TimedPayloadOptions, MotionOptions, OutputOption, PictureOptions):
    """Report forces and moments in the joints along a motion.

    For each joint it prints peak and RMS of force and moment, without what the drive bears: the
    moment about an actuated joint's axis, or the force along it. One cycle of the equivalent load
    range does the same damage as all cycles of the motion (rainflow counting, in axes that turn
    with the joint's inner body). With --bearings also equivalent load and L10 life (ISO 281; for
    sliding joints ISO 14728-1, C for 100 km).

    In an overconstrained machine the elasticity of members and joints determines what rigid-body
    equations do not. Without elasticity these components are reported as undetermined.
    """

    motion: Path = setting(..., "a recording or a path: MCAP, rosbag2 folder or table", argument=True)
    bearings: Path | None = setting(None, "YAML of bearings by joint: C (N), p, and X, Y")
    exponent: float = setting(5.0, "Wöhler exponent of the equivalent load range", low=1.0, high=50.0)
    out: Path | None = setting(None, "CSV of the loads over time", writes=True)
    spectrum: Path | None = setting(None, "CSV of the rainflow counts", writes=True)


@command("Torques, paths and drives")
def loads(given: Loads) -> Report:
    """Compute the loads of all joints; the answer names the largest."""
    from pkm_twin.paths.joint_loads import format_spectra, summarise_loads

    motion = given.read_motion(given.motion, given.machine())
    with draw_progress("loads", len(motion.time)) as update, convert_write_errors(given.out):
        found = summarise_loads(motion, given.bearings, given.out, update)
    if given.spectrum is not None:
        replace_file(given.spectrum, format_spectra(found).encode())
    robot, duration = motion.robot, float(motion.time[-1] - motion.time[0])
    joints = {load.name: describe_joint(load, given.exponent, duration) for load in found}
    worst = max(found, key=lambda load: load.peaks[2])
    answer = f"{robot.name}: no joint's force is determined"
    if worst.peaks[2] > 0.0:
        part = "" if all(load.known[2] for load in found) else " of what is determined"
        most = f"{'up to' if worst.known[2] else 'at least'} {worst.peaks[2]:.4g} N"
        answer = f"{robot.name}: {worst.name} bears most{part}, a force of {most}"
    open_ = any(one["undetermined"] for one in joints.values())
    idle = [n for n, j in joints.items() if j.get("life") and math.isnan(j["life"]["L10_hours"])]
    return Report(
        motion.with_effort_warning(answer),
        [
            Fact("robot", robot.name),
            Fact("samples", len(motion.time), text="samples"),
            Fact("duration_s", duration, "s", "duration"),
            payload_fact(motion.load),
            Fact("exponent", given.exponent),
            Fact("joints", joints),
        ],
        _tabulate_bearing_loads(joints),
        figures={"": lambda: draw(motion, found, answer)},
        notes=[
            *motion.notes,
            *(
                [
                    "undetermined: neither rigid-body equations nor elastic members or joints determine it; in a "
                    "planar linkage make one pin of a loop spherical and one cylindrical, or give compliances"
                ]
                if open_
                else []
            ),
            *([f"no life, because the bearing bears a load and does not move: {', '.join(idle)}"] if idle else []),
        ],
        files={"out": given.out, "spectrum": given.spectrum},
    )


def describe_joint(load: Summary, exponent: float, duration: float) -> dict[str, Any]:
    """Return the reported values of one joint, with units in the keys."""
    open_axes = [axis for axis, good in zip(WRENCH, load.determined, strict=True) if not good]
    entry: dict[str, Any] = {"undetermined": open_axes, "turned_rad": load.turned}
    entry |= {"travelled_m": load.travelled} if load.slides else {}
    kinds = ("force", "N"), ("moment", "N_m"), ("bearing_force", "N"), ("bearing_moment", "N_m")
    for k, (what, unit) in enumerate(kinds):
        peak, rms = float(load.peaks[k]), math.sqrt(load.squares[k] / load.samples)
        whole = 1.0 if load.known[k] else math.nan
        entry |= {f"{what}_peak_{unit}": whole * peak, f"{what}_rms_{unit}": whole * rms}
        entry |= {f"{what}_determined_peak_{unit}": peak}
    entry["equivalent_range"] = {
        axis: load.cycles(k).equivalent_range(exponent) for k, axis in enumerate(WRENCH) if axis not in open_axes
    }
    if load.spec is not None:
        entry["life"] = None
        if load.known[0]:
            life = load.life(duration)
            entry["life"] = {
                "equivalent_load_N": life.load,
                "turns": life.moved,
                "L10_turns": life.life,
                "L10_hours": life.hours,
            }
            if load.slides:
                travel = {"travel_m": life.moved, "L10_m": life.life}
                entry["life"] |= {"turns": 0.0, "L10_turns": math.nan} | travel
    return entry


def _tabulate_bearing_loads(joints: dict[str, Any]) -> list[Table]:
    columns = [
        Column("bearing_force_peak_N", "N", "force peak"),
        Column("bearing_force_rms_N", "N", "RMS"),
        Column("bearing_moment_peak_N_m", "N m", "moment peak"),
        Column("bearing_moment_rms_N_m", "N m", "RMS"),
    ]
    rows: dict[str, list[Any]] = {}
    for name, entry in joints.items():
        forces = {a: v for a, v in entry["equivalent_range"].items() if a[0] == "f"}
        worst = max(forces, key=lambda axis: forces[axis], default=None)
        ranges = "" if worst is None else f"{forces[worst]:.4g} ({worst})"
        values = [entry[column.name] for column in columns]
        for k, unit in enumerate(("force_determined_peak_N", "moment_determined_peak_N_m")):
            key = f"bearing_{unit}"
            most = max(other[key] for other in joints.values())
            if math.isnan(values[2 * k]) and entry[key] > ROUNDING * most:
                values[2 * k] = f"at least {entry[key]:.4g}"
        rows[name] = [*values, ranges, ", ".join(entry["undetermined"])]
    columns += [Column("", "N", "equivalent range"), Column("", "", "undetermined")]
    tables = [Table("", columns, rows, head="joint")]
    lives = {name: entry["life"] for name, entry in joints.items() if "life" in entry}
    if lives:
        shown = [Column("", "N", "equivalent load"), Column("", "h", "L10")]
        keys = ("equivalent_load_N", "L10_hours")
        found = {n: [math.nan if v is None else v[k] for k in keys] for n, v in lives.items()}
        tables.append(Table("", shown, found, head="bearing"))
    return tables


def draw(motion: Recording, loads: Sequence[Summary], title: str) -> Figure:
    """Draw the largest joint forces over time, and their rainflow spectra."""
    told = [load for load in loads if load.determined[:3].any()]
    shown = sorted(told, key=lambda load: -load.peaks[2])
    figure, axes = plots.make_subplots(2, 1)
    (force,), (counted,) = axes
    for k, load in enumerate(shown[:6]):
        style: dict[str, Any] = {"color": plots.COLOURS[k], "ls": plots.LINE_STYLES[k % 3], "lw": 1.2}
        label = f"{load.name}: {'' if load.known[2] else 'at least '}{load.peaks[2]:.4g} N"
        force.plot(motion.clock, np.concatenate(load.sizes), label=label, **style)
        own = [k for k in range(3) if load.determined[k]]
        axis = max(own, key=lambda k: float(np.ptp(load.reversals[k].values)))
        cycles = load.cycles(axis)
        down = np.argsort(-cycles.ranges)
        label = f"{load.name}, {WRENCH[axis]}"
        reached = np.cumsum(cycles.counts[down])
        counted.step(reached, cycles.ranges[down], where="pre", label=label, **style)
    counted.set(xscale="log", xlim=(0.4, max(10.0, 1.2 * counted.get_xlim()[1])))
    counted.xaxis.set_major_formatter("{x:g}")
    counted.xaxis.set_minor_formatter("")
    plots.label(force, "time (s)", "force (N)", "force in the joints, and its peak")
    x = "cycles of at least this range"
    plots.label(counted, x, "range (N)", "load cycles of one component")
    for ax in (force, counted):
        if shown:
            # Put the legend below the axes, which the curves fill.
            plots.legend(ax, below=True)
    plots.write_title(figure, title)
    return figure
