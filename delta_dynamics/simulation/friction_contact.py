# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Decide which joints stick, slide or rest at their stops, and compute the accelerations.

Rows are the actuated joints, then the passive ones that have friction or a rotor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv  # type: ignore[import-untyped]

from delta_dynamics.simulation.exponential_integrator import Stepper, make_damped_stepper, make_undamped_stepper
from delta_dynamics.torques.equations import Equations, Terms
from pkm_twin.codegen.arrays import Array, Indices, Mask
from pkm_twin.machine.friction import Memory, bound_static_friction, potential, read_friction_values, sum_laws
from pkm_twin.machine.inertia import list_loaded_joints
from pkm_twin.robot.robot import Robot

States = NDArray[np.int8]
"""For each row 0 if its force is between its bounds, 1 at the upper and -1 at the lower bound."""

RELATIVE_TOLERANCE: Final = 1e-7
"""Tolerance of forces and motions, relative to the largest."""


def solve_resisting_forces(
    matrix: Array, motion: Array, low: Array, high: Array, states: States
) -> tuple[Array, States]:
    """Solve for forces that resist motions: a bounded linear complementarity problem.

    The remaining motion, w = motion - matrix force, is zero for a force between its bounds, not
    negative at the upper bound and not positive at the lower bound: Coulomb's law with -low = high =
    friction, or a stop with one infinite bound. Solved by block pivoting (Judice and Pires 1994),
    which ends for every positive definite matrix.

    :param matrix: motion per force, symmetric positive semidefinite, shape (m, m).
    :param motion: motion without these forces, shape (m,).
    :param states: initial guess of the states, shape (m,).
    :returns: the forces and their states; for dependent rows the smallest forces.
    :raises ValueError: a value that is not finite.
    """
    diagonal = matrix.diagonal()
    widths = np.minimum(np.where(np.isfinite(high), high, 0.0), 1e300)
    size = float(np.abs(motion).max() + (diagonal * np.abs(widths)).max())
    if not np.isfinite(size):
        raise ValueError("the motion is not finite")
    wrong_motion = RELATIVE_TOLERANCE * size
    wrong_force = wrong_motion / np.maximum(diagonal, 1e-300)
    # Dependent rows share their force, by a regularisation far below the tolerance.
    regular = matrix + np.eye(len(motion)) * (1e-11 * diagonal.max())
    states = np.where(np.isinf(np.where(states > 0, high, low)), 0, states).astype(np.int8)
    for sweep in range(1000):
        force = np.where(states > 0, high, np.where(states < 0, low, 0.0))
        held = np.flatnonzero(states == 0)
        if len(held):
            rest = motion[held] - matrix[held] @ force
            force[held] = np.linalg.solve(regular[np.ix_(held, held)], rest)
        left = motion - matrix @ force
        turned = np.where(
            states == 0,
            (force > high + wrong_force).astype(np.int8) - (force < low - wrong_force),
            np.where(states * left < -wrong_motion, 0, states),
        ).astype(np.int8)
        changes = np.flatnonzero(turned != states)
        if not len(changes):
            return force, states
        if sweep >= 10:
            # Block pivoting may cycle; one row at a time always terminates.
            changes = changes[:1]
        states[changes] = turned[changes]
    raise ValueError("no forces resist this motion")


def find_independent_rows(rows: Array, inverse: Array) -> list[int]:
    """Return the indices of the rows that are independent of earlier rows, to a relative 1e-7.

    :param rows: shape (m, n).
    :param inverse: inverse mass matrix, which defines the rows' scalar product, shape (n, n).
    """
    kept: list[int] = []
    basis: list[Array] = []
    for i, row in enumerate(rows):
        left = row
        for done in basis:
            left = left - (done @ inverse @ left) * done
        if left @ inverse @ left > 1e-7**2 * (row @ inverse @ row):
            kept.append(i)
            basis.append(left / np.sqrt(left @ inverse @ left))
    return kept


ZERO_VELOCITY: Final = 1e-12
"""Largest velocity of a row at rest, relative to the largest contribution of one joint."""


