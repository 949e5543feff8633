# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Describe a graph as sections of a robot file: bodies, joints and rods."""

from __future__ import annotations

from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.graph import Graph
from pkm_twin.machine.joints import TURN


def graph_description(graph: Graph) -> dict[str, Any]:
    """Describe a graph's bodies, joints and rods as sections of a robot file.

    A pair of rods that the graph has as one rod is written as one: the constraint that the pair adds
    is in a joint of the graph.
    """
    bodies: dict[str, Any] = {}
    for name, body in graph.bodies.items():
        diagonal = np.diag(body.inertia)
        inertia: list[Any] = [_round_numbers(row) for row in body.inertia]
        if not np.any(body.inertia - np.diag(diagonal)):
            inertia = _round_numbers(diagonal)
        bodies[name] = {"mass": body.mass, "com": _round_numbers(body.com), "inertia": inertia}
    joints = {}
    for name, joint in graph.joints.items():
        entry: dict[str, Any] = {
            "type": joint.kind,
            "between": [joint.inner, joint.outer],
            "at": _round_numbers(joint.at),
        }
        axes = [_round_numbers(axis) for axis in joint.axes]
        if axes:
            entry |= {"axis": axes[0]} if len(axes) == 1 else {"axes": axes}
        if joint.pitch:
            entry["lead"] = joint.pitch * TURN
        if joint.actuated:
            entry["actuated"] = True
        # The file states where a slide counts from, so that a leg does not seem to have no length.
        if joint.home or (joint.actuated and joint.kind == "prismatic"):
            entry["home"] = float(joint.home)
        if joint.rotor_inertia:
            entry["rotor_inertia"] = joint.rotor_inertia
        if joint.viscous or joint.coulomb:
            entry["friction"] = {"viscous": joint.viscous, "coulomb": joint.coulomb}
        joints[name] = entry
    rods = {
        name: {"between": [rod.inner, rod.outer], "ends": [_round_numbers(end) for end in rod.ends], "mass": rod.mass}
        for name, rod in graph.rods.items()
    }
    data = {"mechanism": "machine", "platform": graph.platform, "origin": _round_numbers(graph.origin)}
    return data | {"bodies": bodies, "joints": joints} | ({"rods": rods} if rods else {})


def _round_numbers(values: Array) -> list[float]:
    """List numbers without the rounding that rotations leave in their sixteenth digit."""
    least = 1e-15 * max(1.0, float(np.abs(values).max(initial=0.0)))
    return [0.0 if abs(x) < least else float(x) for x in values]
