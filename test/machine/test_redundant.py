# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""More actuated joints than degrees of freedom, against virtual work and a quadratic programme.

The judge of planar n-RRR machines is written in pose coordinates: two circles that meet give a
limb's joints, one linear system of two unknowns its rates and accelerations. A spatial machine is
judged by the same machine with fewer drives, and a programme of its own.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import root

from delta_dynamics import (
    dynamics_terms,
    energy,
    forward_dynamics,
    inverse_dynamics,
    mass_matrix,
    null_efforts,
    reactions,
    torque_derivatives,
)
from delta_dynamics.feedforward import Feedforward, Settings
from pkm_twin import load
from pkm_twin.design import PosePath, design, drawn, tolerances
from pkm_twin.errors import (
    MessageError,
    MobilityError,
    ParameterError,
    SingularityError,
    UnreachableError,
)
from pkm_twin.export.c_package import c_package
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.derivatives import joint_rates, nearest_motion
from test.export.c_programs import Package, functions, inputs_of
from test.nodes.harness import SECOND, Maker, Plain

pytestmark = pytest.mark.usefixtures("quickly_compiled")
GRAVITY = np.array([1.0, -9.0, -3.0])
ROOT = "examples/machines"


def turned(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.moveaxis(np.array([[c, -s], [s, c]]), (0, 1), (-2, -1))


def across(v):
    return np.stack([-v[..., 1], v[..., 0]], -1)


class Planar:
    """A planar machine of n limbs, motor, elbow and wrist each, of random sizes.

    :param point: the wrists meet in one point, which alone moves.
    """

    def __init__(self, rng, n, *, point, limits):
        azimuth = 2 * np.pi * (np.arange(n) + rng.uniform(-0.2, 0.2, n)) / n
        out = turned(azimuth)
        place = lambda x, y: np.einsum("nij,nj->ni", out, np.stack([x, y], -1))  # noqa: E731
        self.n, self.point, self.limits = n, point, limits
        self.base = place(rng.uniform(0.28, 0.34, n), np.zeros(n))
        self.elbow = place(rng.uniform(0.18, 0.24, n), rng.uniform(0.14, 0.2, n))
        reach = 0.0 if point else rng.uniform(0.06, 0.1, n)
        self.wrist = place(reach + np.zeros(n), np.zeros(n) if point else rng.uniform(-0.04, 0, n))
        self.masses = rng.uniform(0.1, 0.5, (2, n))
        self.turns = rng.uniform(1e-4, 1e-3, (2, n))
        self.coms = np.stack([(self.base + self.elbow) / 2, (self.elbow + self.wrist) / 2])
        self.coms = self.coms + rng.uniform(-0.02, 0.02, self.coms.shape)
        self.load = rng.uniform(0.3, 0.8), np.zeros(2) if point else rng.uniform(-0.02, 0.02, 2)
        self.load_turn = 2e-3
        self.viscous, self.coulomb, self.rotor = rng.uniform(0.01, 0.05, (3, n))
        self.home = rng.uniform(-1.0, 1.0, n)

    def file(self, **more):
        joint = {"type": "revolute", "axis": [0, 0, 1]}
        bodies = {"platform": self._body(self.load[0], self.load[1], self.load_turn)}
        joints = {}
        if self.point:
            joints["slide"] = {"type": "translation", "between": ["base", "platform"]}
        for k in range(self.n):
            for part, name in enumerate(("crank", "coupler")):
                bodies[f"{name}_{k}"] = self._body(self.masses[part, k], self.coms[part, k], self.turns[part, k])
            joints[f"motor_{k}"] = joint | {
                "between": ["base", f"crank_{k}"],
                "at": [*self.base[k].tolist(), 0.0],
                "actuated": True,
                "home": float(self.home[k]),
                "friction": {"viscous": float(self.viscous[k]), "coulomb": float(self.coulomb[k])},
                "rotor_inertia": float(self.rotor[k]),
            }
            if self.limits is not None:
                joints[f"motor_{k}"]["limits"] = {"effort": float(self.limits[k])}
            ends = f"crank_{k}", f"coupler_{k}", "platform"
            for name, pair, at in (("elbow", ends[:2], self.elbow[k]), ("wrist", ends[1:], self.wrist[k])):
                joints[f"{name}_{k}"] = joint | {"between": [*pair], "at": [*at.tolist(), 0.0]}
        pose = ["x", "y"] if self.point else ["x", "y", "yaw"]
        return {
            "mechanism": "machine",
            "pose": pose,
            "gravity": GRAVITY.tolist(),
            "bodies": bodies,
            "origin": [0, 0, 0],
            "joints": joints,
            **more,
        }

    @staticmethod
    def _body(mass, com, turn):
        return {"mass": float(mass), "com": [*map(float, com), 0.0], "inertia": [turn, turn, float(turn) * 1.9]}

    def judged(self, pose, rate, change, wrench):
        """q, qd, qdd, rates by the pose (n, m), and forces that the pose's coordinates need."""
        m = 2 if self.point else 3
        yaw, spin, swing = (0.0, 0.0, 0.0) if self.point else (pose[2], rate[2], change[2])

        def carried(point, here):
            """A point of the platform: place, velocity, acceleration, velocity by the pose."""
            arm = turned(yaw) @ (point - here)
            columns = np.column_stack([np.eye(2), across(arm)])[:, :m]
            return (
                pose[:2] + arm,
                rate[:2] + spin * across(arm),
                change[:2] + swing * across(arm) - spin**2 * arm,
                columns,
            )

        q, qd, qdd, by = [], [], [], []
        need = np.zeros(m)

        def body(mass, turn, acceleration, swing, columns, angle):
            nonlocal need
            force = mass * (acceleration - GRAVITY[:2])
            need = need + columns.T @ force + turn * swing * angle

        origin = np.zeros(2)
        mass, com = self.load
        _, _, acceleration, columns = carried(com, origin)
        one = np.eye(3)[2][:m] if m == 3 else np.zeros(2)
        body(mass, 1.9 * self.load_turn, acceleration, swing, columns, one)
        _, _, _, columns = carried(origin, origin)
        need = need - columns.T @ wrench[:2] - wrench[5] * one
        for k in range(self.n):
            first, second = self.elbow[k] - self.base[k], self.wrist[k] - self.elbow[k]
            end, velocity, acceleration, columns = carried(self.wrist[k], origin)
            span = end - self.base[k]
            a, b, c = np.linalg.norm(first), np.linalg.norm(second), np.linalg.norm(span)
            bend = np.arccos((a * a + c * c - b * b) / (2 * a * c))
            was = self.wrist[k] - self.base[k]
            side = np.sign(was[0] * first[1] - was[1] * first[0])
            angle = lambda v: np.arctan2(v[1], v[0])  # noqa: E731
            p = turned(angle(span) + side * bend - angle(first)) @ first
            r = span - p
            table = np.stack([across(p), across(r)], -1)
            rates = np.linalg.solve(table, velocity)
            seconds = np.linalg.solve(table, acceleration + p * rates[0] ** 2 + r * rates[1] ** 2)
            each = np.linalg.solve(table, columns)
            turn = (angle(p) - angle(first) + np.pi) % (2 * np.pi) - np.pi
            q.append(turn + self.home[k])
            qd.append(rates[0])
            qdd.append(seconds[0])
            by.append(each[0])
            arm = turned(turn) @ (self.coms[0, k] - self.base[k])
            body(
                self.masses[0, k],
                1.9 * self.turns[0, k],
                seconds[0] * across(arm) - rates[0] ** 2 * arm,
                seconds[0],
                np.outer(across(arm), each[0]),
                each[0],
            )
            lean = (angle(r) - angle(second) + np.pi) % (2 * np.pi) - np.pi
            arm = turned(lean) @ (self.coms[1, k] - self.elbow[k])
            elbow = seconds[0] * across(p) - rates[0] ** 2 * p
            body(
                self.masses[1, k],
                1.9 * self.turns[1, k],
                elbow + seconds[1] * across(arm) - rates[1] ** 2 * arm,
                seconds[1],
                np.outer(across(p), each[0]) + np.outer(across(arm), each[1]),
                each[1],
            )
        q, qd, qdd, by = map(np.array, (q, qd, qdd, by))
        own = self.viscous * qd + self.coulomb * np.sign(qd) + self.rotor * qdd
        return q, qd, qdd, by, need + by.T @ own


def least(by, need, limits, preload):
    """Efforts of the least sum of ((effort - preload) / limit)^2 with by' effort = need."""
    n, m = by.shape
    weights = np.ones(n) if limits is None else 1.0 / np.asarray(limits) ** 2
    table = np.block([[np.diag(weights), by], [by.T, np.zeros((m, m))]])
    return np.linalg.solve(table, np.concatenate([weights * preload, need]))[:n]


LIMITS = {"none": None, "alike": np.full(6, 7.0), "unlike": np.array([2.0, 9.0, 4, 30, 5, 6])}


@pytest.mark.parametrize(
    ("n", "point", "limits", "preloaded"),
    [(3, True, "unlike", False), (4, True, "none", True), (4, False, "alike", False), (5, False, "unlike", True)],
)
def test_planar_machines_share_efforts_as_a_quadratic_programme_does(n, point, limits, preloaded):
    rng = np.random.default_rng(10 * n + point)
    bounds = LIMITS[limits]
    bounds = None if bounds is None else bounds[:n]
    preload = rng.uniform(-1, 1, n) * preloaded
    plane = Planar(rng, n, point=point, limits=bounds)
    robot = robot_of_data(plane.file(redundancy={"preload": preload.tolist()}), "plane")
    m = 2 if point else 3
    assert (robot.joints_count, len(robot.pose_names), len(robot.graph.leads)) == (n, m, m)
    for _ in range(5):
        pose, rate, change = rng.uniform(-1, 1, (3, m)) * np.array([[0.04], [1.0], [9.0]])
        wrench = rng.uniform(-9, 9, 6)
        wrench[2:5] = 0.0
        wrench[5] *= not point
        q, qd, qdd, by, need = plane.judged(pose, rate, change, wrench)
        np.testing.assert_allclose(robot.inverse(pose), q, atol=1e-12)
        np.testing.assert_allclose(robot.forward(q), pose, atol=1e-12)
        np.testing.assert_allclose(robot.jacobian(q) @ qd, rate, atol=1e-11)
        np.testing.assert_allclose(robot.inverse_jacobian(q), by, atol=1e-10)
        np.testing.assert_allclose(robot.pose_acceleration(q, qd, qdd), change, atol=1e-9)
        tau = inverse_dynamics(robot, q, qd, qdd, wrench)
        size = np.abs(tau).max()
        np.testing.assert_allclose(tau, least(by, need, bounds, preload), atol=1e-10 * size)
        # The conditions themselves: the motion, and nothing left along the null efforts.
        inner = null_efforts(robot, q)
        scale = np.ones(n) if bounds is None else bounds
        assert inner.shape == (n - m, n)
        np.testing.assert_allclose(by.T @ tau, need, atol=1e-10 * size)
        np.testing.assert_allclose(inner @ ((tau - preload) / scale**2), 0.0, atol=1e-10 * size)
        np.testing.assert_allclose(inner @ by, 0.0, atol=1e-10 * np.abs(inner).max())
        unit = inner / scale
        np.testing.assert_allclose(unit @ unit.T, np.eye(n - m), atol=1e-12)
        # Any efforts that differ by those accelerate alike.
        more = tau + rng.normal(size=n - m) @ inner
        for efforts in (tau, more):
            found = forward_dynamics(robot, q, qd, efforts, wrench)
            np.testing.assert_allclose(found, qdd, atol=1e-9 * np.abs(qdd).max())
        # Noise of all drives is evened out by least squares.
        noise = 0.01 * rng.normal(size=(2, n))
        onto = by @ np.linalg.pinv(by)
        found = nearest_motion(robot, q, qd + noise[0], qdd)[0]
        np.testing.assert_allclose(found, qd + onto @ noise[0], atol=1e-10)
        found = nearest_motion(robot, q, qd, qdd + noise[1])[1]
        np.testing.assert_allclose(found, qdd + onto @ noise[1], atol=1e-9)
        terms = dynamics_terms(robot, q, qd, qdd, wrench)
        np.testing.assert_allclose(terms.total, tau, atol=1e-11 * size)
        np.testing.assert_allclose(terms.inertia, mass_matrix(robot, q) @ qdd, atol=1e-11 * size)
        push = robot.platform_jacobian(q).T @ wrench
        np.testing.assert_allclose(terms.external, -push, atol=1e-12 * size)
        kinetic = qd @ mass_matrix(robot, q) @ qd / 2
        np.testing.assert_allclose(energy(robot, q, qd).kinetic, kinetic, rtol=1e-11)
        own = plane.viscous * qd + plane.coulomb * np.sign(qd) + plane.rotor * qdd
        held = reactions(robot, q, qd, qdd, wrench)
        np.testing.assert_allclose(held.efforts, tau - own, atol=1e-9 * size)
        assert held.residual < 1e-10
        loop = robot.torque_loop()
        loop.q[:], loop.qd[:], loop.qdd[:], loop.wrench[:] = q, qd, qdd, wrench
        assert loop() == 0
        np.testing.assert_array_equal(loop.tau, tau)


def test_efforts_are_derived_by_the_pose():
    rng = np.random.default_rng(5)
    robot = robot_of_data(Planar(rng, 4, point=False, limits=LIMITS["unlike"][:4]).file(), "plane")
    poses = rng.uniform(-0.03, 0.03, (2, 3))
    rate, change = rng.uniform(-1, 1, (2, 3))

    def motion(share):
        q = robot.inverse(poses[0] + share * (poses[1] - poses[0]))
        return q, *(one[0] for one in joint_rates(robot, q[None], rate[None], change[None]))

    step = 1e-4
    ahead, behind = motion(step), motion(-step)
    ways = [(a - b) / (2 * step) for a, b in zip(ahead, behind, strict=True)]
    found = torque_derivatives(robot, *motion(0.0))
    whole = found.q @ ways[0] + found.qd @ ways[1] + found.qdd @ ways[2]
    efforts = (inverse_dynamics(robot, *ahead) - inverse_dynamics(robot, *behind)) / (2 * step)
    np.testing.assert_allclose(whole, efforts, rtol=1e-5, atol=1e-5)


def four_arms(rng):
    """A Delta with four arms of unlike sizes, each with a pair of rods taken as one."""
    bodies = {"platform": {"mass": 0.4, "com": [0, 0, -0.5], "inertia": [1e-3, 1e-3, 2e-3]}}
    joints = {"plate": {"type": "translation", "between": ["base", "platform"]}}
    rods = {}
    for k in range(4):
        angle = k * np.pi / 2 + rng.uniform(-0.2, 0.2)
        c, s = np.cos(angle), np.sin(angle)
        base, arm = rng.uniform(0.15, 0.2), rng.uniform(0.25, 0.3)
        elbow = [(base + arm * 0.9) * c, (base + arm * 0.9) * s, -arm * 0.3]
        bodies[f"arm_{k}"] = {
            "mass": 0.3,
            "com": [(base + arm / 2) * c, (base + arm / 2) * s, -0.05],
            "inertia": [1e-3, 2e-3, 2e-3],
        }
        joints[f"motor_{k}"] = {
            "type": "revolute",
            "between": ["base", f"arm_{k}"],
            "at": [base * c, base * s, 0.0],
            "axis": [-s, c, 0.0],
            "actuated": True,
            "rotor_inertia": 0.01,
            "limits": {"effort": float(rng.uniform(5, 40))},
        }
        tip = [0.05 * c, 0.05 * s, -0.5]
        rods[f"rod_{k}"] = {"between": [f"arm_{k}", "platform"], "ends": [elbow, tip], "mass": 0.05}
    return {"mechanism": "machine", "bodies": bodies, "joints": joints, "rods": rods, "pose": ["x", "y", "z"]}


def test_every_choice_of_drives_explains_a_spatial_machine():
    """What four drives do is what any three of them alone would, at the same motion."""
    rng = np.random.default_rng(8)
    data = four_arms(rng)
    robot = robot_of_data(data, "four")
    poses = robot.home() + rng.uniform(-0.05, 0.05, (6, 3))
    q, wrench = robot.inverse(poses), rng.uniform(-20, 20, (6, 6))
    qd, qdd = joint_rates(robot, q, *rng.uniform(-2, 2, (2, 6, 3)))
    tau = inverse_dynamics(robot, q, qd, qdd, wrench)
    by = robot.inverse_jacobian(q)
    weights = 1.0 / robot.limits.effort**2
    assert (np.abs(null_efforts(robot, q) @ (weights * tau)[..., None]) < 1e-10).all()
    for idle in range(4):
        left = {**data, "joints": {n: dict(j) for n, j in data["joints"].items()}}
        left["joints"][f"motor_{idle}"] |= {"actuated": False, "limits": {}}
        three = robot_of_data(left, "three")
        rows = [k for k in range(4) if k != idle]
        alone = inverse_dynamics(three, q[:, rows], qd[:, rows], qdd[:, rows], wrench)
        need = np.einsum("knm,kn->km", by[:, rows], alone)
        np.testing.assert_allclose(np.einsum("knm,kn->km", by, tau), need, atol=1e-9)
        chosen = robot_of_data(data | {"redundancy": {"leads": [f"motor_{k}" for k in rows]}}, "four")
        assert chosen.graph.leads == tuple(f"motor_{k}" for k in rows)
        np.testing.assert_allclose(inverse_dynamics(chosen, q, qd, qdd, wrench), tau, atol=1e-10)
        np.testing.assert_allclose(chosen.singularity(q), robot.singularity(q), rtol=1e-9)


def test_redundant_drives_leave_fewer_singularities():
    """Where two couplers are in line, two drives lose the point, and the third one holds it."""
    data = load(f"{ROOT}/rrr3_point.yaml").parameter_sections()
    other = robot_of_data(data | {"redundancy": {"leads": ["motor_2", "motor_3"]}}, "point")
    first = robot_of_data(data | {"redundancy": {"leads": ["motor_1", "motor_2"]}}, "point")
    data["joints"]["motor_3"] |= {"actuated": False, "limits": {}}
    five_bar = robot_of_data({k: v for k, v in data.items() if k != "redundancy"}, "five_bar")
    q = other.inverse(np.linspace([0.0, 0.0], [0.05, 0.2], 40))
    alone, _ = five_bar.try_singularity(q[:, :2])
    assert alone.min() < 0.1
    assert other.singularity(q).min() > 0.3
    np.testing.assert_allclose(first.singularity(q[:20]), other.singularity(q[:20]), rtol=1e-9)
    # Behind a singularity of the two that lead alone there is no answer, and the error says so.
    for state in q[-8:]:
        with pytest.raises((SingularityError, UnreachableError), match=r"redundancy\.leads"):
            first.forward(state)


@pytest.mark.parametrize("joint", range(4))
@pytest.mark.parametrize(("what", "amount"), [(0, 2e-3), (1, 0.2), (2, 15.0)])
def test_contradictions_are_no_assembly(planar, joint, what, amount):
    pose = np.array([[0.02, -0.01, 0.1]])
    q = planar.inverse(pose)
    state = [q, *joint_rates(planar, q, np.ones((1, 3)), np.ones((1, 3)))]
    good = inverse_dynamics(planar, *state)
    state[what] = state[what] + amount * np.eye(4)[joint]
    place = ("", "has a velocity of", "has an acceleration of")[what]
    with pytest.raises(UnreachableError, match=rf"motor_\d .*{place}.*, allowed (0.001|0.1|10) "):
        inverse_dynamics(planar, *state)
    loop = planar.torque_loop()
    loop.q[:], loop.qd[:], loop.qdd[:] = (one[0] for one in state)
    assert loop() == 1
    assert np.isnan(loop.tau).all()
    # What encoders differ by counts as the leading drives say.
    state[what] = state[what] - 0.99 * amount * np.eye(4)[joint]
    np.testing.assert_allclose(inverse_dynamics(planar, *state), good, atol=0.1)
    agreed = planar.project_redundant(*state)
    np.testing.assert_allclose(agreed[0][:, :3], state[0][:, :3])
    np.testing.assert_allclose(inverse_dynamics(planar, *agreed), inverse_dynamics(planar, *state), atol=1e-12)


@pytest.mark.parametrize("turns", [1, -1])
def test_a_full_turn_of_a_drive_alone_is_no_assembly(planar, turns):
    """No closure sees it: an encoder has lost its turns."""
    q = planar.inverse([0.02, -0.01, 0.1])
    for turn in 2 * np.pi * turns * np.eye(4):
        with pytest.raises((UnreachableError, SingularityError)):
            planar.forward(q + turn)
    with pytest.raises(UnreachableError, match=r"motor_4 is 6\.28 rad from where"):
        planar.forward(q + turn)


def test_what_a_file_may_not_say():
    rng = np.random.default_rng(2)
    plane = Planar(rng, 4, point=False, limits=LIMITS["unlike"][:4])

    def rejected(field, change=None, error=ParameterError, **more):
        data = plane.file(**more)
        if change is not None:
            change(data["joints"])
        with pytest.raises(error, match=field):
            robot_of_data(data, "plane")

    rejected("limits.effort", lambda joints: joints["motor_1"].pop("limits"))
    endless = {"limits": {"effort": np.inf}}
    rejected("motor_1.limits.effort: inf", lambda joints: joints["motor_1"].update(endless))
    rejected("redundancy.preload", redundancy={"preload": [1.0, 2.0]})
    rejected("redundancy.leads", redundancy={"leads": ["motor_0", "motor_1"]})
    rejected("redundancy.leads", redundancy={"leads": ["motor_0", "motor_1", "elbow_0"]})
    rejected("redundancy.tolerance", redundancy={"tolerance": 0.0})
    friction = {"viscous": 0.1, "load_dependent": 0.1}
    rejected("friction", lambda joints: joints["motor_2"].update(friction=friction))
    # An axis that is tilted takes freedoms away, which are none that drives share.
    rejected("tilt|parallel", lambda joints: joints["elbow_1"].update(axis=[1e-4, 0, 1]), MobilityError)
    with pytest.raises(ParameterError, match="contacts"):
        from delta_dynamics import ContactMonitor

        ContactMonitor(robot_of_data(plane.file(), "plane"))


def test_changes_keep_the_sharing(planar):
    q = planar.inverse([0.01, 0.02, -0.1])
    zero = np.zeros(4)
    weaker = planar.changed(limits={"effort": [1.0, 6.0, 6.0, 6.0]})
    before, after = (inverse_dynamics(r, q, zero, zero) for r in (planar, weaker))
    assert abs(after[0]) < 0.2 * abs(before[0])
    tense = planar.changed(redundancy={"preload": [0.5, -0.5, 0.5, -0.5]})
    inner = null_efforts(planar, q)[0]
    apart = inverse_dynamics(tense, q, zero, zero) - before
    np.testing.assert_allclose(apart, inner * (apart @ inner) / (inner @ inner), atol=1e-12)
    assert np.abs(apart).max() > 0.1
    again = robot_of_data(tense.parameter_sections(), "again")
    np.testing.assert_allclose(inverse_dynamics(again, q, zero, zero), before + apart, atol=1e-14)
    assert again.graph.leads == ("motor_1", "motor_2", "motor_3")


@pytest.mark.parametrize(("noise", "apart"), [(1e-5, 0.015), (1e-4, 0.15)])
def test_a_stream_of_encoders_that_differ_is_answered(planar, noise, apart):
    """Positions with noise, rates and accelerations by the node; then one encoder slips."""
    make, rng, step = Maker(Plain()), np.random.default_rng(4), SECOND // 1000
    twin = Feedforward(planar, Settings(differentiate=True, recovery_count=3))
    pose, rate, change = [], [], []
    for t in np.arange(0.0, 0.2, 1e-3):
        wave, size = np.array([5.0, 7.0, 4.0]), np.array([0.03, 0.02, 0.1])
        pose.append(size * np.sin(wave * t))
        rate.append(size * wave * np.cos(wave * t))
        change.append(-size * wave**2 * np.sin(wave * t))
    q = planar.inverse(pose)
    qd, qdd = joint_rates(planar, q, np.array(rate), np.array(change))
    expected, answered = inverse_dynamics(planar, q, qd, qdd), 0
    for k, seen in enumerate(q + noise * rng.uniform(-1, 1, q.shape)):
        now = 1000 * SECOND + k * step
        answer = twin.joint_state(make.joint_state(planar.joint_names, seen, stamp=now), now)
        if answer is not None and k > 60:
            answered += 1
            np.testing.assert_allclose(answer.effort, expected[k], atol=apart)
            _, rate, change = answer.motion
            _, *follows = planar.project_redundant(*answer.motion)
            np.testing.assert_allclose([rate, change], follows, atol=1e-9)
    assert answered == len(q) - 61
    now += step
    slipped = make.joint_state(planar.joint_names, seen + 5e-3 * np.eye(4)[2], stamp=now)
    with pytest.raises(MessageError):
        twin.joint_state(slipped, now)


def test_exported_functions_share_alike(planar, tmp_path):
    package = Package(tmp_path / "c", c_package(planar))
    # Optimisation finds what may have no value.
    program = package.build("-O1", "-Wall", "-Wextra", "-Wconversion", "-Werror")
    rng = np.random.default_rng(6)
    q = planar.inverse(rng.uniform(-0.03, 0.03, (20, 3)))
    qd, qdd = joint_rates(planar, q, *rng.uniform(-2, 2, (2, 20, 3)))
    wrench = rng.uniform(-9, 9, (20, 6))
    asked = functions(planar) | {
        "null_efforts": lambda q: null_efforts(planar, q).reshape(20, -1),
        "project_redundant": lambda *motion: np.hstack(planar.project_redundant(*motion)),
    }
    assert set(package.heads) == set(asked)
    given = inputs_of(planar, (q, qd, qdd, wrench))
    given |= {"null_efforts": (q,), "project_redundant": (q, qd, qdd)}
    for name, ask in asked.items():
        status, found = package.run(program, name, *given[name])
        right = ask(*given[name])
        assert not status.any(), name
        np.testing.assert_allclose(found, right, atol=1e-12 * np.abs(right).max(), err_msg=name)
    status, found = package.run(program, "torques", q + 3e-3 * np.eye(4)[2], qd, qdd, wrench)
    assert (status == 1).all()
    assert np.isnan(found).all()


def test_errors_of_parts_move_the_platform_with_the_leading_joints_held():
    """Against circles that meet, by three of four limbs; machines drawn on exact geometry too."""
    rng = np.random.default_rng(12)
    plane = Planar(rng, 4, point=False, limits=LIMITS["unlike"][:4])
    robot = robot_of_data(plane.file(), "plane")
    leads = list(robot.graph.leading)
    pose = np.array([0.01, -0.02, 0.1])
    q = robot.inverse(pose)
    first, second = plane.elbow - plane.base, plane.wrist - plane.elbow
    paths = [
        path
        for k in range(4)
        for path in (f"bodies.crank_{k}.length", f"bodies.coupler_{k}.length", f"joints.motor_{k}.offset")
        if k in leads or "offset" not in path
    ]

    def reached(errors):
        longer = lambda kind: np.array([errors.get(f"{kind}_{k}", 0.0) for k in range(4)])  # noqa: E731
        arm = first * (1 + longer("crank") / np.linalg.norm(first, axis=1))[:, None]
        angle = q - plane.home + longer("motor")
        elbow = plane.base + np.einsum("kij,kj->ki", turned(angle), arm)
        apart = np.linalg.norm(second, axis=1) + longer("coupler")

        def left(p):
            ends = p[:2] + plane.wrist @ turned(p[2]).T
            return (np.linalg.norm(ends - elbow, axis=1) - apart)[leads]

        return root(left, pose, tol=1e-14).x

    names = [path.split(".")[1] for path in paths]
    found = tolerances(robot, dict.fromkeys(paths, 1e-4), q)
    for path, name in zip(paths, names, strict=True):
        slope = (reached({name: 1e-5}) - reached({name: -1e-5})) / 2e-5
        np.testing.assert_allclose(found.sensitivity[path][[0, 1, 5]], slope, atol=1e-6)
    draws = rng.normal(0.0, 1e-4, (400, len(paths)))
    own = np.array([reached(dict(zip(names, row, strict=True))) for row in draws]) - pose
    np.testing.assert_allclose(own.std(0), found.deviation[[0, 1, 5]], rtol=0.12)
    exact = drawn(robot, dict.fromkeys(paths, 1e-4), q, 400, seed=1)[:, 0, [0, 1, 5]]
    np.testing.assert_allclose(exact.std(0), found.deviation[[0, 1, 5]], rtol=0.12)
    other = next(name for name in robot.joint_names if name not in robot.graph.leads)
    with pytest.raises(ParameterError, match="lead"):
        tolerances(robot, {f"joints.{other}.offset": 1e-4}, q)


def test_a_number_of_the_file_is_off_with_the_leading_joints_held(planar):
    q = planar.inverse([[0.02, -0.01, 0.1], [-0.02, 0.0, -0.1]])
    path, step = "parameters.base_radius", 1e-5
    placed = [
        made.platform(made.project_redundant(q)[0])[0]
        for made in (planar.with_file_values({path: 0.3 + side * step}) for side in (1, -1))
    ]
    slope = (placed[0] - placed[1]) / (2 * step)
    found = tolerances(planar, {path: 1e-3}, q)
    np.testing.assert_allclose(found.sensitivity[path][:, :3], slope, atol=1e-7)
    exact = drawn(planar, {path: 1e-3}, q, 300)
    np.testing.assert_allclose(exact[..., :3].std(0), found.deviation[:, :3], rtol=0.12, atol=1e-12)


@pytest.mark.long
def test_a_design_has_less_effort_than_every_machine_of_a_grid(planar):
    t = np.linspace(0.0, 0.5, 12)
    size, rate = np.array([0.02, 0.015, 0.1]), np.array([9.0, 7.0, 8.0])
    pose, speed = size * np.sin(np.outer(t, rate)), size * rate * np.cos(np.outer(t, rate))
    change = -size * rate**2 * np.sin(np.outer(t, rate))
    path = PosePath(t, pose, speed, change, np.tile([3.0, 0, 0, 0, 0, 0.1], (12, 1)))
    name = "parameters.elbow_x"

    def peak(value):
        made = planar.with_file_values({name: value})
        q = made.inverse(pose)
        efforts = inverse_dynamics(made, q, *joint_rates(made, q, speed, change), path.wrench)
        return np.abs(efforts).max()

    found = design(planar, {name: (0.18, 0.26)}, path, "peak-effort", starts=2).best
    best = peak(found.numbers[name])
    assert found.quantities["peak-effort"] == pytest.approx(best, rel=1e-9)
    each = [peak(value) for value in np.linspace(0.18, 0.26, 7)]
    assert 0.19 < found.numbers[name] < 0.25
    assert best <= min(each) * (1 + 1e-6) < 0.99 * peak(0.22)


def test_without_redundancy_nothing_moves_nothing():
    robot = load("five_bar")
    assert null_efforts(robot, np.zeros((5, 2)) + robot.graph.home).shape == (5, 0, 2)


def test_limits_that_are_all_infinite_are_none():
    sharing = []
    for limits in (None, np.full(4, np.inf)):
        plane = Planar(np.random.default_rng(2), 4, point=False, limits=limits)
        robot = robot_of_data(plane.file(), "plane")
        sharing.append(robot.graph.sharing)
        again = robot.changed(limits={"effort": np.inf, "velocity": np.inf})
        sharing.append(again.graph.sharing)
    np.testing.assert_array_equal(sharing, sharing[:1] * 4)
