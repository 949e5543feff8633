# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The pure half of the page: sliders in, numbers out, on every robot and a URDF."""

from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin import robot_names
from pkm_twin.report.plots import pyplot
from pkm_twin.robot.clearance import clearance, has_clearance
from pkm_twin.robot.outline import Posture, is_telescope
from pkm_twin.view import texts
from pkm_twin.view.drawing import draw
from pkm_twin.view.model import Model, _choose_step, _round_up
from pkm_twin.view.scene import (
    ANCHORS,
    ENERGY_COLOURS,
    RIGID,
    Deflection,
    Scene,
    choose_anchors,
    colour_by_share,
    make_plate,
    make_round_meshes,
)
from stiffness_monitor import compliance
from stiffness_monitor.compliance import member_deflections
from test.support.robots import has, load, rigid

URDF = Path(__file__).resolve().parents[1] / "machine/five_bar.urdf"
NAMES = [*robot_names(), URDF.name]
every_model = pytest.mark.parametrize("name", NAMES)


@cache
def model_of(name):
    return Model(load(URDF, platform="platform") if name == URDF.name else load(name))


def states(model, count, rng):
    """States from joint values all over the sliders, those that can be."""
    low, high = (np.array([getattr(r, end) for r in model.joint_ranges]) for end in ("low", "high"))
    tried = low + (high - low) * rng.random((count, len(low)))
    moved = [model.to_joints(model.start, q) for q in tried]
    good = [state for state in moved if not state.rejection]
    assert len(good) >= count / 5, model.robot.name
    return good


@every_model
def test_sliders_span_the_limits_and_the_start_is_within(name):
    model = model_of(name)
    robot = model.robot
    limits = robot.limits.position
    if limits is not None:
        ends = np.array([[r.low, r.high] for r in model.joint_ranges])
        assert np.array_equal(ends[np.isfinite(limits)], limits[np.isfinite(limits)])
        assert np.isfinite(ends).all()
    for ranges, values, names in (
        (model.joint_ranges, model.start.q, robot.joint_names),
        (model.pose_ranges, model.start.pose, robot.pose_names),
        (model.wrench_ranges, model.start.wrench, ("fx", "fy", "fz", "mx", "my", "mz")),
    ):
        assert tuple(r.name for r in ranges) == tuple(names)
        for r, value in zip(ranges, values, strict=True):
            assert r.low <= value <= r.high
            assert 400 <= (r.high - r.low) / r.step <= 5000 or r.high == r.low


@every_model
def test_joints_and_pose_lead_to_the_same_state(name, rng):
    model = model_of(name)
    robot = model.robot
    for state in states(model, 10, rng):
        np.testing.assert_array_equal(state.pose, robot.forward(state.q))
        back = model.to_pose(model.start, state.pose)
        assert back.rejection == ""
        np.testing.assert_array_equal(back.pose, state.pose)
        if name == URDF.name:  # drives that turn all the way reach a pose with either elbow
            np.testing.assert_allclose(robot.forward(back.q), state.pose, rtol=0, atol=1e-7)
        else:
            np.testing.assert_allclose(back.q, state.q, rtol=0, atol=1e-7)


@every_model
def test_no_slider_leads_to_an_exception(name, rng):
    """Whatever is asked for inside the sliders is shown, or rejected in words and left alone."""
    model = model_of(name)
    low, high = (np.array([getattr(r, end) for r in model.pose_ranges]) for end in ("low", "high"))
    rejected, count = 0, 15
    tried = low + (high - low) * rng.random((count, len(low)))
    # All over their ranges hardly any six numbers are a pose; near the start all are.
    tried[10:] = model.start.pose + 0.1 * (tried[10:] - model.start.pose)
    for pose in tried:
        state = model.to_pose(model.start, pose)
        if state.rejection:
            rejected += 1
            assert "\n" not in state.rejection
            np.testing.assert_array_equal(state.q, model.start.q)
            np.testing.assert_array_equal(state.pose, model.start.pose)
        else:
            np.testing.assert_allclose(model.robot.forward(state.q), pose, rtol=0, atol=1e-6)
        assert np.isfinite(model.compute_numbers(state).singularity)
    far = model.to_pose(model.start, np.full(len(low), 50.0))
    assert far.rejection
    assert model.to_joints(model.start, np.full(len(model.start.q), np.nan)).rejection
    assert model.apply_wrench(model.start, np.full(6, np.inf)).rejection
    assert 0 < rejected <= 10


