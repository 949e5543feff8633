# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
import fcntl
import gc
import os
import signal
import sys
from pathlib import Path

# The cores have tests of their own, and matrices are small. Read when numpy is loaded.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pytest
from hypothesis import settings

from pkm_twin.mechanisms.catalogue import robot_of_data
from test.support.command import Commands
from test.support.robots import (  # noqa: F401
    LIMITED,
    both_ways,
    finite_difference,
    load,
    parameters_of,
    random_joints,
    random_poses,
)

# A loaded machine is no fault.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")

# A background job of a shell ignores SIGINT, and so would every process started from here.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """In a fresh clone one worker writes the bytecode of the tests, and the others read it.

    What is collected stays: to look for garbage in it takes a fifth of the time.
    """
    here = Path(__file__)
    gc.disable()
    with here.open() as lock:
        # Of the folder that is collected last.
        if not sys.dont_write_bytecode and not any(here.parent.glob("view/__pycache__/test_*")):
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                fcntl.flock(lock, fcntl.LOCK_SH)
        try:
            return (yield)
        finally:
            gc.enable()


def pytest_collection_modifyitems(items):
    """Files that wait for nodes stand evenly among those that compute, and end before them.

    Workers take files in this order; a waiting one leaves its core to another. Short ones are last,
    the shorter the later, so that no worker is left alone with a long one.
    """
    files = list(dict.fromkeys(item.path for item in items))
    waiting = [path for path in files if path.parent.name == "nodes"]
    place = {path: k / len(waiting) * 0.85 for k, path in enumerate(waiting)}
    others = [path for path in files if path not in place]
    short = [path for path in others if path.parent.name == "laws"]
    short.sort(key=lambda path: -path.stat().st_size)
    others = [path for path in others if path not in short] + short
    place |= {path: k / len(others) for k, path in enumerate(others)}
    items.sort(key=lambda item: place[item.path])


def pytest_collection_finish():
    """What is there by now stays: it is not looked through for garbage again and again."""
    gc.freeze()


@pytest.fixture
def rng():
    return np.random.default_rng(20240229)


@pytest.fixture
def twin(capsys):
    """Run a command in this process: twin("info", "delta_cu")."""
    return Commands(capsys)


@pytest.fixture
def variant():
    """Make a shipped robot with some of its parameters changed: variant(name, geometry=...)."""

    def make(name, **sections):
        data = parameters_of(name)
        for section, values in sections.items():
            if isinstance(values, dict):
                data.setdefault(section, {}).update(values)
            else:
                data[section] = values
        return robot_of_data(data, name), data

    return make
