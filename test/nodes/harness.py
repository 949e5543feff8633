# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages for the pure cores, and node processes in a ROS domain of their own.

Nothing here sleeps to synchronise: every wait is for a condition, with a deadline.
"""

import contextlib
import ctypes
import fcntl
import importlib
import multiprocessing
import os
import re
import runpy
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from pkm_twin.errors import MessageError
from test.support.waiting import wait_until

try:
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.executors import SingleThreadedExecutor
except ImportError:  # The tests of the pure cores run without ROS.
    rclpy = None

REPOSITORY = Path(__file__).resolve().parents[2]
DEADLINE = 240.0
"""How long a condition is waited for, s: no verdict but for what will never be so."""
SECOND = 10**9


class Plain:
    """Message classes with attributes only, as a bag decoder makes them."""

    def __call__(self, **fields):
        return SimpleNamespace(**fields)

    time = duration = header = __call__
    joint_state = point = trajectory = __call__
    vector = wrench = make_wrench_message = __call__


class Ros:
    """The real message classes."""

    def __init__(self):
        from builtin_interfaces.msg import Duration, Time
        from geometry_msgs.msg import Vector3, Wrench, WrenchStamped
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Header
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        self.time, self.duration, self.header = Time, Duration, Header
        self.joint_state = JointState
        self.point, self.trajectory = JointTrajectoryPoint, JointTrajectory
        self.vector, self.wrench, self.make_wrench_message = Vector3, Wrench, WrenchStamped


class Maker:
    """Builds messages of one kind (Plain or Ros); times in ns."""

    def __init__(self, kind):
        self.kind = kind

    def header(self, stamp, frame=""):
        sec, nanosec = divmod(stamp, SECOND)
        return self.kind.header(stamp=self.kind.time(sec=sec, nanosec=nanosec), frame_id=frame)

    def joint_state(self, names, position, velocity=(), effort=(), stamp=0):
        return self.kind.joint_state(
            header=self.header(stamp),
            name=list(names),
            position=list(position),
            velocity=list(velocity),
            effort=list(effort),
        )

    def trajectory(self, names, times, positions, velocities=None, accelerations=None, stamp=0):
        """One point for each of ``times``; a derivative that is None is absent."""
        points = []
        for i, (start, position) in enumerate(zip(times, positions, strict=True)):
            sec, nanosec = divmod(start, SECOND)
            points.append(
                self.kind.point(
                    positions=list(position),
                    velocities=[] if velocities is None else list(velocities[i]),
                    accelerations=[] if accelerations is None else list(accelerations[i]),
                    effort=[],
                    time_from_start=self.kind.duration(sec=sec, nanosec=nanosec),
                )
            )
        return self.kind.trajectory(header=self.header(stamp), joint_names=list(names), points=points)

    def wrench(self, values, stamp=0, frame="platform"):
        fx, fy, fz, mx, my, mz = values
        return self.kind.make_wrench_message(
            header=self.header(stamp, frame),
            wrench=self.kind.wrench(
                force=self.kind.vector(x=fx, y=fy, z=fz),
                torque=self.kind.vector(x=mx, y=my, z=mz),
            ),
        )


class Domain:
    """A ROS domain that no other test on this machine uses, until it is closed."""

    def __init__(self):
        folder = Path(tempfile.gettempdir())
        for number in range(20, 102):
            try:
                lock = (folder / f"ros_domain_{number}.lock").open("w")
            except OSError:  # another user's
                continue
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                lock.close()
                continue
            self.number, self._lock = number, lock
            return
        raise RuntimeError("no ROS domain is free")

    def environment(self):
        """For a node process: the wheels set their own library path anew at its start."""
        names = ("_ROS_WHEELS_BOOTSTRAP_COMPLETE",)
        kept = {key: value for key, value in os.environ.items() if key not in names}
        # Of a sourced workspace the path is where rclpy is.
        path = [str(REPOSITORY), *filter(None, [kept.get("PYTHONPATH")])]
        return kept | {
            "ROS_DOMAIN_ID": str(self.number),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "PYTHONPATH": os.pathsep.join(path),
            "PYTHONUNBUFFERED": "1",
        }

    def close(self):
        self._lock.close()


def reject(call, *arguments):
    """The reason and the text of the error that a call raises."""
    with pytest.raises(MessageError) as caught:
        call(*arguments)
    return caught.value.reason, str(caught.value)


def end_with_parent():
    """In a new process: it takes signals whatever this one does about them.

    On Linux a test run that is killed leaves no node behind.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)


class Process:
    """A process in a session of its own; ``output`` is what it has said so far.

    :param process: makes the process, given the file that takes what it says.
    """

    def __init__(self, process):
        self._output = tempfile.NamedTemporaryFile("w+")  # noqa: SIM115
        self.process = process(self._output)

    @property
    def output(self):
        self._output.seek(0)
        return self._output.read()

    def alive(self):
        return self.process.poll() is None

    def wait(self, timeout=DEADLINE):
        """The exit code of a process that ends by itself."""
        return self.process.wait(timeout)

    def stop(self, number=signal.SIGINT, times=1):
        """Signal the process: its exit code."""
        for _ in range(times):
            self.process.send_signal(number)
        return self.process.wait(DEADLINE)

    def close(self):
        """End the process by its id, whatever state it is in."""
        if self.alive():
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.stop()
        if self.alive():
            self.process.kill()
            self.process.wait()
        self._output.close()


