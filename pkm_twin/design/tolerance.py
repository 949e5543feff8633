# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute how far errors of parts move the platform, leading actuated joints held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, vectors
from pkm_twin.design.parts import (
    MAX_OPEN_FRACTION,
    Assembly,
    Effect,
    find_part,
    match_errors,
    name_error,
)
from pkm_twin.design.variants import variants
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.machine import schema
from pkm_twin.machine.rotations import rotation_vector
from pkm_twin.machine.uncertainty import Tolerance
from pkm_twin.robot.derivatives import platform_derivatives
from pkm_twin.robot.robot import Robot
from stiffness_monitor.compliance import platform_response

MIN_SINGULARITY_INDEX: Final = 0.05
"""Smallest singularity index of joint states that represent the workspace."""
MAX_DEVIATION: Final = 0.02
"""Largest standard deviation, rad, or relative to the machine's size: more is a wrong unit."""
STATES_PER_BLOCK: Final = 256
"""States whose bodies are solved at a time: each has large tables."""


@dataclass(frozen=True, eq=False)
class Tolerances:
    """Hold the first-order effect of independent part errors on the platform, actuated joints held.

    All arrays (..., 6): displacement of the reference point and small rotations, base axes, m and
    rad, relative to the machine without errors at the same joint positions. ``sigma``: standard
    deviation by path, m or rad, and ``bounds``: largest error, half of a play. ``sensitivity``: by
    path, per m or rad of the error. ``texts``: description of each error. ``deflection``: of the
    machine without errors under the wrench, None without one: to first order an error does not
    change it.
    """

    sigma: Mapping[str, float]
    sensitivity: Mapping[str, Array]
    texts: Mapping[str, str]
    units: Mapping[str, str]
    deflection: Array | None = None
    bounds: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def together(self) -> dict[str, list[str]]:
        """Paths of each error by its name: a clearance has three, one per axis; others have one."""
        found: dict[str, list[str]] = {}
        for path in self.sigma:
            found.setdefault(name_error(path), []).append(path)
        return found

    def effect(self, error: str) -> Array:
        """Return the platform's standard deviation due to one error of :attr:`together`, shape (..., 6)."""
        return _root_sum_squares([self.part(path) for path in self.together[error]])

    @cached_property
    def worst(self) -> Array:
        """Largest effect of all errors together on each component, shape (..., 6)."""
        each = [
            _root_sum_squares([self.bounds[path] * self.sensitivity[path] for path in paths])
            for paths in self.together.values()
        ]
        return np.asarray(sum(each), np.float64)

    @cached_property
    def is_exact(self) -> bool:
        """True if :attr:`farthest` is attained: at most 12 errors, none of them with a free direction.

        With 12 errors there are 2,048 different combinations of signs.
        """
        single = all(len(paths) == 1 for paths in self.together.values())
        return single and len(self.bounds) <= 12

    @cached_property
    def farthest(self) -> Array:
        """Largest displacement (m) and rotation (rad) by all errors together, (..., 2).

        A length is greatest with every error at one of its bounds: all combinations of signs are
        tried if :attr:`is_exact`. Otherwise this is an upper bound: the lesser of the errors'
        lengths added up, and of the length of the components' own worst cases.
        """
        shape = self.worst.shape[:-1]
        if not self.is_exact:
            lengths = [
                np.linalg.norm(
                    np.reshape([self.bounds[p] * self.sensitivity[p] for p in paths], (len(paths), *shape, 2, 3)),
                    axis=(0, -1),
                )
                for paths in self.together.values()
            ]
            apart = np.linalg.norm(self.worst.reshape(*shape, 2, 3), axis=-1)
            return np.asarray(np.minimum(sum(lengths), apart), np.float64)
        each = np.array([self.bounds[path] * self.sensitivity[path] for path in self.sigma])
        # The sign of the first error is fixed, because reversing all signs gives the same length.
        signs = np.array([(1.0, *row) for row in product((1.0, -1.0), repeat=len(each) - 1)])
        rows = each.reshape(len(each), -1, 6)
        found = [
            np.linalg.norm(np.tensordot(signs, state, 1).reshape(-1, 2, 3), axis=-1).max(0)
            for state in rows.swapaxes(0, 1)
        ]
        return np.reshape(found, (*shape, 2))

    def part(self, path: str) -> Array:
        """Return the platform's displacement by one standard deviation of the error at a path, shape (..., 6)."""
        return self.sigma[path] * self.sensitivity[path]

    @cached_property
    def deviation(self) -> Array:
        """Standard deviation by all errors together, shape (..., 6)."""
        return _root_sum_squares([self.part(path) for path in self.sigma])

    @cached_property
    def only_turns(self) -> bool:
        """True if the errors only rotate the platform about its reference point."""
        moves, turns = np.split(self.deviation, 2, -1)
        return bool(np.linalg.norm(moves) < 1e-9 * np.linalg.norm(turns))

    @cached_property
    def variance(self) -> dict[str, float]:
        """Fraction of the position's variance over all states by each error, 0 to 1.

        If the reference point does not move, fraction of the rotation's variance.
        """
        counts = slice(3, 6) if self.only_turns else slice(0, 3)
        own = {path: float((self.part(path)[..., counts] ** 2).sum()) for path in self.sigma}
        whole = sum(own.values())
        return {path: value / whole if whole > 0.0 else 0.0 for path, value in own.items()}

    @cached_property
    def share(self) -> dict[str, Array]:
        """Fraction of the variance by each error, 0 to 1, shape (..., 6); 0 without variance."""
        whole = np.where(self.deviation > 0.0, self.deviation, 1.0) ** 2
        return {path: self.part(path) ** 2 / whole for path in self.sigma}


