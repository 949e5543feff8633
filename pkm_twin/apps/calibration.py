# SPDX-License-Identifier: Apache-2.0
"""Geometry from measured platform poses: weighted least squares with the file as prior.

Gauss and Newton's method on the machine itself, damped where it has to be: every step assembles its
graph with the new numbers (:mod:`pkm_twin.kinematics.maximal`, nothing is compiled) and takes the
exact derivatives of its platform (:mod:`pkm_twin.kinematics.sensitivity`). The errors before and
after are those of the loaded robots.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.apps.calibration_faults import (
    HALF,
    MOVED,
    Fault,
    Outlier,
    RejectedPosesError,
    cost_of,
    faults_of,
    looks_placed,
    outliers_of,
    place_fault,
)
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
from pkm_twin.apps.transmission import Transmission, by_map, numbers
from pkm_twin.errors import ParameterError, PkmTwinError, UnreachableError
from pkm_twin.identification.robust import Weighed, weighed
from pkm_twin.identification.undetermined import undetermined
from pkm_twin.kinematics.maximal import GraphChange, Placement
from pkm_twin.kinematics.sensitivity import platform_twists
from pkm_twin.machine.entries import data_of, entries
from pkm_twin.machine.joint_map import JointMap
from pkm_twin.machine.robot import Robot
from pkm_twin.machine.rotations import skew

Array = NDArray[np.float64]

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
WEIGHED: Final = 12
"""Steps after which noise and weights stay: else they and the fit may go round in circles."""
POOR: Final = 0.25
GOOD: Final = 0.75
"""Parts of what a linear machine would gain: below the one steps are damped more, above less."""
SLOW: Final = 0.02
"""Or so little in each of several steps, ``IDLE``: no number moves by its deviation any more."""
IDLE: Final = 3
LIGHT: Final = 0.01
"""The least damping, in squares of prior standard deviations."""
TRIALS: Final = 8
"""Dampings of a step that are tried."""
CONVERGED: Final = 1e-3
"""Part of its deviation by which no parameter moves in the last step."""
GAINED: Final = 1e-4
"""Or by which the sum of squares over the noise falls."""
LINEAR: Final = re.compile(r"\.(at|ends)\[|^origin\[|\.home$")
"""Numbers in which the graph of a machine's file is linear."""
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
    """Before (frame and target of the measurement alone are fitted) and after; no outliers."""
    steps: int
    outliers: tuple[Outlier, ...] = ()
    """Poses that do not fit the others, the worst first."""
    faults: tuple[Fault, ...] = ()
    """Why this machine was not in the poses, where they were accepted all the same."""
    cost: float = 0.0
    """Squares of the machine's changes over their prior standard deviations, summed."""
    placed: bool = False
    """Whether another place of the instrument may explain the poses better."""
    joint_map: JointMap = field(default_factory=lambda: JointMap.of((), {}))
    """With the fitted numbers."""

    @property
    def _unknown(self) -> Array:
        """Orthonormal directions, in units of the priors, that the poses do not tell, (p, u)."""
        prior = np.array([p.prior for p in self.parameters])
        values, vectors = np.linalg.eigh(self.covariance / np.outer(prior, prior))
        return np.asarray(vectors[:, values > KNOWN**2], np.float64)

    @property
    def undetermined(self) -> list[str]:
        """What the poses do not determine, at most ten sentences: the file's values stay."""
        names = [p.name for p in self.parameters]
        prior = np.array([p.prior for p in self.parameters])
        return undetermined(self.robot.graph, names, prior, self._unknown)

    @property
    def unobserved(self) -> tuple[dict[str, float], ...]:
        """Combinations of numbers that the poses do not tell: weights in units of the priors.

        What the file says stays along them; a number that is not observed may be in one whose
        other combinations are.
        """
        found = []
        for column in self._unknown.T:
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
    transmission: Transmission = Transmission.AUTO,
    accept: bool = False,
    progress: Callable[[int], None] = lambda _: None,
) -> Calibration:
    """Fit geometry, joint offsets and the instrument's frame and target to measured poses.

    Poses that do not fit the others hardly count, and are named.

    :param paths: numbers of the robot's file, of :func:`geometric`.
    :param prior: standard deviation that lengths have without the poses, m; angles have it at the
        platform's radius.
    :param transmission: which ratios of the joint map are fitted; ``auto``: those of sliding joints
        that have one.
    :param accept: calibrate with poses that this machine was not in, too.
    :raises ParameterError: too few poses, poses of another machine, unit or frame, poses that tell
        no number, or a fit that does not settle.
    """
    extra = [*(FRAME if frame else ()), *(TARGET if target else ())]
    q = robot.controller.positions(poses.joints)

    def listed(extra: Sequence[str]) -> list[Parameter]:
        return _parameters(robot, q, paths, offsets, transmission, extra, prior)

    parameters = listed(extra)

    def fitted(frame: bool, parameters: Sequence[Parameter]) -> tuple[Calibration, State]:
        return _calibrated(robot, poses, parameters, frame, prior, progress)

    def placed() -> tuple[Calibration, State] | None:
        """The same with the instrument's frame; None where that is no machine either."""
        if frame:
            return None
        try:
            other = fitted(True, listed([*FRAME, *extra]))
        except PkmTwinError:
            return None
        return None if other[0].faults else other

    try:
        result, _ = fitted(frame, parameters)
    except (_UnsettledError, UnreachableError) as error:
        other = placed()
        if other is None:
            raise
        raise RejectedPosesError(_place(other[1])) from error
    # Ratios that are a little off look like a shift of the instrument.
    saved = MOVED * (1 + sum(p.name.endswith(".ratio") for p in parameters))
    if result.faults or result.cost > saved or result.placed:
        other = placed()
        if other is not None and (
            result.faults
            or (result.cost - other[0].cost > saved and other[0].cost < HALF * result.cost)
            or other[0].noise < 0.5 * result.noise
        ):  # fmt: skip
            result = replace(result, faults=(_place(other[1]), *result.faults))
    if result.faults and not accept:
        raise RejectedPosesError(result.faults[0])
    return result


