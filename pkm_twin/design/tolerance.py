# SPDX-License-Identifier: Apache-2.0
"""How far errors of parts take the platform, the actuated joints held."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, vectors
from pkm_twin.design.parts import (
    CONSISTENT,
    Assembly,
    Effect,
    part_of,
    rotation_vector,
    turned,
)
from pkm_twin.design.variants import variants
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.machine import schema
from pkm_twin.robot.derivatives import platform_derivatives
from pkm_twin.robot.robot import Robot
from stiffness_monitor.compliance import platform_response

REGULAR: Final = 0.05
"""Least singularity index of joint states that stand for the workspace."""
LARGEST: Final = 0.02
"""Standard deviation at most, rad, or part of the machine's extent: more is a wrong unit."""
STATES: Final = 256
"""States whose bodies are solved for at a time: large tables for each."""


@dataclass(frozen=True, eq=False)
class Tolerances:
    """What independent errors of parts do to the platform, to first order, actuated joints held.

    All arrays (..., 6): displacement of the reference point and small turns, base axes, m and rad,
    against the machine without errors at the same joint positions. ``sigma``: standard deviation
    by path, m or rad. ``sensitivity``: by path, per m or rad of the error. ``texts``: what each
    error is, in words. ``deflection``: of the machine without errors under the wrench, None
    without one: to first order an error does not change it.
    """

    sigma: Mapping[str, float]
    sensitivity: Mapping[str, Array]
    texts: Mapping[str, str]
    units: Mapping[str, str]
    deflection: Array | None = None

    def part(self, path: str) -> Array:
        """Effect of one standard deviation of an error, shape (..., 6)."""
        return self.sigma[path] * self.sensitivity[path]

    @cached_property
    def deviation(self) -> Array:
        """Standard deviation by all errors together, shape (..., 6)."""
        return np.asarray(np.sqrt(sum(self.part(path) ** 2 for path in self.sigma)), np.float64)

    @cached_property
    def variance(self) -> dict[str, float]:
        """Part of the variance of the position over all states that is each error's, 0 to 1."""
        own = {path: float((self.part(path)[..., :3] ** 2).sum()) for path in self.sigma}
        whole = sum(own.values())
        return {path: value / whole if whole > 0.0 else 0.0 for path, value in own.items()}

    @cached_property
    def share(self) -> dict[str, Array]:
        """Part of the variance that is each error's, 0 to 1, shape (..., 6); 0 where none is."""
        whole = np.where(self.deviation > 0.0, self.deviation, 1.0) ** 2
        return {path: self.part(path) ** 2 / whole for path in self.sigma}


def tolerances(
    robot: Robot, sigma: Mapping[str, float], q: ArrayLike, wrench: ArrayLike | None = None
) -> Tolerances:
    """Errors of the platform by independent errors of single parts, to first order.

    A part's error changes one part: the passive joints close the loops again while the actuated
    joints keep their positions. Paths, in base axes at home:

    - ``rods.NAME.length``;
    - ``bodies.NAME.length``: all joints and rods of the body, and the reference point on the
      platform, but for its joint towards the base, move along the line from that joint to their
      mean;
    - ``joints.NAME.at[0]`` to ``[2]``: the joint's centre on its inner body alone;
    - ``joints.NAME.axis[0]``, ``[1]``: the joint's frame on its inner body turns about its centre
      and two axes across the joint's (first) axis;
    - ``joints.NAME.offset``: an actuated joint stands by this beyond its position;
    - ``limbs.`` in front, or ``limbs[0].`` where ``limbs`` is a list: all copies of a limb alike,
      in the axes of azimuth 0.

    Any other number of the file that moves the platform may be given too, such as
    ``geometry.arm_length``: then the file's number changes, with all that follows from it.

    :param sigma: standard deviation by path, m or rad, at most :data:`LARGEST`.
    :param q: joint positions, shape (..., n), rad or m.
    :param wrench: on the platform, shape (6,) or (..., 6), N and N m, for ``deflection``.
    :raises ParameterError: a path that there is not, a standard deviation that is none, a number
        that moves nothing, or an error of an overconstrained machine's part after which rigid
        parts cannot be assembled: clearance or deformation takes it up, which has no answer here.
    :raises SingularityError: a state in which the loops do not determine the bodies. Others as of
        ``forward``.
    """
    states = vectors(q, robot.joints_count, "q")
    if not sigma:
        raise ParameterError("tolerance", None, "at least one PATH with its standard deviation")
    parts = {path: part_of(robot, path) for path in sigma}
    known = {path: part for path, part in parts.items() if part is not None}
    numbers = [path for path in sigma if path not in known]
    slopes = dict(platform_derivatives(robot, states, numbers).by)
    given = robot.file_numbers() if numbers else {}
    units = {
        path: (given[path][1] if path in given else "") if part is None else part.unit
        for path, part in parts.items()
    }
    for path, value in sigma.items():
        most = {"m": LARGEST * robot.graph.size, "rad": LARGEST}.get(units[path])
        size = schema.number(low=0.0, high=most, unit=units[path])
        schema.checked(size, f"tolerance {path}", value)
    for path in numbers:
        if states.size and not slopes[path].any():
            raise ParameterError(f"tolerance {path}", robot.number(path), "a length or an angle")
    if known:
        rows = states.reshape(-1, robot.joints_count)
        found = [
            Assembly(robot, rows[start : start + STATES]).platform(list(known.values()))
            for start in range(0, max(1, len(rows)), STATES)
        ]
        table = np.concatenate([twist for twist, _ in found])
        table = table.reshape(*states.shape[:-1], 6, len(known))
        for k, (path, part) in enumerate(known.items()):
            slopes[path] = np.ascontiguousarray(table[..., k])
            missed = max(float(part_missed[k]) for _, part_missed in found)
            if missed > CONSISTENT:
                raise ParameterError(
                    f"tolerance {path}", part.text,
                    f"an error after which rigid parts still fit: {robot.name} is overconstrained, "
                    f"and {100 * missed:.2g} % of this error are left to clearance or deformation",
                )  # fmt: skip
    return Tolerances(
        dict(sigma), {path: slopes[path] for path in sigma},
        {path: "number of the file" if part is None else part.text for path, part in parts.items()},
        units,
        None if wrench is None else _deflection(robot, states, wrench),
    )  # fmt: skip