@every_model
def test_a_link_carries_pose_and_load(name, rng):
    model = model_of(name)
    wrench = np.array([3.0, -2.0, 5.0, 0.1, 0.0, -0.3])
    state = model.apply_wrench(model.to_pose(model.start, states(model, 8, rng)[0].pose), wrench)
    for given in (state, model.apply_wrench(state, np.zeros(6))):
        opened = model.read_url(model.start, f"http://127.0.0.1:8080/{model.write_url(given)}")
        assert opened.rejection == ""
        np.testing.assert_allclose(opened.pose, given.pose, rtol=1e-8, atol=1e-12)
        np.testing.assert_array_equal(opened.wrench, given.wrench)
        assert model.write_url(opened) == model.write_url(given)


@every_model
def test_a_dragged_platform_goes_where_it_can(name, rng):
    """To a place that it reaches exactly; out of reach, as far as its joints' limits refuse it."""
    model = model_of(name)
    for state in states(model, 8, rng)[:3]:
        near = model.to_joints(state, 0.9 * state.q + 0.1 * model.start.q)
        if near.rejection:
            continue
        moved = model.to_platform(state, *model.robot.platform(near.q))
        assert moved.rejection == ""
        for got, asked in zip(model.robot.platform(moved.q), model.robot.platform(near.q), strict=True):
            np.testing.assert_allclose(got, asked, atol=1e-6)
        position, rotation = model.robot.platform(state.q)
        assert model.to_platform(state, position + 100.0, rotation).q is state.q


def test_zero_but_for_rounding_has_no_sign():
    """Of a number on the page, of a link, of a slider."""
    assert [texts.format_number(x) for x in (-0.0, -1e-13, 1e-13, -2.0)] == ["0", "0", "0", "-2"]
    model = model_of("five_bar")
    pushed = model.apply_wrench(model.start, np.array([-0.0, 5.0, -1e-13, 0.0, 0.0, 0.0]))
    assert model.write_url(pushed).endswith("load=0,5,0,0,0,0")
    slider = SimpleNamespace(value=1.0, min=-100.0, max=100.0)
    pytest.importorskip("pkm_twin.view.page")._set_sliders([slider], np.array([-1e-14]))
    assert str(slider.value) == "0.0"


def test_a_link_that_says_something_else_changes_nothing():
    model = model_of("five_bar")
    good = model.write_url(model.start)
    for link in (
        "",
        "?",
        "?pose=0,0.4",
        "?robot=delta&pose=0,0.4",
        "?robot=five_bar",
        good + ",1",
        good + "&load=1",
        good + "&load=1,2,3,4,5,nan",
        "?robot=five_bar&pose=0,x",
        "?robot=five_bar&pose=9,9",
    ):
        state = model.read_url(model.start, link)
        assert state.rejection, link
        assert state.q is model.start.q
        assert not state.wrench.any()


