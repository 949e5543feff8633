# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""One reader of recordings and planned motions: MCAP files, rosbag2 folders, tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from pkm_twin.bags.storage import is_bag
from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import FileError, ParameterError, UnknownNameError, one_line, warn_of_file
from pkm_twin.machine.joint_map import JointMap
from pkm_twin.machine.sections import DriveSpec
from pkm_twin.mechanisms.catalogue import load
from pkm_twin.messages.reading import MAX_DEFLECTION_M, MAX_DEFLECTION_RAD, MAX_EFFORT, MAX_FORCE, MIN_NORMAL
from pkm_twin.recordings.bags import read_bag
from pkm_twin.recordings.origin import EffortModel, is_effort_model_column
from pkm_twin.recordings.payload import read_table_load
from pkm_twin.recordings.recording import MODEL_VALUES_NOTE, ReadOptions, Recording
from pkm_twin.recordings.tables import (
    DEFLECTION,
    EFFORTS,
    PAYLOAD,
    RATES,
    UNITS,
    WRENCH,
    Dialect,
    Table,
    map_column_quantities,
    read_table,
)
from pkm_twin.robot.derivatives import joint_rates
from pkm_twin.robot.limits import beyond_limits
from pkm_twin.robot.robot import Robot

RECORDING: Final = "an MCAP file, a rosbag2 folder, or a table with columns time, JOINT.position ..."
COORDINATES: Final = ("joints", "pose")
VALUE_SIDES: Final = ("joint", "controller", "motor")
"""Where joint values are measured: at the joint, in the controller's units and offsets, or at the motor shaft."""
SAMPLES_PER_BLOCK: Final = 4096
"""Samples computed at a time, so that memory stays flat."""
MAX_COLUMN_VALUES: Final = dict(
    zip(
        (*WRENCH, *DEFLECTION),
        np.repeat([MAX_FORCE, MAX_FORCE, MAX_DEFLECTION_M, MAX_DEFLECTION_RAD], 3).tolist(),
        strict=True,
    )
)
"""Largest plausible magnitude of each column of a table, N, N m, m or rad; messages have the same bounds."""
MIN_STEP: Final = 1e-9
"""Smallest step between two times, s: the resolution of a bag's stamps."""
MAX_DURATION: Final = 1e6
"""Longest recording, s, as for trajectories."""
DEFAULT_READ_OPTIONS: Final = ReadOptions()


def read(
    path: str | Path,
    robot: str | Robot | None = None,
    how: ReadOptions = DEFAULT_READ_OPTIONS,
    progress: Callable[[int], None] | None = None,
) -> Recording:
    """Read a recording of a robot; without one, of the robot that the file names.

    Columns of a table, in any order: ``time``; for every joint NAME ``NAME.position``, or in their
    place all coordinates of the pose (m, rad); optionally ``NAME.velocity`` and
    ``NAME.acceleration`` (of the coordinates where the joints follow the pose), efforts, the wrench
    ``fx fy fz mx my mz`` and the deflection ``dx dy dz rx ry rz``, whose absent parts are zero or
    not measured, and the payload. Other columns are left alone.

    :param path: an MCAP file, a rosbag2 folder, a CSV or Parquet file, or ``-`` for a CSV in stdin.
    :param progress: called with the number of messages read so far.
    :raises BagError: the bag is damaged, names no robot, or has no usable joint state.
    :raises ParameterError: a table that is no recording of this robot, or an option that the file
        cannot have.
    """
    path = Path(path)
    if how.follow not in (None, *COORDINATES):
        raise UnknownNameError("follow", str(how.follow), COORDINATES)
    try:
        bag = is_bag(path)
    except OSError as error:
        raise FileError(path, error, RECORDING) from None
    if bag:
        if how.follow is not None:
            raise ParameterError("follow", how.follow, "no --follow: a bag has no pose columns")
        r = read_bag(path, robot, how, progress)
    elif how.topics:
        raise ParameterError("topic", how.topics[0], f"no --topic: {path} is a table")
    else:
        r = _read_table_recording(path, robot, how)
    return r if how.deflected else r.without_repeats