class Command(Process):
    """A command in a new process; ``begin`` is called there before it."""

    def __init__(self, domain, command, begin=lambda: None):
        super().__init__(
            lambda output: subprocess.Popen(
                command,
                stdout=output,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                cwd=tempfile.gettempdir(),
                env=domain.environment(),
                start_new_session=True,
                preexec_fn=lambda: (end_with_parent(), begin()),
            )
        )


def node_words(module, *parameters, arguments=(), code=None, script=None):
    """What Python gets to run a node: ``-m MODULE --ros-args -p ...``

    ``arguments`` are further ROS arguments; ``code`` is run instead of the module, or ``script``,
    a path and its own arguments.
    """
    run = script or (["-m", module] if code is None else ["-c", code])
    pairs = [word for parameter in parameters for word in ("-p", parameter)]
    return [*run, "--ros-args", *pairs, *arguments]


def renamed(name, **topics):
    """ROS arguments of a node of this name, with topics below it: what each is called there."""
    pairs = [f"__node:={name}", *(f"{topic}:=/{name}/{own}" for topic, own in topics.items())]
    return [word for pair in pairs for word in ("-r", pair)]


NODES = (
    "delta_dynamics.nodes.twin",
    "delta_dynamics.nodes.gate",
    "delta_dynamics.nodes.simulation",
    "pkm_twin.state.node",
    "stiffness_monitor.node",
)


def fork_of(words, environment, *outputs):
    """What Python would run by these words, in this process, a fork of one that has imported all.

    Of a module that is a node, or its ``main``.
    """
    os.setsid()
    end_with_parent()
    for output, stream in zip(outputs, (sys.stdout, sys.stderr), strict=True):
        with open(output, "ab") as file:
            os.dup2(file.fileno(), stream.fileno())
        stream.reconfigure(line_buffering=True)
    os.chdir(tempfile.gettempdir())
    os.environ.clear()
    os.environ.update(environment)
    how, *sys.argv = map(str, words)
    if how == "-c":
        code, sys.argv[0] = sys.argv[0], how
        exec(code, {"__name__": "__main__"})
    elif how != "-m":
        sys.argv.insert(0, how)
        sys.path.insert(0, str(Path(how).parent))
        runpy.run_path(how, run_name="__main__")
    elif hasattr(entry := importlib.import_module(sys.argv[0]), "NODE"):
        sys.exit(entry.run(entry.NODE))
    else:
        entry.main()


class Forked(Process):
    """Python in a process that need not import anything: a third of the cost.

    It ends without the interpreter's own end: what a signal does there needs a Command.
    """

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, "pkm_twin.codegen.llvm", *NODES])

    def __init__(self, domain, words):
        environment = domain.environment()
        super().__init__(lambda output: _Fork(words, environment, output.name, output.name))


class ForkedCommand(Process):
    """``pkm-twin WORDS`` in such a fork; ``errors`` is what it has said on standard error."""

    def __init__(self, domain, *words):
        given = ["-m", "pkm_twin.apps.cli", *words], domain.environment()
        self._errors = tempfile.NamedTemporaryFile("w+")  # noqa: SIM115
        super().__init__(lambda output: _Fork(*given, output.name, self._errors.name))

    @property
    def errors(self):
        self._errors.seek(0)
        return self._errors.read()

    def close(self):
        super().close()
        self._errors.close()


class _Fork:
    """A forked process with the methods of subprocess.Popen."""

    def __init__(self, *arguments):
        context = Forked.context
        self._process = context.Process(target=fork_of, args=arguments, daemon=True)
        self._process.start()
        self.pid = self._process.pid

    def poll(self):
        return self._process.exitcode

    def wait(self, timeout=None):
        self._process.join(timeout)
        if self.poll() is None:
            raise subprocess.TimeoutExpired("a forked node", timeout)
        return self.poll()

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        self.send_signal(signal.SIGKILL)


def answers(array):
    """Whether a node's diagnostics are of one that has loaded its programs."""
    return not array.status[0].message.startswith("loading or compiling")


