# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Wrenches measured anywhere, and torques that bear them, on the pure cores."""

import itertools
import math

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from delta_dynamics.feedforward import Feedforward, Settings
from pkm_twin.bags.reader import read_messages
from pkm_twin.errors import MessageError, ParameterError
from pkm_twin.machine import rotations
from pkm_twin.streams.differentiator import Differentiator
from pkm_twin.streams.matched import WrenchWindow, window_weights
from pkm_twin.streams.wrench import Mount, TimeCache, WrenchReader, WrenchSettings
from test.nodes.harness import REPOSITORY, SECOND, Maker, Plain, reject
from test.support.robots import load

MAKE = Maker(Plain())
NOW = 1_000 * SECOND
STEP = SECOND // 1000
WRENCH = np.array([30.0, -20.0, -100.0, 3.0, -2.0, 1.0])
XYZ, RPY = (0.05, -0.02, 0.11), (0.4, -0.7, 2.1)


def random_rotation(rng):
    return rotations.from_rpy(rng.uniform(-3, 3, 3))


class TestMounts:
    def test_quaternions_there_and_back(self):
        rng = np.random.default_rng(1)
        turns = [random_rotation(rng) for _ in range(50)]
        turns += [np.diag(d) for d in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1], [1.0, 1, 1])]
        for rotation in turns:
            quaternion = rotations.to_quaternion(rotation)
            assert np.linalg.norm(quaternion) == pytest.approx(1.0)
            assert np.allclose(rotations.from_quaternion(*quaternion), rotation, atol=1e-14)

    @pytest.mark.parametrize("frame", ["ft_sensor", "base_link"])
    def test_the_power_is_the_same_at_either_point(self, frame):
        """Whatever the platform's motion: the wrench's power does not hang on the point."""
        rng = np.random.default_rng(2)
        rpy = RPY if frame == "ft_sensor" else (0.0, 0.0, 0.0)
        reader = WrenchReader(WrenchSettings(wrench_frame=frame, sensor_xyz=XYZ, sensor_rpy=rpy))
        for _ in range(20):
            rotation, v, omega = random_rotation(rng), *rng.normal(size=(2, 3))
            sample, mount = reader.read(MAKE.wrench(WRENCH, NOW, frame), NOW)
            moved = reader.at_reference(sample, mount, rotation)
            axes = rotation @ rotations.from_rpy(np.array(RPY)) if rpy == RPY else np.eye(3)
            there = v + np.cross(omega, rotation @ XYZ)
            power = (axes @ WRENCH[:3]) @ there + (axes @ WRENCH[3:]) @ omega
            assert moved @ np.concatenate((v, omega)) == pytest.approx(power, rel=1e-12)

    def test_transforms_go_before_the_fixed_mount(self):
        asked = []

        def mounts(frame, stamp):
            asked.append((frame, stamp))
            if len(asked) > 1:
                raise MessageError("transform", "no transform")
            return Mount.of(XYZ, RPY)

        given = WrenchReader(WrenchSettings("ft_sensor"), mounts)
        fixed = WrenchReader(WrenchSettings("ft_sensor", sensor_xyz=XYZ, sensor_rpy=RPY))
        message, turn = (
            MAKE.wrench(WRENCH, NOW, "ft_sensor"),
            random_rotation(np.random.default_rng(3)),
        )
        results = [r.at_reference(*r.read(message, NOW), turn) for r in (given, fixed)]
        assert (results[0] == results[1]).all()
        assert asked == [("ft_sensor", NOW)]
        assert reject(given.read, message, NOW)[0] == "transform"
        # Of the base frame nothing is asked: its axes are fixed, its point the reference point.
        base = WrenchReader(WrenchSettings("base_link"), mounts)
        base.read(MAKE.wrench(WRENCH, NOW, "base_link"), NOW)
        assert len(asked) == 2

    @pytest.mark.parametrize(
        ("options", "named"),
        [
            ({"sensor_xyz": (1.0, math.nan, 0.0)}, "sensor.xyz"),
            ({"sensor_xyz": (1e3, 0.0, 0.0)}, "sensor.xyz"),
            ({"sensor_rpy": (45.0, 0.0, 0.0)}, "sensor.rpy"),
            ({"wrench_frame": "base_link", "sensor_rpy": (0.1, 0.0, 0.0)}, "sensor.rpy"),
        ],
    )
    def test_bad_mounts_are_refused_by_name(self, options, named):
        with pytest.raises(ParameterError, match=named):
            WrenchSettings(**options)


