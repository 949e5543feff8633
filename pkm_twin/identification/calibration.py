# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Geometry from measurements of the platform: weighted least squares with the file as prior.

Gauss and Newton's method on the machine itself, damped where it has to be: every step computes the
platform with the new numbers and its exact derivatives, by programs that take them at run time.
Whole poses are measurements of six axes; the errors of those that are held out are those of the
loaded robots.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array, Indices
from pkm_twin.design import programs
from pkm_twin.design.tolerance import Tolerances, is_play, tolerances, workspace_states
from pkm_twin.design.variants import Variants
from pkm_twin.errors import ParameterError, PkmTwinError, UnreachableError
from pkm_twin.identification.calibration_fit import (
    MAX_COST_RATIO,
    MIN_COST_SAVING,
    Fault,
    Fitted,
    Outlier,
    RejectedPosesError,
    UnsettledError,
    find_outliers,
    fit,
    list_faults,
    place_fault,
)
from pkm_twin.identification.calibration_state import (
    FRAME,
    MAX_LINE_POSES,
    OTHER_PARAMETERS,
    TARGET,
    Instrument,
    Parameter,
    Poses,
    State,
    Transmission,
    differentiate_lines,
    list_map_parameters,
    list_map_values,
    make_state,
    place_frame,
)
from pkm_twin.identification.measurements import POSITION_KIND, Measured, find_redundancy, select_poses
from pkm_twin.identification.parameters import OBSERVED_RATIO, list_weights
from pkm_twin.identification.undetermined import Pair, find_determined_pairs, undetermined
from pkm_twin.machine.formulas import PARAMETERS
from pkm_twin.machine.joint_map import JointMap
from pkm_twin.mechanisms.entries import Fitted as FittedNumber
from pkm_twin.robot.derivatives import list_geometry_numbers
from pkm_twin.robot.numbers import FileNumbers
from pkm_twin.robot.robot import Robot

HELD_OUT_INTERVAL: Final = 4
"""One whole pose in so many is held out to judge the fit."""
NOT_GEOMETRY: Final = ("limits.", "gravity", "payload.", "joint_map.")
TIGHT_PRIOR_RATIO: Final = 0.1
"""Factor on the prior deviations of poorly known lengths while the scale is not determined."""


@dataclass(frozen=True, kw_only=True)
class Free:
    """What is fitted beside the numbers of a file, and how well lengths are known before.

    ``offsets``: of the joints' sensors; ``frame``, ``target``: where the instrument stands, and
    its target on the platform. ``prior``: standard deviation of lengths, m; angles have it at the
    platform's radius. ``transmission``: which ratios of the joint map; ``auto``: those of sliding
    joints that have one. ``only``: beginnings of paths, as of :func:`list_geometric_paths`, of what is fitted
    of the joint map; empty, or with a ``transmission`` that is asked for: all.
    """

    offsets: bool = True
    frame: bool = False
    target: bool = False
    prior: float = 0.01
    transmission: Transmission = Transmission.AUTO
    only: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A robot with fitted numbers, and how sure these are."""

    robot: Robot
    parameters: tuple[Parameter, ...]
    covariance: Array

    def _find_unknown(self) -> tuple[list[str], Array, Array]:
        """Return names, priors, and orthonormal directions in their units that the poses do not determine, (p, u)."""
        prior = np.array([p.prior for p in self.parameters])
        values, vectors = np.linalg.eigh(self.covariance / np.outer(prior, prior))
        unknown = np.asarray(vectors[:, values > OBSERVED_RATIO**2], np.float64)
        return [p.name for p in self.parameters], prior, unknown

    @property
    def undetermined(self) -> list[str]:
        """Sentences, at most ten, on what the poses do not determine: there the file's values stay."""
        return undetermined(self.robot.graph, *self._find_unknown())

    @property
    def unobserved(self) -> tuple[dict[str, float], ...]:
        """Combinations of numbers that the poses do not determine: weights in units of the priors.

        What the file says stays along them; a number that is not observed may be in one whose
        other combinations are.
        """
        names, _, unknown = self._find_unknown()
        return tuple(list_weights(names, column) for column in unknown.T)


