# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Robot files as files and as YAML: what is read, and what is rejected."""

import os

import pytest
import yaml

from pkm_twin import load
from pkm_twin.machine.strict_yaml import MAX_FILE_SIZE
from test.laws.conftest import refusal
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

    def test_a_key_with_brackets_in_braces_is_named_with_its_quotes(self, load_text):
        error = refusal(load_text, self.GOOD + "tolerances: {b: {}, joints.a.at[0]: {x: 1}}\n")
        assert error.value == "joints.a.at[0]" and error.bound.endswith('"joints.a.at[0]"')

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

    @pytest.mark.parametrize("text", ["5e-1", "5.0e-1", "5.0E-1", ".5e0", "5.e-1", "+0.5", "0.05e1"])
    def test_a_number_is_one_however_it_is_written(self, load_text, text):
        assert load_text(f"{self.GOOD}\npayload: {{mass: {text}}}\n").payload.mass == 0.5

    @pytest.mark.parametrize("path", ["/dev/zero", "/dev/null", "/", "/nonexistent.yaml", "a\0.yaml"])
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
