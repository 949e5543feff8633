# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Signals end a process once and for all."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from test.commands.conftest import REPOSITORY

SCRIPT = """
import signal, sys, time
from pkm_twin.ros.signals import first_signal
before = [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)]
with first_signal(KeyboardInterrupt):
    pass
assert before == [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)]
with first_signal(lambda: SystemExit(7)):
    try:
        with first_signal(KeyboardInterrupt):
            try:
                print("ready", flush=True)
                time.sleep(60)
            finally:
                print("caught", flush=True)
                # A clean-up, in which further signals come.
                time.sleep(0.3)
    except KeyboardInterrupt:
        time.sleep(0.3)
        print("cleaned up", flush=True)
"""


def environment():
    return {**os.environ, "PYTHONPATH": str(REPOSITORY)}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_only_the_first_signal_counts(number):
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
    )
    assert process.stdout.readline() == "ready\n"
    for _ in range(3):
        process.send_signal(number)
    assert process.stdout.readline() == "caught\n"
    while process.poll() is None:
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGTERM)
        time.sleep(0.001)
    out, err = process.communicate()
    assert (process.returncode, out, err) == (0, "cleaned up\n", "")


def test_an_interrupt_of_executed_text_is_caught_as_any_other():
    """As data classes are made of text: Python would end by the signal after all."""
    script = """
import signal
from pkm_twin.ros.signals import first_signal
try:
    with first_signal(KeyboardInterrupt):
        exec("signal.raise_signal(signal.SIGINT)")
except KeyboardInterrupt:
    print("caught")
"""
    done = subprocess.run([sys.executable, "-c", script], env=environment(), capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "caught\n", "")


def test_an_exception_that_was_lost_does_not_make_a_process_deaf():
    script = """
import signal, time
from pkm_twin.ros import signals as interrupts
interrupts.IGNORE_TIME = 0.2
with interrupts.first_signal(lambda: SystemExit(7)):
    try:
        signal.raise_signal(signal.SIGINT)
    except SystemExit:
        pass  # as a callback of a C library does it
    signal.raise_signal(signal.SIGINT)
    time.sleep(0.3)
    signal.raise_signal(signal.SIGINT)
"""
    done = subprocess.run([sys.executable, "-c", script], env=environment())
    assert done.returncode == 7


def open_files(process):
    """What a process has open; one that is closed meanwhile is left out."""
    names = set()
    with contextlib.suppress(OSError):
        for link in Path(f"/proc/{process}/fd").iterdir():
            with contextlib.suppress(OSError):
                names.add(os.readlink(link))
    return names


def test_an_interrupted_command_has_its_own_exit_code(tmp_path):
    """Neither good nor bad: a script has to tell them apart."""
    path = tmp_path / "motion.csv"
    joints = [f"arm_{i}.position" for i in (1, 2, 3)]
    rows = (f"{0.001 * k:.3f},0.1,0.2,0.3" for k in range(400_000))
    path.write_text("\n".join([",".join(["time", *joints]), *rows]), encoding="utf-8")
    process = subprocess.Popen(
        [sys.executable, "-m", "pkm_twin.apps.cli", "torques", "delta_cu", str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env=environment(),
    )
    # As soon as it reads, which takes a while.
    while process.poll() is None and str(path.resolve()) not in open_files(process.pid):
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    assert (process.returncode, out) == (130, "")
    assert "Traceback" not in err
