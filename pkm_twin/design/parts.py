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
import re
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import (
    ParameterError,
    PkmTwinError,
    SingularityError,
    UnknownNameError,
    unknown_number,
)
from pkm_twin.machine.graph import BASE, Graph, Joint, rotation_about_z
from pkm_twin.machine.joints import across, unit
from pkm_twin.machine.places import full_keys, keys_of, path_of
from pkm_twin.robot.robot import SINGULARITY_BOUND, Robot

MAX_OPEN_FRACTION: Final = 1e-6
"""Largest fraction of an error's rows that may stay open if the parts can be assembled."""
STEP_TOLERANCE: Final = 1e-12
"""Size of the last Newton step of an assembly, in units of one."""
MAX_ITERATIONS: Final = 30
STENCIL: Final = 1e-3 * np.array([-2.0, -1.0, 1.0, 2.0])
STENCIL_WEIGHTS: Final = np.array([1.0, -8.0, 8.0, -1.0]) / 12e-3
"""Fourth-order finite difference; errors of a rigid part change its rows smoothly."""

CLEARANCE: Final = ("clearance[0]", "clearance[1]", "clearance[2]")
"""Keys of a joint's clearance along the base axes at home."""
ERROR_KEYS: Final = {
    "bodies": ["length"], "rods": ["length"],
    "joints": ["at[0]", "at[1]", "at[2]", "axis[0]", "axis[1]", "offset", "backlash",
               *CLEARANCE],
}  # fmt: skip
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


def part_of(robot: Robot, path: str) -> Part | None:
    """Return the part that a path names; None if it names a number of the file.

    Paths separated by commas share one error, with the opposite sign after a ``-``.

    :raises ParameterError: the machine's entry has no such error.
    """
    keys = full_keys(path)
    if "," in path:
        return _join_parts(robot, path)
    if keys[0] not in (*ERROR_KEYS, "limbs"):
        numbers = robot.file_numbers()
        if keys[0] in {keys_of(number)[0] for number in numbers}:
            return None
        raise unknown_number(path, [*map(path_of, _error_keys(robot)), *numbers])
    effects: dict[Effect, Array] = {}
    texts, unit_ = [], ""
    for kind, name, where, azimuth in robot.named(keys):
        found = _part_effects(robot, kind, name, where, rotation_about_z(azimuth), path)
        if found is None:
            break
        effects |= found[0]
        texts.append(found[1])
        unit_ = found[2]
    if not effects:
        raise _explain_unknown(robot, keys, path)
    alike = ", and its copies alike" if len(texts) > 1 else ""
    return Part(effects, texts[0] + alike, unit_)


def _join_parts(robot: Robot, path: str) -> Part:
    """Return the common error of the parts of several paths."""
    effects: dict[Effect, Array] = {}
    found: list[Part] = []
    for word in path.split(","):
        one = word.strip()
        part = part_of(robot, one.removeprefix("-"))
        if part is None or part.unit != (found or [part])[0].unit:
            raise ParameterError(f"tolerance {path}", one, "parts alone, in m or in rad")
        found.append(part)
        for what, vector in part.effects.items():
            effects[what] = effects.get(what, 0.0) + (-vector if one.startswith("-") else vector)
    return Part(effects, f"{found[0].text}, and {len(found) - 1} more alike", found[0].unit)


def _error_keys(robot: Robot) -> Iterator[list[str | int]]:
    """Yield the keys of every possible error's path."""
    places: dict[tuple[str | int, ...], str] = {}
    for kind in ERROR_KEYS:
        places |= {(kind, name): kind for name in getattr(robot.graph, kind)}
    for (kind, _), source in getattr(robot, "sources", {}).items():
        places[source.path] = kind
    return ([*place, *keys_of(end)] for place, kind in places.items() for end in ERROR_KEYS[kind])


def error_of(path: str) -> str:
    """Return the error of a path: a clearance is one error along three axes."""
    return re.sub(r"(\.clearance)\[\d\]$", r"\1", path)


