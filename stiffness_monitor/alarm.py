# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find elastic elements that have departed from the file, by deflections under measured loads.

A measured deflection is C(s) w + F u + z and noise: s multiplies the elements' compliances
(:mod:`stiffness_monitor.response`), F u is the effect of the file's ``uncertainty`` on C w, with u
of standard deviation 1, and z a zero of the instrument. The fewest elements whose factors explain a
window of samples are found by adding the one that leaves the least sum of squares. An element has
departed if its factor differs from 1 by more than a number of standard deviations, of the measured
noise and of the file's uncertainty for that element. Elements that would explain the samples nearly
as well are named with it.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Indices, one_vector
from pkm_twin.errors import MessageError, PkmTwinError, SingularityError, UnreachableError
from pkm_twin.messages.reading import DeflectionSample, quote_name, read_deflection, rotate_to_base
from pkm_twin.messages.stamps import SECOND, StampRules
from pkm_twin.robot.robot import Robot
from pkm_twin.settings import setting
from pkm_twin.streams.monitor import Core, make_counter, run_to_end
from pkm_twin.streams.noise import estimate_deviation
from pkm_twin.streams.wrench import TimeCache, check_order
from stiffness_monitor.compliance import strain_energy
from stiffness_monitor.derivatives import compliance_effects, energy_effects
from stiffness_monitor.monitor import Answer
from stiffness_monitor.response import element_response

FACTOR_RANGE: Final = (0.05, 100.0)
"""Smallest and largest compliance factor of the search."""
MAX_STEP_RATIO: Final = 3.0
"""Largest ratio of a factor's values in consecutive Gauss-Newton steps."""


@dataclass(frozen=True)
class AlarmSettings:
    """Conditions of an alarm.

    ``sigmas``: threshold in standard deviations of model and noise. ``min_departure``:
    smallest difference of a factor from 1. ``window``: time span of the samples that are evaluated
    together, s. ``directions``: the measured ones of x y z rx ry rz.
    """

    sigmas: float = setting(
        6.0,
        "alarm threshold in standard deviations of model and noise together",
        name="alarm.sigmas",
        low=1.0,
        high=1e3,
    )
    min_departure: float = setting(
        0.1,
        "smallest change of an element's compliance factor that raises an alarm",
        name="alarm.min_departure",
        low=0.0,
        high=10.0,
    )
    window: float = setting(
        20.0,
        "time span of the deflections that are evaluated together",
        name="alarm.window",
        unit="s",
        low=1.0,
        high=3600.0,
    )
    directions: tuple[bool, ...] = (True,) * 6


@dataclass(frozen=True)
class Departure:
    """An element whose compliance is ``factor`` times the file's, with its standard deviation.

    ``bound``: largest difference from 1 that gives no alarm. ``others``: elements that would
    explain the samples equally well, with their factors.
    """

    element: str
    factor: float
    deviation: float
    bound: float
    others: tuple[tuple[str, float], ...] = ()

    @property
    def candidates(self) -> str:
        """All possible elements, as text."""
        return " or ".join((self.element, *(name for name, _ in self.others)))


@dataclass(frozen=True, eq=False)
class _Sample:
    """Hold a load in a pose and the model's quantities for it; shapes as in :class:`_Window`."""

    time: float
    predicted: Array
    load_map: Array
    element_compliance: Array
    loads: Array
    effects: Array
    measured: Array


@dataclass(frozen=True, eq=False)
class _Fit:
    """Hold factors of some elements, their variances by noise alone, and the squared residual."""

    factors: Array
    variances: Array
    squares: float

    def deviations(self, variance_factor: float) -> Array:
        """Return the factors' standard deviations, with variances times ``variance_factor``."""
        return np.asarray(np.sqrt(variance_factor * self.variances), np.float64)


