# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Friction laws of drives: one class a law, with its parameters and the effort that it takes.

Schema, compiled dynamics, plant, regressor and fit read the classes; another law is one class in
this file. Laws add up.
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
"""A law's parameters by key: a number, an expression or an array."""

LEAST: Final = 1e-9
"""Divisor in place of a parameter that is not given: its law's effort is zero."""
KNOWN: Final = 0.01
"""Part of an unknown beginning below which a state is known: after five presliding distances."""


@dataclass(frozen=True)
class Parameter:
    """A number of a law, one a drive.

    ``unit``: with ``{effort}`` and ``{joint}`` (rad or m). ``linear``: the effort is linear in it;
    any other is above zero where one of its law's linear parameters is not zero.
    """

    unit: str
    low: float | None = 0.0
    high: float | None = None
    linear: bool = True

    def in_units(self, *, slides: bool) -> str:
        """The unit of a drive that slides or turns."""
        effort, joint = ("N", "m") if slides else ("N m", "rad")
        text = self.unit.replace("{effort} per {joint}/s", "N s/m" if slides else "N m s/rad")
        return text.format(effort=effort, joint=joint)


class FrictionLaw:
    """A friction law of a drive.

    Its effort is by_position(q) + (dry(q, speed) + share(q, speed) |load|) sign(rate). The load is
    the drive's effort without friction, its rotor's inertia included.
    """

    name: ClassVar[str]
    parameters: ClassVar[Mapping[str, Parameter]]
    turns: ClassVar[bool] = True
    """Whether it turns round with the rate."""
    memory: ClassVar[bool] = False
    """Whether it depends on the way that the joint has come: it is in no compiled program."""

    @staticmethod
    def by_position(values: Values, q: Any) -> Any:
        """Effort that depends on the position alone."""
        del values, q
        return 0.0

    @staticmethod
    def potential(values: Values, q: Any) -> Any:
        """Energy of the same, J: its derivative by q is :meth:`by_position`."""
        del values, q
        return 0.0

    @staticmethod
    def dry(values: Values, q: Any, speed: Any) -> Any:
        """Effort against the motion, zero or more.

        :param speed: without sign.
        """
        del values, q, speed
        return 0.0

    @staticmethod
    def share(values: Values, q: Any, speed: Any) -> Any:
        """Effort against the motion, as part of the load's magnitude, less than one."""
        del values, q, speed
        return 0.0

    @classmethod
    def along(cls, values: Values, q: Array, rates: Array) -> Array:
        """Effort along a motion in the order of time without load, shape (k, n) as q and rates."""
        return np.asarray(taken([cls.name], values, q, rates, 0.0 * q), np.float64)


class ViscousCoulomb(FrictionLaw):
    """Viscous friction, Coulomb friction and a constant effort: of every drive, zero by default.

    The plant integrates the viscous part exactly, so the dynamics take this law by its parameters.
    """

    name = "coulomb"
    parameters: ClassVar = {
        "viscous": Parameter("{effort} per {joint}/s"),
        "coulomb": Parameter("{effort}"),
        "offset": Parameter("{effort}", low=None),
    }


class Stribeck(FrictionLaw):
    """Breakaway friction above Coulomb's, which falls with speed: F exp(-(v / vs)^2).

    Bo and Pavelescu, 1982; Armstrong-Helouvry, Dupont, Canudas de Wit, 1994, eq. 5.
    """

    name = "stribeck"
    parameters: ClassVar = {
        "stribeck": Parameter("{effort}"),
        "stribeck_speed": Parameter("{joint}/s", linear=False),
    }

    @staticmethod
    def dry(values: Values, q: Any, speed: Any) -> Any:
        """Zero or more."""
        del q
        ratio = speed / maximum(values["stribeck_speed"], LEAST)
        return values["stribeck"] * exp(-(ratio * ratio))


class LoadDependent(FrictionLaw):
    """Coulomb friction that grows with the load, of gears and screws."""

    name = "load-dependent"
    parameters: ClassVar = {"load_dependent": Parameter("1", high=0.9)}

    @staticmethod
    def share(values: Values, q: Any, speed: Any) -> Any:
        """Less than one: a drive that its load cannot move back is none."""
        del q, speed
        return values["load_dependent"]


