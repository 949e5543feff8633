# SPDX-License-Identifier: Apache-2.0
"""How goals of ~/follow_joint_trajectory end where the controller does not end them."""

import importlib
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", exc_type=ImportError)

ABORTED, SUCCEEDED = 6, 4
POINTS = 600


class Result(SimpleNamespace):
    """Of the action, which the machine that tests may not have."""

    INVALID_GOAL = -1


class Later:
    """A future that is told by hand."""

    def __init__(self):
        self._callbacks = []

    def add_done_callback(self, callback):
        self._callbacks.append(callback)

    def tell(self, value):
        for callback in self._callbacks:
            callback(SimpleNamespace(result=lambda: value))


class Controller:
    """An action client whose controller is there or not."""

    def __init__(self, *_):
        self.there, self.sent, self.answer = True, [], Later()

    def server_is_ready(self):
        return self.there

    def send_goal_async(self, request, **_):
        self.sent.append(request)
        return self.answer


class Goal:
    """A goal's handle in the server; an end behind the end raises, as rclpy's does."""

    is_cancel_requested = False

    def __init__(self, number):
        self.goal_id = SimpleNamespace(uuid=[number] * 16)
        points = [SimpleNamespace(effort=[]) for _ in range(POINTS)]
        self.request = SimpleNamespace(trajectory=SimpleNamespace(points=points))
        self.ends = []

    def execute(self, end):
        self.ends.append(end(self))
        assert len(self.ends) == 1, "ended twice"

    def abort(self):
        self.how = ABORTED

    def succeed(self):
        self.how = SUCCEEDED


class Node:
    """What the action asks of its node: work is done at once, timers by hand."""

    active = True

    def __init__(self):
        self.timers, self.slices, self.said = [], 0, []

    def create_guarded_timer(self, _, callback):
        self.timers.append(callback)

    def defer(self, _, task):
        self.slices += sum(1 for _ in task)

    def log_throttled(self, _, text):
        self.said.append(text)

    def look(self, times):
        for _ in range(times):
            for timer in self.timers:
                timer()


@pytest.fixture
def action(monkeypatch):
    """The action over a controller that is none, its node and the module."""
    kind = SimpleNamespace(Result=Result)
    module = ModuleType("control_msgs.action")
    module.FollowJointTrajectory = kind
    monkeypatch.setitem(sys.modules, "control_msgs", ModuleType("control_msgs"))
    monkeypatch.setitem(sys.modules, "control_msgs.action", module)
    monkeypatch.delitem(sys.modules, "delta_dynamics.action_node", raising=False)
    code = importlib.import_module("delta_dynamics.action_node")
    monkeypatch.setattr(code, "ActionClient", Controller)
    monkeypatch.setattr(code, "ActionServer", lambda *_, **__: None)
    node = Node()

    def efforts(trajectory):
        yield
        return np.zeros((len(trajectory.points), 3))

    yield code.EffortAction(node, "/controller", efforts), node, code
    sys.modules.pop("delta_dynamics.action_node", None)


@pytest.mark.parametrize("answered", [False, True])
def test_a_goal_whose_controller_was_killed_is_aborted(action, answered):
    served, node, code = action
    goal, late = Goal(1), Later()
    served._accepted(goal)
    handle = SimpleNamespace(accepted=True, get_result_async=lambda: late)
    if answered:
        served._client.answer.tell(handle)
    node.look(20)
    assert not goal.ends
    served._client.there = False
    node.look(code.MISSING - 1)
    served._client.there = True
    node.look(1)
    served._client.there = False
    node.look(code.MISSING - 1)
    assert not goal.ends
    node.look(1)
    (result,) = goal.ends
    assert goal.how == ABORTED
    assert result.error_string == "/controller has gone with the goal"
    # What comes after the end ends nothing again.
    if not answered:
        served._client.answer.tell(handle)
    late.tell(SimpleNamespace(status=SUCCEEDED, result=Result()))
    node.look(20)
    assert (goal.how, len(goal.ends)) == (ABORTED, 1)


def test_efforts_are_written_into_a_goal_in_slices(action):
    served, node, _ = action
    goal = Goal(2)
    served._accepted(goal)
    assert node.slices >= POINTS // 256
    assert all(point.effort == [0.0] * 3 for point in goal.request.trajectory.points)
    assert served._client.sent == [goal.request]
