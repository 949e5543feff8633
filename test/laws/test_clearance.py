# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Laws of limb interference: distances of bars, and which poses they leave."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from pkm_twin.maps.search import find_workspace_box
from pkm_twin.robot.clearance import (
    clearance,
    distance,
    has_clearance,
    member_gaps,
    member_pairs,
)
from pkm_twin.robot.workspace import reachable, regular_workspace
from stiffness_monitor.structure import structural_model
from test.support.robots import SHIPPED, load, partly_long, random_poses

ROBOTS = [name for name, robot in SHIPPED.items() if has_clearance(robot) and robot.mechanism != "machine"]


def segments(a, b, c, d):
    """Distance of the segments a to b and c to d."""
    a, b, c, d = (np.asarray(v, float) for v in (a, b, c, d))
    return float(distance(a, b - a, c, d - c))


def bounded(a, b, c, d):
    """The same as bounded least squares over the two places along the segments."""
    found = lsq_linear(np.column_stack((b - a, c - d)), c - a, bounds=(0, 1), method="bvls")
    return math.sqrt(2 * found.cost)


def pairs(rng, count):
    """Segments of every kind: skew, parallel, crossing, touching, and points; (count, 4, 3)."""
    for k in range(count):
        a, b, c, d = rng.normal(size=(4, 3))
        kind = k % 7
        if kind == 1:
            d = c + rng.normal() * (b - a)
        elif kind == 2:
            # Collinear: apart, one in the other, or overlapping.
            c, d = (a + s * (b - a) for s in rng.uniform(-2, 3, 2))
        elif kind == 3:
            middle = a + rng.uniform() * (b - a)
            d = middle + rng.uniform() * (middle - c)
        elif kind == 4:
            d = c
        elif kind == 5:
            b, d = a, c
        elif kind == 6:
            c = (a, b)[rng.integers(2)]
        yield np.array([a, b, c, d])


def test_distance_is_the_least_over_both_segments(rng):
    for k, points in enumerate(pairs(rng, 2100)):
        assert segments(*points) == pytest.approx(bounded(*points), abs=1e-9), k % 7


@pytest.mark.parametrize("angle", [1e-2, 1e-5, 1e-8, 1e-11])
def test_nearly_parallel_segments_that_cross(angle):
    """They cross at a third of both, so their distance is their offset."""
    u, v = np.array([1.0, 0, 0]), np.array([math.cos(angle), math.sin(angle), 0])
    for offset in (0.0, 0.3):
        up = np.array([0, 0, offset])
        assert segments(-u / 3, 2 * u / 3, up - v / 3, up + 2 * v / 3) == pytest.approx(offset, abs=1e-15)


def tube(diameter):
    """A member of another diameter whose wall is no matter of its mass."""
    return {
        "youngs_modulus": 70e9,
        "shear_modulus": 26e9,
        "outer_diameter": diameter,
        "inner_diameter": 0.5 * diameter,
    }


BY_DEFAULT = (0, 1, 2, 3, 5, 7, 9, 13)
"""Of the variants: shipped robots, two of them with thick members, and two of other shapes."""
VARIANTS = [
    *((name, {}) for name in ROBOTS),
    # Members so thick that limbs meet in some poses.
    ("delta", {"members": {"forearm": tube(0.046)}}),
    ("delta_cu", {"members": {"forearm": tube(0.046), "rcu_forearm": tube(0.060)}}),
    ("prru", {"members": {"limb": tube(0.40)}}),
    ("upr_rpu", {"members": {"diameter": 0.345}}),
    # Where arms, or rods at the elbows, or far from their ends are nearest.
    ("delta", {"members": {"arm": tube(0.140)}}),
    ("delta", {"geometry": {"base_radius": 0.03, "platform_radius": 0.15}}),
    ("delta_cu", {"geometry": {"base_radius": 0.02, "platform_radius": 0.12}}),
    ("delta_cu", {"members": {"parallelogram_width": 0.16}}),
    ("delta_cu", {"members": {"rcu_forearm": tube(0.12)}}),
    (
        "delta_cu",
        {
            "geometry": {"closures": ["rod", "rod", "rcu"]},
            "members": {"rcu_forearm": tube(0.12), "arm": tube(0.02)},
        },
    ),
    ("prru", {"geometry": {"base_radius": 0.15}}),
    ("upr_rpu", {"geometry": {"base_radius": 0.2}, "members": {"diameter": [0.02, 0.3, 0.1]}}),
]


