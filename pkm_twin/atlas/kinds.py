# SPDX-License-Identifier: Apache-2.0
"""All kinds of atlas, and their pictures and pages by the kind that a file says."""

from __future__ import annotations

import html
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from pkm_twin.atlas import isotropy, modes, pages, plots, strain_energy, workspace
from pkm_twin.atlas.maps import figures as maps
from pkm_twin.atlas.store import reading, writing
from pkm_twin.atlas.sweep import Kind
from pkm_twin.errors import UnknownNameError
from pkm_twin.files import replace_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import Dataset

KINDS: Final[Mapping[str, Kind]] = MappingProxyType(
    {module.KIND.name: module.KIND for module in (workspace, strain_energy, isotropy, modes)}
)


def kind_of(atlas: Dataset) -> Kind:
    """The kind of a stored atlas.

    :raises UnknownNameError: a kind that this version does not know.
    """
    name = str(atlas.attrs["kind"])
    if "map" in atlas.attrs:
        return maps.KIND
    if name not in KINDS:
        raise UnknownNameError("map", name, tuple(KINDS))
    return KINDS[name]


def draw(atlas: Dataset) -> dict[str, Figure]:
    """All figures of an atlas: name to matplotlib figure.

    :param atlas: an ``xarray.Dataset`` of ``open_atlas``.
    :raises UnknownNameError: a kind without pictures.
    """
    kind = kind_of(atlas)
    with reading(source(atlas)):
        return {name: figure(atlas) for name, figure in kind.figures.items()}


def source(atlas: Dataset) -> Path:
    """The file that an atlas came from, for errors."""
    return Path(str(atlas.encoding.get("source", "atlas")))


def save_all(atlas: Dataset, out: Path) -> list[Path]:
    """Write all figures as PNG beside a path, ``<stem>_<figure>.png``."""
    return [
        plots.save(figure, out.with_name(f"{out.stem}_{name}.png"))
        for name, figure in draw(atlas).items()
    ]


def write_page(atlas: Dataset, path: Path) -> Path:
    """Write an atlas as one HTML file that needs no network: plotly's script is inside.

    :param atlas: an ``xarray.Dataset`` of ``open_atlas``.
    :raises MissingExtraError: plotly is not installed.
    """
    kind = kind_of(atlas)
    with reading(source(atlas)):
        drawn = kind.page(atlas).update_layout(title=pages.TITLE)
    plot = drawn.to_html(
        include_plotlyjs=True,
        full_html=False,
        config=pages.CONFIG,
        default_width="100%",
        default_height="100%",
        auto_play=False,
        post_script=pages.FIT,
    )
    text = pages.SHELL.format(
        title=html.escape(kind.title(atlas)),
        plot=plot,
        help=html.escape(kind.help),
        width=pages.LEAST,
        below=drawn.layout.meta["below"] - 1,
        tall=pages.TALL if len(list(drawn.select_scenes())) > 1 else 0,
    )
    with writing(path):
        replace_file(path, text.encode())
    return path
