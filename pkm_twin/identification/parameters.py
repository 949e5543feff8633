# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What a fit varies and how well it knows it: parameters of a file, numbers, combinations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise
from typing import Any, Final, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from delta_dynamics.torques.regressor import parameter_names
from delta_dynamics.torques.virtual_work import mass_matrix
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import UnknownNameError
from pkm_twin.identification.identifiable import KINDS, Identifiable, Kind, find_possible_inertia, identifiable
from pkm_twin.machine.graph import group_connected
from pkm_twin.machine.inertia import STANDARD_PARAMETERS, make_frame_change
from pkm_twin.machine.machine_yaml import edit_yaml
from pkm_twin.machine.places import Keys, join_path
from pkm_twin.robot.robot import Robot

T = TypeVar("T")
Status = Literal["fitted", "combination", "not excited"]

COMPLIANCE: Final = "compliance"
"""Name of the kind of number that is fitted to deflections instead of efforts."""
OBSERVED_RATIO: Final = 0.5
"""Largest ratio of a parameter's deviation to the prior's at which it counts as observed."""
FITTED_RATIO: Final = 0.2
"""Largest ratio of a number's deviation to the prior's at which it counts as fitted."""
MIN_RELATIVE_WEIGHT: Final = 0.1
"""Smallest weight of an element in a combination, as a fraction of the largest weight."""


@dataclass(frozen=True, eq=False)
class FileParameters:
    """Some of the parameters that a robot's file gives, k of them.

    ``groups``: entries of the file, in order. ``mixing``: shape (p, k), the regressor's parameters
    by these: Y mixing is the columns of these. ``loads``: values of these by which friction that
    grows with the load is taken, shape (k,); None: the file's.
    """

    groups: tuple[Identifiable, ...]
    mixing: Array
    loads: Array | None = None

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names, shape (k,)."""
        return tuple(name for group in self.groups for name in group.names)

    @cached_property
    def kinds(self) -> NDArray[np.str_]:
        """Kinds, shape (k,)."""
        return np.array([group.kind for group in self.groups for _ in group.names])

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
        """Slice of each group's parameters."""
        ends = np.cumsum([0, *(len(group.names) for group in self.groups)])
        return tuple(slice(int(a), int(b)) for a, b in pairwise(ends))

    @cached_property
    def cones(self) -> tuple[tuple[slice, Array], ...]:
        """Where in the parameters, and the matrices whose sum has to be semidefinite."""
        pairs = zip(self.slices, self.groups, strict=True)
        return tuple((where, cone) for where, group in pairs for cone in group.cones)


def file_parameters(robot: Robot, what: Sequence[Kind] = KINDS) -> FileParameters:
    """List the parameters of some kinds.

    :raises ParameterError: the robot's file gives no masses.
    """
    kept = [g for g in robot.cached(identifiable) if g.kind in what]
    for k, group in enumerate(kept):
        if group.kind == "rotor":
            # A rotor inertia may be all that the mass matrix has at home.
            moved = float(np.diag(mass_matrix(robot, robot.graph.home)).max())
            kept[k] = replace(group, scales=np.array([max(moved, float(group.values[0]))]))
    place = {name: k for k, name in enumerate(parameter_names(robot))}
    tree = robot.engine.tree
    mixing = np.zeros((len(place), sum(len(group.names) for group in kept)))
    start = 0
    for group in kept:
        end = start + len(group.names)
        for body, ten in group.bodies.items():
            rows = [place[f"{body}.{word}"] for word in STANDARD_PARAMETERS]
            mixing[rows, start:end] += make_frame_change(np.eye(3), -tree.at[body]) @ ten
        for name, row in group.others.items():
            mixing[place[name], start:end] += row
        start = end
    return FileParameters(tuple(kept), mixing)


