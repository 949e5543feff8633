# SPDX-License-Identifier: Apache-2.0
"""A machine that is being calibrated: its numbers as they are now, and what an instrument sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.design.variants import Variants
from pkm_twin.errors import ParameterError
from pkm_twin.identification.transmission import centred, changed
from pkm_twin.machine.joint_map import JointMap
from pkm_twin.robot.robot import Robot

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]


FRAME: Final = tuple(f"frame.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))
TARGET: Final = ("target.x", "target.y", "target.z")
BESIDE: Final = (*FRAME, *TARGET, "joint_map.")
"""Names, or their beginnings, of what is fitted beside the machine's own numbers."""


def rotations() -> Any:
    """Scipy's class of rotations."""
    # Not above: every command would load it, which takes as long as all else at its start.
    from scipy.spatial.transform import Rotation

    return Rotation


@dataclass(frozen=True)
class Poses:
    """Measured poses: joints (k, n) in the controller's numbers; positions (k, 3), m; rotations
    from home (k, 3, 3), None where only positions were measured.
    """

    joints: Array
    position: Array
    rotation: Array | None = None

    def part(self, rows: Mask) -> Poses:
        """Some of them."""
        turned = None if self.rotation is None else self.rotation[rows]
        return Poses(self.joints[rows], self.position[rows], turned)


class Posed(Protocol):
    """Measurements at joint positions (k, n) in the controller's numbers."""

    @property
    def joints(self) -> Array:
        """Of the poses."""


@dataclass(frozen=True)
class Errors:
    """Of poses: root mean square and greatest distance, m, and angle, rad (None: not measured)."""

    rms: float
    worst: float
    rms_angle: float | None = None
    worst_angle: float | None = None


@dataclass
class Instrument:
    """What is fitted beside the machine: its joints' sensors, where the instrument stands."""

    map: JointMap
    frame: Rotation = field(default_factory=lambda: rotations().identity())
    place: Array = field(default_factory=lambda: np.zeros(3))
    target: Array = field(default_factory=lambda: np.zeros(3))
    own: dict[str, float] = field(default_factory=dict)
    """Numbers of single measurements, such as a plane's height, by name."""

    def joints(self, poses: Posed) -> Array:
        """The model's joint positions (k, n) at measured poses."""
        return self.map.positions(poses.joints)

    def seen(self, position: Array, rotation: Array) -> tuple[Array, Array]:
        """What it should see of the platform: positions and rotations in its own frame."""
        turn = self.frame.as_matrix()
        return self.place + (position + rotation @ self.target) @ turn.T, turn @ rotation

    def residuals(
        self, poses: Poses, position: Array, rotation: Array
    ) -> tuple[Array, Array | None]:
        """Measured less seen: (k, 3), m, and rotation vectors (k, 3), rad."""
        position, rotation = self.seen(position, rotation)
        if poses.rotation is None:
            return poses.position - position, None
        apart = rotations().from_matrix(poses.rotation @ np.swapaxes(rotation, -1, -2))
        return poses.position - position, apart.as_rotvec()

    def parts(self, robot: Robot, poses: Poses) -> list[Array]:
        """Of a loaded robot: residuals of positions and, where measured, rotations, (k, 3) each."""
        both = self.residuals(poses, *robot.platform(self.joints(poses)))
        return [part for part in both if part is not None]

    def errors(self, robot: Robot, poses: Poses) -> Errors:
        """Of a loaded robot."""
        sizes = [np.linalg.norm(part, axis=1) for part in self.parts(robot, poses)]
        pairs = [(float(np.sqrt(np.mean(size**2))), float(size.max())) for size in sizes]
        values = [value for pair in pairs for value in pair]
        return Errors(*values)


@dataclass
class State:
    """The machine with numbers as they are now, at the poses that are learnt from.

    ``machine``: alone among its variants. ``platform``: positions (k, 3) and rotations (k, 3, 3) of
    its reference point.
    """

    machine: Variants
    q: Array
    platform: tuple[Array, Array]
    instrument: Instrument

    def parts(self, poses: Poses) -> list[Array]:
        """The instrument's residuals of the poses that are learnt from, (k, 3) each."""
        both = self.instrument.residuals(poses, *self.platform)
        return [part for part in both if part is not None]

    @property
    def numbers(self) -> dict[str, float]:
        """Of the file, by path."""
        return dict(zip(self.machine.paths, self.machine.values[0].tolist(), strict=False))


def start_of(robot: Robot, poses: Posed, paths: Sequence[str]) -> State:
    """The robot as it is, with numbers that may change, an instrument at its base.

    :raises UnreachableError: a joint state without an assembly, by limb, sample and miss.
    """
    instrument = Instrument(centred(robot, robot.controller.positions(poses.joints)))
    q = instrument.joints(poses)
    machine = Variants(robot, {path: robot.number(path) for path in paths})
    return State(machine, q, robot.platform(q), instrument)


def place_frame(state: State, poses: Poses) -> None:
    """A first guess of the instrument's frame: the best rigid motion between the point clouds."""
    tool, model = state.instrument, state.platform[0]
    centres = poses.position.mean(0), model.mean(0)
    tool.frame, _ = rotations().align_vectors(poses.position - centres[0], model - centres[1])
    tool.place = centres[0] - tool.frame.apply(centres[1])


def value_of(state: State, name: str, otherwise: float) -> float:
    """A number of the instrument's as it is now, of any other name the given one."""
    tool = state.instrument
    if name in FRAME[:3]:
        return float(tool.place[FRAME.index(name)])
    if name in TARGET:
        return float(tool.target[TARGET.index(name)])
    return tool.own.get(name, otherwise)


def moved(
    robot: Robot, state: State, poses: Posed, values: Mapping[str, float], turn: Array
) -> State:
    """The machine with new numbers.

    :param values: of all that is fitted, by name.
    :param turn: of the instrument's frame since ``state``, a rotation vector, shape (3,), rad.
    :raises ParameterError: numbers that no file may have, or no machine can be assembled with.
    """
    tool = state.instrument
    new = Instrument(
        changed(robot, tool.map, values),
        rotations().from_rotvec(turn) * tool.frame,
        np.array([values.get(n, v) for n, v in zip(FRAME[:3], tool.place, strict=True)]),
        np.array([values.get(n, v) for n, v in zip(TARGET, tool.target, strict=True)]),
        {name: values.get(name, value) for name, value in tool.own.items()},
    )
    machine, q = state.machine, new.joints(poses)
    if machine.paths:
        now = state.numbers
        row = [values.get(path, now[path]) for path in machine.paths]
        machine = machine.with_values(np.array([row]))
    position, rotation = machine.platform(q[None])
    if not np.isfinite(position).all():
        raise ParameterError("geometry", None, "numbers with which the machine can be assembled")
    return State(machine, q, (position[0], rotation[0]), new)
