# SPDX-License-Identifier: Apache-2.0
"""Measured deflections and the wrenches that made them: messages in, departures out. Pure."""

from __future__ import annotations

from bisect import insort
from collections.abc import Generator
from dataclasses import dataclass, field
from typing import Any, Final

from pkm_twin.errors import MessageError, SingularityError, UnreachableError
from pkm_twin.messages.reading import DeflectionSample, in_base_axes, read_deflection, shown
from pkm_twin.messages.stamps import SECOND, StampRules
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.monitor import Core, counting
from pkm_twin.streams.wrench import TimeCache, check_order
from stiffness_monitor.alarm import AlarmSettings, Departure, StiffnessAlarm
from stiffness_monitor.monitor import Answer

WAITING: Final = 64
"""Deflections that wait for the wrench after them; of more the latest by their stamps go."""
JUDGED: Final = 1.0
"""Between two judgements, s of stamps."""


@dataclass
class StiffnessWatch(Core):
    """Pairs each measured deflection with the wrenches around it, and judges a window of pairs.

    ``frames``: of the base and of the platform: a deflection is along the axes of either.
    ``max_age``: from a deflection to the wrench on either side, s. ``period``: least time between
    two pairs that count, s.
    """

    robot: Robot
    rules: StampRules
    frames: tuple[str, str]
    settings: AlarmSettings = field(default_factory=AlarmSettings)
    max_age: float = 0.02
    period: float = 0.1

    def __post_init__(self) -> None:
        self.taken = counting()
        self.departures: tuple[Departure, ...] | None = None
        """What the last judgement found; None before there was one."""
        self._alarm = StiffnessAlarm(self.robot, self.settings)
        self._answers: TimeCache[Answer] = TimeCache(1024)
        self._waiting: list[DeflectionSample] = []
        """By their stamps: what is never paired does not stand before what is."""
        self._last = self._due = self._judged = 0
        self._judging: object | None = None

    @property
    def count(self) -> int:
        """Pairs in the window."""
        return self._alarm.count

    @property
    def stamp(self) -> int:
        """Of the newest pair that was judged, ns."""
        return self._judged

    def reset(self) -> None:
        """Forget all pairs, as when the clock jumps or the machine was repaired."""
        self._alarm.reset()
        self._answers.clear()
        self._waiting.clear()
        self._last = self._due = self._judged = 0
        self._judging = None
        self.departures = None

    def answer(self, answer: Answer) -> None:
        """Take what the monitor made of a wrench."""
        latest = self._answers.latest
        if latest is None or answer.stamp >= latest[0]:
            self._answers.push(answer.stamp, answer)
        self._pair()

    def deflection(self, message: Any, now: int) -> None:
        """Take a geometry_msgs/TransformStamped, of the deflected platform.

        :raises MessageError: the message is rejected, and counted.
        """
        with self.refusing(self.taken):
            sample = read_deflection(message, now, self.rules)
            if sample.frame not in self.frames:
                told = " or ".join(map(repr, dict.fromkeys(self.frames)))
                raise MessageError("frame", f"frame is {shown(sample.frame)}, expected {told}")
            check_order(sample.stamp, self._last)
        insort(self._waiting, sample, key=lambda waiting: waiting.stamp)
        self._pair()
        if len(self._waiting) > WAITING:
            self._waiting.pop()
            text = f"{WAITING} deflections are already waiting for the wrench after them"
            self.refuse(self.taken, MessageError("no wrench", text))

    def judgement(self) -> Generator[None, None, bool] | None:
        """A judgement in slices, where it is time for one; else None.

        One at a time. It ends with whether ``departures`` are new: not where all was forgotten
        meanwhile.
        """
        if self._judging is not None or self._due - self._judged < JUDGED * SECOND:
            return None
        self._judged = self._due
        self._judging = object()
        return self._judge(self._judging)

    def _judge(self, mine: object) -> Generator[None, None, bool]:
        try:
            found = yield from self._alarm.judging()
            if self._judging is not mine:
                return False
            self.departures = found
            return True
        finally:
            if self._judging is mine:
                self._judging = None

    def _pair(self) -> None:
        """Pair what waits and has a wrench behind it."""
        latest = self._answers.latest
        while self._waiting and latest is not None and self._waiting[0].stamp <= latest[0]:
            sample = self._waiting.pop(0)
            try:
                self._take(sample)
            except MessageError as error:
                self.refuse(self.taken, error)
                continue
            self._last = sample.stamp
            self.taken.accept()

    def _take(self, sample: DeflectionSample) -> None:
        before, after = self._around(sample.stamp)
        if sample.stamp - self._due < self.period * SECOND:
            return
        span = after.stamp - before.stamp
        part = (sample.stamp - before.stamp) / span if span else 0.0
        wrench = before.wrench + part * (after.wrench - before.wrench)
        near = before if part < 0.5 else after
        values = sample.values
        if sample.frame != self.frames[0]:
            values = in_base_axes(values, near.rotation)
        try:
            self._alarm.push(sample.stamp / SECOND, near.pose, wrench, values)
        except (UnreachableError, SingularityError, ValueError) as error:
            raise MessageError("pose", str(error)) from error
        self._due = sample.stamp

    def _around(self, stamp: int) -> tuple[Answer, Answer]:
        """The wrenches on either side.

        :raises MessageError: there are none near.
        """
        found = self._answers.around(stamp)
        if found is None:
            raise MessageError("no wrench", "no wrenches before and after the deflection")
        age = max(stamp - found[0][0], found[1][0] - stamp) / SECOND
        if age > self.max_age:
            raise MessageError(
                "no wrench",
                f"the wrench next to the deflection is {age:.3f} s away, allowed "
                f"{self.max_age:g} s",
            )
        return found[0][1], found[1][1]
