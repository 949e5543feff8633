# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin excite``: a trajectory from which a fit learns much, as a bag and a table."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import OutputOption, RobotArgument, SeedOption, SingularityOption
from pkm_twin.console import convert_write_errors, draw_progress
from pkm_twin.errors import BagError
from pkm_twin.report import Fact, Report
from pkm_twin.settings import setting

if TYPE_CHECKING:
    pass

MAX_CONDITION_NUMBER: Final = 1e3
"""Condition number above which a fit determines some parameters poorly."""


@dataclass(frozen=True, kw_only=True)
class Excite(RobotArgument, SingularityOption, SeedOption, OutputOption):
    """Design a motion that excites the parameters to identify.

    Every joint follows a finite Fourier series that starts and ends at rest. The trajectory is
    D-optimal for the base parameters of what is to be fitted. It stays inside the robot file's
    position, velocity and effort limits and inside the workspace, away from singularities. The
    command writes a trajectory_msgs/JointTrajectory on /delta_dynamics/joint_trajectory, and a CSV
    for `pkm-twin torques`.

    With --sweeps every joint alone sweeps its range up and down at three speeds, 1 : 4 : 16, and
    --duration is that of all sweeps; --harmonics, --trials and --seed are not used.
    """

    what: str = setting(
        "friction,rotor,payload,inertia", "what the fit identifies: some of friction,rotor,payload,inertia"
    )
    out: Path = setting(
        Path("excite.mcap"), "MCAP to write; the CSV has the same name with .csv", writes=True, endings=(".mcap",)
    )
    compare: Path | None = setting(None, "also report the condition number of this bag")
    friction: bool = setting(
        False, "slow sweeps up and down, one joint at a time, for friction", name="sweeps", older=("--friction",)
    )
    duration: float = setting(10.0, "duration, s", low=1.0, high=600.0)
    harmonics: int = setting(6, "harmonics per joint", low=3, high=50)
    rate: float = setting(100.0, "points per second", low=10.0, high=1000.0)
    share: float = setting(0.9, "fraction of all limits to use", low=0.05, high=1.0)
    acceleration: float | None = setting(None, "acceleration limit of every joint, rad/s2 or m/s2; default: none")
    trials: int = setting(300, "number of motions to try", low=10, high=10**6)

    @property
    def files(self) -> dict[str, Path]:
        """Files that the command writes, by key."""
        return {"out": self.out, "table": self.out.with_suffix(".csv")}


@command("Identification and calibration")
def excite(given: Excite) -> Report:
    """Plan an exciting trajectory; compare its condition number with that of a bag.

    :raises PkmTwinError: no trajectory keeps to the limits.
    """
    from pkm_twin.identification.excitation import Excitation, Judge, Sweeps, TrajectoryLimits, design_sweeps
    from pkm_twin.identification.excitation import optimize_excitation as design
    from pkm_twin.identification.parameters import file_parameters, parse_kinds
    from pkm_twin.recordings import Recording, read
    from pkm_twin.recordings.bags import write_motion

    machine = given.machine()
    judge = Judge.from_robot(machine, file_parameters(machine, parse_kinds(given.what)))
    other = None
    if given.compare is not None:
        recorded = read(given.compare, machine)
        other = judge.recorded_condition(recorded.time, recorded.q)
        if other is None:
            raise BagError("too few joint states in a row", path=given.compare, reason="too short")
    bounds = TrajectoryLimits(given.share, given.acceleration, given.singularity, given.rate)
    best: Sweeps | Excitation
    if given.friction:
        best = design_sweeps(judge, given.duration, bounds)
    else:
        with draw_progress("excite", given.trials) as update:
            best = design(
                judge, given.duration, given.harmonics, bounds, trials=given.trials, seed=given.seed, progress=update
            )
    time = np.arange(round(best.duration * bounds.rate) + 1) / bounds.rate
    time = time[time <= best.duration]
    plan = Recording(machine, time, *best.at(time))
    with convert_write_errors(given.files["table"]):
        for file in given.files.values():
            facts = {"source": "pkm-twin excite", "condition": best.condition}
            write_motion(file, plan, facts, given.overwrite)
    notes = []
    if other is not None:
        told = f"{other:.4g}" if np.isfinite(other) else "infinite, it does not excite all of them"
        notes.append(f"condition number of {given.compare}: {told}")
    if not best.condition < MAX_CONDITION_NUMBER and not given.friction:
        notes.append(
            f"a condition number above {MAX_CONDITION_NUMBER:g}: a fit will know some parameters badly; try a "
            "longer --duration, more --harmonics or --trials, a smaller --singularity, wider "
            "limits in the robot file, or fewer kinds with --what"
        )
    if isinstance(best, Sweeps):
        shape = [Fact("speeds", best.speeds), Fact("speed_units", machine.joint_units)]
        # Rotary and sliding joints have speeds of different units.
        units = np.array(machine.joint_units)
        rows = {unit: best.speeds[units == unit] for unit in machine.joint_units}
        ranges = " and ".join(f"{one.min():.2g} to {one.max():.2g} {unit}/s" for unit, one in rows.items())
        answer = f"every joint alone moves up and down at {ranges}"
    else:
        shape = [Fact("frequencies_Hz", best.harmonics / best.duration)]
        answer = f"condition number {best.condition:.4g} over {len(judge.columns)} base parameters"
    return Report(
        f"{machine.name}: {answer}, {len(time)} points in {best.duration:.4g} s",
        facts=[
            Fact("robot", machine.name),
            Fact("condition", best.condition),
            Fact("duration_s", best.duration, "s"),
            Fact("base_parameters", len(judge.columns)),
            *shape,
            Fact("compare", given.compare),
            Fact("condition_compared", other),
        ],
        notes=notes,
        files=given.files,
    )