@dataclass(frozen=True, eq=False)
class _Window:
    """Hold k samples in d measured directions, each divided by its noise.

    ``element_of_column``: index of each column's element, (r,). ``load_map``: A of
    :mod:`stiffness_monitor.response`, effect of the columns' forces on the platform, (k, d, r);
    ``element_compliance``: its M, with the platform locked, (k, r, r). ``loads``: the columns' forces
    under the wrench, (k, r). ``bias_effects``: effects of the file's uncertain numbers, then of the
    sensors' offsets, (k, d, c + d). ``residual``: measured less predicted, (k, d). ``prior``: inverse
    prior variance of these numbers and offsets, (c + d,).
    """

    element_of_column: Indices
    load_map: Array
    element_compliance: Array
    loads: Array
    bias_effects: Array
    residual: Array
    prior: Array

    def predict_change(self, chosen: Sequence[int], factors: Array) -> tuple[Array, Array]:
        """Return the deflection change by elements' factors, (k, d), and its derivatives."""
        affected = np.isin(self.element_of_column, chosen)
        by_element = np.equal.outer(self.element_of_column[affected], np.asarray(chosen)).astype(float)
        change = by_element @ (factors - 1.0)
        load_map = self.load_map[..., affected]
        matrix = np.eye(len(change)) + self.element_compliance[:, affected][..., affected] * change
        right = np.concatenate([np.swapaxes(load_map, -1, -2), self.loads[:, affected, None]], -1)
        solved = np.linalg.solve(matrix, right)
        columns, column_forces = np.swapaxes(solved[..., :-1], -1, -2), solved[..., -1]
        change_of_deflection = load_map @ (change * column_forces)[..., None]
        return change_of_deflection[..., 0], (columns * column_forces[:, None]) @ by_element

    def fit(self, chosen: Sequence[int], start: Array) -> _Fit:
        """Fit the factors of chosen elements to the window by Gauss-Newton, from ``start``."""
        factors, e = start, len(chosen)
        prior = np.concatenate([np.zeros(e), self.prior])
        for _ in range(20):
            change, slopes = self.predict_change(chosen, factors)
            table = np.concatenate([slopes, self.bias_effects], -1).reshape(-1, len(prior))
            target = (self.residual - change).ravel()
            information = table.T @ table + np.diag(prior)
            # Scale the unknowns: zeros and factors differ by orders of magnitude.
            scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
            inverse = np.linalg.pinv(scale[:, None] * information * scale, 1e-12, hermitian=True)
            solution = scale * (inverse @ (scale * (table.T @ target)))
            bounds = (
                np.maximum(factors / MAX_STEP_RATIO, FACTOR_RANGE[0]),
                np.minimum(factors * MAX_STEP_RATIO, FACTOR_RANGE[1]),
            )
            new = np.clip(factors + solution[:e], *bounds)
            step, factors = np.abs(new - factors).max(initial=0.0), new
            if step < 1e-4:  # a relative change below any noise
                break
        residual = target - table[:, e:] @ solution[e:]
        squares = float(residual @ residual + prior[e:] @ solution[e:] ** 2)
        variances = (scale**2 * np.diag(inverse))[:e]
        return _Fit(factors, variances, squares)


