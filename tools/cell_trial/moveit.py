# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Load the MoveIt configuration of every robot by MoveIt's own parsers.

    python3 tools/cell_trial/moveit.py [ROBOT ...]

Needs a sourced workspace with pkm_twin, srdfdom, and tools/cell_trial/srdf_loader built with
colcon.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

from ament_index_python.packages import get_package_prefix
from cell import find_executable

from pkm_twin import robot_names


def loaded(robot: str, folder: Path) -> bool:
    """Export a robot's configuration and load its URDF and SRDF."""
    package = folder / robot
    subprocess.run(
        [find_executable("pkm-twin"), "export", "moveit", robot, "--out", str(package)],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    loader = Path(get_package_prefix("pkm_srdf_loader"), "lib", "pkm_srdf_loader", "load_srdf")
    (urdf,), (srdf,) = (list((package / "config").glob(f"*.{kind}")) for kind in ("urdf", "srdf"))
    done = subprocess.run([loader, urdf, srdf], capture_output=True, text=True, check=False)
    print((done.stdout + done.stderr).strip(), flush=True)
    return done.returncode == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("robots", nargs="*", default=list(robot_names()), help="default: all")
    with tempfile.TemporaryDirectory() as folder:
        good = [loaded(robot, Path(folder)) for robot in parser.parse_args().robots]
    print(f"{sum(good)} of {len(good)} loaded without a warning")
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
