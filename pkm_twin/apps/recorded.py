# SPDX-License-Identifier: Apache-2.0
"""A recorded robot as arrays: joint states of a bag, its wrenches, and what it says of itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pkm_twin import load
from pkm_twin.bags.reader import Bag, open_bag
from pkm_twin.errors import BagError, MessageError
from pkm_twin.machine.robot import Robot
from pkm_twin.ros.messages import JointReader, JointSample, StampRules, read_wrench, stamp_of

Array = NDArray[np.float64]

JOINT_STATE = "sensor_msgs/msg/JointState"
WRENCH = "geometry_msgs/msg/WrenchStamped"
BASE_FRAME = "base_link"
PLATFORM_FRAME = "platform"


@dataclass(frozen=True)
class Recording:
    """Accepted joint states on a common time axis.

    stamps (n,) in ns; time (n,) in s since the first stamp; q, qd, effort (n, 3), None where the
    bag has none; wrench (n, 6) in fixed axes at the platform's origin, the one nearest in time,
    None without a wrench topic. ``rejected`` counts refused messages by reason.
    """

    robot: Robot
    bag: Bag
    stamps: NDArray[np.int64]
    time: Array
    q: Array
    qd: Array | None
    effort: Array | None
    wrench: Array | None
    rejected: Counter[str]
    first_reject: str

    @property
    def loaded(self) -> tuple[float, float] | None:
        """From when to when a payload was held, s, where the bag says so."""
        facts = self.bag.report.metadata.get("pkm_twin", {})
        if "payload_picked_s" not in facts:
            return None
        return float(facts["payload_picked_s"]), float(facts["payload_released_s"])

    @property
    def payload_mass(self) -> float:
        """Mass of that payload, kg."""
        return float(self.bag.report.metadata.get("pkm_twin", {}).get("payload_mass_kg", 0.0))


def robot_of(bag: Bag, name: str | None) -> Robot:
    """The robot by name, or the one that the bag's metadata names.

    :raises BagError: neither is given.
    """
    recorded = bag.report.metadata.get("pkm_twin", {}).get("robot")
    if name is None and recorded is None:
        raise BagError(
            "the bag names no robot; give it with --robot", path=bag.report.path, reason="no robot"
        )
    return load(name if name is not None else str(recorded))


def read_recording(
    path: str | Path, robot: str | None = None, progress: Callable[[int], None] | None = None
) -> Recording:
    """Read a bag's joint states and wrenches, every message checked as the nodes check it.

    :param progress: called with the number of messages read so far.
    :raises BagError: the bag is damaged, names no robot, or has no usable joint state.
    """
    bag = open_bag(path)
    machine = robot_of(bag, robot)
    topics = {
        kind: [name for name, info in bag.report.topics.items() if info.type == kind]
        for kind in (JOINT_STATE, WRENCH)
    }
    if not topics[JOINT_STATE]:
        raise BagError("no joint states in the bag", path=bag.report.path, reason="no joint states")
    reader, rules = JointReader(machine), StampRules(future_tolerance=2**62)
    samples: list[JointSample] = []
    wrenches: list[tuple[int, str, Array]] = []
    rejected: Counter[str] = Counter()
    first = ""
    for i, message in enumerate(bag.messages([*topics[JOINT_STATE], *topics[WRENCH]])):
        if progress is not None:
            progress(i + 1)
        try:
            if message.type == JOINT_STATE:
                sample = reader.joint_state(message.message, message.log_time, rules)
                if samples and sample.stamp <= samples[-1].stamp:
                    raise MessageError("stamp order", f"stamp {sample.stamp} is not after the last")
                samples.append(sample)
            else:
                wrenches.append(_wrench(message.message, message.log_time, rules))
        except MessageError as error:
            rejected[error.reason] += 1
            first = first or f"{message.topic}: {error}"
    if not samples:
        raise BagError(
            f"no usable joint state for {machine.name}: {first}",
            path=bag.report.path,
            reason="no joint states",
        )
    stamps = np.array([s.stamp for s in samples], np.int64)
    return Recording(
        machine,
        bag,
        stamps,
        (stamps - stamps[0]) / 1e9,
        np.array([s.q for s in samples]),
        _stacked([s.qd for s in samples]),
        _stacked([s.effort for s in samples]),
        _fixed(machine, stamps, samples, wrenches),
        rejected,
        first,
    )


def _wrench(message: Any, now: int, rules: StampRules) -> tuple[int, str, Array]:
    # Any frame that has a name: all but the base frame turn with the platform.
    frame = message.header.frame_id or PLATFORM_FRAME
    sample = read_wrench(message, now, rules, frame, accept_empty=False)
    return stamp_of(message.header), sample.frame, sample.wrench


def _stacked(values: list[Array | None]) -> Array | None:
    present = [v for v in values if v is not None]
    return np.array(present) if len(present) == len(values) else None


def _fixed(
    robot: Robot, stamps: NDArray[np.int64], samples: list[JointSample], wrenches: list[Any]
) -> Array | None:
    """The wrench nearest to each joint state, turned into fixed axes, shape (n, 6)."""
    if not wrenches:
        return None
    at = np.array([w[0] for w in wrenches], np.int64)
    right = np.clip(np.searchsorted(at, stamps), 1, max(1, len(at) - 1))
    right = np.minimum(right, len(at) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(at[left] - stamps) <= np.abs(at[right] - stamps), left, right)
    values = np.array([w[2] for w in wrenches])[nearest]
    turn = robot.rotation(robot.forward(np.array([s.q for s in samples])))
    moving = np.array([w[1] != BASE_FRAME for w in wrenches])[nearest]
    turn = np.where(moving[:, None, None], turn, np.eye(3))
    return np.concatenate(
        [np.einsum("nij,nj->ni", turn, values[:, k : k + 3]) for k in (0, 3)], axis=1
    )
