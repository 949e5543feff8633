# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Define the sections that all parameter files share, and fields that many of them have."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache as remembered
from typing import Any, Final, Protocol

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.operations import absolute
from pkm_twin.errors import ParameterError
from pkm_twin.machine import schema
from pkm_twin.machine.friction import BASIC, check_laws, list_friction_keys
from pkm_twin.machine.graph import MIN_LENGTH

MAX_LENGTH: Final = 100.0
"""Largest length of a machine, m."""
MAX_MASS: Final = 1e5
"""Largest mass, kg."""
MAX_PLACE: Final = 1e6
"""Largest coordinate of a point of a machine, m."""
MAX_LEAD: Final = 1.0
"""Largest lead of screws and belts, m per turn: larger numbers were meant in mm."""


def length(**options: Any) -> Any:
    """Make a field of a length, m, that may be a divisor."""
    return schema.number(low=MIN_LENGTH, high=MAX_LENGTH, unit="m", **options)


def place(**options: Any) -> Any:
    """Make a field of a point of the machine, m."""
    return schema.vector(3, low=-MAX_PLACE, high=MAX_PLACE, unit="m", **options)


def mass(**options: Any) -> Any:
    """Make a field of a mass of zero or more, kg."""
    return schema.number(low=0.0, high=MAX_MASS, unit="kg", **options)


def check_azimuths(azimuths: Array, path: str) -> None:
    """Reject limbs at equal azimuths, rad."""
    for i in range(len(azimuths)):
        check_angles(float(azimuths[i]), f"{path}[{i}]")
        apart = math.remainder(float(azimuths[i] - azimuths[i - 1]), 2 * math.pi)
        if abs(apart) < 1e-3:
            raise ParameterError(path, azimuths.tolist(), "limbs at least 0.001 rad apart")


def shared_middle(limits: Array | None) -> float | None:
    """Return the middle of the range common to the limits of all joints, shape (n, 2).

    None if there are no limits, no common range or infinite ends.
    """
    if limits is None:
        return None
    low, high = float(limits[:, 0].max()), float(limits[:, 1].min())
    return 0.5 * (low + high) if low <= high and math.isfinite(high - low) else None


@dataclass(frozen=True, eq=False)
class Payload:
    """A payload fixed to the platform: com from the reference point, inertia about the com."""

    mass: float = mass(default=0.0)
    com: Array = schema.vector(3, low=-MAX_LENGTH, high=MAX_LENGTH, unit="m", default=[0, 0, 0])
    inertia: Array = schema.inertia(positive=False, default=[0, 0, 0])

    def verify(self, path: str) -> None:
        """Check that the mass can have the inertia, within :data:`MAX_LENGTH` of its centre."""
        if not spread_margin(self.mass, self.inertia) >= 0.0:
            most = self.mass * MAX_LENGTH**2
            raise ParameterError(
                f"{path}.inertia",
                self.inertia.tolist(),
                f"0 for a payload of mass 0, or half the trace at most {most:g} kg m2: {self.mass:g} kg within "
                f"{MAX_LENGTH:g} m of its centre",
            )


def make_payload(mass: float, com: Any = None) -> dict[str, Any]:
    """Return the entries of a payload of another mass (kg) and centre (m); without mass it has no inertia."""
    entries: dict[str, Any] = {"mass": mass} if com is None else {"mass": mass, "com": list(com)}
    return entries if mass else entries | {"inertia": [0.0, 0.0, 0.0]}


def spread_margin(mass: Any, inertia: Any) -> Any:
    """Return how much of a payload's inertia is left to that of its mass at :data:`MAX_LENGTH`, kg m2.

    Half the trace is the integral of the squared distance from the centre over the mass.
    """
    return MAX_LENGTH**2 * mass - 0.5 * (inertia[0][0] + inertia[1][1] + inertia[2][2])


def payload_margins(mass: Any, com: Any, inertia: Any) -> list[Any]:
    """Return the margins of a payload's numbers to the bounds of :class:`Payload`; >= 0 if valid.

    :param com: shape (3,), m; ``inertia``: shape (3, 3), kg m2. Numbers or expressions.
    """
    return [
        mass,
        MAX_MASS - mass,
        *(MAX_LENGTH - absolute(value) for value in com),
        *schema.inertia_margins(inertia),
        spread_margin(mass, inertia),
    ]


def check_angles(angle: float, path: str) -> None:
    """Reject an angle that was probably meant in degrees."""
    if abs(angle) > 4 * math.pi:
        raise ParameterError(path, angle, f"an angle in rad; degrees? {angle:g} degrees are {math.radians(angle):.6g}")


