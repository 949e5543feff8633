# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read time stamps of messages as nanoseconds and decide which stamps are accepted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from pkm_twin.errors import MessageError

SECOND: Final = 1_000_000_000
"""Nanoseconds per second."""

MAX_DURATION: Final = 1_000_000 * SECOND
"""Longest duration of a trajectory, ns: up to here seconds as floats resolve nanoseconds."""


@dataclass(frozen=True)
class StampRules:
    """Accepted differences between a stamp and the node's clock, ns; ``max_age`` None: any age."""

    accept_zero: bool = False
    future_tolerance: int = SECOND // 10
    max_age: int | None = None

    def check(self, stamp: int, now: int) -> int:
        """Check a message's stamp; return it, or ``now`` for a zero stamp if that is accepted.

        :raises MessageError: the stamp is zero, in the future or too old.
        """
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
            # A message waits in a queue for much less than a minute.
            cause = (
                "a replayed bag needs use_sim_time and a /clock"
                if age > (60 * SECOND)
                else "its sender, the network or this computer is overloaded, or clocks differ"
            )
            raise MessageError(
                "stale stamp", f"the stamp is {age / SECOND:.3f} s old, allowed {self.max_age / SECOND:g} s; {cause}"
            )
        return stamp


def stamp_of(header: Any) -> int:
    """Return a header's stamp, ns, after checking that it is a valid time."""
    sec, nanosec = header.stamp.sec, header.stamp.nanosec
    if sec < 0 or not 0 <= nanosec < SECOND:
        raise MessageError("time", f"stamp is {sec} s and {nanosec} ns")
    return int(sec * SECOND + nanosec)
