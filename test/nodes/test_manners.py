# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A node among others: life cycle, parameters, requests that cannot be, and drivers' messages."""

import math
import re
from types import SimpleNamespace

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from test.nodes.harness import (
    SECOND,
    counts_of,
    one_line_refusal,
    stamp_of,
    text_of,
    values_of,
)

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
)
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from std_srvs.srv import Trigger

from pkm_twin.ros.health import Health
from test.nodes.twin import (
    MAKE,
    MODULE,
    NAMES,
    ROBOT,
    STEP,
    WINDOW,
    Q,
    count_of,
    launched,
    state,
    trajectory,
)
from test.support.robots import partly_long

STRANGE = [10, 99, 255]
"""Types of parameter values that do not exist."""


@pytest.fixture(scope="module", params=partly_long(["single", "events"], "events"))
def twin(request, peer, launch):
    """A node that answers, by either executor."""
    options = ("stale_after:=30", f"executor:={request.param}")
    return launched(peer, launch, f"twin_{request.param}", *options).ready()


@pytest.fixture(scope="module")
def waiting(peer, launch):
    """A node that is not started by itself."""
    options = ("stale_after:=30.0", "autostart:=false")
    return launched(peer, launch, "waiting", *options, fresh=True)


def answered(twin):
    """Whether a stream is, from its first sample on."""
    stamps = twin.stream(WINDOW + 2)
    return twin.since(stamps)[-1]


def strange(kind):
    return ParameterMessage(name="stale_after", value=ParameterValue(type=kind))


DEAF = """
from pkm_twin.ros import node
from pkm_twin.ros.run import run
class Deaf(node.TwinNode):
    def __init__(self):
        super().__init__("deaf")
        self.declare("volume", 1.0, "that nothing hears", changeable=True)
        self.start()
raise SystemExit(run(Deaf))
"""


def test_no_node_starts_with_a_parameter_whose_change_nothing_follows(launch):
    """A set of it would be answered as taken."""
    line = one_line_refusal(launch(MODULE, code=DEAF))
    assert line == "cannot start: nothing follows a change of volume"


COMPILES = """
import time
from pathlib import Path
from pkm_twin.ros import node
from pkm_twin.ros.run import run
class Slow(node.TwinNode):
    def __init__(self):
        super().__init__("slow_start")
        while not Path({gate!r}).exists():
            time.sleep(0.01)
        self.start()
    def summary(self):
        return "started"
    def diagnose(self):
        return b"\\0", "running", {{}}
raise SystemExit(run(Slow))
"""


def test_a_node_that_compiles_says_so_until_it_answers(peer, launch, tmp_path):
    gate = tmp_path / "gate"
    peer.hear(DiagnosticArray, "/diagnostics")
    process = launch(MODULE, code=COMPILES.format(gate=str(gate)))
    status = peer.diagnostics("/slow_start", lambda array: True).status[0]
    assert (status.level, "compiling" in status.message) == (b"\1", True)
    assert "started" not in process.output
    gate.touch()
    peer.diagnostics("/slow_start", lambda a: a.status[0].message == "running")
    assert "compiling" in process.output


LATE = """
from functools import cached_property
import delta_dynamics.nodes.twin as node
from pkm_twin.codegen.code import Code
start, load = node.DeltaDynamics.start, Code.__dict__["_loaded"].func
def late(code):
    print("loaded late:", code.key, flush=True)
    return load(code)
def started(made, *arguments, **options):
    Code._loaded = cached_property(late)
    Code._loaded.__set_name__(Code, "_loaded")
    start(made, *arguments, **options)
node.DeltaDynamics.start = started
raise SystemExit(node.run(node.NODE))
"""


def test_a_node_compiles_nothing_once_it_is_active(peer, launch):
    options = ("acceleration:=differentiate", "stale_after:=30.0", "observe_wrench:=true")
    twin = launched(peer, launch, "slow", *options, code=LATE).ready()
    for velocity in ((), (0.0, 0.0, 0.0)):
        twin.since(twin.stream(WINDOW + 2, velocity=velocity, effort=(0.1, 0.2, 0.3)))
    assert "loaded late" not in twin.process.output