def _root_sum_squares(parts: Sequence[Array]) -> Array:
    """Return the root of the sum of squares."""
    return np.asarray(np.sqrt(sum(part**2 for part in parts)), np.float64)


def is_play(path: str) -> bool:
    """Return whether an error is play (backlash or clearance), which calibration cannot identify."""
    return name_error(path).endswith((".backlash", ".clearance"))


def expand_patterns(robot: Robot, given: Mapping[str, float | Tolerance]) -> dict[str, float | Tolerance]:
    """Return errors by single path: expand patterns to parts, a clearance to its three axes.

    :raises ParameterError: a pattern that matches nothing, or a play without a bound.
    """
    found: dict[str, float | Tolerance] = {}
    # Expand patterns first, so that entries for single parts replace theirs.
    for path in sorted(given, key=lambda path: "*" not in str(path)):
        value = given[path]
        for name in match_errors(robot, path) if "*" in str(path) else [path]:
            play = isinstance(name, str) and is_play(name)
            if play and getattr(value, "bound", None) is None:
                raise ParameterError(f"tolerance {name}", value, "a bound, the whole play")
            axes = range(3) if play and name.endswith(".clearance") else ()
            found |= {f"{name}[{k}]": value for k in axes} or {name: value}
    return found


def tolerances(
    robot: Robot,
    sigma: Mapping[str, float | Tolerance],
    q: ArrayLike,
    wrench: ArrayLike | None = None,
) -> Tolerances:
    """Compute the platform's errors by independent errors of single parts, to first order.

    A part's error changes one part: the passive joints close the loops again while the actuated
    joints keep their positions. Paths, in base axes at home:

    - ``rods.NAME.length``;
    - ``bodies.NAME.length``: all joints and rods of the body, and the reference point on the
      platform, except its joint towards the base, move along the line from that joint to their
      mean, perpendicular to the axes if all joints of the body rotate about parallel ones;
    - ``joints.NAME.at[0]`` to ``[2]``: the joint's centre on its inner body alone;
    - ``joints.NAME.axis[0]``, ``[1]``: the joint's frame on its inner body turns about its centre
      and two axes across the joint's (first) axis;
    - ``joints.NAME.offset``: an actuated joint is off its position by this;
    - ``joints.NAME.backlash``: the play of an actuated joint, uniform within half of it either way;
    - ``joints.NAME.clearance``: the play of a joint, whose centre on the inner body is up to half
      of it away, in any direction;
    - ``limbs.`` in front, or ``limbs[0].`` if ``limbs`` is a list: one error of all copies of a
      limb, in the axes of azimuth 0; paths separated by commas: one error of these parts.

    Any other number of the file that moves the platform may be given too, such as
    ``geometry.arm_length``: then the file's number changes, with all that follows from it.

    A * in a path stands for any text: each matching part has its own error.

    :param sigma: standard deviation by path, m or rad, at most :data:`MAX_DEVIATION`; or the
        error's distribution.
    :param q: joint positions, shape (..., n), rad or m.
    :param wrench: on the platform, shape (6,) or (..., 6), N and N m, for ``deflection``.
    :raises ParameterError: an unknown path, an invalid standard deviation, a number
        that does not affect the platform, or an error with which the rigid parts of an overconstrained machine
        cannot be assembled.
    :raises SingularityError: a state in which the loops do not determine the bodies. Others as of
        ``forward``.
    """
    states = vectors(q, robot.joints_count, "q")
    if not sigma:
        raise ParameterError("tolerance", None, "at least one PATH with its standard deviation")
    given_sizes = expand_patterns(robot, sigma)
    parts = {path: find_part(robot, path) for path in given_sizes}
    known = {path: part for path, part in parts.items() if part is not None}
    numbers = [path for path in given_sizes if path not in known]
    slopes = dict(platform_derivatives(robot, states, numbers).by)
    given = robot.file_numbers() if numbers else {}
    units = {
        path: (given[path][1] if path in given else "") if part is None else part.unit for path, part in parts.items()
    }
    sizes: dict[str, Tolerance] = {}
    for path, value in given_sizes.items():
        most = {"m": MAX_DEVIATION * robot.graph.size, "rad": MAX_DEVIATION}.get(units[path])
        number = schema.number(low=0.0, high=most, unit=units[path])
        value_size = value.size if isinstance(value, Tolerance) else value
        size = schema.check_field(number, f"tolerance {path}", value_size)
        one = value if isinstance(value, Tolerance) else Tolerance(deviation=size)
        # A part is at most half the play from the middle.
        sizes[path] = Tolerance(bound=size / 2.0) if is_play(path) else one
    for path in numbers:
        if states.size and not slopes[path].any():
            raise ParameterError(f"tolerance {path}", robot.number(path), "a length or an angle")
    if known:
        rows = states.reshape(-1, robot.joints_count)
        found = [
            Assembly(robot, rows[start : start + STATES_PER_BLOCK]).platform_effects(list(known.values()))
            for start in range(0, max(1, len(rows)), STATES_PER_BLOCK)
        ]
        table = np.concatenate([twist for twist, _ in found])
        table = table.reshape(*states.shape[:-1], 6, len(known))
        for k, (path, part) in enumerate(known.items()):
            slopes[path] = np.ascontiguousarray(table[..., k])
            open_fraction = max(float(part_missed[k]) for _, part_missed in found)
            if open_fraction > MAX_OPEN_FRACTION:
                raise ParameterError(
                    f"tolerance {path}",
                    part.text,
                    f"errors after which the closed loops of {robot.name} still assemble (this one "
                    f"alone leaves {100 * open_fraction:.2g} % of it open); parts with commas between "
                    f"share an error: {path},OTHER_PART=SIZE",
                )
    return Tolerances(
        {path: size.sigma for path, size in sizes.items()},
        {path: slopes[path] for path in sizes},
        {path: "number of the file" if part is None else part.text for path, part in parts.items()},
        units,
        None if wrench is None else _deflection(robot, states, wrench),
        {path: size.max_error for path, size in sizes.items()},
    )


