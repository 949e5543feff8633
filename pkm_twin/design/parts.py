# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Model errors of a machine's parts, and where they move the bodies, actuated joints held.

A part's error moves a joint's frame on one of its two bodies, or changes a length. Every body has
six coordinates of its own; joints, rods and held drives are rows between two bodies:

    A V + C e = 0

with V the bodies' twists and e the errors, to first order; for errors of any size Newton's method
solves the rows themselves. If no V fulfils all rows, rigid parts cannot be assembled.
"""

from __future__ import annotations

import contextlib
import copy
import math
import re
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import (
    ParameterError,
    PkmTwinError,
    SingularityError,
    UnknownNameError,
    unknown_number_error,
)
from pkm_twin.kinematics.constraints import (
    Equation,
    Placement,
    constraint_equations,
    distance_equation,
    drive_equation,
    rod_pair_equation,
    rotate,
)
from pkm_twin.kinematics.iterations import newton
from pkm_twin.machine.graph import BASE, Graph, Joint, Rod, rotation_about_z
from pkm_twin.machine.joints import perpendicular_axes, unit
from pkm_twin.machine.places import full_keys, join_path, split_path
from pkm_twin.machine.rotations import rotation_about, rotation_vector
from pkm_twin.robot.rejection import SINGULARITY_BOUND
from pkm_twin.robot.robot import Robot

MAX_OPEN_FRACTION: Final = 1e-6
"""Largest residual of an error's rows, relative to them, at which the parts can be assembled."""
STENCIL: Final = 1e-3 * np.array([-2.0, -1.0, 1.0, 2.0])
"""Displacements at which the central difference evaluates, rad or in machine sizes."""
STENCIL_WEIGHTS: Final = np.array([1.0, -8.0, 8.0, -1.0]) / 12e-3
"""Weights of the central difference of fourth order."""

CLEARANCE: Final = ("clearance[0]", "clearance[1]", "clearance[2]")
"""Keys of a joint's clearance along the base axes at home."""
ERROR_KEYS: Final = {
    "bodies": ["length"],
    "rods": ["length"],
    "joints": ["at[0]", "at[1]", "at[2]", "axis[0]", "axis[1]", "offset", "backlash", *CLEARANCE],
}
"""Keys at the end of an error's path, by the kind of the part."""

Effect = tuple[str, str]
"""Kind of a change, and its joint, rod or body: ``inner`` or ``outer`` (a joint's centre on that
body), ``tilt`` (its frame on the inner body), ``start`` or ``end`` (of a rod), ``length``,
``offset``, ``origin``."""


@dataclass(frozen=True)
class Part:
    """Describe an error of a part, or a common error of several parts.

    ``effects``: change per unit of the error, by kind, base axes at home, shape (3,); (1,) for a
    length or an offset. ``text``: description of the error. ``unit``: rad or m.
    """

    effects: Mapping[Effect, Array]
    text: str
    unit: str


