# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Define the friction laws of drives: one class per law, with its parameters and its effort.

Schema, compiled dynamics, simulation, regressor and fit read the classes; a new law is one class in
this file. The efforts of several laws are added.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import references
from pkm_twin.codegen.operations import absolute, cos, exp, maximum, sign, sin
from pkm_twin.errors import ParameterError

Values = Mapping[str, Any]
"""Parameters of a law by key, each a number, an expression or an array."""

MIN_DIVISOR: Final = 1e-9
"""Smallest divisor in a friction law, instead of a missing parameter: the law then has no effort."""
KNOWN_FRACTION: Final = 0.01
"""A state counts as known when this fraction of the unknown initial state is left: after five
presliding distances."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of a law, one number per drive.

    ``unit``: with ``{effort}`` and ``{joint}`` (rad or m). ``linear``: whether the effort is linear
    in it; a nonlinear one must be positive if a linear parameter of its law is not zero.
    """

    unit: str
    low: float | None = 0.0
    high: float | None = None
    linear: bool = True

    def unit_of_drive(self, *, slides: bool) -> str:
        """Return the parameter's unit for a prismatic or a rotary drive."""
        effort, joint = ("N", "m") if slides else ("N m", "rad")
        text = self.unit.replace("{effort} per {joint}/s", "N s/m" if slides else "N m s/rad")
        return text.format(effort=effort, joint=joint)


class FrictionLaw:
    """The base class of a drive's friction laws.

    The effort is by_position(q) + (dry(q, speed) + share(q, speed) |load|) sign(rate). The load is
    the drive's effort without friction, including its rotor's inertia.
    """

    name: ClassVar[str]
    parameters: ClassVar[Mapping[str, Parameter]]
    turns: ClassVar[bool] = True
    """True if the effort changes sign with the velocity."""
    memory: ClassVar[bool] = False
    """True if the effort depends on the past motion; such laws are not in compiled programs."""

    @staticmethod
    def by_position(values: Values, q: Any) -> Any:
        """Return the effort that depends on the position alone."""
        return 0.0

    @staticmethod
    def potential(values: Values, q: Any) -> Any:
        """Return the energy, J, whose derivative by q is :meth:`by_position`."""
        return 0.0

    @staticmethod
    def dry(values: Values, q: Any, speed: Any) -> Any:
        """Return the effort against the motion, zero or more.

        :param speed: absolute value of the velocity.
        """
        return 0.0

    @staticmethod
    def load_fraction(values: Values, q: Any, speed: Any) -> Any:
        """Return the effort against the motion as a fraction of the load's magnitude, below one."""
        return 0.0

    @classmethod
    def along(cls, values: Values, q: Array, rates: Array) -> Array:
        """Return the effort without load along a motion in time, shape (k, n) as q and rates."""
        return np.asarray(evaluate_laws([cls.name], values, q, rates, 0.0 * q), np.float64)


class ViscousCoulomb(FrictionLaw):
    """The friction that every drive has: viscous, Coulomb and a constant effort, zero by default.

    The simulation integrates viscous friction exactly, so the dynamics read its parameters.
    """

    name = "coulomb"
    parameters: ClassVar = {
        "viscous": Parameter("{effort} per {joint}/s"),
        "coulomb": Parameter("{effort}"),
        "offset": Parameter("{effort}", low=None),
    }


class Stribeck(FrictionLaw):
    """Breakaway friction above Coulomb friction, which decreases with speed: F exp(-(v / vs)^2).

    Bo and Pavelescu, 1982; Armstrong-Helouvry, Dupont, Canudas de Wit, 1994, eq. 5.
    """

    name = "stribeck"
    parameters: ClassVar = {"stribeck": Parameter("{effort}"), "stribeck_speed": Parameter("{joint}/s", linear=False)}

    @staticmethod
    def dry(values: Values, q: Any, speed: Any) -> Any:
        """Return F exp(-(v / vs)^2)."""
        ratio = speed / maximum(values["stribeck_speed"], MIN_DIVISOR)
        return values["stribeck"] * exp(-(ratio * ratio))


class LoadDependent(FrictionLaw):
    """Coulomb friction of gears and screws, proportional to the load."""

    name = "load-dependent"
    parameters: ClassVar = {"load_dependent": Parameter("1", high=0.9)}

    @staticmethod
    def load_fraction(values: Values, q: Any, speed: Any) -> Any:
        """Return the friction coefficient, below one: self-locking drives are not modelled."""
        return values["load_dependent"]


