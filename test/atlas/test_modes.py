# SPDX-License-Identifier: Apache-2.0
"""Laws of the modes atlas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkm_twin.atlas.modes.sweep import modes_sweep, structure_edges
from pkm_twin.atlas.store import open_atlas
from pkm_twin.errors import ParameterError
from stiffness_monitor import reachable
from stiffness_monitor.modes import modes, natural_frequencies
from stiffness_monitor.structure import structural_model
from test.support.robots import load

ROBOTS = pytest.mark.parametrize("name", ["prru", "delta_cu", "upr_rpu"])


def test_frequencies_are_those_of_the_library(small_atlases):
    robot = load("prru")
    with open_atlas(small_atlases["modes prru"]) as data:
        grid = np.meshgrid(data.z, data.distance, data.azimuth, indexing="ij")
        poses = robot.grid().polar_pose(*grid)
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


@ROBOTS
def test_stored_shapes_are_those_of_the_library_at_the_middle_pose(name, small_atlases):
    with open_atlas(small_atlases[f"modes {name}"]) as data:
        middle = load(name).grid().polar_pose(data.z.values[data.sizes["z"] // 2], 0.0, 0.0)
        assert data.shape_pose.values.tolist() == middle.tolist()
        found = modes(load(name), middle, 6)
        assert tuple(data.node.values) == found.nodes
        assert tuple(data.element.values) == found.energies.elements
        assert data.shape_frequency.values == pytest.approx(found.frequencies, rel=1e-12)
        at = data.frequency.values[data.sizes["z"] // 2, 0, 0]
        assert data.shape_frequency.values == pytest.approx(at, rel=1e-9)
        assert data.position.values == pytest.approx(found.positions, abs=1e-15)
        for stored, expected in (
            (data.displacement, found.shapes[..., :3]),
            (data.rotation, found.shapes[..., 3:]),
            (data.strain_share, found.energies.strain),
            (data.kinetic_share, found.energies.kinetic),
        ):
            assert stored.values == pytest.approx(expected, rel=1e-9, abs=1e-9)


@ROBOTS
def test_stored_shapes_say_what_they_are(name, small_atlases):
    node, part = ("mode", "node", "axis"), ("mode", "element")
    expected = {
        "shape_pose": (("parameter",), ", ".join(load(name).pose_units)),
        "shape_frequency": (("mode",), "Hz"),
        "position": (("node", "axis"), "m"),
        "displacement": (node, "1/sqrt(kg)"),
        "rotation": (node, "rad/(m sqrt(kg))"),
        "strain_share": (part, "1"),
        "kinetic_share": (part, "1"),
    }
    with open_atlas(small_atlases[f"modes {name}"]) as data:
        for variable, (dims, unit) in expected.items():
            assert data[variable].dims == dims
            assert data[variable].attrs["units"] == unit
            assert data[variable].attrs["long_name"]
        assert tuple(data.parameter.values) == tuple(load(name).pose_names)
        assert tuple(data.axis.values) == ("x", "y", "z")


@ROBOTS
def test_lines_join_the_whole_frame(name, small_atlases):
    """Every node is in one figure of lines, and the platform's lines close around it."""
    with open_atlas(small_atlases[f"modes {name}"]) as data:
        lines, count = data.line.values, data.sizes["node"]
    group = np.arange(count)
    for _ in range(count):
        for a, b in lines:
            group[group == group[a]] = group[b]
    assert len(set(group.tolist())) == 1
    spokes = sorted(int(b) for a, b in lines if a == 0)
    rim = [pair for pair in lines.tolist() if set(pair) <= set(spokes)]
    assert len(rim) == len(spokes) >= 3
    assert sorted(node for pair in rim for node in pair) == sorted(spokes * 2)


def test_the_rim_of_a_platform_does_not_cross_itself_in_any_order_of_the_members():
    robot = load("delta_cu")
    model = structural_model(robot, robot.graph.home)
    found = modes(robot, robot.home(), 1)
    shuffled = replace(model, parts=(*model.parts[::2], *model.parts[1::2]))
    lines = structure_edges(shuffled, found.nodes)
    spokes = [b for a, b in lines.tolist() if a == 0]
    flat = found.positions[spokes, :2]
    steps = np.diff(np.unwrap(np.arctan2(flat[:, 1], flat[:, 0])))
    assert (steps > 0).all() or (steps < 0).all()
    assert abs(steps.sum()) < 2 * np.pi
