# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A machine that moves: energy, an independent engine, friction, stops."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from delta_dynamics import energy, inverse_dynamics, mass_matrix
from delta_dynamics.simulation.friction_contact import solve_resisting_forces
from delta_dynamics.simulation.plant import Plant
from delta_dynamics.torques.equations import Equations
from pkm_twin.errors import PkmTwinError
from pkm_twin.machine.inertia import list_loaded_joints
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.machine.random_machines import FILES, variant
from test.support.robots import (
    FREE,
    MASSIVE,
    joint_units_of_size,
    load,
    massive,
    often,
    partly_long,
    random_joints,
)

STEP = 1e-3
NO_WRENCH = np.zeros(6)
GANTRY = Path(__file__).parents[1] / "machine/machines/gantry.yaml"


def smooth(robot):
    """The robot without friction in its drives; passive joints keep theirs."""
    n = robot.joints_count
    return robot.changed(friction={key: [value] * n for key, value in FREE.items()})


def rubs_inside(robot):
    """Whether a passive joint has friction."""
    return any(joint.viscous or joint.coulomb for joint in robot.graph.joints.values() if not joint.actuated)


def inner_friction(robot):
    """Dry friction of all passive joints, N m or N."""
    return sum(joint.coulomb for joint in list_loaded_joints(robot.graph))


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
    from tools.certificate.machines import build
    from tools.certificate.swing import find_engine, starts

    (start,) = (s for s in starts() if s.title == name)
    robot = build(start.data)
    plant = Plant(robot, start.q)
    plant.qd = start.qd.copy()
    effort = inverse_dynamics(robot, start.rest, 0.0 * start.rest, 0.0 * start.rest)
    engine = find_engine(start.data)
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


def test_a_machine_without_stops_is_one_with_far_ones():
    data = variant("four_bar", np.random.default_rng(1)) | {"mechanism": "machine"}
    found = []
    for limits in (None, {"position": [-1e3, 1e3]}):
        for joint in data["joints"].values():
            if joint.get("actuated"):
                joint.pop("limits", None)
                joint |= {} if limits is None else {"limits": limits}
        plant = Plant(robot_of_data(data, "four_bar"), [data["joints"]["motor"]["home"]])
        plant.qd = np.array([0.5])
        for _ in range(200):
            plant.advance(np.zeros(1), NO_WRENCH, STEP)
        found.append([*plant.q, *plant.qd])
    np.testing.assert_allclose(*found, 1e-9, 1e-12)


@pytest.mark.parametrize("n", range(1, 7))
def test_forces_of_friction_and_stops_obey_coulomb(n, rng):
    for k in range(60):
        root = rng.normal(size=(n, n))
        matrix = root @ root.T + 0.1 * np.eye(n)
        motion, dry = rng.normal(size=n), rng.uniform(0.0, 1.0, n)
        # A row at a stop is pushed back as hard as it takes; others rub alone.
        low = np.where(rng.random(n) < 0.2, -np.inf, -dry)
        high = np.where(rng.random(n) < 0.2, np.inf, dry)
        if k % 3 == 0 and n > 1:
            # One row says the same as another.
            matrix[-1], motion[-1] = matrix[0], motion[0]
            matrix[:, -1] = matrix[:, 0]
            matrix[-1, -1] = matrix[0, 0]
        force, states = solve_resisting_forces(matrix, motion, low, high, rng.integers(-1, 2, n))
        left = motion - matrix @ force
        size = 1e-6 * max(1.0, np.abs(motion).max() + np.abs(matrix @ np.minimum(dry, 1.0)).max())
        assert (force >= low - size).all() and (force <= high + size).all()
        for j in range(n):
            assert left[j] >= -size or force[j] <= low[j] + size
            assert left[j] <= size or force[j] >= high[j] - size
            assert states[j] or abs(left[j]) <= size


# Of the chain rccc every state is near a singularity.
UNSEEN = [name for name in FILES if name not in (*MASSIVE, "rccc")]
VARIANTS = ("five_bar", "elbow_motors", "rps3", "hinged_platform", "rrr3_spherical")


@pytest.fixture(scope="module")
def machine():
    """A robot by its name: shipped, of a file, or of random dimensions with friction all over."""
    made = {}

    def get(name):
        if name not in made:
            kind, _, what = name.partition(" ")
            rng = np.random.default_rng([3, len(name)])
            if kind == "random":
                made[name] = robot_of_data(variant(what, rng), what)
            else:
                made[name] = load(FILES[name] if name in UNSEEN else name)
        return made[name]

    return get


def every_machine(*kept):
    """Shipped machines, those of files, and random ones; ``kept`` are run by default."""
    names = [*MASSIVE, *UNSEEN, *(f"random {name}" for name in VARIANTS)]
    return pytest.mark.parametrize("name", partly_long(names, *kept))


