# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Laws of the compliance by the elements' factors, over robots, poses, loads and factors."""

from __future__ import annotations

import numpy as np
import pytest

from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.identification.deflections import fit_elements
from pkm_twin.recordings import Recording
from stiffness_monitor import compliance, strain_energy
from stiffness_monitor.response import element_response
from test.support.robots import load, random_joints, rigid

MORE = [pytest.param(name, marks=pytest.mark.long) for name in ("delta", "prru")]
ELASTIC = ("upr_rpu", "delta_cu", *MORE)


def near_home(robot, rng, count):
    """Poses around home, a few hundredths of the joints' ranges away."""
    q = robot.inverse(robot.home())
    return robot.forward(q + 0.03 * robot.size * rng.uniform(-1.0, 1.0, (count, len(q))))


def drawn(name, count=2):
    """A robot, poses, wrenches, and factors from a half to three."""
    robot, rng = load(name), np.random.default_rng(7)
    poses = near_home(robot, rng, count)
    names = element_response(robot, poses[0]).names
    wrenches = rng.normal(size=(count, 6)) * np.repeat([50.0, 50.0 * robot.size], 3)
    return robot, poses, wrenches, rng.uniform(0.5, 3.0, len(names))


@pytest.mark.parametrize("name", ELASTIC)
def test_factors_are_those_of_the_file(name):
    robot, poses, wrenches, factors = drawn(name)
    response = element_response(robot, poses)
    softer = robot.changed(element_compliance=dict(zip(response.names, factors, strict=True)))
    expected = compliance(softer, poses)
    size = np.abs(expected).max()
    np.testing.assert_allclose(response.compliance, compliance(robot, poses), atol=1e-12 * size)
    np.testing.assert_allclose(response.compliance_at(factors), expected, atol=1e-10 * size)
    moved, _ = response.deflection(wrenches, factors)
    np.testing.assert_allclose(moved, (expected @ wrenches[..., None])[..., 0], atol=1e-9 * np.abs(moved).max())
    # All elements alike: compliance is their multiple.
    np.testing.assert_allclose(
        response.compliance_at(np.full(len(factors), 2.5)),
        2.5 * response.compliance,
        atol=1e-10 * size,
    )


@pytest.mark.parametrize("name", ELASTIC)
def test_derivatives_are_those_of_a_complex_step_and_the_elements_energies(name):
    robot, poses, wrenches, factors = drawn(name)
    response = element_response(robot, poses)
    slopes = response.derivatives(factors)
    size = np.abs(slopes).max()
    for k in range(len(factors)):
        stepped = factors.astype(complex)
        stepped[k] += 1e-30j
        exact = response.compliance_at(stepped).imag / 1e-30
        np.testing.assert_allclose(slopes[:, k], exact, atol=1e-11 * size)
    np.testing.assert_allclose(
        response.deflection(wrenches, factors)[1],
        np.einsum("nejk,nk->nje", slopes, wrenches),
        atol=1e-10 * size * np.abs(wrenches).max(),
    )
    # Homogeneous of degree one: the weighted sum is the compliance.
    np.testing.assert_allclose(
        np.einsum("e,nejk->njk", factors, slopes),
        response.compliance_at(factors),
        atol=1e-10 * size,
    )
    energy = strain_energy(robot, poses, wrenches)
    assert energy.elements == response.names
    doubled = np.einsum("nj,nejk,nk->ne", wrenches, response.derivatives(), wrenches)
    np.testing.assert_allclose(doubled / 2, energy.energies, atol=1e-9 * energy.energies.max())
    assert np.linalg.eigvalsh(slopes).min() > -1e-12 * size


def test_members_of_a_frame_are_fitted():
    robot, _, wrenches, factors = drawn("delta_cu", 12)
    # Near home an arm's torsion and its forearm's stretch deflect the platform alike.
    poses = robot.forward(random_joints(robot, np.random.default_rng(7), 12))
    response = element_response(robot, poses)
    moved, _ = response.deflection(wrenches, factors)
    time, q = np.arange(12.0), robot.inverse(poses)
    recording = Recording(robot, time, q, wrench=wrenches, deflection=moved)
    numbers = fit_elements(robot, [recording]).numbers
    np.testing.assert_allclose([n.after for n in numbers], factors, rtol=1e-6)


def test_factors_stand_in_the_file_and_wrong_names_are_refused(tmp_path):
    robot = load("upr_rpu").changed(element_compliance={"3U": 3.0})
    again = robot.with_file_values({"element_compliance.3U": 2.0})
    assert again.element_compliance == {"3U": 2.0}
    with pytest.raises(UnknownNameError, match="did you mean '3U'"):
        robot.changed(element_compliance={"3V": 3.0})
    with pytest.raises(ParameterError, match=r"element_compliance\.3U: 0\.0"):
        robot.changed(element_compliance={"3U": 0.0})
    with pytest.raises(ParameterError, match="nothing is elastic"):
        load(rigid("stewart", tmp_path / "rigid.yaml")).changed(element_compliance={"3U": 3.0})
