# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write the C functions that exported programs call, with the numbers of compiled programs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from pkm_twin.codegen.operations import (
    ATAN_P,
    ATAN_Q,
    COSINE,
    HALF_PI,
    HALF_PI_REMAINDER,
    MAX_ANGLE,
    MAX_QUARTER,
    SINE,
    Operation,
    atan2,
    c_number,
    sin,
)


def _write_polynomial(coefficients: Sequence[float]) -> str:
    text = c_number(coefficients[0])
    for c in coefficients[1:]:
        text = f"PKM_FMA({text}, z,\n        {c_number(c)})"
    return text


SINE_COSINE_C: Final = f"""\
/* Sines and cosines: polynomials after Cody and Waite's reduction by quarter turns. NaN where
   the angle is so large that the reduction loses digits. */
static void @_turn(const double *x, double *s, double *c, int count)
{{
    int i;
    for (i = 0; i < count; i++) {{
        const double angle = (fabs(x[i]) < {MAX_ANGLE!r}) ? x[i] : 0.0;
        const int k = (int)((angle * {c_number(2.0 / math.pi)}) + {MAX_QUARTER}.5) - {MAX_QUARTER};
        const double n = -(double)k;
        const double y = PKM_FMA(n, {c_number(HALF_PI[2])},
            PKM_FMA(n, {c_number(HALF_PI[1])}, PKM_FMA(n, {c_number(HALF_PI[0])}, angle)));
        const double z = y * y;
        const double sine = PKM_FMA(z * y, {_write_polynomial(SINE)}, y);
        const double cosine = PKM_FMA(z, -0.5, 1.0) + (z * z) * {_write_polynomial(COSINE)};
        const int even = 1 - (k & 1);
        const int side = 1 - (k & 2);
        const double u = (double)(even * side);
        const double v = (double)((1 - even) * side);
        s[i] = PKM_FMA(u, sine, v * cosine);
        c[i] = PKM_FMA(u, cosine, -(v * sine));
    }}
    for (i = 0; i < count; i++) {{
        if (!(fabs(x[i]) < {MAX_ANGLE!r})) {{
            s[i] = c[i] = (double)NAN;
        }}
    }}
}}
"""


ARCTANGENT_C: Final = f"""\
/* Arctangent of y over x in all quadrants: a quotient of polynomials up to 0.66, beyond it of the
   angle from an eighth turn. */
static double @_atan2(double y, double x)
{{
    const double small = (fabs(y) > fabs(x)) ? fabs(x) : fabs(y);
    const double large = (fabs(y) > fabs(x)) ? fabs(y) : fabs(x);
    const int high = (small * {1 / 0.66!r}) > large;
    const double over = high ? (small - large) : small;
    const double below = high ? (small + large) : large;
    const double u = over / ((below <= 0.0) ? 1.0 : below);
    const double z = u * u;
    const double ratio = {_write_polynomial(ATAN_P)}
        / {_write_polynomial(ATAN_Q)};
    double angle = PKM_FMA(u * z, ratio, u);
    angle = high ? ((angle + {HALF_PI_REMAINDER / 2!r}) + {math.pi / 4!r}) : angle;
    angle = (fabs(y) > fabs(x)) ? (({math.pi / 2!r} - angle) + {HALF_PI_REMAINDER!r}) : angle;
    angle = (copysign(1.0, x) < 0.0) ? (({math.pi!r} - angle) + {2 * HALF_PI_REMAINDER!r}) : angle;
    return copysign(angle, y);
}}
"""


C_FUNCTIONS: Final[Mapping[Operation, str]] = {sin: SINE_COSINE_C, atan2: ARCTANGENT_C}
"""Functions that the text of an operation calls; of sines and cosines together."""
