# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Where a URDF's machine starts from, and drawings with spheres, rounding and initial values."""

import re
import warnings

import numpy as np
import pytest
import yaml

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.singularity import singularity_at_home
from pkm_twin.mechanisms.machine import Machine
from pkm_twin.robot.urdf_home import Assembly
from pkm_twin.robot.urdf_read import UrdfSelection, read_tree
from test.support.robots import partly_long, random_joints

pytest.importorskip("pinocchio")

import pinocchio as pin

from .sketches import SKETCHES, Tree, delta, five_bar, palletizer, rrr3

pytestmark = pytest.mark.usefixtures("quickly_compiled")
DRAWINGS = (palletizer, five_bar, SKETCHES["four_bar"])


def spheres_of(path):
    """A URDF and its YAML file in Pinocchio, every pair of frames a closure of six equations."""
    model = pin.buildModelFromUrdf(str(path))
    beside = yaml.safe_load(path.with_suffix(".yaml").read_text())
    ends = [("fixed", *map(model.getFrameId, pair), None) for pair in beside["closed_loop"]]
    return Tree(model, ends, beside["name_mot"])


def closed(tree, robot, q):
    """All joint values: the robot's, and of joints that it holds those that close the loops."""
    known = dict(zip(robot.joint_names, q, strict=True))
    known |= dict(zip(robot.passive_joints, robot.passive(q), strict=True))
    full = np.array([float(known.get(name, 0.0)) for name in tree.model.names[1:]])
    return settled(tree, full, [i for i, n in enumerate(tree.model.names[1:]) if n not in known])


def settled(tree, q, free):
    """Joint values of which the free ones close the loops, if they can."""
    for _ in range(60):
        value, rates = tree.rows(q)
        step = np.linalg.lstsq(rates[:, free], -value, rcond=1e-6)[0]
        q[free] += step * min(1.0, 0.5 / max(np.abs(step).max(), 1e-12))
    return q


def read(path, **options):
    """A file's reading, and the robot of it."""
    reading = read_tree(path, **options)
    return reading, Machine.from_data(reading.description, "drawing")


def spheres(sketch, folder, change=lambda text: text):
    """A sketch's file with spheres, hinges without friction, its numbers changed."""
    path = sketch.save(folder, "spheres")
    text = re.sub(r'damping="0.1" friction="0.2"', 'damping="0" friction="0"', path.read_text())
    path.write_text(change(text))
    return path


def written(change):
    """Every number of a place or direction changed."""
    return lambda text: re.sub(
        r'(xyz|rpy)="([^"]*)"',
        lambda m: f'{m[1]}="{" ".join(change(float(word)) for word in m[2].split())}"',
        text,
    )


def rounded(digits):
    return written(lambda value: f"{value:.{digits}f}")


def shaken(amount):
    """Places and directions that are off by a drawing program's own accuracy, all digits told."""
    rng = np.random.default_rng(4)
    return written(lambda value: repr(value + float(rng.uniform(-amount, amount))))


EXPORTS = {
    "as it is": (lambda text: text, 1e-6),
    "shaken by 1e-8": (shaken(1e-8), 1e-6),
    "eight digits": (rounded(8), 1e-6),
    "five digits": (rounded(5), 1e-3),
}
"""How a file's numbers are written, and how far efforts may differ (N m) and loops be open."""


@pytest.mark.parametrize("export", partly_long(EXPORTS, "shaken by 1e-8"))
@pytest.mark.parametrize("drawing", partly_long(DRAWINGS, *DRAWINGS[1:]), ids=lambda f: f.__name__)
def test_a_drawing_with_spheres_is_the_machine_that_pinocchio_has(drawing, export, tmp_path):
    change, accuracy = EXPORTS[export]
    path = spheres(drawing(), tmp_path, change)
    reading, robot = read(path)
    home = robot.inverse(robot.home())
    np.testing.assert_allclose(home, 0.0, atol=1e-12)
    assert float(robot.singularity(home)) > 0.02
    # Of each pair of hinges at a closure one is held, and no other joint.
    joints = reading.description["joints"]
    for name, *_ in drawing().closures:
        ends = [joints[f"{name}_{side}_frame"]["type"] for side in "AB"]
        assert sorted(ends) == ["fixed", "revolute"]
    hinges = [n for n, kind, *_ in drawing().joints if joints[n]["type"] == "revolute"]
    assert len(hinges) == len(drawing().joints)
    tree = spheres_of(path)
    rng = np.random.default_rng(1)
    for q in rng.uniform(-0.15, 0.15, (3, len(home))):
        full = closed(tree, robot, q)
        assert np.abs(tree.rows(full)[0]).max() < accuracy
        qd, qdd = rng.normal(size=(2, len(home)))
        expected = tree.torques(full, qd, qdd)
        np.testing.assert_allclose(inverse_dynamics(robot, q, qd, qdd), expected, atol=accuracy)


