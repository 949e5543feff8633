# SPDX-License-Identifier: Apache-2.0
"""Geometry from measured platform poses: weighted least squares with the file as prior.

Gauss and Newton's method on the machine itself, damped where it has to be: every step computes the
platform with the new numbers and its exact derivatives, by programs that take them at run time. The
errors before and after are those of the loaded robots.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.design import programs
from pkm_twin.design.variants import Variants
from pkm_twin.errors import ParameterError, PkmTwinError, UnreachableError
from pkm_twin.identification.calibration_faults import (
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
from pkm_twin.identification.calibration_fit import (
    KNOWN,
    Parameter,
    UnsettledError,
    Whole,
    derivatives,
    fit,
)
from pkm_twin.identification.calibration_state import (
    BESIDE,
    FRAME,
    TARGET,
    Errors,
    Poses,
    State,
    place_frame,
    start_of,
)
from pkm_twin.identification.noise import Weighed
from pkm_twin.identification.transmission import Transmission, numbers
from pkm_twin.identification.undetermined import undetermined
from pkm_twin.machine.joint_map import JointMap
from pkm_twin.robot.derivatives import geometry_numbers
from pkm_twin.robot.entries import entries, with_entries
from pkm_twin.robot.numbers import file_numbers
from pkm_twin.robot.robot import Robot

MOVES: Final = 1e-6
"""A number that moves the platform less than this, per unit, is no number of the geometry."""
HELD_OUT: Final = 4
"""Every so many poses one is held out."""
STEP: Final = 1e-6
"""By which a number is moved to see whether the machine can be assembled with another one."""
SAME: Final = 1e-4
"""Difference of joints that makes another pose, rad or m."""
SHOWN: Final = 0.1
"""Part of the greatest weight below which a number is not named in a combination."""
NOT_GEOMETRY: Final = ("limits.", "gravity", "payload.", "joint_map.")


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A robot with fitted numbers, and how sure these are."""

    robot: Robot
    parameters: tuple[Parameter, ...]
    covariance: Array
    steps: int
    faults: tuple[Fault, ...] = ()
    """Why this machine was not in the poses, where they were accepted all the same."""
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


@dataclass(frozen=True, kw_only=True)
class Calibration(Estimate):
    """A robot that was calibrated with poses."""

    condition: float
    """Of the poses' equations in units of the prior deviations, over what was observed."""
    noise: float
    noise_angle: float | None
    """Standard deviations of the measurement that the fit leaves, m an axis and rad an axis."""
    fitted: tuple[Errors, Errors]
    held_out: tuple[Errors, Errors]
    """Before (frame and target of the measurement alone are fitted) and after; no outliers."""
    outliers: tuple[Outlier, ...] = ()
    """Poses that do not fit the others, the worst first."""
    cost: float = 0.0
    """Squares of the machine's changes over their prior standard deviations, summed."""
    placed: bool = False
    """Whether another place of the instrument may explain the poses better."""


def geometric(robot: Robot, q: Array, only: Sequence[str] = ()) -> tuple[str, ...]:
    """Numbers of the robot's file that move its platform at joint states (k, n).

    A number that cannot change alone, because the machine would not assemble, is none.

    :param only: paths, or their beginnings, to choose from.
    :raises ParameterError: a beginning that no number of the geometry has.
    """
    paths = [
        path
        for path in entries(robot)
        if not path.startswith(NOT_GEOMETRY) and (not only or path.startswith(tuple(only)))
    ]
    slopes = file_numbers(robot, tuple(paths), geometry_numbers).slopes
    paths = [path for path, moves in zip(paths, np.abs(slopes).max(0) > 1e-9, strict=True) if moves]
    found: list[str] = []
    if paths:
        own = np.array([robot.number(path) for path in paths])
        many = Variants(robot, dict(zip(paths, own, strict=True)))
        twists = many.platform_slopes(q)
        beside = many.with_values(own + STEP * np.eye(len(paths)))
        each = np.broadcast_to(q, (len(paths), *q.shape))
        possible = beside.run(programs.anywhere, each)[1].all((1, 2))
        good = possible & (np.abs(twists).max((0, 1)) > MOVES)
        found = [path for path, one in zip(paths, good, strict=True) if one]
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
        return parameters_of(robot, q, paths, offsets, transmission, extra, prior)

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
    except (UnsettledError, UnreachableError) as error:
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


def _place(state: State) -> Fault:
    tool = state.instrument
    return place_fault(tool.place, tool.frame.as_rotvec())


def _learnt(poses: Poses) -> Mask:
    """Which poses are learnt from."""
    return np.asarray(np.arange(len(poses.joints)) % HELD_OUT != HELD_OUT - 1)


def parameters_of(
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
    columns = derivatives(robot, state, FRAME)
    halves = [columns[:, :3], columns[:, 3:]][: len(parts)]
    asked = [(p.before - p.value) / p.prior for p in told]
    return looks_placed(table, noise.over(halves), np.append(noise.over(parts), asked))


def _calibrated(
    robot: Robot, poses: Poses, parameters: Sequence[Parameter], frame: bool, prior: float,
    progress: Callable[[int], None],
) -> tuple[Calibration, State]:  # fmt: skip
    """The fit with its faults, and the machine at the poses that are learnt from."""
    rows = _learnt(poses)
    some = poses.part(rows)
    learnt = Whole(some.joints, some.position, some.rotation)
    # A pose that is measured again tells no more numbers.
    different = len(np.unique(np.round(learnt.joints / SAME), axis=0))
    equations = different * (3 if poses.rotation is None else 6)
    if equations < len(parameters) + 6 or rows.all():
        raise ParameterError(
            "poses", f"{different} different ones to learn from",
            f"enough for {len(parameters)} numbers to be fitted",
        )  # fmt: skip
    instrument = [p for p in parameters if p.name in (*FRAME, *TARGET)]
    paths = [p.name for p in parameters if not p.name.startswith(BESIDE)]
    start = start_of(robot, learnt, paths)
    if frame:
        place_frame(start, learnt)
    before = fit(robot, start, learnt, instrument, progress)[0] if instrument else start
    after, values, covariance, information, noise, steps = fit(
        robot, before, learnt, parameters, progress
    )
    built = with_entries(robot, after.numbers)
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
            "poses", len(poses.joints), "poses farther apart: these determine none of the numbers"
        )
    singular = np.linalg.svd(information[:, good], compute_uv=False)
    condition = float(singular[0] / singular[-1]) if good.any() else np.inf
    result = Calibration(
        robot=built, parameters=tuple(told), covariance=covariance, condition=condition,
        noise=noise.noise[0], noise_angle=noise.noise[1] if len(noise.noise) > 1 else None,
        fitted=fitted_errors, held_out=held_errors, steps=steps, outliers=outliers,
        faults=tuple(faults), cost=cost_of(changes),
        placed=not frame and _looks_placed(robot, after, learnt, noise, information, told),
        joint_map=after.instrument.map,
    )  # fmt: skip
    return result, after
