# SPDX-License-Identifier: Apache-2.0
"""docs/parameters.md from the schemas: ``python -m tools.pages.parameters docs/parameters.md``."""

from __future__ import annotations

import dataclasses
import inspect
import sys
from pathlib import Path

from pkm_twin.machine.graph_file import BodySpec, JointSpec, RodSpec
from pkm_twin.machine.joint_map import JointMapEntry
from pkm_twin.machine.members import Tube
from pkm_twin.machine.schema import plain
from pkm_twin.machine.sections import Payload, friction_of, limits_of
from pkm_twin.machine.uncertainty import UncertaintyEntry
from pkm_twin.mechanisms import delta, linear_delta, prru, upr_rpu

HEAD = """# Robot files

Every key of a robot's YAML with its unit, its valid values and its default. SI units, angles in
rad, z up. An unknown key, a value of another type and a value out of its bounds are rejected, with
the name of the key. Of two units, the first is for joints that rotate and the second for joints
that slide; `pkm-twin info ROBOT` prints a robot's values with the units of its joints.

Written by `make pages`.
"""
UNITS = {
    "{effort} per {joint}/s": "N m s/rad or N s/m",
    "{joint}/s": "rad/s or m/s",
    "{joint}": "rad or m",
    "{effort}": "N m or N",
    "{rotor}": "kg m2 or kg",
}
MACHINE = """## `mechanism: machine`

Any machine as a graph of bodies, joints and rods, with every vector in base axes at the home pose.
[new_machine.md](new_machine.md) has an example. `friction` and `limits` are keys of the joints.

| key | unit | allowed | default |
|---|---|---|---|
| `mechanism` |  | machine | required |
| `platform` |  | a body's name: it carries the tool | platform |
| `origin` | m | 3 numbers: the platform's reference point at home | the platform's com |
| `pose` |  | as many of x, y, z, roll, pitch, yaw as the mobility | the first valid choice |
| `bodies`, `joints`, `rods` |  | mappings of names to entries | none |
| `joint_map` |  | a mapping of names to entries | none |
| `uncertainty` |  | a mapping of paths to entries | none |
| `element_compliance` |  | a mapping of names to numbers, at least 1e-06, at most 1e+06 | none |
| `modal_damping` |  | one number or more above 0, at most 0.99 | none |
| `limbs` |  | one section or a list: `azimuths` (rad), `bodies`, `joints`, `rods` | none |

The entries of `limbs` are given for azimuth 0. They are copied and rotated about base z by each
azimuth; the names get _1, _2 and so on. A copy uses its own copy of the bodies in the section;
other bodies are shared."""


FRICTION = """Friction of the actuated joints, opposite to the rate: viscous friction is
proportional to the rate, Coulomb friction depends on its sign. `offset` is a constant effort.
The other keys belong to further friction laws, see [friction](fit.md#friction-of-drives)."""
LIMITS = "Nodes and commands reject values beyond these limits, or warn. The default is no limit."
UNCERTAINTY = """The uncertainty of a number, by its dotted path in this file (`inertia.arm_mass`),
or of all numbers below a name together (`joints_compliance`). Each entry is an independent cause;
`torque_deviation` and `compliance_deviation` propagate them. Give either `deviation`, the standard
deviation in the number's own unit, or `relative`, that of a common factor."""

JOINT_MAP = """Converts between the controller's names and values of a joint and those of the model:
controller = offset + sign * ratio * model for positions, without the offset for velocities and
accelerations, divided by sign * ratio for efforts, so that power is the same on both sides.

`ratio_change`: the ratio is ratio * (1 + ratio_change * (model - ratio_at)), as of a spool. Only
`calibrate` and `robot.controller.positions` convert such a joint; everything else rejects it.
`unit`: the name of the controller's unit, for example rev, for tables.

Messages, bags and the table of poses for `calibrate` contain the controller's names and values.
Everything else uses those of the model: the Python API, parameters of nodes (`effort_limits`,
`friction.*`, `start`), the tables of `torques` and `fit`, the exported code, and `machine_state`'s
`~/joint_states`, whose joints are those of the URDF."""
ELEMENTS = """### `element_compliance`

Factors on the compliance of elastic elements, by the names that `strain_energy` uses (members and
joints); the default is 1. `{3U: 3.0}` makes a joint three times softer than in the other sections.
Above 0, at most 1e6. `fit --what compliance` writes this section.

### `modal_damping`

Damping ratios of the natural modes, from the lowest on; the last one is that of all further modes.
`frf`, `lobes` and input shapers use it."""
GRAVITY = """### `gravity`

Acceleration of free fall in base axes, m/s2; default [0, 0, -9.81]."""
TABLE = "| key | unit | allowed | default |\n|---|---|---|---|"