class Periodic(FrictionLaw):
    """An effort of one harmonic of the position: cogging of a motor, ripple of a gear.

    It stores energy and takes none.
    """

    name = "periodic"
    turns = False
    parameters: ClassVar = {
        "cogging_cos": Parameter("{effort}", low=None),
        "cogging_sin": Parameter("{effort}", low=None),
        "cogging_period": Parameter("{joint}", linear=False),
    }

    @staticmethod
    def by_position(values: Values, q: Any) -> Any:
        """C cos(2 pi q / p) + S sin(2 pi q / p)."""
        angle = q * (math.tau / maximum(values["cogging_period"], LEAST))
        return values["cogging_cos"] * cos(angle) + values["cogging_sin"] * sin(angle)

    @staticmethod
    def potential(values: Values, q: Any) -> Any:
        """Zero on average."""
        wave = math.tau / maximum(values["cogging_period"], LEAST)
        angle = q * wave
        return (values["cogging_cos"] * sin(angle) - values["cogging_sin"] * cos(angle)) / wave


BASIC: Final = ViscousCoulomb
"""The law that every drive has."""


class Memory(NamedTuple):
    """State of friction with memory; shape (n,) each, or (k, n) along a motion.

    ``z``: part of the Coulomb friction that is built up, -1 to 1. ``q``: the farthest place of the
    motion one way. ``way``: its direction, 0 before a motion. ``unknown``: the part of the unknown
    beginning that is left; z begins at zero. ``slope``: of z by the presliding distance, 1/rad or
    1/m.
    """

    z: Array
    q: Array
    way: Array
    unknown: Array
    slope: Array

    @classmethod
    def begun(cls, q: Array) -> Memory:
        """Nothing is known."""
        return cls(np.zeros_like(q), q, np.zeros_like(q), np.ones_like(q), np.zeros_like(q))

    def after(self, q: Array, way: Array, distance: Array) -> Memory:
        """After places (k, n) of a motion one way, +1, -1 or 0 for that before, shape (n,).

        Exact, whatever the steps. What noise goes the other way does not count.

        :param distance: of presliding, shape (n,), rad or m.
        """
        way = np.where(way == 0.0, self.way, way)
        travel = np.maximum.accumulate(np.maximum(way * (q - self.q), 0.0))
        widths = travel / np.maximum(distance, LEAST)
        left = np.exp(-widths)
        away = (self.z - way) * left
        slope = self.slope * left + away * widths / np.maximum(distance, LEAST)
        place, ways = self.q + way * travel, np.broadcast_to(way, q.shape)
        return Memory(way + away, place, ways, self.unknown * left, slope)

    @property
    def last(self) -> Memory:
        """At a motion's end."""
        return Memory(*(one[-1] for one in self))


