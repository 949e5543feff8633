# SPDX-License-Identifier: Apache-2.0
"""The headless verdict: whether a recorded bag is what the twin says of its machine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import inverse_dynamics
from pkm_twin.apps.recorded import JOINT_STATE, WRENCH, Recording, read_recording
from pkm_twin.apps.verdict import Item, Verdict
from pkm_twin.errors import MessageError, SingularityError, UnreachableError
from pkm_twin.streams.differentiator import Differentiator

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Bounds:
    """What a good bag keeps to."""

    residual: float = 0.05
    """Torque residual RMS, part of the joint's peak effort."""
    gap: float = 5.0
    """Longest time between joint states, in median periods."""
    rejected: float = 0.0
    """Messages that a node would refuse, part of all."""
    singularity: float = 1e-3
    """Least reciprocal condition number of the scaled Jacobian."""


@dataclass(frozen=True)
class CheckReport:
    """All items; the whole is good where none is bad."""

    bag: str
    robot: str
    items: tuple[Item, ...]

    @property
    def good(self) -> bool:
        """No item is bad."""
        return not self.named(Verdict.BAD)

    def named(self, verdict: Verdict) -> list[str]:
        """What got this verdict."""
        return [item.what for item in self.items if item.verdict is verdict]

    def as_json(self) -> dict[str, Any]:
        """Plain data for a script."""
        return {**asdict(self), "good": self.good}


def check_bag(
    path: str | Path,
    robot: str | None = None,
    bounds: Bounds | None = None,
    progress: Callable[[int], None] | None = None,
) -> CheckReport:
    """Judge a bag against the twin.

    :raises BagError: the file is damaged or cannot be judged at all.
    """
    bounds = bounds or Bounds()
    recording = read_recording(path, robot, progress)
    items = [*_file(recording, bounds), *_timing(recording, bounds), *_limits(recording)]
    items.append(_singularity(recording, bounds))
    items += _residuals(recording, bounds)
    return CheckReport(str(path), recording.robot.name, tuple(items))


def _file(r: Recording, bounds: Bounds) -> list[Item]:
    report = r.bag.report
    items = [
        Item(
            "file",
            "; ".join(report.warnings) or "every byte whole, counts agree",
            "CRCs, counts and times agree",
            Verdict.UNKNOWN if report.warnings else Verdict.GOOD,
        )
    ]
    refused = sum(r.rejected.values())
    total = sum(t.count for t in report.topics.values() if t.type in (JOINT_STATE, WRENCH))
    reasons = ", ".join(f"{k}: {v}" for k, v in r.rejected.items())
    value = f"{refused} of {total}" + (f" ({reasons}; first: {r.first_reject})" if refused else "")
    items.append(
        _item(
            "messages that a node refuses",
            value,
            f"at most {100 * bounds.rejected:g} %",
            refused <= bounds.rejected * total,
        )
    )
    return items


def _timing(r: Recording, bounds: Bounds) -> list[Item]:
    if len(r.time) < 3:
        return [Item("rate", f"{len(r.time)} joint states", "3 or more", Verdict.UNKNOWN)]
    periods = np.diff(r.time)
    median, longest = float(np.median(periods)), float(periods.max())
    at = float(r.time[int(periods.argmax())])
    return [
        Item("rate", f"{1 / median:.1f} Hz over {r.time[-1]:.3f} s", "", Verdict.GOOD),
        _item(
            "longest gap",
            f"{1e3 * longest:.3f} ms at {at:.3f} s",
            f"at most {1e3 * bounds.gap * median:.3f} ms",
            longest <= bounds.gap * median,
        ),
    ]


def _limits(r: Recording) -> list[Item]:
    """Effort limits; position and velocity limits are already a node's reason to refuse."""
    limits: Any = getattr(r.robot, "limits", None)
    items = []
    for what, values, unit in (
        ("position", r.q, r.robot.joint_unit),
        ("velocity", r.qd, f"{r.robot.joint_unit}/s"),
        ("effort", r.effort, r.robot.effort_unit),
    ):
        bound = getattr(limits, what, None)
        if values is None or bound is None:
            continue
        low, high = (bound[:, 0], bound[:, 1]) if bound.ndim == 2 else (-bound, bound)
        used = np.maximum((values - high).max(0), (low - values).max(0))
        items.append(
            _item(
                f"{what} limits",
                f"least margin {-used.max():.4g} {unit}",
                "0 or more",
                bool((used <= 0).all()),
            )
        )
    return items


