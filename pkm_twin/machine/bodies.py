# SPDX-License-Identifier: Apache-2.0
"""How a mechanism tells the motion of its bodies, and the principle of virtual work over them.

A mechanism's ``motion`` writes one row a body into the scratch space; everything that needs
bodies (torques, energies, reactions) reads these rows. World axes, SI units.

=========== ===========================================================================
offset      entry of a row
=========== ===========================================================================
0           mass, kg
1:4         centre of mass, m
4:7         its acceleration, m/s2
7:10        rate of the angular momentum about it, I alpha + omega x I omega, N m
10:19       its velocity per joint rate, joint by joint: 10 + 3 j + axis
19:28       the body's angular velocity per joint rate: 19 + 3 j + axis
=========== ===========================================================================

After the rows stands the platform's twist at its origin per joint rate: nine numbers of
linear, nine of angular velocity, laid out as in a row.
"""

from __future__ import annotations

import math
from typing import Final

from pkm_twin.codegen.kernels import scalar

ROW: Final = 28
TWIST: Final = 18

# The head of every robot's flat parameters.
GRAVITY: Final = 0
VISCOUS: Final = 3
COULOMB: Final = 6
PAYLOAD_MASS: Final = 9
PAYLOAD_COM: Final = 10
PAYLOAD_INERTIA: Final = 13
HEAD: Final = 22


@scalar
def virtual_work(p, s, bodies, qd, wrench, tau):  # type: ignore[no-untyped-def]
    """Actuator efforts that balance inertia, gravity, friction and the wrench.

    tau = sum over bodies of Jv' m (a - g) + Jw' n, less J_platform' wrench, plus friction
    (Delta-CU paper, step 4; 3-PRRU paper, virtual work). False where a result is not finite.
    """
    for j in range(3):
        tau[j] = p[VISCOUS + j] * qd[j]
        if qd[j] > 0.0:
            tau[j] += p[COULOMB + j]
        elif qd[j] < 0.0:
            tau[j] -= p[COULOMB + j]
    for b in range(bodies):
        o = ROW * b
        m = s[o]
        fx = m * (s[o + 4] - p[0])
        fy = m * (s[o + 5] - p[1])
        fz = m * (s[o + 6] - p[2])
        nx = s[o + 7]
        ny = s[o + 8]
        nz = s[o + 9]
        for j in range(3):
            v = o + 10 + 3 * j
            w = o + 19 + 3 * j
            tau[j] += fx * s[v] + fy * s[v + 1] + fz * s[v + 2]
            tau[j] += nx * s[w] + ny * s[w + 1] + nz * s[w + 2]
    o = ROW * bodies
    for j in range(3):
        v = o + 3 * j
        w = o + 9 + 3 * j
        tau[j] -= wrench[0] * s[v] + wrench[1] * s[v + 1] + wrench[2] * s[v + 2]
        tau[j] -= wrench[3] * s[w] + wrench[4] * s[w + 1] + wrench[5] * s[w + 2]
    return math.isfinite(tau[0] + tau[1] + tau[2])
