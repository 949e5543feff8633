# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Causes of a wrong mobility: joints that were moved on purpose are found, and by how much."""

import copy

import numpy as np
import pytest

from pkm_twin.certify.description import expand
from pkm_twin.errors import MobilityError, ParameterError
from pkm_twin.kinematics.diagnosis import find_small_deviations, is_determined
from pkm_twin.kinematics.rounding import repair
from pkm_twin.kinematics.spins import lock_spins
from pkm_twin.machine import schema
from pkm_twin.machine.graph_file import KINDS, build_graph, expand_limbs
from pkm_twin.mechanisms.machine import Machine, MachineFile
from test.support.robots import partly_long

from .random_machines import changed, plain

PLANAR = partly_long(("rrr3_planar", "four_bar", "slider_crank", "bolted", "five_bar"), "rrr3_planar", "bolted")
DEVIATIONS = partly_long((1e-7, 1e-5, 1e-3), 1e-5)


def graph_of(data):
    file = schema.build(MachineFile, data)
    kinds = {kind: getattr(file, kind) for kind in KINDS}
    return build_graph(file.platform, expand_limbs(kinds, file.limbs)[0], file.origin)


def tilted(axis, angle, rng):
    """An axis turned by an angle (rad) about a random line across it."""
    axis = np.array(axis) / np.linalg.norm(axis)
    across = np.cross(axis, rng.normal(size=3))
    return (np.cos(angle) * axis + np.sin(angle) * across / np.linalg.norm(across)).tolist()


@pytest.mark.parametrize("angle", DEVIATIONS)
@pytest.mark.parametrize("name", PLANAR)
def test_an_axis_that_is_not_parallel_is_named(name, angle, rng):
    data = changed(name, rng)
    hinges = [n for n, j in data["joints"].items() if j["type"] == "revolute"]
    joint = str(rng.choice(hinges[-2:]))
    assert is_determined(graph_of(data))
    data["joints"][joint]["axis"] = tilted(data["joints"][joint]["axis"], angle, rng)
    causes = find_small_deviations(graph_of(data))
    assert causes and all(joint in cause.parts for cause in causes)
    assert max(cause.deviation for cause in causes) == pytest.approx(angle, rel=1e-2)
    with pytest.raises(MobilityError) as error:
        Machine.from_data(data, name)
    assert joint in error.value.causes[0] and f"{angle:.2g}" in error.value.causes[0]
    assert (error.value.field, error.value.actuated) == ("joints", len(graph_of(data).actuated))
    assert error.value.freedoms < error.value.actuated


@pytest.mark.parametrize("shift", DEVIATIONS)
def test_an_axis_that_misses_the_centre_is_named(shift, rng):
    data = changed("rrr3_spherical", rng)
    assert is_determined(graph_of(data))
    joint = data["joints"]["crown_2"]
    across = np.cross(joint["axis"], rng.normal(size=3))
    joint["at"] = (np.array(joint["at"]) + shift * across / np.linalg.norm(across)).tolist()
    causes = find_small_deviations(graph_of(data))
    assert causes and all("crown_2" in cause.parts for cause in causes)
    assert causes[0].deviation == pytest.approx(shift, rel=1e-2)


def guided():
    """A linear Delta of six rods whose platform a guide keeps from turning: three too many."""
    data = expand(plain("linear_delta"))
    data["joints"]["guide"] = {"type": "translation", "between": ["platform", "base"]}
    return data


@pytest.mark.parametrize("shift", DEVIATIONS)
def test_a_rod_whose_end_is_elsewhere_is_named(shift, rng):
    data = guided()
    assert is_determined(graph_of(data))
    rod = data["rods"]["left_1"]
    shifted = np.array(rod["ends"])
    shifted[1] += shift * np.array([0.0, 0.0, 1.0])
    rod["ends"] = shifted.tolist()
    causes = find_small_deviations(graph_of(data))
    assert causes and all({"left_1", "right_1"} & set(cause.parts) for cause in causes)
    assert causes[0].deviation == pytest.approx(shift, rel=1e-2)


