# SPDX-License-Identifier: Apache-2.0
"""Torques, their terms and the joint reactions of a recorded or tabulated motion, as a table."""

from __future__ import annotations

import csv
import importlib.util
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import dynamics_terms, inverse_dynamics, reactions, torque_deviation
from delta_dynamics.rest import friction_reach, moving_rates
from pkm_twin import load
from pkm_twin.apps.columns import check_units, read_columns, times_of
from pkm_twin.apps.limits import beyond_limits
from pkm_twin.apps.loads import Load, by_load, load_of_columns, payload_columns, told_load
from pkm_twin.apps.recorded import (
    WRENCH_AXES,
    check_pose,
    pose_of,
    read_recording,
    robot_of,
)
from pkm_twin.apps.recorded_motion import at_rest, motion
from pkm_twin.apps.topics import JOINT_STATE
from pkm_twin.apps.trajectories import read_trajectory
from pkm_twin.bags.reader import open_bag
from pkm_twin.bags.storage import is_bag
from pkm_twin.errors import (
    BagError,
    ParameterError,
    PkmTwinError,
    SingularityError,
    UnknownNameError,
    UnreachableError,
)
from pkm_twin.files import STANDARD, replacing
from pkm_twin.paths.joint_path import joint_rates
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.rest import gradient_gain, rate_doubt

Array = NDArray[np.float64]
BLOCK = 4096
"""Samples computed at a time, so that memory stays flat."""
ENDINGS = (".csv", ".parquet", ".mat")
FOLLOW = ("joints", "pose")
MOST_EFFORT = 1e9
"""Greatest effort or wrench of a file that can be a machine's, N m or N."""
INPUTS = ("position", "velocity", "acceleration")
BEYOND_LIMITS = "beyond_limits"
MAPPED = "tables use the model's joint values; joint_map applies to messages and bags only"
"""Printed for a robot that has a map."""


@dataclass(frozen=True)
class Motion:
    """A motion of one robot of n joints: time (samples,), s; q, qd, qdd (samples, n), rad or m and
    per s and s2; wrench (samples, 6), N and N m, fixed axes; measured efforts (samples, n).

    ``load`` is a payload beside the robot's own. ``notes`` are for people: what was read and what
    was left out. ``still`` (samples, n): where differentiation cannot tell a joint from one at
    rest, so that dry friction has no direction; None is nowhere.
    """

    robot: Robot
    time: Array
    q: Array
    qd: Array
    qdd: Array
    wrench: Array
    measured: Array | None = None
    load: Load | None = None
    notes: tuple[str, ...] = ()
    still: NDArray[np.bool_] | None = None
    planned: Array | None = None
    """Efforts of a planned motion, shape (samples, n)."""


def motion_of(
    path: Path, robot: str | Robot, topics: Sequence[str] = (), carried: Load | None = None,
    follow: str | None = None,
) -> Motion:  # fmt: skip
    """The motion of a bag or a table; errors as of the two functions below."""
    if not is_bag(path):
        motion = motion_of_csv(path, robot, carried, follow)
    elif follow is not None:
        raise ParameterError("follow", follow, "no --follow: a bag has no pose columns")
    else:
        motion = motion_of_bag(path, robot, topics, carried)
    given = (("wrench", motion.wrench), ("efforts", motion.measured), ("efforts", motion.planned))
    for name, values in given:
        if values is not None and not np.abs(values).max(initial=0.0) <= MOST_EFFORT:
            row = int(np.abs(values).max(1).argmax())
            value = float(np.abs(values[row]).max())
            raise ParameterError(
                f"{path}: {name}, sample {row}", value, f"up to {MOST_EFFORT:g} N or N m"
            )
    return motion


