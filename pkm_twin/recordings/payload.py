# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The payload of a recording: from its bag, its table, or an option."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from pkm_twin.bags.reader import Bag
from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import BagError, ParameterError
from pkm_twin.files import parse_numbers
from pkm_twin.machine.sections import make_payload
from pkm_twin.recordings.tables import PAYLOAD, Table
from pkm_twin.robot.plausibility import check_payload_mass
from pkm_twin.robot.robot import Robot

SOURCE_NAMES = {"bag": "recording", "table": "table, as sampled", "path": "path's waypoints"}
"""How reports name the source of a payload, by :attr:`Load.source`."""


@dataclass(frozen=True)
class Load:
    """A payload that replaces the one in the robot file, and the time intervals in which it is on the platform.

    mass in kg, com (centre of mass) in m from the platform's reference point. ``times``: intervals
    in s since the first joint state; the begin belongs to the interval, the end does not and may be
    infinite; empty if the payload is always on the platform. ``source``: ``bag``, ``table``,
    ``path`` or ``option``. ``masses``: one for each interval, kg, if they differ; ``mass`` is then
    the greatest.
    """

    mass: float
    com: tuple[float, float, float] | None = None
    times: tuple[tuple[float, float], ...] = ()
    source: str = "option"
    sought: bool = False
    """True if the payload is to be fitted; the robot then keeps the payload of its file."""
    masses: tuple[float, ...] = ()

    @classmethod
    def from_intervals(
        cls, spans: Sequence[tuple[float, float, float]], source: str, com: tuple[float, float, float] | None = None
    ) -> Load:
        """Build the payload from intervals, each with its begin, end (s) and mass (kg)."""
        masses = tuple(mass for *_, mass in spans)
        alike = len(set(masses)) == 1
        times = tuple((begin, end) for begin, end, _ in spans)
        if alike and len(times) == 1 and times[0][0] <= 0.0 and times[0][1] == math.inf:
            times = ()
        return cls(max(masses), com, times, source, masses=() if alike else masses)

    @property
    def spans(self) -> list[tuple[float, float, float]]:
        """Intervals as :meth:`from_intervals` takes them."""
        times = self.times or ((0.0, math.inf),)
        masses = self.masses or (self.mass,) * len(times)
        return [(*span, mass) for span, mass in zip(times, masses, strict=True)]

    def mass_at(self, time: Array) -> Array:
        """Return the payload's mass at times (n,), kg; NaN where the payload of the robot file applies."""
        if not self.times:
            return np.full(len(time), self.mass)
        found = np.full(len(time), np.nan)
        for begin, end, mass in self.spans:
            found[(time >= begin) & (time < end)] = mass
        return found

    def is_on_platform(self, time: Array) -> Mask:
        """Return at which times the payload is on the platform, shape (n,)."""
        return np.isfinite(self.mass_at(time))

    def mass_farthest_from(self, robot_mass: float) -> float:
        """Return the payload mass that differs most from the mass in the robot file, kg."""
        return max(self.masses or (self.mass,), key=lambda mass: abs(mass - robot_mass))

    def near_change(self, time: Array, within: float) -> Mask:
        """Return whether a pick or release is less than ``within`` seconds away, shape (n,)."""
        edges = [edge for span in self.times for edge in span]
        if not edges:
            return np.zeros(len(time), np.bool_)
        near = [np.abs(time - edge) < within for edge in edges]
        return np.asarray(np.logical_or.reduce(near), np.bool_)

    def apply_to(self, robot: Robot, mass: float | None = None) -> Robot:
        """Return a copy of the robot that carries this payload.

        :param mass: one of ``masses``, by default the greatest.
        :raises ParameterError: the robot cannot carry this payload, or its mass is many times that
            of all moving parts.
        """
        loaded = robot.changed(payload=make_payload(self.mass if mass is None else mass, self.com))
        for finding in check_payload_mass(loaded):
            raise ParameterError(finding.field, finding.value, f"{finding.bound:.4g} kg or less: {finding.likely}")
        return loaded

    def as_json(self) -> dict[str, Any]:
        """Return the payload as JSON data with units in the keys; without times if it is always on the platform."""
        several = {"masses_kg": list(self.masses)} if self.masses else {}
        return several | {
            "mass_kg": self.mass,
            "com_m": None if self.com is None else list(self.com),
            "held_s": [list(span) for span in self.times] or None,
            "source": self.source,
        }

    def __str__(self) -> str:
        at = "" if self.com is None else " at " + ", ".join(f"{v:g}" for v in self.com) + " m"
        told = "from --payload" if self.source == "option" else f"from the {SOURCE_NAMES[self.source]}"
        words = [f"{b:g} s on" if e == math.inf else f"{b:g} to {e:g} s" for b, e in self.times]
        if self.masses:
            masses = zip(self.masses, words, strict=True)
            return f"{', '.join(f'{mass:g} kg {word}' for mass, word in masses)}{at}, {told}"
        return f"{self.mass:g} kg{at}, {', '.join(words) or 'throughout'}, {told}"


