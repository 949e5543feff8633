# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""pkm_twin: the digital twin of parallel kinematic machines."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from delta_dynamics.torques.transmission import transmission
    from pkm_twin.design.variants import variants
    from pkm_twin.mechanisms.catalogue import load, robot_names
    from pkm_twin.robot.derivatives import forward_derivatives, inverse_derivatives, platform_derivatives
    from pkm_twin.robot.robot import Robot

__all__ = [
    "Robot",
    "forward_derivatives",
    "inverse_derivatives",
    "load",
    "platform_derivatives",
    "robot_names",
    "transmission",
    "variants",
]

_MODULES = {
    "Robot": "pkm_twin.robot.robot",
    "forward_derivatives": "pkm_twin.robot.derivatives",
    "inverse_derivatives": "pkm_twin.robot.derivatives",
    "platform_derivatives": "pkm_twin.robot.derivatives",
    "load": "pkm_twin.mechanisms.catalogue",
    "robot_names": "pkm_twin.mechanisms.catalogue",
    "transmission": "delta_dynamics.torques.transmission",
    "variants": "pkm_twin.design.variants",
}
"""Module of each public name, imported on first use: commands and nodes handle signals before numpy loads."""


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version(__name__)
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
