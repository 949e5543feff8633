# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Topics of the nodes ``delta_dynamics``, ``command_gate`` and ``machine_sim``."""

from __future__ import annotations

from typing import Final

from pkm_twin.streams.topics import JOINTS, NUMBER_ARRAY, STATUSES, TEXT, TRAJECTORY, TRIGGER, WRENCH, Topic, table

_INERTIA: Final = "geometry_msgs/InertiaStamped"
_OBSERVED: Final = "`observe_wrench`"

TWIN: Final = table(
    Topic(
        "in", "~/joint_trajectory", TRAJECTORY, "a whole trajectory; a zero stamp means start on receipt", whole=True
    ),
    Topic("in", "joint_states", JOINTS, "a stream, matched by name in any order"),
    Topic("in", "wrench", WRENCH, "the external wrench on the platform", "`use_wrench`"),
    Topic(
        "in",
        "base_imu",
        "sensor_msgs/Imu",
        "angular velocity of the base, and its acceleration less gravity",
        "`base_imu`",
    ),
    Topic("out", "~/joint_trajectory_ff", TRAJECTORY, "the input with `effort` added, for joint_trajectory_controller"),
    Topic("out", "~/joint_torques", JOINTS, "names and effort, with the stamp of the input"),
    Topic("out", "~/torque_residual", JOINTS, "measured minus predicted effort, where the input carries effort"),
    Topic("out", "~/commands", NUMBER_ARRAY, "efforts in configured order", "`publish_commands`"),
    Topic(
        "out", "~/payload", _INERTIA, "mass and centre of mass of the load, from measured efforts", "`estimate_payload`"
    ),
    Topic(
        "out",
        "~/payload_deviation",
        _INERTIA,
        "standard deviations of mass and centre; infinite where the motion does not determine them",
        "`estimate_payload`",
    ),
    Topic(
        "out",
        "~/external_wrench",
        WRENCH,
        "the smallest wrench at the platform that explains the efforts, base axes",
        _OBSERVED,
    ),
    Topic("out", "~/external_effort", JOINTS, "the external efforts at the joints", _OBSERVED),
    Topic(
        "out",
        "~/contact",
        "std_msgs/Bool",
        "whether an external effort exceeds its bound, published on change",
        _OBSERVED,
        latched=True,
    ),
    Topic(
        "out",
        "~/contact_body",
        TEXT,
        "`platform`, the limb, `clamping A and B` or `unknown`; empty without a contact; published on change",
        _OBSERVED,
        latched=True,
    ),
    Topic(
        "out",
        "~/contact_point",
        "geometry_msgs/PointStamped",
        "during a contact: the most likely place, base axes",
        _OBSERVED,
    ),
    Topic(
        "out",
        "~/reactions/<joint>",
        WRENCH,
        "the wrench that a joint's inner body applies to its outer body, at the joint, base axes",
        "`publish_reactions`",
    ),
    Topic("service", "~/reset_payload", TRIGGER, "resets the payload's estimate", "`estimate_payload`"),
)
GATE: Final = table(
    Topic(
        "in",
        "delta_dynamics/joint_torques",
        JOINTS,
        "the stamped torques; the publisher must offer deadline and lifespan",
    ),
    Topic("in", "joint_states", JOINTS, "the measured position", "`on_stop` gravity"),
    Topic("out", "~/commands", NUMBER_ARRAY, "for JointGroupEffortController, configured order"),
    Topic("out", "~/commands_stamped", JOINTS, "the same, with joint names and time of sending"),
)
SIMULATION: Final = table(
    Topic("in", "~/commands", NUMBER_ARRAY, "efforts in configured order, as for an effort controller"),
    Topic(
        "in",
        "~/joint_trajectory",
        TRAJECTORY,
        "followed by an internal PD position control, `effort` added as feedforward; a zero stamp means now",
        whole=True,
    ),
    Topic("in", "~/applied_wrench", WRENCH, "external wrench on the platform until the next message, in `base_frame`"),
    Topic("out", "joint_states", JOINTS, "position, velocity, and the drives' effort"),
    Topic(
        "out",
        "wrench",
        WRENCH,
        "measured by a sensor at the platform's reference point, platform axes, tared (without the payload)",
    ),
    Topic(
        "out",
        "~/drawn",
        STATUSES,
        "once: each perturbed parameter and its factor (for a position its shift, m)",
        latched=True,
    ),
)