def matching(robot: Robot, pattern: str) -> list[str]:
    """Return the errors of the machine's parts that match a pattern, with * for any text.

    :raises ParameterError: nothing matches.
    """
    fits = re.compile(".*".join(map(re.escape, pattern.split("*")))).fullmatch
    found = []
    for path in map(path_of, _error_keys(robot)):
        if fits(error_of(path)):
            with contextlib.suppress(ParameterError):
                part_of(robot, path)
                found.append(error_of(path))
    if not found:
        raise ParameterError("tolerance", pattern, "a pattern that fits a part, as rods.*.length")
    return list(dict.fromkeys(found))


def _explain_unknown(robot: Robot, keys: Sequence[str | int], path: str) -> ParameterError:
    """Return the error for a path without a part: it names the first unknown word."""
    known = list(_error_keys(robot))
    for k in range(len(keys) + 1):
        words = {str(one[k]) for one in known if one[:k] == keys[:k] and len(one) > k}
        if k < len(keys) and words and str(keys[k]) not in words:
            return UnknownNameError(path, keys[k], words)
        if not words or k == len(keys):
            rest = f"one of {', '.join(sorted(words))} behind it" if words else "no more keys"
            return ParameterError(path, path_of(keys[k:]) or None, rest)
    raise AssertionError(path)


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
            about = np.asarray(turn @ across(unit(turn.T @ joint.axes[0]))[k])
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
    far, ring = {BASE: 0}, [BASE]
    for near in ring:
        for joint in joints:
            for one, other in ((joint.inner, joint.outer), (joint.outer, joint.inner)):
                if one == near and other not in far:
                    far[other] = far[near] + 1
                    ring.append(other)
    own = [j for j in joints if body in (j.inner, j.outer)]
    towards = [j for j in own if min(far.get(b, 0) for b in (j.inner, j.outer)) < far.get(body, 0)]
    if len(towards) != 1:
        raise ParameterError(
            path, ", ".join(j.name for j in towards) or None,
            "a body with one joint towards the base; move the joints of others by joints.NAME.at",
        )  # fmt: skip
    start = towards[0]
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
        flat = line - axis * (axis @ line)
        parallel = all(np.linalg.norm(np.cross(j.axes[0], axis)) < MAX_OPEN_FRACTION for j in own)
        if parallel and float(np.linalg.norm(flat)) > MAX_OPEN_FRACTION * graph.size:
            line = flat
    if not float(np.linalg.norm(line)) > MAX_OPEN_FRACTION * graph.size:
        raise ParameterError(path, start.name, "a body with points apart from that joint")
    return dict.fromkeys(moved, unit(line))


class Row(NamedTuple):
    """Describe a scalar equation between two bodies, of unit one; leading axes are the batch.

    A unit of its multiplier is a force and a moment at ``point`` on ``outer``, the opposite on
    ``inner``. ``part``: the joint or rod.
    """

    part: str
    value: Array
    inner: str
    outer: str
    point: Array
    force: Array
    moment: Array


@dataclass(frozen=True)
class Placed:
    """Hold where bodies are: rotation from home (..., 3, 3) and origin (..., 3) by name."""

    rotation: dict[str, Array]
    origin: dict[str, Array]

    def moved(self, twists: Mapping[str, Array]) -> Placed:
        """Return the bodies after displacements of origins and small rotations, (..., 6) each."""
        rotation = {n: rotation_about(v[..., 3:]) @ self.rotation[n] for n, v in twists.items()}
        return Placed(rotation, {n: self.origin[n] + v[..., :3] for n, v in twists.items()})


