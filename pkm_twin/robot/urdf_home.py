# SPDX-License-Identifier: Apache-2.0
"""The home of a tree with loop closures: which of its assemblies the robot starts from.

The actuated joints stand where the file wants them: at the initial values of ``<ros2_control>``,
else at zero, else, where the limits leave zero out, amid the limits. Of several such assemblies the
one as drawn is taken, else the best conditioned; where there is none, the best conditioned near it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, SingularityError
from pkm_twin.kinematics.conditions import Conditions
from pkm_twin.kinematics.diagnosis import is_clear, is_right
from pkm_twin.kinematics.singularity import singularity_at_home
from pkm_twin.kinematics.spins import hold, without_spins
from pkm_twin.machine.assembly import EXACT, Assembly
from pkm_twin.machine.graph import Graph

DRAWN: Final = 0.1
"""A closed assembly is as drawn where no joint is farther from zero, rad or parts of the size."""
SMALL: Final = 0.01
"""Singularity index below which a home is not taken for its nearness alone."""
SINGULAR: Final = 1e-4
"""Singularity index below which a home is no home: hardly a way leads away from it."""
BETTER: Final = 1.05
"""Of assemblies whose indices differ by less than this factor the nearest to zero is taken."""
SAME: Final = 1e-4
"""Assemblies are one where no link is farther apart, parts of the size."""
STARTS: Final = 12
"""Random starts from which other assemblies are looked for."""
REACHES: Final = (0.05, 0.1, 0.2, 0.4, 0.8)
"""How far from the wanted values the actuated joints may be, rad or parts of the size."""
TRIES: Final = 6
"""Random starts within each."""
ROUNDED: Final = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4)
"""Deviations of axes and points that may be a file's rounding, rad and parts of the size."""
TURNING: Final = 8
"""Steps in which a part that only spins is turned back to zero."""
WORDS: Final = {
    "drawn": "as drawn, the actuated joints at {place}",
    "wanted": "the actuated joints at {place}, not as drawn",
    "near": "the best conditioned assembly near {place}, as there is none at it",
}
"""How a home was chosen, in words."""


@dataclass(frozen=True, eq=False)
class Home:
    """An assembly: the steps' ``values``, and how far the loops ``miss`` (m or rad).

    ``how``: of WORDS; ``place``: where the actuated joints were wanted. ``graph``: idealised, with
    spins held by the joints ``held`` (each with the greatest mass times offset of what it holds,
    kg m); None where its mobility is not right. ``rounding``: the
    largest deviation that was removed, rad or parts of the size. ``index``: the singularity index.
    """

    values: Array
    miss: float
    how: str
    place: str
    graph: Graph | None
    held: Mapping[str, float]
    rounding: float
    index: float

    @property
    def text(self) -> str:
        """How it was chosen, in words."""
        return WORDS[self.how].format(place=self.place)


