# SPDX-License-Identifier: Apache-2.0
"""How a mechanism with masses declares its joints, and the motion of its platform's frame.

A joint is a point, the two bodies that meet there, and the wrenches that it can transmit:
all that its freedoms do not let through, and the actuator's effort. World axes, SI units,
batch axes lead.

May import: numpy, the mechanisms' core, the standard library.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.errors import ParameterError
from pkm_twin.machine.bodies import PAYLOAD_COM, ROW
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

GROUND: Final = "base"
MOVING: Final = "platform"
PAYLOAD: Final = "payload"


@dataclass(frozen=True)
class Joint:
    """One joint: what the inner body (on the base's side) can transmit to the outer one.

    ``components`` names the columns of ``basis``, shape (..., 6, components): unit forces and
    unit couples at ``point``, shape (..., 3), m. A component of the same name at two joints is
    one unknown: a couple that passes through a body without touching its balance.
    ``actuated`` is the component that the actuator applies, positive as q is.
    """

    name: str
    inner: str
    outer: str
    point: Array
    components: tuple[str, ...]
    basis: Array
    actuated: str | None = None


def joint(
    name: str,
    bodies: tuple[str, str],
    point: Array,
    forces: Mapping[str, Array],
    moments: Mapping[str, Array],
    *,
    actuated: str | None = None,
    passed: Mapping[str, Array] | None = None,
) -> Joint:
    """A joint from unit directions, shape (..., 3), by the name of the direction.

    :param bodies: inner (base's side) and outer body.
    :param actuated: ``"force along z"``, say: the component that the actuator applies.
    :param passed: couples that this joint shares with another, by their full names.
    """
    names = [f"{name}: force along {key}" for key in forces]
    names += [f"{name}: moment along {key}" for key in moments]
    couples = [*moments.values(), *(passed or {}).values()]
    names += list(passed or {})
    count = len(forces)
    basis = np.zeros((*point.shape[:-1], 6, len(names)))
    for k, direction in enumerate(forces.values()):
        basis[..., :3, k] = direction
    for k, direction in enumerate(couples):
        basis[..., 3:, count + k] = direction
    effort = None if actuated is None else f"{name}: {actuated}"
    return Joint(name, *bodies, point, tuple(names), basis, effort)


@dataclass(frozen=True)
class PlatformMotion:
    """The platform's frame and its first two derivatives in time, world axes.

    Of the origin, shape (..., 3), m, m/s, m/s2; of the axes x, y, z as columns, shape (..., 3, 3).
    """

    position: Array
    velocity: Array
    acceleration: Array
    axes: Array
    axes_rate: Array
    axes_acceleration: Array


@runtime_checkable
class Jointed(Protocol):
    """A mechanism that declares its joints and how its pose follows its platform."""

    def body_joints(self, q: Array, platform: PlatformMotion) -> tuple[Joint, ...]:
        """All joints at positions q, shape (..., 3), the actuated ones in the order of q."""
        ...

    def pose_rates(self, platform: PlatformMotion) -> tuple[Array, Array]:
        """First and second derivative of the pose in time, shape (..., 3) each."""
        ...


def jointed(robot: Robot) -> Jointed:
    """The robot as one that declares its joints.

    :raises ParameterError: the mechanism declares none.
    """
    if not isinstance(robot, Jointed):
        raise ParameterError(
            "mechanism", robot.mechanism, "a mechanism that declares its joints (delta, prru)"
        )
    return robot


def platform_motion(
    robot: Robot, q: ArrayLike, qd: ArrayLike = (0.0, 0.0, 0.0), qdd: ArrayLike = (0.0, 0.0, 0.0)
) -> PlatformMotion:
    """Motion of the platform's frame, exact, from the bodies' rows.

    The payload's row tells the motion of any point of the platform: here the origin and the
    points one metre along its x and y axes.
    """
    kernel = robot.motion_kernel
    if kernel is None:
        raise ParameterError("mechanism", robot.mechanism, "a mechanism with masses (delta, prru)")
    row = slice(ROW * robot.body_names.index(PAYLOAD), ROW * (robot.body_names.index(PAYLOAD) + 1))
    points = []
    for offset in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)):
        p = robot.parameters.copy()
        p[PAYLOAD_COM : PAYLOAD_COM + 3] = offset
        flat, fault = kernel(p, q, qd, qdd)
        robot.raise_fault(fault, "joint state")
        data = flat[..., row]
        per_rate = data[..., 10:19].reshape(*data.shape[:-1], 3, 3)
        velocity = np.einsum("...jk,...j->...k", per_rate, np.asarray(qd, np.float64))
        points.append((data[..., 1:4], velocity, data[..., 4:7]))
    o, px, py = points
    x, xd, xdd = (b - a for a, b in zip(o, px, strict=True))
    y, yd, ydd = (b - a for a, b in zip(o, py, strict=True))
    z = np.cross(x, y)
    zd = np.cross(xd, y) + np.cross(x, yd)
    zdd = np.cross(xdd, y) + 2 * np.cross(xd, yd) + np.cross(x, ydd)
    return PlatformMotion(
        *o, np.stack([x, y, z], -1), np.stack([xd, yd, zd], -1), np.stack([xdd, ydd, zdd], -1)
    )
