# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin frf`` and ``pkm-twin lobes``: frequency response and chatter at a pose."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from pkm_twin.apps.options import (
    BeyondLimits,
    Json,
    OverwriteBoth,
    Payload,
    Platform,
    RobotName,
    drawing_of,
    loaded,
)
from pkm_twin.console import answer, numbers
from pkm_twin.errors import ParameterError
from pkm_twin.files import STANDARD, parse_numbers
from pkm_twin.options import OptionalFloat, OptionalPath, OptionalText, file_name

if TYPE_CHECKING:
    from pkm_twin.maps.kinds.cutting_depth import CuttingDepth
    from pkm_twin.robot.robot import Robot
    from stiffness_monitor.chatter import Lobes, Milling
    from stiffness_monitor.vibration import ToolModes

Array = NDArray[np.float64]
At = Annotated[
    OptionalText, typer.Option(help="the pose's coordinates, separated by commas; default: home")
]
Tool = Annotated[
    str, typer.Option(help="tool point from the platform's reference point, platform axes, m")
]
Damping = Annotated[
    OptionalText,
    typer.Option(
        help="damping ratio of all modes, or one per mode from the lowest on; the last one also "
        "holds for all higher modes; default: `modal_damping` of the robot file"
    ),
]
Out = Annotated[
    OptionalPath,
    typer.Option(
        help="table to write, .csv, .parquet or .mat; the picture has the same name with .png",
        callback=file_name,
    ),
]
Picture = Annotated[bool, typer.Option(help="plot the result as a PNG next to the table")]
Teeth = Annotated[int, typer.Option(help="teeth of the tool")]
Tangential = Annotated[
    float, typer.Option(help="tangential cutting coefficient Kt, N/m2, e.g. 600e6 for 600 MPa")
]
Radial = Annotated[float, typer.Option(help="ratio of radial to tangential cutting force, Kr")]
Immersion = Annotated[
    float, typer.Option(help="radial depth of cut over tool diameter, 1 is a slot")
]
Up = Annotated[bool, typer.Option("--up", help="up-milling instead of down-milling")]
Feed = Annotated[
    float, typer.Option(help="direction of the feed in the platform's xy plane, deg from x to y")
]
AXES = "xyz"


def parse_damping(text: str | None) -> list[float] | None:
    """Damping ratios of a command line.

    :raises ParameterError: other than numbers with commas between.
    """
    if text is None:
        return None
    values = parse_numbers(text)
    if not values:
        raise ParameterError("damping", text, "ratios separated by commas, as 0.02")
    return values


def process_of(
    teeth: int, tangential: float, radial: float, immersion: float, up: bool, feed: float,
    tool: str, damping: str | None,
) -> CuttingDepth:  # fmt: skip
    """The milling process of a command line.

    :raises ParameterError: a number out of range.
    """
    from pkm_twin.maps.kinds.cutting_depth import CuttingDepth
    from stiffness_monitor.chatter import Milling

    ratios = parse_damping(damping)
    return CuttingDepth(
        Milling(teeth, tangential, radial, immersion, up, math.radians(feed)),
        None if ratios is None else tuple(ratios),
        tuple(numbers(tool, 3, "a tool point: x,y,z")),
    )


def _prepared(
    robot: str, platform: str | None, payload: str | None, at: str | None, out: Path | None,
    picture: bool, overwrite: bool, beyond: bool,
) -> tuple[Robot, list[float], Path | None]:  # fmt: skip
    """The loaded robot, the pose, and the picture's name, of a command line."""
    from pkm_twin.recordings.tables import ENDINGS, check_target
    from pkm_twin.robot.limits import beyond_limits, refuse_beyond

    drawing = drawing_of(out, picture, overwrite, ENDINGS)
    if out is not None:
        check_target(out)
    machine, _ = loaded(robot, platform, payload)
    names = machine.pose_names
    home = machine.home().tolist()
    pose = home if at is None else numbers(at, len(names), f"a pose: {', '.join(names)}")
    outside = beyond_limits(machine, machine.inverse(pose))[1]
    if not beyond:
        refuse_beyond(outside)
    for joint in outside:
        typer.echo(f"outside the limits: {joint}", err=True)
    return machine, pose, drawing


def _common(machine: Robot, pose: list[float], modes: ToolModes) -> dict[str, Any]:
    """What both commands print as JSON."""
    pairs = zip(modes.frequencies.tolist(), modes.damping.tolist(), strict=True)
    return {
        "robot": machine.name,
        "pose": dict(zip(machine.pose_names, pose, strict=True)),
        "modes": [{"frequency_hz": f, "damping": z} for f, z in pairs][:6],
    }