class Errors(NamedTuple):
    """Measured less computed: root mean square and worst, m or rad; of whole poses the distance."""

    rms: float
    worst: float


@dataclass(frozen=True)
class Agreement:
    """Errors of one kind of measurement, before and after, without the outliers.

    Before, only the instrument's own numbers are fitted. ``held_out``: of whole poses those that
    were not learnt from, else of each measurement by the fit to all others. ``noise``: standard
    deviation an axis that the fit leaves.
    """

    name: str
    unit: str
    count: int
    noise: float
    fitted: tuple[Errors, Errors]
    held_out: tuple[Errors, Errors]


class Scale(NamedTuple):
    """How well distances and angles between new poses are known, among the measured ones.

    ``before``, ``after``: relative standard deviation of the uniform scale. ``distance`` and
    ``angle``: standard deviations of a distance, over its length, and of an angle between two
    lines, rad; shear and distortion are in both.
    """

    before: float
    after: float
    determined: bool
    distance: float
    angle: float

    def __str__(self) -> str:
        ends = f"{100.0 * self.distance:.2g} mm in 100 mm"
        if np.isfinite(self.angle):
            ends = f"{ends}, angles to {1e3 * self.angle:.2g} mrad"
        if self.determined:
            return f"scale: determined; distances between new poses are known to {ends} (standard deviations)"
        return (
            f"the scale is not determined (standard deviation {100.0 * self.after:.2g} mm in 100 "
            f"mm, {100.0 * self.before:.2g} mm before): distances between new poses are known to "
            f"{ends}. Numbers that depend on it are marked no, and stay near the file's values. "
            "Measure distances as well (--measure height,distance)"
        )


@dataclass(frozen=True, kw_only=True)
class Calibration(Estimate):
    """Result of a kinematic calibration: the fitted parameters and the robot with them."""

    instrument: Instrument
    agreements: tuple[Agreement, ...]
    outliers: tuple[Outlier, ...]
    """Lines of the table that do not fit the others, the worst first."""
    scale: Scale | None
    """None where the platform does not move from its place."""
    pairs: tuple[Pair, ...]
    """Sums and differences of parameters that are determined though the parameters are not."""
    condition: float | None
    """Of the measurements' equations in units of the prior deviations, over what was observed."""
    steps: int
    cost: float
    """Squares of the machine's changes over their prior standard deviations, summed."""
    faults: tuple[Fault, ...]
    """Why this machine was not in the poses, where they were accepted all the same."""
    placed: bool
    """Whether another place of the instrument may explain the measurements better."""

    @property
    def joint_map(self) -> JointMap:
        """Return the joint map with the fitted values."""
        return self.instrument.map

    def fitted(self, robot: Robot, source: str) -> dict[str, FittedNumber]:
        """Return the fitted numbers of the file by path.

        :param robot: before. ``source``: what they are from, in words.
        """
        unknown = f"{source}; not determined by these measurements"
        values = {
            p.name: FittedNumber(p.value, p.deviation, p.unit, source if p.observed else unknown)
            for p in self.parameters
            if not p.name.startswith(OTHER_PARAMETERS) and p.name not in self.instrument.own
        }
        mapped = {p.name: (p.value, p.deviation) for p in self.parameters}
        own = list_map_values(robot, self.joint_map, mapped)
        return values | {path: FittedNumber(*number, source) for path, number in own.items()}


