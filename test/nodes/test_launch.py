# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The launch files, read everywhere and run where launch is installed.

Running needs what the wheels do not bring: ``ros2 launch``, and this package in a sourced
workspace.
"""

import ast
import contextlib
import os
import re
import signal
import sys
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from delta_dynamics import inverse_dynamics
from pkm_twin import robot_names
from pkm_twin.errors import UnknownNameError
from pkm_twin.machine import rotations
from pkm_twin.robot.robot_urdf import robot_urdf
from pkm_twin.ros.arguments import check_launch_arguments
from test.nodes.harness import REPOSITORY, Command, Maker, Ros
from test.support.mapped import sides
from test.support.robots import load

LAUNCH = REPOSITORY / "launch"
FILES = ("twin", "cell", "control", "view")
NODES = {
    "delta_dynamics": "delta_dynamics/nodes/twin.py",
    "stiffness_monitor": "stiffness_monitor/node.py",
    "command_gate": "delta_dynamics/nodes/gate.py",
    "machine_state": "pkm_twin/state/node.py",
}
SHARED = (
    "pkm_twin/ros/wrench.py",
    "pkm_twin/streams/wrench.py",
    "delta_dynamics/nodes/parameters.py",
    "delta_dynamics/feedforward.py",
)
"""Where nodes declare what they share, and what their settings are."""


def literal(name, variable):
    """A top-level variable of a launch file, f-strings in it as <>."""
    tree = ast.parse((LAUNCH / f"{name}.launch.py").read_text(encoding="utf-8"))
    (value,) = (node.value for node in tree.body if isinstance(node, ast.Assign) and node.targets[0].id == variable)

    class Plain(ast.NodeTransformer):
        def visit_JoinedStr(self, node):
            return ast.copy_location(ast.Constant("<>"), node)

        def visit_Name(self, node):
            return ast.copy_location(ast.Constant(literal(name, node.id)), node)

    return ast.literal_eval(Plain().visit(value))


class TestText:
    """What holds without launch."""

    @pytest.mark.parametrize("name", FILES)
    def test_the_page_lists_every_argument_with_its_default(self, name):
        page = (REPOSITORY / "docs" / "launch.md").read_text(encoding="utf-8")
        listing = page.split(f"**`{name}.launch.py`**")[1].split("\n\n")[1]
        rows = re.findall(r"^\* `(\w+)`(?: \(`(.*?)`\))?:", listing, re.MULTILINE)
        listed = dict(rows)
        assert listed == {key: default for key, (default, _) in literal(name, "ARGUMENTS").items()}

    def test_every_node_has_its_switch_and_knows_its_parameters(self):
        parameters, arguments = literal("twin", "PARAMETERS"), literal("twin", "ARGUMENTS")
        assert set(parameters) == set(NODES) <= set(arguments)
        for node, names in parameters.items():
            files = (NODES[node], *SHARED)
            source = "".join((REPOSITORY / file).read_text(encoding="utf-8") for file in files)
            assert all(re.search(rf"\b{name}\b", source) for name in names)
            assert set(names) <= set(arguments)

    @pytest.mark.parametrize("name", FILES)
    def test_an_argument_that_a_file_lacks_is_rejected_where_the_command_line_names_it(self, monkeypatch, name):
        """A user's own file, which includes it, has arguments of its own."""
        file, declared = str(LAUNCH / f"{name}.launch.py"), literal(name, "ARGUMENTS")
        for words in (["pkm_twin", f"{name}.launch.py"], [file]):
            monkeypatch.setattr(sys, "argv", ["ros2", "launch", *words])
            check_launch_arguments(file, [f"{key}:=x" for key in declared], declared)
            for key in declared:
                with pytest.raises(UnknownNameError) as error:
                    check_launch_arguments(file, [f"{key}:=x", f"{key}x:=y"], declared)
                assert error.value.closest == key
        monkeypatch.setattr(sys, "argv", ["ros2", "launch", "cell", f"{name}.launch.py"])
        check_launch_arguments(file, ["speed:=x"], declared)
        calls = [
            node.func.id
            for node in ast.walk(ast.parse(Path(file).read_text(encoding="utf-8")))
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        ]
        assert "check_launch_arguments" in calls

    def test_what_a_cell_passes_on_a_twin_takes(self):
        assert set(literal("cell", "ARGUMENTS")) - {"machines"} <= set(literal("twin", "ARGUMENTS"))


