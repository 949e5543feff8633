# SPDX-License-Identifier: Apache-2.0
"""One engine for every machine: what its graph gives at home, and the programs made of it.

At home, on numbers: mobility, rank, redundant closures. Away from it, as compiled programs:
Newton's method on independent closures from a known state, judged by all of them, and behind it
whatever is asked: pose, Jacobians, torques.

May import: numpy, pkm_twin's machine and codegen, this package, the standard library.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.derivatives import adjoints
from pkm_twin.codegen.expressions import GEOMETRY, Expression, Numbers, Objects, Tape, snapped_all
from pkm_twin.codegen.kernels import Code, Kernel
from pkm_twin.codegen.lu import Order, SparseLU, independent_rows, pivot_order
from pkm_twin.codegen.program import UNKNOWNS, Equations, Program
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics import pose as poses
from pkm_twin.kinematics.motion import Motion, Row, cross, matrices, numbers
from pkm_twin.kinematics.pose import Coordinate
from pkm_twin.machine.geometry import geometry_of, graph_on, pattern_of
from pkm_twin.machine.graph import Array, Graph
from pkm_twin.machine.tree import Tree

_NO_PARAMETERS: Final = np.zeros(0)
RANK: Final = 1e-9
"""Part of a matrix's largest singular value below which one counts as zero."""
MET: Final = 1e-9
"""Largest miss of a closure that holds, over the machine's size."""
POSE_WEIGHT: Final = 100.0
"""What the pose weighs against closures where not all can be met: so a closure falls short."""
SAMPLES: Final = 6
"""States near home, beside it, in which pivots have to be good."""


@dataclass(frozen=True, eq=False)
class Closed:
    """What a mechanism's closed forms hang on beside the graph.

    ``numbers``: shape (k,). ``start``: where there is one, of such numbers and q to the values of
    passive tree joints beside home, by name, from the inner to the outer body.
    """

    numbers: Array
    start: Callable[[Numbers, Objects], Mapping[str, Sequence[Any]]] | None = None


Branch = Callable[[Motion], Sequence[Any]]
"""A mechanism's numbers that are above zero in its own branch, of the motion."""


@dataclass(frozen=True)
class Mobility:
    """What the graph at home says.

    ``freedoms``: of the whole machine. ``rank``: of all closures. ``redundant``: closures less
    their rank. ``parts``: the cut joints and rods among which they are. ``unknowns``: of the tree.
    """

    freedoms: int
    closures: int
    rank: int
    redundant: int
    parts: tuple[str, ...]
    unknowns: int