def parse_kinds(what: str) -> tuple[Kind, ...]:
    """Parse the kinds of numbers, separated by commas.

    :raises UnknownNameError: another word.
    """
    words = tuple(word.strip() for word in what.split(","))
    for word in words:
        if word not in KINDS:
            raise UnknownNameError("--what", word, (*KINDS, COMPLIANCE))
    return tuple(kind for kind in KINDS if kind in words)


@dataclass(frozen=True)
class Number:
    """One number of the file: where it stands, before and after, and its standard deviation.

    ``deviation``: NaN where it is withheld, as the model does not explain the recordings.
    ``status``: ``fitted``; ``combination``:
    known only in combination; ``not excited``: the motion does not identify it, the file's value
    stays.
    """

    key: Keys
    unit: str
    before: float
    after: float
    deviation: float
    status: Status

    @property
    def spread(self) -> str:
        """The standard deviation in words."""
        return f"{self.deviation:.2g}" if np.isfinite(self.deviation) else "withheld"

    @property
    def name(self) -> str:
        """The key, with dots."""
        return join_path(self.key)


def make_number(
    key: Keys, unit: str, before: float, value: float, deviations: tuple[float, float], prior: float
) -> Number:
    """Return a number with its standard deviation by the noise alone.

    :param deviations: by the noise alone, and with what the model does not explain.
    :param prior: its standard deviation before.
    """
    plain, wide = deviations
    share = plain / prior if prior > 0.0 else 1.0
    if share > 0.98 and abs(value - before) <= 1e-3 * prior:
        return Number(key, unit, before, before, plain, "not excited")
    status: Status = "fitted" if share < FITTED_RATIO else "combination"
    return Number(key, unit, before, value, wide, status)


def make_group_numbers(
    group: Identifiable, values: Array, prior: Array, covariances: tuple[Array, Array]
) -> list[Number]:
    """Return a group's numbers of the file, their deviations by the derivatives of its keys.

    An inertia that no body has with the file's value of what is not excited is fitted as a whole.

    :param covariances: of the values by the noise alone, and with what the model does not explain.
    """
    before, after = group.keys(group.values), group.keys(values)
    columns = []
    for step in np.diag(1e-6 * prior):
        high, low = group.keys(values + step), group.keys(values - step)
        columns.append([(high[key] - low[key]) / (2.0 * step.sum()) for key in after])
    numbers, whole = list[Number](), list[Number]()
    each = zip(np.array(columns).T, after.items(), group.units, strict=True)
    for slope, (key, value), unit in each:
        plain, wide = (float(np.sqrt(max(slope @ one @ slope, 0.0))) for one in covariances)
        usual = float(np.linalg.norm(slope * prior))
        numbers.append(make_number(key, unit, before[key], value, (plain, wide), usual))
        whole.append(Number(key, unit, before[key], value, wide, "combination"))
    moments: dict[Keys, list[int]] = {}
    for k, one in enumerate(numbers):
        if isinstance(one.key[-1], int) and isinstance(one.key[-2], int):
            moments.setdefault(_find_entry_key(one.key), []).append(k)
    for places in moments.values():
        inertia = np.array([numbers[k].after for k in places])
        off = np.abs(find_possible_inertia(inertia) - inertia).max()
        for k in places if off > 1e-12 * np.abs(inertia).max() else ():
            numbers[k] = numbers[k] if numbers[k].status != "not excited" else whole[k]
    return numbers


@dataclass(frozen=True)
class Combination:
    """A weighted sum of elements' factors, of weights with squares that sum to 1."""

    weights: dict[str, float]
    value: float
    deviation: float


@dataclass(frozen=True)
class Group:
    """Elements that the loads do not distinguish, and what is known of them together."""

    elements: tuple[str, ...]
    known: tuple[Combination, ...]