def motion_of_bag(
    path: Path, robot: str | Robot | None, topics: Sequence[str] = (), carried: Load | None = None
) -> Motion:
    """The motion that a bag recorded, accelerations by the node's differentiator.

    Of a bag without joint states, the motion of its JointTrajectory as it is.

    Messages that a node rejects are left out, but not those beyond the robot's limits: see
    :func:`pkm_twin.apps.limits.beyond_limits`.

    :raises BagError: the bag is damaged, or has too few joint states in a row.
    """
    bag = open_bag(path)
    if not any(topic.type == JOINT_STATE for topic in bag.report.topics.values()):
        machine = robot_of(bag, robot)
        plan = read_trajectory(bag, machine)
        if plan is not None:
            time, q, qd, qdd, planned = plan
            still, held = np.zeros((len(time), 6)), carried or told_load(bag)
            return Motion(machine, time, q, qd, qdd, still, load=held, planned=planned)
    r = read_recording(path, robot, topics=topics, carried=carried, limited=False)
    qd, qdd, used = motion(r)
    if not used.any():
        text = f"too few joint states in a row to differentiate: {len(r.time)}"
        raise BagError(text, path=path, reason="too short")
    wrench = np.zeros((len(r.time), 6)) if r.wrench is None else r.wrench
    refused = ", ".join(f"{reason}: {count}" for reason, count in r.rejected.items())
    return Motion(
        r.robot,
        r.time[used],
        r.q[used],
        qd[used],
        qdd[used],
        wrench[used],
        None if r.effort is None else r.effort[used],
        r.load,
        (
            str(r.topics),
            f"payload: {r.load or 'as in the robot file'}",
            *(
                [f"rejected messages, left out: {refused}; first: {r.first_reject}"]
                if refused
                else []
            ),
            *([] if r.robot.controller.plain else [MAPPED]),
        ),
        at_rest(r, qd)[used],
    )


def motion_of_csv(
    path: Path, robot: str | Robot, carried: Load | None = None, follow: str | None = None
) -> Motion:
    """A motion from a CSV with a header row.

    Columns, in any order: ``time``; for every joint NAME ``NAME.position``, or in their place all
    coordinates of the pose (m, rad); optionally ``NAME.velocity`` and ``NAME.acceleration`` (of all
    joints or of none; of the coordinates where the joints follow the pose), and the wrench ``fx fy
    fz mx my mz``. Absent rates are differentiated by second-order differences; below what these can
    tell dry friction has no direction and is zero. Absent parts of the wrench are zero. Columns
    ``payload.mass`` (kg) and ``payload.x``, ``.y`` and ``.z`` (m) are the payload, unless one is
    given. Other columns are left alone, but not those that begin with a joint's name and are none
    of these or of :func:`table`'s: they are misspelt.

    :param follow: ``joints`` or ``pose``: which columns of a table that has both are the motion;
        None: both, which have to agree.
    :raises ParameterError: a column is missing or misspelt, a value is no finite number, or joint
        positions and pose are those of different machines.
    """
    if follow not in (None, *FOLLOW):
        raise UnknownNameError("follow", str(follow), FOLLOW)
    machine = robot if isinstance(robot, Robot) else load(robot)
    columns = read_columns(path, machine)
    _check_names(path, machine, columns)
    q = _stacked(path, columns, machine.joint_names, "position")
    pose = pose_of(machine, columns)
    posed = q is None or follow == "pose"
    if (pose is None and posed) or "time" not in columns:
        needed = ", ".join(f"{joint}.position" for joint in machine.joint_names)
        or_pose = ", ".join(machine.pose_names)
        raise ParameterError(
            str(path), ", ".join(columns), f"columns time, {needed}; or time, {or_pose}"
        )
    time = columns["time"]
    times_of(path, time)
    notes = []
    efforts: Array | None = None
    if q is None or (pose is not None and posed):
        assert pose is not None  # noqa: S101  one of the two is there
        q, qd, qdd = _of_pose(path, machine, columns, pose)
        how = "" if qd is not None else "; velocities and accelerations differentiated"
        notes.append(f"joints computed from the pose, {', '.join(machine.pose_names)}{how}")
    else:
        if pose is not None and follow is None:
            how = "; --follow pose plans its pose again, --follow joints ignores it"
            check_pose(path, machine, q, pose, how)
        qd, qdd = (_stacked(path, columns, machine.joint_names, what) for what in INPUTS[1:])
        if all(f"{joint}.effort" in columns for joint in machine.joint_names):
            efforts = _stacked(path, columns, machine.joint_names, "effort")
    check_units(path, machine, time, q, qd)
    if (qd is None or qdd is None) and len(time) < 3:
        raise ParameterError(str(path), f"{len(time)} rows", "3 or more, to differentiate")
    rates = _differentiated(q, time) if qd is None else qd
    carried = carried or load_of_columns(path, time, columns)
    return Motion(
        machine,
        time,
        q,
        rates,
        _differentiated(rates, time) if qdd is None else qdd,
        np.stack([columns.get(name, np.zeros(len(time))) for name in WRENCH_AXES], -1),
        load=carried,
        notes=(
            *([] if carried is None else [f"payload: {carried}"]),
            *notes,
            *([] if machine.controller.plain else [MAPPED]),
        ),
        still=None if qd is not None else np.abs(rates) <= rate_doubt(time, q, gradient_gain(time)),
        planned=efforts,
    )