def test_the_softest_pose_is_softer_than_all_others(rng):
    """Without a load by the compliance, under one by the deflection; the answer has its unit."""
    model = model_of("five_bar")
    others = states(model, 40, rng)
    for wrench, unit in (np.zeros(6), "µm/N"), (np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.0]), "µm"):

        def moves(state, wrench=wrench):
            block = compliance(model.robot, state.pose)
            if wrench.any():
                return np.linalg.norm((block @ wrench)[:3])
            return np.linalg.eigvalsh(block[:3, :3])[-1]

        parts = []
        q, told = model.find_softest_pose(wrench, parts.append)
        assert parts == sorted(parts)
        found = model.to_joints(model.start, q)
        assert found.rejection == ""
        number, told_unit = told.split(" along ")[0].split()[-2:]
        assert told_unit == unit
        assert float(number) == pytest.approx(1e6 * moves(found), rel=1e-3)
        assert moves(found) >= max(map(moves, others))


@every_model
def test_beyond_a_limit_is_told_with_joint_value_and_range(name):
    model = model_of(name)
    if model.robot.limits.position is None:
        pytest.skip("this machine has no limits")
    q = model.start.q.copy()
    q[0] = model.joint_ranges[0].high + 0.25
    told = model.to_joints(model.start, q).rejection
    joint, unit = model.robot.joint_names[0], model.robot.joint_units[0]
    assert told.startswith(f"{joint}.position is {q[0]:.6g} {unit}, limits ")
    assert "--" not in told


def test_beyond_a_passive_limit_names_the_joint():
    """The angle is that between the joint's leg and the platform's normal, drawn by the scene."""
    model = model_of("upr_rpu")
    graph = model.robot.graph
    beta = model.start.pose.copy()
    beta[2] = model.pose_ranges[2].high
    told = model.to_pose(model.start, beta).rejection
    name, value = told.split(" rad, limit ")[0].split(" is at ")
    assert name == "R joint 1"
    posture = Posture(model.robot, model.robot.inverse(beta))
    foot, tip = (graph.joints[joint] for joint in ("U joint 1", name))
    leg = foot.at - posture.locate_point(tip.outer, tip.at)
    normal = posture.rotate_vector(graph.platform, np.array([0.0, 0.0, 1.0]))
    angle = np.arccos(leg @ normal / np.linalg.norm(leg))
    assert float(value) == pytest.approx(angle, abs=1e-5)


@every_model
def test_numbers_are_the_cores(name, rng):
    model = model_of(name)
    robot = model.robot
    wrench = np.array([3.0, -2.0, 5.0, 0.1, 0.2, -0.3])
    known = {"clearance": has_clearance(robot), "energy": has(robot, "structure")}
    known["effort"] = has(robot, "massive")
    for state in states(model, 5, rng)[:2]:
        got = model.compute_numbers(model.apply_wrench(state, wrench))
        assert {what: what not in got.why for what in known} == known
        assert got.singularity == pytest.approx(float(robot.singularity(state.q)), rel=1e-12)
        assert got.singularity_grade == ("good" if got.singularity >= 0.05 else "warn")
        position, rotation = robot.platform(state.q)
        np.testing.assert_array_equal(got.position, position)
        np.testing.assert_array_equal(got.rotation, rotation)
        if "clearance" in got.why:
            assert got.clearance is None
        else:
            assert got.clearance == pytest.approx(float(clearance(robot, state.pose)), abs=1e-12)
        if "effort" not in got.why:
            rest = np.zeros(robot.joints_count)
            expected = inverse_dynamics(robot, state.q, rest, rest, wrench)
            np.testing.assert_array_equal(got.effort, expected)
        if "energy" not in got.why:
            moved = compliance(robot, state.pose) @ wrench
            np.testing.assert_allclose(got.energy.deflection, moved, rtol=1e-7)
        html = texts.describe_state(model, state, got) + texts.describe_load(got)
        for key in ("singularity", "clearance", "q_0", "refusal"):
            assert html.count(f'id="{key}"') == 1


def test_what_is_not_known_is_said(tmp_path):
    model = model_of(rigid("stewart", tmp_path / "rigid.yaml"))
    numbers = model.compute_numbers(model.start)
    assert numbers.energy is None
    assert "member" in numbers.why["energy"]
    assert "diameters" in numbers.why["clearance"]
    assert "member" in texts.describe_load(numbers)


