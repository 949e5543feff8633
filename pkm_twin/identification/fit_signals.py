# SPDX-License-Identifier: Apache-2.0
"""What a fit's residual is held against: the noise above the motion's band, and common errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for

from pkm_twin.codegen.arrays import Array
from pkm_twin.identification.noise import Resonance, passed_band
from pkm_twin.identification.samples import DEGREE, Filtering, Track, low_pass
from pkm_twin.identification.verdict import Suspect
from pkm_twin.robot.robot import Robot

Efforts = Callable[[Array, Array, Array], Array]
"""Of positions, rates and accelerations (k, n) at the rows of a recording, shape (k, n)."""

GAIN: Final = "gain of the efforts"
LATE: Final = "efforts late"
LOAD: Final = "friction that grows with the load"
OFFSET: Final = "sensor offset"
ELASTIC: Final = "elastic drive"
SPEED: Final = "time at another rate"
STRIBECK: Final = (0.05, 0.1, 0.2)
"""Speeds below which static friction shows, over the rms speed."""
STEP: Final = 1e-4
"""Of difference quotients by an offset or a give, rad or machine sizes."""
MOTION: Final = 0.4
"""Part of the filter's cut-off in which nearly all of the motion is."""
SMOOTH: Final = 5
"""Degree of the splines that have the motion below it."""
RESONANCE: Final = "drive resonance"
INTERFERENCE: Final = "interference at one frequency"
CENTRAL: Final = (7, 6)
"""Samples and degree of the polynomial whose derivatives in its middle are central differences of
sixth order."""
ENDS: Final = (9, 4)
"""And of the one that is differentiated at the ends of a piece: there are no samples beyond."""


@dataclass(frozen=True, eq=False)
class Signals:
    """Signals of a recording at its rows, filtered as they are; k rows, n joints.

    ``motion``: q, qd and qdd, without noise beyond the motion's band, and ``missed``: what the
    differentiation misses of qd and qdd; ``load``: of the efforts without friction, with its first
    and second derivative, (k, n) each. ``effort``: what a first fit predicts, and its derivative.
    ``own``: friction of other laws, a unit of each, (k, n, laws). ``wrench``: (k, 6); ``held``:
    (k,). ``noise``: deviation of a row's noise as if rows were independent, (n,). ``band``: the
    part of the rows' rate that the filter passes. ``resonances``: of the residual above the band.
    """

    motion: tuple[Array, Array, Array]
    missed: tuple[Array, Array]
    load: tuple[Array, Array, Array]
    effort: tuple[Array, Array]
    own: Array
    wrench: Array
    held: Array
    noise: Array
    band: float
    resonances: tuple[Resonance, ...] = ()


def signals_of(
    tracks: Sequence[Track], told: Sequence[Array], rub: Sequence[Array], how: Filtering,
    noise: Array, resonances: tuple[Resonance, ...] = (),
) -> Signals:  # fmt: skip
    """The signals of a recording's pieces.

    :param told: efforts of a first fit, every sample, (samples, n) each. ``rub``: the part of them
        that is friction of the drives.
        ``noise``: of :func:`.noise.noise_of`. ``resonances``: of :func:`.noise.resonances_of`.
    """
    speed = np.sqrt(np.mean(np.concatenate([t.qd for t in tracks]) ** 2, 0))
    parts = []
    for track, effort, friction in zip(tracks, told, rub, strict=True):
        load, sign = effort - friction, np.sign(track.qd)
        laws = [np.abs(load) * sign, track.qd * np.abs(track.qd)]
        for share in STRIBECK:
            laws.append(np.exp(-((track.qd / np.maximum(share * speed, 1e-300)) ** 2)) * sign)
        change = np.gradient(effort, track.period, axis=0)
        columns = [effort, change, *_calm(track, load, how), *laws, track.wrench]
        whole = np.concatenate([*columns, track.held[:, None]], 1)
        parts.append(low_pass(whole, track.period, how))
    whole = np.concatenate(parts)
    count = 10 + 2 + len(STRIBECK)
    each = np.split(whole[:, : count * tracks[0].q.shape[1]], count, 1)
    rate = 1.0 / (tracks[0].period * how.keep_every)
    return Signals(
        (each[2], each[3], each[4]), (each[5], each[6]), (each[7], each[8], each[9]),
        (each[0], each[1]), np.stack(each[10:], -1), whole[:, -7:-1], whole[:, -1],
        noise * np.sqrt(rate), passed_band(how, rate), resonances,
    )  # fmt: skip