def make_payload_columns(robot: Robot, carried: Load | None, time: Array) -> dict[str, Array]:
    """Return a table's payload columns, which have the robot file's payload outside the intervals."""
    if carried is None:
        return {}
    own, mass = robot.payload, carried.mass_at(time)
    held = np.isfinite(mass)
    centre = () if carried.com is None else zip(carried.com, own.com.tolist(), strict=True)
    columns = (np.where(held, mass, own.mass), *(np.where(held, *pair) for pair in centre))
    return dict(zip(PAYLOAD, columns, strict=False))


def read_table_load(robot: Robot, table: Table, time: Array) -> Load | None:
    """Read the payload from a table's columns; None if it is the robot's own.

    :raises ParameterError: a mass is negative, the centre of mass varies, or one of its columns is missing.
    """
    mass = table.get(PAYLOAD[0])
    if mass is None:
        return None
    there = [name for name in PAYLOAD if name in table]
    centres, own = table.stack(there)[:, 1:], robot.payload
    same = (centres == own.com).all(1) if len(there) == len(PAYLOAD) else True
    held = np.asarray((mass != own.mass) | ((mass > 0.0) & np.logical_not(same)))
    centred = centres[held & (mass > 0.0)]
    if (mass < 0.0).any() or (centred != centred[:1]).any() or len(there) not in (1, 4):
        raise ParameterError(
            f"{table.path}: payload",
            f"columns {', '.join(there)}, {mass.min():g} to {mass.max():g} kg",
            f"masses of 0 kg or more in {PAYLOAD[0]}, and one centre, in all of {', '.join(PAYLOAD[1:])}, or none",
        )
    if not held.any():
        return None
    step = (np.diff(held) != 0) | (np.diff(mass) != 0.0)
    edges = [0, *(np.flatnonzero(step) + 1).tolist(), len(held)]
    ends = [*time[edges[1:-1]].tolist(), math.inf]
    spans = [(float(time[b]), end, float(mass[b])) for b, end in zip(edges[:-1], ends, strict=True) if held[b]]
    com = centred[0].tolist() if centred.size else None
    return Load.from_intervals(spans, "table", None if com is None else (com[0], com[1], com[2]))


MASS, PICKED, RELEASED, CENTRE = ("payload_mass_kg", "payload_picked_s", "payload_released_s", "payload_com_m")
"""Keys of the payload in a bag's metadata; the numbers of several intervals are separated by blanks."""


