# SPDX-License-Identifier: Apache-2.0
"""A description of ``mechanism: machine`` as a YAML file that people read and edit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import yaml

WIDTH: Final = 100
"""An entry that is longer than this takes a line for each of its keys."""
HEAD: Final = """\
# A machine as bodies, joints and rods at its home pose: every vector in base axes at home.
# Units: m, kg, kg m2, rad, s, N, N m. The ground is called base.
"""
NOTES: Final = {
    "gravity": "m/s2",
    "platform": "the body that carries the tool",
    "origin": "m, its reference point at home",
    "pose": "of x y z roll pitch yaw (relative to home): as many as the mobility",
    "payload": "kg; com from the reference point, m; inertia about it, kg m2",
}
"""What stands behind a key of one line."""
SECTIONS: Final = {
    "bodies": """\
# mass: kg. com: centre of mass at home, m. inertia: about it, kg m2, three moments or 3x3.
""",
    "joints": """\
# type: revolute, prismatic, cylindrical (axis), universal (axes: first fixed to the inner body,
# second to the outer), spherical, fixed, translation. between: [inner body, outer body], positive
# motion is that of the outer one. at: a point of the joint, m. home: its value at home, rad or m.
# limits: position, velocity, effort. friction: viscous (effort per rate), coulomb,
# offset (effort).
# rotor_inertia: the drive's at the joint, kg m2 or kg.
# The actuated joints' order is that of the robot's joint_names.
""",
    "rods": """\
# Thin even bars with a ball joint at each end. between: bodies. ends: their points, m. mass: kg.
""",
    "limbs": """\
# Copied and turned about base z by each azimuth, rad; names get _1, _2, ...
""",
}
"""What stands above a section."""


def describe_machine_yaml(data: Mapping[str, Any]) -> str:
    """The description as YAML with units and meanings in comments.

    Reading it gives the same numbers to the last bit.

    :param data: a description, limbs written out or not, in any order of keys.
    """
    order = ("mechanism", *NOTES, *SECTIONS)
    keys = sorted(data, key=lambda key: order.index(key) if key in order else len(order))
    lines = [HEAD]
    for key in keys:
        if key in SECTIONS and data[key] and isinstance(data[key], Mapping):
            lines.append(f"\n{SECTIONS[key]}{key}:\n")
            lines += [_entry(name, value, "  ") for name, value in data[key].items()]
        elif key in SECTIONS and data[key]:
            lines.append(f"\n{SECTIONS[key]}{key}:\n")
            for item in data[key]:
                entries = "".join(_entry(name, value, "    ") for name, value in item.items())
                lines.append("  - " + entries[4:])
        else:
            line, note = f"{key}: {_flow(data[key])}", NOTES.get(key, "")
            if len(line) + len(note) > WIDTH and note:
                line, note = f"# {note}\n{line}", ""
            lines.append(f"{line}  # {note}\n" if note else f"{line}\n")
    if "pose" not in data:
        at = 1 + sum(key in ("mechanism", "gravity", "platform", "origin") for key in keys)
        lines.insert(at, f"# pose: [x, y, z]  # for example; {NOTES['pose']}\n")
    return "".join(lines)


def _entry(name: object, value: Any, indent: str) -> str:
    """One line if it fits, else a line a key."""
    line = f"{indent}{_flow(name)}: {_flow(value)}"
    if not isinstance(value, Mapping) or len(line) <= WIDTH:
        return line + "\n"
    inner = "".join(_entry(key, item, indent + "  ") for key, item in value.items())
    return f"{indent}{_flow(name)}:\n{inner}"


def _flow(value: Any) -> str:
    # In a list, so that names are quoted as they must be between brackets.
    text = yaml.safe_dump([_plain(value)], default_flow_style=True, sort_keys=False, width=math.inf)
    return text.strip()[1:-1]


def _plain(value: Any) -> Any:
    """Whole numbers without a point, no minus before zero, and no object twice."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, str | bool) or value is None:
        return value
    if isinstance(value, int | float):
        whole = math.isfinite(value) and float(value).is_integer() and abs(value) < 1e15
        return int(value) if whole else float(value)
    return [_plain(item) for item in value]
