# SPDX-License-Identifier: Apache-2.0
"""How far members of different limbs stay apart.

A member is a straight round bar, taken as a capsule: all points within its radius of the segment
between its two joints. A mechanism writes one row a member into the scratch space with
:func:`bar`, limb by limb, and :func:`least` compares the members of different limbs. Members of
one limb share joints, so they are not compared. Nor is anything whose shape no parameter tells:
platform and base (rings of joints, no bodies), sliders and their guides, joints' housings, the
crosspieces that carry a parallelogram's two rods.

=========== ===========================================================================
offset      entry of a row
=========== ===========================================================================
0:3         start, m
3:6         vector from start to end, m
6           radius, m
7           half the length, m
8           limb
=========== ===========================================================================

May import: pkm_twin's kernels, the standard library.
"""

from __future__ import annotations

import math
from typing import Final

from pkm_twin.codegen.kernels import scalar

BAR: Final = 9
"""Size of a row."""


@scalar
def bar(s, k, limb, radius, start, end):  # type: ignore[no-untyped-def]
    """Write member k between two points (x, y, z); returns k + 1."""
    o = BAR * k
    x = end[0] - start[0]
    y = end[1] - start[1]
    z = end[2] - start[2]
    s[o] = start[0]
    s[o + 1] = start[1]
    s[o + 2] = start[2]
    s[o + 3] = x
    s[o + 4] = y
    s[o + 5] = z
    s[o + 6] = radius
    s[o + 7] = 0.5 * math.sqrt(x * x + y * y + z * z)
    s[o + 8] = limb
    return k + 1


@scalar
def _clamp(value):  # type: ignore[no-untyped-def]
    return min(1.0, max(0.0, value))


@scalar
def distance(ax, ay, az, ux, uy, uz, bx, by, bz, vx, vy, vz):  # type: ignore[no-untyped-def]
    """Distance (m) of the segments from a along u and from b along v; either may be a point.

    The lines' nearest points, clamped to the first segment, then to the second, then to the
    first again (Ericson, Real-Time Collision Detection, 5.1.9); on parallel lines any first guess
    will do. The lines' common normal comes from a cross product, which stays accurate for
    directions that are nearly parallel.
    """
    wx = bx - ax
    wy = by - ay
    wz = bz - az
    uu = ux * ux + uy * uy + uz * uz
    vv = vx * vx + vy * vy + vz * vz
    nx = uy * vz - uz * vy
    ny = uz * vx - ux * vz
    nz = ux * vy - uy * vx
    nn = nx * nx + ny * ny + nz * nz
    s = 0.0
    if nn > 0.0:
        # (w x v) . n / n . n
        s = (wy * vz - wz * vy) * nx + (wz * vx - wx * vz) * ny + (wx * vy - wy * vx) * nz
        s = _clamp(s / nn)
    t = 0.0
    free = 0.0
    if vv > 0.0:
        free = ((s * ux - wx) * vx + (s * uy - wy) * vy + (s * uz - wz) * vz) / vv
        t = _clamp(free)
    if uu > 0.0 and (t != free or nn == 0.0):
        s = _clamp(((t * vx + wx) * ux + (t * vy + wy) * uy + (t * vz + wz) * uz) / uu)
    dx = wx + t * vx - s * ux
    dy = wy + t * vy - s * uy
    dz = wz + t * vz - s * uz
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@scalar
def least(s, count):  # type: ignore[no-untyped-def]
    """Least distance (m) between the surfaces of members of different limbs, below 0 inside.

    Below zero it is the distance of the axes less the radii: how deep bars are in each other.
    """
    result = math.inf
    for i in range(count - 1):
        a = BAR * i
        # The middle, for a bound that most pairs never come below.
        mx = s[a] + 0.5 * s[a + 3]
        my = s[a + 1] + 0.5 * s[a + 4]
        mz = s[a + 2] + 0.5 * s[a + 5]
        for j in range(i + 1, count):
            b = BAR * j
            if s[a + 8] == s[b + 8]:
                continue
            radii = s[a + 6] + s[b + 6]
            x = s[b] + 0.5 * s[b + 3] - mx
            y = s[b + 1] + 0.5 * s[b + 4] - my
            z = s[b + 2] + 0.5 * s[b + 5] - mz
            near = result + radii + s[a + 7] + s[b + 7]
            if near > 0.0 and x * x + y * y + z * z >= near * near:
                continue
            gap = distance(
                s[a], s[a + 1], s[a + 2], s[a + 3], s[a + 4], s[a + 5],
                s[b], s[b + 1], s[b + 2], s[b + 3], s[b + 4], s[b + 5],
            )  # fmt: skip
            result = min(result, gap - radii)
    return result
