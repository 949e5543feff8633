# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Signals to a node's process: at every line of its start and end, and while it imports."""

import os
import signal
import subprocess
import sys
import time
from itertools import product
from pathlib import Path

import pytest

from test.nodes.harness import DEADLINE, end_with_parent
from test.support.robots import partly_long
from test.support.waiting import wait_until

pytest.importorskip("rclpy", exc_type=ImportError)

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

LINES = """
import os, signal, sys
from types import SimpleNamespace
from pkm_twin.apps import nodes
from pkm_twin.ros import run, signals

# Where the tests run under nohup nodes leave it alone.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
TRACED = {m.__file__ for m in (nodes, run, signals)}

class Node:
    made, shutting_down, thread_priority = 0, False, 0
    def __init__(self):
        os.write(OUT, b"made ")
    def shutdown(self):
        os.write(OUT, b"zeros ")
    def destroy_node(self):
        pass

class Executor:
    def __init__(self, nodes):
        pass
    def spin(self, ended):
        if not ended():
            signal.raise_signal(signal.SIGINT)
    def close(self):
        pass

run._Executor = Executor
run.gc = run.rclpy = SimpleNamespace(
    init=lambda **_: None, collect=lambda: None, freeze=lambda: None,
    get_default_context=lambda: SimpleNamespace(try_shutdown=lambda: None),
)
run.one_blas_thread = lambda: None
nodes.MODULES["command_gate"] = "gate"
sys.modules["gate"] = SimpleNamespace(NODE=Node)
sys.argv = ["command_gate"]
lines = 0

def trace(frame, event, _):
    global lines
    if frame.f_code.co_filename not in TRACED:
        return None
    if event == "line" and signal.getsignal(signal.SIGHUP) is not signal.SIG_DFL:
        lines += 1
        if lines >= FIRST and lines - FIRST in AFTER:
            signal.raise_signal(signal.SIGTERM if lines % 2 else signal.SIGINT)
    return trace

def child():
    sys.settrace(trace)
    try:
        nodes.command_gate()
    except SystemExit as end:
        sys.settrace(None)
        os.write(OUT, str(lines).encode())
        os._exit(end.code)
    except BaseException as error:
        os.write(OUT, repr(error).encode())
    os._exit(99)

for AFTER in (range(10**9), (0,), (0, 1), (0, 3)):
    FIRST = 1
    while True:
        IN, OUT = os.pipe()
        number = os.fork()
        if not number:
            child()
        os.close(OUT)
        status = os.waitpid(number, 0)[1]
        with os.fdopen(IN) as file:
            said = file.read()
        print(FIRST, status, said)
        ended = [int(word) for word in said.split() if word.isdigit()]
        if ended and ended[0] < FIRST:
            break
        FIRST += 1
"""


def test_no_line_is_one_at_which_a_signal_takes_the_last_words():
    """One at each line of the start and the end, two close together, and one at each line after."""
    done = subprocess.run([sys.executable, "-c", LINES], capture_output=True, text=True)
    assert done.stderr == ""
    runs = [line.split(maxsplit=2) for line in done.stdout.splitlines()]
    assert len(runs) > 100
    for run in runs:
        _, status, *rest = run
        said = rest[0].split() if rest else []
        assert status == "0", run
        # A node that was not returned yet has sent nothing but what it sends of itself.
        assert said.count("zeros") <= said.count("made"), run
    ends = [rest for _, _, *rest in runs if rest]
    assert sum("zeros" in said[0] for said in ends) > 50


def hearing():
    end_with_parent()
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.mark.parametrize(
    "case",
    partly_long(
        product(("_multiarray_umath", "_rclpy_pybind11"), SIGNALS),
        ("_multiarray_umath", SIGNALS[0]),
        *(("_rclpy_pybind11", each) for each in SIGNALS[1:]),
    ),
)
def test_a_signal_in_an_import_ends_a_node_quietly(domain, case):
    loaded, number = case
    code = "from pkm_twin.apps.nodes import command_gate; command_gate()"
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=domain.environment(),
        preexec_fn=hearing,
    )
    try:
        maps = Path(f"/proc/{process.pid}/maps")
        wait_until(lambda: loaded in maps.read_text(), lambda: time.sleep(0.002), DEADLINE, loaded)
        for _ in range(2):
            os.kill(process.pid, number)
        said, _ = process.communicate(timeout=DEADLINE)
    finally:
        process.kill()
        process.wait()
    assert (process.returncode, said) == (0, "")


WRAPPED = """
import os, signal
from pkm_twin.apps.nodes import command_gate
from pkm_twin.ros import run

class Named:
    def __set_name__(self, owner, name):
        os.kill(os.getpid(), signal.SIGINT)

# Python 3.11 wraps what is raised in __set_name__ into a RuntimeError.
run.one_blas_thread = lambda: type("Owner", (), {"name": Named()})
command_gate()
"""


def test_a_signal_that_comes_out_as_another_error_ends_a_node_quietly(domain):
    """All nodes are made by then, and end as they do after a signal."""
    done = subprocess.run([sys.executable, "-c", WRAPPED], capture_output=True, text=True, env=domain.environment())
    assert done.returncode == 0 and "Traceback" not in done.stdout + done.stderr


LAUNCH = """
import os
import signal
import socket
from pkm_twin.ros.signals import leave_interrupts_to_launch
reads, writes = socket.socketpair()
writes.setblocking(False)
signal.set_wakeup_fd(writes.fileno())
leave_interrupts_to_launch()
for _ in range(2):
    os.kill(os.getpid(), signal.SIGINT)
print(list(reads.recv(9)))
own = lambda *_: None
signal.signal(signal.SIGINT, own)
leave_interrupts_to_launch()
print(signal.getsignal(signal.SIGINT) is own)
"""


def test_an_interrupt_of_a_launch_is_in_its_socket_and_nowhere_else():
    done = subprocess.run([sys.executable, "-c", LAUNCH], capture_output=True, text=True)
    assert done.stdout.splitlines() == [f"{[int(signal.SIGINT)] * 2}", "True"], done.stderr
