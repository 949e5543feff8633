# SPDX-License-Identifier: Apache-2.0
"""Why measured efforts contradict the model: each cause named was put right, and they agreed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import inverse_dynamics
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.check import (
    MEASURED,
    NEAR,
    POSITION_STEPS,
    VELOCITIES,
    Checked,
    checked,
    compared_of,
    recorded_of,
)
from pkm_twin.identification.compare import MAX_RESIDUAL, Compared, by_held
from pkm_twin.identification.plausible import held_payload
from pkm_twin.recordings import Load, Recording
from pkm_twin.report import Verdict
from pkm_twin.robot.entries import with_entries
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.rates import rms

Mask = NDArray[np.bool_]

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


def judged(r: Recording, residual: float = MAX_RESIDUAL, thorough: bool = True) -> Checked:
    """Compare a recording with the model, and find why they disagree.

    :param residual: largest good one, RMS, part of the peak effort.
    :param thorough: also ask what `fit` finds, which takes some seconds.
    """
    found = checked(r, residual)
    causes, findings = _causes_of(found, thorough)
    return replace(found, causes=causes, findings=findings)


def _causes_of(found: Checked, thorough: bool) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The first cause that makes the efforts agree, and what `fit` finds where there is none."""
    c, r, bad = found.compared, found.recording, found.named(Verdict.BAD)
    # Of positions that are none the efforts say nothing.
    if {POSITION_STEPS, VELOCITIES, MEASURED} & set(bad) or c is None or c.good.all():
        return (), ()

    def good(other: Recording, without: Mask) -> bool:
        try:
            compared = compared_of(other, without, c.bound)
        except (PkmTwinError, ValueError):
            return False
        return compared is not None and bool(compared.good.all())

    def explained(other: Recording) -> bool:
        """Whether it makes the efforts agree on samples on which they do not as recorded."""
        if other.load is r.load or other.load is None or not other.load.times:
            return good(other, found.left_out)
        without = found.left_out | other.load.near_change(r.time, NEAR)
        return good(other, without) and not good(r, without)

    for text, other in _retold(r, c):
        if explained(other):
            return (text,), ()
    saturated = _saturated(r, c)
    if saturated:
        return saturated, ()
    contact, without = _contact(r, c)
    if contact and good(r, found.left_out | without):
        return (contact,), ()
    fitted, findings = _of_fit(r, found.left_out) if thorough else (None, ())
    if fitted is not None and explained(fitted):
        return ("friction other than the file's explains the efforts: `pkm-twin fit`",), ()
    return (), findings


def _retold(r: Recording, c: Compared) -> Iterator[tuple[str, Recording]]:
    """Efforts and wrenches of the other sign, wrenches in other axes, a payload."""
    assert r.effort is not None  # noqa: S101
    turned = ~c.good & (np.sum(c.measured * c.expected, 0) < 0.0)
    if turned.any():
        names = ", ".join(np.array(r.robot.joint_names)[turned].tolist())
        effort = r.effort * np.where(turned, -1.0, 1.0)
        yield f"efforts of {names} have the opposite sign", replace(r, effort=effort)
    if r.wrench is not None and r.wrench.any():
        rotation, axes = r.robot.rotation(r.robot.forward(r.q)), "platform"
        if r.topics.turns:
            rotation, axes = rotation.swapaxes(-1, -2), "base"
        both = r.wrench.reshape(-1, 2, 3)
        moved = np.einsum("nij,nkj->nki", rotation, both).reshape(-1, 6)
        yield f"the wrench has {axes} axes", replace(r, wrench=moved)
        text = (
            "the wrench has the opposite sign: it is what the platform applies to its surroundings"
        )
        yield text, replace(r, wrench=-r.wrench)
        text = "without the wrench the efforts agree: it does not act on the platform"
        yield text, replace(r, wrench=None)
    if r.load is None:
        yield from _payloads(r, c)


