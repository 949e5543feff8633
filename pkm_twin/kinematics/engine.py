# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The kinematics engine of a machine: compiled programs from its graph, and reasons of rejection.

Every program solves the independent closures by Newton's method from a known state, accepts the
solution if all closures are satisfied, and then computes the outputs: pose, Jacobians, torques.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Final
from weakref import WeakValueDictionary

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.code import Code
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.key import EMPTY, ProgramKey
from pkm_twin.codegen.program import Program
from pkm_twin.errors import ParameterError, SingularityError
from pkm_twin.kinematics.iterations import newton, solve_damped
from pkm_twin.kinematics.linkage import keep_linkage
from pkm_twin.kinematics.pose import Coordinate
from pkm_twin.kinematics.posed import PlatformFirstScheme
from pkm_twin.kinematics.programs import (
    POSE_WEIGHT,
    acceleration_program,
    body_jacobian_program,
    forward_program,
    inverse_program,
    jacobian_program,
    newton_step_program,
    placement_program,
    quick_inverse_program,
)
from pkm_twin.kinematics.scheme import ClosedFormStart, Scheme
from pkm_twin.kinematics.traced import NO_NUMBERS, Traced
from pkm_twin.machine.graph import Graph

MAX_GAP: Final = 1e-9
"""Largest residual of a closure that counts as satisfied, relative to the machine's size."""
WITHOUT_STOPPING: Final[Mapping[str, float]] = {"gain": math.inf, "tolerance": 0.0}
"""Options of :func:`newton` that take all iterations, towards the least-squares residual."""


