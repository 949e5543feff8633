# SPDX-License-Identifier: Apache-2.0
"""A judged property: what the commands that judge bags and live topics have in common."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Verdict(StrEnum):
    """Not enough evidence is a verdict of its own."""

    GOOD = "good"
    BAD = "bad"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class Item:
    """One judged property: its value against its bound, in words."""

    what: str
    value: str
    bound: str
    verdict: Verdict
