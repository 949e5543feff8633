# SPDX-License-Identifier: Apache-2.0
"""Recordings as :mod:`pkm_twin.identification.plausible` needs them, corrected and as they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations, product
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.plausible import Problem, Retold, fault_of
from pkm_twin.identification.rows import LARGEST, Recorded, Rows, rows_of
from pkm_twin.machine.friction import turning_keys
from pkm_twin.machine.inertia import ten_numbers

OFFSET: Final = 0.1
"""Part of the efforts that a current sensor is off by."""
HEAVIER: Final = 0.3
"""Part of its value that a mass or a rotor of the file is off by."""
REACH: Final = 1.5
"""Machine sizes from the platform within which a payload is."""
SOME: Final = 2000
"""Samples by which other positions and times are judged: those that are explained worst."""
TIMES: Final = {
    "the time is in ms, not in s": 1e-3, "the time is in us, not in s": 1e-6,
    "the time is in ns, not in s": 1e-9, "the time is in minutes, not in s": 60.0,
    "the time is in s, and was taken for ms": 1e3,
}  # fmt: skip
ANGLES: Final = {
    "positions are in degrees": np.pi / 180.0, "positions are in rad, and were taken for degrees":
    180.0 / np.pi, "positions are in mm": 1e-3, "positions are in turns": 2.0 * np.pi,
}  # fmt: skip


def recording_fault(rows: Rows) -> str | None:
    """Why this machine cannot have made a recording; None where it can.

    :param rows: with all parameters of the file.
    """
    r, robot, everything = rows.recording, rows.model.robot, rows.model.parameters
    period, motion = float(np.median(np.diff(r.time))), rows.signals.motion
    still = replace(motion, qd=0.0 * motion.qd, qdd=0.0 * motion.qdd)
    moving, standing = (rows.model.columns(one)[0] for one in (motion, still))
    rubs = [group.kind == "friction" for group in everything.groups for _ in group.names]
    problem = problem_of(rows, np.where(rubs, 0.0, moving - standing))
    first = int(np.searchsorted(r.time, _worst(problem, SOME * period)))
    first = max(0, min(first, len(r.time) - SOME))

    def put_right(**changes: Array) -> Callable[[], Problem | None]:
        def make() -> Problem | None:
            cut: dict[str, Any] = {"time": r.time, "q": r.q, "effort": r.effort} | changes
            cut |= {"wrench": r.wrench, "held": r.held}
            few: dict[str, Any] = {
                k: None if v is None else v[first : first + SOME] for k, v in cut.items()
            }
            try:
                some = Recorded(r.name, **few, carried=r.carried)
                made = rows_of(robot, everything, some)
            except (PkmTwinError, ValueError, np.linalg.LinAlgError):
                return None
            needs = made.rest + made.table @ everything.values
            if not np.abs(needs).max() < LARGEST:
                return None
            return problem_of(made)

        return make

    names, eye = robot.joint_names, np.eye(robot.joints_count)
    retold: list[Retold] = [(text, put_right(time=r.time * scale)) for text, scale in TIMES.items()]
    retold += [(text, put_right(q=r.q * scale)) for text, scale in ANGLES.items()]
    if len(names) > 1:
        retold.append(("positions of all joints have the wrong sign", put_right(q=-r.q)))
    # A drive that counts the wrong way is mirrored at zero, where it was homed, or anywhere.
    middles = 0.0 * robot.graph.home, robot.graph.home, r.q.mean(0)
    for (name, e), middle in product(zip(names, eye, strict=True), middles):
        turned = 1.0 - 2.0 * e
        q = middle + turned * (r.q - middle)
        text = f"positions of {name} have the wrong sign (joint_map?)"
        retold.append((text, put_right(q=q)))
        text = f"positions and efforts of {name} have the wrong sign (joint_map?)"
        retold.append((text, put_right(q=q, effort=turned * r.effort)))
    for i, k in combinations(range(len(names)), 2):
        order = list(range(len(names)))
        order[i], order[k] = k, i
        text = f"positions of {names[i]} and {names[k]} are exchanged"
        retold.append((text, put_right(q=r.q[:, order])))
        text = f"{names[i]} and {names[k]} are exchanged"
        retold.append((text, put_right(q=r.q[:, order], effort=r.effort[:, order])))
    return fault_of(problem, names, retold, put_right(), period)


def _worst(problem: Problem, duration: float) -> float:
    """Where the part of such a duration begins that is explained worst, s."""
    total = np.concatenate([[0.0], np.cumsum(np.sum(problem.missed() ** 2, 1))])
    ends = np.searchsorted(problem.time, problem.time + duration)
    return float(problem.time[np.argmax(total[ends] - total[:-1])])


def problem_of(rows: Rows, inertial: Array | None = None) -> Problem:
    """The machines that may have made a recording, around the robot's file.

    :param inertial: the part of the rows' table that grows with the square of the rate of time.
    """
    robot, everything = rows.model.robot, rows.model.parameters
    tables = [rows.table] if inertial is None else [rows.table, inertial]
    told = rows.rest + rows.table @ everything.values
    size = np.sqrt(np.mean(told**2, 0))
    total = sum(body.mass for body in robot.graph.bodies.values())
    total += sum(rod.mass for rod in robot.graph.rods.values()) + robot.payload.mass
    parts: list[list[Array]] = []
    bounds: list[tuple[float, float]] = []
    prior: list[tuple[slice, float, float]] = []
    friction: list[bool] = []
    payload: list[bool] = []
    turning = turning_keys() | {"viscous"}
    for where, group in zip(everything.slices, everything.groups, strict=True):
        own, value = [table[..., where] for table in tables], float(group.values[0])
        scale, first = float(everything.scales[where][0]), len(bounds)
        rubs = group.kind == "friction" and group.name.rpartition(".")[2] in turning
        bound, known = (0.0, np.inf), (value, scale)
        if group.kind == "inertia":
            own = [(one @ group.values)[..., None] for one in own]
            bound, known = (0.3, 2.5), (1.0, HEAVIER)
        elif group.kind == "payload":
            own = [one @ _points(REACH * robot.size) for one in own]
            bound, known = (0.0, total), (value, scale)
        elif group.kind == "rotor" and value > 0.0:
            known = (value, HEAVIER * value)
        elif group.name.endswith("offset"):
            most = OFFSET * float(np.max(np.abs(own[0]).max((0, 1)) * size))
            bound, known = (-np.inf, np.inf), (value, most)
        parts.append(own)
        bounds += [bound] * own[0].shape[-1]
        friction += [rubs] * own[0].shape[-1]
        payload += [group.kind == "payload"] * own[0].shape[-1]
        if not rubs and known[1] > 0.0:
            prior.append((slice(first, len(bounds)), *known))
    rows_of_prior = np.zeros((len(prior), len(bounds)))
    for row, (columns, _, spread) in zip(rows_of_prior, prior, strict=True):
        row[columns] = 1.0 / spread
    low, high = np.array(bounds).T
    wholes = [np.concatenate(each, -1) for each in zip(*parts, strict=True)]
    return Problem(
        rows.effort, rows.change, rows.rest, wholes[0], low, high, rows_of_prior,
        np.array([value / spread for _, value, spread in prior]), np.array(friction), rows.counts,
        rows.signals.noise * np.sqrt(rows.signals.band), rows.time, np.array(payload),
        None if inertial is None else wholes[1],
    )  # fmt: skip


def _points(reach: float) -> Array:
    """Ten numbers of a kilogram at the platform's point and around it, shape (10, points)."""
    corners = (
        reach / np.sqrt(3.0) * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    )
    places = [np.zeros(3), *(reach * np.eye(3)), *(-reach * np.eye(3)), *corners]
    return np.stack([ten_numbers(1.0, place, np.zeros((3, 3))) for place in places], -1)
