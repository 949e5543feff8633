# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``frf`` and ``lobes`` as commands: poses that the machine cannot have are rejected."""

import pytest
import yaml

from test.commands.conftest import REPOSITORY

MILLING = (
    "--teeth",
    2,
    "--tangential",
    600e6,
    "--radial",
    0.3,
    "--speeds",
    "9000,10000",
    "--points",
    2,
)


each = pytest.mark.parametrize("given", [("frf",), ("lobes", *MILLING)], ids=lambda given: given[0])


@each
def test_a_pose_beyond_the_joint_limits_is_rejected_unless_asked_for(twin, given):
    name, *options = given
    asked = (name, "prru", "--at", "0.4,0,0", *options)
    refused = twin.good(*asked, "--json", code=1)
    assert not refused.out and "slider_1" in refused.err
    answered = twin.good(*asked, "--json", "--beyond-limits")
    assert "slider_1" in answered.err
    assert twin.told(*asked, "--beyond-limits")["pose"]["z"] == 0.4


@each
def test_a_platform_on_a_rigid_chain_is_rejected_with_the_joint_to_soften(twin, tmp_path, given):
    """A Tricept whose passive chain is rigid."""
    name, *options = given
    data = yaml.safe_load((REPOSITORY / "examples/machines/tricept.yaml").read_text())
    file = tmp_path / "tricept.yaml"
    elastic = {joint: data["joints"][joint].pop("compliance") for joint in ("gimbal", "slide")}
    del data["bodies"]["platform"]["member"]
    file.write_text(yaml.safe_dump({**data, "modal_damping": [0.03]}))
    assert "joints.gimbal.compliance" in twin.refused(name, file, *options)
    data["joints"]["gimbal"]["compliance"] = elastic["gimbal"]
    file.write_text(yaml.safe_dump({**data, "modal_damping": [0.03]}))
    twin.good(name, file, *options)


def test_natural_frequencies_need_no_damping(twin, tmp_path):
    data = yaml.safe_load((REPOSITORY / "config/five_bar.yaml").read_text())
    whole = twin.told("frf", "five_bar")["modes"]
    del data["modal_damping"]
    file = tmp_path / "five_bar.yaml"
    file.write_text(yaml.safe_dump(data))
    found = twin.told("frf", file)["modes"]
    hertz = [[mode["frequency_hz"] for mode in modes] for modes in (found, whole)]
    assert hertz[0] == pytest.approx(hertz[1], rel=1e-9)
    assert "modal_damping" in twin.refused("frf", file, "--out", tmp_path / "frf.csv")
