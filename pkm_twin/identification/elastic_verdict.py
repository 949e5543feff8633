# SPDX-License-Identifier: Apache-2.0
"""The verdict on a fit of elastic elements: its residual against noise and common errors.

Noise is what differs between neighbours in time where loads change slowly; elsewhere all that the
fit leaves is taken for noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.identification.estimation import Estimate
from pkm_twin.identification.judge import Evidence, judge
from pkm_twin.identification.verdict import Suspect, Verdict
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.deflection import in_base_axes
from stiffness_monitor.response import ElementResponse

Model = tuple[ElementResponse, Array, Array]
"""The elements in the poses of a recording; its joints (k, n) and wrenches (k, 6)."""

SMOOTH: Final = 0.2
"""Of neighbours' difference over the signal: below, what differs between neighbours is noise."""
AXES: Final = ("x", "y", "z")


def elastic_verdict(
    robot: Robot,
    directions: Sequence[str],
    models: Sequence[Model],
    left: Sequence[Array],
    found: Estimate,
    table: Array,
    before: Array,
) -> Verdict:
    """Judge a fit of factors on the compliance of the elements.

    :param directions: names of the six directions.
    :param models: by recording. ``left``: its deflection less the fitted one, (k, 6), NaN where it
        was not measured; the first samples are those that were fitted.
    :param found: factors, then zeros of the instrument. ``table``: their columns, (samples, 6, e),
        the fitted samples of all recordings one after the other.
    :param before: factors and zeros before, (e,).
    """
    factors = found.values[: len(models[0][0].names)]
    suspects = _suspects(robot, directions)
    measured = np.any([np.isfinite(one).any(0) for one in left], 0)
    ends = _ends(left, len(table))
    cases = []
    for i, ((response, q, wrench), residual, end) in enumerate(
        zip(models, left, ends, strict=True)
    ):
        counts = np.isfinite(residual)
        told, slopes = response.deflection(wrench, factors)
        errors = np.stack(list(_columns(response, q, wrench, factors, told)), -1)
        zeros = np.zeros((*residual.shape, 6 * len(models)))
        zeros[..., 6 * i : 6 * i + 6] = np.eye(6)
        own = np.where(counts, told, 0.0)
        columns = np.concatenate([slopes, zeros], -1)
        cases.append(
            Evidence(
                np.where(counts, residual, 0.0)[:, measured],
                columns[:, measured], np.zeros((*own[:, measured].shape, 0)),
                np.zeros(int(measured.sum())), errors[:, measured],
                _noise(residual, own, columns.shape[-1])[measured], 1.0,
                counts[:, measured].astype(np.float64), end,
                np.sqrt(np.mean(own**2, 0))[measured], np.std(own, 0)[measured],
            )
        )  # fmt: skip

    def respond(signals: Sequence[Array]) -> Array:
        whole = []
        for signal, end in zip(signals, ends, strict=True):
            full = np.zeros((end, 6, signal.shape[-1]))
            full[:, measured] = signal[:end]
            whole.append(full)
        return found.response(table, np.concatenate(whole))

    prior = found.values - before, found.prior, np.sqrt(np.diag(found.covariance))
    names = [name for name, good in zip(directions, measured.tolist(), strict=True) if good]
    told = judge(names, suspects, cases, prior, respond)
    # Factors are not corrected: what the suspects probably changed is uncertain.
    return replace(told, unseen=np.concatenate([told.unseen, told.shift[None]]))


def _ends(left: Sequence[Array], samples: int) -> list[int]:
    """How many samples of each recording were fitted."""
    total = sum(len(one) for one in left)
    ends = [round(samples * len(one) / total) for one in left]
    ends[-1] += samples - sum(ends)
    return ends


def _noise(left: Array, told: Array, fitted: int) -> Array:
    """Deviation of a deflection's noise by direction, shape (6,)."""
    result = np.zeros(6)
    for k in range(6):
        good = np.isfinite(left[:, k])
        values, signal = left[good, k], told[good, k]
        if len(values) < 4:
            continue
        free = max(len(values) - fitted / 6.0, 1.0)
        result[k] = np.sqrt(np.sum((values - values.mean()) ** 2) / free)
        # Of second differences, which are of no slope, the variance is six times the noise's.
        apart = np.sqrt(np.mean(np.diff(signal, 2) ** 2) / 6.0)
        if apart < SMOOTH * max(float(np.std(signal)), 1e-300):
            rough = np.sqrt(np.mean(np.diff(values, 2) ** 2) / 6.0)
            result[k] = min(result[k], float(rough))
    return result