@pytest.mark.parametrize(
    ("name", "sections"),
    [case if k in BY_DEFAULT else pytest.param(*case, marks=pytest.mark.long) for k, case in enumerate(VARIANTS)],
)
def test_members_are_those_of_the_frame(name, sections, variant, rng):
    """The elastic frame declares the same bars, each on its own."""
    robot, _ = variant(name, **sections)
    assert has_clearance(robot)
    # A platform wider than the base is nowhere far from a singularity.
    poses = random_poses(robot, rng, 25, clear=0.02)
    assert len(poses) == 25
    for pose in poses:
        members = structural_model(robot, robot.inverse(pose)).members
        bars = [(m.start, m.end, m.section.outer_diameter / 2) for m in members]
        # "arm II", "forearm II a", "limb II", "2B"
        limbs = [m.name.split()[1] if " " in m.name else m.name[0] for m in members]
        assert len(set(limbs)) == 3
        gaps = {
            frozenset((members[i].name, members[j].name)): bounded(*bars[i][:2], *bars[j][:2]) - bars[i][2] - bars[j][2]
            for i in range(len(bars))
            for j in range(i)
            if limbs[i] != limbs[j]
        }
        assert float(clearance(robot, pose)) == pytest.approx(min(gaps.values()), abs=1e-9)
        found = member_gaps(robot, robot.inverse(pose))
        for (a, b), gap in zip(member_pairs(robot), found, strict=True):
            assert gap == pytest.approx(gaps[frozenset((a.name, b.name))], abs=1e-9)


def box(robot, count=25):
    """Poses around all that a robot reaches, shape (..., m)."""
    ticks = [np.linspace(low, high, count) for low, high in robot.cached(find_workspace_box)]
    return np.stack(np.meshgrid(*ticks, indexing="ij"), -1)


def thicker(robot, much):
    """The robot with every member's radius greater by that much, m."""
    other = replace(robot)
    other.__dict__["beams"] = tuple(replace(b, radius=b.radius + much) for b in robot.beams)
    return other


@pytest.mark.parametrize("name", partly_long(ROBOTS, "delta_cu"))
def test_poses_where_limbs_meet_are_refused(name):
    shipped = load(name)
    poses = box(shipped, 11)
    otherwise = reachable(shipped, poses, -math.inf)
    robot = thicker(shipped, float(np.median(clearance(shipped, poses[otherwise]))) / 2)
    # A shipped robot's limbs are thinner, its limits the same.
    assert (reachable(robot, poses, -math.inf) == otherwise).all()
    gaps = np.full(otherwise.shape, np.nan)
    gaps[otherwise] = clearance(robot, poses[otherwise])
    assert 0 < (gaps <= 0).sum() < otherwise.sum()
    assert (reachable(robot, poses) == (gaps > 0)).all()
    bound = float(np.nanmedian(gaps))
    kept = reachable(robot, poses, bound)
    assert (kept == (gaps > bound)).all()
    assert 0 < kept.sum() < otherwise.sum()
    worst = poses[np.unravel_index(np.nanargmin(gaps), gaps.shape)]
    assert not reachable(robot, worst)
    assert reachable(robot, worst, -math.inf)
    assert reachable(shipped, worst)
    assert reachable(robot, worst).shape == ()


LEAST = {"delta": 0.026, "delta_cu": 0.026, "prru": 0.26, "upr_rpu": 0.23}


@pytest.mark.parametrize("name", partly_long(LEAST, "delta_cu", "upr_rpu"))
def test_limbs_of_the_shipped_robots_never_meet(name):
    """In no pose that the other limits allow; the least is at the edge of these."""
    robot, at_least = load(name), LEAST[name]
    poses = box(robot, 21)
    otherwise = reachable(robot, poses, -math.inf)
    assert otherwise.sum() > 1000
    assert at_least < clearance(robot, poses[otherwise]).min() < 1.1 * at_least
    assert (reachable(robot, poses) == otherwise).all()


def test_the_regular_workspace_is_that_without_interference(monkeypatch):
    robot = load("upr_rpu")
    z = np.arange(-0.90, -0.34, 0.05)
    found = regular_workspace(robot, z, directions=24)
    monkeypatch.setattr(type(robot), "beams", ())
    blind = replace(robot)
    assert not has_clearance(blind)
    without = regular_workspace(blind, z, directions=24)
    assert (found.z == without.z).all()
    assert (found.radius == without.radius).all()


def test_the_regular_workspace_ends_where_limbs_meet(variant):
    """Bars so thick that they meet first: its circles are smaller, and limbs touch on them."""
    z = np.arange(-0.90, -0.34, 0.05)
    robot, _ = variant("upr_rpu", members={"diameter": 0.36})
    wide = regular_workspace(load("upr_rpu"), z, least_radius=0.0, directions=72)
    narrow = regular_workspace(robot, z, least_radius=0.0, directions=72)
    assert (narrow.z == wide.z).all()
    assert (narrow.radius <= wide.radius).all()
    touched = narrow.radius < wide.radius - 1e-6
    assert touched.sum() >= 3
    turn = np.arange(72) * (2 * np.pi / 72)
    for height, radius in zip(narrow.z[touched], narrow.radius[touched], strict=True):
        poses = np.column_stack((np.full(72, height), radius * np.cos(turn), radius * np.sin(turn)))
        assert clearance(robot, poses).min() == pytest.approx(0.0, abs=1e-7)


def test_an_rcu_limb_without_its_rod_is_not_known(variant):
    robot, _ = variant("delta", geometry={"closures": ["rod", "rod", "rcu"]})
    assert not has_clearance(robot)
    assert reachable(robot, robot.home(), 1e3)
    assert has_clearance(load("delta"))
