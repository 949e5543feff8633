# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The action FollowJointTrajectory, its goals filled with effort on their way to the controller.

Motion planners send this action, not the trajectory's topic. Needs control_msgs, so only
``delta_dynamics`` imports this module, and only where it is asked for.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from action_msgs.srv import CancelGoal
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from delta_dynamics.feedforward import POINTS_PER_SLICE
from pkm_twin.errors import MessageError
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.effort_limits import LimitedEfforts
from pkm_twin.ros.node import TwinNode
from pkm_twin.ros.turns import Task
from pkm_twin.streams.monitor import run_to_end

Efforts = Callable[[Any], Generator[None, None, LimitedEfforts]]
ReadPositions = Callable[[], "Mapping[str, float] | None"]
Result = FollowJointTrajectory.Result

ACTION_NAME = "~/follow_joint_trajectory"
CHECK_PERIOD = 0.1
"""Period of the checks of goals, s."""
SILENT_CHECKS_BEFORE_REQUEST = 5
"""Checks without a message of the controller after which it is asked for one."""
MAX_SILENT_CHECKS = 18
"""Checks without a message of the controller after which its goals are aborted: 1.8 s."""
MAX_DISCOVERY_TIME = 5.0
"""Longest time to find the controller's action, s."""
REST_VELOCITY = 1e-3
"""Joint velocity below which the machine rests, rad/s or m/s."""


@dataclass(eq=False)
class _Goal:
    """A client's goal and its state at the controller; times on the steady clock, s.

    ``handle``: of the action server. ``filled``: time at which its efforts were ready.
    ``controller``: handle of the action client, once the controller has accepted the goal.
    ``actual``: joint positions of the newest feedback, by name, ``measured`` at that time.
    """

    handle: Any
    filled: float | None = None
    sent: bool = False
    controller: Any = None
    actual: dict[str, float] = field(default_factory=dict)
    measured: float = -math.inf
    held: bool = False
    asked: bool = False


@dataclass
class _Settling:
    """The state of a machine that slows down after a hold point.

    ``held``: the hold point. ``positions``: joint positions at the last check, at the time ``since``;
    ``speed``: of the fastest joint then, None before the first check. Times on the steady clock, s.
    """

    until: float
    names: list[str]
    held: list[float]
    positions: list[float]
    since: float
    speed: float | None = None


