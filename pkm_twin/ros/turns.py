# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What waits for turns of the executor: requests, and work in steps."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from typing import Any, Final

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup

from pkm_twin.errors import MessageError

MAX_TASKS: Final = 10
"""How much work may wait beside the callbacks."""
LOW_RATE_PERIOD: Final = 0.1
LOW_RATE_TURNS: Final = 3
"""How often requests are looked for, s, and how many at a time at least."""

Task = Generator[None, None, None]


class LowRateGroup(MutuallyExclusiveCallbackGroup):
    """What is not asked for a thousand times a second: requests.

    rclpy makes a new wait set for every message, and each entity in it costs time; these are
    in it now and then only. The events executor has no wait set and does not ask.
    """

    def __init__(self) -> None:
        super().__init__()
        self._turns = 0

    def open(self) -> None:
        """Let the next turns of the executor look at them."""
        self._turns = LOW_RATE_TURNS

    def end_turn(self) -> None:
        """A turn of the executor is over."""
        if self._turns:
            self._turns -= 1

    def can_execute(self, entity: Any) -> bool:
        """Whether the executor looks at it."""
        return self._turns > 0 and bool(super().can_execute(entity))


class Tasks:
    """Work in steps between the callbacks, one task after the other.

    :param failed: takes what a task raised, and where.
    """

    def __init__(self, failed: Callable[[str, Exception], None]) -> None:
        self._failed = failed
        self._waiting: deque[tuple[str, Task]] = deque()

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def add(self, where: str, task: Task) -> None:
        """Let a task wait for its turn.

        :raises MessageError: too much waits already.
        """
        if len(self._waiting) >= MAX_TASKS:
            raise MessageError("busy", f"{MAX_TASKS} requests are waiting already")
        self._waiting.append((where, task))

    def clear(self) -> None:
        """Forget what waits."""
        self._waiting.clear()

    def step(self) -> None:
        """One step of the first task."""
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
