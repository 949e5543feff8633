# SPDX-License-Identifier: Apache-2.0
"""Memory under requests that are far too long: refused, and none of it kept."""

from pathlib import Path

import pytest

pytest.importorskip("rclpy", exc_type=ImportError)

from rcl_interfaces.srv import GetParameters

from test.nodes.harness import REPOSITORY

PROFILE = REPOSITORY / "docs" / "security" / "memory.xml"
LENGTH, COUNT = 20_000, 2_000
MEGABYTES = LENGTH * COUNT / 1e6


def resident(process):
    """Memory of a process, MB."""
    lines = Path(f"/proc/{process.process.pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1e3 for line in lines if line.startswith("VmRSS"))


@pytest.mark.long
@pytest.mark.parametrize("freed", [False, True])
def test_requests_that_are_too_long_do_not_add_up(launch_alone, peer, monkeypatch, freed):
    """By default the middleware keeps one buffer; with the profile of docs/security.md none."""
    if freed:
        monkeypatch.setenv("RMW_FASTRTPS_USE_QOS_FROM_XML", "1")
        monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(PROFILE))
    node = launch_alone("delta_dynamics.node", fresh=True)
    service = "/delta_dynamics/get_parameters"
    few = GetParameters.Request(names=["payload.mass"])
    assert len(peer.call(GetParameters, service, few).values) == 1
    before = resident(node)
    many = GetParameters.Request(names=["x" * LENGTH] * COUNT)
    for _ in range(4):
        assert not peer.call(GetParameters, service, many).values
    assert len(peer.call(GetParameters, service, few).values) == 1
    kept = resident(node) - before
    assert kept < 0.5 * MEGABYTES if freed else 0.5 * MEGABYTES < kept < 2.0 * MEGABYTES
