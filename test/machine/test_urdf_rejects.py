# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""URDFs that are rejected, and with what error; damaged ones; the work for long ones."""

from __future__ import annotations

import functools
import sys

import numpy as np
import pytest

from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.robot.urdf_read import read_urdf
from test.support.robots import load

pytest.importorskip("pinocchio")


from .sketches import five_bar
from .small_urdf import SMALL, small

pytestmark = pytest.mark.usefixtures("quickly_compiled")

REFUSED = {
    "no XML": ("</robot>", "", "well-formed XML"),
    "entities": ("<robot", '<!DOCTYPE r [<!ENTITY a "b">]><robot', "without a document type"),
    "other root": ("robot", "world", "a <robot> element"),
    "xacro": ('<link name="tool"/>', '<link name="tool"/><xacro:x/>', "run xacro"),
    "two roots": ('<link name="tool"/>', '<link name="tool"/><link name="x"/>', "one root link"),
    "circle": ('<parent link="stand"/>', '<parent link="tool"/>', "circle"),
    "mimic": ("<axis", '<mimic joint="x"/><axis', r"joint.motor.mimic"),
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
    "nobody drives": ('<command_interface name="effort"/>', "", "no joint is marked as actuated"),
    "unknown motor": ('<joint name="motor">', '<joint name="moto">', "did you mean 'motor'"),
    "unnamed motor": ('<joint name="motor">', "<joint>", "joint: .*with a name"),
    "unnamed transmission": (
        '<command_interface name="effort"/></joint></ros2_control>',
        "</joint></ros2_control><transmission><joint/></transmission>",
        "joint: missing",
    ),
    "driven weld": ('<joint name="motor">', '<joint name="weld">', "ros2_control.weld: 'fixed'"),
    "no closure": (
        'name="weld" type="fixed"',
        'name="weld" type="revolute"',
        "passive joints: weld",
    ),
    "no platform": ('"tool"', '"bit"', "platform: missing.*one of bit, bob, crank, stand, world"),
    "platform at rest": ('"stand"', '"platform"', "platform: 'platform'.*can move"),
}
MORE = {
    '<joint name="l" type="fixed"><parent link="world"/><child link="tool"/></joint>': (
        "joint.l.child.*'tool' already .* 'tip'"
    ),
    '<coupling name="g"/>': "coupling.g",
    '<robot name="second"/>': "robot.second: .*one <robot>",
    '<constraint name="k" type="sphercal"/>': "constraint.k.type.*did you mean 'spherical'",
    '<constraint name="k" type="link"><parent_orgin xyz="0 0 1"/></constraint>': (
        "constraint.k: .*'parent_orgin'.*did you mean 'parent_origin'"
    ),
    '<constraint name="k" type="link"><parent link="bob"><origin/></parent></constraint>': (
        "constraint.k.parent: 'origin'"
    ),
    '<loop name="k" type="revolute"><origin/></loop>': "loop.k: 'origin'",
    '<loop name="k" type="planar"/>': "loop.k.type",
    '<constraint name="k" type="link"><parent link="world"/></constraint>': "k.child: missing",
    '<constraint name="k" type="link"><parent link="bob"/><child link="bob"/></constraint>': (
        "k: 'bob'.*between two links"
    ),
}
REFUSED |= {more: ("</robot>", f"{more}</robot>", text) for more, text in MORE.items()}


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
        f'<link name="l{k}"/><joint name="j{k}" type="fixed"><parent link="{parent}"/><child link="l{k}"/></joint>'
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


def test_files_that_are_no_files_or_too_much_are_refused(tmp_path):
    with pytest.raises(ParameterError, match="a folder"):
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
