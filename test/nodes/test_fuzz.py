# SPDX-License-Identifier: Apache-2.0
"""What nobody would send, for ``FUZZ_SECONDS`` each, from ``FUZZ_SEED`` on."""

import json
import os

import pytest

pytest.importorskip("rclpy", exc_type=ImportError)

from test.nodes.fuzz import fuzz_cores, fuzz_nodes

SECONDS = float(os.environ.get("FUZZ_SECONDS", "10"))
SEED = int(os.environ.get("FUZZ_SEED", "1"))
LIMIT = 120 + 2 * SECONDS

pytestmark = [pytest.mark.long, pytest.mark.timeout(LIMIT)]


def test_cores(capsys):
    counts = fuzz_cores(SECONDS, SEED)
    with capsys.disabled():
        print(f"\ncores, seed {SEED}: {counts.total()} messages {json.dumps(counts)}")
    assert counts["answered"] > 0


def test_nodes(peer, launch, capsys):
    counts = fuzz_nodes(peer, launch, SECONDS, SEED)
    with capsys.disabled():
        print(f"\nnodes, seed {SEED}: {json.dumps(counts)}")
    assert counts["requests without an answer"] <= 1
