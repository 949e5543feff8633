# SPDX-License-Identifier: Apache-2.0
"""Planned motions as files: a JointTrajectory in a bag of its own, read back too, or a table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from pkm_twin.bags.reader import Bag, BagWriter
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import BagError, MessageError
from pkm_twin.messages.reading import JointReader
from pkm_twin.messages.stamps import SECOND
from pkm_twin.recordings.payload import load_facts, payload_columns
from pkm_twin.recordings.recording import Recording
from pkm_twin.recordings.tables import write_table
from pkm_twin.recordings.topics import DEFINITIONS, TRAJECTORY, Topics
from pkm_twin.robot.robot import Robot

TOPIC: Final = "/delta_dynamics/joint_trajectory"


def write_motion(
    path: Path, r: Recording, facts: Mapping[str, Any], overwrite: bool = False
) -> None:
    """Write a planned motion: a bag with one JointTrajectory, FILE.mcap, or a table.

    A table has time, the joints' motion and efforts, the pose with its rates, and the payload. In a
    bag numbers are the controller's, and a zero stamp means a start on receipt.

    :param r: with rates and accelerations.
    :param facts: of the bag's metadata, beside its robot and payload.
    :raises BagError: the bag exists or cannot be written.
    """
    if path.suffix != ".mcap":
        write_table(_columns(r) | payload_columns(r.load, r.time), path)
        return
    own = r.robot.controller
    q, qd, qdd, _ = r.motion
    empty: list[list[float]] = [[]] * len(r.time)
    efforts = empty if r.effort is None else own.controller_efforts(r.effort).tolist()
    rows = zip(
        r.time.tolist(), own.controller_positions(q).tolist(), own.controller_rates(qd).tolist(),
        own.controller_rates(qdd).tolist(), efforts, strict=True,
    )  # fmt: skip
    points = []
    for t, position, rate, change, force in rows:
        whole = round(t * SECOND)
        points.append(
            {
                "positions": position, "velocities": rate, "accelerations": change, "effort": force,
                "time_from_start": {"sec": whole // SECOND, "nanosec": whole % SECOND},
            }
        )  # fmt: skip
    message = {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
        "joint_names": list(own.names),
        "points": points,
    }
    told = {"robot": r.robot.name, **facts, **load_facts(r.load, float(r.time[-1]))}
    metadata = {"pkm_twin": {key: str(value) for key, value in told.items()}}
    with BagWriter(path, overwrite=overwrite, metadata=metadata, flush_period=None) as bag:
        bag.add_topic(TOPIC, TRAJECTORY, definition=DEFINITIONS[TRAJECTORY])
        bag.write(TOPIC, message, 0)


def _columns(r: Recording) -> dict[str, Array]:
    """Columns of a table: time, the joints' motion and efforts, the pose and its rates."""
    q, qd, qdd, _ = r.motion
    words = {"position": q, "velocity": qd, "acceleration": qdd}
    words |= {} if r.effort is None else {"effort": r.effort}
    columns = {"time": r.time}
    for i, joint in enumerate(r.robot.joint_names):
        columns |= {f"{joint}.{word}": values[:, i] for word, values in words.items()}
    if r.pose is not None:
        rate = (r.robot.jacobian(q) @ qd[..., None])[..., 0]
        change = r.robot.pose_acceleration(q, qd, qdd)
        for word, values in (("", r.pose), (".velocity", rate), (".acceleration", change)):
            for i, name in enumerate(r.robot.pose_names):
                # A joint that has a coordinate's name is told as the joint.
                columns.setdefault(f"{name}{word}", values[:, i])
    return columns


def read_trajectory(bag: Bag, robot: Robot) -> Recording | None:
    """The motion of a bag's only JointTrajectory, in the model's numbers.

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
        robot, plan.times, plan.q, plan.qd, plan.qdd, plan.effort, efforts="effort", bag=bag,
        topics=Topics(names[0]),
    )  # fmt: skip
