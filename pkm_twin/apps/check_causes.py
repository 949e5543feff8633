# SPDX-License-Identifier: Apache-2.0
"""Why measured efforts contradict the model: what is said here was put right and then agreed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import inverse_dynamics
from pkm_twin.apps.check_efforts import Efforts, compared_of, recorded_of
from pkm_twin.apps.loads import Load
from pkm_twin.apps.recorded import Recording
from pkm_twin.apps.wrench_frames import FRAMES
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.compare import Compared, by_held
from pkm_twin.robot.robot import Robot

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BLOCK: Final = 0.25
"""Time over which a payload is held or is not, s,"""
BLOCKS: Final = 400
"""and at most so many of them in a recording."""
SPANS: Final = 50
"""Most times that a payload is picked."""
LIGHTEST: Final = 1e-3
"""Part of the machine's mass below which a payload is none."""
BEFORE: Final = 0.2
"""Part of a recording that agrees before something else acts on the machine,"""
MOVED: Final = 0.5
"""and part of the peak efforts that are seen in it."""
FULL: Final = 0.01
"""Part of the samples whose effort is at its greatest where a sensor is saturated."""
FOUND: Final = 2
"""Findings of a fit that are named."""


def causes_of(r: Recording, efforts: Efforts, bound: float, thorough: bool = True) -> list[str]:
    """The likely cause of a bad residual, the first that explains it; empty where none does.

    :param bound: on the residual, as for :meth:`Compared.good`.
    :param thorough: also ask what `fit` finds, which takes some seconds.
    """
    c, leave_out = efforts.compared, efforts.left_out
    if c is None or c.good(bound).all():
        return []

    def explained(other: Recording, without: Mask | None = None) -> bool:
        try:
            found = compared_of(other, leave_out if without is None else leave_out | without)
        except (PkmTwinError, ValueError):
            return False
        return found is not None and bool(found.good(bound).all())

    for text, other, without in _changes(r, c, bound):
        if explained(other, without):
            return [text]
    found = _saturated(r, c, bound)
    return found or (_of_fit(r, leave_out) if thorough else [])


def _changes(
    r: Recording, c: Compared, bound: float
) -> Iterator[tuple[str, Recording, Mask | None]]:
    """What may be wrong, the recording with it put right, and samples to leave out."""
    yield from _wrenches(r)
    yield from _payloads(r, c, bound)
    begins = c.begins(c.limit(bound))
    before = c.time < (c.time[0] if begins is None else begins)
    # Before the motion is under way every machine agrees.
    moved = (
        before.mean() > BEFORE
        and (np.abs(c.expected[before]).max(0) > MOVED * np.abs(c.expected).max(0)).all()
    )
    if begins is not None and moved:
        yield (
            f"before {begins:.3f} s the efforts agree with the model, from then on something else "
            "acts on the machine (contact, collision or another load?)",
            r, r.time >= begins - 2.0 * c.edge,
        )  # fmt: skip


def _wrenches(r: Recording) -> Iterator[tuple[str, Recording, None]]:
    """Other readings of the wrench."""
    if r.wrench is None or not r.wrench.any():
        return
    rotation = r.robot.rotation(r.robot.forward(r.q))
    if r.topics.frame and r.topics.frame != FRAMES.get().base_frame:
        turned, axes = rotation.swapaxes(-1, -2), "base"
    else:
        turned, axes = rotation, "platform"
    moved = [np.einsum("nij,nj->ni", turned, r.wrench[:, k : k + 3]) for k in (0, 3)]
    yield f"the wrench has {axes} axes", replace(r, wrench=np.concatenate(moved, 1)), None
    text = "the wrench has the opposite sign: it is what the platform applies to its surroundings"
    yield text, replace(r, wrench=-r.wrench), None
    text = "without the wrench the efforts agree: it does not act on the platform"
    yield text, replace(r, wrench=None), None