class Engine:
    """Kinematics of a graph, and the compiled programs of it, each made when it is first used."""

    def __init__(
        self,
        graph: Graph,
        coordinates: Sequence[Coordinate],
        closed: Closed | None = None,
        branch: Branch | None = None,
        mark: str = "",
    ) -> None:
        self.graph, self.coordinates = graph, tuple(coordinates)
        self.tree = Tree(graph)
        self.closed, self._branch, self._mark = closed or Closed(np.zeros(0)), branch, mark
        self._kernels: dict[str, Kernel] = {}

    @cached_property
    def geometry(self) -> Array:
        """What programs take of the machine's geometry, shape (k,)."""
        return np.concatenate([geometry_of(self.graph), self.closed.numbers])

    @cached_property
    def structure(self) -> str:
        """Text of all that programs hang on: machines of one structure share them."""
        return repr((
            self._mark, self.graph.topology, pattern_of(self.tree), self.coordinates,
            self.closed.start is not None, self._branch is not None, self.kept, self.pivots,
        ))  # fmt: skip

    @cached_property
    def pivots(self) -> Order:
        """Of the kept closures by the unknowns, good in states near home."""
        return pivot_order(self._sampled[0][:, self.kept])

    @cached_property
    def inverse_pivots(self) -> Order:
        """The same of kept closures and pose by the unknowns and q."""
        samples = []
        for x, q in self._samples:
            there, closed = self.at(x, q)
            position, rotation = (numbers(part) for part in there.platform())
            here = [float(v) for v in poses.values(self.coordinates, position, rotation)]
            samples.append(self._inverse_matrix(there, closed, here))
        return pivot_order(np.array(samples))

    # On numbers.

    @property
    def joints(self) -> int:
        """Number of actuated joints."""
        return len(self.graph.actuated)

    def at(self, x: Numbers, q: Numbers) -> tuple[Motion, list[Row]]:
        """Motion and closures in a state, on numbers."""
        motion = Motion(self.tree, x, q)
        return motion, motion.closures()

    def _scaled(self, rows: Sequence[Row]) -> tuple[Array, Array]:
        """Derivatives by u and by qd, every row and column of unit one."""
        ju, jq = (numbers(m) for m in matrices(self.tree, rows))
        left = np.array([row.scale for row in rows]).reshape(-1, 1)
        drives = np.array([self._drive_scale(name) for name in self.graph.actuated])
        return left * ju / np.array(self.tree.scales), left * jq / drives

    def _drive_scale(self, name: str) -> float:
        return 1.0 / self.tree.size if self.graph.joints[name].slides else 1.0

    def close(self, q: Numbers, start: Numbers | None = None) -> Array | None:
        """Unknowns of a state near a known one, on numbers; None where they are not found."""
        x = list(self.tree.home) if start is None else list(start)
        last = np.inf
        for _ in range(12):
            _, rows = self.at(x, q)
            if not rows:
                return np.array(x, float)
            ju, _ = self._scaled(rows)
            value = np.array([row.scale * float(row.value) for row in rows])
            step, *_ = np.linalg.lstsq(ju, -value, rcond=RANK)
            size = float(np.abs(step).max(initial=0.0))
            if not size < 0.5 * last:
                return None
            motion = Motion(self.tree, x, q)
            x = [float(v) for v in motion.retracted(x, step / np.array(self.tree.scales))]
            if size < 1e-12:
                return np.array(x, float) if float(np.abs(value).max()) < 1e-9 else None
            last = max(size, 1e-13)
        return None

    @cached_property
    def _samples(self) -> list[tuple[Array, Array]]:
        """States (x, q) at home and near it, found by the first engine of a geometry for all."""
        first = _engines.setdefault(self.graph.key, self)
        if first is not self:
            return first._samples
        # The one that chooses pose coordinates is followed by the one that has them.
        _hold(self)
        return self._near_home()

    def _near_home(self) -> list[tuple[Array, Array]]:
        """The same in every run."""
        graph, home = self.graph, self.graph.home
        states = [(np.array(self.tree.home, float), home)]
        random = np.random.default_rng(0)
        reach = np.array(
            [0.15 * self.tree.size if self._drive_scale(n) != 1.0 else 0.3 for n in graph.actuated]
        )
        for _ in range(4 * SAMPLES):
            if len(states) > SAMPLES:
                break
            way = random.uniform(-1.0, 1.0, len(home)) * reach
            x: Array | None = states[0][0]
            for part in (0.5, 1.0):
                x = None if x is None else self.close(home + part * way, x)
            if x is not None:
                states.append((x, home + way))
            else:
                reach = reach * 0.8
        return states

    @cached_property
    def _sampled(self) -> tuple[Array, Array]:
        """Scaled derivatives by u and qd in the samples, shape (k, rows, ...)."""
        pairs = [self._scaled(self.at(x, q)[1]) for x, q in self._samples]
        return np.array([a for a, _ in pairs]), np.array([b for _, b in pairs])

    @cached_property
    def kept(self) -> list[int]:
        """Closures that determine the unknowns; the others only judge.

        :raises ParameterError: something can move while the actuated joints are held.
        """
        ju, _ = self._sampled
        rows = independent_rows(ju)
        if len(rows) < self.tree.unknown_rates:
            from pkm_twin.kinematics.diagnosis import mobility_error

            raise mobility_error(self)
        return rows

    def scaled_at_home(self) -> tuple[Array, Array]:
        """Derivatives of the closures at home by u and by qd, every row and column of unit one."""
        return self._scaled(self.at(self.tree.home, self.graph.home)[1])

    def regular_state(self) -> tuple[Motion, Array]:
        """The motion in a state of the highest rank at or beside home, and derivatives by u."""
        k = int(np.argmax([_rank(ju) for ju in self._sampled[0]]))
        return self.at(*self._samples[k])[0], np.asarray(self._sampled[0][k], np.float64)

    @cached_property
    def mobility(self) -> Mobility:
        """Freedoms, rank and redundancy at home."""
        _, rows = self.at(self.tree.home, self.graph.home)
        both = np.hstack(self._scaled(rows))
        rank = _rank(both)
        parts: tuple[str, ...] = ()
        if rank < len(rows):
            left = np.linalg.svd(both)[0][:, rank:]
            used = np.abs(left).max(1) > 1e-6
            parts = tuple(dict.fromkeys(r.part for r, u in zip(rows, used, strict=True) if u))
        unknowns = self.tree.unknown_rates
        return Mobility(
            unknowns + self.joints - rank, len(rows), rank, len(rows) - rank, parts, unknowns
        )

    def check(self) -> None:
        """Refuse a graph that its actuated joints and pose coordinates do not determine.

        :raises ParameterError: by the field.
        """
        near = [_rank(np.hstack([a, b])) for a, b in zip(*self._sampled, strict=True)]
        if len(near) > 1 and near[0] < min(near[1:]):
            from pkm_twin.kinematics.diagnosis import singular_home

            raise singular_home(self, near[0], min(near[1:]))
        if self.mobility.freedoms != self.joints:
            from pkm_twin.kinematics.diagnosis import mobility_error

            raise mobility_error(self)
        _ = self.kept
        if len(self.coordinates) != self.joints:
            raise ParameterError(
                "pose",
                [c.name for c in self.coordinates],
                f"{self.joints} coordinates, the mobility",
            )
        motion, rows = self.at(*self._samples[0])
        matrix = self._inverse_matrix(motion, rows, self.home_pose.tolist())
        if _rank(matrix) < len(matrix):
            raise ParameterError(
                "pose", [c.name for c in self.coordinates],
                "coordinates that determine the platform's pose at home",
            )  # fmt: skip

    @cached_property
    def home_pose(self) -> Array:
        """Pose coordinates at home, shape (m,)."""
        origin = self.graph.origin
        return np.array([0.0 if c.axis is None else origin[c.axis] for c in self.coordinates])

    def _inverse_matrix(self, motion: Motion, rows: Sequence[Row], pose: Numbers) -> Array:
        """Scaled derivatives of kept closures and pose equations by u and qd."""
        ju, jq = self._scaled(rows)
        extra = self._pose_rows(motion, pose)
        table = np.array(self._pose_scales)[:, None] * numbers(extra)
        n = self.tree.unknown_rates
        drives = np.array([self._drive_scale(name) for name in self.graph.actuated])
        lower = np.hstack([table[:, :n] / np.array(self.tree.scales), table[:, n:] / drives])
        return np.vstack([np.hstack([ju, jq])[self.kept], lower])

    @property
    def _pose_scales(self) -> list[float]:
        return [1.0 / self.tree.size if c.axis is not None else 1.0 for c in self.coordinates]

    def _pose_rows(self, motion: Motion, pose: Numbers) -> Objects:
        n = self.tree.unknown_rates
        table = np.zeros((len(self.coordinates), n + self.joints), dtype=object)
        for i, (_, columns) in enumerate(poses.rows(self.coordinates, motion, pose)):
            for (kind, k), value in columns.items():
                table[i, k if kind == "u" else n + k] = value
        return table

    def _look(self, x: Array, q: Array, move: Array | None = None) -> tuple[Array, Array, Array]:
        """Closures and their derivatives by the unknowns, of unit one; and the unknowns moved.

        :param move: of unit one, shape (unknown rates,).
        """
        walk = self.kernel("walk", _walk)
        step = np.zeros(self.tree.unknown_rates) if move is None else move
        (values, table, moved), _ = walk(_NO_PARAMETERS, x, q, step)
        return values, table.reshape(len(values), -1), moved

    def _closed(self, q: Array, x: Array) -> Array | None:
        """As :meth:`close`, compiled."""
        last = np.inf
        for _ in range(12):
            values, table, _ = self._look(x, q)
            if not (np.isfinite(values).all() and np.isfinite(table).all()):
                return None
            step = np.asarray(np.linalg.lstsq(table, -values, rcond=RANK)[0], np.float64)
            size = float(np.abs(step).max(initial=0.0))
            if not size < 0.5 * last:
                return None
            x = self._look(x, q, step)[2]
            if size < 1e-12:
                return x if float(np.abs(values).max(initial=0.0)) < 1e-9 else None
            last = max(size, 1e-13)
        return None

    def reach(
        self, q: Array, limit: float = 1.0, precision: float = 1e-4
    ) -> tuple[float, Array, float]:
        """How far the straight way from home to q leads without passing a singularity.

        :param limit: part of the way beyond which nothing is looked for.
        :returns: the part of the way, the unknowns there, and the closures' least reciprocal
            condition on it.
        """
        home = self.graph.home
        x, done = np.array(self.tree.home, float), 0.0
        side, least = self._regularity(x, home)
        step = 1 / 8
        while step > precision and done < 1.0:
            way = min(1.0, done + step)
            there = home + way * (q - home)
            new = self._closed(there, x)
            # Beyond a singularity is another assembly.
            sign, measure = (0.0, 0.0) if new is None else self._regularity(new, there)
            if new is None or sign != side or way > limit:
                step /= 8
                continue
            x, done, least = new, way, min(least, measure)
        return done, x, least

    def ending(self, q: Array, reached: float) -> tuple[str, float, float | None]:
        """Why no assembly is found beyond a part of the straight way from home to q.

        :returns: the part that falls short the most, by how much (m), and None; or, where there is
            an assembly behind a singularity, the closures' least reciprocal condition on the way.
        """
        _, x, least = self.reach(q, max(reached, 1e-12) + 1 / 8)
        part, miss = self._shortest(x, q)
        # Where nothing falls short there is an assembly, but the way does not lead to it.
        return part, miss, least if miss < MET * self.tree.size else None

    def _regularity(self, x: Array, q: Array) -> tuple[float, float]:
        """Sign of the determinant of the kept closures, and their reciprocal condition."""
        matrix = self._look(x, q)[1][self.kept]
        return float(np.linalg.slogdet(matrix)[0]), _reciprocal(matrix)

    def _shortest(self, x: Array, q: Array) -> tuple[str, float]:
        """The closure that misses the most where all together miss the least, and by how much."""
        values, table, _ = self._look(x, q)
        for _ in range(20):
            if not (np.isfinite(values).all() and np.isfinite(table).all()):
                return self._parts[0], math.inf
            damped = table.T @ table + 1e-6 * np.eye(table.shape[1])
            step = np.asarray(np.linalg.solve(damped, -table.T @ values), np.float64)
            step *= min(1.0, 0.2 / max(float(np.abs(step).max(initial=0.0)), 1e-300))
            x = self._look(x, q, step)[2]
            values, table, _ = self._look(x, q)
        worst = int(np.abs(values).argmax())
        return self._parts[worst], float(abs(values[worst])) * self.tree.size

    @cached_property
    def _parts(self) -> list[str]:
        """The joint or rod of every closure."""
        return [row.part for row in self.at(self.tree.home, self.graph.home)[1]]

    def shortest_pose(self, pose: Array) -> tuple[str, float, bool]:
        """The closure that misses the most where the platform is held in a pose.

        :returns: its joint or rod, by how much it misses, m, and whether all closures are met in
            the pose: then a singularity ends the path from home to it.
        """
        walk = self.kernel("pose walk", _pose_walk)
        x = np.array([*self.tree.home, *self.graph.home], float)
        still = np.zeros(self.tree.unknown_rates + self.joints)
        (values, flat, _), _ = walk(_NO_PARAMETERS, x, pose, still)
        names = self._parts
        for _ in range(40):
            if not (np.isfinite(values).all() and np.isfinite(flat).all()):
                return self.graph.platform, math.inf, False
            table = flat.reshape(len(values), -1)
            damped = table.T @ table + 1e-6 * np.eye(table.shape[1])
            step = np.asarray(np.linalg.solve(damped, -table.T @ values), np.float64)
            step *= min(1.0, 0.2 / max(float(np.abs(step).max(initial=0.0)), 1e-300))
            (_, _, x), _ = walk(_NO_PARAMETERS, x, pose, step)
            (values, flat, _), _ = walk(_NO_PARAMETERS, x, pose, still)
        misses = np.abs(values)
        if not names:
            # A serial chain: what falls short is the platform itself.
            return self.graph.platform, float(misses.max()) * self.tree.size / POSE_WEIGHT, False
        worst = int(misses[: len(names)].argmax())
        return names[worst], float(misses[worst]) * self.tree.size, float(misses.max()) < MET

    # As programs.

    def kernel(
        self, name: str, write: Callable[[Traced], Program], extra: str = "", *, free: bool = False
    ) -> Kernel:
        """The compiled program of that name on this geometry, the same object every time.

        :param extra: text of what the program hangs on beside the machine's structure.
        :param free: the program takes no number of the geometry for constant.
        """
        known = self._kernels.get(name)
        if known is None:
            known = self.kernel_with(_NO_PARAMETERS, name, write, extra, free=free)
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
        """A program with numbers beside the geometry's, which are :attr:`Traced.more` there.

        :param extra: as of :meth:`kernel`, and ``free``.
        """
        key, numbers = f"{name} {extra} {self.structure}", np.concatenate([self.geometry, more])
        made = Kernel(_code(key, self, write, more, free=free), numbers)
        if not made.holds:
            # It takes for constant what is none here: a program of these numbers' own.
            exact = f"{key} {self.graph.key} {more.tolist()}"
            made = Kernel(_code(exact, self, write, more), numbers)
        return made

    @property
    def forward(self) -> Kernel:
        """Q to pose (m), position (3) and rotation (9) of the platform."""
        return self.kernel("forward", forward_program)

    @property
    def jacobian(self) -> Kernel:
        """Q to pose rates per joint rate (m n) and platform twist per joint rate (6 n), by row."""
        return self.kernel("jacobian", _jacobian)

    @property
    def inverse(self) -> Kernel:
        """Pose to q, by Newton's method from home."""
        return self.kernel("inverse", _inverse, repr(self.inverse_pivots))

    @property
    def placement(self) -> Kernel:
        """Q to rotation (9) from home and place of the origin (3) of every body, by body."""
        return self.kernel("placement", _placement)

    @property
    def acceleration(self) -> Kernel:
        """q, qd, qdd to the second derivative of the pose (m)."""
        return self.kernel("acceleration", _acceleration)


