# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compare a random machine by all routes, and collect the figures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from delta_dynamics import inverse_dynamics
from delta_dynamics.torques.reactions import reactions
from delta_dynamics.torques.virtual_work import energy
from pkm_twin.certify.mujoco_tree import MujocoTree
from pkm_twin.robot.robot_urdf import robot_description
from tools.certificate.lagrange_machines import energies
from tools.certificate.machines import Case, friction, random_case
from tools.certificate.swing import find_engine

ROUTES = ("Pinocchio", "MuJoCo", "Lagrange")
EFFORT_BOUND = 1e-9
"""Greatest relative difference of the torques that passes."""
PLACE_BOUND = 1e-9
"""Greatest difference of the platform's centre that passes, m."""
BALANCE_BOUNDS = {"residual": 1e-10, "efforts": 1e-9, "power": 1e-9, "energy": 1e-9}


@dataclass
class Figures:
    """The results; lists have one number per state."""

    machines: int = 0
    efforts: dict[str, list[float]] = field(default_factory=lambda: {r: [] for r in ROUTES})
    places: dict[str, list[float]] = field(default_factory=lambda: {r: [] for r in ROUTES})
    balances: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in BALANCE_BOUNDS})

    def add(self, other: Figures) -> None:
        """Append the results of another machine."""
        self.machines += other.machines
        for mine, theirs in (
            (self.efforts, other.efforts),
            (self.places, other.places),
            (self.balances, other.balances),
        ):
            for key, values in theirs.items():
                mine[key] += values


def difference(got: np.ndarray, expected: np.ndarray) -> float:
    """Return the greatest difference over the greatest expected magnitude."""
    return float(np.abs(got - expected).max() / np.abs(expected).max())


def compare(name: str, seed: tuple[int, ...], states: int, exact: int) -> Figures:
    """Compare one random machine by all engines; slow engines take the first ``exact`` states."""
    return compare_case(random_case(name, np.random.default_rng(seed), states), exact)


def compare_case(case: Case, exact: int) -> Figures:
    """Compare a given machine, as :func:`compare`."""
    figures = Figures(machines=1)
    robot, data = case.robot, case.data
    got = inverse_dynamics(robot, case.q, case.qd, case.qdd, case.wrench)
    place_of, _ = robot.platform(case.q)
    twist = np.einsum("kij,kj->ki", robot.platform_jacobian(case.q), case.qd)
    joint = reactions(robot, case.q, case.qd, case.qdd, case.wrench)
    drag = friction(data, case.qd)
    figures.balances["residual"] = joint.residual.tolist()
    rotors = np.array([robot.graph.joints[name].rotor_inertia for name in robot.joint_names])
    reaching = got - drag - rotors * case.qdd
    figures.balances["efforts"] = [difference(one, other) for one, other in zip(joint.efforts, reaching, strict=True)]

    engine, source = find_engine(data), energies(data)
    mechanics = MujocoTree(robot_description(robot))
    stored = energy(robot, case.q, case.qd).total
    for k in range(len(case.q)):
        state = case.q[k], case.qd[k], case.qdd[k]
        full = engine.state(*state)
        effort = engine.actuator_effort(full, case.wrench[k])[0] + engine.friction(case.qd[k])
        place = engine.platform_placement(full.q).translation
        _note(figures, "Pinocchio", got[k], effort, place_of[k], place)

        if k >= exact:
            continue
        effort = mechanics.inverse_dynamics(*state, case.wrench[k])
        _note(figures, "MuJoCo", got[k], effort, place_of[k], mechanics.platform(case.q[k])[0])
        result = source.solve(*state, case.wrench[k])
        effort = result.effort + drag[k]
        _note(figures, "Lagrange", got[k], effort, place_of[k], result.platform)
        # The twin's efforts and velocities against the rate of the other route's energy.
        shares = (got[k] - drag[k]) * case.qd[k]
        load = case.wrench[k] @ twist[k]
        scale = np.abs(shares).sum() + abs(load)
        figures.balances["power"].append(float(abs(shares.sum() + load - result.energy_rate) / scale))
        size = abs(result.energy) + abs(result.kinetic)
        figures.balances["energy"].append(float(abs(stored[k] - result.energy) / size))
    return figures


def _note(
    figures: Figures,
    route: str,
    got: np.ndarray,
    effort: np.ndarray,
    mine: np.ndarray,
    place: np.ndarray,
) -> None:
    figures.efforts[route].append(difference(got, effort))
    figures.places[route].append(float(np.abs(mine - place).max()))
