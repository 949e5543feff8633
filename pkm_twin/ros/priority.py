# SPDX-License-Identifier: Apache-2.0
"""Real-time scheduling of a node's process, as controller_manager has it for its control thread."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path
from typing import Final

_MCL_CURRENT: Final = 1
_MCL_ONFAULT: Final = 4


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
            continue  # It has ended meanwhile.
        except OSError as error:
            raise OSError(f"SCHED_FIFO: {error.strerror}") from None
    if ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_ONFAULT):
        raise OSError(f"locking memory: {os.strerror(ctypes.get_errno())}")