def rubbing(robot, rng, q, laws):
    """The robot with friction from none to a locked drive, or of all laws, and stops about q."""
    n, scale = robot.joints_count, joint_units_of_size(robot)
    friction = {
        "viscous": rng.choice([0.0, 0.0, 1e-3, 0.1, 1.0, 28.0, 1e3, 1e6], n).tolist(),
        "coulomb": rng.choice([0.0, 0.0, 0.01, 1.0, 30.0], n).tolist(),
    }
    if laws:
        friction |= {
            "stribeck": rng.uniform(0.0, 1.0, n).tolist(),
            "stribeck_speed": (0.3 * scale).tolist(),
            "load_dependent": rng.uniform(0.0, 0.3, n).tolist(),
            "cogging_cos": rng.normal(size=n).tolist(),
            "cogging_sin": rng.normal(size=n).tolist(),
            "cogging_period": (0.05 * scale).tolist(),
            "offset": rng.normal(size=n).tolist(),
        }
    room = rng.choice([0.01, 0.1]) * scale
    stops = np.stack([q - room * rng.random(n), q + room * rng.random(n)], 1)
    return stopped_at(robot.changed(friction=friction), stops)


def stopped_at(robot, stops):
    """The robot with stops, shape (n, 2)."""
    field = "limb_length" if robot.mechanism == "upr_rpu" else "position"
    return robot.changed(limits={field: stops.tolist()})


def balance(plant, effort):
    """Energy, that of cogging too, less the work of constant efforts, J; and its parts' size."""
    both, f = energy(plant.robot, plant.q, plant.qd), plant.robot.friction
    wave = 2.0 * np.pi / np.where(f.cogging_period > 0.0, f.cogging_period, 1.0)
    cogging = f.cogging_cos * np.sin(wave * plant.q) - f.cogging_sin * np.cos(wave * plant.q)
    parts = [
        float(both.kinetic),
        float(both.potential),
        float((cogging / wave).sum()),
        -float((effort - f.offset) @ plant.q),
    ]
    return sum(parts), sum(map(abs, parts))


@every_machine("delta_cu", "upr_rpu", "rps3", "gantry", "random elbow_motors")
@pytest.mark.parametrize("trials", often(3, 40))
def test_energy_never_grows_without_input(name, trials, machine):
    robot = machine(name)
    n, scale = robot.joints_count, joint_units_of_size(robot)
    moved = 0
    for trial in range(trials):
        rng = np.random.default_rng([11, trial, n, len(name)])
        q = random_joints(robot, rng, 1)[0]
        plant = Plant(rubbing(robot, rng, q, trial % 3 == 2), q)
        plant.qd = rng.normal(0.0, rng.choice([0.0, 0.1, 1.0, 5.0]), n) * scale
        effort = rng.normal(0.0, 1.0, n) * rng.choice([0.0, 1.0, 10.0])
        step = rng.choice([1e-4, 1e-3, 5e-3])
        before, size = balance(plant, effort)
        for _ in range(40):
            try:
                plant.advance(effort, NO_WRENCH, step)
            except PkmTwinError:
                break  # where it cannot be assembled
            if plant.robot.singularity(plant.q) < 1e-2:
                break  # nor simulated
            now, size = balance(plant, effort)
            assert now <= before + 1e-12 * (size + np.abs(effort) @ np.abs(plant.q)), (trial, step)
            before = now
            moved += 1
    assert moved > 15 * trials


@every_machine("five_bar", "rps3", "random hinged_platform")
def test_an_impact_is_the_least_change_that_all_stops_allow(name, machine, rng):
    robot = machine(name)
    n = robot.joints_count
    for trial in range(6):
        q = random_joints(robot, rng, 1)[0]
        stopped = rng.random(n) < 0.6
        scale = joint_units_of_size(robot)
        stops = np.stack([q - scale, np.where(stopped, q, q + scale)], 1)
        plant = Plant(stopped_at(robot, stops), q)
        qd = rng.normal(0.0, 1.0, n) * scale
        plant.qd = qd.copy()
        instant = 1e-9
        plant.advance(np.zeros(n), NO_WRENCH, instant)
        # Of all choices of who is stopped the one that obeys the laws of impact.
        masses, found = mass_matrix(robot, q), []
        for held in product([False, True], repeat=int(stopped.sum())):
            rows = np.eye(n)[np.flatnonzero(stopped)[list(held)]]
            back = np.linalg.solve(masses, rows.T)
            push = np.linalg.solve(rows @ back, rows @ qd) if len(rows) else np.zeros(0)
            after = qd - back @ push
            if (push >= 0.0).all() and (after[stopped] <= 1e-12).all():
                found.append(after)
        assert found, trial
        size = np.abs(qd).max()
        assert np.abs(plant.qd - found[0]).max() < 1e-5 * size