class EffortAction:
    """Accept goals, compute their efforts, and forward them to the controller's action.

    Feedback, cancelling and the result pass through. A goal stays accepted until the controller's
    result arrives, because rclpy polls an executing goal that awaits something without a pause.

    A controller that ends a goal early holds its position with the effort of another point, or
    without effort. Therefore it gets a hold point: the present position with the effort against gravity.
    """

    def __init__(
        self,
        node: TwinNode,
        controller: str,
        efforts: Efforts,
        read_positions: ReadPositions,
        hold: bool,
        *,
        hold_efforts: Efforts | None = None,
        max_age: Callable[[], float] = lambda: math.inf,
        check: Callable[[Any], None] = lambda _: None,
    ) -> None:
        """Serve ``~/follow_joint_trajectory``.

        :param controller: the controller's action, by its name.
        :param efforts: efforts of a JointTrajectory in its own joint order, shape (points, n), in
            steps; raises MessageError.
        :param read_positions: gives the present joint positions by name, in the controller's numbers; None
            if unknown.
        :param hold: whether hold points are sent. ``hold_efforts``: as ``efforts``, for them.
        :param max_age: largest age of the controller's feedback that replaces ``read_positions``, s.
        :param check: rejects a malformed JointTrajectory at once; raises MessageError.
        """
        self._node, self._controller, self._efforts = node, controller, efforts
        self._read_positions, self._max_age, self._hold = read_positions, max_age, hold
        self._hold_efforts = hold_efforts or efforts
        self._check = check
        self._client = ActionClient(node, FollowJointTrajectory, controller)
        self._ping = node.create_client(CancelGoal, f"{controller}/_action/cancel_goal")
        self._goals: dict[bytes, _Goal] = {}
        self._ending: set[bytes] = set()
        self._holding = 0
        """Number of hold points that the controller has not answered yet."""
        self._turns = 0
        self._silent = 0
        """Number of checks since the controller's last message."""
        self._settling: _Settling | None = None
        node.create_guarded_timer(CHECK_PERIOD, self._check_goals)
        self._server = ActionServer(
            node,
            FollowJointTrajectory,
            ACTION_NAME,
            # Goals are executed with their results, see ``_finish``.
            execute_callback=lambda handle: Result(),
            goal_callback=self._check_request,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
        )

    def _check_request(self, request: Any) -> GoalResponse:
        """Accept a goal, unless the node is inactive or the trajectory malformed."""
        if not self._node.active:
            return GoalResponse.REJECT
        try:
            self._check(request.trajectory)
        except MessageError as error:
            self._node.log_throttled(ACTION_NAME, f"{ACTION_NAME}: rejected a goal, {error.reason}: {error}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def deactivated(self) -> None:
        """Abort the goals that wait for their efforts; goals at the controller continue."""
        for goal in list(self._goals.values()):
            if not goal.sent:
                self._abort(goal, "the node was deactivated")

    def cancel_hold_points(self) -> None:
        """Cancel the hold points: another trajectory was sent to the controller."""
        self._settling = None

    def shutdown(self) -> None:
        """Stop the machine at its present position, and abort every goal."""
        moving = [goal for goal in self._goals.values() if goal.sent]
        if moving:
            self._hold_and_cancel(moving[-1])
        for goal in list(self._goals.values()):
            self._abort(goal, "delta_dynamics is shutting down")

    @property
    def shutting_down(self) -> bool:
        """True while results and hold points of :meth:`shutdown` are on their way."""
        if self._ending or self._holding:
            # The last results take a few turns of the executor.
            self._turns = 5
        else:
            self._turns -= 1
        return self._turns > 0

    def _check_goals(self) -> None:
        self._send_ready_goals()
        for goal in list(self._goals.values()):
            if goal.filled is None or goal.sent:
                continue
            if goal.handle.is_cancel_requested:
                self._finish(goal, GoalStatus.STATUS_CANCELED, Result())
            elif time.monotonic() - goal.filled > MAX_DISCOVERY_TIME:
                self._abort(goal, f"no action server at {self._controller}")
        self._check_controller()
        self._check_rest()

    def _check_controller(self) -> None:
        """Abort the goals of a controller that no longer answers.

        A killed controller ends no goal, and the middleware lists it for seconds.
        """
        sent = [goal for goal in self._goals.values() if goal.sent]
        self._silent = self._silent + 1 if sent else 0
        if self._silent >= MAX_SILENT_CHECKS:
            for goal in sent:
                if goal.controller is not None:
                    goal.controller.cancel_goal_async()
                self._abort(goal, f"{self._controller} disappeared during the goal")
        elif self._silent and self._silent % SILENT_CHECKS_BEFORE_REQUEST == 0:
            # The request to cancel an unknown goal has no effect, but a running controller answers it.
            request = CancelGoal.Request()
            request.goal_info.goal_id.uuid = np.frombuffer(os.urandom(16), np.uint8)
            self._ping.call_async(request).add_done_callback(self._note_sign_of_life)
            for goal in sent:
                if goal.controller is not None and not goal.asked:
                    # A restarted controller answers that it does not know the goal.
                    goal.asked = True
                    self._await_result(goal)

    def _note_sign_of_life(self, _: Any = None) -> None:
        self._silent = 0

    def _on_accepted(self, handle: Any) -> None:
        goal = self._goals[_goal_id(handle)] = _Goal(handle)

        def fill_efforts() -> Task:
            trajectory = goal.handle.request.trajectory
            try:
                efforts = yield from self._efforts(trajectory)
            except MessageError as error:
                reject(error)
                return
            for k, (point, effort) in enumerate(zip(trajectory.points, efforts.tolist(), strict=True)):
                point.effort = effort
                if k % POINTS_PER_SLICE == POINTS_PER_SLICE - 1:
                    yield
            goal.filled = time.monotonic()
            if goal.handle.is_cancel_requested:
                self._finish(goal, GoalStatus.STATUS_CANCELED, Result())
            self._send_ready_goals()

        def reject(error: MessageError) -> None:
            self._abort(goal, f"delta_dynamics rejected the trajectory, {error.labelled}")

        try:
            self._node.defer(ACTION_NAME, fill_efforts())
        except MessageError as error:
            reject(error)

    def _send_ready_goals(self) -> None:
        """Send the goals that have their efforts to the controller, in the order of arrival."""
        waiting = [g for g in self._goals.values() if g.filled is not None and not g.sent]
        if waiting and self._client.server_is_ready():
            for goal in waiting:
                self._send(goal)

    def _send(self, goal: _Goal) -> None:
        goal.sent = True
        self.cancel_hold_points()
        self._note_sign_of_life()

        def forward_feedback(message: Any) -> None:
            self._note_sign_of_life()
            feedback = message.feedback
            goal.actual = dict(zip(feedback.joint_names, feedback.actual.positions, strict=False))
            stamp = feedback.header.stamp.sec * SECOND + feedback.header.stamp.nanosec
            age = max(0, self._node.now() - stamp) / SECOND if stamp else 0.0
            goal.measured = time.monotonic() - age
            if _goal_id(goal.handle) in self._goals:
                goal.handle.publish_feedback(feedback)

        self._client.send_goal_async(goal.handle.request, feedback_callback=forward_feedback).add_done_callback(
            lambda future: self._on_response(goal, future.result())
        )

    def _on_response(self, goal: _Goal, handle: Any) -> None:
        self._note_sign_of_life()
        if _goal_id(goal.handle) not in self._goals:
            if handle.accepted:
                handle.cancel_goal_async()
            return
        if not handle.accepted:
            self._abort(
                goal,
                f"{self._controller} rejected the trajectory; see its log (without an effort "
                "command interface it accepts no efforts)",
            )
            return
        goal.controller = handle
        if goal.handle.is_cancel_requested:
            self._hold_and_cancel(goal)
        self._await_result(goal)

    def _await_result(self, goal: _Goal) -> None:
        goal.controller.get_result_async().add_done_callback(lambda future: self._on_result(goal, future.result()))

    def _on_result(self, goal: _Goal, end: Any) -> None:
        self._note_sign_of_life()
        if _goal_id(goal.handle) not in self._goals:
            return
        if end.status == GoalStatus.STATUS_UNKNOWN:
            self._abort(goal, f"{self._controller} was restarted and lost the goal")
            return
        last = goal.handle.request.trajectory.points[-1]
        if end.status == GoalStatus.STATUS_SUCCEEDED:
            # The controller keeps the last point's effort, also that of an acceleration.
            stopped = any([*last.velocities, *last.accelerations])
        else:
            # A goal that another trajectory replaced does not stop the machine.
            stopped = end.result.error_code != Result.INVALID_GOAL
        if stopped and not goal.held and self._is_newest(goal):
            self._send_hold(goal)
        self._finish(goal, end.status, end.result)

    def _is_newest(self, goal: _Goal) -> bool:
        """Return whether no other goal was sent to the controller after this one."""
        return [g for g in self._goals.values() if g.sent][-1:] == [goal]

    def _on_cancel(self, handle: Any) -> CancelResponse:
        goal = self._goals.get(_goal_id(handle))
        if goal is not None and goal.controller is not None:
            self._hold_and_cancel(goal)
        return CancelResponse.ACCEPT

    def _hold_and_cancel(self, goal: _Goal) -> None:
        """Cancel a goal at the controller, after a hold point, so that an effort is always set."""

        def cancel_goal(_: Any = None) -> None:
            if goal.controller is not None:
                goal.controller.cancel_goal_async()

        if not (self._is_newest(goal) and self._send_hold(goal, cancel_goal)):
            cancel_goal()

    def _send_hold(self, goal: _Goal, then: Callable[[Any], None] = lambda _: None) -> bool:
        """Send the present position as hold point, with the effort against gravity.

        :param then: called with the controller's answer.
        :returns: whether the position is known and the model has an effort for it.
        """
        names = list(goal.handle.request.trajectory.joint_names)
        goal.held = True
        fresh = time.monotonic() - goal.measured <= self._max_age()
        measured = {**(goal.actual if fresh else {}), **(self._read_positions() or {})}
        return self._send_point(names, measured, then)

    def _send_point(self, names: Sequence[str], measured: Mapping[str, float], then: Callable[[Any], None]) -> bool:
        if not self._hold:
            return False
        try:
            positions = [measured[name] for name in names]
            zeros = [0.0] * len(names)
            point = JointTrajectoryPoint(positions=positions, velocities=zeros, accelerations=zeros)
            trajectory = JointTrajectory(joint_names=names, points=[point])
            point.effort = run_to_end(self._hold_efforts(trajectory))[0].tolist()
        except KeyError as error:
            self._node.log_throttled("hold", f"{ACTION_NAME}: no hold point: {error} was not measured")
            return False
        except MessageError as error:
            self._node.log_throttled("hold", f"{ACTION_NAME}: no hold point, {error.labelled}")
            return False
        self._holding += 1

        def on_response(future: Any) -> None:
            self._holding -= 1
            self._note_sign_of_life()
            then(future.result())

        now = time.monotonic()
        # After a stop the machine rests within 3 s.
        self._settling = _Settling(now + 3.0, list(names), positions, positions, now)
        goal = FollowJointTrajectory.Goal(trajectory=trajectory)
        self._client.send_goal_async(goal).add_done_callback(on_response)
        return True

    def _check_rest(self) -> None:
        """Send another hold point if the machine came to rest more than 1e-4 rad or m from the last one.

        A machine that speeds up again is moved by another client of the controller.
        """
        settling, self._settling = self._settling, None
        measured, now = self._read_positions(), time.monotonic()
        if settling is None or measured is None or now > settling.until:
            return
        if not measured.keys() >= set(settling.names):
            return
        positions = [measured[name] for name in settling.names]
        elapsed = (now - settling.since) or CHECK_PERIOD
        speed = float(np.abs(np.subtract(positions, settling.positions)).max()) / elapsed
        before = settling.speed
        # The first interval may be too short to recognise rest.
        if before is not None and speed < REST_VELOCITY:
            if np.abs(np.subtract(positions, settling.held)).max() > 1e-4:
                self._send_point(settling.names, measured, lambda _: None)
        elif before is None or speed <= before + REST_VELOCITY:
            self._settling = replace(settling, positions=positions, since=now, speed=speed)

    def _abort(self, goal: _Goal, text: str) -> None:
        self._node.log_throttled(ACTION_NAME, f"{ACTION_NAME}: {text}")
        result = Result(error_code=Result.INVALID_GOAL, error_string=text)
        self._finish(goal, GoalStatus.STATUS_ABORTED, result)

    def _finish(self, goal: _Goal, status: int, result: Any) -> None:
        """End a goal with the controller's status and result; a second call for the goal is ignored."""
        key = _goal_id(goal.handle)
        if self._goals.pop(key, None) is None:
            return
        self._ending.add(key)

        def report_result(handle: Any) -> Any:
            self._ending.discard(key)
            if status == GoalStatus.STATUS_SUCCEEDED:
                handle.succeed()
            elif handle.is_cancel_requested:
                handle.canceled()
                # The controller reports a goal that the hold point replaced as invalid.
                return Result() if goal.held else result
            else:
                handle.abort()
            return result

        goal.handle.execute(report_result)


def _goal_id(handle: Any) -> bytes:
    return bytes(handle.goal_id.uuid)
