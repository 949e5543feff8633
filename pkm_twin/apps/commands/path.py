# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin path``: a motion along waypoints, a cycle or a circle, as a trajectory or table."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import (
    OutputOption,
    PayloadOption,
    PictureOptions,
    SingularityOption,
    TableOptions,
    payload_fact,
)
from pkm_twin.console import convert_write_errors
from pkm_twin.errors import check_limit
from pkm_twin.recordings.tables import WRITABLE_SUFFIXES
from pkm_twin.report import Column, Fact, Report, Table, plots
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pkm_twin.paths import Path as Way
    from pkm_twin.paths import TimedPath
    from pkm_twin.paths.along import SoftCut
    from pkm_twin.robot.robot import Robot


@dataclass(frozen=True, kw_only=True)
class Motion(PayloadOption, TableOptions, SingularityOption, OutputOption, PictureOptions):
    """Plan a motion along a path: by a law, the fastest, or slower where the machine is soft.

    The table of waypoints has a header row and the pose's coordinates (m, rad) or JOINT.position of
    every joint. The platform passes through the points on a smooth curve without a stop. With a
    column blend (m), dwell (s) or arc (1: the middle of an arc), or with --blend, it follows
    straight lines and arcs, and stops where blend is 0. It does not stop between an arc and a
    tangent line.

    A column payload (kg) or --load changes the payload at waypoints, from the moment on that the
    platform reaches them. Waypoints count from 0, the start; a cycle has 0 to 6: the pick is 0, the
    place is 3. The limits hold with the payload of each part, and the file that is written states
    the times of the changes.

    --fastest finds the shortest time within effort, velocity, acceleration, jerk and speed limits.
    It uses the exact inverse dynamics with payload and friction. The command prints the duration,
    which limit binds when, and the largest fraction of each limit that the motion uses.

    --slow-where-soft plans a cut: a force that is proportional to the feed and against the motion
    deflects the platform's reference point by its compliance at the pose. The motion is the fastest
    one whose feed is at most --speed and whose deflection is at most --deflection.

    The table that it writes has the columns time, JOINT.position, JOINT.velocity,
    JOINT.acceleration, JOINT.effort, the pose's coordinates with their velocity and acceleration,
    and what the efforts rest on: the payload (payload.mass, and payload.x, .y, .z where given),
    gravity, and a checksum of the robot's numbers (computed_with.ROBOT). `pkm-twin torques`,
    `size`, `loads` and `design` read it, and reject efforts that the robot does not compute.
    """

    waypoints: Path | None = setting(None, "table of waypoints, unless --cycle or --circle is given", argument=True)
    cycle: tuple[float, ...] | None = setting(
        None,
        "pick-and-place cycle, mm: HEIGHT up, WIDTH across, DROP down (default: HEIGHT), and back",
        count=0,
        metavar="HEIGHT,WIDTH[,DROP]",
    )
    circle: float | None = setting(None, "follow a circle of this radius, m, or rad for angles")
    at: tuple[float, ...] | None = setting(None, "pose at the centre of --cycle or --circle; default: home", count=0)
    direction: float | None = setting(None, "direction of the cycle, degrees from x towards y; default: x, else y")
    blend: float | None = setting(
        None,
        "distance from corners at which rounding begins, m; 0: stop at waypoints; default: a smooth curve",
        low=0.0,
    )
    dwell: float = setting(0.0, "dwell at pick and at place, s", low=0.0)
    carries: tuple[str, ...] = setting(
        (),
        "payload between waypoints: 0.5@2:4 is 0.5 kg from waypoint 2 to 4; may be repeated",
        name="load",
        metavar="MASS@FROM:TO",
    )
    fastest: bool = setting(False, "plan the shortest motion within all limits")
    slow_where_soft: bool = setting(False, "plan the fastest cut within --deflection")
    force: float | None = setting(
        None, "of --slow-where-soft: cutting force per feed, N per m/s, against the motion", low=0.0
    )
    deflection: float | None = setting(
        None, "of --slow-where-soft: largest deflection of the platform, m", older=("--tolerance",)
    )
    law: str = setting("quintic", "motion law without --fastest: quintic or s-curve, from stop to stop")
    duration: float | None = setting(None, "duration of the motion, s; default: the shortest")
    effort: tuple[float, ...] | None = setting(
        None, "effort limits, one or one per joint, N m or N; default: the file's", count=0
    )
    velocity: tuple[float, ...] | None = setting(None, "velocity limits, rad/s or m/s; default: the file's", count=0)
    acceleration: tuple[float, ...] | None = setting(
        None, "acceleration limits, rad/s2 or m/s2; default: none", count=0
    )
    jerk: tuple[float, ...] | None = setting(None, "jerk limits, rad/s3 or m/s3; default: none", count=0)
    speed: float | None = setting(
        None,
        "speed limit of the reference point, m/s, or rad/s for angles; with --slow-where-soft the "
        "programmed feed; default: none",
    )
    share: float = setting(1.0, "fraction of the file's effort and velocity limits to use", low=1e-3, high=1.0)
    shaper: str | None = setting(None, "input shaper for the first natural frequency: zv, or zvd (more robust)")
    damping: float | None = setting(None, "its damping ratio; default: the robot file's", low=0.0, high=0.99)
    rate: float = setting(1000.0, "samples per second in the file", low=1.0, high=1e5)
    out: Path | None = setting(
        None,
        "file to write: .mcap (a JointTrajectory with efforts), or a table, .csv, .parquet or .mat",
        writes=True,
        endings=(".mcap", *WRITABLE_SUFFIXES),
    )


