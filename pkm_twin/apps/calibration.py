# SPDX-License-Identifier: Apache-2.0
"""Geometry from measured platform poses: weighted least squares with the file as prior.

Gauss and Newton's method on the machine itself: every step loads the machine with the new numbers
and takes the exact derivatives of its platform (:mod:`pkm_twin.kinematics.sensitivity`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.sensitivity import GraphChange, platform_change
from pkm_twin.machine.entries import changed_graph, entries, with_entries
from pkm_twin.machine.robot import Robot
from pkm_twin.machine.rotations import skew

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

Array = NDArray[np.float64]

STEP: Final = 1e-6
"""Of a difference quotient of the graph at home: what is linear in it is exact to rounding."""
MOVES: Final = 1e-6
"""A number that moves the platform less than this, per unit, is no number of the geometry."""
KNOWN: Final = 0.5
"""A parameter whose deviation stays above this part of its prior one was not observed."""
HELD_OUT: Final = 4
"""Every so many poses one is held out."""
SHOWN: Final = 0.1
"""Part of the greatest weight below which a number is not named in a combination."""
STEPS: Final = 12
CONVERGED: Final = 1e-3
"""Part of its deviation by which no parameter moves in the last step."""
FRAME: Final = tuple(f"frame.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))
TARGET: Final = ("target.x", "target.y", "target.z")
NOT_GEOMETRY: Final = ("limits.", "gravity", "payload.", "joint_map.")


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

    def part(self, rows: NDArray[np.bool_]) -> Poses:
        """Some of them."""
        turned = None if self.rotation is None else self.rotation[rows]
        return Poses(self.joints[rows], self.position[rows], turned)


@dataclass(frozen=True)
class Parameter:
    """One number that is fitted, in its unit, with standard deviations before and after."""

    name: str
    unit: str
    before: float
    prior: float
    value: float = np.nan
    deviation: float = np.nan

    @property
    def observed(self) -> bool:
        """Whether the poses tell it: they, not the prior, make its deviation."""
        return self.deviation < KNOWN * self.prior


@dataclass(frozen=True)
class Errors:
    """Of poses: root mean square and greatest distance, m, and angle, rad (None: not measured)."""

    rms: float
    worst: float
    rms_angle: float | None = None
    worst_angle: float | None = None


@dataclass(frozen=True)
class Calibration:
    """A calibrated robot and how sure it is."""

    robot: Robot
    parameters: tuple[Parameter, ...]
    covariance: Array
    condition: float
    """Of the poses' equations in units of the prior deviations, over what was observed."""
    noise: float
    noise_angle: float | None
    """Standard deviations of the measurement that the fit leaves, m an axis and rad an axis."""
    fitted: tuple[Errors, Errors]
    held_out: tuple[Errors, Errors]
    """Before (frame and target of the measurement alone are fitted) and after."""
    steps: int

    @property
    def unobserved(self) -> tuple[dict[str, float], ...]:
        """Combinations of numbers that the poses do not tell: weights in units of the priors.

        What the file says stays along them; a number that is not observed may be in one whose
        other combinations are.
        """
        prior = np.array([p.prior for p in self.parameters])
        values, vectors = np.linalg.eigh(self.covariance / np.outer(prior, prior))
        found = []
        for column in vectors[:, values > KNOWN**2].T:
            vector = column * np.sign(column[np.argmax(np.abs(column))])
            shown = np.abs(vector) > SHOWN * np.abs(vector).max()
            found.append(
                {
                    p.name: float(w)
                    for p, w, s in zip(self.parameters, vector, shown, strict=True)
                    if s
                }
            )
        return tuple(found)


@dataclass
class _State:
    """The machine with numbers as they are now."""

    robot: Robot
    offsets: Array
    frame: Rotation = field(default_factory=lambda: rotations().identity())
    place: Array = field(default_factory=lambda: np.zeros(3))
    target: Array = field(default_factory=lambda: np.zeros(3))

    def joints(self, poses: Poses) -> Array:
        return self.robot.controller.positions(poses.joints - self.offsets)

    def predicted(self, poses: Poses) -> tuple[Array, Array]:
        """What the instrument should see: positions and rotations in its own frame."""
        position, rotation = self.robot.platform(self.joints(poses))
        turn = self.frame.as_matrix()
        return self.place + (position + rotation @ self.target) @ turn.T, turn @ rotation

    def residuals(self, poses: Poses) -> tuple[Array, Array | None]:
        """Measured less predicted: (k, 3), m, and rotation vectors (k, 3), rad."""
        position, rotation = self.predicted(poses)
        if poses.rotation is None:
            return poses.position - position, None
        apart = rotations().from_matrix(poses.rotation @ np.swapaxes(rotation, -1, -2))
        return poses.position - position, apart.as_rotvec()

    def errors(self, poses: Poses) -> Errors:
        linear, angular = self.residuals(poses)
        sizes = [np.linalg.norm(part, axis=1) for part in (linear, angular) if part is not None]
        pairs = [(float(np.sqrt(np.mean(size**2))), float(size.max())) for size in sizes]
        values = [value for pair in pairs for value in pair]
        return Errors(*values)


