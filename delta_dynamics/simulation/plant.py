# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulate rigid bodies under efforts, with friction and stops, in joint coordinates.

Loops cannot drift open, because actuated joints are the coordinates.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from delta_dynamics.simulation.friction_contact import Law, Resistance
from delta_dynamics.torques.equations import Terms
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError
from pkm_twin.machine.inertia import list_loaded_joints
from pkm_twin.robot.robot import Robot

MAX_EXPLICIT_PARTS: Final = 100
"""Number of parts of a step after which implicit parts become longer, to limit their number."""
MIN_RELATIVE_SPAN: Final = 0.5**12
"""Shortest part of a step, relative to the step: the part in which sticking or sliding changes."""
MAX_ENERGY_GROWTH: Final = 1e-9
"""Energy that the method may add in a part, relative to the kinetic energy; it is removed
afterwards."""
ENERGY_ROUNDING: Final = 1e-14
"""Rounding error of energies, relative to the largest summand."""


@dataclass
class Plant:
    """Hold a robot's state, and integrate its motion.

    Efforts and wrench are constant in a step. While no joint starts or stops sliding, the integrator
    is a Runge-Kutta method of order four that is exact in viscous friction, however stiff. Dry
    friction of all joints, and stops, obey Coulomb's law: a joint sticks exactly until the force
    exceeds its friction. A part of a step ends just before sticking or sliding changes, found by
    linear interpolation; the change itself is integrated implicitly within 1/4096 of the step. Stops
    do not bounce: an impact projects the rates, in the metric of the mass matrix, onto those that all
    stops allow. A part in which the energy grows by more than the work of efforts and wrench is
    halved.
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
        names = [joint.name for joint in list_loaded_joints(robot.leading_machine.graph)] if self.others else []
        pushed = [names.index(robot.joint_names[k]) for k in self.others]
        before: Resistance | None = vars(self).get("_resistance")
        memory = None if before is None else before.memory
        self._resistance = Resistance(robot.leading_machine, pushed, memory)
        self._here: Terms | None = None

    def _find_drive_states(self, here: Terms) -> tuple[Array, Array]:
        if not self.others:
            return here.q.copy(), here.qd.copy()
        q, qd = self.q.copy(), np.zeros_like(self.q)
        q[self._leading], qd[self._leading] = here.q, here.qd
        found = self.robot.project_redundant(q, qd)
        q[self.others], qd[self.others] = (rows[self.others] for rows in found[:2])
        return q, qd

    def stop_motion(self) -> None:
        """Set all velocities to zero."""
        self.qd = np.zeros_like(self.q)

    def advance(self, effort: Array, wrench: Array, step: float) -> None:
        """Integrate one step, s.

        :param effort: of the actuators, shape (n,), N m or N.
        :param wrench: what the surroundings apply to the platform at its reference point, base
            axes, shape (6,), N and N m.
        :raises UnreachableError: the machine has left where it can be assembled.
        :raises SingularityError: it has reached a singularity.
        :raises ValueError: a result that is not finite, or a motion too fast for the shortest part.
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
            here = self._resistance.apply_state(q, qd)
        least, span, changes = step * MIN_RELATIVE_SPAN, step, False
        for part in itertools.count():
            # After many changes in one step, lengthen the implicit parts.
            least *= 4.0 if part > MAX_EXPLICIT_PARTS else 1.0
            law, taken = self._resistance.find_law(here, effort, load), left
            if changes and not law.is_at_rest:
                here, taken = self._step_implicitly(here, law, min(left, least))
                changes, span = False, step
            elif not law.is_at_rest:
                here, taken, changes = self._integrate_law(here, law, min(left, span), least)
                span = 2.0 * taken
            self._resistance.store_memory(here)
            self._here, (self.q, self.qd) = here, self._find_drive_states(here)
            left -= taken
            if left <= 0.0:
                return

    def _integrate_law(self, here: Terms, law: Law, span: float, least: float) -> tuple[Terms, float, bool]:
        """Integrate at most ``span`` s, as long as the law lasts.

        A span in which the law changes is cut before the change; one in which the method adds
        energy, or has no result, is halved, down to ``least``.

        :returns: the state, the time, and whether the law changes next.
        """
        resistance, changes = self._resistance, False
        while True:
            part = 1.0
            with contextlib.suppress(PkmTwinError, ValueError):  # the law may change before
                end, work = self._step_explicitly(here, law, span)
                part = resistance.find_lasting_fraction(here, end, law)
                growth = _energy_growth(here, end, law, work)
                if part == 1.0 and growth <= MAX_ENERGY_GROWTH * (here.kinetic + end.kinetic) + _energy_rounding(
                    here, end, law
                ):
                    settled = resistance.finish_part(end, law)
                    if settled is not end or growth > 0.0:
                        settled = _remove_growth(here, settled, law, work)
                    return settled, span, changes
            if span <= least:
                return here, 0.0, True
            changes = part < 1.0
            span = max(part * span - 0.5 * least, least) if changes else 0.5 * span

    def _step_implicitly(self, here: Terms, law: Law, span: float) -> tuple[Terms, float]:
        """Integrate at most ``span`` s implicitly, through changes of sticking; return state and time."""
        shortest = MIN_RELATIVE_SPAN * span
        while True:
            end = self._resistance.step_implicitly(here, law, span)
            sound = _energy_growth(here, end, law, 0.0) <= end.kinetic + _energy_rounding(here, end, law)
            if sound or span <= shortest:
                return _remove_growth(here, end, law), span
            span *= 0.5

    def _step_explicitly(self, here: Terms, law: Law, span: float) -> tuple[Terms, float]:
        """Return the state after a part, and the work of the wrench in it, J."""
        resistance, powers = self._resistance, []

        def accelerations(q: Array, qd: Array) -> Array:
            t = here if q is here.q else resistance.evaluate_terms(q, qd)
            if law.wrench is not None:
                powers.append(float(law.wrench @ (t.twists @ qd)))
            return law.acceleration if t is here else resistance.accelerate(law, t)[0]

        end = resistance.evaluate_terms(*resistance.stepper(here, law, span).run(here.q, here.qd, accelerations))
        if not powers:
            return end, 0.0
        return end, span / 6.0 * (powers[0] + 2.0 * (powers[1] + powers[2]) + powers[3])


def _energy_growth(here: Terms, end: Terms, law: Law, work: float) -> float:
    """Return the energy that the integration has added, J.

    :param work: of the wrench, J.
    """
    done = work + float((law.input_effort) @ (end.q - here.q))
    return end.kinetic - here.kinetic + (end.potential - here.potential) - done


def _energy_rounding(here: Terms, end: Terms, law: Law) -> float:
    """Bound the rounding error of the energy growth, J, including that of positions."""
    forces = np.abs(law.input_effort) + np.abs(here.bias)
    size = here.kinetic + end.kinetic + abs(here.potential) + abs(end.potential)
    return ENERGY_ROUNDING * (size + float(forces @ np.abs(here.q)))


def _remove_growth(here: Terms, end: Terms, law: Law, work: float = 0.0) -> Terms:
    """Return the end state without the energy that the integration has added."""
    growth = _energy_growth(here, end, law, work)
    if growth <= 0.0 or growth <= _energy_rounding(here, end, law):
        return end
    # The correction is so small that the other terms of the state need no update.
    left = max(0.0, 1.0 - growth / end.kinetic) if end.kinetic else 0.0
    return end._replace(qd=math.sqrt(left) * end.qd, kinetic=left * end.kinetic)
