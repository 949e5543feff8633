# SPDX-License-Identifier: Apache-2.0
"""Parameter files: what is refused, by name and bound; nothing else than ParameterError."""

import math

import numpy as np
import pytest
import yaml

from pkm_twin import load, robot_names
from pkm_twin.errors import ParameterError, UnknownNameError
from test.laws.conftest import MISSING, changed, refusal
from test.support.robots import parameters_of

ROBOTS = robot_names()
DELTA = parameters_of("delta_cu")

# A file that is implausible warns; nothing else may.
pytestmark = pytest.mark.filterwarnings("error", "ignore::pkm_twin.errors.RobotWarning")


@pytest.mark.parametrize("name", ROBOTS)
def test_shipped_robots_load_by_name_and_by_path(name, load_data):
    robot = load(name)
    assert robot.name == name
    assert 1 <= len(robot.joint_names) == len(robot.pose_names) <= 6
    again = load_data(parameters_of(name))
    assert (again.own_inertial == robot.own_inertial).all()
    assert again.graph.key == robot.graph.key


def test_arrays_are_read_only():
    robot = load("delta_cu")
    for array in (robot.inertial, robot.gravity, robot.geometry.azimuths, robot.payload.inertia):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0


class TestNames:
    @pytest.mark.parametrize(
        ("name", "closest"), [("delta_uc", "delta_cu"), ("upr_rpv", "upr_rpu"), ("pruu", "prru")]
    )
    def test_an_unknown_robot_names_the_closest(self, name, closest):
        error = refusal(load, name)
        assert isinstance(error, UnknownNameError)
        assert error.closest == closest
        assert f"did you mean '{closest}'" in str(error)

    @pytest.mark.parametrize(
        ("dotted", "closest"),
        [
            ("geometri", "geometry"),
            ("geometry.arm_lenght", "arm_length"),
            ("inertia.platform_mas", "platform_mass"),
            ("payload.masss", "mass"),
            ("friction.viscos", "viscous"),
            ("limits.torque", None),
        ],
    )
    def test_an_unknown_key_names_the_closest(self, load_data, dotted, closest):
        error = refusal(load_data, changed(DELTA, dotted, 1.0))
        assert isinstance(error, UnknownNameError)
        assert (error.field, error.closest) == (dotted, closest)

    @pytest.mark.parametrize("key", ["1", "null", "[a, b]", "2001-01-01", "1.5", "true"])
    def test_a_key_that_is_no_text_is_refused(self, load_text, key):
        refusal(load_text, f"{yaml.safe_dump(DELTA)}\n? {key}\n: 1\n")

    @pytest.mark.parametrize(
        "value", ["detla", "Delta", "", 5, None, True, ["delta"], {"delta": 1}, []]
    )
    def test_an_unknown_mechanism_is_refused(self, load_data, value):
        assert refusal(load_data, changed(DELTA, "mechanism", value)).field == "mechanism"

    @pytest.mark.parametrize(
        "names",
        [
            ["a", "b"],
            ["a", "b", "c", "d"],
            ["a", "b", "a"],
            ["a", "", "c"],
            ["a", 2, "c"],
            ["a", None, "c"],
            "abc",
            {"a": 1, "b": 2, "c": 3},
        ],
    )
    def test_bad_joint_names_are_refused(self, load_data, names):
        error = refusal(load_data, changed(DELTA, "joints", names))
        assert error.field.startswith("joints")

    @pytest.mark.parametrize("value", ["base", "plate", "", 5, None, [], {"platform": 1}])
    def test_a_platform_that_is_no_body_is_refused(self, load_data, value):
        data = changed(parameters_of("five_bar"), "platform", value)
        assert refusal(load_data, data).field == "platform"


