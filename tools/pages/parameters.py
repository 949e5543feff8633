# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write docs/parameters.md from the schemas: ``python -m tools.pages.parameters docs/parameters.md``."""

from __future__ import annotations

import dataclasses
import inspect
import re
import sys
from pathlib import Path

import numpy as np

from pkm_twin.machine.graph_file import BodySpec, FrictionSpec, JointSpec, LimbFile, RodSpec
from pkm_twin.machine.joint_map import JointMapEntry
from pkm_twin.machine.members import Tube
from pkm_twin.machine.schema import plain
from pkm_twin.machine.sections import DriveSpec, make_friction_schema
from pkm_twin.machine.uncertainty import UncertaintyEntry
from pkm_twin.mechanisms import delta, linear_delta, machine, prru, upr_rpu
from pkm_twin.robot.mechanism import Common, Mechanism
from pkm_twin.settings import map_parameters

HEAD = """# Robot files

The keys of a robot's YAML with their valid values and defaults. SI units, angles in rad, z up.
Anything else is rejected, with the name of the key. A unit such as `rad or m` is rad for joints
that turn, m for joints that slide. Bold keys are required, defaults are in brackets; `pkm-twin info
ROBOT` prints all values. Where no values are stated, lengths are 1e-06 to 100 m, masses 0 to
100000 kg, moduli 1000 to 1e+14 Pa, coordinates -1e+06 to 1e+06 m.
An inertia is three principal moments or a symmetric 3x3 matrix whose moments are not negative and
keep the triangle rule; a payload's needs its mass.
"""
UNITS = {
    "{effort} per {joint}/s": "N m s/rad or N s/m",
    "{joint}/s": "rad/s or m/s",
    "{joint}": "rad or m",
    "{effort}": "N m or N",
    "{rotor}": "kg m2 or kg",
}
STATED = {"m": "1e-06 to 100", "kg": "0 to 100000", "Pa": "1000 to 1e+14"}
"""Values of a unit that the head of the page states for all keys."""
ROBOTS = {
    "delta": delta.Delta,
    "linear_delta": linear_delta.LinearDelta,
    "prru": prru.Prru,
    "upr_rpu": upr_rpu.UprRpu,
}
TITLES = {
    BodySpec: "bodies.NAME",
    JointSpec: "joints.NAME",
    RodSpec: "rods.NAME",
    Tube: "tube",
    DriveSpec: "drive",
    FrictionSpec: "friction",
    make_friction_schema(3): "friction",
    JointMapEntry: "joint_map.JOINT",
    UncertaintyEntry: "uncertainty.PATH",
}
"""Headings of the classes with their own table."""


def default(field):
    """Return a field's default as a file would have it."""
    value = field.default
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
        if dataclasses.is_dataclass(value):
            return ""
    if value is dataclasses.MISSING:
        return "required"
    if isinstance(value, bool):
        return str(value).lower()
    value = plain(value)
    if value in (None, [], {}):
        return ""
    if not np.any(value) and not isinstance(value, str):
        return "0"
    return f"{value:g}" if isinstance(value, float) else str(value).replace("'", "")


def rows(kind, without=(), prefix=""):
    """Yield a line per key; nested sections follow the key that holds them."""
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for name, (own, row) in map_parameters(kind).items():
        if name in without:
            continue
        other = TITLES.get(row.section or row.entries)
        if other:
            anchor = other.lower().replace(".", "")
            bound = f"[{other}](#{anchor})"
        else:
            bound = re.sub("^number(, | )", "", row.bound).removesuffix(", -1e+06 to 1e+06")
            bound = "" if bound == STATED.get(row.unit) else bound
        unit, values = UNITS.get(row.unit, row.unit), "; ".join(filter(None, (bound, row.text)))
        if values != "a section":
            given = default(fields[own])
            key = f"`{prefix}{name}`"
            if given == "required":
                key, given = f"**{key}**", ""
            given = f" [{given}]" if given else ""
            yield f"* {key}{f' ({unit})' if unit else ''}{f': {values}' if values else ''}{given}"
        inner = row.section or row.entries
        if inner and not other:
            yield from rows(inner, (), f"{prefix}{name}.")


def table(kind, without=(), prefix=""):
    """Write a class's text on its keys, and the keys."""
    said = inspect.cleandoc(kind.__doc__).replace("``", "`")
    return f"{said}\n\n" + "\n".join(rows(kind, without, prefix))


def page():
    """Write the page."""
    common, shared = set(map_parameters(Common)), set(map_parameters(Mechanism))
    parts = [HEAD.rstrip(), "## Every file\n\n" + "\n".join(rows(Common))]
    listed = "\n".join(rows(Mechanism, common))
    parts.append(f"## Every mechanism but `machine`\n\n{listed}")
    for name, kind in ROBOTS.items():
        own = shared - {"limits"} if name == "upr_rpu" else shared
        flat = {key for key, (_, row) in map_parameters(kind).items() if row.section is None}
        keep = set(map_parameters(kind)) - (flat - own)
        parts.append(f"## `mechanism: {name}`\n\n" + "\n".join(rows(kind, keep)))
        for key, (_, row) in map_parameters(kind).items():
            if row.section is not None and key not in own:
                parts.append(f"### `{key}`\n\n{table(row.section)}")
    parts.append(f"## `mechanism: machine`\n\n{table(machine.MachineFile, common)}")
    parts.append(f"### `limbs`\n\n{table(LimbFile, ('bodies', 'joints', 'rods'))}")
    for kind in (BodySpec, JointSpec, RodSpec):
        parts.append(f"### {TITLES[kind]}\n\n{table(kind)}")
    parts.append("## Sections of several")
    for kind in (DriveSpec, FrictionSpec, JointMapEntry, UncertaintyEntry, Tube):
        parts.append(f"### {TITLES[kind]}\n\n{table(kind)}")
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(page(), encoding="utf-8")
