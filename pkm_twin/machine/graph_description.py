# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What a file says of a graph: bodies, joints and rods."""

from __future__ import annotations

from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.graph import Body, Graph, Joint
from pkm_twin.machine.joints import TURN


def graph_description(graph: Graph) -> dict[str, Any]:
    """Bodies, joints and rods of a graph.

    A pair of rods that the graph has as one rod is written as one: a joint of the graph has the
    constraint that the pair adds.
    """
    data: dict[str, Any] = {
        "mechanism": "machine",
        "platform": graph.platform,
        "origin": _numbers(graph.origin),
        "bodies": {name: _body_entry(body) for name, body in graph.bodies.items()},
        "joints": {name: _joint_entry(joint) for name, joint in graph.joints.items()},
    }
    if graph.rods:
        data["rods"] = {
            name: {"between": [rod.inner, rod.outer], "ends": [_numbers(end) for end in rod.ends], "mass": rod.mass}
            for name, rod in graph.rods.items()
        }
    return data


def _body_entry(body: Body) -> dict[str, Any]:
    inertia: list[Any] = [_numbers(row) for row in body.inertia]
    if np.count_nonzero(body.inertia - np.diag(np.diag(body.inertia))) == 0:
        inertia = _numbers(np.diag(body.inertia))
    return {"mass": body.mass, "com": _numbers(body.com), "inertia": inertia}


def _joint_entry(joint: Joint) -> dict[str, Any]:
    data: dict[str, Any] = {"type": joint.kind, "between": [joint.inner, joint.outer], "at": _numbers(joint.at)}
    if len(joint.axes) == 1:
        data["axis"] = _numbers(joint.axes[0])
    elif len(joint.axes) == 2:
        data["axes"] = [_numbers(axis) for axis in joint.axes]
    if joint.pitch:
        data["lead"] = joint.pitch * TURN
    if joint.actuated:
        data["actuated"] = True
    # Of a slide the file says where it counts from, lest a leg seems to have no length.
    if joint.home or (joint.actuated and joint.kind == "prismatic"):
        data["home"] = float(joint.home)
    if joint.rotor_inertia:
        data["rotor_inertia"] = joint.rotor_inertia
    if joint.viscous or joint.coulomb:
        data["friction"] = {"viscous": joint.viscous, "coulomb": joint.coulomb}
    return data


def _numbers(values: Array) -> list[float]:
    """List numbers without the rounding that rotations leave in their sixteenth digit."""
    least = 1e-15 * max(1.0, float(np.abs(values).max(initial=0.0)))
    return [0.0 if abs(x) < least else float(x) for x in values]
