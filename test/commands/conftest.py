# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Run `pkm-twin` in a process of its own, and cut or spoil recorded bags."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pkm_twin.apps.commands.check import Check, check_one
from pkm_twin.bags.reader import BagWriter, open_bag
from pkm_twin.report import plots
from test.support.command import Result

REPOSITORY = Path(__file__).resolve().parents[2]
DELTA = REPOSITORY / "bags/delta_cu_pick_and_place.mcap"
COLLISION = REPOSITORY / "bags/delta_cu_collision.mcap"
MILLING = REPOSITORY / "bags/prru_milling.mcap"
STIFFNESS = REPOSITORY / "bags/upr_rpu_milling.mcap"
JOINTS = "/joint_states"
CYCLE = ("path", "delta", "--cycle", "25,305,25", "--fastest")


@pytest.fixture(scope="session")
def process():
    """Run a command as a process, as a script does."""

    def run(*arguments, folder=None):
        done = subprocess.run(
            [sys.executable, "-m", "pkm_twin.apps.cli", *map(str, arguments)],
            capture_output=True,
            text=True,
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        )
        return Result(done.returncode, done.stdout, done.stderr)

    return run


@pytest.fixture(scope="module", autouse=True)
def coarse_pictures():
    """Pictures of few pixels, with their parts where matplotlib puts them at first."""
    drawn = plots.render

    def coarse(figure, dpi, form="png"):
        figure.set_layout_engine("none")
        return drawn(figure, 30, form)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plots, "render", coarse)
        yield


def rewrite(source, target, change=None, begin=0.0, seconds=1.2, metadata=None, topics=None):
    """Copy a part of a bag, each decoded message through ``change``: None leaves it out.

    ``change(topic, message, time)`` gets the time since the bag's first message, s.
    """
    bag = open_bag(source)
    kept = dict(bag.report.metadata) if metadata is None else metadata
    names = [name for name in bag.report.topics if topics is None or name in topics]
    first = bag.report.start_time
    with BagWriter(target, metadata=kept, flush_period=None) as writer:
        for name in names:
            info = bag.report.topics[name]
            writer.add_topic(name, info.type, definition=info.definition)
        for m in bag.messages(names):
            time = (m.log_time - first) * 1e-9
            if time >= begin + seconds:
                break
            if time < begin:
                continue
            message = m.data if change is None else change(m.topic, m.message, time)
            if message is not None:
                writer.write(m.topic, message, m.log_time)
    return target


def checked(bag, **options):
    """The report of `check`, without what `fit` finds, which takes some seconds."""
    return check_one(Check(bag=bag, **options), bag, thorough=False)


def items_of(report):
    """Judged items of a report's data by their names."""
    return {item["what"]: item for item in report.data["items"]}


@pytest.fixture(scope="session")
def sample(tmp_path_factory):
    """A part of the Delta's recording, before the payload; not to be changed."""
    return rewrite(DELTA, tmp_path_factory.mktemp("sample") / "sample.mcap", seconds=1.5)


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """Sixty joint states of it, to be damaged many times."""
    path = tmp_path_factory.mktemp("tiny") / "tiny.mcap"
    return rewrite(DELTA, path, seconds=0.06, topics=["/joint_states"])
