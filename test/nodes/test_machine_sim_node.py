# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The running machine_sim: its topics are the core's numbers, and what it refuses."""

import numpy as np
import pytest

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from delta_dynamics import inverse_dynamics
from delta_dynamics.nodes.simulation import CHECK_PERIOD
from delta_dynamics.simulation.machine import MachineSettings, Simulation, WrenchSignal, tune_position_control
from pkm_twin.robot.variation import vary_robot
from test.nodes.harness import SECOND, counts_of, stamp_of
from test.support.robots import load

MODULE = "delta_dynamics.nodes.simulation"
ROBOT = load("delta_cu")
HOME = ROBOT.inverse(ROBOT.home())
KINDS = ("masses", "inertias")
SPREAD = (
    "spread:=0.02",
    "spread_kinds:=[masses, inertias]",
    "seed:=7",
    "distribution:=uniform",
)
COMMANDS = "/machine_sim/commands"


@pytest.fixture(scope="module")
def machine(peer, launch):
    """A machine in lockstep: one period with every command."""
    for kind, topic in (
        (JointState, "/joint_states"),
        (WrenchStamped, "/wrench"),
        (Clock, "/clock"),
        (DiagnosticArray, "/diagnostics"),
    ):
        peer.hear(kind, topic)
    peer.talk(Float64MultiArray, COMMANDS)
    wrench = "wrench.constant:=[1.0, 0.0, -2.0, 0.0, 0.0, 0.0]"
    resolution = "encoder_resolution:=[1.0e-5]"
    process = launch(MODULE, "clock:=lockstep", wrench, resolution, "deadline:=10.0", *SPREAD)
    peer.until(lambda: peer.received("/joint_states") and peer.matched())
    # It may find a publisher later than that finds it: greeted with what it refuses.
    told = peer.received("/diagnostics")
    peer.until(
        lambda: told and refused(told[-1]).get("length"),
        repeat=lambda: peer.send(COMMANDS, Float64MultiArray(data=[0.0])),
    )
    return process


def refused(array):
    return counts_of(array, "effort commands rejected")


def answer(peer, data):
    """Command, and the joint state that follows it; a period gone alone may lie between."""
    states = peer.received("/joint_states")
    last = stamp_of(states[-1]) if states else 0
    peer.send(COMMANDS, Float64MultiArray(data=data))

    def answered():
        return stamp_of(states[-1]) > last and list(states[-1].effort) == data

    peer.until(answered)
    return states[-1]


def test_lockstep_gives_the_core_s_numbers(peer, machine):
    robot = vary_robot(ROBOT, dict.fromkeys(KINDS, 0.02), 7, "uniform").robot
    core = Simulation(
        robot,
        MachineSettings(
            HOME,
            robot.limits.effort,
            *tune_position_control(robot, 10.0),
            resolution=np.full(3, 1e-5),
            deadline=10.0,
            wrench=WrenchSignal(np.array([1.0, 0.0, -2.0, 0.0, 0.0, 0.0])),
        ),
        stamp_of(peer.received("/joint_states")[-1]),
    )
    weight = inverse_dynamics(ROBOT, HOME, np.zeros(3), np.zeros(3))
    effort = weight + np.array([0.3, -0.2, 0.1])
    for k in range(50):
        state = answer(peer, effort.tolist())
        core.commands(Float64MultiArray(data=effort.tolist()))
        core.advance()
        want = core.read_sensors()
        if k == 0:
            # Braked, its clock went on alone.
            ahead = stamp_of(state) - want.stamp
        assert stamp_of(state) - want.stamp == ahead
        assert list(state.name) == list(ROBOT.joint_names)
        assert np.abs(np.array(state.position) - want.q).max() < 1e-12
        assert np.abs(np.array(state.velocity) - want.qd).max() < 1e-9
        assert (np.array(state.effort) == effort).all()
    peer.until(lambda: stamp_of(peer.received("/wrench")[-1]) >= stamp_of(state))
    force = peer.received("/wrench")[-1]
    assert force.header.frame_id == "platform"
    assert (force.wrench.force.x, force.wrench.force.z) == (1.0, -2.0)
    clocks = [c.clock.sec * SECOND + c.clock.nanosec for c in peer.received("/clock")]
    assert clocks == sorted(clocks) and stamp_of(state) - clocks[-1] <= 5_000_000


def test_a_bad_command_is_refused_and_time_stands(peer, machine):
    # Commands come in order: this one's answer says that all greetings are counted.
    answer(peer, [0.0, 0.0, 0.0])
    greeted = refused(peer.diagnostics("/machine_sim"))["length"]
    before, begun = stamp_of(answer(peer, [0.0, 0.0, 0.0])), peer.now()
    for bad in ([float("nan"), 0.0, 0.0], [0.0, 0.0]):
        peer.send(COMMANDS, Float64MultiArray(data=bad))
    array = peer.diagnostics("/machine_sim", lambda a: refused(a).get("length", 0) > greeted)
    assert refused(array) == {"not finite": 1, "length": greeted + 1}
    # It goes alone, a period of 1 ms in each time between two looks, and no other way.
    looks = (peer.now() - begun) / (CHECK_PERIOD * SECOND)
    assert stamp_of(peer.received("/joint_states")[-1]) - before <= 1_000_000 * (looks + 2)


def test_the_clock_of_others_is_refused_while_it_runs_too(peer, machine):
    request = SetParameters.Request()
    request.parameters = [Parameter("use_sim_time", value=True).to_parameter_msg()]
    (result,) = peer.call(SetParameters, "/machine_sim/set_parameters", request).results
    assert not result.successful
    assert result.reason.startswith("use_sim_time: True; expected false")


def test_what_is_refused_is_counted(peer, machine):
    """Wrenches of a wrong frame, and bytes that are no trajectory."""
    push, way = "/machine_sim/applied_wrench", "/machine_sim/joint_trajectory"
    peer.talk(WrenchStamped, push)
    peer.talk(JointTrajectory, way)

    def send():
        peer.send(push, WrenchStamped())
        peer.send(way, bytes([0, 7, 0, 0, *range(40)]))

    def counted(array):
        wrenches = counts_of(array, "applied wrenches rejected")
        return wrenches.get("frame") and counts_of(array, "trajectories rejected").get("cdr")

    told = peer.received("/diagnostics")
    peer.until(lambda: any(map(counted, told)), repeat=send)


def test_who_comes_late_gets_what_was_drawn(peer, machine):
    received = []
    kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    peer.node.create_subscription(DiagnosticArray, "/machine_sim/drawn", received.append, kept)
    peer.until(lambda: received)
    drawn = vary_robot(ROBOT, dict.fromkeys(KINDS, 0.02), 7, "uniform").drawn
    (status,) = received[0].status
    assert {pair.key: float(pair.value) for pair in status.values} == drawn
    assert all(f"drawn: {name} " in machine.output for name in drawn)


def test_it_ends_on_a_signal(peer, machine):
    assert machine.stop() == 0
    assert "Traceback" not in machine.output
