# SPDX-License-Identifier: Apache-2.0
"""A parameter file's own numbers, as linear parameters that bodies and joints share.

Efforts are linear in masses, first moments and second moments, not in centres and inertias about
them; and one number of a file may stand for three limbs. What a file can hold and what efforts are
linear in meet here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.friction import all_keys
from pkm_twin.machine.graph import Body, Graph
from pkm_twin.machine.inertia import TEN, matrix_of, ten_numbers, transport

Kind = Literal["friction", "rotor", "payload", "inertia"]
Key = tuple[str | int, ...]
"""Where a number stands in a file: keys, and places in lists."""

KINDS: Final[tuple[Kind, ...]] = ("friction", "rotor", "payload", "inertia")
TEN_UNITS: Final = ("kg", *["kg m"] * 3, *["kg m2"] * 6)


@dataclass(frozen=True, eq=False)
class Shared:
    """Parameters that one entry of a file gives, k of them.

    ``values``: shape (k,), in ``units``. ``scales``: how far each may be from the file's for all
    that is known, shape (k,). ``bodies``: by body, what a unit of each adds to its ten numbers
    about the base's origin at home, base axes, shape (10, k). ``others``: by ``OWNER.WHAT``, of
    rods (``mass``) and joints, shape (k,). ``cones``: matrices, shape (d, d, k), whose sum over
    the parameters has to be positive semidefinite. ``keys``: what stands in the file for values.
    """

    kind: Kind
    name: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    scales: Array
    keys: Callable[[Array], Mapping[Key, float]]
    bodies: Mapping[str, Array] = field(default_factory=dict)
    others: Mapping[str, Array] = field(default_factory=dict)
    cones: tuple[Array, ...] = ()


def above_zero(k: int, count: int) -> Array:
    """The cone of a parameter that is not negative."""
    result = np.zeros((1, 1, count))
    result[0, 0, k] = 1.0
    return result


def pseudo_inertia() -> Array:
    """The cone of ten numbers that a body can have, shape (4, 4, 10).

    Wensing, Kim, Slotine, Linear matrix inequalities for physically consistent inertial parameter
    identification, 2018, doi:10.1109/LRA.2017.2729659.
    """
    parts = []
    for ten in np.eye(10):
        about = matrix_of(ten)
        block = np.zeros((4, 4))
        block[:3, :3] = 0.5 * np.trace(about) * np.eye(3) - about
        block[:3, 3] = block[3, :3] = ten[1:4]
        block[3, 3] = ten[0]
        parts.append(block)
    return np.stack(parts, -1)


def com_and_inertia(ten: Array, place: Array) -> tuple[Array, Array]:
    """Centre of mass (m) and inertia about it of ten numbers about a place of those axes."""
    mass = ten[0]
    if not mass > 0.0:
        return place, np.zeros((3, 3))
    c = ten[1:4] / mass
    inertia = matrix_of(ten) - mass * (c @ c * np.eye(3) - np.outer(c, c))
    # A solver stops beside the edge of what a body can be: its second moments are not negative.
    values, vectors = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    if values[0] < 0.0:
        second = (vectors * np.maximum(values, 0.0)) @ vectors.T
        inertia = np.trace(second) * np.eye(3) - second
    return place + c, inertia


def shared_body(
    name: str,
    body: Body,
    path: Key,
    copies: Mapping[str, Array],
    *,
    kind: Kind = "inertia",
    words: Sequence[str] = ("mass", "com", "inertia"),
    origin: Array | None = None,
    mass_scale: float = 0.0,
    length: float = 0.1,
) -> Shared:
    """All ten numbers of a body that a file gives, about its centre of mass as the file has it.

    :param body: as the file has it, base axes of the first copy.
    :param path: of the entry in the file. ``words``: its keys there.
    :param copies: by body of the graph the rotation about the base's origin, shape (3, 3).
    :param origin: the point that the file's ``com`` starts at; default the base's origin.
    :param mass_scale: how far the mass may be off; by default by all of it.
    :param length: a length of the body, m.
    """
    start = np.zeros(3) if origin is None else origin
    scale = mass_scale or body.mass
    place, inertia = body.com, body.inertia
    values = ten_numbers(body.mass, np.zeros(3), inertia)

    def keys(new: Array) -> dict[Key, float]:
        com, about = com_and_inertia(new, place)
        result: dict[Key, float] = {(*path, words[0]): float(new[0])}
        result |= {(*path, words[1], i): float(com[i] - start[i]) for i in range(3)}
        pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        return result | {(*path, words[2], i, j): float(about[i, j]) for i, j in pairs}

    return Shared(
        kind, name, tuple(f"{name}.{what}" for what in TEN), TEN_UNITS, values,
        scale * np.array([1.0, *[length] * 3, *[length**2] * 6]), keys,
        {
            copy: transport(rotation.T, np.zeros(3)) @ transport(np.eye(3), place)
            for copy, rotation in copies.items()
        },
        cones=(pseudo_inertia(),),
    )  # fmt: skip


def shared_number(
    kind: Kind,
    name: str,
    unit: str,
    value: float,
    scale: float,
    path: Key,
    *,
    bodies: Mapping[str, Array] | None = None,
    others: Sequence[str] = (),
    signed: bool = False,
) -> Shared:
    """One number of a file, not negative unless ``signed``.

    :param bodies: by body the ten numbers about the base's origin that a unit of it gives, (10,).
    :param others: rods' and joints' parameters that are this number.
    """
    return Shared(
        kind, name, (name,), (unit,), np.array([value]), np.array([scale]),
        lambda new: {path: float(new[0])},
        {body: ten.reshape(10, 1) for body, ten in (bodies or {}).items()},
        {other: np.ones(1) for other in others},
        () if signed else (above_zero(0, 1),),
    )  # fmt: skip


def shared_payload(
    graph: Graph, mass: float, com: Array, inertia: Array, mass_scale: float, length: float
) -> Shared:
    """The payload section of a file, as a part of the platform."""
    body = Body("payload", mass, graph.origin + com, inertia)
    return shared_body(
        "payload", body, ("payload",), {graph.platform: np.eye(3)}, kind="payload",
        origin=graph.origin, mass_scale=max(mass, mass_scale), length=length,
    )  # fmt: skip


def drive_units(graph: Graph, joint: str) -> dict[str, str]:
    """Units of a joint's friction and rotor."""
    slides = graph.joints[joint].slides
    units = {key: one.in_units(slides=slides) for key, one in all_keys().items()}
    return units | {"rotor_inertia": "kg" if slides else "kg m2"}