def _read_table_recording(path: Path, name: str | Robot | None, how: ReadOptions) -> Recording:
    if name is None:
        # Report an unreadable file first, and a missing robot name only afterwards.
        try:
            columns = list(read_table(path))
        except ParameterError as error:
            expected = f"{RECORDING} ({error})"
            raise ParameterError(str(path), "neither a bag nor a table", expected) from None
        if "time" not in columns or not any(name.endswith(".position") for name in columns):
            raise ParameterError(str(path), f"columns {one_line(', '.join(columns), 80)}", RECORDING)
        raise ParameterError("--robot", None, "a robot, because a table does not name its robot")
    robot = name if isinstance(name, Robot) else load(name)
    table, side = (read_table(path, map_column_quantities(robot, how.side), how.dialect), _find_map(robot, how.side))
    joints = robot.joint_names if side is None else side.names
    _reject_misspelt_columns(table, robot, joints, how)

    def stack_columns(word: str) -> Array | None:
        values = table.stack_if([f"{joint}.{word}" for joint in joints])
        if values is not None and word in EFFORTS[:2] and "effort" in how.dialect.units:
            # The column is in per cent of the motors' rated torques: convert it to N m.
            if how.side != "motor":
                raise ParameterError("--units", "percent", "--side motor: it is the motor's rated torque")
            rated = [drive.rated_torque for drive in _require_drives(robot)]
            if None in rated:
                raise ParameterError(f"{robot.name}: drive.rated_torque", None, "N m, for per cent of it")
            values = values * np.array(rated, np.float64)
        if values is None or side is None:
            return values
        if word == "current":
            # One factor, which includes the gear, converts it to an effort at the joint.
            return np.asarray(values * np.sign(side.factors))
        if word == "position":
            return side.positions(values)
        return side.efforts(values) if word in EFFORTS else side.rates(values)

    q = stack_columns("position")
    if q is None and any(f"{joint}.position" in table for joint in robot.joint_names):
        theirs = ", ".join(f"{joint}.position" for joint in joints)
        raise ParameterError("--side", how.side, f"columns {theirs}, or no --side")
    pose = None
    if all(name in table for name in robot.pose_names):
        pose = table.stack(robot.pose_names)
    posed = q is None or how.follow == "pose"
    deflection = table.fill(DEFLECTION, np.nan)
    times = table.get("time")
    if times is None and (how.deflected or deflection is not None):
        times = np.arange(float(table.rows))
    if (pose is None and posed) or times is None:
        needed = ", ".join(f"{joint}.position" for joint in joints)
        or_pose = f"; or time, {', '.join(robot.pose_names)}"
        raise ParameterError(
            str(path), ", ".join(table), f"columns time, {needed}{or_pose}; other names: --columns OURS=THEIRS"
        )
    time, notes, effort, word = read_times(path, times), [], None, how.efforts[0]
    effort_model = EffortModel.from_table(table)
    # A table with the terms of the model has computed efforts.
    computed = any(f"{joint}.effort_gravity" in table for joint in robot.joint_names)
    if computed:
        # Reject computed efforts without the wrench or payload that they were computed with.
        own = how.load is not None or robot.payload.mass > 0.0
        for term, (what, needed_columns) in {
            "effort_external": ("a wrench", WRENCH),
            "effort_payload": ("a payload", PAYLOAD),
        }.items():
            if any(name in table for name in needed_columns) or (needed_columns is PAYLOAD and own):
                continue
            for joint in robot.joint_names:
                most = np.abs(table.get(f"{joint}.{term}", np.zeros(1))).max()
                if most > 0.0:
                    raise ParameterError(
                        f"{table.path}: {joint}.{term}",
                        float(most),
                        f"{what} that the efforts were computed with: columns {', '.join(needed_columns)}",
                    )
    if posed:
        assert pose is not None  # noqa: S101  one of the two is there
        # Compute joint positions, and their rates if given, from the pose and its rates.
        q = robot.inverse(pose)
        # The rates of a table of poses are those of the pose coordinates.
        qd, qdd = (table.stack_if([f"{name}.{what}" for name in robot.pose_names]) for what in RATES[1:])
        if set(robot.joint_names) & set(robot.pose_names) or qd is None or qdd is None:
            q, qd, qdd = q, None, None
        else:
            q, qd, qdd = q, *joint_rates(robot, q, qd, qdd)
        rates = "" if qd is not None else "; velocities and accelerations differentiated"
        notes.append(f"joints computed from the pose, {', '.join(robot.pose_names)}{rates}")
    else:
        assert q is not None  # noqa: S101
        if pose is not None and how.follow is None:
            hint = "; --follow pose plans its pose again, --follow joints ignores it"
            check_pose(path, robot, q, pose, hint if how.planned else "")
        qd, qdd = map(stack_columns, RATES[1:])
    if not (posed and how.planned):
        for word in how.efforts:
            if how.planned or not computed or word != "effort":
                effort = stack_columns(word)
            if effort is not None:
                break
    check_units(path, robot, time, q, qd, how.dialect)
    wrench = table.fill(WRENCH)
    if how.deflected:
        for what, values, axes in (("wrench", wrench, WRENCH), ("deflection", deflection, DEFLECTION)):
            if values is None:
                raise ParameterError(str(path), f"no {what}", f"a column {axes[0]} or more of {', '.join(axes)}")
    efforts = (f"{joint}.{what}" for joint in joints for what in EFFORTS)
    # As in messages, reject impossible numbers and numbers below every sensor's resolution.
    for name, bound in (MAX_COLUMN_VALUES | dict.fromkeys(efforts, MAX_EFFORT)).items():
        sizes = np.abs(table.get(name, np.zeros(1)))
        bad = np.flatnonzero((sizes > bound) | ((sizes < MIN_NORMAL) & (sizes > 0.0)))
        if len(bad):
            raise ParameterError(
                f"{table.line(bad[0])}: {name}",
                float(table[name][bad[0]]),
                f"0, or {MIN_NORMAL:g} to {bound:g} in size",
            )
    held = how.load or read_table_load(robot, table, time)
    return Recording(
        robot,
        time,
        q,
        qd,
        qdd,
        effort,
        wrench,
        deflection,
        pose,
        held,
        efforts="model" if computed and word == "effort" else word,
        computed=stack_columns("effort") if (computed or effort_model is not None) and not posed else None,
        effort_model=effort_model,
        source=str(path),
        notes=(
            *notes,
            *([] if side is None else [f"values read as the {how.side}'s; results: the model's"]),
            *([] if robot.controller.is_identity or side is not None else [MODEL_VALUES_NOTE]),
        ),
        start=round(1e9 * float(times[0])),
    )


