# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The origin of a file's efforts: robot, gravity, wrench and payload.

A table has them as columns, so that every program reads it: those that do not vary by sample are
constant. A bag has the robot, gravity and payload in its metadata.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from pkm_twin.bags.reader import Bag
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.files import parse_numbers
from pkm_twin.recordings.payload import CENTRE, MASS, PICKED, RELEASED, Load, metadata_error, payload_columns
from pkm_twin.recordings.tables import WRENCH, Table
from pkm_twin.robot.robot import Robot

COMPUTED_WITH: Final = "computed_with"
"""Key of the digest; the name of a table's column ends in the robot's name."""
MARK: Final = f"{COMPUTED_WITH}."
GRAVITY: Final = ("gravity.x", "gravity.y", "gravity.z")


@dataclass(frozen=True)
class Origin:
    """The robot that computed a file's efforts.

    ``digest``: of all numbers of the robot's file. ``gravity``: m/s2, base axes.
    """

    robot: str
    digest: int
    gravity: tuple[float, ...]

    @classmethod
    def of(cls, robot: Robot) -> Origin:
        """Return the origin of efforts that a robot computes."""
        numbers = json.dumps([robot.mechanism, robot.parameter_sections()], sort_keys=True)
        # A table's number, of 53 bits, holds six bytes exactly.
        digest = hashlib.sha256(numbers.encode()).digest()[:6]
        return cls(robot.name, int.from_bytes(digest), tuple(robot.gravity.tolist()))

    @classmethod
    def of_table(cls, table: Table) -> Origin | None:
        """Return the origin that a table's columns state; None where there are none.

        :raises ParameterError: rows of several robots, or a column that is missing.
        """
        names = [name for name in table if name.startswith(MARK)]
        if not names:
            return None
        values = table.stack([*names, *GRAVITY])
        if len(names) > 1 or (values != values[0]).any():
            raise ParameterError(f"{table.path}: {', '.join([*names, *GRAVITY])}", "several values", "one robot")
        digest, *gravity = values[0].tolist()
        return cls(names[0].removeprefix(MARK), int(digest), tuple(gravity))

    @classmethod
    def of_bag(cls, bag: Bag) -> Origin | None:
        """Return the origin that a bag's metadata states; None where it states none.

        :raises BagError: a value that is no number.
        """
        facts = bag.report.metadata.get("pkm_twin", {})
        digest = facts.get(COMPUTED_WITH)
        if digest is None:
            return None
        gravity = parse_numbers(facts.get("gravity", "").replace(" ", ","))
        if not digest.isdecimal():
            raise metadata_error(bag, COMPUTED_WITH, digest, "a whole number")
        if len(gravity) != len(GRAVITY):
            raise metadata_error(bag, "gravity", facts.get("gravity"), "x y z")
        return cls(facts.get("robot", ""), int(digest), tuple(gravity))

    def differs_from(self, robot: Robot) -> str:
        """Describe how the origin differs from a robot; empty if all numbers are equal."""
        own = Origin.of(robot)
        if self.digest == own.digest:
            return ""
        if self.gravity != own.gravity:
            theirs, ours = (", ".join(f"{v:g}" for v in one.gravity) for one in (self, own))
            return f"the file was computed with gravity {theirs}, {robot.name} has {ours} m/s2"
        return f"the file was computed with other numbers of the robot {self.robot}"


def states_origin(name: str) -> bool:
    """Return whether a table's column states the robot that computed it."""
    return name in GRAVITY or name.startswith(MARK)


def origin_columns(robot: Robot, load: Load | None, wrench: Array | None, time: Array) -> dict[str, Array]:
    """Return a table's columns of robot, gravity, wrench and payload, shape (samples,) each.

    :param wrench: shape (samples, 6); ``time``: (samples,), s.
    """
    own, one = Origin.of(robot), np.ones(len(time))
    columns = {} if wrench is None else dict(zip(WRENCH, wrench.T, strict=True))
    columns |= payload_columns(robot, load, time)
    columns |= {MARK + own.robot: own.digest * one}
    return columns | {name: v * one for name, v in zip(GRAVITY, own.gravity, strict=True)}


def origin_facts(robot: Robot, load: Load | None) -> dict[str, Any]:
    """Return a bag's metadata of robot, gravity and payload."""
    own = Origin.of(robot)
    facts = {"robot": own.robot, COMPUTED_WITH: own.digest, "gravity": " ".join(map(repr, own.gravity))}
    if load is not None:
        # Times have the resolution of the bag's stamps.
        *times, _ = zip(*load.spans, strict=True)
        stamped = [[round(1e9 * t) / 1e9 if math.isfinite(t) else t for t in row] for row in times]
        values = [*stamped, load.masses or [load.mass]]
        facts |= {key: " ".join(map(repr, v)) for key, v in zip((PICKED, RELEASED, MASS), values, strict=True)}
        facts |= {} if load.com is None else {CENTRE: " ".join(map(repr, load.com))}
    return facts
