# SPDX-License-Identifier: Apache-2.0
"""Laws of the modes atlas."""

from __future__ import annotations

import numpy as np
import pytest

from pkm_twin import load
from pkm_twin.atlas.grids import polar_pose
from pkm_twin.atlas.modes import modes_sweep
from pkm_twin.atlas.store import open_atlas
from pkm_twin.errors import ParameterError
from stiffness_monitor import reachable
from stiffness_monitor.modes import natural_frequencies


def test_frequencies_are_those_of_the_library(small_atlases):
    robot = load("prru")
    with open_atlas(small_atlases["modes prru"]) as data:
        grid = np.meshgrid(data.z, data.distance, data.azimuth, indexing="ij")
        poses = polar_pose(robot, *grid)
        assert reachable(robot, poses).all()
        f = data.frequency.values
        assert (np.diff(f, axis=-1) >= 0).all()
        assert f.min() > 0
        where = (1, 2, 3)
        assert f[where] == pytest.approx(natural_frequencies(robot, poses[where], 6), rel=1e-9)
        # Upright, the azimuth means nothing.
        assert np.ptp(f[:, 0], axis=1).max() < 1e-6 * f.max()


def test_refusals():
    with pytest.raises(ParameterError):
        modes_sweep(load("prru"), 10)