def friction_number(graph: Graph, joint: str, key: str, value: float, path: Key) -> Shared:
    """A parameter of a joint's friction that the effort is linear in."""
    name = f"{joint}.{key}"
    return shared_number(
        "friction", name, drive_units(graph, joint)[key], value, math.nan, path, others=[name],
        signed=all_keys()[key].at_least is None,
    )  # fmt: skip


def point_mass(place: Array) -> Array:
    """Ten numbers of a kilogram at a place, shape (10,)."""
    return ten_numbers(1.0, place, np.zeros((3, 3)))


def bar(pivot: Array, along: Array) -> Array:
    """Ten numbers by mass, first and second moment along a line from a pivot, shape (10, 3).

    Kg, kg m, kg m2; a bar without thickness, ``along`` of length one.
    """
    across = np.eye(3) - np.outer(along, along)
    local = np.array(
        [
            [1.0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
            [0.0, *along, 0, 0, 0, 0, 0, 0],
            [0.0, 0, 0, 0, *np.diag(across), across[0, 1], across[0, 2], across[1, 2]],
        ]
    )
    return np.asarray(transport(np.eye(3), pivot) @ local.T, np.float64)


def behind_gear(reflected: Shared, turns: float) -> Callable[[Array], Mapping[Key, float]]:
    """The rotor's own inertia for the one that is reflected to the joint.

    :param turns: motor angle per joint motion.
    """
    return lambda new: {key: v / turns**2 for key, v in reflected.keys(new).items()}