def list_geometric_paths(robot: Robot, q: Array, only: Sequence[str] = ()) -> tuple[str, ...]:
    """List the paths of the file's numbers that move the platform at joint states (k, n).

    A number that cannot change alone, because the machine would not assemble, is none.

    :param only: paths, or their beginnings, to choose from.
    :raises ParameterError: a beginning that no number of the geometry has.
    """
    paths = [
        path
        for path in robot.file_numbers()
        if not path.startswith(NOT_GEOMETRY if only else (*NOT_GEOMETRY, f"{PARAMETERS}."))
        and (not only or path.startswith(tuple(only)))
    ]
    slopes = robot.cached(FileNumbers, tuple(paths), list_geometry_numbers).slopes
    paths = [path for path, moves in zip(paths, np.abs(slopes).max(0) > 1e-9, strict=True) if moves]
    found: list[str] = []
    if paths:
        own = np.array([robot.number(path) for path in paths])
        many = Variants(robot, dict(zip(paths, own, strict=True)))
        twists = many.differentiate_platform(q)
        # Can the machine be assembled with another number?
        beside = many.with_values(own + 1e-6 * np.eye(len(paths)))
        each = np.broadcast_to(q, (len(paths), *q.shape))
        possible = beside.run_program(programs.forward_of_all_structures, each)[1].all((1, 2))
        # Numbers that do not move the platform are left out.
        good = possible & (np.abs(twists).max((0, 1)) > 1e-6)
        found = [path for path, one in zip(paths, good, strict=True) if one]
    known = [*found, *(f"joint_map.{joint}.offset" for joint in robot.joint_names)]
    for beginning in only:
        if not any(path.startswith(beginning) for path in known):
            raise ParameterError("--only", beginning, "the beginning of a geometric number's path")
    return tuple(found)


def left_by_calibration(robot: Robot, errors: Callable[[Array], Array], states: Array, q: Array) -> Array:
    """Return what a calibration without noise leaves of errors of the platform, shape (k, 6, p).

    :param errors: of joint states (k, n) the twists by each error, shape (k, 6, p).
    :param states: with measured poses, shape (s, n); ``q``: where the errors count, shape (k, n).
    """
    paths = list_geometric_paths(robot, states)

    def differentiate(rows: Array) -> Array:
        """Differentiate the platform's pose by the joints' zeros and the numbers that a calibration fits."""
        zeros = robot.platform_jacobian(rows) @ robot.drive_jacobian(rows)
        if not paths:
            return zeros
        many = Variants(robot, {path: robot.number(path) for path in paths})
        return np.concatenate([zeros, many.differentiate_platform(rows)], -1)

    scale = np.repeat([1.0, robot.size], 3)[:, None]
    table, wanted = ((scale * of(states)).reshape(6 * len(states), -1) for of in (differentiate, errors))
    found = np.linalg.lstsq(table, wanted, rcond=1e-8)[0]
    return np.asarray(errors(q) - differentiate(q) @ found, np.float64)


MEASURED_STATES: Final = 100
"""Joint states of the workspace in which a calibration measures poses."""


def calibrated_errors(robot: Robot, found: Tolerances, q: Array) -> dict[str, Array]:
    """Return the position errors that a calibration leaves of each error, shape (k, 3), m.

    They are standard deviations.

    A play changes from pose to pose, so that no calibration identifies it.

    :param q: joint states of ``found``, shape (k, n).
    """
    known = {path: sigma for path, sigma in found.sigma.items() if not is_play(path)}
    left = {n: found.effect(n)[:, :3] for n in found.together if is_play(n)}
    if not known:
        return left
    try:
        states = workspace_states(robot, MEASURED_STATES)
    except ParameterError:
        states = q[np.unique(np.linspace(0, len(q) - 1, MEASURED_STATES).round().astype(int))]

    def errors(rows: Array) -> Array:
        own = tolerances(robot, known, rows)
        return np.stack([own.part(path) for path in known], -1)

    stays = left_by_calibration(robot, errors, states, q)
    return left | {path: stays[:, :3, k] for k, path in enumerate(known)}


