# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute the state of the whole machine from joint states, for the node ``machine_state``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.errors import MessageError
from pkm_twin.kinematics.passive import moving_state_program, state_program
from pkm_twin.messages.reading import JointSample, WrenchSample, as_message_error
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.monitor import Pace
from pkm_twin.streams.topics import JOINTS, TEXT, WRENCH, Topic, table
from pkm_twin.streams.wrench import Mount, TimeCache, TimeSynchronizer, check_order

_TRANSFORM_TYPE: Final = "tf2_msgs/TFMessage"

STATE_TOPICS: Final = table(
    Topic("in", "joint_states", JOINTS, "positions, and velocities where present"),
    Topic("in", "wrench", WRENCH, "the load to draw"),
    Topic(
        "out",
        "~/joint_states",
        JOINTS,
        "positions of all joints, by the exported URDF's names; velocities where the input carries velocities",
    ),
    Topic("out", "~/pose", "geometry_msgs/PoseStamped", "the platform's reference point, rotation from home"),
    Topic(
        "out",
        "~/twist",
        "geometry_msgs/TwistStamped",
        "its velocity and angular velocity, base axes; only if the input carries velocities",
    ),
    Topic(
        "out",
        "~/markers",
        "visualization_msgs/MarkerArray",
        "bars; under a load also colours by strain energy, deflected lines, the compliance "
        "ellipsoid, the wrench and the dominant element's name",
    ),
    Topic(
        "out",
        "robot_description",
        TEXT,
        "the output of `pkm-twin export urdf`, without a `ros2_control` element unless `hardware_plugin` is set",
        latched=True,
    ),
    Topic("out", "/tf", _TRANSFORM_TYPE, "`base_frame` to `platform_frame`, if tf2_msgs is installed"),
    Topic(
        "out", "/tf_static", _TRANSFORM_TYPE, "`platform_frame` to `tool_frame`, if tf2_msgs is installed", latched=True
    ),
)


@dataclass(frozen=True, eq=False)
class State:
    """The state of the machine at one stamp, ns, in base axes.

    ``q``: actuated joints, shape (n,). ``joints``: positions of all joints of the exported URDF,
    actuated ones first, rad or m. ``position`` (3,), ``rotation`` (3, 3): pose of the platform's
    reference point. ``rates``: velocities of all joints, rad/s or m/s; ``twist``: velocity of the
    reference point and angular velocity, shape (6,), m/s and rad/s; both None without joint
    velocities.
    """

    stamp: int
    q: Array
    joints: Array
    position: Array
    rotation: Array
    rates: Array | None
    twist: Array | None


def make_state_program(robot: Robot) -> Kernel:
    """Return the compiled program that computes the platform's pose and the passive joints from q."""
    return robot.engine.kernel("state", state_program)


def make_state_program_with_velocities(robot: Robot) -> Kernel:
    """Return the compiled program that computes pose, passive joints and their velocities from q and qd."""
    return robot.engine.kernel("moving state", moving_state_program)


@dataclass
class MachineState(TimeSynchronizer):
    """Compute the machine's state from joint states, with the wrench nearest in time."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.joint_names = (*self.robot.joint_names, *self.robot.passive_joints)
        self.latest: State | None = None
        self.pace = Pace(0.0)
        self._last_stamp = 0
        self._recent: TimeCache[tuple[WrenchSample, Mount]] = TimeCache()

    def reset(self) -> None:
        """Forget states and wrenches, for instance after a jump of the clock."""
        self.latest = None
        self.pace.reset()
        self._recent.clear()

    def joint_state(self, message: Any, now: int) -> State | None:
        """Compute the machine's state from a sensor_msgs/JointState; None if ``pace`` skips it.

        :raises MessageError: the message is rejected, and counted.
        """
        with self.taking(self.states):
            sample = self._reader.joint_state(message, now, self._rules)
            if self.latest is not None:
                check_order(sample.stamp, self._last_stamp)
            if not self.pace.due(sample.stamp):
                self._last_stamp = sample.stamp
                return None
            state: State = as_message_error(self._compute_state, sample)
        self.latest, self._last_stamp = state, sample.stamp
        self.pace.answered(sample.stamp)
        return state

    def store_wrench(self, message: Any, now: int) -> None:
        """Store a geometry_msgs/WrenchStamped.

        :raises MessageError: the message is rejected, and counted.
        """
        with self.taking(self.wrenches):
            sample, mount = self._wrench_reader.read(message, now)
            self._recent.push(sample.stamp, (sample, mount))

    def find_wrench(self, state: State) -> Array | None:
        """Return the wrench nearest in time to a state, base axes at the reference point, (6,).

        None if no wrench is within ``max_state_age``.
        """
        found = self._recent.nearest(state.stamp)
        if found is None or abs(state.stamp - found[0]) > self.settings.max_state_age * SECOND:
            return None
        sample, mount = found[1]
        return self._wrench_reader.at_reference(sample, mount, state.rotation)

    def _compute_state(self, sample: JointSample) -> State:
        robot, q, qd = self.robot, sample.q, sample.qd
        rates = twist = None
        if qd is None:
            position, flat, passive = robot.evaluate(make_state_program(robot), q)
        else:
            found = robot.evaluate(make_state_program_with_velocities(robot), q, qd)
            position, flat, passive, passive_rates, twist = found
            rates = np.concatenate((qd, passive_rates))
        rotation, joints = flat.reshape(3, 3), np.concatenate((q, passive))
        for values in (position, joints, rates, twist):
            if values is not None and not np.isfinite(values).all():
                raise MessageError("non-finite result", "the model gave a value that is not finite")
        return State(sample.stamp, q, joints, position, rotation, rates, twist)