class HomeSearch:
    """Looks for the home of an assembly.

    :param graph: gives the machine at the assembly's placed values, no spin held.
    """

    def __init__(self, assembly: Assembly, graph: Callable[[], Graph]) -> None:
        self.assembly, self.graph = assembly, graph
        tree, steps = assembly.tree, assembly.steps
        self.held = np.array([name in tree.actuated for name in steps], bool)
        self.turns = assembly.turns
        self.units = np.where(self.turns, 1.0, assembly.size)
        # Values count from the drawing.
        drawn = np.array([tree.joints[name].drawn for name in steps])
        bounds = [tree.joints[name].limits.get("position", (-math.inf, math.inf)) for name in steps]
        self.low, self.high = np.reshape(bounds, (-1, 2)).T - drawn
        self.wanted = np.where(self.held, -drawn, 0.0)
        self.place = "zero"
        if all(name in tree.initial for name in tree.actuated):
            start = np.array([tree.initial.get(name, 0.0) for name in steps])
            if start.any():
                self.wanted = np.where(self.held, start - drawn, 0.0)
                self.place = "the file's initial values"
        outside = self.held & ((self.wanted < self.low) | (self.wanted > self.high))
        if outside.any():
            self.wanted[outside] = (self.low[outside] + self.high[outside]) / 2
            self.place = "zero or amid their limits"

        self._known: list[Array] = []
        """Where the links are in the assemblies that were looked at, shape (links, 3), m."""
        self._hinges: dict[str, float] | None = None
        """The joints that hold the spins of an assembly, which hold those of others too."""

    def home(self) -> Home:
        """The home, with the parts that only spin at the file's zero where they can be.

        :raises ParameterError: the loops close nowhere, by how much they are open.
        """
        return self._unspun(self._best())

    def _unspun(self, home: Home) -> Home:
        """The same, with parts that only spin turned back towards zero.

        Where they stand is left to chance by the search, and where their masses are off the axis it
        counts.
        """
        if not home.held or home.graph is None:
            return home
        values = self.assembly.relaxed(home.values, self.held)
        steps = list(self.assembly.steps)
        zero = np.array([name in home.held and steps.count(name) == 1 for name in steps], bool)
        for left in range(TURNING, 0, -1):
            values = np.where(zero, values * (left - 1) / left, values)
            values, miss = self.assembly.close(values, self.held | zero)
        if miss > max(home.miss, EXACT):
            return home
        turned = self._home(self._wrapped(values), miss, home.how)
        return turned if turned.index >= SINGULAR else home

    def _best(self) -> Home:
        """The home as it is found."""
        drawn = self._drawn()
        if drawn is not None and drawn.how == "drawn" and drawn.index >= SMALL:
            return drawn
        if drawn is None:
            # What closes nowhere is rejected before much is tried.
            closed = self.assembly.anywhere()[0]
        chosen = self._chosen([home for home in (drawn, *self._others()) if home is not None])
        if chosen is not None and chosen.index >= SINGULAR:
            return chosen
        near = self._near()
        if near is not None:
            return near
        if chosen is not None:
            return chosen
        # No assembly is sound: the reason is the machine's, and told where it is looked at whole.
        values = self.assembly.relaxed(closed)
        return self._home(values, self.assembly.miss(), "near")

    def _drawn(self) -> Home | None:
        """The assembly that the drawing leads to, with the actuated joints where they should be."""
        values = self.wanted.copy()
        self.assembly.place(values)
        miss = self.assembly.miss()
        if miss > EXACT:
            values, miss = self.assembly.close(values, self.held)
        if miss > self.assembly.closed:
            return None
        self._known.append(self.assembly.places())
        far = float((np.abs(values) / self.units)[~self.held].max(initial=0.0))
        return self._home(values, miss, "drawn" if far <= DRAWN else "wanted")

    def _reached(self, start: Array, how: str) -> Home | None:
        """The assembly that a start leads to; None where loops stay open, or it is known."""
        values, miss = self.assembly.close(start, self.held)
        if miss > self.assembly.closed and how == "near":
            values, miss = self.assembly.close(values)
        places, apart = self.assembly.places(), SAME * self.assembly.size
        known = any(float(np.abs(places - other).max()) <= apart for other in self._known)
        if miss > self.assembly.closed or known:
            return None
        self._known.append(places)
        return self._home(self._wrapped(values), miss, how)

    def _others(self) -> list[Home | None]:
        """Assemblies with the actuated joints at the same values, from random starts."""
        rng, reach = np.random.default_rng(0), np.where(self.turns, math.pi, self.units / 2)
        starts = rng.uniform(-reach, reach, (0 if self.held.all() else STARTS, len(reach)))
        return [self._reached(np.where(self.held, self.wanted, s), "wanted") for s in starts]

    def _wrapped(self, values: Array) -> Array:
        """The same with no turn of more than half a circle."""
        turned = (values + math.pi) % (2 * math.pi) - math.pi
        return np.where(self.turns & ~self.held, turned, values)

    def _chosen(self, found: list[Home]) -> Home | None:
        """The best conditioned, of equal ones the nearest to the zeros of all joints."""
        inside = [home for home in found if self._inside(home.values)] or found
        if not inside:
            return None
        best = max(home.index for home in inside)
        good = [home for home in inside if home.index * BETTER >= best]
        return min(good, key=lambda home: float(np.linalg.norm(home.values / self.units)))

    def _inside(self, values: Array) -> bool:
        """Whether all joints are inside the limits that the file states, the passive ones too."""
        return bool(((values >= self.low - 1e-6) & (values <= self.high + 1e-6)).all())

    def _near(self) -> Home | None:
        """The best conditioned of the assemblies within the least reach that has a good one."""
        rng = np.random.default_rng(1)
        tried: list[Home] = []
        best: Home | None = None
        for reach in REACHES:
            for _ in range(TRIES):
                start = self.wanted + rng.uniform(-reach, reach, len(self.wanted)) * self.units
                start = np.where(self.held, np.clip(start, self.low, self.high), start)
                home = self._reached(start, "near")
                tried += [] if home is None else [home]
            good = [h for h in tried if self._inside(np.where(self.held, h.values, self.low))]
            best = max(good, key=lambda home: home.index, default=None)
            if best is not None and best.index >= 5 * SMALL:
                return best
            if tried and (best is None or best.index < SINGULAR):
                # All that close are singular, and not for where they are.
                break
        return best if best is not None and best.index >= SINGULAR else None

    def _home(self, values: Array, miss: float, how: str) -> Home:
        self.assembly.place(values)
        try:
            settled = self._settle(
                self.graph(), max(ROUNDED[2], 10 * miss, 20 * self.assembly.tree.accuracy)
            )
            index = 0.0 if settled is None else singularity_at_home(settled[0])
        except (ParameterError, SingularityError, np.linalg.LinAlgError):
            # The machine is looked at again by whoever makes a robot of it.
            settled, index = None, 0.0
        sound, held, rounding = settled or (None, {}, 0.0)
        return Home(values, miss, how, self.place, sound, held, rounding, index)

    def _settle(self, graph: Graph, most: float) -> tuple[Graph, dict[str, float], float] | None:
        """The graph without spins and without a file's rounding, as little of it as will do."""
        fallback = None
        if self._hinges is not None:
            sound = hold(graph, list(self._hinges))
            if is_right(sound) and is_clear(sound):
                return sound, self._hinges, 0.0
        most = min(most, ROUNDED[-1])
        for tolerance in (0.0, *(t for t in ROUNDED if t < most), most):
            ideal: Graph | None = graph
            rounding = 0.0
            if tolerance:
                conditions = Conditions(graph, tolerance)
                rounding = max((c.size for c in conditions.missed), default=0.0)
                ideal = conditions.idealized() if rounding else None
            if ideal is None:
                continue
            sound, held = without_spins(ideal)
            if is_right(sound):
                result = sound, held, rounding
                if is_clear(sound):
                    if not tolerance and all(sound.joints[n].kind == "fixed" for n in held):
                        self._hinges = result[1]
                    return result
                fallback = fallback or result
        return fallback