def list_parameters(robot: Robot, measured: Measured, paths: Sequence[str], free: Free) -> list[Parameter]:
    """List what is fitted, with its present values: numbers of machine, instrument and kinds."""
    robot.check_independent("calibrations", "a pose does not give the others' zeros")
    known, prior = robot.file_numbers(), free.prior
    angle = prior / robot.size
    q = robot.controller.positions(measured.joints)
    mapped = list_map_parameters(robot, q, free.transmission, free.offsets, prior, angle)
    if free.only and free.transmission in (Transmission.AUTO, Transmission.FILE):
        mapped = [one for one in mapped if one.name.startswith(tuple(free.only))]
    # A joint's value at home and its sensor's offset are one number.
    own = {one.name for one in mapped}
    homes = {f"joints.{j}.home" for j in robot.joint_names if f"joint_map.{j}.offset" in own}
    fitted = [(path, *known[path]) for path in paths if path not in homes]
    parameters = [Parameter(path, unit, value, prior if unit == "m" else angle) for path, value, unit in fitted]
    parameters += mapped
    # Nothing is known of the instrument's place: the prior is 100 machine sizes and 10 rad wide.
    far = 100.0 * robot.engine.tree.size
    for name in [*(FRAME if free.frame else ()), *(TARGET if free.target else ())]:
        turns = name[-2] == "r"
        parameters.append(Parameter(name, "rad" if turns else "m", 0.0, 10.0 if turns else far))
    return parameters + [Parameter(n, unit, 0.0, far) for n, (unit, far) in measured.own.items()]


def make_start(robot: Robot, measured: Measured, paths: Sequence[str], frame: bool = False) -> State:
    """Place the machine at the measured poses, with a first guess of instrument and target."""
    state = make_state(robot, measured.joints, paths)
    state.instrument.own = dict.fromkeys(measured.own, 0.0)
    for one in measured.readings:
        if frame and one.kind is POSITION_KIND:
            place_frame(state, one.values)
        state.instrument.own |= one.kind.begin(one.compute_poses(state)[0], one.values[:, 0])
    return state


def calibrate(
    robot: Robot,
    poses: Poses | Measured,
    paths: Sequence[str],
    *,
    accept: bool = False,
    progress: Callable[[int], None] = lambda _: None,
    **options: Any,
) -> Calibration:
    """Fit geometry, joint offsets and the instrument's frame and target to measurements.

    Measurements that do not fit the others hardly count, and are named. What they do not determine
    stays near the file's values.

    :param poses: whole poses, of which every fourth is held out, or measurements of some
        quantities, of which none is.
    :param paths: numbers of the robot's file, of :func:`list_geometric_paths`.
    :param accept: calibrate with poses that this machine was not in, too.
    :param options: of :class:`Free`.
    :raises ParameterError: too few poses, poses of another machine, unit or frame, poses that tell
        no number, or a fit that does not settle.
    """
    free, apart = Free(**options), None
    if isinstance(poses, Measured):
        learnt = poses
    else:
        held = np.arange(len(poses.joints)) % HELD_OUT_INTERVAL == HELD_OUT_INTERVAL - 1
        learnt, apart = (select_poses(poses, np.flatnonzero(rows)) for rows in (~held, held))
    fit_of = partial(_calibrated, robot, learnt, apart, paths, progress)

    def calibrate_with_frame() -> Calibration | None:
        """Repeat the calibration with the instrument's frame free; return None if it is rejected too."""
        if free.frame or apart is None:
            return None
        try:
            other = fit_of(replace(free, frame=True))
        except PkmTwinError:
            return None
        return None if other.faults else other

    try:
        result = fit_of(free)
    except (UnsettledError, UnreachableError) as error:
        other = calibrate_with_frame()
        if other is None:
            raise
        raise RejectedPosesError(place_fault(other.instrument)) from error
    # A small error of a ratio looks like a shift of the instrument, so each adds to the bound.
    saved = MIN_COST_SAVING * (1 + sum(p.name.endswith(".ratio") for p in result.parameters))
    if result.faults or result.cost > saved or result.placed:
        other = calibrate_with_frame()
        if other is not None and (
            result.faults
            or (result.cost - other.cost > saved and other.cost < MAX_COST_RATIO * result.cost)
            or other.agreements[0].noise < 0.5 * result.agreements[0].noise
        ):
            result = replace(result, faults=(place_fault(other.instrument), *result.faults))
    if result.faults and not accept:
        raise RejectedPosesError(result.faults[0])
    return result


