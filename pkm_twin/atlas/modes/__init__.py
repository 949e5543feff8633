# SPDX-License-Identifier: Apache-2.0
"""Modes atlas: the lowest natural frequencies over the regular workspace, actuators locked."""

from typing import Final

from pkm_twin.atlas.modes import figures, page
from pkm_twin.atlas.sweep import Kind

KIND: Final = Kind(
    "modes", figures.FIGURES, page.page, page.title,
    help="Left: the frame at rest (grey) and in the chosen mode, enlarged; squares stand on the "
    "ground. The button swings it, the slider stops it. Right: the mode's frequency at places of "
    "the workspace; modes are numbered at each place, lowest first.",
)  # fmt: skip
