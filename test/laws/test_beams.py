# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Beam elements and assembled frames against closed forms and a second way to assemble."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.optimize import brentq

from pkm_twin.machine.graph import BASE
from pkm_twin.machine.members import Section, shear_area_ratio
from stiffness_monitor.frame import Frame, rigid_offset
from stiffness_monitor.modes import assemble, body_mass, element_matrices, member_matrices
from stiffness_monitor.structure import (
    RIGID,
    Member,
    RigidBody,
    StructuralModel,
    Support,
    local_axes,
)

PLATFORM = "platform"

FREE = math.inf
LENGTH = 0.8
TUBE = Section(70e9, 26e9, 0.04, 0.03, 2700 * math.pi / 4 * (0.04**2 - 0.03**2), 1.9)
SOLID = Section(210e9, 80e9, 0.1, 0.0, 7850 * math.pi / 4 * 0.01, 10 / 9)
SLENDER = Section(210e9, 80e9, 0.004, 0.0, 7850 * math.pi / 4 * 0.004**2, 0.0)
"""No shear, and next to no rotary inertia: the beam of Euler and Bernoulli."""
SECTIONS = pytest.mark.parametrize("section", [TUBE, SOLID, SLENDER])
# Of bending, by boundary: roots of cos x cosh x = -1, and of cos x cosh x = 1.
CLAMPED_FREE = [1.8751040687, 4.6940911330, 7.8547574382]
FREE_FREE = [4.7300407449, 7.8532046241, 10.9956078380]


def frequencies(stiffness, mass, count=None):
    values = eigh(stiffness, mass, eigvals_only=True)
    return np.sqrt(np.abs(values[:count])) / (2 * np.pi)


def lowest(system, count):
    """As above, by the inverse problem: stiff joints cost the low frequencies no digits."""
    values = eigh(system.mass, system.stiffness, eigvals_only=True)[::-1]
    return 1 / (2 * np.pi * np.sqrt(values[:count]))


def chain(section, elements, fixed=()):
    """Matrices of a chain with some displacements held."""
    stiffness, mass = member_matrices(section, LENGTH, elements)
    kept = np.setdiff1d(np.arange(len(mass)), list(fixed))
    return stiffness[np.ix_(kept, kept)], mass[np.ix_(kept, kept)]


def wave(section):
    """sqrt(E I / (mass per length)), m2/s."""
    return math.sqrt(section.youngs_modulus * section.second_moment / section.mass_per_length)


# ------------------------------------------------------------------ one element


@SECTIONS
@pytest.mark.parametrize("elements", [1, 3])
def test_static_deflections_of_a_cantilever(section, elements):
    stiffness, _ = chain(section, elements, range(6))
    flexibility = np.linalg.inv(stiffness)[-6:, -6:]
    s, l = section, LENGTH  # noqa: E741
    bending = s.youngs_modulus * s.second_moment
    shear = s.shear_factor / (s.shear_modulus * s.area)
    for across, slope, sign in ((1, 5, 1.0), (2, 4, -1.0)):
        assert flexibility[across, across] == pytest.approx(l**3 / (3 * bending) + l * shear)
        assert flexibility[slope, across] == pytest.approx(sign * l**2 / (2 * bending))
        assert flexibility[slope, slope] == pytest.approx(l / bending)
    assert flexibility[0, 0] == pytest.approx(l / (s.youngs_modulus * s.area))
    assert flexibility[3, 3] == pytest.approx(l / (s.shear_modulus * 2 * s.second_moment))


