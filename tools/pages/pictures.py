# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The pictures that the pages' commands draw: ``python -m tools.pages.pictures docs/gallery``.

Those of robots, recordings of nodes and the browser have their own programs.
"""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
from collections.abc import Mapping, Set
from pathlib import Path
from typing import Final

from PIL import Image

from pkm_twin.apps import cli

CYCLE: Final = "path delta --cycle 25,305,25 --fastest --payload 0.5"
MILL: Final = "--teeth 2 --tangential 600e6 --radial 0.3 --immersion 0.5"
PICTURES: Final = {
    "path_limits": f"{CYCLE} --out cycle.mcap",
    "drive_speeds": "size delta cycle.mcap --drives shipped --ratios 5:50 --efficiency 0.9",
    "pick": f"{CYCLE} --out pick.csv",
    "joint_loads": "loads delta pick.csv --payload 0.5",
    "lobes": f"lobes upr_rpu --tool 0,0,-0.1 {MILL} --speeds 3000,20000",
    "map_compliance": "map delta compliance",
    "map_stewart_payload": "map stewart payload",
    "map_upr_rpu_strain-energy": "map upr_rpu strain-energy",
    "map_delta_cu_workspace": "map delta_cu workspace --at 0,0,-0.35",
    "map_five_bar_speeds": "map five_bar speeds",
    "map_prru_isotropy": "map prru isotropy --spheres",
    "map_upr_rpu_modes": "map upr_rpu modes",
}
"""Commands by the picture's name; where one draws several, each has its own ending."""


def draw_pictures(gallery: Path, commands: Mapping[str, str], wanted: Set[str]) -> None:
    """Run the commands in an empty folder, and keep the pictures whose names are wanted.

    :raises SystemExit: a command failed.
    """
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for name, words in commands.items():
            table = f"{name}.nc" if words.startswith("map ") else f"{name}.csv"
            out = [] if " --out " in words or words.startswith("size") else ["--out", table]
            try:
                with contextlib.redirect_stdout(io.StringIO()):
                    cli.main([*words.split(), *out, "--picture", f"{name}.png"])
            except SystemExit as end:
                if end.code:
                    raise
        for found in Path().glob("*.png"):
            if found.name in wanted:
                # 256 colours: a tenth to a third of the size, without a visible difference.
                Image.open(found).convert("RGB").quantize(256).save(gallery / found.name)


if __name__ == "__main__":
    target = Path(sys.argv[1]).resolve()
    draw_pictures(target, PICTURES, {path.name for path in target.iterdir()})