def test_the_graph_is_asked_once_however_many_are_there():
    """And of the others' only what concerns this node is compared."""
    asked, told = [], []
    fits, unfit = (QoSProfile(depth=1, reliability=ReliabilityPolicy[kind]) for kind in ("RELIABLE", "BEST_EFFORT"))

    def end(number, name, qos, kind="a/msg/A"):
        return TopicEndpointInfo(
            node_name=name,
            node_namespace="/",
            topic_type=kind,
            qos_profile=qos,
            endpoint_gid=[number],
        )

    speakers = [end(k, "other", fits) for k in range(200)]
    speakers += [end(200, "other", unfit), end(201, "other", unfit, "a/msg/B")]
    listeners = [end(k, "third", fits) for k in range(202, 255)] + [end(255, "own", fits)]

    def ask(topic, ends):
        asked.append(topic)
        return ends

    node = SimpleNamespace(
        get_name=lambda: "own",
        get_namespace=lambda: "/",
        get_publishers_info_by_topic=lambda topic: ask(topic, speakers),
        get_subscriptions_info_by_topic=lambda topic: ask(topic, listeners),
        get_logger=lambda: SimpleNamespace(warning=lambda text: None),
    )
    own = Health(node, lambda: 0)
    own.watch("~/x", told.append)
    # A publisher on the same topic takes nothing from the subscription.
    own.watch("~/x")
    for _ in range(2):
        own._find_incompatible_ends()
    # The graph's calls expand and remap a name: one that has been would be twice.
    assert asked == ["~/x"] * 4
    assert sorted(told) == [("QoS", "reliability"), ("message type", "a/msg/B for a/msg/A")]


class TestRequests:
    def test_a_parameter_of_no_type_is_refused_and_the_next_one_is_set(self, twin):
        good = Parameter("payload.mass", value=0.25).to_parameter_msg()
        for kind in STRANGE:
            answer = twin.call(SetParameters, "set_parameters", parameters=[strange(kind), good])
            assert [result.successful for result in answer.results] == [False, True]
            assert str(kind) in answer.results[0].reason
            assert not twin.set_to([strange(kind)]).successful
        assert twin.set(payload__mass=0.0).successful
        array = twin.diagnostics(lambda a: int(values_of(a)["requests rejected"]) >= 6)
        assert values_of(array)["exceptions"] == "0"
        answered(twin)

    def test_names_that_are_none_are_answered(self, twin):
        for names in ([""], ["no such"], ["x" * 10**5], ["\x00", "../.."]):
            assert not twin.get(*names)
            twin.call(DescribeParameters, "describe_parameters", names=names)
            twin.call(ListParameters, "list_parameters", prefixes=names)
            value = [Parameter(name or "a", value=1.0).to_parameter_msg() for name in names]
            answer = twin.call(SetParameters, "set_parameters", parameters=value)
            assert not any(result.successful for result in answer.results)
        answered(twin)

    def test_requests_of_masses_of_entries_are_refused_unread(self, twin):
        """Each entry of a set costs what a set does: a long one would hold up the stream."""
        entry = Parameter("payload.mass", value=0.5).to_parameter_msg()
        answer = twin.call(SetParameters, "set_parameters", parameters=[entry] * 2000)
        (result,) = answer.results
        assert not result.successful
        assert "parameters: 2000; expected at most" in result.reason
        answer = twin.call(SetParameters, "set_parameters", parameters=[entry] * 2)
        (result,) = answer.results
        assert result.reason == "ParameterError: payload.mass: 2; expected once in a request"
        assert not twin.set_to([entry] * 2000).successful
        names = ["payload.mass"] * 2000
        assert not twin.get(*names)
        assert not twin.call(GetParameterTypes, "get_parameter_types", names=names).types
        assert not twin.call(DescribeParameters, "describe_parameters", names=names).descriptors
        told = twin.call(ListParameters, "list_parameters", prefixes=["payload"] * 2000)
        assert not told.result.names
        (value,) = twin.get("payload.mass")
        assert value.double_value == 0.0
        answered(twin)

    def test_all_parameters_at_once_are_one_request(self, twin):
        """As ``ros2 param dump`` and ``load`` ask: a node takes back its own dump."""
        names = twin.call(ListParameters, "list_parameters").result.names
        values = twin.get(*names)
        assert len(values) == len(names) > 30
        given = [ParameterMessage(name=n, value=v) for n, v in zip(names, values, strict=True)]
        answer = twin.call(SetParameters, "set_parameters", parameters=given)
        assert len(answer.results) == len(names)
        assert [r.reason for r in answer.results if not r.successful] == []
        assert twin.set_to(given).successful
        assert not twin.set(mechanism="delta").successful
        answered(twin)

    def test_joints_of_others_are_answered_as_soon_as_the_parameter_says_so(self, twin):
        names = (*NAMES, "telescope")
        rows, zero = [(*Q, 0.5)], [(0.0,) * 4]
        message = MAKE.trajectory(names, [SECOND], rows, zero, zero, twin.begin())
        with twin.changed(extra_joints="zero"):
            (answer,) = twin.ask(message)
        effort = list(answer.points[0].effort)
        assert effort[3] == 0.0
        assert effort[:3] == pytest.approx(inverse_dynamics(ROBOT, Q, [0.0] * 3, [0.0] * 3))
        before = counts_of(twin.diagnostics(), "trajectories rejected").get("unknown joint", 0)
        message = MAKE.trajectory(names, [SECOND], rows, zero, zero, twin.begin())
        twin.peer.send(f"/{twin.name}/joint_trajectory", message)
        twin.diagnostics(lambda a: counts_of(a, "trajectories rejected").get("unknown joint", 0) > before)

    def test_a_transition_that_does_not_exist_is_refused(self, twin):
        for transition in (Transition(id=77), Transition(label="fly"), Transition(id=3)):
            answer = twin.call(ChangeState, "change_state", transition=transition)
            if transition.id != 3:
                assert not answer.success
        # The last one was a deactivation.
        activate = Transition(id=Transition.TRANSITION_ACTIVATE)
        state_now = twin.call(GetState, "get_state").current_state.label
        if state_now == "inactive":
            twin.call(ChangeState, "change_state", transition=activate)
        assert twin.call(GetState, "get_state").current_state.label == "active"
        answered(twin)

    def test_a_long_name_is_cut(self, twin):
        names = ("x" * 30_000, *NAMES[1:])
        twin.send_state(MAKE.joint_state(names, Q, stamp=twin.stamp()))
        array = twin.diagnostics(lambda a: "missing joint" in counts_of(a, "joint states rejected"))
        assert all(len(pair.value) < 1000 for pair in array.status[0].values)
        assert len(array.status[0].message) < 1000
        assert max(map(len, twin.process.output.splitlines())) < 2000
        answered(twin)