def _find_map(robot: Robot, side: str) -> JointMap | None:
    """Return the map from a table's joint values to the joints'; None if they are the joints' own.

    :raises ParameterError: motors of a robot without drives.
    """
    if side not in VALUE_SIDES:
        raise UnknownNameError("side", side, VALUE_SIDES)
    own = robot.controller
    if side != "motor":
        return own if side == "controller" else None
    turns = np.array([drive.turns for drive in _require_drives(robot)])
    zero = np.zeros(len(turns))
    factors = np.sign(own.factors) * turns
    return replace(own, factors=factors, offsets=zero, changes=zero, centres=zero)


def _require_drives(robot: Robot) -> list[DriveSpec]:
    for joint, drive in zip(robot.joint_names, robot.drives, strict=True):
        if drive is None:
            raise ParameterError(f"{robot.name}: drive of {joint}", None, "a drive, for its motor")
    return [drive for drive in robot.drives if drive is not None]


def _reject_misspelt_columns(table: Table, robot: Robot, joints: Sequence[str], how: ReadOptions) -> None:
    """Reject columns with a misspelt name, instead of ignoring them.

    :raises UnknownNameError: by the column.
    """
    inputs = [f"{joint}.{what}" for joint in joints for what in RATES]
    if how.planned:
        for name in (*table, *table.left_out):
            joint, dot, what = name.rpartition(".")
            computed = what in (*EFFORTS, *WRENCH) or what.startswith("effort_")
            known = computed or name in inputs or is_effort_model_column(name)
            if dot and joint in joints and not known:
                raise UnknownNameError(f"{table.path}: column", name, inputs)
    if how.deflected:
        known = ("time", *MAX_COLUMN_VALUES, *PAYLOAD, *robot.pose_names, *inputs)
        for name in table:
            _, dot, what = name.rpartition(".")
            if name not in known and (not dot or what == "position"):
                raise UnknownNameError(f"{table.path}: column", name, known)


