# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The machine's state and its shapes, on the pure core, for every robot."""

import math

import numpy as np
import pytest

from pkm_twin import robot_names
from pkm_twin.errors import MessageError
from pkm_twin.machine import rotations
from pkm_twin.state.scene import Scales, Scene, WrenchEffects, choose_heat_colour
from pkm_twin.state.state import MachineState
from pkm_twin.streams.wrench import WrenchSettings
from stiffness_monitor import compliance, strain_energy
from stiffness_monitor.compliance import member_deflections
from test.nodes.harness import SECOND, Maker, Plain, reject
from test.support.robots import KINDS, load, partly_long, some_elastic

MAKE = Maker(Plain())
NOW = 1_000 * SECOND
STEP = SECOND // 1000
WRENCH = np.array([30.0, -20.0, -100.0, 3.0, -2.0, 1.0])


@pytest.fixture(scope="module", params=partly_long(robot_names(), *KINDS, "prru"))
def robot(request):
    return load(request.param)


def poses(robot, count=5):
    """Joint positions near home, within the limits."""
    rng = np.random.default_rng(len(robot.name))
    home = robot.inverse(robot.home())
    return home + 0.01 * rng.uniform(-1, 1, (count, len(home)))


def told(robot, q, qd=(), stamp=NOW):
    core = MachineState(robot)
    return core.joint_state(MAKE.joint_state(robot.joint_names, q, qd, stamp=stamp), stamp)


def loaded(robot, q, wrench=WRENCH):
    """What a load does to a machine at these joint positions."""
    pose = robot.forward(q)
    energy = strain_energy(robot, pose, wrench)
    return WrenchEffects(
        np.asarray(wrench, float),
        compliance(robot, pose),
        energy.deflection,
        dict(zip(energy.elements, energy.factors.tolist(), strict=True)),
        str(energy.dominant),
        member_deflections(robot, q, wrench),
    )


each_elastic = pytest.mark.parametrize("robot", some_elastic, indirect=True)


class TestState:
    def test_all_joints_and_the_platform(self, robot):
        for q in poses(robot):
            state = told(robot, q)
            position, rotation = robot.platform(q)
            joints = [*q, *robot.passive(q)]
            for found, expected in zip(
                (state.position, state.rotation, state.joints),
                (position, rotation, joints),
                strict=True,
            ):
                np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)
            assert len(MachineState(robot).joint_names) == len(state.joints)
            assert state.twist is None and state.rates is None

    def test_rates_of_all_joints_and_the_platforms_twist(self, robot):
        q = poses(robot, 1)[0]
        qd = np.linspace(0.1, 0.3, len(q))
        state = told(robot, q, qd)
        h = 1e-5
        ends = [told(robot, q + s * h * qd).joints for s in (-1.0, 1.0)]
        assert np.allclose(state.rates, (ends[1] - ends[0]) / (2 * h), atol=1e-7)
        assert (state.rates[: len(q)] == qd).all()
        places = [robot.platform(q + s * h * qd) for s in (-1.0, 1.0)]
        velocity = (places[1][0] - places[0][0]) / (2 * h)
        spin = (places[1][1] - places[0][1]) @ state.rotation.T / (2 * h)
        omega = [spin[2, 1], spin[0, 2], spin[1, 0]]
        assert np.allclose(state.twist, [*velocity, *omega], atol=1e-7)

    def test_faults_are_refused_and_counted(self):
        robot = load("delta_cu")
        core, names, q = MachineState(robot), robot.joint_names, [0.1, 0.2, 0.3]
        core.joint_state(MAKE.joint_state(names, q, stamp=NOW), NOW)
        bad = [
            ("stamp order", MAKE.joint_state(names, q, stamp=NOW - 1)),
            ("not finite", MAKE.joint_state(names, [0.1, math.nan, 0.3], stamp=NOW)),
            ("missing joint", MAKE.joint_state(names[:2], q[:2], stamp=NOW)),
            ("zero stamp", MAKE.joint_state(names, q)),
            ("limit", MAKE.joint_state(names, [0.1, 9.0, 0.3], stamp=NOW)),
        ]
        for reason, message in bad:
            assert reject(core.joint_state, message, NOW)[0] == reason
        assert core.states.rejected == {reason: 1 for reason, _ in bad}
        assert core.states.accepted == 1 and core.latest.stamp == NOW
        core.reset()
        assert core.latest is None

    def test_the_load_is_the_nearest_wrench_and_not_an_old_one(self):
        robot = load("upr_rpu")
        settings = WrenchSettings("ft", max_state_age=0.01, sensor_xyz=(0.0, 0.0, 0.1))
        core = MachineState(robot, settings)
        state = told(robot, poses(robot, 1)[0])
        assert core.find_wrench(state) is None
        for i in (-30, -4, 3):
            stamp = NOW + i * STEP
            core.store_wrench(MAKE.wrench(WRENCH + i, stamp, "ft"), stamp)
        turn = state.rotation
        force = turn @ (WRENCH + 3)[:3]
        moment = turn @ (WRENCH + 3)[3:] + np.cross(turn @ [0.0, 0.0, 0.1], force)
        assert np.allclose(core.find_wrench(state), [*force, *moment], rtol=1e-13)
        with pytest.raises(MessageError, match="frame"):
            core.store_wrench(MAKE.wrench(WRENCH, NOW, "platform"), NOW)
        late = told(robot, state.q, stamp=NOW + SECOND)
        assert core.find_wrench(late) is None


