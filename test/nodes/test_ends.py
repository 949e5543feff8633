# SPDX-License-Identifier: Apache-2.0
"""A node whose parent ignores signals, and one that is sent thousands of bad messages."""

import signal
import subprocess
import sys
import tempfile
import time

import pytest

from test.nodes.harness import DEADLINE, counts_of

pytest.importorskip("rclpy", exc_type=ImportError)


from test.nodes.twin import MODULE, launched, state
from test.support.waiting import wait_until


def deaf():
    """As a background job of a shell, or under nohup."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_a_node_whose_parent_ignores_them(domain, number):
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", MODULE],
            stdout=output,
            stderr=subprocess.STDOUT,
            cwd=tempfile.gettempdir(),
            env=domain.environment(),
            preexec_fn=deaf,
        )
        try:
            end = time.monotonic() + DEADLINE
            while not said(output) and time.monotonic() < end:
                time.sleep(0.05)
            process.send_signal(number)
            assert process.wait(DEADLINE) == 0, said(output)
        finally:
            process.kill()
            process.wait()
        assert "Traceback" not in said(output)


@pytest.mark.parametrize("command", ["node", "guard-check"])
def test_a_home_that_cannot_be_written_costs_log_files_alone(domain, command):
    """The middleware itself would not start. In /proc not even root makes a folder."""
    environment = domain.environment() | {"ROS_LOG_DIR": "/proc/none/log"}
    program = {
        "node": [sys.executable, "-m", MODULE],
        "guard-check": [
            sys.executable, "-m", "pkm_twin.apps.cli", "guard-check", "--wait", "0.1", "/none"
        ],
    }[command]  # fmt: skip
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(
            program, stdout=output, stderr=subprocess.STDOUT, cwd=tempfile.gettempdir(),
            env=environment,
        )  # fmt: skip
        try:
            wait_until(
                lambda: "joints" in said(output) or process.poll() is not None,
                lambda: time.sleep(0.05),
                DEADLINE,
                "a robot's joints or an end",
            )
            process.send_signal(signal.SIGINT)
            assert process.wait(DEADLINE) == (0 if command == "node" else 1), said(output)
        finally:
            process.kill()
            process.wait()
        lines = [line for line in said(output).splitlines() if "no log files: " in line]
        assert len(lines) == 1 and "set ROS_LOG_DIR" in lines[0]
        assert "Traceback" not in said(output)


def said(output):
    output.seek(0)
    return output.read()


def test_a_flood_of_refusals_is_a_line_a_second(peer, launch):
    began = time.monotonic()
    twin = launched(peer, launch, "flooded")
    peer.until(peer.matched, 90.0)
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
