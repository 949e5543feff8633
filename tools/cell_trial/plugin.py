# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The exported controller under joint_trajectory_controller: its efforts compared with the twin's.

    python3 tools/cell_trial/plugin.py [--robot delta_cu] [--bandwidth 2] [PART ...]

``mock``: mock hardware, which does not move. ``sim``: machine_sim in lockstep, through the hardware
in tools/cell_trial/topic_hardware. Of both, the references that the controller has followed go to a
running delta_dynamics as a JointTrajectory, and its efforts are compared with the controller's.
``beyond``: mock hardware, and a trajectory through a position limit: the controller holds, and
after its hold_time the chain is deactivated and the gravity controller carries the machine, with a
payload that was set at run time. ``fall``: the same with machine_sim, which moves. ``lost``: with
machine_sim, a velocity and then a position of one joint become NaN, and good again. ``killed``:
``kill -9`` of the manager. ``twin``: without the plugin, the trajectory goes through
delta_dynamics, and the controller's effort is compared with the model's along it.

Needs a sourced Jazzy workspace with pkm_twin, ros2_control, joint_trajectory_controller and the
package that ``pkm-twin export ros2-control ROBOT`` wrote; for ``sim``, ``fall`` and ``lost`` also
pkm_topic_hardware.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from ament_index_python.packages import get_package_share_directory
from builtin_interfaces.msg import Duration
from cell import Peer, Process, closing, node, peer
from control_msgs.msg import JointTrajectoryControllerState
from controller_manager_msgs.srv import SwitchController
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from delta_dynamics import inverse_dynamics
from delta_dynamics.simulation.machine import tune_position_control
from pkm_twin import Robot, load
from pkm_twin.export.ros2_control import CONTROLLER, GRAVITY_CONTROLLER, TRAJECTORY_CONTROLLER, package_name
from pkm_twin.robot.effort_limits import effort_limits

MOCK = "mock_components/GenericSystem"
TOPICS = "pkm_topic_hardware/TopicSystem"
KINDS = ("positions", "velocities", "accelerations")
HARDWARE = {
    "mock": MOCK,
    "sim": TOPICS,
    "beyond": MOCK,
    "fall": TOPICS,
    "lost": TOPICS,
    "killed": MOCK,
    "twin": MOCK,
}
ADDED_PAYLOAD = 0.5
"""Payload added at run time, kg."""


def to_duration(seconds: float) -> Duration:
    """Convert seconds to a Duration message."""
    sec, nanosec = divmod(round(seconds * 1e9), 10**9)
    return Duration(sec=sec, nanosec=nanosec)


def trajectory(names: list[str], times: Any, *columns: Any) -> JointTrajectory:
    """Make a trajectory message of positions, velocities and accelerations (points, n)."""
    points = [
        JointTrajectoryPoint(
            positions=q.tolist(),
            velocities=qd.tolist(),
            accelerations=qdd.tolist(),
            time_from_start=to_duration(float(t)),
        )
        for t, q, qd, qdd in zip(times, *columns, strict=True)
    ]
    return JointTrajectory(joint_names=names, points=points)


def there_and_back(robot: Robot, start: Any, seconds: float) -> JointTrajectory:
    """Return a motion over a tenth of the range, there and back, in the controller's values."""
    limits = robot.limits.position
    size = 0.1 * (1.0 if limits is None else float(np.ptp(limits, axis=1).min()))
    toward = np.ones(len(start)) if limits is None else np.sign(limits.mean(1) - start)
    aim = np.where(toward == 0.0, 1.0, toward) * size * robot.controller.factors
    t = np.linspace(0.0, 1.0, 201)
    w = 6.0 * np.pi
    # Begins and ends at rest: a quintic of the phase.
    phase = t**3 * (10.0 - 15.0 * t + 6.0 * t**2)
    rate = 30.0 * t**2 * (1.0 - t) ** 2
    second = 60.0 * t * (1.0 - t) * (1.0 - 2.0 * t)
    shape = (1.0 - np.cos(w * phase)) / 2.0
    first = w / 2.0 * np.sin(w * phase) * rate / seconds
    twice = w / 2.0 * (w * np.cos(w * phase) * rate**2 + np.sin(w * phase) * second) / seconds**2
    home = robot.controller.controller_positions(start)
    return trajectory(
        list(robot.controller.names),
        0.05 + seconds * t,
        home + np.outer(shape, aim),
        np.outer(first, aim),
        np.outer(twice, aim),
    )


