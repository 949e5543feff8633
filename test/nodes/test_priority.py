# SPDX-License-Identifier: Apache-2.0
"""A node with thread_priority: every thread is real-time, or the node says that it may not be."""

import errno
import os
from pathlib import Path

import pytest

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from pkm_twin.ros import run

PRIORITY = 7


def policies(pid):
    """Scheduling policy and real-time priority of each thread."""
    return {
        (os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority)
        for thread in (int(path.name) for path in Path(f"/proc/{pid}/task").iterdir())
    }


def locked(pid):
    """Kilobytes of memory that stay."""
    (line,) = (
        line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if "VmLck" in line
    )
    return int(line.split()[1])


def test_all_threads_are_real_time_and_memory_stays_or_the_node_warns(peer, launch_alone):
    process = launch_alone("delta_dynamics.gate_node", f"thread_priority:={PRIORITY}", fresh=True)
    peer.hear(DiagnosticArray, "/diagnostics")
    status = peer.diagnostics("/command_gate").status[0]
    warnings = [status.message, *(v.value for v in status.values if v.key == "other problems")]
    if any("thread_priority" in text for text in warnings):
        assert status.level >= DiagnosticStatus.WARN
    else:
        assert policies(process.process.pid) == {(os.SCHED_FIFO, PRIORITY)}
        assert locked(process.process.pid) > 10_000


def test_without_the_parameter_nothing_is_changed(peer, launch_alone):
    process = launch_alone("delta_dynamics.gate_node", fresh=True)
    peer.hear(DiagnosticArray, "/diagnostics")
    peer.diagnostics("/command_gate")
    assert policies(process.process.pid) == {(os.SCHED_OTHER, 0)}
    assert locked(process.process.pid) == 0


def test_a_refusal_of_the_system_is_told(monkeypatch):
    def refuse(*_):
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with pytest.raises(OSError, match=os.strerror(errno.EPERM)):
        run.set_priority(PRIORITY)
