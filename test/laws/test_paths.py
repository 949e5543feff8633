# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Paths and motions along them: what they go through, and laws of the fastest motion."""

from types import SimpleNamespace

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import ParameterError, UnreachableError
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.paths import circle, cycle, fastest, lines, through, timed
from pkm_twin.paths.carrying import PayloadChange
from pkm_twin.paths.fastest import LAWS
from pkm_twin.paths.jerk import smooth_run
from pkm_twin.paths.joint_path import make_joint_paths
from pkm_twin.paths.motion import BINDING_USE
from pkm_twin.paths.pieces import Arc, Corner, arc_through
from test.support.robots import load, parameters_of, partly_long

SOME = partly_long(["delta", "prru", "five_bar", "stewart", "linear_delta", "rps3"], "delta", "five_bar", "stewart")


def points_of(robot, count=4, seed=3):
    rng = np.random.default_rng(seed)
    span = np.array([0.03 if unit == "m" else 0.06 for unit in robot.pose_units])
    return robot.home() + span * rng.uniform(-1.0, 1.0, (count, len(robot.pose_names)))


def walked(path, count=400):
    """Places along a path, and the pieces' derivatives against differences."""
    places = []
    for stretch in path.stretches:
        for piece in stretch.pieces:
            s = np.linspace(0.0, piece.length, count)
            p, first, second = piece.at(s)
            tol = 1e-4 * np.abs(second).max() + 1e-9
            np.testing.assert_allclose(np.gradient(p, s, axis=0)[1:-1], first[1:-1], atol=tol)
            np.testing.assert_allclose(
                np.gradient(first, s, axis=0)[1:-1],
                second[1:-1],
                atol=2e-2 * np.abs(second).max() + 1e-9,
            )
            places.append(p)
    return np.concatenate(places)


@pytest.mark.parametrize("name", ["delta", "stewart", "five_bar"])
def test_a_smooth_curve_goes_through_its_way_points(name):
    robot = load(name)
    points = points_of(robot, 6)
    path = through(robot, points)
    assert len(path.stretches) == 1
    p = path.stretches[0].pieces[0]
    np.testing.assert_allclose(p.at(p.spline.x)[0], points, atol=1e-12)
    walked(path)


def test_lines_are_rounded_where_they_are_asked_to_and_stop_elsewhere():
    robot = load("delta")
    points = points_of(robot, 5)
    blend = [0.0, 0.004, 0.0, 0.9, 0.0]
    path = lines(robot, points, blend=blend, dwell=[0.1, 0.0, 0.2, 0.0, 0.3])
    assert [stretch.dwell for stretch in path.stretches] == [0.2, 0.3]
    assert path.wait == 0.1
    places = walked(path)
    distance = np.linalg.norm(places[:, None] - points, axis=-1).min(0)
    assert distance[[0, 2, 4]].max() < 1e-12
    assert 0.0 < distance[1] < 0.004
    corners = [p for s in path.stretches for p in s.pieces if isinstance(p, Corner)]
    sides = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert [corner.radius for corner in corners] == pytest.approx([0.004, sides[2:].min() / 2])
    for stretch in path.stretches:
        for one, other in zip(stretch.pieces, stretch.pieces[1:], strict=False):
            before, behind = one.at(np.array([one.length])), other.at(np.zeros(1))
            for k in range(3):
                np.testing.assert_allclose(before[k], behind[k], atol=1e-9)


def test_way_points_that_repeat_rest_longer_and_a_reversal_is_a_stop():
    robot = load("delta")
    a, b = points_of(robot, 2)
    path = lines(robot, [a, a, b, a], blend=0.01, dwell=[0.5, 0.25, 0.0, 0.0])
    assert path.wait == 0.75
    assert len(path.stretches) == 2