def find_part(robot: Robot, path: str) -> Part | None:
    """Find the part error that a path names; return None if it names a number of the file.

    Paths separated by commas share one error, with the opposite sign after a ``-``.

    :raises ParameterError: the machine's entry has no such error.
    """
    keys, effects = full_keys(path), dict[Effect, Array]()
    if "," in path:
        parts: list[Part] = []
        for word in path.split(","):
            word_part = word.strip()
            part = find_part(robot, word_part.removeprefix("-"))
            if part is None or part.unit != (parts or [part])[0].unit:
                raise ParameterError(f"tolerance {path}", word_part, "parts alone, in m or in rad")
            parts.append(part)
            for what, vector in part.effects.items():
                effects[what] = effects.get(what, 0.0) + (-vector if word_part.startswith("-") else vector)
        return Part(effects, f"{parts[0].text}, and {len(parts) - 1} more alike", parts[0].unit)
    if keys[0] not in (*ERROR_KEYS, "limbs"):
        numbers = robot.file_numbers()
        if keys[0] in {split_path(number)[0] for number in numbers}:
            return None
        raise unknown_number_error(path, [*map(join_path, _error_keys(robot)), *numbers])
    texts, unit_ = [], ""
    for kind, name, where, azimuth in robot.named(keys):
        entry = _part_effects(robot, kind, name, where, rotation_about_z(azimuth), path)
        if entry is None:
            break
        effects |= entry[0]
        texts.append(entry[1])
        unit_ = entry[2]
    if effects:
        return Part(effects, texts[0] + (", and its copies alike" if len(texts) > 1 else ""), unit_)
    # The path names no error: report its first unknown word.
    known = list(_error_keys(robot))
    for k in range(len(keys) + 1):
        words = {str(word_part[k]) for word_part in known if word_part[:k] == keys[:k] and len(word_part) > k}
        if k < len(keys) and words and str(keys[k]) not in words:
            raise UnknownNameError(path, keys[k], words)
        if not words or k == len(keys):
            rest = f"one of {', '.join(sorted(words))} behind it" if words else "no more keys"
            raise ParameterError(path, join_path(keys[k:]) or None, rest)
    raise AssertionError(path)


def _error_keys(robot: Robot) -> Iterator[list[str | int]]:
    """Yield the keys of every possible error's path."""
    places: dict[tuple[str | int, ...], str] = {}
    for kind in ERROR_KEYS:
        places |= {(kind, name): kind for name in getattr(robot.graph, kind)}
    for (kind, _), source in getattr(robot, "sources", {}).items():
        places[source.path] = kind
    return ([*place, *split_path(end)] for place, kind in places.items() for end in ERROR_KEYS[kind])


def name_error(path: str) -> str:
    """Return the name of a path's error, which the three axes of a clearance share."""
    return re.sub(r"(\.clearance)\[\d\]$", r"\1", path)


def match_errors(robot: Robot, pattern: str) -> list[str]:
    """List the part errors that match a pattern, in which * stands for any text.

    :raises ParameterError: no error matches.
    """
    fits = re.compile(".*".join(map(re.escape, pattern.split("*")))).fullmatch
    found = []
    for path in map(join_path, _error_keys(robot)):
        if fits(name_error(path)):
            with contextlib.suppress(ParameterError):
                find_part(robot, path)
                found.append(name_error(path))
    if not found:
        raise ParameterError("tolerance", pattern, "a pattern that fits a part, as rods.*.length")
    return list(dict.fromkeys(found))


def _part_effects(
    robot: Robot, kind: str, name: str, where: Sequence[str | int], turn: Array, path: str
) -> tuple[dict[Effect, Array], str, str] | None:
    """Return the effects of an entry's error, its description and unit; None if it has none."""
    graph = robot.graph
    match kind, *where:
        case "rods", "length":
            return {("length", name): np.ones(1)}, f"{name} longer", "m"
        case "bodies", "length":
            return _lengthen_body(robot, name, path), f"{name} longer", "m"
        case "joints", ("offset" | "backlash") as what:
            joint = graph.joints[name]
            if name not in graph.leads:
                leads = f": {', '.join(graph.leads)} lead" if robot.redundant else ""
                raise ParameterError(path, name, f"an actuated joint{leads}")
            word, unit_ = "zero" if what == "offset" else what, "m" if joint.slides else "rad"
            return {("offset", name): np.ones(1)}, f"{word} of {name}", unit_
        case "joints", ("at" | "axis" | "clearance") as what, int(k) if k < 3 - (what == "axis"):
            joint = graph.joints[name]
            if joint.virtual:
                raise ParameterError(path, name, "a joint that does not stand for others")
            if what != "axis":
                moved, text = np.asarray(turn @ np.eye(3)[k]), "centre" if what == "at" else what
                return {("inner", name): moved}, f"{text} of {name} on {joint.inner}", "m"
            if not len(joint.axes):
                raise ParameterError(path, joint.kind, "a joint with an axis")
            if name in robot.without_point:
                raise ParameterError(f"joints.{name}.at", None, "the point about which it tilts")
            about = np.asarray(turn @ perpendicular_axes(unit(turn.T @ joint.axes[0]))[k])
            return {("tilt", name): about}, f"axis of {name} on {joint.inner}", "rad"
    return None


