# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The process of a node: signals, exceptions, priority, memory, a missing clock, its imports."""

import errno
import itertools
import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

from test.nodes.harness import DEADLINE, Command, counts_of, renamed, stamp_of, text_of, values_of

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import GetParameters
from std_msgs.msg import Bool

from pkm_twin.ros import run
from test.nodes.harness import REPOSITORY
from test.nodes.twin import MODULE, WINDOW, launched, state
from test.support.robots import partly_long
from test.support.waiting import wait_until

CALLBACKS = "_on_joint_state", "_publish_diagnostics"


class TestProcess:
    @pytest.mark.parametrize(
        "interrupt",
        partly_long(
            itertools.product((signal.SIGINT, signal.SIGTERM), CALLBACKS),
            (signal.SIGINT, CALLBACKS[0]),
            (signal.SIGTERM, CALLBACKS[1]),
        ),
    )
    def test_a_signal_in_the_middle_of_a_callback_ends_the_node(self, peer, launch, interrupt):
        number, callback = interrupt
        code = f"""
import os, time
import numpy as np
import delta_dynamics.nodes.twin as node
original = node.DeltaDynamics.{callback}
def interrupted(self, *arguments):
    os.kill(os.getpid(), {int(number)})
    time.sleep(0.05)
    # The topics are there until the callback is over, and for the node's last words.
    self._torques.publish(0, np.zeros(3))
node.DeltaDynamics.{callback} = interrupted
raise SystemExit(node.run(node.NODE))
"""
        name = f"interrupted_{number}{callback}"
        twin = launched(peer, launch, name, code=code, fresh=True)
        process = twin.process
        twin.peer.until(lambda: not process.alive(), repeat=lambda: twin.send_state(state(twin.stamp())))
        assert process.wait() == 0, process.output
        assert "Traceback" not in process.output

    def test_an_exception_in_a_callback_stops_the_stream_and_not_the_node(self, peer, launch):
        code = """
import delta_dynamics.nodes.twin as node
solve = node.Feedforward._compute_efforts
def broken(self, message, *times):
    if message.position[0] == 0.125:
        raise ZeroDivisionError("made for the test")
    return solve(self, message, *times)
node.Feedforward._compute_efforts = broken
raise SystemExit(node.run(node.NODE))
"""
        twin = launched(peer, launch, "broken", "stale_after:=5.0", code=code).ready()
        twin.stream(3, position=(0.125, 0.2, 0.3))
        array = twin.diagnostics(lambda a: values_of(a)["exceptions"] == "3")
        assert array.status[0].level == b"\x02"
        assert counts_of(array, "stopped") == {"exception": 1}
        assert twin.process.output.count("Traceback") == 1
        stamps = twin.stream(WINDOW + 3)
        assert [stamp_of(m) for m in twin.since(stamps)] == stamps[WINDOW:]
        # Without thread_priority no thread is real-time and no memory stays.
        assert policies(twin.process.process.pid) == {(os.SCHED_OTHER, 0)}
        assert locked(twin.process.process.pid) == 0

    def test_a_clock_that_never_comes_is_told(self, peer, launch):
        peer.hear(DiagnosticArray, "/diagnostics")
        process = launch(MODULE, "use_sim_time:=true", arguments=renamed("waiting"))
        array = peer.diagnostics("/waiting")
        assert "use_sim_time is set and no /clock arrives" in text_of(array)
        assert "waiting for joint_states" in text_of(array)
        assert array.status[0].level == b"\x01"
        assert process.stop() == 0


