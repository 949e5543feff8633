# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Packages of exported C that several files of tests run."""

import pytest

from pkm_twin.export.c_package import c_package
from test.support.robots import loaded

from .c_programs import Package


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A machine whose code compiles in a moment."""
    robot = loaded("five_bar")
    return robot, Package(tmp_path_factory.mktemp("c"), c_package(robot))