def test_arcs_are_circles_and_join_tangent_lines_at_speed():
    robot = load("delta")
    x, y, z = robot.home()
    r = 0.03
    points = [[x - 0.05, y, z], [x, y, z], [x + r, y + r, z], [x, y + 2 * r, z], [x - 0.05, y + 2 * r, z]]
    path = lines(robot, points, arc=[0, 0, 1, 0, 0])
    (stretch,) = path.stretches
    (arc,) = (piece for piece in stretch.pieces if isinstance(piece, Arc))
    assert arc.length == pytest.approx(np.pi * r)
    places = walked(path)
    assert np.linalg.norm(places - np.array(points[2]), axis=1).min() < 1e-3
    round_ = arc.at(np.linspace(0, arc.length, 50))[0]
    np.testing.assert_allclose(np.linalg.norm(round_ - [x, y + r, z], axis=1), r, atol=1e-12)
    with pytest.raises(ParameterError):
        arc_through(*np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]]), places=[0, 1, 2])
    assert circle(robot, robot.home(), r).length == pytest.approx(2 * np.pi * r)


def test_a_cycle_has_its_height_width_and_two_stops():
    robot = load("delta")
    path = cycle(robot, 0.025, 0.305, 0.02, dwell=0.05)
    places = walked(path)
    assert np.ptp(places[:, 0]) == pytest.approx(0.305)
    assert np.ptp(places[:, 2]) == pytest.approx(0.025)
    assert [stretch.dwell for stretch in path.stretches] == [0.05, 0.05]
    second = path.stretches[0].pieces[-1].at(np.array([path.stretches[0].pieces[-1].length]))[0][0]
    assert places[:, 2].max() - second[2] == pytest.approx(0.02)


@pytest.mark.parametrize("name", SOME)
def test_all_limits_hold_at_every_moment(name):
    robot = load(name)
    acceleration = {"rad": 400.0, "m": 20.0}[robot.joint_units[0]]
    motion = fastest(robot, points_of(robot), acceleration=acceleration, speed=1.5)
    times = np.random.default_rng(1).uniform(0.0, motion.duration, 4000)
    s = motion.sample(times)
    assert (np.abs(s.effort) / robot.limits.effort).max() <= 1.0 + 1e-5
    assert (np.abs(s.qd) / robot.limits.velocity).max() <= 1.0 + 1e-9
    assert np.abs(s.qdd).max() <= acceleration * (1.0 + 1e-5)
    assert s.speed.max() <= 1.5 * (1.0 + 1e-5)
    # Something binds nearly always.
    assert np.quantile(motion.used.max(1), 0.1) > 0.98
    named = " ".join(bound.what for bound in motion.bounds)
    assert any(word in named for word in ("effort", "velocity", "acceleration", "speed"))
    begins = [bound.begin for bound in motion.bounds] + [motion.duration]
    assert begins == sorted(begins)
    assert begins[0] == 0.0


@pytest.mark.parametrize("law", ["fastest", "s-curve"])
def test_a_limit_that_is_reached_binds_and_a_rest_uses_its_own(law):
    robot, dwell = load("delta"), 0.1
    motion = timed(robot, cycle(robot, 0.025, 0.1, 0.025, dwell=dwell), law)
    free = [bound.used for bound in motion.bounds if not bound.what]
    assert max(free) < BINDING_USE and any(bound.what for bound in motion.bounds)
    begin = motion.begins[1] - dwell
    (rest,) = [b for b in motion.bounds if b.begin < begin + 0.02 and b.end > begin + 0.08]
    assert law != "fastest" or rest.used < 0.1


def test_a_planar_cycle_goes_where_the_machine_can():
    robot = load("five_bar")
    there, back = (cycle(robot, 0.02, 0.06, direction=way) for way in (None, np.pi))
    first, second = (walked(path)[0] for path in (there, back))
    assert first[0] - robot.home()[0] == pytest.approx(-0.03)
    assert second[0] - robot.home()[0] == pytest.approx(0.03)
    for way in (0.25 * np.pi, 0.5 * np.pi):
        with pytest.raises(ParameterError, match="no y"):
            cycle(robot, 0.02, 0.06, direction=way)


def close_pair(robot, seed):
    """Poses of a random smooth curve, two of them a few micrometres to a millimetre apart."""
    rng = np.random.default_rng(seed)
    span = np.array([0.025 if unit == "m" else 0.05 for unit in robot.pose_units])
    size, phase = rng.normal(size=(2, 3, len(span)))

    def curve(t):
        waves = (np.sin((4.0 * t[:, None] + phase[k]) * (k + 1)) / (k + 1) for k in range(3))
        return robot.home() + span * sum(size[k] * wave for k, wave in enumerate(waves))

    t = np.sort(rng.uniform(size=11))
    at = t[rng.integers(1, 9)]
    ends = curve(np.array([at, at + 1e-6])) * robot.pose_scales
    speed = np.linalg.norm(np.diff(ends, axis=0)) / 1e-6
    return curve(np.sort(np.append(t, at + 10 ** rng.uniform(-5.5, -3.0) / speed)))