class _UnsettledError(ParameterError):
    """A fit that does not settle."""


def _place(state: State) -> Fault:
    tool = state.instrument
    return place_fault(tool.place, tool.frame.as_rotvec())


def _learnt(poses: Poses) -> NDArray[np.bool_]:
    """Which poses are learnt from."""
    return np.asarray(np.arange(len(poses.joints)) % HELD_OUT != HELD_OUT - 1)


def _parameters(
    robot: Robot, q: Array, paths: Sequence[str], offsets: bool, transmission: Transmission,
    extra: Sequence[str], prior: float,
) -> list[Parameter]:  # fmt: skip
    """What is fitted, as it is before."""
    known = entries(robot)
    angle = prior / robot.size
    # A joint's value at home and its sensor's offset are one number.
    homes = {f"joints.{name}.home" for name in robot.joint_names} if offsets else set()
    fitted = [path for path in paths if path not in homes]
    parameters = [
        Parameter(path, known[path][1], known[path][0], prior if known[path][1] == "m" else angle)
        for path in fitted
    ]
    mapped = numbers(robot, q, transmission, offsets, prior, angle)
    parameters += [Parameter(*number) for number in mapped]
    # Where the instrument stands is not known at all.
    far = 100.0 * robot.engine.tree.size
    return parameters + _placing(extra, far)


def _placing(names: Sequence[str], far: float) -> list[Parameter]:
    return [
        Parameter(name, "rad" if name[-2] == "r" else "m", 0.0, 10.0 if name[-2] == "r" else far)
        for name in names
    ]