def _calibrated(
    robot: Robot,
    learnt: Measured,
    apart: Measured | None,
    paths: Sequence[str],
    progress: Callable[[int], None],
    free: Free,
) -> Calibration:
    """Return the fit with its faults.

    :param apart: whole poses that are not learnt from.
    """
    parameters = list_parameters(robot, learnt, paths, free)
    if apart is not None:
        # A repeated pose determines no further number.
        different = len(np.unique(np.round(learnt.joints / 1e-4), axis=0))
        if 3 * different * len(learnt.readings) < len(parameters) + 6 or not len(apart.joints):
            raise ParameterError(
                "poses",
                f"{different} different ones to learn from",
                f"enough for {len(parameters)} numbers to be fitted",
            )
    beside = {p.name for p in parameters if p.name.startswith(OTHER_PARAMETERS)} | learnt.own.keys()
    machine = [p.name for p in parameters if p.name not in beside]
    start = make_start(robot, learnt, machine, free.frame)
    first = [p for p in parameters if p.name in (*FRAME, *TARGET, *learnt.own)]
    before = fit(robot, start, learnt, first, progress).state if first else start
    found = fit(robot, before, learnt, parameters, progress)
    covariance, steps = found.covariance, found.steps
    deviations = np.sqrt(np.diag(covariance)).tolist()
    estimates = [replace(p, deviation=d) for p, d in zip(parameters, deviations, strict=True)]
    scale, estimates, row = _judge_scale(robot, found.state, learnt, estimates, covariance)
    if scale is not None and not scale.determined:
        near = [
            replace(p, prior=TIGHT_PRIOR_RATIO * p.prior)
            if p.unit == "m" and p.deviation > TIGHT_PRIOR_RATIO * p.prior and p.name in machine
            else p
            for p in estimates
        ]
        found = fit(robot, before, learnt, near, progress)
        steps += found.steps
    estimates = [replace(p, value=float(v)) for p, v in zip(estimates, found.values, strict=True)]
    built = robot.with_file_values(found.state.numbers)
    agreements, outliers = _compare_measurements(robot, built, learnt, apart, before, found, parameters)
    changes = [p for p in estimates if p.name not in (*FRAME, *TARGET, *learnt.own)]
    count = len({k for m in (learnt, apart) if m for one in m.readings for k in one.lines.tolist()})
    left = [(one.unit, one.noise) for one in agreements]
    faults = list_faults(left, outliers, count, changes, free.prior, robot.engine.tree.size)
    good = np.array([p.observed for p in estimates])
    if apart is not None and not good.any() and not faults:
        raise ParameterError("poses", count, "poses farther apart: these determine none of the numbers")
    pairs = find_determined_pairs(
        [k for k in np.flatnonzero(~good).tolist() if estimates[k].name not in learnt.own],
        [p.unit for p in estimates],
        covariance,
        row,
    )
    singular = np.linalg.svd(found.table[:, good], compute_uv=False)
    return Calibration(
        robot=built,
        parameters=tuple(estimates),
        covariance=covariance,
        agreements=agreements,
        condition=float(singular[0] / singular[-1]) if good.any() else None,
        scale=scale,
        pairs=tuple(pairs),
        outliers=outliers,
        steps=steps,
        faults=tuple(faults),
        cost=sum(((p.value - p.before) / p.prior) ** 2 for p in changes),
        placed=apart is not None and not free.frame and _needs_instrument_frame(robot, learnt, found, estimates),
        instrument=found.state.instrument,
    )


