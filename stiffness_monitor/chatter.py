# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Regenerative chatter in milling: the axial depth of cut up to which a pose cuts stably.

With the tool point's displacement u in the cutting plane, x along the feed and y to its left, the
force of a depth b is F = -b W(t) (u(t) - u(t - T)), T the time from tooth to tooth (Altintas and
Budak 1995). The teeth cut by turns, so W is periodic in T. :func:`stability_lobes` discretises one
period: modes go exactly under forces that are linear in time between its steps, as in the full
discretisation of Ding et al. (2010), and are stable where all eigenvalues of the period's map have
a size below one. :func:`stable_depth` takes the mean of W (zero-order), at the worst spindle speed.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import ParameterError, check_limit
from pkm_twin.robot.robot import Robot
from stiffness_monitor.vibration import Complex, ToolModes, responses, tool_modes

MAX_WAVES_PER_TOOTH: Final = 20.0
"""Largest number of vibrations of a mode per tooth period; process damping governs below."""
STEPS_PER_WAVE: Final = 20
"""Time steps per vibration; a tooth period has at least twice as many."""
DEFAULT_DEPTH_RATIO: Final = 25.0
"""Default deepest depth that is tried, over the same zero-order depth."""
SPEED_MARGIN: Final = 0.01
"""Default relative error of the spindle's speed."""


@dataclass(frozen=True)
class Milling:
    """Describe a milling process; tool axis along the platform's z, clockwise from above.

    ``teeth``: number, evenly spaced, without helix. ``tangential``: cutting coefficient Kt, N/m2.
    ``radial``: force across over tangential force, Kr. ``immersion``: radial depth of cut over tool
    diameter, 0.001 to 1. ``up``: up-milling instead of down-milling. ``feed``: direction of the
    feed in the platform's xy plane from x towards y, rad.

    :raises ParameterError: a number out of range.
    """

    teeth: int
    tangential: float
    radial: float
    immersion: float = 1.0
    up: bool = False
    feed: float = 0.0

    def __post_init__(self) -> None:
        bounds = {
            "teeth": (1 <= self.teeth <= 100, "1 to 100"),
            "tangential": (1e6 <= self.tangential <= 1e11, "1e6 to 1e11 N/m2, as 600e6 for 600 MPa"),
            "radial": (-10.0 <= self.radial <= 10.0, "-10 to 10, a ratio"),
            "immersion": (1e-3 <= self.immersion <= 1.0, "0.001 to 1, a ratio"),
            "feed": (abs(self.feed) < 1e3, "an angle, rad"),
        }
        for field in fields(self):
            good, text = bounds.get(field.name, (True, ""))
            if not good:
                raise ParameterError(field.name, getattr(self, field.name), text)

    @property
    def engaged(self) -> tuple[float, float]:
        """Angles at which a tooth enters and leaves, from y towards x, rad."""
        width = float(np.arccos(1.0 - 2.0 * self.immersion))
        return (0.0, width) if self.up else (np.pi - width, np.pi)

    def primitive(self, angle: Array) -> Array:
        """Integrate one tooth's W from 0 to angles (...), the cut alone, shape (..., 2, 2)."""
        a = np.clip(angle, *self.engaged)
        sine_squared, sine_cosine = 0.5 * a - 0.25 * np.sin(2.0 * a), 0.5 * np.sin(a) ** 2
        cosine_squared, r = a - sine_squared, self.radial
        rows = [
            [sine_cosine + r * sine_squared, cosine_squared + r * sine_cosine],
            [r * sine_cosine - sine_squared, r * cosine_squared - sine_cosine],
        ]
        return self.tangential * np.moveaxis(np.array(rows), (0, 1), (-2, -1))

    def mean(self) -> Array:
        """Return W averaged over time, shape (2, 2)."""
        ends = self.primitive(np.array(self.engaged))
        return np.asarray(self.teeth / (2.0 * np.pi) * (ends[1] - ends[0]))

    def steps(self, count: int) -> Array:
        """Return the mean of W in each of ``count`` steps of a tooth period, (count, 2, 2)."""
        pitch = 2.0 * np.pi / self.teeth
        edges = pitch / count * (np.arange(count + 1) - 0.5)
        angles = edges + pitch * np.arange(self.teeth)[:, None]
        total = self.primitive(angles).sum(0)
        return np.asarray(np.diff(total, axis=0) * (count / pitch))


