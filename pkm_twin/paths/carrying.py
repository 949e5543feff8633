# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Split paths at payload changes, and compute efforts with the payload of each part.

A path is split where its payload changes, so that no interval of its points has two payloads.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import inverse_dynamics
from pkm_twin.codegen.arrays import Array, doubles
from pkm_twin.errors import ParameterError
from pkm_twin.paths.geometry import MIN_DISTANCE, Path
from pkm_twin.paths.pieces import SubPiece
from pkm_twin.recordings.payload import Load
from pkm_twin.robot.robot import Robot


@dataclass(frozen=True)
class PayloadChange:
    """Describe a payload from a position of a path on.

    ``stretch``, ``piece``: it begins with this piece of the stretch, or at the stretch's end if it
    has no such piece; stretch -1 is the rest before the first. ``rest``: time of standstill there
    before the change, s. ``mass``: kg, None as in the robot's file, or the same. ``robot``: with
    the payload.
    """

    robot: Robot
    mass: float | None = None
    stretch: int = -1
    piece: int = 0
    rest: float = 0.0


def split_at_payloads(
    robot: Robot, path: Path, payload: Sequence[float | None] | None
) -> tuple[Path, tuple[PayloadChange, ...]]:
    """Split a path where its payload changes; return it with the payloads from where on.

    :param payload: from each waypoint on, kg, (waypoints,); None is the robot's own.
    :raises ParameterError: not one for each waypoint, or a mass that the robot cannot carry.
    """
    if payload is None:
        return path, (PayloadChange(robot),)
    expected = f"{len(path.marks)} masses (kg) or None, one for each waypoint"
    if isinstance(payload, str | Mapping) or np.ndim(np.asarray(payload, object)) != 1:
        raise ParameterError("payload", payload, expected)
    if len(payload) != len(path.marks):
        raise ParameterError("payload", f"{len(payload)} values", expected)
    own = robot.payload.mass
    try:
        given = [None if m is None else float(doubles(m, "payload")) for m in payload]
    except (TypeError, ValueError):
        raise ParameterError("payload", payload, expected) from None
    masses = [None if mass == own else mass for mass in given]
    robots = {m: robot if m is None else Load(m).apply_to(robot) for m in dict.fromkeys(masses)}
    result = [PayloadChange(robots[masses[0]], masses[0])]
    stretches = list(path.stretches)
    for mark, mass in zip(path.marks[1:], masses[1:], strict=True):
        if mass == result[-1].mass:
            continue
        k = 0
        if mark.stretch >= 0:
            # The piece that begins with the payload; one that the change lies within is split.
            pieces, distance = list(stretches[mark.stretch].pieces), mark.distance
            while k < len(pieces) and distance >= pieces[k].length - MIN_DISTANCE and distance > MIN_DISTANCE:
                distance -= pieces[k].length
                k += 1
            if k < len(pieces) and distance > MIN_DISTANCE:
                whole = pieces[k]
                pieces[k : k + 1] = SubPiece(whole, 0.0, distance), SubPiece(whole, distance, whole.length)
                stretches[mark.stretch] = replace(stretches[mark.stretch], pieces=tuple(pieces))
                k += 1
        result.append(PayloadChange(robots[mass], mass, mark.stretch, k, mark.rest))
    return replace(path, stretches=tuple(stretches)), tuple(result)


def compute_efforts(
    robots: Sequence[Robot],
    which: NDArray[np.int64],
    q: Array,
    qd: Array,
    qdd: Array,
    wrench: Array | None,
) -> Array:
    """Return efforts of samples, (k, n), each with its own robot by number ``which`` (k,)."""
    if all(robot is robots[0] for robot in robots):
        return inverse_dynamics(robots[0], q, qd, qdd, wrench)
    made = np.empty_like(q)
    for k, robot in enumerate(robots):
        rows = which == k
        if rows.any():
            made[rows] = inverse_dynamics(robot, q[rows], qd[rows], qdd[rows], wrench)
    return made