@every_machine("delta_cu", "five_bar")
def test_stick_and_slip_at_the_default_step_is_that_of_small_steps(name, machine, monkeypatch):
    robot, evaluations, at = machine(name), [], Equations.at

    def counted(equations, *state):
        evaluations[-1] += 1
        return at(equations, *state)

    monkeypatch.setattr(Equations, "at", counted)
    n = robot.joints_count
    q = robot.inverse(robot.home())
    weight = inverse_dynamics(smooth(robot), q, 0.0 * q, 0.0 * q)
    dry = 0.2 * np.abs(weight).max() + 0.02 + 4.0 * inner_friction(robot)
    rng = np.random.default_rng(len(name))
    robot = robot.changed(friction={"coulomb": (dry * rng.uniform(0.8, 1.0, n)).tolist()})
    turn, phase = 2.0 * np.pi * rng.uniform(4.0, 12.0, n), rng.uniform(0.0, 6.0, n)
    ends, stuck = [], 0
    for parts in (1, 10):
        plant = Plant(robot, q)
        for k in range(300):
            effort = weight + 1.5 * dry * np.sin(turn * k * STEP + phase)
            for _ in range(parts):
                before = plant.q
                evaluations.append(0)
                plant.advance(effort, NO_WRENCH, STEP / parts)
            stuck += int((plant.q == before).any())
        ends.append(plant.q)
    print(f"{name}: {np.abs(ends[0] - ends[1]).max():.1e}, moved {np.abs(ends[1] - q).max():.1e}")
    assert np.abs(ends[0] - ends[1]).max() < 1e-7
    assert np.abs(ends[1] - q).max() > 1e-5 and stuck
    # A change takes about ten evaluations, and a step has up to three; without one it takes four.
    print(f"{name}: evaluations of a step: mean {np.mean(evaluations):.1f}, worst {max(evaluations)}")
    assert max(evaluations) < 60 and np.mean(evaluations) < 8


@pytest.mark.parametrize("decay", [0.01, 0.3, 2.8, 50.0, 1e5])
def test_viscous_friction_is_exact_however_stiff(decay):
    """Of one mass that a constant force moves: rate and place are known."""
    robot = load(GANTRY)
    q = robot.inverse(robot.home())
    mass = mass_matrix(robot, q)[0, 0]
    drag = decay * mass / STEP
    robot = robot.changed(friction={"viscous": [drag, 0.0, 0.0], "coulomb": [0.0, 1e9, 1e9]})
    weight = inverse_dynamics(smooth(robot), q, 0.0 * q, 0.0 * q)
    plant, force, began = Plant(robot, q), 4.0, 0.3
    effort = weight + np.array([force, 0.0, 0.0])
    plant.qd = np.array([began, 0.0, 0.0])
    for _ in range(20):
        plant.advance(effort, NO_WRENCH, STEP)
    time, last = 20 * STEP, force / drag
    part = -np.expm1(-drag / mass * time)
    assert abs(plant.qd[0] - (began + (last - began) * part)) < 1e-9 * began
    place = last * time + (began - last) * mass / drag * part
    assert abs(plant.q[0] - q[0] - place) < 1e-9 * abs(place)
    assert (plant.q[1:] == q[1:]).all()


def test_terms_of_machines_that_share_a_program_are_their_own():
    """Machines that differ in dimensions alone share one program, written for the first of them."""
    first = load("rps3")
    for robot in (first, first.with_file_values({"origin[2]": first.number("origin[2]") + 0.2})):
        q = robot.graph.home + 0.01
        twists = robot.platform_jacobian(q)
        assert np.abs(Equations(robot).at(q, np.zeros(3)).twists - twists).max() < 1e-12 * np.abs(twists).max()


@every_machine("rps3", "four_bar", "random five_bar")
def test_all_terms_are_those_of_inverse_dynamics(name, machine, rng):
    robot = machine(name)
    n, equations = robot.joints_count, Equations(robot)
    friction, passive = robot.friction, list_loaded_joints(robot.graph)
    for q in random_joints(robot, rng, 3):
        qd, qdd = rng.normal(size=(2, n)) * joint_units_of_size(robot)
        wrench = rng.normal(size=6)
        t = equations.at(q, qd)
        efforts = t.mass @ qdd + t.bias - wrench @ t.twists
        efforts += friction.viscous * qd + friction.coulomb * np.sign(qd) + friction.offset
        for row, joint in zip(t.rows, passive, strict=True):
            rate = row @ qd
            efforts += row * (joint.viscous * rate + joint.coulomb * np.sign(rate))
        wanted = inverse_dynamics(robot, q, qd, qdd, wrench)
        assert np.abs(efforts - wanted).max() < 1e-11 * np.abs(wanted).max()
        both = energy(robot, q, qd)
        assert abs(t.kinetic - both.kinetic) < 1e-12 * (abs(t.kinetic) + 1e-9)
        assert abs(t.potential - both.potential) < 1e-12 * (abs(t.potential) + 1.0)
        if len(passive):
            small = 1e-6
            ahead, behind = (equations.at(q + s * small * qd, qd).rows for s in (1.0, -1.0))
            drift = (ahead - behind) @ qd / (2.0 * small)
            assert np.abs(t.drift - drift).max() < 1e-7 * (1.0 + np.abs(drift).max())
