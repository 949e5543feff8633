# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The singularity measure beside maximal coordinates, which know no tree, and beside statics."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from delta_dynamics import reactions
from pkm_twin import robot_names
from pkm_twin.certify.maximal import Maximal
from pkm_twin.certify.rows import stack_rows
from pkm_twin.errors import SingularityError
from pkm_twin.kinematics.linkage import Linkage
from pkm_twin.kinematics.singularity import KinematicCopy, numeric_singularity
from pkm_twin.machine.graph import weld
from pkm_twin.machine.graph_description import graph_description
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.robot_urdf import robot_description
from stiffness_monitor import compliance
from test.machine.random_machines import GALLERY, NAMES, plain, rotation_of, variant
from test.support.robots import KINDS, joint_range, load, partly_long, random_joints

SURFACE = np.array([-0.08871, 0.34395, -0.18159])
"""A pose of the Delta-CU, inside its limits and its reach, where its platform is free to turn."""
UP = np.array([0.0, 0.0, 1.0])
SHORT = ("five_bar", "four_bar", "gantry", "rps3", "upr_rpu")
"""Machines of few operations: with redundant closures, with none, with three of balls."""
MACHINES = [name for name in robot_names() if name not in ("delta", "delta_cu")]


def with_both_rods(robot):
    """The robot's plain description with the rods of every pair, and nothing that stands for them.

    Their distance is the platform's reach.
    """
    graph = robot.graph
    data = graph_description(graph) | {"pose": ["x", "y", "z"]}
    del data["joints"]["translation"]
    for name, rod in graph.rods.items():
        whole = data["rods"].pop(name)
        for side, sign in (("left", 0.5), ("right", -0.5)):
            ends = (rod.ends + sign * graph.body_scale(graph.platform)[1] * rod.pair).tolist()
            data["rods"][f"{name} {side}"] = {**whole, "ends": ends, "mass": whole["mass"] / 2}
    return data


def frame(graph, body):
    """A body's point at home and the length of its turning, as the measure's definition has it."""

    def extent(name):
        points = np.array(graph.joint_points(name))
        middle = points.mean(0)
        return middle, np.linalg.norm(points - middle, axis=1).max()

    middle, reach = extent(body)
    own = extent(graph.platform)[1]
    every = np.vstack([graph.joint_points(name) for name in graph.bodies])
    whole = np.linalg.norm(every - every.mean(0), axis=1).max()
    return middle, max(reach, own if own > 1e-6 * whole else 0.1 * whole, 1e-6)


def twists(judge, graph):
    """Motion of all bodies by rates of maximal coordinates, shape (6 bodies, rates)."""
    rows = []
    for name in graph.bodies:
        middle, reach = frame(graph, name)
        rows += [judge.point(name, middle).columns, reach * judge.spin(name).columns]
    return np.vstack(rows)


