# SPDX-License-Identifier: Apache-2.0
"""How the platform moves when the machine's geometry changes and its joints are held.

By the equations of :mod:`pkm_twin.kinematics.maximal`: exact, for any graph.

May import: numpy, pkm_twin's machine, this package, the standard library.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.kinematics.maximal import Equations, GraphChange, Placement
from pkm_twin.machine.graph import Array, Graph
from pkm_twin.machine.rotations import skew

OPEN: Final = 1e-6
"""Part of a change's equations that no motion of the bodies makes up for: it cannot be."""


def platform_twists(
    graph: Graph, q: Array, placement: Placement, changes: Sequence[GraphChange]
) -> tuple[Array, NDArray[np.bool_]]:
    """Displacement of the platform by numbers of the geometry, actuated joints held.

    :param q: joint positions, shape (..., n), rad or m; ``placement``: of the graph there.
    :returns: translation of the reference point and rotation, base axes, by number, shape
        (..., 6, changes): where an overconstrained machine cannot be assembled with a change, the
        displacement that misses least. And which changes can be: those that leave all closures
        closed to first order, in all states.
    """
    equations = Equations(graph, q, placement, changes)
    twists, missed = equations.twists()
    k = equations.bodies[graph.platform]
    twist = twists[..., k : k + 6, :]
    lever = placement.point(graph.platform, graph.origin) - placement.origin[graph.platform]
    origins = np.stack([change.origin for change in changes], -1)
    linear = twist[..., :3, :] - skew(lever) @ twist[..., 3:, :]
    linear = linear + placement.rotation[graph.platform] @ origins
    rows = tuple(range(missed.ndim - 1))
    size = np.abs(equations.by_changes).max(rows, initial=0.0)
    possible = np.abs(missed).max(rows, initial=0.0) <= OPEN * size
    return np.concatenate((linear, twist[..., 3:, :]), -2), np.asarray(possible)
