# SPDX-License-Identifier: Apache-2.0
"""The payload of a recording: as its bag or table tells it, or as it is asked for."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from pkm_twin.bags.reader import Bag
from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import BagError, ParameterError
from pkm_twin.files import parse_numbers
from pkm_twin.recordings.tables import PAYLOAD, Table
from pkm_twin.robot.plausibility import payload_findings
from pkm_twin.robot.robot import Robot

SOURCES = {"bag": "recording", "table": "table"}


@dataclass(frozen=True)
class Load:
    """A payload that is no part of the robot's file, and when it is on the platform.

    mass in kg, com in m from the platform's reference point; times in s since the first joint
    state, empty where it is there all the time. ``source``: ``bag``, ``table`` or ``option``.
    """

    mass: float
    com: tuple[float, float, float] | None = None
    times: tuple[tuple[float, float], ...] = ()
    source: str = "option"
    sought: bool = False
    """Whether it is fitted, and is the robot's own."""

    def held(self, time: Array) -> Mask:
        """When it is on the platform, shape (n,)."""
        if not self.times:
            return np.ones(len(time), np.bool_)
        spans = [(time >= begin) & (time <= end) for begin, end in self.times]
        return np.asarray(np.logical_or.reduce(spans), np.bool_)

    def near_change(self, time: Array, within: float) -> Mask:
        """Where a pick or release is less than ``within`` seconds away, shape (n,)."""
        edges = [edge for span in self.times for edge in span]
        if not edges:
            return np.zeros(len(time), np.bool_)
        near = [np.abs(time - edge) < within for edge in edges]
        return np.asarray(np.logical_or.reduce(near), np.bool_)

    def on(self, robot: Robot) -> Robot:
        """The robot with this payload.

        :raises ParameterError: the robot takes none, or not such a one; a mass that is many times
            that of all that moves.
        """
        changes: dict[str, Any] = {"mass": self.mass}
        if self.com is not None:
            changes["com"] = list(self.com)
        loaded = robot.changed(payload=changes)
        for finding in payload_findings(loaded):
            raise ParameterError(
                finding.field, finding.value, f"{finding.bound:.4g} kg or less: {finding.likely}"
            )
        return loaded

    def as_json(self) -> dict[str, Any]:
        """Plain data, units in the keys; no times where it is held all the time."""
        return {
            "mass_kg": self.mass,
            "com_m": None if self.com is None else list(self.com),
            "held_s": [list(span) for span in self.times] or None,
            "source": self.source,
        }

    def __str__(self) -> str:
        at = "" if self.com is None else " at " + ", ".join(f"{v:g}" for v in self.com) + " m"
        spans = ", ".join(f"{begin:g} to {end:g} s" for begin, end in self.times) or "throughout"
        told = "from --payload" if self.source == "option" else f"from the {SOURCES[self.source]}"
        return f"{self.mass:g} kg{at}, {spans}, {told}"


def payload_columns(carried: Load | None, time: Array) -> dict[str, Array]:
    """A table's columns of its payload; none without one."""
    if carried is None:
        return {}
    values = (carried.mass, *(carried.com or ()))
    held = carried.held(time)
    return {name: np.where(held, v, 0.0) for name, v in zip(PAYLOAD, values, strict=False)}


def load_of_table(table: Table, time: Array) -> Load | None:
    """The payload of a table's columns, None where there is none.

    :raises ParameterError: a negative mass, several payloads, or a part of a centre.
    """
    mass = table.get(PAYLOAD[0])
    if mass is None or not mass.any():
        return None
    held = mass > 0.0
    there = [name for name in PAYLOAD if name in table]
    values = table.stack(there)[held]
    if (mass < 0.0).any() or np.ptp(values, axis=0).any() or len(there) not in (1, 4):
        raise ParameterError(
            f"{table.path}: payload",
            f"columns {', '.join(there)}, {mass.min():g} to {mass.max():g} kg",
            f"one payload of 0 kg or more, in {PAYLOAD[0]} or in all of {', '.join(PAYLOAD)}",
        )
    edges = [0, *(np.flatnonzero(np.diff(held)) + 1).tolist(), len(held)]
    spans = [(float(time[b]), float(time[e - 1])) for b, e in pairwise(edges) if held[b]]
    row = values[0].tolist()
    com = (row[1], row[2], row[3]) if len(row) == 4 else None
    return Load(row[0], com, () if held.all() else tuple(spans), "table")