def test_the_nearest_of_recent_values_is_that_of_all():
    rng = np.random.default_rng(4)
    recent = TimeCache(16)
    assert recent.nearest(5) is None and recent.find_before(5) is None and recent.latest is None
    stamps = np.sort(rng.integers(0, 1000, 40)).tolist()
    for k, stamp in enumerate(stamps):
        recent.push(stamp, k)
        kept = stamps[max(0, k - 15) : k + 1]
        for asked in rng.integers(-50, 1050, 5).tolist():
            found = recent.nearest(asked)[0]
            assert abs(found - asked) == min(abs(s - asked) for s in kept)
            before = [s for s in kept if s <= asked]
            assert recent.find_before(asked)[0] == (max(before) if before else kept[0])
    with pytest.raises(MessageError):
        recent.push(stamps[-1] - 1, 0)


@pytest.mark.parametrize("carries", [True, False])
@pytest.mark.parametrize(("order", "window"), [(2, 25), (1, 5), (3, 9), (4, 30)])
def test_a_fit_weighs_the_accelerations_between_its_samples(order, window, carries):
    """Of a motion with constant accelerations between uneven stamps, beside the differentiator."""
    rng = np.random.default_rng(window)
    stamps = np.cumsum(rng.integers(STEP // 2, 3 * STEP // 2, window))
    t = stamps / SECOND
    a = rng.normal(size=window - 1)
    dt = np.diff(t)
    v = np.concatenate(([0.3], 0.3 + np.cumsum(a * dt)))
    q = np.concatenate(([1.0], 1.0 + np.cumsum(v[:-1] * dt + 0.5 * a * dt**2)))
    fit = Differentiator(order, window)
    for k in range(window):
        rates = fit.push(int(stamps[k]), q[k : k + 1], v[k : k + 1] if carries else None)
    weights = window_weights(stamps, order, carries)
    assert weights.sum() == pytest.approx(1.0, abs=1e-9)
    scale = np.abs(weights).sum()
    assert rates[1][0] == pytest.approx(weights @ a, abs=1e-7 * scale)


class TestTorques:
    ROBOT = load("prru")
    WINDOW = 5

    def core(self, missing_wrench_policy="ignore", max_age=STEP * 20, **settings):
        rules = Settings(window=self.WINDOW, recovery_count=2, **settings)
        reader = WrenchReader(WrenchSettings())
        wrenches = WrenchWindow(reader, max_age, missing_wrench_policy, rules.order, rules.window)
        return Feedforward(self.ROBOT, rules, wrenches)

    def state(self, i, effort=()):
        q = self.ROBOT.inverse(self.ROBOT.home())
        rate = np.array([0.1, -0.05, 0.02])
        stamp = NOW + i * STEP
        return MAKE.joint_state(self.ROBOT.joint_names, q + rate * i / 1000, rate, effort, stamp), stamp

    def answer(self, core, i, **options):
        message, stamp = self.state(i, **options)
        return core.joint_state(message, stamp)

    def push(self, core, i, wrench=WRENCH):
        core.wrenches.take(MAKE.wrench(wrench, NOW + i * STEP), NOW + i * STEP)

    def expected(self, result, wrench):
        q, qd, qdd = result.motion
        turn = self.ROBOT.platform(q)[1]
        fixed = np.concatenate((turn @ wrench[:3], turn @ wrench[3:]))
        return inverse_dynamics(self.ROBOT, q, qd, qdd, fixed)

    def test_a_wrench_that_comes_after_its_joint_state_is_the_same(self):
        first, second = self.core(), self.core()
        rng = np.random.default_rng(5)
        for i in range(12):
            wrench = WRENCH + 10.0 * rng.normal(size=6)
            self.push(first, i, wrench)
            early = self.answer(first, i)
            late = self.answer(second, i)
            if i < 11:
                self.push(second, i, wrench)
        # Of the newest state alone the wrench is not yet known.
        rows = list(zip(first.wrenches._rows, second.wrenches._rows, strict=True))
        assert all((a.wrench == b.wrench).all() for a, b in rows[:-1])
        assert early.stamp == late.stamp

    def test_ignored_where_there_is_none(self):
        core = self.core()
        plain = Feedforward(self.ROBOT, core.settings)
        for i in range(12):
            result, free = self.answer(core, i), self.answer(plain, i)
        assert (result.effort == free.effort).all()
        assert core.wrenches.without == 12
        assert not core.stream.stopped

    def test_stopped_where_there_is_none_and_started_again(self):
        core = self.core("stop")
        with pytest.raises(MessageError, match="no wrench has arrived"):
            self.answer(core, 0)
        assert core.stream.stopped and core.stream.reason == "no wrench"
        answers = []
        for i in range(1, 12):
            self.push(core, i)
            answers.append(self.answer(core, i))
        assert answers[-1] is not None and not core.stream.stopped
        for i in itertools.count(12):
            try:
                self.answer(core, i)
            except MessageError as error:
                assert (error.reason, i) == ("no wrench", 11 + 21)
                break
        assert core.stream.stopped and core.stream.stops["no wrench"] == 2

    def test_a_wrench_of_much_later_is_none(self):
        """The first one may come before the joint state that it follows: by its age it is none."""
        core = self.core("stop")
        self.push(core, 21)
        assert reject(self.answer, core, 0)[0] == "no wrench"
        near = self.core("stop")
        self.push(near, 19)
        self.answer(near, 0)

    def test_refused_wrenches_are_counted_and_leave_nothing(self):
        core = self.core()
        self.push(core, 5)
        bad = [
            ("stamp order", MAKE.wrench(WRENCH, NOW)),
            ("frame", MAKE.wrench(WRENCH, NOW + 5 * STEP, "tool0")),
            ("not finite", MAKE.wrench([math.nan] * 6, NOW + 5 * STEP)),
            ("future stamp", MAKE.wrench(WRENCH, NOW + 9 * SECOND)),
            ("zero stamp", MAKE.wrench(WRENCH, 0)),
        ]
        for reason, message in bad:
            assert reject(core.wrenches.take, message, NOW + 5 * STEP)[0] == reason
        assert core.wrenches.stream.rejected == {reason: 1 for reason, _ in bad}
        assert core.wrenches.require(NOW + 5 * STEP)[0].stamp == NOW + 5 * STEP

    def test_a_reset_forgets_the_wrenches(self):
        core = self.core("stop")
        self.push(core, 0)
        core.reset()
        with pytest.raises(MessageError, match="no wrench"):
            self.answer(core, 0)


@pytest.mark.parametrize("carries", [True, False])
def test_a_stream_has_the_torques_of_its_motion_at_any_rate(make, carries):
    """A sine of 1 Hz by the default window, under a load; each rate after another in one core."""
    settings = Settings(differentiate=True, stale_after=0.5, recovery_count=1)
    window = WrenchWindow(WrenchReader(WrenchSettings()), SECOND, "stop", 2, settings.window)
    robot, now, push = load("delta_cu"), NOW, np.array([3.0, -2.0, 5.0, 0, 0, 0])
    core = Feedforward(robot, settings, window)
    turn, reach = 2.0 * np.pi, np.array([0.2, -0.15, 0.1])
    for rate in (200, 1000, 100):
        now += SECOND
        results = []
        for i in range(rate):
            stamp = now + i * SECOND // rate
            q, qd = 0.2 + reach * np.sin(turn * i / rate), reach * turn * np.cos(turn * i / rate)
            pushed = push * np.sin(turn * i / rate)
            core.wrenches.take(make.wrench(pushed, stamp=stamp), stamp)
            message = make.joint_state(robot.joint_names, q, qd if carries else (), qd, stamp=stamp)
            answer = core.joint_state(message, stamp)
            if answer is not None:
                exact = inverse_dynamics(robot, q, qd, turn**2 * (0.2 - q), answer.wrench)
                results.append(np.concatenate([answer.effort - exact, answer.wrench - pushed]))
        now += SECOND
        assert len(results) >= rate - 25
        assert np.abs(results)[:, :3].max() < 0.01 * np.abs(exact).max()
        assert np.abs(results)[:, 3:].max() < 0.01 * push.max()


def test_a_cut_is_no_residual():
    """Of the milling bag's first seconds."""
    bag = REPOSITORY / "bags" / "prru_milling.mcap"
    robot = load("prru")
    settings = Settings(stale_after=1.0)
    reader = WrenchReader(WrenchSettings())
    window = WrenchWindow(reader, SECOND // 10, "stop", settings.order, settings.window)
    cores = {"with": Feedforward(robot, settings, window), "without": Feedforward(robot, settings)}
    residuals, efforts, cutting = {name: [] for name in cores}, [], False
    for record in read_messages(bag, ["/joint_states", "/wrench"]):
        now = record.log_time
        if record.topic == "/wrench":
            force = record.message.wrench.force
            cutting = math.hypot(force.x, force.y, force.z) > 50.0
            window.take(record.message, now)
            continue
        if len(efforts) == 3200:
            break
        for name, core in cores.items():
            try:
                answer = core.joint_state(record.message, now)
            except MessageError as error:
                assert error.reason == "no wrench"
                continue
            if answer is not None and cutting:
                residuals[name].append(answer.residual)
        efforts.append(record.message.effort)
    peak = np.abs(efforts).max(0)
    part = {n: np.sqrt(np.mean(np.square(r), 0)) / peak for n, r in residuals.items()}
    assert len(residuals["with"]) > 700
    assert (part["with"] < 0.01).all(), part
    assert (part["without"] > 10.0 * part["with"]).all(), part
