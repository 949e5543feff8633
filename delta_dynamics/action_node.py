# SPDX-License-Identifier: Apache-2.0
"""The action FollowJointTrajectory, its goals filled with effort on their way to the controller.

Motion planners send this action, not the trajectory's topic. Needs control_msgs, so only
``delta_dynamics`` imports this module, and only where it is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse

from delta_dynamics.feedforward import SLICE
from pkm_twin.errors import MessageError
from pkm_twin.ros import node as health

Efforts = Callable[[Any], Generator[None, None, "np.ndarray[Any, Any]"]]

NAME = "~/follow_joint_trajectory"
LOOK = 0.5
"""How often it is looked whether the controller of goals that are under way is still there, s."""
MISSING = 4
"""How often in a row it has to be missing: what is discovered anew may flicker."""


class EffortAction:
    """Takes goals, has their efforts computed, and is the controller's client for the rest.

    Feedback, cancelling and the result pass through. A goal stays accepted until the controller's
    result is there: rclpy polls whatever awaits in an executing goal without a pause.
    """

    def __init__(self, node: health.TwinNode, controller: str, efforts: Efforts) -> None:
        """Serve ``~/follow_joint_trajectory``.

        :param controller: the controller's action, by its name.
        :param efforts: efforts of a JointTrajectory in its own joint order, shape (points, n), in
            steps; raises MessageError.
        """
        self._node, self._controller, self._efforts = node, controller, efforts
        self._client = ActionClient(node, FollowJointTrajectory, controller)
        self._handles: dict[bytes, Any] = {}
        self._waiting: dict[bytes, Any] = {}
        self._sent: dict[bytes, Any] = {}
        """Goals that the controller has, whether it has answered or not."""
        self._missing = 0
        node.create_guarded_timer(LOOK, self._watch)
        self._server = ActionServer(
            node,
            FollowJointTrajectory,
            NAME,
            execute_callback=self._never_begun,
            goal_callback=lambda _: GoalResponse.ACCEPT if node.active else GoalResponse.REJECT,
            handle_accepted_callback=self._accepted,
            cancel_callback=self._cancel,
        )

    def deactivated(self) -> None:
        """The node answers nothing more: goals that wait for their efforts end here.

        What the controller has already is the controller's.
        """
        for goal in list(self._waiting.values()):
            self._abort(goal, "the node was deactivated")

    def _watch(self) -> None:
        """A controller that was killed ends no goal: its goals are aborted here."""
        gone = bool(self._sent) and not self._client.server_is_ready()
        self._missing = self._missing + 1 if gone else 0
        if self._missing >= MISSING:
            for goal in list(self._sent.values()):
                self._abort(goal, f"{self._controller} has gone with the goal")

    def _accepted(self, goal: Any) -> None:
        self._waiting[_key(goal)] = goal

        def refused(error: MessageError) -> None:
            self._abort(goal, f"the twin refused the trajectory, {error.reason}: {error}")

        def steps() -> health.Task:
            try:
                yield from self._fill(goal)
            except MessageError as error:
                refused(error)
                raise

        try:
            self._node.defer(NAME, steps())
        except MessageError as error:
            refused(error)

    def _fill(self, goal: Any) -> health.Task:
        trajectory = goal.request.trajectory
        efforts = yield from self._efforts(trajectory)
        for k, (point, effort) in enumerate(zip(trajectory.points, efforts.tolist(), strict=True)):
            point.effort = effort
            if k % SLICE == SLICE - 1:
                yield
        if goal.is_cancel_requested:
            self._finish(goal, GoalStatus.STATUS_CANCELED, FollowJointTrajectory.Result())
        elif not self._client.server_is_ready():
            self._abort(goal, f"no controller serves {self._controller}")
        else:
            self._sent[_key(goal)] = self._waiting.pop(_key(goal))
            self._client.send_goal_async(
                goal.request, feedback_callback=lambda m: goal.publish_feedback(m.feedback)
            ).add_done_callback(lambda future: self._answered(goal, future.result()))

    def _answered(self, goal: Any, handle: Any) -> None:
        if _key(goal) not in self._sent:
            return
        if not handle.accepted:
            self._abort(
                goal,
                f"{self._controller} refused the trajectory; its log says why (without an effort "
                "command interface it takes no efforts)",
            )
            return
        self._handles[_key(goal)] = handle
        if goal.is_cancel_requested:
            handle.cancel_goal_async()
        handle.get_result_async().add_done_callback(
            lambda future: self._finish(goal, future.result().status, future.result().result)
        )

    def _cancel(self, goal: Any) -> CancelResponse:
        handle = self._handles.get(_key(goal))
        if handle is not None:
            handle.cancel_goal_async()
        return CancelResponse.ACCEPT

    def _abort(self, goal: Any, text: str) -> None:
        self._node.log_throttled(NAME, f"{NAME}: {text}")
        result = FollowJointTrajectory.Result(
            error_code=FollowJointTrajectory.Result.INVALID_GOAL, error_string=text
        )
        self._finish(goal, GoalStatus.STATUS_ABORTED, result)

    def _finish(self, goal: Any, status: int, result: Any) -> None:
        """End a goal as the controller has ended it; once, whatever comes late."""
        key = _key(goal)
        if key not in self._waiting and key not in self._sent:
            return
        for table in (self._handles, self._waiting, self._sent):
            table.pop(key, None)

        def end(goal: Any) -> Any:
            if status == GoalStatus.STATUS_SUCCEEDED:
                goal.succeed()
            elif status == GoalStatus.STATUS_CANCELED and goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.abort()
            return result

        goal.execute(end)

    def _never_begun(self, goal: Any) -> Any:
        raise NotImplementedError("goals end by what the controller says")


def _key(goal: Any) -> bytes:
    return bytes(goal.goal_id.uuid)