def _looks_placed(
    robot: Robot, state: State, poses: Poses, noise: Weighed, table: Array,
    told: Sequence[Parameter],
) -> bool:  # fmt: skip
    parts = state.parts(poses)
    six = _placing(FRAME, 1.0)
    columns = _derivatives(robot, state, six)
    halves = [columns[:, :3], columns[:, 3:]][: len(parts)]
    asked = [(p.before - p.value) / p.prior for p in told]
    return looks_placed(table, noise.over(halves), np.append(noise.over(parts), asked))


def _calibrated(
    robot: Robot, poses: Poses, parameters: Sequence[Parameter], frame: bool, prior: float,
    progress: Callable[[int], None],
) -> tuple[Calibration, State]:  # fmt: skip
    """The fit with its faults, and the machine at the poses that are learnt from."""
    rows = _learnt(poses)
    learnt = poses.part(rows)
    # A pose that is measured again tells no more numbers.
    different = len(np.unique(np.round(learnt.joints / SAME), axis=0))
    equations = different * (3 if poses.rotation is None else 6)
    if equations < len(parameters) + 6 or rows.all():
        raise ParameterError(
            "poses", f"{different} different ones to learn from",
            f"enough for {len(parameters)} numbers to be fitted",
        )  # fmt: skip
    instrument = [p for p in parameters if p.name in (*FRAME, *TARGET)]
    start = start_of(robot, learnt)
    if frame:
        place_frame(start, learnt)
    before = _fit(robot, start, learnt, instrument, progress)[0] if instrument else start
    after, values, covariance, information, noise, steps = _fit(
        robot, before, learnt, parameters, progress
    )
    built = type(robot).from_data(after.data, robot.name)
    deviations = np.sqrt(np.diag(covariance))
    told = [
        Parameter(p.name, p.unit, p.before, p.prior, float(v), float(d))
        for p, v, d in zip(parameters, values, deviations, strict=True)
    ]
    outliers = outliers_of(after.instrument.parts(built, poses), noise.noise)
    sound = np.ones(len(rows), bool)
    sound[[one.index for one in outliers]] = False
    shown = [
        poses.part(which & sound if (which & sound).any() else which) for which in (rows, ~rows)
    ]
    fitted_errors, held_errors = (
        (before.instrument.errors(robot, part), after.instrument.errors(built, part))
        for part in shown
    )
    changes = [(p.name, p.unit, p.value - p.before, p.prior) for p in told]
    faults = faults_of(noise, outliers, len(rows), changes, prior, robot.engine.tree.size)
    good = np.array([p.observed for p in told])
    if not good.any() and not faults:
        raise ParameterError(
            "poses", len(poses.joints), "poses apart from each other: these tell no number"
        )
    singular = np.linalg.svd(information[:, good], compute_uv=False)
    condition = float(singular[0] / singular[-1]) if good.any() else np.inf
    result = Calibration(
        built, tuple(told), covariance, condition, noise.noise[0],
        noise.noise[1] if len(noise.noise) > 1 else None, fitted_errors, held_errors, steps,
        outliers, tuple(faults), cost_of(changes),
        not frame and _looks_placed(robot, after, learnt, noise, information, told),
        after.instrument.map,
    )  # fmt: skip
    return result, after