def used_at_most(motion, count=40_000):
    """Greatest used part of a limit at many times, jerks by differences of accelerations."""
    s, limits = motion.sample(np.linspace(0.0, motion.duration, count)), motion.limits
    robot = motion.robot
    effort = inverse_dynamics(robot, s.q, s.qd, s.qdd)
    moved = np.diff(robot.forward(s.q)[:, :3], axis=0) if np.isfinite(limits.speed) else np.zeros(1)
    step = s.time[1]
    parts = (
        effort / limits.effort,
        s.qd / limits.velocity,
        s.qdd / limits.acceleration,
        np.diff(s.qdd, axis=0) / step / limits.jerk,
        np.linalg.norm(moved, axis=-1) / step / limits.speed,
    )
    return max(float(np.abs(part).max()) for part in parts)


@pytest.mark.parametrize("seed", [*range(2), *(pytest.param(k, marks=pytest.mark.long) for k in range(2, 60))])
@pytest.mark.parametrize("name", partly_long(["delta", "five_bar", "stewart"], "delta", "five_bar"))
def test_limits_hold_between_points_that_are_close_too(name, seed):
    robot = load(name)
    for bounds in ({}, {"acceleration": 300.0, "speed": 1.0}):
        try:
            motion = fastest(robot, close_pair(robot, seed), **bounds)
        except ParameterError:  # out of reach
            continue
        found, said = used_at_most(motion), max(motion.worst.values())
        assert found <= said + 1e-6 <= 1.0 + 1e-6
        assert said - found < 2e-3


@pytest.mark.parametrize("name", ["delta", "five_bar", "rps3"])
def test_limits_hold_between_few_points_too(name):
    robot = load(name)
    for points in (48, 70):
        motion = fastest(robot, points_of(robot), points=points)
        assert used_at_most(motion, 5000) <= 1.0
        fine = fastest(robot, points_of(robot)).duration
        assert motion.duration == pytest.approx(fine, rel=0.03)


@pytest.mark.parametrize("name", SOME)
def test_rates_are_those_of_the_positions_and_efforts_those_of_the_model(name):
    robot = load(name)
    motion = fastest(robot, points_of(robot))
    s = motion.sample(np.linspace(0.1, 0.9, 9) * motion.duration)
    step = 1e-6
    on, back = (motion.sample(s.time + sign * step) for sign in (1.0, -1.0))
    scale = np.abs(motion.fine.qdd).max()
    np.testing.assert_allclose((on.q - back.q) / (2 * step), s.qd, atol=2 * scale * step)
    expected = inverse_dynamics(robot, s.q, s.qd, s.qdd)
    np.testing.assert_allclose(s.effort, expected, rtol=1e-12)
    np.testing.assert_allclose(robot.inverse(s.pose), s.q, atol=1e-7)
    end = motion.sample([motion.duration, motion.duration + 1.0])
    assert not end.qd.any()
    assert not end.qdd.any()


@pytest.mark.parametrize("name", ["delta", "five_bar"])
def test_jerks_are_kept_and_cost_time(name):
    robot = load(name)
    points = points_of(robot)
    free = fastest(robot, points).duration
    slower = timed(robot, points, "quintic", jerk=2e5).duration
    motion = fastest(robot, points, jerk=2e5, points=300)
    assert free < motion.duration < slower
    assert 0.98 < used_at_most(motion) <= 1.0001


def missed_by_the_rates(motion):
    """Greatest difference between positions and the rates' integral, between the rates' jumps."""
    node, weight = np.polynomial.legendre.leggauss(8)
    ends = motion.runs[0].times
    half = 0.5 * np.diff(ends)[:, None]
    times = ends[:-1, None] + half * (1.0 + node)
    qd = motion.sample(times.ravel()).qd.reshape(*times.shape, -1)
    q = motion.sample(ends).q
    return np.abs(np.diff(q, axis=0) - np.einsum("kg,kgn->kn", half * weight, qd)).sum(0).max()