def _suspects(robot: Robot, directions: Sequence[str]) -> list[Suspect]:
    """The errors whose columns :func:`_columns` gives, in their order."""
    units = ["m"] * 3 + ["rad"] * 3
    found = [Suspect("gain of the deflection", name, usual=0.05) for name in directions]
    found += [Suspect("gain of the wrench", f"f{axis}", usual=0.05) for axis in AXES]
    found += [Suspect("gain of the wrench", f"m{axis}", usual=0.05) for axis in AXES]
    found += [
        Suspect("the wrench's point of attack", axis, "m", 0.05 * robot.size) for axis in AXES
    ]
    found += [Suspect("axes of the wrench turned about", axis, "rad") for axis in AXES]
    found += [Suspect("axes of the deflection turned about", axis, "rad") for axis in AXES]
    found += [
        Suspect("stiffness that changes with the load", name, "", None) for name in directions
    ]
    found += [
        Suspect("hysteresis", name, unit) for name, unit in zip(directions, units, strict=True)
    ]
    found += [
        Suspect("drift", name, f"{unit}, from first to last")
        for name, unit in zip(directions, units, strict=True)
    ]
    found += [
        Suspect("base that gives", name, f"{unit}/{'N' if unit == 'm' else '(N m)'}")
        for name, unit in zip(directions, units, strict=True)
    ]
    for joint in robot.joint_names:
        found += [Suspect("compliance that changes with the pose", joint) for _ in directions]
    return found


def _columns(
    response: ElementResponse, q: Array, wrench: Array, factors: Array, told: Array
) -> Iterator[Array]:
    """Derivatives of the measured deflections by the suspects' sizes, (k, 6) each."""
    eye = np.eye(6)

    def bent(load: Array) -> Array:
        return response.deflection(load, factors)[0]

    yield from (told * e for e in eye)
    yield from (-bent(wrench * e) for e in eye)
    for e in np.eye(3):
        yield bent(np.concatenate([0.0 * wrench[:, :3], np.cross(e, wrench[:, :3])], 1))
    for e in np.eye(3):
        yield bent(np.concatenate([np.cross(e, wrench[:, k : k + 3]) for k in (0, 3)], 1))
    for e in np.eye(3):
        yield np.concatenate([np.cross(e, told[:, k : k + 3]) for k in (0, 3)], 1)
    size = np.maximum(np.abs(told).max(0), 1e-300)
    yield from (told * np.abs(told) / size * e for e in eye)
    rate = np.sign(np.gradient(told, axis=0))
    yield from (rate * e for e in eye)
    yield from (np.linspace(-0.5, 0.5, len(told))[:, None] * e for e in eye)
    yield from (wrench * e for e in eye)
    place = q - q.mean(0)
    place = place / np.maximum(np.abs(place).max(0), 1e-300)
    for k in range(q.shape[1]):
        yield from (told * place[:, [k]] * e for e in eye)


def put_right(
    robot: Robot, q: Array, wrench: Array, deflection: Array
) -> Iterator[tuple[str, Array, Array]]:
    """Faults of a recording, and its wrenches and deflections without them."""
    rotation = robot.rotation(robot.forward(q))
    back = np.swapaxes(rotation, -1, -2)
    base, platform = "the base's axes", "the platform's"
    yield (
        f"the wrench is in {platform} axes, not in {base}",
        in_base_axes(wrench, rotation),
        deflection,
    )
    yield f"the wrench is in {base}, not in {platform}", in_base_axes(wrench, back), deflection
    own = in_base_axes(deflection, rotation)
    yield f"the deflection is in {platform} axes, not in {base}", wrench, own
    for first in (0, 3):
        for i, j in ((0, 1), (0, 2), (1, 2)):
            order = np.arange(6)
            order[[first + i, first + j]] = first + j, first + i
            pair = f"{AXES[i]} and {AXES[j]}"
            of = "forces" if first == 0 else "moments"
            yield f"{of} along {pair} are exchanged", wrench[:, order], deflection
            of = "shifts" if first == 0 else "turns"
            yield f"{of} along {pair} are exchanged", wrench, deflection[:, order]
    for k in range(6):
        sign = np.where(np.arange(6) == k, -1.0, 1.0)
        name = f"{'f' if k < 3 else 'm'}{AXES[k % 3]}"
        yield f"{name} has the wrong sign", wrench * sign, deflection
        name = f"{'d' if k < 3 else 'r'}{AXES[k % 3]}"
        yield f"{name} has the wrong sign", wrench, deflection * sign
    mixed = np.repeat([1.0, 1e-3], 3)
    yield "moments are in N mm, forces in N", wrench * mixed, deflection
    yield "turns are in mrad, shifts in m", wrench, deflection * mixed
    yield "shifts are in mm, turns in rad", wrench, deflection * mixed[::-1]
