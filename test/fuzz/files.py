# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Parameter files, URDFs and tables that nobody would write: refused by the field, or sound."""

from __future__ import annotations

import copy
import functools
import math
import random
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from delta_dynamics import inverse_dynamics
from pkm_twin import load, robot_names
from pkm_twin.bags.reader import inspect
from pkm_twin.mechanisms.catalogue import config_folder, robot_of_data
from pkm_twin.paths.along import tabulate_torques
from pkm_twin.recordings import ReadOptions, read
from pkm_twin.robot.limits import beyond_limits
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.robot_urdf import robot_urdf
from test.bags.folders import make_folder
from test.fuzz.bags import small_bag
from test.fuzz.tally import Kind, damaged, refusal
from test.support.mapped import sides

MACHINES = Path(__file__).resolve().parents[1] / "machine" / "machines"
NUMBERS = (
    "0",
    "1",
    "-1",
    "0.1",
    "-0.2",
    "1e-300",
    "5e-324",
    "1e300",
    "1e400",
    "-1e18",
    "nan",
    "inf",
    "-inf",
    ".nan",
    ".inf",
    "1e",
    "",
    "x",
    "0x1F",
    "1_000",
    "1,5",
    "9" * 400,
    "é",
    "1 2",
)
SCALARS: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    1,
    -1,
    2**70,
    -(2**70),
    0.5,
    -0.5,
    1e-300,
    5e-324,
    1e300,
    math.nan,
    math.inf,
    -math.inf,
    "x",
    "",
    "base",
    "revolute",
    "spherical",
    "mcap",
    "zstd",
    "../x",
    [],
    {},
    [[1]],
    [0, 0, 0],
    [0, 0, 1e-300],
    [1, 2, 3],
    [math.nan] * 3,
    ["base", "base"],
    "é" * 100,
)


COMPILED = 25
"""Of new geometries one in so many is compiled: that takes a hundred times what loading does."""
KEPT = 8
"""Compiled geometries that are looked for again."""
DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


class Machines(Kind):
    """Files of machines: what loads has a finite answer at home, or a typed refusal."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.compiled: dict[str, Robot] = {}
        self.new = 0

    def stands(self, robot: Robot) -> None:
        home = robot.home()
        assert np.isfinite(home).all(), home
        if not self.chosen(robot):
            return
        q = robot.inverse(home)
        assert np.isfinite(q).all(), q
        zero = np.zeros(len(robot.joint_names))
        effort = inverse_dynamics(robot, q, zero, zero)
        assert np.isfinite(effort).all(), effort

    def chosen(self, robot: Robot) -> bool:
        """Whether it is computed with: all of a geometry that is compiled, and some new ones."""
        key = robot.graph.key
        if key not in self.compiled:
            self.new += 1
            if self.new % COMPILED:
                return False
            if len(self.compiled) >= KEPT:
                self.compiled.pop(next(iter(self.compiled)))
        # The newest stands last; its engine is kept with it.
        self.compiled[key] = self.compiled.pop(key, robot)
        return True


def changed(rng: random.Random, data: Any) -> None:
    """Change a value somewhere in a mapping, drop it, or put another key there."""
    at = data
    while True:
        key = rng.choice(list(at)) if at else "x"
        if isinstance(at.get(key), dict) and at[key] and rng.random() < 0.85:
            at = at[key]
            continue
        break
    kind = rng.random()
    value = at.get(key)
    if kind < 0.2:
        at.pop(key, None)
    elif kind < 0.3:
        at[rng.choice(("x", "", "masss", 3, "é", key))] = copy.deepcopy(rng.choice(SCALARS))
    elif kind < 0.6 and isinstance(value, list) and value:
        value[rng.randrange(len(value))] = copy.deepcopy(rng.choice(SCALARS))
    elif kind < 0.75 and isinstance(value, int | float):
        at[key] = value * rng.choice((0, -1, 1e-12, 1e12, 0.5, 2))
    else:
        at[key] = copy.deepcopy(rng.choice(SCALARS))


class Yaml(Machines):
    """Parameter files of every mechanism with changes: refused by the field, or finite at home."""

    name = "robots in YAML"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        shipped = [config_folder() / f"{name}.yaml" for name in robot_names()]
        # Machines of a graph are quick to load and have the longest list of keys.
        self.shipped = len(shipped)
        self.sources = [p.read_text() for p in (*shipped, *MACHINES.glob("*.yaml"))]
        self.data = [yaml.safe_load(source) for source in self.sources]

    def draw(self, rng: random.Random) -> bytes | dict[str, Any]:
        """A file; most of those that are sound YAML as what a reader makes of them."""
        number = self.shipped if rng.random() < 0.9 else 0
        number = rng.randrange(number, len(self.sources)) if number else rng.randrange(self.shipped)
        if rng.randrange(8) == 0:
            return damaged(rng, self.sources[number].encode())
        data: dict[str, Any] = copy.deepcopy(self.data[number])
        for _ in range(rng.randint(1, 2)):
            changed(rng, data)
        if rng.randrange(8):
            return data
        text: bytes = yaml.dump(data, Dumper=DUMPER, allow_unicode=False).encode()
        return text

    def check(self, example: bytes | dict[str, Any]) -> str:
        if isinstance(example, dict):
            return refusal(lambda: self.stands(robot_of_data(example, "robot")))
        path = self.folder / "robot.yaml"
        path.write_bytes(example)
        return refusal(lambda: self.stands(load(path)))


class Metadata(Kind):
    """rosbag2's metadata.yaml with changes."""

    name = "metadata of rosbag2"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.rosbag = make_folder(folder / "rec", small_bag(folder / "for_folder.mcap"), splits=2)
        self.metadata = (self.rosbag / "metadata.yaml").read_text()
        self.data = yaml.safe_load(self.metadata)

    def draw(self, rng: random.Random) -> bytes:
        if rng.randrange(3) == 0:
            return damaged(rng, self.metadata.encode())
        data = copy.deepcopy(self.data)
        for _ in range(rng.randint(1, 2)):
            changed(rng, data)
        text: bytes = yaml.dump(data, Dumper=DUMPER).encode()
        return text

    def check(self, example: bytes) -> str:
        (self.rosbag / "metadata.yaml").write_bytes(example)
        return refusal(lambda: inspect(self.rosbag))