@pytest.mark.long
def test_rates_with_limits_of_jerk_are_those_of_the_positions():
    """Two of the points are 10 micrometres apart; there the machine nearly stops."""
    robot = load("delta_cu").changed(payload={"mass": 0.3})
    millimetres = [
        [-2.3463, 9.4973, -353.3997],
        [0.4832, -6.3215, -366.7954],
        [-0.2985, 8.0417, -354.1937],
        [8.2979, -4.5807, -360.5465],
        [8.2993, -4.5709, -360.5432],
        [-7.0692, 0.6709, -358.6772],
        [-3.6767, -8.8975, -362.2181],
        [-2.1533, -4.2661, -361.0709],
    ]
    motion = fastest(robot, 1e-3 * np.array(millimetres), jerk=4000.0, points=300)
    assert missed_by_the_rates(motion) < 1e-9
    assert max(motion.worst.values()) <= 1.0


def test_a_motion_never_goes_back_along_its_path():
    """Of any profile, with places where the machine nearly stops."""
    rng, robot = np.random.default_rng(2), load("five_bar")
    [part] = make_joint_paths(through(robot, points_of(robot)), [PayloadChange(robot)], 120, 1e-6)
    s = part.ends / part.ends[-1]
    for dip in 10.0 ** rng.uniform(-9.0, 0.0, 20):
        x = np.sin(np.pi * s) ** (4 / 3) * (1.0 - (1.0 - dip) * (rng.random(len(s)) < 0.05))
        run = smooth_run(part, x)
        assert run is not None
        v = run.at(np.linspace(0.0, run.duration, 50_000))[2]
        assert v.min() >= -1e-9 * v.max()


def test_jerks_are_kept_on_paths_with_corners_and_close_points():
    """Third derivatives of the path jump where its pieces meet."""
    for name, jerk in (("delta", 2e5), ("stewart", 200.0)):
        robot = load(name)
        path = cycle(robot, 0.025, 0.2)
        motion = fastest(robot, path, jerk=jerk)
        assert 0.98 < used_at_most(motion) <= 1.0001
        assert max(motion.worst.values()) <= 1.0
    robot = load("delta")
    motion = fastest(robot, close_pair(robot, 0), jerk=2e5)
    assert used_at_most(motion) <= 1.0001
    assert missed_by_the_rates(motion) < 1e-9


@pytest.mark.parametrize("name", ["effort", "velocity", "acceleration", "jerk", "speed"])
def test_every_limit_is_plausible_or_rejected(name):
    robot = load("five_bar")
    for value in (0.0, -1.0, np.nan, 1e300, 1e-300):
        with pytest.raises(ParameterError) as error:
            fastest(robot, points_of(robot), **{name: value})
        assert error.value.field == name
    for value in (1e-9, 1e12) if name != "effort" else (1e12,):
        motion = fastest(robot, points_of(robot), **{name: value})
        assert np.isfinite(motion.effort).all()
        assert max(motion.worst.values()) <= 1.0


@pytest.mark.parametrize("law", [law for laws in LAWS.values() for law in laws])
def test_laws_go_from_rest_to_rest(law):
    t = np.linspace(0.0, 1.0, 20001)
    part = SimpleNamespace(ends=np.linspace(0.0, 1.0, 11))
    run = law.make_run(part, 1.0)
    way, rate, change = run.evaluate(np.searchsorted(run.knots[1:-1], t, side="right"), t)
    np.testing.assert_allclose(np.interp(run.ends, t, way), part.ends, atol=1e-6)
    for values, ends in ((way, (0.0, 1.0)), (rate, (0.0, 0.0)), (change, (0.0, 0.0))):
        np.testing.assert_allclose(values[[0, -1]], ends, atol=1e-9)
    np.testing.assert_allclose(np.gradient(way, t)[1:-1], rate[1:-1], atol=1e-6)
    np.testing.assert_allclose(np.gradient(rate, t)[1:-1], change[1:-1], atol=2e-2)
    assert rate.min() > -1e-12