def choose_coordinates(graph: Graph) -> tuple[str, ...]:
    """Pose coordinates that determine the platform at home, the first ones that do.

    :raises ParameterError: something is free to move while the actuated joints are held.
    """
    engine = Engine(graph, ())
    motion, closed = engine.at(engine.tree.home, graph.home)
    ju, jq = (numbers(m) for m in matrices(engine.tree, closed))
    kept = engine.kept
    rates = np.vstack([-np.linalg.solve(ju[kept], jq[kept]), np.eye(engine.joints)])
    chosen: list[str] = []
    table = np.zeros((0, engine.joints))
    for name, coordinate in poses.COORDINATES.items():
        row = np.zeros(engine.tree.unknown_rates + engine.joints)
        ((_, columns),) = poses.rows((coordinate,), motion, [0.0])
        for (kind, k), value in columns.items():
            row[k if kind == "u" else engine.tree.unknown_rates + k] = float(value)
        scale = 1.0 / engine.tree.size if coordinate.axis is not None else 1.0
        extended = np.vstack([table, scale * row @ rates])
        if np.linalg.matrix_rank(extended, 1e-6) == len(extended):
            chosen.append(name)
            table = extended
    return tuple(chosen)


def _rank(matrix: Array) -> int:
    if not matrix.size:
        return 0
    s = np.linalg.svd(matrix, compute_uv=False)
    return int((s > RANK * max(1.0, float(s[0]))).sum())


