# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A running delta_dynamics and its topics, seen from the other side; needs rclpy."""

import contextlib

import numpy as np
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from test.nodes.harness import SECOND, Maker, Ros, Running, stamp_of, values_of
from test.support.robots import load

MODULE = "delta_dynamics.nodes.twin"
ROBOT = load("delta_cu")
NAMES = ROBOT.joint_names
STEP = SECOND // 1000
WINDOW = 4
MAKE = Maker(Ros())
COMMON = (
    f"differentiator.window:={WINDOW}",
    "recovery_count:=2",
    "publish_commands:=true",
    "on_stop:=nothing",
)
Q = np.array([0.1, 0.2, 0.3])
TALK = {"joint_trajectory": JointTrajectory, "states": JointState}
HEAR = {
    "joint_trajectory_ff": JointTrajectory,
    "joint_torques": JointState,
    "torque_residual": JointState,
    "commands": Float64MultiArray,
}


def launched(peer, launch, name, *parameters, **options):
    """A node of this name in a process, its topics not yet connected."""
    return Twin(
        peer,
        launch,
        MODULE,
        name,
        *COMMON,
        *parameters,
        remaps={"joint_states": "states"},
        talk=TALK,
        hear=HEAR,
        **options,
    )


class Twin(Running):
    """A running node delta_dynamics."""

    def begin(self):
        """A stamp for a trajectory: so late that none is over before it is looked at, ns."""
        return self.stamp() + 60 * SECOND

    def ask(self, message):
        """Send a trajectory and wait for its answer: all answers up to it."""
        received = self.received("joint_trajectory_ff")
        self.send("joint_trajectory", message)
        self.peer.until(lambda: any(stamp_of(m) == stamp_of(message) for m in received))
        answers = list(received)
        received.clear()
        return answers

    def send_state(self, message):
        self.send("states", message)

    def ask_anew(self):
        """Wait for the answer to a trajectory; after each second without one a new one is sent.

        Where many wait already, as at a node's start, one is refused as busy.
        """
        received = self.received("joint_trajectory_ff")
        sent = []

        def ask():
            message = trajectory(stamp=self.begin())
            sent.append(stamp_of(message))
            self.send("joint_trajectory", message)

        self.peer.until(lambda: any(stamp_of(m) in sent[-1:] for m in received), repeat=ask, every=1.0)
        received.clear()

    def ready(self):
        """Wait until all topics are connected both ways."""

        def repeat():
            self.send("joint_trajectory", trajectory(stamp=self.begin()))
            self.send_state(state(stamp=self.stamp(), effort=(0.0, 0.0, 0.0)))

        topics = ("joint_trajectory_ff", "joint_torques", "torque_residual", "commands")
        self.until(lambda: all(self.received(t) for t in topics), repeat=repeat)
        self.settle()
        return self

    def settle(self):
        """Wait until a new trajectory and a new state are answered, and forget everything before.

        A stream that has stopped in a long pause runs again.
        """
        self.ask_anew()
        sent = set()

        def repeat():
            sent.add(self.stamp())
            self.send_state(state(self._last))

        received = self.received("joint_torques")
        self.peer.until(lambda: any(stamp_of(m) in sent for m in received), repeat=repeat)
        self.ask_anew()
        for topic in ("joint_torques", "torque_residual", "commands"):
            self.received(topic).clear()

    def stream(self, count, **fields):
        """Send joint states: their stamps."""
        stamps = [self.stamp() for _ in range(count)]
        for stamp in stamps:
            self.send_state(state(stamp, **fields))
        return stamps

    def since(self, stamps, topic="joint_torques"):
        """The messages from the first of these stamps on, once that of the last has come."""
        received = self.received(topic)
        self.peer.until(lambda: any(stamp_of(m) == stamps[-1] for m in received))
        return [m for m in received if stamp_of(m) >= stamps[0]]

    def set_to(self, parameters):
        """Set parameters, given as messages, atomically."""
        service = "set_parameters_atomically"
        return self.call(SetParametersAtomically, service, parameters=parameters).result

    def set(self, **values):
        """Set parameters atomically; dots are written as two underscores."""
        return self.set_to(
            [Parameter(key.replace("__", "."), value=value).to_parameter_msg() for key, value in values.items()]
        )

    def get(self, *names):
        """Values of parameters, as messages."""
        return self.call(GetParameters, "get_parameters", names=names).values

    @contextlib.contextmanager
    def changed(self, **values):
        """Parameters as long as the context lasts."""
        names = [key.replace("__", ".") for key in values]
        before = zip(names, self.get(*names), strict=True)
        assert self.set(**values).successful
        try:
            yield
        finally:
            old = [ParameterMessage(name=name, value=value) for name, value in before]
            assert self.set_to(old).successful

    def effort(self, q=Q):
        """What the node answers for holding still at q."""
        rows = [tuple(q)]
        zero = [(0.0, 0.0, 0.0)]
        (answer,) = self.ask(MAKE.trajectory(NAMES, [SECOND], rows, zero, zero, self.begin()))
        return np.array(answer.points[0].effort)

    def at_rest(self):
        """Diagnostics after which nothing more waits: two seconds of them with the same count.

        A process that stood still sends several at once, before it takes what waits.
        """
        first = self.diagnostics()
        while True:
            array = self.diagnostics()
            if count_of(array) != count_of(first):
                first = array
            elif stamp_of(array) - stamp_of(first) > 1.5 * SECOND:
                return array

    def even(self):
        """Diagnostics at rest in which everything sent before is counted.

        Of what was lost last only a later one tells, so one is sent, and after each second another
        until it is counted.
        """
        first, more = count_of(self.at_rest()), 0
        told = self.peer.received("/diagnostics")
        told.clear()

        def again():
            nonlocal more
            more += 1
            self.send_state(state(self.stamp()))

        def counted():
            own = [a for a in told if a.status[0].name == f"/{self.name}"]
            return more and any(count_of(a) >= first + more for a in own)

        self.peer.until(counted, repeat=again, every=1.0)
        return self.at_rest()

    def balance(self, total):
        """The diagnostics up to where every one of ``total`` samples is taken or counted as lost.

        More are sent until it is so: what is lost last is seen by what comes after it.
        """
        told = self.peer.received("/diagnostics")
        told.clear()
        sent = total

        def again():
            nonlocal sent
            sent += 1
            self.send_state(state(self.stamp()))

        def own():
            return [a for a in told if a.status[0].name == f"/{self.name}"]

        self.peer.until(lambda: any(count_of(a) >= total for a in own()), repeat=again)
        self.peer.until(lambda: any(count_of(a) >= sent for a in own()))
        assert count_of(own()[-1]) == sent
        return own()


