# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings of drawn machines: sound ones, and such as no machine or another one makes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from delta_dynamics import inverse_dynamics
from pkm_twin import Robot
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.columns import Lengths
from pkm_twin.recordings import Recording
from test.laws.recordings import smooth_motion


@dataclass(frozen=True, eq=False)
class Drawn:
    """A machine: the robot of its file, the robot that it is, and its motion."""

    robot: Robot
    truth: Robot
    time: Array
    q: Array
    qd: Array
    qdd: Array
    efforts: Array

    @property
    def size(self) -> Array:
        """Rms of the efforts by joint, shape (n,)."""
        return np.sqrt(np.mean(self.efforts**2, 0))

    def recorded(self, q: Array | None = None, effort: Array | None = None) -> Recording:
        return Recording(
            self.robot,
            self.time,
            self.q if q is None else q,
            effort=self.efforts if effort is None else effort,
        )


def machine(robot: Robot, rng: np.random.Generator, duration: float = 12.0, rate: float = 100.0) -> Drawn:
    """With friction and a payload that the file does not have."""
    time, q, qd, qdd = smooth_motion(robot, rng, duration, rate)
    size = np.sqrt(np.mean(inverse_dynamics(robot, q, qd, qdd) ** 2, 0))
    n, radius = robot.joints_count, robot.size
    mass = rng.uniform(0.3, 1.2) * robot.graph.bodies[robot.graph.platform].mass
    moment = mass * (rng.uniform(0.2, 0.4) * radius) ** 2
    truth = robot.changed(
        friction={
            "viscous": (rng.uniform(0.03, 0.15, n) * size / np.sqrt(np.mean(qd**2, 0))).tolist(),
            "coulomb": (rng.uniform(0.02, 0.1, n) * size).tolist(),
        },
        payload={
            "mass": mass,
            "com": (radius * rng.uniform(-0.3, 0.3, 3)).tolist(),
            "inertia": [moment, 1.3 * moment, 1.6 * moment],
        },
    )
    return Drawn(robot, truth, time, q, qd, qdd, inverse_dynamics(truth, q, qd, qdd))


def of_prior(robot: Robot, rng: np.random.Generator) -> Drawn:
    """A drawn machine whose lengths are off by what is usual; its payload is light or heavy."""
    m = machine(robot, rng, 8.0)
    lengths = Lengths.from_robot(robot)
    usual = np.array([one.usual for one in lengths.suspects])
    platform, radius = robot.graph.bodies[robot.graph.platform].mass, robot.size
    mass = platform * np.exp(rng.uniform(np.log(0.1), np.log(1.5)))
    moment = mass * (0.3 * radius) ** 2
    off = lengths.mixing @ (usual * rng.normal(size=len(usual)))
    truth = m.truth.changed(
        payload={
            "mass": mass,
            "com": (radius * rng.uniform(-0.2, 0.2, 3)).tolist(),
            "inertia": [moment, 1.2 * moment, 1.3 * moment],
        }
    )
    truth = truth.numbered({p: truth.number(p) + by for p, by in zip(lengths.paths, off, strict=True)})
    return replace(m, truth=truth, efforts=inverse_dynamics(truth, m.q, m.qd, m.qdd))


def noisy(recorded: Recording, rng: np.random.Generator, share: float = 0.01, steps: float = 1e5) -> Recording:
    """White noise of the efforts by their rms, an encoder of so many steps a span."""
    shape = recorded.q.shape
    size = np.sqrt(np.mean(recorded.effort**2, 0))
    step = np.ptp(recorded.q, axis=0) / steps
    q = np.round(recorded.q / step + rng.normal(size=shape)) * step
    return replace(recorded, q=q, effort=recorded.effort + share * size * rng.normal(size=shape))


def shifted(values: Array, time: Array, by: float) -> Array:
    """Later by so many seconds."""
    return np.stack([np.interp(time - by, time, column) for column in values.T], -1)


