# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""How goals of ~/follow_joint_trajectory end where the controller does not end them."""

import importlib
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from pkm_twin.errors import MessageError
from test.nodes.harness import SECOND, Maker, Plain

pytest.importorskip("rclpy", exc_type=ImportError)

from delta_dynamics.feedforward import Feedforward, Settings
from test.support.robots import load

UNKNOWN, SUCCEEDED, CANCELED, ABORTED = 0, 4, 5, 6
POINTS = 600
NOW = 1000 * SECOND


def told_of(names, positions, age=0.0):
    """The controller's feedback, measured so long ago, s."""
    return SimpleNamespace(
        header=Maker(Plain()).header(NOW - round(age * SECOND)),
        joint_names=names,
        actual=SimpleNamespace(positions=positions),
    )


class Result(SimpleNamespace):
    """Of the action, which the machine that tests may not have."""

    INVALID_GOAL, TOLERANCE = -1, -4
    error_code, error_string = 0, ""


class Later:
    """A future that is told by hand."""

    def __init__(self):
        self._callbacks = []

    def add_done_callback(self, callback):
        self._callbacks.append(callback)

    def tell(self, value):
        for callback in self._callbacks:
            callback(SimpleNamespace(result=lambda: value))


class Accepted:
    """The client's handle of a goal at the controller."""

    accepted = True

    def __init__(self):
        self.cancelled, self.results = 0, []

    def cancel_goal_async(self):
        self.cancelled += 1

    def get_result_async(self):
        self.results.append(Later())
        return self.results[-1]

    def end(self, status, **fields):
        for later in self.results:
            later.tell(SimpleNamespace(status=status, result=Result(**fields)))


class Controller:
    """An action client whose controller is there or not."""

    def __init__(self, *_):
        self.there, self.sent, self.answers, self.feedback = True, [], [], None

    def server_is_ready(self):
        return self.there

    def send_goal_async(self, request, feedback_callback=None):
        self.sent.append(request)
        self.answers.append(Later())
        self.feedback = feedback_callback or self.feedback
        return self.answers[-1]

    def take(self, k=-1):
        handle = Accepted()
        self.answers[k].tell(handle)
        return handle


class Goal:
    """A goal's handle in the server; an end behind the end raises, as rclpy's does."""

    is_cancel_requested = False

    def __init__(self, number, points=2, last=0.0):
        self.goal_id = SimpleNamespace(uuid=[number] * 16)
        rows = [SimpleNamespace(effort=[], velocities=[last] * 2, accelerations=[]) for _ in range(points)]
        self.request = SimpleNamespace(trajectory=SimpleNamespace(points=rows, joint_names=["a", "b"]))
        self.ends = []

    def execute(self, end):
        self.ends.append(end(self))
        assert len(self.ends) == 1, "ended twice"

    def publish_feedback(self, feedback):
        pass

    def abort(self):
        self.how = ABORTED

    def succeed(self):
        self.how = SUCCEEDED

    def canceled(self):
        self.how = CANCELED


class Node:
    """What the action asks of its node: work is done at once, timers by hand."""

    active = True

    def __init__(self):
        self.timers, self.slices, self.said, self.asked = [], 0, [], []

    def create_guarded_timer(self, _, callback):
        self.timers.append(callback)

    def create_client(self, *_):
        def call_async(request):
            self.asked.append(Later())
            return self.asked[-1]

        return SimpleNamespace(call_async=call_async)

    def defer(self, _, task):
        self.slices += sum(1 for _ in task)

    def now(self):
        return NOW

    def log_throttled(self, _, text):
        self.said.append(text)

    def look(self, times):
        for _ in range(times):
            for timer in self.timers:
                timer()


class Action(SimpleNamespace):
    """The action over a controller that is none: what a test says of the machine and the time."""

    def accept(self, goal):
        self.served._on_accepted(goal)
        return goal

    def cancel(self, goal):
        goal.is_cancel_requested = True
        self.served._on_cancel(goal)

    @property
    def holds(self):
        """Positions and efforts of the hold points that were sent."""
        points = [goal.trajectory.points for goal in self.controller.sent]
        return [(list(p[0].positions), list(p[0].effort)) for p in points if len(p) == 1]


@pytest.fixture
def action(monkeypatch):
    """The action, its node, its controller, the machine's place, the time and the module."""
    kind = SimpleNamespace(Result=Result, Goal=SimpleNamespace)
    module = ModuleType("control_msgs.action")
    module.FollowJointTrajectory = kind
    monkeypatch.setitem(sys.modules, "control_msgs", ModuleType("control_msgs"))
    monkeypatch.setitem(sys.modules, "control_msgs.action", module)
    monkeypatch.delitem(sys.modules, "delta_dynamics.nodes.action", raising=False)
    code = importlib.import_module("delta_dynamics.nodes.action")
    monkeypatch.setattr(code, "ActionClient", Controller)
    monkeypatch.setattr(code, "ActionServer", lambda *_, **__: None)
    node = Node()
    made = Action(node=node, code=code, place={"a": 0.1, "b": 0.2}, now=100.0)
    monkeypatch.setattr(code.time, "monotonic", lambda: made.now)

    def efforts(trajectory):
        yield
        # The weight is another one in each place.
        return np.array([np.add(getattr(p, "positions", [0, 0]), 5) for p in trajectory.points])

    made.served = code.EffortAction(node, "/controller", efforts, lambda: made.place, True)
    made.controller = made.served._client
    yield made
    sys.modules.pop("delta_dynamics.nodes.action", None)


