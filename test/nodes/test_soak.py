# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""All nodes at full rate for minutes, in all kinds of weather: nothing grows, nothing ends.

``SOAK_MINUTES`` sets how long; the first fifth is warm-up. Where ``SOAK_OUT`` names a folder, the
course and the distributions go there, as JSON and as a picture.
"""

import os
from collections import Counter
from pathlib import Path

import pytest

from test.nodes.harness import values_of

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped, WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from test.nodes.soak import STALE, Ages, Ears, Sender, Watched, Weather, write

SECONDS = 60.0 * float(os.environ.get("SOAK_MINUTES", "3"))
OUT = os.environ.get("SOAK_OUT", "")

pytestmark = [pytest.mark.long, pytest.mark.timeout(180 + 2 * SECONDS)]

GROWTH = 4 * 2**20
"""Bytes by which the memory's median may differ between the first and the last part."""


def start(launch):
    def node(module, name, *parameters):
        remaps = (
            ("__node", name),
            ("joint_states", f"/{name}/states"),
            ("wrench", f"/{name}/wrench"),
            ("delta_dynamics/joint_torques", "/feeding/joint_torques"),
        )
        flags = [word for old, new in remaps for word in ("-r", f"{old}:={new}")]
        return launch(module, *parameters, arguments=flags)

    return {
        "feeding": node("delta_dynamics.nodes.twin", "feeding", f"stale_after:={STALE}"),
        "watching": node("stiffness_monitor.node", "watching", "max_state_age:=1.0"),
        "looping": node("delta_dynamics.nodes.twin", "looping", "use_sim_time:=true"),
        "gating": node("delta_dynamics.nodes.gate", "gating", f"deadline:={STALE}"),
    }


def test_nodes_do_not_grow(peer, launch):
    nodes = start(launch)
    peer.talk(JointState, "/feeding/states")
    peer.talk(JointState, "/watching/states")
    peer.talk(WrenchStamped, "/watching/wrench")
    peer.talk(JointTrajectory, "/feeding/joint_trajectory")
    peer.hear(DiagnosticArray, "/diagnostics")
    ears, ages, counts = Ears(peer), Ages(), Counter()

    def count(topic):
        return lambda message, info: counts.update([topic])

    ears.hear(JointState, "/feeding/joint_torques", ages.torque)
    ears.hear(Float64MultiArray, "/gating/commands", ages.command)
    ears.hear(TransformStamped, "/watching/deflection", ages.deflection)
    ears.hear(JointState, "/looping/joint_torques", count("looping"))
    ears.hear(JointTrajectory, "/feeding/joint_trajectory_ff", count("trajectories"))
    peer.until(peer.matched, 90.0)
    weather, sender = Weather(peer, launch, nodes), Sender(peer)
    turns = 0

    def turn(now):
        nonlocal turns
        turns += 1
        ears.listen()
        weather.pass_by(now)
        if turns % 20 == 0:
            # Answers of services, and the diagnostics.
            peer.spin()

    sender.run(SECONDS / 5, turn)
    weather.calm()
    weather.due = dict.fromkeys(weather.due, 0.0)
    ages.clear()
    counts.clear()
    watched = {name: Watched(process) for name, process in nodes.items()}
    sender.run(SECONDS * 4 / 5, turn, lambda now: [w.look(now) for w in watched.values()])
    weather.calm()
    summary = {
        "minutes": SECONDS / 60,
        "nodes": {name: w.summary() for name, w in watched.items()},
        "happened": weather.happened,
        "joint states sent": sender.sent,
        "answers": counts,
        "ages, s": ages.summary(),
    }
    if OUT:
        write(Path(OUT), summary, watched, ages)
    for name, process in nodes.items():
        assert process.alive(), process.output
        array = peer.diagnostics(f"/{name}")
        assert values_of(array)["exceptions"] == "0", process.output
        for what, found in summary["nodes"][name].items():
            grown = found["last"] - found["first"]
            assert grown <= (GROWTH if "memory" in what else 0), (name, what, found)
    assert set(summary["ages, s"]) == set(ages.all)
    assert set(counts) == {"looping", "trajectories"}
