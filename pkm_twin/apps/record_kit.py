# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin record-kit``: what to play and note for a recording, and a recording without names."""

from __future__ import annotations

import shlex
from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from pkm_twin.apps.excite import write_motion
from pkm_twin.apps.options import Json, Platform
from pkm_twin.bags.reader import Bag, BagWriter, open_bag
from pkm_twin.console import print_json, refuse_existing, writing
from pkm_twin.errors import BagError, ParameterError
from pkm_twin.messages.stamps import SECOND
from pkm_twin.options import OptionalPath, OptionalText
from pkm_twin.recordings.topics import DEFINITIONS, JOINT_STATE, TRAJECTORY, WRENCH, is_output
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.wrench import PLATFORM, WrenchSettings

KEPT: Final = {
    JOINT_STATE: "/joint_states", WRENCH: "/wrench", TRAJECTORY: "/joint_trajectory",
}  # fmt: skip
"""Types of topics that stay in an anonymised bag, and their neutral topics."""
NAMES: Final = {JOINT_STATE: "name", TRAJECTORY: "joint_names"}
"""Where their joints' names are."""
ONE_CLOCK: Final = 60 * SECOND
"""Stamps and log times that begin further apart are of two clocks, ns."""
DAY: Final = 86_400 * SECOND
"""Times further apart are of two clocks, ns."""
FRAMES: Final = ("", WrenchSettings.base_frame, PLATFORM)
"""Frames that keep their names: readers depend on them."""


def record_kit(
    robot: Annotated[
        OptionalText,
        typer.Argument(
            help="a robot's name, a YAML file or a URDF; with --anonymise optional: only its "
            "joints are kept"
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option(help="folder to write; with --anonymise the file, FILE.mcap")
    ] = Path("record_kit"),
    anonymise: Annotated[
        OptionalPath, typer.Option(help="write this bag again without names and dates")
    ] = None,
    keep_names: Annotated[
        bool,
        typer.Option("--keep-names", help="with --anonymise: keep names of joints and topics"),
    ] = False,
    duration: Annotated[
        float, typer.Option(help="duration of the exciting motion, s", min=1.0, max=600.0)
    ] = 20.0,
    friction_duration: Annotated[
        float, typer.Option(help="duration of the slow sweeps, s", min=1.0, max=600.0)
    ] = 120.0,
    share: Annotated[
        float, typer.Option(help="fraction of all limits to use", min=0.05, max=1.0)
    ] = 0.9,
    trials: Annotated[int, typer.Option(help="number of motions to try", min=10)] = 300,
    platform: Platform = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="replace files that exist")
    ] = False,
    json_output: Json = False,
) -> None:
    """Prepare the recording of a real machine, or remove names and dates from one.

    Writes into a folder: the exciting motion and slow friction sweeps of `pkm-twin excite`
    (excitation.mcap, friction.mcap, and a CSV of each), NOTES.md with what to note, and README.md
    with the commands that record and judge.

    With --anonymise BAG it writes a bag with only joint states, wrenches and trajectories: joints
    are joint_1, joint_2, ..., topics and frames have neutral names, time begins at zero, and
    metadata, definitions and QoS are written by pkm-twin. Topics that are left out are listed.
    """
    if anonymise is not None:
        _anonymise(anonymise, out, robot, platform, keep_names, overwrite, json_output)
        return
    if robot is None:
        raise typer.BadParameter("a robot is missing; give one, or --anonymise BAG")
    if keep_names:
        raise typer.BadParameter("--keep-names needs --anonymise")
    from pkm_twin import load
    from pkm_twin.identification.excitation import Bounds, Judge
    from pkm_twin.identification.parameters import file_parameters

    machine = load(robot, platform=platform)
    judge, bounds = Judge.of(machine, file_parameters(machine)), Bounds(share)
    motions = {"excitation": (False, duration), "friction": (True, friction_duration)}
    texts = {"README.md": readme(machine, robot, platform), "NOTES.md": notes(machine)}
    names = [*texts, *(f"{name}.{ending}" for name in motions for ending in ("mcap", "csv"))]
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    for name in names:
        refuse_existing(out / name, overwrite)
    for name, (sweeps, seconds) in motions.items():
        best, _ = write_motion(
            judge, out / f"{name}.mcap", bounds, seconds, trials=trials, friction=sweeps,
            overwrite=overwrite,
        )  # fmt: skip
        if not json_output:
            typer.echo(f"{out / name}.mcap, .csv: {best.duration:.4g} s")
    for name, text in texts.items():
        with writing(out / name):
            (out / name).write_text(text, encoding="utf-8")
    if json_output:
        print_json({"robot": machine.name, "out": str(out), "files": names})
        return
    typer.echo(f"{out}: next, read {out / 'README.md'}")