def _payloads(r: Recording, c: Compared, bound: float) -> Iterator[tuple[str, Recording, None]]:
    """The payload that explains most, while it is held."""
    if r.load is not None:
        return

    def more(robot: Robot, *motion: Array) -> Array:
        heavy = robot.changed(payload={"mass": robot.payload.mass + 1.0})
        return inverse_dynamics(heavy, *motion) - inverse_dynamics(robot, *motion)

    try:
        column = c.filtered([by_held(r.robot, None, track, more) for track in c.tracks])
    except PkmTwinError:
        return
    weight = 1.0 / c.limit(bound) ** 2
    span = max(BLOCK, float(c.time[-1] - c.time[0]) / BLOCKS)
    block = np.floor((c.time - c.time[0]) / span).astype(np.int64)
    size = np.bincount(block, np.sum(weight * column**2, 1))
    pull = np.bincount(block, np.sum(weight * column * c.residual, 1))
    sums = [np.concatenate([[0.0], np.cumsum(one)]) for one in (pull, size)]
    ahead, below = (one[None, :] - one[:, None] for one in sums)
    gain = np.triu(np.maximum(ahead, 0.0) ** 2 / np.where(below > 0.0, below, np.inf), 1)
    first, last = np.unravel_index(int(np.argmax(gain)), gain.shape)
    mass = float(ahead[first, last] / max(below[first, last], 1e-300))
    total = sum(body.mass for body in r.robot.graph.bodies.values())
    if not mass > LIGHTEST * total:
        return
    held = pull > 0.5 * mass * size
    mass = float(pull[held].sum() / size[held].sum())
    times: list[tuple[float, float]] = []
    if not held.all():
        edges = np.flatnonzero(np.diff(np.concatenate([[False], held, [False]]).astype(int)))
        times = [
            (float(c.time[0] + a * span), float(c.time[0] + b * span))
            for a, b in pairwise(edges.tolist())
            if held[a]
        ]
    if len(times) > SPANS:
        return
    whole = r.robot.payload.mass + mass
    load = Load(float(f"{whole:.3g}"), None, tuple(times))
    text = f"a payload of {load.mass:g} kg explains the efforts: use --payload {load.mass:g}"
    if times:
        text += " --load-times " + ",".join(f"{edge:.2f}" for pair in times for edge in pair)
    yield text, replace(r, load=load), None


def _saturated(r: Recording, c: Compared, bound: float) -> list[str]:
    """Joints whose effort stays at its greatest while the model needs more, and else agrees."""
    assert r.effort is not None  # noqa: S101
    rows = np.searchsorted(r.time, c.time - 1e-9).clip(0, len(r.time) - 1)
    measured, limit = r.effort[rows], c.limit(bound)
    expected = measured - c.raw
    found, good = [], c.good(bound)
    for j, (joint, unit) in enumerate(zip(r.robot.joint_names, r.robot.effort_units, strict=True)):
        most = np.abs(measured[:, j]).max()
        full = np.abs(measured[:, j]) >= most * (1.0 - 1e-9)
        if good[j]:
            continue
        less = c.raw[~full, j]
        usual = 1.4826 * float(np.median(np.abs(less))) if len(less) else 0.0
        enough = (
            full.mean() > FULL
            and (np.abs(expected[full, j]) > most - limit[j] - 4.0 * usual).mean() > 1.0 - FULL
        )
        if not enough or (len(less) and np.sqrt(np.mean(less**2)) > limit[j] + 4.0 * usual):
            return []
        found.append(
            f"the effort of {joint} stays at {most:.4g} {unit} in {100 * full.mean():.2g} % of the "
            "samples while the model needs more: saturated?"
        )
    return found


def _of_fit(r: Recording, leave_out: Mask) -> list[str]:
    """What `fit` says of the recording: a fault of the recording, or its findings."""
    from pkm_twin.identification.file_parameters import file_parameters
    from pkm_twin.identification.fit import fit
    from pkm_twin.identification.fit_plausible import recording_fault
    from pkm_twin.identification.fit_rows import rows_of

    recorded: Any = recorded_of(r, leave_out)
    try:
        everything = file_parameters(r.robot)
        rows, _ = rows_of(r.robot, everything, recorded, None)
        fault = recording_fault(r.robot, everything, recorded, rows)
        if fault is not None:
            return [fault]
        verdict = fit(r.robot, [recorded], ("friction",), accept=True).verdict
    except (PkmTwinError, ValueError, np.linalg.LinAlgError):
        return []
    if verdict.answer == "does not explain":
        return []
    return [str(finding) for finding in verdict.findings[:FOUND]]