def rotation_about(vector: Array) -> Array:
    """Return the rotation about a vector by its length, shape (..., 3, 3)."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector, -1, 0)
    o = np.zeros_like(x)
    skew = np.moveaxis(np.array([[o, -z, y], [z, o, -x], [-y, x, o]]), (0, 1), (-2, -1))
    half = np.sinc(angle / (2.0 * np.pi))
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * skew + 0.5 * half**2 * skew @ skew)


def rotation_vector(rotation: Array) -> Array:
    """Return the vector of :func:`rotation_about` for less than half a turn, (..., 3)."""
    r = rotation
    twice = np.stack(
        [r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1
    )
    sine = 0.5 * np.linalg.norm(twice, axis=-1)
    angle = np.arctan2(sine, 0.5 * (np.trace(r, axis1=-2, axis2=-1) - 1.0))
    return np.asarray(twice * 0.5 / np.sinc(angle / np.pi)[..., None], np.float64)


class Assembly:
    """Hold a machine's bodies and rows at joint positions, with errors of its parts.

    :param q: joint positions, shape (..., n). Errors as of :meth:`Robot.forward`.
    """

    def __init__(self, robot: Robot, q: Array) -> None:
        self.robot, self.graph = robot, robot.graph
        self.at, self.size = robot.engine.tree.at, float(robot.graph.size)
        self.bodies = list(self.graph.bodies)
        self.q, self.placed = q, Placed(*robot.placements(q))

    # Rows, on bodies anywhere and errors of any size.

    def rows(
        self, placed: Placed, q: Array, errors: Mapping[Effect, Array],
        only: Container[str] | None = None,
    ) -> list[Row]:  # fmt: skip
        """Return the equations of joints, rods and held drives.

        :param errors: by effect, shape (..., 3) or (..., 1); missing effects have no error.
        :param only: names of joints and rods; None for all.
        """
        found: list[Row] = []
        names = list(self.graph.actuated)
        for joint in self.graph.joints.values():
            if joint.virtual or (only is not None and joint.name not in only):
                continue
            value = q[..., names.index(joint.name)] if joint.name in self.graph.leads else None
            found += self._joint_rows(joint, placed, value, errors)
        for rod in self.graph.rods.values():
            if only is not None and rod.name not in only:
                continue
            start, end = (
                self._point(placed, body, at, errors.get((side, rod.name)))
                for side, body, at in zip(
                    ("start", "end"), (rod.inner, rod.outer), rod.ends, strict=True
                )
            )
            apart = end - start
            far = np.linalg.norm(apart, axis=-1)
            longer = errors.get(("length", rod.name), np.zeros(1))[..., 0]
            long = float(np.linalg.norm(rod.ends[1] - rod.ends[0])) + longer
            along = apart / far[..., None]
            found.append(
                Row(
                    rod.name, (far - long) / self.size, rod.inner, rod.outer, end,
                    along / self.size, np.zeros(3),
                )
            )  # fmt: skip
            if rod.pair is not None:
                # Two rods of equal length: their middle line is perpendicular to the difference of
                # the directions from rod to rod on both bodies.
                first, second = (
                    np.asarray((np.eye(3) if body == BASE else placed.rotation[body]) @ rod.pair)
                    for body in (rod.inner, rod.outer)
                )
                value = (along * (second - first)).sum(-1)
                found.append(
                    Row(
                        rod.name, value, rod.inner, rod.outer, end, np.zeros(3),
                        np.cross(second, along),
                    )
                )  # fmt: skip
        return found

    def _point(self, placed: Placed, body: str, at: Array, error: Array | None) -> Array:
        local = at if error is None else at + error
        if body == BASE:
            return np.asarray(local)
        arm = (placed.rotation[body] @ (local - self.at[body])[..., None])[..., 0]
        return np.asarray(placed.origin[body] + arm)

    def _joint_rows(
        self, joint: Joint, placed: Placed, value: Array | None, errors: Mapping[Effect, Array]
    ) -> list[Row]:
        a, b = joint.inner, joint.outer
        first = self._point(placed, a, joint.at, errors.get(("inner", joint.name)))
        point = self._point(placed, b, joint.at, errors.get(("outer", joint.name)))
        apart, none = point - first, np.zeros(3)
        inner, outer = (np.eye(3) if n == BASE else placed.rotation[n] for n in (a, b))
        if ("tilt", joint.name) in errors:
            inner = inner @ rotation_about(errors["tilt", joint.name])
        rows: list[Row] = []

        def add(value: Array, force: Array, moment: Array, scale: float) -> None:
            rows.append(Row(joint.name, value * scale, a, b, point, force * scale, moment * scale))

        def angle(one: Array, other: Array, known: float = 0.0) -> None:
            """Add the equation of a constant angle between vectors of both frames."""
            e, u = (inner @ one[..., None])[..., 0], outer @ other
            add((e * u).sum(-1) - known, none, np.cross(u, e), 1.0)

        scale = 1.0 / self.size
        for held in joint.constraints:
            e = inner @ held.inner
            if held.kind == "point":
                for k in range(3):
                    add(apart[..., k], np.eye(3)[k], none, scale)
            elif held.kind == "plane":
                add((e * apart).sum(-1), e, none, scale)
            elif held.kind == "angle":
                angle(held.inner, held.outer, float(held.inner @ held.outer))
            else:
                way = (e * apart).sum(-1)
                x, y = (
                    ((inner @ one)[..., None, :] @ (outer @ held.outer)[..., None])[..., 0, 0]
                    for one in (held.outer, np.cross(held.inner, held.outer))
                )
                turn = np.arctan2(y, x)
                turn = turn + 2.0 * np.pi * np.round((way / held.slide - turn) / (2.0 * np.pi))
                add(way - held.slide * turn, e, -held.slide * e, scale)
        if value is not None:
            (freedom,) = joint.freedoms
            goal = value - joint.home + errors.get(("offset", joint.name), np.zeros(1))[..., 0]
            if freedom.turns:
                mark = across(joint.axes[0])
                s, c = np.sin(goal)[..., None], np.cos(goal)[..., None]
                angle(c * mark[1] - s * mark[0], mark[0])
            else:
                e = inner @ joint.axes[0]
                add((e * apart).sum(-1) - goal, e, none, scale)
        return rows

    # To first order.

    def _matrix(self, rows: Sequence[Row]) -> Array:
        """Return the rows' derivatives by the bodies' twists of unit one, (..., rows, 6 bodies)."""
        table = np.zeros((*self.q.shape[:-1], len(rows), 6 * len(self.bodies)))
        for i, row in enumerate(rows):
            for body, side in ((row.outer, 1.0), (row.inner, -1.0)):
                if body != BASE:
                    k = 6 * self.bodies.index(body)
                    arm = row.point - self.placed.origin[body]
                    table[..., i, k : k + 3] += side * self.size * row.force
                    table[..., i, k + 3 : k + 6] += side * (np.cross(arm, row.force) + row.moment)
        return table

    @cached_property
    def _rows(self) -> list[Row]:
        """Rows without errors."""
        return self.rows(self.placed, self.q, {})

    @cached_property
    def _factors(self) -> tuple[Array, Array]:
        """QR factors of the matrix: orthonormal columns and a triangle.

        :raises SingularityError: the rows do not determine the bodies.
        """
        q, r = np.linalg.qr(self._matrix(self._rows))
        sizes = np.abs(np.diagonal(r, axis1=-2, axis2=-1))
        measure = sizes.min(-1) / sizes.max(-1)
        if not (measure > SINGULARITY_BOUND).all():
            k = int(np.argmin(measure))
            state = np.round(self.q.reshape(-1, self.q.shape[-1])[k], 6).tolist()
            bound = SINGULARITY_BOUND
            raise SingularityError(f"the joint state {state}", (), float(np.min(measure)), bound)
        return q, r

    def _solve_twists(self, values: Array) -> Array:
        """Return the least-squares twists, of unit one, that make rows (..., rows, k) zero."""
        q, r = self._factors
        return np.asarray(-np.linalg.solve(r, q.swapaxes(-1, -2) @ values), np.float64)

    def _differentiate(self, part: Part) -> Array:
        """Return the rows' derivatives by an error, shape (..., rows, 1), by differences."""
        scale = self.size if part.unit == "m" else 1.0
        moving, shape = {name for _, name in part.effects}, self.q.shape[:-1]
        total: Any = 0.0
        for point, weight in zip(STENCIL, STENCIL_WEIGHTS, strict=True):
            errors = {what: scale * point * vector for what, vector in part.effects.items()}
            moved = iter(self.rows(self.placed, self.q, errors, moving))
            values = [
                np.broadcast_to(next(moved).value if row.part in moving else 0.0, shape)
                for row in self._rows
            ]
            total = total + weight / scale * np.stack(values, -1)
        return np.asarray(total[..., None], np.float64)

    def platform(self, parts: Sequence[Part]) -> tuple[Array, Array]:
        """Return how errors move the platform, and the fraction of each that stays open, 0 to 1.

        :returns: displacement of the reference point and small rotation per unit of each error,
        base axes, shape (..., 6, parts); largest open fraction of each error's rows, shape
        (parts,).
        """
        columns = np.concatenate([self._differentiate(part) for part in parts], -1)
        found = self._solve_twists(columns)
        left = columns - self._factors[0] @ (self._factors[0].swapaxes(-1, -2) @ columns)
        whole = np.maximum(np.linalg.norm(columns, axis=-2), np.finfo(float).tiny)
        missed = (np.linalg.norm(left, axis=-2) / whole).reshape(-1, len(parts)).max(0, initial=0.0)
        name = self.graph.platform
        k, rotation = 6 * self.bodies.index(name), self.placed.rotation[name]
        arm = self._point(self.placed, name, self.graph.origin, None) - self.placed.origin[name]
        moved, turn = self.size * found[..., k : k + 3, :], found[..., k + 3 : k + 6, :]
        moved = moved + np.cross(turn, arm[..., None], axis=-2)
        for column, part in enumerate(parts):
            if ("origin", name) in part.effects:
                moved[..., column] += rotation @ part.effects["origin", name]
        return np.concatenate([moved, turn], -2), np.asarray(missed, np.float64)

    # Of any size.

    def like(self, graph: Graph) -> Assembly:
        """Return the assembly of a machine with other numbers, to be solved from these bodies."""
        # Compute the factors once, before they are shared.
        _ = self._factors
        other = copy.copy(self)
        other.graph = graph
        return other

    def displaced(self, errors: Mapping[Effect, Array]) -> Array:
        """Compute how far errors move the platform, by Newton's method on all rows.

        :param errors: by effect, shape (count, 3) or (count, 1).
        :returns: displacement of the reference point and rotation vector, base axes, shape
            (count, ..., 6).
        :raises PkmTwinError: parts with these errors cannot be assembled.
        """
        count, inner = len(next(iter(errors.values()))), self.q.shape[:-1]
        shape = (count, *inner)
        errors = {k: v.reshape(count, *(1 for _ in inner), -1) for k, v in errors.items()}
        placed = Placed(
            {n: np.broadcast_to(r, (*shape, 3, 3)) for n, r in self.placed.rotation.items()},
            {n: np.broadcast_to(o, (*shape, 3)) for n, o in self.placed.origin.items()},
        )
        worst = 0
        for _ in range(MAX_ITERATIONS):
            rows = self.rows(placed, self.q, errors)
            values = np.stack([np.broadcast_to(row.value, shape) for row in rows], -1)
            step = np.moveaxis(self._solve_twists(np.moveaxis(values, 0, -1)), -1, 0)
            twists = step.reshape(*shape, -1, 6) * ([self.size] * 3 + [1.0] * 3)
            placed = placed.moved({n: twists[..., k, :] for k, n in enumerate(self.bodies)})
            last = float(np.abs(step).max())
            worst = int(np.abs(values).max(-1).max(0).argmax())
            if not last < 1.0:
                break
            if last < STEP_TOLERANCE:
                left = float(np.abs(values).max())
                if left > MAX_OPEN_FRACTION:
                    break
                name, origin = self.graph.platform, self.graph.origin
                there = self._point(placed, name, origin, errors.get(("origin", name)))
                turn = placed.rotation[name] @ self.placed.rotation[name].swapaxes(-1, -2)
                moved = there - self._point(self.placed, name, self.robot.graph.origin, None)
                return np.concatenate([moved, rotation_vector(turn)], -1)
        raise PkmTwinError(
            f"{self.robot.name}: rigid parts with errors of this size cannot be assembled at "
            f"{np.round(self.q.reshape(-1, self.q.shape[-1])[worst], 6).tolist()}"
        )
