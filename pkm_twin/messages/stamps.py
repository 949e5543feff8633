# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Time stamps and durations of messages: nanoseconds, and which stamps are accepted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from pkm_twin.errors import MessageError

SECOND: Final = 1_000_000_000

REPLAYED: Final = 60 * SECOND
"""Age of a stamp beyond which it is one of a recording, ns: no queue holds a message so long."""
MAX_DURATION: Final = 1_000_000 * SECOND
"""Bounds beyond all machines of this kind, for values that no limit of the robot bounds."""


@dataclass(frozen=True)
class StampRules:
    """What a stamp has to keep to, relative to the node's clock; ns, None where unchecked."""

    accept_zero: bool = False
    future_tolerance: int = SECOND // 10
    max_age: int | None = None

    def check(self, stamp: int, now: int) -> int:
        """The stamp to use: the message's, or the arrival time where zero is accepted."""
        if stamp == 0:
            if self.accept_zero:
                return now
            raise MessageError("zero stamp", "the stamp is zero; set accept_zero_stamp to allow it")
        if stamp > now + self.future_tolerance:
            hint = "; use_sim_time is set and no /clock arrives?" if now == 0 else ""
            raise MessageError(
                "future stamp",
                f"the stamp is {(stamp - now) / SECOND:.3f} s ahead of the clock, "
                f"allowed {self.future_tolerance / SECOND:g} s{hint}",
            )
        if self.max_age is not None and stamp < now - self.max_age:
            age = now - stamp
            cause = (
                "a replayed bag needs use_sim_time and a /clock"
                if age > REPLAYED
                else "its sender, the network or this computer is overloaded, or clocks differ"
            )
            raise MessageError(
                "stale stamp",
                f"the stamp is {age / SECOND:.3f} s old, allowed {self.max_age / SECOND:g} s; "
                f"{cause}",
            )
        return stamp


def stamp_of(header: Any) -> int:
    """A header's stamp in nanoseconds, checked to be a valid time."""
    return _nanoseconds("stamp", header.stamp)


def _nanoseconds(what: str, time: Any) -> int:
    sec, nanosec = time.sec, time.nanosec
    if sec < 0 or not 0 <= nanosec < SECOND:
        raise MessageError("time", f"{what} is {sec} s and {nanosec} ns")
    return int(sec * SECOND + nanosec)
