# SPDX-License-Identifier: Apache-2.0
"""pkm_twin: the digital twin of parallel kinematic machines."""

from pkm_twin.machine.catalogue import load, robot_names
from pkm_twin.machine.robot import Robot

__all__ = ["Robot", "load", "robot_names"]
__version__ = "0.1.0"