class Urdf(Machines):
    """URDFs with loops, their text or one of their numbers changed."""

    name = "robots in URDF"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        small = [
            (MACHINES.parent / "five_bar.urdf").read_text(),
            robot_urdf(load("five_bar")),
            robot_urdf(sides("five_bar").mapped),
            robot_urdf(load(MACHINES / "four_bar.yaml")),
        ]
        self.sources = [*3 * small, robot_urdf(load("linear_delta"))]

    def draw(self, rng: random.Random) -> bytes:
        source = rng.choice(self.sources)
        how = rng.random()
        if how < 0.3:
            return damaged(rng, source.encode())
        if how < 0.5:
            lines = source.splitlines()
            for _ in range(rng.randint(1, 3)):
                at = rng.randrange(len(lines))
                lines[at : at + rng.randint(0, 2)] = [rng.choice(lines)] * rng.randint(0, 2)
            return "\n".join(lines).encode()
        places = list(re.finditer(r'"([^"]*)"', source))
        place = rng.choice(places)
        others = [m.group(1) for m in rng.choices(places, k=2)]
        new = rng.choice((*NUMBERS, *others, *others, *others, "0 0 0", "nan 0 0", "1e-300 0 0"))
        return (source[: place.start(1)] + new + source[place.end(1) :]).encode()

    def check(self, example: bytes) -> str:
        path = self.folder / "robot.urdf"
        path.write_bytes(example)
        return refusal(lambda: self.stands(load(path)))


class Csv(Kind):
    """Motions in CSV: refused by line and column, or a row of finite torques for each."""

    name = "motions in CSV"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.robots = ("delta", "prru", "five_bar")
        self.rows = {}
        for name in self.robots:
            robot = load(name)
            q = robot.inverse(robot.home())
            self.rows[name] = (robot.joint_names, q)
        # The file is what is tried here, not the robot's own.
        self.load = functools.cache(load)

    def draw(self, rng: random.Random) -> tuple[str, bytes]:
        name = rng.choice(self.robots)
        joints, home = self.rows[name]
        columns = ["time", *(f"{j}.position" for j in joints)]
        more = [*(f"{j}.{w}" for j in joints for w in ("velocity", "acceleration")), "fx", "mz"]
        columns += rng.sample(more, rng.choice((0, 0, 0, 1, 2)))
        if rng.random() < 0.15:
            columns[rng.randrange(len(columns))] = rng.choice((*columns, "x", "", "arm_1.velocty"))
        rows = []
        for index in range(rng.randint(0, 12)):
            values = {"time": 0.01 * index}
            for joint, value in zip(joints, home, strict=True):
                values[f"{joint}.position"] = float(value) + 1e-4 * index
            row = [repr(values.get(column, 0.0)) for column in columns]
            if rng.random() < 0.06:
                row[rng.randrange(len(row))] = rng.choice(NUMBERS)
            if rng.random() < 0.02:
                row = row[: rng.randrange(len(row) + 1)]
            rows.append(",".join(row))
        end = rng.choice(("\n", "\n", "\n", "\r\n", "\r"))
        content = end.join([",".join(columns), *rows]).encode(errors="replace")
        return name, damaged(rng, content) if rng.random() < 0.2 else content

    def check(self, example: tuple[str, bytes]) -> str:
        name, content = example
        path = self.folder / "motion.csv"
        path.write_bytes(content)

        def compute() -> None:
            motion = read(path, self.load(name), ReadOptions(planned=True)).with_rates()
            beyond_limits(motion.robot, motion.q, motion.qd)
            columns = tabulate_torques(motion)
            assert {len(values) for values in columns.values()} == {len(motion.time)}
            # What rigid bodies leave open of a reaction is not a number in the table.
            for column in (f"{joint}.effort" for joint in motion.robot.joint_names):
                assert np.isfinite(columns[column]).all(), column

        return refusal(compute)

    def corpus(self) -> Iterator[tuple[str, Any]]:
        for name, content in super().corpus():
            yield name, ("delta", content)
