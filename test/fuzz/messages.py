# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages that nobody would send, at the nodes' pure cores, judged by rules written here anew.

What is answered must be a message without a fault, and its torque that of the model at the state
that the message tells; what has a fault must be refused.
"""

from __future__ import annotations

import json
import math
import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from delta_dynamics import inverse_dynamics
from delta_dynamics.feedforward import Feedforward, Settings
from delta_dynamics.gate import Gate, GateSettings
from pkm_twin.bags.cdr import MessageCodec
from pkm_twin.bags.definitions import message_definition
from pkm_twin.errors import MessageError
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.messages.fast_decoder import JointStateDecoder, RawTrajectory
from pkm_twin.robot.robot import Robot
from stiffness_monitor import monitor
from test.fuzz.rules import Rules
from test.fuzz.tally import Kind
from test.nodes.harness import SECOND, Maker, Plain
from test.support.robots import parameters_of, without

VALUES = (
    0.0,
    -0.0,
    0.1,
    -0.7,
    1.3,
    1e3,
    -1e7,
    1e18,
    1e300,
    5e-324,
    -1e-310,
    math.nan,
    math.inf,
    -math.inf,
)
JOINT_STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
WRENCH = "geometry_msgs/msg/WrenchStamped"
NOW = 1_000_000 * SECOND
ROBOTS = ("delta_cu", "prru", "upr_rpu", "stewart", "five_bar", "rps3", "linear_delta", "delta")
ELASTIC = ("upr_rpu",) * 15 + ("prru",)
"""A frame of beams costs a thousand times what the closed forms do."""
CLOSE = 1e-9
"""Relative to a machine's greatest torque here."""


@dataclass
class Source:
    """Messages of a slow motion about home; some of them with something wrong."""

    rng: random.Random
    robot: Robot
    faults: float = 0.3

    def __post_init__(self) -> None:
        self.make = Maker(Plain())
        self.names = self.robot.joint_names
        self.q = self.robot.inverse(self.robot.home())
        self.step = 1e-3 if self.robot.joint_units[0] == "m" else 1e-2

    def motion(self, now: int) -> tuple[list[float], list[float]]:
        t = (now - NOW) / SECOND
        rates = [1.0 + 0.3 * i for i in range(len(self.q))]
        q = [float(c) + self.step * math.sin(w * t) for c, w in zip(self.q, rates, strict=True)]
        return q, [self.step * w * math.cos(w * t) for w in rates]

    def chance(self, part: float) -> bool:
        return self.rng.random() < part

    def spoiled(self, values: list[float]) -> list[float]:
        """An array of another length, or with a value that is none."""
        how = self.rng.randrange(4)
        if how == 0:
            return [self.rng.uniform(-1.0, 1.4) for _ in range(self.rng.randrange(8))]
        if how == 1:
            return [math.nan] * len(values)
        values = list(values)
        if values:
            values[self.rng.randrange(len(values))] = self.rng.choice(VALUES)
        return values

    def joints(self, arrays: list[list[float]]) -> tuple[list[str], list[list[float]]]:
        """Names in any order, with what belongs to each; now and then wrong ones."""
        order = list(range(len(self.names)))
        if self.chance(0.5):
            self.rng.shuffle(order)
        names = [self.names[i] for i in order]
        arrays = [[a[i] for i in order] if len(a) == len(order) else a for a in arrays]
        if self.chance(0.1):
            names.append("gripper")
            arrays = [[*a, self.rng.choice(VALUES)] if a else a for a in arrays]
        if self.chance(self.faults / 6):
            strange = ("", "a", "ä" * 99, "x" * 100_000, "\0", *self.names)
            names[self.rng.randrange(len(names))] = self.rng.choice(strange)
        return names, arrays

    def stamp(self, now: int) -> int:
        if not self.chance(self.faults / 3):
            return now
        odd = (1, -1, -SECOND, SECOND, 10**7, 10**8, -(10**8), -now, 2**31 * SECOND - now - 1)
        return now + self.rng.choice(odd)

    def joint_state(self, now: int) -> Any:
        q, qd = self.motion(now)
        arrays = [q, qd if self.chance(0.9) else [], q if self.chance(0.2) else []]
        if self.chance(self.faults):
            which = self.rng.randrange(3)
            arrays[which] = self.spoiled(arrays[which])
        names, arrays = self.joints(arrays)
        return self.make.joint_state(names, *arrays, stamp=self.stamp(now))

    def torques(self, now: int) -> Any:
        effort = [self.rng.uniform(-1.0, 1.0) for _ in self.names]
        if self.chance(self.faults):
            effort = self.spoiled(effort)
        names, (effort,) = self.joints([effort])
        return self.make.joint_state(names, [], effort=effort, stamp=self.stamp(now))

    def trajectory(self, now: int) -> Any:
        count = self.rng.randrange(1, 8)
        times = np.cumsum([self.rng.randrange(1, SECOND) for _ in range(count)]).tolist()
        states = [self.motion(now + t) for t in times]
        rows = [[s[0] for s in states], [s[1] for s in states], [[0.0] * len(self.q)] * count]
        rows = [[list(row) for row in what] for what in rows]
        if self.chance(self.faults):
            what = self.rng.choice(rows)
            at = self.rng.randrange(count)
            what[at] = self.spoiled(what[at])
        names, _ = self.joints([])
        message = self.make.trajectory(names, times, *rows, stamp=self.stamp(now))
        if self.chance(self.faults / 3):
            start = self.rng.choice(message.points).time_from_start
            start.sec = self.rng.choice((-(2**31), -1, 0, 5, 2**31 - 1))
            start.nanosec = self.rng.choice((0, 1, SECOND - 1, SECOND, 2**32 - 1))
        return message

    def wrench(self, now: int) -> Any:
        frames = ("platform",) * 8 + ("", "base_link", "x" * 300, "platform\0", "Platform")
        load = [self.rng.uniform(-50.0, 50.0) for _ in range(6)]
        if self.chance(0.1):
            load = [0.0] * 6
        if self.chance(self.faults / 2):
            load[self.rng.randrange(6)] = self.rng.choice(VALUES)
        return self.make.wrench(load, self.stamp(now), self.rng.choice(frames))

    def damaged(self, data: bytes) -> bytes:
        """Bytes with some of them changed, cut, or behind more."""
        raw = bytearray(data)
        for _ in range(self.rng.randrange(6)):
            raw[self.rng.randrange(len(raw))] = self.rng.randrange(256)
        if self.chance(0.3):
            raw = raw[: self.rng.randrange(len(raw) + 1)]
        return bytes(raw)


