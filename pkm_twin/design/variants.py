# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Evaluate many machines that differ in numbers of their file, in one call.

They share the programs of one robot; only inputs that depend on their numbers are computed for
each. If a machine lacks a property that a program takes as constant, a zero or a parallel axis, a
program of its own structure is used.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from delta_dynamics.torques.reactions import BALANCE_BOUND, Reactions, hide_indeterminate, solve_balances
from pkm_twin.codegen.arrays import Array, Mask, common_batch, doubles
from pkm_twin.codegen.code import Code
from pkm_twin.codegen.kernels import MAX_GEOMETRY_MISMATCH
from pkm_twin.design import programs
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.machine.formulas import PARAMETERS
from pkm_twin.machine.geometry import describe_pattern
from pkm_twin.machine.places import split_path
from pkm_twin.machine.tree import Tree
from pkm_twin.robot.derivatives import make_twist_rows
from pkm_twin.robot.robot import Robot
from stiffness_monitor.compliance import MIN_PIVOT_RATIO
from stiffness_monitor.programs import Elastic

SAMPLES_PER_BALANCE: Final = 2048
"""Samples whose joint loads are solved at a time: each has large tables."""


class Variants:
    """Evaluate machines of one robot with other numbers, see :func:`variants`.

    Methods are those of one robot, with a leading axis over the k machines in the result. An input
    whose first axis has length k, and which has one axis more than a sample, is per machine; every
    other input applies to all machines. (To give all machines the same k samples, shape them (1,
    k, ...).) Results that a machine does not have are NaN.
    """

    def __init__(self, robot: Robot, numbers: Mapping[str, ArrayLike]) -> None:
        self.robot = robot
        self.paths = tuple(numbers)
        arrays = []
        for path, value in numbers.items():
            _ = split_path(path)
            try:
                arrays.append(doubles(value, path))
            except ValueError:
                raise ParameterError(path, value, "a number, or one per machine") from None
            if arrays[-1].ndim > 1:
                raise ParameterError(path, arrays[-1].shape, "a number, or one per machine")
        try:
            rows = np.broadcast_arrays(*arrays) if arrays else [np.zeros(1)]
        except ValueError:
            sizes = {path: len(a) for path, a in zip(self.paths, arrays, strict=True) if a.ndim}
            raise ParameterError("numbers", sizes, "as many of each, one per machine") from None
        self.values: Array = np.stack([np.atleast_1d(row) for row in rows], -1)
        """Values of the paths, shape (k, paths)."""
        self.functions = robot.cached(programs.NumberFunctions, self.paths)
        self._robots: dict[int, Robot | PkmTwinError] = {}
        self._structure_patterns: dict[int, str] = {}
        self._prepared: dict[int, tuple[Code, Array]] = {}

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, index: int) -> Robot:
        """Return one of the machines as a robot.

        :raises PkmTwinError: a file with its numbers is rejected.
        """
        k = range(len(self))[index]
        if k not in self._robots:
            try:
                given = dict(zip(self.paths, self.values[k].tolist(), strict=True))
                self._robots[k] = self.robot.with_file_values(given)
            except PkmTwinError as error:
                self._robots[k] = error
        found = self._robots[k]
        if isinstance(found, PkmTwinError):
            raise found
        return found

    def __iter__(self) -> Iterator[Robot]:
        return (self[k] for k in range(len(self)))

    @cached_property
    def valid(self) -> Mask:
        """Mask of the machines that can be assembled at home and near it, shape (k,)."""
        home, graph = self.robot.graph.home, self.robot.graph
        reach = [graph.size if graph.joints[name].slides else 1.0 for name in graph.actuated]
        steps = np.linspace(-1.0, 1.0, len(home)) + 0.3
        # Also test a pose near home: a machine that can only be assembled at home has no freedom.
        away = 1e-3 * np.array([0.0 * steps, steps, -steps]) * reach
        rest = [np.zeros_like(home)] * 2 * self.robot.redundant
        request = programs.project_redundant if self.robot.redundant else programs.forward
        (poses, *_), good = self.run_program(request, (home + away)[None], *rest)
        sound = good[..., 0] & np.isfinite(poses).all(-1)
        known = np.isfinite(self.geometry).all(1) & np.isfinite(self.masses).all(1)
        return np.asarray(sound.reshape(len(self), 3).all(1) & known)

    def reason(self, index: int) -> str:
        """Return why a machine is not valid; empty for a valid one."""
        if self.valid[index]:
            return ""
        try:
            _ = self[index]
        except PkmTwinError as error:
            return str(error)
        if not np.isfinite(self.masses[index]).all():
            return "a number that follows from these is not finite"
        return "no assembly at home, or none beside it"

    def inverse_dynamics(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None) -> Array:
        """Return efforts, shape (k, ..., n), see :func:`delta_dynamics.inverse_dynamics`."""
        load = np.zeros(6) if wrench is None else wrench
        return self.run_program(programs.torques, q, qd, qdd, load)[0][0]

    def reactions(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None) -> Reactions:
        """Return reactions with arrays (k, ..., joints, 6), see :func:`delta_dynamics.reactions`.

        Nothing is determinate for a machine without assembly or equilibrium. Components along
        "across 1" and "across 2" are in the directions of the first robot.
        """
        self.robot.check_independent("joint loads of variants")
        load = np.zeros(6) if wrench is None else wrench
        loads, good = self.run_program(programs.loads, q, qd, qdd, load)
        rows, at = [part.reshape(good.size, part.shape[-1]) for part in loads], np.flatnonzero(good)
        parts = []
        for start in range(0, max(1, len(at)), SAMPLES_PER_BALANCE):
            taken = [row[at[start : start + SAMPLES_PER_BALANCE]] for row in rows]
            found = solve_balances(self.robot, taken, strict=False)
            parts.append(hide_indeterminate(found.reactions(found.value, found.null)))
        kept = np.concatenate([part.residual <= BALANCE_BOUND for part in parts])
        made: dict[str, Any] = {}
        for name in ("points", "wrenches", "determinate", "values", "determinate_components", "residual"):
            values = np.concatenate([getattr(part, name) for part in parts])
            table = np.full((good.size, *values.shape[1:]), False if values.dtype == bool else np.nan)
            table[at[kept]] = values[kept]
            table.setflags(write=False)
            made[name] = table.reshape(*good.shape[:-1], *values.shape[1:])
        return replace(parts[0], **made)

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Return mass matrices, shape (k, ..., n, n), see :func:`delta_dynamics.mass_matrix`."""
        flat = self.run_program(programs.masses, q)[0][0]
        n = self.robot.joints_count
        return flat.reshape(*flat.shape[:-1], n, n)

    def project_redundant(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> tuple[Array, Array, Array]:
        """Return the motion of all drives, as :meth:`Robot.project_redundant`, (k, ..., n) each."""
        first, second, third = self.run_program(programs.project_redundant, q, qd, qdd)[0]
        return first, second, third

    def forward(self, q: ArrayLike) -> Array:
        """Return poses, shape (k, ..., m), see :meth:`Robot.forward`."""
        return self.run_program(programs.forward, q)[0][0]

    def inverse(self, pose: ArrayLike) -> Array:
        """Return joint positions, shape (k, ..., n), see :meth:`Robot.inverse`."""
        return self.run_program(programs.inverse, pose)[0][0]

    def jacobian(self, q: ArrayLike) -> Array:
        """Return pose rates per joint rate, shape (k, ..., m, n), see :meth:`Robot.jacobian`."""
        flat, n = self.run_program(programs.jacobian, q)[0][0], self.robot.joints_count
        return flat.reshape(*flat.shape[:-1], len(self.robot.pose_names), n)

    def platform_jacobian(self, q: ArrayLike) -> Array:
        """Return platform twists per joint rate, shape (k, ..., 6, n)."""
        flat, n = self.run_program(programs.jacobian, q)[0][1], self.robot.joints_count
        return flat.reshape(*flat.shape[:-1], 6, n)

    def differentiate_platform(self, q: ArrayLike) -> Array:
        """Return how the platform moves with each number at constant joint positions, (..., 6, paths).

        Derivatives of the first machine's position and rotation: m and rad per unit of the number.

        :param q: joint positions, shape (samples, n).
        """
        states = np.asarray(q, np.float64)[None]
        rows = make_twist_rows(len(self.robot.pose_names), self.platform(states)[1])
        (found,), _ = self.run_program(programs.platform_derivatives, states[..., None, :], rows)
        return np.asarray(found[0] @ self.geometry_jacobian, np.float64)

    def pose_acceleration(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> Array:
        """Return the second derivative of the pose, shape (k, ..., m)."""
        return self.run_program(programs.acceleration, q, qd, qdd)[0][0]

    def platform(self, q: ArrayLike) -> tuple[Array, Array]:
        """Return positions (k, ..., 3) and rotations (k, ..., 3, 3), see :meth:`Robot.platform`."""
        _, position, rotation = self.run_program(programs.forward, q)[0]
        return position, rotation.reshape(*rotation.shape[:-1], 3, 3)

    def singularity(self, q: ArrayLike) -> Array:
        """Return singularity indices, shape (k, ...), see :meth:`Robot.singularity`."""
        return np.asarray(self.run_program(programs.singularity, q)[0][0][..., 0], np.float64)

    def compliance(self, pose: ArrayLike) -> Array:
        """Return compliances, (k, ..., 6, 6), see :func:`stiffness_monitor.compliance`.

        :raises ParameterError: the robot's file lacks a section that elasticity needs.
        """
        _ = Elastic(self.robot)
        (flat, measure), good = self.run_program(programs.compliance, self.inverse(pose))
        found = np.where(good & (measure > MIN_PIVOT_RATIO), flat, np.nan)
        return np.asarray(found.reshape(*flat.shape[:-1], 6, 6), np.float64)

    def with_values(self, values: Array, *, checked: bool = False) -> Variants:
        """Return machines with other values of the same paths, shape (k, paths).

        :param checked: the values are known to be valid.
        """
        made = copy.copy(self)
        for name, value in vars(type(self)).items():
            if isinstance(value, cached_property):
                vars(made).pop(name, None)
        made.values = values
        made._robots, made._structure_patterns, made._prepared = {}, {}, {}
        if checked:
            vars(made)["_out_of_range"] = np.zeros(len(values), bool)
        return made

    @cached_property
    def geometry(self) -> Array:
        """Geometry as programs take it, shape (k, size); NaN where a number is out of range."""
        found = self.functions.geometry(self.values)
        found[self._out_of_range] = np.nan
        return found

    @cached_property
    def masses(self) -> Array:
        """Masses as programs take them, shape (k, size); NaN likewise."""
        found = self.functions.rigid(self.values)[:, self.geometry.shape[1] :]
        found[self._out_of_range] = np.nan
        return found

    @cached_property
    def geometry_jacobian(self) -> Array:
        """Derivatives of the first machine's geometry with respect to the numbers, shape (entries, paths)."""
        return np.asarray(self.functions.geometry.slopes_at(self.values[:1])[0])

    @cached_property
    def elasticity(self) -> Array:
        """Inputs of the elastic model's programs that follow the geometry, shape (k, size)."""
        return self.functions.elastic_inputs(self.values)

    @cached_property
    def _out_of_range(self) -> Mask:
        """Machines with numbers that a file may not have."""
        out = np.asarray(np.isnan(self.values).any(1))
        for columns in self._sections:
            known = self.values[~out][:, columns]
            if len(known) and not self._is_box_valid(columns, known):
                paths = [self.paths[column] for column in columns]
                rows, which = np.unique(known, axis=0, return_inverse=True)
                fits = np.array([self._is_valid(paths, row) for row in rows.tolist()])
                out[~out] = ~fits[which.ravel()]
        return out

    @property
    def whole_box_fits(self) -> bool:
        """True if a file may have all numbers between each path's smallest and largest value."""
        return all(self._is_box_valid(columns, self.values[:, columns]) for columns in self._sections)

    @property
    def _sections(self) -> list[list[int]]:
        sections: dict[str, list[int]] = {}
        for column, path in enumerate(self.paths):
            sections.setdefault(path.rpartition(".")[0], []).append(column)
        return list(sections.values())

    def _is_box_valid(self, columns: Sequence[int], rows: Array) -> bool:
        """Return whether all rows are valid, by their corners: bounds in a section are convex.

        Numbers that depend on a parameter may be any function of it.
        """
        paths = [self.paths[column] for column in columns]
        # Check sample by sample: so many numbers would have too many corners.
        if len(columns) > 5 or any(split_path(path)[0] == PARAMETERS for path in paths):
            return False
        ends = zip(rows.min(0).tolist(), rows.max(0).tolist(), strict=True)
        return all(self._is_valid(paths, row) for row in set(itertools.product(*ends)))

    def _is_valid(self, paths: Sequence[str], values: Sequence[float]) -> bool:
        """Return whether a file may have these numbers."""
        try:
            made = self.robot.numbered(dict(zip(paths, values, strict=True)))
            for path in paths:
                made.check_number(path)
        except PkmTwinError:
            return False
        return True

    def _join_inputs(self, names: Sequence[programs.Numbers]) -> Array:
        """Return a program's inputs of each machine, shape (k, size)."""
        return np.concatenate([getattr(self, name) for name in names], 1)

    def _compile_and_prepare(self, request: programs.MakeRequest, robot: Robot) -> tuple[Code, Array]:
        """Return a robot's compiled program and each machine's prepared inputs, shape (k, prepared + 1)."""
        kernel, numbers = request(robot)
        code = kernel.code
        found = self._prepared.get(id(code))
        if found is None:
            rows = self._join_inputs(numbers)
            prepared = code.prepare(rows) if len(rows) else np.zeros((0, 1))
            found = self._prepared[id(code)] = code, prepared
        return found

    def run_program(self, request: programs.MakeRequest, *inputs: ArrayLike) -> tuple[list[Array], Mask]:
        """Evaluate a program for all k machines.

        :returns: the outputs, shape (k, ..., size) each, and which are valid, shape (k, ..., 1).
        """
        code, prepared = self._compile_and_prepare(request, self.robot)
        k = len(self)
        arrays, shapes = code.checked(inputs), []
        for array in arrays:
            each = array.ndim > 1 and array.shape[0] == k
            # With a first axis of 1 all machines have the same samples.
            shapes.append((each, array.shape[1 if each or array.shape[:2] == (1, k) else 0 : -1]))
        batch = common_batch(*(shape for _, shape in shapes))
        count = math.prod(batch)
        # Shapes of the compiled code: (k or 1, samples or 1, size).
        rows = []
        for array, (each, shape) in zip(arrays, shapes, strict=True):
            machines, size, one = k if each else 1, array.shape[-1], math.prod(shape) == 1
            values = array.reshape(machines, *([1] * (len(batch) - len(shape))), *shape, size)
            if not one:
                values = np.broadcast_to(values, (machines, *batch, size))
            rows.append(np.ascontiguousarray(values.reshape(machines, 1 if one else count, size)))
        if (prepared[:, -1] <= MAX_GEOMETRY_MISMATCH).all():
            outputs, status = code.run_machines(prepared, *rows)
            good = np.ones((k, count), bool) if status is None else status[..., 0] == 0.0
        else:
            outputs = [np.full((k, count, size), np.nan) for size in code.sizes[1]]
            good = np.zeros((k, count), bool)
            for one_code, rest, own in self._programs_by_structure(request):
                picked = [row[own] if len(row) > 1 else row for row in rows]
                found, status = one_code.run_machines(rest[own], *picked)
                for table, values in zip(outputs, found, strict=True):
                    table[own] = values
                good[own] = True if status is None else status[..., 0] == 0.0
        shaped = [values.reshape(k, *batch, values.shape[-1]) for values in outputs]
        return shaped, np.asarray(good).reshape(k, *batch, 1)

    def _programs_by_structure(self, request: programs.MakeRequest) -> Iterator[tuple[Code, Array, NDArray[np.intp]]]:
        """Yield each structure's program with the machines that it is valid for."""
        # A machine without an assembly at home has no inputs for the programs.
        remaining = np.asarray(~np.isnan(self._join_inputs(request(self.robot)[1])).any(1))
        others = self.functions.others
        robots = itertools.chain([self.robot, *others], self._build_robots(remaining))
        for robot in robots:
            try:
                code, prepared = self._compile_and_prepare(request, robot)
            except (PkmTwinError, ValueError):
                if robot is self.robot:
                    raise
                continue
            fits = remaining & (prepared[:, -1] <= MAX_GEOMETRY_MISMATCH)
            if fits.any() and robot is not self.robot and robot not in others:
                others.append(robot)
            yield code, prepared, np.flatnonzero(fits)
            remaining &= ~fits

    def _build_robots(self, remaining: Mask) -> Iterator[Robot]:
        """Yield the first remaining machine as a robot until none remains.

        The caller clears the entries of ``remaining`` that the robot's program covers.
        """
        while remaining.any():
            first, *others = np.flatnonzero(remaining).tolist()
            try:
                robot = self[first]
                if _inertia_order(robot) == _inertia_order(self.robot):
                    yield robot
            except PkmTwinError:
                # Other machines of this structure cannot be built, either.
                pattern = self._structure_pattern(first)
                for other in others:
                    remaining[other] = self._structure_pattern(other) != pattern
            remaining[first] = False

    def _structure_pattern(self, k: int) -> str:
        """Return a text of a machine's zeros and parallels."""
        if k not in self._structure_patterns:
            given = dict(zip(self.paths, self.values[k].tolist(), strict=True))
            try:
                self._structure_patterns[k] = describe_pattern(Tree(self.robot.numbered(given).graph))
            except PkmTwinError:
                self._structure_patterns[k] = "none"
        return self._structure_patterns[k]


def _inertia_order(robot: Robot) -> list[tuple[str, str]]:
    """Return bodies with the joints that carry them: the order of the inertial inputs."""
    return [(link.body, str(link.joint)) for link in robot.engine.tree.links.values()]


def variants(robot: Robot, numbers: Mapping[str, ArrayLike]) -> Variants:
    """Return machines that differ from a robot in numbers of its file.

    :param numbers: by dotted path as docs/parameters.md has it (``geometry.arm_length``,
        ``joints.ball_1.at[0]``; ``limbs.joints.ball.at[0]`` for all copies of a limb), each an
        array of one number a machine, shape (k,), or one number for all; SI units.
    :raises ParameterError: an unknown path, or arrays of several lengths.
    """
    return Variants(robot, numbers)