def load_facts(carried: Load | None, end: float) -> dict[str, Any]:
    """What a bag's metadata tell of its payload, that is there until after ``end``, s."""
    if carried is None:
        return {}
    picked, released = carried.times[0] if carried.times else (0.0, end + 1.0)
    facts = {
        "payload_mass_kg": carried.mass, "payload_picked_s": picked, "payload_released_s": released,
    }  # fmt: skip
    com = {} if carried.com is None else {"payload_com_m": " ".join(map(repr, carried.com))}
    return facts | com


def told_load(bag: Bag) -> Load | None:
    """The payload that the bag's metadata tell of.

    :raises BagError: a value is missing or no number.
    """
    facts = bag.report.metadata.get("pkm_twin", {})
    if "payload_picked_s" not in facts:
        return None
    names = ("payload_mass_kg", "payload_picked_s", "payload_released_s")
    mass, picked, released = (_fact(bag, facts, name) for name in names)
    if mass < 0:
        raise metadata_error(bag, names[0], facts[names[0]], "0 or more")
    if released < picked:
        raise metadata_error(bag, names[2], facts[names[2]], f"{names[1]}, {picked:g}, or later")
    com = None
    if "payload_com_m" in facts:
        try:
            com = parse_payload(",".join([repr(mass), *facts["payload_com_m"].split()]))[1]
        except ParameterError:
            raise metadata_error(bag, "payload_com_m", facts["payload_com_m"], "x y z") from None
    return Load(mass, com, ((picked, released),), "bag")


def _fact(bag: Bag, facts: Mapping[str, str], name: str) -> float:
    try:
        value = float(facts[name])
    except (KeyError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise metadata_error(bag, name, facts.get(name), "a finite number")
    return value


def metadata_error(bag: Bag, name: str, value: str | None, expected: str) -> BagError:
    """The refusal of a value of the bag's own metadata."""
    return BagError(
        f"metadata 'pkm_twin': {name} is {value!r}; expected {expected}",
        path=bag.report.path,
        reason="metadata",
    )


def parse_payload(text: str) -> tuple[float, tuple[float, float, float] | None]:
    """Mass (kg) and, where given, centre (m) of ``MASS[,x,y,z]``.

    :raises ParameterError: it is not 1 or 4 finite numbers, or the mass is negative.
    """
    numbers = parse_numbers(text)
    if len(numbers) not in (1, 4) or numbers[0] < 0:
        raise ParameterError("--payload", text, "MASS or MASS,x,y,z: kg, 0 or more, and m")
    return numbers[0], (numbers[1], numbers[2], numbers[3]) if len(numbers) == 4 else None


def parse_times(text: str) -> tuple[tuple[float, float], ...]:
    """Spans of ``FROM,TO[,FROM,TO...]``, s.

    :raises ParameterError: the numbers are not pairs, finite and rising.
    """
    numbers = parse_numbers(text)
    rising = all(one < other for one, other in pairwise(numbers))
    if not numbers or len(numbers) % 2 or not rising:
        raise ParameterError("--load-times", text, "FROM,TO[,FROM,TO...] in s, rising")
    return tuple(zip(numbers[::2], numbers[1::2], strict=True))


def by_load(
    robot: Robot, carried: Load | None, time: Array, longest: int
) -> Iterator[tuple[Robot, slice]]:
    """The robot as it is loaded, and the samples in a row (at most ``longest``) for which."""
    held = np.zeros(len(time), np.bool_) if carried is None else carried.held(time)
    loaded = robot if carried is None else carried.on(robot)
    edges = [0, *(np.flatnonzero(np.diff(held)) + 1).tolist(), len(time)]
    for begin, end in pairwise(edges):
        for start in range(begin, end, longest):
            stop = min(start + longest, end)
            yield (loaded if held[start] else robot), slice(start, stop)
