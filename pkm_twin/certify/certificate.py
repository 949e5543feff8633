# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compare a robot's torques, poses and matrices with other engines over random states.

The engines compute from the machine's description alone, see ``pkm_twin.certify``. One of them
needs only numpy; Pinocchio and MuJoCo are used if they are installed.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from typing import Any, Final, Protocol

import numpy as np

from delta_dynamics import inverse_dynamics, mass_matrix
from pkm_twin.certify.description import UnfitError
from pkm_twin.certify.maximal import Maximal, States, random_states
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, PkmTwinError, SingularityError, UnreachableError, write_install_command
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.robot_urdf import robot_description
from pkm_twin.robot.variation import KINDS, vary_robot

ENGINES: Final = {
    "maximal": ("pkm_twin.certify.maximal:Maximal", "numpy"),
    "pinocchio": ("pkm_twin.certify.pinocchio_tree:PinocchioTree", "pin"),
    "mujoco": ("pkm_twin.certify.mujoco_tree:MujocoTree", "mujoco"),
}
"""Each engine's class and the distribution that it needs."""
BOUNDS: Final = {
    "torques": 1e-9,
    "platform": 1e-9,
    "jacobian": 1e-9,
    "mass_matrix": 1e-9,
    "round_trip": 1e-9,
    "batch": 0.0,
}
"""Largest differences that pass: platform in m and entries of the rotation, round trip in rad or m,
all others relative."""
VARIANT_DEVIATION: Final = 0.02
"""Relative standard deviation of the parameters of random machines."""


class Judge(Protocol):
    """Quantities that an independent engine computes for one state."""

    def inverse_dynamics(self, q: Array, qd: Array, qdd: Array, wrench: Array) -> Array:
        """Compute the efforts, shape (n,)."""

    def platform(self, q: Array) -> tuple[Array, Array]:
        """Compute the platform's position, shape (3,), and rotation, shape (3, 3)."""

    def jacobian(self, q: Array) -> Array:
        """Compute the platform's twist per joint velocity, shape (6, n)."""

    def mass_matrix(self, q: Array) -> Array:
        """Compute the mass matrix, shape (n, n)."""


@dataclass(frozen=True)
class Item:
    """One comparison: the largest and the median difference over all states, and its bound."""

    engine: str
    what: str
    worst: float
    median: float
    bound: float

    @property
    def good(self) -> bool:
        """True if the largest difference is within the bound."""
        return self.worst <= self.bound


@dataclass(frozen=True)
class Certificate:
    """The result of all comparisons, and the engines that could not be used.

    ``drawn``, ``skipped``: see :class:`States`. ``mobility``, ``rank``, ``rows``: degrees of
    freedom, rank and number of the constraint equations at home.
    """

    robot: str
    seed: int
    states: int
    drawn: int
    skipped: int
    mobility: int
    rank: int
    rows: int
    versions: Mapping[str, str]
    """Versions of the engines."""
    missing: Mapping[str, str]
    """Reasons why engines were not used."""
    items: Sequence[Item]
    variants: int = 0
    """Number of random machines that were compared, too."""

    @property
    def good(self) -> bool:
        """True if every comparison is within its bound."""
        return all(item.good for item in self.items)

    @property
    def data(self) -> dict[str, Any]:
        """The certificate as numbers and names, for JSON; units of differences as in BOUNDS."""
        found = asdict(self)
        found["constraints"] = found.pop("rows")
        found["items"] = [asdict(item) | {"good": item.good} for item in self.items]
        return found | {"good": self.good}