def expected(robot, judge, q):
    """The measure by its definition, on numbers, from a matrix of all bodies' free motion."""
    placed = KinematicCopy(robot.engine.evaluate_state(robot.engine.tree.home, robot.graph.home)[0])
    graph = weld(robot.graph)
    judge.assemble(q)
    bodies, radius = twists(judge, graph), frame(graph, graph.platform)[1]
    exact = [judge.drives().columns]
    wrong = [judge.rod_rows(rod).columns / rod.length for rod in judge.machine.rods]
    for joint in judge.machine.joints:
        rows = stack_rows(judge.joint_rows(joint), judge.size).columns
        if joint.name not in placed.tree.cut:
            exact.append(rows)
            continue
        # Rows without a velocity of the centres are about directions.
        angles = ~rows.reshape(len(rows), -1, 6)[..., :3].any((1, 2))
        wrong.append(np.where(angles[:, None], radius * rows, rows))
    held = 1.0
    _, s, vt = np.linalg.svd(np.vstack(exact))
    free = vt[int((s > 1e-9 * s[0]).sum()) :].T
    if free.size:
        a = np.vstack(wrong) @ free
        response = np.linalg.norm(bodies @ free @ np.linalg.pinv(a))
        held = 0.5 * a.shape[1] / np.sqrt(len(a)) / response
    tangent = judge.tangent()
    k = list(graph.bodies).index(graph.platform)
    # A pose without an angle is one of the reference point.
    whole = "rad" in robot.pose_units
    point = judge.point(graph.platform, graph.origin).columns
    inverse = np.linalg.pinv((bodies[6 * k : 6 * k + 6] if whole else point) @ tangent)
    farthest = max(np.linalg.norm(body @ tangent @ inverse) for body in np.split(bodies, len(bodies) // 6))
    moved = np.sqrt(len(q)) / farthest
    return min(1.0, held, moved)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in SHORT else pytest.mark.long)
        for name in dict.fromkeys([*MACHINES, *NAMES])
    ],
)
def test_the_definition_in_maximal_coordinates(name):
    robot = load(name) if name in MACHINES else robot_of_data(plain(name), name)
    judge = Maximal(robot_description(robot))
    q = random_joints(robot, np.random.default_rng(3), 8, clear=0.01)
    by_twin = robot.singularity(q)
    assert ((by_twin > 0.0) & (by_twin <= 1.0)).all()
    by_judge = [expected(robot, judge, here) for here in q]
    assert by_twin == pytest.approx(by_judge, rel=1e-6)
    assert [float(robot.singularity(here)) for here in q] == by_twin.tolist()


def replaced(graph, turn, scale, shift):
    """The same machine elsewhere, turned and of another size."""
    joints = {
        name: replace(
            joint,
            at=scale * turn @ joint.at + shift,
            axes=joint.axes @ turn.T,
            pitch=scale * joint.pitch,
        )
        for name, joint in graph.joints.items()
    }
    rods = {
        name: replace(
            rod,
            ends=scale * rod.ends @ turn.T + shift,
            pair=None if rod.pair is None else turn @ rod.pair,
        )
        for name, rod in graph.rods.items()
    }
    return replace(graph, joints=joints, rods=rods, origin=scale * turn @ graph.origin + shift)


def shuffled(entries, rng):
    names = list(entries)
    rng.shuffle(names)
    return {name: entries[name] for name in names}


def law_machines():
    """Shipped robots, templates of the gallery, machines of tests and random ones; by default some of each."""
    yield from partly_long(robot_names(), *KINDS)
    templates = sorted(GALLERY.glob("*.yaml"))
    yield from partly_long(templates, *templates[::4])
    for k, name in enumerate(NAMES):
        yield pytest.param(partial(plain, name), id=name, marks=[pytest.mark.long] if k % 4 else [])
        made = partial(variant, name, np.random.default_rng(k))
        yield pytest.param(made, id=f"random {name}", marks=pytest.mark.long)


class TestOneMachineOneMeasure:
    """However its file is written, where the reference point is, turned, or of another size."""

    @staticmethod
    def measures(graph, states, point):
        """By joint positions by name, of the joints that lead."""
        linkage = Linkage(graph)
        rows = ([state[name] for name in graph.leads] for state in states)
        return [numeric_singularity(linkage, np.array(row), point=point) for row in rows]

    @pytest.mark.parametrize("machine", list(law_machines()), ids=lambda m: Path(m).stem)
    def test_measure(self, machine):
        robot = robot_of_data(machine(), "machine") if callable(machine) else load(machine)
        graph, rng = robot.graph, np.random.default_rng(7)
        point = "rad" not in robot.pose_units
        slides = {name: graph.joints[name].slides for name in graph.leads}
        home = {name: graph.joints[name].home for name in graph.leads}
        # Translation joints slide along base axes.
        turns = all(joint.kind != "translation" for joint in graph.joints.values())
        scale, turn = rng.uniform(0.3, 3.0), rotation_of(rng.normal(size=3) * turns)
        away = [{n: rng.uniform(-1.0, 1.0) * (0.05 * graph.size if slides[n] else 0.1) for n in home} for _ in range(2)]
        away = [dict.fromkeys(home, 0.0), *away]
        states = [{n: home[n] + move[n] for n in home} for move in away]
        grown = [{n: home[n] + move[n] * scale ** slides[n] for n in home} for move in away]
        expected = self.measures(graph, states, point)
        assert all(0.0 < value <= 1.0 for value in expected)
        order = replace(
            graph,
            bodies=shuffled(graph.bodies, rng),
            joints=shuffled(graph.joints, rng),
            rods=shuffled(graph.rods, rng),
        )
        elsewhere = replaced(graph, turn, scale, rng.normal(size=3))
        cases = [(order, states), (elsewhere, grown)]
        if not point:
            moved = replace(graph, origin=graph.origin + graph.size * rng.normal(size=3))
            cases.append((moved, states))
        for same, there in cases:
            assert self.measures(same, there, point) == pytest.approx(expected, rel=1e-10)

    @pytest.mark.parametrize("name", ["prru", "rps3", "rrr3_planar"])
    def test_on_numbers_and_compiled(self, name):
        robot = load(name) if name in robot_names() else load(GALLERY / f"{name}.yaml")
        q = random_joints(robot, np.random.default_rng(1), 4)
        linkage = Linkage(robot.graph)
        found = [numeric_singularity(linkage, here) for here in q]
        assert robot.singularity(q) == pytest.approx(found, rel=1e-9)