@pytest.mark.parametrize("answered", [False, True])
def test_a_goal_whose_controller_was_killed_is_aborted_within_two_seconds(action, answered):
    goal = action.accept(Goal(1))
    handle = action.controller.take() if answered else Accepted()
    feedback = told_of([], [])
    for _ in range(3):
        action.node.look(action.code.MAX_SILENT_CHECKS - 1)
        # Feedback is a sign of life, and so is an answer to a question.
        action.controller.feedback(SimpleNamespace(feedback=feedback))
        action.node.look(action.code.MAX_SILENT_CHECKS - 1)
        action.node.asked[-1].tell(None)
    assert not goal.ends
    assert action.code.MAX_SILENT_CHECKS * action.code.CHECK_PERIOD < 2.0
    action.node.look(action.code.MAX_SILENT_CHECKS)
    (result,) = goal.ends
    assert goal.how == ABORTED
    assert "/controller" in result.error_string
    # What comes after the end ends nothing again.
    if not answered:
        action.controller.answers[0].tell(handle)
    handle.end(SUCCEEDED)
    action.node.look(50)
    assert (goal.how, len(goal.ends)) == (ABORTED, 1)


def test_a_controller_that_was_started_again_has_lost_the_goal(action):
    goal = action.accept(Goal(1))
    handle = action.controller.take()
    action.node.look(action.code.SILENT_CHECKS_BEFORE_REQUEST)
    assert len(handle.results) == 2
    handle.end(UNKNOWN)
    assert goal.how == ABORTED and "lost the goal" in goal.ends[0].error_string


def test_goals_wait_for_the_controller_to_be_found_in_their_order_and_not_for_ever(action):
    action.controller.there = False
    goals = [action.accept(Goal(k)) for k in (1, 2)]
    action.node.look(3)
    assert not action.controller.sent
    action.controller.there = True
    action.node.look(1)
    assert action.controller.sent == [goal.request for goal in goals]
    action.controller.there = False
    late, cancelled = action.accept(Goal(3)), action.accept(Goal(4))
    cancelled.is_cancel_requested = True
    action.now += action.code.MAX_DISCOVERY_TIME - 0.1
    action.node.look(1)
    assert cancelled.how == CANCELED and not late.ends
    action.now += 0.2
    action.node.look(1)
    assert late.how == ABORTED
    assert late.ends[0].error_string == "no action server at /controller"


def test_a_cancelled_goal_is_replaced_by_the_weight_of_the_place_before_it_ends(action):
    goal = action.accept(Goal(1))
    handle = action.controller.take()
    action.cancel(goal)
    assert action.holds == [([0.1, 0.2], [5.1, 5.2])]
    # Not before the hold point is the controller's: in between it would have no effort at all.
    assert not handle.cancelled
    action.controller.take()
    assert handle.cancelled == 1
    handle.end(ABORTED, error_code=Result.INVALID_GOAL)
    assert goal.how == CANCELED and len(action.holds) == 1


def test_a_goal_that_is_cancelled_before_the_controller_has_answered_is_stopped_then(action):
    goal = action.accept(Goal(1))
    action.cancel(goal)
    assert not action.holds
    action.controller.take()
    assert action.holds


def test_without_a_known_place_or_an_effort_the_controller_is_only_told_to_cancel(action):
    goal = action.accept(Goal(1))
    handle = action.controller.take()
    action.place = None
    action.cancel(goal)
    assert not action.holds and handle.cancelled == 1
    # The controller's own feedback has the place where no joint state has it.
    goal = action.accept(Goal(2))
    action.controller.take()
    told = told_of(["a", "b"], [0.3, 0.4])
    action.controller.feedback(SimpleNamespace(feedback=told))
    action.cancel(goal)
    assert action.holds == [([0.3, 0.4], [5.3, 5.4])]


@pytest.mark.parametrize(("age", "later", "held"), [(0.2, 0.29, True), (0.2, 0.31, False)])
def test_feedback_from_before_a_suspension_is_no_place_to_hold(action, age, later, held):
    action.served._max_age = lambda: 0.5
    action.place = None
    goal = action.accept(Goal(1))
    action.controller.take()
    told = told_of(["a", "b"], [0.3, 0.4], age)
    action.controller.feedback(SimpleNamespace(feedback=told))
    action.now += later
    action.cancel(goal)
    assert bool(action.holds) is held


def test_a_rejected_goal_is_logged_once(action):
    def rejected(trajectory):
        yield
        raise MessageError("limit", "arm_1 is at 3 rad")

    action.served._efforts = rejected
    goal = action.accept(Goal(1))
    assert goal.how == ABORTED
    assert len(action.node.said) == 1 and "arm_1 is at 3 rad" in action.node.said[0]


