# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The fastest motion against closed forms of one axis, and against linear programs.

The programs share the inverse dynamics and the geometry alone: derivatives of the joints by
the path are those of a spline, limits hold in the middle of intervals.
"""

import numpy as np
import pytest
from scipy import sparse
from scipy.interpolate import make_interp_spline
from scipy.optimize import brentq, linprog

from delta_dynamics import inverse_dynamics
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.paths import cycle, fastest, lines, through
from test.support.robots import load, often

FORCE, MASS, WAY = 12.0, 3.0, 0.5


def slider(*, velocity=None, viscous=0.0, coulomb=0.0, gravity=(0.0, 0.0, 0.0)):
    """One mass on one prismatic joint."""
    limits = {"position": [-1.0, 1.0], "effort": FORCE}
    if velocity is not None:
        limits["velocity"] = velocity
    data = {
        "mechanism": "machine",
        "platform": "table",
        "pose": ["x"],
        "gravity": list(gravity),
        "bodies": {"table": {"mass": MASS, "com": [0, 0, 0], "inertia": [1, 1, 1]}},
        "joints": {
            "axis": {
                "type": "prismatic",
                "between": ["base", "table"],
                "axis": [1, 0, 0],
                "actuated": True,
                "home": 0.0,
                "limits": limits,
                "friction": {"viscous": viscous, "coulomb": coulomb},
            }
        },
    }
    return robot_of_data(data, "slider")


def duration(robot, **options):
    motion = fastest(robot, [[0.0], [WAY]], **options)
    # The result keeps 0.9999 of the limits.
    assert motion.used.max() <= 1.0
    return motion.duration


def test_one_mass_accelerates_half_the_way():
    best = 2.0 * np.sqrt(WAY * MASS / FORCE)
    assert duration(slider()) == pytest.approx(best, rel=1e-4)


def test_one_mass_up_to_a_speed():
    top = 0.8
    rate = FORCE / MASS
    best = WAY / top + top / rate
    assert duration(slider(velocity=top)) == pytest.approx(best, rel=3e-4)


def test_one_mass_against_gravity_and_dry_friction():
    up, dry = 1.1, 1.7
    robot = slider(coulomb=dry, gravity=(-up, 0.0, 0.0))
    on, off = (FORCE - dry) / MASS - up, (FORCE + dry) / MASS + up
    # v^2 / 2 (1 / on + 1 / off) = way
    top = np.sqrt(2.0 * WAY / (1.0 / on + 1.0 / off))
    assert duration(robot) == pytest.approx(top / on + top / off, rel=3e-4)


def test_one_mass_in_oil():
    oil = 9.0
    robot = slider(viscous=oil)
    a, b = FORCE / MASS, oil / MASS

    def started(t):
        """Way and speed under full force after t."""
        return a / b * (t - (1 - np.exp(-b * t)) / b), a / b * (1 - np.exp(-b * t))

    def stopped(v):
        """Way and time to rest under full braking from v."""
        t = np.log(1 + b * v / a) / b
        return v / b - a / b * t, t

    def missing(t):
        way, v = started(t)
        return way + stopped(v)[0] - WAY

    t = brentq(missing, 1e-3, 5.0)
    best = t + stopped(started(t)[1])[1]
    # Oil takes most of the force: it is linear in v^2 between two points.
    assert duration(robot) == pytest.approx(best, rel=1e-3)


def judged(robot, path, count, rounds=3, acceleration=np.inf):
    """Duration of the best motion along a path from rest to rest, by linear programs in v^2.

    The duration is convex in v^2; each program minimises its tangent at the one before.
    """
    limits = robot.limits
    total = 0.0
    for stretch in path.stretches:
        s, places = [], []
        begin = 0.0
        for piece in stretch.pieces:
            steps = max(12, round(count * piece.length / stretch.length))
            own = np.linspace(0.0, piece.length, steps)
            s.append(begin + own[bool(s) :])
            places.append(piece.at(own)[0][bool(places) :])
            begin += piece.length
        s, places = np.concatenate(s), np.concatenate(places)
        spline = make_interp_spline(s, robot.inverse(places), k=3)
        h, middle = np.diff(s), 0.5 * (s[1:] + s[:-1])
        q, first, second = (spline(middle, k) for k in range(3))
        zero = 0.0 * q
        g = inverse_dynamics(robot, q, zero, zero)
        a = inverse_dynamics(robot, q, zero, first) - g
        moving = {v: inverse_dynamics(robot, q, v * first, v * v * second) - g for v in (-1, 1, 3)}
        b = (moving[1] + moving[-1]) / 2
        odd = {1: moving[1] - b, 3: moving[3] - 9 * b}
        w = (odd[3] - odd[1]) / 2
        k = odd[1] - w
        mean = sparse.diags([0.5, 0.5], [0, 1], shape=(len(h), len(s)))
        change = sparse.diags([-0.5 / h, 0.5 / h], [0, 1], shape=(len(h), len(s)))
        most = np.full(len(s), np.inf)
        at = np.abs(spline(s, 1)) / limits.velocity
        most = 1.0 / at.max(1) ** 2
        most[0] = most[-1] = 0.0
        x = 0.25 * most + 1e-6 * most.max()
        best = np.inf
        for _ in range(rounds):
            v = np.sqrt(mean @ x)
            rows, tops = [], []
            for i in range(robot.joints_count):
                row = sparse.diags(a[:, i]) @ change + sparse.diags(b[:, i]) @ mean
                rest = w[:, i] * v + k[:, i] + g[:, i]
                rows += [row / limits.effort[i], -row / limits.effort[i]]
                tops += [1.0 - rest / limits.effort[i], 1.0 + rest / limits.effort[i]]
                if np.isfinite(acceleration):
                    row = sparse.diags(first[:, i]) @ change + sparse.diags(second[:, i]) @ mean
                    rows += [row / acceleration, -row / acceleration]
                    tops += [np.ones(len(h))] * 2
            root = np.sqrt(x)
            share = h / (root[1:] + root[:-1]) ** 2
            weight = np.zeros(len(s))
            weight[1:] += share / np.maximum(root[1:], 1e-3 * root.max())
            weight[:-1] += share / np.maximum(root[:-1], 1e-3 * root.max())
            answer = linprog(
                -weight / weight.max(),
                A_ub=sparse.vstack(rows).tocsr(),
                b_ub=np.concatenate(tops),
                bounds=np.stack([0 * most, most], -1),
                method="highs",
            )
            assert answer.status == 0, answer.message
            x = np.maximum(answer.x, 0.0)
            root = np.sqrt(x)
            best = float(np.sum(2 * h / (root[1:] + root[:-1])))
        total += best
    return total


def hidden_path(robot, seed):
    """Way-points about home, lines rounded or a smooth curve."""
    rng = np.random.default_rng(seed)
    span = np.array([0.04 if unit == "m" else 0.08 for unit in robot.pose_units])
    points = robot.home() + span * rng.uniform(-1.0, 1.0, (4, len(robot.pose_names)))
    return through(robot, points) if seed % 2 else lines(robot, points, blend=0.03)


def test_the_pick_and_place_cycle_is_the_best():
    robot = load("delta")
    path = cycle(robot, 0.025, 0.305, 0.025)
    assert fastest(robot, path).duration == pytest.approx(judged(robot, path, 400), rel=2e-3)


@pytest.mark.parametrize("seed", often(1, 7))
@pytest.mark.parametrize("name", ["delta_cu", "prru", "linear_delta", "stewart", "rps3"])
def test_no_program_is_faster(name, seed):
    robot = load(name)
    if name in ("delta_cu", "prru"):
        robot = robot.changed(payload={"mass": 0.7, "com": [0.02, 0.0, -0.03]})
    rubs = bool(robot.friction.viscous.any())
    for number in range(seed):
        path = hidden_path(robot, number + len(name))
        best = judged(robot, path, 400, rounds=6 if rubs else 3)
        assert fastest(robot, path).duration == pytest.approx(best, rel=2e-3)


def test_accelerations_of_joints_are_limits_too():
    robot = load("delta")
    path = hidden_path(robot, 4)
    best = judged(robot, path, 400, acceleration=300.0)
    assert fastest(robot, path, acceleration=300.0).duration == pytest.approx(best, rel=2e-3)
