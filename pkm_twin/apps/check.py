# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin check``: compare a recording with the model of its machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import inverse_dynamics, torque_deviation
from delta_dynamics.rest import beyond_friction, friction_reach, moving_rates
from pkm_twin.apps.describe import why_no_torques
from pkm_twin.apps.limits import ranges
from pkm_twin.apps.loads import Load, by_load
from pkm_twin.apps.recorded import Recording
from pkm_twin.apps.topics import Topics
from pkm_twin.apps.verdict import Item, Verdict
from pkm_twin.errors import MessageError, SingularityError, UnreachableError
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.differentiator import Differentiator
from pkm_twin.streams.drives import idle_samples
from pkm_twin.streams.rest import SIGMAS, fit_gain, noise, rate_doubt

Array = NDArray[np.float64]
# Samples computed at a time, so that memory stays flat.
_BLOCK = 4096
# Of the differentiator: degree of the velocity's polynomial, samples.
_ORDER, _WINDOW = 3, 9
DEVIATIONS: Final = (1, 2, 3)
"""Of the model, inside which residuals are counted."""


@dataclass(frozen=True)
class Bounds:
    """What a good bag keeps to."""

    residual: float = 0.05
    """Torque residual RMS, part of the joint's peak effort."""
    gap: float = 5.0
    """Longest time between joint states, in median periods."""
    rejected: float = 0.0
    """Messages that a node would reject, part of all."""
    singularity: float = 1e-3
    """Least singularity index, 0 in a singularity, 1 at best."""


@dataclass(frozen=True)
class ModelBand:
    """A joint's residual beside what the file's ``uncertainty`` makes of the model's torque.

    ``deviation_rms``: of the model's standard deviation over the judged samples, ``unit``.
    ``share_within``: part of the samples whose residual is inside so many of their deviations.
    """

    deviation_rms: float
    unit: str
    share_within: Mapping[int, float]

    def __str__(self) -> str:
        shares = ", ".join(f"{100 * share:.3g}" for share in self.share_within.values())
        counts = ", ".join(map(str, self.share_within))
        return (
            f"{shares} % inside {counts} standard deviations of the model (RMS "
            f"{self.deviation_rms:.3g} {self.unit})"
        )


@dataclass(frozen=True)
class CheckReport:
    """All items; the whole is good where none is bad.

    ``bands``: by joint; empty where the robot's file has no ``uncertainty``, or torques were not
    judged.
    """

    bag: str
    robot: str
    items: tuple[Item, ...]
    topics: Topics
    load: Load | None
    unsure: bool
    """Whether the robot's file has an ``uncertainty``."""
    bands: Mapping[str, ModelBand]

    @property
    def good(self) -> bool:
        """No item is bad."""
        return not self.named(Verdict.BAD)

    def named(self, verdict: Verdict) -> list[str]:
        """What got this verdict."""
        return [item.what for item in self.items if item.verdict is verdict]

    def as_json(self) -> dict[str, Any]:
        """Plain data for a script."""
        return {
            "bag": self.bag,
            "robot": self.robot,
            "topics": asdict(self.topics),
            "payload": None if self.load is None else self.load.as_json(),
            "items": [asdict(item) for item in self.items],
            "uncertainty": {
                joint: {
                    "effort_deviation_rms": band.deviation_rms,
                    "effort_unit": band.unit,
                    "share_within_deviations": {str(k): v for k, v in band.share_within.items()},
                }
                for joint, band in self.bands.items()
            }
            or None,
            "good": self.good,
        }


def judged(recording: Recording, bounds: Bounds | None = None) -> CheckReport:
    """Compare a recording with the model."""
    bounds = bounds or Bounds()
    path = recording.source
    items = [*_file(recording, bounds), *_timing(recording, bounds), *_limits(recording)]
    items.append(_singularity(recording, bounds))
    judged, bands = _residuals(recording, bounds)
    items += judged
    r = recording
    return CheckReport(
        str(path), r.robot.name, tuple(items), r.topics, r.load, bool(r.robot.uncertainty), bands
    )


