# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Streams of a machine that is not quite the model, for contact observers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from delta_dynamics import ContactMonitor, inverse_dynamics
from delta_dynamics.estimates.isolation import CLAMPING, PLATFORM, map_limbs
from delta_dynamics.torques.regressor import PAYLOAD, parameter_names, parameter_values, regressor
from pkm_twin import Robot
from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.graph import BASE
from pkm_twin.machine.inertia import STANDARD_PARAMETERS
from pkm_twin.machine.members import Place
from pkm_twin.robot.outline import Bar, body_points, robot_bars
from test.support.robots import joint_range

Spot = tuple[Place, Place, float]

RATE = 500.0
REST = 2.0
"""How long the machine stands before it moves, s."""


OFF: dict[str, dict[str, float]] = {
    "as the model": {},
    "all masses 3 % more": {"masses": 0.03},
    "all masses 3 % less": {"masses": -0.03},
    "each mass within 3 %": {"each": 0.03},
    "3 % of peak friction left out": {"friction": 0.03},
    "both, 3 % each": {"masses": 0.03, "friction": 0.03},
    "10 % of peak friction left out": {"friction": 0.1},
}
"""How a machine may depart from its model."""


@dataclass(frozen=True)
class Stream:
    """What a controller measures: time (k,), q, qd, qdd, effort (k, n); qdd is not measured."""

    time: Array
    q: Array
    qd: Array
    qdd: Array
    effort: Array

    def watched(self, robot: Robot, monitor: ContactMonitor | None = None) -> Array:
        """Whether the monitor sees a contact, shape (k,)."""
        monitor = monitor or ContactMonitor(robot)
        touching = np.zeros(len(self.time), bool)
        for k, (t, q, qd, qdd, effort) in enumerate(
            zip(self.time, self.q, self.qd, self.qdd, self.effort, strict=True)
        ):
            found = monitor.push(float(t), (q, qd, qdd), effort)
            touching[k] = found is not None and found.touching
        return touching


def moves(robot: Robot, rng: np.random.Generator, count: int, share: float, rest: float = REST) -> tuple[Array, ...]:
    """Rest, then point to point without jerk at the ends: time, q, qd, qdd.

    :param share: of the joints' range that moves go to; each takes a quarter to half a second.
    """
    middle, half = joint_range(robot)
    here = robot.inverse(robot.home())
    pieces = [np.repeat(here[None], round(rest * RATE), 0)]
    while len(pieces) <= count:
        goal = middle + share * half * rng.uniform(-1.0, 1.0, len(middle))
        seconds = rng.uniform(0.25, 0.6)
        x = np.arange(1, round(seconds * RATE) + 1)[:, None] / round(seconds * RATE)
        piece = here + (goal - here) * (x**3 * (10.0 + x * (6.0 * x - 15.0)))
        if not robot.try_forward(piece[::10])[1].all():
            continue
        pieces.append(piece)
        here = goal
    q = np.concatenate(pieces)
    time = np.arange(len(q)) / RATE
    qd = np.gradient(q, time, axis=0)
    return time, q, qd, np.gradient(qd, time, axis=0)


