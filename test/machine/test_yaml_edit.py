# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""New numbers in a robot's own text: they are read back, and the rest stays."""

import numpy as np
import pytest
import yaml

from pkm_twin.identification.identifiable import identifiable
from pkm_twin.machine.machine_yaml import edit_yaml, flow
from pkm_twin.mechanisms.catalogue import config_folder, robot_of_data
from test.support.robots import massive, parameters_of


def text_of(name):
    return (config_folder() / f"{name}.yaml").read_text()


@massive
def test_friction_and_payload_are_written_into_every_file(name):
    robot = robot_of_data(parameters_of(name), name)
    values, notes = {}, {}
    for group in identifiable(robot):
        for key, value in group.keys(group.values + 0.01 * (group.kind == "friction")).items():
            base = tuple(k for k in key if not isinstance(k, int))
            if group.kind == "friction":
                values.setdefault(base, []).append(value)
    values["payload", "mass"] = 0.5
    values = {k: v if len(np.atleast_1d(v)) > 1 else float(np.atleast_1d(v)[0]) for k, v in values.items()}
    notes["payload", "mass"] = "a note"
    text = edit_yaml(text_of(name), values, notes)
    again = robot_of_data(yaml.safe_load(text), name)
    assert again.payload.mass == 0.5
    assert again.friction.viscous == pytest.approx(robot.friction.viscous + 0.01)
    assert again.friction.offset == pytest.approx(robot.friction.offset + 0.01)
    assert "# a note" in text
    # What was said before is still said.
    for line in text_of(name).splitlines():
        if line.startswith("#"):
            assert line in text


def test_lists_sections_and_numbers_that_are_not_there():
    text = "a: 1  # one\nb:\n  - c: {d: 2}\n    e: [1, 2]\n  - c: {}\n    e: 3\n"
    new = edit_yaml(
        text,
        {
            ("b", 0, "c", "d"): 4.0,
            ("b", 0, "c", "f"): [1e-5, 2],
            ("b", 1, "c", "d"): 7,
            ("b", 1, "g"): 8.0,
            ("h", "i", "j"): 9.0,
            ("b", 0, "e"): 5.0,
        },
        {("b", 0, "c", "d"): "note"},
    )
    assert yaml.safe_load(new) == {
        "a": 1,
        "b": [{"c": {"d": 4, "f": [1e-5, 2]}, "e": 5}, {"c": {"d": 7}, "e": 3, "g": 8}],
        "h": {"i": {"j": 9}},
    }
    assert "a: 1  # one" in new
    assert "# note" in new
    assert flow({"x": [1.0, 1e-7]}) == "{x: [1, 1.0e-07]}"
