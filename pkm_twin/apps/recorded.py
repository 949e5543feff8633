# SPDX-License-Identifier: Apache-2.0
"""A recorded robot as arrays: joint states of a bag, its wrenches, and what it says of itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin import load, robot_names
from pkm_twin.apps.columns import check_units, read_columns, times_of
from pkm_twin.apps.loads import Load, load_of_columns, metadata_error, told_load
from pkm_twin.apps.topics import JOINT_STATE, Topics, choose_topics
from pkm_twin.apps.wrench_frames import FRAMES
from pkm_twin.bags.reader import Bag, open_bag
from pkm_twin.bags.storage import is_bag
from pkm_twin.errors import BagError, MessageError, ParameterError, one_line
from pkm_twin.messages.reading import JointReader, JointSample
from pkm_twin.messages.stamps import StampRules
from pkm_twin.messages.wrenches import WrenchSample
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.deflection import in_base_axes

Array = NDArray[np.float64]

WRENCH_AXES: Final = ("fx", "fy", "fz", "mx", "my", "mz")

POSE_MISS: Final = 1e-3
"""Difference between a table's pose and that of its joint positions, of the robot's size."""
BLOCK: Final = 4096
"""Samples computed at a time, so that memory stays flat."""
RECORDING: Final = "an MCAP file, a rosbag2 folder, or a CSV with columns time, JOINT.position ..."
"""What is a recording."""


@dataclass(frozen=True)
class Recording:
    """Accepted joint states on a common time axis, of n joints.

    stamps (samples,) in ns; time (samples,) in s since the first stamp; q, qd, effort (samples, n),
    None where the bag has none; wrench (samples, 6) in fixed axes at the platform's origin, the one
    nearest in time, None without a wrench topic. ``rejected`` counts refused messages by reason.
    ``bag`` is None of a table.
    """

    robot: Robot
    bag: Bag | None
    topics: Topics
    load: Load | None
    stamps: NDArray[np.int64]
    time: Array
    q: Array
    qd: Array | None
    effort: Array | None
    wrench: Array | None
    rejected: Counter[str]
    first_reject: str
    source: str = ""
    """The file, as it was named."""
    qdd: Array | None = None
    """Accelerations of a table that has them, shape (samples, n)."""

    @property
    def message_count(self) -> int:
        """How many messages the chosen topics have."""
        if self.bag is None:
            return len(self.time)
        names = (self.topics.joint_states, self.topics.wrench)
        return sum(self.bag.report.topics[name].count for name in names if name is not None)


def robot_of(bag: Bag, name: str | Robot | None) -> Robot:
    """The robot, by name too, or the one that the bag's metadata names.

    :raises BagError: neither is given, or the bag names one that is not in ``config/``.
    """
    if name is not None:
        return name if isinstance(name, Robot) else load(name)
    recorded = bag.report.metadata.get("pkm_twin", {}).get("robot")
    if recorded is None:
        raise BagError(
            "the bag names no robot; use --robot", path=bag.report.path, reason="no robot"
        )
    # Not a path: a bag does not choose which files are opened.
    if recorded not in robot_names():
        raise metadata_error(
            bag, "robot", recorded, f"one of {', '.join(robot_names())}; or give --robot"
        )
    return load(recorded)


def read_recording(
    path: str | Path,
    robot: str | Robot | None = None,
    progress: Callable[[int], None] | None = None,
    *,
    topics: Sequence[str] = (),
    carried: Load | None = None,
    limited: bool = True,
) -> Recording:
    """Read a bag's joint states and wrenches, every message checked as the nodes check it.

    Or a table, a CSV: see :func:`recorded_table`.

    :param progress: called with the number of messages read so far.
    :param topics: what to read, where names and joints do not tell.
    :param carried: the payload; by default the one that the bag tells of.
    :param limited: refuse what is beyond the robot's limits, as a node does.
    :raises BagError: the bag is damaged, names no robot, or has no usable joint state.
    :raises ParameterError: a table that is no recording.
    """
    if not is_bag(Path(path)):
        return recorded_table(Path(path), robot, carried)
    bag = open_bag(path)
    machine = robot_of(bag, robot)
    chosen = choose_topics(bag, machine, topics)
    carried = carried or told_load(bag)
    reader, rules = JointReader(machine, limited=limited), StampRules(future_tolerance=2**62)
    samples: list[JointSample] = []
    wrenches: list[WrenchSample] = []
    read_one = FRAMES.get().reader()
    rejected: Counter[str] = Counter()
    first = ""
    names = [name for name in (chosen.joint_states, chosen.wrench) if name is not None]
    for i, message in enumerate(bag.messages(names)):
        if progress is not None:
            progress(i + 1)
        try:
            if message.type == JOINT_STATE:
                sample = reader.joint_state(message.message, message.log_time, rules)
                if samples and sample.stamp <= samples[-1].stamp:
                    raise MessageError("stamp order", f"stamp {sample.stamp} is not after the last")
                samples.append(sample)
            else:
                wrenches.append(read_one(message.message, message.log_time))
        except MessageError as error:
            rejected[error.reason] += 1
            first = first or one_line(f"{message.topic}: {error}")
    if not samples:
        raise BagError(
            f"no usable joint state for {machine.name}: {first}",
            path=bag.report.path,
            reason="no joint states",
        )
    stamps = np.array([s.stamp for s in samples], np.int64)
    return Recording(
        robot=machine,
        bag=bag,
        topics=replace(chosen, frame=wrenches[0].frame if wrenches else ""),
        load=carried,
        stamps=stamps,
        time=(stamps - stamps[0]) / 1e9,
        q=np.array([s.q for s in samples]),
        qd=_stacked([s.qd for s in samples]),
        effort=_stacked([s.effort for s in samples]),
        wrench=_fixed(machine, stamps, samples, wrenches),
        rejected=rejected,
        first_reject=first,
        source=str(path),
    )


def recorded_table(
    path: Path, robot: str | Robot | None, carried: Load | None,
    efforts: Sequence[str] = ("measured", "effort"),
) -> Recording:  # fmt: skip
    """A recording as a CSV with columns ``time`` and ``JOINT.position``.

    Optionally ``JOINT.velocity`` and ``.acceleration``, the wrench ``fx fy fz mx my mz``, the
    payload as in ``motion_of_csv``, and of the columns of ``efforts``, ``JOINT.measured`` or else
    ``JOINT.effort``, the first that are there; a pose has to be that of the joints, and other
    columns are left alone.

    :raises ParameterError: no robot is given, a column is missing, a value is no finite number, or
        joint positions and pose are those of different machines.
    """
    if robot is None:
        _require_table(path)
        raise ParameterError("--robot", None, "a robot, because a table does not name its robot")
    machine = robot if isinstance(robot, Robot) else load(robot)
    columns = read_columns(path, machine)

    def stack(what: str) -> Array | None:
        names = [f"{joint}.{what}" for joint in machine.joint_names]
        missing = [name for name in names if name not in columns]
        if missing and len(missing) < len(names):
            raise ParameterError(str(path), ", ".join(columns), f"a column {missing[0]}")
        return None if missing else np.stack([columns[name] for name in names], -1)

    q = stack("position")
    if q is None or "time" not in columns:
        needed = ", ".join(f"{joint}.position" for joint in machine.joint_names)
        raise ParameterError(str(path), ", ".join(columns), f"columns time, {needed}")
    time, qd = times_of(path, columns["time"]), stack("velocity")
    found = (values for what in efforts if (values := stack(what)) is not None)
    check_units(path, machine, time, q, qd)
    pose = pose_of(machine, columns)
    if pose is not None:
        check_pose(path, machine, q, pose)
    wrench = None
    if any(axis in columns for axis in WRENCH_AXES):
        wrench = np.stack([columns.get(axis, np.zeros(len(time))) for axis in WRENCH_AXES], -1)
    return Recording(
        robot=machine, bag=None, topics=Topics("columns of the table"),
        load=carried or load_of_columns(path, time, columns),
        stamps=np.round(time * 1e9).astype(np.int64), time=time, q=q, qd=qd,
        effort=next(found, None), wrench=wrench,
        rejected=Counter(), first_reject="", source=str(path), qdd=stack("acceleration"),
    )  # fmt: skip


def pose_of(robot: Robot, columns: Mapping[str, Array]) -> Array | None:
    """A table's pose columns, shape (samples, m); None where one is missing."""
    if not all(name in columns for name in robot.pose_names):
        return None
    return np.stack([columns[name] for name in robot.pose_names], -1)