# What is wrong with the model ------------------------------------------------------------------


def gain(m: Drawn, rng: np.random.Generator) -> Recording:
    """One joint's efforts 5 % high."""
    factor = np.ones(len(m.size))
    factor[rng.integers(len(factor))] = 1.05
    return m.recorded(effort=m.efforts * factor)


def gains(m: Drawn, rng: np.random.Generator) -> Recording:
    """All efforts 5 % high."""
    return m.recorded(effort=1.05 * m.efforts)


def unit_of(robot: Robot) -> Array:
    """A radian, or the machine's size."""
    return np.array([robot.size if unit == "m" else 1.0 for unit in robot.joint_units])


def sensor(m: Drawn, rng: np.random.Generator) -> Recording:
    """One joint's sensor off by 0.01 rad."""
    off = np.zeros(len(m.size))
    off[rng.integers(len(off))] = 0.01
    return m.recorded(q=m.q + off * unit_of(m.robot))


def sensors(m: Drawn, rng: np.random.Generator) -> Recording:
    """Every joint's sensor off by 0.01 rad."""
    return m.recorded(q=m.q + 0.01 * rng.choice([-1.0, 1.0], len(m.size)) * unit_of(m.robot))


def late(m: Drawn, rng: np.random.Generator) -> Recording:
    """One joint's efforts 2 ms late."""
    j = rng.integers(len(m.size))
    effort = m.efforts.copy()
    effort[:, j] = shifted(effort, m.time, 2e-3)[:, j]
    return m.recorded(effort=effort)


def load_friction(m: Drawn, rng: np.random.Generator) -> Recording:
    """Friction of 5 % of the load."""
    return m.recorded(effort=m.efforts + 0.05 * np.abs(m.efforts) * np.sign(m.qd))


def stribeck(m: Drawn, rng: np.random.Generator) -> Recording:
    """Static friction of twice the Coulomb friction, below a tenth of the rms speed."""
    slow = 0.1 * np.sqrt(np.mean(m.qd**2, 0))
    peak = m.truth.friction.coulomb * np.exp(-((m.qd / slow) ** 2)) * np.sign(m.qd)
    return m.recorded(effort=m.efforts + peak)


def elastic(m: Drawn, rng: np.random.Generator) -> Recording:
    """Drives that give 5 mrad under their greatest effort, measured at the motor."""
    give = 5e-3 * unit_of(m.robot) / np.abs(m.efforts).max(0)
    return m.recorded(q=m.q + give * m.efforts)


def lengths(m: Drawn, rng: np.random.Generator) -> Recording:
    """One length of the geometry off by 1 %, or a place by 1 % of the machine's size."""
    robot = m.truth
    found = {
        path: value
        for path, (value, unit) in robot.file_numbers().items()
        if unit == "m"
        and not path.startswith(("limits", "payload", "joint_map", "uncertainty", "members", "inertia", "bodies"))
        and ".com" not in path
        and "compliance" not in path
    }
    named = [p for p in found if p.startswith("geometry.") and "arm" in p]
    for _ in range(50):
        path = str(rng.choice(named or list(found)))
        step = 0.01 * (found[path] if abs(found[path]) > 0.1 * robot.size else robot.size)
        try:
            other = robot.with_file_values({path: found[path] + step})
            effort = inverse_dynamics(other, m.q, m.qd, m.qdd)
        except (PkmTwinError, ValueError):
            continue
        if np.abs(effort - m.efforts).max() > 1e-3 * np.abs(m.efforts).max():
            return m.recorded(effort=effort)
    raise AssertionError(f"no length of {robot.name} can change alone")


WRONG: dict[str, Callable[[Drawn, np.random.Generator], Recording]] = {
    f.__name__: f for f in (gain, gains, sensor, sensors, late, load_friction, stribeck, elastic, lengths)
}
"""Recordings that the model does not explain."""


# What no machine of this file makes ------------------------------------------------------------


