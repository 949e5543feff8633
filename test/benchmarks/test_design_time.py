# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The design of a machine against an optimiser that compiles each machine, by processor time."""

from time import process_time

import numpy as np
import pytest
from scipy.optimize import minimize

from delta_dynamics import inverse_dynamics
from pkm_twin.design import design
from pkm_twin.errors import PkmTwinError
from pkm_twin.kinematics.engine import Engine
from test.benchmarks.test_speed import record
from test.laws.test_design import BOX, pick_and_place

pytestmark = pytest.mark.benchmark_run


@pytest.mark.timeout(3600)
def test_an_optimiser_that_compiles_each_machine_finds_no_better_one(benchmark, monkeypatch):
    robot, path = pick_and_place()
    began = process_time()
    found = design(robot, BOX, path, "peak-effort", ["singularity>=0.1"], starts=16)
    took = process_time() - began
    structure = Engine.structure.func
    monkeypatch.setattr(Engine, "structure", property(lambda e: structure(e).extend(e.graph.key)))
    counted = 0

    def asked(x):
        """Peak effort of the machine as a robot of its own; much where it misses a bound."""
        nonlocal counted
        counted += 1
        try:
            machine = robot.with_file_values(dict(zip(BOX, x.tolist(), strict=True)))
            q = machine.inverse(path.pose)
            miss = 0.1 - machine.singularity(q).min()
            qd = np.linalg.solve(machine.jacobian(q), path.rate[..., None])
            bias = machine.pose_acceleration(q, qd[..., 0], np.zeros_like(q))
            qdd = np.linalg.solve(machine.jacobian(q), (path.acceleration - bias)[..., None])
            tau = inverse_dynamics(machine, q, qd[..., 0], qdd[..., 0])
        except (PkmTwinError, ValueError):
            return 1e3
        return np.abs(tau).max() + 1e3 * max(0.0, miss)

    start = np.array([robot.number(number) for number in BOX])
    began = process_time()
    other = minimize(
        asked,
        start,
        method="Nelder-Mead",
        bounds=list(BOX.values()),
        options={"xatol": 1e-4, "fatol": 1e-4},
    )
    theirs = process_time() - began
    best = found.best.quantities["peak-effort"]
    record(
        benchmark,
        "design",
        best=best,
        seconds=took,
        others_best=float(other.fun),
        others_seconds=theirs,
        compiled=counted,
    )
    assert best <= 1.005 * other.fun
    assert took < theirs / 20.0
