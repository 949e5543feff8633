# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Input shapers: an oscillator of the pose's frequency that the motion shakes comes to rest."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.paths import lines, shaped, timed
from stiffness_monitor.modes import natural_frequencies
from test.support.command import command
from test.support.robots import load

ROBOT = load("five_bar")
DAMPING = 0.02
START, END = np.array([-0.05, 0.33]), np.array([0.06, 0.38])
ALONG = (END - START) / np.linalg.norm(END - START)


def frequency(poses):
    """From 20 to 27 Hz on the way."""
    return 20.0 + 60.0 * (np.asarray(poses)[..., 0] + 0.05)


def left_over(motion, scale=1.0):
    """Amplitude of the oscillator after the motion: how far its undamped swing would go, m."""
    time = np.linspace(0.0, motion.duration, 3001)
    h, pose = time[1], motion.sample(time).pose
    # The pose's own second differences, whatever the motion says of its accelerations.
    pushed = np.diff(np.pad(pose @ ALONG, 1, mode="edge"), 2) / h
    turn = 2.0 * np.pi * scale * frequency(pose)
    place = rate = 0.0
    for push, w in zip(pushed.tolist(), turn.tolist(), strict=True):
        # Semi-implicit, so that a step adds no energy.
        rate = (rate - push - h * w**2 * place) / (1.0 + 2.0 * DAMPING * w * h)
        place += h * rate
    return float(np.hypot(place, rate / turn[-1]))


@pytest.fixture(scope="module")
def plain():
    return timed(ROBOT, lines(ROBOT, [START, END]), "fastest")


def test_the_mode_rests_after_a_shaped_motion(plain):
    shaken = left_over(plain)
    zv, zvd = (shaped(plain, name, frequency, DAMPING) for name in ("zv", "zvd"))
    assert left_over(zv) < 0.03 * shaken and left_over(zvd) < 0.03 * shaken
    # With a frequency that is 8 % wrong, ZVD does better.
    assert left_over(zvd, 1.08) < 0.5 * left_over(zv, 1.08) < 0.25 * shaken
    # What they cost: half a damped vibration and a whole one, of poses near the stop.
    for motion, count in ((zv, 0.5), (zvd, 1.0)):
        vibrations = motion.added * np.sqrt(1.0 - DAMPING**2) / count
        assert 1.0 / frequency(END) <= vibrations <= 1.0 / frequency(START)


def test_a_shaped_motion_is_a_motion_of_the_same_path(plain):
    motion = shaped(plain, "zvd", frequency, DAMPING)
    s = motion.uniform(2e4)
    ends = s.pose[[0, -1]]
    np.testing.assert_allclose(ends, [START, END], atol=1e-9)
    np.testing.assert_allclose(s.qd[[0, -1]], 0.0, atol=1e-6)
    # A straight line stays one, and rates and accelerations are those of the positions.
    away = (s.pose - START) - ((s.pose - START) @ ALONG)[:, None] * ALONG
    assert np.abs(away).max() < 1e-9
    np.testing.assert_allclose(s.q, ROBOT.inverse(s.pose), atol=1e-12)
    moved = np.diff(s.q, axis=0) / np.diff(s.time)[:, None]
    mean = 0.5 * (s.qd[1:] + s.qd[:-1])
    assert np.abs(moved - mean).max() < 1e-3 * np.abs(s.qd).max()
    turned = np.diff(s.qd, axis=0) / np.diff(s.time)[:, None]
    apart = np.abs(turned - 0.5 * (s.qdd[1:] + s.qdd[:-1])).max(1)
    # Steps of the acceleration are between samples.
    assert np.quantile(apart, 0.99) < 1e-2 * np.abs(s.qdd).max()
    assert max(motion.worst.values()) <= 1.0 + 1e-6


def test_stops_are_reached_before_the_next_stretch(plain):
    way = lines(ROBOT, [START, END, START], blend=0.0, dwell=[0.0, 0.05, 0.0])
    motion = shaped(timed(ROBOT, way, "quintic"), "zv", frequency, DAMPING)
    rest = motion.begins[1] - 0.05
    at = motion.sample([rest + 1e-9, rest + 0.04])
    np.testing.assert_allclose(at.pose, [END, END], atol=1e-9)
    np.testing.assert_allclose(at.qd, 0.0, atol=1e-6)


def test_what_cannot_be_shaped_is_rejected(plain):
    with pytest.raises(UnknownNameError):
        shaped(plain, "zvv", frequency, DAMPING)
    with pytest.raises(ParameterError, match="damping"):
        shaped(plain, "zv", frequency, 1.0)
    with pytest.raises(ParameterError, match="frequency"):
        shaped(plain, "zv", lambda poses: np.full(len(poses), np.nan), DAMPING)


def test_the_command_shapes_by_the_first_mode(capsys, tmp_path):
    points, out = tmp_path / "points.csv", tmp_path / "path.csv"
    points.write_text("x,z,blend\n-0.05,0.33,0\n0.06,0.38,0\n")
    words = (
        "path",
        "five_bar",
        points,
        "--fastest",
        "--shaper",
        "zv",
        "--damping",
        "0.1",
        "--json",
    )
    told = json.loads(command(capsys, *words, "--out", out, "--no-picture").out)
    own = natural_frequencies(ROBOT, [START, END], 1)[:, 0]
    low, high = told["shaper"]["lowest_hz"], told["shaper"]["highest_hz"]
    assert low <= own.min() * (1 + 1e-9) and high >= own.max() * (1 - 1e-9)
    assert 0.5 / high <= told["shaper"]["added_s"] * np.sqrt(0.99) <= 0.5 / low
    last = list(csv.DictReader(out.open()))[-1]
    assert [float(last[name]) for name in "xz"] == pytest.approx(END.tolist())
    assert float(last["time"]) == pytest.approx(told["duration_s"])
