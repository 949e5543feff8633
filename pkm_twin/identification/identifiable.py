# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Numbers of a robot's file that efforts identify, as linear parameters, by exact derivatives.

Efforts are linear in ten numbers of each body about a fixed point. About the centre of mass that
the file has, these ten change in proportion to masses and inertias of the file, and to its centres
times the mass. The inertia about a centre that has moved follows by the parallel axis theorem.
So the derivatives of the bodies by the file's numbers give the parameters of any file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np

from pkm_twin.codegen.arrays import Array, Indices
from pkm_twin.machine.friction import LAWS, list_friction_keys, list_linear_keys
from pkm_twin.machine.inertia import drive_units, inertia_matrix, make_frame_change, standard_parameters
from pkm_twin.machine.places import Keys, join_path
from pkm_twin.robot.numbers import FileNumbers
from pkm_twin.robot.robot import Robot

Kind = Literal["friction", "rotor", "payload", "inertia"]
KINDS: Final[tuple[Kind, ...]] = ("friction", "rotor", "payload", "inertia")
PAYLOAD: Final = "payload"
"""Name of the payload among the bodies."""


@dataclass(frozen=True, eq=False)
class Identifiable:
    """Parameters that numbers of a file give together, k of them, a number each.

    ``values``: shape (k,), in ``units``. ``scales``: how far each may be from the file's for all
    that is known, shape (k,). ``bodies``: by body, what a unit of each adds to its ten numbers
    about the base's origin at home, base axes, shape (10, k). ``others``: by ``OWNER.WHAT``, of
    rods (``mass``) and joints, shape (k,). ``cones``: matrices, shape (d, d, k), whose sum over
    the parameters has to be positive semidefinite. ``keys``: what stands in the file for values.
    """

    kind: Kind
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    scales: Array
    keys: Callable[[Array], Mapping[Keys, float]]
    bodies: Mapping[str, Array] = field(default_factory=dict)
    others: Mapping[str, Array] = field(default_factory=dict)
    cones: tuple[Array, ...] = ()


def make_nonnegative_cone(k: int, count: int) -> Array:
    """Return the cone of a parameter that is not negative."""
    return np.asarray(np.eye(count)[k].reshape(1, 1, -1), np.float64)


def make_inertia_cone() -> Array:
    """Return the cone of ten numbers that a body can have, shape (4, 4, 10).

    Wensing, Kim, Slotine, Linear matrix inequalities for physically consistent inertial parameter
    identification, 2018, doi:10.1109/LRA.2017.2729659.
    """
    parts = []
    for ten in np.eye(10):
        about = inertia_matrix(ten)
        block = np.zeros((4, 4))
        block[:3, :3] = 0.5 * np.trace(about) * np.eye(3) - about
        block[:3, 3] = block[3, :3] = ten[1:4]
        block[3, 3] = ten[0]
        parts.append(block)
    return np.stack(parts, -1)


def identifiable(robot: Robot) -> tuple[Identifiable, ...]:
    """List all that a fit of the robot's file may change: drives, payload, bodies and rods.

    :raises ParameterError: the robot's file gives no masses.
    """
    # The engine's own graph may be that of a machine with other masses.
    robot.massive()
    return (*list_drive_parameters(robot), *list_mass_parameters(robot.with_default_inertia))


def list_drive_parameters(robot: Robot) -> tuple[Identifiable, ...]:
    """List the friction of each joint that has some, and rotors; joints may share one number."""
    graph, friction = robot.graph, robot.friction
    found, rotors = [], dict[Keys, list[str]]()
    # A regressor lacks the columns of friction with memory: they depend on the whole motion.
    open_keys = [key for name in robot.open_laws if LAWS[name].memory for key in LAWS[name].parameters]
    key_names = dict.fromkeys((*list_linear_keys(robot.laws), *open_keys))

    def add_parameter(kind: Kind, name: str, value: float, key: Keys, joints: Sequence[str]) -> None:
        """Append one parameter, at ``key`` of the file, that these joints share."""
        key_name = name.rpartition(".")[2]
        friction_key = list_friction_keys().get(key_name)
        linear = friction_key is None or friction_key.linear
        signed = friction_key is not None and friction_key.low is None
        # The file gives the inertia of a rotor behind a gear at the motor.
        drive = dict(zip(robot.joint_names, robot.drives, strict=True)).get(joints[0])
        inertia_factor = drive.turns**-2 if drive is not None and kind == "rotor" else 1.0
        found.append(
            Identifiable(
                kind,
                (name,),
                (drive_units(graph, joints[0])[key_name],),
                np.array([value]),
                np.array([math.nan]),
                lambda new: {key: inertia_factor * float(new[0])},
                others={f"{joint}.{key_name}": np.ones(1) for joint in joints if linear},
                cones=() if signed else (make_nonnegative_cone(0, 1),),
            )
        )

    for name, joint in graph.joints.items():
        if joint.actuated:
            k = graph.actuated.index(name)
            values = {what: getattr(friction, what)[k] for what in key_names}
        else:
            own = ("viscous", "coulomb") if joint.loaded else ()
            values = {what: getattr(joint, what) for what in own}
        for what, value in values.items():
            key = robot.friction_key(name, what)
            add_parameter("friction", f"{name}.{what}", float(value), key, [name])
        if joint.actuated or joint.rotor_inertia:
            rotors.setdefault(robot.rotor_key(name), []).append(name)
    for key, names in rotors.items():
        owner = names[0] if len(names) == 1 else join_path(key[:-1])
        value = graph.joints[names[0]].rotor_inertia
        add_parameter("rotor", f"{owner}.rotor_inertia", value, key, names)
    return tuple(found)