def read_load(bag: Bag) -> Load | None:
    """Read the payload from the bag's metadata.

    :raises BagError: a value is missing or no number.
    """
    facts = bag.report.metadata.get("pkm_twin", {})
    if PICKED not in facts:
        return None
    masses, picked, released = (_read_numbers(bag, facts, name) for name in (MASS, PICKED, RELEASED))
    if min(masses) < 0.0:
        raise make_metadata_error(bag, MASS, facts[MASS], "0 or more")
    before = -math.inf
    for begin, end in zip(picked, released, strict=False):
        if not before <= begin <= end:
            raise make_metadata_error(bag, RELEASED, facts[RELEASED], f"{PICKED}, {begin:g}, or later")
        before = end
    if not len(picked) == len(released) or len(masses) not in (1, len(picked)):
        raise make_metadata_error(bag, RELEASED, facts[RELEASED], f"a time for each of {PICKED}")
    com = None
    if CENTRE in facts:
        try:
            com = parse_payload(",".join(["0", *facts[CENTRE].split()]))[1]
        except ParameterError:
            raise make_metadata_error(bag, CENTRE, facts[CENTRE], "x y z") from None
    each = masses * len(picked) if len(masses) == 1 else masses
    return Load.from_intervals(list(zip(picked, released, each, strict=True)), "bag", com)


def _read_numbers(bag: Bag, facts: Mapping[str, str], name: str) -> list[float]:
    """Read the numbers of a value; only the last release may be infinite."""
    try:
        values = [float(word) for word in facts[name].split()]
    except (KeyError, ValueError):
        values = []
    if not values or not all(map(math.isfinite, values[: -1 if name == RELEASED else None])):
        raise make_metadata_error(bag, name, facts.get(name), "a finite number")
    if math.isnan(values[-1]) or values[-1] == -math.inf:
        raise make_metadata_error(bag, name, facts.get(name), "a finite number")
    return values


def make_metadata_error(bag: Bag, name: str, value: str | None, expected: str) -> BagError:
    """Return the error for a wrong value in the bag's own metadata."""
    return BagError(
        f"metadata 'pkm_twin': {name} is {value!r}; expected {expected}", path=bag.report.path, reason="metadata"
    )


def parse_payload(text: str) -> tuple[float, tuple[float, float, float] | None]:
    """Parse ``MASS[,x,y,z]``: mass, kg, and the centre, m, if given.

    :raises ParameterError: it is not 1 or 4 finite numbers, or the mass is negative.
    """
    numbers = parse_numbers(text)
    if len(numbers) not in (1, 4) or numbers[0] < 0:
        raise ParameterError("--payload", text, "MASS or MASS,x,y,z: kg, 0 or more, and m")
    return numbers[0], (numbers[1], numbers[2], numbers[3]) if len(numbers) == 4 else None


def parse_intervals(text: str) -> tuple[tuple[float, float], ...]:
    """Parse the intervals of ``FROM,TO[,FROM,TO...]``, s.

    :raises ParameterError: the numbers are not pairs, finite and rising.
    """
    numbers = parse_numbers(text)
    rising = all(one < other for one, other in pairwise(numbers))
    if not numbers or len(numbers) % 2 or not rising:
        raise ParameterError("--load-times", text, "FROM,TO[,FROM,TO...] in s, rising")
    return tuple(zip(numbers[::2], numbers[1::2], strict=True))


def split_by_load(robot: Robot, carried: Load | None, time: Array, longest: int) -> Iterator[tuple[Robot, slice]]:
    """Split samples where the payload changes; yield the robot with its payload and the slice of samples.

    While the payload is to be fitted, the robot has the payload of its file.

    :param longest: greatest number of samples of a slice.
    """
    carried = None if carried is None or carried.sought else carried
    mass = np.full(len(time), np.nan) if carried is None else carried.mass_at(time)
    own = -1.0
    mass = np.where(np.isfinite(mass), mass, own)
    loaded = {own: robot}
    if carried is not None:
        loaded |= {one: carried.apply_to(robot, one) for one in {*(carried.masses or (carried.mass,))}}
    edges = [0, *(np.flatnonzero(np.diff(mass)) + 1).tolist(), len(time)]
    for begin, end in pairwise(edges):
        for start in range(begin, end, longest):
            yield loaded[float(mass[start])], slice(start, min(start + longest, end))
