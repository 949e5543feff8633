# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute inverse dynamics in maximal coordinates, and draw random states for comparisons.

Each body has six coordinates; every joint is a set of equations between two bodies, see ``rows``.
Positions follow by continuation from home along the straight line in joint space: a predictor of
second order, then Newton's method on all equations, with a step length for which Newton's
correction is small. There is no spanning tree and no symbolic algebra.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from pkm_twin.certify.description import Array, Description, UnfitError, cross, read
from pkm_twin.certify.rows import MIN_SINGULAR_VALUE_RATIO, Engine, Frame

DEFAULT_HALF_RANGE: Final = 0.3
"""Half the range of a joint without limits, rad; for a prismatic joint half this times the size."""
MIN_RELATIVE_CONDITION: Final = 0.1
"""Smallest reciprocal condition number and determinant on the line from home, relative to home:
closer to a singularity every engine loses digits, and beyond a fold a pose has two assemblies."""


@dataclass(frozen=True)
class State:
    """Positions and velocities of all bodies."""

    rotation: Array
    """Rotations, shape (bodies, 3, 3); the identity at home."""
    com: Array
    """Centres of mass, shape (bodies, 3), m."""
    velocity: Array
    """Velocities of the centres and angular velocities, shape (bodies, 6), m/s and rad/s."""
    least: float = 1.0
    """Smallest reciprocal condition number on the line from home, relative to home."""
    pose: float = 1.0
    """Smallest determinant of d(pose)/dq on the line from home, relative to home: at zero the pose
    has a fold and no longer determines the joint positions."""


class Home(NamedTuple):
    """Mobility, rank, number and conditioning of the constraint equations at home."""

    mobility: int
    rank: int
    rows: int
    condition: float
    """Reciprocal condition number of all equations, including those of the actuated joints."""


def rotation_of(turn: Array) -> Array:
    """Return the rotations of rotation vectors (..., 3), shape (..., 3, 3)."""
    return np.asarray(Rotation.from_rotvec(turn).as_matrix(), np.float64)