def measured(
    robot: Robot,
    rng: np.random.Generator,
    motion: tuple[Array, ...],
    *,
    masses: float = 0.0,
    each: float = 0.0,
    friction: float = 0.0,
    wrench: Array | None = None,
    external: Array | None = None,
) -> Stream:
    """Efforts of a machine that departs from the model, with noise on rates and efforts.

    :param masses: all bodies are heavier by this share; ``each``: each by one of its own within it.
    :param friction: dry friction that the model does not have, a share of each joint's peak effort.
    :param wrench: on the platform, shape (k, 6); ``external``: efforts of any contact, (k, n).
    """
    time, q, qd, qdd = motion
    effort = inverse_dynamics(robot, q, qd, qdd, wrench)
    if external is not None:
        effort = effort - external
    free = inverse_dynamics(robot, q, qd, qdd)
    peak = np.abs(free).max(0)
    if masses or each:
        names, values = parameter_names(robot), parameter_values(robot)
        change = np.zeros(len(values))
        shares: dict[str, float] = {}
        for k, name in enumerate(names):
            owner, _, what = name.rpartition(".")
            if what in STANDARD_PARAMETERS and owner != PAYLOAD:
                share = shares.setdefault(owner, masses + each * rng.uniform(-1.0, 1.0))
                change[k] = share * values[k]
        effort = effort + regressor(robot, q, qd, qdd) @ change
    effort = effort + friction * peak * np.sign(qd)
    noise = 2e-3 * peak
    speed = 2e-4 * np.abs(qd).max(0)
    return Stream(
        time,
        q,
        qd + speed * rng.normal(size=q.shape),
        qdd,
        effort + noise * rng.normal(size=q.shape),
    )


def pushed(robot: Robot, rng: np.random.Generator, motion: tuple[Array, ...], share: float, begin: float) -> Array:
    """A force on the platform in a drawn direction from a time on, shape (k, 6).

    :param share: of the peak effort of the joint that feels it most, when it begins.
    """
    time, q, qd, qdd = motion
    peak = np.abs(inverse_dynamics(robot, q, qd, qdd)).max(0)
    k = int(np.searchsorted(time, begin))
    direction = np.zeros(6)
    direction[:3] = rng.normal(size=3)
    felt = np.abs(robot.platform_jacobian(q[k]).T @ direction) / peak
    return np.where(time[:, None] >= begin, share / felt.max() * direction, 0.0)


def seen_after(stream: Stream, robot: Robot, begin: float) -> float:
    """Time from the beginning of a push to the verdict, s; NaN where there is a verdict before."""
    touching = stream.watched(robot)
    if touching[stream.time < begin].any():
        return np.nan
    late = stream.time[touching] - begin
    return float(late[0]) if len(late) else np.inf


# Contacts with any body, of which the efforts follow from the places of points alone.

STIFFNESS = 30e3
"""Of what is struck, N/m: of the order of a human arm in ISO/TS 15066."""
MOST = 500.0
"""Greatest force, N."""
GRIP = 0.2
"""Coefficient of friction of the contact."""
SLOWEST = 0.05
"""Least speed of a contact, m/s."""


@dataclass(frozen=True)
class Strike:
    """A contact: its class as in ``ContactPlace.classes``, its bodies, and when it begins, s.

    ``point``: where it is, (k, 3); ``external``: efforts, (k, n).
    """

    where: str
    bodies: tuple[str, ...]
    begin: float
    point: Array
    external: Array


def place_and_jacobian(robot: Robot, q: Array, where: Spot) -> tuple[Array, Array]:
    """A point of a bar at each sample (k, 3), and its Jacobian (k, 3, n), by differences."""
    start, end, s = where
    at = robot.engine.tree.at

    def place(q: Array) -> Array:
        turned, origin = robot.placements(q)
        ends = [
            origin[body] + turned[body] @ (point - at[body]) if body in turned else point
            for body, point in (start, end)
        ]
        return np.asarray((1 - s) * ends[0] + s * ends[1], np.float64)

    step = 1e-6
    columns = [(place(q + step * e) - place(q - step * e)) / (2 * step) for e in np.eye(q.shape[1])]
    return place(q), np.stack(columns, -1)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12), np.float64)


@lru_cache(16)
def _bars(robot: Robot) -> tuple[Bar, ...]:
    return robot_bars(robot)


def spot(robot: Robot, rng: np.random.Generator, parts: list[str]) -> tuple[str, Spot, bool]:
    """A place on one of the parts: which, where, and whether it is a bar."""
    found = [bar for bar in _bars(robot) if bar.part in parts]
    if not found:
        body = parts[int(rng.integers(len(parts)))]
        only = body, body_points(robot.graph)[body][0]
        return body, (only, only, 0.0), False
    length = np.array([np.linalg.norm(b.end[1] - b.start[1]) for b in found])
    bar = found[int(rng.choice(len(found), p=length / length.sum()))]
    sliding = any(
        j.kind == "prismatic" and j.inner == BASE and j.outer == bar.part for j in robot.graph.joints.values()
    )
    thin = bar.part != robot.graph.platform and not sliding
    return bar.part, (bar.start, bar.end, float(rng.uniform())), thin