class Chain:
    """joint_trajectory_controller in front of the exported controller, by the launch file."""

    def __init__(self, other: Peer, given: str, part: str, bandwidth: float) -> None:
        self.other, self.robot, self.part = other, load(given), part
        self.bandwidth = bandwidth
        use, source, target = (
            ("twin", TRAJECTORY_CONTROLLER, "delta_dynamics")
            if part == "twin"
            else ("plugin", CONTROLLER, TRAJECTORY_CONTROLLER)
        )
        self.states = other.hear(JointTrajectoryControllerState, f"/{source}/controller_state", 50000)
        self.fallen = other.hear(JointTrajectoryControllerState, f"/{GRAVITY_CONTROLLER}/controller_state", 50000)
        self.hardware = other.hear(JointState, "/joint_states", 50000)
        self.counts = other.hear(DiagnosticArray, "/diagnostics", 1000)
        self.send = other.node.create_publisher(JointTrajectory, f"/{target}/joint_trajectory", QoSProfile(depth=10))
        simulated = HARDWARE[part] == TOPICS
        settings = [f"controllers:={self._write_lockstep_settings()}"] if simulated else []
        self.process = Process(
            "ros2",
            "launch",
            "pkm_twin",
            "control.launch.py",
            f"robot:={given}",
            f"use:={use}",
            f"hardware_plugin:={HARDWARE[part]}",
            f"bandwidth:={bandwidth}",
            *settings,
        )

    def _write_lockstep_settings(self) -> Path:
        """Write the package's settings with simulated time, one command per 5 ms of /clock."""
        share = Path(get_package_share_directory(package_name(self.robot)))
        sections = yaml.safe_load((share / "config" / "controllers.yaml").read_text())
        sections["/**/joint_state_broadcaster"] = {"ros__parameters": {}}
        for section in sections.values():
            section["ros__parameters"]["use_sim_time"] = True
        sections["/**/controller_manager"]["ros__parameters"]["update_rate"] = 200
        file = Path(tempfile.mkdtemp()) / "controllers.yaml"
        file.write_text(yaml.safe_dump(sections))
        return file

    def start(self) -> Any:
        """Wait for both controllers; return the model's joint positions."""
        self.other.until(lambda: self.states, lambda: f"the controller\n{self.process.output}")
        self.other.until(self.send.get_subscription_count, "who takes trajectories")
        # The controllers become active one after the other.
        self.other.spin(5.0)
        found, home = np.array(self.last.feedback.positions), self.robot.graph.home
        miss = np.abs(found - self.robot.controller.controller_positions(home)).max()
        print(f"{self.part}: starts at {found.round(6).tolist()}, {miss:.1e} from home")
        return self.robot.controller.positions(found)

    def go(self, motion: JointTrajectory) -> None:
        """Send a trajectory and wait until it begins."""
        self.states.clear()
        self.send.publish(motion)
        self.other.until(lambda: self.states and any(self.last.reference.velocities), "motion")

    @property
    def last(self) -> Any:
        """The last controller state."""
        return self.states[-1]

    def followed(self) -> list[Any]:
        """Send a motion there and back; return the controller states."""
        self.go(there_and_back(self.robot, self.start(), 4.0))
        self.other.spin(5.0)
        self.other.until(lambda: not any(self.last.reference.velocities), "the motion's end")
        self.other.spin(1.5)
        self.report()
        return [s for s in self.states if any(s.reference.velocities)]

    def through_the_twin(self) -> None:
        """Send a motion there and back through delta_dynamics."""
        robot = self.robot
        motion = there_and_back(robot, self.start(), 4.0)
        self.go(motion)
        self.other.spin(5.0)
        found = np.array([s.output.effort for s in self.states if any(s.reference.velocities)])
        columns = [np.array([getattr(p, name) for p in motion.points]) for name in KINDS]
        rates = robot.controller.rates
        model = inverse_dynamics(robot, robot.controller.positions(columns[0]), *map(rates, columns[1:]))
        right = robot.controller.controller_efforts(model)
        # The controller interpolates efforts between points.
        a, d = right[:-1], np.diff(right, axis=0)
        away = found[:, None] - a
        share = np.clip((away * d).sum(-1) / np.maximum((d * d).sum(-1), 1e-300), 0.0, 1.0)
        error = np.linalg.norm(away - share[..., None] * d, axis=-1).min(1).max()
        print(
            f"twin: {len(found)} states of the motion, effort less that of the model {error:.2e} "
            f"at most, {error / np.abs(right).max():.1e} of the peak; efforts at their peaks "
            f"{[right[k, j].round(5).item() for j, k in enumerate(np.abs(right).argmax(0))]}"
        )

    def set_parameter(self, name: str, parameter: str, value: Any) -> None:
        """Set a parameter of a node."""
        client = self.other.node.create_client(SetParameters, f"/{name}/set_parameters")
        given = Parameter(parameter, value=value).to_parameter_msg()
        answer = self._call(client, SetParameters.Request(parameters=[given]))
        if not answer.results[0].successful:
            raise RuntimeError(answer.results[0].reason)

    def _call(self, client: Any, request: Any) -> Any:
        self.other.until(client.service_is_ready, f"service {client.srv_name}")
        future = client.call_async(request)
        self.other.until(future.done, f"answer of {client.srv_name}")
        return future.result()

    def compare_control(self, states: list[Any]) -> None:
        """Compare commands with feedforward plus PD within the limits, of the same updates."""
        robot, scale = self.robot, self.robot.controller.factors**2
        p, d = (gains / scale for gains in tune_position_control(robot, self.bandwidth))
        limits = np.abs(robot.controller.controller_efforts(effort_limits(robot)))
        rows = [
            np.array([values(s) for s in states])
            for values in (
                lambda s: s.reference.effort,
                lambda s: s.error.positions,
                lambda s: s.error.velocities,
                lambda s: s.output.effort,
            )
        ]
        wanted = rows[0] + p * rows[1] + d * rows[2]
        beyond = int((np.abs(wanted) > limits).any(1).sum())
        error = np.abs(rows[3] - np.clip(wanted, -limits, limits)).max()
        part = np.abs(wanted - rows[0]).max()
        print(
            f"{self.part}: {len(states)} states, gains of {self.bandwidth:g} Hz: PD up to "
            f"{part:.3g}, limited in {beyond} states; command less feedforward, PD and limits "
            f"{error:.1e} at most"
        )

    def compare_gravity(self, what: str) -> None:
        """Compare the gravity controller's commands with weight and damping at what is measured."""
        robot = self.robot
        share = Path(get_package_share_directory(package_name(robot)))
        sections = yaml.safe_load((share / "config" / "controllers.yaml").read_text())
        gains = sections[f"/**/{GRAVITY_CONTROLLER}"]["ros__parameters"]["gains"]
        d = np.array([gains[name]["d"] for name in robot.controller.names])
        states = [s for s in self.fallen if np.isfinite(s.feedback.positions).all()]
        columns = [np.array([getattr(s.feedback, k) for s in states]) for k in KINDS[:2]]
        at, still = robot.controller.positions(columns[0]), np.zeros_like(columns[0])
        weight = robot.controller.controller_efforts(inverse_dynamics(robot, at, still, still))
        carried = np.array([s.output.effort for s in states])
        error = np.abs(carried - (weight - d * np.nan_to_num(columns[1]))).max()
        lost = int(np.isnan(columns[1]).any(1).sum())
        print(
            f"{self.part}: {what}: {GRAVITY_CONTROLLER}, {len(states)} states, {lost} of them without a "
            f"velocity: effort {carried[-1].tolist()}, less weight and damping at what is measured "
            f"{error:.1e} at most; moved {np.abs(at - at[0]).max():.1e}"
        )

    def beyond(self) -> None:
        """Send a trajectory through the position limit of the first joint, with another payload."""
        start, load = self.start(), self.robot.payload
        self.set_parameter(CONTROLLER, "payload.mass", load.mass + ADDED_PAYLOAD)
        self.robot = robot = self.robot.changed(
            payload={
                "mass": load.mass + ADDED_PAYLOAD,
                "com": load.com.tolist(),
                "inertia": load.inertia.tolist(),
            }
        )
        aim = np.array(start)
        aim[0] = robot.limits.position[0, 1] + 0.2 * np.ptp(robot.limits.position[0])
        end, rest = robot.controller.controller_positions(aim)[None], np.zeros((1, len(start)))
        self.go(trajectory(list(robot.controller.names), [4.0], end, rest, rest))
        self.other.until(lambda: not any(self.last.reference.velocities), "the hold")
        held = robot.controller.positions(np.array(self.last.reference.positions))
        weight = inverse_dynamics(robot, held, 0.0 * held, 0.0 * held)
        found = robot.controller.efforts(np.array(self.last.reference.effort))
        print(
            f"{self.part}: held {robot.limits.position[0, 1] - held[0]:.1e} before the limit, "
            f"feedforward less that of the weight {np.abs(found - weight).max():.1e}, 1 state"
        )
        self.fallen.clear()
        self.hardware.clear()
        self.other.until(lambda: self.fallen, GRAVITY_CONTROLLER)
        self.other.spin(3.0)
        self.report()
        self.compare_gravity(f"payload {ADDED_PAYLOAD:g} kg more at {CONTROLLER} alone")
        idle = [m for m in self.hardware if not any(m.effort)]
        print(f"{self.part}: {len(idle)} of {len(self.hardware)} joint states have no effort")
        said = [line for line in self.process.output.splitlines() if "hold_time" in line]
        print(f"{self.part}: log: {said}")

    def lost(self) -> None:
        """Set the velocity, then the position of the first joint to NaN, and back."""
        self.start()
        self.other.spin(1.0)
        self.compare_control(self.states)
        for what, seconds in (("velocity", 3.0), ("position", 0.0)):
            self.fallen.clear()
            self.set_parameter("topic_system", "lost", what)
            self.other.until(lambda: self.fallen, GRAVITY_CONTROLLER)
            self.other.spin(seconds)
            if seconds:
                self.compare_gravity(f"{what} lost")
        before = len(self.fallen)
        self.other.spin(2.0)
        blind = [s for s in self.fallen[1:] if not np.isfinite(s.feedback.positions).all()]
        efforts = np.array([s.output.effort for s in blind])
        print(
            f"{self.part}: position lost: {len(blind)} of {len(self.fallen)} states, {before} at "
            f"once; effort changes by {np.ptp(efforts, axis=0).max():.1e}, then "
            f"{list(self.hardware[-1].effort)}"
        )
        self.set_parameter("topic_system", "lost", "")
        self.fallen.clear()
        client = self.other.node.create_client(SwitchController, "/controller_manager/switch_controller")
        request = SwitchController.Request(activate_controllers=[GRAVITY_CONTROLLER], strictness=2)
        print(f"{self.part}: activated again: {self._call(client, request).ok}")
        self.other.until(lambda: self.fallen, GRAVITY_CONTROLLER)
        self.other.spin(1.0)
        self.compare_gravity("position good again")

    def killed(self) -> None:
        """``kill -9`` of the manager."""
        self.start()
        group = str(self.process.process.pid)
        found = _output("pgrep", "-g", group, "-f", "lib/controller_manager/ros2_control_node")
        for number in found.split():
            os.kill(int(number), signal.SIGKILL)
        self.other.until(lambda: not self.process.alive(), "the launch's end")
        print(f"killed: the launch ended with exit code {self.process.process.returncode}")

    def report(self) -> None:
        """Print the last diagnostics of the controller and of machine_sim."""
        for name in (": feedforward", "machine_sim"):
            mine = [s for m in self.counts for s in m.status if s.name.endswith(name)]
            if mine:
                text = ", ".join(f"{v.key} {v.value}" for v in mine[-1].values)
                print(f"{self.part}: {mine[-1].message}; {text}")