class TestTuning:
    def test_whole_numbers_are_taken_for_floats(self, twin):
        with twin.changed(stale_after=20, gravity=[0, 0, -9]):
            values = twin.get("stale_after", "gravity")
        assert values[0].double_value == 20.0
        assert list(values[1].double_array_value) == [0.0, 0.0, -9.0]

    def test_parameters_have_descriptions_units_and_ranges(self, twin):
        names = twin.call(ListParameters, "list_parameters").result.names
        names = [n for n in names if not n.startswith(("qos_overrides", "use_sim_time", "start_"))]
        described = twin.call(DescribeParameters, "describe_parameters", names=names).descriptors
        assert len(described) == len(names) > 20
        for descriptor in described:
            assert descriptor.description, descriptor.name
            number = descriptor.type in (2, 3)
            assert number == bool(descriptor.floating_point_range or descriptor.integer_range)
        by_name = {descriptor.name: descriptor for descriptor in described}
        assert by_name["stale_after"].description.endswith("; s")
        assert by_name["on_stop"].additional_constraints == "one of nothing, zeros, gravity"


class TestReset:
    def test_a_latched_stop_is_ended_by_a_request(self, twin):
        answered(twin)
        nothing = twin.call(Trigger, "reset")
        assert (nothing.success, nothing.message) == (True, "no stop was latched")
        twin.stream(5, position=(math.nan, 0.0, 0.0))
        twin.diagnostics(lambda a: a.status[0].level == b"\x02")
        message = twin.call(Trigger, "reset").message
        assert message.endswith(": not finite: position of arm_1 is nan")
        # Nothing is held back but for a window that fills anew after a silence.
        stamps = twin.stream(WINDOW + 2)
        assert [stamp_of(m) for m in twin.since(stamps)] in (stamps, stamps[WINDOW - 1 :])


SLOW = """
import time
from delta_dynamics import feedforward
from delta_dynamics.nodes import twin as node
solve = feedforward.inverse_dynamics
answered = 0
def slowly(robot, q, *rates, **more):
    global answered
    answered += q.ndim == 1
    if q.ndim > 1:
        time.sleep(0.05)
        print("answered", answered, flush=True)
    return solve(robot, q, *rates, **more)
feedforward.inverse_dynamics = slowly
raise SystemExit(node.run(node.NODE))
"""