class Messages(Kind):
    """Messages at the cores of all nodes; each seed another robot."""

    name = "messages at the nodes' cores"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.codecs = {n: MessageCodec(n, message_definition(n)) for n in (JOINT_STATE, TRAJECTORY)}
        self.decode = JointStateDecoder(message_definition(JOINT_STATE))
        # Whether a joint with dry friction is at rest hangs on the samples before it.
        self.robots = {n: robot_of_data(without(parameters_of(n), "friction"), n) for n in ROBOTS}
        self.turn = 0

    def begin(self, seed: int) -> None:
        rng = random.Random(f"messages {seed}")
        name, elastic = ROBOTS[self.turn % len(ROBOTS)], ELASTIC[self.turn % len(ELASTIC)]
        self.turn += 1
        self.robot, self.elastic = self.robots[name], self.robots[elastic]
        differentiate = rng.random() < 0.3
        window = rng.choice((4, 5, 25))
        self.feedforward = Feedforward(
            self.robot, Settings(differentiate=differentiate, window=window, recovery_count=1)
        )
        self.gate = Gate(self.robot, GateSettings(recovery_count=1))
        self.monitor = monitor.Monitor(self.elastic)
        self.rules, self.elastic_rules = Rules(self.robot), Rules(self.elastic)
        self.source, self.head = Source(rng, self.robot), Source(rng, self.elastic)
        self.now = NOW
        self.answers: list[tuple[Any, Any, Any, Any]] = []

    def draw(self, rng: random.Random) -> tuple[str, Any]:
        self.now += rng.randrange(1, 3 * 10**6)
        kind = rng.random()
        if kind < 0.5:
            return "joint_state", self.source.joint_state(self.now)
        if kind < 0.65:
            return "torques", self.source.torques(self.now)
        if kind < 0.72:
            return "trajectory", self.source.trajectory(self.now)
        if kind < 0.82:
            return "elastic_state", self.head.joint_state(self.now)
        if kind < 0.9:
            return "wrench", self.head.wrench(self.now)
        if kind < 0.96:
            data = self.codecs[JOINT_STATE].encode(self.source.joint_state(self.now))
            return "raw_state", self.source.damaged(data)
        data = self.codecs[TRAJECTORY].encode(self.source.trajectory(self.now))
        return "raw_trajectory", self.source.damaged(data)

    def check(self, example: tuple[str, Any]) -> str:
        what, message = example
        try:
            return "good" if getattr(self, what)(message) else "held back"
        except MessageError as error:
            assert len(str(error)) < 1000, len(str(error))
            return error.reason

    def joint_state(self, message: Any) -> bool:
        result = self.feedforward.joint_state(message, self.now)
        assert self.rules.joint_state(message, self.now), "answered with a fault"
        if result is None:
            return False
        q, qd, qdd = result.motion
        told = self.rules.named(message, message.position)
        assert told is not None and q.tolist() == list(told.values())
        self.answers.append((q, qd, qdd, result.effort))
        return True

    def torques(self, message: Any) -> bool:
        command = self.gate.torques(message, self.now, self.now)
        assert self.rules.torques(message, self.now), "forwarded with a fault"
        if command is None:
            return False
        told = self.rules.named(message, message.effort)
        assert told is not None and command.tolist() == list(told.values())
        return True

    def trajectory(self, message: Any) -> bool:
        differentiate = self.feedforward.settings.differentiate
        efforts = self.feedforward.trajectory(message, self.now)
        if differentiate:
            assert np.isfinite(efforts).all()
            return True
        assert self.rules.trajectory(message), "answered with a fault"
        order = [message.joint_names.index(joint) for joint in self.rules.names]
        rows = zip(message.points, efforts, strict=True)
        for point, effort in rows:
            arrays = (point.positions, point.velocities, point.accelerations)
            q, qd, qdd = (np.array(values)[order] for values in arrays)
            self.answers.append((q, qd, qdd, effort[order]))
        return True

    def elastic_state(self, message: Any) -> bool:
        self.monitor.joint_state(message, self.now)
        told = self.elastic_rules.named(message, message.position)
        assert told is not None and all(map(math.isfinite, told.values()))
        return True

    def wrench(self, message: Any) -> bool:
        answer = self.monitor.wrench(message, self.now)
        assert self.elastic_rules.wrench(message, self.now), "answered with a fault"
        matrix, energy = answer.compliance, answer.energy
        assert np.isfinite(matrix).all() and np.abs(matrix - matrix.T).max() <= 1e-9
        size = np.abs(energy.deflection).max() + 1e-12
        assert np.abs(energy.deflection - matrix @ answer.wrench).max() <= 1e-6 * size
        total = float(energy.total)
        assert math.isclose(total, 0.5 * answer.wrench @ energy.deflection, rel_tol=1e-6)
        factors = np.asarray(energy.factors)
        assert not total or math.isclose(float(factors.sum()), 1.0, rel_tol=1e-6)
        return True

    def raw_state(self, data: bytes) -> bool:
        return self.joint_state(self.decode(data))

    def raw_trajectory(self, data: bytes) -> bool:
        raw = RawTrajectory.decode(data)
        efforts = self.feedforward.trajectory(raw.fields, self.now)
        assert np.isfinite(efforts).all()
        again = RawTrajectory.decode(raw.with_effort(efforts))
        assert again.fields.names == raw.fields.names
        return True

    def end(self) -> None:
        """Torques of the whole seed at once, by another program than that of single samples."""
        if self.answers:
            q, qd, qdd, effort = (np.array(rows) for rows in zip(*self.answers, strict=True))
            exact = inverse_dynamics(self.robot, q, qd, qdd)
            scale = 1e-3 + np.abs(exact).max(axis=1, keepdims=True)
            assert np.isfinite(effort).all()
            worst = float((np.abs(effort - exact) / scale).max())
            assert worst <= CLOSE, (self.robot.name, worst)

    def corpus(self) -> Iterator[tuple[str, Any]]:
        """A file is a JSON object: the kind of a message, and its fields; ``null`` is NaN."""
        for name, content in super().corpus():
            self.begin(0)
            yield name, read_example(json.loads(content), self.source)


def read_example(told: dict[str, Any], source: Source) -> tuple[str, Any]:
    """A message of the corpus; ``hex`` are the bytes of one."""
    if "hex" in told:
        return told["kind"], bytes.fromhex(told["hex"])
    q = source.motion(NOW)[0]

    def numbers(values: Any) -> list[float]:
        return list(q) if values == "home" else [math.nan if v is None else float(v) for v in values]

    stamp = NOW + int(told.get("ahead", 0)) if "stamp" not in told else int(told["stamp"])
    names = told.get("names", list(source.names))
    names = [name * told.get("repeat", 1) for name in names]
    if told["kind"] == "wrench":
        frame = told.get("frame", "platform")
        return "wrench", source.make.wrench(numbers(told["wrench"]), stamp, frame)
    if told["kind"] == "trajectory":
        rows = [numbers(row) for row in told["positions"]]
        zero = [[0.0] * len(row) for row in rows]
        return "trajectory", source.make.trajectory(names, told["times"], rows, zero, zero, stamp)
    arrays = [numbers(told.get(key, ())) for key in ("position", "velocity", "effort")]
    return told["kind"], source.make.joint_state(names, *arrays, stamp=stamp)
