# SPDX-License-Identifier: Apache-2.0
"""Torques of both closures against Pinocchio: a tree with loop constraints, a model of its own."""

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import SingularityError, UnreachableError
from test.support.robots import partly_long

pytest.importorskip("pinocchio")
from bags.recording.pinocchio_delta import DeltaEngine
from bags.recording.pinocchio_loops import AssemblyError

MACHINES, STATES = partly_long([2, 10], 2), 20


def reachable(robot, engine, rng):
    """A random joint state that both assemble, some way from the singular ones."""
    for _ in range(1000):
        q = rng.uniform(-0.5, 0.8, 3)
        try:
            engine.state(q, np.zeros(3), np.zeros(3))
            if abs(np.linalg.det(robot.jacobian(q))) < 1.0:
                return q
        except (UnreachableError, SingularityError, AssemblyError):
            pass
    raise AssertionError("no reachable state found")


@pytest.mark.parametrize("machines", MACHINES)
@pytest.mark.parametrize("closure", ["rod", "rcu"])
def test_torques_of_random_machines_and_states(closure, machines, variant, rng):
    worst = 0.0
    for machine in range(machines):
        arm = rng.uniform(0.12, 0.4)
        robot, data = variant(
            "delta",
            geometry={
                "base_radius": float(rng.uniform(0.06, 0.2)),
                "platform_radius": float(rng.uniform(0.03, 0.06)),
                "arm_length": float(arm),
                "forearm_length": float(arm * rng.uniform(1.8, 2.6)),
                "closures": ["rod", "rod", closure],
            },
            inertia={
                "platform_mass": float(rng.uniform(0.1, 1.0)),
                "arm_mass": float(rng.uniform(0.1, 1.0)),
                "forearm_mass": float(rng.uniform(0.05, 0.4)),
                "arm_com": float(rng.uniform(0.0, 1.0)),
                "arm_inertia": float(rng.uniform(1e-4, 1e-2)),
                "rotor_inertia": float(rng.uniform(0.0, 1e-2)),
            },
            payload={
                "mass": float(rng.uniform(0.0, 1.0)),
                "com": rng.uniform(-0.05, 0.05, 3).tolist(),
                "inertia": [1e-3, 2e-3, 1.5e-3],
            },
            friction={
                "viscous": rng.uniform(0, 0.2, 3).tolist(),
                "coulomb": rng.uniform(0, 0.2, 3).tolist(),
            },
            gravity=[0.3, -0.4, -9.7],
        )
        # The PyYAML reader of the engine knows full matrices only.
        data["payload"]["inertia"] = np.diag(data["payload"]["inertia"]).tolist()
        engine = DeltaEngine(data)
        for _ in range(STATES):
            q, qd, qdd = reachable(robot, engine, rng), rng.normal(0, 4, 3), rng.normal(0, 60, 3)
            wrench = rng.normal(0, 20, 6)
            expected = engine.inverse_dynamics(q, qd, qdd, wrench)
            got = inverse_dynamics(robot, q, qd, qdd, wrench)
            worst = max(worst, np.abs(got - expected).max() / np.abs(expected).max())
        assert worst < 1e-9, machine