def _deflection(robot: Robot, q: Array, wrench: ArrayLike) -> Array | None:
    """Of the machine without errors, shape (..., 6); None where its file has no elasticity."""
    try:
        _ = robot.element_names
    except ParameterError:
        return None
    return platform_response(robot, q, wrench).deflection


def drawn(
    robot: Robot, sigma: Mapping[str, float], q: ArrayLike, count: int, seed: int = 0
) -> Array:
    """Errors of the platform of machines with normally distributed errors, on exact geometry.

    Every machine is assembled in every state, without a linear step: what
    :func:`tolerances` gives to first order.

    :param q: joint positions, shape (k, n). Other parameters and errors as there; paths are those
        of parts, or those of numbers of the file.
    :returns: displacements and rotation vectors, base axes, m and rad, shape (count, k, 6).
    :raises PkmTwinError: errors so large that a machine cannot be assembled.
    """
    states = np.atleast_2d(vectors(q, robot.joints_count, "q"))
    known = tolerances(robot, sigma, states)
    rng = np.random.default_rng(seed)
    errors = {path: value * rng.normal(size=count) for path, value in known.sigma.items()}
    parts = [path for path in sigma if part_of(robot, path) is not None]
    if len(parts) == len(sigma):
        return _assembled(robot, errors, states)
    own = {path: robot.number(path) + errors[path] for path in sigma if path not in parts}
    machines = variants(robot, own)
    position, rotation = machines.platform(np.broadcast_to(states, (count, *states.shape)))
    place, turn = robot.platform(states)
    if parts:
        # The errors of parts are those of each machine, whose numbers differ.
        moved = np.concatenate([
            _assembled(machine, {path: errors[path][k : k + 1] for path in parts}, states)
            for k, machine in enumerate(machines)
        ])  # fmt: skip
        position, rotation = position + moved[..., :3], turned(moved[..., 3:]) @ rotation
    turns = rotation_vector(rotation @ turn.swapaxes(-1, -2))
    found = np.concatenate([position - place, turns], -1)
    if not np.isfinite(found).all():
        raise PkmTwinError(f"{robot.name}: machines with errors of this size have no assembly")
    return found


def _assembled(robot: Robot, errors: Mapping[str, Array], states: Array) -> Array:
    """Errors of the platform of a machine by those of parts, (count,) each: (count, states, 6)."""
    effects: dict[Effect, Array] = {}
    for path, values in errors.items():
        part = part_of(robot, path)
        for what, vector in part.effects.items() if part else ():
            effects[what] = effects.get(what, 0.0) + values[:, None] * vector
    return np.stack([Assembly(robot, one).displaced(effects) for one in states], 1)


def workspace_states(robot: Robot, count: int, seed: int = 0) -> Array:
    """Joint states between the limits, away from singularities, shape (k, n), k at most ``count``.

    :raises ParameterError: no limits of positions, or no such state.
    """
    limits = robot.limits.position
    if limits is None or not np.isfinite(limits).all():
        raise ParameterError("limits.position", None, "limits of all joints, or a path")
    rng = np.random.default_rng(seed)
    q = limits[:, 0] + np.ptp(limits, 1) * rng.random((count, robot.joints_count))
    measure, good = robot.try_singularity(q)
    kept = q[good & (measure >= REGULAR)]
    if not len(kept):
        raise ParameterError("limits.position", None, "limits inside which states are regular")
    return np.asarray(kept, np.float64)


def rms(vectors: Array) -> float:
    """Root mean square length of vectors (..., 3)."""
    return float(np.sqrt((vectors**2).sum(-1).mean()))


def greatest(vectors: Array) -> float:
    """The greatest length of vectors (..., 3)."""
    return float(np.linalg.norm(vectors, axis=-1).max())
