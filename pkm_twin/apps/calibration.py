# SPDX-License-Identifier: Apache-2.0
"""Geometry from measured platform poses: weighted least squares with the file as prior.

Gauss and Newton's method on the machine itself, damped where it has to be: every step assembles its
graph with the new numbers (:mod:`pkm_twin.kinematics.maximal`, nothing is compiled) and takes the
exact derivatives of its platform (:mod:`pkm_twin.kinematics.sensitivity`). The errors before and
after are those of the loaded robots.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.apps.calibration_state import (
    BESIDE,
    FRAME,
    TARGET,
    Errors,
    Poses,
    State,
    change_of,
    moved,
    place_frame,
    start_of,
    value_of,
)
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.maximal import GraphChange, Placement
from pkm_twin.kinematics.sensitivity import platform_twists
from pkm_twin.machine.entries import data_of, entries
from pkm_twin.machine.robot import Robot
from pkm_twin.machine.rotations import skew

Array = NDArray[np.float64]
Noise = tuple[float, float | None]
"""Standard deviations: m an axis, and rad an axis where rotations were measured."""

MOVES: Final = 1e-6
"""A number that moves the platform less than this, per unit, is no number of the geometry."""
KNOWN: Final = 0.5
"""A parameter whose deviation stays above this part of its prior one was not observed."""
HELD_OUT: Final = 4
"""Every so many poses one is held out."""
SAME: Final = 1e-4
"""Difference of joints that makes another pose, rad or m."""
SHOWN: Final = 0.1
"""Part of the greatest weight below which a number is not named in a combination."""
STEPS: Final = 60
WRONG: Final = 0.02
"""Part of the machine's size that no fit may leave over: such poses are not its own."""
TWISTED: Final = 0.05
"""Angle an axis that no fit may leave over, rad: those are other angles, or other units."""
FINEST: Final = 1e-9
"""Noise that no instrument is below, m or rad."""
POOR: Final = 0.25
GOOD: Final = 0.75
"""Parts of what a linear machine would gain: below the one steps are damped more, above less."""
TRIALS: Final = 8
"""Dampings of a step that are tried."""
CONVERGED: Final = 1e-3
"""Part of its deviation by which no parameter moves in the last step."""
NOT_GEOMETRY: Final = ("limits.", "gravity", "payload.", "joint_map.")


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


def geometric(robot: Robot, q: Array, only: Sequence[str] = ()) -> tuple[str, ...]:
    """Numbers of the robot's file that move its platform at joint states (k, n).

    A number that cannot change alone, because the machine would not assemble, is none.

    :param only: paths, or their beginnings, to choose from.
    :raises ParameterError: a beginning that no number of the geometry has.
    """
    data, changes = data_of(robot), {}
    for path in entries(robot):
        if path.startswith(NOT_GEOMETRY) or (only and not path.startswith(tuple(only))):
            continue
        try:
            change = change_of(robot, data, path)
        except ParameterError:
            continue  # a machine that closes only with this very number
        if not change.nothing(1e-9):
            changes[path] = change
    found: list[str] = []
    if changes:
        near = Placement.of(robot, q)
        twists, possible = platform_twists(robot.graph, q, near, list(changes.values()))
        good = possible & (np.abs(twists).max((0, 1)) > MOVES)
        found = [path for path, one in zip(changes, good, strict=True) if one]
    for beginning in only:
        if not any(path.startswith(beginning) for path in found):
            raise ParameterError("--only", beginning, "the beginning of a geometric number's path")
    return tuple(found)


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
    :raises ParameterError: too few poses, poses of another machine or unit, poses that tell no
        number, or a fit that does not settle.
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
    # A pose that is measured again tells no more numbers.
    different = len(np.unique(np.round(learnt.joints / SAME), axis=0))
    equations = different * (3 if poses.rotation is None else 6)
    if equations < len(parameters) + 6 or not held.any():
        raise ParameterError(
            "poses", f"{different} different ones to learn from",
            f"enough for {len(parameters)} numbers to be fitted",
        )  # fmt: skip
    instrument = [p for p in parameters if p.name in extra]
    start = start_of(robot, learnt)
    if frame:
        place_frame(start, learnt)
    before = _fit(robot, start, learnt, instrument, progress)[0] if instrument else start
    after, values, covariance, information, noise, steps = _fit(
        robot, before, learnt, parameters, progress
    )
    most = max(prior, WRONG * robot.engine.tree.size)
    if noise[0] > most:
        raise ParameterError(
            "poses", f"{noise[0]:.3g} m an axis left over", "poses of this machine, m and rad, its "
            f"own joints beside them: at most {most:.3g} m",
        )  # fmt: skip
    steepest = max(prior / robot.engine.tree.size, TWISTED)
    if noise[1] is not None and noise[1] > steepest:
        raise ParameterError(
            "poses", f"{noise[1]:.3g} rad an axis left over", "rotations of this machine from its "
            f"home, rad, in the order and axes of the columns: at most {steepest:.3g} rad",
        )  # fmt: skip
    built = type(robot).from_data(after.data, robot.name)
    deviations = np.sqrt(np.diag(covariance))
    told = [
        Parameter(p.name, p.unit, p.before, p.prior, float(v), float(d))
        for p, v, d in zip(parameters, values, deviations, strict=True)
    ]
    good = np.array([p.observed for p in told])
    if not good.any():
        raise ParameterError(
            "poses", len(poses.joints), "poses apart from each other: these tell no number"
        )
    singular = np.linalg.svd(information[:, good], compute_uv=False)
    fitted_errors, held_errors = (
        (before.instrument.errors(robot, part), after.instrument.errors(built, part))
        for part in (learnt, judged)
    )
    return Calibration(
        built, tuple(told), covariance, float(singular[0] / singular[-1]), noise[0],
        noise[1], fitted_errors, held_errors, steps,
    )  # fmt: skip


