# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The model along a recorded or planned motion: efforts, their terms and joint reactions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np

from delta_dynamics import dynamics_terms, inverse_dynamics, reactions, torque_deviation
from delta_dynamics.torques.stiction import friction_reach, zero_resting_rates
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, PkmTwinError, SingularityError, UnreachableError
from pkm_twin.machine.friction import Dahl
from pkm_twin.paths.joint_path import only_turns, reference_velocity
from pkm_twin.paths.motion import Samples
from pkm_twin.paths.sizing import rms
from pkm_twin.recordings.origin import make_effort_model_columns
from pkm_twin.recordings.payload import split_by_load
from pkm_twin.recordings.recording import Recording
from pkm_twin.recordings.tables import WRENCH
from pkm_twin.robot.limits import beyond_limits
from pkm_twin.robot.robot import Robot

SAMPLES_PER_BLOCK: Final = 256
"""Samples computed at a time, so that the balances of a block of :func:`~delta_dynamics.reactions` stay in a
processor's cache: half the time of 4096."""
EFFORT_TOLERANCE: Final = 1e-6
"""Largest relative difference of two computations of the same efforts."""
MAX_EFFORT_DIFFERENCE: Final = 0.05
"""RMS difference between a file's efforts and the model's, over the model's RMS, above which it is
reported."""


@dataclass(frozen=True)
class EffortComparison:
    """Hold a motion, its efforts, shape (k, n), and their source in words.

    ``model``: efforts of the robot's model along the motion, shape (k, n).
    """

    motion: Recording
    effort: Array
    source: str
    model: Array

    @property
    def difference(self) -> Array:
        """RMS difference between efforts and model over the model's RMS, shape (n,)."""
        return relative_difference(self.effort, self.model)

    def check_source(self) -> EffortComparison:
        """Check that efforts which this robot computed for the file equal the model's.

        :returns: the comparison; the ``effort_warning`` of its motion says that measured efforts are not
            this robot's, or that another robot computed them.
        :raises ParameterError: this robot computed them, or the file does not name its robot, and
            the model computes others: the file lacks a wrench, payload or number.
        """
        motion, effort_warning = self.motion, self.mismatch_warning
        if motion.computed is not None:
            origin, away = motion.effort_model, relative_difference(motion.computed, self.model)
            other = "" if origin is None else origin.differs_from(motion.robot)
            worst = int(away.argmax())
            if away[worst] > (MAX_EFFORT_DIFFERENCE if origin is None or other else 1e-3):
                if not other:
                    raise ParameterError(
                        f"{motion.source}: efforts of {motion.robot.joint_names[worst]}",
                        f"{100 * away[worst]:.3g} % RMS from those that {motion.robot.name} computes",
                        "a file with the wrench (fx ... mz) and payload that its efforts were computed with, "
                        "or without efforts",
                    )
                effort_warning = other
        return replace(self, motion=replace(motion, effort_warning=effort_warning))

    @property
    def mismatch_warning(self) -> str:
        """Warning that names the joint whose efforts differ most from the model's; or empty."""
        worst = int(self.difference.argmax())
        if not self.difference[worst] > MAX_EFFORT_DIFFERENCE:
            return ""
        return (
            f"the file's efforts of {self.motion.robot.joint_names[worst]} differ from the model's "
            f"by {100 * self.difference[worst]:.3g} % RMS: another robot, payload or rotor, or a wrench "
            "that the file lacks"
        )


def relative_difference(efforts: Array, model: Array) -> Array:
    """Return the RMS difference of efforts (k, n) from the model's over the model's RMS, (n,)."""
    squares = ((efforts - model) ** 2).mean(0)
    return np.asarray(np.sqrt(squares / np.maximum((model**2).mean(0), 1e-24)))


def check_efforts(motion: Recording) -> Recording:
    """Compare a file's efforts, if any, with the model's; errors of ``check_source``."""
    if not motion.robot.has_masses or (motion.effort is None and motion.computed is None):
        return motion
    return compare_efforts(motion).check_source().motion


