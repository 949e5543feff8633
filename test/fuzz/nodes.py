# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages, bytes, clocks and parameters that nobody would send, at real nodes over DDS."""

from __future__ import annotations

import math
import random
import time
from collections import Counter
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from pkm_twin import load
from pkm_twin.bags.cdr import MessageCodec
from pkm_twin.bags.definitions import message_definition
from test.fuzz.messages import JOINT_STATE, NOW, TRAJECTORY, VALUES, WRENCH, Source
from test.fuzz.rules import Rules
from test.nodes.harness import SECOND, stamp_of, values_of

NAMES = (
    "stale_after",
    "payload.mass",
    "payload.com",
    "gravity",
    "on_stop",
    "effort_limits",
    "",
    "é",
    "friction.viscous",
    "singularity_warn",
    "differentiator.window",
    "mechanism",
    "x" * 2**20,
)
EXPIRY = Duration(seconds=0.1)
QUICK = ("use_sim_time:=true", "differentiator.window:=4", "recovery_count:=1")
TYPES = (*range(11), 99, 128, 255)
"""Of a parameter's value; those from ten on are none."""


class Fuzzed:
    """A twin, a monitor and a gate of one robot, and everything that is sent to them."""

    def __init__(self, peer: Any, launch: Any, seed: int) -> None:
        self.peer, self.rng = peer, random.Random(seed)
        self.counts: Counter[str] = Counter()
        robot = load("delta_cu")
        self.source, self.rules = Source(self.rng, robot), Rules(robot)
        self.now = NOW
        self.pending: list[Any] = []
        self.sound: dict[int, bool] = {}
        self.torques: list[Any] = []
        self.commands: list[Any] = []
        remaps = (
            "joint_states:=/fuzz/states",
            "wrench:=/fuzz/wrench",
            "delta_dynamics/joint_torques:=/fuzz/torques",
        )
        words = [word for remap in remaps for word in ("-r", remap)]

        def node(module: str, name: str, *parameters: str) -> Any:
            return launch(module, *parameters, arguments=(*words, "-r", f"__node:={name}"))

        self.nodes = {
            "feeding": node("delta_dynamics.nodes.twin", "feeding", *QUICK),
            "watching": node("stiffness_monitor.node", "watching", "mechanism:=delta_cu"),
            "gating": node("delta_dynamics.nodes.gate", "gating", "use_sim_time:=true"),
        }
        kinds = {
            "/fuzz/states": (JointState, JOINT_STATE, self.source.joint_state),
            "/fuzz/torques": (JointState, JOINT_STATE, self.source.torques),
            "/feeding/joint_trajectory": (JointTrajectory, TRAJECTORY, self.source.trajectory),
            "/fuzz/wrench": (WrenchStamped, WRENCH, self.source.wrench),
        }
        self.kinds = {
            topic: (MessageCodec(name, message_definition(name)), draw) for topic, (_, name, draw) in kinds.items()
        }
        # The gate takes torques of publishers alone that promise a deadline.
        promised = QoSProfile(depth=10, lifespan=EXPIRY, deadline=EXPIRY)
        for topic, (kind, _, _) in kinds.items():
            peer.talk(kind, topic, promised if topic == "/fuzz/torques" else 10)
        peer.talk(Clock, "/clock")
        peer.hear(DiagnosticArray, "/diagnostics")
        peer.hear(JointState, "/feeding/joint_torques")
        peer.hear(Float64MultiArray, "/gating/commands")
        peer.until(peer.matched, 90.0)
        self.clients = [
            peer.node.create_client(kind, f"/{name}/{service}")
            for name in self.nodes
            for kind, service in (
                (SetParameters, "set_parameters"),
                (SetParametersAtomically, "set_parameters_atomically"),
            )
        ]

    def send_parameters(self) -> None:
        value = ParameterValue(type=self.rng.choice(TYPES))
        value.bool_value = self.rng.random() < 0.5
        value.integer_value = self.rng.choice((0, -1, 2**63 - 1, -(2**63)))
        value.double_value = self.rng.choice(VALUES)
        value.string_value = self.rng.choice(("zeros", "", "ä" * 1000))
        value.double_array_value = [self.rng.choice(VALUES) for _ in range(self.rng.randrange(5))]
        value.byte_array_value = [b"\xff"] * self.rng.randrange(3)
        names = self.rng.choices(NAMES, k=self.rng.choice((0, 1, 1, 1, 3)))
        client = self.rng.choice(self.clients)
        request = client.srv_type.Request()
        request.parameters = [Parameter(name=name, value=value) for name in names]
        if client.service_is_ready():
            self.pending.append(client.call_async(request))
            self.counts["requests"] += 1

    def send_clock(self) -> None:
        clock = Clock()
        odd = self.rng.random() < 0.1
        clock.clock.sec = self.rng.randrange(-(2**31), 0) if odd else self.now // SECOND
        clock.clock.nanosec = self.rng.randrange(2**32) if odd else self.now % SECOND
        self.peer.send("/clock", clock)
        self.counts["clocks"] += 1

    def send_message(self) -> None:
        topic = self.rng.choice(list(self.kinds))
        codec, draw = self.kinds[topic]
        message = draw(self.now)
        data = codec.encode(message)
        if self.rng.random() < 0.1:
            data = self.source.damaged(data)
        elif topic == "/fuzz/states":
            self.sound[stamp_of(message)] = self.rules.joint_state(message, self.now)
        if len(data) >= 4:
            self.peer.send(topic, data)
            self.counts[topic] += 1

    def turn(self) -> None:
        """One thing that is sent, and what came back."""
        self.now += self.rng.randrange(1, 2 * 10**6)
        kind = self.rng.random()
        if kind < 0.01:
            self.send_parameters()
        elif kind < 0.3:
            self.send_clock()
        else:
            self.send_message()
        self.peer.spin()
        self.pending = [future for future in self.pending if not future.done()]

    def judge(self) -> dict[str, int]:
        """All alive, no exception, nothing but torques of sound states; what the nodes counted.

        :raises AssertionError: one of these is not so.
        """
        refused = {"requests": 0, "clocks": 0}
        for name, process in self.nodes.items():
            assert process.alive(), f"{name} died\n{process.output}"
            values = values_of(self.peer.diagnostics(f"/{name}"))
            assert values["exceptions"] == "0", f"{name} raised\n{process.output}"
            refused["requests"] += int(values["requests rejected"])
            refused["clocks"] += int(values["clock messages rejected"])
        torques = self.peer.received("/feeding/joint_torques")
        for message in torques:
            assert all(map(math.isfinite, message.effort)), message
            # A state whose bytes were damaged may be sound too, and has no entry.
            assert self.sound.get(stamp_of(message), True), message
        for message in self.peer.received("/gating/commands"):
            assert np.isfinite(message.data).all(), message
        return refused | {"torques": len(torques)}


def fuzz_nodes(peer: Any, launch: Any, seconds: float, seed: int) -> dict[str, Any]:
    """Send for so long: what was sent and what came of it."""
    fuzzed = Fuzzed(peer, launch, seed)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        fuzzed.turn()
        for name, process in fuzzed.nodes.items():
            assert process.alive(), f"seed {seed}: {name} died\n{process.output}"
    found = fuzzed.judge()
    peer.until(lambda: sum(not future.done() for future in fuzzed.pending) <= 1)
    return {"seed": seed, "seconds": seconds, "sent": fuzzed.counts, **found}