def _reciprocal(matrix: Array) -> float:
    """Reciprocal condition number."""
    s = np.linalg.svd(matrix, compute_uv=False)
    return float(s[-1] / s[0]) if s.size and s[0] > 0.0 else 0.0


class Traced:
    """A machine's motion on expressions of its geometry: what programs are written with."""

    def __init__(self, engine: Engine, more: Array = _NO_PARAMETERS, *, free: bool = False) -> None:
        self.engine = engine
        self.tape = Tape([*engine.geometry.tolist(), *more.tolist()], free=free)
        given = self.tape.inputs(GEOMETRY, len(self.tape.reference))
        end = len(engine.geometry)
        own = end - len(engine.closed.numbers)
        self.geometry = given[:end]
        self.graph = graph_on(engine.graph, given[:own])
        self.closed = given[own:end]
        """Numbers of the mechanism's closed forms."""
        self.more = given[end:]
        """Numbers beside the geometry's, see :meth:`Engine.kernel_with`."""
        self.tree, self.joints = Tree(self.graph), engine.joints
        self.x = self.tape.inputs(UNKNOWNS, len(self.tree.home))
        self.q = self.tape.inputs("q", self.joints)

    def solve(self) -> None:
        """Take unknowns and closures."""
        self.motion = Motion(self.tree, self.x, self.q)
        self.rows = self.motion.closures()
        self.ju, self.jq = matrices(self.tree, self.rows)
        self.lu = SparseLU(self.ju[self.engine.kept], self.engine.pivots)

    @property
    def drive_scales(self) -> list[Any]:
        """What makes joint rates of unit one."""
        joints = (self.graph.joints[name] for name in self.graph.actuated)
        return [1.0 / self.tree.size if joint.slides else 1.0 for joint in joints]

    @property
    def pose_scales(self) -> list[Any]:
        """What makes pose coordinates of unit one."""
        size = self.tree.size
        return [1.0 if c.axis is None else 1.0 / size for c in self.engine.coordinates]

    def equations(self) -> Equations:
        """Newton's method for the unknowns at q, from home or the mechanism's closed form."""
        engine, tree = self.engine, self.tree
        step = -self.lu.solve([self.rows[k].value for k in engine.kept])
        closed = engine.closed.start
        start = self._along() if closed is None else self._ordered(closed(self.closed, self.q))
        return Equations(
            "q", self.lift(tree.home), self.lift(self.graph.home), self.lift(start),
            self.lift(self.motion.retracted(self.x, step)),
            self._square(step, tree.scales),
            self.tape.lift(self._at_home[2].inverse_determinant / self.lu.inverse_determinant),
            self._square([r.value for r in self.rows], [r.scale for r in self.rows]),
            closed is None,
            () if engine._branch is None else self.lift(engine._branch(self.motion)),
        )  # fmt: skip

    @cached_property
    def home(self) -> Motion:
        """The motion at home."""
        return Motion(self.tree, self.tree.home, self.graph.home)

    @cached_property
    def _at_home(self) -> tuple[Motion, Objects, SparseLU]:
        """At home: the motion, derivatives of the kept closures by qd, factors of those by u."""
        motion = self.home
        ju, jq = (snapped_all(m[self.engine.kept]) for m in matrices(self.tree, motion.closures()))
        return motion, jq, SparseLU(ju, self.engine.pivots)

    def _along(self) -> list[Any]:
        """Unknowns along the tangent at home: nearer than home itself."""
        motion, jq, lu = self._at_home
        away = self.q - self.graph.home
        # Solved by joint: what is left to a sample are products with what is prepared.
        columns = snapped_all([-lu.solve(jq[:, j]) for j in range(self.joints)])
        return motion.retracted(self.tree.home, columns.T @ away)

    def _ordered(self, values: Mapping[str, Sequence[Any]]) -> list[Any]:
        """Unknowns of joints' values."""
        result: list[Any] = list(self.tree.home)
        for link in self.tree.links.values():
            steps = link.steps
            if steps and not steps[0].actuated:
                given = list(values[str(link.joint)])
                given = given if steps[0].sign > 0.0 else given[::-1]
                for step, value in zip(steps, given, strict=True):
                    result[step.position] = value
        return result

    def lift(self, values: Numbers) -> list[Expression]:
        """Results as expressions."""
        return [self.tape.lift(value) for value in values]

    def _square(self, values: Numbers, scales: Numbers) -> Expression:
        total: Any = 0.0
        for value, scale in zip(values, scales, strict=True):
            part = value * scale
            total = total + part * part
        return self.tape.lift(total)

    def gradient(self, sums: Sequence[tuple[Any, Any]], by: Sequence[Expression]) -> list[Any]:
        """Derivatives by inputs of a sum of results times factors, the closures held closed.

        The unknowns x follow from f(x, q, g) = 0: with J' m = ds/du, J = df/du, the derivative is
        ds - m df (adjoint of the implicit function theorem).
        """
        found = adjoints(sums, [*by, *self.x])
        direct, by_x = found[: len(by)], found[len(by) :]
        multipliers = self.lu.solve_transposed(self._by_rates(by_x))
        values = [self.rows[k].value for k in self.engine.kept]
        through = adjoints(list(zip(values, multipliers, strict=True)), by)
        return [a - b for a, b in zip(direct, through, strict=True)]

    def _by_rates(self, by_x: Sequence[Any]) -> list[Any]:
        """Derivatives by the unknown rates, of those by the unknowns: see ``Motion.retracted``."""
        result: list[Any] = [0.0] * self.tree.unknown_rates
        for link in self.tree.links.values():
            for step in link.steps:
                k, r = step.position, step.rate
                if step.actuated:
                    continue
                if not (step.ball or step.free):
                    result[r] = by_x[k]
                    continue
                w, v = self.x[k], np.array(self.x[k + 1 : k + 4], dtype=object)
                dw, dv = by_x[k], np.array(by_x[k + 1 : k + 4], dtype=object)
                result[r : r + 3] = list((w * dv - dw * v + cross(v, dv)) * 0.5)
                if step.free:
                    result[r + 3 : r + 6] = by_x[k + 4 : k + 7]
        return result

    def set_rates(self, qd: Numbers) -> Objects:
        """Rates of everything by qd; returns those of the unknowns."""
        kept = self.engine.kept
        u = self.lu.solve(-(self.jq[kept] @ np.asarray(qd, dtype=object)))
        self.motion.set_rates(u, qd)
        return u

    def set_accelerations(self, qdd: Numbers, gravity: Any | None = None) -> None:
        """Accelerations of everything by qdd, after the rates."""
        kept = self.engine.kept
        self.motion.set_accelerations(np.zeros(self.tree.unknown_rates), qdd)
        bias = [self.rows[k].bias() for k in kept]
        self.motion.set_accelerations(-self.lu.solve(bias), qdd, gravity)

    def rate_columns(self) -> list[Objects]:
        """Rates of the unknowns per joint rate."""
        kept = self.engine.kept
        return [self.lu.solve(-self.jq[kept][:, j]) for j in range(self.joints)]

    def twists(self) -> list[tuple[Any, Any]]:
        """Velocity of the reference point and angular velocity of the platform per joint rate."""
        motion, body = self.motion, self.graph.platform
        position, _ = motion.platform()
        linear, angular = motion.point_columns(body, position), motion.turn_columns(body)
        result = []
        for j, u in enumerate(self.rate_columns()):
            pair = []
            for columns in (linear, angular):
                total: Any = np.zeros(3, dtype=object)
                for (kind, k), column in columns.items():
                    if kind == "u":
                        total = total + np.asarray(column, dtype=object) * u[k]
                    elif k == j:
                        total = total + column
                pair.append(total)
            result.append((pair[0], pair[1]))
        return result