class Maximal(Engine):
    """A machine in maximal coordinates.

    :raises UnfitError: the description cannot be read.
    """

    name = "maximal"

    def __init__(self, description: Description) -> None:
        self.machine = read(description)
        self.names = list(self.machine.bodies)
        self.size = 6 * len(self.names)
        self._coms = np.array([body.com for body in self.machine.bodies.values()])
        self._columns = np.split(np.eye(self.size), len(self.names))
        self._start = State(
            np.tile(np.eye(3), (len(self.names), 1, 1)), self._coms.copy(), np.zeros((len(self.names), 6))
        )
        self._state = self._start
        self._assembled: dict[bytes, State] = {}
        closures = self.closures()
        sizes = np.linalg.svd(closures.columns, compute_uv=False)
        rank = int((sizes > 1e-9 * sizes[0]).sum()) if sizes.size else 0
        whole = np.vstack([closures.columns, self.drives().columns])
        full = np.linalg.svd(whole, compute_uv=False)
        condition = float(full[self.size - 1] / full[0]) if len(full) >= self.size else 0.0
        self.home: Final = Home(self.size - rank, rank, len(closures.value), condition)

    def frame(self, body: str) -> Frame:
        """Return a body's frame at its centre of mass."""
        k, state = self.names.index(body), self._state
        columns = self._columns[k]
        return Frame(self._coms[k], state.com[k], state.rotation[k], columns, state.velocity[k], np.zeros(6))

    # Positions

    def assemble(self, q: Array) -> State:
        """Find the assembly at ``q``, shape (n,), by continuation from home on a straight line.

        :raises UnfitError: a singularity lies on the line; the text says where.
        """
        q = np.asarray(q, dtype=float)
        if q.tobytes() not in self._assembled:
            # Cache assemblies, because the continuation takes far longer than computations in a state.
            if len(self._assembled) == 64:
                self._assembled.clear()
            self._assembled[q.tobytes()] = self._continue_to(q - self.machine.home)
        self._state = self._assembled[q.tobytes()]
        return self._state

    def _continue_to(self, goal_motion: Array) -> State:
        if self.home.condition < MIN_SINGULAR_VALUE_RATIO:
            raise UnfitError("the actuated joints do not determine the machine at home")
        # Steps are fractions of the line from home to the goal.
        state, done, step, least = self._start, 0.0, 1.0 / 16.0, 1.0
        folds = []
        while done < 1.0:
            step = min(step, 1.0 - done)
            self._state = state
            tangent = self.tangent()
            folds.append(self._pose_determinant(tangent))
            state = replace(state, velocity=(tangent @ goal_motion).reshape(-1, 6))
            self._state = state
            change = self.solve(-self.closures().bias, -self.drives().bias)
            size = float(np.abs(state.velocity).max())
            guess = self._move_bodies(state, step * state.velocity.ravel() + step**2 / 2 * change)
            goal = 1.0 if step >= 1.0 - done else done + step
            # Accept a step only if its first correction is at most a fiftieth of its motion.
            trial, condition = self._close_loops(guess, goal * goal_motion, 0.02 * max(size * step, 1e-9))
            if trial is None:
                step /= 2
                if step < 1e-5:
                    raise UnfitError(f"a singularity on the way from home, at {done:.4g} of it")
                continue
            state, done, step = trial, goal, 1.5 * step
            least = min(least, condition / self.home.condition)
        self._state = state
        folds.append(self._pose_determinant(self.tangent()))
        pose = min(fold / folds[0] for fold in folds) if folds[0] else 0.0
        return replace(state, velocity=np.zeros_like(state.velocity), least=least, pose=pose)

    def _pose_determinant(self, tangent: Array) -> float:
        """Return the determinant of d(pose)/dq; 1 if this matrix is not square."""
        machine = self.machine
        if len(machine.pose) != len(machine.actuated):
            return 1.0
        twist = self.twist_columns() @ tangent
        _, rotation = self._platform_pose()
        sequence = machine.sequence
        turns = Rotation.from_matrix(rotation).as_euler(sequence)
        first = Rotation.from_euler(sequence[0], turns[0]).as_matrix()
        second = Rotation.from_euler(sequence[:2], turns[:2]).as_matrix()
        a, b, c = (np.eye(3)["XYZ".index(axis)] for axis in sequence)
        # Angular velocity per rate of each angle.
        spin = np.stack([a, first @ b, second @ c], -1)
        return float(np.linalg.det(machine.select_pose_rows(twist[:3], np.linalg.solve(spin, twist[3:]))))

    def _move_bodies(self, state: State, change: Array) -> State:
        each = change.reshape(-1, 6)
        turned = rotation_of(each[:, 3:]) @ state.rotation
        # Restore orthogonality after rounding by a Newton step of the polar decomposition.
        turned = turned @ (1.5 * np.eye(3) - 0.5 * turned.transpose(0, 2, 1) @ turned)
        return replace(state, rotation=turned, com=state.com + each[:, :3])

    def _close_loops(self, guess: State, goal: Array, max_first_step: float) -> tuple[State | None, float]:
        state, last, condition = guess, math.inf, 0.0
        for _ in range(12):
            self._state = state
            closures, drives = self.closures(), self.drives()
            step, _, rank, sizes = np.linalg.lstsq(
                np.vstack([closures.columns, drives.columns]),
                np.concatenate([-closures.value, self.remaining_motion(goal)]),
                rcond=MIN_SINGULAR_VALUE_RATIO,
            )
            length = float(np.abs(step).max())
            condition = float(sizes[self.size - 1] / sizes[0])
            if rank < self.size or length > (max_first_step if last == math.inf else last / 2):
                return (state if last < 1e-13 else None), condition
            state, last = self._move_bodies(state, step), length
            if length < 1e-15:
                break
        return (state if last < 1e-13 else None), condition

    # Rates and forces

    def set_velocities(self, rates: Array) -> None:
        """Set the velocities of the bodies, shape (6 bodies,)."""
        self._state = replace(self._state, velocity=rates.reshape(-1, 6))

    def pose(self, q: Array) -> Array:
        """Compute the pose coordinates, shape (m,), m and rad."""
        position, rotation = self.platform(q)
        angles = Rotation.from_matrix(rotation).as_euler(self.machine.sequence)
        return self.machine.select_pose_rows(position, angles)

    def energy(self, q: Array, qd: Array) -> tuple[float, float]:
        """Compute kinetic and potential energy, J; the latter is zero at the base's origin."""
        qd = np.asarray(qd, dtype=float)
        kinetic = float(qd @ self.mass_matrix(q) @ qd / 2)
        weights = [
            body.mass * self.point(name, body.com).value @ self.machine.gravity
            for name, body in self.machine.bodies.items()
        ]
        for rod in self.machine.rods:
            ends = self.point(rod.inner, rod.ends[0]).value + self.point(rod.outer, rod.ends[1]).value
            weights.append(rod.mass * ends @ self.machine.gravity / 2)
        return kinetic, -float(sum(weights))

    def forces(self, change: Array) -> Array:
        """Compute the generalised forces of inertia and weight, shape (6 bodies,)."""
        gravity = self.machine.gravity
        total = np.zeros(self.size)
        for name, body in self.machine.bodies.items():
            point, spin = self.point(name, body.com), self.spin(name)
            rotation = self._state.rotation[self.names.index(name)]
            inertia = rotation @ body.inertia @ rotation.T
            pull = body.mass * (point.columns @ change + point.bias - gravity)
            turning = inertia @ (spin.columns @ change) + cross(spin.rate, inertia @ spin.rate)
            total += point.columns.T @ pull + spin.columns.T @ turning
        for rod in self.machine.rods:
            a, b = self.point(rod.inner, rod.ends[0]), self.point(rod.outer, rod.ends[1])
            one, other = (end.columns @ change + end.bias - gravity for end in (a, b))
            total += rod.mass / 6 * a.columns.T @ (2 * one + other)
            total += rod.mass / 6 * b.columns.T @ (one + 2 * other)
        return total


