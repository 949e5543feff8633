# SPDX-License-Identifier: Apache-2.0
"""Loads and deflections of bags and tables, on one time axis."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.apps.columns import read_columns, times_of
from pkm_twin.apps.recorded import WRENCH_AXES, read_recording
from pkm_twin.apps.topics import TRANSFORM, is_truth, require_definition
from pkm_twin.apps.wrench_frames import FRAMES
from pkm_twin.bags.reader import Bag, open_bag
from pkm_twin.bags.storage import is_bag
from pkm_twin.errors import BagError, MessageError, ParameterError, UnknownNameError, one_line
from pkm_twin.identification.deflections import AXES, Deflected
from pkm_twin.messages.reading import TINY
from pkm_twin.messages.stamps import SECOND, StampRules
from pkm_twin.messages.wrenches import MAX_FORCE, MAX_MOMENT, WrenchSample
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.deflection import (
    MAX_SHIFT,
    MAX_TURN,
    DeflectionSample,
    in_base_axes,
    read_deflection,
)

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

OWN: Final = ["stiffness_monitor", "deflection"]
"""The end of the topic that the twin's own, computed, deflections come on."""
MEASURED: Final = "measured_deflection"
"""The usual name of the measured ones."""
BOUNDS: Final = dict(
    zip(
        (*WRENCH_AXES, *AXES),
        np.repeat([MAX_FORCE, MAX_MOMENT, MAX_SHIFT, MAX_TURN], 3).tolist(),
        strict=True,
    )
)
"""Greatest values of a table's columns, as of messages: N, N m, m, rad."""
KNOWN: Final = ("time", *BOUNDS)
"""Columns of a table beside the joints'."""
APART: Final = 0.02
"""Farthest that a wrench or a joint state may be from a deflection, s."""


def read_deflected(path: Path, robot: Robot, topics: Sequence[str] = ()) -> Deflected:
    """A recording with joint positions, a wrench and a deflection: a bag, or a table.

    Columns of a table: ``JOINT.position``; of the wrench at the platform's reference point, base
    axes, any of fx fy fz mx my mz (others are zero); of the deflection there any of dx dy dz (m)
    and rx ry rz (rad) (others are not measured); optionally ``time`` (s).

    :raises PkmTwinError: something of this is missing.
    """
    return _of_bag(path, robot, topics) if is_bag(path) else _of_table(path, robot)


def _of_table(path: Path, robot: Robot) -> Deflected:
    columns = read_columns(path, robot)
    names = [f"{joint}.position" for joint in robot.joint_names]
    for name in names:
        if name not in columns:
            raise ParameterError(str(path), ", ".join(columns), f"a column {name}")
    for what, axes in (("wrench", WRENCH_AXES), ("deflection", AXES)):
        if not any(axis in columns for axis in axes):
            raise ParameterError(
                str(path), f"no {what}", f"a column {axes[0]} or more of {', '.join(axes)}"
            )
    q = np.stack([columns[name] for name in names], -1)
    count = len(q)
    time = times_of(path, columns.get("time", np.arange(count, dtype=np.float64)))
    for name in columns:
        _, dot, kind = name.rpartition(".")
        if name not in KNOWN and name not in names and (not dot or kind == "position"):
            raise UnknownNameError(f"{path}: column", name, (*names, *KNOWN))
    for axis, bound in BOUNDS.items():
        _check_size(path, axis, columns.get(axis, np.zeros(1)), bound)
    wrench = [columns.get(axis, np.zeros(count)) for axis in WRENCH_AXES]
    deflection = [columns.get(axis, np.full(count, np.nan)) for axis in AXES]
    return Deflected(
        one_line(path.name, 100), time, q, np.stack(wrench, -1), np.stack(deflection, -1)
    )


def _check_size(path: Path, name: str, values: Array, bound: float) -> None:
    """As of a message: no number that no machine has, and none below every measurement."""
    sizes = np.abs(values)
    bad = np.flatnonzero((sizes > bound) | ((sizes < TINY) & (sizes > 0.0)))
    if len(bad):
        raise ParameterError(
            f"{path}: line {bad[0] + 2}: {name}",
            float(values[bad[0]]),
            f"0, or {TINY:g} to {bound:g} in size",
        )