def frf(
    robot: RobotName,
    at: At = None,
    tool: Tool = "0,0,0",
    damping: Damping = None,
    frequencies: Annotated[
        OptionalText,
        typer.Option(help="LOW,HIGH of the table, Hz; default: 0 to above the sixth mode"),
    ] = None,
    points: Annotated[int, typer.Option(help="rows of the table", min=2, max=10**6)] = 2001,
    payload: Payload = None,
    platform: Platform = None,
    out: Out = None,
    picture: Picture = True,
    overwrite: OverwriteBoth = False,
    beyond_limits: BeyondLimits = False,
    as_json: Json = False,
) -> None:
    """Compute the frequency response of the tool point at a pose.

    The response is the displacement per harmonic force (receptance), actuators locked, of the
    elastic frame with its masses and modal damping. The command prints natural frequencies, and the
    frequency and direction in which the tool point responds most.

    The table has the columns frequency (Hz) and, for each pair of directions in base axes,
    real and imaginary part (m/N): xx.real, xx.imag, xy.real, ... xy is the displacement along x per
    force along y.
    """
    from stiffness_monitor.vibration import tool_modes

    machine, pose, drawing = _prepared(
        robot, platform, payload, at, out, picture, overwrite, beyond_limits
    )
    modes = tool_modes(
        machine, pose, damping=parse_damping(damping), tool=numbers(tool, 3, "a tool point: x,y,z")
    )
    own = modes.frequencies
    low, high = 0.0, 1.2 * float(own[:6][-1])
    if frequencies is not None:
        low, high = numbers(frequencies, 2, "LOW,HIGH")
        if not 0.0 <= low < high:
            raise ParameterError("frequencies", frequencies, "LOW,HIGH in Hz, 0 or more, rising")
    grid = np.linspace(low, high, points)
    response = modes.receptance(grid)[:, :3, :3]
    # Peaks are narrower than the table's steps may be.
    peaks = own * np.sqrt(np.maximum(1.0 - 2.0 * modes.damping**2, 0.0))
    tried = np.concatenate([grid, peaks[(peaks >= low) & (peaks <= high)]])
    _, size, ways = np.linalg.svd(modes.receptance(tried)[:, :3, :3])
    k = int(size[:, 0].argmax())
    # A complex vector is that of a straight direction up to its phase.
    way = ways[k, 0] / np.exp(1j * np.angle(ways[k, 0][np.abs(ways[k, 0]).argmax()]))
    static = modes.receptance([0.0])[0, :3, :3].real
    data = _common(machine, pose, modes) | {
        "static_compliance_m_per_n": static.tolist(),
        "most": {
            "frequency_hz": float(tried[k]), "compliance_m_per_n": float(size[k, 0]),
            "direction": way.real.tolist(),
        },
        "out": None if out is None else str(out),
        "picture": None if drawing is None else str(drawing),
    }  # fmt: skip
    ratio = float(size[k, 0] / np.linalg.eigvalsh(static).max())
    along = ", ".join(f"{v:.3g}" for v in way.real.round(3) + 0.0)
    title = (
        f"{machine.name}: the tool point responds most at {tried[k]:.4g} Hz along ({along}): "
        f"{1e6 * size[k, 0]:.4g} µm/N, {ratio:.3g} times the static compliance"
    )
    if out is not None:
        from pkm_twin.recordings import write_table

        columns = {"frequency": grid}
        for i, row in enumerate(AXES):
            for j, column in enumerate(AXES):
                columns[f"{row}{column}.real"] = response[:, i, j].real
                columns[f"{row}{column}.imag"] = response[:, i, j].imag
        write_table(columns, out)
    if drawing is not None:
        _draw_response(grid, response, modes, title, drawing)
    shown = (f"{m['frequency_hz']:.4g} Hz ({100 * m['damping']:.3g} %)" for m in data["modes"])
    text = [title, f"modes (damping): {', '.join(shown)}"]
    _print(data, text, as_json, out)


def _print(data: dict[str, Any], text: list[str], as_json: bool, out: Path | None) -> None:
    files = [data[name] for name in ("out", "picture") if data[name] is not None]
    answer(data, "\n".join([*text, *files]), as_json, piped=str(out) == STANDARD)


def _draw_response(grid: Array, response: Any, modes: ToolModes, title: str, path: Path) -> None:
    from pkm_twin.report import plots

    figure, axes = plots.columns(1, 2)
    size, phase = axes[0]
    for k, name in enumerate(AXES):
        one = response[:, k, k]
        size.semilogy(grid, 1e6 * np.abs(one), color=plots.COLOURS[k], label=f"along {name}")
        phase.plot(grid, np.degrees(np.angle(one)), color=plots.COLOURS[k])
    for frequency in modes.frequencies[modes.frequencies <= grid[-1]]:
        size.axvline(frequency, color="0.8", lw=0.8, zorder=0)
    figure.suptitle(title.replace("): ", "):\n"), fontsize=11)
    plots.label(size, "frequency (Hz)", "displacement per force (µm/N)")
    size.legend(fontsize=8)
    plots.label(phase, "frequency (Hz)", "phase (deg)")
    plots.save(figure, path)