def group_elements(
    names: Sequence[str], factors: Array, covariance: Array, wide: Array | None = None
) -> tuple[Group, ...]:
    """Group the elements that the data do not separate, with the combinations that are known.

    :param factors: shape (elements,), known to 1 before. ``covariance``: of them, and of more
        behind them, by the noise alone. ``wide``: with what the model does not explain; default
        the same.
    """
    count = len(names)
    own = covariance[:count, :count]
    full = own if wide is None else wide[:count, :count]
    values, vectors = np.linalg.eigh(own)
    unknown = vectors[:, values > FITTED_RATIO**2]
    shared = np.abs(unknown @ unknown.T)
    open_ = np.flatnonzero(np.diag(shared) > MIN_RELATIVE_WEIGHT**2).tolist()
    pairs = ((i, j) for i, j in combinations(open_, 2) if shared[i, j] > MIN_RELATIVE_WEIGHT)
    found = [sorted(members) for members in group_connected(open_, pairs)]
    result = list[Group]()
    for members in found:
        if len(members) < 2:
            continue
        values, vectors = np.linalg.eigh(own[np.ix_(members, members)])
        told = []
        for vector in vectors[:, values <= FITTED_RATIO**2].T:
            named = list_weights(range(len(members)), vector)
            weights = np.zeros(len(members))
            weights[list(named)] = list(named.values())
            weights /= np.linalg.norm(weights)
            deviation = float(np.sqrt(weights @ full[np.ix_(members, members)] @ weights))
            each = {names[members[k]]: float(weights[k]) for k in named}
            told.append(Combination(each, float(weights @ factors[members]), deviation))
        result.append(Group(tuple(names[k] for k in members), tuple(told)))
    return tuple(result)


def list_weights(names: Sequence[T], vector: Array) -> dict[T, float]:
    """List a direction's weights by name, without small ones; the largest is positive."""
    vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
    least = MIN_RELATIVE_WEIGHT * float(np.abs(vector).max())
    return {n: w for n, w in zip(names, vector.tolist(), strict=True) if abs(w) > least}


def fitted_yaml(text: str, fitted: Sequence[Number], recordings: Sequence[str]) -> str:
    """Write the robot's file with the fitted numbers, each with deviation and source.

    :param text: of the file before.
    """
    groups: dict[Keys, list[Number]] = {}
    for number in fitted:
        groups.setdefault(_find_entry_key(number.key), []).append(number)
    values: dict[Keys, Any] = {}
    notes: dict[Keys, str] = {}
    source = ", ".join(recordings)
    for base, numbers in groups.items():
        if all(number.status == "not excited" for number in numbers):
            continue
        values[base] = _value(base, numbers)
        told = [n for n in numbers if n.status != "not excited"]
        spread = ", ".join(n.spread for n in told)
        alone = all(n.status == "fitted" for n in told)
        how = "" if alone else "; known only in combination with others"
        was = ", ".join(f"{n.before:.6g}" for n in told)
        unit = f" {told[0].unit}" if told[0].unit else ""
        notes[base] = (
            f"{'.'.join(str(k) for k in base[-2:])}: fitted from {source}, +- {spread}{unit} "
            f"(one standard deviation), was {was}{how}"
        )
    return edit_yaml(text, values, notes)


def _find_entry_key(key: Keys) -> Keys:
    """Return the key of the number, vector or matrix that a number belongs to."""
    base: Keys = tuple(k for k in key if not isinstance(k, int))
    # A section of a list is no place in a vector.
    return (*key[:2], *base[1:]) if key[:1] == ("limbs",) and isinstance(key[1], int) else base


def _value(base: Keys, numbers: Sequence[Number]) -> Any:
    """Return a number, a list, or a matrix from what stands below one key."""
    tails = {n.key[len(base) :]: n.after for n in numbers}
    if () in tails:
        return tails[()]
    if len(next(iter(tails))) == 1:
        return [tails[k,] for k in range(len(tails))]
    upper = np.triu_indices(3)
    inertia = np.array([tails.get((i, j), np.nan) for i, j in np.transpose(upper).tolist()])
    matrix = np.zeros((3, 3))
    matrix[upper] = matrix[upper[::-1]] = inertia
    if not np.any(matrix - np.diag(np.diag(matrix))):
        return np.diag(matrix).tolist()
    return matrix.tolist()