@pytest.mark.parametrize(
    ("status", "code", "last", "held"),
    [
        (ABORTED, Result.TOLERANCE, 0.0, True),
        (CANCELED, 0, 0.0, True),
        (ABORTED, Result.INVALID_GOAL, 0.0, False),
        (SUCCEEDED, 0, 0.0, False),
        (SUCCEEDED, 0, 0.5, True),
    ],
)
def test_what_the_controller_ends_is_held_unless_another_motion_goes_on(action, status, code, last, held):
    """An end at rest has the right effort; one that another trajectory replaced must go on."""
    action.accept(Goal(1, last=last))
    handle = action.controller.take()
    handle.end(status, error_code=code)
    assert bool(action.holds) is held
    # The second goal replaces the first, whatever the controller says of that.
    action.accept(Goal(2))
    old = action.controller.take()
    action.accept(Goal(3))
    before = len(action.holds)
    old.end(ABORTED, error_code=Result.TOLERANCE)
    assert len(action.holds) == before


def test_a_machine_that_rests_elsewhere_gets_the_weight_of_that_place(action):
    goal = action.accept(Goal(1))
    action.controller.take()
    action.cancel(goal)
    for place in (0.15, 0.18, 0.19):
        action.place = {"a": place, "b": 0.2}
        action.node.look(1)
        assert len(action.holds) == 1
    action.node.look(1)
    assert action.holds[1:] == [([0.19, 0.2], [5.19, 5.2])]
    action.node.look(50)
    assert len(action.holds) == 2


@pytest.mark.parametrize("rested", [True, False])
def test_another_client_s_motion_is_not_ended_by_a_hold_point(action, rested):
    """It starts from rest or takes the machine over, and it dwells."""
    goal = action.accept(Goal(1))
    action.controller.take()
    action.cancel(goal)
    places = [0.1, 0.2, 0.3] if rested else [0.15, 0.16, 0.2, 0.3]
    for k, place in enumerate([*places, *[places[-1]] * 5, 0.5, 0.5]):
        action.now += (0.02 if k == 0 else 0.1) * bool(rested)
        action.place = {"a": place, "b": 0.2}
        action.node.look(1)
    assert len(action.holds) == 1


def test_a_trajectory_that_was_forwarded_is_not_ended_by_a_hold_point(action):
    goal = action.accept(Goal(1))
    action.controller.take()
    action.cancel(goal)
    action.served.cancel_hold_points()
    for place in (0.15, 0.18, 0.19, 0.19, 0.19):
        action.place = {"a": place, "b": 0.2}
        action.node.look(1)
    assert len(action.holds) == 1


def test_goals_end_and_the_machine_is_held_when_the_node_ends(action):
    moving = action.accept(Goal(1))
    handle = action.controller.take()
    action.served.shutdown()
    assert moving.how == ABORTED and "shutting down" in moving.ends[0].error_string
    assert len(action.holds) == 1
    assert action.served.shutting_down
    action.controller.take()
    assert handle.cancelled == 1
    turns = 0
    while action.served.shutting_down:
        turns += 1
    assert 0 < turns < 20


def test_efforts_are_written_into_a_goal_in_slices(action):
    goal = action.accept(Goal(2, POINTS))
    assert action.node.slices >= POINTS // 256
    assert all(point.effort == [5.0] * 2 for point in goal.request.trajectory.points)
    assert action.controller.sent == [goal.request]


def test_a_malformed_goal_is_rejected_before_it_is_accepted(action):
    """By what the node's core says of its shape; and every goal while the node is inactive."""
    robot = load("delta")
    core = Feedforward(robot, Settings())
    served = action.code.EffortAction(action.node, "/controller", None, lambda: None, True, check=core.check_shape)
    make, accept, reject = (
        Maker(Plain()),
        action.code.GoalResponse.ACCEPT,
        action.code.GoalResponse.REJECT,
    )
    q = np.tile(robot.inverse(robot.home()), (3, 1))
    times = [0, SECOND, 2 * SECOND]

    def judge(**changes):
        given = {"names": robot.joint_names, "times": times, "q": q, "qd": 0 * q, "qdd": 0 * q}
        given |= changes
        message = make.trajectory(*given.values())
        return served._check_request(SimpleNamespace(trajectory=message)), message

    action.node.active = True
    assert judge()[0] == accept
    bad = (
        {"names": ("arm_1", "arm_2", "wrist")},
        {"names": ("arm_1", "arm_2", "arm_2")},
        {"names": ("arm_1", "arm_2")},
        {"names": ()},
        {"times": []} | dict.fromkeys(("q", "qd", "qdd"), q[:0]),
        {"q": q[:, :2]},
        {"q": q[:, :0]},
        {"qd": q[:, :2]},
        {"qdd": q[:, :1]},
    )
    for changes in bad:
        verdict, message = judge(**changes)
        assert verdict == reject, changes
        with pytest.raises(MessageError):
            core.trajectory(message, 0)
    assert len(action.node.said) == len(bad)
    action.node.active = False
    assert judge()[0] == reject
