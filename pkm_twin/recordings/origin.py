# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The model from which a file's efforts were computed: robot, gravity, wrench and payload.

A table states them in columns, which are constant if the value does not vary, so that any program
can read them. A bag has the robot, gravity and payload in its metadata.
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
from pkm_twin.recordings.payload import CENTRE, MASS, PICKED, RELEASED, Load, make_metadata_error, make_payload_columns
from pkm_twin.recordings.tables import WRENCH, Table
from pkm_twin.robot.robot import Robot

COMPUTED_WITH: Final = "computed_with"
"""Metadata key of the hash of the robot file from which efforts were computed; in a table, the
column's name is this key, a dot and the robot's name."""
MARK: Final = f"{COMPUTED_WITH}."
GRAVITY: Final = ("gravity.x", "gravity.y", "gravity.z")


@dataclass(frozen=True)
class EffortModel:
    """The robot model and gravity from which a file's efforts were computed.

    ``robot``: its name. ``digest``: hash of all numbers of the robot file. ``gravity``: m/s2, base axes.
    """

    robot: str
    digest: int
    gravity: tuple[float, ...]

    @classmethod
    def from_robot(cls, robot: Robot) -> EffortModel:
        """Return the model of efforts that are computed with a robot."""
        numbers = json.dumps([robot.mechanism, robot.parameter_sections()], sort_keys=True)
        # Six bytes fit exactly into the 53-bit mantissa of a number in a table.
        digest = hashlib.sha256(numbers.encode()).digest()[:6]
        return cls(robot.name, int.from_bytes(digest), tuple(robot.gravity.tolist()))

    @classmethod
    def from_table(cls, table: Table) -> EffortModel | None:
        """Return the model that a table's columns state; None if they state none.

        :raises ParameterError: rows state different robots, or a column is missing.
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
    def from_bag(cls, bag: Bag) -> EffortModel | None:
        """Return the model that a bag's metadata states; None if it states none.

        :raises BagError: a value is not a number.
        """
        facts = bag.report.metadata.get("pkm_twin", {})
        digest = facts.get(COMPUTED_WITH)
        if digest is None:
            return None
        gravity = parse_numbers(facts.get("gravity", "").replace(" ", ","))
        if not digest.isdecimal():
            raise make_metadata_error(bag, COMPUTED_WITH, digest, "a whole number")
        if len(gravity) != len(GRAVITY):
            raise make_metadata_error(bag, "gravity", facts.get("gravity"), "x y z")
        return cls(facts.get("robot", ""), int(digest), tuple(gravity))

    def differs_from(self, robot: Robot) -> str:
        """Describe how this model differs from a robot; empty if all numbers are equal."""
        own = EffortModel.from_robot(robot)
        if self.digest == own.digest:
            return ""
        if self.gravity != own.gravity:
            theirs, ours = (", ".join(f"{v:g}" for v in one.gravity) for one in (self, own))
            return f"the file was computed with gravity {theirs}, {robot.name} has {ours} m/s2"
        return f"the file was computed with other numbers of the robot {self.robot}"


def is_effort_model_column(name: str) -> bool:
    """Return whether a table's column states the robot or gravity from which efforts were computed."""
    return name in GRAVITY or name.startswith(MARK)


def make_effort_model_columns(robot: Robot, load: Load | None, wrench: Array | None, time: Array) -> dict[str, Array]:
    """Return a table's columns of robot, gravity, wrench and payload, shape (samples,) each.

    :param wrench: shape (samples, 6); ``time``: (samples,), s.
    """
    own, one = EffortModel.from_robot(robot), np.ones(len(time))
    columns = {} if wrench is None else dict(zip(WRENCH, wrench.T, strict=True))
    columns |= make_payload_columns(robot, load, time)
    columns |= {MARK + own.robot: own.digest * one}
    return columns | {name: v * one for name, v in zip(GRAVITY, own.gravity, strict=True)}


def make_effort_model_facts(robot: Robot, load: Load | None) -> dict[str, Any]:
    """Return a bag's metadata of robot, gravity and payload."""
    own = EffortModel.from_robot(robot)
    facts = {"robot": own.robot, COMPUTED_WITH: own.digest, "gravity": " ".join(map(repr, own.gravity))}
    if load is not None:
        # Times have the resolution of the bag's stamps.
        *times, _ = zip(*load.spans, strict=True)
        stamped = [[round(1e9 * t) / 1e9 if math.isfinite(t) else t for t in row] for row in times]
        values = [*stamped, load.masses or [load.mass]]
        facts |= {key: " ".join(map(repr, v)) for key, v in zip((PICKED, RELEASED, MASS), values, strict=True)}
        facts |= {} if load.com is None else {CENTRE: " ".join(map(repr, load.com))}
    return facts