def _anonymise(
    source: Path,
    out: Path,
    robot: str | None,
    platform: str | None,
    keep_names: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    from pkm_twin import load, robot_names

    if out.suffix != ".mcap":
        raise ParameterError("out", str(out), "a name that ends in .mcap")
    if out.resolve().is_relative_to(source.resolve()):
        raise ParameterError("out", str(out), "another file than the recording's")
    machine = None if robot is None else load(robot, platform=platform)
    metadata = {"anonymised": "names and dates removed by pkm-twin record-kit"}
    if keep_names and machine is not None and robot in robot_names():
        metadata["robot"] = machine.name
    counts, dropped = anonymised(
        open_bag(source), out, machine, keep_names=keep_names, metadata=metadata,
        overwrite=overwrite,
    )  # fmt: skip
    if as_json:
        print_json({"out": str(out), "messages": counts, "left_out": dropped})
        return
    for topic, count in counts.items():
        typer.echo(f"{topic}: {count} messages")
    for topic, why in dropped.items():
        typer.echo(f"left out: {topic} ({why})")
    typer.echo(f"{out}: before you publish it, check that its numbers do not identify the product")


class _Names:
    """Neutral names in the order in which they are asked for."""

    def __init__(self, word: str, known: Sequence[str] = (), same: Sequence[str] = ()) -> None:
        self._word = word
        self._same = set(same)
        self._found: dict[str, str] = {}
        for name in known:
            self.of(name)

    def of(self, name: str) -> str:
        """The neutral name."""
        if name in self._same:
            return name
        return self._found.setdefault(name, f"{self._word}_{len(self._found) + 1}")


class _Beginnings:
    """Where clocks begin: times a day apart are of two, as before and after a clock was set."""

    def __init__(self, times: Sequence[int]) -> None:
        times = sorted(times)
        self._begins = [times[0], *(b for a, b in pairwise(times) if b - a > DAY)]

    def since(self, time: int) -> int:
        """Time since its clock's beginning, ns, from 1: a stamp of zero means no stamp."""
        return time - self._begins[bisect_right(self._begins, time) - 1] + 1


def anonymised(
    bag: Bag,
    out: Path,
    robot: Robot | None,
    *,
    keep_names: bool = False,
    metadata: dict[str, str],
    overwrite: bool = False,
) -> tuple[dict[str, int], dict[str, str]]:
    """Write a bag without names, dates and other topics.

    :param robot: only its joints are kept, in its order; None keeps all.
    :returns: messages by topic that is written, and by topic that is not the reason.
    :raises BagError: no joints to keep, a type whose fields are others, or the file exists.
    """
    dropped: dict[str, str] = {}
    topics: dict[str, str] = {}
    used: dict[str, int] = {}
    for name, info in bag.report.topics.items():
        if info.type not in KEPT:
            dropped[name] = info.type
        elif is_output(name):
            dropped[name] = "published by pkm_twin"
        elif not info.count:
            dropped[name] = "no messages"
        else:
            neutral = KEPT[info.type]
            used[neutral] = used.get(neutral, 0) + 1
            number = used[neutral]
            topics[name] = name if keep_names else neutral + (f"_{number}" if number > 1 else "")
    own = () if robot is None else robot.controller.names
    joints = _Names("joint", own)
    frames = _Names("frame", same=FRAMES)
    log, stamps = _beginnings(bag, topics, dropped, set(own))
    counts = dict.fromkeys(topics.values(), 0)
    with BagWriter(
        out, overwrite=overwrite, metadata={"pkm_twin": metadata}, flush_period=None
    ) as writer:
        for name, neutral in topics.items():
            kind = bag.report.topics[name].type
            writer.add_topic(neutral, kind, definition=DEFINITIONS[kind])
        for message in bag.messages(list(topics)):
            content = message.message
            header = {
                "stamp": _shifted(content.header.stamp, stamps),
                "frame_id": "" if message.type != WRENCH else frames.of(content.header.frame_id),
            }
            if message.type == WRENCH:
                body: dict[str, Any] = {"wrench": content.wrench}
            else:
                body = _joints(content, message.type, own, None if keep_names else joints)
            neutral = topics[message.topic]
            counts[neutral] += 1
            # Its publish time may be of a clock that has the date.
            writer.write(neutral, {"header": header} | body, log.since(message.log_time))
    return counts, dropped


def _joints(message: Any, kind: str, own: Sequence[str], joints: _Names | None) -> dict[str, Any]:
    """The fields of joint states or a trajectory with other names, and the robot's joints alone."""
    names = list(getattr(message, NAMES[kind]))
    kept = [names.index(name) for name in own if name in names] if own else range(len(names))
    new = [names[k] if joints is None else joints.of(names[k]) for k in kept]

    def of(values: Any) -> list[float]:
        # A field is empty, or has one number for each joint.
        return [values[k] for k in kept if k < len(values)]

    if kind == JOINT_STATE:
        words = ("position", "velocity", "effort")
        return {"name": new} | {word: of(getattr(message, word)) for word in words}
    fields = ("positions", "velocities", "accelerations", "effort")
    points = [
        {field: of(getattr(point, field)) for field in fields}
        | {"time_from_start": point.time_from_start}
        for point in message.points
    ]
    return {"joint_names": new, "points": points}


def _beginnings(
    bag: Bag, topics: dict[str, str], dropped: dict[str, str], own: set[str]
) -> tuple[_Beginnings, _Beginnings]:
    """Of log times and of stamps; the same where they are of one clock.

    Topics without one of the robot's joints are moved to ``dropped``.

    :raises BagError: nothing is left.
    """
    log: list[int] = []
    stamps: list[int] = []
    names: dict[str, set[str]] = {topic: set() for topic in topics}
    for message in bag.messages(list(topics)):
        log.append(message.log_time)
        content = message.message
        if message.type != WRENCH:
            names[message.topic].update(getattr(content, NAMES[message.type]))
        if stamp := _time(content.header.stamp):
            stamps.append(stamp)
    for topic, seen in names.items():
        if own and bag.report.topics[topic].type != WRENCH and not seen & own:
            dropped[topic] = f"joints {', '.join(sorted(seen)) or 'none'}"
            del topics[topic]
    if not any(bag.report.topics[topic].type != WRENCH for topic in topics):
        text = "no joint states or trajectories to keep"
        raise BagError(text, path=bag.report.path, reason="no joint states")
    if abs(min(log) - min(stamps, default=min(log))) < ONE_CLOCK:
        log = stamps = log + stamps
    return _Beginnings(log), _Beginnings(stamps)


def _time(stamp: Any) -> int:
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def _shifted(stamp: Any, begin: _Beginnings) -> dict[str, int]:
    time = _time(stamp)
    time = begin.since(time) if time else 0
    return {"sec": time // SECOND, "nanosec": time % SECOND}


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

    pkm-twin record-kit {robot} --anonymise excitation_run --out excitation_run.mcap
    pkm-twin record-kit {robot} --anonymise friction_run --out friction_run.mcap

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