def geometric(robot: Robot, q: Array, only: Sequence[str] = ()) -> tuple[str, ...]:
    """Numbers of the robot's file that move its platform at joint states (k, n).

    :param only: paths, or their beginnings, to choose from.
    :raises ParameterError: a beginning that no number of the geometry has.
    """
    found = []
    for path, (value, _) in entries(robot).items():
        if path.startswith(NOT_GEOMETRY) or (only and not path.startswith(tuple(only))):
            continue
        try:
            change = _change(robot, path, value)
        except ParameterError:
            continue  # a machine that closes only with this very number
        if change.nothing(1e-9):
            continue
        if np.abs(platform_change(robot, q, [change])).max() > MOVES:
            found.append(path)
    for beginning in only:
        if not any(path.startswith(beginning) for path in found):
            raise ParameterError("--only", beginning, "the beginning of a geometric number's path")
    return tuple(found)


def _change(robot: Robot, path: str, value: float) -> GraphChange:
    low, high = (changed_graph(robot, path, value + sign * STEP) for sign in (-1.0, 1.0))
    return GraphChange.between(low, high, 2.0 * STEP)


def calibrate(
    robot: Robot,
    poses: Poses,
    paths: Sequence[str],
    *,
    offsets: bool = True,
    frame: bool = False,
    target: bool = False,
    prior: float = 0.01,
    progress: Callable[[int], None] = lambda _: None,
) -> Calibration:
    """Fit geometry, joint offsets and the instrument's frame and target to measured poses.

    :param paths: numbers of the robot's file, of :func:`geometric`.
    :param prior: standard deviation that lengths have without the poses, m; angles have it at the
        platform's radius.
    :raises ParameterError: too few poses, or a fit that does not settle.
    """
    known = entries(robot)
    angle = prior / robot.size
    # A joint's value at home and its sensor's offset are one number.
    homes = {f"joints.{name}.home" for name in robot.joint_names} if offsets else set()
    fitted = [path for path in paths if path not in homes]
    parameters = [
        Parameter(path, known[path][1], known[path][0], prior if known[path][1] == "m" else angle)
        for path in fitted
    ]
    factors = robot.controller.factors
    if offsets:
        for joint, unit, factor, old in zip(
            robot.joint_names, robot.joint_units, factors, robot.controller.offsets, strict=True
        ):
            size = (prior if unit == "m" else angle) * abs(factor)
            parameters.append(Parameter(f"joint_map.{joint}.offset", unit, float(old), float(size)))
    # Where the instrument stands is not known at all.
    far = 100.0 * robot.engine.tree.size
    extra = [*(FRAME if frame else ()), *(TARGET if target else ())]
    parameters += [
        Parameter(name, "rad" if name[-2] == "r" else "m", 0.0, 10.0 if name[-2] == "r" else far)
        for name in extra
    ]
    held = np.arange(len(poses.joints)) % HELD_OUT == HELD_OUT - 1
    learnt, judged = poses.part(~held), poses.part(held)
    equations = learnt.position.size * (1 if poses.rotation is None else 2)
    if equations < len(parameters) + 6 or not held.any():
        raise ParameterError(
            "poses", len(poses.joints), f"enough for {len(parameters)} numbers to be fitted"
        )
    instrument = [p for p in parameters if p.name in extra]
    start = _State(robot, np.zeros(robot.joints_count))
    if frame:
        _place_frame(start, learnt)
    before = _fit(start, learnt, instrument, progress)[0] if instrument else start
    after, values, covariance, information, noise, steps = _fit(
        before, learnt, parameters, progress
    )
    deviations = np.sqrt(np.diag(covariance))
    told = [
        Parameter(p.name, p.unit, p.before, p.prior, float(v), float(d))
        for p, v, d in zip(parameters, values, deviations, strict=True)
    ]
    good = np.array([p.observed for p in told])
    singular = np.linalg.svd(information[:, good], compute_uv=False) if good.any() else np.ones(1)
    fitted_errors, held_errors = (
        (before.errors(part), after.errors(part)) for part in (learnt, judged)
    )
    return Calibration(
        after.robot, tuple(told), covariance, float(singular[0] / singular[-1]), noise[0],
        noise[1], fitted_errors, held_errors, steps,
    )  # fmt: skip


def _place_frame(state: _State, poses: Poses) -> None:
    """A first guess of the instrument's frame: the best rigid motion between the point clouds."""
    model = state.predicted(poses)[0]
    centres = poses.position.mean(0), model.mean(0)
    state.frame, _ = rotations().align_vectors(poses.position - centres[0], model - centres[1])
    state.place = centres[0] - state.frame.apply(centres[1])


