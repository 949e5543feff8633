# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The catalogue of mechanisms, and loading a robot by name or path."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from pkm_twin.errors import ParameterError, UnknownNameError, one_line, warn_of_file
from pkm_twin.machine import usd_file
from pkm_twin.machine.strict_yaml import read_yaml
from pkm_twin.robot.plausibility import find_implausible_numbers
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.urdf_read import UrdfSelection, read_tree

CATALOGUE: Final = {
    "delta": "pkm_twin.mechanisms.delta:Delta",
    "linear_delta": "pkm_twin.mechanisms.linear_delta:LinearDelta",
    "machine": "pkm_twin.mechanisms.machine:Machine",
    "prru": "pkm_twin.mechanisms.prru:Prru",
    "upr_rpu": "pkm_twin.mechanisms.upr_rpu:UprRpu",
}
"""Class of each mechanism, by name."""
TREE_SUFFIXES: Final = (".urdf", ".xml", ".mjcf", ".sdf", ".world", *usd_file.SUFFIXES)
"""Suffixes of files with links, joints and loop closures."""


def config_folder() -> Path:
    """Return the folder of the shipped robot files, inside the package in every installation."""
    packed = Path(__file__).resolve().parent.parent / "config"
    return packed if packed.is_dir() else packed.parent.parent / "config"


def robot_names() -> list[str]:
    """Names that :func:`load` knows."""
    return sorted(path.stem for path in config_folder().glob("*.yaml"))


def robot_path(robot: str | Path) -> Path:
    """Return the file of a robot's name or path.

    :raises UnknownNameError: no such name; the closest one is named.
    :raises ParameterError: a xacro file, which is a program that writes a URDF.
    """
    text = str(robot)
    if text.endswith(".xacro"):
        written = Path(text.removesuffix(".xacro")).with_suffix(".urdf").name
        raise ParameterError(
            text,
            "a xacro file",
            f"a URDF: run `xacro {Path(text).name} > {written}` and use that file",
        )
    if isinstance(robot, Path) or text.endswith((".yaml", ".yml", *TREE_SUFFIXES)) or "/" in text:
        return Path(robot)
    if text in robot_names():
        return config_folder() / f"{text}.yaml"
    near = [f"{text}{ending}" for ending in (".yaml", ".yml", *TREE_SUFFIXES)]
    files = [name for name in near if Path(name).is_file()]
    raise UnknownNameError("robot", text, [*robot_names(), *files])


def load(
    robot: str | Path,
    *,
    platform: str | None = None,
    base: str | None = None,
    actuated: Sequence[str] | None = None,
    pose: Sequence[str] | None = None,
    carry: bool = False,
) -> Robot:
    """Load a robot by its name in ``config/`` or from a YAML, URDF, MJCF, SDF or USD file.

    Changes that the import made to a user's file, and implausible numbers in it, give warnings
    (:class:`pkm_twin.errors.RobotWarning`), each once.

    :param robot: a name such as ``"delta_cu"``, or a path to a YAML, URDF, MJCF, SDF or USD file.
    :param platform: link that carries the tool, of a file of links; default: by usual names.
    :param base: link that is the ground, of such a file; default: the root. With ``base`` or
        ``actuated`` only what is between base and platform, or in a loop with that, is the robot.
    :param actuated: names of the actuated joints, in the order of q; default: as the file marks.
    :param pose: names of the pose coordinates, of x y z roll pitch yaw; default: rotations if they
        determine the platform, else the first that do.
    :param carry: whether parts beyond the platform are its payload, fixed as drawn, and those at
        other moving bodies parts of them; default: they are left out.
    :raises UnknownNameError: no such name; the closest one is named.
    :raises ParameterError: an invalid file, key, type or value, with its dotted name.
    """
    path, part = robot_path(robot), UrdfSelection(platform, base, actuated, pose, carry)
    if path.suffix in TREE_SUFFIXES:
        reading = read_tree(path, part)
        robot_read = robot_of_data(reading.description, path.stem)
        graph = robot_read.graph
        if robot_read.redundant:
            follows = [name for name in graph.actuated if name not in graph.leads]
            warn_of_file(
                path,
                f"{len(graph.actuated)} actuated joints ({reading.marked}) for "
                f"{len(graph.leads)} degrees of freedom: the positions of {', '.join(follows)} "
                f"follow from {', '.join(graph.leads)}",
            )
        for note in reading.notes:
            warn_of_file(path, note)
        return _warn_of_implausible(path, replace(robot_read, home_choice=reading.home, visuals=reading.visuals))
    for key in ("platform", "base", "actuated", "carry"):
        if getattr(part, key):
            raise ParameterError(key, getattr(part, key), f"none, because the file has its {key}")
    data = read_yaml(path)
    if pose is not None:
        data = {**data, "pose": list(pose)}
    return _warn_of_implausible(path, robot_of_data(data, path.stem))


def _warn_of_implausible(path: Path, robot: Robot) -> Robot:
    """Return the robot, after a warning of each implausible number in a user's file."""
    if path.parent != config_folder():
        for finding in find_implausible_numbers(robot):
            warn_of_file(path, finding.text)
    return robot


def robot_of_data(data: Mapping[str, Any], name: str) -> Robot:
    """Create a robot from the content of a robot file.

    :raises UnknownNameError: no such mechanism; the closest one is named.
    :raises ParameterError: a key, type or value that is refused, by its dotted name.
    """
    mechanism = data.get("mechanism")
    if mechanism is None:
        raise ParameterError("mechanism", None, f"one of {', '.join(sorted(CATALOGUE))}")
    if not isinstance(mechanism, str) or mechanism not in CATALOGUE:
        raise UnknownNameError("mechanism", mechanism, CATALOGUE)
    module, kind = CATALOGUE[mechanism].split(":")
    made: type[Robot] = getattr(importlib.import_module(module), kind)
    # File names are untrusted: they appear in titles, XML and JSON.
    return made.from_data(data, one_line(name, 200))