def test_names_cannot_write_into_the_page():
    model = model_of("five_bar")
    state = model.to_joints(model.start, model.start.q)
    bad = type(state)(state.q, state.pose, state.wrench, "<script>alert(1)</script>")
    assert "<script>" not in texts.describe_state(model, bad, model.compute_numbers(bad))


def test_steps_and_rounding():
    assert [_choose_step(span) for span in (2.2, 0.42, 200.0)] == [0.001, 0.001, 0.1]
    assert [_round_up(value) for value in (0.7, 1.0, 1.3, 34.0, 61.0)] == [1.0, 1.0, 2.0, 50.0, 100.0]


@every_model
def test_bars_keep_their_lengths_and_the_platform_carries_what_is_on_it(name, rng):
    """Bars of one body and rods are rigid, whatever the drawing does; a telescope is not."""
    model = model_of(name)
    scene = Scene(model.robot)
    rods = model.robot.graph.rods
    rigid = [k for k, b in enumerate(scene.bars) if b.start[0] == b.end[0] or b.part in rods]
    assert rigid
    for state in states(model, 8, rng)[:3]:
        shapes = scene.shapes(state.q)
        for k in rigid:
            bar = scene.bars[k]
            length = np.linalg.norm(bar.end[1] - bar.start[1])
            own = np.repeat(range(len(scene.bars)), scene.pieces) == k
            drawn = shapes.cylinder_sizes[: len(own), 2][own].sum()
            assert drawn == pytest.approx(length, abs=1e-8)
        np.testing.assert_allclose(shapes.platform_at, model.robot.platform(state.q)[0], atol=1e-12)
        shift = np.array([0.01, -0.02, 0.03, 0.0, 0.0, 0.0])
        moved = scene.shapes(state.q, Deflection(shift, {}))
        np.testing.assert_allclose(moved.platform_at - shapes.platform_at, shift[:3], atol=1e-12)
        for (_, spot), before, after in zip(scene._balls, shapes.ball_at, moved.ball_at, strict=False):
            expected = shift[:3] * scene._on_platform(spot)
            np.testing.assert_allclose(after - before, expected, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(shapes.cylinder_turns, axis=1), 1.0)


@pytest.mark.parametrize("name", ["stewart", "upr_rpu", "delta", "delta_cu", "five_bar", "prru"])
def test_a_deflected_machine_stays_together_and_moves_as_its_members(name):
    """What joints without a slide join stays joined, drives stay on their legs."""
    model = model_of(name)
    scene, state = Scene(model.robot), model.apply_wrench(model.start, [10.0, 5, -20, 0, 0, 0])
    deflection = model.compute_numbers(state).energy.deflection
    # So small that turns are linear.
    factor = 1e-4 * scene.size / np.abs(deflection).max()
    moved = model.compute_deflection(state, deflection).times(factor)
    rest, after = scene.shapes(state.q), scene.shapes(state.q, moved)
    last = np.cumsum(scene.pieces) - 1
    tips = np.column_stack([last - scene.pieces + 1, last]), [0, 1]
    before, now = (s.ends[tips].reshape(-1, 3) for s in (rest, after))
    ways = now - before
    graph = model.robot.graph
    sliding = {j.at.tobytes() for j in graph.joints.values() if j.kind == "cylindrical"}
    spots = [spot for bar in scene.bars for spot in (bar.start, bar.end)]
    held = [k for k, (_, at) in enumerate(spots) if at.tobytes() not in sliding]
    together = np.linalg.norm(before[held][:, None] - before[held], axis=-1) < 1e-6 * scene.size
    gaps = np.linalg.norm(ways[held][:, None] - ways[held], axis=-1)[together]
    assert together.sum() > len(held)
    assert gaps.max() < 0.02 * np.linalg.norm(ways, axis=-1).max()
    answer = member_deflections(model.robot, state.q, state.wrench)
    for beam, place in ((b, p) for b in model.robot.beams for p in (b.inner, b.outer)):
        if not scene._on_platform(place):
            points, shifts = answer[beam.name]
            k = next(k for k, spot in enumerate(spots) if spot is place)
            own = np.linalg.norm(points - before[k], axis=-1).argmin()
            np.testing.assert_allclose(ways[k], factor * shifts[own], atol=1e-9 * scene.size)
    for name in filter(lambda name: is_telescope(graph.joints[name]), after.drives):
        at = after.drives[name]
        bars = [k for k, b in enumerate(scene.bars) if graph.joints[name].inner == b.part]
        assert bars
        for foot, tip in (now[2 * k : 2 * k + 2] for k in bars):
            off = np.linalg.norm(np.cross(at - foot, tip - foot))
            assert off < 1e-4 * np.linalg.norm(tip - foot) ** 2


