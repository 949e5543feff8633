# SPDX-License-Identifier: Apache-2.0
"""Dynamic-isotropy atlas: on every pose of a grid a sphere of directions, coloured by an index."""

from typing import Final

from pkm_twin.atlas.isotropy import figures, page
from pkm_twin.atlas.sweep import Kind

KIND: Final = Kind(
    "isotropy", figures.FIGURES, page.page, page.title,
    help="A sphere is all directions of the pose rates at one pose; it looks the same from behind. "
    "A few values beyond the ends of the colours have the end's colour.",
)  # fmt: skip