def compare_efforts(motion: Recording) -> EffortComparison:
    """Return a motion with the file's efforts, or the model's if the file has none.

    :raises ParameterError: a robot without masses.
    """
    model = compute_model_efforts(motion)
    if motion.effort is None:
        return EffortComparison(motion, model, "the model's", model)
    return EffortComparison(motion, motion.effort, "the file's", model)


def compute_model_efforts(m: Recording) -> Array:
    """Return the model's efforts along a motion with velocities, shape (samples, n).

    Dry friction has no direction at standstill, and the model adds none there.
    """
    (q, _, qdd, wrench), rates, made = m.motion, _zero_resting_rates(m), np.empty_like(m.q)
    for robot, part in split_by_load(m.robot, m.load, m.time, SAMPLES_PER_BLOCK):
        made[part] = inverse_dynamics(robot, q[part], rates[part], qdd[part], wrench[part])
    return made + Dahl.bounded_memory_effort(m.robot.friction, q, rates)[0]


def zero_resting_motion(m: Recording) -> Recording:
    """Return the motion with zero velocities where efforts are computed for a joint at rest."""
    return replace(m, qd=_zero_resting_rates(m), still=None)


def _zero_resting_rates(m: Recording) -> Array:
    """Return the velocities, with zero where friction may not count."""
    qd = m.motion[1]
    if m.still is None:
        return qd
    rates = zero_resting_rates(qd, m.still, friction_reach(m.robot))
    # Redundant drives follow those at rest.
    rests = (rates != qd).any(1)
    rates[rests] = m.robot.project_redundant(m.q[rests], rates[rests])[1]
    return rates


@dataclass(frozen=True)
class SoftCut:
    """Model a cut whose force is proportional to the feed and against the motion.

    ``force``: N per m/s; ``tolerance``: largest deflection of the reference point, m; ``feed``:
    programmed, m/s.
    """

    robot: Robot
    force: float
    tolerance: float
    feed: float

    def __post_init__(self) -> None:
        if only_turns(self.robot):
            raise ParameterError("slow-where-soft", self.robot.name, "a pose with x, y or z")

    def deflection_per_feed(self, q: Array, direction: Array) -> Array:
        """Return the deflection of the reference point per feed, m per m/s, shape (p,).

        :param q: joint positions (p, n); ``direction``: directions of the motion (p, 3), base axes.
        :raises ParameterError: a robot without elastic members.
        """
        from stiffness_monitor import platform_response

        matrix = platform_response(self.robot, q, np.zeros(6)).compliance[..., :3, :3]
        return np.asarray(self.force * np.linalg.norm(matrix @ direction[..., None], axis=(-2, -1)))

    def slowdown(self, q: Array, direction: Array) -> Array:
        """Return the divisor of the feed that keeps the deflection within the tolerance, (p,)."""
        return np.maximum(1.0, self.feed / self.tolerance * self.deflection_per_feed(q, direction))

    def along(self, samples: Samples) -> tuple[Array, float]:
        """Return the deflection along a motion, shape (k,), m, and the largest constant feed, m/s.

        The constant feed keeps the deflection within the tolerance everywhere on the motion.
        """
        directions = reference_velocity(self.robot, samples.q, samples.qd) / np.maximum(samples.speed, 1e-300)[:, None]
        per_feed = self.deflection_per_feed(samples.q, directions)
        softest = float(per_feed.max())
        constant = min(self.feed, self.tolerance / softest) if softest > 0.0 else self.feed
        return per_feed * samples.speed, constant


@dataclass(frozen=True)
class EffortPeak:
    """Hold a joint's effort of the largest magnitude, its time (s), and the RMS of the effort."""

    effort: float
    time: float
    rms: float


def find_peaks(robot: Robot, columns: dict[str, Array]) -> dict[str, EffortPeak]:
    """Return the effort's peak of each joint in a table of :func:`tabulate_torques`."""
    time, found = columns["time"], {}
    for joint in robot.joint_names:
        effort = columns[f"{joint}.effort"]
        k = int(abs(effort).argmax())
        # A single sample is its own root mean square.
        root = rms(time, effort) if time[-1] > time[0] else float(abs(effort[k]))
        found[joint] = EffortPeak(float(effort[k]), float(time[k]), root)
    return found


