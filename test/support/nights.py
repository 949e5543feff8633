# SPDX-License-Identifier: Apache-2.0
"""Recordings of one motion, night after night, as examples/nights.py makes them."""

import runpy
from pathlib import Path

night = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "nights.py"))["night"]