def default(field):
    """A field's default as the file would write it."""
    value = field.metadata["default"]
    if value is dataclasses.MISSING:
        return "required"
    if value is None or value == []:
        return "none"
    if value == {}:
        return "its own defaults" if field.metadata["section"] else "none"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(plain(value)).replace("'", "")


def rows(kind, prefix=""):
    """A row a key, nested sections behind the key that holds them."""
    for field in dataclasses.fields(kind):
        data = field.metadata
        if "check" not in data:
            continue
        key = prefix + (data["key"] or field.name)
        unit = UNITS.get(data["unit"], data["unit"])
        bound = "a [tube](#tube)" if data["section"] is Tube else data["bound"]
        yield f"| `{key}` | {unit} | {bound} | {default(field)} |"
        if data["section"] is not None and data["section"] is not Tube:
            yield from rows(data["section"], f"{key}.")


def table(title, kind, text=None):
    """A section of keys with what its class says about them."""
    said = inspect.cleandoc(kind.__doc__ if text is None else text).replace("``", "`")
    return f"### {title}\n\n{said}\n\n{TABLE}\n" + "\n".join(rows(kind))


def page():
    """The whole page."""
    parts = [HEAD.rstrip()]
    for module, name in (
        (delta.Delta, "delta"), (linear_delta.LinearDelta, "linear_delta"), (prru.Prru, "prru"),
        (upr_rpu.UprRpu, "upr_rpu"),
    ):  # fmt: skip
        fields = {f.name: f for f in dataclasses.fields(module) if "check" in f.metadata}
        parts.append(f"## `mechanism: {name}`")
        top = [f for f in fields.values() if f.metadata["section"] is None]
        lines = [TABLE]
        for field in top:
            unit = UNITS.get(field.metadata["unit"], field.metadata["unit"])
            lines.append(
                f"| `{field.name}` | {unit} | {field.metadata['bound']} | {default(field)} |"
            )
        parts.append("\n".join(lines))
        common = {"payload", "friction"} | ({"limits"} if name != "upr_rpu" else set())
        optional = [k for k, f in fields.items() if f.metadata["default"] in (None, {})]
        for key, field in fields.items():
            if field.metadata["section"] is not None and key not in common:
                note = " (may be left out)" if key in optional else ""
                parts.append(table(f"`{key}`{note}", field.metadata["section"]))
        shared = ", ".join(f"`{key}`" for key in fields if key in common)
        parts.append(f"And {shared}, which may be left out: see below.")
    parts.append(MACHINE)
    for title, kind in (
        ("`bodies.NAME`", BodySpec),
        ("`joints.NAME`", JointSpec),
        ("`rods.NAME`", RodSpec),
    ):
        parts.append(table(title, kind))
    parts.append("And `payload` and `gravity`, as everywhere.")
    parts.append("## In every file")
    parts.append(table("`payload`", Payload))
    parts.append(table("`friction`, by actuated joint (here three)", friction_of(3), FRICTION))
    parts.append(table("`limits`, by actuated joint (here three)", limits_of(3), LIMITS))
    parts.append(table("`joint_map.NAME`, by actuated joint", JointMapEntry, JOINT_MAP))
    parts.append(table("`uncertainty.PATH`", UncertaintyEntry, UNCERTAINTY))
    parts.append(ELEMENTS)
    parts.append(table("Tube", Tube))
    parts.append(GRAVITY)
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(page(), encoding="utf-8")
