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
from pkm_twin.machine.graph import Graph
from pkm_twin.machine.inertia import matrix_of

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


def shared_number(
    kind: Kind,
    name: str,
    unit: str,
    value: float,
    scale: float,
    path: Key,
    *,
    others: Sequence[str] = (),
    signed: bool = False,
) -> Shared:
    """One number of a file, not negative unless ``signed``.

    :param others: rods' and joints' parameters that are this number.
    """
    return Shared(
        kind, name, (name,), (unit,), np.array([value]), np.array([scale]),
        lambda new: {path: float(new[0])},
        others={other: np.ones(1) for other in others},
        cones=() if signed else (above_zero(0, 1),),
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


def behind_gear(reflected: Shared, turns: float) -> Callable[[Array], Mapping[Key, float]]:
    """The rotor's own inertia for the one that is reflected to the joint.

    :param turns: motor angle per joint motion.
    """
    return lambda new: {key: v / turns**2 for key, v in reflected.keys(new).items()}