def test_both_rods_of_a_parallelogram_say_what_its_couple_says():
    """One rod and a couple, beside two rods, which nothing but the lengths of rods holds."""
    whole = load("delta_cu")
    split = robot_of_data(with_both_rods(whole), "split")
    q = np.random.default_rng(4).uniform(*whole.limits.position.T, (300, 3))
    one, other = whole.singularity(q), split.singularity(q)
    # Errors of two rods are not those of one and a couple, so they agree in kind, not in digits.
    assert (one / other > 0.3).all()
    assert (one / other < 3.0).all()
    assert (one < 0.03).any()


class TestConstraintSingularity:
    """The Delta-CU's: two parallelograms and the universal joint lose the platform's turning."""

    robot = load("delta_cu")

    @pytest.fixture(scope="class")
    @classmethod
    def place(cls):
        """Where the measure is least on a short upright line through the surface's pose."""
        line = {"method": "bounded", "bounds": (-1e-4, 1e-4), "options": {"xatol": 1e-14}}
        found = minimize_scalar(lambda z: cls.measure(SURFACE + z * UP), **line)
        return SURFACE + found.x * UP

    @classmethod
    def measure(cls, pose):
        return float(cls.robot.singularity(cls.robot.inverse(pose)))

    def test_measure_is_zero_in_it_and_small_beside(self, place):
        robot = self.robot
        assert np.abs(place - SURFACE).max() < 2e-5
        q = robot.inverse(place)
        assert ((q > robot.limits.position[:, 0]) & (q < robot.limits.position[:, 1])).all()
        assert self.measure(place) < 1e-8
        # None of these directions is along the surface, as x nearly is.
        sine = np.sqrt(0.75)
        across = np.array([[-0.5, sine, 0.0], [-sine, -0.5, 0.0], UP])
        for shift in (*across, *-across):
            assert 1e-4 < self.measure(place + 1e-3 * shift) < 2e-3
        assert self.measure(robot.home()) > 0.15

    def test_it_is_where_maximal_coordinates_have_it(self, place):
        """By their determinant, extrapolated: their way from home ends next to the surface."""
        judge = Maximal(with_both_rods(self.robot))
        ways = np.array([2e-4, 4e-4, 6e-4])
        values = []
        for way in ways:
            judge.assemble(self.robot.inverse(place - way * UP))
            columns = np.vstack([judge.closures().columns, judge.drives().columns])
            assert columns.shape == (judge.size, judge.size)
            values.append(np.linalg.slogdet(columns / np.abs(columns).max())[1])
        roots = np.roots(np.polyfit(ways, np.exp(np.array(values) - values[0]), 2))
        assert np.abs(roots).min() < 1e-7

    def test_statics_fails_where_the_measure_does(self, place):
        robot, rest = self.robot, np.zeros(3)
        greatest = []
        for shift in (1e-5, 1e-4, 1e-3, 1e-2):
            q = robot.inverse(place - shift * UP)
            load_ = np.abs(reactions(robot, q, rest, rest).values).max()
            assert 0.02 < load_ * robot.singularity(q) < 2.0
            greatest.append(np.abs(compliance(robot, place - shift * UP)).max())
        # Compliance goes with the square.
        assert np.diff(np.log10(greatest)) == pytest.approx([-2.0] * 3, abs=0.2)
        try:
            load_ = np.abs(reactions(robot, robot.inverse(place), rest, rest).values).max()
        except SingularityError:
            load_ = np.inf
        # What lies within rounding of the surface bears 1e6 times what a good pose does.
        assert load_ > 1e6


