# SPDX-License-Identifier: Apache-2.0
"""A robot's file as linear parameters: what a fit varies, and the regressor's columns of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from delta_dynamics.regressor import TEN, parameter_names
from delta_dynamics.virtual_work import mass_matrix
from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.inertia import transport
from pkm_twin.machine.shared import KINDS, Kind, Shared
from pkm_twin.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class FileParameters:
    """Some of the parameters that a robot's file gives, k of them.

    ``groups``: entries of the file, in order. ``mixing``: shape (p, k), the regressor's parameters
    by these: Y mixing is the columns of these. ``loads``: values of these by which friction that
    grows with the load is taken, shape (k,); None: the file's.
    """

    groups: tuple[Shared, ...]
    mixing: Array
    loads: Array | None = None

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names, shape (k,)."""
        return tuple(name for group in self.groups for name in group.names)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Units, shape (k,)."""
        return tuple(unit for group in self.groups for unit in group.units)

    @cached_property
    def values(self) -> Array:
        """The file's own, shape (k,)."""
        return np.concatenate([group.values for group in self.groups])

    @cached_property
    def scales(self) -> Array:
        """How far each may be from the file's, shape (k,); NaN where only data can tell."""
        return np.concatenate([group.scales for group in self.groups])

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """Where each group's parameters stand."""
        ends = np.cumsum([0, *(len(group.names) for group in self.groups)])
        return tuple(slice(int(a), int(b)) for a, b in pairwise(ends))

    @cached_property
    def cones(self) -> tuple[tuple[slice, Array], ...]:
        """Where in the parameters, and the matrices whose sum has to be semidefinite."""
        pairs = zip(self.slices, self.groups, strict=True)
        return tuple((where, cone) for where, group in pairs for cone in group.cones)


def _scaled(group: Shared, robot: Robot) -> Shared:
    """A rotor may weigh as much as all that the joints move at home."""
    if group.kind != "rotor":
        return group
    moved = float(np.diag(mass_matrix(robot, robot.graph.home)).max())
    return replace(group, scales=np.array([max(moved, float(group.values[0]))]))


def file_parameters(robot: Robot, what: Sequence[Kind] = KINDS) -> FileParameters:
    """The parameters of some kinds.

    :raises ParameterError: the robot's file gives no masses.
    """
    kept = [_scaled(g, robot) for g in robot.shared_parameters() if g.kind in what]
    place = {name: k for k, name in enumerate(parameter_names(robot))}
    tree = robot.engine.tree
    mixing = np.zeros((len(place), sum(len(group.names) for group in kept)))
    start = 0
    for group in kept:
        end = start + len(group.names)
        for body, ten in group.bodies.items():
            rows = [place[f"{body}.{word}"] for word in TEN]
            mixing[rows, start:end] += transport(np.eye(3), -tree.at[body]) @ ten
        for name, row in group.others.items():
            mixing[place[name], start:end] += row
        start = end
    return FileParameters(tuple(kept), mixing)
