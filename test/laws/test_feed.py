# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A cut that is slower where the machine is softer keeps its tolerance, and no more than that."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from pkm_twin.paths import fastest, lines
from stiffness_monitor import strain_energy
from test.support.command import command
from test.support.robots import load

ROBOT = load("delta_cu")
FORCE, TOLERANCE, SPEED = 50.0, 2e-4, 0.3
START, END = [-0.10, 0.0, -0.30], [0.15, 0.0, -0.36]


@pytest.fixture
def cut(capsys, tmp_path):
    """What the command says of a cut, and the table's columns."""
    points, out = tmp_path / "points.csv", tmp_path / "cut.csv"
    rows = [",".join(str(v) for v in (*pose, 0)) for pose in (START, END)]
    points.write_text("\n".join(["x,y,z,blend", *rows]) + "\n")

    def run(*words):
        told = command(
            capsys,
            "feed",
            "delta_cu",
            points,
            "--tolerance",
            TOLERANCE,
            "--speed",
            SPEED,
            "--out",
            out,
            "--overwrite",
            "--json",
            *words,
        )
        table = list(csv.DictReader(out.open()))
        return json.loads(told.out), {k: np.array([float(r[k]) for r in table]) for k in table[0]}

    return run


def test_the_deflection_uses_the_tolerance_and_keeps_it(cut):
    told, table = cut("--force", FORCE)
    pose = np.stack([table[name] for name in ROBOT.pose_names], -1)
    velocity = np.gradient(pose, table["time"], axis=0)
    inner = slice(2, -2)
    wrench = np.concatenate([-FORCE * velocity, np.zeros_like(velocity)], -1)
    bent = np.linalg.norm(strain_energy(ROBOT, pose, wrench).deflection[:, :3], axis=1)[inner]
    speed = np.linalg.norm(velocity, axis=1)[inner]
    assert bent.max() <= TOLERANCE * 1.001 and speed.max() <= SPEED * 1.001
    # Somewhere each of the two bounds binds, and one of them or the drives everywhere.
    assert bent.max() > 0.999 * TOLERANCE and speed.max() > 0.999 * SPEED
    moving = slice(100, -100)
    assert (np.maximum(bent / TOLERANCE, speed / SPEED)[moving] > 0.99).all()
    assert told["greatest_deflection_m"] == pytest.approx(TOLERANCE, rel=1e-3)
    bound = sum(p["to_s"] - p["from_s"] for p in told["limits"] if p["limit"] == "speed")
    assert bound > 0.8 * told["duration_s"]
    # Faster than the constant feed that keeps the tolerance.
    assert told["duration_s"] < told["length_m"] / told["constant_feed_m_s"]


def test_without_force_it_is_the_fastest_motion_at_that_speed(cut):
    told, _ = cut("--force", 0.0, "--no-picture")
    plain = fastest(ROBOT, lines(ROBOT, [START, END]), speed=SPEED)
    assert told["duration_s"] == pytest.approx(plain.duration, rel=1e-9)
    assert told["greatest_deflection_m"] == 0.0