@dataclass(frozen=True, eq=False)
class DriveSpec:
    """A drive: a rotor with a gear, a screw or a belt; reflected inertia becomes ``rotor_inertia``.

    ``inertia``: of the rotor, kg m2. ``ratio``: motor revolutions per revolution of the joint, of a
    gear; or ``lead``: m per revolution of the motor, of a screw or belt. ``efficiency``: of the
    gear or screw, for sizing motors; the dynamics do not use it. ``rated_torque``: of the motor,
    N m, for tables whose efforts are in per cent of it.
    """

    inertia: float = schema.number(low=0.0, unit="kg m2")
    ratio: float | None = schema.number(low=1e-6, high=1e6, unit="turns per turn", default=None)
    lead: float | None = schema.number(low=1e-6, high=1e6, unit="m per turn", default=None)
    efficiency: float = schema.number(above=0.0, high=1.0, default=1.0)
    rated_torque: float | None = schema.number(above=0.0, unit="N m", default=None)

    def verify(self, path: str) -> None:
        """Check that exactly one of ``ratio`` and ``lead`` is given."""
        if (self.ratio is None) == (self.lead is None):
            raise ParameterError(path, None, "either `ratio` (turns per turn) or `lead` (m per turn)")

    @property
    def turns(self) -> float:
        """Motor angle per joint motion, rad/rad or rad/m."""
        turns: Any = self.ratio if self.lead is None else 2 * math.pi / self.lead
        return turns  # type: ignore[no-any-return]

    def reflect_inertia(self, slides: bool, path: str) -> float:
        """Return the inertia reflected to the joint: kg m2 if rotary, kg if prismatic."""
        if slides != (self.lead is not None):
            what = "lead, m per turn" if slides else "ratio, turns per turn"
            raise ParameterError(path, None, f"{what}, for this type of joint")
        return self.inertia * self.turns**2


@dataclass(frozen=True, eq=False)
class Redundancy:
    """Settings of a machine with more actuated joints than degrees of freedom."""

    leads: tuple[str, ...] | None = schema.words(
        text="joints that determine the pose; default: the most independent", default=None
    )
    tolerance: float = schema.number(
        above=0.0,
        high=0.1,
        unit="rad",
        default=1e-3,
        text="how far other joints may be from where the leading ones put them; sliding joints: "
        "times the machine's size; rates: this in 10 ms",
    )
    preload: Array = schema.vector(
        0, unit="{effort}", default=[], text="one effort per joint: the efforts of a motion are those nearest to these"
    )


@remembered
def make_friction_schema(joints: int) -> Any:
    """Make the schema of friction at this number of actuated joints.

    Its fields are the parameters of all laws of :mod:`~pkm_twin.machine.friction`.
    """
    fields = friction_fields(schema.vector, joints, spread=True, default=[0.0] * joints)
    return _make_section("Friction", fields, joints, {"verify": check_laws})


def friction_fields(kind: Any, *size: int, **options: Any) -> list[tuple[str, Any, Any]]:
    """Return names, types and fields of friction; only the basic law's zeros are written out."""
    return [
        (key, Any, kind(*size, unit=one.unit, low=one.low, high=one.high, rare=key not in BASIC.parameters, **options))
        for key, one in list_friction_keys().items()
    ]


@remembered
def make_limits_schema(joints: int) -> Any:
    """Make the schema of limits for this number of joints: None if absent; one value sets all."""
    above: dict[str, Any] = {"above": 0.0, "high": math.inf, "spread": True, "default": None}
    entries = [
        ("position", Any, schema.interval(count=joints, unit="{joint}", default=None)),
        ("velocity", Any, schema.vector(joints, unit="{joint}/s", **above)),
        ("effort", Any, schema.vector(joints, unit="{effort}", **above)),
    ]
    return _make_section("Limits", entries, joints)


def _make_section(name: str, entries: list[tuple[str, Any, Any]], joints: int, more: Mapping[str, Any] = {}) -> Any:
    """Make a section's class for this number of joints; its instances can be pickled."""

    def reduce(self: Any) -> tuple[Any, ...]:
        return _rebuild_section, (name, joints, [getattr(self, entry[0]) for entry in entries])

    return dataclasses.make_dataclass(name, entries, frozen=True, eq=False, namespace={"__reduce__": reduce, **more})


def _rebuild_section(name: str, joints: int, values: list[Any]) -> Any:
    schema_of = make_friction_schema if name == "Friction" else make_limits_schema
    return schema_of(joints)(*values)


class JointLimits(Protocol):
    """The limits of the actuated joints, common to all mechanisms."""

    @property
    def position(self) -> Array | None:
        """Smallest and largest positions, shape (n, 2), rad or m."""

    @property
    def velocity(self) -> Array | None:
        """Largest velocities, shape (n,), rad/s or m/s."""

    @property
    def effort(self) -> Array | None:
        """Largest efforts, shape (n,), N m or N."""
