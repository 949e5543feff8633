# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A recorded or planned motion of one robot as arrays, whatever file it is from."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.bags.reader import Bag
from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import BagError, MessageError, ParameterError, PkmTwinError, one_line
from pkm_twin.recordings.origin import EffortModel
from pkm_twin.recordings.payload import Load
from pkm_twin.recordings.tables import DEFAULT_DIALECT, Dialect
from pkm_twin.recordings.topics import TABLE_SOURCE, Topics
from pkm_twin.robot.derivatives import nearest_motion
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.differentiator import Differentiator
from pkm_twin.streams.noise import SIGMAS, estimate_noise
from pkm_twin.streams.rates import MAX_ACCELERATION_ERROR, MAX_MOVE_DIFFERENCE, STANDSTILL_FRACTION, compare_rates
from pkm_twin.streams.rest import gradient_gain, velocity_error_bound
from pkm_twin.streams.steps import MAX_GAP_PERIODS, Steps, find_backlash, find_repeats, find_steps
from pkm_twin.streams.wrench import WrenchSettings

MODEL_VALUES_NOTE: Final = "tables use the model's joint values; joint_map applies to messages and bags only"
"""Printed for a robot that has a map."""
MAX_LISTED_JUMPS: Final = 4
"""Largest number of listed jumps."""
# Differentiator: degree of the velocity's polynomial, and samples.
_ORDER, _WINDOW = 3, 9


@dataclass(frozen=True)
class ReadOptions:
    """How a recording is read, as options of commands give it.

    ``topics``: of a bag, where names and joints do not decide. ``load``: the payload; None is the
    one that the file names. ``follow``: ``joints`` or ``pose``: which columns of a table
    that has both are the motion; None: both, which have to agree. ``side``: whose values a
    table's joints have: of the ``joint``, the ``controller`` (joint_map) or the ``motor``
    (drive). ``wrench_frame``: of a bag's wrenches, as the node's parameter; None is the
    platform's or the base frame, whichever comes first. ``base_frame``: has base axes; every
    other frame turns with the platform. ``limited``: messages beyond the robot's limits are
    rejected, as a node does. ``planned``: the trajectory of a bag and the efforts of a plan are
    read too; ``trajectory``: the former alone. ``currents``: efforts of a table may be motor
    currents. ``deflected``: deflections are needed, and a bag is read at their times.
    """

    topics: tuple[str, ...] = ()
    load: Load | None = None
    follow: str | None = None
    dialect: Dialect = DEFAULT_DIALECT
    side: str = "joint"
    wrench_frame: str | None = None
    base_frame: str = WrenchSettings.base_frame
    limited: bool = False
    planned: bool = False
    trajectory: bool = False
    currents: bool = False
    deflected: bool = False

    @property
    def efforts(self) -> tuple[str, ...]:
        """Columns of a table's efforts; the first that are there are taken."""
        return (*(["current"] if self.currents else []), "measured", "effort")


