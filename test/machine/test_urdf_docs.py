# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The blocks of docs/urdf.md are read as they stand there."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from pkm_twin.errors import ParameterError
from pkm_twin.robot.urdf_read import read_urdf

PAGE = Path(__file__).parents[2] / "docs" / "urdf.md"
XML = re.findall(r"```xml\n(.*?)```", PAGE.read_text(), re.DOTALL)
YAML = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(), re.DOTALL)


def read(tmp_path, *parts, beside=None):
    path = tmp_path / "five_bar.urdf"
    path.write_text(XML[0].replace("</robot>", "".join(parts) + "</robot>"))
    if beside:
        path.with_suffix(".yaml").write_text(beside)
    return read_urdf(path)


def test_the_blocks_say_the_same_machine(tmp_path):
    _, constraint, loop, control = XML
    first, second = read(tmp_path, constraint, control), read(tmp_path, loop, control)
    assert first == second
    end = (
        '<link name="tip_2"/><joint name="end" type="fixed"><parent link="fore_2"/>'
        '<child link="tip_2"/><origin xyz="0.3 0 0"/></joint>'
    )
    third = read(tmp_path, end, beside=YAML[0])
    for name, body in first["bodies"].items():
        assert third["bodies"][name]["com"] == pytest.approx(body["com"], abs=1e-12)
    assert third["joints"].pop("tool_tip_2")["type"] == "spherical"
    assert first["joints"].pop("tip")["type"] == "revolute"
    assert list(third["joints"]) == list(first["joints"])
    for name, joint in first["joints"].items():
        assert third["joints"][name].get("home") == pytest.approx(joint.get("home"), abs=1e-12)
    assert first["platform"] == "tool"
    np.testing.assert_allclose(first["origin"][0], 0.0, atol=0.01)


def test_the_tree_alone_is_refused(tmp_path):
    with pytest.raises(ParameterError, match="no loop closure, and passive joints: elbow_1"):
        read(tmp_path, XML[3])