@SECTIONS
def test_mass_is_the_integral_over_the_shape_functions(section):
    """Shapes from the cantilever's own statics, not from the closed form of the matrix."""
    s, l = section, LENGTH  # noqa: E741
    stiffness, mass = element_matrices(s, l)
    bending = s.youngs_modulus * s.second_moment
    shear = s.shear_factor / (s.shear_modulus * s.area)
    points, weights = np.polynomial.legendre.leggauss(6)
    total = np.zeros((12, 12))
    for x, weight in zip((points + 1) / 2 * l, weights / 2 * l, strict=True):
        # Displacement of the section at x: the left end's, plus what the left part's loads do.
        loads = -stiffness[:6]
        left = np.eye(6, 12)
        shape = rigid_offset(np.array([x, 0.0, 0.0])) @ left
        # A cantilever of length x from the left, with the loads of the cut at x on its end.
        cut = rigid_offset(np.array([-x, 0.0, 0.0])).T @ loads
        flex = np.zeros((6, 6))
        flex[0, 0] = x / (s.youngs_modulus * s.area)
        flex[3, 3] = x / (s.shear_modulus * 2 * s.second_moment)
        for across, slope, sign in ((1, 5, 1.0), (2, 4, -1.0)):
            flex[across, across] = x**3 / (3 * bending) + x * shear
            flex[across, slope] = flex[slope, across] = sign * x**2 / (2 * bending)
            flex[slope, slope] = x / bending
        shape = shape + flex @ cut
        density = np.diag([s.mass_per_length] * 3 + [2 * s.rotary_inertia, s.rotary_inertia, s.rotary_inertia])
        total += weight * shape.T @ density @ shape
    scale = np.sqrt(np.diag(mass))
    assert np.abs((total - mass) / np.outer(scale, scale)).max() < 1e-9


@SECTIONS
@pytest.mark.parametrize("elements", [1, 4])
def test_rigid_motion_has_the_mass_of_the_bar_and_no_strain(section, elements):
    stiffness, mass = member_matrices(section, LENGTH, elements)
    ends = np.arange(elements + 1) / elements * LENGTH
    rigid = np.vstack([rigid_offset(np.array([x, 0.0, 0.0])) for x in ends])
    m, radial = section.mass_per_length * LENGTH, section.rotary_inertia * LENGTH
    body = RigidBody(
        "bar",
        m,
        np.array([LENGTH / 2, 0, 0]),
        np.diag([2 * radial, m * LENGTH**2 / 12 + radial, m * LENGTH**2 / 12 + radial]),
        "bar",
    )
    expected = body_mass(body, np.zeros(3))
    assert np.allclose(rigid.T @ mass @ rigid, expected, rtol=1e-12, atol=1e-12 * m)
    assert np.abs(stiffness @ rigid).max() < 1e-9 * np.abs(stiffness).max()
    values = np.linalg.eigvalsh(stiffness / np.sqrt(np.outer(*[np.diag(stiffness)] * 2)))
    assert (np.abs(values) < 1e-12).sum() == 6
    assert np.linalg.eigvalsh(mass).min() > 0.0


def test_shear_factors_of_a_tube():
    assert shear_area_ratio(0.0) == pytest.approx(7 / 6)
    assert shear_area_ratio(1.0) == pytest.approx(2.0)


# ------------------------------------------------------------------ frequencies in closed form


@pytest.mark.parametrize(("roots", "fixed", "rigid"), [(CLAMPED_FREE, range(6), 0), (FREE_FREE, (), 6)])
def test_bending_of_a_slender_beam(roots, fixed, rigid):
    found = frequencies(*chain(SLENDER, 16, fixed), rigid + 6)
    expected = np.repeat(np.square(roots), 2) / LENGTH**2 * wave(SLENDER) / (2 * np.pi)
    assert (found[:rigid] < 1e-3 * expected[0]).all()
    assert found[rigid:] == pytest.approx(expected, rel=5e-5)


def timoshenko_simply_supported(section, n):
    """Lower root of the frequency equation of half waves n, Hz (Timoshenko 1922)."""
    s = section
    k = n * math.pi / LENGTH
    m, j = s.mass_per_length, s.rotary_inertia
    bending = s.youngs_modulus * s.second_moment
    shear = s.shear_factor / (s.shear_modulus * s.area)
    a, b, c = m * j * shear, -(m + (j + m * bending * shear) * k * k), bending * k**4
    square = 2 * c / (-b + math.sqrt(b * b - 4 * a * c))
    return math.sqrt(square) / (2 * math.pi)


