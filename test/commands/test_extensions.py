# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Another package, installed, adds a command, a kind of map and an export by entry points."""

import json
import os
import re
import subprocess
import sys
from importlib.util import find_spec

import pytest

from test.support.command import REPOSITORY, Result

PAGE = (REPOSITORY / "docs/new_machine.md").read_text(encoding="utf-8")
PROJECT = """
[project]
name = "my_tools"
version = "1.0"

[tool.setuptools]
py-modules = ["my_tools"]
"""
BROKEN = """
absent = "my_tools:ABSENT"
number = "my_tools:setting"
info = "my_tools:height"
"""
"""Commands: two that cannot be loaded, and one that has the name of another."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Run ``pkm-twin`` where the page's package is installed."""
    pytest.importorskip("pip")
    folder = tmp_path_factory.mktemp("extensions")
    blocks = dict(re.findall(r"^```(toml|python)\n(.*?)^```", PAGE.split("## Your own command")[1], re.M | re.S))
    (folder / "my_tools.py").write_text(blocks["python"], encoding="utf-8")
    points = blocks["toml"].replace('commands"]\n', 'commands"]' + BROKEN)
    (folder / "pyproject.toml").write_text(PROJECT + points, encoding="utf-8")
    target = folder / "site"
    options = ("--no-deps", "--no-index", "--no-build-isolation", "--quiet")
    install = [sys.executable, "-m", "pip", "install", *options, "--target", target, folder]
    subprocess.run(install, check=True, capture_output=True)
    paths = os.pathsep.join(map(str, (target, REPOSITORY)))

    def call(*words):
        done = subprocess.run(
            [sys.executable, "-m", "pkm_twin.apps.cli", *words],
            capture_output=True,
            text=True,
            cwd=folder,
            env=os.environ | {"PYTHONPATH": paths},
        )
        return Result(done.returncode, done.stdout, done.stderr)

    return call


def test_its_command_and_export_have_options_json_and_errors(run):
    one, other = run("height", "delta"), run("export", "height", "delta", "--floor", "-1", "--json")
    assert one.code == other.code == 0, one.err + other.err
    height = json.loads(other.out)["height"]
    assert float(one.out.split()[0]) == pytest.approx(height - 1.0, abs=1e-3)
    wrong = run("height", "delta", "--floor", "-11")
    assert wrong.code == 2 and "'-11'" in wrong.one_line_error()


@pytest.mark.long
def test_its_map_is_computed_and_plotted_again(run):
    if not all(map(find_spec, ("xarray", "h5netcdf", "h5py"))):
        pytest.skip("maps need xarray, h5netcdf and h5py")
    words = ("map", "delta", "height", "--points", "60", "--jobs", "1", "--no-picture", "--json")
    assert (made := run(*words)).code == 0, made.err
    shown = run("map", "show", "delta_height.nc", "--json")
    assert json.loads(shown.out)["worst"] == json.loads(made.out)["worst"] != []


def test_help_lists_it_and_warns_of_what_cannot_be_loaded(run):
    found = run("--help")
    assert found.code == 0
    robots = found.out.partition("Robots:")[2].partition(":")[0]
    assert re.search(r"^  height +Print the height", robots, re.M)
    assert [name for name in ("ABSENT", "setting") if name in found.err] == ["ABSENT", "setting"]
    assert len(found.err.splitlines()) == 2
    assert "height" in run("map", "delta", "--help").out
    error = run("absent").one_line_error()
    assert "my_tools:ABSENT" in error and "click" in error
    assert "height of the floor" not in run("info", "--help").out