@dataclass(frozen=True, eq=False)
class Recording:
    """Joint states of n joints on a common time axis, with other measurements.

    time (samples,) in s since the first sample; q, qd, qdd, effort (samples, n), rad or m, per s
    and s2, N m or N; wrench (samples, 6) in base axes at the platform's reference point, N and N m;
    deflection (samples, 6) there, m and rad, NaN where not measured. None is not known.
    """

    robot: Robot
    time: Array
    q: Array
    qd: Array | None = None
    qdd: Array | None = None
    effort: Array | None = None
    wrench: Array | None = None
    deflection: Array | None = None
    pose: Array | None = None
    """Coordinates of the pose where they are known beside q, shape (samples, m)."""
    load: Load | None = None
    """A payload in place of the robot file's."""
    still: Mask | None = None
    """Samples at which differentiation cannot distinguish a joint from rest, so that dry friction
    has no direction, shape (samples, n); None: no sample."""
    efforts: str = "measured"
    """Kind of the efforts: ``measured``, the ``effort`` of a plan or of a table that does not
    tell, the ``model``'s, which only a plan has, or a ``current``, A."""
    computed: Array | None = None
    """Efforts that a model computed according to the file, shape (samples, n)."""
    effort_model: EffortModel | None = None
    """The robot model from which the efforts were computed, if the file states it."""
    effort_warning: str = ""
    """Sentence on efforts of the file that the robot's model does not give; empty without such efforts."""
    late: float = 0.0
    """Delay of the efforts behind the positions, s, which was removed."""
    source: str = ""
    """Name of the file as the user gave it."""
    notes: tuple[str, ...] = ()
    """Notes for users on what was read and left out."""
    start: int = 0
    """Stamp of the first sample, ns."""
    bag: Bag | None = None
    """The bag; None for a table."""
    topics: Topics = Topics(TABLE_SOURCE)
    rejected: Counter[str] = field(default_factory=Counter)
    """Refused messages by reason."""
    first_reject: str = ""

    def __post_init__(self) -> None:
        """Check the joints' number.

        :raises ParameterError: values of another number of samples, or of joints than the robot's.
        """
        shape = len(self.time), self.robot.joints_count
        for name in ("q", "qd", "qdd", "effort"):
            values = getattr(self, name)
            if values is not None and values.shape != shape:
                raise ParameterError(name, f"shape {values.shape}", f"{shape}, samples and joints of {self.robot.name}")

    @property
    def name(self) -> str:
        """The file's name, in one line."""
        return one_line(Path(self.source).name, 100)

    def with_effort_warning(self, answer: str) -> str:
        """Return an answer for this motion, with the warning about its efforts if there is one."""
        return f"{answer}; {self.effort_warning}" if self.effort_warning else answer

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Times in ns, shape (samples,)."""
        return self.start + np.round(1e9 * self.time).astype(np.int64)

    @property
    def clock(self) -> Array:
        """Times of the table, s; for a bag since its first sample."""
        return self.time if self.bag is not None else self.time + self.start / 1e9

    @cached_property
    def steps(self) -> Steps:
        """Jumps of the positions and interleaved publishers, found with the measured velocities if they are sound."""
        limit = self.robot.limits.velocity
        steps = find_steps(self.time, self.q, self.qd, limit)
        if self.qd is None or not steps.jumps.any():
            return steps
        alone = find_steps(self.time, self.q, None, limit)
        # Jumps found only with the measured velocities are faults of the velocities.
        return steps if alone.jumps.any() else alone

    @cached_property
    def jump_description(self) -> str:
        """Description of the positions' jumps with their times; empty without any."""
        steps, found = self.steps, self.steps.jump_indices
        if steps.publishers:
            counts = " and ".join(map(str, steps.publishers))
            jump = f"{len(found)} of {len(self.time) - 1} steps jump"
            return f"two publishers interleaved, {counts} samples: {jump}"
        names, units = self.robot.joint_names, self.robot.joint_units
        texts = [
            f"{names[j]} by {steps.sizes[k, j]:.3g} {units[j]} at {self.time[k + 1]:.3f} s"
            for k, j in found[:MAX_LISTED_JUMPS]
        ]
        more = f" and {len(found) - MAX_LISTED_JUMPS} more" if len(found) > MAX_LISTED_JUMPS else ""
        return f"{len(found)} jumps: {', '.join(texts)}{more}" if found else ""

    @cached_property
    def backlash_description(self) -> str:
        """Description of positions that step by a backlash; empty without any, or if publishers are interleaved."""
        if self.steps.publishers:
            return ""
        names, units = self.robot.joint_names, self.robot.joint_units
        texts = [
            f"the position of {name} steps by {size:.3g} {unit} {count} times, up and down in turn"
            for name, unit, size, count in zip(names, units, *find_backlash(self.q), strict=True)
            if count
        ]
        return f"{'; '.join(texts)}: play between the joint and its encoder?" if texts else ""

    @property
    def message_count(self) -> int:
        """Number of messages of the chosen topics, or of a table's rows."""
        if self.bag is None:
            return len(self.time)
        names = (self.topics.joint_states, self.topics.wrench)
        return sum(self.bag.report.topics[name].count for name in names if name is not None)

    @property
    def payload_fraction(self) -> Array | None:
        """Payload mass at each sample, (samples,): linear, 0 for the robot file's, 1 for :attr:`loaded_robot`'s."""
        if self.load is None:
            return None
        mass, own = self.load.mass_at(self.time), self.robot.payload.mass
        if not self.load.masses:
            return np.isfinite(mass).astype(np.float64)
        return np.nan_to_num((mass - own) / (self.load.mass_farthest_from(own) - own))

    @property
    def loaded_robot(self) -> Robot | None:
        """The robot with the known payload; of several masses, the one that differs most from the robot file's."""
        load = self.load
        if load is None or load.sought:
            return None
        return load.apply_to(self.robot, load.mass_farthest_from(self.robot.payload.mass))

    @property
    def measured(self) -> Array:
        """Measured efforts, shape (samples, n).

        :raises PkmTwinError: there are none.
        """
        if self.effort is None and self.bag is None:
            joint = self.robot.joint_names[0]
            raise ParameterError(
                self.source,
                "no efforts",
                f"columns {joint}.effort ... of the drives, or {joint}.current ... with --torque-constant",
            )
        if self.effort is None:
            raise BagError(
                f"no efforts on {self.topics.joint_states}, which are those of the drives",
                path=Path(self.source),
                reason="no efforts",
            )
        return self.effort

    @property
    def motion(self) -> tuple[Array, Array, Array, Array]:
        """q, qd, qdd (samples, n) and the wrench (samples, 6), zero where there is none.

        :raises PkmTwinError: rates are not known, see :meth:`with_rates`.
        """
        if self.qd is None or self.qdd is None:
            raise PkmTwinError(f"{self.source}: no velocities and accelerations")
        wrench = np.zeros((len(self.time), 6)) if self.wrench is None else self.wrench
        return self.q, self.qd, self.qdd, wrench

    def select(self, rows: slice | NDArray[np.generic]) -> Recording:
        """Return the recording of some samples only, by a slice, mask or indices; times are not shifted."""
        values = {
            name: getattr(self, name)
            for name in ("time", "q", "qd", "qdd", "effort", "wrench", "deflection", "pose", "still", "computed")
        }
        return replace(self, **{k: v[rows] for k, v in values.items() if v is not None})

    @property
    def without_repeats(self) -> Recording:
        """The recording without samples that repeat the previous one although a joint moves."""
        again = find_repeats(self.time, self.q)
        if not again.any():
            return self
        text = f"{again.sum()} of {len(again)} samples repeat the one before: left out"
        return replace(self, notes=(*self.notes, text)).select(~again)

    def compensate_effort_delay(self, late: float) -> Recording:
        """Shift efforts earlier by a delay, s, rounded to whole sampling periods.

        Fractions of a period stay, because interpolation would change the noise of the efforts.
        """
        period = float(np.median(np.diff(self.time)))
        late = period * round(late / period)
        there = self.time + late
        ends = self.time[0] - 0.5 * period, self.time[-1] + 0.5 * period
        after = np.searchsorted(self.time, there).clip(1, len(self.time) - 1)
        known = (there > ends[0]) & (there < ends[1])
        known &= np.diff(self.time)[after - 1] < MAX_GAP_PERIODS * period
        effort = np.stack([np.interp(there, self.time, one) for one in self.measured.T], -1)
        return replace(self, effort=effort, late=self.late + late).select(known)

    def check_rates(self) -> None:
        """Reject velocities that contradict the positions, and accelerations that contradict the velocities.

        :raises PkmTwinError: the difference is larger than `check` allows; names a constant factor if there is one.
        """
        judged = (
            ("velocities", self.q, self.qd, MAX_MOVE_DIFFERENCE, ("position", "velocity")),
            ("accelerations", self.qd, self.qdd, MAX_ACCELERATION_ERROR, ("velocity", "acceleration")),
        )
        for what, values, rates, most, names in judged:
            if values is None or rates is None or len(self.time) < 3:
                return
            # An overflow gives numbers that are not finite, which the model rejects.
            with np.errstate(all="ignore"):
                _, faults = compare_rates(self.robot, self.stamps, values, rates, self.steps.jumps, most, names)
            if faults:
                plural = "positions" if values is self.q else "velocities"
                raise PkmTwinError(
                    f"{self.source}: {what} differ from the rate of the {plural} by {', '.join(faults)}; "
                    f"expected at most {100 * most:g} %, or no {what}"
                )

    def _has_unreachable_steps(self) -> bool:
        """Return whether positions jump farther than the largest measured velocity takes them."""
        speed = 0.0 if self.qd is None else np.abs(self.qd).max(0)
        moves = np.abs(np.diff(self.q, axis=0))
        return bool((moves > speed * np.diff(self.time)[:, None])[self.steps.jumps].any())

    def with_rates(self) -> Recording:
        """Return the samples whose velocities and accelerations are known, with these.

        If the recording has both, they stay. In a table the missing ones are second-order
        differences; in a bag, a node's differentiator gives them in the middle of its window.

        :raises PkmTwinError: too few samples in a row, two interleaved publishers, or as :meth:`check_rates`.
        """
        if len(self.time) > 2 and self.steps.publishers and self._has_unreachable_steps():
            raise PkmTwinError(f"{self.source}: {self.jump_description}; expected the samples of one")
        self.check_rates()
        if self.qd is not None and len(self.time) > 2 and self.jump_description:
            self = replace(self, notes=(*self.notes, f"positions jump: {self.jump_description}"))
        with np.errstate(all="ignore"):
            self = self._with_gap_note()
        if self.qd is not None and self.qdd is not None:
            return self
        if self.bag is not None:
            qd, qdd, used = differentiate_motion(self)
            if not used.any():
                raise PkmTwinError(f"{self.source}: too few joint states in a row to differentiate: {len(self.time)}")
            return self._project_motion(qd, qdd, find_resting_joints(self, qd), used)
        if len(self.time) < 3:
            raise PkmTwinError(f"{self.source}: {len(self.time)} rows; 3 or more to differentiate")
        qd = _differentiate(self.q, self.time) if self.qd is None else self.qd
        rest = None
        if self.qd is None:
            rest = np.abs(qd) <= velocity_error_bound(self.time, self.q, gradient_gain(self.time))
        qdd = _differentiate(qd, self.time) if self.qdd is None else self.qdd
        return self._project_motion(qd, qdd, rest, slice(None))

    def _with_gap_note(self) -> Recording:
        """Return the recording with a note of its longest gap in which joints move, if there is one."""
        span = np.diff(self.time)
        if self.qd is None:
            steps = np.pad(np.abs(np.diff(self.q, axis=0)) / span[:, None], ((1, 1), (0, 0)))
            rates = steps[:-2] + steps[2:]
        else:
            rates = np.abs(self.qd[:-1]) + np.abs(self.qd[1:])
        moving = (rates > STANDSTILL_FRACTION * rates.max(0, initial=0.0)).any(1)
        gaps = np.flatnonzero(moving & (span > MAX_GAP_PERIODS * np.median(span))) if len(span) else span
        if not len(gaps):
            return self
        k = int(gaps[span[gaps].argmax()])
        others = f" and {len(gaps) - 1} more gaps" if len(gaps) > 1 else ""
        text = f"no samples from {self.time[k]:.6g} to {self.time[k + 1]:.6g} s{others}, while joints move: "
        return replace(self, notes=(*self.notes, f"{text}RMS and energy are interpolated there"))

    def _project_motion(
        self, qd: Array, qdd: Array, still: Mask | None, rows: slice | NDArray[np.generic]
    ) -> Recording:
        """Return some samples with these velocities and accelerations; measured ones are kept.

        Differentiated velocities and accelerations are projected onto the motions that the mechanism
        permits, so that their noise does not violate the loop closures.
        """
        r = replace(self, qd=qd, qdd=qdd, still=still).select(rows)
        rate, change = nearest_motion(r.robot, *r.motion[:3])
        r = r if self.qd is not None else replace(r, qd=rate)
        return r if self.qdd is not None else replace(r, qdd=change)


def _differentiate(values: Array, time: Array) -> Array:
    """Differentiate with second order on uneven times, shape (samples, n)."""
    with np.errstate(all="ignore"):
        return np.gradient(values, time, axis=0, edge_order=2)


def find_resting_joints(r: Recording, qd: Array) -> Mask:
    """Return which joints are at rest within the error of rates ``qd``, (samples, n)."""
    if r.qd is not None:
        return np.asarray(np.abs(qd) <= SIGMAS * estimate_noise(r.time, r.qd))
    if len(r.time) < 3:
        return np.zeros(r.q.shape, np.bool_)
    fit = Differentiator(order=_ORDER, window=_WINDOW, middle=True)
    gain = fit.slope_gain() / float(np.median(np.diff(r.time)))
    return np.asarray(np.abs(qd) <= velocity_error_bound(r.time, r.q, gain, _WINDOW // 2))


def differentiate_motion(r: Recording) -> tuple[Array, Array, Mask]:
    """Return rates and accelerations (samples, n) by the differentiator, and where they are known."""
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
        except MessageError:  # the stamps are too uneven here
            continue
        if rates is not None:
            used[i - late], qd[i - late], qdd[i - late] = True, *rates
    return qd, qdd, used