@pytest.mark.parametrize("section", [TUBE, SOLID])
def test_axial_and_torsional_waves_of_a_cantilever(section):
    s, elements = section, 40
    stiffness, mass = member_matrices(s, LENGTH, elements)
    for first, speed in (
        (0, math.sqrt(s.youngs_modulus * s.area / s.mass_per_length)),
        (3, math.sqrt(s.shear_modulus * s.area / s.mass_per_length)),
    ):
        kept = np.arange(6 + first, len(mass), 6)
        found = frequencies(stiffness[np.ix_(kept, kept)], mass[np.ix_(kept, kept)], 2)
        assert found == pytest.approx(np.array([1, 3]) * speed / (4 * LENGTH), rel=1e-3)


@pytest.mark.parametrize(("section", "order"), [(SLENDER, 4), (TUBE, 2), (SOLID, 2)])
def test_frequencies_converge_with_the_elements(section, order):
    """Fourth power of their length, second where the shear's share of an element's bend counts."""
    expected = timoshenko_simply_supported(section, 2)
    errors = []
    for elements in (8, 16, 32):
        last = 6 * elements
        found = frequencies(*chain(section, elements, (0, 1, 2, 3, last + 1, last + 2)))
        errors.append(np.abs(found / expected - 1).min())
    assert errors[-1] < 2e-4
    assert errors[0] / errors[1] == pytest.approx(2**order, rel=0.2)
    assert errors[1] / errors[2] == pytest.approx(2**order, rel=0.2)


# ------------------------------------------------------------------ frames


def frame_of(origin, members, bodies):
    """A model of members alone; bodies of the platform by their place from its origin."""
    placed = tuple(replace(body, at=origin + body.at) for body in bodies)
    return StructuralModel(origin, PLATFORM, members, (), placed)


def point(mass, inertia=0.0):
    return RigidBody(PLATFORM, mass, np.zeros(3), inertia * np.eye(3), PLATFORM)


def cantilever(section, along, compliance=RIGID, body=None):
    axes = local_axes(along)
    end = LENGTH * along
    inner = Support("root", BASE, axes, compliance)
    outer = Support("tip", PLATFORM, axes)
    bar = Member("bar", "bar", section, np.zeros(3), end, inner, outer)
    return frame_of(end, (bar,), (body or point(0.0),))


@pytest.mark.parametrize("ratio", [0.1, 1.0, 25.0])
def test_cantilever_with_a_tip_mass(ratio, rng):
    """1 + cos x cosh x = ratio x (sin x cosh x - cos x sinh x), tip mass over bar mass."""
    mass = ratio * SLENDER.mass_per_length * LENGTH
    along = rng.normal(size=3)
    along /= np.linalg.norm(along)

    def equation(x):
        return 1 + math.cos(x) * math.cosh(x) - ratio * x * (math.sin(x) * math.cosh(x) - math.cos(x) * math.sinh(x))

    expected = brentq(equation, 1e-3, 1.9) ** 2 / LENGTH**2 * wave(SLENDER) / (2 * math.pi)
    system = assemble(cantilever(SLENDER, along, body=point(mass)), 8)
    assert frequencies(system.stiffness, system.mass, 2) == pytest.approx(expected, rel=2e-5)


def test_a_pinned_strut_has_the_simply_supported_beams_frequencies():
    """Ball joints at both ends of a rod, between ground and a heavy platform on a stiff post."""
    axes = np.eye(3)
    end = np.array([LENGTH, 0.0, 0.0])
    post = Section(1e13, 1e13, 1.0, 0.0, 1.0, 0.0)
    rod = Member(
        "rod",
        "rod",
        TUBE,
        np.zeros(3),
        end,
        Support("foot", BASE, axes, (0.0,) * 4 + (FREE,) * 2),
        Support("head", PLATFORM, axes, (FREE, 0.0, 0.0) + (FREE,) * 3),
    )
    hold = Member(
        "post",
        "post",
        post,
        np.array([LENGTH, 0.0, 0.01]),
        end,
        Support("a", BASE, axes),
        Support("b", PLATFORM, axes),
    )
    system = assemble(frame_of(end, (rod, hold), (point(1e3, 1e3),)), 16)
    found = lowest(system, 20)
    for n in (1, 2):
        near = np.sort(np.abs(found / timoshenko_simply_supported(TUBE, n) - 1))[:2]
        assert (near < 4e-4).all()


