# SPDX-License-Identifier: Apache-2.0
"""A URDF with loop closures as a description: against Pinocchio, and what is refused."""

from __future__ import annotations

import functools
import sys
import warnings

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.mechanisms.machine import Machine
from pkm_twin.robot.urdf_read import read_urdf
from test.support.robots import load, partly_long

pytest.importorskip("pinocchio")

import pinocchio as pin

from .sketches import SKETCHES, Z, closure_rows, five_bar

pytestmark = pytest.mark.usefixtures("quickly_compiled")
NEAR = ("rrr3",)
"""Sketches that have no assembly with their actuated joints at zero."""


@pytest.fixture(params=partly_long(sorted(SKETCHES), "delta", "five_bar", "rrr3"), scope="module")
def sketch(request):
    return SKETCHES[request.param]()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("sketches")


@pytest.fixture(scope="module")
def described(sketch, folder):
    """A sketch's description, read once."""
    return read_urdf(sketch.save(folder))


def values(model, data):
    """The joint values of a description in the order of Pinocchio's model."""
    joints = data["joints"]
    return np.array([joints[name].get("home", 0.0) for name in model.names[1:]])


def test_home_is_a_closed_assembly_with_the_actuated_joints_at_zero(sketch, described):
    data = described
    model, state, ends = sketch.model()
    residual, _ = closure_rows(model, state, ends, values(model, data))
    assert np.abs(residual).max() < 1e-11
    zero = not any(data["joints"][name].get("home") for name in sketch.actuated)
    assert zero == (sketch.seed not in [SKETCHES[name]().seed for name in NEAR])
    assert any("home" in joint for joint in data["joints"].values())


def test_every_body_and_joint_stands_where_pinocchio_has_it(sketch, described):
    data = described
    model, state, ends = sketch.model()
    closure_rows(model, state, ends, values(model, data))
    for name in sketch.links:
        frame = model.frames[model.getFrameId(name)]
        place, inertia = state.oMi[frame.parentJoint], model.inertias[frame.parentJoint]
        body = data["bodies"][name]
        assert body["mass"] == pytest.approx(inertia.mass, abs=1e-12)
        matrix = np.array(body["inertia"])
        matrix = np.diag(matrix) if matrix.ndim == 1 else matrix
        expected = place.rotation @ inertia.inertia @ place.rotation.T
        np.testing.assert_allclose(matrix, expected, atol=1e-12)
        if inertia.mass > 0.0:
            np.testing.assert_allclose(body["com"], place.act(inertia.lever), atol=1e-12)
    for name, kind, parent, child, _, axis, _ in sketch.joints:
        joint = data["joints"][name]
        frame = state.oMf[model.getFrameId(child)]
        assert joint["type"] == kind
        ground = {"ground": "base"}
        assert joint["between"] == [ground.get(parent, parent), child]
        if kind == "revolute":
            np.testing.assert_allclose(joint["at"], frame.translation, atol=1e-12)
        turned = frame.rotation @ sketch.frames()[child].rotation.T @ axis
        np.testing.assert_allclose(joint["axis"], turned, atol=1e-12)
        assert joint.get("actuated", False) == (name in sketch.actuated)
    for (kind, a, b, axis), (name, *_) in zip(ends, sketch.closures, strict=True):
        joint = data["joints"][name]
        assert joint["type"] == kind
        np.testing.assert_allclose(joint["at"], state.oMf[b].translation, atol=1e-11)
        if kind == "revolute":
            np.testing.assert_allclose(joint["axis"], state.oMf[a].rotation @ axis, atol=1e-11)
    np.testing.assert_allclose(
        data["origin"], state.oMf[model.getFrameId("platform")].translation, atol=1e-12
    )


