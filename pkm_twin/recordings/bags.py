# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings of bags as nodes read them; planned motions as bags, or as tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pkm_twin.bags.definitions import JOINT_STATE, TRAJECTORY
from pkm_twin.bags.reader import Bag, open_bag
from pkm_twin.bags.storage import METADATA_FILE
from pkm_twin.bags.writer import write_whole_bag
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import BagError, MessageError, ParameterError, one_line
from pkm_twin.mechanisms.catalogue import load, robot_names
from pkm_twin.messages.reading import (
    DeflectionSample,
    JointReader,
    JointSample,
    WrenchSample,
    read_deflection,
    read_wrench,
    rotate_to_base,
)
from pkm_twin.messages.stamps import SECOND, StampRules
from pkm_twin.recordings.origin import EffortModel, make_effort_model_columns, make_effort_model_facts
from pkm_twin.recordings.payload import make_metadata_error, read_load
from pkm_twin.recordings.recording import MODEL_VALUES_NOTE, ReadOptions, Recording
from pkm_twin.recordings.tables import write_table
from pkm_twin.recordings.topics import DEFINITIONS, Topics, choose_topics
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.wrench import PLATFORM

Stamps = NDArray[np.int64]

MAX_DEFLECTION_OFFSET: Final = 0.02
"""Largest time between a deflection and its wrench or joint state, s."""


def read_bag(
    path: Path, robot: str | Robot | None, how: ReadOptions, progress: Callable[[int], None] | None = None
) -> Recording:
    """Read a bag's joint states and its other measurements; messages are checked as by a node.

    If the bag has no joint states and ``how`` allows it, the motion of its JointTrajectory is read.

    :param progress: called with the number of messages read so far.
    :raises BagError: the bag is damaged, names no robot, or lacks what is asked for.
    """
    bag = open_bag(path)
    # The robot, which may be a name; without one, the robot of the bag's metadata.
    if robot is not None:
        machine = robot if isinstance(robot, Robot) else load(robot)
    else:
        recorded = bag.report.metadata.get("pkm_twin", {}).get("robot")
        if recorded is None:
            raise BagError("the bag names no robot; use --robot", path=bag.report.path, reason="no robot")
        # A bag names a shipped robot only, so that it cannot choose which files are opened.
        if recorded not in robot_names():
            raise make_metadata_error(bag, "robot", recorded, f"one of {', '.join(robot_names())}; or give --robot")
        machine = load(recorded)
    held = how.load or read_load(bag)
    kinds = {topic.type for topic in bag.report.topics.values()}
    if (how.trajectory or how.planned) and JOINT_STATE not in kinds and TRAJECTORY in kinds:
        plan = read_trajectory(bag, machine)
        if plan is not None:
            effort_model = EffortModel.from_bag(bag)
            computed = None if effort_model is None else plan.effort
            return replace(plan, load=held, source=str(path), effort_model=effort_model, computed=computed)
    topics = choose_topics(bag, machine, how.topics, how.deflected)
    found = _read_messages(bag, machine, topics, how, progress)
    frame = found.wrenches[0].frame if found.wrenches else ""
    topics = replace(topics, frame=frame, turns=bool(frame) and frame != how.base_frame)
    notes = [str(topics)]
    if found.rejected:
        refused = ", ".join(f"{reason}: {count}" for reason, count in found.rejected.items())
        notes.append(f"rejected messages, left out: {refused}; first: {found.first_reject}")
    if found.others:
        notes.append(f"left alone: {found.others} messages of other joints on {topics.joint_states}")
    if not machine.controller.is_identity:
        notes.append(MODEL_VALUES_NOTE)
    stamps = np.array([s.stamp for s in found.samples], np.int64)
    r = Recording(
        machine,
        (stamps - stamps[0]) / 1e9,
        np.array([s.q for s in found.samples]),
        qd=_stack_values([s.qd for s in found.samples]),
        effort=_stack_values([s.effort for s in found.samples]),
        load=held,
        source=str(path),
        notes=tuple(notes),
        start=int(stamps[0]),
        bag=bag,
        topics=topics,
        rejected=found.rejected,
        first_reject=found.first_reject,
    )
    if how.deflected:
        counts = {r.topics.wrench: found.wrenches, r.topics.deflection: found.deflections}
        for topic, samples in counts.items():
            if not samples:
                text = f"no usable message on {topic}: {r.first_reject}"
                raise BagError(text, path=r.source, reason="no messages")
        moved = {one.stamp: one for one in found.deflections}
        moved_stamps = np.array(sorted(moved), np.int64)
        times, wrench = _sort_wrenches(found.wrenches)
        apart = [np.abs(at[_find_nearest(at, moved_stamps)] - moved_stamps) / SECOND for at in (times, stamps)]
        near = moved_stamps[(np.array(apart) <= MAX_DEFLECTION_OFFSET).all(0)]
        if not len(near):
            raise BagError(
                f"no deflection on {r.topics.deflection} has a wrench and a joint state within "
                f"{MAX_DEFLECTION_OFFSET:g} s",
                path=r.source,
                reason="no pairs",
            )
        q, wrench = _interpolate(near, stamps, r.q), _interpolate(near, times, wrench)
        rotation = r.robot.platform(q)[1]
        values = np.array([moved[stamp].values for stamp in near.tolist()])
        fixed = np.array([moved[stamp].frame == how.base_frame for stamp in near.tolist()])
        return Recording(
            r.robot,
            (near - near[0]) / SECOND,
            q,
            wrench=rotate_to_base(wrench, rotation) if r.topics.turns else wrench,
            deflection=np.where(fixed[:, None], values, rotate_to_base(values, rotation)),
            source=r.source,
            notes=r.notes,
            start=int(near[0]),
            bag=r.bag,
            topics=r.topics,
            rejected=r.rejected,
            first_reject=r.first_reject,
        )
    if not found.wrenches:
        return r
    at, wrench = _sort_wrenches(found.wrenches)
    wrench = wrench[_find_nearest(at, stamps)]
    if topics.turns:
        wrench = rotate_to_base(wrench, machine.rotation(machine.forward(r.q)))
    return replace(r, wrench=wrench)