def _walk(t: Traced) -> Program:
    """The closures where they do not hold, for telling why."""
    tree = t.tree
    motion = Motion(tree, t.x, t.q)
    rows = motion.closures()
    table, _ = matrices(tree, rows)
    move = t.tape.inputs("move", tree.unknown_rates)
    scales = np.array(tree.scales)
    entries = [
        row.scale * e / c
        for row, line in zip(rows, table, strict=True)
        for e, c in zip(line, scales, strict=True)
    ]
    outputs = {
        "values": t.lift([row.scale * row.value for row in rows]),
        "table": t.lift(entries),
        "moved": t.lift(motion.retracted(t.x, move / scales)),
    }
    sizes = {UNKNOWNS: len(tree.home), "q": t.joints, "move": tree.unknown_rates}
    return Program(sizes, 0, outputs)


def _pose_walk(t: Traced) -> Program:
    """The same of a pose, the actuated joints unknown too."""
    engine, tree, tape = t.engine, t.tree, t.tape
    size, free = len(tree.home), tree.unknown_rates
    everything = tape.inputs(UNKNOWNS, size + t.joints)
    goal = tape.inputs("pose", len(engine.coordinates))
    motion = Motion(tree, everything[:size], everything[size:])
    rows = motion.closures()
    equations = poses.rows(engine.coordinates, motion, goal)
    table = np.vstack([np.hstack(matrices(tree, rows)), engine._pose_rows(motion, goal)])
    scales = [row.scale for row in rows] + [POSE_WEIGHT * scale for scale in t.pose_scales]
    columns = [*tree.scales, *t.drive_scales]
    entries = [
        scale * entry / column
        for scale, line in zip(scales, table, strict=True)
        for entry, column in zip(line, columns, strict=True)
    ]
    values = [row.value for row in rows] + [value for value, _ in equations]
    move = tape.inputs("move", free + t.joints) / np.array(columns)
    moved = [*motion.retracted(everything[:size], move[:free]), *(everything[size:] + move[free:])]
    outputs = {
        "values": t.lift([s * v for s, v in zip(scales, values, strict=True)]),
        "table": t.lift(entries),
        "moved": t.lift(moved),
    }
    sizes = {UNKNOWNS: size + t.joints, "pose": len(goal), "move": free + t.joints}
    return Program(sizes, 0, outputs)


