# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""State of a calibration: the machine with its current parameter values, and the instrument."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import combinations
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.design.variants import Variants
from pkm_twin.errors import ParameterError
from pkm_twin.identification.parameters import OBSERVED_RATIO
from pkm_twin.machine.joint_map import JointMap
from pkm_twin.machine.rotations import skew
from pkm_twin.robot.robot import Robot

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

FRAME: Final = tuple(f"frame.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))
TARGET: Final = ("target.x", "target.y", "target.z")
OTHER_PARAMETERS: Final = (*FRAME, *TARGET, "joint_map.")
"""Names, or prefixes of names, of fitted parameters that are not the machine's geometry."""


def rotations() -> Any:
    """Scipy's class of rotations."""
    # Not above: every command would load it, which takes as long as all else at its start.
    from scipy.spatial.transform import Rotation

    return Rotation


@dataclass(frozen=True)
class Poses:
    """Measured poses.

    Joints (k, n) in the controller's numbers; positions (k, 3), m; rotations from home (k, 3, 3),
    None where only positions were measured.
    """

    joints: Array
    position: Array
    rotation: Array | None = None

    def part(self, rows: Mask) -> Poses:
        """Return the measurements that a mask selects, (k,)."""
        turned = None if self.rotation is None else self.rotation[rows]
        return Poses(self.joints[rows], self.position[rows], turned)


@dataclass
class Instrument:
    """Parameters beside the machine's geometry: joint map, and pose and target of the instrument."""

    map: JointMap
    frame: Rotation = field(default_factory=lambda: rotations().identity())
    place: Array = field(default_factory=lambda: np.zeros(3))
    target: Array = field(default_factory=lambda: np.zeros(3))
    own: dict[str, float] = field(default_factory=dict)
    """Numbers of single measurements, such as a plane's height, by name."""

    def compute_reading(self, position: Array, rotation: Array) -> tuple[Array, Array]:
        """Compute the positions and rotations that the instrument reads, in its own frame."""
        turn = self.frame.as_matrix()
        return self.place + (position + rotation @ self.target) @ turn.T, turn @ rotation


@dataclass
class State:
    """The machine with its current parameter values, at the measured poses.

    ``machine``: alone among its variants. ``platform``: positions (k, 3) and rotations (k, 3, 3) of
    its reference point.
    """

    machine: Variants
    q: Array
    platform: tuple[Array, Array]
    instrument: Instrument

    @property
    def numbers(self) -> dict[str, float]:
        """Current values of the file's numbers, by path."""
        return dict(zip(self.machine.paths, self.machine.values[0].tolist(), strict=False))


def make_state(robot: Robot, joints: Array, paths: Sequence[str]) -> State:
    """Return the state of the robot as it is, with an instrument at its base.

    :param joints: of the measurements, in the controller's numbers, (k, n).
    :raises UnreachableError: a joint state without an assembly, by limb, sample and miss.
    """
    own = robot.controller
    q = own.positions(joints)
    # A ratio's change over the travel is taken about the middle of the poses' travel.
    middle = np.round(0.5 * (q.max(0) + q.min(0)), 3)
    centred = replace(own, centres=np.where(own.changes == 0.0, middle, own.centres))
    machine, q = Variants(robot, {path: robot.number(path) for path in paths}), centred.positions(joints)
    return State(machine, q, robot.platform(q), Instrument(centred))


def place_frame(state: State, position: Array) -> None:
    """Set the instrument's frame to the rigid motion that best fits measured positions."""
    tool, model = state.instrument, state.platform[0]
    centres = position.mean(0), model.mean(0)
    tool.frame, _ = rotations().align_vectors(position - centres[0], model - centres[1])
    tool.place = centres[0] - tool.frame.apply(centres[1])


def update_state(robot: Robot, state: State, joints: Array, values: Mapping[str, float], turn: Array) -> State:
    """Return the state with new parameter values.

    :param joints: of the measurements, in the controller's numbers, (k, n).
    :param values: of all that is fitted, by name.
    :param turn: of the instrument's frame since ``state``, a rotation vector, shape (3,), rad.
    :raises ParameterError: numbers that no file may have, or no machine can be assembled with.
    """
    tool, old = state.instrument, robot.controller
    offsets, ratios, changes = old.offsets.copy(), np.abs(old.factors), old.changes.copy()
    for i, joint in enumerate(robot.joint_names):
        path = f"joint_map.{joint}"
        offsets[i] = values.get(f"{path}.offset", offsets[i])
        ratios[i] = values.get(f"{path}.ratio", ratios[i] * values.get(SHARED, 1.0))
        changes[i] = values.get(f"{path}.ratio_change", changes[i])
    if not (ratios > 0.0).all():
        raise ParameterError("joint_map", float(ratios.min()), "ratios above 0")
    new = Instrument(
        replace(tool.map, offsets=offsets, factors=np.sign(old.factors) * ratios, changes=changes),
        rotations().from_rotvec(turn) * tool.frame,
        np.array([values.get(n, v) for n, v in zip(FRAME[:3], tool.place, strict=True)]),
        np.array([values.get(n, v) for n, v in zip(TARGET, tool.target, strict=True)]),
        {name: values.get(name, value) for name, value in tool.own.items()},
    )
    machine, q = state.machine, new.map.positions(joints)
    if machine.paths:
        now = state.numbers
        row = [values.get(path, now[path]) for path in machine.paths]
        machine = machine.with_values(np.array([row]))
    position, rotation = machine.platform(q[None])
    if not np.isfinite(position).all():
        raise ParameterError("geometry", None, "numbers with which the machine can be assembled")
    return State(machine, q, (position[0], rotation[0]), new)


def differentiate_poses(robot: Robot, state: State, names: Sequence[str]) -> Array:
    """Differentiate the positions and rotations that the instrument sees by parameters, (k, 6, p).

    The derivatives by numbers of single measurements are zero.
    """
    tool, machine, own = state.instrument, state.machine, state.instrument.map
    position, rotation = state.platform
    by_joints = machine.platform_jacobian(state.q[None])[0]
    # Differentiate joint positions by the joint map's numbers; the controller's positions are constant.
    away, slope = state.q - own.centres, own.slopes(state.q)
    wound = state.q + 0.5 * own.changes * away**2
    rates = {
        "offset": -1.0 / slope,
        "ratio": -np.sign(own.factors) * wound / slope,
        "ratio_change": -0.5 * own.factors * away**2 / slope,
    }
    by_name = {SHARED: np.sum(by_joints * (-own.factors * wound / slope)[:, None, :], -1)}
    by_name |= {
        f"joint_map.{joint}.{name}": by_joints[..., i] * rate[:, i, None]
        for i, joint in enumerate(robot.joint_names)
        for name, rate in rates.items()
    }
    if any(name in machine.paths for name in names):
        slopes = np.moveaxis(machine.differentiate_platform(state.q), -1, 0)
        by_name |= dict(zip(machine.paths, slopes, strict=True))
    turn = tool.frame.as_matrix()
    lever = rotation @ tool.target
    out = np.zeros((len(state.q), 6, len(names)))
    for k, name in enumerate(names):
        if name in FRAME:
            axis = np.eye(3)[FRAME.index(name) % 3]
            if name in FRAME[:3]:
                out[:, :3, k] = axis
            else:
                out[:, :3, k] = np.cross(axis, (position + lever) @ turn.T)
                out[:, 3:, k] = axis
        elif name in TARGET:
            out[:, :3, k] = rotation[..., TARGET.index(name)] @ turn.T
        elif name in by_name:
            linear, angular = by_name[name][:, :3], by_name[name][:, 3:]
            shifted = linear - (skew(lever) @ angular[..., None])[..., 0]
            out[:, :3, k], out[:, 3:, k] = shifted @ turn.T, angular @ turn.T
    return out


MAX_LINE_POSES: Final = 24
"""Largest number of poses between which distances and angles are taken."""


class LineSlopes(NamedTuple):
    """Derivatives of distances and angles between poses by parameters.

    Distances of two poses, over their length, (d, p); angles at one pose between the lines to two
    others, rad, (a, p).
    """

    distances: Array
    angles: Array

    @property
    def scale(self) -> Array:
        """Derivatives of the uniform scale error, the mean relative change of all distances, (p,)."""
        return np.asarray(self.distances.mean(0), np.float64)

    def deviations(self, covariance: Array) -> tuple[float, float]:
        """Return the standard deviations of a distance, over its length, and an angle, rad.

        Root mean square over all lines, so that shear and distortion count, not only the scale.
        """
        variances = (np.sum((rows @ covariance) * rows, -1) for rows in self)
        distance, angle = (float(np.sqrt(max(one.mean(), 0.0))) if one.size else np.nan for one in variances)
        return distance, angle


def differentiate_lines(robot: Robot, state: State, names: Sequence[str]) -> LineSlopes | None:
    """Differentiate the distances of poses and the angles between these lines.

    Lines shorter than 0.3 of the longest, and angles within 30 degrees of 0 or pi, are left out.

    :returns: None if the platform does not move.
    """
    some = np.unique(np.linspace(0, len(state.q) - 1, MAX_LINE_POSES).astype(int))
    position = state.instrument.compute_reading(*state.platform)[0][some]
    columns = differentiate_poses(
        robot, replace(state, q=state.q[some], platform=(state.platform[0][some], state.platform[1][some])), names
    )[:, :3]
    ways = position[:, None] - position
    lengths = np.linalg.norm(ways, axis=-1)
    far = lengths > max(0.3 * float(lengths.max(initial=0.0)), 1e-6)
    if not far.any():
        return None
    first, second = np.nonzero(np.triu(far))
    units = ways / np.where(far, lengths, 1.0)[..., None]
    rates = (columns[:, None] - columns) / np.where(far, lengths, 1.0)[..., None, None]
    distances = np.einsum("ma,map->mp", units[first, second], rates[first, second])
    corners = [(k, i, j) for k in range(len(some)) for i, j in combinations(np.flatnonzero(far[k]), 2)]
    k, i, j = np.array(corners, np.intp).reshape(-1, 3).T
    cosine = np.sum(units[k, i] * units[k, j], -1)
    wide = np.sqrt(np.maximum(1.0 - cosine**2, 0.0)) > 0.5
    k, i, j, cosine = k[wide], i[wide], j[wide], cosine[wide, None]
    sine = np.sqrt(1.0 - cosine**2)
    angles = sum(
        -np.einsum("ma,map->mp", (units[k, to] - cosine * units[k, by]) / sine, rates[k, by])
        for by, to in ((i, j), (j, i))
    )
    return LineSlopes(np.asarray(distances, np.float64), np.asarray(angles, np.float64))


SHARED: Final = "joint_map.*.ratio"
RATIO_DEVIATION: Final = 0.05
"""Prior standard deviation of a ratio, as a fraction of it, and of its change over the travel."""


class Transmission(StrEnum):
    """Which ratios are fitted."""

    AUTO = "auto"
    EACH = "each"
    SHARED = "shared"
    TRAVEL = "travel"
    FILE = "file"


@dataclass(frozen=True)
class Parameter:
    """One number that is fitted, in its unit, with standard deviations before and after."""

    name: str
    unit: str
    before: float
    prior: float
    value: float = np.nan
    deviation: float = np.nan
    scaled: bool = False
    """True if an unmeasured scale causes most of its uncertainty."""

    @property
    def observed(self) -> bool:
        """True if the poses determine it: its deviation is below half of the prior's."""
        return self.deviation < OBSERVED_RATIO * self.prior and not self.scaled


def list_map_units(robot: Robot, joint: int) -> dict[str, str]:
    """Return the units of a joint's offset, ratio and change of the ratio in the joint map."""
    own, model = robot.controller, robot.joint_units[joint]
    plain = abs(own.factors[joint]) == 1.0
    # A sensor that is scaled and whose unit has no name counts in the controller's units.
    unit = own.units[joint] or (model if plain else "controller units")
    ratio = f"{unit} per {model}" if " " in unit else f"{unit}/{model}"
    return {"offset": unit, "ratio": ratio, "ratio_change": f"1/{model}"}


def list_map_parameters(
    robot: Robot, q: Array, how: Transmission, offsets: bool, prior: float, angle: float
) -> list[Parameter]:
    """List the parameters of the joint map that are fitted.

    :param q: the poses' joints, (k, n). ``prior``, ``angle``: standard deviations of lengths, m,
        and angles, rad.
    :raises ParameterError: no joint's transmission can be fitted in this way.
    """
    own, found = robot.controller, []
    scaled = np.abs(own.factors) != 1.0
    sliding = np.array([unit == "m" for unit in robot.joint_units])
    if how is Transmission.FILE:
        fitted = np.zeros_like(scaled)
    else:
        fitted = scaled & sliding if how is Transmission.AUTO else np.ones_like(scaled)
    farthest = np.abs(q).max(0)
    travel = np.maximum(np.ptp(q, axis=0), 1e-9)
    for i, joint in enumerate(robot.joint_names):
        path, units, ratio = f"joint_map.{joint}", list_map_units(robot, i), float(abs(own.factors[i]))
        # The offset is the reading at zero, so an error of the ratio changes it with the distance.
        size = prior if sliding[i] else angle
        size = float(np.hypot(size, RATIO_DEVIATION * farthest[i] if fitted[i] else 0.0))
        if offsets:
            found.append(Parameter(f"{path}.offset", units["offset"], float(own.offsets[i]), size * ratio))
        if fitted[i] and how is not Transmission.SHARED:
            found.append(Parameter(f"{path}.ratio", units["ratio"], ratio, RATIO_DEVIATION * ratio))
        if how is Transmission.TRAVEL:
            change, deviation = float(own.changes[i]), 2.0 * RATIO_DEVIATION / float(travel[i])
            found.append(Parameter(f"{path}.ratio_change", units["ratio_change"], change, deviation))
    if how is Transmission.SHARED:
        found.append(Parameter(SHARED, "", 1.0, RATIO_DEVIATION))
    return found


def list_map_values(
    robot: Robot, own: JointMap, values: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float, str]]:
    """Return value, standard deviation and unit of a fitted joint map by path in the file.

    :param values: of what was fitted of the map, value and deviation by the names above.
    """
    found = {}
    for i, joint in enumerate(robot.joint_names):
        path, units = f"joint_map.{joint}", list_map_units(robot, i)
        for name, its in units.items():
            if f"{path}.{name}" in values:
                found[f"{path}.{name}"] = (*values[f"{path}.{name}"], its)
        if SHARED in values:
            ratio = float(abs(robot.controller.factors[i]))
            factor, deviation = values[SHARED]
            found[f"{path}.ratio"] = (ratio * factor, ratio * deviation, units["ratio"])
        if f"{path}.ratio_change" in values:
            found[f"{path}.ratio_at"] = (float(own.centres[i]), 0.0, robot.joint_units[i])
    return found
