# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Constraint equations: forces and moments are their derivatives, by bodies and by frames."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pkm_twin.kinematics.constraints import (
    Placement,
    constraint_equations,
    differentiate_by_frame,
    distance_equation,
    drive_equation,
    rod_pair_equation,
    rotate,
)
from pkm_twin.machine.graph import BASE, Body, Graph, Joint
from pkm_twin.machine.joints import TYPES
from pkm_twin.machine.rotations import rotation_about, rotation_vector

STEP = 1e-5
BODIES = ("inner", "outer")


def unit(rng):
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def equations(kind, placed, at, axes, shifts=(0.0, 0.0), tilts=(None, None)):
    """The equations of a part between two bodies, whose frames are displaced on them."""
    turns = [placed.body_rotation(n) for n in BODIES]
    turns = [r if t is None else r @ rotation_about(t) for r, t in zip(turns, tilts, strict=True)]
    points = [placed.point(n, at + s) for n, s in zip(BODIES, shifts, strict=True)]
    functions = [partial(rotate, turn) for turn in turns]
    if kind == "rod":
        return [distance_equation("part", BODIES, points, 0.3, placed.size)]
    if kind == "pair":
        vectors = [function(axes[0]) for function in functions]
        return [rod_pair_equation("part", BODIES, points, vectors, 1.0)]
    own = TYPES[kind]
    joint = Joint("part", kind, *BODIES, at, axes[: own.count], actuated=True, pitch=0.1)
    found = []
    for held in joint.constraints:
        found += constraint_equations("part", BODIES, held, points, functions, placed.size)
    if len(joint.freedoms) == 1:
        found.append(drive_equation(joint, 0.2, points, functions, placed.size))
    return found


def place(rng, apart=0.02):
    """Two bodies anywhere, their frames nearly together; one of a batch of three."""
    bodies = {name: Body(name) for name in BODIES}
    graph = Graph(bodies, {}, {}, "outer", np.array([0.3, -0.1, 0.2]))
    home = replace(Placement.at_home(graph, (3,)), size=0.7)
    both = np.tile(rng.uniform(-0.5, 0.5, (3, 1, 6)), (1, 2, 1))
    return home.moved(both.reshape(3, 12)).moved(rng.uniform(-apart, apart, (3, 12)))


@pytest.mark.parametrize("kind", [*TYPES, "rod"])
def test_forces_and_moments_are_derivatives_by_the_bodies(kind, rng):
    placed, at, axes = place(rng), rng.normal(size=3), np.array([unit(rng), unit(rng)])
    table = placed.jacobian(equations(kind, placed, at, axes))
    for k in range(12):
        step = np.zeros((3, 12))
        step[:, k] = STEP
        after, before = (placed.moved(s * step) for s in (1.0, -1.0))
        values = [p.values(equations(kind, p, at, axes)) for p in (after, before)]
        slope = (values[0] - values[1]) / (2.0 * STEP)
        # A screw's axis and its mark are perpendicular where the joint fits.
        bound = 0.02 if kind == "helical" else 1e-8
        np.testing.assert_allclose(table[..., k], slope, atol=bound)


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("kind", [*(kind for kind in TYPES if kind != "helical"), "rod"])
def test_derivatives_by_a_frame_are_differences(kind, side, rng):
    placed, at, axes = place(rng), rng.normal(size=3), np.array([unit(rng), unit(rng)])
    name = BODIES[side]
    for k, one in enumerate(equations(kind, placed, at, axes)):
        shift, tilt = differentiate_by_frame(one, side, placed.point(name, at), placed.body_rotation(name))
        way, values = rng.normal(size=3), []
        for what, found in (("shifts", shift), ("tilts", tilt)):
            if kind == "rod" and what == "tilts":
                continue
            values = []
            for s in (STEP, -STEP):
                own = [np.zeros(3), np.zeros(3)]
                own[side] = s * way
                moved = equations(kind, placed, at, axes, **{what: own})
                values.append(placed.values(moved)[..., k])
            np.testing.assert_allclose(found @ way, (values[0] - values[1]) / (2.0 * STEP), atol=1e-8)


def test_a_pair_of_rods_holds_the_turn_about_its_normal(rng):
    placed, at, axes = place(rng, 0.0), rng.normal(size=3), np.array([unit(rng), unit(rng)])
    points = [placed.point(n, at + k * axes[1]) for k, n in enumerate(BODIES)]
    vectors = [rotate(placed.body_rotation(n), axes[0]) for n in BODIES]
    one = rod_pair_equation("part", BODIES, points, vectors, 1.0)
    normal = np.cross(vectors[1], points[1] - points[0])
    np.testing.assert_allclose(one.value, 0.0, atol=1e-14)
    np.testing.assert_allclose(placed.jacobian([one])[..., 0, 9:12], normal, atol=1e-12)


def test_rotation_vectors_are_undone(rng):
    vectors = rng.uniform(-1.7, 1.7, (50, 3))
    np.testing.assert_allclose(rotation_vector(rotation_about(vectors)), vectors, atol=1e-12)
    assert BASE in place(rng).index