def forward_program(t: Traced) -> Program:
    """The program of :attr:`Engine.forward`, to write others with."""
    t.solve()
    position, rotation = t.motion.platform()
    values = poses.values(t.engine.coordinates, position, rotation)
    outputs = {
        "pose": t.lift(values),
        "position": t.lift(position),
        "rotation": t.lift(np.ravel(rotation)),
    }
    return Program({"q": t.joints}, 0, outputs, t.equations())


def _jacobian(t: Traced) -> Program:
    t.solve()
    _, rotation = t.motion.platform()
    twists = t.twists()
    rates = [poses.rates(t.engine.coordinates, rotation, v, w) for v, w in twists]
    outputs = {
        "rates": t.lift([row[i] for i in range(len(t.engine.coordinates)) for row in rates]),
        "twist": t.lift([pair[part][i] for part in (0, 1) for i in range(3) for pair in twists]),
    }
    return Program({"q": t.joints}, 0, outputs, t.equations())


def _placement(t: Traced) -> Program:
    t.solve()
    rows: list[Any] = []
    for body in t.graph.bodies:
        rows += [*np.ravel(t.motion.turned(body)), *t.motion.origin[body]]
    return Program({"q": t.joints}, 0, {"bodies": t.lift(rows)}, t.equations())


def _acceleration(t: Traced) -> Program:
    t.solve()
    qd, qdd = t.tape.inputs("qd", t.joints), t.tape.inputs("qdd", t.joints)
    t.set_rates(qd)
    t.set_accelerations(qdd)
    motion, graph = t.motion, t.graph
    body = graph.platform
    second = poses.accelerations(
        t.engine.coordinates, motion.turned(body), motion.omega[body],
        motion.acceleration(body, graph.origin), motion.alpha[body],
    )  # fmt: skip
    sizes = {"q": t.joints, "qd": t.joints, "qdd": t.joints}
    return Program(sizes, 0, {"acceleration": t.lift(second)}, t.equations())


