# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The nodes' cores on machines with one to six joints, with a joint map and without one.

Every core that takes or sends joint numbers runs twice: a robot without a map on the model's
numbers, and the same robot with a map on the controller's.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from delta_dynamics.feedforward import Feedforward, Settings
from delta_dynamics.gate import Gate, GateSettings
from delta_dynamics.nodes.topics import GATE, SIMULATION, TWIN
from delta_dynamics.simulation.machine import MachineSettings, Simulation, tune_position_control
from pkm_twin.errors import MessageError
from pkm_twin.messages.reading import JointReader
from pkm_twin.messages.stamps import StampRules
from pkm_twin.robot.effort_limits import EffortLimits, effort_limits
from pkm_twin.state.state import STATE_TOPICS, MachineState
from pkm_twin.streams.topics import JOINTS, NUMBER_ARRAY, TRAJECTORY
from pkm_twin.streams.wrench import WrenchSettings
from pkm_twin.view.live import Live
from stiffness_monitor.monitor import Monitor
from stiffness_monitor.topics import STIFFNESS
from test.nodes.harness import REPOSITORY, SECOND, Maker, Plain, reject
from test.support.mapped import sides
from test.support.robots import joint_units_of_size, random_joints

NOW = 1_000 * SECOND
STEP = SECOND // 1000
MAKE = Maker(Plain())
WINDOW = 5


@pytest.fixture(
    params=[
        ("delta_cu", 1),
        ("linear_delta", 2),
        ("stewart", 3),
        ("upr_rpu", 4),
        ("five_bar", 5),
        (REPOSITORY / "test/machine/machines/slider_crank.yaml", 6),
    ],
    ids=lambda given: Path(given[0]).stem,
)
def both(request):
    return sides(*request.param)


def close(found, expected, within=1e-9):
    """But for the rounding of a conversion there and back."""
    scale = np.abs(expected).max() + 1e-12
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=within * scale)


def swing(robot, t):
    """A slow motion about home: q, qd, qdd."""
    rates = np.linspace(2.0, 3.0, robot.joints_count)
    size = 0.02 * joint_units_of_size(robot)
    home = robot.inverse(robot.home())
    return (
        home + size * np.sin(rates * t),
        size * rates * np.cos(rates * t),
        -size * rates**2 * np.sin(rates * t),
    )


def states(both, q, qd=None, effort=None, stamp=NOW):
    """The same joint state twice: the model's, and the controller's with joints turned over."""
    plain = MAKE.joint_state(
        both.plain.joint_names, q, () if qd is None else qd, () if effort is None else effort, stamp
    )
    mapped = MAKE.joint_state(
        both.names[::-1],
        both.positions(q)[::-1],
        () if qd is None else both.rates(qd)[::-1],
        () if effort is None else both.efforts(effort)[::-1],
        stamp,
    )
    return plain, mapped


def torques(both, effort, stamp=NOW):
    return MAKE.joint_state(both.names, (), (), both.efforts(effort), stamp)


def sent_by(robot, effort):
    """The model's efforts as they leave a node."""
    return EffortLimits(robot).apply(robot.controller.controller_efforts(effort), "reject")[0]


def test_rejections_have_the_names_and_numbers_of_the_sender(both):
    """Of every joint, beyond a bound on either side, in a joint state and in a trajectory."""
    robot = both.mapped
    reader, rules = JointReader(robot), StampRules()
    q = robot.graph.home
    kinds = (("position", both.positions), ("velocity", both.rates), ("effort", both.efforts))
    for joint in range(robot.joints_count):
        for kind, convert in kinds:
            for side in (-1.0, 1.0):
                values = {"position": q, "velocity": 0.0 * q, "effort": 0.0 * q}
                values[kind] = values[kind].copy()
                values[kind][joint] = side * 2e7
                sent = [conversion(values[name]) for name, conversion in kinds]
                with pytest.raises(MessageError) as error:
                    reader.joint_state(MAKE.joint_state(both.names, *sent, NOW), NOW, rules)
                text = re.fullmatch(
                    rf"{kind} of {both.names[joint]} is (\S+), allowed (\S+) to (\S+)",
                    str(error.value),
                )
                assert text, error.value
                value, low, high = map(float, text.groups())
                np.testing.assert_allclose(value, convert(values[kind])[joint], 1e-5)
                assert low < high and not low <= value <= high


