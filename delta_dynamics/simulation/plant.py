# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulate rigid bodies under efforts, with friction and stops, in joint coordinates.

Loops cannot drift open, because actuated joints are the coordinates.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from delta_dynamics.simulation.friction_contact import Law, Resistance
from delta_dynamics.torques.equations import Terms
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError
from pkm_twin.machine.inertia import loaded_joints
from pkm_twin.robot.robot import Robot

CHANGES: Final = 60
"""Changes between sticking and sliding in a step that are resolved one by one."""
HALVINGS: Final = 12
"""Largest number of times that a part of a step is halved if it fails or gains energy."""
RESOLVED: Final = 1e-8
"""Accuracy of the time of a change, as a fraction of a step."""
CRAWL: Final = 1e-6
"""First implicit part of a step where changes accumulate, as a fraction; later parts are longer."""
GROWTH: Final = 1e-9
"""Energy that the method may add in a part, relative to the kinetic energy; it is removed
afterwards."""
ROUNDING: Final = 1e-14
"""Rounding error of energies, relative to the largest summand."""


@dataclass
class Plant:
    """Hold a robot's state, and integrate its motion.

    Between changes a step is one of a Runge-Kutta method of order four that is exact in viscous
    friction, however stiff; efforts and wrench are constant in it. Dry friction of all joints and
    stops obey Coulomb's law, and what sticks or slides changes at times that are found, not at
    steps' ends: a joint sticks exactly and leaves only beyond its friction. Stops do not bounce: an
    impact projects the rates, in the mass matrix, onto those that all stops allow. Energy grows by
    what efforts and wrench do and by nothing else; a part of a step that gains some is divided.
    """

    robot: Robot
    q: Array
    qd: Array = field(init=False)

    def __post_init__(self) -> None:
        self.q = np.array(self.q, np.float64)
        self.qd = np.zeros_like(self.q)
        self.change_robot(self.robot)

    def change_robot(self, robot: Robot) -> None:
        """Continue with a robot of the same joints and another payload.

        The coordinates are the leading drives; the others act as forces on their joints.
        """
        self.robot, self._leading = robot, robot.graph.leading
        self.others = [k for k in range(robot.joints_count) if k not in self._leading]
        names = [joint.name for joint in loaded_joints(robot.led.graph)] if self.others else []
        pushed = [names.index(robot.joint_names[k]) for k in self.others]
        before: Resistance | None = vars(self).get("_resistance")
        memory = None if before is None else before.memory
        self._resistance = Resistance(robot.led, pushed, memory)
        self._here: Terms | None = None

    def _all(self, here: Terms) -> tuple[Array, Array]:
        """Return positions and velocities of all drives."""
        if not self.others:
            return here.q.copy(), here.qd.copy()
        q, qd = self.q.copy(), np.zeros_like(self.q)
        q[self._leading], qd[self._leading] = here.q, here.qd
        found = self.robot.project_redundant(q, qd)
        q[self.others], qd[self.others] = (rows[self.others] for rows in found[:2])
        return q, qd

    def rest(self) -> None:
        """Set all velocities to zero."""
        self.qd = np.zeros_like(self.q)

    def advance(self, effort: Array, wrench: Array, step: float) -> None:
        """Integrate one step, s.

        :param effort: of the actuators, shape (n,), N m or N.
        :param wrench: what the surroundings apply to the platform at its reference point, base
            axes, shape (6,), N and N m.
        :raises UnreachableError: the machine has left where it can be assembled.
        :raises SingularityError: it has reached a singularity.
        :raises ValueError: a result that is not finite, or a motion that no part of the step is
            short enough for.
        """
        effort = np.asarray(effort, np.float64)
        load = np.asarray(wrench, np.float64) if np.any(wrench) else None
        if self.others:
            apart = effort - self.robot.friction.offset
            load = np.concatenate([wrench, apart[self.others]])
            effort = effort[self._leading]
        here, left = self._here, step
        q, qd = self.q[self._leading], self.qd[self._leading]
        if here is None or here.q.tobytes() + here.qd.tobytes() != q.tobytes() + qd.tobytes():
            here = self._resistance.arrive(q, qd)
        at_once, crawled = 0, step * CRAWL
        for part in itertools.count():
            law = self._resistance.law(here, effort, load)
            taken = left
            if at_once > 2 * len(law.pull) or (part > CHANGES and part % 4 == 0):
                here, taken = self._crawl(here, law, min(left, crawled))
                at_once, crawled = 0, 4.0 * crawled
            elif not law.stands:
                here, taken = self._follow(here, law, left, step * RESOLVED)
            self._resistance.passed(here)
            self._here, (self.q, self.qd) = here, self._all(here)
            left -= taken
            if left <= 0.0:
                return
            at_once = 0 if taken else at_once + 1

    def _crawl(self, here: Terms, law: Law, span: float) -> tuple[Terms, float]:
        """Integrate implicitly over a span without energy gain; return the state and the span."""
        for _ in range(HALVINGS):
            end = self._resistance.crawl(here, law, span)
            growth = _growth(here, end, law, 0.0)
            if growth <= end.kinetic + _rounding(here, end, law):
                break
            span *= 0.5
        return _lessened(here, end, law), span

    def _follow(self, here: Terms, law: Law, left: float, instant: float) -> tuple[Terms, float]:
        """Integrate under a law until it changes, at most ``left`` s; return state and time.

        :param instant: time that counts as zero, s.
        """
        resistance, span, least, tries = self._resistance, left, left * 0.5**HALVINGS, 0
        while True:
            tries += 1
            try:
                end, work = self._flow(here, law, span)
            except (PkmTwinError, ValueError):
                # The law may change before.
                if span <= least:
                    raise
                span *= 0.5
                continue
            time, hit = resistance.change(here, end, law, span, RESOLVED)
            if time <= instant and hit is not None:
                return resistance.settle(here, law, hit, passed=False), 0.0
            if time < span - instant:
                # Of what is no cubic a guess may hardly be better than the one before.
                span = time if tries < 4 else min(time, 0.5 * span)
                continue
            growth = _growth(here, end, law, work)
            if growth > 0.0 and growth > GROWTH * (here.kinetic + end.kinetic) + _rounding(
                here, end, law
            ):
                if span <= least:
                    raise ValueError(f"energy grows by {growth:.3g} J in {span:.3g} s")
                span *= 0.5
                continue
            settled = resistance.settle(end, law, hit, passed=True)
            if settled is end and growth <= 0.0:
                return end, span
            return _lessened(here, settled, law, work), span

    def _flow(self, here: Terms, law: Law, span: float) -> tuple[Terms, float]:
        """Return the state after a part, and the work of the wrench in it, J."""
        resistance, powers = self._resistance, []

        def accelerations(q: Array, qd: Array) -> Array:
            t = here if q is here.q else resistance.at(q, qd)
            if law.wrench is not None:
                powers.append(float(law.wrench @ (t.twists @ qd)))
            return law.first if t is here else resistance.accelerate(law, t)[0]

        end = resistance.at(
            *resistance.stepper(here, law, span).run(here.q, here.qd, accelerations)
        )
        if not powers:
            return end, 0.0
        return end, span / 6.0 * (powers[0] + 2.0 * (powers[1] + powers[2]) + powers[3])


def _growth(here: Terms, end: Terms, law: Law, work: float) -> float:
    """Return the energy that the integration has added, J.

    :param work: of the wrench, J.
    """
    done = work + float((law.given) @ (end.q - here.q))
    return end.kinetic - here.kinetic + (end.potential - here.potential) - done


def _rounding(here: Terms, end: Terms, law: Law) -> float:
    """Bound the rounding error of the energy growth, J, including that of positions."""
    forces = np.abs(law.given) + np.abs(here.bias)
    size = here.kinetic + end.kinetic + abs(here.potential) + abs(end.potential)
    return ROUNDING * (size + float(forces @ np.abs(here.q)))


def _lessened(here: Terms, end: Terms, law: Law, work: float = 0.0) -> Terms:
    """Return the end state without the energy that the integration has added."""
    growth = _growth(here, end, law, work)
    if growth <= 0.0 or growth <= _rounding(here, end, law):
        return end
    # The change is so small that the other terms of the state are kept.
    left = max(0.0, 1.0 - growth / end.kinetic) if end.kinetic else 0.0
    return end._replace(qd=math.sqrt(left) * end.qd, kinetic=left * end.kinetic)
