# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Topics of the node ``stiffness_monitor``."""

from __future__ import annotations

from typing import Final

from pkm_twin.streams.topics import JOINTS, NUMBER_ARRAY, STATUSES, TEXT, TRIGGER, WRENCH, Topic, table

_TRANSFORM: Final = "geometry_msgs/TransformStamped"
_IF_CORRECTING: Final = "`correct_setpoint`"

STIFFNESS: Final = table(
    Topic(
        "in",
        "wrench",
        WRENCH,
        "measured at the platform's reference point, or at the sensor position given by `sensor.xyz` or `/tf`",
    ),
    Topic("in", "joint_states", JOINTS, "joint positions, which determine the pose"),
    Topic("out", "~/compliance", NUMBER_ARRAY, "6x6 row-major, labels row, col; base axes, m and rad per N and N m"),
    Topic("out", "~/compliance_stamped", JOINTS, "its upper triangle: names `x_ry` and so on, entries as positions"),
    Topic(
        "out",
        "~/strain_energy",
        STATUSES,
        "message: the dominant element; values: each element's share, `total_energy`, the pose, `frame`",
    ),
    Topic(
        "out",
        "~/strain_energy_stamped",
        JOINTS,
        "elements as names, their shares as positions, energies (J) as efforts",
    ),
    Topic("out", "~/dominant_element", TEXT, "its name, or `none` for a zero wrench"),
    Topic(
        "out",
        "~/deflection",
        _TRANSFORM,
        "platform to deflected platform, in platform axes; frames `platform_frame` and this name "
        "with `_deflected` added",
    ),
    Topic("in", "setpoint", JOINTS, "commanded positions", _IF_CORRECTING),
    Topic(
        "out",
        "~/setpoint_offset",
        JOINTS,
        "offsets for the joints' setpoints that keep the tool point in place",
        _IF_CORRECTING,
    ),
    Topic(
        "out",
        "~/corrected_setpoint",
        JOINTS,
        "`setpoint` with the last offset, which moves at most at `correction_rate`, bounded at "
        "the joints' position limits",
        _IF_CORRECTING,
    ),
    Topic("in", "torques", JOINTS, "efforts, as `~/joint_torques` of `delta_dynamics`", "`pair_torques`"),
    Topic(
        "out",
        "~/setpoint_with_torques",
        JOINTS,
        "corrected setpoint and efforts of the same stamp in one message",
        "`pair_torques`",
    ),
    Topic(
        "in",
        "measured_deflection",
        _TRANSFORM,
        "the platform's measured deflection, in `base_frame` or the frame of `~/deflection`",
        "`watch_stiffness`",
    ),
    Topic(
        "out",
        "~/stiffness_alarm",
        STATUSES,
        "WARN once a second (by the stamps) while an element's compliance differs from the file; "
        "message: its name, or the names that the loads do not distinguish; values `element`, "
        "`factor`, `deviation`, `bound`, and `or NAME` for each other name; when it ends, one OK "
        "with the name `none`",
        "`watch_stiffness`",
        latched=True,
    ),
    Topic(
        "out",
        "~/natural_frequencies",
        NUMBER_ARRAY,
        "the first six, Hz, with locked actuators at the latest joint state; needs masses in the robot's file",
    ),
    Topic("out", "~/natural_frequencies_stamped", JOINTS, "names `mode_1` and so on, frequencies (Hz) as positions"),
    Topic(
        "service",
        "~/reset_stiffness",
        TRIGGER,
        "discards measured deflections, for example after a repair",
        "`watch_stiffness`",
    ),
)