def _file(r: Recording, bounds: Bounds) -> list[Item]:
    if r.bag is None:
        found = f"a table of {len(r.time)} rows, all numbers finite"
        return [Item("file", found, "finite numbers", Verdict.GOOD)]
    report = r.bag.report
    items = [
        Item(
            "file",
            "; ".join(report.warnings) or "complete; checksums and counts agree",
            "complete and consistent",
            Verdict.BAD
            if report.miscounts
            else Verdict.UNKNOWN
            if report.warnings
            else Verdict.GOOD,
        )
    ]
    refused = sum(r.rejected.values())
    total = r.message_count
    reasons = ", ".join(f"{k}: {v}" for k, v in r.rejected.items())
    value = f"{refused} of {total}" + (f" ({reasons}; first: {r.first_reject})" if refused else "")
    items.append(
        _item(
            "messages that a node rejects",
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
    effort = r.robot.limits.effort
    bounds = list(ranges(r.robot))
    if effort is not None:
        bounds.append(("effort", -effort, effort, list(r.robot.effort_units)))
    recorded = {"position": r.q, "velocity": r.qd, "effort": r.effort}
    items = []
    for what, low, high, units in bounds:
        values = recorded[what]
        if values is None:
            continue
        used = np.maximum((values - high).max(0), (low - values).max(0))
        # Joints that turn and joints that slide have no common margin.
        worst = {u: max(x for x, v in zip(used, units, strict=True) if v == u) for u in units}
        margins = ", ".join(f"{-most:.4g} {unit}" for unit, most in worst.items())
        good = bool((used <= 0).all())
        items.append(_item(f"{what} limits", f"least margin {margins}", "0 or more", good))
    return items


def _singularity(r: Recording, bounds: Bounds) -> Item:
    what = "singularity index"
    bound = f"{bounds.singularity:g} or more"
    try:
        measure = r.robot.singularity(r.q)
    except (UnreachableError, SingularityError) as error:
        return Item(what, str(error), bound, Verdict.BAD)
    worst = int(measure.argmin())
    value = f"{measure[worst]:.4f} at {r.time[worst]:.3f} s"
    return _item(what, value, bound, bool(measure[worst] >= bounds.singularity))


def _residuals(r: Recording, bounds: Bounds) -> tuple[list[Item], dict[str, ModelBand]]:
    """Items, and by joint the model's band where the robot's file has an ``uncertainty``."""
    what = "torque residual"
    bound = f"RMS below {100 * bounds.residual:g} % of peak"
    reason = why_no_torques(r.robot) or (
        "" if r.effort is not None else "the bag carries no efforts"
    )
    if reason or r.effort is None:
        return [Item(what, reason, bound, Verdict.UNKNOWN)], {}
    models = (inverse_dynamics, _held, torque_deviation)[: 3 if r.robot.uncertainty else 2]
    try:
        (expected, held, *spread), used, still, _ = modelled(r, *models)
    except (UnreachableError, SingularityError):
        raise
    except ValueError as error:  # numbers within bounds whose result is not finite
        return [Item(what, str(error), bound, Verdict.BAD)], {}
    used = _judged(r, used)
    if not used.any():
        return [Item(what, "too few joint states in a row", bound, Verdict.UNKNOWN)], {}
    idle = used & idle_samples(r.time, still, r.effort, held)
    items = [_idle(r, idle, used)] if idle.any() else []
    used = used & ~idle
    if not used.any():
        return items, {}
    reach = friction_reach(r.robot)
    residual = beyond_friction((r.effort - expected)[used], still[used], reach)
    bands = _bands(r.robot, residual, spread[0][used]) if spread else {}
    rms = np.sqrt(np.mean(residual**2, 0))
    peak = np.abs(r.effort).max(0)
    units = r.robot.effort_units
    good = rms <= bounds.residual * peak
    hint = "" if r.load or good.all() else "; unknown payload? use --payload"
    items += [
        _item(
            f"{what} of {name}",
            f"RMS {rms[i]:.4g} {units[i]}, {100 * rms[i] / max(peak[i], 1e-12):.2f} % of "
            f"peak {peak[i]:.4g}{f'; {bands[name]}' if bands else ''}{'' if good[i] else hint}",
            bound,
            bool(good[i]),
        )
        for i, name in enumerate(r.robot.joint_names)
    ]
    return items, bands


def _idle(r: Recording, idle: NDArray[np.bool_], used: NDArray[np.bool_]) -> Item:
    """How much of a recording is left out because the drives bear nothing."""
    seconds = float(np.sum(np.gradient(r.time)[idle]))
    return Item(
        "drives off or braked",
        f"{seconds:.3f} s of {r.time[-1]:.3f} s, left out: efforts zero or constant at standstill",
        "some efforts measured",
        Verdict.GOOD if (used & ~idle).any() else Verdict.UNKNOWN,
    )


def _bands(robot: Robot, residual: Array, spread: Array) -> dict[str, ModelBand]:
    """By joint, of residuals and the model's deviations, shape (samples, n) each."""
    rms = np.sqrt(np.mean(spread**2, 0))
    shares = np.array([np.mean(np.abs(residual) <= k * spread, 0) for k in DEVIATIONS])
    return {
        joint: ModelBand(
            float(rms[i]),
            robot.effort_units[i],
            dict(zip(DEVIATIONS, shares[:, i].tolist(), strict=True)),
        )
        for i, joint in enumerate(robot.joint_names)
    }


def residuals(r: Recording) -> tuple[Array, NDArray[np.bool_]]:
    """Measured minus predicted efforts (samples, n), and which samples are judged.

    Not judged are samples until the differentiator's window is full, after gaps, and half a second
    around a pick or release, where the payload is neither held nor gone. A payload that the bag or
    the caller tells of is part of the model while it is held.
    """
    assert r.effort is not None  # noqa: S101
    expected, used = predicted(r)
    return r.effort - expected, _judged(r, used)


def _judged(r: Recording, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return used if r.load is None else used & ~r.load.near_change(r.time, 0.5)


def predicted(r: Recording) -> tuple[Array, NDArray[np.bool_]]:
    """Efforts that the twin expects (samples, n), zero where its window is not full; and where."""
    (efforts,), used, _, _ = modelled(r, inverse_dynamics)
    return efforts, used


def _held(robot: Robot, q: Array, qd: Array, qdd: Array, wrench: Array) -> Array:
    """What bears the weight and the wrench at rest, shape (samples, n)."""
    return inverse_dynamics(robot, q, 0.0 * qd, 0.0 * qdd, wrench)


def at_rest(r: Recording, qd: Array) -> NDArray[np.bool_]:
    """Which joints stand still, shape (samples, n), as far as their rates ``qd`` can tell."""
    if r.qd is not None:
        return np.asarray(np.abs(qd) <= SIGMAS * noise(r.time, r.qd))
    if len(r.time) < 3:
        return np.zeros(r.q.shape, np.bool_)
    gain = fit_gain(_ORDER + 1, _WINDOW, _WINDOW // 2) / float(np.median(np.diff(r.time)))
    return np.asarray(np.abs(qd) <= rate_doubt(r.time, r.q, gain, _WINDOW // 2))


def modelled(
    r: Recording, *models: Callable[..., Array]
) -> tuple[list[Array], NDArray[np.bool_], NDArray[np.bool_], Array]:
    """What functions of robot, motion and wrench say, shape (samples, n) each.

    And which samples these are, (samples,), which joints rest, and their rates, (samples, n).
    Where a joint stands still dry friction has no direction, and the model none of it.
    """
    qd, qdd, used = motion(r)
    still = at_rest(r, qd)
    qd = moving_rates(qd, still, friction_reach(r.robot))
    wrench = np.zeros((len(r.time), 6)) if r.wrench is None else r.wrench
    values = [np.zeros_like(r.q) for _ in models]
    for robot, part in by_load(r.robot, r.load, r.time, _BLOCK):
        rows = np.arange(part.start, part.stop)[used[part]]
        for found, model in zip(values, models, strict=True):
            found[rows] = model(robot, r.q[rows], qd[rows], qdd[rows], wrench[rows])
    return values, used, still, qd


def motion(r: Recording) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Rates and accelerations (samples, n) by the differentiator's middle, and where they are.

    Those of a table that has both are taken as they are.
    """
    if r.qd is not None and r.qdd is not None:
        return r.qd, r.qdd, np.ones(len(r.time), bool)
    late = _WINDOW // 2
    differentiator = Differentiator(order=_ORDER, window=_WINDOW, middle=True)
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
