# SPDX-License-Identifier: Apache-2.0
"""Parameter files: what is refused, by name and bound; nothing else than ParameterError."""

import copy
import math
import os

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pkm_twin import load, robot_names
from pkm_twin.errors import FileError, ParameterError, UnknownNameError, one_line
from pkm_twin.machine.strict_yaml import MAX_FILE_SIZE
from test.support.robots import parameters_of

ROBOTS = robot_names()
DELTA = parameters_of("delta_cu")
MISSING = object()

# A file that is implausible warns; nothing else may.
pytestmark = pytest.mark.filterwarnings("error", "ignore::pkm_twin.errors.RobotWarning")


def changed(data, dotted, value):
    """A copy of the parameters with one value set anew, or removed."""
    data = copy.deepcopy(data)
    *sections, key = dotted.split(".")
    place = data
    for name in sections:
        place = place.setdefault(name, {})
    if value is MISSING:
        del place[key]
    else:
        place[key] = value
    return data


@pytest.fixture
def load_text(tmp_path):
    def load_from(text):
        path = tmp_path / "robot.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return load(path)

    return load_from


@pytest.fixture
def load_data(load_text):
    # The order of a machine's joints is that of the file.
    return lambda data: load_text(yaml.safe_dump(data, sort_keys=False))


def refusal(loader, *arguments):
    with pytest.raises(ParameterError) as caught:
        loader(*arguments)
    error = caught.value
    assert one_line(error.field) in str(error)
    assert isinstance(error, FileError) or error.bound in str(error)
    assert "\n" not in str(error)
    return error


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

    @pytest.mark.parametrize("value", ["detla", "Delta", "", 5, None, True])
    def test_an_unknown_mechanism_is_refused(self, load_data, value):
        assert refusal(load_data, changed(DELTA, "mechanism", value)).field == "mechanism"

    @pytest.mark.parametrize("value", [["delta"], {"delta": 1}, []])
    def test_a_mechanism_that_is_no_text_is_refused(self, load_data, value):
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

    @pytest.mark.parametrize("text", ["1e-3", "1E-3", "+1e-3", "0.001", "1.0e-3"])
    def test_numbers_are_read_as_people_write_them(self, load_text, text):
        given = yaml.safe_dump(changed(DELTA, "inertia.rotor_inertia", "HERE"))
        assert load_text(given.replace("HERE", text)).inertia.rotor_inertia == 1e-3


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
            ([1e13, 1e13, 1e13], "1e12"),
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


