# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Laws of the joint reactions: the force route has to agree with the power route."""

import dataclasses

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, least_norm_reactions, reactions
from delta_dynamics.torques.reactions import list_transmitters, needed_wrench_kernel
from pkm_twin.errors import SingularityError
from test.support.bodies import bodies, rubs
from test.support.robots import FREE, MASSIVE, load, loaded, massive, random_motion


def imbalance(robot, result, q, qd, qdd, wrench):
    """Greatest force or moment (about the base's origin) that is missing on any body, relative.

    Written without the matrix of the solver: sums wrench by wrench.
    """
    all_ = bodies(robot, q, qd, qdd)
    moving = robot.graph.platform
    passive = rubs(robot, all_, q, qd)
    worst = 0.0
    for name in robot.body_names:
        if name == "payload":
            continue
        force, moment = np.zeros((2, len(q), 3))
        size = np.zeros(len(q))
        for k, (inner, outer) in enumerate(result.bodies):
            sign = (outer == name) - (inner == name)
            f, m = result.wrenches[:, k, :3], result.wrenches[:, k, 3:]
            force += sign * f
            moment += sign * (m + np.cross(result.points[:, k], f))
            if sign:
                size = np.maximum(size, np.abs(f).max(-1))
        for k, body in enumerate(robot.body_names):
            if body == name or (name == moving and body == "payload"):
                inertial = all_.mass[k] * (all_.acceleration[:, k] - robot.gravity)
                force -= inertial
                moment -= all_.moment[:, k] + np.cross(all_.com[:, k], inertial)
        for rub in passive:
            sign = (rub.joint.outer == name) - (rub.joint.inner == name)
            taken = sign * rub.effort[:, None] * rub.axis
            if rub.turns:
                moment -= taken
            else:
                force -= taken
                moment -= np.cross(rub.point, taken)
        if name == moving:
            origin = robot.platform(q)[0]
            force += wrench[:, :3]
            moment += wrench[:, 3:] + np.cross(origin, wrench[:, :3])
        worst = max(worst, (np.abs(force).max(-1) / size).max(), (np.abs(moment).max(-1) / size).max())
    return worst


def reaching(robot, q, qd, qdd, wrench):
    """What reaches the bodies by virtual work: drives' friction and rotors take the rest."""
    rotors = np.array([robot.graph.joints[name].rotor_inertia for name in robot.joint_names])
    return inverse_dynamics(robot.changed(friction=FREE), q, qd, qdd, wrench) - qdd * rotors


@massive
def test_every_body_is_balanced(name, rng):
    robot = loaded(name)
    motion = random_motion(robot, rng, 200)
    result = least_norm_reactions(robot, *motion)
    assert imbalance(robot, result, *motion) < 1e-10
    assert result.residual.max() < 1e-10


@massive
def test_the_force_route_gives_the_power_routes_efforts(name, rng):
    robot = loaded(name)
    motion = random_motion(robot, rng, 300)
    tau = reaching(robot, *motion)
    efforts = reactions(robot, *motion).efforts
    assert (np.abs(efforts - tau).max(-1) <= 1e-9 * np.abs(tau).max(-1)).all()


@massive
def test_what_is_determinate_is_a_matter_of_counting(name, rng):
    robot = loaded(name)
    result = reactions(robot, *random_motion(robot, rng, 100))
    held = [joint for joint in robot.graph.joints.values() if not joint.virtual]
    count = len(held) + 2 * len(robot.graph.rods)
    # Six balances a body; a rod's spin about itself is nobody's. What is more is not determinate.
    balances = 6 * (len(robot.body_names) - 1) - len(robot.graph.rods)
    surplus = len(result.components) - balances
    assert surplus >= 0
    assert (result.indeterminate == ()) == (surplus == 0)
    assert result.determinate.all() == (surplus == 0)
    np.testing.assert_array_equal(np.isfinite(result.wrenches), result.determinate)
    assert len(result.names) == len(set(result.names)) == count
    assert result.wrenches.shape == result.determinate.shape == (100, count, 6)
    assert result.bodies[0][0] == "base"
    np.testing.assert_array_equal(result.wrench(result.names[-1]), result.wrenches[:, -1])


def test_a_hanging_delta_carries_its_weight():
    """At rest in a symmetric pose the base joints carry a third of the weight each."""
    robot = load("delta")
    result = reactions(robot, np.full(3, 0.3), np.zeros(3), np.zeros(3))
    inertia = robot.inertia
    total = inertia.platform_mass + 3 * (inertia.arm_mass + inertia.forearm_mass)
    for limb in ("I", "II", "III"):
        assert result.wrench(f"base joint {limb}")[2] == pytest.approx(total * 9.81 / 3, rel=1e-12)
        platform = result.wrench(f"platform joint {limb}")
        assert platform[2] == pytest.approx(inertia.platform_mass * 9.81 / 3, rel=1e-12)
        assert np.abs(platform[3:]).max() < 1e-14


OVERCONSTRAINED = [name for name in MASSIVE if load(name).engine.mobility.redundant and name != "delta_cu"]


