# SPDX-License-Identifier: Apache-2.0
"""Deprecated: the old name of :mod:`pkm_twin.robot.robot`; it goes with the next release."""

import warnings
from importlib import import_module
from typing import Any


def __getattr__(name: str) -> Any:
    home = "mechanism" if name == "Inverse" else "robot"
    value = getattr(import_module(f"pkm_twin.robot.{home}"), name)
    warnings.warn(
        "pkm_twin.machine.robot is deprecated; import from pkm_twin.robot.robot",
        DeprecationWarning,
        stacklevel=2,
    )
    return value
