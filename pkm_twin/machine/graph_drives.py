# SPDX-License-Identifier: Apache-2.0
"""Friction and limits of a machine's drives: of its joints' entries, and back into them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.friction import all_keys
from pkm_twin.machine.graph import Graph, array
from pkm_twin.machine.graph_file import FrictionSpec, JointSpec, LimitSpec
from pkm_twin.machine.sections import friction_of, limits_of


def drives_of(graph: Graph, joints: Mapping[str, JointSpec]) -> dict[str, Any]:
    """Friction and limits of the actuated joints."""
    drives = graph.actuated
    limits = [joints[j].limits or LimitSpec() for j in drives]
    rubs = [joints[j].friction or FrictionSpec() for j in drives]
    n = len(drives)
    return {
        "friction": friction_of(n)(
            **{key: array([getattr(rub, key) for rub in rubs]) for key in all_keys()}
        ),
        "limits": limits_of(n)(
            position=_together([v.position for v in limits], [-math.inf, math.inf]),
            velocity=_together([v.velocity for v in limits], math.inf),
            effort=_together([v.effort for v in limits], math.inf),
        ),
    }


def driven(joint: JointSpec, friction: Any, limits: Any, k: int) -> JointSpec:
    """The entry of the actuated joint k with friction and limits as :func:`drives_of` gives them.

    A limit may be one for all joints.
    """
    n = len(friction.viscous)
    position = limits.position
    velocity, effort = (
        None if value is None else float(np.broadcast_to(value, n)[k])
        for value in (limits.velocity, limits.effort)
    )
    bounds = LimitSpec(
        position=None if position is None else array(np.broadcast_to(position, (n, 2))[k]),
        velocity=velocity,
        effort=effort,
    )
    rub = FrictionSpec(**{key: float(getattr(friction, key)[k]) for key in all_keys()})
    return dataclasses.replace(joint, friction=rub, limits=bounds)


def _together(values: list[Any], absent: Any) -> Array | None:
    """One array of what joints have; None where none has it."""
    if all(value is None for value in values):
        return None
    return array([absent if value is None else value for value in values])