def test_every_element_has_a_place_and_its_colour():
    for name in ("delta_cu", "prru", "upr_rpu", "stewart", "linear_delta"):
        model = model_of(name)
        energy = model.compute_numbers(model.apply_wrench(model.start, [10.0, 5, -20, 0, 0, 0])).energy
        shares = dict(zip(energy.elements, energy.factors.tolist(), strict=True))
        shapes = Scene(model.robot).shapes(model.start.q, RIGID, shares)
        assert set(energy.elements) <= set(shapes.places)
        last = tuple(ENERGY_COLOURS[-1].astype(int))
        assert last in {tuple(c) for c in [*shapes.cylinder_colours, *shapes.ball_colours]}
        assert colour_by_share(shares)[energy.dominant] == last
    assert colour_by_share({"a": 0.0}) == {}


def test_labels_do_not_cover_each_other(rng):
    """In any window; and where there is room, all of them are shown."""
    offsets = {name: np.array(aside) for name, aside in ANCHORS.items()}
    for window in (300, 300), (500, 400), (1400, 900):
        spots = rng.random((12, 2)) * window
        sizes = np.column_stack([rng.uniform(30, 240, 12), np.full(12, 19.0)])
        found = choose_anchors(spots, sizes, window)
        shown = [(s + h * offsets[a], h) for s, h, a in zip(spots, sizes / 2, found, strict=True) if a]
        assert len(shown) >= (3 if window[0] < 1000 else 10)
        for k, (middle, half) in enumerate(shown):
            assert (middle - half >= 0).all() and (middle + half <= window).all()
            for other, size in shown[:k]:
                assert (np.abs(middle - other) >= half + size).any()


def test_meshes_are_closed():
    """Every edge is of two triangles, once in each direction."""
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    ball = make_round_meshes()[1]
    vertices, faces = make_plate(square, 0.1)
    half = faces[: len(faces) // 2]
    for points, triangles in (ball, (vertices, half)):
        _, place = np.unique(np.round(points, 9), axis=0, return_inverse=True)
        corners = place.reshape(-1)[triangles]
        corners = corners[[len(set(row)) == 3 for row in corners.tolist()]]
        edges = {(a, b) for row in corners.tolist() for a, b in zip(row, row[1:] + row[:1], strict=True)}
        assert {(b, a) for a, b in edges} == edges


@pytest.mark.parametrize("name", ["five_bar", "delta_cu"])
def test_a_picture_at_home_marks_the_bodies_centres_and_the_reference_point(name):
    robot = load(name)
    figure = draw(robot, marked=True)
    ax = figure.axes[0]
    centres, reference = (line for line in ax.lines if not line.get_label().startswith("_"))
    assert len(centres.get_xdata()) == sum(b.mass > 0.0 for b in robot.graph.bodies.values())
    assert len(reference.get_xdata()) == 1
    inside = ax.viewLim.contains
    assert all(inside(*at) for line in (centres, reference) for at in line.get_xydata())
    pyplot().close(figure)