class Periodic(FrictionLaw):
    """An effort periodic in the position: cogging of a motor, ripple of a gear; conservative."""

    name = "periodic"
    turns = False
    parameters: ClassVar = {
        "cogging_cos": Parameter("{effort}", low=None),
        "cogging_sin": Parameter("{effort}", low=None),
        "cogging_period": Parameter("{joint}", linear=False),
    }

    @staticmethod
    def by_position(values: Values, q: Any) -> Any:
        """Return C cos(2 pi q / p) + S sin(2 pi q / p)."""
        angle = q * (math.tau / maximum(values["cogging_period"], MIN_DIVISOR))
        return values["cogging_cos"] * cos(angle) + values["cogging_sin"] * sin(angle)

    @staticmethod
    def potential(values: Values, q: Any) -> Any:
        """Return the energy of the periodic effort, J, zero on average."""
        wave = math.tau / maximum(values["cogging_period"], MIN_DIVISOR)
        angle = q * wave
        return (values["cogging_cos"] * sin(angle) - values["cogging_sin"] * cos(angle)) / wave


BASIC: Final = ViscousCoulomb
"""Law that every drive has."""


class Memory(NamedTuple):
    """The state of friction with memory; shape (n,) each, or (k, n) along a motion.

    ``z``: friction relative to Coulomb friction, -1 to 1. ``q``: the farthest position since the
    last reversal. ``way``: direction of motion, 0 before the first. ``unknown``: fraction of the
    unknown initial state that is left; z begins at zero. ``slope``: derivative of z by the
    presliding distance, 1/rad or 1/m.
    """

    z: Array
    q: Array
    way: Array
    unknown: Array
    slope: Array

    @classmethod
    def unknown_at(cls, q: Array) -> Memory:
        """Return an unknown initial state at positions q."""
        return cls(np.zeros_like(q), q, np.zeros_like(q), np.ones_like(q), np.zeros_like(q))

    def advance_to(self, q: Array, way: Array, distance: Array) -> Memory:
        """Return the states after positions (k, n) of a motion in one direction.

        The solution is exact for any step. Moves against the direction count as noise.

        :param way: direction of motion, +1, -1 or 0 to keep the last one, shape (n,).
        :param distance: presliding distance, shape (n,), rad or m.
        """
        way = np.where(way == 0.0, self.way, way)
        travel = np.maximum.accumulate(np.maximum(way * (q - self.q), 0.0))
        widths = travel / np.maximum(distance, MIN_DIVISOR)
        left = np.exp(-widths)
        away = (self.z - way) * left
        slope = self.slope * left + away * widths / np.maximum(distance, MIN_DIVISOR)
        place, ways = self.q + way * travel, np.broadcast_to(way, q.shape)
        return Memory(way + away, place, ways, self.unknown * left, slope)

    @property
    def last(self) -> Memory:
        """The state at the end of the motion."""
        return Memory(*(one[-1] for one in self))


