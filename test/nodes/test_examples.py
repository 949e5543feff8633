# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The examples, run as they are against machine_sim in processes of their own."""

import importlib
import re

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", exc_type=ImportError)

from std_msgs.msg import Float64MultiArray

from delta_dynamics import inverse_dynamics
from pkm_twin.machine.machine_yaml import describe_machine_yaml
from pkm_twin.robot.urdf_read import read_urdf
from test.nodes.harness import REPOSITORY
from test.support.mapped import sides
from test.support.robots import load, parameters_of

EXAMPLES = REPOSITORY / "examples"
SIM = "delta_dynamics.nodes.simulation"
ROBOT = load("delta_cu")
PATIENCE = 120.0
SIM_TIME = "use_sim_time:=true"


def example(launch, name, *words, **options):
    return launch(None, *options.pop("parameters", ()), script=[EXAMPLES / name, *words], **options)


def numbers(text):
    return [float(word) for word in re.findall(r"-?\d+\.?\d*(?:e[+-]\d+)?", text)]


@pytest.fixture(scope="module")
def twin_and_machine(launch):
    """Both nodes, until the module's end."""
    return (
        launch(SIM, "clock:=simulated", "real_time_factor:=5.0"),
        launch("delta_dynamics.nodes.twin"),
    )


def test_a_robot_without_limits_has_a_way_to_go_too(tmp_path, monkeypatch):
    """Limits are optional in a file, joint by joint."""
    monkeypatch.syspath_prepend(EXAMPLES)
    client = importlib.import_module("trajectory_client")
    np.testing.assert_allclose(client.choose_travel(ROBOT, 0.1), 0.22)
    data = parameters_of("five_bar")
    _, (low, high) = load("five_bar").limits.position
    for expected in ([1.0, high - low], [1.0, 1.0]):
        joint = next(joint for joint in data["joints"].values() if "limits" in joint)
        del joint["limits"]
        path = tmp_path / "free.yaml"
        path.write_text(yaml.safe_dump(data, sort_keys=False))
        np.testing.assert_allclose(client.choose_travel(load(path), 0.1), 0.1 * np.array(expected))


@pytest.mark.parametrize("name", ["trajectory_client.py", "computed_torque.py"])
def test_what_an_example_cannot_go_with_is_one_line(launch, name):
    process = example(launch, name, "--robot", "none")
    assert process.wait(PATIENCE) == 1
    assert "Traceback" not in process.output and "none" in process.output.splitlines()[-1]


class TestComputedTorque:
    """In lockstep, so that a loaded machine closes the same loop."""

    @pytest.fixture(autouse=True)
    def commands(self, peer):
        peer.hear(Float64MultiArray, "/machine_sim/commands")
        return peer.received("/machine_sim/commands")

    def test_it_follows_a_machine_that_is_one_percent_another(self, launch_alone, peer, commands, tmp_path):
        """One whose controller has other names and numbers for the joints."""
        robot = sides("delta_cu").write(tmp_path)
        kinds = "spread_kinds:=[masses, inertias, friction]"
        # Silence is of the wall's time, which a loaded machine has little of.
        controller = example(
            launch_alone,
            "computed_torque.py",
            "--deadline",
            "60",
            "--seconds",
            "0.8",
            "--robot",
            str(robot),
            parameters=(SIM_TIME,),
        )
        # Its whole path takes a second or two: who is to hear it has to be there before.
        peer.until(lambda: peer.node.count_publishers("/machine_sim/commands"))
        sim = launch_alone(SIM, f"mechanism:={robot}", "clock:=lockstep", "spread:=0.01", kinds)
        peer.until(lambda: not controller.alive(), PATIENCE)
        assert controller.wait() == 0, controller.output
        samples, worst = numbers(controller.output.splitlines()[-1])
        assert samples == 801
        assert worst < 1e-3
        peer.until(lambda: commands and list(commands[-1].data) == [0.0] * 3)
        assert any(any(c.data) for c in commands)
        assert sim.stop() == 0

    def test_an_ankle_follows_in_roll_and_pitch(self, launch_alone, peer, commands, tmp_path):
        path = tmp_path / "ankle.yaml"
        part = {"base": "shank", "platform": "foot", "carry": True}
        with pytest.warns(match="toes"):
            data = read_urdf(EXAMPLES / "humanoid.xml", **part)
        path.write_text(describe_machine_yaml(data))
        controller = example(
            launch_alone,
            "ankle.py",
            "--deadline",
            "60",
            "--robot",
            str(path),
            parameters=(SIM_TIME,),
        )
        peer.until(lambda: peer.node.count_publishers("/machine_sim/commands"), PATIENCE)
        sim = launch_alone(SIM, f"mechanism:={path}", "clock:=lockstep")
        peer.until(lambda: not controller.alive(), PATIENCE)
        assert controller.wait() == 0, controller.output
        samples, worst = numbers(controller.output.splitlines()[-1])
        assert samples == 1001 and worst < 5e-3
        assert any(any(c.data) for c in commands)
        assert sim.stop() == 0

    def test_a_machine_that_falls_silent_stops_it_with_zeros(self, launch_alone, peer, commands):
        sim = launch_alone(SIM, "clock:=lockstep")
        controller = example(
            launch_alone,
            "computed_torque.py",
            "--deadline",
            "2",
            "--seconds",
            "1000",
            parameters=(SIM_TIME,),
        )
        peer.until(lambda: len(commands) > 50 and any(any(c.data) for c in commands), PATIENCE)
        assert controller.alive()
        sim.process.kill()
        peer.until(lambda: not controller.alive(), PATIENCE)
        assert controller.wait() == 1, controller.output
        assert "stopped: no joint state for" in controller.output
        peer.until(lambda: list(commands[-1].data) == [0.0] * 3)


class TestByTheTwin:
    """Trajectories that the twin has filled with effort."""

    @pytest.fixture(autouse=True)
    def nodes(self, twin_and_machine):
        assert all(process.alive() for process in twin_and_machine)

    def test_the_trajectory_client_reaches_its_goal_with_the_twin_s_efforts(self, launch):
        client = example(launch, "trajectory_client.py")
        assert client.wait(PATIENCE) == 0, client.output
        points, *peak, miss = numbers(client.output)
        q = ROBOT.inverse(ROBOT.home())
        x = np.linspace(0.0, 1.0, 101)
        way = np.array([6.0, -15.0, 10.0, 0.0, 0.0, 0.0])
        rows = [np.outer(np.polyval(np.polyder(way, k), x), np.full(3, 0.22)) for k in range(3)]
        expected = np.abs(inverse_dynamics(ROBOT, q + rows[0], *rows[1:])).max(0)
        assert points == 101
        assert np.abs(np.array(peak) - expected).max() < 5e-3 * expected.max()
        assert miss < 1e-4