class TestWays:
    """Along a way to a singularity the measure goes to zero with the way."""

    def test_edge_of_reach(self):
        robot = load("five_bar")
        home = robot.home()
        # Straight down until an arm and its rod are in line.
        low, high = 0.0, 1.0
        for _ in range(60):
            middle = (low + high) / 2
            good = robot.try_inverse(home - [0.0, middle])[1]
            low, high = (middle, high) if good else (low, middle)
        way = np.array([1e-8, 1e-6, 1e-4, 1e-2])
        poses = home - np.stack([np.zeros(4), low - way], -1)
        measure = robot.singularity(robot.inverse(poses))
        assert (np.diff(measure) > 0.0).all()
        # With the square root of what is left.
        assert np.diff(np.log10(measure[:3])) == pytest.approx([1.0, 1.0], abs=0.1)

    @pytest.mark.parametrize("seed", range(3))
    def test_a_point_that_joints_do_not_move_one_way(self, seed):
        """The platform of a five-bar is a forearm: it turns where its point stands still."""
        robot = robot_of_data(variant("five_bar", np.random.default_rng(seed)), "five_bar")
        q = np.random.default_rng(seed).uniform(-3.0, 3.0, (20_000, 2))
        measure, good = robot.try_singularity(q)
        least = np.linalg.svd(robot.jacobian(q[good]), compute_uv=False)[:, -1]
        near = least < 1e-3 * robot.engine.tree.size
        assert near.sum() > 10
        assert (measure[good][near] < 10.0 * least[near] / robot.engine.tree.size).all()

    def test_dead_points_of_one_joint(self):
        """One joint and one coordinate: no ratio of singular values tells anything there."""
        robot = robot_of_data(plain("slider_crank"), "crank")
        home = float(robot.graph.home[0])
        q = home + np.linspace(-3.0, 3.0, 20_001)[:, None]
        measure, good = robot.try_singularity(q)
        inside = measure[good]
        assert inside.max() > 0.1
        assert inside.min() < 0.01


@pytest.mark.parametrize("name", partly_long(("four_bar", "elbow_motors", "rsur"), "four_bar"))
def test_how_a_body_is_welded_together_does_not_count(name):
    """Each joint of a body that moves stands on a part of its own, bolted on."""
    whole = robot_of_data(plain(name), name)
    data = robot_description(whole)
    joints, bolts = data["joints"], {}
    for own, joint in joints.items():
        for k, body in enumerate(joint["between"]):
            if body != "base":
                part = f"{own}_part_{k}"
                data["bodies"][part] = {}
                joint["between"][k] = part
                bolts[f"{part}_bolt"] = {"type": "fixed", "between": [body, part], "at": joint["at"]}
    data["joints"] = {**joints, **bolts}
    parts = robot_of_data(data, name)
    q = random_joints(whole, np.random.default_rng(5), 4, clear=0.01)
    np.testing.assert_allclose(parts.singularity(q), whole.singularity(q), rtol=1e-9)


@pytest.mark.parametrize("name", robot_names())
def test_where_there_is_no_assembly_there_is_no_measure(name):
    robot = load(name)
    middle, half = joint_range(robot)
    q = middle + 30.0 * half * np.linspace(0.0, 1.0, 40)[:, None]
    measure, good = robot.try_singularity(q)
    assert (measure[~good] == 0.0).all()
    assert (measure[good] > 0.0).all()
    assert good.tolist() == robot.try_forward(q)[1].tolist()
