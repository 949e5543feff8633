# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""One engine for every machine: the programs made of its graph, and why one finds no assembly.

Newton's method on independent closures from a known state, judged by all of them, and behind it
whatever is asked: pose, Jacobians, torques.
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
from pkm_twin.kinematics.linkage import hold
from pkm_twin.kinematics.pose import Coordinate
from pkm_twin.kinematics.posed import CarriedScheme
from pkm_twin.kinematics.programs import (
    POSE_WEIGHT,
    acceleration_program,
    ahead_forward_program,
    body_jacobian_program,
    forward_program,
    inverse_program,
    jacobian_program,
    placement_program,
    quick_inverse_program,
    walk_program,
)
from pkm_twin.kinematics.scheme import Scheme, Start
from pkm_twin.kinematics.traced import NO_NUMBERS, Traced
from pkm_twin.machine.graph import Graph

MET: Final = 1e-9
"""Largest miss of a closure that holds, over the machine's size."""
TO_THE_END: Final[Mapping[str, float]] = {"gain": math.inf, "tolerance": 0.0}
"""Options of Newton's method that takes all its steps: the values of least squares are wanted."""


class Engine(Scheme):
    """Kinematics of a graph, and the compiled programs of it, each made when it is first used."""

    @cached_property
    def _kernels(self) -> dict[str, Kernel]:
        return {}

    def _walk(self, pose: Array, state: Array, step: Array) -> list[Array]:
        """Return values of closures and pose equations, their derivatives, and the state after a step."""
        return self.kernel("walk", walk_program)(NO_NUMBERS, state, pose, step)[0]

    def _look(self, q: Array, x: Array) -> tuple[Array, Array]:
        """Return the closures and their derivatives by the unknowns, of unit one."""
        still = np.zeros(self.tree.unknown_rates + self.joints)
        values, table, _ = self._walk(self.home_pose, np.concatenate([x, q]), still)
        k = len(self.parts)
        return values[:k], table.reshape(len(values), -1)[:k, : self.tree.unknown_rates]

    def _moved(self, q: Array, x: Array, step: Array) -> Array:
        """Return the unknowns after a step along their rates for a time of one."""
        steps = np.concatenate([step, np.zeros(self.joints)])
        return self._walk(self.home_pose, np.concatenate([x, q]), steps)[2][: len(x)]

    def reach(self, q: Array, limit: float = 1.0, precision: float = 1e-4) -> tuple[float, Array, float]:
        """Follow the straight line from home to q up to a singularity.

        :param limit: part of the way beyond which nothing is looked for.
        :returns: the part of the way, the unknowns there, and the closures' least reciprocal
            condition on it.
        """
        home = self.graph.lead_home
        x, done = np.array(self.tree.home, float), 0.0
        side, least = self._regularity(x, home)
        step = 1 / 8
        while step > precision and done < 1.0:
            way = min(1.0, done + step)
            there = home + way * (q - home)
            new, closed = newton(x, partial(self._look, there), partial(self._moved, there))
            # Beyond a singularity is another assembly.
            sign, measure = self._regularity(new, there) if closed else (0.0, 0.0)
            if not closed or sign != side or way > limit:
                step /= 8
                continue
            x, done, least = new, way, min(least, measure)
        return done, x, least

    def ending(self, q: Array, reached: float) -> tuple[str, float, float | None]:
        """Explain why no assembly is found beyond a part of the straight line from home to q.

        :returns: the part that falls short the most, by how much (m), and None; or, where there is
            an assembly behind a singularity, the closures' least reciprocal condition on the way.
        """
        _, x, least = self.reach(q, max(reached, 1e-12) + 1 / 8)
        look = partial(self._look, q)
        x, _ = newton(x, look, partial(self._moved, q), solve_damped, iterations=20, **TO_THE_END)
        values = look(x)[0]
        if not np.isfinite(values).all():
            return self.parts[0], math.inf, None
        worst = int(np.abs(values).argmax())
        miss = float(abs(values[worst])) * self.tree.size
        # Where nothing falls short there is an assembly, but the way does not lead to it.
        return self.parts[worst], miss, least if miss < MET * self.tree.size else None

    def _regularity(self, x: Array, q: Array) -> tuple[float, float]:
        """Return the sign of the independent closures' determinant, and their reciprocal condition."""
        matrix = self._look(q, x)[1][self.independent]
        s = np.linalg.svd(matrix, compute_uv=False)
        return float(np.linalg.slogdet(matrix)[0]), float(s[-1] / s[0]) if s.size and s[0] > 0.0 else 0.0

    def shortest_pose(self, pose: Array) -> tuple[str, float, bool]:
        """Return the closure with the largest miss while the platform is held in a pose.

        :returns: its joint or rod, by how much it misses, m, and whether all closures are met in
            the pose: then a singularity ends the path from home to it.
        """
        short = self.posed.find_shortfall(pose) if self.posed is not None else None
        if short is not None:
            return *short, not short[1] > MET * self.tree.size
        still = np.zeros(self.tree.unknown_rates + self.joints)

        def look(state: Array) -> tuple[Array, Array]:
            values, table, _ = self._walk(pose, state, still)
            return values, table.reshape(len(values), -1)

        def move(state: Array, step: Array) -> Array:
            return self._walk(pose, state, step)[2]

        home = np.array([*self.tree.home, *self.graph.lead_home], float)
        state, _ = newton(home, look, move, solve_damped, iterations=40, **TO_THE_END)
        values = look(state)[0]
        if not np.isfinite(values).all():
            return self.graph.platform, math.inf, False
        misses, names = np.abs(values), self.parts
        if not names:
            # A serial chain: what falls short is the platform itself.
            return self.graph.platform, float(misses.max()) * self.tree.size / POSE_WEIGHT, False
        worst = int(misses[: len(names)].argmax())
        return names[worst], float(misses[worst]) * self.tree.size, float(misses.max()) < MET

    # As programs.

    def kernel(self, name: str, write: Callable[[Traced], Program], extra: str = "", *, free: bool = False) -> Kernel:
        """Return the compiled program of a name on this geometry, the same object every time.

        :param extra: text of what the program hangs on beside the machine's structure.
        :param free: the program takes no number of the geometry for constant.
        """
        known = self._kernels.get(name)
        if known is None:
            known = self.kernel_with(NO_NUMBERS, name, write, extra, free=free)
            self._kernels[name] = known
        return known

    def kernel_with(
        self,
        more: Array,
        name: str,
        write: Callable[[Traced], Program],
        extra: str = "",
        *,
        free: bool = False,
    ) -> Kernel:
        """Return a program with more numbers than the geometry's: :attr:`Traced.more` there.

        :param extra: as of :meth:`kernel`, and ``free``.
        """
        key = self.structure.also(f"{name} {extra}", write, Traced)
        numbers = np.concatenate([self.geometry, more])
        made = Kernel(_code(key, self, write, more, free=free), numbers)
        if not made.holds:
            # It takes for constant what is none here: a program of these numbers' own.
            exact = key.also(f"{self.graph.key} {more.tolist()}")
            made = Kernel(_code(exact, self, write, more), numbers)
        return made

    @property
    def forward(self) -> Kernel:
        """Joint positions q to pose (m), position (3) and rotation (9) of the platform."""
        return self.kernel("forward", ahead_forward_program, self._ahead_key)

    @property
    def jacobian(self) -> Kernel:
        """Joint positions q to pose rates (m n) and platform twist (6 n) per joint rate, by row."""
        return self.kernel("jacobian", jacobian_program)

    @cached_property
    def posed(self) -> CarriedScheme | None:
        """The machine that is driven by its pose, None where its joints do not follow so.

        A screw turns more than once, and a joint that alone carries the platform would be cut.
        """
        if any(joint.type.threaded() for joint in self.graph.joints.values()):
            return None
        try:
            scheme = CarriedScheme(self, by_pose=True)
        except ParameterError:
            return None
        return scheme if all(n in scheme.tree.steps for n in self.graph.actuated) else None

    @cached_property
    def ahead(self) -> CarriedScheme | None:
        """The machine with the platform before its limbs, if all limbs have closed forms so.

        Then Newton's method has the platform's coordinates alone, fewer than all coordinates, and a
        scalar equation or two a limb. Machines with a closed form or a virtual joint keep their
        tree, and those whose platform has coordinates that follow from the pose: these could not be
        found from a pose beyond a singularity of the coordinates, which only that tree notices.
        """
        if self.start is not None or not self.solved[1]:
            return None
        if any(joint.virtual for joint in self.graph.joints.values()):
            return None
        try:
            scheme = CarriedScheme(self, by_pose=False)
            if any(c.place is None and not c.held for c in scheme.chain.carriers):
                return None
            fewer = len(scheme.solved[1]) < self.tree.unknown_rates
            return scheme if fewer and scheme.has_closed_limbs else None
        except (ParameterError, SingularityError):
            # A drive that reaches the platform alone cannot come after it.
            return None

    def posed_kernel(self, name: str, write: Callable[..., Program]) -> Kernel:
        """Return the compiled program of a name that solves the machine driven by its pose.

        :param write: writes it, of a :class:`Traced` and ``scheme``, :attr:`posed` or None.
        """
        scheme = self.posed
        if scheme is None:
            key = f"{self.inverse_pivots}"
        else:
            key = f"{scheme.structure.text} {scheme.drive_pivots} {scheme.chain}"
        key += self._ahead_key
        return self.kernel(name, partial(write, scheme=scheme), key)

    @property
    def _ahead_key(self) -> str:
        return self.ahead.structure.text if self.ahead is not None else ""

    @property
    def inverse(self) -> Kernel:
        """Pose to q, as ``forward`` confirms."""
        return self.posed_kernel("inverse", inverse_program)

    @property
    def own_forward(self) -> Kernel:
        """The program of :attr:`forward` with the machine's own tree.

        It holds for machines of other dimensions too, whose limbs may have no closed form.
        """
        return self.kernel("forward on own tree", forward_program)

    @property
    def followed_inverse(self) -> Kernel:
        """The program of :attr:`inverse` with the machine's own tree, as :attr:`own_forward`."""
        write = partial(inverse_program, scheme=None)
        return self.kernel("followed inverse", write, repr(self.inverse_pivots))

    @property
    def quick_inverse(self) -> Kernel:
        """Pose to q where the assembly is certain; other poses are rejected."""
        if self.posed is None:
            return self.inverse
        return self.posed_kernel("quick inverse", quick_inverse_program)

    @property
    def placement(self) -> Kernel:
        """Joint positions q to rotation (9) from home and origin (3) of every body, by body."""
        return self.kernel("placement", placement_program)

    @property
    def body_jacobian(self) -> Kernel:
        """Joint positions q to the twist (6 n) of every body's frame per joint rate, by body."""
        return self.kernel("body jacobian", body_jacobian_program)

    @property
    def acceleration(self) -> Kernel:
        """q, qd, qdd to the second derivative of the pose (m)."""
        return self.kernel("acceleration", acceleration_program)


_engines: Final[WeakValueDictionary[ProgramKey, Engine]] = WeakValueDictionary()
"""Engines that something still holds, by geometry: however many machines there are in between."""
_codes: Final[WeakValueDictionary[ProgramKey, Code]] = WeakValueDictionary()
"""Programs that something still holds: machines of one structure share them."""


def engine_of(graph: Graph, coordinates: Sequence[Coordinate], start: Start | None = None) -> Engine:
    """Return the engine of a geometry; machines that differ in inertia or limits alone share it."""
    key = EMPTY.also(f"{graph.key} {coordinates!r} {start!r}")
    engine = _engines.get(key)
    if engine is None:
        engine = _engines.setdefault(key, Engine(graph, coordinates, start=start))
        hold(engine)
    return engine


def _code(
    key: ProgramKey,
    engine: Engine,
    write: Callable[[Traced], Program],
    more: Array,
    *,
    free: bool = False,
) -> Code:
    """Return the program of a key; write it on an engine if it is not cached."""
    code = _codes.get(key)
    if code is None:
        code = _codes.setdefault(key, Code(lambda: write(Traced(engine, more, free=free)), key))
    return code