def _inverse(t: Traced) -> Program:
    engine, tree, tape = t.engine, t.tree, t.tape
    n, size, split = engine.joints, len(tree.home), tree.unknown_rates
    everything = tape.inputs(UNKNOWNS, size + n)
    goal = tape.inputs("pose", len(engine.coordinates))
    home = [*tree.home, *t.graph.home]
    origin = [0.0 if c.axis is None else t.graph.origin[c.axis] for c in engine.coordinates]

    def system(state: Numbers, pose: Numbers) -> tuple[Motion, list[Row], list[Any], SparseLU]:
        """Closures, pose equations, and the factors of their derivatives."""
        motion = Motion(tree, state[:size], state[size:])
        rows = motion.closures()
        table = np.hstack(matrices(tree, rows))[engine.kept]
        matrix = np.vstack([table, engine._pose_rows(motion, pose)])
        equations = [value for value, _ in poses.rows(engine.coordinates, motion, pose)]
        return motion, rows, equations, SparseLU(matrix, engine.inverse_pivots)

    motion, rows, equations, lu = system(everything, goal)
    step = -lu.solve([rows[k].value for k in engine.kept] + equations)
    joints = everything[size:] + step[split:]
    moved = [*motion.retracted(everything[:size], step[:split]), *joints]
    at_home = system(home, origin)[3]
    solved = Equations(
        "pose", t.lift(home), t.lift(origin), None, t.lift(moved),
        t._square(step, [*tree.scales, *t.drive_scales]),
        tape.lift(at_home.inverse_determinant / lu.inverse_determinant),
        t._square(
            [r.value for r in rows] + equations, [r.scale for r in rows] + t.pose_scales
        ),
    )  # fmt: skip
    return Program({"pose": len(goal)}, 0, {"q": t.lift(everything[size:])}, solved)


