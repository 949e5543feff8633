# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin excite``: a trajectory from which a fit learns much, as a bag and a table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Optional

import numpy as np
import typer
from numpy.typing import NDArray

from pkm_twin.apps.options import Json, RobotName
from pkm_twin.console import file_name, print_json, progress, refuse_existing
from pkm_twin.errors import BagError, ParameterError, PkmTwinError

Array = NDArray[np.float64]

TOPIC: Final = "/delta_dynamics/joint_trajectory"
TYPE: Final = "trajectory_msgs/msg/JointTrajectory"
DEFINITION: Final = """\
std_msgs/Header header
string[] joint_names
JointTrajectoryPoint[] points
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: trajectory_msgs/JointTrajectoryPoint
float64[] positions
float64[] velocities
float64[] accelerations
float64[] effort
builtin_interfaces/Duration time_from_start
================================================================================
MSG: builtin_interfaces/Duration
int32 sec
uint32 nanosec
"""
SECOND: Final = 1_000_000_000


def excite(
    robot: RobotName,
    what: Annotated[
        str, typer.Option(help="of friction, rotor, payload, inertia, commas between")
    ] = "friction,rotor,payload,inertia",
    out: Annotated[
        Path, typer.Option(help="MCAP to write; the same as CSV goes beside it", callback=file_name)
    ] = Path("excite.mcap"),
    beside: Annotated[
        Optional[Path],  # noqa: UP045  typer of Ubuntu 24.04 reads no unions
        typer.Option(help="a bag whose condition number is told beside", show_default=False),
    ] = None,
    duration: Annotated[float, typer.Option(help="s", min=1.0, max=600.0)] = 10.0,
    harmonics: Annotated[int, typer.Option(help="of each joint", min=3, max=50)] = 6,
    rate: Annotated[float, typer.Option(help="points a second", min=10.0, max=1000.0)] = 100.0,
    share: Annotated[
        float, typer.Option(help="of all limits that is used", min=0.05, max=1.0)
    ] = 0.9,
    acceleration: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(help="limit of every joint, rad/s2 or m/s2", show_default=False),
    ] = None,
    singularity: Annotated[
        float, typer.Option(help="least singularity measure, 0 to 1", min=0.001, max=0.9)
    ] = 0.1,
    trials: Annotated[int, typer.Option(help="trajectories that are tried", min=10)] = 300,
    seed: Annotated[int, typer.Option(help="of the trials", min=0)] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace both files")] = False,
    json_output: Json = False,
) -> None:
    """Design a trajectory that identifies a robot well.

    A finite Fourier series in every joint, at rest at both ends, D-optimal over the base
    parameters of what is to be fitted; inside position, velocity and effort limits of the robot's
    file, its workspace, and clear of singularities. Written as a trajectory_msgs/JointTrajectory
    on /delta_dynamics/joint_trajectory, and as a CSV as `pkm-twin torques` takes it.
    """
    from delta_dynamics.excitation import Bounds, Judge
    from delta_dynamics.excitation import excite as design
    from delta_dynamics.file_parameters import file_parameters
    from pkm_twin import load
    from pkm_twin.apps.fit import kinds_of
    from pkm_twin.apps.torques import write_table

    if out.suffix != ".mcap":
        raise ParameterError("out", str(out), "a name that ends in .mcap")
    table = out.with_suffix(".csv")
    for target in (out, table):
        refuse_existing(target, overwrite)
    machine = load(robot)
    judge = Judge.of(machine, file_parameters(machine, kinds_of(what)))
    other = None if beside is None else _condition_of(beside, judge)
    bounds = Bounds(share, acceleration, singularity, rate)
    with progress("excite", trials) as update:
        best = design(judge, duration, harmonics, bounds, trials=trials, seed=seed, progress=update)
    time = np.arange(round(duration * rate) + 1) / rate
    time = time[time <= duration]
    motion = best.at(time)
    own = machine.controller
    place, rates, changes = (m * own.factors for m in motion)
    commanded = (place + own.offsets, rates, changes)
    facts = {"robot": machine.name, "source": "pkm-twin excite", "condition": best.condition}
    _write_bag(out, own.names, time, commanded, facts, overwrite)
    columns = {"time": time}
    for i, joint in enumerate(machine.joint_names):
        for word, values in zip(("position", "velocity", "acceleration"), motion, strict=True):
            columns[f"{joint}.{word}"] = values[:, i]
    try:
        write_table(columns, table)
    except OSError as error:
        raise PkmTwinError(f"cannot write {error.filename or table}: {error.strerror}") from None
    if json_output:
        print_json(
            {
                "robot": machine.name, "condition": best.condition, "duration_s": best.duration,
                "base_parameters": len(judge.columns),
                "frequencies_Hz": (best.harmonics / best.duration).tolist(),
                "beside": None if beside is None else str(beside),
                "condition_beside": other if other is not None and np.isfinite(other) else None,
                "out": str(out), "table": str(table),
            }
        )  # fmt: skip
        return
    typer.echo(f"condition number {best.condition:.4g} over {len(judge.columns)} base parameters")
    if other is not None:
        told = f"{other:.4g}" if np.isfinite(other) else "infinite, some of them do not show"
        typer.echo(f"beside it {beside}: {told}")
    typer.echo(f"{out}, {table}: {len(time)} points, {duration:g} s")


def _condition_of(path: Path, judge: Any) -> float:
    """Condition number of a recorded motion."""
    from delta_dynamics.samples import tracks
    from pkm_twin.apps.recorded import read_recording

    r = read_recording(path, judge.robot, limited=False)
    none = np.zeros((len(r.time), 6))
    pieces, _ = tracks(r.time, r.q, np.zeros_like(r.q), none, none[:, 0])
    if not pieces:
        raise BagError("too few joint states in a row", path=path, reason="too short")
    parts = [np.concatenate([getattr(p, k) for p in pieces]) for k in ("q", "qd", "qdd")]
    step = max(1, len(parts[0]) // 2000)
    result: float = judge.condition(*(part[::step] for part in parts))
    return result


def _write_bag(
    path: Path,
    names: tuple[str, ...],
    time: Array,
    motion: tuple[Array, Array, Array],
    facts: Mapping[str, Any],
    overwrite: bool,
) -> None:
    """One message, whose zero stamp means a start on receipt."""
    from pkm_twin.bags.reader import BagWriter

    points = []
    for t, q, qd, qdd in zip(time.tolist(), *(m.tolist() for m in motion), strict=True):
        whole = round(t * SECOND)
        points.append(
            {
                "positions": q, "velocities": qd, "accelerations": qdd, "effort": [],
                "time_from_start": {"sec": whole // SECOND, "nanosec": whole % SECOND},
            }
        )  # fmt: skip
    message = {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
        "joint_names": list(names),
        "points": points,
    }
    metadata = {"pkm_twin": {key: str(value) for key, value in facts.items()}}
    with BagWriter(path, overwrite=overwrite, metadata=metadata, flush_period=None) as bag:
        bag.add_topic(TOPIC, TYPE, definition=DEFINITION)
        bag.write(TOPIC, message, 0)
