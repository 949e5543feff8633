# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A small URDF without closures, to be changed."""

from __future__ import annotations

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
