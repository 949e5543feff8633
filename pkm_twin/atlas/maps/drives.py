# SPDX-License-Identifier: Apache-2.0
"""Maps of what the drives' effort limits allow at rest: payload and acceleration."""

from __future__ import annotations

from typing import Final

import numpy as np

from delta_dynamics import inverse_dynamics
from pkm_twin.atlas.maps.quantity import Array, Case, Found, Quantity, no_wrench, require_effort
from pkm_twin.robot.robot import Robot


def capacity(robot: Robot, q: Array, wrench: Array | None) -> Found:
    """The largest mass on the platform that the drives hold, its own payload taken away.

    The mass has the centre of the file's payload. 0 where the drives do not hold the machine
    without it; infinite where no drive feels the mass. The element is the drive at its limit.
    """
    limits, still = require_effort(robot), np.zeros_like(q)
    none = {"mass": 0.0, "inertia": np.zeros((3, 3)).tolist()}
    bare, loaded = (robot.changed(payload=none | {"mass": mass}) for mass in (0.0, 1.0))
    held = inverse_dynamics(bare, q, still, still, wrench)
    each = inverse_dynamics(loaded, q, still, still, wrench) - held
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(each == 0.0, np.inf, (np.copysign(limits, each) - held) / each)
    over = np.abs(held) / limits
    value, joint = room.min(-1), room.argmin(-1)
    fails = over.max(-1) > 1.0
    direction = robot.gravity / (np.linalg.norm(robot.gravity) or 1.0)
    return Found(
        np.where(fails, 0.0, value),
        np.broadcast_to(direction, (*value.shape, 3)),
        np.where(fails, over.argmax(-1), joint),
    )


def acceleration(robot: Robot, q: Array, wrench: Array | None) -> Found:
    """The acceleration of the platform from rest that the drives reach in every direction.

    Of the position in the pose, its angles not accelerated; of a pose of angles alone the angular
    acceleration. The direction is the worst one, the element the drive at its limit there. 0 where
    the drives do not hold the machine.
    """
    limits, still = require_effort(robot), np.zeros_like(q)
    places = [k for k, name in enumerate(robot.pose_names) if name in "xyz"]
    if places:
        back = np.linalg.inv(robot.jacobian(q))[..., places]
        axes = np.eye(3)[["xyz".index(robot.pose_names[k]) for k in places]]
    else:
        back = np.linalg.pinv(robot.platform_jacobian(q)[..., 3:, :])
        axes = np.eye(3)
    held = inverse_dynamics(robot, q, still, still, wrench)
    each = np.stack(
        [
            inverse_dynamics(robot, q, still, back[..., k], wrench) - held
            for k in range(back.shape[-1])
        ],
        -1,
    )
    size = np.linalg.norm(each, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(size > 0.0, (limits - np.abs(held)) / size, np.inf)
    joint = room.argmin(-1)
    value = np.take_along_axis(room, joint[..., None], -1)[..., 0]
    row = np.take_along_axis(each, joint[..., None, None], -2)[..., 0, :] @ axes
    sign = np.where(np.take_along_axis(held, joint[..., None], -1) < 0.0, -1.0, 1.0)
    length = np.linalg.norm(row, axis=-1, keepdims=True)
    return Found(np.maximum(value, 0.0), sign * row / np.where(length > 0.0, length, 1.0), joint)


def _acceleration_unit(robot: Robot, case: Case) -> str:
    return "m/s2" if set("xyz") & set(robot.pose_names) else "rad/s2"


PAYLOAD: Final = Quantity(
    "payload",
    "largest mass on the platform that the drives hold at rest",
    "how much can it carry?",
    capacity,
    lambda robot: robot.joint_names,
    lambda robot, case: "kg",
    no_wrench("rest"),
    element="drive",
    largest=False,
)
ACCELERATION: Final = Quantity(
    "acceleration",
    "acceleration of the platform from rest in its worst direction",
    "how hard can it accelerate?",
    acceleration,
    lambda robot: robot.joint_names,
    _acceleration_unit,
    no_wrench("rest"),
    element="drive",
    largest=False,
)