def _lengthen_body(robot: Robot, body: str, path: str) -> dict[Effect, Array]:
    """Return effects on all points of a body except its joint towards the base.

    They move along the line from that joint to their mean. If all joints of the body rotate about
    parallel axes, the line is perpendicular to these: a component along them would tilt the body
    out of its plane.
    """
    graph = robot.graph
    joints = [j for j in graph.joints.values() if not j.virtual]
    distance, reached = {BASE: 0}, [BASE]
    for near in reached:
        for joint in joints:
            for one, other in ((joint.inner, joint.outer), (joint.outer, joint.inner)):
                if one == near and other not in distance:
                    distance[other] = distance[near] + 1
                    reached.append(other)
    own = [j for j in joints if body in (j.inner, j.outer)]
    inner_joints = [j for j in own if min(distance.get(b, 0) for b in (j.inner, j.outer)) < distance.get(body, 0)]
    if len(inner_joints) != 1:
        raise ParameterError(
            path,
            ", ".join(j.name for j in inner_joints) or None,
            "a body with one joint towards the base; move the joints of others by joints.NAME.at",
        )
    start = inner_joints[0]
    if start.name in robot.without_point:
        raise ParameterError(f"joints.{start.name}.at", None, f"the point where {body} begins")
    moved: dict[Effect, Array] = {}
    for joint in own:
        if joint is not start:
            moved["inner" if joint.inner == body else "outer", joint.name] = joint.at
    for rod in graph.rods.values():
        for side, end, on in zip(("start", "end"), rod.ends, (rod.inner, rod.outer), strict=True):
            if on == body:
                moved[side, rod.name] = end
    if body == graph.platform:
        moved["origin", body] = graph.origin
    line = np.mean(list(moved.values()), 0) - start.at if moved else np.zeros(3)
    if len(moved) == len(own) - 1 and all(joint.kind == "revolute" for joint in own):
        axis = start.axes[0]
        across = line - axis * (axis @ line)
        parallel = all(np.linalg.norm(np.cross(j.axes[0], axis)) < MAX_OPEN_FRACTION for j in own)
        if parallel and float(np.linalg.norm(across)) > MAX_OPEN_FRACTION * graph.size:
            line = across
    if not float(np.linalg.norm(line)) > MAX_OPEN_FRACTION * graph.size:
        raise ParameterError(path, start.name, "a body with points apart from that joint")
    return dict.fromkeys(moved, unit(line))