@pytest.mark.long
def test_the_index_is_that_of_the_machine_however_its_closures_are_written(tmp_path):
    """Of spheres at frames that are links of their own, and of hinges."""
    found = [singularity_at_home(read(rrr3().save(tmp_path, way))[1].graph) for way in ("spheres", "constraint")]
    assert found[0] == pytest.approx(found[1], rel=1e-9)


@pytest.mark.long
def test_of_several_assemblies_the_best_conditioned_is_home(tmp_path):
    """Those that Pinocchio's tree has with the motors at zero, each made a drawing of its own."""
    path = spheres(palletizer(), tmp_path)
    _, robot = read(path)
    best = float(robot.singularity(robot.inverse(robot.home())))
    tree = spheres_of(path)
    rng, found = np.random.default_rng(2), []
    for _ in range(12):
        q = np.zeros(tree.model.nv)
        q[tree.loose] = rng.uniform(-np.pi, np.pi, len(tree.loose))
        if np.abs(tree.rows(settled(tree, q, tree.loose))[0]).max() < 1e-9:
            found.append(q)
    assert found
    for q in found:
        text = path.read_text()
        for name, value in zip(tree.model.names[1:], q, strict=True):
            text = turned(text, name, value)
        drawn = tmp_path / "drawn.urdf"
        drawn.write_text(text)
        drawn.with_suffix(".yaml").write_text(path.with_suffix(".yaml").read_text())
        other = Machine.from_data(read_tree(drawn).description, "other")
        assert float(other.singularity(other.inverse(other.home()))) <= 1.05 * best


def turned(text, joint, value):
    """The file with a joint's zero where it has had that value."""
    start = text.index(f'<joint name="{joint}"')
    end = text.index("</joint>", start)
    part = text[start:end]
    xyz, rpy = (
        np.array([float(v) for v in re.search(rf'<origin[^>]*{key}="([^"]*)"', part)[1].split()])
        for key in ("xyz", "rpy")
    )
    axis = np.array([float(v) for v in re.search(r'<axis xyz="([^"]*)"', part)[1].split()])
    axis = axis / np.linalg.norm(axis)
    new = pin.rpy.rpyToMatrix(*rpy) @ pin.AngleAxis(value, axis).toRotationMatrix()
    origin = " ".join(repr(float(v)) for v in pin.rpy.matrixToRpy(new))
    place = " ".join(repr(float(v)) for v in xyz)
    part = re.sub(r"<origin[^>]*/>", f'<origin xyz="{place}" rpy="{origin}"/>', part)
    return text[:start] + part + text[end:]


def test_where_no_assembly_is_at_zero_a_good_one_near_it_is_home(tmp_path):
    _, robot = read(rrr3().save(tmp_path))
    home = robot.inverse(robot.home())
    assert 1e-3 < np.abs(home).max() < 0.9
    # It is not at the edge of the workspace.
    poses = robot.home() + np.random.default_rng(0).uniform(-0.3, 0.3, (500, 3))
    best = np.nanmax(robot.try_singularity(robot.try_inverse(poses)[0])[0])
    assert float(robot.singularity(home)) > 0.4 * best


def test_initial_values_of_the_controllers_are_home(tmp_path):
    path = five_bar().save(tmp_path)
    text = path.read_text()
    # A joint without an initial value starts at zero.
    start = {"m1": -0.05, "m2": 0.0}
    for name, value in start.items():
        old = f'<joint name="{name}"><command_interface name="effort"/>'
        assert old in text
        if not value:
            continue
        state = f'<param name="initial_value">{value}</param>'
        text = text.replace(old, f'{old}<state_interface name="position">{state}</state_interface>')
    path.write_text(text)
    _, robot = read(path)
    found = dict(zip(robot.joint_names, robot.inverse(robot.home()), strict=True))
    assert found == pytest.approx(start, abs=1e-12)


