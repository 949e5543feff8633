# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Machines of one geometry share their programs, but each has its own masses and rotors."""

import copy
import dataclasses
import gc
import weakref

import numpy as np
import pytest

from delta_dynamics import least_norm_reactions
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.linkage import Linkage
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.mechanisms.machine import Machine
from test.support.robots import load, parameters_of


def longer(variant, length):
    """A delta with forearms of a length of its own."""
    robot, _ = variant("delta", geometry={"forearm_length": length})
    return robot.engine


def test_a_geometry_has_one_engine_however_many_others_were_loaded(variant):
    """Also after engines that nothing holds have made room for others."""
    first, second = longer(variant, 0.4015), longer(variant, 0.4025)
    for k in range(100):
        longer(variant, 0.41 + 1e-4 * k)
    assert longer(variant, 0.4015) is first
    assert longer(variant, 0.4025) is second


def test_engines_that_no_machine_has_are_given_up(variant):
    """A service that loads variants for days does not grow."""
    made = [weakref.ref(longer(variant, 0.43 + 1e-4 * k)) for k in range(60)]
    gc.collect()
    assert sum(engine() is not None for engine in made) <= 20


def test_directions_of_reactions_are_each_machines_own():
    """Machines that differ in nothing else share no program of reactions."""
    robot = load("upr_rpu")
    turned = dataclasses.replace(robot, name="turned")
    joints = {
        name: dataclasses.replace(
            joint,
            directions=tuple(dataclasses.replace(d, vector=-d.vector) for d in joint.directions),
        )
        for name, joint in robot.graph.joints.items()
    }
    vars(turned)["graph"] = dataclasses.replace(robot.graph, joints=joints)
    q, still = robot.graph.home, np.zeros(3)
    one, other = (least_norm_reactions(machine, q, still, still) for machine in (robot, turned))
    np.testing.assert_allclose(other.wrenches, one.wrenches, atol=1e-9)
    own = {joint.label or joint.name for joint in joints.values() if joint.directions}
    along = [k for k, name in enumerate(one.components) if name.split(":")[0] in own and not name.endswith("along n")]
    assert np.abs(one.values[along]).max() > 100.0
    np.testing.assert_allclose(other.values[along], -one.values[along], atol=1e-9)


def test_states_near_home_are_found_once_a_geometry(monkeypatch):
    """Also where a file leaves the pose's coordinates to be chosen, by an engine without any."""
    data = parameters_of("rps3")
    del data["pose"]
    data["origin"] = [0.001, 0.0, 0.6]
    found = []
    close = Linkage.close
    monkeypatch.setattr(Linkage, "close", lambda *given: found.append(given[0]) or close(*given))
    robot_of_data(data, "chosen").engine.check()
    assert len({id(one) for one in found}) == 1


def test_masses_are_judged_by_the_file_s_own_numbers():
    """Whatever machine of the same geometry was loaded before."""
    data = parameters_of("five_bar")
    for robot in (data, weightless := copy.deepcopy(data), data):
        if robot is weightless:
            for body in robot["bodies"].values():
                body.update(mass=0.0)
                body.pop("inertia", None)
            for joint in robot["joints"].values():
                joint.pop("rotor_inertia", None)
            with pytest.raises(ParameterError):
                Machine.from_data(robot, "weightless")
        else:
            assert Machine.from_data(copy.deepcopy(robot), "heavy").graph.bodies
