# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin feed``: a cut along a path that is slower where the machine is softer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from pkm_twin.apps.options import (
    Json,
    LimitShare,
    MotionOut,
    OverwriteBoth,
    Payload,
    Platform,
    RobotName,
    SampleRate,
    drawing_of,
    loaded,
)
from pkm_twin.apps.path import ENDINGS, read_waypoints
from pkm_twin.console import answer, writing
from pkm_twin.errors import check_limit
from pkm_twin.files import STANDARD
from pkm_twin.options import OptionalFloat

if TYPE_CHECKING:
    from pkm_twin.paths import TimedPath
    from pkm_twin.robot.robot import Robot

Array = NDArray[np.float64]


def bend_per_feed(robot: Robot, force: float, q: Array, way: Array) -> Array:
    """Deflection of the reference point per feed, m per m/s, shape (p,).

    :param force: of the cut per feed, against the motion, N per m/s.
    :param q: joint positions (p, n); ``way``: directions of the motion (p, 3), base axes.
    :raises ParameterError: a robot without elastic members.
    """
    from stiffness_monitor import platform_response

    matrix = platform_response(robot, q, np.zeros(6)).compliance[..., :3, :3]
    return np.asarray(force * np.linalg.norm(matrix @ way[..., None], axis=(-2, -1)))


def feed(
    robot: RobotName,
    waypoints: Annotated[
        Path, typer.Argument(help="CSV of waypoints, in the format of `pkm-twin path`")
    ],
    force: Annotated[
        float,
        typer.Option(help="cutting force per feed, N per m/s, against the motion", min=0.0),
    ],
    tolerance: Annotated[float, typer.Option(help="largest deflection of the platform, m")],
    speed: Annotated[float, typer.Option(help="programmed feed, m/s")],
    blend: Annotated[
        OptionalFloat,
        typer.Option(
            help="distance from a corner at which rounding begins, m; 0 stops at every waypoint; "
            "default: a smooth curve through the waypoints",
            min=0.0,
        ),
    ] = None,
    share: LimitShare = 1.0,
    payload: Payload = None,
    platform: Platform = None,
    rate: SampleRate = 1000.0,
    out: MotionOut = None,
    picture: Annotated[
        bool, typer.Option(help="plot feed and deflection; the PNG has the file's name")
    ] = True,
    overwrite: OverwriteBoth = False,
    as_json: Json = False,
) -> None:
    """Plan a cut that is slower where the machine is softer, so that it stays within a tolerance.

    The cutting force is proportional to the feed and against the motion. It deflects the platform's
    reference point by its compliance at the pose. The command finds the fastest motion whose feed
    is at most --speed and whose deflection is at most --tolerance, within the limits of the robot's
    file. It writes the motion as `pkm-twin path` does.
    """
    from pkm_twin.apps.path_report import write
    from pkm_twin.paths import fastest

    for name, value, unit in (("tolerance", tolerance, "m"), ("speed", speed, "m/s")):
        check_limit(name, value, unit)
    drawing = drawing_of(out, picture, overwrite, ENDINGS, waypoints)
    machine, carried = loaded(robot, platform, payload)

    def slowdown(q: Array, way: Array) -> Array:
        return np.maximum(1.0, speed / tolerance * bend_per_feed(machine, force, q, way))

    way = read_waypoints(waypoints, machine, blend, carried)
    motion = fastest(machine, way, speed=speed, share=share, slowdown=slowdown)
    with writing(out):
        if out is not None:
            write(motion, motion.uniform(rate), carried, out, overwrite)
        data, text = _report(motion, force, speed, tolerance, out, drawing)
    answer(data, text, as_json, piped=str(out) == STANDARD)


def _report(
    motion: TimedPath, force: float, speed: float, tolerance: float, out: Path | None,
    drawing: Path | None,
) -> tuple[dict[str, Any], str]:  # fmt: skip
    """The result as plain data and as text; the picture, where one is asked for."""
    s, robot = motion.fine, motion.robot
    moved = (robot.platform_jacobian(s.q)[:, :3] @ s.qd[..., None])[..., 0]
    bend = bend_per_feed(robot, force, s.q, moved / np.maximum(s.speed, 1e-300)[:, None])
    soft, most = float(bend.max()), float((bend * s.speed).max())
    # The largest constant feed within the tolerance.
    even = min(speed, tolerance / soft) if soft > 0.0 else speed
    data = {
        "robot": robot.name, "duration_s": motion.duration, "length_m": motion.path.length,
        "greatest_feed_m_s": float(s.speed.max()), "constant_feed_m_s": even,
        "greatest_deflection_m": most, "tolerance_m": tolerance,
        "limits": [bound.as_json() for bound in motion.bounds],
        "out": None if out is None else str(out),
        "picture": None if drawing is None else str(drawing),
    }  # fmt: skip
    title = (
        f"{robot.name}: duration {motion.duration:.4g} s, feed at most "
        f"{1e3 * s.speed.max():.4g} mm/s, deflection at most {1e6 * most:.4g} µm "
        f"(tolerance {1e6 * tolerance:.4g} µm); the largest "
        f"constant feed within the tolerance is {1e3 * even:.4g} mm/s"
    )
    if drawing is not None:
        from pkm_twin.report import plots

        figure, axes = plots.columns(1, 2)
        curves = ((1e3 * s.speed, "feed (mm/s)", speed), (1e6 * bend * s.speed, "deflection (µm)",
                  tolerance))  # fmt: skip
        for ax, (values, label, limit), scale in zip(axes[0], curves, (1e3, 1e6), strict=True):
            ax.plot(s.time, values, color=plots.COLOURS[0], lw=1.2)
            ax.axhline(scale * limit, color=plots.COLOURS[1], lw=1.0)
            plots.label(ax, "time (s)", label)
            ax.set_ylim(bottom=0.0)
        figure.suptitle(title.replace(", deflection", ",\ndeflection"), fontsize=10)
        plots.save(figure, drawing)
    return data, "\n".join([title, *(str(name) for name in (out, drawing) if name is not None)])
