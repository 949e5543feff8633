# SPDX-License-Identifier: Apache-2.0
"""A machine that moves: energy, an independent engine, dry friction, stops."""

from pathlib import Path

import numpy as np
import pytest

from delta_dynamics import energy, inverse_dynamics, mass_matrix
from delta_dynamics.plant import Plant, _least
from test.support.robots import FREE, load, massive, random_joints

STEP = 1e-3
NO_WRENCH = np.zeros(6)
GANTRY = Path(__file__).parents[1] / "machine/machines/gantry.yaml"


def smooth(robot):
    """The robot without friction in its drives; passive joints keep theirs."""
    n = robot.joints_count
    return robot.changed(friction={key: [value] * n for key, value in FREE.items()})


def rubs_inside(robot):
    """Whether a passive joint has friction."""
    return any(joint.viscous or joint.coulomb for joint in robot.graph.joints.values()
               if not joint.actuated)  # fmt: skip


def beside_rest(robot):
    """At home, moving, with the efforts that bear the weight there, which have a potential."""
    q = robot.inverse(robot.home())
    plant = Plant(robot, q)
    plant.qd = np.array([0.5 if unit == "rad" else 0.1 for unit in robot.joint_units])
    return plant, inverse_dynamics(robot, q, 0.0 * q, 0.0 * q)


def swing(plant, effort, steps, step=STEP):
    """Bodies' energy less efforts times positions over a swing, and the greatest kinetic one."""
    sums, kinetic = [], 0.0
    for _ in range(steps):
        plant.advance(effort, NO_WRENCH, step)
        now = energy(plant.robot, plant.q, plant.qd)
        sums.append(float(now.total) - plant.q @ effort)
        kinetic = max(kinetic, float(now.kinetic))
    return np.array(sums), kinetic


@massive
def test_a_free_swing_keeps_its_energy_and_friction_takes_some(name):
    robot = smooth(load(name))
    plant, effort = beside_rest(robot)
    sums, kinetic = swing(plant, effort, 100)
    drift = np.abs(sums - sums[0]).max() / kinetic
    print(f"{name}: drift {drift:.1e} of the greatest kinetic energy")
    if rubs_inside(robot):
        assert (np.diff(sums) < 0.0).all()
    else:
        assert drift < 1e-9


@pytest.mark.parametrize("name", ["delta_cu", "prru"])
def test_a_swing_is_that_of_an_independent_engine(name):
    pytest.importorskip("pinocchio")
    from test.certificate.machines import build
    from test.certificate.swing import engine_of, starts

    (start,) = (s for s in starts() if s.title == name)
    robot = build(start.data)
    plant = Plant(robot, start.q)
    plant.qd = start.qd.copy()
    effort = inverse_dynamics(robot, start.rest, 0.0 * start.rest, 0.0 * start.rest)
    engine = engine_of(start.data)
    state = engine.state(start.q, start.qd, np.zeros(3))
    q, v = state.q, state.v
    for _ in range(150):
        plant.advance(effort, NO_WRENCH, STEP)
        q, v = engine.step(q, v, effort, None, STEP)
    assert np.abs(plant.q - start.q).max() > 5e-3
    assert np.abs(plant.q - q[engine.actuated]).max() < 1e-9
    assert np.abs(plant.qd - v[engine.actuated]).max() < 1e-8


@massive
def test_joints_stick_within_their_friction_and_leave_beyond_it(name, rng):
    plain = smooth(load(name))
    q = random_joints(plain, rng, 1)[0]
    weight = inverse_dynamics(plain, q, 0.0 * q, 0.0 * q)
    dry = 0.1 * np.abs(weight).max() + 0.01
    n = plain.joints_count
    plant = Plant(plain.changed(friction={"coulomb": [dry] * n}), q)
    for push in (np.full(n, 0.999 * dry), np.full(n, -0.999 * dry), rng.uniform(-dry, dry, n)):
        for _ in range(20):
            plant.advance(weight + push, NO_WRENCH, STEP)
        assert (plant.q == q).all() and (plant.qd == 0.0).all()
    push = np.zeros(n)
    push[0] = 1.5 * dry
    plant.advance(weight + push, NO_WRENCH, STEP)
    assert plant.qd[0] > 0.0
    if rubs_inside(plain):
        return
    for _ in range(20):
        plant.advance(weight + push, NO_WRENCH, STEP)
    # And it stands again, for good, once nothing pushes.
    for _ in range(400):
        plant.advance(inverse_dynamics(plain, plant.q, 0.0 * q, 0.0 * q), NO_WRENCH, STEP)
        if not plant.qd.any():
            break
    stands = plant.q.copy()
    weight = inverse_dynamics(plain, stands, 0.0 * q, 0.0 * q)
    for _ in range(20):
        plant.advance(weight, NO_WRENCH, STEP)
    assert (plant.q == stands).all()


def test_a_slide_stops_where_coulomb_says():
    robot = load(GANTRY)
    q = robot.inverse(robot.home())
    masses = mass_matrix(robot, q)
    dry = np.array([20.0, 300.0, 300.0])
    robot = robot.changed(friction={"viscous": [0.0] * 3, "coulomb": dry.tolist()})
    plant = Plant(robot, q)
    plant.qd = np.array([0.5, 0.0, 0.0])
    weight = inverse_dynamics(smooth(robot), q, 0.0 * q, 0.0 * q)
    time = 0.0
    while plant.qd.any():
        plant.advance(weight, NO_WRENCH, STEP)
        time += STEP
    # The other two joints are held by their friction: one mass, one constant force.
    slowing = dry[0] / masses[0, 0]
    assert abs(time - 0.5 / slowing) <= STEP
    assert abs(plant.q[0] - q[0] - 0.5**2 / (2.0 * slowing)) < 0.5 * STEP**2 * slowing
    assert (plant.q[1:] == q[1:]).all()


def test_stops_hold_and_let_go():
    robot = smooth(load("delta_cu"))
    low, high = robot.limits.position.T
    plant = Plant(robot, robot.inverse(robot.home()))
    push = np.full(3, 5.0)
    for _ in range(400):
        plant.advance(push, NO_WRENCH, STEP)
        assert (plant.q <= high).all() and (plant.q >= low).all()
    assert (plant.q == high).all() and (plant.qd == 0.0).all()
    plant.advance(-push, NO_WRENCH, STEP)
    assert (plant.qd < 0.0).all()


@pytest.mark.parametrize("n", range(1, 7))
def test_rates_under_dry_friction_obey_coulomb(n, rng):
    for _ in range(50):
        root = rng.normal(size=(n, n))
        matrix = root @ root.T + 0.1 * np.eye(n)
        free, dry = rng.normal(size=n), rng.uniform(0.0, 1.0, n)
        low, high = -rng.uniform(0.0, 2.0, n), rng.uniform(0.0, 2.0, n)
        v = _least(matrix, free, dry, low, high)
        impulse = matrix @ (free - v)
        size = 1e-8 * np.linalg.norm(matrix)
        assert (v >= low).all() and (v <= high).all()
        for j in range(n):
            least, most = (dry[j] * s for s in ((-1, 1) if v[j] == 0.0 else (np.sign(v[j]),) * 2))
            # A stop pushes back as hard as it takes.
            assert impulse[j] >= (-np.inf if v[j] == low[j] else least - size)
            assert impulse[j] <= (np.inf if v[j] == high[j] else most + size)