_engines: Final[WeakValueDictionary[str, Engine]] = WeakValueDictionary()
"""Engines that something still holds, by geometry: however many machines there are in between."""
_codes: Final[WeakValueDictionary[str, Code]] = WeakValueDictionary()
"""Programs that something still holds, by structure: machines of one structure share them."""
_recent: Final[deque[Engine]] = deque(maxlen=16)
"""Held although no machine may: loading a file again takes no engine anew."""


def _hold(engine: Engine) -> None:
    if engine not in _recent:
        _recent.append(engine)


def engine_of(
    graph: Graph,
    coordinates: Sequence[Coordinate],
    closed: Closed | None = None,
    branch: Branch | None = None,
    mark: str = "",
) -> Engine:
    """The engine of a geometry: machines that differ in inertia or limits alone share it.

    :param mark: text that tells closed forms and branch rules from others.
    """
    key = f"{graph.key} {coordinates!r} {mark}"
    engine = _engines.get(key)
    if engine is None:
        engine = _engines.setdefault(key, Engine(graph, coordinates, closed, branch, mark))
        _hold(engine)
    return engine


def _code(
    key: str, engine: Engine, write: Callable[[Traced], Program], more: Array, *, free: bool = False
) -> Code:
    """The program of a key, written on an engine if nobody has it."""
    code = _codes.get(key)
    if code is None:
        code = _codes.setdefault(key, Code(lambda: write(Traced(engine, more, free=free)), key))
    return code


__all__ = ["Closed", "Engine", "Mobility", "NDArray", "Traced", "engine_of"]
