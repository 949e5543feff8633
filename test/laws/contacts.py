# SPDX-License-Identifier: Apache-2.0
"""Streams of a machine that is not quite the model, for contact observers."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import ContactMonitor, inverse_dynamics
from delta_dynamics.regressor import PAYLOAD, TEN, parameter_names, parameter_values, regressor
from pkm_twin import Robot
from test.support.robots import joint_range, load

Array = NDArray[np.float64]

RATE = 500.0
REST = 2.0
"""How long the machine stands before it moves, s."""


OFF: dict[str, dict[str, float]] = {
    "as the model": {},
    "all masses 3 % more": {"masses": 0.03},
    "all masses 3 % less": {"masses": -0.03},
    "each mass within 3 %": {"each": 0.03},
    "3 % of peak friction left out": {"friction": 0.03},
    "both, 3 % each": {"masses": 0.03, "friction": 0.03},
    "10 % of peak friction left out": {"friction": 0.1},
}
"""How a machine may depart from its model."""


@dataclass(frozen=True)
class Stream:
    """What a controller measures: time (k,), q, qd, qdd, effort (k, n); qdd is not measured."""

    time: Array
    q: Array
    qd: Array
    qdd: Array
    effort: Array

    def watched(self, robot: Robot, monitor: ContactMonitor | None = None) -> Array:
        """Whether the monitor sees a contact, shape (k,)."""
        monitor = monitor or ContactMonitor(robot)
        touching = np.zeros(len(self.time), bool)
        for k, (t, q, qd, qdd, effort) in enumerate(
            zip(self.time, self.q, self.qd, self.qdd, self.effort, strict=True)
        ):
            found = monitor.push(float(t), (q, qd, qdd), effort)
            touching[k] = found is not None and found.touching
        return touching


def moves(robot: Robot, rng: np.random.Generator, count: int, share: float) -> tuple[Array, ...]:
    """Rest, then point to point without jerk at the ends: time, q, qd, qdd.

    :param share: of the joints' range that moves go to; each takes a quarter to half a second.
    """
    middle, half = joint_range(robot)
    here = robot.inverse(robot.home())
    pieces = [np.repeat(here[None], round(REST * RATE), 0)]
    while len(pieces) <= count:
        goal = middle + share * half * rng.uniform(-1.0, 1.0, len(middle))
        seconds = rng.uniform(0.25, 0.6)
        x = np.arange(1, round(seconds * RATE) + 1)[:, None] / round(seconds * RATE)
        piece = here + (goal - here) * (x**3 * (10.0 + x * (6.0 * x - 15.0)))
        if not robot.try_forward(piece[::10])[1].all():
            continue
        pieces.append(piece)
        here = goal
    q = np.concatenate(pieces)
    time = np.arange(len(q)) / RATE
    qd = np.gradient(q, time, axis=0)
    return time, q, qd, np.gradient(qd, time, axis=0)


def measured(
    robot: Robot, rng: np.random.Generator, motion: tuple[Array, ...], *,
    masses: float = 0.0, each: float = 0.0, friction: float = 0.0, wrench: Array | None = None,
) -> Stream:  # fmt: skip
    """Efforts of a machine that departs from the model, with noise on rates and efforts.

    :param masses: all bodies are heavier by this share; ``each``: each by one of its own within it.
    :param friction: dry friction that the model does not have, a share of each joint's peak effort.
    :param wrench: on the platform, shape (k, 6).
    """
    time, q, qd, qdd = motion
    effort = inverse_dynamics(robot, q, qd, qdd, wrench)
    free = inverse_dynamics(robot, q, qd, qdd)
    peak = np.abs(free).max(0)
    if masses or each:
        names, values = parameter_names(robot), parameter_values(robot)
        change = np.zeros(len(values))
        shares: dict[str, float] = {}
        for k, name in enumerate(names):
            owner, _, what = name.rpartition(".")
            if what in TEN and owner != PAYLOAD:
                share = shares.setdefault(owner, masses + each * rng.uniform(-1.0, 1.0))
                change[k] = share * values[k]
        effort = effort + regressor(robot, q, qd, qdd) @ change
    effort = effort + friction * peak * np.sign(qd)
    noise = 2e-3 * peak
    speed = 2e-4 * np.abs(qd).max(0)
    return Stream(
        time, q, qd + speed * rng.normal(size=q.shape), qdd,
        effort + noise * rng.normal(size=q.shape),
    )  # fmt: skip


def pushed(robot: Robot, rng: np.random.Generator, motion: tuple[Array, ...], share: float,
           begin: float) -> Array:  # fmt: skip
    """A force on the platform in a drawn direction from a time on, shape (k, 6).

    :param share: of the peak effort of the joint that feels it most, when it begins.
    """
    time, q, qd, qdd = motion
    peak = np.abs(inverse_dynamics(robot, q, qd, qdd)).max(0)
    k = int(np.searchsorted(time, begin))
    direction = np.zeros(6)
    direction[:3] = rng.normal(size=3)
    felt = np.abs(robot.platform_jacobian(q[k]).T @ direction) / peak
    return np.where(time[:, None] >= begin, share / felt.max() * direction, 0.0)


def seen_after(stream: Stream, robot: Robot, begin: float) -> float:
    """Time from the beginning of a push to the verdict, s; NaN where there is a verdict before."""
    touching = stream.watched(robot)
    if touching[stream.time < begin].any():
        return np.nan
    late = stream.time[touching] - begin
    return float(late[0]) if len(late) else np.inf


def table(robots: list[str], seeds: range) -> str:
    """Share of a run that is taken for a contact, and pushes that are seen, in Markdown."""
    lines = ["| machine | " + " | ".join(robots) + " |", "|---" * (1 + len(robots)) + "|"]
    for what, off in OFF.items():
        cells = []
        for name in robots:
            robot, shares = load(name), []
            for seed in seeds:
                rng = np.random.default_rng(seed)
                motion = moves(robot, rng, 8, 0.7)
                shares.append(measured(robot, rng, motion, **off).watched(robot).mean())
            cells.append(f"{100 * max(shares):.2g} %")
        lines.append(f"| {what} | " + " | ".join(cells) + " |")
    for share in (0.15, 0.2, 0.3, 0.5):
        cells = []
        for name in robots:
            robot, delays = load(name), []
            for seed in seeds:
                rng = np.random.default_rng(seed)
                motion = moves(robot, rng, 8, 0.7)
                begin = rng.uniform(REST + 0.5, motion[0][-1] - 0.3)
                wrench = pushed(robot, rng, motion, share, begin)
                stream = measured(robot, rng, motion, wrench=wrench, **OFF["both, 3 % each"])
                delays.append(seen_after(stream, robot, begin))
            found = [delay for delay in delays if delay < 0.3]
            late = f", {1e3 * np.median(found):.0f} ms" if found else ""
            cells.append(f"{len(found)} of {len(delays)}{late}")
        lines.append(f"| a push of {100 * share:.0f} % of peak | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    ROBOTS = ["delta_cu", "linear_delta", "rps3", "stewart", "prru", "five_bar"]
    print(table(ROBOTS, range(int(sys.argv[1]))))