def list_mass_parameters(robot: Robot) -> Iterator[Identifiable]:
    """Yield masses, centres and inertias of payload, bodies and rods, by what they move together.

    :param robot: of a file that gives all of them.
    """
    graph, load = robot.graph, robot.payload

    def list_inertial(robot: Robot) -> list[Any]:
        """List ten inertial parameters of each body and the payload about the origin, and rod masses."""
        graph, load = robot.graph, robot.payload
        tens = [standard_parameters(body.mass, body.com, body.inertia) for body in graph.bodies.values()]
        tens.append(standard_parameters(load.mass, graph.origin + load.com, load.inertia))
        return [*(value for ten in tens for value in ten), *(rod.mass for rod in graph.rods.values())]

    every: list[Keys] = [(PAYLOAD, "mass"), *((PAYLOAD, "com", i) for i in range(3))]
    every += [*((PAYLOAD, "inertia", *ij) for ij in np.ndindex(3, 3)), *robot.mass_keys()]
    # Keep the upper triangle of an inertia matrix; each entry stands for its mirrored one, too.
    keys = [key for key in every if key <= _mirror_key(key)]
    both = [dict.fromkeys((key, _mirror_key(key))) for key in keys]
    tie = np.repeat(np.eye(len(keys)), [len(pair) for pair in both], 0)
    values = np.array([robot.number(join_path(key)) for key in keys])
    # Masses above zero: as much as each may be off.
    masses = [body.mass for body in graph.bodies.values()]
    heavy = max(graph.bodies[graph.platform].mass, 0.1 * sum(masses))
    reference = values.copy()
    for k in _find_places(keys, "mass", "density"):
        reference[k] = max(values[k], heavy if keys[k][0] == PAYLOAD or not values[k] else 0.0)
    made = FileNumbers(robot, [join_path(key) for pair in both for key in pair], list_inertial)
    slopes = made.slopes_at((tie @ reference)[None])[0] @ tie
    names = [*graph.bodies, PAYLOAD]
    tens = slopes[: 10 * len(names)].reshape(len(names), 10, -1)
    rods = dict(zip(graph.rods, slopes[10 * len(names) :], strict=True))
    coms = [*(body.com for body in graph.bodies.values()), graph.origin + load.com]
    moved = zip(coms, tens, strict=True)
    own = np.array([make_frame_change(np.eye(3), -com) @ ten for com, ten in moved])
    own[np.abs(own) < 1e-12 * np.abs(own).max((1, 2), keepdims=True, initial=1e-300)] = 0.0
    touched = np.vstack([own.any(1), slopes[10 * len(names) :] != 0.0]).astype(float)
    linked = np.linalg.matrix_power(touched.T @ touched > 0.0, 4)
    extents = list[float]()
    for name, body in graph.bodies.items():
        # The greatest distance of a body's joints and rods from its centre.
        far = max((float(np.linalg.norm(p - body.com)) for p in graph.joint_points(name)), default=0.0)
        extents.append(far if far > 1e-3 * graph.size else 0.1 * graph.size)
    extents.append(0.3 * graph.size)
    units = {"mass": "kg", "density": "kg/m3", "inertia": "kg m2"}
    for chosen in dict.fromkeys(tuple(np.flatnonzero(row).tolist()) for row in linked):
        part = list(chosen)
        inside = [b for b in range(len(names)) if own[b][:, part].any()]
        if not touched[:, part].any():
            continue
        group = _BodyGroup([keys[k] for k in part], values[part], reference[part], own[inside][:, :, part])
        payload = keys[part[0]][0] == PAYLOAD
        yield Identifiable(
            "payload" if payload else "inertia",
            tuple(map(join_path, group.keys)),
            tuple(units.get(_find_word(k), "m" if isinstance(k[-1], int) else "") for k in group.keys),
            group.begin,
            group.scales([extents[b] for b in inside]),
            group.numbers,
            {graph.platform if payload else names[b]: tens[b][:, part] for b in inside},
            {f"{rod}.mass": row[part] for rod, row in rods.items() if row[part].any()},
            tuple(group.cones()),
        )


