# SPDX-License-Identifier: Apache-2.0
"""When a payload is held, and what is too near to a pick or release to be judged."""

import numpy as np

from pkm_twin.apps.loads import Load

TIME = np.array([0.4, 0.6, 1.0, 1.4, 1.6, 2.0, 2.4, 2.6])


def test_a_load_is_held_between_its_times():
    load = Load(0.2, None, ((1.0, 2.0),))
    assert load.held(TIME).tolist() == [False, False, True, True, True, True, False, False]
    assert Load(0.2).held(TIME).all()


def test_what_is_near_a_change_is_within_the_span_of_either_edge():
    load = Load(0.2, None, ((1.0, 2.0),))
    near = load.near_change(TIME, 0.5)
    assert near.tolist() == [False, True, True, True, True, True, True, False]
    assert load.near_change(TIME, 0.1).tolist() == [t in (1.0, 2.0) for t in TIME]
    assert not Load(0.2).near_change(TIME, 0.5).any()
