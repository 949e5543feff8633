# SPDX-License-Identifier: Apache-2.0
"""Messages, bytes, clocks and parameters that nobody would send, at the cores and at real nodes.

``python -m test.nodes.fuzz --seconds 60 --seed 1`` prints what was sent and what came of it.
"""

import argparse
import json
import math
import sys
import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from delta_dynamics.feedforward import Feedforward, Settings
from pkm_twin import load
from pkm_twin.bags.cdr import MessageCodec, message_definition
from pkm_twin.errors import MessageError
from pkm_twin.ros.intake import JointStateDecoder, RawTrajectory
from test.nodes.harness import SECOND, Maker, Plain, values_of

VALUES = (
    0.0, -0.0, 0.1, -0.7, 1.3, 1e3, -1e7, 1e18, 1e300, 5e-324, math.nan, math.inf, -math.inf,
)  # fmt: skip
JOINT_STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
WRENCH = "geometry_msgs/msg/WrenchStamped"
NOW = 1_000_000 * SECOND


@dataclass
class Source:
    """Random messages: mostly good ones with something wrong in them."""

    rng: np.random.Generator
    names: tuple[str, ...]
    make: Maker = field(default_factory=lambda: Maker(Plain()))

    def chance(self, part):
        return self.rng.random() < part

    def value(self):
        if self.chance(0.3):
            return VALUES[self.rng.integers(len(VALUES))]
        return float(self.rng.uniform(-1.0, 1.4))

    def values(self, count):
        count = int(self.rng.integers(0, 7)) if self.chance(0.1) else count
        return [self.value() if self.chance(0.1) else 0.2 for _ in range(count)]

    def joints(self):
        names = list(self.names)
        self.rng.shuffle(names)
        if self.chance(0.1):
            names[int(self.rng.integers(len(names)))] = str(self.rng.choice(["", "a", "ä" * 99]))
        if self.chance(0.1):
            names.append(str(self.rng.choice([*names, "gripper"])))
        return names

    def stamp(self, now):
        return int(now + self.rng.choice([0, 0, 0, 1, -SECOND, SECOND, 10**7, 10**8, -now]))

    def joint_state(self, now):
        names = self.joints()
        absent = [math.nan] * len(names)
        arrays = [
            absent if self.chance(0.05) else self.values(len(names) if self.chance(0.8) else 0)
            for _ in range(3)
        ]
        return self.make.joint_state(names, *arrays, stamp=self.stamp(now))

    def trajectory(self, now):
        names = self.joints()
        count = int(self.rng.integers(0, 8))
        times = np.cumsum(self.rng.integers(-1 if self.chance(0.1) else 1, SECOND, count))
        rows = [[self.values(len(names)) for _ in range(count)] for _ in range(3)]
        message = self.make.trajectory(names, times.tolist(), *rows, stamp=self.stamp(now))
        if count and self.chance(0.1):
            message.points[0].time_from_start.nanosec = int(self.rng.integers(0, 2**32))
        return message

    def wrench(self, now):
        frame = str(self.rng.choice(["platform", "platform", "", "base_link", "x" * 300]))
        return self.make.wrench((self.values(6) + [0.0] * 6)[:6], self.stamp(now), frame)

    def damaged(self, data):
        """Bytes with some of them changed, cut, or behind more."""
        raw = bytearray(data)
        for _ in range(int(self.rng.integers(0, 6))):
            raw[int(self.rng.integers(len(raw)))] = int(self.rng.integers(256))
        if self.chance(0.3):
            raw = raw[: int(self.rng.integers(len(raw) + 1))]
        return bytes(raw)


def fuzz_cores(seconds, seed):
    """Pure: every message is answered with finite efforts, or refused as a message."""
    robot = load("delta_cu")
    source = Source(np.random.default_rng(seed), robot.joint_names)
    decode = JointStateDecoder(message_definition(JOINT_STATE))
    state_codec = MessageCodec(JOINT_STATE, message_definition(JOINT_STATE))
    path_codec = MessageCodec(TRAJECTORY, message_definition(TRAJECTORY))
    core = Feedforward(robot, Settings(differentiate=True, window=4, recovery_count=1))
    counts = Counter()
    now = NOW
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        now += int(source.rng.integers(1, 5 * 10**6))
        kind = source.rng.random()
        try:
            if kind < 0.6:
                result = core.joint_state(source.joint_state(now), now)
                found = None if result is None else result.effort
            elif kind < 0.8:
                found = core.trajectory(source.trajectory(now), now)
            elif kind < 0.9:
                data = source.damaged(state_codec.encode(source.joint_state(now)))
                result = core.joint_state(decode(data), now)
                found = None if result is None else result.effort
            else:
                raw = RawTrajectory.of(source.damaged(path_codec.encode(source.trajectory(now))))
                found = core.trajectory(raw.fields, now)
                RawTrajectory.of(raw.with_effort(found))
        except MessageError as error:
            counts[error.reason] += 1
            continue
        counts["held back" if found is None else "answered"] += 1
        if found is not None and not np.isfinite(found).all():
            raise AssertionError(f"seed {seed}: efforts {found}")
    return counts