def strike(robot: Robot, rng: np.random.Generator, motion: tuple[Array, ...], kind: str) -> Strike | None:
    """A contact of a kind, ``platform``, ``limb`` or ``clamping``; None where the draw is none.

    The machine follows its path; what it strikes is a spring that the path compresses.
    """
    time, q, qd, _ = motion
    moving = time[np.abs(qd).max(1) > 0.0][0]
    limbs = map_limbs(robot)
    platform, names = robot.graph.platform, sorted({*limbs.values()} - {PLATFORM})
    limb = names[int(rng.integers(len(names)))]
    own = [platform] if kind == PLATFORM else [p for p, name in limbs.items() if name == limb]
    late = (time > moving + 0.2) & (time < time[-1] - 0.15)
    k = int(rng.choice(np.flatnonzero(late)))
    body, near, thin = spot(robot, rng, own)
    far = near
    bodies: tuple[str, ...] = (body,)
    if kind == CLAMPING:
        apart = [
            p for p, name in limbs.items() if name != limbs[body] and not {(p, body), (body, p)} & {*robot.graph.links}
        ]
        if not apart:
            return None
        other, far, _ = spot(robot, rng, apart)
        bodies = (body, other)

    def touch(q: Array) -> tuple[Array, Array, Array]:
        """Where it is, its Jacobian, and what it is apart, by joint states (k, n)."""
        point, jacobian = place_and_jacobian(robot, q, near)
        if kind != CLAMPING:
            return point, jacobian, 0.0 * point
        point_b, jacobian_b = place_and_jacobian(robot, q, far)
        return (point + point_b) / 2, jacobian - jacobian_b, point - point_b

    _, jacobian, apart = touch(q[k : k + 1])
    ahead = jacobian[0] @ qd[k]
    if kind == CLAMPING:
        normal = apart[0]
        if np.linalg.norm(normal) > 0.4 * robot.graph.size:
            return None
    else:
        # Even on a plate across the motion: normals as often as their cosine.
        normal = _unit(rng.normal(size=3)) - _unit(ahead)
        if thin:
            ends = (place_and_jacobian(robot, q[k : k + 1], (*near[:2], s))[0][0] for s in (0.0, 1.0))
            along = _unit(np.subtract(*ends))
            normal = normal - along * (along @ normal)
    normal = _unit(normal)
    if not -ahead @ normal >= SLOWEST:
        return None
    point, jacobian, _ = touch(q[k:])
    velocity = np.einsum("kin,kn->ki", jacobian, qd[k:])
    speed = -velocity @ normal
    depth = np.maximum(np.cumsum(speed) / RATE, 0.0)
    way = np.broadcast_to(normal, velocity.shape)
    if kind != CLAMPING:
        slip = velocity + speed[:, None] * normal
        size = np.linalg.norm(slip, axis=1, keepdims=True)
        way = normal - GRIP * np.divide(slip, size, out=np.zeros_like(slip), where=size > SLOWEST)
    per_newton = np.einsum("kin,ki->kn", jacobian, way)
    peak = np.abs(inverse_dynamics(robot, *motion[1:])).max(0)
    most = min(MOST, 1.5 / max(float((np.abs(per_newton) / peak).max()), 1e-9))
    external = np.zeros_like(q)
    external[k:] = np.minimum(STIFFNESS * depth, most)[:, None] * per_newton
    places = np.full((len(q), 3), np.nan)
    places[k:] = point
    return Strike(kind if kind != "limb" else limb, bodies, float(time[k]), places, external)
