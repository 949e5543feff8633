# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Meshes of a URDF are where its links are, in every state; unreadable ones are named."""

from importlib.util import find_spec

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

if find_spec("trimesh") is None:
    pytest.skip("trimesh comes with viser: the extra view", allow_module_level=True)

from pkm_twin import load
from pkm_twin.errors import RobotWarning
from pkm_twin.robot.outline import Posture
from pkm_twin.view.meshes import read_body_meshes
from pkm_twin.view.scene import RIGID, Scene
from test.commands.conftest import REPOSITORY

SOURCE = (REPOSITORY / "examples/machines/dual_scara.urdf").read_text(encoding="utf-8")
CORNERS = np.array([[0.0, 0.0, 0.0], [0.22, 0.0, 0.02], [0.0, 0.05, 0.01]])
STL = "solid part\nfacet normal 0 0 1\nouter loop\n{}endloop\nendfacet\nendsolid part\n"


def written(folder, filename, scale=1.0, origin=""):
    """A URDF whose left upper arm has a triangle as its mesh, in a file of other units."""
    rows = "".join("vertex {:.9g} {:.9g} {:.9g}\n".format(*(row / scale)) for row in CORNERS)
    (folder / "meshes").mkdir(exist_ok=True)
    (folder / "meshes/part.stl").write_text(STL.format(rows))
    visual = (
        f'<link name="upper_left"><visual>{origin}<geometry><mesh filename="{filename}" '
        f'scale="{scale} {scale} {scale}"/></geometry></visual>'
    )
    path = folder / "robot.urdf"
    path.write_text(SOURCE.replace('<link name="upper_left">', visual))
    return path


@pytest.mark.parametrize("filename", ["meshes/part.stl", "package://cell/meshes/part.stl", "file://{}/meshes/part.stl"])
def test_a_mesh_moves_with_its_link(tmp_path, filename, rng):
    folder = tmp_path / "cell"
    folder.mkdir()
    robot = load(written(folder, filename.format(folder), scale=0.001))
    (found,) = read_body_meshes(robot).values()
    corners = found[0][found[1]].reshape(-1, 3)
    graph, scene = robot.graph, Scene(robot)
    for _ in range(5):
        q = robot.inverse(robot.home()) + rng.uniform(-0.2, 0.2, 2)
        at, turn = scene.frames(q, RIGID)["upper_left"]
        now = Rotation.from_quat(np.roll(turn, -1)).apply(corners) + at
        posture = Posture(robot, q)
        for name, corner in (("motor_left", 0), ("elbow_left", 1)):
            joint = posture.locate_point("upper_left", graph.joints[name].at)
            assert np.linalg.norm(now - joint, axis=1).argmin() == corner
            assert now[corner] == pytest.approx(joint, abs=1e-7)


@pytest.mark.parametrize("filename", ["meshes/none.stl", "package://other/part.stl", "robot.urdf"])
def test_a_mesh_that_cannot_be_read_is_named_and_left_out(tmp_path, filename):
    robot = load(written(tmp_path, filename))
    with pytest.warns(RobotWarning, match=f"mesh '{filename}'.*it is not shown"):
        assert read_body_meshes(robot).keys() <= {"upper_left"}


def test_an_invalid_place_of_a_mesh_does_not_stop_the_machine(tmp_path):
    path = written(tmp_path, "meshes/part.stl", origin='<origin xyz="0 0"/>')
    with pytest.warns(RobotWarning, match="this mesh is not shown"):
        robot = load(path)
    assert robot.visuals == ()
