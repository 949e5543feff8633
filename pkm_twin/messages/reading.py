# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Convert messages, live or decoded, to checked arrays.

Every function either returns finite, complete, ordered data or raises
:class:`~pkm_twin.errors.MessageError` with a short stable reason for counting. Times are
integers in nanoseconds.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import le
from typing import Any, Final, Literal, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError, SingularityError, UnreachableError
from pkm_twin.machine.joint_map import ControllerNumbers, JointMap
from pkm_twin.messages.stamps import MAX_DURATION, SECOND, StampRules, stamp_of
from pkm_twin.robot.robot import Robot

P = ParamSpec("P")
R = TypeVar("R")

MIN_NORMAL: Final = sys.float_info.min
"""Smallest normal number: a smaller value that is not zero comes from damaged data."""

MAX_VELOCITY: Final = 1e4
"""Largest joint velocity, rad/s or m/s, where the robot has no limit: beyond all machines."""
MAX_ACCELERATION: Final = 1e7
"""Largest joint acceleration, rad/s^2 or m/s^2: beyond all machines."""
MAX_EFFORT: Final = 1e7
"""Largest effort, N m or N: beyond all machines."""
MAX_POINTS: Final = 100_000
"""Most points of a trajectory."""
CONVERSION_ROUNDING: Final = 4.0 * sys.float_info.epsilon
"""Relative rounding error of a number that is converted to other units and back."""
MAX_NAME_CHARACTERS: Final = 80
"""Most characters of a name from a message that an error shows."""
COLUMNS: Final = {
    "positions": "position",
    "velocities": "velocity",
    "accelerations": "acceleration",
    "effort": "effort",
}
"""Fields of a trajectory's points that are read, and the singular of each name."""


ExtraJoints = Literal["refuse", "zero"]


_TO_MODEL: Final[Mapping[str, Callable[[JointMap, Array], Array]]] = {
    "position": JointMap.positions,
    "velocity": JointMap.rates,
    "acceleration": JointMap.rates,
    "effort": JointMap.efforts,
}
"""Conversions of a controller's joint values to the model's."""


class JointSample(NamedTuple):
    """One joint state in the robot's joint order; None for fields that the message leaves out."""

    stamp: int
    q: Array
    qd: Array | None
    effort: Array | None


@dataclass(frozen=True)
class EffortSample:
    """One message of stamped torques in the robot's joint order, shape (n,), N m or N.

    ``given``: the same numbers in the controller's units, to be forwarded bit by bit.
    """

    stamp: int
    effort: Array
    given: ControllerNumbers


@dataclass(frozen=True)
class Ragged:
    """The first point whose array has a wrong length, and that length."""

    point: int
    length: int


@dataclass(frozen=True)
class TrajectoryFields:
    """A trajectory's fields in the message's own order and units, points as arrays.

    ``times``: seconds and nanoseconds of ``time_from_start``, shape (2, p). ``columns``: values of
    each field of :data:`COLUMNS`, shape (p, n); None where no point has any.
    """

    header: Any
    names: tuple[str, ...]
    times: NDArray[np.int64]
    columns: Mapping[str, Array | Ragged | None]

    @classmethod
    def from_message(cls, message: Any) -> TrajectoryFields:
        """Read the fields of a trajectory_msgs/JointTrajectory, live or decoded."""
        points = message.points
        names = tuple(message.joint_names)
        durations = [point.time_from_start for point in points]
        times = np.array([[d.sec for d in durations], [d.nanosec for d in durations]], np.int64)
        columns: dict[str, Array | Ragged | None] = dict.fromkeys(COLUMNS)
        for what in COLUMNS:
            rows = [getattr(point, what) for point in points]
            odd = next((Ragged(i, len(row)) for i, row in enumerate(rows) if len(row) != len(names)), None)
            if any(map(len, rows)):
                columns[what] = odd or np.array(rows, np.float64)
        return cls(message.header, names, times, columns)