class TestValues:
    @pytest.mark.parametrize(
        "dotted",
        [
            *(f"geometry.{key}" for key in DELTA["geometry"]),
            "mechanism",
            "geometry",
            "inertia",
            "inertia.platform_mass",
            "inertia.arm_mass",
            "inertia.forearm_mass",
        ],
    )
    def test_a_missing_key_is_named(self, load_data, dotted):
        error = refusal(load_data, changed(DELTA, dotted, MISSING))
        assert error.field == dotted

    @pytest.mark.parametrize(
        "dotted",
        ["geometry.arm_length", "inertia.arm_mass", "inertia.arm_com", "payload.mass"],
    )
    @pytest.mark.parametrize(
        "value",
        [
            math.nan,
            math.inf,
            -math.inf,
            "0.19",
            "nan",
            None,
            True,
            [0.19],
            {"value": 0.19},
            1e308,
            -1e-3,
            10**400,
        ],
    )
    def test_a_number_that_is_none_or_out_of_range_is_named(self, load_data, dotted, value):
        error = refusal(load_data, changed(DELTA, dotted, value))
        # The integer beyond all floats is refused before the schema is asked.
        assert error.field == dotted or value == 10**400

    @pytest.mark.parametrize(
        ("dotted", "value"),
        [
            ("geometry.base_radius", 0.0),
            ("geometry.platform_radius", -0.05),
            ("geometry.platform_radius", 1e-300),
            ("geometry.arm_length", 1e300),
            ("geometry.arm_length", 0),
            ("geometry.forearm_length", 100.1),
            ("inertia.platform_mass", -1e-9),
            ("inertia.forearm_mass", 1e6),
            ("inertia.arm_com", 1.01),
            ("inertia.rotor_inertia", -1e-6),
            ("payload.mass", -0.1),
            ("limits.velocity", 0.0),
            ("limits.effort", -20.0),
        ],
    )
    def test_out_of_range_is_named(self, load_data, dotted, value):
        error = refusal(load_data, changed(DELTA, dotted, value))
        assert error.field.startswith(dotted)
        assert error.value == value

    def test_a_length_in_millimetres_is_told_the_unit(self, load_data):
        error = refusal(load_data, changed(DELTA, "geometry.arm_length", 190.0))
        assert error.bound.endswith(" 100 m")

    @pytest.mark.parametrize(
        ("dotted", "value"),
        [
            ("gravity", [0.0, -9.81]),
            ("gravity", [0.0, 0.0, 0.0, -9.81]),
            ("gravity", -9.81),
            ("gravity", [0.0, 0.0, math.nan]),
            ("gravity", [0.0, 0.0, "-9.81"]),
            ("gravity", [0.0, 0.0, True]),
            ("gravity", [0.0, 0.0, -1e300]),
            ("geometry.azimuths", [1e308, -1e308, 0.0]),
            ("geometry.azimuths", [0.0, 2 * math.pi, 1.0]),
            ("geometry.azimuths", [0.0, 0.0, 1.0]),
            ("geometry.closures", ["rod", "rod"]),
            ("geometry.closures", ["rod", "rod", "rodd"]),
            ("geometry.closures", ["rcu", "rod", "rcu"]),
            ("geometry.closures", [["rod"], "rod", "rod"]),
            ("friction.viscous", [-1.0, 0.0, 0.0]),
            ("friction.coulomb", [0.0, 0.0]),
            ("payload.com", [0.0, math.inf, 0.0]),
            ("limits.position", [1.3, -0.9]),
            ("limits.position", [0.5, 0.5]),
            ("limits.position", [[-1, 1], [-1, 1]]),
            ("limits.position", [-0.9, math.inf]),
            ("limits.effort", [20.0, math.nan, 20.0]),
        ],
    )
    def test_a_wrong_vector_is_named(self, load_data, dotted, value):
        assert refusal(load_data, changed(DELTA, dotted, value)).field.startswith(dotted)

    def test_a_section_that_is_no_mapping_is_refused(self, load_data):
        for value in (None, 5, "rod", [1, 2]):
            assert refusal(load_data, changed(DELTA, "geometry", value)).field == "geometry"

    def test_an_infinite_effort_limit_is_none(self, load_data):
        robot = load_data(changed(DELTA, "limits.effort", [math.inf, 20.0, 20.0]))
        assert robot.limits.effort.tolist() == [math.inf, 20.0, 20.0]