def test_the_three_dialects_say_the_same(sketch, described, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loop, beside = (read_urdf(sketch.save(tmp_path, dialect)) for dialect in ("loop", "yaml"))
    constraint = described
    assert loop == constraint
    closures = [name for name, *_ in sketch.closures]
    assert [n for n, j in beside["joints"].items() if j.get("actuated")] == sketch.actuated
    kinds = {n: j["type"] for n, j in beside["joints"].items() if n.startswith(tuple(closures))}
    revolute = any(kind == "revolute" for _, kind, *_ in sketch.closures)
    assert set(kinds.values()) == ({"continuous", "fixed"} if revolute else {"spherical"}) - {
        "continuous"
    } | ({"revolute"} if revolute else set())
    # The zeros of more joints count, so that the assembly may be another one of the same machine.
    assert set(beside["bodies"]) >= set(constraint["bodies"])
    for name, body in constraint["bodies"].items():
        assert beside["bodies"][name]["mass"] == body["mass"]


def test_limits_and_friction_are_read(tmp_path):
    joints = read_urdf(five_bar().save(tmp_path))["joints"]
    assert list(joints) == ["m2", "m1", "e1", "e2", "tip"]
    # Nine radians either way are no limit.
    assert joints["m1"]["limits"] == {"velocity": 7.0, "effort": 50.0}
    assert "limits" not in joints["e1"]
    assert joints["m1"]["friction"] == joints["e1"]["friction"] == {"viscous": 0.1, "coulomb": 0.2}
    assert "friction" not in joints["tip"]


SMALL = """<robot name="small">
<link name="world"/>
<link name="stand"><inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
<joint name="bolt" type="fixed"><parent link="world"/><child link="stand"/>
  <origin xyz="0 0 0.5"/></joint>
<link name="crank"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>
  <inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>
<joint name="motor" type="revolute"><parent link="stand"/><child link="crank"/>
  <axis xyz="0 0 2"/><limit lower="-1" upper="1" effort="3" velocity="4"/></joint>
<link name="bob"><inertial><origin xyz="0 0 0.1"/><mass value="3"/>
  <inertia ixx="0.2" iyy="0.1" izz="0.1"/></inertial></link>
<joint name="weld" type="fixed"><parent link="crank"/><child link="bob"/>
  <origin xyz="0.2 0 0" rpy="0 1.5707963267948966 0"/></joint>
<link name="tool"/>
<joint name="tip" type="fixed"><parent link="bob"/><child link="tool"/>
  <origin xyz="0 0 0.3"/></joint>
<ros2_control name="c" type="system"><joint name="motor">
  <command_interface name="effort"/></joint></ros2_control>
</robot>"""


def small(tmp_path, old="", new="", beside=None):
    assert old in SMALL
    path = tmp_path / "small.urdf"
    path.write_text(SMALL.replace(old, new) if old else SMALL)
    if beside is not None:
        path.with_suffix(".yaml").write_text(beside)
    return path


def test_links_that_are_fixed_together_are_one_body(tmp_path):
    data = read_urdf(small(tmp_path))
    assert data["platform"] == "tool"
    np.testing.assert_allclose(data["origin"], [0.5, 0.0, 0.5], atol=1e-14)
    assert list(data["bodies"]) == ["tool"]
    body = data["bodies"]["tool"]
    assert body["mass"] == 4.0
    np.testing.assert_allclose(body["com"], [(0.1 + 3 * 0.3) / 4, 0.0, 0.5], atol=1e-14)
    # Two parts 0.2 m apart along x; the second one's x and z are the body's z and x.
    across = 0.75 * 0.2**2
    np.testing.assert_allclose(body["inertia"], [0.2, 0.2 + across, 0.3 + across], atol=1e-12)
    assert data["joints"]["motor"] == {
        "type": "revolute",
        "between": ["base", "tool"],
        "at": [0.0, 0.0, 0.5],
        "axis": [0.0, 0.0, 1.0],
        "actuated": True,
        "limits": {"position": [-1.0, 1.0], "velocity": 4.0, "effort": 3.0},
    }


def test_another_link_can_be_the_ground(tmp_path):
    data = read_urdf(small(tmp_path), platform="world", base="bob")
    assert data["platform"] == "world"
    np.testing.assert_allclose(data["origin"], [0.5, 0.0, -0.2], atol=1e-14)
    assert data["bodies"]["world"]["mass"] == 2.0
    assert data["joints"]["motor"]["between"] == ["world", "base"]
    np.testing.assert_allclose(data["joints"]["motor"]["axis"], [-1.0, 0.0, 0.0], atol=1e-14)


def test_a_moving_link_may_be_called_like_the_ground(tmp_path):
    path = small(tmp_path, '"bob"', '"x"')
    path.write_text(path.read_text().replace('"crank"', '"base"').replace('"tool"', '"end"'))
    data = read_urdf(path, platform="base")
    assert data["platform"] == "base_" and list(data["bodies"]) == ["base_"]


def spinning(tmp_path):
    """A five-bar whose tip is a pin between two hinges of one axis."""
    path = five_bar().save(tmp_path)
    pin_link = (
        '<link name="pin"><inertial><mass value="0.1"/>'
        '<inertia ixx="1e-4" iyy="1e-4" izz="1e-4"/></inertial></link>'
        '<joint name="pin_joint" type="continuous"><parent link="fore_1"/><child link="pin"/>'
    )
    content = path.read_text()
    start = content.index("<parent_origin", content.index("<constraint"))
    origin = content[start : content.index("/>", start)]
    axis_at = content.index('<parent_axis xyz="') + len('<parent_axis xyz="')
    axis = content[axis_at : content.index('"', axis_at)]
    pin_link += f'{origin.replace("parent_origin", "origin")}/><axis xyz="{axis}"/></joint>'
    head, tail = content.split("<constraint", 1)
    tail = tail.replace('<parent link="fore_1"/>', '<parent link="pin"/>', 1)
    tail = tail.replace(origin + "/>", "", 1)
    path.write_text(head + pin_link + "<constraint" + tail)
    return path


def test_a_pin_that_only_spins_about_itself_is_held(tmp_path):
    with pytest.warns(UserWarning, match="held, .* spin about itself: pin_joint"):
        data = read_urdf(spinning(tmp_path))
    assert data["joints"]["pin_joint"]["type"] == "fixed"
    assert [j["type"] for j in data["joints"].values()].count("revolute") == 5


def test_what_hangs_loose_is_no_spin(tmp_path):
    path = five_bar().save(tmp_path)
    loose = (
        '<link name="charm"><inertial><mass value="0.1"/>'
        '<inertia ixx="1e-4" iyy="1e-4" izz="1e-4"/></inertial></link>'
        '<joint name="chain" type="continuous"><parent link="arm_1"/><child link="charm"/>'
        '<axis xyz="0 1 0"/></joint></robot>'
    )
    path.write_text(path.read_text().replace("</robot>", loose))
    assert read_urdf(path)["joints"]["chain"]["type"] == "revolute"


def test_a_chosen_type_of_the_yaml_file_replaces_a_joint(tmp_path):
    beside = "name_mot: [motor]\njoint_name: [weld]\njoint_type: [SPHERICAL]\n"
    path = small(tmp_path, beside=beside)
    with pytest.raises(ParameterError, match="no loop closure, and passive joints: weld"):
        read_urdf(path)
    closed = beside.replace("SPHERICAL", "UJOINT_XZ") + "closed_loop: [[tip, world]]\ntype: [3d]\n"
    path = small(tmp_path, 'xyz="0 0 0.3"', 'xyz="0 0 0.3"', closed)
    path.write_text(path.read_text().replace('xyz="0 0 0.5"', 'xyz="0.5 0 0"'))
    joints = read_urdf(path)["joints"]
    assert joints["weld"]["type"] == "universal"
    first, second = joints["weld"]["axes"]
    assert abs(np.dot(first, second)) < 1e-12
    assert joints["tip_world"]["type"] == "spherical" and joints["tip_world"]["at"] == [0, 0, 0]


def test_an_empty_or_foreign_yaml_file_is_passed_over(tmp_path):
    expected = read_urdf(small(tmp_path))
    for content in ("", "mechanism: machine\nbodies: {}\n"):
        assert read_urdf(small(tmp_path, beside=content)) == expected


REFUSED = {
    "no XML": ("</robot>", "", "well-formed XML"),
    "entities": ("<robot", '<!DOCTYPE r [<!ENTITY a "b">]><robot', "without a document type"),
    "other root": ("robot", "sdf", "a <robot> element"),
    "xacro": ('<link name="tool"/>', '<link name="tool"/><xacro:x/>', "run xacro"),
    "two roots": ('<link name="tool"/>', '<link name="tool"/><link name="x"/>', "one root link"),
    "circle": ('<parent link="stand"/>', '<parent link="tool"/>', "circle"),
    "two parents": (
        "</robot>",
        '<joint name="l" type="fixed"><parent link="world"/><child link="tool"/></joint></robot>',
        "joint.l.child.*'tool' already .* 'tip'",
    ),
    "mimic": ("<axis", '<mimic joint="x"/><axis', r"joint.motor.mimic"),
    "coupling": ("</robot>", '<coupling name="g"/></robot>', "coupling.g"),
    "planar": ('"revolute"', '"planar"', "joint.motor.type: 'planar'"),
    "floating": ('"revolute"', '"floating"', "joint.motor.type: 'floating'"),
    "unknown type": ('"revolute"', '"revolut"', "did you mean 'revolute'"),
    "unknown link": ('<child link="crank"/>', '<child link="crnk"/>', "did you mean 'crank'"),
    "two inertials": (
        '<link name="bob"><inertial>',
        '<link name="bob"><inertial><mass value="9"/></inertial><inertial>',
        "link.bob.inertial: '2 <inertial> elements'",
    ),
    "two masses": ('<mass value="3"/>', '<mass value="3"/><mass value="4"/>', "inertial.mass"),
    "two limits": ("<axis", '<limit lower="0" upper="9"/><axis', "joint.motor.limit: '2 <limit>"),
    "two axes": ("<axis", '<axis xyz="1 0 0"/><axis', "joint.motor.axis: '2 <axis>"),
    "two origins": ("<origin", '<origin xyz="1 1 1"/><origin', "origin: '2 <origin>"),
    "two children": ('<child link="crank"/>', '<child link="crank"/><child link="bob"/>', "child"),
    "underscores": ('<mass value="3"/>', '<mass value="1_0"/>', "link.bob.inertial.mass: '1_0'"),
    "other digits": ('<mass value="3"/>', '<mass value="\u0663"/>', "link.bob.inertial.mass"),
    "underscore in a limit": ('effort="3"', 'effort="1_0"', "joint.motor.limit.effort: '1_0'"),
    "no parent": ('<parent link="bob"/>', "", "joint.tip.parent"),
    "name twice": ('<link name="tool"/>', '<link name="tool"/><link name="tool"/>', "unique name"),
    "no name": ('<link name="tool"/>', '<link name="tool"/><link/>', "with a name"),
    "no inertia": (
        '<inertia ixx="0.2" iyy="0.1" izz="0.1"/>',
        "",
        "link.bob.inertial.inertia: missing",
    ),
    "no moment": ('ixx="0.2"', "", "link.bob.inertial.inertia.ixx"),
    "no mass": ('<mass value="3"/>', "", "link.bob.inertial.mass"),
    "negative mass": ('<mass value="3"/>', '<mass value="-3"/>', "link.bob.inertial.mass: -3.0"),
    "nan": ('xyz="0.2 0 0"', 'xyz="nan 0 0"', "joint.weld.xyz: 'nan'"),
    "two numbers": ('xyz="0.2 0 0"', 'xyz="0.2 0"', "joint.weld.xyz.*3 numbers"),
    "no axis": ('xyz="0 0 2"', 'xyz="0 0 0"', "joint.motor.axis"),
    "limits": ('lower="-1"', 'lower="2"', r"joint.motor.limit: \[2.0, 1.0\]"),
    "negative effort": ('effort="3"', 'effort="-3"', "joint.motor.limit.effort"),
    "nobody drives": ('<command_interface name="effort"/>', "", "no actuated joint"),
    "unknown motor": ('<joint name="motor">', '<joint name="moto">', "did you mean 'motor'"),
    "driven weld": ('<joint name="motor">', '<joint name="weld">', "ros2_control.weld: 'fixed'"),
    "no closure": (
        'name="weld" type="fixed"',
        'name="weld" type="revolute"',
        "passive joints: weld",
    ),
    "closure's type": (
        "</robot>",
        '<constraint name="k" type="sphercal"/></robot>',
        "constraint.k.type.*did you mean 'spherical'",
    ),
    "closure's part": (
        "</robot>",
        '<constraint name="k" type="link"><parent_orgin xyz="0 0 1"/></constraint></robot>',
        "constraint.k: .*'parent_orgin'.*did you mean 'parent_origin'",
    ),
    "closure's nested part": (
        "</robot>",
        '<constraint name="k" type="link"><parent link="bob"><origin/></parent></constraint>'
        "</robot>",
        "constraint.k.parent: 'origin'",
    ),
    "loop's part": (
        "</robot>",
        '<loop name="k" type="revolute"><origin/></loop></robot>',
        "loop.k: 'origin'",
    ),
    "loop's type": ("</robot>", '<loop name="k" type="planar"/></robot>', "loop.k.type"),
    "closure's link": (
        "</robot>",
        '<constraint name="k" type="link"><parent link="world"/></constraint></robot>',
        "constraint.k.child: missing",
    ),
    "closure on itself": (
        "</robot>",
        '<constraint name="k" type="link"><parent link="bob"/><child link="bob"/></constraint>'
        "</robot>",
        "k: 'bob'.*between two links",
    ),
    "no platform": ('"tool"', '"bit"', "platform: missing.*one of bit, bob, crank, stand, world"),
    "platform at rest": ('"stand"', '"platform"', "platform: 'platform'.*can move"),
}


@pytest.mark.parametrize("case", sorted(REFUSED))
def test_refused_by_name(case, tmp_path):
    old, new, message = REFUSED[case]
    with pytest.raises(ParameterError, match=message):
        read_urdf(small(tmp_path, old, new))


BESIDE = {
    "closed_loop: [[tip, nowhere]]": "closed_loop.*'nowhere'",
    "closed_loop: [[tip]]": "closed_loop.0.*a pair",
    "closed_loop: [[tip, world]]\ntype: [5d]": "type.0.*'5d'",
    "closed_loop: [[tip, world]]\ntype: []\nname_mot: [motr]": "did you mean 'motor'",
    "closed_loop: [[tip, world]]\ntype: [6d, 6d]": "type.*one per pair",
    "closed_loop: tip": "closed_loop.*a list",
    "name_mot: [motor, motor]": "name_mot.*once",
    "name_mot: [motor]\njoint_name: [weld]\njoint_type: [BALL]": "joint_type: 'BALL'",
    "name_mot: [motor]\njoint_name: [wld]\njoint_type: [FIXED]": "joint_name.*did you mean 'weld'",
    "name_mot: !!python/object:x [motor]": "tags are not allowed",
}


@pytest.mark.parametrize("content", sorted(BESIDE))
def test_a_yaml_file_beside_it_is_refused_by_name(content, tmp_path):
    with pytest.raises(ParameterError, match=BESIDE[content]):
        read_urdf(small(tmp_path, beside=content))


def chain(folder, count):
    """A crank on a motor, and so many links that fixed joints hang one on another."""
    links = "".join(
        f'<link name="l{k}"/><joint name="j{k}" type="fixed"><parent link="{parent}"/>'
        f'<child link="l{k}"/></joint>'
        for k, parent in enumerate(["crank", *(f"l{k}" for k in range(count - 1))])
    )
    path = small(folder)
    path.write_text(path.read_text().replace("</robot>", links + "</robot>"))
    return path


def steps_of(call):
    """How many instructions the interpreter takes for a call, and what the call gives."""
    count = 0

    def trace(frame, event, _):
        nonlocal count
        frame.f_trace_opcodes = True
        count += event == "opcode"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        result = call()
    finally:
        sys.settrace(before)
    return count, result


def test_long_chains_of_fixed_links_take_time_in_proportion(tmp_path):
    steps = []
    for count in (200, 1200):
        path = chain(tmp_path, count)
        taken, data = steps_of(functools.partial(read_urdf, path, platform=f"l{count - 1}"))
        assert list(data["bodies"]) == [f"l{count - 1}"]
        steps.append(taken)
    # Six times the links: in squares it would be 36 times as much.
    assert steps[1] < 7 * steps[0]


def test_more_joints_than_can_be_assembled_are_rejected(tmp_path):
    path = chain(tmp_path, 1001)
    path.write_text(path.read_text().replace('type="fixed"', 'type="continuous"'))
    with pytest.raises(ParameterError, match="at most 1000"):
        read_urdf(path)


@pytest.mark.parametrize("name", ["robot.xacro", "robot.urdf.xacro"])
def test_a_xacro_file_says_what_to_do(name, tmp_path):
    (tmp_path / name).write_text(SMALL)
    with pytest.raises(ParameterError, match=f"run `xacro {name} > robot.urdf`"):
        load(tmp_path / name)


def test_unknown_platform_and_base_are_refused(tmp_path):
    with pytest.raises(UnknownNameError, match="did you mean 'tool'"):
        read_urdf(small(tmp_path), platform="tol")
    with pytest.raises(UnknownNameError, match="did you mean 'world'"):
        read_urdf(small(tmp_path), base="wrld")


def test_an_open_loop_is_refused_with_its_miss(tmp_path):
    path = five_bar().save(tmp_path)
    content = path.read_text()
    path.write_text(content.replace('<child_origin xyz="', '<child_origin xyz="5'))
    with (
        pytest.warns(UserWarning, match="an offset of 50"),
        pytest.raises(ParameterError, match=r"tip: 'open by \d"),
    ):
        read_urdf(path)


def test_files_that_are_no_files_or_too_much_are_refused(tmp_path):
    with pytest.raises(ParameterError, match="not a file"):
        read_urdf(tmp_path)
    with pytest.raises(ParameterError, match="no such file"):
        read_urdf(tmp_path / "none.urdf")
    deep = tmp_path / "deep.urdf"
    deep.write_text("<robot>" + "<a>" * 100_000)
    with pytest.raises(ParameterError, match="a nesting of at most"):
        read_urdf(deep)
    large = tmp_path / "large.urdf"
    large.write_text("<robot>" + " " * 4_200_000 + "</robot>")
    with pytest.raises(ParameterError, match="at most 4194304 bytes"):
        read_urdf(large)


def test_what_looks_like_millimetres_or_degrees_is_asked(tmp_path):
    with pytest.warns(UserWarning, match=r"joint.weld.origin: .* 200 m; .* millimetres\?"):
        read_urdf(small(tmp_path, 'xyz="0.2 0 0"', 'xyz="200 0 0"'))
    with pytest.warns(UserWarning, match=r"joint.weld.rpy: .*degrees\?"):
        read_urdf(small(tmp_path, "1.5707963267948966", "90"))


def test_a_quaternion_serves_as_well_as_angles(tmp_path):
    expected = read_urdf(small(tmp_path))
    half = repr(float(np.sqrt(0.5)))
    turned = read_urdf(
        small(tmp_path, 'rpy="0 1.5707963267948966 0"', f'quat_xyzw="0 {half} 0 {half}"')
    )
    np.testing.assert_allclose(
        turned["bodies"]["tool"]["inertia"], expected["bodies"]["tool"]["inertia"]
    )
    np.testing.assert_allclose(turned["origin"], expected["origin"], atol=1e-14)


def constrained_torques(sketch, model, data, ends, q, v, a):
    """Actuator efforts and closure forces that give the accelerations, all other efforts zero."""
    free = pin.rnea(model, data, q, v, a) + 0.1 * v + 0.2 * np.sign(v)
    _, rows = closure_rows(model, data, ends, q)
    driven = [model.joints[model.getJointId(name)].idx_v for name in sketch.actuated]
    select = np.zeros((model.nv, len(driven)))
    select[driven, range(len(driven))] = 1.0
    solved, *_ = np.linalg.lstsq(np.hstack([select, rows.T]), free, rcond=1e-10)
    return solved[: len(driven)]


def test_torques_are_pinocchios_constrained_solution(sketch, described):
    description = described
    robot = Machine.from_data(description, "sketch")
    model, data, ends = sketch.model()
    q = values(model, description)
    driven = [model.joints[model.getJointId(name)].idx_v for name in robot.joint_names]
    loose = [i for i in range(model.nv) if i not in driven]
    rng = np.random.default_rng(0)
    for _ in range(5):
        _, rows = closure_rows(model, data, ends, q)

        def follow(known, bias, rows=rows):
            full = np.zeros(model.nv)
            full[driven] = known
            rest = -bias - rows[:, driven] @ known
            full[loose] = np.linalg.lstsq(rows[:, loose], rest, rcond=1e-9)[0]
            return full

        v = follow(rng.normal(size=len(driven)), np.zeros(len(rows)))
        step = 1e-5
        before, after = (closure_rows(model, data, ends, q + s * step * v)[1] for s in (-1, 1))
        a = follow(rng.normal(size=len(driven)), (after - before) @ v / (2 * step))
        expected = constrained_torques(sketch, model, data, ends, q, v, a)
        found = inverse_dynamics(robot, q[driven], v[driven], a[driven])
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_a_tree_whose_joints_are_all_driven_needs_no_closure(tmp_path):
    assert np.allclose(read_urdf(small(tmp_path))["joints"]["motor"]["axis"], Z)


def test_passive_joints_have_the_values_of_the_urdf(sketch, described):
    """With the robot's passive values Pinocchio closes the loops, away from home as well."""
    robot = Machine.from_data(described, "sketch")
    model, data, ends = sketch.model()
    assert {*robot.joint_names, *robot.passive_joints} == set(model.names[1:])
    rng = np.random.default_rng(0)
    home = robot.inverse(robot.home())
    for q in home + rng.uniform(-0.03, 0.03, (5, len(home))):
        known = dict(zip(robot.joint_names, q, strict=True))
        known |= dict(zip(robot.passive_joints, robot.passive(q), strict=True))
        full = np.array([known[name] for name in model.names[1:]])
        residual, _ = closure_rows(model, data, ends, full)
        assert np.abs(residual).max() < 1e-9
        platform = data.oMf[model.getFrameId("platform")]
        start = sketch_home(robot, model, data, ends)
        np.testing.assert_allclose(
            robot.platform(q)[1], platform.rotation @ start.rotation.T, atol=1e-9
        )
        np.testing.assert_allclose(robot.platform(q)[0], platform.translation, atol=1e-9)


def sketch_home(robot, model, data, ends):
    """The platform's frame at the robot's home."""
    home = robot.inverse(robot.home())
    known = dict(zip(robot.joint_names, home, strict=True))
    known |= dict(zip(robot.passive_joints, robot.passive(home), strict=True))
    kept = data.copy()
    closure_rows(model, kept, ends, np.array([known[name] for name in model.names[1:]]))
    return kept.oMf[model.getFrameId("platform")]


def test_load_takes_a_urdf(sketch, tmp_path):
    robot = load(str(sketch.save(tmp_path)), platform="platform")
    assert list(robot.joint_names) == sketch.actuated


WORDS = ["nan", "inf", "-1", "", "1e400", "1e-320", "1e18", "0 0 0", "fixed", "spherical", "base"]


@pytest.mark.filterwarnings("ignore")
def test_damaged_files_are_read_or_refused_by_name(tmp_path):
    rng = np.random.default_rng(8)
    good = 0
    path = tmp_path / "damaged.urdf"
    for _ in range(120):
        content = bytearray((SMALL, five_bar().urdf()[0])[rng.integers(2)].encode())
        for _ in range(rng.integers(1, 3)):
            at = int(rng.integers(len(content)))
            how = rng.integers(4)
            if how == 0:
                content[at] = rng.integers(256)
            elif how == 1:
                del content[at : at + int(rng.integers(1, 40))]
            else:
                start = content.find(b'="', at) + 2
                content[start : content.find(b'"', start)] = rng.choice(WORDS).encode()
        path.write_bytes(bytes(content))
        try:
            read_urdf(path)
            good += 1
        except ParameterError as error:
            assert "\n" not in str(error)
    assert good > 0
