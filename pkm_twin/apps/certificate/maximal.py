# SPDX-License-Identifier: Apache-2.0
"""Inverse dynamics in maximal coordinates: six for each body, every joint its rows.

All bodies are free; a joint is equations between two of them, see ``rows``:

    A V = 0,  B V = q',   A V' = -a,  B V' = q'' - b,   T = [A; B]^+ [0; 1]
    tau = T' (M V' + gyroscopic - weight - wrench) + friction + rotors

by least squares over all rows, redundant ones too. Positions come from home by continuation along
the straight line in joint space: a step of second order, then Newton's method on all rows, with
the step's length held so that Newton has little to do. No tree, no spanning, no symbolic algebra.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from pkm_twin.apps.certificate.description import (
    BASE,
    POSE_NAMES,
    Array,
    Body,
    Description,
    Joint,
    UnfitError,
    angles,
    cross,
    read,
    with_laws,
)
from pkm_twin.apps.certificate.rows import Jet, Moving

FIRST_STEP: Final = 1.0 / 16.0
"""Part of the way home to goal that the first step goes."""
LEAST_STEP: Final = 1e-5
FAR: Final = 0.02
"""Longest first correction of a good step, relative to the motion's own size."""
KEPT: Final = 64
"""Assemblies that are kept: the way from home takes far longer than what is asked for there."""
SINGULAR: Final = 1e-9
"""Least singular value over the greatest: below it the rows do not determine the motion."""


@dataclass(frozen=True)
class State:
    """All bodies' places and, where asked for, their rates."""

    rotation: Array
    """Shape (bodies, 3, 3); the identity at home."""
    com: Array
    """Shape (bodies, 3), m."""
    velocity: Array
    """Velocity of the centre, angular velocity, shape (bodies, 6), m/s and rad/s."""
    least: float = 1.0
    """Least singular value over the greatest on the way from home, relative to home's."""
    pose: float = 1.0
    """Least determinant of the pose's rates by the joints', relative to home's: at zero the pose
    folds over and no longer tells the joint state."""


class Home(NamedTuple):
    """What the rows say at home."""

    mobility: int
    rank: int
    rows: int
    condition: float
    """Least over greatest singular value of all rows, actuated ones included."""


def rotation_of(turn: Array) -> Array:
    """Rotation by a vector's length about it (Rodrigues), shape (3, 3)."""
    angle = float(np.linalg.norm(turn))
    skew = skewed(turn)
    if angle < 1e-4:
        # Taylor; the next terms are below 1e-19.
        return np.eye(3) + (1 - angle**2 / 6) * skew + (0.5 - angle**2 / 24) * skew @ skew
    result: Array = (
        np.eye(3)
        + math.sin(angle) / angle * skew
        + (2 * math.sin(angle / 2) ** 2 / angle**2) * skew @ skew
    )
    return result