@pytest.mark.parametrize("law", ["quintic", "s-curve"])
@pytest.mark.parametrize("name", ["delta", "five_bar"])
def test_laws_are_as_short_as_limits_let_them_be(name, law):
    robot = load(name)
    path = lines(robot, points_of(robot), blend=0.004)
    motion = timed(robot, path, law)
    assert 0.99 < motion.used.max() <= 1.0
    longer = timed(robot, path, law, duration=2.0 * motion.duration)
    assert longer.duration == pytest.approx(2.0 * motion.duration)
    assert longer.used.max() < 1.0
    with pytest.raises(ParameterError) as error:
        timed(robot, path, law, duration=0.9 * motion.duration)
    assert error.value.field == "duration"
    assert law in str(error.value)
    assert motion.duration > fastest(robot, path).duration


def test_what_cannot_be_is_rejected_by_its_place():
    robot = load("delta")
    home = robot.home()
    up, deep = (home + np.array([0.0, 0.0, z]) for z in (0.02, -2.0))
    for bad in ([home, deep], [home], [home, home], [[0.0, np.nan, 0.0], home]):
        with pytest.raises(ParameterError):
            fastest(robot, bad)
    with pytest.raises(ParameterError) as error:
        fastest(robot, [home, up], effort=0.4)
    assert "at rest" in error.value.field
    with pytest.raises(ParameterError) as error:
        fastest(robot, [home, up], singularity=0.99)
    assert "singularity" in error.value.field
    for make in (
        lambda: cycle(robot, 0.025, 1e300),
        lambda: circle(robot, home, 1e300),
        lambda: lines(robot, [home, up], dwell=1e300),
    ):
        with pytest.raises(ParameterError, match=r"1e\+?06"):
            fastest(robot, make())
    with pytest.raises(ParameterError, match=r"1e\+06 s"):
        timed(robot, lines(robot, [home, up]), "quintic", duration=1e300)
    with pytest.raises(ParameterError):
        fastest(load("upr_rpu"), points_of(load("upr_rpu")))
    rails = load("linear_delta")
    away = rails.home() + np.array([-0.45, 0.0, 0.0])
    with pytest.raises(UnreachableError) as why:
        rails.inverse(away)
    with pytest.raises(ParameterError) as error:
        fastest(rails, [away, rails.home()])
    assert len(str(why.value)) > 80
    assert str(why.value) in str(error.value), "the reason is cut"
    assert fastest(load("upr_rpu"), points_of(load("upr_rpu")), velocity=0.3).duration > 0.0
    # The tool point of a circle of tilts turns back, and its speed alone bounds no motion there.
    tilting = load("upr_rpu")
    with pytest.raises(ParameterError) as error:
        timed(tilting, circle(tilting, tilting.home(), 0.05), "fastest", speed=0.1)
    assert "acceleration" in error.value.bound


def test_a_path_keeps_the_ranges_of_passive_joints():
    data = parameters_of("linear_delta")
    data["limbs"]["rods"]["left"]["swivel"] = 0.1
    tight, free = robot_of_data(data, "tight"), load("linear_delta")
    points = free.home() + np.array([[0.0, 0.0, 0.0], [0.06, 0.0, 0.0]])
    fastest(free, points)
    with pytest.raises(ParameterError) as error:
        fastest(tight, points)
    assert "left_" in error.value.field
    assert error.value.bound == "0 to 0.1 rad"


def test_a_given_duration_needs_no_limits():
    robot = load("upr_rpu")
    motion = timed(robot, points_of(robot), "quintic", duration=0.8)
    assert motion.duration == pytest.approx(0.8)
    assert motion.sample([0.4]).qd.any()
    assert not motion.worst


def test_a_path_of_joints_is_followed_in_joints():
    robot = load("delta")
    q = robot.inverse(points_of(robot, 3))
    motion = fastest(robot, through(robot, q, space="joint"))
    ends = motion.sample([0.0, motion.duration])
    np.testing.assert_allclose(ends.q, q[[0, -1]], atol=1e-12)


POSES = {
    "cycle": lambda r: cycle(r, 0.02, 0.15, 0.03),
    "curve": lambda r: through(r, points_of(r, 5)),
    "corners": lambda r: lines(
        r,
        [
            (-0.1, 0, -0.4),
            (-0.1, 0, -0.36),
            (0.1, 0, -0.36),
            (0.1, 0, -0.36),
            (0.13, 0.05, -0.36),
            (0.1, 0.1, -0.36),
            (0.1, 0.1, -0.4),
        ],
        blend=[0, 0.02, 0, 0, 0, 0, 0],
        dwell=[0, 0, 0.05, 0.1, 0, 0, 0.02],
        arc=np.arange(7) == 4,
    ),
}


