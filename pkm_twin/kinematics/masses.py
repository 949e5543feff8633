# SPDX-License-Identifier: Apache-2.0
"""Whether every actuated joint moves a mass."""

from __future__ import annotations

import math

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.motion import matrices, numbers
from pkm_twin.kinematics.scheme import Scheme
from pkm_twin.machine.graph import BASE, Graph


def check_masses(scheme: Scheme, graph: Graph) -> None:
    """Refuse actuated joints that move no mass at all.

    :param graph: has the masses; the scheme's own graph may have those of another machine.
    :raises ParameterError: by a massless body that must move alone.
    """
    motion, rows = scheme.at(scheme.tree.home, graph.home)
    ju, jq = (numbers(m) for m in matrices(scheme.tree, rows))
    moved = -np.linalg.solve(ju[scheme.kept], jq[scheme.kept])
    n = len(graph.actuated)
    table = []
    for j in range(n):
        motion.set_rates(moved[:, j], np.eye(n)[j])
        column = [
            np.sqrt(graph.joints[name].rotor_inertia) * np.eye(n)[j][k]
            for k, name in enumerate(graph.actuated)
        ]
        for body in graph.bodies.values():
            root = _root(body.inertia)
            column += [*(math.sqrt(body.mass) * numbers(motion.velocity(body.name, body.com)))]
            column += [*(root @ numbers(motion.omega[body.name]))]
        for rod in graph.rods.values():
            ends = zip((rod.inner, rod.outer), rod.ends, strict=True)
            for body_name, end in ends:
                column += [*(math.sqrt(rod.mass) * numbers(motion.velocity(body_name, end)))]
        table.append(column)
    values = np.array(table, float)
    size = np.linalg.norm(values, axis=1, keepdims=True)
    if (size > 0.0).all() and np.linalg.matrix_rank(values / size, 1e-6) == n:
        return
    joint = graph.joints[graph.actuated[int(np.argmin(size))]]
    idle = next((b for b in (joint.outer, joint.inner) if b != BASE), graph.platform)
    raise ParameterError(
        f"bodies.{idle}.mass", graph.bodies[idle].mass,
        f"mass or rotor_inertia that resists {joint.name}: no massless body can move alone",
    )  # fmt: skip


def _root(inertia: Array) -> Array:
    """A matrix whose square is a symmetric one."""
    values, vectors = np.linalg.eigh(inertia)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T, np.float64)