def test_limits_that_leave_zero_out_are_kept(tmp_path):
    sketch = five_bar()
    path = sketch.save(tmp_path)
    start = path.read_text().index('<joint name="m1"')
    head, tail = path.read_text()[:start], path.read_text()[start:]
    path.write_text(head + tail.replace('lower="-9" upper="9"', 'lower="0.1" upper="0.3"', 1))
    _, robot = read(path)
    home = dict(zip(robot.joint_names, robot.inverse(robot.home()), strict=True))
    assert home == pytest.approx({"m1": 0.2, "m2": 0.0}, abs=1e-12)


@pytest.mark.long
def test_bars_between_two_balls_are_kept_from_spinning(tmp_path):
    """A Delta whose bars hang on ball joints at both ends: universal joints at one of them."""
    sketch = delta()
    path = sketch.save(tmp_path)
    expected = Machine.from_data(read_tree(path).description, "universal")
    text = path.read_text()
    # The first axis of every bar's universal joint becomes a ball, the second a weld.
    names = [f"u_bar_{i}{s}" for i in range(3) for s in "ab" if f"u_bar_{i}{s}" in text]
    assert names
    beside = {
        "name_mot": sketch.actuated,
        "joint_name": [f"{n}_1" for n in names],
        "joint_type": ["SPHERICAL"] * len(names),
    }
    for name in names:
        start = text.index(f'<joint name="{name}_2"')
        part = text[start : text.index("</joint>", start)]
        text = text.replace(part, part.replace('type="revolute"', 'type="fixed"'))
    path.write_text(text)
    path.with_suffix(".yaml").write_text(yaml.safe_dump(beside))
    reading = read_tree(path)
    robot = Machine.from_data(reading.description, "balls")
    kinds = [j["type"] for j in reading.description["joints"].values()]
    # The first bar's other ball is three hinges, of which one is held.
    assert (kinds.count("universal"), kinds.count("fixed")) == (5, 1)
    q = random_joints(robot, np.random.default_rng(0), 3)
    for found, wanted in zip(robot.platform(q), expected.platform(q), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_what_moves_another_part_than_the_platform_is_named(tmp_path):
    """A second leg at the ground, and a motor on the arm that moves a flap."""
    path = five_bar().save(tmp_path)
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'
    for parent, at in (("ground", "flap"), ("arm_1", "flap"), ("platform", "flap")):
        more = (
            f'<link name="{at}">{inertial}</link><joint name="hinge" type="continuous">'
            f'<parent link="{parent}"/><child link="{at}"/></joint><ros2_control name="x">'
            '<joint name="hinge"><command_interface name="effort"/></joint></ros2_control></robot>'
        )
        other = path.with_name(f"{parent}.urdf")
        other.write_text(path.read_text().replace("</robot>", more))
        with pytest.raises(ParameterError) as error:
            read_tree(other)
        assert error.value.field == "actuated"
        assert error.value.value == "hinge" and "at hinge" in error.value.bound


def test_an_open_loop_is_named_with_its_gap(tmp_path, monkeypatch):
    tries, real = [], Assembly.close
    monkeypatch.setattr(Assembly, "close", lambda self, *given: tries.append(given) or real(self, *given))
    path = five_bar().save(tmp_path)
    path.write_text(path.read_text().replace('<child_origin xyz="', '<child_origin xyz="5'))
    with warnings.catch_warnings(), pytest.raises(ParameterError) as error:
        warnings.simplefilter("ignore")
        read_tree(path)
    assert error.value.field == "tip"
    # A second look at every start of the search would be of no use.
    assert len(tries) <= 2 * 11
    assert re.search(r"open by \d[\d.e+]* mm", str(error.value))


SPUN = """<robot name="crank"><link name="base"/>
<link name="arm"><inertial><origin xyz="0.05 0 0"/><mass value="0.5"/>
  <inertia ixx="1e-3" iyy="1e-3" izz="1e-3"/></inertial></link>
<link name="yaw"/><link name="pitch"/>
<link name="rod"><inertial><origin xyz="0.15 {offset} 0"/><mass value="1.5"/>
  <inertia ixx="1e-3" iyy="5e-3" izz="5e-3"/></inertial></link>
<link name="tool"><inertial><mass value="0.7"/>
  <inertia ixx="1e-3" iyy="1e-3" izz="1e-3"/></inertial></link>
<joint name="m" type="continuous"><parent link="base"/><child link="arm"/>
  <axis xyz="0 0.3 1"/></joint>
<joint name="a" type="continuous"><parent link="arm"/><child link="yaw"/>
  <origin xyz="0.1 0 0"/><axis xyz="0 0 1"/></joint>
<joint name="b" type="continuous"><parent link="yaw"/><child link="pitch"/>
  <axis xyz="0 1 0"/></joint>
<joint name="c" type="continuous"><parent link="pitch"/><child link="rod"/>
  <axis xyz="1 0 0"/></joint>
<joint name="s" type="prismatic"><parent link="base"/><child link="tool"/>
  <origin xyz="0.6 0.05 -0.1"/><axis xyz="1 0 0"/><limit lower="-2" upper="2"/></joint>
<constraint name="pin" type="spherical"><parent link="rod"/><parent_origin xyz="0.3 0 0"/>
  <child link="tool"/></constraint>
<ros2_control name="c" type="system"><joint name="m"><command_interface name="effort"/>
  <state_interface name="position"><param name="initial_value">{start}</param></state_interface>
</joint></ros2_control></robot>"""


@pytest.mark.parametrize("start", [0.3, 1.3, -2.0])
def test_a_part_that_only_spins_is_held_at_zero_and_its_imbalance_is_said(start, tmp_path):
    path = tmp_path / "crank.urdf"
    path.write_text(SPUN.format(offset=0.02, start=start))
    reading = read_tree(path)
    data = reading.description
    assert data["joints"]["c"]["type"] == "fixed"
    assert any("spin about itself: c" in note for note in reading.notes)
    # At zero, the centre is off the rod's axis along the pitch joint's, and nowhere else.
    ends = [np.array(data["joints"][name]["at"]) for name in ("a", "pin")]
    along = (ends[1] - ends[0]) / 0.3
    off = np.array(data["bodies"]["rod"]["com"]) - ends[0] - 0.15 * along
    np.testing.assert_allclose(off, 0.02 * np.array(data["joints"]["b"]["axis"]), atol=1e-9)
    assert any("c (0.03 kg m)" in note for note in reading.notes)
    path.write_text(SPUN.format(offset=0.0, start=start))
    assert not any("kg m" in note for note in read_tree(path).notes)


def test_a_drawing_that_does_not_tell_the_assembly_is_told(tmp_path):
    """A four bar linkage drawn as a line: the loop closes on either side of it."""
    path, fields = tmp_path / "robot.urdf", 'ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"'
    mass = f'<inertial><origin xyz="0.1 0 0"/><mass value="1"/><inertia {fields}/></inertial>'
    links = "".join(f'<link name="{name}">{mass}</link>' for name in ("world", "crank", "rod", "tool"))
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="{inner}"/><child link="{outer}"/>'
        f'<origin xyz="{x} 0 0"/><axis xyz="0 0 1"/></joint>'
        for name, inner, outer, x in (
            ("motor", "world", "crank", 0.0),
            ("elbow", "crank", "rod", 0.3),
            ("pivot", "world", "tool", 0.4),
        )
    )
    ends = '<predecessor link="rod"><origin xyz="0.35 0 0"/></predecessor><successor link="tool"><origin xyz="{} 0 0"/>'
    for length, told in ((0.25, False), (0.3, True)):
        end = ends.format(length)
        loop = f'<loop name="tip" type="revolute">{end}</successor><axis xyz="0 0 1"/></loop>'
        path.write_text(f'<robot name="four_bar">{links}{joints}{loop}</robot>')
        notes = read_tree(path, UrdfSelection(platform="tool", actuated=("motor",))).notes
        assert any("of 2 assemblies" in note for note in notes) is told