def _fit(
    robot: Robot, start: State, poses: Poses, parameters: Sequence[Parameter],
    progress: Callable[[int], None],
) -> tuple[State, Array, Array, Array, Weighed, int]:  # fmt: skip
    """Robust least squares over all parameters, the noise found with them.

    :raises ParameterError: it does not settle.
    """
    state = start
    values = np.array([value_of(start, p.name, p.before) for p in parameters])
    centre = np.array([p.before for p in parameters])
    prior = np.array([p.prior for p in parameters])

    def right(state: State, values: Array, noise: Weighed) -> Array:
        return np.concatenate([noise.over(state.parts(poses)), (centre - values) / prior])

    constant: dict[str, GraphChange] = {}
    # Errors of drives in metres are not those of drives in radians.
    alike = len(set(robot.joint_units)) == 1
    drives = [Parameter(f"joint_map.{j}.offset", "", 0.0, 1.0) for j in robot.joint_names if alike]
    damping, problem, settled, idle = 0.0, f"{STEPS} steps", False, 0
    # By the residuals of the instrument alone first: then the drives' part of them is known.
    for steps in range(1, STEPS + 1):
        progress(1)
        columns = _derivatives(robot, state, [*parameters, *drives], constant)
        if settled and drives:
            slopes = state.instrument.map.slopes(state.q)
            by_drives = columns[..., len(parameters) :] * slopes[:, None]
            noise = weighed(state.parts(poses), len(parameters), by_drives)
            drives = []
        elif steps <= WEIGHED and (drives or not alike):
            noise = weighed(state.parts(poses), len(parameters))
        last, settled = not drives, False
        columns = columns[..., : len(parameters)]
        halves = [columns[:, :3], columns[:, 3:]][: len(noise.noise)]
        table = noise.over(halves)
        left, before = np.vstack([table, np.diag(1.0 / prior)]), right(state, values, noise)
        # In units of the prior no singular value is below one.
        _, sizes, axes = np.linalg.svd(left * prior, full_matrices=False)
        spread = prior[:, None] * axes.T / sizes
        covariance = spread @ spread.T
        trial, gained = None, 0.0
        for _ in range(TRIALS):
            move = _move(left, before, np.sqrt(damping) / prior)
            small = bool(np.all(np.abs(move) < CONVERGED * np.sqrt(np.diag(covariance))))
            sums = [float(row @ row) for row in (before, before - left @ move)]
            settled = small or sums[0] - sums[1] < GAINED
            try:
                trial = _stepped(robot, state, poses, parameters, values, move)
            except PkmTwinError as error:
                # No machine has such numbers, or none of them is in these poses: a smaller step.
                problem = str(error)
            else:
                row = right(trial, values + move, noise)
                gained = (sums[0] - float(row @ row)) / max(sums[0] - sums[1], 1e-300)
                if settled or gained > POOR:
                    break
            damping = max(10.0 * damping, LIGHT)
        if trial is None:
            break
        state, values = trial, values + move
        idle = idle + 1 if gained * (sums[0] - sums[1]) < SLOW else 0
        settled = settled or idle >= IDLE
        idle = 0 if settled else idle
        if settled and last:
            return state, values, covariance, table * prior, noise, steps
        order = np.argsort(-np.abs(move) / np.sqrt(np.diag(covariance)))[:3]
        problem = f"{steps} steps, {', '.join(parameters[k].name for k in order)} still move"
        if gained > GOOD:
            damping = 0.1 * damping if damping > LIGHT else 0.0
    raise _UnsettledError(
        "poses", problem, "poses to which a fit settles: measure more, or fit less (--only)"
    )


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


def _derivatives(
    robot: Robot, state: State, parameters: Sequence[Parameter],
    constant: dict[str, GraphChange] | None = None,
) -> Array:  # fmt: skip
    """Of predicted positions and rotations by the parameters, shape (k, 6, parameters).

    :param constant: changes of the graph that stay the same in all steps; filled here.
    """
    tool, joints = state.instrument, robot.joint_names
    position, rotation = state.platform
    paths = [p.name for p in parameters if not p.name.startswith(BESIDE)]
    kept = {} if constant is None else constant
    changes = [kept.get(path) or change_of(robot, state.data, path) for path in paths]
    linear = not any("azimuth" in path for path in paths) and robot.mechanism == "machine"
    kept |= {p: c for p, c in zip(paths, changes, strict=True) if linear and LINEAR.search(p)}
    changes += [GraphChange.of_joint(state.graph, joint) for joint in joints]
    twists, _ = platform_twists(state.graph, state.q, state.placement, changes)
    by_joints = twists[..., len(paths) :]
    by_name = dict(zip(paths, np.moveaxis(twists[..., : len(paths)], -1, 0), strict=True))
    by_name |= by_map(robot, tool.map, state.q, by_joints)
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