def _check_names(path: Path, robot: Robot, columns: Mapping[str, Array]) -> None:
    """Reject columns that begin with a joint's name and are misspelt."""
    known = [f"{joint}.{what}" for joint in robot.joint_names for what in INPUTS]
    for name in columns:
        joint, dot, what = name.rpartition(".")
        computed = what in ("effort", "measured") or what.startswith("effort_")
        if dot and joint in robot.joint_names and name not in known and not computed:
            raise UnknownNameError(f"{path}: column", name, known)


def _stacked(
    path: Path, columns: Mapping[str, Array], names: Sequence[str], what: str
) -> Array | None:
    """Columns ``NAME.what``, shape (samples, names), of all names or of none.

    :raises ParameterError: of some.
    """
    wanted = [f"{name}.{what}" for name in names]
    missing = [name for name in wanted if name not in columns]
    if len(missing) == len(wanted):
        return None
    if missing:
        raise ParameterError(str(path), None, f"a column {missing[0]!r} as for the others")
    return np.stack([columns[name] for name in wanted], -1)


def _of_pose(
    path: Path, robot: Robot, columns: Mapping[str, Array], pose: Array
) -> tuple[Array, Array | None, Array | None]:
    """Joint positions of a pose, and their rates where the table has those of the pose."""
    q = robot.inverse(pose)
    # Joint rates in the table are those of the machine whose joint positions it has.
    rates = [_stacked(path, columns, robot.pose_names, what) for what in INPUTS[1:]]
    if set(robot.joint_names) & set(robot.pose_names) or rates[0] is None or rates[1] is None:
        return q, None, None
    return q, *joint_rates(robot, q, rates[0], rates[1])


def _differentiated(values: Array, time: Array) -> Array:
    """Second-order differences on uneven times, shape (samples, n)."""
    # What overflows is not finite, which the model refuses in one line.
    with np.errstate(all="ignore"):
        return np.gradient(values, time, axis=0, edge_order=2)


