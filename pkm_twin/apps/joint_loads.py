# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin loads``: forces and moments in the joints along a motion, cycles and bearing life."""

from __future__ import annotations

import csv
import fnmatch
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
import typer
import yaml
from numpy.typing import NDArray

from delta_dynamics.elastic_reactions import elastic_reactions
from pkm_twin.apps.loads import by_load
from pkm_twin.apps.options import (
    BagTopics,
    Follow,
    Json,
    LoadTimes,
    Payload,
    Platform,
    RobotName,
    load_of,
)
from pkm_twin.apps.torques import Motion, motion_of
from pkm_twin.console import answer, finite, refuse_existing, writing
from pkm_twin.errors import ParameterError
from pkm_twin.files import STANDARD, replace_file
from pkm_twin.machine import schema
from pkm_twin.machine.graph import BASE
from pkm_twin.options import OptionalPath, file_name
from pkm_twin.robot.robot import Robot

if TYPE_CHECKING:
    from pkm_twin.paths.durability import Life

Array = NDArray[np.float64]

AXES: Final = ("fx", "fy", "fz", "mx", "my", "mz")
BLOCK: Final = 512
"""Samples at once: each has matrices of all unknowns."""
CLASSES: Final = 32
ALONG: Final = 1e-9
"""Part of a direction below which it is across another."""
SHOWN: Final = 6
"""Most joints in a picture."""


@dataclass(frozen=True, eq=False)
class BearingSpec:
    """A bearing of a joint: C (N), the life's exponent p, and its load X Fr + Y Fa.

    Without Y the load is the force's amount. ``axis`` (base axes, at home): default the joint's.
    """

    C: float = schema.number(above=0.0, unit="N")
    p: float = schema.number(at_least=1.0, at_most=20.0, default=3.0)
    X: float = schema.number(at_least=0.0, at_most=100.0, default=1.0)
    Y: float | None = schema.number(at_least=0.0, at_most=100.0, default=None)
    axis: Array | None = schema.vector(3, default=None)


@dataclass(frozen=True, eq=False)
class JointLoad:
    """Of one joint, what its inner body applies to its outer one at its point.

    ``wrench``: base axes, ``own``: axes that turn with the inner body, (k, 6), N and N m; NaN where
    undetermined. ``turned``: between samples, the outer body against the inner one, rad, (k - 1,).
    """

    name: str
    inner: str
    wrench: Array
    own: Array
    turned: Array

    @property
    def known(self) -> bool:
        """Whether its force is determined in all samples."""
        return bool(np.isfinite(self.wrench[:, :3]).all())


def joint_loads(motion: Motion) -> list[JointLoad]:
    """Loads of all joints along a motion; errors as ``reactions``."""
    parts: list[tuple[Array, Array]] = []
    names: tuple[str, ...] = ()
    bodies: tuple[tuple[str, str], ...] = ()
    for robot, rows in by_load(motion.robot, motion.load, motion.time, BLOCK):
        found = elastic_reactions(
            robot, motion.q[rows], motion.qd[rows], motion.qdd[rows], motion.wrench[rows]
        )
        names, bodies = found.names, found.bodies
        parts.append((found.wrenches, found.points))
    wrenches, points = (np.concatenate(column) for column in zip(*parts, strict=True))
    robot = motion.robot
    rotations, _ = robot.placements(motion.q)
    still = np.broadcast_to(np.eye(3), (len(motion.q), 3, 3))
    turn = {BASE: still, **rotations}
    order = list(names)
    for rod in robot.graph.rods.values():
        # What a rod turns is its direction; its spin is idle.
        start, end = (points[:, order.index(name)] for name in rod.joint_names)
        turn[rod.name] = _swung(rod.ends[1] - rod.ends[0], end - start)
    result = []
    for k, (name, (inner, outer)) in enumerate(zip(names, bodies, strict=True)):
        back = turn[inner].swapaxes(-1, -2)
        wrench = wrenches[:, k]
        own = np.concatenate([_times(back, wrench[:, :3]), _times(back, wrench[:, 3:])], -1)
        relative = back @ turn[outer]
        step = relative[:-1].swapaxes(-1, -2) @ relative[1:]
        skew = np.stack([step[:, i, j] - step[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], -1)
        sine = np.linalg.norm(skew, axis=-1)
        angle = np.arctan2(sine, np.trace(step, axis1=-2, axis2=-1) - 1.0)
        result.append(JointLoad(name, inner, wrench, own, angle))
    return result


def _times(matrices: Array, vectors: Array) -> Array:
    # What is undetermined leaves the directions across it alone.
    products = np.where(np.abs(matrices) > ALONG, matrices * vectors[..., None, :], 0.0)
    return np.asarray(products.sum(-1), np.float64)


def _swung(home: Array, now: Array) -> Array:
    """The least rotations that turn a direction to others, shape (k, 3, 3)."""
    a = home / np.linalg.norm(home)
    b = now / np.linalg.norm(now, axis=-1, keepdims=True)
    v, cosine = np.cross(a, b), b @ a
    x, y, z = v.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + cosine)[:, None, None], np.float64)


