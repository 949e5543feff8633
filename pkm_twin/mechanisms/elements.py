# SPDX-License-Identifier: Apache-2.0
"""How a mechanism tells its elastic elements, and the strain-energy method over them.

A mechanism writes one block a limb into the scratch space; everything elastic (stiffness,
compliance, deflection, energies) reads these blocks. A limb carries three wrenches, of amplitudes
W_i, and has three elements in series. World axes at the platform's origin o, SI units.

=========== ===========================================================================
offset      entry of a block
=========== ===========================================================================
0:18        J_i, the limb's three unit wrenches at o, wrench by wrench: 6 k + row
18:27       C_i1, compliance of the limb's first element on W_i, row-major
27:36       C_i2, of its second
36:45       C_i3, of its third
=========== ===========================================================================

Then K = sum of J_i (C_i1 + C_i2 + C_i3)^-1 J_i' (2UPR-RPU paper, equation 34).
"""

from __future__ import annotations

import math
from typing import Final

from pkm_twin.codegen.kernels import NOT_FINITE, SINGULAR, scalar
from pkm_twin.machine.robot import SINGULARITY_BOUND

BLOCK: Final = 45
ELEMENTS: Final = 9
WRENCH: Final = 6
"""Where the fault NOT_FINITE has this for a limb, it is the wrench that is not finite."""
TIE: Final = 1e-9
"""Two energies tie where they differ by less than this part of the larger one."""

_ROOT: Final = 3 * BLOCK
"""Lower Cholesky factors of the limbs' compliances, nine numbers a limb."""
_SOLVED: Final = _ROOT + 27
"""Those factors' inverses times J_i', eighteen numbers a limb, laid out as J_i."""
_FACTOR: Final = _SOLVED + 54
"""Lower Cholesky factor of K, row-major."""
_WORK: Final = _FACTOR + 36
SCRATCH: Final = _WORK + 36


@scalar
def _cholesky(s, o, n):  # type: ignore[no-untyped-def]
    """Factor the symmetric n x n matrix at s[o] in place, lower triangle.

    Returns the least pivot over its diagonal entry, which no choice of units changes: 1 for a
    diagonal matrix, 0 or less for one that is not positive definite, where it stops.
    """
    least = 1.0
    for j in range(n):
        diagonal = s[o + n * j + j]
        pivot = diagonal
        for k in range(j):
            pivot -= s[o + n * j + k] * s[o + n * j + k]
        # Written so that NaN fails, too.
        if not (diagonal > 0.0 and pivot > 0.0 and diagonal < math.inf):
            return 0.0
        least = min(least, pivot / diagonal)
        root = math.sqrt(pivot)
        s[o + n * j + j] = root
        for i in range(j + 1, n):
            value = s[o + n * i + j]
            for k in range(j):
                value -= s[o + n * i + k] * s[o + n * j + k]
            s[o + n * i + j] = value / root
    return least


@scalar
def factorise(s, fault):  # type: ignore[no-untyped-def]
    """Stiffness of the blocks in s and its Cholesky factor; False where not positive definite."""
    for i in range(36):
        s[_FACTOR + i] = 0.0
    for limb in range(3):
        o = BLOCK * limb
        r = _ROOT + 9 * limb
        m = _SOLVED + 18 * limb
        for k in range(9):
            s[r + k] = s[o + 18 + k] + s[o + 27 + k] + s[o + 36 + k]
        measure = _cholesky(s, r, 3)
        if not measure > SINGULARITY_BOUND:
            fault[0] = SINGULAR
            fault[1] = limb
            fault[2] = measure
            return False
        for row in range(6):
            for k in range(3):
                value = s[o + 6 * k + row]
                for h in range(k):
                    value -= s[r + 3 * k + h] * s[m + 6 * h + row]
                s[m + 6 * k + row] = value / s[r + 4 * k]
        for k in range(3):
            for i in range(6):
                for j in range(i + 1):
                    s[_FACTOR + 6 * i + j] += s[m + 6 * k + i] * s[m + 6 * k + j]
    measure = _cholesky(s, _FACTOR, 6)
    if not measure > SINGULARITY_BOUND:
        fault[0] = SINGULAR
        fault[2] = measure
        return False
    return True