def table(m: Motion, progress: Callable[[int], None] | None = None) -> dict[str, Array]:
    """Named columns: time, the motion, efforts, their terms, and every joint's reaction.

    The terms ``NAME.effort_gravity``, ``NAME.effort_inertia`` ... sum to ``NAME.effort``. A
    reaction that rigid bodies do not determine is left empty (NaN) in the table. Where a sample is
    beyond the limits, there is a column :data:`BEYOND_LIMITS`, 1 for such samples, 0 for others.
    Of a robot whose file has an ``uncertainty``, ``NAME.effort_deviation`` is what that makes.

    :raises UnreachableError: by the sample's index in the motion.
    :raises SingularityError: likewise.
    :raises PkmTwinError: values so large that the model's result is not finite.
    """
    columns: dict[str, list[Array]] = {}

    def put(name: str, values: Array) -> None:
        columns.setdefault(name, []).append(values)

    outside, _ = beyond_limits(m.robot, m.q, m.qd)
    rates = m.qd if m.still is None else moving_rates(m.qd, m.still, friction_reach(m.robot))
    for robot, part in by_load(m.robot, m.load, m.time, BLOCK):
        begin = part.start
        state = (robot, m.q[part], rates[part], m.qdd[part], m.wrench[part])
        try:
            tau, terms, react = inverse_dynamics(*state), dynamics_terms(*state), reactions(*state)
            spread = torque_deviation(*state) if robot.uncertainty else None
        except UnreachableError as e:
            at = (begin + e.index[0],)
            raise UnreachableError("joint state", e.limb, at, e.miss) from None
        except SingularityError as e:
            at = (begin + e.index[0],)
            raise SingularityError("joint state", at, e.measure, e.bound) from None
        except ParameterError:
            raise
        except ValueError as e:
            seconds = f"{m.time[part][0]:g} to {m.time[part][-1]:g} s"
            raise PkmTwinError(f"between {seconds}: {e}") from None
        put("time", m.time[part])
        if outside.any():
            put(BEYOND_LIMITS, outside[part].astype(np.float64))
        for i, joint in enumerate(m.robot.joint_names):
            put(f"{joint}.position", m.q[part][:, i])
            put(f"{joint}.velocity", m.qd[part][:, i])
            put(f"{joint}.acceleration", m.qdd[part][:, i])
            put(f"{joint}.effort", tau[:, i])
            if spread is not None:
                put(f"{joint}.effort_deviation", spread[:, i])
            if m.measured is not None:
                put(f"{joint}.measured", m.measured[part][:, i])
            for field in fields(terms):
                put(f"{joint}.effort_{field.name}", getattr(terms, field.name)[:, i])
        for k, name in enumerate(react.names):
            for i, axis in enumerate(WRENCH_AXES):
                put(f"{name}.{axis}", react.wrenches[:, k, i])
        if progress is not None:
            progress(part.stop)
    whole = {name: np.concatenate(parts) for name, parts in columns.items()}
    return whole | payload_columns(m.load, m.time)


def check_target(path: Path) -> None:
    """Refuse a table's name before the work, not after it.

    :raises ParameterError: the ending is none of :data:`ENDINGS`, or pyarrow is missing for it.
    """
    if path.suffix not in ENDINGS and str(path) != STANDARD:
        raise ParameterError("out", str(path), f"a name that ends in {' or '.join(ENDINGS)}")
    if path.suffix == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        raise ParameterError("out", str(path), "CSV; Parquet needs the Python package pyarrow")


def write_table(columns: dict[str, Array], path: Path) -> None:
    """Write CSV, or where the name ends so Parquet (needs pyarrow) or a MATLAB file.

    The file appears only once it is complete. In MATLAB a name's points and spaces are underscores.

    :raises ParameterError: another ending, or pyarrow is missing.
    """
    check_target(path)
    with replacing(path) as hidden:
        {".parquet": _write_parquet, ".mat": _write_mat}.get(path.suffix, _write_csv)(
            columns, hidden
        )


def _write_csv(columns: dict[str, Array], path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for row in zip(*(values.tolist() for values in columns.values()), strict=True):
            # An undetermined reaction is an empty cell; repr keeps every digit.
            writer.writerow(["" if value != value else repr(value) for value in row])


def _write_mat(columns: dict[str, Array], path: Path) -> None:
    from scipy.io import savemat  # type: ignore[import-untyped]

    named = {re.sub(r"^(?=[\d_])", "x", re.sub(r"\W", "_", name)): v for name, v in columns.items()}
    if len(named) < len(columns):
        raise ParameterError("out", str(path), "CSV: names of columns are the same in MATLAB")
    with path.open("wb") as file:
        savemat(file, named, oned_as="column")


def _write_parquet(columns: dict[str, Array], path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    parquet.write_table(pyarrow.table(columns), path)