class TestFeedforward:
    @pytest.mark.parametrize("rates", [True, False])
    def test_a_stream_with_residuals(self, both, rates):
        settings = Settings(differentiate=True, window=WINDOW, order=3 if rates else 2)
        cores = Feedforward(both.plain, settings), Feedforward(both.mapped, settings)
        for i in range(12):
            q, qd, qdd = swing(both.plain, i / 1000)
            measured = inverse_dynamics(both.plain, q, qd, qdd) + 0.1
            now = NOW + i * STEP
            messages = states(both, q, qd if rates else None, measured, now)
            plain, mapped = (core.joint_state(message, now) for core, message in zip(cores, messages, strict=True))
        # Differences over a millisecond enlarge what rounding leaves of positions.
        close(mapped.sent, both.efforts(plain.effort), 1e-6)
        missed = np.abs(mapped.residual - plain.residual)
        assert missed.max() < 1e-6 * np.abs(plain.effort).max()
        close(mapped.motion[0], plain.motion[0])
        close(mapped.motion[1], plain.motion[1], 1e-6)
        # What a polynomial through milliseconds leaves of a slow wave, and of its rounding.
        exact = measured - 0.1
        assert np.abs(plain.effort - exact).max() < 1e-3 * (1.0 + np.abs(exact).max())

    def test_a_trajectory_in_another_order(self, both):
        times = np.arange(40) * 0.01
        q, qd, qdd = (np.array(v) for v in zip(*(swing(both.plain, t) for t in times), strict=True))
        stamps = [round(t * SECOND) for t in times]
        exact = inverse_dynamics(both.plain, q, qd, qdd)
        order = list(range(both.plain.joints_count))[::-1]
        message = MAKE.trajectory(
            [both.names[k] for k in order],
            stamps,
            both.positions(q)[:, order],
            both.rates(qd)[:, order],
            both.rates(qdd)[:, order],
        )
        close(Feedforward(both.mapped).trajectory(message, NOW), both.efforts(exact)[:, order])

    def test_a_stop_that_bears_the_weight(self, both):
        core = Feedforward(both.mapped, Settings(on_stop="gravity", window=4))
        q, still = both.plain.inverse(both.plain.home()), np.zeros(both.plain.joints_count)
        for i in range(6):
            core.joint_state(states(both, q, still, None, NOW + i * STEP)[1], NOW + i * STEP)
        held = inverse_dynamics(both.plain, q, still, still)
        close(core.stop_effort(NOW + 6 * STEP), both.efforts(held))

    def test_a_point_at_a_limit_is_within_it(self, both):
        if both.plain.limits.position is None:
            pytest.skip("its file gives no limits")
        reader, speed = JointReader(both.mapped), both.plain.limits.velocity
        speed = np.zeros(len(both.names)) if speed is None else speed
        ends = both.plain.limits.position.T
        for q in ends:
            for qd in (speed, -speed):
                found = reader.joint_state(states(both, q, qd)[1], NOW, StampRules())
                close(found.q, q, 1e-12)
                if speed.any():
                    with pytest.raises(MessageError, match="velocity of"):
                        fast = states(both, q, (1.0 + 1e-9) * qd)[1]
                        reader.joint_state(fast, NOW, StampRules())
            beyond = q + 1e-6 * (q - ends.mean(0))
            with pytest.raises(MessageError, match="position of"):
                reader.joint_state(states(both, beyond)[1], NOW, StampRules())