def _of_bag(path: Path, robot: Robot, topics: Sequence[str]) -> Deflected:
    bag = open_bag(path)
    kinds = {name: info.type for name, info in bag.report.topics.items()}
    chosen = _deflection_topic(bag, [name for name in topics if kinds.get(name) == TRANSFORM])
    others = [name for name in topics if kinds.get(name) != TRANSFORM]
    r = read_recording(path, robot=robot, topics=others, limited=False)
    if r.topics.wrench is None:
        raise BagError(
            "no wrench in the bag; a fit of compliance needs the applied wrench",
            path=path,
            reason="no wrench",
        )
    wrenches, deflections = _messages(bag, r.topics.wrench, chosen)
    for what, found in ((r.topics.wrench, wrenches), (chosen, deflections)):
        if not found:
            raise BagError(f"no usable message on {what}", path=path, reason="no messages")
    stamps = np.array([one.stamp for one in deflections], np.int64)
    times = np.array([one.stamp for one in wrenches], np.int64)
    near = (_apart(stamps, times) <= APART) & (_apart(stamps, r.stamps) <= APART)
    if not near.any():
        raise BagError(
            f"no deflection on {chosen} has a wrench and a joint state within {APART:g} s",
            path=path, reason="no pairs",
        )  # fmt: skip
    values = np.array([one.values for one in deflections])[near]
    in_base = np.array([one.frame == FRAMES.get().base_frame for one in deflections])[near]
    q = _between(stamps[near], r.stamps, r.q)
    rotation = r.robot.platform(q)[1]
    loads = _between(stamps[near], times, np.array([one.wrench for one in wrenches]))
    if r.topics.frame != FRAMES.get().base_frame:
        loads = in_base_axes(loads, rotation)
    deflection = np.where(in_base[:, None], values, in_base_axes(values, rotation))
    time = (stamps[near] - stamps[near][0]) / SECOND
    return Deflected(one_line(path.name, 100), time, q, loads, deflection)


def _deflection_topic(bag: Bag, wanted: Sequence[str]) -> str:
    """The topic of measured deflections.

    :raises BagError: there is none, or several fit.
    """
    topics = bag.report.topics
    fit = list(wanted) or [
        name
        for name, info in topics.items()
        if info.type == TRANSFORM
        and info.count
        and name.split("/")[-2:] != OWN
        and not is_truth(name)
    ]
    usual = [name for name in fit if name.split("/")[-1] == MEASURED]
    if not fit:
        raise BagError(
            f"no deflection in the bag: a topic of {TRANSFORM} from the platform to the deflected "
            "platform",
            path=bag.report.path, reason="no deflection",
        )  # fmt: skip
    if len(fit) > 1 and len(usual) != 1:
        raise BagError(
            f"deflections on {', '.join(fit)}; choose one with --topic", path=bag.report.path,
            reason="topic",
        )  # fmt: skip
    chosen = usual[0] if usual else fit[0]
    require_definition(bag, chosen)
    return chosen


def _messages(
    bag: Bag, wrench: str, deflection: str
) -> tuple[list[WrenchSample], list[DeflectionSample]]:
    """Samples of both in the order of their stamps; bad ones left out."""
    read_one = FRAMES.get().reader()
    rules = StampRules(future_tolerance=2**62)
    wrenches: dict[int, WrenchSample] = {}
    deflections: dict[int, DeflectionSample] = {}
    for message in bag.messages([wrench, deflection]):
        try:
            if message.topic == wrench:
                one = read_one(message.message, message.log_time)
                wrenches[one.stamp] = one
            else:
                sample = read_deflection(message.message, message.log_time, rules)
                deflections[sample.stamp] = sample
        except MessageError as error:
            # Between wrenches of two frames there is no middle.
            if error.reason == "frame" and message.topic == wrench:
                text = f"{wrench}: {error}"
                raise BagError(text, path=bag.report.path, reason="frames") from None
    return [wrenches[k] for k in sorted(wrenches)], [deflections[k] for k in sorted(deflections)]


def _apart(stamps: Stamps, others: Stamps) -> Array:
    """From each stamp to the nearest of the others, s."""
    right = np.minimum(np.searchsorted(others, stamps), len(others) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.minimum(np.abs(others[right] - stamps), np.abs(others[left] - stamps))
    return np.asarray(nearest / SECOND, np.float64)


def _between(stamps: Stamps, others: Stamps, values: Array) -> Array:
    """Values (k, n) at the stamps, linear between two."""
    at = (stamps - others[0]) / SECOND
    known = (others - others[0]) / SECOND
    return np.stack([np.interp(at, known, column) for column in values.T], -1)