def list_bags(folder: Path) -> list[Path]:
    """List the recordings in a folder and below: MCAP files and rosbag2 folders, by name."""
    whole = {path.parent for path in folder.rglob(METADATA_FILE)}
    files = [p for p in folder.rglob("*.mcap") if not whole & set(p.parents)]
    return sorted([*whole, *files])


def is_collection(path: Path) -> bool:
    """Return whether a path is a folder of recordings, not a rosbag2 bag itself."""
    if not path.is_dir() or (path / METADATA_FILE).exists():
        return False
    # A rosbag2 folder without metadata has .db3 files side by side.
    return bool(list_bags(path)) and not any(path.glob("*.db3"))


class _BagMessages(NamedTuple):
    """The accepted messages of a bag's chosen topics; ``others``: joint states without the robot's joints."""

    samples: list[JointSample]
    wrenches: list[WrenchSample]
    deflections: list[DeflectionSample]
    rejected: Counter[str]
    first_reject: str
    others: int = 0


def _read_messages(
    bag: Bag, robot: Robot, topics: Topics, how: ReadOptions, progress: Callable[[int], None] | None
) -> _BagMessages:
    """Read the accepted messages of the chosen topics, joint states in the order of their stamps.

    :raises BagError: no joint state is accepted.
    """
    reader, rules = JointReader(robot, limited=how.limited), StampRules(future_tolerance=2**62)
    required_frame = how.wrench_frame

    def read_wrench_in_frame(message: Any, now: int) -> WrenchSample:
        """Read a wrench; without an option, the first known frame is required of all later ones."""
        nonlocal required_frame
        frame = message.header.frame_id
        if required_frame is None and frame in (PLATFORM, how.base_frame):
            required_frame = frame
        try:
            return read_wrench(message, now, rules, required_frame or PLATFORM, accept_empty=False)
        except MessageError as error:
            if error.reason != "frame" or not frame:
                raise
            raise MessageError(
                "frame",
                f"{error}; --wrench-frame accepts a frame that turns with the platform, "
                "--base-frame one with base axes",
            ) from None

    found, first = _BagMessages([], [], [], Counter(), ""), ""
    names = [topics.joint_states, topics.wrench, topics.deflection]
    own, others = set(robot.controller.names), 0
    for i, message in enumerate(bag.messages([name for name in names if name is not None])):
        if progress is not None:
            progress(i + 1)
        try:
            if message.topic == topics.joint_states:
                if own.isdisjoint(message.message.name) and message.message.name:
                    others += 1  # another publisher's, such as wheels
                    continue
                sample = reader.joint_state(message.message, message.log_time, rules)
                if found.samples and sample.stamp <= found.samples[-1].stamp:
                    raise MessageError("stamp order", f"stamp {sample.stamp} is not after the last")
                found.samples.append(sample)
            elif message.topic == topics.wrench:
                found.wrenches.append(read_wrench_in_frame(message.message, message.log_time))
            else:
                moved = read_deflection(message.message, message.log_time, rules)
                found.deflections.append(moved)
        except MessageError as error:
            text = f"{message.topic}: {error}"
            if error.reason == "zero stamp":
                # Log times cannot replace stamps, because they are the times of writing.
                text = (
                    f"{message.topic}: the stamp is zero; expected joint states with the time of each sample in "
                    "header.stamp; without them, record a table with a column time"
                )
            if how.deflected and error.reason == "frame" and message.topic == topics.wrench:
                # Wrenches of different frames cannot be interpolated.
                raise BagError(text, path=bag.report.path, reason="frames") from None
            found.rejected[error.reason] += 1
            first = first or one_line(text)
    if not found.samples:
        raise BagError(
            f"no usable joint state for {robot.name}: {first}", path=bag.report.path, reason="no joint states"
        )
    return found._replace(first_reject=first, others=others)


def _stack_values(values: list[Array | None]) -> Array | None:
    present = [v for v in values if v is not None]
    return np.array(present) if len(present) == len(values) else None


