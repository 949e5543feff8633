# SPDX-License-Identifier: Apache-2.0
"""Machines of one geometry share their programs, but each has its own masses and rotors."""

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, mass_matrix
from test.support.robots import load


@pytest.mark.parametrize("heavy_first", [True, False])
@pytest.mark.parametrize(
    ("name", "mass", "rotor"),
    [
        ("delta_cu", {"platform_mass": 0.9}, {"rotor_inertia": 0.02}),
        ("prru", {"platform_mass": 40.0}, {"rotor_inertia": 3.0}),
    ],
)
def test_masses_are_those_of_the_file(variant, name, mass, rotor, heavy_first):
    makes = [lambda: load(name), lambda: variant(name, inertia=mass)[0]]
    robots = [make() for make in (makes[::-1] if heavy_first else makes)]
    light, heavy = robots[::-1] if heavy_first else robots
    q = light.inverse(light.home())
    zero = np.zeros(len(q))
    assert (np.diag(mass_matrix(heavy, q)) > np.diag(mass_matrix(light, q))).all()
    difference = inverse_dynamics(heavy, q, zero, zero) - inverse_dynamics(light, q, zero, zero)
    assert np.abs(difference).min() > 1e-3
    # A rotor adds its own inertia to the joint's, and no weight.
    geared, _ = variant(name, inertia=rotor)
    more = np.diag(mass_matrix(geared, q)) - np.diag(mass_matrix(light, q))
    assert np.allclose(more, rotor["rotor_inertia"])
    assert np.array_equal(
        inverse_dynamics(geared, q, zero, zero), inverse_dynamics(light, q, zero, zero)
    )
