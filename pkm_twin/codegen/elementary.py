# SPDX-License-Identifier: Apache-2.0
"""Coefficients of sine, cosine and arctangent, as all compiled back ends compute them."""

from __future__ import annotations

from typing import Final

# Minimax polynomials of sine and cosine up to a quarter turn, and pi / 2 in three parts
# (Cody and Waite 1980; coefficients as in Cephes, public domain).
SINE: Final = (
    1.58962301576546568060e-10, -2.50507477628578072866e-8, 2.75573136213857245213e-6,
    -1.98412698295895385996e-4, 8.33333333332211858878e-3, -1.66666666666666307295e-1,
)  # fmt: skip
COSINE: Final = (
    -1.13585365213876817300e-11, 2.08757008419747316778e-9, -2.75573141792967388112e-7,
    2.48015872888517045348e-5, -1.38888888888730564116e-3, 4.16666666666665929218e-2,
)  # fmt: skip
MAX_ANGLE: Final = 1e6
"""Sines and cosines of larger angles, rad, are NaN: the reduction by quarter turns loses digits."""
QUARTER: Final = (1.5707963267341256e00, 6.0771005065061922e-11, 2.0222662487959506e-21)
# Arctangent up to 0.66 as x + x z P(z) / Q(z), z = x^2 (Cephes).
ATAN_P: Final = (
    -8.750608600031904122785e-1, -1.615753718733365076637e1, -7.500855792314704667340e1,
    -1.228866684490136173410e2, -6.485021904942025371773e1,
)  # fmt: skip
ATAN_Q: Final = (
    1.0, 2.485846490142306297962e1, 1.650270098316988542046e2, 4.328810604912902668951e2,
    4.853903996359136964868e2, 1.945506571482613964425e2,
)  # fmt: skip
MORE: Final = 6.123233995736765886130e-17
"""pi / 2 less its nearest double."""