class TestFiles:
    GOOD = yaml.safe_dump(DELTA)

    @pytest.mark.parametrize(
        "tag",
        [
            "!!python/object/apply:os.mkdir ['{side_effect}']",
            "!!python/object/new:os.mkdir ['{side_effect}']",
            "!!python/name:os.system",
            "!!python/module:os",
            "!!python/tuple [1, 2]",
            "!anything 5",
            "!<tag:yaml.org,2002:float> 5",
            "!!map [a]",
            "!!set {{a}}",
            "!!omap [a]",
            '!!int ""',
            '!!float ""',
            "!!bool maybe",
            "!!timestamp never",
            "!!binary '%%'",
            "!!str 5",
        ],
    )
    def test_tags_are_refused_without_a_side_effect(self, load_text, tmp_path, tag):
        side_effect = tmp_path / "made"
        value = tag.format(side_effect=side_effect)
        refusal(load_text, f"{self.GOOD}\npayload: {value}\n")
        refusal(load_text, value)
        assert not side_effect.exists()

    @pytest.mark.parametrize(
        "addition",
        [
            "gravity: [0, 0, -1]\n",
            '"gravity": [0, 0, -1]\n',
            "payload: {mass: 1, mass: 2}\n",
            "payload: &p {mass: 1}\nfriction: *p\n",
            "payload: &p [*p]\n",
            "<<: {gravity: [0, 0, -1]}\n",
            "payload: {<<: {mass: 1}}\n",
            "---\nmechanism: delta\n",
            "\tpayload: 1\n",
            "payload: {mass: 1\n",
            "payload: 'open\n",
            "payload: \x00\n",
            "payload: {com: 2001-99-99}\n",
            "payload: {mass: 1_0}\n",
            "payload: {mass: 1_0.5}\n",
            "payload: {mass: 1:30}\n",
            "payload: {mass: 010}\n",
            "payload: {mass: 0x10}\n",
            "payload: {mass: 0x" + "f" * 3000 + "}\n",
            "payload: 0x" + "f" * 5000 + "\n",
            "payload: {mass: " + "9" * 5000 + "}\n",
        ],
    )
    def test_what_is_not_one_plain_mapping_is_refused(self, load_text, addition):
        refusal(load_text, self.GOOD + addition)

    @pytest.mark.parametrize(
        "content",
        [
            b"",
            b"5",
            b"text",
            b"- 1\n- 2",
            b"null",
            b"\xff\xfe\x00",
            b"\x80",
            b"a: b: c",
            b"%YAML 9.9",
        ],
    )
    def test_other_content_is_refused(self, load_text, content):
        refusal(load_text, content)

    @pytest.mark.parametrize("opening", ["[", "{a: ", "- " * 10, "? "])
    def test_deep_nesting_is_refused(self, load_text, opening):
        refusal(load_text, "payload: " + opening * (30_000 // len(opening)))

    def test_a_large_file_is_refused_unread(self, load_text):
        good = load_text(self.GOOD + "#" * (MAX_FILE_SIZE - len(self.GOOD)))
        assert good.name == "robot"
        error = refusal(load_text, self.GOOD + "#" * (MAX_FILE_SIZE + 1 - len(self.GOOD)))
        assert "bytes" in str(error)

    def test_many_keys_are_refused(self, load_text):
        refusal(load_text, "".join(f"k{i}: 0\n" for i in range(7000)))

    @pytest.mark.parametrize(
        "text", ["5e-1", "5.0e-1", "5.0E-1", ".5e0", "5.e-1", "+0.5", "0.05e1"]
    )
    def test_a_number_is_one_however_it_is_written(self, load_text, text):
        assert load_text(f"{self.GOOD}\npayload: {{mass: {text}}}\n").payload.mass == 0.5

    @pytest.mark.parametrize(
        "path", ["/dev/zero", "/dev/null", "/", "/nonexistent.yaml", "a\0.yaml"]
    )
    def test_what_is_not_a_file_is_refused(self, path):
        refusal(load, path)

    def test_a_pipe_is_refused_and_not_waited_for(self, tmp_path):
        path = tmp_path / "robot.yaml"
        os.mkfifo(path)
        refusal(load, path)

    def test_an_unreadable_file_is_refused(self, tmp_path):
        path = tmp_path / "robot.yaml"
        path.write_text(self.GOOD)
        path.chmod(0)
        if os.access(path, os.R_OK):
            pytest.skip("this user reads every file")
        refusal(load, path)


SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.floats(),
    st.integers(-(10**30), 10**30),
    st.text(max_size=6),
    st.sampled_from(["delta", "prru", "upr_rpu", "rod", "rcu", 0.1, 1e308, 5e-324, math.nan]),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=6), inner, max_size=3)
    ),
    max_leaves=8,
)


def dotted_keys(data, path=""):
    """All keys of nested mappings, dotted."""
    for key, value in data.items():
        yield f"{path}{key}"
        if isinstance(value, dict):
            yield from dotted_keys(value, f"{path}{key}.")


class TestAnything:
    """Whatever the file says: a robot, or a ParameterError; never another exception."""

    relaxed = settings(
        max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
    )

    def judge(self, loader, content):
        try:
            robot = loader(content)
            # Built when it is first asked for; what cannot be assembled is refused then.
            graph = robot.graph
        except ParameterError as error:
            assert error.field and error.bound and str(error)
            return
        assert np.isfinite(graph.home).all()
        for body in graph.bodies.values():
            assert np.isfinite([body.mass, *body.com, *body.inertia.ravel()]).all()

    @relaxed
    @given(data=st.data())
    def test_any_value_anywhere(self, load_data, data):
        parameters = parameters_of(data.draw(st.sampled_from(ROBOTS)))
        for _ in range(data.draw(st.integers(1, 2))):
            dotted = data.draw(st.sampled_from(sorted(dotted_keys(parameters))))
            parameters = changed(parameters, dotted, data.draw(VALUES))
        self.judge(load_data, parameters)

    @relaxed
    @given(data=st.data())
    def test_any_damage_to_the_text(self, load_text, data):
        parameters = parameters_of(data.draw(st.sampled_from(ROBOTS)))
        text = yaml.safe_dump(parameters, sort_keys=False)
        for _ in range(data.draw(st.integers(1, 4))):
            at = data.draw(st.integers(0, len(text) - 1))
            cut = data.draw(st.integers(0, 3))
            piece = data.draw(
                st.one_of(
                    st.text(max_size=4),
                    st.text("0123456789.eE+-_:[]{},&*!?|>'\"%@`#<=~ \n\t", max_size=5),
                    st.sampled_from(
                        ["<<: ", "!!int ", "0x_", "1_0", "1:30", ".nan", "-.inf", "? "]
                    ),
                )
            )
            text = text[:at] + piece + text[at + cut :]
        self.judge(load_text, text.encode("utf-8", "surrogatepass"))

    @relaxed
    @given(content=st.one_of(st.binary(max_size=40), st.text(max_size=40).map(str.encode)))
    def test_any_bytes(self, load_text, content):
        self.judge(load_text, content)