def _compare_measurements(
    robot: Robot,
    built: Robot,
    learnt: Measured,
    apart: Measured | None,
    before: State,
    found: Fitted,
    parameters: Sequence[Parameter],
) -> tuple[tuple[Agreement, ...], tuple[Outlier, ...]]:
    """Compare the measurements with both machines, before and after the fit, and find outliers."""
    noise, old, new = found.weights.noise, learnt.parts(before), learnt.parts(found.state)
    readings, parts = learnt.readings, new
    if apart is None:
        slopes = learnt.slopes(robot, found.state, [p.name for p in parameters])
        left = find_redundancy(slopes, noise, np.array([p.prior for p in parameters]))
        held = old, [part / one[:, None] for part, one in zip(new, left, strict=True)]
    else:
        pairs = (robot, before), (built, found.state)
        states = [(machine, state, state.instrument.map.positions(apart.joints)) for machine, state in pairs]
        first, last = (apart.parts(replace(state, q=q, platform=machine.platform(q))) for machine, state, q in states)
        held, readings, parts = (first, last), (*readings, *apart.readings), [*new, *last]
    outliers = find_outliers(readings, parts, noise * (len(readings) // len(noise)))
    bad = [one.line for one in outliers]

    def errors(part: Array, lines: Indices) -> Errors:
        sizes, sound = np.linalg.norm(part, axis=1), ~np.isin(lines, bad)
        sizes = sizes[sound] if sound.any() else sizes
        return Errors(float(np.sqrt(np.mean(sizes**2))), float(sizes.max()))

    agreements = []
    for k, one in enumerate(learnt.readings):
        lines = one.lines if apart is None else apart.readings[k].lines
        fitted = errors(old[k], one.lines), errors(new[k], one.lines)
        left_out = errors(held[0][k], lines), errors(held[1][k], lines)
        kind = one.kind
        agreements.append(Agreement(kind.name, kind.unit, len(one.lines), noise[k], fitted, left_out))
    return tuple(agreements), outliers


def _needs_instrument_frame(robot: Robot, measured: Measured, found: Fitted, estimates: Sequence[Parameter]) -> bool:
    """Return whether a free frame of the instrument would reduce the residual by more than 20 %."""
    over, asked = found.weights.over, [(p.before - p.value) / p.prior for p in estimates]
    target = np.append(over(measured.parts(found.state)), asked)
    own = np.vstack([found.table, np.eye(len(estimates))])
    frame = over(measured.slopes(robot, found.state, FRAME))
    both = np.hstack([own, np.pad(frame, ((0, len(estimates)), (0, 0)))])
    left = [target - one @ np.linalg.lstsq(one, target, rcond=None)[0] for one in (own, both)]
    return float(left[1] @ left[1]) < 0.8 * float(left[0] @ left[0])


def _judge_scale(
    robot: Robot, state: State, measured: Measured, estimates: list[Parameter], covariance: Array
) -> tuple[Scale | None, list[Parameter], Array | None]:
    """Return how well the scale is known, and the parameters, marked where the scale limits them.

    The last is the derivatives of the scale, None where it is determined.
    """
    # Joint states on lines between measured ones.
    rng, joints = np.random.default_rng(0), measured.joints
    first, second = rng.integers(len(joints), size=(2, MAX_LINE_POSES))
    between = joints[first] + rng.uniform(size=(MAX_LINE_POSES, 1)) * (joints[second] - joints[first])
    q = state.instrument.map.positions(between)
    position, rotation = (one[0] for one in state.machine.platform(q[None]))
    good = np.isfinite(position).all(1)
    sampled = replace(state, q=q[good], platform=(position[good], rotation[good]))
    lines = differentiate_lines(robot, sampled, [p.name for p in estimates])
    if lines is None:
        return None, estimates, None
    row = lines.scale
    prior = np.array([p.prior for p in estimates])
    before, after = (float(np.sqrt(row @ c @ row)) for c in (np.diag(prior**2), covariance))
    length = any(one.kind.length for one in measured.readings)
    # Measured lengths determine the scale if they halve its deviation; else 0.01 mm in 100 mm is enough.
    known = after < 0.5 * before and (length or after < 1e-4)
    scale = Scale(before, after, known, *lines.deviations(covariance))
    if known or not before > 0.0:
        return scale, estimates, None
    share = (covariance @ row) ** 2 / (after**2 * np.diag(covariance))
    marked = [replace(p, scaled=bool(s > 0.5)) for p, s in zip(estimates, share, strict=True)]
    return scale, marked, row