class TestGate:
    def opened(self, both, robot=None, **changes):
        gate = Gate(robot or both.mapped, GateSettings(recovery_count=1, **changes))
        assert gate.torques(torques(both, np.zeros(len(both.names)), NOW), NOW, 0) is not None
        return gate

    def test_what_the_twin_sends_is_forwarded_bit_by_bit(self, both):
        gate = self.opened(both)
        rng = np.random.default_rng(1)
        limits = np.minimum(effort_limits(both.plain), 100.0)
        for k in range(1, 20):
            sent = sent_by(both.mapped, rng.uniform(-1.0, 1.0, len(limits)) * limits)
            now = NOW + k * STEP
            message = MAKE.joint_state(both.names[::-1], (), (), sent[::-1], now)
            assert gate.torques(message, now, k * STEP).tobytes() == sent.tobytes()

    def test_a_torque_at_its_limit_goes_through_and_one_beyond_does_not(self, both):
        if both.plain.limits.effort is None:
            pytest.skip("its file has no place for effort limits")
        limits = np.linspace(1.0, 3.0, len(both.names))
        robot = both.mapped.changed(limits={"effort": limits.tolist()})
        gate = self.opened(both, robot)
        sent = sent_by(robot, limits)
        message = MAKE.joint_state(both.names, (), (), sent, NOW + STEP)
        assert gate.torques(message, NOW + STEP, STEP).tobytes() == sent.tobytes()
        for k in range(len(limits)):
            effort = np.zeros(len(limits))
            effort[k] = -limits[k] * (1.0 + 1e-9)
            with pytest.raises(MessageError, match=f"effort of {both.names[k]} is"):
                gate.torques(torques(both, effort, NOW + (2 + k) * STEP), NOW + STEP, STEP)

    def test_gravity_where_the_machine_stands(self, both):
        gate = self.opened(both, on_stop="gravity")
        q = random_joints(both.plain, np.random.default_rng(4), 1)[0]
        _, message = states(both, q, stamp=NOW + STEP)
        gate.joint_state(message, NOW + STEP, STEP)
        still = np.zeros(len(q))
        held = inverse_dynamics(both.plain, q, still, still)
        assert np.abs(held).max() > 0.0
        close(gate.stop_command(STEP), both.efforts(held))


class TestSimulation:
    def machines(self, both):
        home = both.plain.inverse(both.plain.home())
        stiffness, damping = tune_position_control(both.plain, 5.0)
        settings = MachineSettings(home, effort_limits(both.plain), stiffness, damping)
        return [Simulation(robot, settings, SECOND) for robot in (both.plain, both.mapped)]

    def test_efforts(self, both):
        plain, mapped = self.machines(both)
        still = np.zeros(both.plain.joints_count)
        rng = np.random.default_rng(1)
        for _ in range(20):
            held = inverse_dynamics(both.plain, plain.plant.q, still, still)
            effort = 6.0 * held + 3.0 * both.plain.friction.coulomb * rng.choice([-1.0, 1.0], len(held))
            plain.commands(SimpleNamespace(data=effort.tolist()))
            mapped.commands(SimpleNamespace(data=both.efforts(effort).tolist()))
            plain.advance()
            mapped.advance()
        close(mapped.read_sensors().q, plain.read_sensors().q)
        close(mapped.read_sensors().qd, plain.read_sensors().qd)
        close(mapped.read_sensors().effort, plain.read_sensors().effort)
        assert np.abs(plain.read_sensors().qd).max() > 0.0

    def test_a_trajectory_with_effort(self, both):
        plain, mapped = self.machines(both)
        times = np.arange(1, 11) * 0.01
        q, qd, qdd = (np.array(v) for v in zip(*(swing(both.plain, t) for t in times), strict=True))
        stamps = [round(t * SECOND) for t in times]
        efforts = inverse_dynamics(both.plain, q, qd, qdd)
        one = MAKE.trajectory(both.plain.joint_names, stamps, q, qd, qdd)
        other = MAKE.trajectory(both.names, stamps, both.positions(q), both.rates(qd), both.rates(qdd))
        for message, rows in ((one, efforts), (other, both.efforts(efforts))):
            for point, row in zip(message.points, rows.tolist(), strict=True):
                point.effort = row
        plain.trajectory(one)
        mapped.trajectory(other)
        for _ in range(60):
            plain.advance()
            mapped.advance()
        assert np.abs(plain.read_sensors().q - both.plain.inverse(both.plain.home())).max() > 1e-4
        close(mapped.read_sensors().q, plain.read_sensors().q)
        close(mapped.read_sensors().effort, plain.read_sensors().effort)

    def test_numbers_that_are_no_efforts(self, both):
        machine = self.machines(both)[1]
        n = len(both.names)
        for data, reason in (
            ([0.0] * (n + 1), "length"),
            ([np.nan] + [0.0] * (n - 1), "not finite"),
        ):
            assert reject(machine.commands, SimpleNamespace(data=data))[0] == reason
        assert machine.braked