def _fit(
    robot: Robot, start: State, poses: Poses, parameters: Sequence[Parameter],
    progress: Callable[[int], None],
) -> tuple[State, Array, Array, Array, Noise, int]:  # fmt: skip
    """Least squares over all parameters, the noise found with them."""
    state = start
    values = np.array([value_of(start, p.name, p.before) for p in parameters])
    centre = np.array([p.before for p in parameters])
    prior = np.array([p.prior for p in parameters])

    def right(state: State, values: Array, noise: Noise) -> Array:
        return np.concatenate([_over(state.residuals(poses), noise), (centre - values) / prior])

    damping = 0.0
    for steps in range(1, STEPS + 1):
        progress(1)
        noise = _noise(state, poses, len(parameters))
        columns = _derivatives(robot, state, parameters)
        angular = None if poses.rotation is None else columns[:, 3:]
        table = _over((columns[:, :3], angular), noise).reshape(-1, len(parameters))
        left, before = np.vstack([table, np.diag(1.0 / prior)]), right(state, values, noise)
        # In units of the prior no singular value is below one.
        _, sizes, axes = np.linalg.svd(left * prior, full_matrices=False)
        spread = prior[:, None] * axes.T / sizes
        covariance = spread @ spread.T
        for _ in range(TRIALS):
            move = _move(left, before, np.sqrt(damping) / prior)
            trial = _stepped(robot, state, poses, parameters, values, move)
            settled = bool(np.all(np.abs(move) < CONVERGED * np.sqrt(np.diag(covariance))))
            sums = [
                float(row @ row)
                for row in (before, before - left @ move, right(trial, values + move, noise))
            ]
            gained = (sums[0] - sums[2]) / max(sums[0] - sums[1], 1e-300)
            if settled or gained > POOR:
                break
            damping = max(10.0 * damping, 1.0)
        state, values = trial, values + move
        if settled:
            return state, values, covariance, table * prior, noise, steps
        if gained > GOOD:
            damping = 0.1 * damping if damping > 1.0 else 0.0
    raise ParameterError("poses", f"{STEPS} steps", "poses to which a fit settles")


def _move(left: Array, right: Array, damping: Array) -> Array:
    """A step of Gauss and Newton's method, damped where that is not zero (Levenberg, Marquardt).

    Along a direction that the poses tell badly the machine may turn away from its tangent: without
    damping a step then goes beyond, and back, for ever.
    """
    rows, end = (left, right)
    if damping.any():
        rows = np.vstack([left, np.diag(damping)])
        end = np.concatenate([right, np.zeros(len(damping))])
    return np.asarray(np.linalg.lstsq(rows, end, rcond=None)[0], np.float64)


def _stepped(
    robot: Robot, state: State, poses: Poses, parameters: Sequence[Parameter], values: Array,
    move: Array,
) -> State:  # fmt: skip
    names = [p.name for p in parameters]
    by = dict(zip(names, move.tolist(), strict=True))
    turn = np.array([by.get(name, 0.0) for name in FRAME[3:]])
    new = dict(zip(names, (values + move).tolist(), strict=True))
    return moved(robot, state, poses, new, turn)


def _noise(state: State, poses: Poses, parameters: int) -> Noise:
    """Standard deviations of positions and rotations that the residuals tell."""
    linear, angular = state.residuals(poses)
    count = max(1, linear.size - parameters // (1 if angular is None else 2))
    sizes = [
        max(float(np.sqrt((part**2).sum() / count)), FINEST)
        for part in (linear, angular)
        if part is not None
    ]
    return sizes[0], sizes[1] if len(sizes) > 1 else None


def _over(parts: tuple[Array, Array | None], noise: Noise) -> Array:
    """Rows of positions, then of rotations, in units of their noise, the poses' axes flat."""
    rows = [
        part.reshape(part.shape[0] * 3, *part.shape[2:]) / size
        for part, size in zip(parts, noise, strict=True)
        if part is not None and size is not None
    ]
    return np.concatenate(rows)


def _derivatives(robot: Robot, state: State, parameters: Sequence[Parameter]) -> Array:
    """Of predicted positions and rotations by the parameters, shape (k, 6, parameters)."""
    tool, joints = state.instrument, robot.joint_names
    position, rotation = state.platform
    paths = [p.name for p in parameters if not p.name.startswith(BESIDE)]
    changes = [change_of(robot, state.data, path) for path in paths]
    changes += [GraphChange.of_joint(state.graph, joint) for joint in joints]
    twists, _ = platform_twists(state.graph, state.q, state.placement, changes)
    twists[..., len(paths) :] /= -robot.controller.factors
    names = [*paths, *(f"joint_map.{joint}.offset" for joint in joints)]
    by_name = dict(zip(names, np.moveaxis(twists, -1, 0), strict=True))
    turn = tool.frame.as_matrix()
    lever = rotation @ tool.target
    out = np.zeros((len(state.q), 6, len(parameters)))
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
            linear, angular = by_name[p.name][:, :3], by_name[p.name][:, 3:]
            shifted = linear - (skew(lever) @ angular[..., None])[..., 0]
            out[:, :3, k], out[:, 3:, k] = shifted @ turn.T, angular @ turn.T
    return out