def certify(
    robot: Any,
    description: Mapping[str, Any],
    *,
    states: int = 20,
    seed: int = 1,
    engines: Sequence[str] = tuple(ENGINES),
    progress: Callable[[int], None] = lambda _: None,
) -> Certificate:
    """Compare a robot with engines that know only its plain description.

    :param robot: the robot to check.
    :param description: the same machine as a ``mechanism: machine`` mapping; for a loaded robot
        ``robot_description(robot)``. With more actuated joints than degrees of freedom the efforts
        are compared as projected on the independent joints.
    :param states: number of random states inside the limits.
    :param seed: seed of the random numbers.
    :param engines: names out of ``ENGINES``; engines that are not installed are reported.
    :param progress: called with the number of states that are done.
    :raises PkmTwinError: no engine can compute the machine, or too few states can be reached.
    """

    def reaches(q: Array) -> bool:
        try:
            robot.forward(_expand_to_all_joints(robot, q)[0])
        except (SingularityError, UnreachableError):
            return False
        return True

    if _is_redundant(robot):
        idle = set(robot.joint_names) - set(robot.graph.leads)
        joints = {
            name: {**joint, "actuated": False, "limits": {}} if name in idle else joint
            for name, joint in description["joints"].items()
        }
        description = {**description, "joints": joints}
    try:
        first = Maximal(description)
        drawn = random_states(first, np.random.default_rng(seed), states, reaches)
    except UnfitError as error:
        raise PkmTwinError(f"{robot.name} cannot be cross-checked: {error}") from None
    judges: dict[str, Judge] = {}
    missing: dict[str, str] = {}
    for name in engines:
        if name == first.name:
            judges[name] = first
            continue
        module, kind = ENGINES[name][0].split(":")
        try:
            maker: Callable[[Mapping[str, Any]], Judge] = getattr(importlib.import_module(module), kind)
            judges[name] = maker(description)
        except ImportError as error:
            if error.name is None or error.name.startswith("pkm_twin"):
                raise
            missing[name] = f"{ENGINES[name][1]} is not installed; {write_install_command('certificate')}"
        except UnfitError as error:
            missing[name] = str(error)
    # Compare the inverse with the forward kinematics, and single samples with a batch.
    motion = *_expand_to_all_joints(robot, drawn.q, drawn.qd, drawn.qdd), drawn.wrench
    trip = np.abs(robot.inverse(robot.forward(motion[0])) - motion[0]).max(-1)
    single = np.array([inverse_dynamics(robot, *state) for state in zip(*motion, strict=True)])
    items = [
        _make_item("twin", "round_trip", trip),
        _make_item("twin", "batch", np.abs(inverse_dynamics(robot, *motion) - single)),
        *_compare_engines(robot, judges, drawn, progress),
    ]
    return Certificate(
        robot.name,
        seed,
        states,
        drawn.drawn,
        drawn.skipped,
        first.home.mobility,
        first.home.rank,
        first.home.rows,
        {name: version(ENGINES[name][1]) for name in judges},
        missing,
        items,
    )


def certify_robot(robot: Any, **options: Any) -> Certificate:
    """Run :func:`certify` with the robot's own description."""
    return certify(robot, robot_description(robot), **options)


def certify_variants(
    robot: Robot, count: int, *, seed: int = 1, progress: Callable[[int], None], **options: Any
) -> Certificate:
    """Compare the robot and random variants of it; return one certificate of all.

    :param count: number of variants, whose masses, inertias, friction and lengths are perturbed by
        ``VARIANT_DEVIATION``; lengths stay unchanged if the loops do not close otherwise.
    :param seed: seed of the states and of the variants.
    """
    found: list[Certificate] = []
    for k in range(count + 1):
        machine = robot if k == 0 else draw_variant(robot, seed + k)
        done = sum(one.states for one in found)
        found.append(certify_robot(machine, seed=seed, progress=lambda n, done=done: progress(done + n), **options))
    by_name: dict[tuple[str, str], list[Item]] = {}
    for item in (item for one in found for item in one.items):
        by_name.setdefault((item.engine, item.what), []).append(item)
    items = [
        replace(
            same[0], worst=max(item.worst for item in same), median=float(np.median([item.median for item in same]))
        )
        for same in by_name.values()
    ]
    return replace(
        found[0],
        items=items,
        missing={name: reason for one in found for name, reason in one.missing.items()},
        drawn=sum(one.drawn for one in found),
        skipped=sum(one.skipped for one in found),
        variants=count,
    )