class Engine(Scheme):
    """Kinematics of a graph, with its programs, each compiled when it is first used."""

    @cached_property
    def _kernels(self) -> dict[str, Kernel]:
        return {}

    def _newton_step(self, pose: Array, state: Array, step: Array) -> list[Array]:
        """Return residuals of closures and pose, their Jacobian, and the state after a given step."""
        return self.kernel("walk", newton_step_program)(NO_NUMBERS, state, pose, step)[0]

    def _evaluate_closures(self, q: Array, x: Array) -> tuple[Array, Array]:
        """Return the closures' dimensionless residuals and their Jacobian by the unknowns."""
        still = np.zeros(self.tree.unknown_rates + self.joints)
        values, table, _ = self._newton_step(self.home_pose, np.concatenate([x, q]), still)
        k = len(self.parts)
        return values[:k], table.reshape(len(values), -1)[:k, : self.tree.unknown_rates]

    def _retract(self, q: Array, x: Array, step: Array) -> Array:
        """Return the unknowns after a step along their rates."""
        steps = np.concatenate([step, np.zeros(self.joints)])
        return self._newton_step(self.home_pose, np.concatenate([x, q]), steps)[2][: len(x)]

    def follow_line(self, q: Array, limit: float = 1.0, precision: float = 1e-4) -> tuple[float, Array, float]:
        """Follow the straight line from home to q up to a singularity.

        :param limit: fraction of the line at which to stop.
        :returns: the fraction of the line that was reached, the unknowns there, and the smallest
            reciprocal condition number of the closures up to there.
        """
        home = self.graph.lead_home
        x, done = np.array(self.tree.home, float), 0.0
        side, least = self._regularity(x, home)
        step = 1 / 8
        while step > precision and done < 1.0:
            way = min(1.0, done + step)
            there = home + way * (q - home)
            new, closed = newton(x, partial(self._evaluate_closures, there), partial(self._retract, there))
            # Beyond a singularity Newton's method finds another assembly.
            sign, measure = self._regularity(new, there) if closed else (0.0, 0.0)
            if not closed or sign != side or way > limit:
                step /= 8
                continue
            x, done, least = new, way, min(least, measure)
        return done, x, least

    def explain_missing_assembly(self, q: Array, reached: float) -> tuple[str, float, float | None]:
        """Explain why no assembly is found beyond a fraction of the straight line from home to q.

        :returns: the joint or rod whose closure has the largest gap at q, the gap, m, and None. If
            an assembly exists at q beyond a singularity, the last is the closures' smallest
            reciprocal condition number on the line.
        """
        _, x, least = self.follow_line(q, max(reached, 1e-12) + 1 / 8)
        evaluate_closures = partial(self._evaluate_closures, q)
        x, _ = newton(x, evaluate_closures, partial(self._retract, q), solve_damped, iterations=20, **WITHOUT_STOPPING)
        values = evaluate_closures(x)[0]
        if not np.isfinite(values).all():
            return self.parts[0], math.inf, None
        worst = int(np.abs(values).argmax())
        miss = float(abs(values[worst])) * self.tree.size
        # Without a gap an assembly exists at q, but the straight line does not lead to it.
        return self.parts[worst], miss, least if miss < MAX_GAP * self.tree.size else None

    def _regularity(self, x: Array, q: Array) -> tuple[float, float]:
        """Return the sign of the closures' determinant and their reciprocal condition number."""
        matrix = self._evaluate_closures(q, x)[1][self.independent]
        s = np.linalg.svd(matrix, compute_uv=False)
        return float(np.linalg.slogdet(matrix)[0]), float(s[-1] / s[0]) if s.size and s[0] > 0.0 else 0.0

    def find_pose_gap(self, pose: Array) -> tuple[str, float, bool]:
        """Find the closure with the largest gap while the platform is fixed in a pose.

        :returns: the joint or rod of that closure, the gap, m, and whether all closures are
            satisfied: then a singularity prevents the pose.
        """
        short = self.posed.find_shortfall(pose) if self.posed is not None else None
        if short is not None:
            return *short, not short[1] > MAX_GAP * self.tree.size
        still = np.zeros(self.tree.unknown_rates + self.joints)

        def evaluate_closures(state: Array) -> tuple[Array, Array]:
            values, table, _ = self._newton_step(pose, state, still)
            return values, table.reshape(len(values), -1)

        def move(state: Array, step: Array) -> Array:
            return self._newton_step(pose, state, step)[2]

        home = np.array([*self.tree.home, *self.graph.lead_home], float)
        state, _ = newton(home, evaluate_closures, move, solve_damped, iterations=40, **WITHOUT_STOPPING)
        values = evaluate_closures(state)[0]
        if not np.isfinite(values).all():
            return self.graph.platform, math.inf, False
        misses, names = np.abs(values), self.parts
        if not names:
            # A serial chain has no closures: the gap is that of the platform to the pose.
            return self.graph.platform, float(misses.max()) * self.tree.size / POSE_WEIGHT, False
        worst = int(misses[: len(names)].argmax())
        return names[worst], float(misses[worst]) * self.tree.size, float(misses.max()) < MAX_GAP

    def kernel(self, name: str, write: Callable[[Traced], Program], extra: str = "", *, free: bool = False) -> Kernel:
        """Return the named program for this geometry; compile it at the first call.

        :param extra: text that identifies what the program depends on in addition to the structure.
        :param free: treat no number of the geometry as a constant.
        """
        known = self._kernels.get(name)
        if known is None:
            known = self.kernel_with_inputs(NO_NUMBERS, name, write, extra, free=free)
            self._kernels[name] = known
        return known

    def kernel_with_inputs(
        self,
        more: Array,
        name: str,
        write: Callable[[Traced], Program],
        extra: str = "",
        *,
        free: bool = False,
    ) -> Kernel:
        """Return a program with constant inputs in addition to the geometry: :attr:`Traced.more`.

        :param more: values of these inputs. ``extra``, ``free``: as in :meth:`kernel`.
        """
        key = self.structure.extend(f"{name} {extra}", write, Traced)
        numbers = np.concatenate([self.geometry, more])
        made = Kernel(_find_code(key, self, write, more, free=free), numbers)
        if not made.matches_geometry:
            # A number that the program treats as a constant differs here: write another program.
            exact = key.extend(f"{self.graph.key} {more.tolist()}")
            made = Kernel(_find_code(exact, self, write, more), numbers)
        return made

    @property
    def forward(self) -> Kernel:
        """Program from joint positions to pose (m), position (3) and rotation (9) of the platform."""
        return self.kernel("forward", lambda t: forward_program(t.reduced), self._reduced_key)

    @property
    def jacobian(self) -> Kernel:
        """Program from joint positions to pose rates (m n) and twist (6 n) per joint rate, by row."""
        return self.kernel("jacobian", jacobian_program)

    @cached_property
    def posed(self) -> PlatformFirstScheme | None:
        """The machine driven by its pose; None if its joints do not follow from the pose.

        None for machines with screws, which turn more than once, and where the tree would cut an
        actuated joint.
        """
        if any(joint.type.threaded() for joint in self.graph.joints.values()):
            return None
        try:
            scheme = PlatformFirstScheme(self, by_pose=True)
        except ParameterError:
            return None
        return scheme if all(n in scheme.tree.steps for n in self.graph.actuated) else None

    @cached_property
    def reduced(self) -> PlatformFirstScheme | None:
        """The machine with its platform placed first; None if that saves no unknowns.

        If all limbs have closed forms, Newton's method solves for the platform's coordinates alone,
        with one or two scalar equations per limb. Machines with a closed form of all unknowns or
        with a virtual joint keep their own tree; so do machines whose platform has free coordinates
        that are not pose coordinates: a pose beyond a singularity does not determine these, and
        only the machine's own tree detects that.
        """
        if self.start is not None or not self.newton_unknowns[1]:
            return None
        if any(joint.virtual for joint in self.graph.joints.values()):
            return None
        try:
            scheme = PlatformFirstScheme(self, by_pose=False)
            if any(c.pose_index is None and not c.constrained for c in scheme.chain.virtual_joints):
                return None
            fewer = len(scheme.newton_unknowns[1]) < self.tree.unknown_rates
            return scheme if fewer and scheme.has_closed_limbs else None
        except (ParameterError, SingularityError):
            # A drive that alone connects platform and base cannot be placed after the platform.
            return None

    def posed_kernel(self, name: str, write: Callable[..., Program]) -> Kernel:
        """Return the named program of the machine driven by its pose; compile it at the first call.

        :param write: writes the program from a :class:`Traced` and ``scheme``, :attr:`posed` or None.
        """
        scheme = self.posed
        if scheme is None:
            key = f"{self.inverse_pivots}"
        else:
            key = f"{scheme.structure.text} {scheme.drive_pivots} {scheme.chain}"
        key += self._reduced_key
        return self.kernel(name, partial(write, scheme=scheme), key)

    @property
    def _reduced_key(self) -> str:
        return self.reduced.structure.text if self.reduced is not None else ""

    @property
    def inverse(self) -> Kernel:
        """Program from a pose to joint positions, confirmed by the forward kinematics."""
        return self.posed_kernel("inverse", inverse_program)

    @property
    def generic_forward(self) -> Kernel:
        """Forward kinematics on the machine's own tree, without closed forms of limbs.

        Valid also for changed dimensions, for which the closed forms may not exist.
        """
        return self.kernel("forward on own tree", forward_program)

    @property
    def generic_inverse(self) -> Kernel:
        """Inverse kinematics on the machine's own tree, as :attr:`generic_forward`."""
        write = partial(inverse_program, scheme=None)
        return self.kernel("followed inverse", write, repr(self.inverse_pivots))

    @property
    def quick_inverse(self) -> Kernel:
        """Program from a pose to joint positions, only for poses whose assembly is certain."""
        if self.posed is None:
            return self.inverse
        return self.posed_kernel("quick inverse", quick_inverse_program)

    @property
    def placement(self) -> Kernel:
        """Program from joint positions to rotation (9) from home and origin (3) of each body."""
        return self.kernel("placement", placement_program)

    @property
    def body_jacobian(self) -> Kernel:
        """Program from joint positions to the twist (6 n) of each body's frame per joint rate."""
        return self.kernel("body jacobian", body_jacobian_program)

    @property
    def acceleration(self) -> Kernel:
        """Program from q, qd and qdd to the second derivative of the pose (m)."""
        return self.kernel("acceleration", acceleration_program)


_engines: Final[WeakValueDictionary[ProgramKey, Engine]] = WeakValueDictionary()
"""Engines that are still referenced, by geometry."""
_codes: Final[WeakValueDictionary[ProgramKey, Code]] = WeakValueDictionary()
"""Programs that are still referenced; machines of one structure share them."""


def find_engine(graph: Graph, coordinates: Sequence[Coordinate], start: ClosedFormStart | None = None) -> Engine:
    """Return the engine of a geometry, shared by machines that differ only in inertia or limits."""
    key = EMPTY.extend(f"{graph.key} {coordinates!r} {start!r}")
    engine = _engines.get(key)
    if engine is None:
        engine = _engines.setdefault(key, Engine(graph, coordinates, start=start))
        keep_linkage(engine)
    return engine


def _find_code(
    key: ProgramKey,
    engine: Engine,
    write: Callable[[Traced], Program],
    more: Array,
    *,
    free: bool = False,
) -> Code:
    """Return the program with a key, from memory or written for an engine."""
    code = _codes.get(key)
    if code is None:
        code = _codes.setdefault(key, Code(lambda: write(Traced(engine, more, free=free)), key))
    return code