def by_group(shapes):
    groups = {}
    for shape in shapes:
        groups.setdefault(shape.group, []).append(shape)
    for group in groups.values():
        assert [shape.number for shape in group] == list(range(len(group)))
    return groups


def ends_of(shape):
    """Both ends of a cylinder, from its pose."""
    axis = rotations.from_quaternion(*shape.quaternion)[:, 2]
    return shape.position + np.outer([-0.5, 0.5], axis * shape.size[2])


class TestScene:
    def test_bars_keep_their_length_and_reach_the_platform(self, robot):
        scene = Scene(robot)
        straight = [k for k, bar in enumerate(scene.bars) if "tube" not in bar.start[0]]
        lengths = []
        for q in poses(robot):
            state = told(robot, q)
            places = scene.place_bars(q)
            bars = by_group(scene.shapes(state))["bars"]
            assert len(bars) == len(scene.bars) and all(bar.lasting for bar in bars)
            for bar, ends in zip(bars, places, strict=True):
                assert np.allclose(ends_of(bar), ends, atol=1e-12)
            gaps = np.linalg.norm(places.reshape(-1, 3) - state.position, axis=1)
            assert gaps.min() < robot.size + 1e-9
            lengths.append(np.linalg.norm(places[:, 1] - places[:, 0], axis=1)[straight])
        assert np.ptp(lengths, axis=0).max(initial=0.0) < 1e-9

    def test_without_a_load_there_is_the_machine_alone(self, robot):
        assert set(by_group(Scene(robot).shapes(told(robot, poses(robot, 1)[0])))) == {"bars"}

    @each_elastic
    def test_a_load_is_drawn_as_the_numbers_say(self, robot):
        scales = Scales(deflection=500.0, force=0.002, moment=0.03, ellipsoid_force=50.0)
        scene = Scene(robot, scales)
        state = told(robot, poses(robot, 1)[0])
        load = loaded(robot, state.q)
        groups = by_group(scene.shapes(state, load))
        # Colours: the hottest is the dominant element, wherever it is.
        shown = {bar.element: shape.colour for bar, shape in zip(scene.bars, groups["bars"], strict=True)}
        shown |= {shape.text: shape.colour for shape in groups.get("joints", [])}
        greatest = max(load.energy_fractions.values())
        assert set(load.energy_fractions) <= set(shown)
        for name, share in load.energy_fractions.items():
            assert shown[name] == choose_heat_colour(share / greatest)
        assert shown[load.dominant] == choose_heat_colour(1.0)
        assert [shape.text for shape in groups["dominant"]] == [load.dominant]
        # The deflected machine: members' ends on the undeflected ones, moved and enlarged.
        lines = {shape.text: shape.points for shape in groups["deflected"]}
        for name, (points, moved) in load.members.items():
            assert np.allclose((lines[name] - points) / 500.0, moved, atol=1e-12)
        # Force and moment from the reference point.
        force, moment = (shape.points for shape in groups["wrench"])
        assert np.allclose(force, [state.position, state.position + 0.002 * WRENCH[:3]])
        assert np.allclose(moment, [state.position, state.position + 0.03 * WRENCH[3:]])
        # Every deflection under a force of this size lies on the ellipsoid.
        (ball,) = groups["compliance"]
        axes = rotations.from_quaternion(*ball.quaternion)
        rng = np.random.default_rng(7)
        directions = rng.normal(size=(3, 20))
        directions /= np.linalg.norm(directions, axis=0)
        reach = 500.0 * 50.0 * load.compliance[:3, :3] @ directions
        inside = axes.T @ reach / (0.5 * np.array(ball.size))[:, None]
        assert np.allclose(np.linalg.norm(inside, axis=0), 1.0, atol=1e-9)

    @each_elastic
    def test_members_are_straight_and_bend_in_proportion(self, robot):
        state = told(robot, poses(robot, 1)[0])
        load = loaded(robot, state.q)
        assert load.members
        for points, moved in load.members.values():
            assert points.shape == moved.shape == (5, 3)
            steps = np.diff(points, axis=0)
            assert np.ptp(steps, axis=0).max() < 1e-12
        # Twice the load bends twice as much.
        twice = member_deflections(robot, state.q, 2.0 * WRENCH)
        for name, (_, moved) in load.members.items():
            assert np.allclose(twice[name][1], 2.0 * moved, rtol=1e-9, atol=1e-18)

    def test_a_zero_wrench_has_neither_name_nor_arrow(self):
        robot = load("upr_rpu")
        state = told(robot, poses(robot, 1)[0])
        groups = by_group(Scene(robot).shapes(state, loaded(robot, state.q, np.zeros(6))))
        assert not {"dominant", "wrench"} & set(groups)
        assert "compliance" in groups
