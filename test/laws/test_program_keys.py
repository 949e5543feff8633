# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A program is compiled again exactly if its content or a source that writes it has changed."""

import shutil
import sys
from functools import partial
from pathlib import Path

import pytest

from delta_dynamics.torques.reactions import needed_wrench_kernel
from delta_dynamics.torques.virtual_work import torque_kernel
from pkm_twin.codegen import key as keys
from pkm_twin.codegen.key import EMPTY
from stiffness_monitor.derivatives import compliance_gradient
from stiffness_monitor.programs import Elastic
from test.support.robots import MASSIVE, has, load, partly_long
from test.support.sources import PACKAGES, ROOT, room, sources

CODEGEN = "pkm_twin.codegen.code"


def kernels(robot):
    found = {
        "forward": robot.engine.forward,
        "inverse": robot.engine.inverse,
        "torques": torque_kernel(robot),
        "loads": needed_wrench_kernel(robot),
    }
    if has(robot, "structure"):
        elastic = robot.cached(Elastic)
        found |= {"response": elastic.response, "gradient": compliance_gradient(elastic)}
    return found


@pytest.mark.parametrize("name", partly_long(MASSIVE, "five_bar"))
def test_a_key_has_all_sources_that_write_its_program(name):
    """Whose functions run while a program is written, and whose the key has."""
    for kernel in kernels(load(name)).values():
        run = set()
        before = sys.gettrace()
        sys.settrace(lambda frame, *_, run=run: run.add(frame.f_code.co_filename))
        try:
            kernel.code.build()
        finally:
            sys.settrace(before)
        written = {str(path) for path in sources().values()} & run
        # The engine hands its machine to the writers: it holds the program, and writes none of it.
        written.discard(str(sources()["pkm_twin.kinematics.engine"]))
        assert written and written <= kernel.code.key.sources


def test_a_key_has_no_node_and_no_command():
    at = {str(path): module for module, path in sources().items()}
    for kernel in kernels(load("delta_cu")).values():
        rooms = {room(at[path]) for path in kernel.code.key.sources}
        assert {"pkm_twin.codegen", "pkm_twin.kinematics", "pkm_twin.machine"} <= rooms
        assert not {name for name in rooms if name.endswith(("node", ".ros", ".apps", ".maps"))}


@pytest.fixture
def forgetful():
    """Sources are read anew when the result is called."""

    def forget():
        for known in (keys._find_sources, keys._find_imports, keys._module_file, keys._read_source):
            known.cache_clear()

    yield forget
    forget()


def test_keys_follow_the_sources_that_write_a_program(tmp_path, monkeypatch, forgetful):
    """On a copy of the sources, one of which changes at a time."""
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("*.pyc", "maps"))
    found = {name: kernel.code.key for name, kernel in kernels(load("delta_cu")).items()}
    for module in {CODEGEN}.union(*(key.writers for key in found.values())):
        own = sys.modules[module]
        copy = tmp_path / Path(own.__file__).relative_to(ROOT)
        monkeypatch.setattr(own, "__file__", str(copy))

    def changed(source):
        forgetful()
        before = {name: key.digest() for name, key in found.items()}
        with (tmp_path / source).open("a") as file:
            file.write("\nFURTHER = 0\n")
        forgetful()
        return {name for name, key in found.items() if key.digest() != before[name]}

    rigid, elastic = {"torques", "loads"}, {"response", "gradient"}
    for source in ("codegen/expressions.py", "codegen/llvm.py", "kinematics/motion.py"):
        assert changed(f"pkm_twin/{source}") == set(found)
    assert changed("pkm_twin/machine/joints.py") == set(found)
    assert changed("delta_dynamics/torques/virtual_work.py") == rigid
    assert changed("stiffness_monitor/frame.py") == elastic
    for source in ("apps/cli.py", "apps/fit.py", "ros/node.py", "mechanisms/delta.py"):
        assert not changed(f"pkm_twin/{source}")
    for source in ("delta_dynamics/nodes/twin.py", "stiffness_monitor/node.py"):
        assert not changed(source)


def test_keys_follow_the_content_and_the_writers():
    def one(*_):
        """A writer of this module."""

    plain = EMPTY.extend("a", one)
    assert plain == EMPTY.extend("a", one)
    assert plain.digest() == EMPTY.extend("a", one).digest()
    others = [
        EMPTY.extend("b", one),
        EMPTY.extend("a", load),
        EMPTY.extend("a", partial(one, load)),
        plain.extend("a"),
    ]
    assert len({key.digest() for key in (plain, *others)}) == len({plain, *others}) == 5
    assert plain.digest("x") != plain.digest()


def test_a_writer_without_a_file_is_another_one_in_every_process(monkeypatch):
    def one(*_):
        """A writer of no module."""

    saved = EMPTY.extend("a").digest()
    one.__module__ = "of_no_file"
    first = EMPTY.extend("a", one).digest()
    assert first == EMPTY.extend("a", one).digest() != saved
    monkeypatch.setattr(keys, "_UNSAVED", "another process")
    assert EMPTY.extend("a", one).digest() != first