def _fit(
    start: _State, poses: Poses, parameters: Sequence[Parameter], progress: Callable[[int], None]
) -> tuple[_State, Array, Array, Array, tuple[float, float | None], int]:
    """Least squares over all parameters, the noise found with them."""
    state = start
    values = np.array([_value(start, p) for p in parameters])
    centre = np.array([p.before for p in parameters])
    prior = np.array([p.prior for p in parameters])
    noise: tuple[float, float | None] = (0.0, None)
    steps = 0
    while True:
        steps += 1
        progress(1)
        residual, table, noise = _weighted(state, poses, parameters)
        left = np.vstack([table, np.diag(1.0 / prior)])
        right = np.concatenate([residual, (centre - values) / prior])
        move, *_ = np.linalg.lstsq(left, right, rcond=None)
        covariance = np.linalg.inv(left.T @ left)
        state = _moved(start, state, parameters, values + move, move)
        values = values + move
        if np.all(np.abs(move) < CONVERGED * np.sqrt(np.diag(covariance))):
            break
        if steps == STEPS:
            raise ParameterError("poses", f"{STEPS} steps", "poses to which a fit settles")
    return state, values, covariance, table * prior, noise, steps


def _weighted(
    state: _State, poses: Poses, parameters: Sequence[Parameter]
) -> tuple[Array, Array, tuple[float, float | None]]:
    """Residuals and derivatives over the noise that the residuals tell."""
    linear, angular = state.residuals(poses)
    count = max(1, linear.size - len(parameters) // (1 if angular is None else 2))
    sigma = max(float(np.sqrt((linear**2).sum() / count)), 1e-12)
    columns = _derivatives(state, poses, parameters)
    residual = linear.ravel() / sigma
    table = columns[:, :3].reshape(-1, len(parameters)) / sigma
    if angular is None:
        return residual, table, (sigma, None)
    turn = max(float(np.sqrt((angular**2).sum() / count)), 1e-12)
    residual = np.concatenate([residual, angular.ravel() / turn])
    table = np.vstack([table, columns[:, 3:].reshape(-1, len(parameters)) / turn])
    return residual, table, (sigma, turn)


def _derivatives(state: _State, poses: Poses, parameters: Sequence[Parameter]) -> Array:
    """Of predicted positions and rotations by the parameters, shape (k, 6, parameters)."""
    robot, q = state.robot, state.joints(poses)
    known = entries(robot)
    position, rotation = robot.platform(q)
    paths = [p.name for p in parameters if p.name in known and not p.name.startswith("joint_map.")]
    changes = [_change(robot, path, known[path][0]) for path in paths]
    moved: dict[str, Array] = {}
    if paths:
        found = np.moveaxis(platform_change(robot, q, changes), -1, 0)
        moved = dict(zip(paths, found, strict=True))
    twist = robot.platform_jacobian(q) / -robot.controller.factors
    for k, joint in enumerate(robot.joint_names):
        moved[f"joint_map.{joint}.offset"] = twist[..., k]
    turn = state.frame.as_matrix()
    lever = rotation @ state.target
    out = np.zeros((len(q), 6, len(parameters)))
    for k, p in enumerate(parameters):
        if p.name in FRAME:
            axis = np.eye(3)[FRAME.index(p.name) % 3]
            if p.name in FRAME[:3]:
                out[:, :3, k] = axis
            else:
                out[:, :3, k] = np.cross(axis, (position + lever) @ turn.T)
                out[:, 3:, k] = axis
        elif p.name in TARGET:
            out[:, :3, k] = rotation[..., TARGET.index(p.name)] @ turn.T
        else:
            linear, angular = moved[p.name][:, :3], moved[p.name][:, 3:]
            shifted = linear - (skew(lever) @ angular[..., None])[..., 0]
            out[:, :3, k], out[:, 3:, k] = shifted @ turn.T, angular @ turn.T
    return out


def _value(state: _State, parameter: Parameter) -> float:
    name = parameter.name
    if name in FRAME[:3]:
        return float(state.place[FRAME.index(name)])
    if name in TARGET:
        return float(state.target[TARGET.index(name)])
    return parameter.before


def _moved(
    start: _State, state: _State, parameters: Sequence[Parameter], values: Array, move: Array
) -> _State:
    """The machine with the new numbers."""
    by_name = {p.name: float(v) for p, v in zip(parameters, values, strict=True)}
    steps = {p.name: float(v) for p, v in zip(parameters, move, strict=True)}
    joints = start.robot.joint_names
    paths = {
        name: value
        for name, value in by_name.items()
        if name not in (*FRAME, *TARGET) and not name.startswith("joint_map.")
    }
    old = start.robot.controller.offsets
    offsets = np.array(
        [by_name.get(f"joint_map.{j}.offset", o) - o for j, o in zip(joints, old, strict=True)]
    )
    turn = rotations().from_rotvec([steps.get(name, 0.0) for name in FRAME[3:]])
    return _State(
        with_entries(start.robot, paths) if paths else start.robot,
        offsets,
        turn * state.frame,
        np.array([by_name.get(n, v) for n, v in zip(FRAME[:3], state.place, strict=True)]),
        np.array([by_name.get(n, v) for n, v in zip(TARGET, state.target, strict=True)]),
    )