def _calm(track: Track, load: Array, how: Filtering) -> list[Array]:
    """Motion and load in the motion's own band, where nearly no noise is, (samples, n) each.

    Positions, rates and accelerations; what the local polynomials miss of the latter two; the load
    and its derivatives. Noise in both of two columns would look like something in common.
    """
    cutoff = None if how.cutoff is None else MOTION * how.cutoff
    motion, force = (calm(values, track.period, cutoff) for values in (track.q, load))
    missed = []
    inner = slice(how.window // 2 + 3, len(load) - how.window // 2 - 3)
    for order in (1, 2):
        rough = scipy.signal.savgol_filter(
            motion[0], how.window, DEGREE, order, track.period, axis=0
        )
        apart = np.zeros_like(rough)
        apart[inner] = (rough - motion[order])[inner]
        missed.append(apart)
    return [*motion, *missed, *force]


def calm(values: Array, period: float, cutoff: float | None) -> list[Array]:
    """Signals (samples, n) below a frequency, Hz, with their first and second derivative.

    A least-squares spline with two knots a period: unlike a filter's, its ends take nothing for
    granted of what is beyond them, so that derivatives hold there too. None: as they are.
    """
    if cutoff is None:
        return [values, *(derivative(values, order, period) for order in (1, 2))]
    last = (len(values) - 1) * period
    places = np.linspace(0.0, last, 1 + max(1, round(2.0 * cutoff * last)))
    knots = np.concatenate([np.zeros(SMOOTH), places, np.full(SMOOTH, last)])
    time = np.linspace(0.0, last, len(values))
    spline = scipy.interpolate.make_lsq_spline(time, values, knots, SMOOTH)
    return [np.asarray(spline(time, order), np.float64) for order in range(3)]


def derivative(values: Array, order: int, period: float) -> Array:
    """Along the first axis: central differences of sixth order, polynomials at the ends."""
    inner, ends = (
        scipy.signal.savgol_filter(values, points, degree, order, period, axis=0, mode="interp")
        for points, degree in (CENTRAL, ENDS)
    )
    beside = CENTRAL[0] // 2
    return np.concatenate([ends[:beside], inner[beside:-beside], ends[-beside:]])


def suspects_of(robot: Robot) -> list[Suspect]:
    """The errors whose columns :func:`columns_of` gives, in their order."""
    names, units, efforts = robot.joint_names, robot.joint_units, robot.effort_units
    lengths = lengths_of(robot)
    # A law of the robot is fitted.
    share = None if "load-dependent" in robot.laws else 0.05
    found = [Suspect(GAIN, name, usual=0.05) for name in names]
    found += [Suspect(LATE, name, "s", 2e-3) for name in names]
    found += [Suspect(LOAD, name, usual=share) for name in names]
    found += [
        Suspect("friction that grows with the square of the speed", name, f"{e} s2/{u}2")
        for name, u, e in zip(names, units, efforts, strict=True)
    ]
    for _ in STRIBECK:
        found += [
            Suspect("static friction above Coulomb friction", name, unit)
            for name, unit in zip(names, efforts, strict=True)
        ]
    found += [
        Suspect(OFFSET, name, unit, 0.01 * float(length))
        for name, unit, length in zip(names, units, lengths, strict=True)
    ]
    found += [
        Suspect(ELASTIC, name, f"{u}/({e})" if " " in e else f"{u}/{e}", positive=True)
        for name, u, e in zip(names, units, efforts, strict=True)
    ]
    found += [
        Suspect(GAIN, "all joints", usual=0.05), Suspect(LATE, "all joints", "s"),
        Suspect(LOAD, "all joints", usual=share), Suspect(SPEED, "all joints"),
    ]  # fmt: skip
    return found


def lengths_of(robot: Robot) -> Array:
    """A radian of the joints that turn, the machine's size of those that slide, (n,)."""
    return np.array([robot.size if unit == "m" else 1.0 for unit in robot.joint_units])


def columns_of(robot: Robot, signals: Signals, efforts: Efforts) -> tuple[Array, Array]:
    """Derivatives of the measured efforts by the suspects' sizes, shape (k, n, suspects).

    And what the differentiation misses, joint by joint, (k, n, n).
    """
    n = robot.joints_count
    eye = np.eye(n)
    unit = lengths_of(robot)
    told, change = signals.effort

    q, qd, qdd = signals.motion
    here = efforts(q, qd, qdd)
    missed = efforts(q, qd + signals.missed[0], qdd + signals.missed[1])

    def each(values: Array) -> list[Array]:
        return [values * e for e in eye]

    laws = np.moveaxis(signals.own, -1, 0)
    alone = each(told) + each(-change)
    for law in laws:
        alone += each(law)
    offsets = []
    for j in range(n):
        h = STEP * unit[j] * eye[j]
        apart = efforts(q - h, qd, qdd) - efforts(q + h, qd, qdd)
        offsets.append(apart / (2.0 * STEP * unit[j]))
    gives = []
    for j in range(n):
        # The load turns the drive's outer side back by so much.
        size = STEP * unit[j] / max(float(np.abs(signals.load[0][:, j]).max()), 1e-300)
        back = [size * one[:, [j]] * eye[j] for one in signals.load]
        moved = efforts(*(a - b for a, b in zip(signals.motion, back, strict=True)))
        gives.append((moved - here) / size)
    fast, slow = (efforts(q, rate * qd, rate**2 * qdd) for rate in (1.0 + STEP, 1.0 - STEP))
    speed = (fast - slow) / (2.0 * STEP)
    columns = [*alone, *offsets, *gives, told, -change, laws[0], speed]
    return np.stack(columns, -1), (missed - here)[..., None] * eye