def read_times(path: Path, values: Array) -> Array:
    """Return a column of times, s from its first.

    :raises ParameterError: they do not rise, or farther than a recording lasts.
    """
    # The difference of the largest floats overflows; the checks below reject it.
    with np.errstate(over="ignore"):
        time: Array = np.asarray(values - values[0], np.float64)
        flat = np.flatnonzero(~(np.diff(values) >= MIN_STEP))
    found = f"{values[flat[0]]}, then {values[flat[0] + 1]}" if len(flat) else ""
    if found or not time[-1] <= MAX_DURATION:
        raise ParameterError(
            f"{path}: time",
            found or f"{values[0]:g} to {values[-1]:g}",
            f"rising times, {MIN_STEP:g} s or more apart, up to {MAX_DURATION:g} s in all"
            + (
                ""
                if found and values[0] < 1e17
                else "; are these microseconds (--units us) or nanoseconds (--units ns)?"
            ),
        )
    return time


def check_pose(path: Path, robot: Robot, q: Array, pose: Array, hint: str = "") -> None:
    """Reject a table whose pose disagrees with the forward kinematics of its joint positions.

    :param hint: appended to the error: how else the table can be read.
    :raises ParameterError: they disagree; the error names the sample with the largest deviation.
    """
    for begin in range(0, len(q), SAMPLES_PER_BLOCK):
        rows = slice(begin, begin + SAMPLES_PER_BLOCK)
        found, good = robot.try_forward(q[rows])
        off = found - pose[rows]
        turns = [i for i, unit in enumerate(robot.pose_units) if unit != "m"]
        off[:, turns] = (off[:, turns] + np.pi) % (2.0 * np.pi) - np.pi
        # Joint positions without a forward-kinematics solution are rejected later, with the reason.
        size = np.where(good, np.linalg.norm(off * robot.pose_scales, axis=1), 0.0)
        worst = int(size.argmax())
        # Tolerance between pose and joint positions: 1e-3 of the machine's size.
        if size[worst] > 1e-3 * robot.size:
            names = ", ".join(robot.pose_names)
            raise ParameterError(
                f"{path}: {names}, sample {begin + worst}",
                f"{1e3 * size[worst]:.4g} mm from the pose of the joint positions on {robot.name}",
                f"a table of this machine{hint}",
            )


def check_units(path: Path, robot: Robot, time: Array, q: Array, qd: Array | None, dialect: Dialect) -> None:
    """Warn if positions, or times, are probably in other units (degrees, ms or us).

    Times are checked only if the file has no velocities, with which they would be compared later.

    :param time: shape (samples,); q and qd: shape (samples, n); qd is None if the file has no velocities.
    """
    if "angle" not in dialect.units and _is_in_degrees(robot, q):
        most = float(np.abs(q).max())
        warn_of_file(path, f"positions up to {most:.4g}; expected rad; are these degrees? --units deg")
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if qd is None and step > 0.2:
        unit = "milliseconds? --units ms" if step < 200.0 else "microseconds? --units us"
        warn_of_file(path, f"time: steps of {step:g} s; expected seconds; are these {unit}")


def _is_in_degrees(robot: Robot, q: Array) -> bool:
    """Return whether most joint states are unreachable in rad and all are reachable if read as degrees.

    States slightly beyond a limit are in rad: only those with a joint more than half a turn from
    zero count as unreachable.
    """
    turns = np.array([unit == "rad" for unit in robot.joint_units])
    if not turns.any():
        return False
    some = q[:: max(1, len(q) // 500)]

    def is_reachable(states: Array) -> Mask:
        """Return which states are within the limits and have a forward-kinematics solution."""
        outside, _ = beyond_limits(robot, states)
        return np.asarray(robot.try_forward(states)[1] & ~outside, np.bool_)

    far = np.abs(some[:, turns]).max(1) > np.pi
    if np.mean(far & ~is_reachable(some)) <= 0.5:
        return False
    return bool(is_reachable(np.where(turns, some * UNITS["deg"][1], some)).all())
