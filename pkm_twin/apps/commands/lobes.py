# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin lobes``: the depth of cut above which milling chatters."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pkm_twin.apps.commands.frf import report_modes
from pkm_twin.apps.frame import command
from pkm_twin.apps.options import MillingOptions, OutputOption, PictureOptions, PoseOption, ToolOptions
from pkm_twin.errors import ParameterError
from pkm_twin.recordings.tables import WRITABLE_SUFFIXES, write_table
from pkm_twin.report import Fact, Report, plots
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from stiffness_monitor.chatter import Lobes as Limits
    from stiffness_monitor.chatter import Milling


@dataclass(frozen=True, kw_only=True)
class Lobes(MillingOptions, PoseOption, ToolOptions, OutputOption, PictureOptions):
    """Compute the axial depth above which milling chatters, over spindle speeds.

    Example: `pkm-twin lobes upr_rpu --teeth 2 --tangential 600e6 --radial 0.3 --immersion 0.5
    --speeds 3000,20000 --tool 0,0,-0.1`.

    The tool turns about the platform's z axis, clockwise from above. The command prints the
    smallest limit in the range of speeds, and the spindle speed with the largest stable axial depth
    of cut if the speed may be off by 1 %. Speeds are added at lobes, minima and steep flanks of the
    limit, and every 0.1 % within this 1 %. Only the machine's modes are included, not the
    flexibility of spindle, holder and tool.

    The table has the columns speed (rpm), depth (m) and open: 1 where the cut is stable up to the
    largest depth that was computed.
    """

    speeds: tuple[float, ...] = setting(..., "spindle speeds, rpm", count=2, metavar="LOW,HIGH")
    points: int = setting(181, "evenly spaced spindle speeds; more are added at lobes", low=2, high=10**5)
    deepest: float | None = setting(
        None, "largest depth to compute, m; default: 25 times the depth stable at every speed"
    )
    out: Path | None = setting(None, "table to write, .csv, .parquet or .mat", writes=True, endings=WRITABLE_SUFFIXES)


@command("Stiffness, workspace and vibration")
def lobes(given: Lobes) -> Report:
    """Compute the limits of stability over the spindle's speed."""
    from stiffness_monitor.chatter import SPEED_MARGIN, refine_lobes
    from stiffness_monitor.vibration import tool_modes

    low, high = given.speeds
    if not 0.0 < low < high:
        raise ParameterError("speeds", f"{low:g},{high:g}", "rpm, above 0, rising")
    milling = given.milling
    machine = given.machine()
    pose = given.pose(machine)
    modes = tool_modes(machine, pose, damping=given.damping, tool=given.tool)
    found = refine_lobes(modes, milling, low, high, given.points, given.deepest)
    best, least = found.steady(), int(found.depths.argmin())
    worst = found.speeds[least], found.depths[least], found.open[least]
    answer = (
        f"{machine.name}: stable up to {_format_depth(*worst)} at every speed from {low:g} to {high:g} "
        f"rpm (least at {worst[0]:.0f} rpm); up to {_format_depth(*best)} at {best[0]:.0f} rpm "
        f"± {100 * SPEED_MARGIN:g} %"
    )
    if given.out is not None:
        columns = {"speed": found.speeds, "depth": found.depths, "open": found.open.astype(float)}
        write_table(columns, given.out)
    return Report(
        answer,
        [
            *report_modes(machine, pose, modes.frequencies, modes.damping),
            Fact("best", _limit_data(*best) | {"speed_margin": SPEED_MARGIN}),
            Fact("least", _limit_data(*worst)),
            Fact("zero_order_depth_m", found.safe),
            Fact("speeds_rpm", found.speeds),
            Fact("depths_m", found.depths),
        ],
        figures={"": lambda: draw(found, milling, answer)},
        files={"out": given.out},
    )


def _format_depth(_speed: float, depth: float, is_open: bool) -> str:
    return f"{'more than ' if is_open else ''}{1e3 * depth:.3g} mm"


def _limit_data(speed: float, depth: float, is_open: bool) -> dict[str, Any]:
    return {"speed_rpm": float(speed), "depth_m": float(depth), "open": bool(is_open)}


def draw(found: Limits, milling: Milling, title: str) -> Figure:
    """Draw the limit of the depth over the speed, with the best speed."""
    figure, axes = plots.make_subplots(1, 1)
    ax = axes[0][0]
    depth = 1e3 * found.depths
    ax.plot(found.speeds, depth, color="black", lw=1.2)
    ax.fill_between(found.speeds, depth, 1.05 * depth.max(), color=plots.COLOURS[1], alpha=0.3)
    speed, safe, _ = found.steady()
    ax.plot(speed, 1e3 * safe, "*", color="red", mec="white", ms=13)
    way = "slot" if milling.immersion == 1.0 else "up-milling" if milling.up else "down-milling"
    words = f"{milling.teeth} teeth, {way}; chatter above the line; star: the best speed"
    plots.label(ax, "spindle speed (rpm)", "axial depth of cut (mm)", words)
    plots.write_title(figure, title)
    ax.set_ylim(0.0, 1.05 * depth.max())
    ax.margins(x=0.0)
    return figure