class Dahl(FrictionLaw):
    """Coulomb friction that builds up over a presliding distance after each reversal.

    The effort is coulomb z instead of coulomb sign(rate), dz = (sign(dq) - z) |dq| / presliding.
    P. Dahl, A solid friction model, 1968, with the stiffness sigma0 = coulomb / presliding. Only
    computations along a motion in time use z; all others use coulomb sign(rate).
    """

    name = "dahl"
    memory = True
    parameters: ClassVar = {"coulomb": BASIC.parameters["coulomb"], "presliding": Parameter("{joint}", linear=False)}

    @staticmethod
    def states(q: Array, rates: Array, distance: Array) -> Memory:
        """Compute the states along a motion, shape (k, n).

        :param rates: zero if their sign is unknown; a reversal is at the farthest position there.
        """
        way, parts, here = np.sign(rates), [], Memory.unknown_at(q[0])
        for own, place in zip(way.T, q.T, strict=True):
            sure = np.flatnonzero(own)
            for k in np.flatnonzero(np.diff(own[sure])):
                a, b = sure[k : k + 2]
                own[a + np.argmax(own[a] * place[a:b]) + 1 : b] = own[b]
        latest = np.maximum.accumulate(np.where(way, np.arange(len(q))[:, None], 0))
        way = np.take_along_axis(way, latest, 0)
        turns = np.flatnonzero((way[1:] != way[:-1]).any(1)) + 1
        for a, b in pairwise([0, *turns.tolist(), len(q)]):
            parts.append(here.advance_to(q[a:b], way[a], distance))
            here = parts[-1].last
        return Memory(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    @classmethod
    def along(cls, values: Values, q: Array, rates: Array) -> Array:
        """Return the effort along a motion that begins with an unknown state."""
        z = cls.states(q, rates, values["presliding"]).z
        return np.asarray(values["coulomb"] * z, np.float64)

    @staticmethod
    def memory_effort(friction: Any, z: Array, rates: Array) -> Array:
        """Return coulomb (z - sign(rate)), the effect of memory on efforts, N m or N, in z's shape."""
        change = friction.coulomb * (z - np.sign(rates))
        return np.where(friction.presliding > 0.0, change, 0.0)

    @classmethod
    def bounded_memory_effort(cls, friction: Any, q: Array, rates: Array) -> tuple[Array, Array]:
        """Return :meth:`memory_effort` from an unknown state, and its error bound, shape (k, n) each."""
        if not friction.presliding.any():
            return np.zeros_like(q), np.zeros_like(q)
        memory = cls.states(q, rates, friction.presliding)
        doubt = np.where(friction.presliding > 0.0, friction.coulomb * memory.unknown, 0.0)
        return cls.memory_effort(friction, memory.z, rates), doubt


LAWS: Final[Mapping[str, type[FrictionLaw]]] = {
    law.name: law for law in FrictionLaw.__subclasses__() if law is not BASIC
}
"""All laws but the basic one, by name."""


def find_law_names(friction: Any, opened: Sequence[str] = ()) -> tuple[str, ...]:
    """Name the laws besides the basic one that ``friction`` or ``opened`` has."""

    def given(law: type[FrictionLaw], *, linear: bool) -> list[bool]:
        keys = [key for key, one in law.parameters.items() if one.linear == linear]
        return [bool(np.any(references(getattr(friction, key)))) for key in keys]

    return tuple(
        name
        for name, law in LAWS.items()
        if name in opened or (any(given(law, linear=True)) and all(given(law, linear=False)))
    )


def select_compiled_laws(names: Sequence[str]) -> tuple[str, ...]:
    """Select the laws that are part of compiled programs: those without memory."""
    return tuple(name for name in names if not LAWS[name].memory)


def list_unshareable_laws(names: Sequence[str]) -> list[str]:
    """Select the laws that depend on load or past motion, which redundant drives cannot have."""
    laws = {name: LAWS[name] for name in names}
    return [n for n, law in laws.items() if law.memory or law.load_fraction is not FrictionLaw.load_fraction]


def list_parameters(names: Sequence[str]) -> dict[str, Parameter]:
    """Return the parameters of laws by key, in order."""
    return {key: one for name in names for key, one in LAWS[name].parameters.items()}


def list_linear_keys(names: Sequence[str]) -> tuple[str, ...]:
    """Return the keys of the linear parameters of the basic law and of the named laws."""
    every = {**BASIC.parameters, **list_parameters(names)}
    return tuple(key for key, one in every.items() if one.linear)


def list_reversal_keys() -> frozenset[str]:
    """Return the keys of the parameters whose efforts jump at a reversal of the joint."""
    own = (key for law in LAWS.values() if law.turns for key in law.parameters)
    return frozenset({"coulomb", *own})


def list_friction_keys() -> dict[str, Parameter]:
    """Return all parameters of a drive's friction, those of the basic law first."""
    return {**BASIC.parameters, **list_parameters(tuple(LAWS))}


def check_laws(friction: Any, path: str) -> None:
    """Check that a law whose linear parameters are given has its nonlinear ones, too.

    :raises ParameterError: a parameter is missing; the error names its field.
    """
    for law in (LAWS[name] for name in select_compiled_laws(tuple(LAWS))):
        linear = [key for key, one in law.parameters.items() if one.linear]
        used = np.any([references(getattr(friction, key)) != 0.0 for key in linear], axis=0)
        for key, one in law.parameters.items():
            missing = used & ~(references(getattr(friction, key)) > 0.0)
            if not one.linear and np.any(missing):
                raise ParameterError(f"{path}.{key}", 0.0, f"above zero where {' or '.join(linear)} is given")


def evaluate_laws(names: Sequence[str], values: Values, q: Any, rate: Any, load: Any) -> Any:
    """Return the friction of a drive by the named laws, without the basic law.

    :param names: names of the laws; other arguments as for :class:`FrictionLaw`.
    """
    speed, way = absolute(rate), sign(rate)
    at_place, dry, share = sum_laws(names, values, q, speed)
    return at_place + (dry + share * absolute(load)) * way


def sum_laws(names: Sequence[str], values: Values, q: Any, speed: Any) -> tuple[Any, Any, Any]:
    """Sum the laws' efforts by position, dry efforts, and fractions of the load's magnitude."""
    laws = [LAWS[name] for name in names]
    at_place: Any = sum((law.by_position(values, q) for law in laws), 0.0)
    dry: Any = sum((law.dry(values, q, speed) for law in laws), 0.0)
    share: Any = sum((law.load_fraction(values, q, speed) for law in laws), 0.0)
    return at_place, dry, share


def potential(names: Sequence[str], values: Values, q: Any) -> Any:
    """Return the energy of a drive's effort by position, J."""
    return sum((LAWS[name].potential(values, q) for name in names), 0.0)


def read_friction_values(names: Sequence[str], friction: Any) -> dict[str, Array]:
    """Return the parameters of laws, by key, from a friction section."""
    return {key: np.asarray(getattr(friction, key), np.float64) for key in list_parameters(names)}


def solve_load(driving: Any, share: Any, way: Any) -> Any:
    """Solve L + share |L| way = driving for the load L, with a share below one."""
    return driving / (1.0 + share * way * sign(driving))


def bound_static_friction(held: Any, dry: Any, share: Any) -> tuple[Any, Any]:
    """Return the smallest and largest friction f of a joint at rest: |f| <= dry + share |held - f|.

    :param held: effort of the drive minus the efforts that depend on position and velocity.
    """
    low, high = (held - solve_load(held - way * dry, share, way) for way in (-1.0, 1.0))
    return low, high
