# SPDX-License-Identifier: Apache-2.0
"""Robot files as files and as YAML: what is read, what is rejected, and random damage to them."""

import math
import os

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pkm_twin import load, robot_names
from pkm_twin.errors import ParameterError
from pkm_twin.machine.strict_yaml import MAX_FILE_SIZE
from test.laws.conftest import changed, refusal
from test.support.robots import parameters_of

# A file that is implausible warns; nothing else may.
pytestmark = pytest.mark.filterwarnings("error", "ignore::pkm_twin.errors.RobotWarning")


class TestFiles:
    GOOD = yaml.safe_dump(parameters_of("delta_cu"))

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
        parameters = parameters_of(data.draw(st.sampled_from(robot_names())))
        for _ in range(data.draw(st.integers(1, 2))):
            dotted = data.draw(st.sampled_from(sorted(dotted_keys(parameters))))
            parameters = changed(parameters, dotted, data.draw(VALUES))
        self.judge(load_data, parameters)

    @relaxed
    @given(data=st.data())
    def test_any_damage_to_the_text(self, load_text, data):
        parameters = parameters_of(data.draw(st.sampled_from(robot_names())))
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