def _payloads(r: Recording, c: Compared) -> Iterator[tuple[str, Recording]]:
    """The payload that explains most, while it is held."""

    def more(robot: Robot, *motion: Array) -> Array:
        heavy = robot.changed(payload={"mass": robot.payload.mass + 1.0})
        return inverse_dynamics(heavy, *motion) - inverse_dynamics(robot, *motion)

    try:
        columns = [by_held(r.robot, None, more, track) for track in c.tracks]
    except PkmTwinError:
        return
    weight = 1.0 / c.limit**2
    mass, spans, held = held_payload(c.time, c.filtered(columns), c.residual, weight)
    total = sum(body.mass for body in r.robot.graph.bodies.values())
    if not mass > LIGHTEST * total or len(spans) > SPANS:
        return
    times = () if held.all() else tuple(spans)
    load = Load(float(f"{r.robot.payload.mass + mass:.3g}"), None, times)
    text = f"a payload of {load.mass:g} kg explains the efforts: use --payload {load.mass:g}"
    if times:
        text += " --load-times " + ",".join(f"{edge:.2f}" for pair in times for edge in pair)
    yield text, replace(r, load=load)


def _contact(r: Recording, c: Compared) -> tuple[str, Mask]:
    """When something else begins to act on the machine, and the samples from then on."""
    begins = c.begins()
    if begins is None:
        return "", np.zeros(0, np.bool_)
    before = c.time < begins
    # Before the motion is under way every machine agrees.
    seen = np.abs(c.expected[before]).max(0, initial=0.0) > MOVED * np.abs(c.expected).max(0)
    text = (
        f"before {begins:.3f} s the efforts agree with the model, from then on something else "
        "acts on the machine (contact, collision or another load?)"
    )
    found = before.mean() > BEFORE and seen.all()
    return text if found else "", r.time >= begins - 2.0 * c.edge


def _saturated(r: Recording, c: Compared) -> tuple[str, ...]:
    """Joints whose effort stays at its greatest while the model needs more, and else agrees."""
    assert r.effort is not None  # noqa: S101
    rows = np.searchsorted(r.time, c.time - 1e-9).clip(0, len(r.time) - 1)
    measured, limit = r.effort[rows], c.limit
    expected = measured - c.raw
    texts = []
    for j in np.flatnonzero(~c.good):
        most = np.abs(measured[:, j]).max()
        full = np.abs(measured[:, j]) >= most * (1.0 - 1e-9)
        less = c.raw[~full, j]
        usual = 1.4826 * float(np.median(np.abs(less))) if len(less) else 0.0
        slack = limit[j] + 4.0 * usual
        enough = (
            full.mean() > FULL
            and full.sum() >= TENS
            and (np.abs(expected[full, j]) > most - slack).mean() > 1.0 - FULL
        )
        if not enough or (len(less) and rms(less) > slack):
            return ()
        texts.append(
            f"the effort of {r.robot.joint_names[j]} stays at {most:.4g} "
            f"{r.robot.effort_units[j]} in {100 * full.mean():.2g} % of the samples while the "
            "model needs more: saturated?"
        )
    return tuple(texts)


def _of_fit(r: Recording, leave_out: Mask) -> tuple[Recording | None, tuple[str, ...]]:
    """The recording of a machine with the friction that `fit` finds, and what else it finds."""
    from pkm_twin.identification.fit import fit
    from pkm_twin.identification.suspects import ELASTIC

    recorded = recorded_of(r, leave_out)
    try:
        result = fit(r.robot, [recorded], ("friction",), accept=True)
        fitted = with_entries(r.robot, {one.name: one.after for one in result.numbers})
    except (PkmTwinError, ValueError, np.linalg.LinAlgError):
        return None, ()
    if result.accepted:
        return None, (result.accepted[0].removeprefix(f"{recorded.name}: "),)
    # A compliance below zero is no drive's.
    findings = [
        str(one) for one in result.verdict.findings if one.suspect.kind != ELASTIC or one.size > 0.0
    ]
    return replace(r, robot=fitted), tuple(findings[:FOUND])