def why_not(package="pkm_twin"):
    """Why nothing of a package can be launched here, or None."""
    if find_spec("launch_ros") is None or find_spec("ros2launch") is None:
        return "ros2 launch is not installed"
    from ament_index_python.packages import PackageNotFoundError, get_package_prefix

    try:
        get_package_prefix(package)
    except PackageNotFoundError:
        return f"{package} is in no sourced workspace"
    return None


class Launched(Command):
    """``ros2 launch FILE ARGUMENTS``."""

    def __init__(self, domain, name, arguments):
        super().__init__(domain, ["ros2", "launch", str(LAUNCH / f"{name}.launch.py"), *arguments])

    def started(self, node):
        """Process ids of a node, in the order of its starts."""
        pattern = rf"\[{node}-\d+\]: process started with pid \[(\d+)\]"
        return [int(number) for number in re.findall(pattern, self.output)]

    def close(self):
        """As Ctrl-C in a terminal; what the launch leaves behind is killed."""
        super().close()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)


@pytest.mark.skipif(why_not() is not None, reason=str(why_not()))
class TestRunning:
    @pytest.fixture
    def launched(self, domain):
        running = []

        def start(name, *arguments):
            running.append(Launched(domain, name, arguments))
            return running[-1]

        yield start
        for process in running:
            process.close()

    def nodes(self, peer):
        """Nodes that publish what each of them does.

        The middleware's own list of nodes may keep one that has ended: news of its nodes that are
        taken after the news of its end add it again.
        """
        ends = peer.node.get_publishers_info_by_topic("/parameter_events")
        pairs = [(end.node_name, end.node_namespace) for end in ends]
        return sorted(f"{space.rstrip('/')}/{name}" for name, space in pairs if name != "peer")

    def subscribed(self, peer):
        """Topics that a node of the launch subscribes to."""
        return {topic for topic, _ in peer.node.get_topic_names_and_types() if peer.node.count_subscribers(topic)} - {
            "/parameter_events",
            "/rosout",
        }

    def until_nodes(self, peer, process, *names):
        """Wait until exactly these nodes are there."""

        def so():
            assert process.alive(), process.output
            return self.nodes(peer) == sorted(names)

        try:
            peer.until(so)
        except AssertionError as error:
            said = f"{names} are not all: {self.nodes(peer)}\n{process.output}"
            raise AssertionError(said) from error

    def parameter(self, peer, node, name):
        from rcl_interfaces.srv import GetParameters
        from rclpy.parameter import parameter_value_to_python

        request = GetParameters.Request(names=[name])
        answer = peer.call(GetParameters, f"{node}/get_parameters", request)
        return parameter_value_to_python(answer.values[0])

    def test_one_robot_in_both_nodes_by_default(self, launched, peer):
        process = launched("twin")
        self.until_nodes(peer, process, "/delta_dynamics", "/stiffness_monitor")
        for node in ("/delta_dynamics", "/stiffness_monitor"):
            assert self.parameter(peer, node, "mechanism") == "delta_cu"
            assert self.parameter(peer, node, "use_sim_time") is False

    def test_a_namespace_takes_every_topic_along(self, launched, peer):
        process = launched("twin", "namespace:=left", "command_gate:=true", "machine_state:=true", "robot:=prru")
        names = [f"/left/{node}" for node in NODES]
        self.until_nodes(peer, process, *names)
        peer.until(lambda: "/left/wrench" in self.subscribed(peer))
        assert {topic for topic in self.subscribed(peer) if not topic.startswith("/left/")} == set()
        assert "/left/joint_states" in self.subscribed(peer)
        for name in names:
            assert self.parameter(peer, name, "mechanism") == "prru"

    @pytest.mark.parametrize("space", ["", "right"])
    @pytest.mark.parametrize("section", ["/**", "node"])
    @pytest.mark.parametrize("robot", ["", "delta"])
    def test_a_file_goes_before_the_default_and_an_argument_before_the_file(
        self, launched, peer, tmp_path, space, section, robot
    ):
        node = f"/{space}/command_gate".replace("//", "/")
        file = tmp_path / "parameters.yaml"
        parameters = {"mechanism": "prru", "deadline": 0.25}
        key = node if section == "node" else section
        file.write_text(yaml.safe_dump({key: {"ros__parameters": parameters}}))
        # The command line of launch takes no empty values.
        chosen = {"namespace": space, "robot": robot}
        process = launched(
            "twin",
            *(f"{key}:={value}" for key, value in chosen.items() if value),
            f"params_file:={file}",
            "delta_dynamics:=false",
            "stiffness_monitor:=false",
            "command_gate:=true",
        )
        self.until_nodes(peer, process, node)
        assert self.parameter(peer, node, "mechanism") == (robot or "prru")
        assert self.parameter(peer, node, "deadline") == 0.25

    def test_a_killed_node_comes_again_and_so_does_the_gate_in_any_case(self, launched, peer):
        process = launched("twin", "respawn:=false", "stiffness_monitor:=false", "command_gate:=true")
        self.until_nodes(peer, process, "/delta_dynamics", "/command_gate")
        (gate,) = process.started("command_gate")
        os.kill(gate, signal.SIGKILL)
        peer.until(lambda: len(process.started("command_gate")) == 2)
        (dynamics,) = process.started("delta_dynamics")
        os.kill(dynamics, signal.SIGKILL)
        peer.until(lambda: f"process has died [pid {dynamics}, exit code -9" in process.output)
        self.until_nodes(peer, process, "/command_gate")
        assert len(process.started("delta_dynamics")) == 1

    def test_respawn_is_the_default(self, launched, peer):
        process = launched("twin", "stiffness_monitor:=false")
        self.until_nodes(peer, process, "/delta_dynamics")
        os.kill(process.started("delta_dynamics")[0], signal.SIGKILL)
        peer.until(lambda: len(process.started("delta_dynamics")) == 2)

    def test_the_log_level_is_passed_on(self, launched, peer):
        process = launched("twin", "stiffness_monitor:=false", "log_level:=error")
        self.until_nodes(peer, process, "/delta_dynamics")
        peer.until(lambda: "/joint_states" in self.subscribed(peer))
        assert "robot delta_cu" not in process.output

    def test_a_cell_keeps_its_machines_apart(self, launched, peer):
        process = launched("cell", "machines:=a=delta_cu,b=prru")
        names = [f"/{space}/{node}" for space in "ab" for node in list(NODES)[:2]]
        self.until_nodes(peer, process, *names)
        both = {f"/{space}/joint_states" for space in "ab"}
        peer.until(lambda: both <= self.subscribed(peer))
        assert "/joint_states" not in self.subscribed(peer)
        assert self.parameter(peer, "/a/delta_dynamics", "mechanism") == "delta_cu"
        assert self.parameter(peer, "/b/delta_dynamics", "mechanism") == "prru"
        assert self.parameter(peer, "/b/stiffness_monitor", "mechanism") == "prru"

    @pytest.mark.skipif(why_not("robot_state_publisher") is not None, reason="robot_state_publisher is missing")
    @pytest.mark.parametrize("space", ["", "left"])
    @pytest.mark.parametrize("robot", robot_names())
    def test_every_link_stands_in_one_tree(self, launched, peer, robot, space):
        """robot_state_publisher finds every joint, and the platform stands where the twin says."""
        from rclpy.time import Time
        from sensor_msgs.msg import JointState
        from tf2_ros import Buffer, TransformListener

        model = load(robot)
        q = model.inverse(model.home())
        position, rotation = model.platform(q)
        links = {element.get("name") for element in ElementTree.fromstring(robot_urdf(model)) if element.tag == "link"}
        prefix = f"{space}/" if space else ""
        chosen = [f"namespace:={space}"] if space else []
        process = launched("view", f"robot:={robot}", "rviz:=false", *chosen)
        buffer = Buffer()
        listener = TransformListener(buffer, peer.node)
        topic = f"/{prefix}joint_states"
        peer.talk(JointState, topic)
        message = Maker(Ros()).joint_state

        def connected():
            assert process.process.poll() is None, process.output
            now = Time()
            names = [f"{prefix}{link}" for link in (*links, "tool0")]
            return all(buffer.can_transform(f"{prefix}base_link", name, now) for name in names)

        def send():
            peer.send(topic, message(model.joint_names, q, stamp=peer.now()))

        peer.until(connected, repeat=send)
        found = buffer.lookup_transform(f"{prefix}base_link", f"{prefix}platform", Time()).transform
        at, turn = found.translation, found.rotation
        assert np.allclose([at.x, at.y, at.z], position, atol=1e-9)
        turned = rotations.from_quaternion(turn.x, turn.y, turn.z, turn.w)
        assert np.allclose(turned, rotation, atol=1e-9)
        listener.unregister()

    @pytest.mark.skipif(why_not("controller_manager") is not None, reason="no ros2_control")
    @pytest.mark.parametrize(("space", "mapped"), [("", False), ("left", True)])
    def test_a_controller_gets_the_efforts_of_a_goal(self, launched, peer, tmp_path, space, mapped):
        """Through the twin's action to joint_trajectory_controller on mock hardware.

        ``mapped``: names, signs, ratios and offsets of the controller are its own.
        """
        from action_msgs.msg import GoalStatus
        from control_msgs.action import FollowJointTrajectory
        from control_msgs.msg import JointTrajectoryControllerState
        from rclpy.action import ActionClient
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from std_msgs.msg import String

        from test.nodes.twin import ROBOT, trajectory

        prefix = f"/{space}".rstrip("/")
        both = sides(ROBOT.name)
        robot = both.mapped if mapped else ROBOT
        given = both.write(tmp_path) if mapped else ROBOT.name
        description = robot_urdf(robot)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        publisher = peer.node.create_publisher(String, f"{prefix}/robot_description", latched)
        publisher.publish(String(data=description))
        state = f"{prefix}/joint_trajectory_controller/controller_state"
        peer.hear(JointTrajectoryControllerState, state)
        action = f"{prefix}/delta_dynamics/follow_joint_trajectory"
        client = ActionClient(peer.node, FollowJointTrajectory, action)
        chosen = [f"namespace:={space}"] if space else []
        process = launched("control", f"robot:={given}", "robot_state_publisher:=false", *chosen)

        def ready():
            assert process.alive(), process.output
            return client.server_is_ready() and peer.received(state)

        try:
            peer.until(ready)
            home = ROBOT.graph.home
            start = np.array(peer.received(state)[-1].feedback.positions)
            right = both.positions(home) if mapped else home
            np.testing.assert_allclose(start, right, 1e-12, 1e-12)
            peer.received(state).clear()
            sent = trajectory(count=20)
            # The controller takes none that does not end at rest.
            sent.points[-1].velocities = [0.0] * robot.joints_count
            rows = [(p.positions, p.velocities, p.accelerations) for p in sent.points]
            q, qd, qdd = (np.array(values) for values in zip(*rows, strict=True))
            controller = robot.controller
            sent.joint_names = list(controller.names)
            for point, row in zip(sent.points, zip(q, qd, qdd, strict=True), strict=True):
                point.positions = controller.controller_positions(row[0]).tolist()
                point.velocities = controller.controller_rates(row[1]).tolist()
                point.accelerations = controller.controller_rates(row[2]).tolist()

            def answer():
                goal = client.send_goal_async(FollowJointTrajectory.Goal(trajectory=sent))
                peer.until(goal.done)
                result = goal.result().get_result_async()
                peer.until(result.done)
                return result.result()

            last = answer()
            # The node may see the controller later than this process does.
            while last.result.error_string.startswith("no action server"):
                last = answer()
            assert last.status == GoalStatus.STATUS_SUCCEEDED, last.result.error_string
            efforts = inverse_dynamics(ROBOT, q, qd, qdd)
            least = 1e-4 * np.abs(efforts).max()

            def outputs():
                found = np.array([m.output.effort for m in peer.received(state)])
                return found * both.factors if mapped else found

            # The last point accelerates: what bears the weight where the mock hardware stands
            # takes its place.
            weight = inverse_dynamics(ROBOT, home, 0 * home, 0 * home)
            peer.until(lambda: np.abs(outputs()[-1] - weight).max() < least)
            moving = outputs()[np.abs(outputs()).max(1) > 0.0]
            moving = moving[np.abs(moving - weight).max(1) > least]
            assert len(moving) > 5
            # The controller interpolates between the points.
            a, d = efforts[:-1], np.diff(efforts, axis=0)
            away = moving[:, None] - a
            share = np.clip((away * d).sum(-1) / (d * d).sum(-1), 0.0, 1.0)
            assert (np.linalg.norm(away - share[..., None] * d, axis=-1).min(1) < least).all()
        finally:
            client.destroy()
            peer.node.destroy_publisher(publisher)

    @pytest.mark.parametrize(
        ("name", "argument", "said"),
        [
            ("twin", "params_file:=/no/such.yaml", "params_file: '/no/such.yaml' is no file"),
            ("twin", "robot:=nope", "nope"),
            ("cell", "machines:=a=nope", "nope"),
            ("twin", "respawn:=maybe", "respawn: 'maybe' is neither true nor false"),
            ("cell", "machines:=a", "machines: 'a' is not NAMESPACE=ROBOT"),
            ("cell", "machines:=a=delta,a=prru", "two share a namespace"),
            *((name, "robto:=delta", "unknown launch argument 'robto'") for name in FILES),
        ],
    )
    def test_a_bad_argument_is_refused_by_name(self, launched, name, argument, said):
        process = launched(name, argument)
        assert process.wait() == 1
        assert said in process.output

    @pytest.mark.parametrize("key", ["/**", "/left/delta_dynamics", "left"])
    def test_torques_that_the_gate_would_never_get_are_refused(self, launched, tmp_path, key):
        """The middleware connects nobody to a topic whose deadline is longer than demanded."""
        file = tmp_path / "parameters.yaml"
        parameters = {"ros__parameters": {"stale_after": 0.2}}
        section = {"delta_dynamics": parameters} if key == "left" else parameters
        file.write_text(yaml.safe_dump({key: section}))
        arguments = ["namespace:=left", f"params_file:={file}", "stiffness_monitor:=false"]
        process = launched("twin", *arguments, "command_gate:=true")
        assert process.wait() == 1
        assert "stale_after 0.2 s" in process.output and "deadline 0.1 s" in process.output

    def test_a_node_that_refuses_its_configuration_is_not_started_for_ever(self, launched, peer, tmp_path):
        file = tmp_path / "parameters.yaml"
        file.write_text(yaml.safe_dump({"/**": {"ros__parameters": {"stale_aftr": 0.2}}}))
        process = launched("twin", f"params_file:={file}", "stiffness_monitor:=false")
        peer.until(lambda: "not started again" in process.output)
        assert len(process.started("delta_dynamics")) == 4

    def test_composed_nodes_share_a_process_and_have_their_own_parameters(self, launched, peer, tmp_path):
        file = tmp_path / "parameters.yaml"
        sections = {
            "/left/delta_dynamics": {"ros__parameters": {"stale_after": 0.05}},
            "/left/machine_state": {"ros__parameters": {"rate": 50.0}},
        }
        file.write_text(yaml.safe_dump(sections))
        process = launched(
            "twin",
            "namespace:=left",
            "composed:=true",
            "command_gate:=true",
            "machine_state:=true",
            "joint_states:=measured",
            f"params_file:={file}",
        )
        self.until_nodes(peer, process, *(f"/left/{node}" for node in NODES))
        assert len(process.started("composed")) == len(process.started("command_gate")) == 1
        assert self.parameter(peer, "/left/delta_dynamics", "stale_after") == 0.05
        assert self.parameter(peer, "/left/machine_state", "rate") == 50.0
        assert self.parameter(peer, "/left/machine_state", "mechanism") == "delta_cu"
        peer.until(lambda: "/left/measured" in self.subscribed(peer))
        assert "/left/joint_states" not in self.subscribed(peer)
        os.kill(process.started("composed")[0], signal.SIGKILL)
        peer.until(lambda: len(process.started("composed")) == 2)

    def test_ctrl_c_ends_all_of_it_cleanly(self, launched, peer):
        process = launched("twin", "command_gate:=true", "machine_state:=true")
        self.until_nodes(peer, process, *(f"/{node}" for node in NODES))
        process.process.send_signal(signal.SIGINT)
        process.wait()
        assert process.output.count("process has finished cleanly") == 4
        assert "Traceback" not in process.output