def random_frame(rng):
    """Two legs of two bars each: hinged, sprung and rigid joints in random axes, one free end."""

    def axes():
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        return q * np.sign(np.linalg.det(q))

    origin = rng.normal(size=3)
    members = []
    for leg in "ab":
        start, knee, end = rng.normal(size=(3, 3))
        spring = tuple(10.0 ** rng.uniform(-9, -6, 6))
        members += [
            Member(f"thigh {leg}", "thigh", SOLID, start, knee, Support("hip", BASE, axes()), None),
            Member(
                f"shin {leg}",
                "shin",
                TUBE,
                knee + 0.1 * rng.normal(size=3),
                end,
                Support("knee", f"thigh {leg}", axes(), (0.0, *spring[1:5], FREE), 1),
                Support("foot", PLATFORM, axes(), (spring[0], 0.0, 0.0, FREE, 0.0, spring[5])),
            ),
        ]
    body = RigidBody(PLATFORM, 3.0, rng.normal(size=3) * 0.1, np.diag([0.1, 0.2, 0.25]), PLATFORM)
    return frame_of(origin, tuple(members), (body,))


def test_modes_of_held_members_stand_for_their_nodes(rng):
    """Statics exactly, low frequencies closely, and equal ones remain equal."""
    for _ in range(2):
        frame = random_frame(rng)
        full, reduced = assemble(frame, 8), assemble(frame, 8, 8)
        assert len(reduced.mass) < len(full.mass) / 2
        static = [np.linalg.inv(s.stiffness)[:6, :6] for s in (full, reduced)]
        assert static[1] == pytest.approx(static[0], rel=1e-6, abs=1e-9 * np.abs(static[0]).max())
        a, b = lowest(full, 6), lowest(reduced, 6)
        # A smaller space: never below.
        assert (b > a * (1 - 1e-7)).all()
        assert b == pytest.approx(a, rel=2e-3)
        shape = np.zeros(len(reduced.mass))
        shape[:6] = rng.normal(size=6)
        moved = dict(zip(reduced.nodes, reduced.displacements(shape), strict=True))
        place = reduced.positions[reduced.nodes.index("shin a 8/8")]
        assert moved["shin a 8/8"] == pytest.approx(rigid_offset(place - frame.origin) @ shape[:6])
    bar = assemble(cantilever(SLENDER, np.array([0.6, 0.0, -0.8]), body=point(0.01)), 8, 3)
    found = frequencies(bar.stiffness, bar.mass, 4)
    assert found[::2] == pytest.approx(found[1::2], rel=1e-9)


def test_frames_are_symmetric_and_energies_add_up(rng):
    frame = random_frame(rng)
    system = assemble(frame, 3)
    for matrix in (system.stiffness, system.mass):
        assert np.abs(matrix - matrix.T).max() < 1e-12 * np.abs(matrix).max()
    shape = rng.normal(size=len(system.mass))
    names, strain, kinetic = system.energies(shape)
    assert set(names) == {"platform", "thigh", "shin", "hip", "knee", "foot"} - {"hip"}
    assert strain.sum() == pytest.approx(shape @ system.stiffness @ shape)
    assert kinetic.sum() == pytest.approx(shape @ system.mass @ shape)


def test_columns_add_up_to_the_stiffness(rng):
    for _ in range(3):
        frame = random_frame(rng)
        bare = [replace(m, section=m.section.rigidities) for m in frame.members]
        made = Frame(replace(frame, parts=tuple(bare)))
        columns = [c for bar in made.bars for c in made.columns(bar)] + made.springs
        found = np.zeros((made.size, made.size))
        for column in columns:
            row = np.zeros(made.size)
            row[list(column.row)] = list(column.row.values())
            found += column.rigidity * np.outer(row, row)
        expected = assemble(frame, 1).stiffness
        assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


def test_a_member_on_nothing_is_refused():
    bar = Member("bar", "bar", TUBE, np.zeros(3), np.ones(3), Support("j", "arm", np.eye(3)), None)
    with pytest.raises(ValueError, match="arm"):
        assemble(frame_of(np.zeros(3), (bar,), ()), 2)