def tabulate_torques(m: Recording, progress: Callable[[int], None] | None = None) -> dict[str, Array]:
    """Return named columns: time, motion, efforts, their terms, and all joints' reactions.

    The terms ``NAME.effort_gravity``, ``NAME.effort_inertia`` ... sum to ``NAME.effort``. A
    reaction that rigid bodies do not determine is left empty (NaN) in the table. Where a sample is
    beyond the limits, there is a column ``beyond_limits``, 1 for such samples, 0 for others.
    If the robot's file has an ``uncertainty``, ``NAME.effort_deviation`` is its effect.

    :raises UnreachableError: by the sample's index in the motion.
    :raises SingularityError: likewise.
    :raises PkmTwinError: values so large that the model's result is not finite.
    """
    columns: dict[str, list[Array]] = {}

    def append_column(name: str, values: Array) -> None:
        columns.setdefault(name, []).append(values)

    q, qd, qdd, wrench = m.motion
    told = m.efforts == "measured" or (m.efforts == "effort" and m.bag is None)
    outside, _ = beyond_limits(m.robot, q, qd)
    rates = _zero_resting_rates(m)
    memory = Dahl.bounded_memory_effort(m.robot.friction, q, rates)[0]
    for robot, part in split_by_load(m.robot, m.load, m.time, SAMPLES_PER_BLOCK):
        begin = part.start
        state = (robot, q[part], rates[part], qdd[part], wrench[part])
        try:
            tau, terms, react = inverse_dynamics(*state), dynamics_terms(*state), reactions(*state)
            tau, terms = tau + memory[part], replace(terms, friction=terms.friction + memory[part])
            spread = torque_deviation(*state) if robot.uncertainty else None
        except UnreachableError as e:
            at = (begin + e.index[0],)
            raise UnreachableError("joint state", e.limb, at, e.miss, how=e.how) from None
        except SingularityError as e:
            at = (begin + e.index[0],)
            raise SingularityError("joint state", at, e.measure, e.bound) from None
        except ParameterError:
            raise
        except ValueError as e:
            seconds = f"{m.clock[part][0]:g} to {m.clock[part][-1]:g} s"
            raise PkmTwinError(f"between {seconds}: {e}") from None
        append_column("time", m.clock[part])
        if outside.any():
            append_column("beyond_limits", outside[part].astype(np.float64))
        for i, joint in enumerate(m.robot.joint_names):
            append_column(f"{joint}.position", q[part][:, i])
            append_column(f"{joint}.velocity", rates[part][:, i])
            append_column(f"{joint}.acceleration", qdd[part][:, i])
            append_column(f"{joint}.effort", tau[:, i])
            if spread is not None:
                append_column(f"{joint}.effort_deviation", spread[:, i])
            if m.effort is not None and told:
                append_column(f"{joint}.measured", m.effort[part][:, i])
            for field in fields(terms):
                append_column(f"{joint}.effort_{field.name}", getattr(terms, field.name)[:, i])
        for k, name in enumerate(react.names):
            for i, axis in enumerate(WRENCH):
                append_column(f"{name}.{axis}", react.wrenches[:, k, i])
        if progress is not None:
            progress(part.stop)
    table = {name: np.concatenate(parts) for name, parts in columns.items()}
    if m.effort is not None and m.efforts == "effort" and told:
        model = np.stack([table[f"{joint}.effort"] for joint in m.robot.joint_names], -1)
        if np.abs(m.effort - model).max() <= EFFORT_TOLERANCE * np.abs(model).max():
            # The file is a plan of this machine, not a measurement.
            table = {name: v for name, v in table.items() if not name.endswith(".measured")}
    return table | make_effort_model_columns(m.robot, m.load, m.wrench, m.time)
