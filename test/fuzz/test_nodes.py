# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What nobody would send, at real nodes, for ``FUZZ_SECONDS`` from ``FUZZ_SEED`` on.

Where ``FUZZ_OUT`` names a folder, the figures go there.
"""

import json
import os
from pathlib import Path

import pytest

from test.nodes.conftest import domain, launch, peer  # noqa: F401

pytest.importorskip("rclpy", exc_type=ImportError)

from test.fuzz.__main__ import NODES
from test.fuzz.nodes import fuzz_nodes

SECONDS = float(os.environ.get("FUZZ_SECONDS", "10"))
SEED = int(os.environ.get("FUZZ_SEED", "1"))
OUT = os.environ.get("FUZZ_OUT", "")

pytestmark = [pytest.mark.long, pytest.mark.timeout(180 + 2 * SECONDS)]


def test_nodes(peer, launch):  # noqa: F811
    found = fuzz_nodes(peer, launch, SECONDS, SEED)
    if OUT:
        folder = Path(OUT)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / NODES).write_text(json.dumps(found, indent=2) + "\n")
    assert found["torques"] > 0