def read_bearings(path: Path, names: tuple[str, ...]) -> dict[str, BearingSpec]:
    """Bearings by joint, of a YAML with a mapping ``bearings`` of names to data; * stands for any.

    :raises ParameterError: by the field; a name that no joint has.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        what = error.strerror if isinstance(error, OSError) else str(error)
        raise ParameterError(str(path), what, "a readable YAML file of bearings") from None
    entries = data.get("bearings") if isinstance(data, dict) else None
    if not isinstance(entries, dict) or not entries:
        raise ParameterError(str(path), None, "a mapping bearings of joints to data")
    found: dict[str, BearingSpec] = {}
    for pattern, entry in entries.items():
        fitting = fnmatch.filter(names, str(pattern))
        if not fitting:
            raise ParameterError(f"{path}: bearings", pattern, f"of {', '.join(names)}")
        spec = schema.build(BearingSpec, entry, f"{path}: bearings.{pattern}")
        found |= dict.fromkeys(fitting, spec)
    return found


def life_of(robot: Robot, load: JointLoad, spec: BearingSpec, time: Array) -> Life:
    """L10 of a joint's bearing, its load between samples their mean.

    :raises ParameterError: Y without an axis.
    """
    from pkm_twin.paths.durability import bearing_life

    force = load.own[:, :3]
    amount = np.linalg.norm(force, axis=-1)
    if spec.Y is not None:
        joint = {j.label or j.name: j for j in robot.graph.joints.values()}.get(load.name)
        axis = spec.axis
        if axis is None and joint is not None and len(joint.axes) == 1:
            axis = joint.axes[0]
        if axis is None:
            raise ParameterError(f"bearings.{load.name}.axis", None, "the bearing's axis, for Y")
        along = force @ (axis / np.linalg.norm(axis))
        across = np.sqrt(np.maximum(amount**2 - along**2, 0.0))
        amount = spec.X * across + spec.Y * np.abs(along)
    middle = (amount[1:] + amount[:-1]) / 2.0
    return bearing_life(middle, load.turned, float(time[-1] - time[0]), spec.C, spec.p)


def report(
    motion: Motion,
    loads: list[JointLoad],
    bearings: Mapping[str, BearingSpec],
    exponent: float,
) -> tuple[dict[str, Any], str]:
    """The result as plain data and as text."""
    from pkm_twin.paths.durability import rainflow

    robot = motion.robot
    data: dict[str, Any] = {
        "robot": robot.name, "samples": len(motion.time),
        "duration_s": float(motion.time[-1] - motion.time[0]), "exponent": exponent, "joints": {},
    }  # fmt: skip
    lines = [
        f"{robot.name}: {len(motion.time)} samples, {data['duration_s']:.4g} s; payload: "
        f"{motion.load or 'as in the robot file'}"
    ]
    for load in loads:
        open_axes = [a for k, a in enumerate(AXES) if not np.isfinite(load.own[:, k]).all()]
        entry: dict[str, Any] = {"undetermined": open_axes, "turned_rad": float(load.turned.sum())}
        text = f"{load.name}:"
        for what, unit, part in (("force", "N", slice(0, 3)), ("moment", "N_m", slice(3, 6))):
            size = np.linalg.norm(load.wrench[:, part], axis=-1)
            known = bool(np.isfinite(size).all())
            peak = float(size.max()) if known else None
            rms = float(np.sqrt(np.mean(size**2))) if known else None
            entry |= {f"{what}_peak_{unit}": peak, f"{what}_rms_{unit}": rms}
            if known:
                text += f" {what} peak {peak:.4g}, RMS {rms:.4g} {unit.replace('_', ' ')};"
        entry["equivalent_range"] = {
            axis: rainflow(load.own[:, k]).equivalent_range(exponent)
            for k, axis in enumerate(AXES)
            if axis not in open_axes
        }
        ranges = {a: v for a, v in entry["equivalent_range"].items() if a[0] == "f"}
        if ranges:
            worst = max(ranges, key=lambda a: ranges[a])
            text += f" equivalent load range {ranges[worst]:.4g} N ({worst})"
        if open_axes:
            text += f" undetermined: {', '.join(open_axes)}"
        if load.name in bearings:
            if not load.known:
                entry["life"] = None
                text += "; no life, as the force is undetermined"
            else:
                life = life_of(robot, load, bearings[load.name], motion.time)
                entry["life"] = {
                    "equivalent_load_N": life.load, "turns": life.turns,
                    "L10_turns": finite(life.life_turns), "L10_hours": finite(life.life_hours),
                }  # fmt: skip
                text += f"; bearing: P {life.load:.4g} N, L10 {life.life_hours:.4g} h"
        data["joints"][load.name] = entry
        lines.append(text)
    if any(entry["undetermined"] for entry in data["joints"].values()):
        lines.append(
            "undetermined: neither rigid-body equations nor elastic members or joints determine it"
        )
    return data, "\n".join(lines)


def table(motion: Motion, loads: list[JointLoad]) -> str:
    """Wrenches over time in base axes, as CSV; empty where undetermined."""
    header = ["time", *(f"{load.name}.{axis}" for load in loads for axis in AXES)]
    rows = np.concatenate([motion.time[:, None], *(load.wrench for load in loads)], -1)
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(header)
    writer.writerows([["" if math.isnan(v) else v for v in row] for row in rows.tolist()])
    return text.getvalue()


def spectra(loads: list[JointLoad]) -> str:
    """Rainflow counts by joint, component and class of range, as CSV."""
    from pkm_twin.paths.durability import rainflow

    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(["joint", "component", "range_up_to", "cycles"])
    for load in loads:
        for k, axis in enumerate(AXES):
            if np.isfinite(load.own[:, k]).all() and np.ptp(load.own[:, k]) > 0.0:
                for end, count in zip(*rainflow(load.own[:, k]).spectrum(CLASSES), strict=True):
                    writer.writerow([load.name, axis, float(end), float(count)])
    return text.getvalue()


def draw(motion: Motion, loads: list[JointLoad], path: Path) -> None:
    """Forces of the joints with the largest ones over time, and their rainflow spectra."""
    from pkm_twin.maps import figures, plots
    from pkm_twin.paths.durability import rainflow

    sizes = {load.name: np.linalg.norm(load.wrench[:, :3], axis=-1) for load in loads if load.known}
    order = sorted(sizes, key=lambda name: -float(sizes[name].max()))[:SHOWN]
    figure, axes = figures.subplots(1, 2, figsize=(9, 4.6), layout="constrained")
    by_name = {load.name: load for load in loads}
    for colour, name in zip(figures.LINES, order, strict=False):
        axes[0].plot(motion.time, sizes[name], color=colour, lw=1, label=name)
        own = by_name[name].own[:, :3]
        axis = int(np.ptp(own, axis=0).argmax())
        cycles = rainflow(own[:, axis])
        down = np.argsort(-cycles.ranges)
        label = f"{name}, {AXES[axis]}"
        reached = np.cumsum(cycles.counts[down])
        axes[1].step(reached, cycles.ranges[down], color=colour, where="pre", label=label)
    plots.label(axes[0], "time (s)", "force (N)", "force in the joints")
    x = "cycles of at least this range"
    plots.label(axes[1], x, "range (N)", "load cycles of one component")
    for ax in axes:
        if order:
            # Below: beside curves that fill their axes there is no room.
            ax.legend(fontsize=9, ncol=2, loc="upper center", bbox_to_anchor=(0.5, -0.16))
    worst = f" {order[0]}, {float(sizes[order[0]].max()):.4g} N" if order else ""
    figure.suptitle(f"{motion.robot.name}: which joint bears most?{worst}")
    plots.save(figure, path)


def loads(
    robot: RobotName,
    motion: Annotated[
        Path, typer.Argument(help="a recording or a path: MCAP, rosbag2 folder or CSV")
    ],
    bearings: Annotated[
        OptionalPath, typer.Option(help="YAML of bearings by joint: C (N), p, and X, Y")
    ] = None,
    exponent: Annotated[
        float, typer.Option(help="Woehler exponent of the equivalent load range", min=1.0, max=50.0)
    ] = 5.0,
    follow: Follow = None,
    payload: Payload = None,
    load_times: LoadTimes = None,
    platform: Platform = None,
    topic: BagTopics = [],  # noqa: B006  typer copies it
    out: Annotated[
        OptionalPath, typer.Option(help="CSV of the loads over time", callback=file_name)
    ] = None,
    spectrum: Annotated[
        OptionalPath, typer.Option(help="CSV of the rainflow counts", callback=file_name)
    ] = None,
    picture: Annotated[
        OptionalPath, typer.Option(help="PNG of forces and spectra", callback=file_name)
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the files")] = False,
    as_json: Json = False,
) -> None:
    """Report forces and moments in the joints along a motion.

    For each joint it prints peak and RMS force and moment, and the equivalent load range: one cycle
    of this range does the same damage as all cycles of the motion (rainflow counting, in axes that
    turn with the joint's inner body). With --bearings also equivalent load and L10 life (ISO 281).

    In an overconstrained machine the elasticity of members and joints determines what rigid-body
    equations do not. Without elasticity these components are reported as undetermined.
    """
    from pkm_twin import load

    for target in (out, spectrum, picture):
        if target is not None:
            refuse_existing(target, overwrite, motion)
    machine = load(robot, platform=platform)
    taken = motion_of(motion, machine, topic, load_of(payload, load_times), follow)
    if len(taken.time) < 2:
        raise ParameterError(str(motion), f"{len(taken.time)} samples", "2 or more")
    found = joint_loads(taken)
    names = tuple(load.name for load in found)
    fitted = {} if bearings is None else read_bearings(bearings, names)
    data, text = report(taken, found, fitted, exponent)
    with writing(out):
        if out is not None:
            replace_file(out, table(taken, found).encode())
        if spectrum is not None:
            replace_file(spectrum, spectra(found).encode())
        if picture is not None:
            draw(taken, found, picture)
    answer(data, text, as_json, piped=STANDARD in (str(out), str(spectrum)))
