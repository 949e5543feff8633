# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Processes and a ROS node for all trials."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor

DEADLINE = 120.0
"""Longest wait for a condition, s."""


def find_executable(name: str) -> str:
    """Find the file of ``ros2 run pkm_twin NAME``; without a workspace, the script."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix, "lib", "pkm_twin", name)
        if prefix and path.is_file():
            return str(path)
    return str(Path(sys.executable).with_name(name))


class Process:
    """A command in its own session, with default signal handlers."""

    def __init__(self, *command: str, environment: dict[str, str] | None = None) -> None:
        self._file = tempfile.TemporaryFile("w+")  # noqa: SIM115
        inherited = dict(os.environ)
        # The wheels of ROS set their library path at each start of an interpreter.
        if "site-packages" not in inherited.get("LD_LIBRARY_PATH", ""):
            inherited.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=self._file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env=inherited | {"PYTHONUNBUFFERED": "1"} | (environment or {}),
            preexec_fn=_restore_signals,
        )

    @property
    def output(self) -> str:
        """Output of the process so far."""
        self._file.seek(0)
        return self._file.read()

    def alive(self) -> bool:
        """Return whether the process runs."""
        return self.process.poll() is None

    def signal(self, number: int, *, group: bool = False) -> None:
        """Send a signal to the process, or like a terminal to its whole group."""
        with contextlib.suppress(ProcessLookupError):
            if group:
                os.killpg(self.process.pid, number)
            elif self.alive():
                self.process.send_signal(number)

    def close(self) -> None:
        """End the whole session."""
        for number in (signal.SIGINT, signal.SIGKILL):
            self.signal(number, group=True)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(10.0)
        self._file.close()

    def usage(self) -> float:
        """Return the processor time of the process and its threads so far, s."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def memory(self) -> float:
        """Return the resident memory, MB."""
        pages = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _restore_signals() -> None:
    """Restore the default signals, because a background job of a shell ignores SIGINT."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def node(*names: str, parameters: Iterable[str] = (), remap: Iterable[str] = ()) -> Process:
    """Start a node, or several in one process, with NAME:=VALUE and FROM:=TO."""
    words = [word for p in parameters for word in ("-p", p)]
    words += [word for r in remap for word in ("-r", r)]
    program = [find_executable(names[0])] if len(names) == 1 else [find_executable("composed"), *names]
    return Process(*program, *(["--ros-args", *words] if words else []))


class Peer:
    """A node that subscribes to and publishes on the topics of the nodes under test."""

    def __init__(self, name: str = "trial") -> None:
        rclpy.init(args=[])
        self.node = rclpy.create_node(name)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)

    def hear(self, kind: Any, topic: str, qos: Any = 1000) -> list[Any]:
        """Subscribe to a topic, and return the list of its messages."""
        heard: list[Any] = []
        self.node.create_subscription(kind, topic, heard.append, qos)
        return heard

    def spin(self, seconds: float) -> None:
        """Receive messages for a time, s."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)

    def until(
        self,
        condition: Callable[[], Any],
        what: str | Callable[[], str],
        timeout: float = DEADLINE,
        every: float = 0.005,
        needs: Iterable[Process] = (),
    ) -> Any:
        """Receive messages until a condition holds; return the condition's value.

        :param needs: processes without which it cannot hold.
        :raises TimeoutError: the condition does not hold in time.
        :raises RuntimeError: one of the processes has ended.
        """
        end = time.monotonic() + timeout
        while not (found := condition()):
            for process in needs:
                if not process.alive():
                    raise RuntimeError(f"{process.process.args} has ended\n{process.output}")
            if time.monotonic() > end:
                raise TimeoutError(what if isinstance(what, str) else what())
            self._executor.spin_once(timeout_sec=every)
        return found

    def close(self) -> None:
        """End the node."""
        self.node.destroy_node()
        rclpy.try_shutdown()


@contextlib.contextmanager
def peer(name: str = "trial") -> Iterator[Peer]:
    """Yield a peer for the duration of a block."""
    made = Peer(name)
    try:
        yield made
    finally:
        made.close()


@contextlib.contextmanager
def closing(*processes: Process) -> Iterator[tuple[Process, ...]]:
    """End processes at the end of the block."""
    try:
        yield processes
    finally:
        for process in processes:
            process.close()