@pytest.fixture(params=OVERCONSTRAINED)
def overconstrained(request):
    return loaded(request.param)


def test_an_overconstrained_mechanism_names_what_statics_cannot_tell(overconstrained, rng):
    motion = random_motion(overconstrained, rng, 60)
    result = reactions(overconstrained, *motion)
    np.testing.assert_array_equal(result.determinate, np.isfinite(result.wrenches))
    np.testing.assert_array_equal(result.determinate_components, np.isfinite(result.values))
    known = result.determinate_components.all(0)
    assert {n for n, k in zip(result.components, known, strict=True) if not k} == set(result.indeterminate)
    tau = reaching(overconstrained, *motion)
    np.testing.assert_allclose(result.efforts, tau, rtol=1e-9, atol=1e-10 * np.abs(tau).max())


def test_the_2upr_rpu_cannot_tell_how_its_three_limbs_share_a_twist():
    """Its symmetric plane holds three surplus couples and a force (2UPR-RPU paper, section 2)."""
    robot = load("upr_rpu")
    home = robot.graph.home
    result = reactions(robot, home, 0 * home, 0 * home)
    assert len(result.components) - 6 * (len(robot.body_names) - 1) == 3
    # What the limbs push along themselves does the weight's work alone.
    assert np.isfinite(result.efforts).all()
    for name in result.indeterminate:
        assert "force along axis" not in name


def balance(robot, motion):
    """What every component does to every body: shape (n, 6 bodies, components), base's origin."""
    (_, rods, places), status = needed_wrench_kernel(robot)(robot.inertial, *motion)
    assert status is None
    joints = list_transmitters(robot.graph, rods, places)
    names = list(dict.fromkeys(c for joint in joints for c in joint.components))
    rows = [n for n in robot.body_names if n != "payload"]
    matrix = np.zeros((len(rods), len(rows), 6, len(names)))
    for joint in joints:
        unit = joint.basis.copy()
        lever = np.cross(joint.point[..., None, :], unit[:, :3].swapaxes(-1, -2))
        unit[:, 3:] += lever.swapaxes(-1, -2)
        for k, component in enumerate(joint.components):
            for body, sign in ((joint.outer, 1.0), (joint.inner, -1.0)):
                if body in rows:
                    column = matrix[:, rows.index(body), :, names.index(component)]
                    column += sign * unit[..., k]
    return names, joints, matrix.reshape(len(rods), -1, len(names))


def test_determinate_components_are_the_same_in_every_solution(overconstrained, rng):
    """With a self-stress of the surplus components added, the balance stays and so do these."""
    motion = random_motion(overconstrained, rng, 60)
    known = reactions(overconstrained, *motion)
    least = least_norm_reactions(overconstrained, *motion)
    assert imbalance(overconstrained, least, *motion) < 1e-10
    names, joints, matrix = balance(overconstrained, motion)
    assert tuple(names) == least.components
    _, s, vt = np.linalg.svd(matrix)
    rank = int((s[0] > 1e-9 * s[0, 0]).sum())
    assert (s[:, rank - 1] > 1e-9 * s[:, 0]).all() and rank < len(names)
    stress = np.einsum("nsk,ns->nk", vt[:, rank:], rng.normal(0.0, 5.0, (60, len(names) - rank)))
    wrenches = least.wrenches.copy()
    for k, joint in enumerate(joints):
        along = np.stack([stress[:, names.index(c)] for c in joint.components], -1)
        wrenches[:, k] += np.einsum("nij,nj->ni", joint.basis, along)
    other = dataclasses.replace(least, wrenches=wrenches)
    assert imbalance(overconstrained, other, *motion) < 1e-10
    size = np.abs(wrenches).max()
    for solution in (least, other):
        difference = np.abs(solution.wrenches - known.wrenches)[known.determinate]
        assert difference.max() < 1e-10 * size
    assert np.abs(wrenches - least.wrenches)[~known.determinate].max() > 0.1
    # The least of all solutions is normal to every self-stress, moments counted as forces.
    centred = least.points - least.points.mean(-2, keepdims=True)
    length = np.sqrt(np.mean(np.sum(centred**2, -1), -1))
    unit = np.where(["moment" in name for name in names], length[:, None], 1.0)
    slope = np.sum(least.values / unit * stress / unit, -1)
    assert np.abs(slope).max() < 1e-10 * size**2