def skewed(v: Array) -> Array:
    """The matrix of v x, shape (3, 3)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


class Maximal(Moving):
    """A machine in maximal coordinates.

    :raises UnfitError: a description that cannot be read.
    """

    name = "maximal"

    def __init__(self, description: Description) -> None:
        self.machine = read(description)
        self.names = list(self.machine.bodies)
        self.size = 6 * len(self.names)
        self._coms = np.array([body.com for body in self.machine.bodies.values()])
        self._start = State(
            np.tile(np.eye(3), (len(self.names), 1, 1)),
            self._coms.copy(),
            np.zeros((len(self.names), 6)),
        )
        self._state = self._start
        self._assembled: dict[bytes, State] = {}
        self.home: Final = self._analyse()

    # Motion of points and directions

    def point(self, body: str, at: Array) -> Jet:
        """A point fixed in a body, by its place at home (m)."""
        if body == BASE:
            return self.still(at)
        k = self.names.index(body)
        state = self._state
        arm = state.rotation[k] @ (at - self._coms[k])
        columns = np.zeros((3, self.size))
        columns[:, 6 * k : 6 * k + 3] = np.eye(3)
        columns[:, 6 * k + 3 : 6 * k + 6] = -skewed(arm)
        v, w = state.velocity[k, :3], state.velocity[k, 3:]
        swing = cross(w, arm)
        return Jet(state.com[k] + arm, columns, v + swing, cross(w, swing))

    def direction(self, body: str, axis: Array) -> Jet:
        """A direction fixed in a body, by its components at home."""
        if body == BASE:
            return self.still(axis)
        k = self.names.index(body)
        value = self._state.rotation[k] @ axis
        columns = np.zeros((3, self.size))
        columns[:, 6 * k + 3 : 6 * k + 6] = -skewed(value)
        w = self._state.velocity[k, 3:]
        swing = cross(w, value)
        return Jet(value, columns, swing, cross(w, swing))

    def spin(self, body: str) -> Jet:
        """A body's angular velocity; as a vector it is nothing, its value is zero."""
        columns = np.zeros((3, self.size))
        if body == BASE:
            return self.still(np.zeros(3))
        k = self.names.index(body)
        columns[:, 6 * k + 3 : 6 * k + 6] = np.eye(3)
        return Jet(np.zeros(3), columns, self._state.velocity[k, 3:], np.zeros(3))

    def _analyse(self) -> Home:
        closures = self.closures()
        sizes = np.linalg.svd(closures.columns, compute_uv=False)
        rank = int((sizes > 1e-9 * sizes[0]).sum()) if sizes.size else 0
        whole = np.vstack([closures.columns, self.drives().columns])
        full = np.linalg.svd(whole, compute_uv=False)
        condition = float(full[self.size - 1] / full[0]) if len(full) >= self.size else 0.0
        return Home(self.size - rank, rank, len(closures.value), condition)

    # Positions

    def assemble(self, q: Array) -> State:
        """The assembly at ``q``, shape (n,), connected to home along the straight line.

        :raises UnfitError: a singularity on the way, with where it is.
        """
        q = np.asarray(q, dtype=float)
        if q.tobytes() not in self._assembled:
            if len(self._assembled) == KEPT:
                self._assembled.clear()
            self._assembled[q.tobytes()] = self._follow(q - self.machine.home)
        self._state = self._assembled[q.tobytes()]
        return self._state

    def _follow(self, way: Array) -> State:
        if self.home.condition < SINGULAR:
            raise UnfitError("the actuated joints do not determine the machine at home")
        state, gone, step, least = self._start, 0.0, FIRST_STEP, 1.0
        folds = []
        while gone < 1.0:
            step = min(step, 1.0 - gone)
            self._state = state
            tangent = self._tangent()
            folds.append(self._fold(tangent))
            state = replace(state, velocity=(tangent @ way).reshape(-1, 6))
            self._state = state
            change = self._changes_of(np.zeros(len(way)))
            size = float(np.abs(state.velocity).max())
            guess = self._moved(state, (step * state.velocity + step**2 / 2 * change).ravel())
            goal = 1.0 if step >= 1.0 - gone else gone + step
            trial, condition = self._close(guess, goal * way, FAR * max(size * step, 1e-9))
            if trial is None:
                step /= 2
                if step < LEAST_STEP:
                    raise UnfitError(f"a singularity on the way from home, at {gone:.4g} of it")
                continue
            state, gone, step = trial, goal, 1.5 * step
            least = min(least, condition / self.home.condition)
        self._state = state
        folds.append(self._fold(self._tangent()))
        pose = min(fold / folds[0] for fold in folds) if folds[0] else 0.0
        return replace(state, velocity=np.zeros_like(state.velocity), least=least, pose=pose)

    def _fold(self, tangent: Array) -> float:
        """Determinant of the pose's rates by the joints' rates; one where they are not as many."""
        machine = self.machine
        if len(machine.pose) != len(machine.actuated):
            return 1.0
        twist = self.twist_columns() @ tangent
        _, rotation = self._place()
        _, pitch, yaw = angles(rotation)
        c, s = math.cos(yaw), math.sin(yaw)
        # Angular velocity by the rates of roll, pitch and yaw.
        spin = np.array(
            [
                [c * math.cos(pitch), -s, 0.0],
                [s * math.cos(pitch), c, 0.0],
                [-math.sin(pitch), 0.0, 1.0],
            ]
        )
        full = np.vstack([twist[:3], np.linalg.solve(spin, twist[3:])])
        return float(np.linalg.det(full[[POSE_NAMES.index(name) for name in machine.pose]]))

    def _moved(self, state: State, change: Array) -> State:
        each = change.reshape(-1, 6)
        turned = np.array([rotation_of(step[3:]) for step in each]) @ state.rotation
        # Products of rotations lose their right angles digit by digit; this gives them back.
        turned = turned @ (1.5 * np.eye(3) - 0.5 * turned.transpose(0, 2, 1) @ turned)
        return replace(state, rotation=turned, com=state.com + each[:, :3])

    def _close(self, guess: State, way: Array, far: float) -> tuple[State | None, float]:
        state, last, condition = guess, math.inf, 0.0
        for _ in range(12):
            self._state = state
            closures, drives = self.closures(), self.drives()
            step, _, rank, sizes = np.linalg.lstsq(
                np.vstack([closures.columns, drives.columns]),
                np.concatenate([-closures.value, self.missing(way)]),
                rcond=SINGULAR,
            )
            length = float(np.abs(step).max())
            condition = float(sizes[self.size - 1] / sizes[0])
            if rank < self.size or length > (far if last == math.inf else last / 2):
                return (state if last < 1e-13 else None), condition
            state, last = self._moved(state, step), length
            if length < 1e-15:
                break
        return (state if last < 1e-13 else None), condition

    # Rates

    def _solve(self, closed: Array, driven: Array) -> Array:
        columns = np.vstack([self.closures().columns, self.drives().columns])
        result: Array = np.linalg.lstsq(columns, np.concatenate([closed, driven]), rcond=SINGULAR)[
            0
        ]
        return result

    def _rates_of(self, qd: Array) -> Array:
        none = np.zeros(self.home.rows)
        return self._solve(none, qd).reshape(-1, 6)

    def _changes_of(self, qdd: Array) -> Array:
        closures, drives = self.closures(), self.drives()
        return self._solve(-closures.bias, qdd - drives.bias).reshape(-1, 6)

    # What is asked for

    def platform(self, q: Array) -> tuple[Array, Array]:
        """Position of the reference point, shape (3,), m, and rotation from home, (3, 3)."""
        self.assemble(q)
        return self._place()

    def _place(self) -> tuple[Array, Array]:
        machine = self.machine
        rotation = self._state.rotation[self.names.index(machine.platform)]
        return self.point(machine.platform, machine.origin).value, rotation

    def pose(self, q: Array) -> Array:
        """Pose coordinates, shape (m,), m and rad."""
        position, rotation = self.platform(q)
        return self.machine.of(rotation, position)

    def jacobian(self, q: Array) -> Array:
        """The platform's twist at its reference point per joint rate, shape (6, n)."""
        self.assemble(q)
        return self.twist_columns() @ self._tangent()

    def _tangent(self) -> Array:
        n = len(self.machine.actuated)
        return self._solve(np.zeros((self.home.rows, n)), np.eye(n))

    def inverse_dynamics(
        self, q: Array, qd: Array, qdd: Array, wrench: Array | None = None
    ) -> Array:
        """Efforts of the actuated joints, shape (n,), N m or N.

        :param q: positions, shape (n,), rad or m; ``qd``, ``qdd`` their derivatives.
        :param wrench: force (N) and moment (N m) of the surroundings on the platform, shape (6,).
        """
        state = self.assemble(q)
        qd, qdd = np.asarray(qd, dtype=float), np.asarray(qdd, dtype=float)
        self._state = state = replace(state, velocity=self._rates_of(qd))
        change = self._changes_of(qdd)
        tangent = self._tangent()
        force = self._mass() @ change.ravel() + self._bias()
        if wrench is not None:
            force -= self.twist_columns().T @ np.asarray(wrench, dtype=float)
        for joint in self.machine.joints:
            if joint.actuated:
                continue
            if joint.viscous or joint.coulomb:
                columns = self.rates(joint).columns
                force += columns.T @ drag(joint, columns @ state.velocity.ravel())
            if joint.rotor_inertia:
                row = self.rates(joint)
                own = row.columns @ change.ravel() + row.bias
                force += joint.rotor_inertia * row.columns.T @ own
        tau: Array = tangent.T @ force
        for k, joint in enumerate(self.machine.actuated):
            tau[k] += joint.rotor_inertia * qdd[k] + drag(joint, qd[k : k + 1])[0]
        return with_laws(self.machine.actuated, q, qd, tau)

    def mass_matrix(self, q: Array) -> Array:
        """Inertia felt at the actuated joints, shape (n, n), kg m2, kg or kg m."""
        self.assemble(q)
        tangent = self._tangent()
        result: Array = tangent.T @ self._mass() @ tangent + self.rotors(tangent)
        return result

    def energy(self, q: Array, qd: Array) -> tuple[float, float]:
        """Kinetic and potential energy, J; the potential one is zero at base height."""
        qd = np.asarray(qd, dtype=float)
        kinetic = float(qd @ self.mass_matrix(q) @ qd / 2)
        weights = [
            body.mass * self.point(name, body.com).value @ self.machine.gravity
            for name, body in self._solids()
        ]
        for rod in self.machine.rods:
            ends = (
                self.point(rod.inner, rod.ends[0]).value + self.point(rod.outer, rod.ends[1]).value
            )
            weights.append(rod.mass * ends @ self.machine.gravity / 2)
        return kinetic, -float(sum(weights))

    def _solids(self) -> list[tuple[str, Body]]:
        """All that has mass, with the body that it moves with."""
        solids = list(self.machine.bodies.items())
        if self.machine.payload is not None:
            solids.append((self.machine.platform, self.machine.payload))
        return solids

    def _mass(self) -> Array:
        total = np.zeros((self.size, self.size))
        for name, body in self._solids():
            point, spin = self.point(name, body.com), self.spin(name).columns
            rotation = self._state.rotation[self.names.index(name)]
            total += body.mass * point.columns.T @ point.columns
            total += spin.T @ (rotation @ body.inertia @ rotation.T) @ spin
        for rod in self.machine.rods:
            a = self.point(rod.inner, rod.ends[0]).columns
            b = self.point(rod.outer, rod.ends[1]).columns
            total += rod.mass / 6 * (2 * a.T @ a + a.T @ b + b.T @ a + 2 * b.T @ b)
        return total

    def _bias(self) -> Array:
        """Forces of the rates and the weight, shape (6 bodies,)."""
        gravity = self.machine.gravity
        total = np.zeros(self.size)
        for name, body in self._solids():
            point, spin = self.point(name, body.com), self.spin(name)
            rotation = self._state.rotation[self.names.index(name)]
            total += body.mass * point.columns.T @ (point.bias - gravity)
            turning = rotation @ body.inertia @ rotation.T @ spin.rate
            total += spin.columns.T @ cross(spin.rate, turning)
        for rod in self.machine.rods:
            a, b = self.point(rod.inner, rod.ends[0]), self.point(rod.outer, rod.ends[1])
            one, other = a.bias - gravity, b.bias - gravity
            total += rod.mass / 6 * a.columns.T @ (2 * one + other)
            total += rod.mass / 6 * b.columns.T @ (one + 2 * other)
        return total


def drag(joint: Joint, rates: Array) -> Array:
    """Friction's share of the effort at these rates, one a rate, N m or N."""
    result: Array = joint.viscous * rates + joint.coulomb * np.sign(rates) + joint.offset
    return result