def deaf():
    """As a background job of a shell, or under nohup."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_a_node_whose_parent_ignores_them(peer, launch, number):
    """In the middle of a stream, several of them: a terminal and a launcher both send one."""
    twin = launched(peer, launch, f"ending_{number}", fresh=True, begin=deaf).ready()
    enough = threading.Event()

    def stream():
        # At some kHz, so that the signal comes while a callback publishes.
        while not enough.wait(0.0002):
            twin.send_state(state(peer.now(), effort=(1.0, 2.0, 3.0)))

    thread = threading.Thread(target=stream)
    thread.start()
    try:
        twin.peer.until(lambda: len(twin.received("joint_torques")) > 50)
        code = twin.process.stop(number, times=3)
    finally:
        enough.set()
        thread.join()
    assert code == 0, twin.process.output
    assert "Traceback" not in twin.process.output


@pytest.mark.parametrize("command", ["node", "monitor-torques"])
def test_a_home_that_cannot_be_written_costs_log_files_alone(domain, monkeypatch, command):
    """The middleware itself would not start. In /proc not even root makes a folder."""
    monkeypatch.setenv("ROS_LOG_DIR", "/proc/none/log")
    words = {
        "node": ["-m", MODULE],
        "monitor-torques": ["-m", "pkm_twin.apps.cli", "monitor-torques", "--wait", "0.1", "/none"],
    }[command]
    process = Command(domain, [sys.executable, *words])
    try:
        wait_until(
            lambda: "joints" in process.output or not process.alive(),
            lambda: time.sleep(0.05),
            DEADLINE,
            "a robot's joints or an end",
        )
        assert process.stop() == (0 if command == "node" else 1), process.output
        lines = [line for line in process.output.splitlines() if "no log files: " in line]
        assert len(lines) == 1 and "set ROS_LOG_DIR" in lines[0]
        assert "Traceback" not in process.output
    finally:
        process.close()


def test_a_flood_of_refusals_is_a_line_a_second(peer, launch):
    began = time.monotonic()
    twin = launched(peer, launch, "flooded")
    reasons = {
        "length": {"position": [0.1]},
        "duplicated joint": {"name": ["arm_1", "arm_1", "arm_2", "arm_3"]},
    }

    def flood():
        for fields in reasons.values():
            message = state(twin.stamp())
            for field, value in fields.items():
                setattr(message, field, value)
            for _ in range(20):
                twin.send_state(message)

    counted = {}

    def enough():
        arrays = [a for a in peer.received("/diagnostics") if a.status[0].name == "/flooded"]
        counted.update(counts_of(arrays[-1], "joint states rejected") if arrays else {})
        return min(counted.get(reason, 0) for reason in reasons) > 500

    peer.until(enough, repeat=flood)
    seconds = time.monotonic() - began
    for reason in reasons:
        lines = [x for x in twin.process.output.splitlines() if f"rejected, {reason}" in x]
        assert 1 <= len(lines) <= seconds + 1


def test_what_was_sent_before_is_forgotten_though_it_arrives_later(peer):
    peer.hear(Bool, "/said")
    peer.talk(Bool, "/said")
    peer.until(peer._publishers["/said"].get_subscription_count)
    peer.send("/said", Bool(data=False))
    peer.clear()
    peer.send("/said", Bool(data=True))
    peer.until(lambda: peer.received("/said"))
    assert [message.data for message in peer.received("/said")] == [True]


PROFILE = REPOSITORY / "docs" / "security" / "memory.xml"
LENGTH, COUNT = 20_000, 2_000
MEGABYTES = LENGTH * COUNT / 1e6


def resident(process):
    """Memory of a process, MB."""
    lines = Path(f"/proc/{process.process.pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1e3 for line in lines if line.startswith("VmRSS"))


@pytest.mark.long
@pytest.mark.parametrize("freed", [False, True])
def test_requests_that_are_too_long_do_not_add_up(launch_alone, peer, monkeypatch, freed):
    """By default the middleware keeps one buffer; with the profile of docs/launch.md none."""
    if freed:
        monkeypatch.setenv("RMW_FASTRTPS_USE_QOS_FROM_XML", "1")
        monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(PROFILE))
    node = launch_alone("delta_dynamics.nodes.twin", fresh=True)
    service = "/delta_dynamics/get_parameters"
    few = GetParameters.Request(names=["payload.mass"])
    assert len(peer.call(GetParameters, service, few).values) == 1
    before = resident(node)
    many = GetParameters.Request(names=["x" * LENGTH] * COUNT)
    for _ in range(4):
        assert not peer.call(GetParameters, service, many).values
    assert len(peer.call(GetParameters, service, few).values) == 1
    kept = resident(node) - before
    assert kept < 0.5 * MEGABYTES if freed else 0.5 * MEGABYTES < kept < 2.0 * MEGABYTES


PRIORITY = 7


def policies(pid):
    """Scheduling policy and real-time priority of each thread."""
    return {
        (os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority)
        for thread in (int(path.name) for path in Path(f"/proc/{pid}/task").iterdir())
    }


def locked(pid):
    """Kilobytes of memory that stay."""
    (line,) = (line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if "VmLck" in line)
    return int(line.split()[1])


def test_all_threads_are_real_time_and_memory_stays_or_the_node_warns(peer, launch_alone):
    process = launch_alone("delta_dynamics.nodes.gate", f"thread_priority:={PRIORITY}", fresh=True)
    peer.hear(DiagnosticArray, "/diagnostics")
    status = peer.diagnostics("/command_gate").status[0]
    warnings = [status.message, *(v.value for v in status.values if v.key == "other problems")]
    if any("thread_priority" in text for text in warnings):
        assert status.level >= DiagnosticStatus.WARN
    else:
        assert policies(process.process.pid) == {(os.SCHED_FIFO, PRIORITY)}
        assert locked(process.process.pid) > 10_000


HIDING = """
import sys
class Hidden:
    def find_spec(self, name, *_):
        if name.partition(".")[0] == "llvmlite":
            raise ModuleNotFoundError("hidden", name=name)
sys.meta_path.insert(0, Hidden())
"""
INSTALLING = ("sudo apt install python3-llvmlite", "pip install llvmlite")


def test_a_missing_compiler_is_warned_of_once_at_a_nodes_start_and_in_info(domain, peer, launch_alone):
    """With the line that installs it."""
    begin = "from delta_dynamics.nodes import gate\nraise SystemExit(gate.run(gate.NODE))"
    node = launch_alone(None, code=HIDING + begin, fresh=True, arguments=renamed("slow"))
    peer.hear(DiagnosticArray, "/diagnostics")
    array = peer.diagnostics("/slow")
    assert "llvmlite is not installed" in text_of(array) and array.status[0].level >= DiagnosticStatus.WARN
    command = "from pkm_twin.apps import cli\ncli.main(['info', 'delta'])"
    info = Command(domain, [sys.executable, "-c", HIDING + command])
    assert info.wait() == 0, info.output
    for output in (node.output, info.output):
        (line,) = (line for line in output.splitlines() if "llvmlite" in line)
        assert all(words in line for words in INSTALLING)
    assert "[WARN]" in next(line for line in node.output.splitlines() if "llvmlite" in line)
    info.close()


def test_a_refusal_of_the_system_is_told(monkeypatch):
    def refuse(*_):
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with pytest.raises(OSError, match=os.strerror(errno.EPERM)):
        run.set_priority(PRIORITY)