def test_a_single_faulty_pose_in_a_batch_is_told_apart(rng):
    """Where the three couples are dependent, they are indeterminate, there and only there."""
    robot = load("delta").changed(gravity=[0, 0, 0])
    inside, beyond = np.array([0.98, 1.36, 0.785]), np.array([1.758, -0.796, 1.362])

    def couples(way):
        """Joints, and the parallelograms' couples e = t x w as columns."""
        q = (1 - way) * inside + way * beyond
        rotations, origins = robot.placements(q)
        at, g = robot.engine.tree.at, robot.geometry
        columns = []
        for azimuth, rod in zip(g.azimuths, robot.graph.rods.values(), strict=True):
            a, b = (
                origins[body] + rotations[body] @ (point - at[body])
                for body, point in zip((rod.inner, rod.outer), rod.ends, strict=True)
            )
            e = np.cross([-np.sin(azimuth), np.cos(azimuth), 0.0], b - a)
            columns.append(e / np.linalg.norm(e))
        return q, np.stack(columns, -1)

    low, high = 0.0, 1.0
    for _ in range(80):
        middle = (low + high) / 2
        if np.linalg.det(couples(middle)[1]) > 0:
            low = middle
        else:
            high = middle
    q, matrix = couples(low)
    assert np.linalg.svd(matrix)[1][-1] < 1e-12
    batch = np.array([inside, q])
    wrench = np.concatenate([np.zeros(3), matrix @ [0.1, 0.2, -0.3]])
    result = reactions(robot, batch, np.zeros(3), np.zeros(3), wrench * [[0], [1]])
    assert result.determinate[0].all()
    assert set(result.indeterminate) == {
        *(f"limb {limb}: moment along e" for limb in ("I", "II", "III")),
        *(f"base joint {limb}: moment along {a}" for limb in ("I", "II", "III") for a in "rz"),
    }
    out_of_hold = np.concatenate([np.zeros(3), np.linalg.svd(matrix)[0][:, -1]])
    with pytest.raises(SingularityError) as caught:
        reactions(robot, batch, np.zeros(3), np.zeros(3), out_of_hold)
    assert caught.value.index == (1,)


class RodByRod:
    """A Delta with every rod a body of its own; moments about the base's origin."""

    def __init__(self, robot, all_, k):
        self.robot, self.all, self.k = robot, all_, k
        self.loads, self.columns = [], []

    def body(self, name, share=1.0, shift=0.0):
        self.loads.append(self.needs(name, share, shift))
        return len(self.loads) - 1

    def needs(self, name, share=1.0, shift=0.0):
        at = self.robot.body_names.index(name)
        all_, k = self.all, self.k
        force = share * all_.mass[at] * (all_.acceleration[k, at] - self.robot.gravity)
        moment = share * all_.moment[k, at] + np.cross(all_.com[k, at] + shift, force)
        return np.concatenate([force, moment])

    def unknown(self, inner, outer, force, moment):
        self.columns.append((inner, outer, np.concatenate([force, moment])))
        return len(self.columns) - 1

    def ball(self, inner, outer, point):
        return [self.unknown(inner, outer, axis, np.cross(point, axis)) for axis in np.eye(3)]

    def solve(self):
        matrix = np.zeros((len(self.loads), 6, len(self.columns)))
        for k, (inner, outer, wrench) in enumerate(self.columns):
            matrix[outer, :, k] += wrench
            if inner is not None:
                matrix[inner, :, k] -= wrench
        matrix = matrix.reshape(-1, len(self.columns))
        solution, _, rank, _ = np.linalg.lstsq(matrix, np.concatenate(self.loads), rcond=1e-12)
        assert rank == len(self.columns) == 54
        return solution


@pytest.mark.parametrize("half_width", [0.02, 0.05])
def test_a_parallelogram_rod_by_rod_gives_the_same(half_width, rng):
    """Six rods with ball ends, each with half a limb's mass, beside one limb body with a couple."""
    robot = loaded("delta")
    motion = random_motion(robot, rng, 20)
    result = reactions(robot, *motion)
    all_ = bodies(robot, *motion[:3])
    origin = robot.platform(motion[0])[0]
    for n, (points, wrenches, wrench) in enumerate(zip(result.points, result.wrenches, motion[3], strict=True)):
        model = RodByRod(robot, all_, n)
        platform = model.body("platform")
        about = np.cross(origin[n], wrench[:3])
        model.loads[platform] += model.needs("payload") - wrench - np.concatenate([np.zeros(3), about])
        rods = {}
        for i, limb in enumerate(("I", "II", "III")):
            azimuth = robot.geometry.azimuths[i]
            t = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
            joints = [result.names.index(f"{joint} {limb}") for joint in ("base joint", "elbow", "platform joint")]
            a, b, c = points[joints]
            arm = model.body(f"arm {limb}")
            model.ball(None, arm, a)
            for axis in np.eye(3):
                model.unknown(None, arm, np.zeros(3), axis)
            for lever in (-half_width * t, half_width * t):
                rod = model.body(f"forearm {limb}", 0.5, lever)
                at_b, at_c = model.ball(arm, rod, b + lever), model.ball(rod, platform, c + lever)
                rods.setdefault(joints[1], []).append((lever, at_b))
                rods.setdefault(joints[2], []).append((lever, at_c))
        solution = model.solve()
        for joint, ends in rods.items():
            force = sum(solution[where] for _, where in ends)
            couple = sum(np.cross(lever, solution[where]) for lever, where in ends)
            np.testing.assert_allclose(wrenches[joint], [*force, *couple], atol=1e-10 * np.abs(solution).max())