def _sort_wrenches(samples: list[WrenchSample]) -> tuple[Stamps, Array]:
    """Sort wrenches (k, 6) by stamp; of those with the same stamp the last is kept."""
    by_stamp = {one.stamp: one.wrench for one in samples}
    at = sorted(by_stamp)
    return np.array(at, np.int64), np.array([by_stamp[stamp] for stamp in at])


def _find_nearest(stamps: Stamps, others: Stamps) -> NDArray[np.intp]:
    """Return the index of the sorted stamp nearest to each of the others."""
    right = np.minimum(np.searchsorted(stamps, others), len(stamps) - 1)
    left = np.maximum(right - 1, 0)
    before = np.abs(stamps[left] - others) <= np.abs(stamps[right] - others)
    return np.where(before, left, right)


def _interpolate(stamps: Stamps, others: Stamps, values: Array) -> Array:
    """Interpolate values (k, n) linearly at the stamps."""
    at = (stamps - others[0]) / SECOND
    known = (others - others[0]) / SECOND
    return np.stack([np.interp(at, known, column) for column in values.T], -1)


TOPIC: Final = "/delta_dynamics/joint_trajectory"


def write_motion(path: Path, r: Recording, facts: Mapping[str, Any], overwrite: bool = False) -> None:
    """Write a planned motion: a bag with one JointTrajectory, FILE.mcap, or a table.

    A table has time, the joints' motion and efforts, the pose with its rates, and the model of the
    efforts (:mod:`~pkm_twin.recordings.origin`). In a bag, joint values are in the controller's
    units and offsets, and a zero stamp means "start on receipt".

    :param r: must have velocities and accelerations.
    :param facts: metadata of the bag in addition to robot and payload.
    :raises BagError: the bag exists or cannot be written.
    """
    q, qd, qdd, _ = r.motion
    if path.suffix != ".mcap":
        columns = {"time": r.time}
        for i, joint in enumerate(r.robot.joint_names):
            columns |= {f"{joint}.position": q[:, i], f"{joint}.velocity": qd[:, i], f"{joint}.acceleration": qdd[:, i]}
            columns |= {} if r.effort is None else {f"{joint}.effort": r.effort[:, i]}
        if r.pose is not None:
            rate = (r.robot.jacobian(q) @ qd[..., None])[..., 0]
            change = r.robot.pose_acceleration(q, qd, qdd)
            for word, values in (("", r.pose), (".velocity", rate), (".acceleration", change)):
                for i, name in enumerate(r.robot.pose_names):
                    # A joint and a coordinate may have the same name: the column is the joint's.
                    columns.setdefault(f"{name}{word}", values[:, i])
        write_table(columns | make_effort_model_columns(r.robot, r.load, r.wrench, r.time), path)
        return
    if r.wrench is not None and r.wrench.any():
        raise ParameterError("out", str(path), "a table: a bag's trajectory has no wrench")
    own = r.robot.controller
    empty: list[list[float]] = [[]] * len(r.time)
    efforts = empty if r.effort is None else own.controller_efforts(r.effort).tolist()
    rows = zip(
        r.time.tolist(),
        own.controller_positions(q).tolist(),
        own.controller_rates(qd).tolist(),
        own.controller_rates(qdd).tolist(),
        efforts,
        strict=True,
    )
    points = []
    for t, position, rate, change, force in rows:
        whole = round(t * SECOND)
        points.append(
            {
                "positions": position,
                "velocities": rate,
                "accelerations": change,
                "effort": force,
                "time_from_start": {"sec": whole // SECOND, "nanosec": whole % SECOND},
            }
        )
    message = {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
        "joint_names": list(own.names),
        "points": points,
    }
    told = {**facts, **make_effort_model_facts(r.robot, r.load)}
    metadata = {"pkm_twin": {key: str(value) for key, value in told.items()}}
    with write_whole_bag(path, overwrite, metadata) as bag:
        bag.add_topic(TOPIC, TRAJECTORY, definition=DEFINITIONS[TRAJECTORY])
        bag.write(TOPIC, message, 0)


def read_trajectory(bag: Bag, robot: Robot) -> Recording | None:
    """Read the motion of a bag's only JointTrajectory, in the model's numbers.

    None where the bag has no trajectory with velocities and accelerations.

    :raises BagError: one that a node rejects, or several trajectories.
    """
    names = [name for name, topic in bag.report.topics.items() if topic.type == TRAJECTORY]
    messages = list(bag.messages(names)) if names else []
    if not messages:
        return None
    if len(messages) > 1:
        text = f"{len(messages)} trajectories; expected one"
        raise BagError(text, path=bag.report.path, reason="trajectories")
    reader = JointReader(robot, limited=False, with_effort=True)
    try:
        plan = reader.trajectory(messages[0].message, 0)
    except MessageError as error:
        text = f"topic {names[0]}: {error}"
        raise BagError(text, path=bag.report.path, reason=error.reason) from None
    if plan.qd is None or plan.qdd is None or len(plan.times) < 2:
        return None
    return Recording(
        robot, plan.times, plan.q, plan.qd, plan.qdd, plan.effort, efforts="effort", bag=bag, topics=Topics(names[0])
    )