def check_pose(path: Path, robot: Robot, q: Array, pose: Array, how: str = "") -> None:
    """Reject a table whose joint positions and pose are not those of one machine.

    :param how: what else the table may be read as.
    :raises ParameterError: by the sample that is farthest off.
    """
    for begin in range(0, len(q), BLOCK):
        rows = slice(begin, begin + BLOCK)
        found, good = robot.try_forward(q[rows])
        off = found - pose[rows]
        turns = [i for i, unit in enumerate(robot.pose_units) if unit != "m"]
        off[:, turns] = (off[:, turns] + np.pi) % (2.0 * np.pi) - np.pi
        # What has no pose is rejected with its own reason later.
        size = np.where(good, np.linalg.norm(off * robot.pose_scales, axis=1), 0.0)
        worst = int(size.argmax())
        if size[worst] > POSE_MISS * robot.size:
            names = ", ".join(robot.pose_names)
            raise ParameterError(
                f"{path}: {names}, sample {begin + worst}",
                f"{1e3 * size[worst]:.4g} mm from the pose of the joint positions on {robot.name}",
                f"a table of this machine{how}",
            )  # fmt: skip


def _require_table(path: Path) -> None:
    """Refuse what is no recording of any robot.

    :raises ParameterError: no table, or one without times and positions.
    """
    try:
        columns = list(read_columns(path))
    except ParameterError as error:
        expected = f"{RECORDING} ({error})"
        raise ParameterError(str(path), "neither a bag nor a table", expected) from None
    if "time" not in columns or not any(name.endswith(".position") for name in columns):
        raise ParameterError(str(path), f"columns {one_line(', '.join(columns), 80)}", RECORDING)


def _stacked(values: list[Array | None]) -> Array | None:
    present = [v for v in values if v is not None]
    return np.array(present) if len(present) == len(values) else None


def _fixed(
    robot: Robot, stamps: NDArray[np.int64], samples: list[JointSample],
    wrenches: list[WrenchSample],
) -> Array | None:  # fmt: skip
    """The wrench nearest to each joint state, rotated into fixed axes, shape (samples, 6)."""
    if not wrenches:
        return None
    wrenches.sort(key=lambda wrench: wrench.stamp)
    at = np.array([w.stamp for w in wrenches], np.int64)
    right = np.clip(np.searchsorted(at, stamps), 1, max(1, len(at) - 1))
    right = np.minimum(right, len(at) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(at[left] - stamps) <= np.abs(at[right] - stamps), left, right)
    values = np.array([w.wrench for w in wrenches])[nearest]
    if wrenches[0].frame == FRAMES.get().base_frame:
        return values
    return in_base_axes(values, robot.rotation(robot.forward(np.array([s.q for s in samples]))))
