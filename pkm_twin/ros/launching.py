# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Check launch arguments before the first action, so that a failing launch starts no node."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Mapping
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType

from ament_index_python.packages import PackageNotFoundError, get_package_prefix

from pkm_twin.errors import PkmTwinError
from pkm_twin.mechanisms.catalogue import load
from pkm_twin.robot.robot import Robot

LOG_LEVELS = ("debug", "info", "warn", "error", "fatal")


def is_installed(package: str) -> bool:
    """Return whether a package is in a sourced workspace."""
    try:
        get_package_prefix(package)
    except PackageNotFoundError:
        return False
    return True


def check_executables(pairs: Iterable[tuple[str, str]]) -> None:
    """Check that all programs of a launch exist, given as package and executable.

    :raises RuntimeError: a package is in no sourced workspace, or has no such program.
    """
    missing = []
    for package, executable in dict.fromkeys(pairs):
        if not is_installed(package):
            missing.append(f"package {package} is in no sourced workspace")
        elif not Path(get_package_prefix(package), "lib", package, executable).exists():
            missing.append(f"package {package} has no program {executable}")
    if missing:
        raise RuntimeError(f"nothing was started: {'; '.join(dict.fromkeys(missing))}")


def read_choice(given: Mapping[str, str], name: str, choices: Iterable[str]) -> str:
    """Return the value of a launch argument that has to be one of some words.

    :raises RuntimeError: it is none of them.
    """
    words = list(choices)
    if given[name] not in words:
        raise RuntimeError(f"{name}: {given[name]!r} is not one of {', '.join(words)}")
    return given[name]


def read_flag(given: Mapping[str, str], name: str) -> bool:
    """Return the value of a launch argument that has to be true or false.

    :raises RuntimeError: it is neither.
    """
    value = given[name].lower()
    if value not in ("true", "false"):
        raise RuntimeError(f"{name}: {given[name]!r} is neither true nor false")
    return value == "true"


def load_robot(name: str) -> Robot:
    """Load the robot of a launch argument.

    :raises RuntimeError: there is no such robot, or its file is rejected.
    """
    try:
        return load(name)
    except PkmTwinError as error:
        raise RuntimeError(f"robot: {error}") from None


def load_launch_file(path: Path) -> ModuleType:
    """Import another launch file: its nodes are made, and checked, before anything starts."""
    loader = SourceFileLoader(path.name.partition(".")[0] + "_launch", str(path))
    spec = importlib.util.spec_from_loader(loader.name, loader)
    if spec is None:
        raise RuntimeError(f"{path} is no launch file")
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module
