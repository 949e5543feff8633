# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The nodes' command lines, with and without ROS."""

import os
import subprocess
import sys

import pytest

from test.nodes.harness import REPOSITORY

NODES = ("delta_dynamics", "command_gate", "stiffness_monitor")
WITHOUT = "import sys; sys.modules['rclpy'] = None; "


def run(node, *arguments, before=""):
    code = f"{before}from pkm_twin.apps.nodes import {node}; {node}()"
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("before", ["", WITHOUT])
@pytest.mark.parametrize("node", NODES)
def test_help_and_version_end_at_once(node, before):
    for option in ("--help", "-h"):
        done = run(node, option, before=before)
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout.startswith(f"usage: {node} ")
    done = run(node, "--version", "--ros-args", "-p", "a:=1", before=before)
    assert (done.returncode, done.stdout.count("\n")) == (0, 1)


@pytest.mark.parametrize("node", NODES)
def test_an_argument_that_is_none_is_refused(node):
    done = run(node, "mechanism:=delta")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "'mechanism:=delta'" in line
    assert "--ros-args -p NAME:=VALUE" in line


@pytest.mark.parametrize("node", NODES)
def test_without_ros_one_line_says_what_is_missing(node):
    done = run(node, before=WITHOUT)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"cannot start: {node} needs ROS 2: source its setup, or pip install")