@dataclass(frozen=True, eq=False)
class Lobes:
    """Hold limit depths over spindle speeds.

    ``speeds``: (k,), rpm. ``depths``: (k,), m, the depth at which the cut becomes unstable.
    ``open``: (k,), where the cut is stable at the deepest depth that was tried; ``depths`` then has
    that depth.
    ``safe``: the zero-order depth that is stable at every speed, m.
    """

    speeds: Array
    depths: Array
    open: Mask
    safe: float

    @property
    def best(self) -> int:
        """Index of the speed with the greatest depth; of several such speeds the fastest."""
        return int(np.flatnonzero(self.depths == self.depths.max())[-1])

    def steady(self, margin: float = SPEED_MARGIN) -> tuple[float, float, bool]:
        """Return the speed (rpm) with the largest depth that stays stable under speed errors.

        Also returns that depth, m, and True if it is the largest depth tried (no limit was found).

        The depth (m) is stable at all speeds within the margin, and at the next ones on both sides. If
        the range of speeds is narrower than the margin, its middle is taken. Speeds must rise.

        :param margin: relative error of the speed.
        """
        last = len(self.speeds) - 1
        low = np.searchsorted(self.speeds, self.speeds * (1.0 - margin), "right") - 1
        high = np.searchsorted(self.speeds, self.speeds * (1.0 + margin), "left")
        inside = np.flatnonzero((low >= 0) & (high <= last))
        if not len(inside):
            middle = 0.5 * float(self.speeds[0] + self.speeds[-1])
            return middle, float(self.depths.min()), bool(self.open.all())
        lowest_depths = np.array([self.depths[low[k] : high[k] + 1].min() for k in inside])
        k = int(np.flatnonzero(lowest_depths == lowest_depths.max())[-1])
        at = int(inside[k])
        all_open = bool(self.open[low[at] : high[at] + 1].all())
        return float(self.speeds[at]), float(lowest_depths[k]), all_open

    def gaps(self, waves: Array) -> Mask:
        """Return a mask of the intervals between neighbouring speeds that need refinement, shape (k - 1,).

        :param waves: vibrations of the fastest mode from tooth to tooth, by speed, shape (k,).
        """
        n, depth = self.speeds, self.depths
        ratio = np.maximum(depth[1:], depth[:-1]) / np.minimum(depth[1:], depth[:-1])
        before, after = np.append(1.0, ratio), np.append(ratio, 1.0)
        falls = np.append(True, np.diff(depth) <= 0.0)
        lowest = falls & np.append(np.diff(depth) >= 0.0, True)
        # Refine until minima are known to 0.1 %, steps of the depth by a quarter (where it may be
        # discontinuous) to 0.05 % of the speed, and lobes, one vibration wide, have ten speeds.
        near_minimum = lowest & (np.maximum(before, after) > 1.001)
        split = (ratio > 1.25) | near_minimum[1:] | near_minimum[:-1]
        split = (split & (np.diff(n) > 5e-4 * n[1:])) | (waves[:-1] - waves[1:] > 0.1)
        if not split.any():
            best = self.steady()[0]
            inside_margin = (n[1:] > (1.0 - SPEED_MARGIN) * best) & (n[:-1] < (1.0 + SPEED_MARGIN) * best)
            split = inside_margin & (np.diff(n) > 1e-3 * n[1:])
        return np.asarray(split)


