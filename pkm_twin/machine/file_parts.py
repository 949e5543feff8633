# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Bars, elastic structure and passive limits of a machine, by the entries of its file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import norm, plain
from pkm_twin.errors import ParameterError
from pkm_twin.machine.graph import BASE, Graph, limb_numbers
from pkm_twin.machine.graph_file import LimitSpec
from pkm_twin.machine.joints import unit
from pkm_twin.machine.members import Beam, RigidError, Structure
from pkm_twin.machine.reach import PassiveLimit

Specs = Mapping[str, Mapping[str, Any]]
"""Entries of a file by kind and name."""


def find_beams(graph: Graph, specs: Specs) -> tuple[Beam, ...]:
    """Return bodies with a member, and rods with a section or radius, limb by limb."""
    limb = limb_numbers(graph)
    beams = []
    for name, body in specs["bodies"].items():
        m = body.member
        if m is not None:
            beams.append(Beam(name, name, limb[name], (name, m.start), (name, m.end), (name,), m.outer))
    for name, rod in specs["rods"].items():
        radius = rod.section.outer_diameter / 2 if rod.section is not None else rod.radius
        if radius is not None:
            inner, outer = rod.between
            ends = (inner, rod.ends[0]), (outer, rod.ends[1])
            beams.append(Beam(name, name, limb[name], *ends, (name,), radius))
    return tuple(beams)


def find_passive_limits(graph: Graph, specs: Specs) -> tuple[PassiveLimit, ...]:
    """Return positions and swivels of joints that are not actuated, and of rods at both ends.

    :raises ParameterError: a swivel without an axis.
    """
    found = []
    for name, joint in graph.joints.items():
        limits = specs["joints"][name].limits
        ends = joint.inner, joint.outer, joint.at
        if limits is None or joint.actuated:
            continue
        if limits.swivel is not None:
            axis = unit(_swivel_axis(graph, specs, name, limits))
            found.append(PassiveLimit(name, "swivel", *ends, axis, 0.0, limits.swivel))
        elif limits.position is not None:
            kind = "slide" if joint.slides else "turn"
            low, high = limits.position.tolist()
            found.append(PassiveLimit(name, kind, *ends, joint.axes[0], low, high, joint.home))
    for name, rod in specs["rods"].items():
        if rod.swivel is not None:
            for k, way in ((0, 1), (1, 0)):
                axis = unit(rod.ends[way] - rod.ends[k])
                body, other = rod.between[k], rod.between[way]
                found.append(
                    PassiveLimit(
                        name,
                        "rod",
                        body,
                        other,
                        rod.ends[k],
                        axis,
                        0.0,
                        rod.swivel,
                        far=rod.ends[way],
                    )
                )
    return tuple(found)


def _swivel_axis(graph: Graph, specs: Specs, name: str, limits: LimitSpec) -> Array:
    """Return the direction that a ball joint swivels from."""
    joint = graph.joints[name]
    if limits.axis is not None:
        return limits.axis
    if joint.kind == "universal":
        return np.cross(*joint.axes)
    for body in (joint.inner, joint.outer):
        member = None if body == BASE else specs["bodies"][body].member
        if member is not None and body != graph.platform:
            return np.asarray(member.end - member.start, np.float64)
    raise ParameterError(
        f"joints.{name}.limits.axis",
        None,
        "the direction in the middle of its range, base axes",
    )


def find_structure(graph: Graph, specs: Specs) -> Structure:
    """Return bars with sections, and the compliance of joints.

    :raises RigidError: no body and no joint is elastic.
    :raises ParameterError: sections that no bar has, all named, or a rod without one.
    """
    bars = [
        (name, m.section, body.mass, m.end - m.start, f"bodies.{name}.member.section")
        for name, body in specs["bodies"].items()
        if (m := body.member) is not None
    ] + [
        (name, rod.section, rod.mass, rod.ends[1] - rod.ends[0], f"rods.{name}.section")
        for name, rod in specs["rods"].items()
    ]
    sections, faults = {}, []
    for name, tube, mass, along, path in bars:
        try:
            if tube is not None:
                sections[name] = tube.section(mass / norm(plain(along)), path)
        except ParameterError as error:
            faults.append(error)
    if faults:
        first, *others = faults
        more = "".join(f"; wrong too: {error.field}" for error in others)
        raise ParameterError(first.field, first.value, f"{first.bound}{more}")
    compliances = {
        name: joint.compliance.tolist() for name, joint in specs["joints"].items() if joint.compliance is not None
    }
    if not sections and not compliances:
        raise RigidError(
            "bodies.NAME.member.section",
            None,
            "a member's section, rods.NAME.section or joints.NAME.compliance: nothing is elastic",
        )
    missing = [name for name in specs["rods"] if name not in sections]
    if missing:
        raise ParameterError(f"rods.{missing[0]}.section", None, "a section, as rods carry load")
    beams = tuple(beam for beam in find_beams(graph, specs) if beam.name in sections)
    return Structure(beams, sections, compliances)