def fuzz_nodes(peer, launch, seconds, seed):
    """Real nodes: alive at the end, without an exception, and answering."""
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import WrenchStamped
    from rcl_interfaces.msg import Parameter, ParameterValue
    from rcl_interfaces.srv import SetParameters
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory

    rng = np.random.default_rng(seed)
    remap = ("-r", "joint_states:=/fuzz/states", "-r", "wrench:=/fuzz/wrench")
    nodes = {
        "feeding": launch(
            "delta_dynamics.node", "use_sim_time:=true", arguments=(*remap, "-r", "__node:=feeding")
        ),
        "watching": launch(
            "stiffness_monitor.node",
            "mechanism:=delta_cu",
            arguments=(*remap, "-r", "__node:=watching"),
        ),
    }
    kinds = {
        "/fuzz/states": (JointState, JOINT_STATE, "joint_state"),
        "/feeding/joint_trajectory": (JointTrajectory, TRAJECTORY, "trajectory"),
        "/fuzz/wrench": (WrenchStamped, WRENCH, "wrench"),
    }
    for topic, (kind, _, _) in kinds.items():
        peer.talk(kind, topic)
    peer.talk(Clock, "/clock")
    peer.hear(DiagnosticArray, "/diagnostics")
    peer.hear(JointState, "/feeding/joint_torques")
    peer.until(peer.matched, 90.0)
    clients = [peer.node.create_client(SetParameters, f"/{name}/set_parameters") for name in nodes]
    source = Source(rng, load("delta_cu").joint_names)
    codecs = {
        topic: MessageCodec(name, message_definition(name)) for topic, (_, name, _) in kinds.items()
    }
    counts = Counter()
    parameters = ("stale_after", "payload.mass", "gravity", "on_stop", "use_sim_time", "", "é")
    pending = []

    def set_something():
        value = ParameterValue(type=int(rng.choice([0, 1, 2, 3, 4, 7, 8, 9, 10, 99, 255])))
        value.double_value = source.value()
        value.double_array_value = source.values(3)
        value.string_value = str(rng.choice(["zeros", "", "ä" * 1000]))
        # The clock stays the simulation's: the end below needs it.
        name = str(rng.choice([p for p in parameters if p != "use_sim_time"]))
        request = SetParameters.Request(parameters=[Parameter(name=name, value=value)])
        pending.append(clients[int(rng.integers(2))].call_async(request))

    now = NOW
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        now += int(rng.integers(1, 3 * 10**6))
        kind = rng.random()
        if kind < 0.02:
            set_something()
            counts["parameters"] += 1
        elif kind < 0.1:
            clock = Clock()
            odd = rng.random() < 0.2
            clock.clock.sec = int(rng.integers(-(2**31), 2**31)) if odd else now // SECOND
            clock.clock.nanosec = int(rng.integers(0, 2**32)) if odd else now % SECOND
            peer.send("/clock", clock)
            counts["clocks"] += 1
        else:
            topic = list(kinds)[int(rng.integers(len(kinds)))]
            data = codecs[topic].encode(getattr(source, kinds[topic][2])(now))
            if rng.random() < 0.3:
                data = source.damaged(data)
            if len(data) >= 4:
                peer.send(topic, data)
                counts[topic] += 1
        peer.spin()
        for name, process in nodes.items():
            if not process.alive():
                raise AssertionError(f"seed {seed}: {name} died\n{process.output}")
    for name, process in nodes.items():
        values = values_of(peer.diagnostics(f"/{name}"))
        if values["exceptions"] != "0":
            raise AssertionError(f"seed {seed}: {name} raised\n{process.output}")
        counts[f"{name}: requests refused"] = int(values["requests refused"])
        counts[f"{name}: clock messages refused"] = int(values["clock messages refused"])
    counts["requests without an answer"] = sum(not future.done() for future in pending)
    return counts


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    counts = fuzz_cores(arguments.seconds, arguments.seed)
    json.dump(
        {"seed": arguments.seed, "messages": counts.total(), "of them": dict(counts.most_common())},
        sys.stdout, indent=2,
    )  # fmt: skip
    print()


if __name__ == "__main__":
    main()