@command("Torques, paths and drives")
def path(given: Motion) -> Report:
    """Plan the motion along a path; report which limits it uses."""
    from pkm_twin.paths import ShapedPath, shaped, timed
    from pkm_twin.paths.along import SoftCut
    from pkm_twin.paths.joint_path import only_turns
    from pkm_twin.paths.waypoints import parse_loads
    from pkm_twin.recordings import Recording
    from pkm_twin.recordings.bags import write_motion

    machine = given.machine()
    if given.slow_where_soft:
        missing = [n for n in ("force", "deflection", "speed") if getattr(given, n) is None]
        if missing:
            raise click.UsageError(f"--slow-where-soft needs --{' and --'.join(missing)}")
        for name, unit in (("deflection", "m"), ("speed", "m/s")):
            check_limit(name, getattr(given, name), unit)
    elif given.force is not None or given.deflection is not None:
        raise click.UsageError("--force and --deflection are for --slow-where-soft")
    cut = None
    if given.slow_where_soft:
        cut = SoftCut(machine, given.force or 0.0, given.deflection or 0.0, given.speed or 0.0)
    bounds: dict[str, Any] = {}
    for name in ("effort", "velocity", "acceleration", "jerk"):
        values, n = getattr(given, name), machine.joints_count
        if values is not None and (len(values) not in (1, n) or min(values) <= 0.0):
            found = ",".join(f"{value:g}" for value in values)
            raise click.UsageError(f"--{name} {found}: one number above 0, or {n} with commas between")
        bounds[name] = None if values is None else list(values)
    if given.carries and given.payload is not None:
        raise click.UsageError("--payload is for the whole path; leave it out with --load")
    way, masses = _read_path(given, machine)
    option = "--load" if given.carries else "--payload" if given.payload is not None else ""
    same = not given.carries and set(masses or ()) <= {machine.payload.mass}
    if masses is not None and option and not same:
        raise click.UsageError(f"the waypoints have a column payload; leave out {option}")
    payload = parse_loads(given.carries, len(way.marks)) if given.carries else masses
    law = "fastest" if given.fastest or given.slow_where_soft else given.law
    motion = timed(
        machine,
        way,
        law,
        payload=payload,
        duration=given.duration,
        speed=given.speed,
        share=given.share,
        singularity=given.singularity,
        slowdown=None if cut is None else cut.slowdown,
        **bounds,
    )
    if given.shaper is not None:
        motion = shaped(motion, given.shaper, None, given.damping, singularity=given.singularity)
    elif given.damping is not None:
        raise click.UsageError("--damping is for --shaper")
    carried = motion.load or given.load
    if given.out is not None:
        s = motion.uniform(given.rate)
        plan = Recording(machine, s.time, s.q, s.qd, s.qdd, s.effort, pose=s.pose, load=carried)
        with convert_write_errors(given.out):
            source = {"source": "pkm-twin path", "law": motion.law}
            write_motion(given.out, plan, source, given.overwrite)
    fine, robot = motion.fine, motion.robot
    turns, length = only_turns(robot), f"{motion.path.length:.4g} m"
    unit = "rad/s" if turns else "m/s"
    way_units = robot.pose_units if motion.path.space == "pose" else robot.joint_units
    if turns and "m" not in way_units:
        length = f"{motion.path.length / robot.size:.4g} rad"
    answer = (
        f"{robot.name}: {motion.path.kind}, {length} in {motion.duration:.6g} s, at most {fine.speed.max():.4g} {unit}"
    )
    facts = [
        Fact("robot", robot.name),
        Fact("path", motion.path.kind),
        Fact("law", motion.law, text="motion law"),
        Fact("duration_s", motion.duration, "s"),
        Fact("length_m", motion.path.length, "m"),
        Fact(
            "stretches",
            [
                {
                    "begin_s": round(begin, 9),
                    "duration_s": run.duration,
                    "length_m": stretch.length,
                    "dwell_s": stretch.dwell,
                }
                for begin, run, stretch in zip(motion.begins, motion.runs, motion.path.stretches, strict=True)
            ],
            text="segments from stop to stop",
            shown=str(len(motion.runs)),
        ),
        payload_fact(carried),
        Fact("limits", [bound.as_json() for bound in motion.bounds]),
        Fact("used", motion.worst),
        Fact("peaks", motion.peaks),
        Fact(f"greatest_speed_{unit.replace('/', '_')}", float(fine.speed.max()), unit),
    ]
    if isinstance(motion, ShapedPath):
        low, high = motion.frequencies
        shaper = {"kind": motion.shaper, "added_s": motion.added, "lowest_hz": low, "highest_hz": high}
        words = f"{motion.shaper} for {low:.4g} to {high:.4g} Hz, adds {motion.added:.4g} s"
        facts.append(Fact("shaper", shaper, text="shaper", shown=words))
    draw: Callable[[TimedPath, str], Figure] = draw_limits
    if cut is not None:
        more, draw = _report_milling(cut, motion)
        facts += more
    # Tables of limits and peaks; with ``soft`` the tolerance bounds the speed, too.
    rows: dict[str, list[Any]] = {}
    words_of = {"speed": "speed or tolerance"} if given.slow_where_soft else {}
    for bound in motion.bounds:
        what = words_of.get(bound.what, bound.what) or f"none (largest fraction of a limit: {100 * bound.used:.0f} %)"
        rows[f"{bound.begin:.4f} to {bound.end:.4f}"] = [what]
    peaks = {
        joint: [f"{one['value']:.4g} {one['unit']}" for one in values.values()]
        for joint, values in motion.peaks.items()
    }
    peak_columns = [Column("", "", word) for word in next(iter(motion.peaks.values()))]
    worst = sorted(motion.worst.items(), key=lambda item: -item[1])[:6]
    used = {words_of.get(name, name): [100.0 * value] for name, value in worst}
    tables = [
        Table("", [Column("", "", "limit that binds")], rows, head="time (s)"),
        Table("", peak_columns, peaks, head="|peak|"),
    ]
    if used:
        tables.append(Table("", [Column("", "%", "used")], used, head="limit"))
    return Report(answer, facts, tables, {"": lambda: draw(motion, answer)}, files={"out": given.out})


