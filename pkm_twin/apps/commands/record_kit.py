# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin record-kit``: what to play and note for the recording of a real machine."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pkm_twin.apps.commands.excite import write_motion
from pkm_twin.apps.frame import command
from pkm_twin.apps.options import OfRobot, Overwrites
from pkm_twin.console import refuse_existing, writing
from pkm_twin.report import Fact, Report
from pkm_twin.robot.robot import Robot
from pkm_twin.settings import setting


@dataclass(frozen=True, kw_only=True)
class RecordKit(OfRobot, Overwrites):
    """Prepare the recording of a real machine.

    Writes into a folder: the excitation motion and slow friction sweeps of `pkm-twin excite`
    (excitation.mcap, friction.mcap, and a CSV of each), NOTES.md with what to note, and README.md
    with the commands that record and judge. `pkm-twin anonymise` removes names and dates from a
    recording.
    """

    out: Path = setting(Path("record_kit"), "folder to write")
    duration: float = setting(20.0, "duration of the excitation motion, s", low=1.0, high=600.0)
    friction_duration: float = setting(120.0, "duration of the slow sweeps, s", low=1.0, high=600.0)
    share: float = setting(0.9, "fraction of all limits to use", low=0.05, high=1.0)
    trials: int = setting(300, "number of motions to try", low=10, high=10**6)


def record_kit(given: RecordKit) -> Report:
    """Write the motions, the sheet and the commands.

    :raises PkmTwinError: a file that is there, or no motion inside the limits.
    """
    from pkm_twin.identification.excitation import Bounds, Judge
    from pkm_twin.identification.parameters import file_parameters

    machine, out = given.machine(), given.out
    judge, bounds = Judge.of(machine, file_parameters(machine)), Bounds(given.share)
    motions = {"excitation": (False, given.duration), "friction": (True, given.friction_duration)}
    texts = {
        "README.md": readme(machine, given.robot, given.platform), "NOTES.md": notes(machine),
    }  # fmt: skip
    names = [*texts, *(f"{name}.{ending}" for name in motions for ending in ("mcap", "csv"))]
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    for name in names:
        refuse_existing(out / name, given.overwrite)
    told = []
    for name, (sweeps, seconds) in motions.items():
        best, _ = write_motion(
            judge, out / f"{name}.mcap", bounds, seconds, trials=given.trials, friction=sweeps,
            overwrite=given.overwrite,
        )  # fmt: skip
        told.append(f"{out / name}.mcap, .csv: {best.duration:.4g} s")
    for name, text in texts.items():
        with writing(out / name):
            (out / name).write_text(text, encoding="utf-8")
    return Report(
        answer=f"{out}: next, read {out / 'README.md'}",
        facts=[Fact("robot", machine.name), Fact("out", str(out)), Fact("files", names)],
        notes=told,
    )


def readme(machine: Robot, robot: str, platform: str | None = None) -> str:
    """The commands, for this robot."""
    words = [robot] if platform is None else [robot, "--platform", platform]
    return README.format(
        robot=shlex.join(words), name=machine.name, joints=", ".join(machine.controller.names),
        units=", ".join(dict.fromkeys(machine.effort_units)),
    )  # fmt: skip


def notes(machine: Robot) -> str:
    """The sheet, with a line for each joint."""
    rows = [f"| {name} | | | | | |" for name in machine.controller.names]
    return NOTES.format(name=machine.name, joints="\n".join(rows))


README: Final = """# Record {name}

Joints in the controller's names: {joints}. The robot file is `{robot}`.

## 1. Before

* Fill in `NOTES.md`: a recording without it can hardly be judged.
* Warm the drives up until friction is steady, at least 20 minutes.
* `excitation.csv` and `friction.csv` are the motions as tables. Check in your controller that they
  are free of collisions. Play them at reduced speed first, with a hand on the emergency stop.
* Start each motion from its first point: move there slowly.

## 2. Record

Joint states need position, velocity and effort, at 200 Hz or more, with the drive's own stamps:

    ros2 bag record -s mcap -o excitation_run /joint_states /wrench

Leave `/wrench` out without a force sensor. In a second terminal, with the topic of your controller:

    TOPIC=/joint_trajectory_controller/joint_trajectory
    pkm-twin play excitation.mcap --remap /delta_dynamics/joint_trajectory:=$TOPIC

Stop the recording with Ctrl-C after the motion. Then the slow sweeps in the same way:

    ros2 bag record -s mcap -o friction_run /joint_states /wrench
    pkm-twin play friction.mcap --remap /delta_dynamics/joint_trajectory:=$TOPIC

Record both twice, without a payload and with one whose mass you have weighed: `excitation_load` and
`friction_load` for the second pair. Without ROS, log time, position, velocity and effort of each
joint to a CSV (columns `time`, `JOINT.position`, `JOINT.velocity`, `JOINT.effort`).

## 3. Judge

    pkm-twin check excitation_run --robot {robot}
    pkm-twin check excitation_load --robot {robot} --payload MASS
    pkm-twin fit {robot} excitation_run friction_run --out fitted.yaml

Efforts are in {units}. If the drives report motor current, add `--torque-constant` to `fit`.

## 4. Send

    pkm-twin anonymise excitation_run --robot {robot} --out excitation_run.mcap
    pkm-twin anonymise friction_run --robot {robot} --out friction_run.mcap

The new bags have joint states, wrenches and trajectories alone, neutral names, and time from zero.
Send them with `NOTES.md`, the robot file and a licence that allows publication.
"""

NOTES: Final = """# Notes on the recording of {name}

Write "unknown" where you do not know: an estimate that looks like a measurement does harm.

| what | value |
|---|---|
| machine: type, size, age | |
| mounting: direction of gravity in the base frame | |
| robot file, and where its lengths and masses are from (drawing, CAD, scale) | |
| payload: mass (kg), centre of mass (m from the reference point), how weighed | |
| tool, cables and hoses on the platform | |
| temperature: ambient, drives; minutes of motion before | |
| lubrication, brakes, counterbalance | |
| controller: cycle time, source of the stamps, filters of velocity and effort | |
| frames: base and platform (origin, axes), home position of the joints | |
| wrench: instrument, frame, sign (on the platform or by it), zeroed when | |
| pose: instrument, its frame, standard deviation, when calibrated | |
| what went wrong or was unusual | |
| licence of the data, and how to name you | |

| joint | unit of effort (N m, N, A, % of what) | effort at motor or joint; gear ratio | torque constant | encoder at motor or load; resolution | drive and motor |
|---|---|---|---|---|---|
{joints}

| recording | what was played | payload | temperature | remarks |
|---|---|---|---|---|
| excitation_run | excitation.mcap | none | | |
| friction_run | friction.mcap | none | | |
| excitation_load | excitation.mcap | | | |
| friction_load | friction.mcap | | | |
"""  # noqa: E501

COMMAND = command(record_kit, "Identification and calibration")