@dataclass(slots=True)
class Law:
    """The sliding rows (m) and the held rows (h), valid until a row starts or stops sliding."""

    dry_friction: Array
    """Constant dry friction of all rows, shape (n + k,)."""
    still: Mask
    """Rows that do not move, shape (n + k,)."""
    slides: Indices
    signs: Array
    """Rows with dry friction that slide, and their directions, shape (m,)."""
    held: Indices = field(default_factory=lambda: np.zeros(0, np.intp))
    """Independent rows that friction or stops hold at rest, drives first, shape (h,)."""
    low: Array = field(default_factory=lambda: np.zeros(0))
    high: Array = field(default_factory=lambda: np.zeros(0))
    """Bounds of the holding forces, shape (h,)."""
    moves: Indices = field(default_factory=lambda: np.zeros(0, np.intp))
    """Actuated joints that are not held."""
    floor: Array = field(default_factory=lambda: np.zeros(0))
    ceiling: Array = field(default_factory=lambda: np.zeros(0))
    """Bounds of the positions of ``moves``: the stops, or the initial position if it is beyond."""

    input_effort: Array = field(default_factory=lambda: np.zeros(0))
    effort: Array = field(default_factory=lambda: np.zeros(0))
    """Efforts of the drives without offset and dry friction, shape (n,)."""
    wrench: Array | None = None
    acceleration: Array = field(default_factory=lambda: np.zeros(0))
    """Accelerations at the start, shape (n,)."""
    force: Array = field(default_factory=lambda: np.zeros(0))
    """Holding forces at the start, shape (h,)."""

    @property
    def is_at_rest(self) -> bool:
        """True if friction or stops hold all drives."""
        return len(self.held) == len(self.effort)


