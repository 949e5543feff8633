# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The action ~/follow_joint_trajectory, between a client and a controller of this process."""

import numpy as np
import pytest

pytest.importorskip("rclpy", exc_type=ImportError)
pytest.importorskip("control_msgs", reason="control_msgs is not installed")

from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse

from delta_dynamics import inverse_dynamics
from test.nodes.harness import SECOND
from test.nodes.twin import MAKE, MODULE, ROBOT, trajectory


class Controller:
    """A controller's action: it keeps the goals that come and ends them as it is told."""

    def __init__(self, node, name):
        self.goals, self.open, self.accepts = [], [], True
        self.server = ActionServer(
            node,
            FollowJointTrajectory,
            name,
            execute_callback=lambda goal: FollowJointTrajectory.Result(error_string="as told"),
            goal_callback=lambda _: GoalResponse.ACCEPT if self.accepts else GoalResponse.REJECT,
            handle_accepted_callback=self._accepted,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def _accepted(self, goal):
        self.goals.append(goal.request)
        self.open.append(goal)

    def end(self, how):
        goal = self.open.pop()

        def ended(goal):
            getattr(goal, how)()
            return FollowJointTrajectory.Result(error_string="as told")

        goal.execute(ended)


class Client:
    """A planner: one goal and what became of it."""

    def __init__(self, peer, name):
        self.peer = peer
        self.client = ActionClient(peer.node, FollowJointTrajectory, name)

    def send(self, message):
        self.feedback = []
        peer = self.peer
        peer.until(self.client.server_is_ready)
        goal = FollowJointTrajectory.Goal(trajectory=message)
        sent = self.client.send_goal_async(goal, feedback_callback=self.feedback.append)
        peer.until(sent.done)
        self.handle = sent.result()
        self.result = self.handle.get_result_async()

    def ended(self):
        self.peer.until(self.result.done)
        answer = self.result.result()
        return answer.status, answer.result


@pytest.fixture(scope="module")
def controller(peer):
    return Controller(peer.node, "/controller/follow_joint_trajectory")


@pytest.fixture(scope="module")
def client(peer, launch, controller):
    name = "planned"
    remap = ("-r", f"__node:={name}", "-r", f"joint_states:=/{name}/states")
    action = "controller_action:=/controller/follow_joint_trajectory"
    launch(MODULE, action, arguments=remap)
    return Client(peer, f"/{name}/follow_joint_trajectory")


def test_a_goal_reaches_the_controller_with_effort_and_nothing_else_changed(client, controller):
    sent = trajectory()
    client.send(sent)
    client.peer.until(lambda: controller.open)
    (goal,) = controller.goals
    rows = [(p.positions, p.velocities, p.accelerations) for p in sent.points]
    q, qd, qdd = (np.array(values) for values in zip(*rows, strict=True))
    efforts = np.array([p.effort for p in goal.trajectory.points])
    assert np.abs(efforts - inverse_dynamics(ROBOT, q, qd, qdd)).max() < 1e-12
    for point in goal.trajectory.points:
        point.effort = []
    assert goal.trajectory == sent
    controller.open[0].publish_feedback(FollowJointTrajectory.Feedback(joint_names=["seen"]))
    client.peer.until(lambda: client.feedback)
    assert client.feedback[0].feedback.joint_names == ["seen"]
    controller.end("succeed")
    status, result = client.ended()
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert result.error_string == "as told"


def test_a_cancelled_goal_is_cancelled_at_the_controller(client, controller):
    client.send(trajectory())
    client.peer.until(lambda: controller.open)
    cancelled = client.handle.cancel_goal_async()
    client.peer.until(cancelled.done)
    client.peer.until(lambda: controller.open[0].is_cancel_requested)
    controller.end("canceled")
    assert client.ended()[0] == GoalStatus.STATUS_CANCELED


@pytest.mark.parametrize("spoil", ["another joint", "a length", "no points", "no positions"])
def test_a_malformed_goal_is_rejected_and_never_reaches_the_controller(client, controller, spoil):
    before, message = len(controller.goals), trajectory()
    if spoil == "another joint":
        message.joint_names[2] = "wrist"
    elif spoil == "no points":
        message.points = []
    for point in message.points[-1:]:
        point.velocities = point.velocities[:2] if spoil == "a length" else point.velocities
        point.positions = [] if spoil == "no positions" else point.positions
    client.peer.until(client.client.server_is_ready)
    goal = FollowJointTrajectory.Goal(trajectory=message)
    sent = client.client.send_goal_async(goal)
    client.peer.until(sent.done)
    assert not sent.result().accepted
    assert len(controller.goals) == before


def test_what_the_twin_refuses_of_a_well_formed_goal_is_aborted_with_the_reason(client, controller):
    before, message = len(controller.goals), trajectory()
    message.points[1].positions[0] = 9.0
    client.send(message)
    status, result = client.ended()
    assert status == GoalStatus.STATUS_ABORTED
    assert result.error_code == FollowJointTrajectory.Result.INVALID_GOAL
    assert "rejected the trajectory, limit" in result.error_string
    assert len(controller.goals) == before


def test_a_controller_that_refuses_efforts_is_named(client, controller):
    controller.accepts = False
    try:
        client.send(trajectory())
        status, result = client.ended()
    finally:
        controller.accepts = True
    assert status == GoalStatus.STATUS_ABORTED
    assert "/controller/follow_joint_trajectory" in result.error_string
    assert "effort command interface" in result.error_string


def test_goals_that_wait_for_their_efforts_end_with_the_node_s_activity(client, controller):
    before = len(controller.goals)
    q = np.full((50_000, 3), 0.1)
    times = [i * SECOND // 1000 for i in range(len(q))]
    client.send(MAKE.trajectory(ROBOT.joint_names, times, q, 0.0 * q, 0.0 * q))
    for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE):
        request = ChangeState.Request(transition=Transition(id=transition))
        assert client.peer.call(ChangeState, "/planned/change_state", request).success
    status, result = client.ended()
    assert status == GoalStatus.STATUS_ABORTED
    assert result.error_string == "the node was deactivated"
    assert len(controller.goals) == before