class _BodyGroup:
    """Numbers of the file that change the same bodies' inertial parameters.

    ``own``: derivatives of the bodies' ten inertial parameters, about the file's centres of mass,
    by these k numbers, (bodies, 10, k).
    """

    def __init__(self, keys: list[Keys], values: Array, reference: Array, own: Array) -> None:
        self.keys, self.values, self.reference, self.own = keys, values, reference, own
        self.masses = _find_places(keys, "mass", "density")
        self.coms, self.inertias = _find_places(keys, "com"), _find_places(keys, "inertia")
        # Centres that are parts of a length, 0 to 1.
        self.parts = np.array([not isinstance(keys[k][-1], int) for k in self.coms], bool)

    @property
    def begin(self) -> Array:
        """Parameters at the file's values: masses, inertias, and no change of centres."""
        return np.where(np.isin(np.arange(len(self.keys)), self.coms), 0.0, self.values)

    def scales(self, far: Sequence[float]) -> Array:
        """Return the scale of each parameter's error; ``far``: extents of the bodies, m."""
        result = self.reference.copy()
        for k in (*self.coms, *self.inertias):
            b = int(np.flatnonzero(self.own[:, :, k].any(1))[0])
            mass = self.own[b, 0] @ self.reference
            away = np.linalg.norm(self.own[b, 1:4, k]) / mass
            result[k] = far[b] / away if k in self.coms else mass * far[b] ** 2
        return result

    def numbers(self, new: Array) -> Mapping[Keys, float]:
        """Return the file's numbers: masses and inertias, and centres times the mass."""
        result, whole = new.copy(), float(new[self.masses].sum())
        before = float(self.reference[self.masses].sum())
        change = new[self.coms] * (before / whole if whole > 0.0 else 0.0)
        centres = self.values[self.coms] + change
        result[self.coms] = np.where(self.parts, np.clip(centres, 0.0, 1.0), centres)
        if len(self.coms) and len(self.inertias):
            change = result[self.coms] - self.values[self.coms]
            heavy = self.own[:, 0, self.masses]
            usual, mass = (heavy @ v[self.masses] for v in (self.reference, new))
            away = self.own[:, 1:4, self.coms] @ change / usual[:, None]
            table, target = self.own[:, 4:, self.inertias], []
            for m, d, rows in zip(mass, away, table, strict=True):
                about = m * (d @ d * np.eye(3) - np.outer(d, d))
                target.append(
                    rows @ new[self.inertias]
                    - [about[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
                )
            flat = table.reshape(-1, len(self.inertias))
            found = np.linalg.lstsq(flat, np.concatenate(target), rcond=None)[0]
            result[self.inertias] = find_possible_inertia(found) if whole > 0.0 else 0.0
        return dict(zip(self.keys, result.tolist(), strict=True))

    def cones(self) -> Iterator[Array]:
        """Yield the matrices that must be positive semidefinite, (d, d, k) each."""
        eye = np.eye(len(self.keys))
        if not len(self.coms):
            yield from (make_nonnegative_cone(k, len(eye)) for k in self.masses)
            return
        for k in self.coms[self.parts]:
            total, once = eye[self.masses].sum(0), eye[k] * self.reference[self.masses].sum()
            yield (self.values[k] * total + once).reshape(1, 1, -1)
            yield ((1.0 - self.values[k]) * total - once).reshape(1, 1, -1)
        # Copies of a body depend on the same masses.
        for ten in {tuple(ten[0].tolist()): ten for ten in self.own[::-1]}.values():
            cone = np.einsum("ijt,tk->ijk", make_inertia_cone(), ten)
            axes, sizes, _ = np.linalg.svd(cone.reshape(4, -1), full_matrices=False)
            axes = axes[:, sizes > 1e-12 * sizes[0]]
            yield np.einsum("ia,ijk,jb->abk", axes, cone, axes)


def find_possible_inertia(inertia: Array) -> Array:
    """Return the nearest inertia (6,), or principal ones (k,), without negative second moments.

    A solver stops beside the edge of what a body can be.
    """
    upper = np.triu_indices(3)
    if len(inertia) != len(upper[0]):
        return np.maximum(inertia, 0.0)
    whole = np.zeros((3, 3))
    whole[upper] = whole[upper[::-1]] = inertia
    values, vectors = np.linalg.eigh(0.5 * np.trace(whole) * np.eye(3) - whole)
    if values[0] < 0.0:
        second = (vectors * np.maximum(values, 0.0)) @ vectors.T
        whole = np.trace(second) * np.eye(3) - second
    return np.asarray(whole[upper], np.float64)


def _mirror_key(key: Keys) -> Keys:
    """Return the key of the equal entry of an inertia matrix; else the key itself."""
    return (*key[:-2], key[-1], key[-2]) if isinstance(key[-2], int) else key


def _find_word(key: Keys) -> str:
    """Return which of ``mass``, ``density``, ``com`` or ``inertia`` a key has."""
    return [str(k) for k in key if not isinstance(k, int)][-1].rpartition("_")[2]


def _find_places(keys: Sequence[Keys], *words: str) -> Indices:
    return np.flatnonzero([_find_word(key) in words for key in keys])