class Assembly:
    """Hold a machine's bodies at joint positions, with errors of its parts.

    :param q: joint positions, shape (..., n). Errors as of :meth:`Robot.forward`.
    """

    def __init__(self, robot: Robot, q: Array) -> None:
        self.robot, self.graph, self.q = robot, robot.graph, q
        home = Placement.at_home(robot.graph, q.shape[:-1])
        rotations, shifts = [home.body_rotation(BASE)], [home.shift[..., 0, :]]
        turned, origins = robot.placements(q)
        for name, rotation in turned.items():
            rotations.append(rotation)
            shifts.append(origins[name] - rotation @ robot.engine.tree.at[name])
        self.placed = replace(home, rotation=np.stack(rotations, -3), shift=np.stack(shifts, -2))

    # Equations for any positions of bodies and any size of errors.

    def equations(
        self, placed: Placement, errors: Mapping[Effect, Array], only: Container[str] | None = None
    ) -> list[Equation]:
        """Return the equations of joints, rods and held drives.

        :param errors: by effect, shape (..., 3) or (..., 1); missing effects have no error.
        :param only: names of joints and rods; None for all.
        """
        found: list[Equation] = []
        graph, size = self.graph, self.placed.size

        def find_points(part: Joint | Rod, kinds: tuple[str, str], ends: Sequence[Array]) -> tuple[Array, Array]:
            inner, outer = (
                placed.point(body, at + errors.get((kind, part.name), 0.0))
                for kind, body, at in zip(kinds, (part.inner, part.outer), ends, strict=True)
            )
            return inner, outer

        for joint in graph.joints.values():
            if joint.virtual or (only is not None and joint.name not in only):
                continue
            points = find_points(joint, ("inner", "outer"), (joint.at, joint.at))
            inner, outer = placed.body_rotation(joint.inner), placed.body_rotation(joint.outer)
            if ("tilt", joint.name) in errors:
                inner = inner @ rotation_about(errors["tilt", joint.name])
            turns = partial(rotate, inner), partial(rotate, outer)
            for held in joint.constraints:
                found += constraint_equations(joint.name, (joint.inner, joint.outer), held, points, turns, size)
            if joint.name in graph.leads:
                goal = self.q[..., graph.actuated.index(joint.name)] - joint.home
                goal = goal + errors.get(("offset", joint.name), np.zeros(1))[..., 0]
                found.append(drive_equation(joint, goal, points, turns, size))
        for rod in graph.rods.values():
            if only is not None and rod.name not in only:
                continue
            points, bodies = (
                find_points(rod, ("start", "end"), (*rod.ends,)),
                (rod.inner, rod.outer),
            )
            length = errors.get(("length", rod.name), np.zeros(1))[..., 0]
            length = length + np.linalg.norm(rod.ends[1] - rod.ends[0])
            found.append(distance_equation(rod.name, bodies, points, length**2, size))
            if rod.pair is not None:
                first, second = (rotate(placed.body_rotation(body), np.asarray(rod.pair)) for body in bodies)
                apart = np.linalg.norm(points[1] - points[0], axis=-1, keepdims=True)
                found.append(rod_pair_equation(rod.name, bodies, points, (first, second), apart))
        return found

    # First-order effects of the errors.

    @cached_property
    def _equations(self) -> list[Equation]:
        """Equations without errors."""
        return self.equations(self.placed, {})

    @cached_property
    def _factors(self) -> tuple[Array, Array]:
        """QR factors of the matrix: orthonormal columns and a triangle.

        :raises SingularityError: the rows do not determine the bodies.
        """
        q, r = np.linalg.qr(self.placed.jacobian(self._equations))
        sizes = np.abs(np.diagonal(r, axis1=-2, axis2=-1))
        measure = sizes.min(-1) / sizes.max(-1)
        if not (measure > SINGULARITY_BOUND).all():
            k = int(np.argmin(measure))
            state = np.round(self.q.reshape(-1, self.q.shape[-1])[k], 6).tolist()
            bound = SINGULARITY_BOUND
            raise SingularityError(f"the joint state {state}", (), float(np.min(measure)), bound)
        return q, r

    def _solve_twists(self, values: Array) -> Array:
        """Return the dimensionless least-squares twists that make rows (..., rows, k) zero."""
        q, r = self._factors
        return np.asarray(-np.linalg.solve(r, q.swapaxes(-1, -2) @ values), np.float64)

    def _differentiate(self, part: Part) -> Array:
        """Return the rows' derivatives by an error, shape (..., rows, 1), by differences."""
        scale = self.placed.size if part.unit == "m" else 1.0
        moving, shape = {name for _, name in part.effects}, self.q.shape[:-1]
        total = np.zeros((*shape, len(self._equations)))
        for point, weight in zip(STENCIL, STENCIL_WEIGHTS, strict=True):
            errors = {what: scale * point * vector for what, vector in part.effects.items()}
            moved = iter(self.placed.values(self.equations(self.placed, errors, moving)).T)
            for k, one in enumerate(self._equations):
                if one.part in moving:
                    total[..., k] += weight / scale * next(moved).T
        return total[..., None]

    def platform_effects(self, parts: Sequence[Part]) -> tuple[Array, Array]:
        """Return the platform's displacements by errors, and the fraction of each error that cannot be assembled.

        :returns: displacement of the reference point and small rotation per unit of each error,
        base axes, shape (..., 6, parts); largest open fraction of each error's rows, shape
        (parts,).
        """
        columns = np.concatenate([self._differentiate(part) for part in parts], -1)
        found = self._solve_twists(columns)
        left = columns - self._factors[0] @ (self._factors[0].swapaxes(-1, -2) @ columns)
        sizes = np.maximum(np.linalg.norm(columns, axis=-2), np.finfo(float).tiny)
        open_fraction = (np.linalg.norm(left, axis=-2) / sizes).reshape(-1, len(parts)).max(0, initial=0.0)
        name, placed = self.graph.platform, self.placed
        k = 6 * (placed.index[name] - 1)
        arm = placed.point(name, self.graph.origin) - placed.middle
        moved, turn = placed.size * found[..., k : k + 3, :], found[..., k + 3 : k + 6, :]
        moved = moved + np.cross(turn, arm[..., None], axis=-2)
        for column, part in enumerate(parts):
            if ("origin", name) in part.effects:
                moved[..., column] += placed.body_rotation(name) @ part.effects["origin", name]
        return np.concatenate([moved, turn], -2), np.asarray(open_fraction, np.float64)

    # Effects of errors of any size.

    def with_graph(self, graph: Graph) -> Assembly:
        """Return an assembly with another graph, whose solution starts from the present bodies."""
        # Compute the factors before the copy, which shares them.
        _ = self._factors
        other = copy.copy(self)
        other.graph = graph
        return other

    def solve_displacements(self, errors: Mapping[Effect, Array]) -> Array:
        """Compute the platform's displacements by errors of any size, by Newton's method.

        :param errors: by effect, shape (count, 3) or (count, 1).
        :returns: displacement of the reference point and rotation vector, base axes, shape
            (count, ..., 6).
        :raises PkmTwinError: parts with these errors cannot be assembled.
        """
        count, inner = len(next(iter(errors.values()))), self.q.shape[:-1]
        errors = {k: v.reshape(count, *(1 for _ in inner), -1) for k, v in errors.items()}
        start = self.placed
        placed = replace(
            start,
            rotation=np.broadcast_to(start.rotation, (count, *start.rotation.shape)),
            shift=np.broadcast_to(start.shift, (count, *start.shift.shape)),
        )

        def residuals(placed: Placement) -> tuple[Array, None]:
            return placed.values(self.equations(placed, errors)), None

        def correct(_: None, values: Array) -> Array:
            return np.moveaxis(self._solve_twists(np.moveaxis(values, 0, -1)), -1, 0)

        # The derivatives stay those without errors, so convergence is linear: do not require halved steps.
        placed, closed = newton(
            placed, residuals, Placement.moved, correct, iterations=30, gain=math.inf, most=MAX_OPEN_FRACTION
        )
        if closed:
            name, origin = self.graph.platform, self.graph.origin
            there = placed.point(name, origin + errors.get(("origin", name), 0.0))
            turn = placed.body_rotation(name) @ start.body_rotation(name).swapaxes(-1, -2)
            moved = there - start.point(name, self.robot.graph.origin)
            return np.concatenate([moved, rotation_vector(turn)], -1)
        worst = int(np.abs(residuals(placed)[0]).max(-1).max(0).argmax())
        raise PkmTwinError(
            f"{self.robot.name}: rigid parts with errors of this size cannot be assembled at "
            f"{np.round(self.q.reshape(-1, self.q.shape[-1])[worst], 6).tolist()}"
        )
