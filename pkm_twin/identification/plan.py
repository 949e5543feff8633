# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Which poses to measure next, and how well a machine will then be known (D-optimal, greedy)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.identification.calibration import Estimate, Free, list_geometric_paths, list_parameters, make_start
from pkm_twin.identification.calibration_state import State, differentiate_lines, differentiate_poses
from pkm_twin.identification.measurements import MEASUREMENT_KINDS, Kind, Measured, Readings, parse_named_numbers
from pkm_twin.machine.rotations import skew
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import within_limits

MAX_CANDIDATES: Final = 300
MAX_MEASUREMENTS: Final = 150
"""Largest number of measurements of a plan."""


def parse_within(text: str | None) -> dict[str, tuple[float, float]]:
    """Parse ``x=-0.1:0.1, z=0``: least and greatest values, m or rad.

    :raises ParameterError: anything else.
    """
    right = "COORDINATE=LEAST:GREATEST, as x=-0.1:0.1"
    found = parse_named_numbers("--within", text or "", right)
    for name, ends in found.items():
        if len(ends) > 2 or ends[0] > ends[-1]:
            raise ParameterError("--within", f"{name}={':'.join(map(str, ends))}", right)
    return {name: (ends[0], ends[-1]) for name, ends in found.items()}


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Poses to measure, in order, and deviations before the first and after each, (count + 1,).

    ``joints``: (count, n) in the controller's numbers; ``second``: of a pair's other pose;
    ``poses``: (count, m). ``position``: standard deviation of the platform's position on the worst
    axis, m, root mean square over the workspace, apart from a rigid motion of it; ``quantity``: of
    what is measured, by kind; ``distance``, ``angle``: of distances of poses, over their length,
    and of angles between these lines, rad. ``known``: what will be known of the numbers.
    """

    joints: Array
    second: Array | None
    poses: Array
    position: Array
    quantity: Mapping[str, Array]
    distance: Array
    angle: Array
    known: Estimate

    def table(self, robot: Robot) -> str:
        """Write a CSV of joints, poses and an empty column for each quantity."""
        names = [f"{name}.position" for name in robot.controller.names]
        columns = [self.joints]
        if self.second is not None:
            names += [f"{name}_2" for name in names]
            columns.append(self.second)
        poses = [name for name in robot.pose_names if name not in self.quantity]
        shown = [robot.pose_names.index(name) for name in poses]
        rows = np.hstack([*columns, self.poses[:, shown]])
        lines = [[*names, *(f"planned_{name}" for name in poses), *self.quantity]]
        empty = [""] * len(self.quantity)
        lines += [[*(f"{v:.9g}" for v in row), *empty] for row in rows]
        return "".join(",".join(line) + "\n" for line in lines)

    def needed(self, accuracy: float) -> int | None:
        """Measurements after which the position is known so well, m; None: not by this plan."""
        found = np.flatnonzero(self.position <= accuracy)
        return int(found[0]) if len(found) else None


def plan(
    robot: Robot,
    kinds: Sequence[Kind],
    *,
    measured: Measured | None = None,
    within: Mapping[str, tuple[float, float]] | None = None,
    count: int | None = None,
    accuracy: float | None = None,
    noise: Mapping[str, float] | None = None,
    **options: Any,
) -> Plan:
    """Choose poses one after the other so that each tells most of the numbers.

    :param measured: what was measured already; its poses then bound the workspace.
    :param within: least and greatest value by pose coordinate, m or rad.
    :param accuracy: of the platform's position, m: as many as it needs; ``count``: so many.
    :param options: of :class:`~pkm_twin.identification.calibration.Free`.
    :raises ParameterError: no workspace is known, or two families of poses (pairs and single ones).
    """
    pair = {kind.pair for kind in kinds}
    if len(pair) > 1:
        raise ParameterError("--measure", "distance", "distance alone, or other kinds, in a plan")
    q = _candidates(robot, measured, dict(within or {}), kinds)
    paths = list_geometric_paths(robot, q, (free := Free(**options)).only)
    joints, position = np.asarray(robot.controller.controller_positions(q)), robot.platform(q)[0]
    first, noise = np.arange(len(q)), dict(noise or {})
    second = np.roll(first, len(q) // 2) if pair == {True} else None
    all_poses = Measured(joints, tuple(Readings(k, first, second, k.likely(position), first) for k in kinds), noise)
    parameters = list_parameters(robot, all_poses, paths, free)
    names, prior = [p.name for p in parameters], np.array([p.prior for p in parameters])
    fitted = [name for name in names if name in paths]
    state, covariance = make_start(robot, all_poses, fitted), np.asarray(np.eye(len(names)), np.float64)

    def scale_slopes(one: Measured, at: State) -> list[Array]:
        """Return derivatives (m, p) of each kind over its noise, in units of the priors."""
        sizes = [one.noise.get(r.kind.name, r.kind.noise) for r in one.readings]
        return [part[:, 0] * prior / size for part, size in zip(one.slopes(robot, at, names), sizes, strict=True)]

    if measured is not None:
        there = make_start(robot, measured, fitted)
        state.instrument.own |= {k: v for k, v in there.instrument.own.items() if k in names}
        table = np.concatenate(scale_slopes(measured, there))
        covariance = np.asarray(np.linalg.inv(covariance + table.T @ table), np.float64)
    usual = [noise.get(kind.name, kind.noise) for kind in kinds]
    rows = np.stack(scale_slopes(all_poses, state), 1)
    places = differentiate_poses(robot, state, names)[:, :3] * prior
    # A rigid motion of the workspace is the instrument's pose, not an error of the machine.
    rigid = np.concatenate([np.broadcast_to(np.eye(3), (len(q), 3, 3)), -skew(state.platform[0])], -1).reshape(-1, 6)
    flat = places.reshape(len(rigid), -1)
    places = (flat - rigid @ np.linalg.lstsq(rigid, flat, rcond=1e-9)[0]).reshape(places.shape)
    lines = differentiate_lines(robot, state, names)
    order, told = list[int](), list[tuple[float, float, float, Array]]()
    most = min(count or (MAX_MEASUREMENTS if accuracy else 12), MAX_MEASUREMENTS, len(q))
    while True:
        axes, seen = (np.sqrt(np.mean(np.sum((one @ covariance) * one, -1), 0)) for one in (places, rows))
        apart = (0.0, 0.0) if lines is None else lines.deviations(covariance * np.outer(prior, prior))
        told.append((float(axes.max()), *apart, seen))
        if len(order) == most or (accuracy and not count and told[-1][0] <= accuracy):
            break
        moved = rows @ covariance
        inner = moved @ np.swapaxes(rows, 1, 2) + np.eye(rows.shape[1])
        gain = np.linalg.slogdet(inner)[1]
        gain[order] = -1.0
        best = int(np.argmax(gain))
        order.append(best)
        covariance = covariance - moved[best].T @ np.linalg.solve(inner[best], moved[best])
    axis, distance, angle, each = zip(*told, strict=True)
    quantity = {k.name: size * seen for k, size, seen in zip(kinds, usual, np.array(each).T, strict=True)}
    deviations = prior * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    numbers = tuple(replace(p, value=p.before, deviation=float(d)) for p, d in zip(parameters, deviations, strict=True))
    return Plan(
        joints=joints[order],
        second=None if second is None else joints[second[order]],
        poses=robot.forward(q[order]),
        position=np.array(axis),
        quantity=quantity,
        distance=np.array(distance),
        angle=np.array(angle),
        known=Estimate(robot=robot, parameters=numbers, covariance=covariance * np.outer(prior, prior)),
    )


def _candidates(
    robot: Robot, measured: Measured | None, within: dict[str, tuple[float, float]], kinds: Sequence[Kind]
) -> Array:
    """Draw the joint states (k, n) from which poses are chosen.

    :raises ParameterError: the workspace is not known, or none of it can be reached.
    """
    rng = np.random.default_rng(0)
    box = np.full((len(robot.pose_names), 2), np.nan)
    limits = robot.limits.position
    if measured is not None:
        poses = robot.forward(robot.controller.positions(measured.joints))
        box = np.stack([poses.min(0), poses.max(0)], -1)
    elif limits is not None and np.isfinite(limits).all():
        drawn = rng.uniform(limits[:, 0], limits[:, 1], (20 * MAX_CANDIDATES, len(limits)))
        poses, good = robot.try_forward(drawn)
        if good.any():
            box = np.stack([poses[good].min(0), poses[good].max(0)], -1)
    names = list(robot.pose_names)
    if MEASUREMENT_KINDS["plane"] in kinds and measured is None and "z" in names:
        box[names.index("z")] = robot.home()[names.index("z")]
    for name, ends in within.items():
        if name not in names:
            raise ParameterError("--within", name, f"one of {', '.join(names)}")
        box[names.index(name)] = ends
    if not np.isfinite(box).all():
        missing = names[int(np.flatnonzero(~np.isfinite(box).all(1))[0])]
        right = f"the range of {missing}, as {missing}=-0.1:0.1: the file has no joint limits"
        raise ParameterError("--within", None, right)
    poses = rng.uniform(box[:, 0], box[:, 1], (20 * MAX_CANDIDATES, len(box)))
    q, good = robot.try_inverse(poses)
    good &= within_limits(robot, q)
    if good.sum() < len(names):
        raise ParameterError("--within", dict(within) or None, "poses that the machine reaches")
    return np.asarray(q[good][:MAX_CANDIDATES], np.float64)