def _read_path(given: Motion, machine: Robot) -> tuple[Way, list[float] | None]:
    """Return the path, and the payload of a table's waypoints."""
    from pkm_twin import paths
    from pkm_twin.paths.waypoints import read_waypoints

    if sum(one is not None for one in (given.waypoints, given.cycle, given.circle)) != 1:
        raise click.UsageError("give one of WAYPOINTS, --cycle and --circle")
    if given.waypoints is not None:
        if given.at is not None or given.dwell or given.direction is not None:
            raise click.UsageError("--at, --direction and --dwell are not for waypoints")
        return read_waypoints(given.waypoints, machine, given.blend, given.dialect)
    if given.at is not None and len(given.at) != len(machine.pose_names):
        names = ", ".join(machine.pose_names)
        raise click.UsageError(f"--at has {len(given.at)} numbers; expected a pose: {names}")
    if given.circle is not None:
        if given.direction is not None or given.dwell:
            raise click.UsageError("--direction and --dwell are for --cycle")
        home = machine.home() if given.at is None else np.array(given.at)
        return paths.circle(machine, home, given.circle), None
    lengths = given.cycle or ()
    # A length below 1 mm was probably given in metres.
    if len(lengths) not in (2, 3) or min(lengths) < 1.0:
        found = ",".join(f"{length:g}" for length in lengths)
        raise click.UsageError(f"--cycle {found}: HEIGHT,WIDTH[,DROP] in millimetres, for example 25,305,25")
    metres = [1e-3 * value for value in lengths]
    way = None if given.direction is None else math.radians(given.direction)
    made = paths.cycle(machine, *metres, at=given.at, direction=way, blend=given.blend, dwell=given.dwell)
    return made, None