def _deflection(robot: Robot, q: Array, wrench: ArrayLike) -> Array | None:
    """Return the deflection without errors, shape (..., 6); None without elasticity data."""
    try:
        _ = robot.element_names
    except ParameterError:
        return None
    return platform_response(robot, q, wrench).deflection


def drawn(robot: Robot, sigma: Mapping[str, float | Tolerance], q: ArrayLike, count: int, seed: int = 0) -> Array:
    """Draw machines with random errors; return the platform's errors by exact assembly.

    :func:`tolerances` gives them to first order.

    :param q: joint positions, shape (k, n). Other parameters and errors as there; paths are those
        of parts, or those of numbers of the file.
    :returns: displacements and rotation vectors, base axes, m and rad, shape (count, k, 6).
    :raises PkmTwinError: errors so large that a machine cannot be assembled.
    """
    states = np.atleast_2d(vectors(q, robot.joints_count, "q"))
    known, sizes = tolerances(robot, sigma, states), expand_patterns(robot, sigma)
    rng = np.random.default_rng(seed)
    errors: dict[str, Array] = {}
    for paths in known.together.values():
        if getattr(sizes[paths[0]], "bound", None) is None:
            errors |= {path: known.sigma[path] * rng.normal(size=count) for path in paths}
        else:
            # The parts of a joint with clearance touch each other: a random direction, with the bound's length.
            directions = rng.normal(size=(len(paths), count)) if len(paths) > 1 else None
            unit = (
                rng.uniform(-1.0, 1.0, (1, count))
                if directions is None
                else (directions / np.linalg.norm(directions, axis=0))
            )
            errors |= {one: known.bounds[one] * row for one, row in zip(paths, unit, strict=True)}
    parts = [path for path in errors if find_part(robot, path) is not None]
    assembly = Assembly(robot, states)
    if len(parts) == len(errors):
        return assembly.solve_displacements(_add_effects(robot, errors))
    own = {path: robot.number(path) + errors[path] for path in errors if path not in parts}
    machines = variants(robot, own)
    if parts:
        # Solve machine by machine, because each has its own numbers and part errors.
        found = np.concatenate(
            [
                assembly.with_graph(machine.graph).solve_displacements(
                    _add_effects(robot, {path: errors[path][k : k + 1] for path in parts})
                )
                for k, machine in enumerate(machines)
            ]
        )
    else:
        each = np.broadcast_to(states, (count, *states.shape))
        if robot.redundant:
            each = machines.project_redundant(each, np.zeros_like(each), np.zeros_like(each))[0]
        position, rotation = machines.platform(each)
        place, turn = robot.platform(states)
        turns = rotation_vector(rotation @ turn.swapaxes(-1, -2))
        found = np.concatenate([position - place, turns], -1)
    if not np.isfinite(found).all():
        raise PkmTwinError(f"{robot.name}: machines with errors of this size have no assembly")
    return found


