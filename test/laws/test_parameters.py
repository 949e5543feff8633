# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Parameter files: what is refused, by name and bound; nothing else than ParameterError."""

import math

import numpy as np
import pytest
import yaml

from delta_dynamics.simulation.machine import PayloadEvent
from pkm_twin import load, robot_names
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.recordings.payload import Load
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
    @pytest.mark.parametrize(("name", "closest"), [("delta_uc", "delta_cu"), ("upr_rpv", "upr_rpu"), ("pruu", "prru")])
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

    @pytest.mark.parametrize("value", ["detla", "Delta", "", 5, None, True, ["delta"], {"delta": 1}, []])
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


INF, NAN = math.inf, math.nan
WRONG = [
    ("delta_cu", "geometry", 5),
    ("delta_cu", "geometry", None),
    ("delta_cu", "geometry.base_radius", 0.0),
    ("delta_cu", "geometry.platform_radius", 1e-300),
    ("delta_cu", "geometry.forearm_length", 100.1),
    ("delta_cu", "inertia.platform_mass", -1e-9),
    ("delta_cu", "inertia.forearm_mass", 1e6),
    ("delta_cu", "inertia.arm_com", 1.01),
    ("delta_cu", "inertia.rotor_inertia", -1e-6),
    ("delta_cu", "payload.mass", -0.1),
    ("delta_cu", "limits.velocity[0]", 0.0),
    ("delta_cu", "limits.effort[0]", -20.0),
    ("delta_cu", "gravity", [0.0, -9.81]),
    ("delta_cu", "gravity", [0.0, 0.0, 0.0, -9.81]),
    ("delta_cu", "gravity", -9.81),
    ("delta_cu", "gravity[2]", [0.0, 0.0, NAN]),
    ("delta_cu", "gravity[2]", [0.0, 0.0, "-9.81"]),
    ("delta_cu", "gravity[2]", [0.0, 0.0, True]),
    ("delta_cu", "gravity[2]", [0.0, 0.0, -1e300]),
    ("delta_cu", "geometry.azimuths[0]", [1e308, -1e308, 0.0]),
    ("delta_cu", "geometry.azimuths", [0.0, 2 * math.pi, 1.0]),
    ("delta_cu", "geometry.azimuths", [0.0, 0.0, 1.0]),
    ("delta_cu", "geometry.closures", ["rod", "rod"]),
    ("delta_cu", "geometry.closures[2]", ["rod", "rod", "rodd"]),
    ("delta_cu", "geometry.closures", ["rcu", "rod", "rcu"]),
    ("delta_cu", "geometry.closures[0]", [["rod"], "rod", "rod"]),
    ("delta_cu", "friction.viscous[0]", [-1.0, 0.0, 0.0]),
    ("delta_cu", "friction.coulomb", [0.0, 0.0]),
    ("delta_cu", "payload.com[1]", [0.0, INF, 0.0]),
    ("delta_cu", "limits.position", [1.3, -0.9]),
    ("delta_cu", "limits.position", [0.5, 0.5]),
    ("delta_cu", "limits.position", [[-1, 1], [-1, 1]]),
    ("delta_cu", "limits.position[1]", [-0.9, INF]),
    ("delta_cu", "limits.effort[1]", [20.0, NAN, 20.0]),
    ("prru", "geometry.azimuths", [0.0, 2.0, 2.0 + 2 * math.pi]),
    ("prru", "geometry.limb_length", 0.05),
    ("prru", "geometry.branch", "beside"),
    ("prru", "inertia.link_com", 1.5),
    ("prru", "inertia.upper_link_inertia", [0.1, 0.3]),
    ("prru", "inertia.platform_inertia", [0.1, 0.1, 0.5]),
    ("upr_rpu", "members.shear_modulus", 0.0),
    ("upr_rpu", "members.diameter[1]", [0.1, -0.1, 0.1]),
    ("upr_rpu", "members.diameter[0]", 1e-90),
    ("upr_rpu", "members.diameter", [0.1, 0.1]),
    ("upr_rpu", "members.shear_factor", -0.1),
    ("upr_rpu", "joints_compliance.upr_revolute", [1e-10] * 5),
    ("upr_rpu", "joints_compliance.upr_revolute[1]", [1e-10, INF, 1e-10, 1e-11, INF, 1e-11]),
    ("upr_rpu", "joints_compliance.upr_revolute[4]", [1e-10] * 3 + [1e-11] * 3),
    ("upr_rpu", "joints_compliance.upr_universal[5]", [1e-10] * 3 + [INF] * 3),
    ("upr_rpu", "joints_compliance.rpu_universal[2]", [1e-10, 1e-10, -1e-10, INF, INF, 1e-11]),
    ("upr_rpu", "joints_compliance.rpu_revolute[2]", [1e-10, 1e-10, NAN, INF, 1e-11, 1e-11]),
    ("upr_rpu", "limits.limb_length", [1.0, 0.3]),
    ("upr_rpu", "limits.limb_length[0]", [0.0, 0.3]),
    ("upr_rpu", "limits.joint_angle", 0.0),
    ("upr_rpu", "joints", ["a", "a", "b"]),
]


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
    def test_a_number_that_is_none_or_out_of_range_is_named(self, load_data, value):
        error = refusal(load_data, changed(DELTA, "geometry.arm_length", value))
        # The integer beyond all floats is refused before the schema is asked.
        assert error.field == "geometry.arm_length" or value == 10**400

    @pytest.mark.parametrize(("name", "field", "value"), WRONG)
    def test_a_wrong_value_is_named(self, load_data, name, field, value):
        error = refusal(load_data, changed(parameters_of(name), field.partition("[")[0], value))
        assert error.field == field

    def test_a_length_in_millimetres_is_told_the_unit(self, load_data):
        error = refusal(load_data, changed(DELTA, "geometry.arm_length", 190.0))
        assert error.bound.endswith(" 100 m")

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
        data = changed(changed(DELTA, "payload.mass", 1.0), "payload.inertia", value)
        if bound is None:
            assert load_data(data).payload.inertia.tolist() == value
        else:
            error = refusal(load_data, data)
            assert error.field.startswith("payload.inertia") and bound in str(error)

    @pytest.mark.parametrize("mass", [0.0, 1e-9])
    def test_a_payload_s_inertia_needs_its_mass(self, load_data, mass):
        """Half the trace is at most the mass times the square of the greatest length, 100 m."""
        for moment in (1e-12, 1e-3) if mass == 0.0 else (1e-3,):
            data = changed(changed(DELTA, "payload.mass", mass), "payload.inertia", [moment, moment, 0.0])
            assert refusal(load_data, data).field == "payload.inertia"
            with pytest.raises(ParameterError, match=r"payload\.inertia"):
                load_data(DELTA).changed(payload={"mass": mass, "inertia": [moment] * 3})
        robot = load_data(changed(changed(DELTA, "payload.mass", 2.0), "payload.inertia", [0.1] * 3))
        with pytest.raises(ParameterError, match=r"payload\.inertia"):
            robot.changed(payload={"mass": 0.0})
        # A payload that is put down takes its inertia along.
        for none in (Load(0.0).apply_to(robot), robot.changed(payload=PayloadEvent(0.0, 0.0).load)):
            assert none.payload.mass == 0.0 and not none.payload.inertia.any()

    def test_any_turned_body_is_taken(self, load_data, rng):
        for _ in range(20):
            points = rng.normal(size=(5, 3))
            points -= points.mean(0)
            matrix = np.sum([(p @ p) * np.eye(3) - np.outer(p, p) for p in points], 0)
            robot = load_data(changed(changed(DELTA, "payload.mass", 1.0), "payload.inertia", matrix.tolist()))
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


def test_of_many_names_the_nearest_are_listed():
    names = [f"offset_{k}" for k in range(5000)]
    error = UnknownNameError("parameter", "offset_12x", names)
    assert error.closest in names and error.valid == sorted(names)
    assert len(str(error)) < 200
