# SPDX-License-Identifier: Apache-2.0
"""``frf`` and ``lobes`` as commands: poses that the machine cannot have are rejected."""

import json

import pytest

from test.support.command import command

MILLING = (
    "--teeth", 2, "--tangential", 600e6, "--radial", 0.3, "--speeds", "9000,10000", "--points", 2,
)  # fmt: skip


@pytest.mark.parametrize("given", [("frf",), ("lobes", *MILLING)], ids=lambda given: given[0])
def test_a_pose_beyond_the_joint_limits_is_rejected_unless_asked_for(capsys, given):
    name, *options = given
    asked = (name, "prru", "--at", "0.4,0,0", *options, "--json")
    refused = command(capsys, *asked)
    assert refused.code == 1
    assert not refused.out
    assert "slider_1" in refused.err
    answered = command(capsys, *asked, "--beyond-limits")
    assert answered.code == 0
    assert "slider_1" in answered.err
    assert json.loads(answered.out)["pose"]["z"] == 0.4
