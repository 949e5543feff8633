# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Limit linear algebra to one thread: for small matrices threads cost more time than they save."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

VARIABLES: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that the libraries read when they are loaded."""


def one_blas_thread() -> None:
    """Limit BLAS to one thread in this process and its children, unless the environment sets it.

    Libraries that are already loaded are limited only if threadpoolctl is installed.
    """
    for name in VARIABLES:
        os.environ.setdefault(name, "1")
    if "numpy" not in sys.modules:
        return
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        return
    threadpool_limits(limits=1, user_api="blas")


@contextmanager
def one_blas_thread_for_children() -> Iterator[None]:
    """Limit BLAS to one thread in processes started here, unless the environment sets it."""
    new = [name for name in VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(new, "1"))
    try:
        yield
    finally:
        for name in new:
            del os.environ[name]