@pytest.mark.parametrize(
    ("name", "kind", "law", "jerk"),
    [
        ("delta", "cycle", "fastest", None),
        ("delta", "corners", "fastest", None),
        ("delta", "curve", "fastest", 2e4),
        ("delta", "corners", "s-curve", None),
        ("five_bar", "curve", "fastest", None),
    ],
)
def test_a_payload_changes_at_its_waypoint_and_the_limits_hold_with_it(name, kind, law, jerk):
    robot = load(name)
    path = POSES[kind](robot)
    count, heavy = len(path.marks), 0.2 * robot.graph.bodies[robot.graph.platform].mass
    masses = [(None, heavy, 0.4 * heavy)[k % 3] for k in range(count)]
    m = timed(robot, path, law, jerk=jerk, payload=masses)
    if kind == "curve":
        at = m.sample(m.switches).pose
        np.testing.assert_allclose(at, points_of(robot, 5)[1:], atol=1e-12)
    edges = [0.0, *m.switches, np.inf]
    assert m.load.spans == [
        (begin, end, mass) for begin, end, mass in zip(edges[:-1], edges[1:], masses, strict=True) if mass is not None
    ]
    times = np.linspace(0.0, m.duration, 20_001)
    s = m.sample(np.unique([*times, *m.switches, *np.nextafter(m.switches, 0.0)]))
    part = np.searchsorted(m.switches, s.time, side="right")
    for k, mass in enumerate(masses):
        own = robot if mass is None else robot.changed(payload={"mass": mass})
        rows = part == k
        effort = inverse_dynamics(own, s.q[rows], s.qd[rows], s.qdd[rows])
        np.testing.assert_allclose(s.effort[rows], effort, rtol=0, atol=1e-12 * np.abs(effort).max())
        assert (np.abs(effort) <= robot.limits.effort * (1.0 + 1e-9)).all()
    if robot.limits.effort is not None and law == "fastest" and jerk is None:
        assert max(m.worst.values()) > 0.999


def test_one_payload_by_waypoints_is_the_robots_to_the_last_digit():
    robot = load("delta")
    path = cycle(robot, 0.025, 0.305, 0.025, dwell=0.1)
    alike = fastest(robot, path, payload=[0.3] * 7)
    plain = fastest(robot.changed(payload={"mass": 0.3}), path)
    assert all(
        map(
            np.array_equal,
            (alike.times, alike.q, alike.effort),
            (plain.times, plain.q, plain.effort),
        )
    )
    # Reached before the rest there, and after that of the same waypoint before it.
    twice = lines(robot, [(0, 0, -0.4), (0, 0, -0.36), (0, 0, -0.36)], dwell=[0.1, 0.2, 0.3])
    m = fastest(robot, twice, payload=[0.0, 0.1, 0.2])
    assert np.diff([m.begins[0] + m.runs[0].duration, *m.switches, m.duration]) == pytest.approx([0.0, 0.2, 0.3])
    one, other = (fastest(robot, twice, payload=[mass, None, None]).duration for mass in (None, 0.5))
    assert other > one


@pytest.mark.parametrize(
    "payload",
    [
        "abc",
        0.5,
        ["a", *[0.0] * 6],
        {0: 1.0},
        [True] * 7,
        [0.1] * 6,
        [0.1] * 8,
        [-0.1] * 7,
        [np.nan] * 7,
        [500.0] * 7,
    ],
)
def test_payloads_that_cannot_be_are_rejected(payload):
    robot = load("delta")
    with pytest.raises(ParameterError, match="payload"):
        fastest(robot, cycle(robot, 0.025, 0.305, 0.025), payload=payload)


def test_a_payload_that_the_drives_cannot_hold_at_the_end_is_rejected():
    robot = load("delta")
    still = np.abs(inverse_dynamics(robot.changed(payload={"mass": 5.0}), *np.zeros((3, 3)))).max()
    path = cycle(robot, 0.025, 0.305, 0.025)
    fastest(robot, path, effort=0.9 * still)
    with pytest.raises(ParameterError, match="at rest"):
        fastest(robot, path, effort=0.9 * still, payload=[0.0] * 6 + [5.0])