class TestInertia:
    @pytest.mark.parametrize(
        ("value", "bound"),
        [
            ([[2, 1, 0], [0, 3, 0], [0, 0, 4]], "symmetric"),
            ([[2, 1e-6, 0], [0, 3, 0], [0, 0, 4]], "symmetric"),
            ([-1, 1, 1], "principal moments"),
            ([[1, 3, 0], [3, 1, 0], [0, 0, 1]], "principal moments"),
            ([1, 1, 2.1], "triangle"),
            ([[1.45, 0.45, 0], [0.45, 1.45, 0], [0, 0, 1]], None),
            ([[2.0, 0.95, 0], [0.95, 2.0, 0], [0, 0, 0.5]], "triangle"),
            ([1, 1], "list of 3"),
            ([[1, 0], [0, 1]], "list of 3"),
            ([[1, 0, 0], [0, 1, 0], [0, 0]], "list of 3"),
            ([1, [0, 1, 0], 1], "list of 3"),
            ([1, 1, math.nan], "finite"),
            ([1e13, 1e13, 1e13], "1e+12"),
        ],
    )
    def test_only_a_real_bodys_matrix_is_taken(self, load_data, value, bound):
        data = changed(DELTA, "payload.inertia", value)
        if bound is None:
            assert load_data(data).payload.inertia.tolist() == value
        else:
            error = refusal(load_data, data)
            assert error.field.startswith("payload.inertia") and bound in str(error)

    def test_any_turned_body_is_taken(self, load_data, rng):
        for _ in range(20):
            points = rng.normal(size=(5, 3))
            points -= points.mean(0)
            matrix = np.sum([(p @ p) * np.eye(3) - np.outer(p, p) for p in points], 0)
            robot = load_data(changed(DELTA, "payload.inertia", matrix.tolist()))
            assert np.allclose(robot.payload.inertia, matrix, atol=1e-12)
            assert (robot.payload.inertia == robot.payload.inertia.T).all()


class TestChanges:
    """What a running node may change: whole sections, all or none."""

    def test_a_change_gives_a_copy(self):
        robot = load("delta_cu")
        heavy = robot.changed(payload={"mass": 0.5}, gravity=[0.0, 0.0, -1.62])
        assert (robot.payload.mass, heavy.payload.mass) == (0.0, 0.5)
        assert heavy.gravity.tolist() == [0.0, 0.0, -1.62]
        assert heavy.name == robot.name

    def test_other_lengths_make_the_machine_of_another_file(self, load_data):
        robot = load("delta_cu")
        other = robot.changed(geometry={"arm_length": 0.21}, payload={"mass": 0.3})
        data = changed(DELTA, "geometry.arm_length", 0.21)
        made = load_data(data).changed(payload={"mass": 0.3})
        assert other.geometry.arm_length == 0.21 and other.name == robot.name
        assert (other.engine.geometry == made.engine.geometry).all()
        assert (other.inertial == made.inertial).all()

    @pytest.mark.parametrize(
        "sections",
        [
            {"payload": {"mass": 0.5, "com": [0, 0, math.nan]}},
            {"payload": {"mass": 0.5}, "gravity": [0, 0]},
            {"payload": {"mass": -0.5}},
            {"payload": {"mas": 0.5}},
            {"geometry": {"arm_length": -0.2}},
            {"inertia": {"arm_mass": -0.2}},
            {"mechanism": "prru"},
            {"nothing": 1},
        ],
    )
    def test_one_bad_value_refuses_all(self, sections):
        robot = load("delta_cu")
        before = robot.inertial.copy()
        with pytest.raises(ParameterError):
            robot.changed(**sections)
        assert (robot.inertial == before).all()
