# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A linkage as a transmission between its actuators and the joint that it moves.

The joint side has the m pose coordinates x, as roll and pitch of an ankle. The actuator side has
the n actuated joints in the controller's numbers a (``joint_map``: names, signs, ratios, offsets).
With the ratio B = da/dx, power is the same on both sides:

    da/dt = B dx/dt        B' t = f        t: efforts of the actuators, f: those of the joint

With more actuators than freedoms, P = (B' W B)^-1 B' W, W = diag(effort limit^2), has P B = 1: of
all efforts t with B' t = f, t = P' f has the least sum of (effort / limit)^2. Otherwise P = B^-1.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.torques.at_pose import evaluate_at_pose, pose_mass_kernel
from pkm_twin.codegen.arrays import Array, vectors
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.programs import actuator_program, transmission_program
from pkm_twin.robot.robot import Robot

_NO_PARAMETERS: Final = np.zeros(0)
_ROUNDING: Final = 1e-9
"""Part of the largest entry below which an effort or a velocity of a transmission is rounding."""


@dataclass(frozen=True)
class TransmissionState:
    """Positions, velocities and efforts of one side, (..., m) or (..., n); None: not given."""

    position: Array
    velocity: Array | None = None
    effort: Array | None = None


def transmission_kernel(robot: Robot, *, certified: bool, curved: bool) -> Kernel:
    """Return the program from a pose to q and dq/dpose, see :func:`transmission_program`."""
    certified = certified and robot.engine.posed is not None
    name = f"transmission{' curved' * curved}{' certified' * certified}"
    write = partial(transmission_program, certified=certified, curved=curved)
    return robot.engine.posed_kernel(name, write)


class Transmission:
    """A robot's linkage as a transmission, see :func:`transmission`.

    Inputs are single, shape (m,) or (n,), or batches with leading axes that broadcast. Efforts are
    those of the linkage alone: friction, weight and inertia are not in them. All methods that take
    a position raise UnreachableError or SingularityError as ``robot.inverse`` does.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joint side: the pose coordinates."""
        return self.robot.pose_names

    @property
    def actuators(self) -> tuple[str, ...]:
        """Names of the actuator side: the controller's joints."""
        return self.robot.controller.names

    def joint_to_actuator(
        self, position: ArrayLike, velocity: ArrayLike | None = None, effort: ArrayLike | None = None
    ) -> TransmissionState:
        """Convert joint states to actuator states.

        :param position: pose coordinates, shape (..., m), rad or m.
        :param velocity: their rates, shape (..., m). ``effort``: their efforts, N m or N.
        :returns: shape (..., n) each, in the controller's units.
        """
        q, ratio = self._solve(position)
        rate = None if velocity is None else _multiply(ratio, self._check_joint_values(velocity, "velocities"))
        load = None
        if effort is not None:
            load = _multiply(
                self._joint_per_actuator(q, ratio).swapaxes(-1, -2), self._check_joint_values(effort, "efforts")
            )
        return TransmissionState(self.robot.controller.controller_positions(q), rate, load)

    def actuator_to_joint(
        self, position: ArrayLike, velocity: ArrayLike | None = None, effort: ArrayLike | None = None
    ) -> TransmissionState:
        """Convert actuator states to joint states, as ``robot.forward`` finds the assembly.

        :param position: actuator positions, shape (..., n), in the controller's units.
        :param velocity: their rates. ``effort``: their efforts; shape (..., n) each.
        :returns: shape (..., m) each.
        """
        robot, n = self.robot, self.robot.joints_count
        q = robot.controller.positions(vectors(position, n, "positions"))
        if velocity is None and effort is None:
            return TransmissionState(robot.forward(q))
        rate, load = (
            np.zeros(n) if given is None else vectors(given, n, name)
            for given, name in ((velocity, "velocities"), (effort, "efforts"))
        )
        slopes = robot.controller.slopes(q)
        kernel = robot.engine.kernel("actuator to joint", actuator_program)
        pose, moved, carried = robot.evaluate(kernel, q, rate / slopes, load * slopes)
        return TransmissionState(pose, None if velocity is None else moved, None if effort is None else carried)

    def ratio(self, position: ArrayLike) -> Array:
        """Return the actuators' rates per joint rate, B = d(actuator)/d(joint), (..., n, m)."""
        return self._solve(position)[1]

    def gains(
        self, position: ArrayLike, stiffness: ArrayLike, damping: ArrayLike, effort: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Return the actuators' gains that give the joint a stiffness K and a damping D.

        Actuators with t = effort - Ka (a - a0) - Da da/dt give the joint, at a position a0(x), the
        efforts f with df/dx = -K and df/dv = -D. As the ratio changes with x, an effort changes
        the stiffness:

            Ka = P' (K + sum_i effort_i d2a_i/dx2) P,        Da = P' D P

        :param stiffness: K, and ``damping``: D, of the pose coordinates, shape (m, m) or with
            leading axes; a vector (m,) or a number: a diagonal.
        :param effort: efforts that the actuators carry at the position, (..., n); default: none.
        :returns: Ka and Da, shape (..., n, n) each: their coupling is a part of the result.
        """
        stiffness_sum = self._check_matrix(stiffness, "stiffness")
        if effort is None:
            q, ratio = self._solve(position)
        else:
            q, ratio, curvature = self._solve_with_curvature(position)
            load = vectors(effort, self.robot.joints_count, "efforts")
            stiffness_sum = stiffness_sum + np.einsum("...i,...ijk->...jk", load, curvature)
        joint_per_actuator = self._joint_per_actuator(q, ratio)
        transposed = joint_per_actuator.swapaxes(-1, -2)
        return transposed @ stiffness_sum @ joint_per_actuator, transposed @ self._check_matrix(
            damping, "damping"
        ) @ joint_per_actuator

    def curvature(self, position: ArrayLike) -> Array:
        """Return the second derivatives d2(actuator)/d(joint)2, shape (..., n, m, m)."""
        return self._solve_with_curvature(position)[2]

    def _solve_with_curvature(self, position: ArrayLike) -> tuple[Array, Array, Array]:
        """Return the results of :meth:`_solve`, and the curvature."""
        m, controller = len(self.joints), self.robot.controller
        pose = self._check_joint_values(position, "positions")[..., None, :]
        # Polarisation: f''(a + b) - f''(a) - f''(b) is twice the mixed second derivative.
        pairs = [(j, k) for j in range(m) for k in range(j)]
        directions = np.array([*np.eye(m), *(np.eye(m)[j] + np.eye(m)[k] for j, k in pairs)])
        q, flat, change = evaluate_at_pose(
            self.robot, partial(transmission_kernel, curved=True), _NO_PARAMETERS, pose, directions
        )
        curvature = np.empty((*change.shape[:-2], change.shape[-1], m, m))
        for j in range(m):
            curvature[..., j, j] = change[..., j, :]
        for row, (j, k) in enumerate(pairs, m):
            mixed = (change[..., row, :] - change[..., j, :] - change[..., k, :]) / 2.0
            curvature[..., j, k] = curvature[..., k, j] = mixed
        by_pose = flat.reshape(*q.shape, m)[..., 0, :, :]
        q = q[..., 0, :]
        slopes = controller.slopes(q)[..., None]
        controller_curvature = (controller.factors * controller.changes)[:, None, None]
        curvature = curvature * slopes[..., None] + controller_curvature * by_pose[..., :, None] * by_pose[..., None, :]
        return q, by_pose * slopes, curvature

    def effort_limits(self, position: ArrayLike) -> Array:
        """Return the least and largest effort of each joint alone, shape (..., m, 2), N m or N.

        The other joints have no effort, and no actuator is beyond its limit; infinite if a joint
        needs only actuators without a limit.

        :raises ParameterError: the file has no effort limits.
        """
        q, ratio = self._solve(position)
        # Efforts that the limits allow are bounded by planes c f <= sum_i limit_i |c B_i|, whose
        # normals c are across m - 1 rows of the ratio each.
        n, m = ratio.shape[-2:]
        if n == m:
            normals = np.linalg.inv(ratio).swapaxes(-1, -2)
        else:
            chosen = [list(rows) for rows in itertools.combinations(range(n), m - 1)]
            normals = np.linalg.svd(ratio[..., chosen, :])[2][..., -1, :]
        reach = np.abs(normals @ ratio.swapaxes(-1, -2))
        reach[reach < _ROUNDING * reach.max(-1, keepdims=True)] = 0.0
        limits = self._actuator_limits("effort", q)[..., None, :]
        with np.errstate(invalid="ignore", divide="ignore"):
            bound = np.where(reach > 0.0, limits * reach, 0.0).sum(-1)
            slope = np.abs(normals)
            slope[slope < _ROUNDING * slope.max(-1, keepdims=True)] = 0.0
            most = np.where(slope > 0.0, bound[..., None] / slope, np.inf).min(-2)
        return np.stack([-most, most], -1)

    def velocity_limits(self, position: ArrayLike) -> Array:
        """Return the least and largest velocity of each joint alone, shape (..., m, 2).

        The other joints are at rest, and no actuator is beyond its limit, in rad/s or m/s.

        :raises ParameterError: the file has no velocity limits.
        """
        q, ratio = self._solve(position)
        limits, rates = self._actuator_limits("velocity", q)[..., None], np.abs(ratio)
        rates = np.where(rates < _ROUNDING * rates.max(-2, keepdims=True), 0.0, rates)
        with np.errstate(divide="ignore"):
            most = np.where(rates > 0.0, limits / rates, np.inf).min(-2)
        return np.stack([-most, most], -1)

    def effort_polytope(self, position: ArrayLike) -> Array:
        """Return joint efforts of all actuators at a limit, shape (..., 2^n, m).

        Their convex hull contains all joint efforts that the actuators can apply; each is a vertex
        if there are as many actuators as freedoms.

        :raises ParameterError: an actuator without an effort limit.
        """
        q, ratio = self._solve(position)
        limits = self._actuator_limits("effort", q)
        free = [n for n, own in zip(self.actuators, limits.T, strict=True) if np.isinf(own).any()]
        if free:
            raise ParameterError("limits.effort", np.inf, f"finite limits of {', '.join(free)}")
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=self.robot.joints_count)))
        return np.asarray((corners * limits[..., None, :]) @ ratio)

    def inertia(self, position: ArrayLike) -> Array:
        """Return the inertia that the joint feels, (..., m, m): bodies, payload and rotors.

        Rotors count with the square of their ratio. kg m2, kg, or kg m between both.

        :raises ParameterError: the robot's file gives no masses.
        """
        place, m = self._check_joint_values(position, "positions"), len(self.joints)
        found = evaluate_at_pose(self.robot, pose_mass_kernel, self.robot.inertial, place)[1]
        return found.reshape(*found.shape[:-1], m, m)

    def _solve(self, position: ArrayLike) -> tuple[Array, Array]:
        """Return the model's q, shape (..., n), and the ratio, shape (..., n, m)."""
        place = self._check_joint_values(position, "positions")
        q, flat = evaluate_at_pose(self.robot, partial(transmission_kernel, curved=False), _NO_PARAMETERS, place)
        ratio = flat.reshape(*q.shape, len(self.joints))
        return q, ratio * self.robot.controller.slopes(q)[..., None]

    def _joint_per_actuator(self, q: Array, ratio: Array) -> Array:
        """Return P, the joint rates per actuator rate, shape (..., m, n)."""
        if not self.robot.redundant:
            return np.asarray(np.linalg.inv(ratio))
        weights = (self.robot.effort_scale / self.robot.controller.slopes(q)) ** 2
        weighted = (ratio * weights[..., None]).swapaxes(-1, -2)
        return np.asarray(np.linalg.inv(weighted @ ratio) @ weighted)

    def _actuator_limits(self, name: str, q: Array) -> Array:
        """Return the actuators' limits in the controller's numbers at positions q, (..., n)."""
        limits = getattr(self.robot.limits, name)
        if limits is None:
            raise ParameterError(f"limits.{name}", None, f"{name} limits of {', '.join(self.robot.joint_names)}")
        slopes = np.abs(self.robot.controller.slopes(q))
        return np.asarray(limits / slopes if name == "effort" else limits * slopes)

    def _check_joint_values(self, values: ArrayLike, name: str) -> Array:
        return vectors(values, len(self.joints), name)

    def _check_matrix(self, values: ArrayLike, name: str) -> Array:
        """Return matrices of the joint side, shape (..., m, m)."""
        m, given = len(self.joints), np.asarray(values, np.float64)
        if given.ndim < 2:
            given = np.diag(np.broadcast_to(given, (m,))) if given.shape in ((), (m,)) else given
        if given.shape[-2:] != (m, m) or not np.isfinite(given).all():
            raise ParameterError(name, values, f"finite numbers, shape (..., {m}, {m}) or ({m},)")
        return np.asarray(given, np.float64)


def _multiply(matrix: Array, vector: Array) -> Array:
    return np.asarray((matrix @ vector[..., None])[..., 0])


def transmission(robot: Robot) -> Transmission:
    """Return a robot as a transmission: pose coordinates to actuators and back, exactly.

    Made once for a robot. Only :meth:`Transmission.inertia` needs masses.
    """
    return robot.cached(Transmission)