def lobes(
    robot: RobotName,
    teeth: Teeth,
    tangential: Tangential,
    radial: Radial,
    speeds: Annotated[str, typer.Option(help="spindle speeds LOW,HIGH, rpm")],
    immersion: Immersion = 1.0,
    up: Up = False,
    feed: Feed = 0.0,
    at: At = None,
    tool: Tool = "0,0,0",
    damping: Damping = None,
    points: Annotated[
        int,
        typer.Option(help="even spindle speeds; more are added at lobes", min=2, max=10**5),
    ] = 181,
    deepest: Annotated[
        OptionalFloat,
        typer.Option(
            help="largest depth to look at, m; default: 25 times the depth that is stable at every "
            "speed"
        ),
    ] = None,
    payload: Payload = None,
    platform: Platform = None,
    out: Out = None,
    picture: Picture = True,
    overwrite: OverwriteBoth = False,
    beyond_limits: BeyondLimits = False,
    as_json: Json = False,
) -> None:
    """Compute the axial depth above which milling chatters, over spindle speeds.

    Example: `pkm-twin lobes upr_rpu --teeth 2 --tangential 600e6 --radial 0.3 --immersion 0.5
    --speeds 3000,20000 --tool 0,0,-0.1`.

    The tool turns about the platform's z axis, clockwise from above. The command prints the
    smallest limit in the range of speeds, and the spindle speed with the largest stable axial depth
    of cut if the speed may be off by 1 %. Speeds are added at lobes, minima and steep flanks of the
    limit, and every 0.1 % within this 1 %. The machine's modes count, not the flexibility of
    spindle, holder and tool.

    The table has the columns speed (rpm), depth (m) and open: 1 where the cut is stable up to the
    largest depth that was computed.
    """
    from pkm_twin.recordings import write_table
    from stiffness_monitor.chatter import MARGIN, lobes_between
    from stiffness_monitor.vibration import tool_modes

    low, high = numbers(speeds, 2, "LOW,HIGH")
    if not 0.0 < low < high:
        raise ParameterError("speeds", speeds, "LOW,HIGH in rpm, above 0, rising")
    process = process_of(teeth, tangential, radial, immersion, up, feed, tool, damping)
    machine, pose, drawing = _prepared(
        robot, platform, payload, at, out, picture, overwrite, beyond_limits
    )
    modes = tool_modes(machine, pose, damping=process.damping, tool=process.tool)
    found = lobes_between(modes, process.milling, low, high, points, deepest)
    best, least = found.steady(), int(found.depths.argmin())
    data = _common(machine, pose, modes) | {
        "best": _place(*best) | {"speed_margin": MARGIN},
        "least": _place(found.speeds[least], found.depths[least], found.open[least]),
        "zero_order_depth_m": found.safe if math.isfinite(found.safe) else None,
        "speeds_rpm": found.speeds.tolist(),
        "depths_m": found.depths.tolist(),
        "out": None if out is None else str(out),
        "picture": None if drawing is None else str(drawing),
    }
    more = "more than " if found.open[least] else ""
    title = (
        f"{machine.name}: stable up to {more}{1e3 * found.depths[least]:.3g} mm at every speed "
        f"from {low:g} to {high:g} rpm (least at {found.speeds[least]:.0f} rpm); up to "
        f"{'more than ' if best[2] else ''}{1e3 * best[1]:.3g} mm at {best[0]:.0f} rpm "
        f"± {100 * MARGIN:g} %"
    )
    if out is not None:
        columns = {"speed": found.speeds, "depth": found.depths, "open": found.open.astype(float)}
        write_table(columns, out)
    if drawing is not None:
        _draw_lobes(found, process.milling, title, drawing)
    _print(data, [title], as_json, out)


def _place(speed: float, depth: float, is_open: bool) -> dict[str, Any]:
    return {"speed_rpm": float(speed), "depth_m": float(depth), "open": bool(is_open)}


def _draw_lobes(found: Lobes, milling: Milling, title: str, path: Path) -> None:
    from pkm_twin.report import plots

    figure, axes = plots.columns(1, 1)
    ax = axes[0][0]
    depth = 1e3 * found.depths
    ax.plot(found.speeds, depth, color="black", lw=1.2)
    ax.fill_between(found.speeds, depth, 1.05 * depth.max(), color=plots.COLOURS[1], alpha=0.3)
    speed, safe, _ = found.steady()
    ax.plot(speed, 1e3 * safe, "*", color="red", mec="white", ms=13)
    way = "slot" if milling.immersion == 1.0 else "up-milling" if milling.up else "down-milling"
    head = f"{title.replace('; ', chr(10))}\n{milling.teeth} teeth, {way}; chatter above the line"
    plots.label(ax, "spindle speed (rpm)", "axial depth of cut (mm)", head, 10)
    ax.set_ylim(0.0, 1.05 * depth.max())
    ax.margins(x=0.0)
    plots.save(figure, path)
