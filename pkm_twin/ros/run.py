# SPDX-License-Identifier: Apache-2.0
"""A node's process: start, executor, signals, end."""

from __future__ import annotations

import gc
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Final

import rclpy
from rclpy.exceptions import InvalidHandle, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.signals import SignalHandlerGuardCondition, SignalHandlerOptions

from pkm_twin.errors import PkmTwinError, plain_warnings
from pkm_twin.ros.context import middleware_arguments
from pkm_twin.ros.node import TwinNode
from pkm_twin.ros.parameters import UnknownParametersError
from pkm_twin.ros.signals import (
    SIGNALS,
    first_signal,
    ignore_signals,
    noted_signals,
    nothing_raised,
)
from pkm_twin.threads import one_blas_thread

LOOK: Final = 0.5
"""How often the events executor looks whether the context has ended, s."""


class _NeverMade:
    """For the handle of a guard that a signal keeps from being made: its end is quiet then."""

    def __enter__(self) -> None:
        raise InvalidHandle("never made")

    def __exit__(self, *_: object) -> None:
        """Nothing was entered."""


SignalHandlerGuardCondition._GuardCondition__gc = _NeverMade()


class _Executor(SingleThreadedExecutor):
    """One whose making a signal may interrupt: rclpy's own end asks for what is not there then."""

    _sigint_gc = None


def spin(node: TwinNode, ended: Callable[[], bool] = lambda: False) -> None:
    """Run callbacks, and between them a step of what waits, until the context ends.

    :param ended: asked between two callbacks; true ends it too.
    """
    if not node.context.ok():
        return  # A signal has come before: rclpy cannot make an executor any more, and prints so.
    events = node.executor_kind == "events"
    executor = EventsExecutor() if events else _Executor()
    executor.add_node(node)
    # Without a bound the one waits for ever; with one the other makes a timer a message.
    patience = LOOK if events else None
    going, turn = node.context.ok, executor.spin_once
    while going() and not ended():
        try:
            turn(0.0 if node.busy else patience)
            node.turned()
        except (KeyboardInterrupt, ExternalShutdownException):
            raise
        except Exception as error:
            # The last line of defence: rclpy's own code, on the way to a callback or back.
            node.caught("rclpy", error)


def run(
    factory: Callable[[], TwinNode],
    arguments: Sequence[str] | None = None,
    *,
    farewell: bool = False,
) -> int:
    """Run a node until SIGINT or SIGTERM.

    :param farewell: call :meth:`TwinNode.farewell` at the end. Signals are then not the
        middleware's, which would close the topics at once, and end the node at its next event.
    :returns: 0 after a signal, 1 where the node refuses its configuration.
    """
    node: TwinNode | None = None
    begun = False
    try:
        # Until it spins: the middleware's handler for SIGINT calls this one, that for SIGTERM none.
        with first_signal(KeyboardInterrupt, SIGNALS if farewell else (signal.SIGINT,)):
            rclpy.init(
                args=middleware_arguments(sys.argv if arguments is None else arguments),
                signal_handler_options=SignalHandlerOptions.NO if farewell else None,
            )
            begun = True
            with plain_warnings():
                node = factory()
            one_blas_thread()
            # What is loaded by now stays: the collector need not look at it again.
            gc.collect()
            gc.freeze()
            if not farewell:
                # The middleware's handler ends its context, and with it the loop.
                with nothing_raised():
                    spin(node)
                return 0
            with noted_signals() as asked:
                spin(node, asked)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (PkmTwinError, ParameterException, RuntimeError) as error:
        if begun and not rclpy.ok():
            return 0  # A signal in the middle of a call of the middleware.
        if node is not None:
            raise
        # The middleware's own refusals (arguments, types, QoS overrides) have many lines.
        lines = error.lines if isinstance(error, UnknownParametersError) else [str(error)]
        for line in lines:
            print(f"refused to start: {' '.join(line.split())}", file=sys.stderr)
        return 1
    finally:
        ignore_signals()
        if node is not None:
            if farewell:
                node.farewell()
            node.destroy_node()
        # rclpy.try_shutdown would bring the old signal handlers back.
        rclpy.get_default_context().try_shutdown()
    return 0