@dataclass(frozen=True, eq=False)
class CuttingPlaneModes:
    """Hold modes in the cutting plane: rad/s, damping ratios (m,), shapes (m, 2) of unit mass."""

    turn: Array
    damping: Array
    shapes: Array

    @classmethod
    def project(cls, modes: ToolModes, milling: Milling) -> CuttingPlaneModes:
        """Project tool-point modes onto the cutting plane; keep at most 8, and drop those below 1 %."""
        c, s = np.cos(milling.feed), np.sin(milling.feed)
        axes = modes.rotation @ np.array([[c, -s], [s, c], [0.0, 0.0]])
        shapes, turn = modes.shapes[:, :3] @ axes, 2.0 * np.pi * modes.frequencies
        peak = (shapes**2).sum(1) / (2.0 * modes.damping * turn**2)
        order = np.argsort(-peak)[:8]
        kept = np.sort(order[peak[order] >= 0.01 * peak.max()])
        return cls(turn[kept], modes.damping[kept], shapes[kept])

    def stable_depth(self, milling: Milling) -> tuple[float, float]:
        """Return the zero-order depth that is stable at every speed, m, and its chatter frequency, rad/s."""
        far_offsets = np.geomspace(4.0, 100.0, 16)
        offsets = np.concatenate([-far_offsets, np.linspace(-4.0, 4.0, 65), far_offsets])
        omega = (self.turn[:, None] * (1.0 + self.damping[:, None] * offsets)).ravel()
        omega = omega[omega > 0.0]
        real = self._oriented_eigenvalues(milling, omega).real.min(1)
        k = int(real.argmin())
        return (-0.5 / float(real[k]) if real[k] < 0.0 else np.inf), float(omega[k])

    def _oriented_eigenvalues(self, milling: Milling, at: Array) -> Complex:
        """Return the eigenvalues of mean W times the response at rad/s (k,), shape (k, 2)."""
        response = responses(at, self.turn, self.damping, self.shapes)
        return np.asarray(np.linalg.eigvals(milling.mean() @ response))

    def lobe_speeds(self, milling: Milling, low: float, high: float) -> Array:
        """Return the speeds in a range at which zero-order lobes are deepest, rpm, (k,).

        For each mode, a whole number of vibrations plus the lobe's phase fits into a tooth period
        at its worst frequency; for period doubling (every second tooth cuts deeper) half a
        vibration more at its own frequency.
        """
        found: list[float] = []
        for w, z in zip(self.turn, self.damping, strict=True):
            omega = w * (1.0 + z * np.linspace(-3.0, 3.0, 61))
            values = self._oriented_eigenvalues(milling, omega)
            k, i = np.unravel_index(int(values.real.argmin()), values.shape)
            phase = np.pi - 2.0 * float(np.angle(-1.0 / values[k, i]))
            period_doubling = [(w * (1.0 + part * z), np.pi) for part in (-1.0, 0.0, 1.0)]
            for turn, extra in ((float(omega[k]), phase), *period_doubling):
                tooth_rate = 60.0 * turn / (2.0 * np.pi * milling.teeth)
                periods = np.arange(-1.0, np.ceil(tooth_rate / low) + 1.0) + extra / (2.0 * np.pi)
                found += [tooth_rate / n for n in periods.tolist() if n > 0.0 and low < tooth_rate / n < high]
        return np.array(found)

    def waves(self, milling: Milling, speeds: Array) -> Array:
        """Return the fastest mode's vibrations per tooth period at speeds, rpm."""
        return np.asarray(60.0 * self.turn.max() / (2.0 * np.pi * milling.teeth) / speeds)

    def spectral_radius(self, milling: Milling, speed: float, depths: Array) -> Array:
        """Return the spectral radius of the motion over a tooth period, for depths (k,), m, at a speed."""
        period = 60.0 / (speed * milling.teeth)
        waves = float(self.waves(milling, np.array(speed)))
        count = max(2 * STEPS_PER_WAVE, int(np.ceil(STEPS_PER_WAVE * waves)))
        force, h = milling.steps(count), period / count
        # Matrices of a step: free motion, (m, 2, 2), and response to the forces at its begin and end, (m, 2),
        # which follow from the responses to a constant and to a rising force.
        w, z = self.turn, self.damping
        root = w * np.sqrt(1.0 - z * z)
        decay, c, s = np.exp(-z * w * h), np.cos(root * h), np.sin(root * h) / root
        free = np.array([[c + z * w * s, s], [-w * w * s, c - z * w * s]]) * decay
        constant_gain = np.array([(1.0 - free[0, 0]) / w**2, free[0, 1]])
        rising_gain = np.array([h - 2.0 * z / w * (1.0 - free[0, 0]) - free[0, 1], 1.0 - free[0, 0]])
        end = rising_gain / (w**2 * h)
        free, begin, end = np.moveaxis(free, -1, 0), (constant_gain - end).T, end.T
        # Only displacements while a tooth cuts change later forces. They are smooth: fit polynomials of time.
        cut = np.flatnonzero(np.abs(force).max((1, 2)) > 1e-12 * milling.tangential)
        parts = np.split(cut, np.flatnonzero(np.diff(cut) > 1) + 1)
        basis = scipy.linalg.block_diag(*(_chebyshev_basis(len(part), waves / count) for part in parts))
        states = 2 * len(self.turn)
        n, b = states + 2 * basis.shape[1], depths[:, None, None]
        before = np.zeros((count, 2, n))
        before[cut, 0, states::2] = before[cut, 1, states + 1 :: 2] = basis
        begins, ends = (v[:, :, None] * self.shapes[:, None] for v in (begin, end))
        gain, transposed_shapes = self.shapes.T @ ends[:, 0], self.shapes.T
        state = np.broadcast_to(np.eye(states, n).reshape(-1, 2, n), (len(depths), states // 2, 2, n))
        first = u = transposed_shapes @ state[:, :, 0]
        f = -b * (force[0] @ (u - before[0]))
        rows = []
        for k in range(count):
            rows.append(u)
            cutting = force[(k + 1) % count]
            earlier = before[k + 1] if k + 1 < count else first
            state = free @ state + begins @ f[:, None]
            u = transposed_shapes @ state[:, :, 0]
            f = -b * np.linalg.solve(np.eye(2) + b * (cutting @ gain), cutting @ (u - earlier))
            state, u = state + ends @ f[:, None], u + gain @ f
        coefficients = np.einsum("ck,kdin->dcin", np.linalg.pinv(basis), np.array(rows)[cut])
        transition = np.concatenate([part.reshape(len(depths), -1, n) for part in (state, coefficients)], 1)
        return np.asarray(np.abs(np.linalg.eigvals(transition)).max(-1))

    def find_limit(self, milling: Milling, speed: float, low: float, deepest: float) -> float:
        """Find the smallest unstable depth at a speed, m; infinite if the deepest is stable.

        :param low: depth to begin at.
        """

        def log_radius(depth: float) -> float:
            return float(np.log(self.spectral_radius(milling, speed, np.array([depth]))[0]))

        while log_radius(low) >= 0.0:
            low /= 4.0
        # Raise the depth by a quarter until the cut is unstable.
        count = max(2, int(np.ceil(np.log(deepest / low) / np.log(1.25))) + 1)
        tried = np.geomspace(low, deepest, count)
        for part in np.array_split(np.arange(1, count), max(1, count // 5)):
            unstable = self.spectral_radius(milling, speed, tried[part]) >= 1.0
            if unstable.any():
                k = int(part[unstable.argmax()])
                return float(scipy.optimize.brentq(log_radius, tried[k - 1], tried[k], rtol=2e-4))
        return np.inf


def _chebyshev_basis(count: int, waves: float) -> Array:
    """Return polynomials at even steps, (count, degree + 1); the identity for few steps.

    :param waves: vibrations per step.
    """
    # Four degrees per vibration, and ten more, resolve it to rounding.
    degree = 10 + int(np.ceil(4.0 * waves * count))
    if count < 2 * degree:
        return np.eye(count)
    return np.asarray(np.polynomial.chebyshev.chebvander(np.linspace(-1.0, 1.0, count), degree))


def stability_lobes(
    robot: Robot,
    pose: ArrayLike,
    milling: Milling,
    speeds: ArrayLike,
    *,
    damping: ArrayLike | None = None,
    tool: ArrayLike = (0.0, 0.0, 0.0),
    deepest: float | None = None,
) -> Lobes:
    """Find the axial depths at which milling begins to chatter, over spindle speeds.

    Uses the lowest modes that move the tool point in the cutting plane, with locked actuators.

    :param pose: shape (m,), the mechanism's pose coordinates, m and rad.
    :param speeds: spindle speeds, shape (k,), rpm.
    :param damping, tool: as in :func:`~stiffness_monitor.vibration.tool_modes`; so are errors.
    :param deepest: depth up to which to look, m; default :data:`DEFAULT_DEPTH_RATIO` times the
        depth that is stable at every speed.
    :raises ParameterError: a speed with more than :data:`MAX_WAVES_PER_TOOTH` vibrations from tooth to tooth.
    """
    return lobes_from_modes(tool_modes(robot, pose, damping=damping, tool=tool), milling, speeds, deepest)


def lobes_from_modes(modes: ToolModes, milling: Milling, speeds: ArrayLike, deepest: float | None = None) -> Lobes:
    """Find limit depths as :func:`stability_lobes`, from the tool point's modes."""
    plane = CuttingPlaneModes.project(modes, milling)
    at = np.atleast_1d(np.asarray(speeds, np.float64))
    last, safe = _find_depth_range(plane, milling, at, deepest)
    return _find_limit_depths(plane, milling, at, last, safe)


def refine_lobes(
    modes: ToolModes, milling: Milling, low: float, high: float, points: int, deepest: float | None = None
) -> Lobes:
    """Find limit depths over a speed range, dense enough for its smallest and best depth.

    Evenly spaced speeds, those where the zero-order approximation has its lobes, and further ones:
    ten for each vibration of the fastest mode from tooth to tooth; until both neighbours of every
    minimum are within 0.1 % of its depth; until depths that differ by more than a quarter are
    0.05 % of the speed apart; and until speeds within the margin of :meth:`Lobes.steady` are
    0.1 % apart.

    :param low, high: rpm. ``points``: number of evenly spaced speeds. Others, and errors, as
        :func:`lobes_from_modes`.
    """
    plane = CuttingPlaneModes.project(modes, milling)
    even = np.linspace(low, high, points)
    last, safe = _find_depth_range(plane, milling, even, deepest)
    new = np.union1d(even, plane.lobe_speeds(milling, low, high))
    found = _find_limit_depths(plane, milling, new, last, safe)
    while True:
        n, depth = found.speeds, found.depths
        split = found.gaps(plane.waves(milling, n))
        if not split.any():
            return found
        more = _find_limit_depths(plane, milling, 0.5 * (n[1:] + n[:-1])[split], last, safe)
        order = np.argsort(np.concatenate([n, more.speeds]))
        found = Lobes(
            np.concatenate([n, more.speeds])[order],
            np.concatenate([depth, more.depths])[order],
            np.concatenate([found.open, more.open])[order],
            safe,
        )


def _find_depth_range(
    plane: CuttingPlaneModes, milling: Milling, at: Array, deepest: float | None
) -> tuple[float, float]:
    """Return the largest depth to try and the zero-order depth, m; reject inputs as :func:`lobes_from_modes`."""
    if at.ndim != 1:
        raise ParameterError("speeds", at.shape, "one speed after another")
    for speed in (at.min(), at.max()) if at.size else ():
        check_limit("speeds", float(speed), "rpm", 1e-3, 1e6)
    waves = plane.waves(milling, at)
    if len(at) and waves.max() > MAX_WAVES_PER_TOOTH * (1.0 + 1e-12):
        bound = f"{at.min() * waves.max() / MAX_WAVES_PER_TOOTH:.4g} rpm or more: process damping governs below"
        raise ParameterError("speeds", at.min(), bound)
    safe, _ = plane.stable_depth(milling)
    if deepest is None and not np.isfinite(safe):
        raise ParameterError("deepest", None, "a depth, m, as no depth is unstable in theory")
    if deepest is None:
        return DEFAULT_DEPTH_RATIO * safe, safe
    check_limit("deepest", deepest, "m", *(1e-6, 10.0))
    return float(deepest), safe


def _find_limit_depths(plane: CuttingPlaneModes, milling: Milling, at: Array, last: float, safe: float) -> Lobes:
    low = min(0.4 * safe, 0.5 * last)
    found = np.array([plane.find_limit(milling, float(speed), low, last) for speed in at])
    return Lobes(at, np.minimum(found, last), found > last, safe)


def stable_depth(
    robot: Robot,
    pose: ArrayLike,
    milling: Milling,
    *,
    damping: ArrayLike | None = None,
    tool: ArrayLike = (0.0, 0.0, 0.0),
) -> float:
    """Return the axial depth that is stable at every spindle speed in zero order, m.

    An interrupted cut can chatter at a smaller depth at some speeds, see :func:`refine_lobes`.
    Infinite where no depth is unstable. Parameters and errors as :func:`stability_lobes`.
    """
    return stable_depth_from_modes(tool_modes(robot, pose, damping=damping, tool=tool), milling)[0]


def stable_depth_from_modes(modes: ToolModes, milling: Milling) -> tuple[float, int]:
    """Return the modes' zero-order stable depth, m, and the index of the chattering mode."""
    depth, turn = CuttingPlaneModes.project(modes, milling).stable_depth(milling)
    return depth, int(np.abs(2.0 * np.pi * modes.frequencies - turn).argmin())
