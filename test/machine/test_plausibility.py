# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Numbers of a file that are hardly meant: each kind by name, none of them in a sound machine."""

import copy
import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import yaml

import pkm_twin
from pkm_twin.certify.description import expand
from pkm_twin.errors import ParameterError, RobotWarning
from pkm_twin.mechanisms.machine import Machine
from pkm_twin.robot.plausibility import find_implausible_numbers, find_members_fault
from test.laws.conftest import changed as edited
from test.support.robots import SHIPPED, partly_long

pytest.importorskip("pinocchio")

from .random_machines import NAMES, changed, plain, variant
from .sketches import SKETCHES


def machine(data):
    return Machine.from_data({"mechanism": "machine"} | data, "machine")


@pytest.mark.parametrize("name", SHIPPED)
def test_no_shipped_robot_has_an_implausible_number(name):
    assert find_implausible_numbers(SHIPPED[name]) == ()


def test_joints_of_a_platform_may_be_anywhere_on_it():
    folder = Path(__file__).parents[2] / "examples" / "machines"
    assert find_implausible_numbers(pkm_twin.load(folder / "tricept.yaml")) == ()


@pytest.mark.parametrize("name", partly_long(NAMES, *NAMES[::4]))
def test_no_sound_machine_has_an_implausible_number(name, rng):
    assert find_implausible_numbers(machine(plain(name))) == ()
    assert [f.text for f in find_implausible_numbers(machine(variant(name, rng)))] == []