def test_several_causes_are_all_named(rng):
    data = changed("rrr3_planar", rng)
    moved = {"elbow_1": 3e-6, "wrist_3": 1e-4}
    for name, angle in moved.items():
        data["joints"][name]["axis"] = tilted(data["joints"][name]["axis"], angle, rng)
    causes = find_small_deviations(graph_of(data))
    assert [next(iter(set(c.parts) & set(moved))) for c in causes] == ["wrist_3", "elbow_1"]


def test_a_sound_machine_is_left_as_it_is(rng):
    graph = graph_of(changed("rrr3_planar", rng))
    assert not find_small_deviations(graph) and not repair(graph, 1e-6).moves


@pytest.mark.parametrize("name", ["rrr3_planar", "rrr3_spherical", "bolted"])
def test_rounding_is_taken_off_by_no_more_than_it_is(name, rng):
    data = changed(name, rng)
    for joint in data["joints"].values():
        for key in ("at", "axis", "axes"):
            if key in joint:
                joint[key] = (np.array(joint[key]) + rng.uniform(-1e-8, 1e-8, np.shape(joint[key]))).tolist()
    rounded = graph_of(data)
    assert not is_determined(rounded)
    ideal = repair(rounded, 1e-6).graph
    assert is_determined(ideal)
    for joint in ideal.joints.values():
        np.testing.assert_allclose(joint.axes, rounded.joints[joint.name].axes, atol=1e-7)
        np.testing.assert_allclose(joint.at, rounded.joints[joint.name].at, atol=1e-7)


def actuate(data, name, value):
    data["joints"][name].pop("friction", None)
    data["joints"][name].pop("limits", None)
    data["joints"][name]["actuated"] = value


def test_drives_are_counted(rng):
    data = changed("rrr3_planar", rng)
    actuate(data, "motor_2", False)
    with pytest.raises(MobilityError) as error:
        Machine.from_data(data, "x")
    assert (error.value.actuated, error.value.freedoms) == (2, 3)
    assert "motor_2" in " ".join(error.value.causes)


def balls():
    """A Delta whose rods are bodies between two ball joints, and spin."""
    data = expand(plain("delta_translation"))
    for name, rod in data.pop("rods").items():
        inner, outer = rod["between"]
        along = np.subtract(*rod["ends"])
        inertia = rod["mass"] / 12 * (along @ along * np.eye(3) - np.outer(along, along))
        data["bodies"][name] = {
            "mass": rod["mass"],
            "com": np.mean(rod["ends"], axis=0).tolist(),
            "inertia": inertia.tolist(),
        }
        for end, (a, b) in enumerate(((inner, name), (name, outer))):
            data["joints"][f"{name}_{end}"] = {"type": "spherical", "between": [a, b], "at": rod["ends"][end]}
    return data


def test_parts_that_spin_are_named_and_can_be_held():
    data = balls()
    with pytest.raises(MobilityError) as error:
        Machine.from_data(data, "x")
    assert (error.value.actuated, error.value.freedoms) == (3, 6)
    assert all(any(f"forearm_{i}" in cause for cause in error.value.causes) for i in (1, 2, 3))
    graph, held = lock_spins(graph_of(data))
    assert is_determined(graph) and len(held) == 3
    assert [graph.joints[name].kind for name in held] == ["universal"] * 3
    # As with rods, which have no spin.
    alone, none = lock_spins(graph_of(plain("delta_translation")))
    assert is_determined(alone) and not none


def test_a_singular_home_says_what_moves_in_it():
    data = copy.deepcopy(plain("four_bar"))
    for k, name in enumerate(("motor", "crank_pin", "rocker_foot", "rocker_pin")):
        data["joints"][name]["at"] = [0.1 * k, 0.0, 0.0]
    with pytest.raises(ParameterError) as error:
        Machine.from_data(data, "x")
    assert error.value.field == "joints" and "crank_pin" in str(error.value)
