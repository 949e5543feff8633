# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The node command_gate over the real middleware, beside the node whose torques it forwards."""

import signal

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from test.nodes.harness import (
    Running,
    counts_of,
    stamp_of,
    text_of,
    values_of,
)

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from test.nodes.twin import MAKE, NAMES, ROBOT, Q, launched, state

GATE = "delta_dynamics.nodes.gate"
DEADLINE = 1.0
"""Longer than a loaded machine keeps a process waiting."""
SETTINGS = (f"deadline:={DEADLINE}", "recovery_count:=2")
ZEROS = [0.0, 0.0, 0.0]


class Gated(Running):
    """A running gate, its commands, and a source of torques of this process."""

    def __init__(self, peer, launch, name, *parameters):
        remaps = {"joint_states": "states", "delta_dynamics/joint_torques": "torques"}
        hear = {"commands": Float64MultiArray, "commands_stamped": JointState}
        super().__init__(peer, launch, GATE, name, *SETTINGS, *parameters, remaps=remaps, hear=hear, fresh=True)
        offered = QoSProfile(depth=10)
        offered.deadline = offered.lifespan = Duration(seconds=DEADLINE)
        self._torques = peer.node.create_publisher(JointState, f"/{name}/torques", offered)

    def start(self):
        self.process = self._start()

    @property
    def commands(self):
        return [list(m.data) for m in self.received("commands")]

    def torque(self, effort):
        stamp = self.stamp(1)
        self._torques.publish(MAKE.joint_state(NAMES, (), effort=list(effort), stamp=stamp))

    def until_last(self, command, repeat=None):
        """Wait until the newest command is this one."""
        self.peer.until(lambda: self.commands[-1:] == [list(command)], repeat=repeat)

    def change(self, transition):
        assert self.call(ChangeState, "change_state", transition=Transition(id=transition)).success


@pytest.fixture(scope="module")
def heard(peer):
    peer.hear(DiagnosticArray, "/diagnostics")
    return peer


@pytest.fixture(scope="module")
def gated(heard, launch):
    return Gated(heard, launch, "gate")


def test_zeros_come_before_the_first_torque(gated):
    gated.peer.until(lambda: len(gated.commands) >= 3)
    assert all(command == ZEROS for command in gated.commands)
    told = "closed: waiting: no torque yet"
    array = gated.diagnostics(lambda a: a.status[0].message == told)
    assert array.status[0].level == b"\x02"
    assert array.status[0].hardware_id == "delta_cu"


def test_torques_are_forwarded_and_silence_makes_them_zeros(gated):
    effort = (0.5, -0.25, 1.0)
    gated.until_last(effort, lambda: gated.torque(effort))
    gated.diagnostics(lambda a: values_of(a)["controllers"] == "1")
    told = gated.peer.received(f"/{gated.name}/commands_stamped")
    gated.peer.until(lambda: effort in [tuple(message.effort) for message in told])
    assert all(tuple(m.name) == tuple(NAMES) and stamp_of(m) > 0 for m in told)
    gated.until_last(ZEROS)
    array = gated.diagnostics(lambda a: values_of(a)["open"] == "False")
    assert counts_of(array, "closed")["stale torques"] >= 1


def test_a_bad_torque_closes_the_gate(gated):
    effort = (0.5, 0.5, 0.5)
    gated.until_last(effort, lambda: gated.torque(effort))
    gated.torque((np.nan, 0.0, 0.0))
    gated.until_last(ZEROS)
    array = gated.diagnostics(lambda a: "not finite" in counts_of(a, "closed"))
    assert counts_of(array, "torques rejected")["not finite"] == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_last_word_of_a_gate_that_is_ended_is_not_a_torque(gated, number):
    effort = (1.0, 2.0, 3.0)
    gated.until_last(effort, lambda: gated.torque(effort))
    # Torques go on, so that nothing but the end itself sends the zeros.
    gated.process.process.send_signal(number)
    gated.peer.until(lambda: not gated.process.alive(), repeat=lambda: gated.torque(effort))
    assert gated.process.wait() == 0, gated.process.output
    assert "Traceback" not in gated.process.output
    gated.until_last(ZEROS)
    gated.start()
    gated.until_last(effort, lambda: gated.torque(effort))


def test_a_new_gate_takes_back_what_a_killed_one_has_left(gated):
    effort = (1.0, 2.0, 3.0)
    gated.until_last(effort, lambda: gated.torque(effort))
    gated.process.process.kill()
    gated.process.process.wait()
    gated.peer.spin()
    assert gated.commands[-1] == list(effort)
    gated.start()
    gated.until_last(ZEROS)


def test_an_inactive_gate_has_said_zeros_and_is_silent(gated):
    effort = (1.0, 2.0, 3.0)
    gated.until_last(effort, lambda: gated.torque(effort))
    gated.change(Transition.TRANSITION_DEACTIVATE)
    gated.until_last(ZEROS)
    gated.peer.received("/gate/commands").clear()
    gated.torque(effort)
    assert "inactive" in text_of(gated.diagnostics())
    assert gated.commands == []
    gated.change(Transition.TRANSITION_ACTIVATE)
    gated.until_last(ZEROS)
    gated.until_last(effort, lambda: gated.torque(effort))


def test_a_killed_twin_leaves_zeros(heard, launch):
    """What the whole is for: kill -9 of the node whose torques move the machine."""
    twin = launched(heard, launch, "twin", f"stale_after:={DEADLINE}").ready()
    heard.hear(Float64MultiArray, "/guarded/commands")
    remap = ("-r", "__node:=guarded", "-r", "delta_dynamics/joint_torques:=/twin/joint_torques")
    launch(GATE, *SETTINGS, arguments=remap)
    torques, commands = twin.received("joint_torques"), heard.received("/guarded/commands")

    def moved():
        return commands and np.abs(commands[-1].data).max() > 0.1

    heard.until(moved, repeat=lambda: twin.send_state(state(twin.stamp())))
    # Every command is a torque that the twin has sent, bit for bit, whichever arrived here first.
    moving = {tuple(m.data) for m in commands} - {tuple(ZEROS)}
    heard.until(lambda: moving <= {tuple(m.effort) for m in torques})
    twin.process.process.kill()
    heard.until(lambda: list(commands[-1].data) == ZEROS)


def test_gravity_is_that_of_the_measured_state(heard, launch):
    gated = Gated(heard, launch, "bearing", "on_stop:=gravity")
    heard.talk(JointState, "/bearing/states")
    held = inverse_dynamics(ROBOT, Q, np.zeros(3), np.zeros(3))
    gated.until_last(held, lambda: heard.send("/bearing/states", state(heard.now())))
    # Without states there is no pose whose weight could be borne.
    gated.until_last(ZEROS)
    gated.process.stop()


def test_a_publisher_that_promises_no_deadline_is_told_of(heard, launch):
    gated = Gated(heard, launch, "demanding")
    heard.talk(JointState, "/demanding/torques")
    also = "another node on delta_dynamics/joint_torques has an incompatible QoS: deadline"
    named = "/peer offers torques with deadline none"
    gated.diagnostics(lambda a: also in values_of(a)["other problems"] and named in a.status[0].message)
    assert all(command == ZEROS for command in gated.commands)
    gated.process.stop()
