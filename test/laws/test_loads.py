# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""When a payload is held, and what is too near to a pick or release to be judged."""

import math
from pathlib import Path

import numpy as np
import pytest

from pkm_twin.errors import ParameterError
from pkm_twin.recordings import Load, Recording, split_by_load
from pkm_twin.recordings.payload import make_payload_columns, read_table_load
from pkm_twin.recordings.tables import Table
from test.support.robots import load as robot_of

TIME = np.array([0.4, 0.6, 1.0, 1.4, 1.6, 2.0, 2.4, 2.6])


def test_a_load_is_held_between_its_times():
    load = Load(0.2, None, ((1.0, 2.0),))
    assert load.is_on_platform(TIME).tolist() == [False, False, True, True, True, False, False, False]
    assert Load(0.2).is_on_platform(TIME).all()


def test_what_is_near_a_change_is_within_the_span_of_either_edge():
    load = Load(0.2, None, ((1.0, 2.0),))
    near = load.near_change(TIME, 0.5)
    assert near.tolist() == [False, True, True, True, True, True, True, False]
    assert load.near_change(TIME, 0.1).tolist() == [t in (1.0, 2.0) for t in TIME]
    assert not Load(0.2).near_change(TIME, 0.5).any()


@pytest.mark.parametrize("name", ["delta_cu", "five_bar"])
def test_a_mass_in_grams_is_no_payload(name):
    """Of a tenth of all that moves, in kg and in g."""
    robot = robot_of(name)
    graph = robot.graph
    moving = sum(b.mass for b in graph.bodies.values()) + sum(r.mass for r in graph.rods.values())
    assert Load(0.1 * moving).apply_to(robot).payload.mass == 0.1 * moving
    with pytest.raises(ParameterError) as caught:
        Load(100.0 * moving).apply_to(robot)
    assert (caught.value.field, caught.value.value) == ("payload.mass", 100.0 * moving)


def test_several_payloads_follow_each_other_without_a_sample_of_both():
    load = Load.from_intervals([(0.6, 1.0, 0.2), (1.0, 2.0, 0.5), (2.4, math.inf, 0.0)], "table")
    expected = [math.nan, 0.2, 0.5, 0.5, 0.5, math.nan, 0.0, 0.0]
    np.testing.assert_array_equal(load.mass_at(TIME), expected)
    assert Load.from_intervals([(0.0, math.inf, 0.5)], "bag") == Load(0.5, source="bag")
    robot = robot_of("delta").changed(payload={"mass": 0.1})
    r = Recording(robot, TIME, np.zeros((8, 3)), load=load)
    masses = r.payload_fraction * (r.loaded_robot.payload.mass - 0.1) + 0.1
    np.testing.assert_allclose(masses, np.where(np.isnan(expected), 0.1, expected), atol=1e-15)
    loaded = {machine.payload.mass for machine, _ in split_by_load(robot, load, TIME, 8)}
    assert loaded == {0.0, 0.1, 0.2, 0.5}
    table = Table(Path("x.csv"), make_payload_columns(robot, load, TIME))
    again = read_table_load(robot, table, TIME)
    np.testing.assert_array_equal(again.mass_at(TIME), expected)