@dataclass
class StiffnessAlarm:
    """Find elements whose compliance differs from the file, from loads and deflections.

    Times are arguments, s.
    """

    robot: Robot
    settings: AlarmSettings = field(default_factory=AlarmSettings)

    def __post_init__(self) -> None:
        self._samples: deque[_Sample] = deque(maxlen=1000)
        self.names: tuple[str, ...] = ()
        # A machine may be singular at home; then the first sample's pose is used.
        with suppress(PkmTwinError, ValueError):
            self._read_elements(self.robot.home())

    def _read_elements(self, pose: Array) -> None:
        """Store the elements' names and the standard deviations that the file gives them."""
        response = element_response(self.robot, pose)
        self._file_deviations = _file_deviations(self.robot, pose, len(response.names))
        self.names, self._element_of_column = response.names, response.owner

    @property
    def count(self) -> int:
        """Samples in the window."""
        return len(self._samples)

    def reset(self) -> None:
        """Discard all samples."""
        self._samples.clear()

    def push(self, time: float, pose: Array, wrench: Array, deflection: Array) -> None:
        """Add a sample: pose (m,), wrench and deflection (6,) in base axes.

        :raises ValueError: a sample of another shape or that is not finite; it is not added.
        """
        wrench = one_vector(wrench, 6, "the wrench")
        deflection = one_vector(deflection, 6, "the deflection").copy()
        if not self.names:
            self._read_elements(pose)
        response = element_response(self.robot, pose)
        effects = np.einsum("ijk,j->ik", compliance_effects(self.robot, pose), wrench)
        self._samples.append(
            _Sample(
                time,
                response.compliance @ wrench,
                response.reach,
                response.rest,
                response.reach.T @ wrench,
                effects,
                deflection,
            )
        )
        while time - self._samples[0].time > self.settings.window:
            self._samples.popleft()

    def judge(self) -> tuple[Departure, ...] | None:
        """Return the elements with an alarm, the most certain first; None without enough load."""
        return run_to_end(self.judging())

    def judging(self) -> Generator[None, None, tuple[Departure, ...] | None]:
        """Evaluate :meth:`judge` in slices, yielding between them, with the samples at the start."""
        if not self._samples:
            return None
        sizes = np.array([np.linalg.norm(sample.predicted[:3]) for sample in self._samples])
        # At least 20 samples must be loaded: predicted to deflect by a twentieth of the largest deflection.
        if int((sizes > 0.05 * sizes.max()).sum()) < 20 or not sizes.max() > 0.0:
            return None
        window, variance_factor, signal_to_noise = self._build_window()
        if signal_to_noise < 10.0:
            # The loads are too small: the measured wrenches may be noise.
            return None
        yield
        # Each element's factor alone, to first order, and its standard error, without common causes.
        count = len(self.names)
        _, slopes = window.predict_change(range(count), np.ones(count))
        rows, columns = slopes.reshape(-1, count), window.bias_effects.reshape(-1, len(window.prior))
        columns = np.concatenate([columns, np.diag(np.sqrt(window.prior))])
        basis = np.linalg.qr(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))[0]
        basis = basis[: len(rows)]
        rows = rows - basis @ (basis.T @ rows)
        information = np.maximum(np.sum(rows**2, 0), 1e-300)
        values, deviations = 1.0 + rows.T @ window.residual.ravel() / information, 1.0 / np.sqrt(information)
        bounds = self._alarm_thresholds(np.sqrt(variance_factor) * deviations, range(len(self.names)))
        if not (np.abs(values - 1.0) > 0.5 * bounds).any():
            # To first order no factor exceeds half its bound, so a full search would find no departure.
            return ()
        yield
        chosen = yield from self._select_elements(window, variance_factor)
        return (yield from self._describe_departures(window, variance_factor, chosen))

    def _alarm_thresholds(self, deviations: Array, elements: Sequence[int]) -> Array:
        """Return the largest difference from 1 of each element's factor that gives no alarm, (elements,)."""
        s = self.settings
        file_deviations = self._file_deviations[list(elements)]
        return np.asarray(np.maximum(s.min_departure, s.sigmas * np.hypot(deviations, file_deviations)), np.float64)

    def _relative_departures(self, fit: _Fit, variance_factor: float, elements: Sequence[int]) -> Array:
        """Return the factors' differences from 1 over their bounds, (elements,)."""
        bounds = self._alarm_thresholds(fit.deviations(variance_factor), elements)
        return np.asarray(np.abs(fit.factors - 1.0) / bounds, np.float64)

    def _select_elements(self, window: _Window, variance_factor: float) -> Generator[None, None, list[int]]:
        """Find the fewest elements that explain the window: add one by one, then drop some."""
        chosen: list[int] = []
        factors = np.zeros(0)
        while len(chosen) < len(self.names):
            remaining = [k for k in range(len(self.names)) if k not in chosen]
            tried = {}
            for k in remaining:
                tried[k] = window.fit([*chosen, k], np.append(factors, 1.0))
                yield
            best = min(remaining, key=lambda k: tried[k].squares)
            if not self._relative_departures(tried[best], variance_factor, [*chosen, best])[-1] > 1.0:
                break
            chosen.append(best)
            factors = tried[best].factors
        while chosen:
            fit = window.fit(chosen, factors)
            yield
            departures = self._relative_departures(fit, variance_factor, chosen)
            least = int(departures.argmin())
            if departures[least] > 1.0:
                break
            del chosen[least]
            factors = np.delete(fit.factors, least)
        return chosen

    def _describe_departures(
        self, window: _Window, variance_factor: float, chosen: Sequence[int]
    ) -> Generator[None, None, tuple[Departure, ...]]:
        """Return the departures of the chosen elements, the most certain first."""
        if not chosen:
            return ()
        fit = window.fit(chosen, np.ones(len(chosen)))
        deviations, departures = (
            fit.deviations(variance_factor),
            self._relative_departures(fit, variance_factor, chosen),
        )
        bounds = self._alarm_thresholds(deviations, chosen)
        found = []
        for position in np.argsort(-departures).tolist():
            others = []
            for k in range(len(self.names)):
                if k in chosen:
                    continue
                swapped, start = list(chosen), fit.factors.copy()
                swapped[position], start[position] = k, 1.0
                other = window.fit(swapped, start)
                yield
                # Elements whose fit is worse by four standard deviations are excluded.
                if other.squares - fit.squares < 4.0**2 * variance_factor:
                    others.append((other.squares, self.names[k], float(other.factors[position])))
            found.append(
                Departure(
                    self.names[chosen[position]],
                    float(fit.factors[position]),
                    float(deviations[position]),
                    float(bounds[position]),
                    tuple((name, value) for _, name, value in sorted(others)),
                )
            )
        return tuple(found)

    def _build_window(self) -> tuple[_Window, float, float]:
        """Build the window of samples, each divided by its noise, for the fit.

        :returns: the window; the factor by which autocorrelation of the noise increases variances;
        the deflections' largest ratio of standard deviation to noise over the directions.
        """
        directions = np.flatnonzero(self.settings.directions)
        predicted, load_map, element_compliance, loads, effects, measured = (
            np.array([getattr(sample, name) for sample in self._samples])
            for name in ("predicted", "load_map", "element_compliance", "loads", "effects", "measured")
        )
        residual, load_map, effects = (a[:, directions] for a in (measured - predicted, load_map, effects))
        zeros = np.broadcast_to(np.eye(len(directions)), (len(predicted), len(directions), len(directions)))
        bias_effects = np.concatenate([effects, zeros], -1)
        prior = np.repeat([1.0, 0.0], [effects.shape[-1], len(directions)])
        plain = _Window(self._element_of_column, load_map, element_compliance, loads, bias_effects, residual, prior)
        _, slopes = plain.predict_change(range(len(self.names)), np.ones(len(self.names)))
        size = np.std(measured[:, directions], 0)
        # Estimate the noise from what elements, causes and zeros do not explain, and its correlation in time.
        table, min_noise = np.concatenate([slopes, bias_effects], -1), 1e-3 * size
        noise, unexplained = np.maximum(min_noise, 1e-30), residual
        for _ in range(2):
            rows = (table / noise[:, None]).reshape(-1, table.shape[-1])
            scale = 1.0 / np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
            found = scale * np.linalg.lstsq(rows * scale, (residual / noise).ravel(), rcond=1e-12)[0]
            unexplained = residual - table @ found
            noise = np.maximum(
                np.maximum(estimate_deviation(unexplained - np.median(unexplained, 0)), min_noise), 1e-30
            )
        scaled = unexplained / noise
        square_sum = float(np.sum(scaled**2))
        correlation = float(np.sum(scaled[1:] * scaled[:-1])) / square_sum if square_sum > 0.0 else 0.0
        # A correlation of 1 would make all variances infinite.
        correlation = min(max(correlation, 0.0), 0.95)
        variance_factor = (1.0 + correlation) / (1.0 - correlation)
        signal_to_noise = float((size / noise).max())
        scale_factors = noise[:, None]
        window = _Window(
            self._element_of_column,
            load_map / scale_factors,
            element_compliance,
            loads,
            bias_effects / scale_factors,
            residual / noise,
            prior,
        )
        return window, variance_factor, signal_to_noise