def draw_variant(robot: Robot, seed: int) -> Robot:
    """Make a variant with perturbed parameters; perturb lengths only if the loops still close."""
    kinds = [kind for kind in KINDS if kind != "lengths"]
    try:
        return vary_robot(robot, dict.fromkeys(KINDS, VARIANT_DEVIATION), seed).robot
    except ParameterError:
        return vary_robot(robot, dict.fromkeys(kinds, VARIANT_DEVIATION), seed).robot


def _is_redundant(robot: Any) -> bool:
    """Return whether the robot has more actuated joints than degrees of freedom."""
    return bool(getattr(robot, "redundant", False))


def _expand_to_all_joints(robot: Any, *motion: Array) -> tuple[Array, ...]:
    """Compute positions, velocities and accelerations of all joints from the independent ones."""
    if not _is_redundant(robot):
        return motion
    expanded = [np.zeros((*one.shape[:-1], robot.joints_count)) for one in motion]
    for one, leads in zip(expanded, motion, strict=True):
        one[..., robot.graph.leading] = leads
    return tuple(robot.project_redundant(*expanded))


def _compare_engines(
    robot: Any, judges: Mapping[str, Judge], states: States, progress: Callable[[int], None]
) -> list[Item]:
    all_positions, rates, changes = _expand_to_all_joints(robot, states.q, states.qd, states.qdd)
    tau = inverse_dynamics(robot, all_positions, rates, changes, states.wrench)
    position, rotation = robot.platform(all_positions)
    twist, inertia = robot.platform_jacobian(all_positions), mass_matrix(robot, all_positions)
    if _is_redundant(robot):
        # Velocities of all joints per velocity of the independent joints.
        joint_rates = robot.inverse_jacobian(all_positions)
        by_independent = joint_rates @ np.linalg.inv(joint_rates[:, robot.graph.leading])
        tau = np.einsum("knm,kn->km", by_independent, tau)
        twist, inertia = twist @ by_independent, by_independent.swapaxes(-1, -2) @ inertia @ by_independent
    efforts: dict[str, list[Array]] = {name: [] for name in judges}
    found: dict[tuple[str, str], list[float]] = {}
    for k in range(len(states.q)):
        q = states.q[k]
        for name, judge in judges.items():
            effort = judge.inverse_dynamics(q, states.qd[k], states.qdd[k], states.wrench[k])
            efforts[name].append(effort)
            all_positions, turned = judge.platform(q)
            difference = max(np.abs(position[k] - all_positions).max(), np.abs(rotation[k] - turned).max())
            found.setdefault((name, "platform"), []).append(float(difference))
            for what, got, expected in (
                ("jacobian", twist[k], judge.jacobian(q)),
                ("mass_matrix", inertia[k], judge.mass_matrix(q)),
            ):
                found.setdefault((name, what), []).append(relative_difference(got, expected))
        progress(k + 1)
    items = []
    for name in judges:
        expected = np.array(efforts[name])
        items.append(_make_item(name, "torques", effort_differences(tau, expected)))
        items += [_make_item(name, what, found[name, what]) for owner, what in found if owner == name]
    return items


def effort_differences(got: Array, expected: Array) -> Array:
    """Return each state's largest difference relative to its largest effort, shape (states,).

    If a state's efforts nearly vanish, the difference is relative to a thousandth of the largest effort
    of all states.
    """
    size = np.abs(expected).max(-1)
    scale = np.maximum(size, 1e-3 * size.max())
    apart = np.abs(got - expected).max(-1)
    return np.asarray(np.divide(apart, scale, out=np.where(apart > 0, np.inf, 0.0), where=scale > 0))


def relative_difference(got: Array, expected: Array) -> float:
    """Return the largest difference relative to the largest expected absolute value."""
    apart, size = float(np.abs(got - expected).max()), float(np.abs(expected).max())
    return apart / size if size else (math.inf if apart else 0.0)


def _make_item(engine: str, what: str, values: Any) -> Item:
    amounts = np.asarray(values, dtype=float)
    # Replace NaN by infinity, so that it exceeds every bound wherever it stands.
    worst = float(np.where(np.isfinite(amounts), amounts, np.inf).max())
    return Item(engine, what, worst, float(np.median(amounts)), BOUNDS[what])