@dataclass(frozen=True)
class States:
    """Joint states, shape (states, n), rad and m, and wrenches, shape (states, 6), N and N m."""

    q: Array
    qd: Array
    qdd: Array
    wrench: Array
    drawn: int
    """Number of positions drawn, also out of reach, near a singularity or beyond a fold."""
    skipped: int
    """Number of positions that the package alone does not reach, because of a singularity on its way."""


def ranges(judge: Maximal) -> Array:
    """Return the ranges from which joint positions are drawn, shape (n, 2), rad or m."""
    machine, size = judge.machine, extent(judge)
    result = []
    for joint in machine.actuated:
        reach = DEFAULT_HALF_RANGE * size / 2 if joint.slides else DEFAULT_HALF_RANGE
        low, high = joint.position
        low = low if np.isfinite(low) else joint.home - reach
        high = high if np.isfinite(high) else joint.home + reach
        # Leave out the outer tenths of the range.
        middle, half = (low + high) / 2, 0.8 * (high - low) / 2
        result.append((middle - half, middle + half))
    return np.array(result)


def extent(judge: Maximal) -> float:
    """Return the machine's size: half the diagonal of the box around all its points at home, m."""
    machine = judge.machine
    points = [machine.origin, *(joint.at for joint in machine.joints)]
    points += [body.com for body in machine.bodies.values() if body.mass]
    points += [end for rod in machine.rods for end in rod.ends]
    return float(np.linalg.norm(np.ptp(np.array(points), axis=0)) / 2) or 1.0


def random_states(
    judge: Maximal, rng: np.random.Generator, count: int, reaches: Callable[[Array], bool] = lambda _: True
) -> States:
    """Draw states inside the limits, connected to home and clear of singularities.

    Velocities are of the order of the range per second, wrenches of the order of the machine's
    weight.

    :param reaches: returns whether the package reaches joint positions, shape (n,).
    :raises UnfitError: twenty times ``count`` draws give too few states.
    """
    low, high = ranges(judge).T
    found: list[Array] = []
    drawn = skipped = 0
    while len(found) < count:
        if drawn == 20 * count:
            raise UnfitError(f"only {len(found)} of {drawn} positions in the limits can be judged")
        drawn += 1
        q = rng.uniform(low, high)
        try:
            state = judge.assemble(q)
        except UnfitError:
            continue
        if min(state.least, state.pose) >= MIN_RELATIVE_CONDITION:
            good = reaches(q)
            skipped += not good
            found += [q] if good else []
    machine, n = judge.machine, len(low)
    span = high - low
    weight = 1.0 + 9.81 * sum(body.mass for body in machine.bodies.values())
    wrench = rng.normal(size=(count, 6)) * weight
    wrench[:, 3:] *= extent(judge)
    qd, qdd = (rng.normal(size=(count, n)) * span * factor for factor in (2.0, 10.0))
    return States(np.array(found), qd, qdd, wrench, drawn, skipped)
