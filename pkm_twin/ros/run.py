# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Run a node's process: start, executor, signals, end."""

from __future__ import annotations

import ctypes
import faulthandler
import gc
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.signals import SignalHandlerOptions

from pkm_twin.errors import PkmTwinError, plain_warnings
from pkm_twin.ros.context import middleware_arguments
from pkm_twin.ros.node import TwinNode
from pkm_twin.ros.parameters import UnknownParametersError
from pkm_twin.ros.signals import NodeSignals, ignore_signals
from pkm_twin.threads import one_blas_thread


def set_priority(priority: int) -> None:
    """Schedule all threads of this process by SCHED_FIFO, and keep its pages in memory (Linux).

    Threads that start later inherit it from the one that starts them.

    :param priority: 1 to 99, before every thread with a lower one and every ordinary process.
    :raises OSError: the user may not (``ulimit -r``, ``ulimit -l``), or the system has none.
    """
    if not hasattr(os, "sched_setscheduler"):
        raise OSError("this system has no SCHED_FIFO")
    parameter = os.sched_param(priority)
    for thread in Path("/proc/self/task").iterdir():
        try:
            os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, parameter)
        except ProcessLookupError:
            continue  # The thread has ended.
        except OSError as error:
            raise OSError(f"SCHED_FIFO: {error.strerror}") from None
    if ctypes.CDLL(None, use_errno=True).mlockall(1 | 4):  # MCL_CURRENT | MCL_ONFAULT
        raise OSError(f"locking memory: {os.strerror(ctypes.get_errno())}")


class _Executor:
    """Spin an rclpy executor one iteration at a time; an EventsExecutor if all nodes request it."""

    def __init__(self, nodes: Sequence[TwinNode]) -> None:
        events = all(node.executor_kind == "events" for node in nodes)
        self._nodes = nodes
        self._executor = EventsExecutor() if events else SingleThreadedExecutor()
        for node in nodes:
            self._executor.add_node(node)
        # The events executor needs a timeout to end; the single one creates a timer per timeout.
        self._patience = 0.5 if events else None

    def spin(self, ended: Callable[[], bool]) -> None:
        """Run callbacks, and between them a step of the waiting tasks, until ``ended``."""
        nodes, turn, patience = self._nodes, self._executor.spin_once, self._patience
        going = nodes[0].context.ok
        while going() and not ended():
            try:
                turn(0.0 if any(node.busy for node in nodes) else patience)
                for node in nodes:
                    node.end_turn()
            except (KeyboardInterrupt, ExternalShutdownException):
                raise
            except Exception as error:
                # An error in rclpy's own code around a callback.
                for node in nodes:
                    node.caught("rclpy", error)

    def close(self) -> None:
        """Stop message delivery, so that the nodes can be destroyed one by one."""
        self._executor.shutdown()


def run(*factories: Callable[[], TwinNode], arguments: Sequence[str] | None = None) -> int:
    """Run a node, or several in one executor, until SIGINT, SIGTERM or SIGHUP.

    The middleware does not handle signals, because it would close the topics at once: a signal ends
    the spinning at its next event, then :meth:`TwinNode.shutdown` is called while the topics exist.
    After that, a node may finish within 1 s (a launcher gives five), and the process must end within
    3 s, because threads of rclpy and the middleware can deadlock.

    :returns: 0 after a signal, 1 if a node rejects its configuration.
    """
    nodes: list[TwinNode] = []
    executor: _Executor | None = None
    signals = NodeSignals()
    try:
        try:
            signals.raises = True
            if signals.came:
                raise KeyboardInterrupt
            rclpy.init(
                args=middleware_arguments(sys.argv if arguments is None else arguments),
                signal_handler_options=SignalHandlerOptions.NO,
            )
            with plain_warnings():
                for factory in factories:
                    nodes.append(factory())
            one_blas_thread()
            node = max(nodes, key=lambda n: n.thread_priority)
            if node.thread_priority:
                try:
                    set_priority(node.thread_priority)
                except OSError as error:
                    text = f"thread_priority: {node.thread_priority} is not possible here: {error}"
                    node.report_limitation(text)
            # Everything loaded by now stays: exclude it from garbage collection.
            gc.collect()
            gc.freeze()
        finally:
            signals.raises = False
        executor = _Executor(nodes)
        executor.spin(lambda: signals.came)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (PkmTwinError, ParameterException, RuntimeError) as error:
        if executor is not None:
            raise
        if signals.came:
            return 0  # Where the interrupt was in an import, say, it may come out as another error.
        # Errors of the middleware (arguments, types, QoS overrides) have many lines.
        lines = error.lines if isinstance(error, UnknownParametersError) else [str(error)]
        for line in lines:
            print(f"cannot start: {' '.join(line.split())}", file=sys.stderr)
        return 1
    finally:
        ignore_signals()
        for node in nodes:
            node.shutdown()
        end = time.monotonic() + 1.0
        if executor is not None:
            executor.spin(lambda: not any([n.shutting_down for n in nodes]) or time.monotonic() > end)
        # A thread without Python's lock ends the process if it hangs, and prints where.
        faulthandler.dump_traceback_later(3.0, exit=True)
        if executor is not None:
            executor.close()
        for node in nodes:
            node.destroy_node()
        rclpy.get_default_context().try_shutdown()
    return 0
