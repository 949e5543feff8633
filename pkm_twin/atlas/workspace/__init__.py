# SPDX-License-Identifier: Apache-2.0
"""Workspace atlas: what a machine reaches, how far from a singularity, and the regular part."""

from typing import Final

from pkm_twin.atlas.sweep import Kind
from pkm_twin.atlas.workspace import figures, page

KIND: Final = Kind(
    "workspace", figures.FIGURES, page.page, page.title,
    help="Reachable poses, coloured by the singularity index: 0 in a singularity, 1 at best. The "
    "menu chooses what is shown, the slider one layer alone.",
)  # fmt: skip
