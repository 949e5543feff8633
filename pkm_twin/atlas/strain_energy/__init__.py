# SPDX-License-Identifier: Apache-2.0
"""Strain-energy atlas: total energy and the elements' factors over the regular workspace."""

from typing import Final

from pkm_twin.atlas.strain_energy import figures, page
from pkm_twin.atlas.sweep import Kind

KIND: Final = Kind(
    "strain-energy", figures.FIGURES, page.page, page.title,
    help="Each slice is one height; the slider shows one alone. The menu chooses the total "
    "energy or one element's part of it.",
)  # fmt: skip
