# SPDX-License-Identifier: Apache-2.0
"""Why measured efforts contradict the model: what is said here was put right and then agreed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import inverse_dynamics
from pkm_twin.apps.check_efforts import MEASURED, NEAR, Efforts, compared_of, recorded_of
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
"""Part of the samples whose effort is at its greatest where a sensor is saturated,"""
TENS: Final = 30
"""and how many they are at least."""
FOUND: Final = 2
"""Findings of a fit that are named."""


@dataclass(frozen=True)
class Causes:
    """Why efforts contradict the model.

    ``explained``: the first cause that makes them agree, on the same samples; empty where none
    does. ``findings``: what `fit` says of them besides.
    """

    explained: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()


def causes_of(r: Recording, efforts: Efforts, bound: float, thorough: bool = True) -> Causes:
    """The likely cause of a bad residual.

    :param bound: on the residual, as for :meth:`Compared.good`.
    :param thorough: also ask what `fit` finds, which takes some seconds.
    """
    c, leave_out = efforts.compared, efforts.left_out
    measured = all(item.what != MEASURED for item in efforts.items)
    if c is None or c.good(bound).all() or not measured:
        return Causes()

    def good(other: Recording, without: Mask) -> bool:
        try:
            found = compared_of(other, without)
        except (PkmTwinError, ValueError):
            return False
        return found is not None and bool(found.good(bound).all())

    def explained(other: Recording) -> bool:
        """Whether it makes the efforts agree on samples on which they do not as recorded."""
        changes = other.load is not r.load and other.load is not None and bool(other.load.times)
        if not changes or other.load is None:
            return good(other, leave_out)
        without = leave_out | other.load.near_change(r.time, NEAR)
        return good(other, without) and not good(r, without)

    for text, other in (*_signs(r, c, bound), *_wrenches(r), *_payloads(r, c, bound)):
        if explained(other):
            return Causes((text,))
    found = _saturated(r, c, bound)
    if found:
        return Causes(tuple(found))
    for text, without in _contacts(r, c, bound):
        if good(r, leave_out | without):
            return Causes((text,))
    return _of_fit(r, leave_out, explained) if thorough else Causes()


def _signs(r: Recording, c: Compared, bound: float) -> Iterator[tuple[str, Recording]]:
    """Efforts of the other sign."""
    assert r.effort is not None  # noqa: S101
    turned = ~c.good(bound) & (np.sum(c.measured * c.expected, 0) < 0.0)
    if turned.any():
        names = ", ".join(np.array(r.robot.joint_names)[turned].tolist())
        effort = r.effort * np.where(turned, -1.0, 1.0)
        yield f"efforts of {names} have the opposite sign", replace(r, effort=effort)


def _contacts(r: Recording, c: Compared, bound: float) -> Iterator[tuple[str, Mask]]:
    """When something else begins to act on the machine, and the samples from then on."""
    begins = c.begins(c.limit(bound))
    if begins is None:
        return
    before = c.time < begins
    if before.mean() <= BEFORE:
        return
    # Before the motion is under way every machine agrees.
    seen = np.abs(c.expected[before]).max(0) > MOVED * np.abs(c.expected).max(0)
    if seen.all():
        yield (
            f"before {begins:.3f} s the efforts agree with the model, from then on something else "
            "acts on the machine (contact, collision or another load?)",
            r.time >= begins - 2.0 * c.edge,
        )  # fmt: skip


def _wrenches(r: Recording) -> Iterator[tuple[str, Recording]]:
    """Other readings of the wrench."""
    if r.wrench is None or not r.wrench.any():
        return
    rotation = r.robot.rotation(r.robot.forward(r.q))
    if r.topics.frame and r.topics.frame != FRAMES.get().base_frame:
        turned, axes = rotation.swapaxes(-1, -2), "base"
    else:
        turned, axes = rotation, "platform"
    moved = [np.einsum("nij,nj->ni", turned, r.wrench[:, k : k + 3]) for k in (0, 3)]
    yield f"the wrench has {axes} axes", replace(r, wrench=np.concatenate(moved, 1))
    text = "the wrench has the opposite sign: it is what the platform applies to its surroundings"
    yield text, replace(r, wrench=-r.wrench)
    text = "without the wrench the efforts agree: it does not act on the platform"
    yield text, replace(r, wrench=None)


def _payloads(r: Recording, c: Compared, bound: float) -> Iterator[tuple[str, Recording]]:
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
    yield text, replace(r, load=load)


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
            and full.sum() >= TENS
            and (np.abs(expected[full, j]) > most - limit[j] - 4.0 * usual).mean() > 1.0 - FULL
        )
        if not enough or (len(less) and np.sqrt(np.mean(less**2)) > limit[j] + 4.0 * usual):
            return []
        found.append(
            f"the effort of {joint} stays at {most:.4g} {unit} in {100 * full.mean():.2g} % of the "
            "samples while the model needs more: saturated?"
        )
    return found


def _of_fit(r: Recording, leave_out: Mask, explained: Callable[[Recording], bool]) -> Causes:
    """What `fit` says of the recording: its friction where that explains it, or its findings."""
    from pkm_twin.identification.fit import fitted
    from pkm_twin.identification.fit_plausible import recording_fault
    from pkm_twin.identification.problem import Problem
    from pkm_twin.identification.suspects import ELASTIC

    recorded: Any = recorded_of(r, leave_out)
    try:
        problem = Problem.of(r.robot, [recorded], ("friction",))
        fault = recording_fault(problem.whole[0])
        if fault is not None:
            return Causes((), (fault,))
        problem.check_count()
        result = fitted(problem, tuple(problem.worse()))
        friction: dict[str, list[float]] = {}
        for name, value in zip(problem.parameters.names, result.estimate.values, strict=True):
            joint, _, law = name.rpartition(".")
            values = friction.setdefault(law, getattr(r.robot.friction, law).tolist())
            values[r.robot.joint_names.index(joint)] = float(value)
        machine = r.robot.changed(friction=friction)
    except (PkmTwinError, ValueError, np.linalg.LinAlgError):
        return Causes()
    if explained(replace(r, robot=machine)):
        text = "friction other than the file's explains the efforts: `pkm-twin fit`"
        return Causes((text,))
    # A compliance below zero is no drive's.
    findings = [
        str(one) for one in result.verdict.findings if one.suspect.kind != ELASTIC or one.size > 0.0
    ]
    return Causes((), tuple(findings[:FOUND]))