@pytest.mark.parametrize("name", partly_long(SKETCHES, "four_bar"))
def test_no_sound_urdf_has_an_implausible_number(name, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pkm_twin.load(SKETCHES[name]().save(tmp_path))


def scaled(factor):
    """Lengths in another unit."""

    def change(data):
        for entry, key in (
            *((body, "com") for body in data["bodies"].values()),
            *((joint, "at") for joint in data["joints"].values()),
            (data, "origin"),
        ):
            entry[key] = (factor * np.array(entry[key])).tolist()

    return change


def weighed(factor):
    def change(data):
        for body in data["bodies"].values():
            body["mass"] *= factor
            body["inertia"] = (factor * np.array(body["inertia"])).tolist()

    return change


def square_millimetres(data):
    inertia = np.array(data["bodies"]["crank_2"]["inertia"])
    data["bodies"]["crank_2"]["inertia"] = (1e6 * inertia).tolist()


def far_centre(data):
    data["bodies"]["coupler_1"]["com"][0] += 120.0


HEAVY = {"bodies.crank_2.mass": 1.0, "bodies.crank_2.inertia": [5e6, 5e6, 5e6]}
OUTSIDE = {"joints.motor_3.limits": {"position": [2.0, 3.0]}, "joints.motor_3.home": 1.0}
BRICK = {"payload": {"mass": 500.0, "com": [0.0, 0.0, 0.0], "inertia": [1.0, 1.0, 1.0]}}
FAR = {"payload": {"mass": 0.5, "com": [0.0, 0.0, 40.0], "inertia": [1e-3, 1e-3, 1e-3]}}
STEEL = {"youngs_modulus": 2.1e11, "shear_modulus": 8e10, "outer_diameter": 0.05, "inner_diameter": 0.04}


def barred(aside=0.0, **section):
    """A member between the joints of a crank, whose end is some metres aside."""

    def change(data):
        ends = [joint["at"] for joint in data["joints"].values() if "crank_2" in joint["between"]]
        bar = {
            "from": ends[0],
            "to": [*ends[1][:2], ends[1][2] + aside],
            "section": STEEL | section,
        }
        data["bodies"]["crank_2"]["member"] = bar

    return change


KINDS = {
    "millimetres": (scaled(1e3), "geometry", "m", None),
    "microns": (scaled(1e-4), "geometry", "m", None),
    "grams": (weighed(1e3), "masses", "kg/m3", None),
    "tonnes": (weighed(1e-4), "masses", "kg/m3", None),
    "square millimetres": (square_millimetres, "crank_2: inertia", "m", None),
    "heavy inertia": (HEAVY, "crank_2: inertia", "m", np.sqrt(5e6)),
    "far centre": (far_centre, "coupler_1: com", "m", 120.0),
    "degrees": ({"joints.motor_1.limits": {"position": [-90.0, 90.0]}}, "motor_1: limits.position", "rad", 90.0),
    "outside": (OUTSIDE, "motor_3: home", "rad", 1.0),
    "feather": ({"bodies.platform": {}}, "platform: mass", "kg", 0.0),
    "brick": (BRICK, "payload.mass", "kg", 500.0),
    "far payload": (FAR, "payload: com", "m", 40.0),
    "gram centimetres": ({"joints.motor_2.rotor_inertia": 800.0}, "motor_2: rotor_inertia", "kg", None),
    "millimetre gravity": ({"gravity": [0.0, -981000.0, 0.0]}, "gravity", "m/s2", 981000.0),
    "member's end": (barred(0.1), "crank_2: member", "m", 0.1),
    "megapascal": (barred(youngs_modulus=2.1e5), "crank_2: youngs_modulus", "Pa", 2.1e5),
    "earths": ({"gravity": [0.0, 0.0, -1.0]}, "gravity", "m/s2", 1.0),
}
"""What is changed, and the finding's field, unit and value."""


def with_change(data, name):
    change, data = KINDS[name][0], copy.deepcopy(data)
    if callable(change):
        change(data)
    for dotted, value in {} if callable(change) else change.items():
        data = edited(data, dotted, value)
    return data


@pytest.fixture
def data(rng):
    """A planar machine of other dimensions, without drives' numbers that scale with it."""
    data = changed("rrr3_planar", rng)
    data["gravity"] = [0.0, -9.81, 0.0]
    data.pop("payload")
    for joint in data["joints"].values():
        joint.pop("rotor_inertia", None)
        joint.pop("limits", None)
        if "home" in joint:
            joint["home"] = 0.2
    return data


def test_what_each_kind_changes_is_sound(data):
    """Also with a bar whose end is a millimetre aside."""
    assert find_implausible_numbers(machine(copy.deepcopy(data))) == ()
    barred(1e-3)(data)
    assert find_implausible_numbers(machine(data)) == ()


@pytest.mark.parametrize("name", KINDS)
def test_each_kind_is_found_by_its_field_and_number(name, data):
    _, field, unit, value = KINDS[name]
    found = find_implausible_numbers(machine(with_change(data, name)))
    assert (found[0].field, found[0].unit) == (field, unit)
    if value is not None:
        assert found[0].value == pytest.approx(value, rel=2e-2, abs=1e-12)
    # A unit's mistake may show in what follows from it, and in nothing else.
    assert len(found) == 1 or name in ("millimetres", "microns")
    assert name != "millimetres" or "tonnes" not in str(found)


def test_members_that_maps_reject_are_named_by_info(data):
    """A hollow bar may be lighter than a solid one of its density, and not heavier."""
    for density, field in ((1e5, ""), (1.0, "bodies.crank_2.member.section.density: 1.0")):
        made = copy.deepcopy(data)
        barred(density=density)(made)
        del made["bodies"]["crank_2"]["member"]["section"]["inner_diameter"]
        assert find_members_fault(machine(made)).partition(";")[0] == field
    assert find_members_fault(machine(data)) == ""
    made["bodies"]["crank_3"]["member"] = made["bodies"]["crank_2"]["member"]
    assert "bodies.crank_3.member.section.density" in find_members_fault(machine(made))


def legs(data, **more):
    data = copy.deepcopy(data)
    for name, joint in data["joints"].items():
        if name.startswith("leg"):
            joint.pop("limits", None)
            joint.pop("home")
            joint.update(more)
    return data


def test_a_leg_without_home_is_asked_for_it():
    stewart = expand(plain("stewart"))
    (found,) = find_implausible_numbers(machine(legs(stewart)))
    assert found.field.startswith("leg_a_1: home") and found.unit == "m"
    # The bound is the leg's own length at home.
    ends = [stewart["joints"][name]["at"] for name in ("foot_a_1", "ball_a_1")]
    assert found.bound == pytest.approx(np.linalg.norm(np.subtract(*ends)), rel=1e-6)
    # A leg that counts from home says so.
    assert find_implausible_numbers(machine(legs(stewart, home=0.0))) == ()


def test_a_small_index_at_home_is_told(rng):
    """A four-bar nearly flat: its links stand within a thousandth of a line."""
    data = plain("four_bar")
    for k, name in enumerate(("motor", "crank_pin", "rocker_pin", "rocker_foot")):
        data["joints"][name]["at"] = [0.1 * k, 3e-4 * (k % 2), 0.0]
    fields = [f.field for f in find_implausible_numbers(machine(data))]
    assert fields == ["home"]


def save(tmp_path, data):
    path = tmp_path / "machine.yaml"
    path.write_text(yaml.safe_dump({"mechanism": "machine"} | data))
    return path


def test_a_users_file_is_warned_of_once_and_without_a_line_of_the_program(data, tmp_path, twin):
    far_centre(data)
    path = save(tmp_path, data)
    with pytest.warns(RobotWarning) as told:
        robot = pkm_twin.load(path)
    (one,) = told
    assert str(one.message) == find_implausible_numbers(robot)[0].text
    assert (one.filename, one.lineno) == (str(path), 0)
    shown = twin("info", path)
    assert shown.err == f"warning: {path}: {one.message}\n"


def test_info_has_a_section_of_it(data, tmp_path, twin):
    path = save(tmp_path, with_change(data, "heavy inertia"))
    told = json.loads(twin("info", path, "--json").out)["plausibility"]
    assert [(t["field"], t["unit"]) for t in told] == [("crank_2: inertia", "m")]
    assert told[0]["value"] == pytest.approx(np.sqrt(5e6)) and told[0]["bound"] < 10.0
    assert "plausibility" in twin("info", path).out
    assert json.loads(twin("info", "delta", "--json").out)["plausibility"] == []


def table(path, times, rates=None):
    joints = SHIPPED["five_bar"].joint_names
    home = SHIPPED["five_bar"].graph.home
    header = ["time", *(f"{j}.position" for j in joints)]
    columns = [times, *(q + 0.1 * np.sin(np.arange(len(times)) / 9) for q in home)]
    if rates is not None:
        header += [f"{j}.velocity" for j in joints]
        columns += [rates * np.gradient(c, times) for c in columns[1:]]
    rows = "\n".join(",".join(map(repr, map(float, row))) for row in zip(*columns, strict=True))
    path.write_text(f"{','.join(header)}\n{rows}\n")
    return path


def test_times_of_a_table_in_milliseconds(tmp_path, twin):
    times = np.arange(60.0)
    seconds = table(tmp_path / "s.csv", 4e-3 * times, 1.0)
    assert twin("torques", "five_bar", seconds, "--no-picture", "--out", tmp_path / "a.csv").err == ""
    alone = twin(
        "torques",
        "five_bar",
        table(tmp_path / "ms.csv", 4.0 * times),
        "--no-picture",
        "--out",
        tmp_path / "b.csv",
    )
    assert alone.code == 0 and alone.err.startswith("warning: ") and alone.err.count("\n") == 1
    # Where velocities tell it for sure, the table is rejected.
    both = twin("torques", "five_bar", table(tmp_path / "both.csv", 4.0 * times, 1e3))
    assert both.code == 1
    both.one_line_error()


def test_copies_of_two_sections_of_one_name_are_told_apart():
    data = plain("rrr3_planar")
    data["limbs"] = [data["limbs"], copy.deepcopy(data["limbs"])]
    with pytest.raises(ParameterError) as error:
        Machine.from_data(data, "x")
    assert (error.value.field, error.value.value) == ("limbs[1].bodies.crank", "crank_1")
    assert "limbs[0].bodies.crank" in str(error.value)


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (np.float64(3.0), "3.0"),
        (np.int64(3), "3"),
        (np.bool_(True), "True"),
        (np.array([1.0, 2.0]), "[1.0, 2.0]"),
        ([np.float64(1.5), (np.float32(0.5),)], "[1.5, (0.5,)]"),
        ({np.str_("a"): np.float64(2.0)}, "{'a': 2.0}"),
    ],
)
def test_numbers_of_numpy_are_plain_in_an_error(value, shown):
    assert str(ParameterError("x", value, "y")) == f"x: {shown}; expected y"
