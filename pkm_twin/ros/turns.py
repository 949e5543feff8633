# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Run requests and stepwise tasks between the callbacks of the executor."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from typing import Any, Final

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup

from pkm_twin.errors import MessageError

MAX_TASKS: Final = 10
"""Largest number of waiting tasks."""
LOW_RATE_PERIOD: Final = 0.1
"""Period at which requests are checked, s."""

Task = Generator[None, None, None]


class LowRateGroup(MutuallyExclusiveCallbackGroup):
    """Group the entities of rare requests.

    rclpy builds a wait set for every message, and each entity in it costs time; these are added
    only now and then. The events executor has no wait set and ignores the group.
    """

    def __init__(self) -> None:
        super().__init__()
        self._turns = 0

    def enable(self) -> None:
        """Include this callback group in the next three spins of the executor."""
        self._turns = 3

    def end_turn(self) -> None:
        """Count a turn of the executor."""
        if self._turns:
            self._turns -= 1

    def can_execute(self, entity: Any) -> bool:
        """Return whether the executor checks an entity."""
        return self._turns > 0 and bool(super().can_execute(entity))


class Tasks:
    """Run tasks in steps between the callbacks, one after the other.

    :param failed: called with the place and the exception of a task.
    """

    def __init__(self, failed: Callable[[str, Exception], None]) -> None:
        self._failed = failed
        self._waiting: deque[tuple[str, Task]] = deque()

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def add(self, where: str, task: Task) -> None:
        """Add a task to the queue.

        :raises MessageError: too many tasks are waiting.
        """
        if len(self._waiting) >= MAX_TASKS:
            raise MessageError("busy", f"{MAX_TASKS} requests are waiting already")
        self._waiting.append((where, task))

    def clear(self) -> None:
        """Discard all waiting tasks."""
        self._waiting.clear()

    def step(self) -> None:
        """Run one step of the first task."""
        if not self._waiting:
            return
        entry = where, task = self._waiting[0]
        try:
            next(task)
            return
        except StopIteration:
            pass
        except Exception as error:
            self._failed(where, error)
        if self._waiting and self._waiting[0] is entry:
            self._waiting.popleft()