class Resistance:
    """Model friction and stops of a robot, and track which of its rows move.

    ``forced_joints``: passive joints on which efforts act, as indices among those with friction.
    These efforts follow the wrench's six numbers, and their rates follow the platform's twist.
    ``memory``: state of the drives' presliding friction at the start of the present part of a step.
    """

    def __init__(self, robot: Robot, forced_joints: Sequence[int] = (), memory: Memory | None = None) -> None:
        self._forced_joints = list(forced_joints)
        n = robot.joints_count
        friction, passive = robot.friction, list_loaded_joints(robot.graph)
        self._offset = np.array(friction.offset, np.float64)
        self._viscous = np.array(friction.viscous, np.float64)
        self._inner = np.array([joint.viscous for joint in passive])
        self._damped = bool(self._viscous.any() or self._inner.any())
        self._passive = bool(passive)
        self._dry = np.array([*friction.coulomb, *(joint.coulomb for joint in passive)])
        self._laws, self._numbers = robot.laws, read_friction_values(robot.laws, robot.friction)
        # Friction with memory acts like a spring at rest, so no joint sticks by it.
        self._distance = np.array(friction.presliding)
        self._level = np.where(self._distance > 0.0, friction.coulomb, 0.0)
        self._dry[:n] -= self._level
        self.memory = memory
        self._has_dry_friction = self._dry > 0.0
        if self._laws:
            _, dry, share = sum_laws(self._laws, self._numbers, robot.graph.home, np.zeros(n))
            self._has_dry_friction[:n] |= (dry > 0.0) | (share > 0.0)
        limits = robot.limits.position
        limits = np.tile([-math.inf, math.inf], (n, 1)) if limits is None else limits
        self._low, self._high = limits[:, 0].copy(), limits[:, 1].copy()
        self._equations = Equations(robot)
        self._drives = np.eye(n)
        self._still = np.zeros(len(self._dry), bool)
        self._states: States = np.zeros(len(self._dry), np.int8)
        """State of each row: direction of sliding, or state of the force at rest."""
        self._law: Law | None = None

    def evaluate_terms(self, q: Array, qd: Array) -> Terms:
        """Return the terms of a state, with position-dependent friction of the drives.

        Errors as in :meth:`Equations.at`.
        """
        here = self._equations.at(q, qd)
        if self._forced_joints:
            here = here._replace(twists=np.concatenate([here.twists, here.rows[self._forced_joints]]))
        if not self._laws:
            return here
        energy = np.sum(potential(self._laws, self._numbers, q))
        energy += 0.5 * np.sum(self._level * self._distance * self._move_memory(q).z ** 2)
        bias, energy = here.bias + self._position_friction(q), here.potential + float(energy)
        return here._replace(bias=bias, potential=energy)

    def _move_memory(self, q: Array) -> Memory:
        """Return the friction memory after a straight motion to a position."""
        before = self.memory = self.memory or Memory.unknown_at(q)
        return before.advance_to(q[None], np.sign(q - before.q), self._distance).last

    def store_memory(self, here: Terms) -> None:
        """Store the friction memory at the end of a part of the step."""
        if self._level.any():
            self.memory = self._move_memory(here.q)

    def _position_friction(self, q: Array) -> Array:
        """Return the drives' friction that does not depend on velocity, shape (n,)."""
        own = sum_laws(self._laws, self._numbers, q, np.zeros_like(q))[0]
        return np.asarray(own + self._level * self._move_memory(q).z, np.float64)

    def _bounds(self, here: Terms, given: Array) -> tuple[Array, Array]:
        """Return the smallest and largest dry friction of all rows at a state, shape (n + k,).

        :param given: efforts of the drives, minus their offset, shape (n,).
        """
        low, high = -self._dry, self._dry.copy()
        if self._laws:
            n = len(given)
            _, dry, share = sum_laws(self._laws, self._numbers, here.q, np.abs(here.qd))
            held = given - self._position_friction(here.q) - self._viscous * here.qd
            low[:n], high[:n] = bound_static_friction(held, self._dry[:n] + dry, share)
        return low, high

    def build_row_jacobian(self, here: Terms) -> Array:
        """Return the matrix from joint velocities to those of the n drives and k passive joints, (n + k, n)."""
        return np.concatenate([self._drives, here.rows]) if self._passive else self._drives

    def apply_state(self, q: Array, qd: Array) -> Terms:
        """Return the terms of a new state, after the impact of joints that reach their stops."""
        return self._apply_impact(self._classify_rows(self.evaluate_terms(q, qd)))

    def _classify_rows(self, here: Terms) -> Terms:
        """Determine which rows move, and in which direction."""
        qd = here.qd
        rates = np.concatenate([qd, here.rows @ qd]) if self._passive else qd
        self._still = np.abs(rates) <= ZERO_VELOCITY * np.abs(self.build_row_jacobian(here) * here.qd).max(1)
        self._states = np.where(self._still, 0.0, np.sign(rates)).astype(np.int8)
        self._law = None
        return here

    def _apply_impact(self, here: Terms) -> Terms:
        """Return the state after the impact of joints at their stops; the same without one."""
        q, qd = here.q, here.qd
        up, down = q >= self._high, q <= self._low
        if not ((up & (qd > 0.0)) | (down & (qd < 0.0))).any():
            return here
        j = np.flatnonzero(up | down)
        across = _inverse(here.mass)[:, j]
        low, high = np.where(down[j], -math.inf, 0.0), np.where(up[j], math.inf, 0.0)
        # An impact is unbounded, so bounded friction cannot resist it.
        impulse, states = solve_resisting_forces(across[j], qd[j], low, high, np.zeros(len(j), np.int8))
        qd = qd - across @ impulse
        qd[j[states == 0]] = 0.0
        qd[up] = np.minimum(qd[up], 0.0)
        qd[down] = np.maximum(qd[down], 0.0)
        return self._classify_rows(self.evaluate_terms(q, qd))

    def find_law(self, here: Terms, effort: Array, wrench: Array | None) -> Law:
        """Return which rows slide and which are held under efforts (n,) and a wrench.

        :param wrench: shape (6,), followed by the efforts on ``forced_joints``.
        """
        law = self._law
        if law is not None:
            self._set_efforts(law, here, effort, wrench)
            # Sticking rows that depend linearly on law.held keep their forces: check the bounds of law.held only.
            if not len(law.held) or ((law.low <= law.force) & (law.force <= law.high)).all():
                return law
        n, still = len(here.q), self._still
        slides = np.flatnonzero(self._has_dry_friction & ~still)
        signs = self._states[slides].astype(np.float64)
        pull = np.zeros(len(self._dry))
        pull[slides] = self._dry[slides] * signs
        law = self._law = Law(pull, np.zeros(len(self._dry), bool), slides, signs)
        self._set_efforts(law, here, effort, wrench)
        up = (here.q >= self._high) & (here.qd == 0.0)
        down = (here.q <= self._low) & (here.qd == 0.0)
        resists = still & self._has_dry_friction
        resists[:n] |= up | down
        if resists.any():
            low, high = self._bounds(here, law.input_effort)
            high[:n][up] = math.inf
            low[:n][down] = -math.inf
            # Solve for the forces that hold the resting rows z, while the others keep their friction.
            z, inverse, motion = np.flatnonzero(resists), _inverse(here.mass), law.acceleration
            rows = self.build_row_jacobian(here)[z]
            if self._passive:
                motion = np.concatenate([motion, here.rows @ motion + here.drift])
            force, states = solve_resisting_forces(rows @ inverse @ rows.T, motion[z], low[z], high[z], self._states[z])
            self._states[z] = states
            stays = np.flatnonzero(states == 0)
            # A row that depends on held rows is at rest with them, so its own force stays constant.
            own = stays[find_independent_rows(rows[stays], inverse)]
            law.still[z[stays]] = True
            for i in np.flatnonzero(states):
                law.still[z[i]] = len(find_independent_rows(rows[[*own, i]], inverse)) == len(own)
            force[own] = 0.0
            law.dry_friction[z] = force
            begins = z[~law.still[z] & self._has_dry_friction[z]]
            law.slides = np.concatenate([law.slides, begins])
            law.signs = np.concatenate([law.signs, self._states[begins]])
            law.held = z[own]
            law.low, law.high = low[law.held], high[law.held]
            self._set_efforts(law, here, effort, wrench)
        law.moves = np.flatnonzero(~law.still[:n])
        law.floor = np.minimum(self._low, here.q)[law.moves]
        law.ceiling = np.maximum(self._high, here.q)[law.moves]
        return law

    def _set_efforts(self, law: Law, here: Terms, effort: Array, wrench: Array | None) -> None:
        """Store the efforts in a law, and compute accelerations, holding forces and their bounds."""
        law.input_effort, law.wrench = effort - self._offset, wrench
        law.effort = law.input_effort - law.dry_friction[: len(effort)]
        if self._laws and len(law.held):
            # Static friction grows with the load on the joint.
            low, high = (one[law.held] for one in self._bounds(here, law.input_effort))
            law.low = np.where(np.isfinite(law.low), low, law.low)
            law.high = np.where(np.isfinite(law.high), high, law.high)
        law.acceleration, law.force = self.accelerate(law, here)

    def accelerate(self, law: Law, here: Terms) -> tuple[Array, Array]:
        """Return accelerations at a state, shape (n,), and the holding forces, shape (h,)."""
        n, h, effort = len(law.effort), len(law.held), law.effort
        if self._laws:
            low, high = self._bounds(here, law.input_effort)
            pull = law.dry_friction.copy()
            pull[law.slides] = np.where(law.signs > 0.0, high[law.slides], low[law.slides])
            effort = law.input_effort - pull[:n]
        rest = effort - here.bias
        if law.wrench is not None:
            rest = rest + law.wrench @ here.twists
        if self._passive:
            rest = rest - (self._inner * (here.rows @ here.qd) + law.dry_friction[n:]) @ here.rows
        if self._damped:
            rest = rest - self._viscous * here.qd
        if not h:
            _, result, bad = dposv(here.mass, rest)
            if bad:
                raise ValueError("the mass matrix is not positive")
            return result, np.zeros(0)
        rows = self.build_row_jacobian(here)[law.held]
        matrix = np.zeros((n + h, n + h))
        matrix[:n, :n] = here.mass
        matrix[:n, n:] = rows.T
        matrix[n:, :n] = rows
        drift = np.concatenate([np.zeros(n), here.drift])[law.held] if self._passive else np.zeros(h)
        result = np.linalg.solve(matrix, np.concatenate([rest, -drift]))
        result[law.held[law.held < n]] = 0.0
        return result[:n], result[n:]

    def stepper(self, here: Terms, law: Law, span: float) -> Stepper:
        """Return the integrator of a part of a step, with the viscous friction at its start."""
        if not self._damped:
            return make_undamped_stepper(span)
        damping = self._damping(here)
        # If velocities decay by less than a tenth in the span, the classical method is stable.
        if span * dposv(here.mass, damping)[1].trace() < 0.1:
            return make_undamped_stepper(span)
        free = self._drives
        if len(law.held):
            # Columns span the joint velocities with held rows at rest.
            free = np.linalg.svd(self.build_row_jacobian(here)[law.held])[2][len(law.held) :].T
            free[law.held[law.held < len(free)]] = 0.0
        root = np.linalg.inv(np.linalg.cholesky(free.T @ here.mass @ free))
        decays, turned = np.linalg.eigh(root @ (free.T @ damping @ free) @ root.T)
        modes = free @ root.T @ turned
        return make_damped_stepper(span, modes, modes.T @ here.mass, np.maximum(decays, 0.0))

    def _damping(self, here: Terms) -> Array:
        """Return the viscous friction of all joints by joint velocities, shape (n, n)."""
        inner: Array = (here.rows.T * self._inner) @ here.rows
        return np.diag(self._viscous) + inner

    def step_implicitly(self, here: Terms, law: Law, span: float) -> Terms:
        """Integrate a part of a step by Moreau's implicit time stepping, of order one.

        For friction so stiff that its transients cannot be resolved. Rows may start or stop sliding in
        the part; there is always a result, and energy never grows.
        """
        n = len(here.q)
        inverse = _inverse(here.mass + span * self._damping(here))
        rest = law.input_effort - here.bias + (0.0 if law.wrench is None else law.wrench @ here.twists)
        rates = inverse @ (here.mass @ here.qd + span * rest)
        up, down = here.q >= self._high, here.q <= self._low
        low, high = (span * one for one in self._bounds(here, law.input_effort))
        high[:n][up] = math.inf
        low[:n][down] = -math.inf
        resists = self._has_dry_friction.copy()
        resists[:n] |= up | down
        z = np.flatnonzero(resists)
        rows = self.build_row_jacobian(here)[z]
        states = np.zeros(len(z), np.int8)
        if len(z):
            force, states = solve_resisting_forces(rows @ inverse @ rows.T, rows @ rates, low[z], high[z], states)
            rates = rates - inverse @ (rows.T @ force)
            rates[z[(states == 0) & (z < n)]] = 0.0
        self._law = None
        self._still[:] = False
        self._still[z] = states == 0
        self._states[z] = states
        low, high = np.minimum(self._low, here.q), np.maximum(self._high, here.q)
        return self._apply_impact(self.evaluate_terms(np.clip(here.q + span * rates, low, high), rates))

    def find_lasting_fraction(self, here: Terms, end: Terms, law: Law) -> float:
        """Return the fraction of a span up to which the law holds, 1 for all of it.

        It holds while joints are within their stops, sliding rows keep their directions, and holding
        forces are within their bounds. The margins are interpolated linearly over the span.
        """
        before, after = here.q[law.moves], end.q[law.moves]
        begins, ends = [law.ceiling - before, before - law.floor], [law.ceiling - after, after - law.floor]
        if len(law.slides):
            first, last = (self.build_row_jacobian(t)[law.slides] for t in (here, end))
            begins.append(law.signs * (first @ here.qd))
            ends.append(law.signs * (last @ end.qd) + ZERO_VELOCITY * (np.abs(last) @ np.abs(end.qd)))
        if len(law.held):
            force = self.accelerate(law, end)[1]
            size = ZERO_VELOCITY * np.maximum(np.abs(force), np.abs(law.force))
            begins += [law.high - law.force, law.force - law.low]
            ends += [law.high - force + size, force - law.low + size]
        margin, left = np.concatenate(begins), np.concatenate(ends)
        broken = left < 0.0
        if not broken.any():
            return 1.0
        margin = np.maximum(margin[broken], 0.0)
        return float((margin / (margin - left[broken])).min())

    def finish_part(self, end: Terms, law: Law) -> Terms:
        """Return the state at the end of a part, with held rows at rest and impacts applied."""
        self._still = law.still
        self._states[law.still] = 0
        if self._passive and len(law.held):
            # Remove the velocity that integration errors give held rows of passive joints.
            rows = self.build_row_jacobian(end)[law.held]
            across = np.linalg.solve(end.mass, rows.T)
            drift = np.linalg.lstsq(rows @ across, rows @ end.qd, rcond=1e-12)[0]
            qd = end.qd - across @ drift
            qd[law.held[law.held < len(qd)]] = 0.0
            end = end if (qd == end.qd).all() else self.evaluate_terms(end.q, qd)
        return self._apply_impact(end)


def _inverse(matrix: Array) -> Array:
    return np.asarray(np.linalg.inv(matrix), np.float64)
