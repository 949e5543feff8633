# SPDX-License-Identifier: Apache-2.0
"""Topics of the node ``machine_state``."""

from __future__ import annotations

from typing import Final

from pkm_twin.streams.topics import JOINTS, TEXT, WRENCH, Topic, table

_TRANSFORMS: Final = "tf2_msgs/TFMessage"

STATE: Final = table(
    Topic("in", "joint_states", JOINTS, "positions, and velocities where present"),
    Topic("in", "wrench", WRENCH, "the load to draw"),
    Topic("out", "~/joint_states", JOINTS,
          "positions of all joints, by the exported URDF's names; velocities where the input "
          "carries velocities"),
    Topic("out", "~/pose", "geometry_msgs/PoseStamped",
          "the platform's reference point, rotation from home"),
    Topic("out", "~/twist", "geometry_msgs/TwistStamped",
          "its velocity and angular velocity, base axes; only if the input carries velocities"),
    Topic("out", "~/markers", "visualization_msgs/MarkerArray",
          "bars; under a load also colours by strain energy, deflected lines, the compliance "
          "ellipsoid, the wrench and the dominant element's name"),
    Topic("out", "robot_description", TEXT,
          "the output of `pkm-twin export urdf` without its `ros2_control` element", latched=True),
    Topic("out", "/tf", _TRANSFORMS,
          "`base_frame` to `platform_frame`, if tf2_msgs is installed"),
    Topic("out", "/tf_static", _TRANSFORMS,
          "`platform_frame` to `tool_frame`, if tf2_msgs is installed", latched=True),
)  # fmt: skip