def _singularity(r: Recording, bounds: Bounds) -> Item:
    what = "distance to singularity"
    bound = f"{bounds.singularity:g} or more"
    try:
        measure = r.robot.singularity(r.q)
    except (UnreachableError, SingularityError) as error:
        return Item(what, str(error), bound, Verdict.BAD)
    worst = int(measure.argmin())
    value = f"{measure[worst]:.4f} at {r.time[worst]:.3f} s"
    return _item(what, value, bound, bool(measure[worst] >= bounds.singularity))


def _residuals(r: Recording, bounds: Bounds) -> list[Item]:
    what = "torque residual"
    bound = f"RMS below {100 * bounds.residual:g} % of peak"
    if r.robot.dynamics_kernel is None:
        return [Item(what, "the robot's file has no masses", bound, Verdict.UNKNOWN)]
    if r.effort is None:
        return [Item(what, "the bag carries no efforts", bound, Verdict.UNKNOWN)]
    residual, used = residuals(r)
    if not used.any():
        return [Item(what, "too few joint states in a row", bound, Verdict.UNKNOWN)]
    rms = np.sqrt(np.mean(residual[used] ** 2, 0))
    peak = np.abs(r.effort).max(0)
    unit = r.robot.effort_unit
    return [
        _item(
            f"{what} of {name}",
            f"RMS {rms[i]:.4g} {unit}, {100 * rms[i] / max(peak[i], 1e-12):.2f} % of {peak[i]:.4g}",
            bound,
            bool(rms[i] <= bounds.residual * peak[i]),
        )
        for i, name in enumerate(r.robot.joint_names)
    ]


def residuals(r: Recording) -> tuple[Array, NDArray[np.bool_]]:
    """Measured less predicted efforts (n, 3), and which samples are judged.

    Not judged are samples until the differentiator's window is full, after gaps, and half a second
    around a pick or release, where the payload is neither held nor gone. A payload that the bag
    tells of is part of the model while it is held.
    """
    assert r.effort is not None  # noqa: S101
    qd, qdd, used = motion(r)
    wrench = np.zeros((len(r.time), 6)) if r.wrench is None else r.wrench
    predicted = np.zeros_like(r.q)
    predicted[used] = inverse_dynamics(r.robot, r.q[used], qd[used], qdd[used], wrench[used])
    if r.loaded is not None:
        picked, released = r.loaded
        held = used & (r.time >= picked) & (r.time <= released)
        carrying: Any = r.robot.changed(payload={"mass": r.payload_mass})
        predicted[held] = inverse_dynamics(carrying, r.q[held], qd[held], qdd[held], wrench[held])
        near = (np.abs(r.time - picked) < 0.5) | (np.abs(r.time - released) < 0.5)
        used = used & ~near
    return r.effort - predicted, used


def motion(r: Recording) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Rates and accelerations (n, 3) by the differentiator's middle, and where they are."""
    window = 9
    late = window // 2
    differentiator = Differentiator(order=3, window=window, middle=True)
    gap = 10 * float(np.median(np.diff(r.time))) if len(r.time) > 1 else 1.0
    qd, qdd = np.zeros_like(r.q), np.zeros_like(r.q)
    used = np.zeros(len(r.time), bool)
    for i, stamp in enumerate(r.stamps.tolist()):
        if i and r.time[i] - r.time[i - 1] > gap:
            differentiator.reset()
        try:
            rates = differentiator.push(stamp, r.q[i], None if r.qd is None else r.qd[i])
        except MessageError:  # stamps too uneven here
            continue
        if rates is not None:
            used[i - late], qd[i - late], qdd[i - late] = True, *rates
    return qd, qdd, used


def _item(what: str, value: str, bound: str, good: bool) -> Item:
    return Item(what, value, bound, Verdict.GOOD if good else Verdict.BAD)