@pytest.fixture(scope="module", params=["single", "events"])
def slow(request, peer, launch):
    """A node whose work on trajectories takes 50 ms a slice, by either executor."""
    options = ("stale_after:=30", f"executor:={request.param}")
    return launched(peer, launch, f"slow_{request.param}", *options, code=SLOW).ready()


def test_the_stream_is_answered_while_a_trajectory_is_worked_on(slow):
    """States are sent once those before are answered: the node answers between slices of work."""
    answered(slow)
    answers, torques = slow.received("joint_trajectory_ff"), slow.received("joint_torques")
    t = np.outer(np.arange(10_000) * 0.001, [3.0, -4.0, 5.0])
    rows = 0.2 + 0.3 * np.sin(t), 0.3 * np.cos(t) * [3.0, -4.0, 5.0], 0.0 * t
    message = MAKE.trajectory(NAMES, [i * STEP for i in range(len(t))], *rows)
    slow.peer.send(f"/{slow.name}/joint_trajectory", message)
    while not answers:
        sent = []
        slow.peer.until(
            lambda sent=sent: answers or any(stamp_of(m) in sent for m in torques[-1:]),
            repeat=lambda sent=sent: sent.extend(slow.stream(WINDOW + 2)),
            every=1.0,
        )
    # States that were answered before each of the last slices, of 40 in all.
    counts = [int(n) for n in re.findall(r"answered (\d+)", slow.process.output)][-38:]
    assert len(counts) == 38
    assert counts[-1] - counts[0] >= 3
    efforts = np.array([point.effort for point in answers[0].points])
    assert len(efforts) == len(t)
    assert np.abs(efforts - inverse_dynamics(ROBOT, *rows)).max() < 1e-9


def test_more_than_can_wait_is_refused_by_name(slow):
    def send():
        message = trajectory(stamp=slow.begin())
        slow.peer.send(f"/{slow.name}/joint_trajectory", message)

    def refused():
        told = slow.peer.told(f"/{slow.name}")
        return told and counts_of(told[-1], "trajectories rejected").get("busy", 0)

    slow.peer.until(refused, repeat=send, every=0.01)
    slow.ask_anew()


class TestLifeCycle:
    def change(self, twin, transition):
        assert twin.call(ChangeState, "change_state", transition=Transition(id=transition)).success

    def label(self, twin):
        return twin.call(GetState, "get_state").current_state.label

    def test_a_node_answers_only_while_it_is_active(self, waiting):
        torques = waiting.received("joint_torques")
        assert self.label(waiting) == "unconfigured"
        waiting.stream(WINDOW + 3)
        assert "inactive" in text_of(waiting.diagnostics())
        self.change(waiting, Transition.TRANSITION_CONFIGURE)
        assert self.label(waiting) == "inactive"
        waiting.stream(WINDOW + 3)
        self.change(waiting, Transition.TRANSITION_ACTIVATE)
        assert waiting.peer.until(lambda: self.label(waiting) == "active")
        assert torques == []
        stamps = waiting.stream(WINDOW + 3)
        assert waiting.since(stamps)
        self.change(waiting, Transition.TRANSITION_DEACTIVATE)
        torques.clear()
        waiting.stream(WINDOW + 3)
        assert "inactive" in text_of(waiting.diagnostics())
        assert torques == []
        self.change(waiting, Transition.TRANSITION_ACTIVATE)
        # From a stop: the window, then the recovery.
        stamps = waiting.stream(WINDOW + 3)
        assert [stamp_of(m) for m in waiting.since(stamps)] == stamps[WINDOW:]
        self.change(waiting, Transition.TRANSITION_DEACTIVATE)
        self.change(waiting, Transition.TRANSITION_CLEANUP)
        assert self.label(waiting) == "unconfigured"
        self.change(waiting, Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
        assert self.label(waiting) == "finalized"
        assert waiting.process.stop() == 0


@pytest.mark.long
def test_a_full_stream_of_states_leaves_nothing_behind(twin):
    """States come and go in thousands: what is counted is what was sent, as of a burst."""
    before, sent = count_of(twin.even()), 3000
    for _ in range(sent):
        twin.send_state(state(twin.stamp()))
        twin.peer.spin()
    twin.balance(before + sent)
