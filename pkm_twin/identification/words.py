# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Words for delays and scales of recorded efforts, and the sizes that are usual."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from pkm_twin.errors import one_line

USUAL_SCALE: Final = 1.22
"""Scale, or its inverse, up to which a drive's constant is usual: 4.5 deviations of 5 %."""
MAX_DELAY: Final = 0.05
"""Delay of efforts that a recording may have, s: buffers of a bus and a filter."""
EFFORT_UNITS: Final = {"N mm or mN m": 1e3, "kgf or kgf m": 1.0 / 9.80665}
"""Units of efforts that messages name: how many of each are a newton or a newton metre."""


def is_usual_scale(scale: float) -> bool:
    """Return whether efforts of a scale can be a machine's: it is nearly right."""
    return 1.0 / USUAL_SCALE < scale < USUAL_SCALE


def write_unreachable(error: Exception) -> str:
    """Describe positions that the machine cannot take, by its error."""
    return one_line(f"{error} (positions of this machine, in rad and m?)")


def write_late(names: str, late: float) -> str:
    """Describe efforts that are late or early against the positions."""
    return f"efforts of {names} are {abs(late):.2g} s {'late' if late > 0 else 'early'}"


def write_scale(names: str, scale: float, *others: str) -> str:
    """Describe efforts that are a constant factor off, and the other causes that would explain it."""
    sign = " and of the wrong sign" if scale < 0.0 else ""
    alike = "".join(f"; or {other}" for other in others)
    alike += ", the recording cannot tell" if others else ""
    unit = "".join(f" ({name}?)" for name, size in EFFORT_UNITS.items() if 0.9 < abs(scale) / size < 1.1)
    return (
        f"efforts of {names} are {abs(scale):.3g} times what the robot's file makes of the motion"
        f"{sign}: units? N m and N{unit}" + alike
    )


def join_names(names: Sequence[str], count: int) -> str:
    """Return joint names as text: "all joints" if they are all ``count`` of them."""
    return "all joints" if len(names) == count > 1 else " and ".join(names)