def _file_deviations(robot: Robot, pose: Array, count: int) -> Array:
    """Return the relative standard deviation of each element's compliance by ``uncertainty``, (elements,).

    The elements' energies under six unit loads are compared at one pose.
    """
    if not robot.uncertainty_changes:
        return np.zeros(count)
    loads = np.diag(np.repeat([1.0, 1.0 / robot.size], 3))
    own = strain_energy(robot, pose, loads).energies.sum(0)
    changes = np.linalg.norm(energy_effects(robot, pose, loads).sum(0), axis=-1)
    return np.asarray(changes / np.maximum(own, 1e-300), np.float64)


MAX_WAITING: Final = 64
"""Largest number of deflections that wait for a later wrench; the latest stamps are dropped first."""


@dataclass
class StiffnessWatch(Core):
    """Pair measured deflections with the wrenches before and after them, and evaluate a window of pairs.

    ``frames``: names of the base frame and of the platform frame; a deflection is in either one's
    axes. ``max_age``: largest time from a deflection to the wrench on either side, s. ``period``:
    shortest time between two pairs that are used, s.
    """

    robot: Robot
    rules: StampRules
    frames: tuple[str, str]
    settings: AlarmSettings = field(default_factory=AlarmSettings)
    max_age: float = 0.02
    period: float = 0.1

    def __post_init__(self) -> None:
        self.taken = make_counter()
        self.departures: tuple[Departure, ...] | None = None
        """Departures of the last evaluation; None before the first."""
        self._alarm = StiffnessAlarm(self.robot, self.settings)
        self._answers: TimeCache[Answer] = TimeCache(1024)
        self._waiting: list[DeflectionSample] = []
        """Deflections that wait for a wrench, sorted by stamp, so that one without a pair does not block others."""
        self._last = self._due = self._judged = 0
        self._judging: object | None = None

    @property
    def count(self) -> int:
        """Pairs in the window."""
        return self._alarm.count

    @property
    def stamp(self) -> int:
        """Stamp of the newest pair that was evaluated, ns."""
        return self._judged

    def reset(self) -> None:
        """Discard all pairs, as when the clock jumps or the machine was repaired."""
        self._alarm.reset()
        self._answers.clear()
        self._waiting.clear()
        self._last = self._due = self._judged = 0
        self._judging = None
        self.departures = None

    def answer(self, answer: Answer) -> None:
        """Add the monitor's answer to a wrench."""
        self._answers.push(answer.stamp, answer)
        self._use_waiting_deflections()

    def deflection(self, message: Any, now: int) -> None:
        """Add a geometry_msgs/TransformStamped of the deflected platform.

        :raises MessageError: the message is rejected, and counted.
        """
        with self.count_rejections(self.taken):
            sample = read_deflection(message, now, self.rules)
            if sample.frame not in self.frames:
                expected = " or ".join(map(repr, dict.fromkeys(self.frames)))
                raise MessageError("frame", f"frame is {quote_name(sample.frame)}, expected {expected}")
            check_order(sample.stamp, self._last)
        insort(self._waiting, sample, key=lambda waiting: waiting.stamp)
        self._use_waiting_deflections()
        if len(self._waiting) > MAX_WAITING:
            self._waiting.pop()
            text = f"{MAX_WAITING} deflections are already waiting for the wrench after them"
            self.count_rejection(self.taken, MessageError("no wrench", text))

    def judgement(self) -> Generator[None, None, bool] | None:
        """Start an evaluation in slices; None if one is running or less than 1 s of stamps has passed.

        The generator returns True if it set ``departures``; after a :meth:`reset` it does not.
        """
        if self._judging is not None or self._due - self._judged < SECOND:
            return None
        self._judged = self._due
        evaluation = self._judging = object()

        def evaluate_if_current() -> Generator[None, None, bool]:
            """Evaluate the alarm in slices; store the departures unless a reset has made them void."""
            try:
                found = yield from self._alarm.judging()
                if self._judging is not evaluation:
                    return False
                self.departures = found
                return True
            finally:
                if self._judging is evaluation:
                    self._judging = None

        return evaluate_if_current()

    def _use_waiting_deflections(self) -> None:
        latest = self._answers.latest
        while self._waiting and latest is not None and self._waiting[0].stamp <= latest[0]:
            sample = self._waiting.pop(0)
            try:
                self._push_pair(sample)
            except MessageError as error:
                self.count_rejection(self.taken, error)
                continue
            self._last = sample.stamp
            self.taken.accept()

    def _push_pair(self, sample: DeflectionSample) -> None:
        """Push a deflection with the wrench interpolated at its stamp to the alarm."""
        neighbours = self._answers.around(sample.stamp)
        if neighbours is None:
            raise MessageError("no wrench", "no wrenches before and after the deflection")
        age = max(sample.stamp - neighbours[0][0], neighbours[1][0] - sample.stamp) / SECOND
        if age > self.max_age:
            text = f"the wrench next to the deflection is {age:.3f} s away, allowed {self.max_age:g} s"
            raise MessageError("no wrench", text)
        before, after = neighbours[0][1], neighbours[1][1]
        if sample.stamp - self._due < self.period * SECOND:
            return
        span = after.stamp - before.stamp
        fraction = (sample.stamp - before.stamp) / span if span else 0.0
        wrench = before.wrench + fraction * (after.wrench - before.wrench)
        nearest = before if fraction < 0.5 else after
        values = sample.values
        if sample.frame != self.frames[0]:
            values = rotate_to_base(values, nearest.rotation)
        try:
            self._alarm.push(sample.stamp / SECOND, nearest.pose, wrench, values)
        except (UnreachableError, SingularityError, ValueError) as error:
            raise MessageError("pose", str(error)) from error
        self._due = sample.stamp