def test_the_state_of_the_machine(both):
    """Its joints are those of the URDF: the model's, by the model's names."""
    q, qd, _ = swing(both.plain, 0.3)
    messages = states(both, q, qd)
    cores = MachineState(both.plain), MachineState(both.mapped)
    plain, mapped = (c.joint_state(m, NOW) for c, m in zip(cores, messages, strict=True))
    for name in ("q", "joints", "position", "rotation", "rates", "twist"):
        close(getattr(mapped, name), getattr(plain, name))
    assert cores[1].joint_names == cores[0].joint_names


def test_the_page_that_listens(both):
    live, effort = Live(both.mapped), np.arange(1.0, both.plain.joints_count + 1.0)
    q = random_joints(both.plain, np.random.default_rng(2), 1)[0]
    live.take("state", states(both, q)[1])
    live.take("torque", torques(both, effort))
    live.take("residual", torques(both, 0.1 * effort, NOW))
    heard = live.read_latest()
    assert heard.rejected == 0
    close(heard.q, q)
    close(heard.traces["torque"][1][-1], effort)
    close(heard.traces["residual"][1][-1], 0.1 * effort)


@pytest.mark.parametrize("name", ["delta_cu", "upr_rpu"])
def test_what_a_wrench_does(name):
    both = sides(name)
    q = random_joints(both.plain, np.random.default_rng(3), 1)[0]
    wrench = MAKE.wrench((10.0, -20.0, 30.0, 1.0, 2.0, 3.0), NOW)
    answers = []
    for robot, message in zip((both.plain, both.mapped), states(both, q), strict=True):
        core = Monitor(robot, WrenchSettings())
        core.joint_state(message, NOW)
        answers.append(core.wrench(wrench, NOW))
    close(answers[1].q, answers[0].q)
    close(answers[1].compliance, answers[0].compliance)
    close(answers[1].energy.deflection, answers[0].energy.deflection)


LEAVES = (JOINTS, TRAJECTORY, NUMBER_ARRAY)
"""Messages that can carry joint numbers."""
OTHERS = {
    ("delta_dynamics/nodes/twin.py", "~/joint_trajectory_ff"): "filled with ControllerNumbers",
    ("pkm_twin/state/node.py", "~/joint_states"): "joints of the URDF, which are the model's",
    ("stiffness_monitor/node.py", "~/compliance"): "no joints",
    ("stiffness_monitor/node.py", "~/compliance_stamped"): "no joints",
    ("stiffness_monitor/node.py", "~/strain_energy_stamped"): "no joints",
    ("stiffness_monitor/node.py", "~/natural_frequencies"): "no joints",
    ("stiffness_monitor/node.py", "~/natural_frequencies_stamped"): "no joints",
}


def test_joint_numbers_leave_through_the_publishers_that_ask_for_converted_ones():
    """Who publishes one of these messages in another way has to be on the list, with a reason."""
    tables = {
        "delta_dynamics": (TWIN, GATE, SIMULATION),
        "stiffness_monitor": (STIFFNESS,),
        "pkm_twin": (STATE_TOPICS,),
    }
    found = set()
    for package, own in tables.items():
        rows = [row for table in own for row in table.values()]
        topics = {row.name for row in rows if row.direction == "out" and row.kind in LEAVES}
        paths = (REPOSITORY / package).rglob("*.py")
        for path in (p for p in paths if re.search(r"node.py$|dynamics/nodes/(?!topics)", str(p))):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
            left = {
                argument
                for call in calls
                if ast.unparse(call.func).endswith(
                    ("JointPublisher", "EffortPublisher", "create_guarded_subscription", "defer")
                )
                for argument in call.args
            }
            found |= {
                (str(path.relative_to(REPOSITORY)), node.value)
                for node in ast.walk(tree)
                if isinstance(node, ast.Constant) and node.value in topics and node not in left
            }
    assert found == set(OTHERS)
