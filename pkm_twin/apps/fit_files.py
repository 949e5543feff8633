# SPDX-License-Identifier: Apache-2.0
"""The files of a fit: the robot's own text before, and the same with fitted numbers after."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from pkm_twin import Robot, load
from pkm_twin.errors import ParameterError
from pkm_twin.identification.parameters import Number
from pkm_twin.machine.machine_yaml import describe_machine_yaml
from pkm_twin.machine.shared import Key
from pkm_twin.machine.yaml_edit import edit_yaml
from pkm_twin.robot.catalogue import TREES, robot_of_data, robot_path
from pkm_twin.robot.robot_urdf import robot_description
from pkm_twin.robot.urdf_read import read_urdf


class Fitted(Protocol):
    """What a fit says of numbers of a file."""

    @property
    def numbers(self) -> tuple[Number, ...]:
        """Before and after."""


def robot_text(
    name: str, *, platform: str | None = None, per_copy: bool = False
) -> tuple[str, Robot]:
    """A robot and the text of its file; of a URDF, or with ``per_copy``, as a machine's YAML.

    :raises ParameterError: the file is refused; or it is to be written out, and would lose what it
        says of elasticity.
    """
    robot = load(name, platform=platform)
    if per_copy and not robot.elastic_entries() and _elastic(robot):
        raise ParameterError(
            "--per-copy",
            robot.name,
            f"a robot whose elastic members can be written out; a {robot.mechanism}'s cannot: take "
            "a file without them, or fit without --per-copy",
        )
    path = robot_path(name)
    if path.suffix in TREES:
        data = read_urdf(path, platform=platform)
    elif per_copy:
        data = robot_description(robot)
    else:
        return path.read_text(encoding="utf-8"), robot
    return describe_machine_yaml(data), robot_of_data(data, path.stem)


def _elastic(robot: Robot) -> bool:
    """Whether its file has elastic members or joints."""
    try:
        robot.structure()
    except ParameterError:
        return False
    return True


def fitted_yaml(text: str, result: Fitted, recordings: Sequence[str]) -> str:
    """The robot's file with what was fitted, each number's deviation and source in a comment."""
    groups: dict[Key, list[Number]] = {}
    for number in result.numbers:
        base: Key = tuple(k for k in number.key if not isinstance(k, int))
        # A section of a list is no place in a vector.
        if number.key[:1] == ("limbs",) and isinstance(number.key[1], int):
            base = (*number.key[:2], *base[1:])
        groups.setdefault(base, []).append(number)
    values: dict[Key, Any] = {}
    notes: dict[Key, str] = {}
    source = ", ".join(recordings)
    for base, numbers in groups.items():
        if all(number.status == "not excited" for number in numbers):
            continue
        values[base] = _value(base, numbers)
        told = [n for n in numbers if n.status != "not excited"]
        spread = ", ".join(n.spread for n in told)
        alone = all(n.status == "fitted" for n in told)
        how = "" if alone else "; known only in combination with others"
        was = ", ".join(f"{n.before:.6g}" for n in told)
        unit = f" {told[0].unit}" if told[0].unit else ""
        notes[base] = (
            f"{'.'.join(str(k) for k in base[-2:])}: fitted from {source}, +- {spread}{unit} "
            f"(one standard deviation), was {was}{how}"
        )
    return edit_yaml(text, values, notes)


def _value(base: Key, numbers: Sequence[Number]) -> Any:
    """A number, a list, or a matrix of what stands below one key."""
    tails = {n.key[len(base) :]: n.after for n in numbers}
    if () in tails:
        return tails[()]
    if len(next(iter(tails))) == 1:
        return [tails[k,] for k in range(len(tails))]
    matrix = [[tails.get((i, j), tails.get((j, i))) for j in range(3)] for i in range(3)]
    apart = max(abs(matrix[i][j] or 0.0) for i in range(3) for j in range(3) if i != j)
    if apart == 0.0:
        return [matrix[i][i] for i in range(3)]
    return matrix
