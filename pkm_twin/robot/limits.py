# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find joint states outside the limits by one rule, which nodes and commands share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import passive_values

ROUNDING: Final = 1e-9
"""Relative distance beyond a limit that counts as rounding."""


@dataclass(frozen=True)
class LimitViolation:
    """The position, velocity or effort of a joint that is farthest outside its range in a motion.

    ``index``: its sample; None for a single joint state.
    """

    joint: str
    quantity: str
    value: float
    low: float
    high: float
    unit: str
    index: int | None = None

    def __str__(self) -> str:
        where = "" if self.index is None else f" at sample {self.index}"
        return (
            f"{self.joint}.{self.quantity} is {self.value:.6g} {self.unit}{where}, limits {self.low:g} to {self.high:g}"
        )


def list_limits(robot: Robot) -> Iterator[tuple[str, Array, Array, list[str]]]:
    """Yield quantity, lowest and highest values (n,) and units of each limit in a robot's file."""
    limits = robot.limits
    units = list(robot.joint_units)
    if limits.position is not None:
        yield "position", limits.position[:, 0], limits.position[:, 1], units
    if limits.velocity is not None:
        yield "velocity", -limits.velocity, limits.velocity, [f"{unit}/s" for unit in units]
    if limits.effort is not None:
        yield "effort", -limits.effort, limits.effort, list(robot.effort_units)


def beyond_limits(
    robot: Robot, q: ArrayLike, qd: ArrayLike | None = None, effort: ArrayLike | None = None
) -> tuple[NDArray[np.bool_], list[LimitViolation]]:
    """Return which joint states are outside the limits, shape (...), and the farthest of each joint.

    q, qd, effort: shape (..., n), rad or m, per s, N m or N; at most one leading axis.
    """
    given = {"position": q, "velocity": qd, "effort": effort}
    values = {k: np.asarray(v, np.float64) for k, v in given.items() if v is not None}
    single = values["position"].ndim == 1
    outside = np.zeros(values["position"].shape[:-1], np.bool_)
    found = []
    for quantity, low, high, units in list_limits(robot):
        if quantity not in values:
            continue
        # A pose on the limit is within it despite rounding.
        slack = ROUNDING * np.maximum(1.0, np.maximum(np.abs(low), np.abs(high)))
        excess = np.maximum(values[quantity] - high, low - values[quantity]) - slack
        outside |= (excess > 0).any(-1)
        rows = excess.reshape(-1, excess.shape[-1])
        for i, name in enumerate(robot.joint_names):
            worst = int(rows[:, i].argmax()) if len(rows) else 0
            if len(rows) and rows[worst, i] > 0:
                value = float(values[quantity].reshape(rows.shape)[worst, i])
                at = None if single else worst
                bounds = float(low[i]), float(high[i])
                found.append(LimitViolation(name, quantity, value, *bounds, units[i], at))
    return outside, found


def find_first_beyond(robot: Robot, q: Array, *, actuated: bool = True) -> LimitViolation | None:
    """Find the first of positions (p, n) where a joint, passive or not, is beyond its limit.

    Errors as ``robot.forward``.

    :param actuated: also judge the actuated joints.
    """
    for names, values, bounds, units in _list_bounded(robot, q, actuated):
        excess = np.maximum(values - bounds[:, 1], bounds[:, 0] - values)
        bad = excess > ROUNDING * np.maximum(1.0, np.abs(values))
        if bad.any():
            row = int(bad.any(1).argmax())
            k = int(excess[row].argmax())
            low, high = bounds[k].tolist()
            return LimitViolation(names[k], "position", float(values[row, k]), low, high, units[k], row)
    return None


def _list_bounded(
    robot: Robot, q: Array, actuated: bool
) -> Iterator[tuple[Sequence[str], Array, Array, Sequence[str]]]:
    """Yield names, values (p, k), bounds (k, 2) and units of all bounded quantities at q (p, n)."""
    if actuated and robot.limits.position is not None:
        yield robot.joint_names, q, robot.limits.position, robot.joint_units
    most = getattr(robot.limits, "joint_angle", None)
    angles = None if most is None else robot.limit_angles(robot.forward(q))
    if angles is not None:
        yield ["joint angle"], np.abs(angles).max(1)[:, None], np.array([[0.0, most]]), ["rad"]
    if passive := robot.passive_limits:
        bounds = np.array([[one.low, one.high] for one in passive])
        units = ["m" if one.kind == "slide" else "rad" for one in passive]
        yield [one.joint for one in passive], passive_values(robot, q), bounds, units


def reject_beyond_limits(found: list[LimitViolation], where: str = "") -> None:
    """Reject a motion if :func:`beyond_limits` found a joint outside its limits.

    :param where: name of the recording, if there are several.
    :raises ParameterError: the first joint, its value and its range.
    """
    if not found:
        return
    first = found[0]
    at = "" if first.index is None else f" at sample {first.index}"
    more = len(found) - 1
    others = f" (and {more} more joint limit{'s' * (more > 1)})" if more else ""
    raise ParameterError(
        f"{where}{': ' if where else ''}{first.joint}.{first.quantity}{at}",
        round(first.value, 9),
        f"{first.low:g} to {first.high:g} {first.unit}{others}; use --beyond-limits to compute anyway",
    )