@scalar
def invert(s, c):  # type: ignore[no-untyped-def]
    """C = K^-1 from the factor in s, row-major into c, exactly symmetric."""
    f = _FACTOR
    w = _WORK
    for j in range(6):
        for i in range(j):
            s[w + 6 * i + j] = 0.0
        s[w + 6 * j + j] = 1.0 / s[f + 7 * j]
        for i in range(j + 1, 6):
            value = 0.0
            for k in range(j, i):
                value -= s[f + 6 * i + k] * s[w + 6 * k + j]
            s[w + 6 * i + j] = value / s[f + 7 * i]
    for i in range(6):
        for j in range(i + 1):
            value = 0.0
            for k in range(i, 6):
                value += s[w + 6 * k + i] * s[w + 6 * k + j]
            c[6 * i + j] = value
            c[6 * j + i] = value


@scalar
def divide(s, wrench, deflection, energies, factors, summary, fault):  # type: ignore[no-untyped-def]
    """Deflection, element energies (J), their parts of the total; the factor of K stands in s.

    Delta = C P, W_i = C_i^-1 J_i' Delta, U_ie = W_i' C_ie W_i / 2 (2UPR-RPU paper, equations 36
    to 38). ``summary``: total energy (J), index of the dominant element (-1 without load), and
    1 where the largest two energies tie. A tie goes to the first element in order. A wrench
    that is not finite, or whose energy is not, is the fault NOT_FINITE of "limb" WRENCH.
    """
    if not math.isfinite(wrench[0] + wrench[1] + wrench[2] + wrench[3] + wrench[4] + wrench[5]):
        fault[0] = NOT_FINITE
        fault[1] = WRENCH
        return
    scale = 0.0
    for i in range(6):
        scale = max(scale, abs(wrench[i]))
    summary[0] = 0.0
    summary[1] = -1.0
    summary[2] = 0.0
    for i in range(6):
        deflection[i] = 0.0
    for e in range(ELEMENTS):
        energies[e] = 0.0
        factors[e] = 0.0
    if scale == 0.0:
        return
    f = _FACTOR
    w = _WORK
    # Of unit size, so that squares of tiny and huge loads neither vanish nor overflow.
    for i in range(6):
        value = wrench[i] / scale
        for k in range(i):
            value -= s[f + 6 * i + k] * s[w + k]
        s[w + i] = value / s[f + 7 * i]
    for n in range(6):
        i = 5 - n
        value = s[w + i]
        for k in range(i + 1, 6):
            value -= s[f + 6 * k + i] * s[w + k]
        s[w + i] = value / s[f + 7 * i]
    total = 0.0
    for limb in range(3):
        o = BLOCK * limb
        r = _ROOT + 9 * limb
        m = _SOLVED + 18 * limb
        a = w + 6
        for k in range(3):
            value = 0.0
            for row in range(6):
                value += s[m + 6 * k + row] * s[w + row]
            s[a + k] = value
        for n in range(3):
            k = 2 - n
            value = s[a + k]
            for h in range(k + 1, 3):
                value -= s[r + 3 * h + k] * s[a + h]
            s[a + k] = value / s[r + 4 * k]
        for e in range(3):
            c = o + 18 + 9 * e
            value = 0.0
            for i in range(3):
                for j in range(3):
                    value += s[a + i] * s[c + 3 * i + j] * s[a + j]
            # An element without load can round to just below zero.
            value = max(0.0, 0.5 * value)
            factors[3 * limb + e] = value
            total += value
    largest = 0.0
    for e in range(ELEMENTS):
        energies[e] = factors[e] * scale * scale
        factors[e] /= total
        largest = max(largest, factors[e])
    first = -1.0
    for e in range(ELEMENTS):
        if factors[e] > largest * (1.0 - TIE):
            if first < 0.0:
                first = e
            else:
                summary[2] = 1.0
    summary[0] = total * scale * scale
    if not math.isfinite(summary[0]):
        fault[0] = NOT_FINITE
        fault[1] = WRENCH
    summary[1] = first
    for i in range(6):
        deflection[i] = s[w + i] * scale