class Dahl(FrictionLaw):
    """Coulomb friction that builds up over a presliding distance, and does so again at reversals.

    The effort is coulomb z instead of coulomb sign(rate), dz = (sign(dq) - z) |dq| / presliding.
    P. Dahl, A solid friction model, 1968, with the stiffness sigma0 = coulomb / presliding.
    Only what follows a motion in time has z; all else takes coulomb sign(rate).
    """

    name = "dahl"
    memory = True
    parameters: ClassVar = {
        "coulomb": BASIC.parameters["coulomb"],
        "presliding": Parameter("{joint}", linear=False),
    }

    @staticmethod
    def states(q: Array, rates: Array, distance: Array) -> Memory:
        """States along a motion, shape (k, n).

        :param rates: zero where their sign is not known: a joint turns at its farthest place there.
        """
        way, parts, here = np.sign(rates), [], Memory.begun(q[0])
        for own, place in zip(way.T, q.T, strict=True):
            sure = np.flatnonzero(own)
            for k in np.flatnonzero(np.diff(own[sure])):
                a, b = sure[k : k + 2]
                own[a + np.argmax(own[a] * place[a:b]) + 1 : b] = own[b]
        latest = np.maximum.accumulate(np.where(way, np.arange(len(q))[:, None], 0))
        way = np.take_along_axis(way, latest, 0)
        turns = np.flatnonzero((way[1:] != way[:-1]).any(1)) + 1
        for a, b in pairwise([0, *turns.tolist(), len(q)]):
            parts.append(here.after(q[a:b], way[a], distance))
            here = parts[-1].last
        return Memory(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    @classmethod
    def along(cls, values: Values, q: Array, rates: Array) -> Array:
        """From an unknown state."""
        z = cls.states(q, rates, values["presliding"]).z
        return np.asarray(values["coulomb"] * z, np.float64)

    @staticmethod
    def beyond(friction: Any, z: Array, rates: Array) -> Array:
        """What memory changes in efforts with coulomb sign(rate), shape of z, N m or N."""
        change = friction.coulomb * (z - np.sign(rates))
        return np.where(friction.presliding > 0.0, change, 0.0)

    @classmethod
    def remembered(cls, friction: Any, q: Array, rates: Array) -> tuple[Array, Array]:
        """The same along a motion from an unknown state, and its doubt, (k, n) as q and rates."""
        if not friction.presliding.any():
            return np.zeros_like(q), np.zeros_like(q)
        memory = cls.states(q, rates, friction.presliding)
        doubt = np.where(friction.presliding > 0.0, friction.coulomb * memory.unknown, 0.0)
        return cls.beyond(friction, memory.z, rates), doubt


LAWS: Final[Mapping[str, type[FrictionLaw]]] = {
    law.name: law for law in FrictionLaw.__subclasses__() if law is not BASIC
}
"""The other laws by name."""


def law_names(friction: Any, opened: Sequence[str] = ()) -> tuple[str, ...]:
    """Laws beside the basic one that a friction section states, or that are open to a fit."""

    def given(law: type[FrictionLaw], *, linear: bool) -> list[bool]:
        keys = [key for key, one in law.parameters.items() if one.linear == linear]
        return [bool(np.any(references(getattr(friction, key)))) for key in keys]

    return tuple(
        name
        for name, law in LAWS.items()
        if name in opened or (any(given(law, linear=True)) and all(given(law, linear=False)))
    )


def compiled(names: Sequence[str]) -> tuple[str, ...]:
    """Those of some laws that programs have."""
    return tuple(name for name in names if not LAWS[name].memory)


def not_shared(names: Sequence[str]) -> list[str]:
    """Those of some laws that follow the load or the way: no drives that share the effort."""
    laws = {name: LAWS[name] for name in names}
    return [n for n, law in laws.items() if law.memory or law.share is not FrictionLaw.share]


def keys_of(names: Sequence[str]) -> dict[str, Parameter]:
    """Parameters of laws by key, in order."""
    return {key: one for name in names for key, one in LAWS[name].parameters.items()}


def linear_keys(names: Sequence[str]) -> tuple[str, ...]:
    """Parameters that efforts are linear in, of the basic law and of others."""
    every = {**BASIC.parameters, **keys_of(names)}
    return tuple(key for key, one in every.items() if one.linear)


def turning_keys() -> frozenset[str]:
    """Parameters whose efforts jump where a joint turns round."""
    own = (key for law in LAWS.values() if law.turns for key in law.parameters)
    return frozenset({"coulomb", *own})


def all_keys() -> dict[str, Parameter]:
    """Every parameter of a drive's friction, the basic law's first."""
    return {**BASIC.parameters, **keys_of(tuple(LAWS))}


def check_laws(friction: Any, path: str) -> None:
    """Reject a law without one of its other parameters.

    :raises ParameterError: by the field.
    """
    for law in (LAWS[name] for name in compiled(tuple(LAWS))):
        linear = [key for key, one in law.parameters.items() if one.linear]
        used = np.any([references(getattr(friction, key)) != 0.0 for key in linear], axis=0)
        for key, one in law.parameters.items():
            missing = used & ~(references(getattr(friction, key)) > 0.0)
            if not one.linear and np.any(missing):
                raise ParameterError(
                    f"{path}.{key}", 0.0, f"above zero where {' or '.join(linear)} is given"
                )


def taken(names: Sequence[str], values: Values, q: Any, rate: Any, load: Any) -> Any:
    """Effort that laws take of a drive beside the basic one.

    :param names: of the laws; others as of :class:`FrictionLaw`, numbers, expressions or arrays.
    """
    speed, way = absolute(rate), sign(rate)
    at_place, dry, share = parts(names, values, q, speed)
    return at_place + (dry + share * absolute(load)) * way


def parts(names: Sequence[str], values: Values, q: Any, speed: Any) -> tuple[Any, Any, Any]:
    """Sums over laws: by position, dry, and the share of the load's magnitude."""
    laws = [LAWS[name] for name in names]
    at_place: Any = sum((law.by_position(values, q) for law in laws), 0.0)
    dry: Any = sum((law.dry(values, q, speed) for law in laws), 0.0)
    share: Any = sum((law.share(values, q, speed) for law in laws), 0.0)
    return at_place, dry, share


def potential(names: Sequence[str], values: Values, q: Any) -> Any:
    """Energy of the effort by position, a drive."""
    return sum((LAWS[name].potential(values, q) for name in names), 0.0)


def friction_values(names: Sequence[str], friction: Any) -> dict[str, Array]:
    """Parameters of laws by key, of a friction section."""
    return {key: np.asarray(getattr(friction, key), np.float64) for key in keys_of(names)}


def load_of(driving: Any, share: Any, way: Any) -> Any:
    """The load L of L + share |L| way = driving, where the share is less than one."""
    return driving / (1.0 + share * way * sign(driving))


def bounds(held: Any, dry: Any, share: Any) -> tuple[Any, Any]:
    """Least and greatest friction f that a joint can have: |f| <= dry + share |held - f|.

    :param held: effort of the drive less what depends on its position and its rate.
    """
    low, high = (held - load_of(held - way * dry, share, way) for way in (-1.0, 1.0))
    return low, high