def draw_limits(motion: TimedPath, title: str) -> Figure:
    """Draw the used fraction of each limit over time, coloured by the limit that binds."""
    from pkm_twin.paths.constraints import limit_names
    from pkm_twin.paths.joint_path import only_turns

    figure, axes = plots.make_subplots(1, 2)
    used, time = motion.used, motion.fine.time
    top, low = axes[0]
    names = limit_names(motion.robot)
    # At most eight limits are drawn, those of which the motion uses more than 30 %.
    shown = [i for i in np.argsort(-used.max(0)) if used[:, i].max() > 0.3][:8]
    colours = {names[i]: plots.COLOURS[k] for k, i in enumerate(shown)}
    for i in shown:
        top.plot(time, 100 * used[:, i], color=colours[names[i]], lw=1.2, label=names[i])
    for bound in motion.bounds:
        colour = colours.get(bound.what)
        if colour is not None:
            for ax in (top, low):
                ax.axvspan(bound.begin, bound.end, color=colour, alpha=0.15, lw=0)
    plots.write_title(figure, title)
    most = max(motion.worst.items(), key=lambda item: item[1], default=None)
    binds = any(bound.what in colours for bound in motion.bounds)
    words = ""
    if binds:
        words = "background: colour of the limit that binds"
    elif most is not None:
        words = f"no limit binds: {most[0]} uses {100 * most[1]:.0f} %"
    plots.label(top, "time (s)", "fraction of the limit (%)", words)
    top.set_ylim(0, 105)
    if shown:
        plots.legend(top)
    low.plot(time, motion.fine.speed, color="black", lw=1.2)
    turns = only_turns(motion.robot)
    words = "speed of the platform's turn (rad/s)" if turns else "speed of the tool point (m/s)"
    plots.label(low, "time (s)", words)
    low.set_ylim(bottom=0)
    return figure


def _report_milling(cut: SoftCut, motion: TimedPath) -> tuple[list[Fact], Callable[[TimedPath, str], Figure]]:
    """Report feed and deflection of a cut with their bounds, and draw them."""
    s, speed, tolerance = motion.fine, cut.feed, cut.tolerance
    deflection, constant_feed = cut.along(s)
    most = float(deflection.max())
    facts = [
        Fact("greatest_feed_m_s", float(s.speed.max()), "m/s", "greatest feed"),
        Fact(
            "greatest_deflection_m",
            most,
            "m",
            "greatest deflection",
            f"{1e6 * most:.4g} µm (tolerance {1e6 * tolerance:.4g} µm)",
        ),
        Fact("constant_feed_m_s", constant_feed, "m/s", "largest constant feed within the tolerance"),
        Fact("tolerance_m", tolerance, "m"),
    ]

    def draw_feed(motion: TimedPath, title: str) -> Figure:
        figure, axes = plots.make_subplots(1, 2)
        curves = (
            (1e3 * s.speed, "feed (mm/s)", 1e3 * speed),
            (1e6 * deflection, "deflection (µm)", 1e6 * tolerance),
        )
        for ax, (values, label, limit) in zip(axes[0], curves, strict=True):
            ax.plot(s.time, values, color=plots.COLOURS[0], lw=1.2)
            ax.axhline(limit, color=plots.COLOURS[1], lw=1.0)
            words = f"{label}: up to {values.max():.4g}, limit {limit:.4g}"
            plots.label(ax, "time (s)", label, words)
            ax.set_ylim(0.0, 1.1 * limit)
        plots.write_title(figure, title)
        return figure

    return facts, draw_feed
