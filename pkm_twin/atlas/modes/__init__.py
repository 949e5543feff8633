# SPDX-License-Identifier: Apache-2.0
"""Modes atlas: the lowest natural frequencies over the largest cylinder, actuators locked."""

from typing import Final

from pkm_twin.atlas.modes import figures, page
from pkm_twin.atlas.sweep import Kind

KIND: Final = Kind(
    "modes", figures.FIGURES, page.page, page.title,
    help="First plot: the frame at rest (grey) and in the chosen mode, magnified; squares are on "
    "the ground. The button animates it, the slider stops it. Second plot: the frequency of the "
    "mode over the workspace; at each pose the modes are numbered from the lowest frequency.",
)  # fmt: skip