def _add_effects(robot: Robot, errors: Mapping[str, Array]) -> dict[Effect, Array]:
    """Sum the effects of errors of parts, (count,) each."""
    effects: dict[Effect, Array] = {}
    for path, values in errors.items():
        part = find_part(robot, path)
        for what, vector in part.effects.items() if part else ():
            effects[what] = effects.get(what, 0.0) + values[:, None] * vector
    return effects


def workspace_states(robot: Robot, count: int, seed: int = 0) -> Array:
    """Draw joint states between the limits, away from singularities: (k, n), k up to ``count``.

    :raises ParameterError: no position limits, or no such state.
    """
    limits = robot.limits.position
    if limits is None or not np.isfinite(limits).all():
        raise ParameterError("limits.position", None, "limits of all joints, or a path")
    rng = np.random.default_rng(seed)
    q = limits[:, 0] + np.ptp(limits, 1) * rng.random((count, robot.joints_count))
    measure, good = robot.try_singularity(q)
    kept = q[good & (measure >= MIN_SINGULARITY_INDEX)]
    if not len(kept):
        raise ParameterError("limits.position", None, "limits inside which states are regular")
    return np.asarray(kept, np.float64)


def rms_length(vectors: Array) -> float:
    """Return the root mean square length of vectors (..., 3)."""
    return float(np.sqrt((vectors**2).sum(-1).mean()))


def largest_length(vectors: Array) -> float:
    """Return the largest length of vectors (..., 3)."""
    return float(np.linalg.norm(vectors, axis=-1).max())