class Peer:
    """The other side of the topics: a node of this process that sends and collects."""

    def __init__(self, domain):
        # The middleware reads the range when the context is made, and only from here.
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain.number)
        self.node = rclpy.create_node("peer", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self._publishers = {}
        self._received = {}
        self._since = {}

    def now(self):
        return self.node.get_clock().now().nanoseconds

    def talk(self, kind, topic, qos=1000):
        self._publishers[topic] = self.node.create_publisher(kind, topic, qos)

    def hear(self, kind, topic, qos=100):
        if topic in self._received:
            self.clear_topic(topic)
            return
        received = self._received[topic] = []

        def take(message, info):
            if info["source_timestamp"] >= self._since.get(topic, 0):
                received.append(message)

        self.node.create_subscription(kind, topic, take, qos)

    def send(self, topic, message):
        self._publishers[topic].publish(message)

    def received(self, topic):
        return self._received[topic]

    def clear(self):
        for topic in self._received:
            self.clear_topic(topic)

    def clear_topic(self, topic):
        """Forget what was received, and what was sent before now and is still on its way."""
        self._since[topic] = time.time_ns()
        self._received[topic].clear()

    def matched(self):
        """Every publisher has a subscriber."""
        return all(p.get_subscription_count() >= 1 for p in self._publishers.values())

    def diagnostics(self, node, condition=answers):
        """The first diagnostics that a node, by its full name, sends from now on and that meet
        the condition.
        """
        self.clear_topic("/diagnostics")
        return self.until(lambda: next(filter(condition, self.told(node)), None))

    def told(self, node):
        """The diagnostics of a node, by its full name, that were heard."""
        received = self._received["/diagnostics"]
        return [array for array in received if array.status[0].name == node]

    def until(self, condition, timeout=DEADLINE, repeat=None, every=0.05):
        """Spin until the condition is true; until then ``repeat`` is called ``every`` so many s.

        :returns: what the condition gave.
        """
        due = 0.0

        def spin():
            nonlocal due
            now = time.monotonic()
            if repeat is not None and now >= due:
                repeat()
                due = now + every
            self.executor.spin_once(timeout_sec=0.05)

        return wait_until(condition, spin, timeout, "what this test waits for")

    def spin(self):
        """Take one message, if one comes within a millisecond."""
        self.executor.spin_once(timeout_sec=0.001)

    def call(self, kind, service, request):
        """The answer of a service; after each five seconds without one it is asked again.

        A server that has not found this side's reader yet answers to nobody.
        """
        client = self.node.create_client(kind, service)
        self.until(client.service_is_ready)
        futures = []
        done = self.until(
            lambda: next((f for f in futures if f.done()), None),
            repeat=lambda: futures.append(client.call_async(request)),
            every=5.0,
        )
        self.node.destroy_client(client)
        return done.result()

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


class Running:
    """A node in a process, and its topics below its name, seen from this side.

    ``remaps``: what other topics of the node are called below that name; ``talk`` and ``hear``:
    types of topics that this side sends and collects; ``options`` are those of the process.
    """

    def __init__(self, peer, launch, module, name, *parameters, remaps, talk=None, hear=None, **options):
        self.peer, self.name, self._last = peer, name, 0
        peer.hear(DiagnosticArray, "/diagnostics")
        for topic, kind in (hear or {}).items():
            peer.hear(kind, f"/{name}/{topic}")
        for topic, kind in (talk or {}).items():
            peer.talk(kind, f"/{name}/{topic}")
        self._start = lambda: launch(module, *parameters, arguments=renamed(name, **remaps), **options)
        self.process = self._start()

    def received(self, topic):
        return self.peer.received(f"/{self.name}/{topic}")

    def send(self, topic, message):
        self.peer.send(f"/{self.name}/{topic}", message)

    def stamp(self, step=SECOND // 1000):
        """The present, and later than every stamp before by a step, ns."""
        self._last = max(self.peer.now(), self._last + step)
        return self._last

    def until(self, condition, repeat=None, **options):
        """As the peer's, as long as the process lives."""

        def again():
            assert self.process.alive(), self.process.output
            repeat()

        return self.peer.until(condition, repeat=repeat and again, **options)

    def diagnostics(self, condition=answers):
        return self.peer.diagnostics(f"/{self.name}", condition)

    def call(self, kind, service, **fields):
        """The answer of one of the node's services."""
        return self.peer.call(kind, f"/{self.name}/{service}", kind.Request(**fields))


def one_line_refusal(process):
    """The one line that a process which refuses to start says, after its exit with 1.

    The middleware's own lines are not counted: other processes may hold its shared memory. Nor is
    the one of a node that takes long to load its programs.
    """
    assert process.wait() == 1, process.output
    lines = [line for line in process.output.strip().splitlines() if "[RTPS_" not in line]
    lines = [line for line in lines if "compiling the robot's programs" not in line]
    assert len(lines) == 1, process.output
    assert "Traceback" not in lines[0]
    return lines[0]


def stamp_of(message):
    """The header's stamp, ns."""
    stamp = message.header.stamp
    return stamp.sec * SECOND + stamp.nanosec


def values_of(array):
    """A DiagnosticArray's only status: its values as a dict."""
    (status,) = array.status
    return {pair.key: pair.value for pair in status.values}


def silence_of(array):
    """How long there was no joint state, s, by the status of a stream that it stopped."""
    text = array.status[0].message
    found = re.fullmatch(r"stopped: stale input: no accepted joint state for ([\d.]+) s.*", text)
    return float(found[1])


def text_of(array):
    """The status message and what else is told: a busy machine's own lines may come first."""
    return f"{array.status[0].message}; {values_of(array).get('other problems', '')}"


def counts_of(array, what):
    """The counters of a DiagnosticArray whose keys are ``what: reason``, by reason."""
    pairs = values_of(array).items()
    return {key[len(what) + 2 :]: int(n) for key, n in pairs if key.startswith(f"{what}: ")}