def one_effort(r: Recording, rng: np.random.Generator, how: Callable[[Array], Array]) -> Recording:
    """One joint's efforts put through a function."""
    effort, j = r.effort.copy(), int(rng.integers(r.q.shape[1]))
    effort[:, j] = how(effort[:, j])
    return replace(r, effort=effort)


def mirrored(r: Recording, rng: np.random.Generator, *, efforts: bool) -> Recording:
    """One joint's positions about their middle, so that the machine can take them."""
    j = int(rng.integers(r.q.shape[1]))
    q, effort = r.q.copy(), r.effort.copy()
    q[:, j] = 2.0 * q[:, j].mean() - q[:, j]
    effort[:, j] *= -1.0 if efforts else 1.0
    return replace(r, q=q, effort=effort)


def swapped(values: Array, rng: np.random.Generator) -> Array:
    """Two columns exchanged."""
    order = np.arange(values.shape[1])
    i, k = rng.permutation(len(order))[:2]
    order[[i, k]] = k, i
    return values[:, order]


IMPOSSIBLE: dict[str, Callable[[Recording, np.random.Generator], Recording]] = {
    "efforts_negated": lambda r, _: replace(r, effort=-r.effort),
    "one_effort_negated": lambda r, rng: one_effort(r, rng, np.negative),
    "positions_negated": lambda r, _: replace(r, q=-r.q),
    "one_position_negated": lambda r, rng: mirrored(r, rng, efforts=False),
    "one_joint_negated": lambda r, rng: mirrored(r, rng, efforts=True),
    "time_reversed": lambda r, _: replace(r, q=r.q[::-1], effort=r.effort[::-1]),
    "efforts_reversed": lambda r, _: replace(r, effort=r.effort[::-1]),
    "effort_columns_swapped": lambda r, rng: replace(r, effort=swapped(r.effort, rng)),
    "effort_columns_rolled": lambda r, _: replace(r, effort=np.roll(r.effort, 1, 1)),
    "position_columns_swapped": lambda r, rng: replace(r, q=swapped(r.q, rng)),
    "columns_taken_for_each_other": lambda r, _: replace(r, q=r.effort, effort=r.q),
    "milliseconds": lambda r, _: replace(r, time=1e3 * r.time),
    "seconds_for_milliseconds": lambda r, _: replace(r, time=1e-3 * r.time),
    "half_speed": lambda r, _: replace(r, time=2.0 * r.time),
    "kgf_cm": lambda r, _: replace(r, effort=r.effort * 100.0 / 9.80665),
    "newton_millimetres": lambda r, _: replace(r, effort=1e3 * r.effort),
    "kilogram_force": lambda r, _: replace(r, effort=r.effort / 9.80665),
    "three_times": lambda r, _: replace(r, effort=3.0 * r.effort),
    "a_third": lambda r, _: replace(r, effort=r.effort / 3.0),
    # Of one joint the torque before its gear.
    "motor_side": lambda r, rng: one_effort(r, rng, lambda v: v / 20.0),
    "degrees": lambda r, _: replace(r, q=np.degrees(r.q)),
    "radians_for_degrees": lambda r, _: replace(r, q=np.radians(r.q)),
    "millimetres": lambda r, _: replace(r, q=1e3 * r.q),
    "efforts_late": lambda r, rng: replace(r, effort=shifted(r.effort, r.time, 0.3 * rng.choice([-1.0, 1.0]))),
    "one_effort_late": lambda r, rng: one_effort(r, rng, lambda v: np.interp(r.time - 0.3, r.time, v)),
    "efforts_shuffled": lambda r, rng: replace(r, effort=rng.permutation(r.effort)),
    "noise_for_efforts": lambda r, rng: replace(
        r, effort=r.effort.mean(0) + r.effort.std(0) * rng.normal(size=r.effort.shape)
    ),
}
"""Recordings that no machine of the file can have made."""
