# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Angles of waypoints that look like degrees are asked about; declared ones are converted."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from pkm_twin.paths.geometry import through
from pkm_twin.paths.waypoints import read_waypoints
from test.support.robots import load


def test_angles_beyond_a_turn_are_asked_about(tmp_path: Path) -> None:
    robot = load("stewart")
    rows = ["0,0,0.65,0,0,0", "0,0,0.65,8,5,-3", "0.01,0,0.65,12,-5,3"]
    plain, declared = tmp_path / "plain.csv", tmp_path / "declared.csv"
    plain.write_text("\n".join(["x,y,z,roll,pitch,yaw", *rows]))
    declared.write_text("\n".join(["x,y,z,roll [deg],pitch [deg],yaw [deg]", *rows]))
    with pytest.warns(match="roll") as told:
        read_waypoints(plain, robot, None)
    assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        converted, _ = read_waypoints(declared, robot, None)
    points = [[float(x) for x in row.split(",")] for row in rows]
    points = [[*p[:3], *np.radians(p[3:])] for p in points]
    assert converted.length == through(robot, points, space="pose").length