def _output(*command: str) -> str:
    """Run a command, and return what it prints."""
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def twin_s_efforts(other: Peer, robot: Robot, given: str, states: list[Any]) -> Any:
    """Return the efforts of a running delta_dynamics for the references of states, (count, n)."""
    answers = other.hear(JointTrajectory, "/delta_dynamics/joint_trajectory_ff", 10)
    send = other.node.create_publisher(JointTrajectory, "/delta_dynamics/joint_trajectory", QoSProfile(depth=10))
    references = [s.reference for s in states]
    columns = [np.array([getattr(r, name) for r in references]) for name in KINDS]
    # Only rising times are needed, as each point has its own efforts.
    message = trajectory(list(robot.controller.names), 1e-3 * np.arange(1, len(states) + 1), *columns)
    with closing(node("delta_dynamics", parameters=[f"mechanism:={given}"])):
        other.until(send.get_subscription_count, "delta_dynamics")
        other.spin(1.0)
        send.publish(message)
        other.until(lambda: answers, "the twin's efforts")
    return np.array([p.effort for p in answers[-1].points])


def show(other: Peer, given: str, part: str, bandwidth: float) -> None:
    """Run one part of the trial."""
    robot, simulated = load(given), []
    moves = HARDWARE[part] == TOPICS
    if moves:
        simulated.append(
            node(
                "machine_sim",
                parameters=[f"mechanism:={given}", "period:=0.005", "clock:=lockstep"],
                remap=["joint_states:=/machine_sim/joint_states"],
            )
        )
    with closing(*simulated):
        # Mock hardware does not follow: the gains push against it, up to the limits.
        chain = Chain(other, given, part, bandwidth)
        with closing(chain.process):
            alone = {
                "twin": chain.through_the_twin,
                "beyond": chain.beyond,
                "fall": chain.beyond,
                "lost": chain.lost,
                "killed": chain.killed,
            }
            if part in alone:
                alone[part]()
                return
            states = chain.followed()
            chain.compare_control(states)
    found = np.array([s.reference.effort for s in states])
    right = twin_s_efforts(other, robot, given, states)
    error = np.abs(found - right).max()
    print(
        f"{part}: {len(states)} states of the motion, effort less that of delta_dynamics "
        f"{error:.2e} at most, {error / np.abs(right).max():.1e} of the peak"
    )
    if part == "sim":
        miss = np.array([s.error.positions for s in states]) / robot.controller.factors
        for unit in dict.fromkeys(robot.joint_units):
            rows = miss[:, np.array(robot.joint_units) == unit]
            print(
                f"sim: tracking error {np.sqrt((rows**2).mean()):.2e} {unit} RMS, "
                f"{rows.shape[1]} joints in {len(rows)} states, gains of {bandwidth:g} Hz"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("parts", nargs="*", default=list(HARDWARE), help=", ".join(HARDWARE))
    parser.add_argument("--robot", default="delta_cu", help="name or path")
    parser.add_argument("--bandwidth", type=float, default=2.0, help="Hz, of the gains for sim")
    given = parser.parse_args()
    with peer() as other:
        for part in given.parts:
            show(other, given.robot, part, given.bandwidth)


if __name__ == "__main__":
    main()
