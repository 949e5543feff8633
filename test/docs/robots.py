# SPDX-License-Identifier: Apache-2.0
"""The gallery's pictures of all robots: ``python -m test.docs.robots docs/gallery``."""

from __future__ import annotations

import sys
from pathlib import Path

from pkm_twin import load, robot_names
from pkm_twin.apps.drawing import picture

if __name__ == "__main__":
    for name in robot_names():
        picture(load(name), Path(sys.argv[1]) / f"robot_{name}.png")