@dataclass(frozen=True)
class Trajectory:
    """A joint trajectory in the robot's joint order.

    ``stamp``: start, ns; zero for a start on receipt. ``times`` (p,), s; ``q``, ``qd``, ``qdd``
    (p, n); None where absent. ``columns``: for each joint of the message its index in the robot's
    order, -1 for a joint that the model lacks.
    """

    stamp: int
    times: Array
    q: Array
    qd: Array | None
    qdd: Array | None
    columns: tuple[int, ...]
    effort: Array | None = None
    """Shape (p, n), N m or N, if the reader reads efforts and every point has them."""


@dataclass
class JointReader:
    """Reads joint values of one robot from messages and converts them to the model's units.

    ``limited``: reject positions and velocities beyond the robot's limits, otherwise only those
    beyond all machines. ``extra_joints``: for joints of a trajectory that the model lacks, such as
    a Delta's telescopic fourth axis, either ``refuse`` the trajectory or answer with effort
    ``zero``. ``with_effort``: read a trajectory's efforts, too.
    """

    robot: Robot
    limited: bool = True
    extra_joints: ExtraJoints = "refuse"
    with_effort: bool = False
    _known: dict[tuple[str, ...], list[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        joints = len(self.robot.joint_names)
        limits = self.robot.limits
        position = limits.position if self.limited else None
        velocity = limits.velocity if self.limited else None
        reach = [100.0 if unit == "m" else 2000.0 * math.pi for unit in self.robot.joint_units]
        self.robot.controller.check_constant_ratios()
        self._map = None if self.robot.controller.is_identity else self.robot.controller
        self._names = self.robot.controller.names
        self._limited = {"position": position is not None, "velocity": velocity is not None}
        self._position = [(-r, r) for r in reach] if position is None else list(map(tuple, position.tolist()))
        rates = [MAX_VELOCITY] * joints if velocity is None else velocity.tolist()
        if self._map is not None:
            # A value at its limit must still be accepted after the rounding of the conversion.
            shift = np.abs(self._map.offsets / self._map.factors).tolist()
            self._position = [
                (low - CONVERSION_ROUNDING * (abs(low) + o), high + CONVERSION_ROUNDING * (abs(high) + o))
                for (low, high), o in zip(self._position, shift, strict=True)
            ]
            rates = [rate * (1.0 + CONVERSION_ROUNDING) for rate in rates]
        self._velocity = [(-rate, rate) for rate in rates]
        self.highest_velocity: tuple[float, ...] = tuple(rates)
        self._highest_velocity = np.array(rates)
        self._acceleration = [(-MAX_ACCELERATION, MAX_ACCELERATION)] * joints
        self._effort = [(-MAX_EFFORT, MAX_EFFORT)] * joints

    def joint_state(self, message: Any, now: int, rules: StampRules) -> JointSample:
        """Read a sensor_msgs/JointState, matched by name in any order; ignore other joints.

        Velocity and effort may be absent: empty, or NaN for all of the robot's joints, as
        joint_state_broadcaster sends quantities that no interface measures.

        :raises MessageError: a joint is missing, or a value or the stamp is invalid.
        """
        stamp, index, q = self._read_positions(message, now, rules)
        count = len(message.name)
        qd = self._read_values("velocity", message.velocity, count, index, self._velocity)
        effort = self._read_values("effort", message.effort, count, index, self._effort)
        return JointSample(stamp, q, qd, effort)

    def positions(self, message: Any, now: int, rules: StampRules) -> JointSample:
        """Read only the positions of a sensor_msgs/JointState; errors as of :meth:`joint_state`."""
        stamp, _, q = self._read_positions(message, now, rules)
        return JointSample(stamp, q, None, None)

    def _read_positions(self, message: Any, now: int, rules: StampRules) -> tuple[int, list[int], Array]:
        index = self._find_joints(message.name)
        count = len(message.name)
        stamp = rules.check(stamp_of(message.header), now)
        q = self._read_values("position", message.position, count, index, self._position)
        if q is None:
            what = "all positions are nan" if len(message.position) else "no positions"
            raise MessageError("empty", f"{what} for {count} names")
        return stamp, index, q

    def efforts(self, message: Any, now: int, rules: StampRules) -> EffortSample:
        """Read only names and efforts of a sensor_msgs/JointState, a source of torques."""
        index = self._find_joints(message.name)
        stamp = rules.check(stamp_of(message.header), now)
        count = len(message.name)
        effort = self._read_values("effort", message.effort, count, index, self._effort)
        if effort is None:
            raise MessageError("empty", f"no efforts for {count} names")
        given = np.array([message.effort[i] for i in index], np.float64)
        return EffortSample(stamp, effort, ControllerNumbers(given))

    def commands(self, values: Sequence[float]) -> Array:
        """Read the efforts of a std_msgs/Float64MultiArray: one per joint, without names."""
        count = len(self._names)
        if len(values) != count:
            raise MessageError("length", f"{len(values)} efforts for {count} joints")
        effort = self._read_values("effort", values, count, list(range(count)), self._effort)
        if effort is None:
            raise MessageError("not finite", "all efforts are nan")
        return effort

    def trajectory(self, message: Any, now: int) -> Trajectory:
        """Read a trajectory_msgs/JointTrajectory with exactly the robot's joints, in any order.

        A zero stamp means a start on receipt, as in ros2_controllers. The start may be in the
        future, the end must not be in the past. All points have a derivative, or none has.

        :param message: the message, or its :class:`TrajectoryFields`.
        """
        given = message if isinstance(message, TrajectoryFields) else None
        names = given.names if given else tuple(message.joint_names)
        index = self._match_trajectory_joints(names, given.times.shape[1] if given else len(message.points))
        fields = given or TrajectoryFields.from_message(message)
        stamp = stamp_of(fields.header)
        times = fields.times
        bad = (times[1] < 0) | (times[1] >= SECOND)
        if bad.any():
            raise MessageError("time", f"nanosec is {times[1, bad.argmax()]}, allowed 0 to {SECOND - 1}")
        nanoseconds: NDArray[np.int64] = times[0] * SECOND + times[1]
        if nanoseconds[0] < 0:
            raise MessageError("time", f"time_from_start begins at {nanoseconds[0] / SECOND:g} s")
        # Beyond MAX_DURATION seconds as floats do not resolve nanoseconds.
        if nanoseconds[-1] > MAX_DURATION:
            raise MessageError(
                "bounds", f"time_from_start ends at {nanoseconds[-1] / SECOND:g} s, at most {MAX_DURATION / SECOND:g} s"
            )
        falls = np.diff(nanoseconds) <= 0
        if falls.any():
            i = int(falls.argmax()) + 1
            raise MessageError(
                "time",
                f"time_from_start of point {i} is {nanoseconds[i] / SECOND:g} s, not after "
                f"{nanoseconds[i - 1] / SECOND:g} s",
            )
        end = stamp + int(nanoseconds[-1])
        if stamp != 0 and end < now:
            raise MessageError(
                "over",
                f"the trajectory ended {(now - end) / SECOND:.3f} s ago; a "
                "replayed bag needs use_sim_time and a /clock",
            )
        q = self._read_columns("positions", fields, index, self._position)
        if q is None:
            raise MessageError("empty", "the points carry no positions")
        return Trajectory(
            stamp,
            nanoseconds / SECOND,
            q,
            self._read_columns("velocities", fields, index, self._velocity),
            self._read_columns("accelerations", fields, index, self._acceleration),
            tuple(self._names.index(n) if n in self._names else -1 for n in names),
            self._read_columns("effort", fields, index, self._effort) if self.with_effort else None,
        )

    def check_shape(self, message: Any) -> None:
        """Check a trajectory's joint names, and the lengths of its first and last point.

        :raises MessageError: what :meth:`trajectory` rejects of these, however many points it has.
        """
        names, points = tuple(message.joint_names), message.points
        self._match_trajectory_joints(names, len(points))
        for point in (points[0], points[-1]):
            for what in COLUMNS:
                count = len(getattr(point, what))
                if count != len(names) and (count or what == "positions"):
                    text = f"{count} {what} for {len(names)} joints"
                    raise MessageError("length" if count else "empty", text)

    def _match_trajectory_joints(self, names: tuple[str, ...], points: int) -> list[int]:
        """Return the index of each of the robot's joints among a trajectory's names."""
        if not names or not points:
            raise MessageError("empty", f"{len(names)} joint names and {points} points")
        if points > MAX_POINTS:
            raise MessageError("bounds", f"{points} points, at most {MAX_POINTS}")
        unknown = [name for name in names if name not in self._names]
        if unknown and self.extra_joints == "refuse":
            raise MessageError(
                "unknown joint",
                f"joint {quote_name(unknown[0])} is not one of {', '.join(self._names)}; "
                "set extra_joints to zero for joints that the model lacks",
            )
        return self._find_joints(names)

    def check_derived(self, qd: Array, qdd: Array) -> None:
        """Check differentiated velocities and accelerations (..., n) as if measured."""
        if qd.ndim == 1:
            # For one sample Python floats are faster than numpy.
            rates, seconds = map(abs, qd.tolist()), map(abs, qdd.tolist())
            # Comparisons are false for NaN, whereas max would hide it.
            slow = all(map(le, rates, self.highest_velocity))
            if slow and all(second <= MAX_ACCELERATION for second in seconds):
                return
        for what, values, high in (("velocity", qd, self._highest_velocity), ("acceleration", qdd, MAX_ACCELERATION)):
            good = np.abs(values) <= high
            if not good.all():
                worst = tuple(np.argwhere(~good)[0])
                joint = int(worst[-1])
                bounds = self._velocity if what == "velocity" else self._acceleration
                raise self._make_bound_error(f"differentiated {what}", joint, float(values[worst]), *bounds[joint])

    def _find_joints(self, names: Sequence[str]) -> list[int]:
        """Return the index of each of the robot's joints among the names."""
        # tuple() of a tuple makes no copy.
        key = tuple(names)
        known = self._known.get(key)
        if known is not None:
            return known
        if not key:
            raise MessageError("empty", "no joint names")
        for joint in self._names:
            count = key.count(joint)
            if count == 0:
                given = ", ".join(map(quote_name, key[:8])) + (", ..." if len(key) > 8 else "")
                raise MessageError("missing joint", f"joint {joint!r} is missing; given: {given}")
            if count > 1:
                raise MessageError("duplicated joint", f"joint {joint!r} occurs {count} times")
        index = [key.index(joint) for joint in self._names]
        # The bounds keep unusual messages from filling the memory.
        if len(self._known) < 16 and sum(map(len, key)) < 4096:
            self._known[key] = index
        return index

    def _read_values(
        self, what: str, values: Sequence[float], count: int, index: list[int], bounds: Sequence[tuple[float, ...]]
    ) -> Array | None:
        if len(values) == 0:
            return None
        if len(values) != count:
            raise MessageError("length", f"{what}: {len(values)} values for {count} names")
        picked = [values[i] for i in index]
        if self._map is not None:
            picked = _TO_MODEL[what](self._map, np.array(picked)).tolist()
        for i, (value, (low, high)) in enumerate(zip(picked, bounds, strict=True)):
            if not low <= value <= high or (-MIN_NORMAL < value < MIN_NORMAL and value != 0.0):
                if all(map(math.isnan, picked)):
                    return None
                raise self._make_bound_error(what, i, value, low, high)
        return np.array(picked, np.float64)

    def _read_columns(
        self, what: str, fields: TrajectoryFields, index: list[int], bounds: Sequence[tuple[float, ...]]
    ) -> Array | None:
        given = fields.columns[what]
        if given is None:
            return None
        if isinstance(given, Ragged) or given.shape[1] != len(fields.names):
            point, length = (given.point, given.length) if isinstance(given, Ragged) else (0, given.shape[1])
            raise MessageError("length", f"point {point}: {length} {what} for {len(fields.names)} joint names")
        values = given[:, index]
        if self._map is not None:
            values = _TO_MODEL[COLUMNS[what]](self._map, values)
        box = np.array(bounds)
        size = np.abs(values)
        good = (values >= box[:, 0]) & (values <= box[:, 1]) & ((size >= MIN_NORMAL) | (size == 0.0))
        if not good.all():
            row, column = np.argwhere(~good)[0]
            low, high = bounds[column]
            value = float(values[row, column])
            error = self._make_bound_error(COLUMNS[what], int(column), value, low, high)
            raise MessageError(error.reason, f"point {row}: {error}")
        return np.ascontiguousarray(values)

    def _make_bound_error(self, what: str, joint: int, value: float, low: float, high: float) -> MessageError:
        # The sender knows the controller's names and units.
        name, quantity = self._names[joint], what.split()[-1]
        value, low, high = self.robot.controller.shown(joint, quantity, value, low, high)
        if not math.isfinite(value):
            return MessageError("not finite", f"{what} of {name} is {value}")
        if low <= value <= high:
            return MessageError("bounds", f"{what} of {name} is {value:g}, a denormal number")
        reason = "limit" if self._limited.get(quantity, False) else "bounds"
        return MessageError(reason, f"{what} of {name} is {value:g}, allowed {low:g} to {high:g}")


def quote_name(name: str) -> str:
    """Quote a name from a message; cut it after MAX_NAME_CHARACTERS characters."""
    return repr(name if len(name) <= MAX_NAME_CHARACTERS else name[:MAX_NAME_CHARACTERS] + "...")


def as_message_error(call: Callable[P, R], *arguments: P.args, **options: P.kwargs) -> R:
    """Call the model; convert its errors to a MessageError of the message that caused them."""
    try:
        return call(*arguments, **options)
    except MessageError:
        raise
    except UnreachableError as error:
        raise MessageError("unreachable", str(error)) from error
    except SingularityError as error:
        raise MessageError("singular", str(error)) from error
    except ValueError as error:
        # The input was finite: the model overflowed.
        raise MessageError("non-finite result", str(error)) from error


MAX_FORCE: Final = 1e7
"""Largest component of a force, N, or moment, N m: beyond all sensors."""


@dataclass(frozen=True)
class WrenchSample:
    """A wrench as received: force and moment, shape (6,), N and N m, in the axes of ``frame``."""

    stamp: int
    frame: str
    wrench: Array


def _check_numbers(labels: Sequence[str], values: Sequence[float], bound: float) -> None:
    """Reject values that are not finite, exceed a bound in size, or are denormal."""
    for label, value in zip(labels, values, strict=True):
        if not math.isfinite(value):
            raise MessageError("not finite", f"{label} is {value}")
        if abs(value) > bound:
            raise MessageError("bounds", f"{label} is {value:g}, allowed up to {bound:g}")
        if 0.0 < abs(value) < MIN_NORMAL:
            raise MessageError("bounds", f"{label} is {value:g}, a denormal number")


def read_wrench(message: Any, now: int, rules: StampRules, frame: str, accept_empty: bool) -> WrenchSample:
    """Read a geometry_msgs/WrenchStamped and check its frame; it may be empty only if allowed."""
    given = message.header.frame_id
    if given != frame and not (given == "" and accept_empty):
        hint = "; set accept_empty_frame to allow it" if given == "" else ""
        raise MessageError("frame", f"frame is {quote_name(given)}, expected {frame!r}{hint}")
    stamp = rules.check(stamp_of(message.header), now)
    force, torque = message.wrench.force, message.wrench.torque
    values = [force.x, force.y, force.z, torque.x, torque.y, torque.z]
    labels = ("force.x", "force.y", "force.z", "torque.x", "torque.y", "torque.z")
    _check_numbers(labels, values, MAX_FORCE)
    return WrenchSample(stamp, given or frame, np.array(values, np.float64))


class ImuSample(NamedTuple):
    """Angular velocity, rad/s, and acceleration less gravity, m/s2, (3,) each, in sensor axes."""

    stamp: int
    angular_velocity: Array
    acceleration: Array


def read_imu(message: Any, now: int, rules: StampRules, frame: str) -> ImuSample:
    """Read a sensor_msgs/Imu: angular velocity and acceleration, not the orientation.

    A covariance of zeros means that it is unknown, and is accepted.

    :raises MessageError: another frame, an invalid stamp, a value that is not finite or too large,
        or a quantity that the sensor does not measure.
    """
    given = message.header.frame_id
    if given != frame:
        raise MessageError("frame", f"frame is {quote_name(given)}, expected {frame!r}")
    stamp = rules.check(stamp_of(message.header), now)
    parts = []
    # Largest components, rad/s and m/s2: beyond all sensors.
    for name, bound in (("angular_velocity", 1e3), ("linear_acceleration", 1e4)):
        vector = getattr(message, name)
        if float(getattr(message, f"{name}_covariance")[0]) == -1.0:  # sensor_msgs/Imu: not measured
            raise MessageError("not measured", f"{name}_covariance[0] is -1: the sensor does not measure it")
        values = [vector.x, vector.y, vector.z]
        _check_numbers([f"{name}.{axis}" for axis in "xyz"], values, bound)
        parts.append(np.array(values, np.float64))
    return ImuSample(stamp, *parts)


MAX_DEFLECTION_M: Final = 0.1
MAX_DEFLECTION_RAD: Final = 0.1
"""Largest deflection, m and rad; formulas for small deflections do not hold beyond."""


class DeflectionSample(NamedTuple):
    """Displacement and small rotation (6,), m and rad, in the axes of ``frame``."""

    stamp: int
    frame: str
    values: Array


def read_deflection(message: Any, now: int, rules: StampRules) -> DeflectionSample:
    """Read a deflection: geometry_msgs/TransformStamped from the unloaded to the loaded platform.

    :raises MessageError: the frame has no name, the stamp is invalid, or a value is not finite or
        too large for a deflection.
    """
    frame = message.header.frame_id
    if not frame:
        raise MessageError("frame", "frame is '', expected the base's or the platform's")
    stamp = rules.check(stamp_of(message.header), now)
    move, turn = message.transform.translation, message.transform.rotation
    labels = ("translation.x", "translation.y", "translation.z", *"xyzw")
    values = (move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w)
    _check_numbers(labels, values, math.inf)
    length = math.hypot(*values[3:])
    if abs(length - 1.0) > 1e-3:
        raise MessageError("bounds", f"the rotation's length is {length:g}, not 1")
    # A quaternion and its negative describe the same rotation.
    sign = math.copysign(1.0, turn.w)
    size = math.hypot(turn.x, turn.y, turn.z)
    angle = 2.0 * math.atan2(size, abs(turn.w))
    scale = sign * (2.0 if size < 1e-9 else angle / size)
    rotation = (scale * turn.x, scale * turn.y, scale * turn.z)
    deflection = np.array((*values[:3], *rotation), np.float64)
    check_deflection(deflection)
    return DeflectionSample(stamp, frame, deflection)


def check_deflection(values: Array) -> None:
    """Reject a displacement and rotation, (6,), m and rad, that are too large for linear elasticity."""
    for what, size, unit, bound in (
        ("translation", float(np.abs(values[:3]).max()), "m", MAX_DEFLECTION_M),
        ("rotation", float(np.linalg.norm(values[3:])), "rad", MAX_DEFLECTION_RAD),
    ):
        if not size <= bound:
            raise MessageError("bounds", f"the platform's {what} is {size:g} {unit}, allowed up to {bound:g}")


def rotate_to_base(values: Array, rotation: Array) -> Array:
    """Rotate deflections (..., 6) from platform axes to base axes by rotations (..., 3, 3)."""
    shift, turn = (rotation @ values[..., k : k + 3, None] for k in (0, 3))
    return np.asarray(np.concatenate([shift[..., 0], turn[..., 0]], -1), np.float64)
