# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin excite``: a trajectory from which a fit learns much, as a bag and a table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from pkm_twin.apps.options import Json, OverwriteBoth, Platform, RobotName
from pkm_twin.console import print_json, progress, refuse_existing, writing
from pkm_twin.errors import BagError, ParameterError
from pkm_twin.options import OptionalFloat, OptionalPath, file_name

if TYPE_CHECKING:
    from pkm_twin.identification.excitation import Bounds, Judge

Array = NDArray[np.float64]


def excite(
    robot: RobotName,
    what: Annotated[
        str, typer.Option(help="what a fit shall identify: friction,rotor,payload,inertia or some")
    ] = "friction,rotor,payload,inertia",
    out: Annotated[
        Path,
        typer.Option(help="MCAP to write; the CSV has the same name with .csv", callback=file_name),
    ] = Path("excite.mcap"),
    beside: Annotated[
        OptionalPath, typer.Option(help="also report the condition number of this bag")
    ] = None,
    friction: Annotated[
        bool,
        typer.Option(
            "--friction", help="slow sweeps up and down, a joint at a time, which show friction"
        ),
    ] = False,
    duration: Annotated[float, typer.Option(help="duration, s", min=1.0, max=600.0)] = 10.0,
    harmonics: Annotated[int, typer.Option(help="harmonics per joint", min=3, max=50)] = 6,
    rate: Annotated[float, typer.Option(help="points per second", min=10.0, max=1000.0)] = 100.0,
    share: Annotated[
        float, typer.Option(help="fraction of all limits to use", min=0.05, max=1.0)
    ] = 0.9,
    acceleration: Annotated[
        OptionalFloat,
        typer.Option(help="acceleration limit of every joint, rad/s2 or m/s2; default: none"),
    ] = None,
    singularity: Annotated[
        float, typer.Option(help="least singularity index, 0 to 1", min=0.001, max=0.9)
    ] = 0.1,
    trials: Annotated[int, typer.Option(help="number of trajectories to try", min=10)] = 300,
    seed: Annotated[int, typer.Option(help="seed of the trials", min=0)] = 0,
    platform: Platform = None,
    overwrite: OverwriteBoth = False,
    json_output: Json = False,
) -> None:
    """Design a trajectory that excites the parameters to identify.

    Every joint follows a finite Fourier series that starts and ends at rest. The trajectory is
    D-optimal for the base parameters of what is to be fitted. It stays inside the robot file's
    position, velocity and effort limits and inside the workspace, away from singularities. The
    command writes a trajectory_msgs/JointTrajectory on /delta_dynamics/joint_trajectory, and a CSV
    for `pkm-twin torques`.

    With --friction every joint alone sweeps its range up and down at three speeds, 1 : 4 : 16, and
    --duration is that of all sweeps; --harmonics, --trials and --seed are not used.
    """
    from pkm_twin import load
    from pkm_twin.apps.fit import kinds_of
    from pkm_twin.identification.excitation import Bounds, Judge
    from pkm_twin.identification.parameters import file_parameters

    table = checked_outputs(out, overwrite)
    machine = load(robot, platform=platform)
    judge = Judge.of(machine, file_parameters(machine, kinds_of(what)))
    other = None if beside is None else _condition_of(beside, judge)
    bounds = Bounds(share, acceleration, singularity, rate)
    best, points = write_motion(
        judge, out, bounds, duration, harmonics, trials=trials, seed=seed, friction=friction,
        overwrite=overwrite,
    )  # fmt: skip
    if json_output:
        print_json(
            {
                "robot": machine.name, "condition": best.condition, "duration_s": best.duration,
                "base_parameters": len(judge.columns),
                **({"speeds": best.speeds.tolist(), "speed_units": machine.joint_units}
                   if friction else
                   {"frequencies_Hz": (best.harmonics / best.duration).tolist()}),
                "beside": None if beside is None else str(beside),
                "condition_beside": other if other is not None and np.isfinite(other) else None,
                "out": str(out), "table": str(table),
            }
        )  # fmt: skip
        return
    typer.echo(f"condition number {best.condition:.4g} over {len(judge.columns)} base parameters")
    if other is not None:
        told = f"{other:.4g}" if np.isfinite(other) else "infinite, it does not excite all of them"
        typer.echo(f"condition number of {beside}: {told}")
    typer.echo(f"{out}, {table}: {points} points, {best.duration:.4g} s")


def checked_outputs(out: Path, overwrite: bool) -> Path:
    """The table's name next to a bag to write; both are checked.

    :raises ParameterError: another ending.
    :raises PkmTwinError: a file that may not be replaced.
    """
    if out.suffix != ".mcap":
        raise ParameterError("out", str(out), "a name that ends in .mcap")
    table = out.with_suffix(".csv")
    for target in (out, table):
        refuse_existing(target, overwrite)
    return table


def write_motion(
    judge: Judge,
    out: Path,
    bounds: Bounds,
    duration: float,
    harmonics: int = 6,
    *,
    trials: int,
    seed: int = 0,
    friction: bool = False,
    overwrite: bool = False,
) -> tuple[Any, int]:
    """Design a motion, or slow sweeps with ``friction``, and write its bag and its table.

    :returns: the motion, and how many points are written.
    """
    from pkm_twin.identification.excitation import excite as design
    from pkm_twin.identification.sweeps import sweeps
    from pkm_twin.recordings import write_table
    from pkm_twin.recordings.trajectories import write_trajectory

    machine, table = judge.robot, out.with_suffix(".csv")
    best: Any
    if friction:
        best = sweeps(judge, duration, bounds)
    else:
        with progress("excite", trials) as update:
            best = design(
                judge, duration, harmonics, bounds, trials=trials, seed=seed, progress=update
            )
    time = np.arange(round(best.duration * bounds.rate) + 1) / bounds.rate
    time = time[time <= best.duration]
    motion = best.at(time)
    facts = {"robot": machine.name, "source": "pkm-twin excite", "condition": best.condition}
    write_trajectory(out, machine, time, motion, None, facts, overwrite)
    columns = {"time": time}
    for i, joint in enumerate(machine.joint_names):
        for word, values in zip(("position", "velocity", "acceleration"), motion, strict=True):
            columns[f"{joint}.{word}"] = values[:, i]
    with writing(table):
        write_table(columns, table)
    return best, len(time)


def _condition_of(path: Path, judge: Any) -> float:
    """Condition number of a recorded motion."""
    from pkm_twin.identification.samples import tracks
    from pkm_twin.recordings import read

    r = read(path, judge.robot)
    none = np.zeros((len(r.time), 6))
    pieces, _ = tracks(r.time, r.q, np.zeros_like(r.q), none, none[:, 0])
    if not pieces:
        raise BagError("too few joint states in a row", path=path, reason="too short")
    parts = [np.concatenate([getattr(p, k) for p in pieces]) for k in ("q", "qd", "qdd")]
    step = max(1, len(parts[0]) // 2000)
    result: float = judge.condition(*(part[::step] for part in parts))
    return result
