# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find bars, elasticity and passive limits of a machine in the entries of its file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.expressions import norm, plain
from pkm_twin.errors import ParameterError
from pkm_twin.machine.graph import BASE, Graph, number_limbs
from pkm_twin.machine.joints import unit
from pkm_twin.machine.members import Beam, Parts
from pkm_twin.machine.reach import PassiveLimit

Specs = Mapping[str, Mapping[str, Any]]
"""Entries of a file by kind and name."""
RIGID: Final = (
    "bodies.NAME.member.section",
    "a member's section, rods.NAME.section or joints.NAME.compliance: nothing is elastic",
)
"""Path and text of what makes parts elastic."""


def find_parts(graph: Graph, specs: Specs) -> Parts:
    """Return bodies with a member, rods with a section or radius, and the compliance of joints."""
    limb = number_limbs(graph)
    beams = []
    for name, body in specs["bodies"].items():
        m = body.member
        if m is not None:
            line = None if m.section is None else body.mass / norm(plain(m.end - m.start))
            ends = (name, m.start), (name, m.end)
            path = f"bodies.{name}.member.section"
            beams.append(Beam(name, name, limb[name], *ends, (name,), m.outer, (), m.section, line, path))
    for name, rod in specs["rods"].items():
        tube = rod.section
        radius = rod.radius if tube is None else tube.outer_diameter / 2
        if radius is not None:
            line = None if tube is None else rod.mass / norm(plain(rod.ends[1] - rod.ends[0]))
            ends = (rod.between[0], rod.ends[0]), (rod.between[1], rod.ends[1])
            beams.append(Beam(name, name, limb[name], *ends, (name,), radius, (), tube, line, f"rods.{name}.section"))
    compliances = {
        name: joint.compliance.tolist() for name, joint in specs["joints"].items() if joint.compliance is not None
    }
    missing = [f"rods.{name}.section" for name, rod in specs["rods"].items() if rod.section is None]
    return Parts(graph, tuple(beams), compliances, (), RIGID, "".join(missing[:1]))


def find_passive_limits(graph: Graph, specs: Specs) -> tuple[PassiveLimit, ...]:
    """Return limits of position and swivel of passive joints, and of the swivel of rods at both ends.

    :raises ParameterError: a swivel without an axis.
    """
    found = []
    for name, joint in graph.joints.items():
        limits = specs["joints"][name].limits
        ends = joint.inner, joint.outer, joint.at
        if limits is None or joint.actuated:
            continue
        if limits.swivel is not None:
            axis = limits.axis
            if axis is None and joint.kind == "universal":
                axis = np.cross(*joint.axes)
            for body in ends[:2] if axis is None else ():
                member = None if body in (BASE, graph.platform) else specs["bodies"][body].member
                axis = member.end - member.start if axis is None and member is not None else axis
            if axis is None:
                bound = "the direction in the middle of its range, base axes"
                raise ParameterError(f"joints.{name}.limits.axis", None, bound)
            found.append(PassiveLimit(name, "swivel", *ends, unit(axis), 0.0, limits.swivel))
        elif limits.position is not None:
            kind = "slide" if joint.slides else "turn"
            low, high = limits.position.tolist()
            found.append(PassiveLimit(name, kind, *ends, joint.axes[0], low, high, joint.home))
    for name, rod in specs["rods"].items():
        if rod.swivel is not None:
            for k, way in ((0, 1), (1, 0)):
                start, far = rod.ends[k], rod.ends[way]
                ends = rod.between[k], rod.between[way], start
                found.append(PassiveLimit(name, "rod", *ends, unit(far - start), 0.0, rod.swivel, far=far))
    return tuple(found)