def count_of(array):
    """Joint states that the node took, that it says were lost, and that it dropped."""
    values = values_of(array)
    keys = ("messages", "lost: joint_states", "dropped by overload: joint_states")
    return sum(int(values[key]) for key in keys)


def trajectory(count=5, order=(0, 1, 2), stamp=0, **changes):
    times = np.arange(count) * 0.05
    waves = np.outer(times, [3.0, -4.0, 5.0])
    rows = {
        "positions": 0.2 + 0.3 * np.sin(waves),
        "velocities": 0.3 * np.cos(waves) * [3.0, -4.0, 5.0],
        "accelerations": -0.3 * np.sin(waves) * [9.0, 16.0, 25.0],
    }
    order = list(order)
    fields = {key: values[:, order].tolist() for key, values in rows.items()}
    fields |= {"names": [NAMES[i] for i in order], "times": [round(t * SECOND) for t in times]}
    return MAKE.trajectory(**(fields | {"stamp": stamp} | changes))


def state(stamp, order=(0, 1, 2), position=Q, velocity=(0.1, -0.2, 0.3), effort=()):
    def pick(values):
        return [float(values[i]) for i in order] if len(values) else []

    names = [NAMES[i] for i in order]
    return MAKE.joint_state(names, pick(position), pick(velocity), pick(effort), stamp)
