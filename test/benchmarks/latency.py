# SPDX-License-Identifier: Apache-2.0
"""Where the time of a joint state goes: ``python -m test.benchmarks.latency FILE``.

In one process and one thread, in CPU time of that thread: other processes are not in it. Beside it
what the same steps cost by other ways.
"""

import os
import sys
import time
from pathlib import Path

import numpy as np

from test.nodes.harness import SECOND, Domain, Maker, Ros
from test.support.pages import write_section

SAMPLES, WARM = 4000, 500
POINTS = 100_000


class Clock:
    """Times calls by wrapping them."""

    def __init__(self):
        self.times = {}

    def wrap(self, owner, name, label):
        call = getattr(owner, name)

        def timed(*arguments):
            began = time.thread_time()
            try:
                return call(*arguments)
            finally:
                self.times.setdefault(label, []).append(time.thread_time() - began)

        setattr(owner, name, timed)

    def median(self, label):
        """Microseconds."""
        return float(np.median(self.times[label][WARM:])) * 1e6


def median_of(call, count=2000):
    """Microseconds of a call."""
    clock = Clock()
    holder = type("Holder", (), {"call": staticmethod(call)})()
    clock.wrap(holder, "call", "call")
    for _ in range(count):
        holder.call()
    return clock.median("call")


def state_of(make, names, i, now):
    phase = 2e-3 * i
    q, qd = 0.3 * np.sin(phase), 0.6 * np.cos(phase)
    return make.joint_state(names, [q] * 3, [qd] * 3, stamp=now)


def once(call):
    """Milliseconds of one call, and what it gave."""
    began = time.thread_time()
    result = call()
    return result, (time.thread_time() - began) * 1e3


def measure():
    """Rows of the two tables."""
    domain = Domain()
    os.environ.update(domain.environment())
    import rclpy
    from rclpy.serialization import deserialize_message, serialize_message
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory

    from delta_dynamics import feedforward
    from delta_dynamics.nodes.twin import DeltaDynamics
    from pkm_twin.messages.fast_decoder import RawTrajectory
    from pkm_twin.threads import one_blas_thread

    rclpy.init(args=[])
    try:
        node = DeltaDynamics()
        one_blas_thread()
        core, make, clock = node._feedforward, Maker(Ros()), Clock()
        names = list(core.robot.joint_names)
        data = bytes(serialize_message(state_of(make, names, 0, node.now())))
        answer = JointState(name=names, effort=[1.0, 2.0, 3.0])
        raw_answer = bytes(serialize_message(answer))
        stream = [
            ("bytes to a joint state", median_of(lambda: node._decode(data))),
            ("the same by rclpy", median_of(lambda: deserialize_message(data, JointState))),
            ("publish bytes", median_of(lambda: node._torques.publish(raw_answer))),
            ("publish a message", median_of(lambda: node._torques.publish(answer))),
        ]
        parts = {
            "checks of the message": (core._reader, "joint_state"),
            "pose, rates, singularity, jump": (core._continuity, "step"),
            "differentiator": (core.differentiator, "push"),
            "inverse dynamics": (feedforward, "inverse_dynamics"),
        }

        def run(begin):
            for i in range(begin, begin + SAMPLES):
                message = state_of(make, names, i, node.now())
                node._on_joint_state(bytes(serialize_message(message)))

        # By itself first: the parts' clocks have their price too.
        clock.wrap(node, "_on_joint_state", "the whole callback")
        run(0)
        whole = clock.median("the whole callback")
        for label, (owner, name) in parts.items():
            clock.wrap(owner, name, label)
        run(SAMPLES)
        stream += [(label, clock.median(label)) for label in parts]
        stream.append(("the whole callback", whole))
        times = np.arange(POINTS) * 1e-3
        waves, rates = np.outer(times, [3.0, -4.0, 5.0]), np.array([3.0, -4.0, 5.0])
        rows = (
            0.2 + 0.3 * np.sin(waves),
            0.3 * np.cos(waves) * rates,
            -0.3 * np.sin(waves) * rates**2,
        )
        message = make.trajectory(names, [round(t * SECOND) for t in times], *rows)
        data = bytes(serialize_message(message))
        _, by_rclpy = once(lambda: deserialize_message(data, JointTrajectory))
        raw, decoded = once(lambda: RawTrajectory.of(data))
        steps, turns = core.trajectory_steps(raw.fields, 0), []
        while True:
            try:
                turns.append(once(lambda: next(steps))[1])
            except StopIteration as end:
                efforts = end.value
                break
        _, encoded = once(lambda: raw.with_effort(efforts))
        long = [
            ("bytes to arrays", decoded),
            ("the same to messages, by rclpy", by_rclpy),
            ("torques, in all", sum(turns)),
            ("torques, the longest slice", max(turns)),
            ("arrays to bytes", encoded),
        ]
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
        domain.close()
    return stream, long


def table(rows, unit):
    lines = [f"| | {unit} |", "|---|---:|"]
    return [*lines, *(f"| {label} | {value:.3g} |" for label, value in rows)]


def main(target):
    stream, long = measure()
    lines = [
        "Processor time of one thread of the node `delta_dynamics` with `delta_cu`, medians, no "
        "subscriber. The round trip above includes the middleware.",
        "",
        "Three compiled programs compute. At 1 kHz the processor's caches are cold, and a call "
        "takes about twice as long as here.",
        "",
        *table(stream, "µs"),
        "",
        f"A trajectory of {POINTS} points, computed in slices between the samples of the stream:",
        "",
        *table(long, "ms"),
    ]
    write_section("latency", "\n".join(lines), Path(target))


if __name__ == "__main__":
    main(*sys.argv[1:])
