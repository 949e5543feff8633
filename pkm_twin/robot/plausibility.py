# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find numbers of a robot's file that are possible but probably not meant, such as millimetres for metres.

Each is compared with the machine itself, so that small and large machines are judged alike. The schema
rejects impossible numbers; the numbers found here are used, with a warning.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.kinematics.singularity import singularity_at_home
from pkm_twin.machine.graph import BASE, Graph, Joint, map_welded_bodies
from pkm_twin.machine.members import RigidError
from pkm_twin.robot.robot import Robot

EXTENT_BOUNDS: Final = (2e-3, 20.0)
"""Bounds of a machine's extent, m; outside them its lengths were probably meant in another unit."""


@dataclass(frozen=True)
class Finding:
    """An implausible number: its ``field``, the ``quantity`` computed from it, and the bound.

    ``likely``: the probable mistake, in a few words.
    """

    field: str
    quantity: str
    value: float
    bound: float
    unit: str
    likely: str

    @property
    def text(self) -> str:
        """The finding in one line."""
        side = "above" if self.value > self.bound else "below"
        numbers = f"{self.value:.4g} {self.unit}".strip()
        bound = f"{self.bound:.4g} {self.unit}".strip()
        return f"{self.field}: {self.quantity} {numbers}, {side} {bound}: {self.likely}"


def find_implausible_numbers(robot: Robot) -> tuple[Finding, ...]:
    """Return the implausible numbers of a robot."""
    graph = robot.graph
    found = [
        *_check_size(graph),
        *_check_masses(robot, graph),
        *_check_bodies(robot, graph),
        *_check_drives(robot, graph),
        *check_gravity(robot),
        *_check_members(robot, graph),
        *_check_home(graph),
    ]
    # Copies of a limb have the same finding.
    alike: dict[tuple[str, ...], list[Finding]] = {}
    for one in found:
        alike.setdefault((one.quantity, one.likely, f"{one.value:.6g}"), []).append(one)
    others = [f" (and {len(group) - 1} more)" * (len(group) > 1) for group in alike.values()]
    return tuple(
        replace(group[0], field=f"{group[0].field}{more}") for group, more in zip(alike.values(), others, strict=True)
    )


def _check_bounds(
    field: str, quantity: str, value: float, bounds: tuple[float, float], unit: str, likely: tuple[str, str]
) -> Iterator[Finding]:
    """Yield a finding if a quantity is out of its bounds; zero counts as absent.

    :param likely: the probable mistake below and above the bounds.
    """
    if value > bounds[1]:
        yield Finding(field, quantity, value, bounds[1], unit, likely[1])
    elif 0.0 < value < bounds[0]:
        yield Finding(field, quantity, value, bounds[0], unit, likely[0])


def _check_maximum(field: str, quantity: str, value: float, most: float, unit: str, likely: str) -> Iterator[Finding]:
    yield from _check_bounds(field, quantity, value, (0.0, most), unit, ("", likely))


def _check_size(graph: Graph) -> Iterator[Finding]:
    yield from _check_bounds(
        "geometry",
        "extent of the machine",
        _extent(graph),
        EXTENT_BOUNDS,
        "m",
        ("lengths in another unit than metres?", "lengths in millimetres?"),
    )


def _check_masses(robot: Robot, graph: Graph) -> Iterator[Finding]:
    total = _sum_mass(graph)
    if not total > 0.0:
        return
    # All masses over the cube of the extent: at most between solid aluminium and steel. Grams or tonnes
    # change it a thousandfold. Lengths in another unit are reported alone.
    extent = _extent(graph)
    density = total / extent**3 if EXTENT_BOUNDS[0] <= extent <= EXTENT_BOUNDS[1] else 0.0
    whole = f"{total:.4g} kg in all; masses in"
    yield from _check_bounds(
        "masses",
        "all that moves over the cube of the extent",
        density,
        (0.01, 4000.0),
        "kg/m3",
        (f"{whole} tonnes?", f"{whole} grams?"),
    )
    lead = map_welded_bodies(graph)
    with_platform = [b for b in graph.bodies if lead[b] == lead[graph.platform]]
    if not any(graph.bodies[b].mass for b in with_platform) and not robot.payload.mass:
        yield Finding(
            f"{graph.platform}: mass",
            "mass of the platform",
            0.0,
            1e-3 * total,
            "kg",
            "left out? then torques lack its weight and inertia",
        )
    yield from check_payload_mass(robot)


def check_payload_mass(robot: Robot) -> Iterator[Finding]:
    """Yield a finding if the payload is too heavy for the machine."""
    total, mass = _sum_mass(robot.graph), robot.payload.mass
    if total > 0.0:
        likely = f"{total:.4g} kg move it; a mass in grams?"
        yield from _check_maximum("payload.mass", "payload", mass, 50.0 * total, "kg", likely)


def _check_bodies(robot: Robot, graph: Graph) -> Iterator[Finding]:
    extent = _extent(graph) or graph.size
    load = robot.payload
    parts = []
    for name, body in graph.bodies.items():
        nearest = [float(np.linalg.norm(body.com - point)) for point in graph.joint_points(name)]
        parts.append((name, body.mass, body.inertia, min(nearest, default=0.0)))
    parts.append(("payload", load.mass, load.inertia, float(np.linalg.norm(load.com))))
    for name, mass, inertia, far in parts:
        if not mass > 0.0:
            continue
        radius = math.sqrt(max(float(np.linalg.eigvalsh(inertia)[-1]), 0.0) / mass)
        likely = f"inertia in {'g mm2' if radius > 3e3 * extent else 'kg mm2'}?"
        yield from _check_maximum(f"{name}: inertia", "radius of gyration", radius, 2.0 * extent, "m", likely)
        what = "its joints" if name != "payload" else "the reference point"
        what = f"distance of the centre of mass from {what}"
        likely = "a place in millimetres, or in other axes?"
        yield from _check_maximum(f"{name}: com", what, far, 2.0 * extent, "m", likely)


def _check_drives(robot: Robot, graph: Graph) -> Iterator[Finding]:
    total = _sum_mass(graph) + robot.payload.mass
    positions, home = robot.limits.position, graph.home.tolist()
    for k, name in enumerate(graph.actuated):
        joint = graph.joints[name]
        unit = robot.joint_units[k]
        turns = unit == "rad"
        if positions is not None:
            low, high = (float(v) for v in positions[k])
            widest = max((abs(v) for v in (low, high) if math.isfinite(v)), default=0.0)
            most = 4.0 * math.pi
            if turns and widest > most:
                likely = f"{widest / (2 * math.pi):.3g} turns; degrees?"
                yield Finding(f"{name}: limits.position", "limit", widest, most, "rad", likely)
            elif not low <= home[k] <= high:
                bound = low if home[k] < low else high
                yield Finding(
                    f"{name}: home",
                    "home outside the limits",
                    home[k],
                    bound,
                    unit,
                    "left out, or counted from elsewhere than the limits?",
                )
        if not turns and not joint.home and name in robot.without_home:
            length = _measure_leg(graph, joint)
            if length > 0.05 * graph.size:
                yield Finding(
                    f"{name}: home",
                    "length of the leg at home by its joint",
                    0.0,
                    length,
                    "m",
                    "home left out? without it the joint counts from home",
                )
        weight = joint.rotor_inertia / (graph.size**2 if turns else 1.0)
        if total > 0.0:
            what, likely = ("rotor as a mass at the machine's extent", "an inertia in kg mm2 or g cm2?")
            yield from _check_maximum(f"{name}: rotor_inertia", what, weight, 100.0 * total, "kg", likely)


def check_gravity(robot: Robot) -> Iterator[Finding]:
    """Return an implausible gravity."""
    size = float(np.linalg.norm(robot.gravity))
    times = f"{size / 9.81:.4g} times the Earth's; in mm/s2 or cm/s2?"
    # Between the Moon and Jupiter.
    yield from _check_bounds("gravity", "gravity", size, (1.0, 25.0), "m/s2", ("in km/s2?", times))
    if size == 1.0:
        yield Finding("gravity", "gravity", size, 1.62, "m/s2", "in units of the Earth's?")


def _check_members(robot: Robot, graph: Graph) -> Iterator[Finding]:
    try:
        structure = robot.structure()
    except PkmTwinError:
        return
    for beam in structure.beams:
        name, modulus = beam.name, structure.sections[beam.name].youngs_modulus
        if modulus < 1e9:  # Pa; plastics have more
            yield Finding(f"{name}: youngs_modulus", "modulus", modulus, 1e9, "Pa", "in MPa or GPa?")
        ends = [np.asarray(at, np.float64) for _, at in (beam.inner, beam.outer)]
        most = 0.1 * float(np.linalg.norm(ends[1] - ends[0]))
        for joint in graph.joints.values():
            outside = (joint.inner in beam.parts) != (joint.outer in beam.parts)
            # The platform is rigid in the elastic frame: its member only states its thickness.
            outside = outside and graph.platform not in beam.parts
            if outside and joint.type.placed and not joint.virtual:
                far = min(float(np.linalg.norm(joint.at - end)) for end in ends)
                what, likely = f"distance of its ends from joint {joint.name}", "a mistyped place?"
                yield from _check_maximum(f"{name}: member", what, far, most, "m", likely)


def _check_home(graph: Graph) -> Iterator[Finding]:
    try:
        index = singularity_at_home(graph)
    except (PkmTwinError, np.linalg.LinAlgError):
        return
    if index < 0.005:
        likely = "a small motion may meet a singularity; is another home meant?"
        yield Finding("home", "singularity index", index, 0.005, "", likely)


def _extent(graph: Graph) -> float:
    """Return the extent of joints and rods, m; if they are one point, that of most bodies about it."""
    points = [j.at for j in graph.joints.values() if j.kind != "translation"]
    points += [end for rod in graph.rods.values() for end in rod.ends]
    points.append(graph.origin)
    extent = float(np.ptp(np.array(points), axis=0).max())
    about = [float(np.linalg.norm(b.com - graph.origin)) for b in graph.bodies.values() if b.mass]
    # The median, because some positions may be wrong; numpy's median would import masked arrays.
    middle = sorted(about)[(len(about) - 1) // 2 : len(about) // 2 + 1]
    extent = max(extent, 2.0 * sum(middle) / len(middle) if middle else 0.0)
    return extent if extent > 1e-9 else 0.0


def _sum_mass(graph: Graph) -> float:
    return sum(b.mass for b in graph.bodies.values()) + sum(r.mass for r in graph.rods.values())


def _measure_leg(graph: Graph, slide: Joint) -> float:
    """Return the distance of the joints beyond a slide that are along its axis, m; 0 for no leg."""
    if BASE in (slide.inner, slide.outer):
        return 0.0
    lengths = [0.0]
    for a in graph.joints.values():
        for b in graph.joints.values():
            if slide.inner in (a.inner, a.outer) and slide.outer in (b.inner, b.outer):
                apart = b.at - a.at
                along = abs(float(apart @ slide.axes[0]))
                if slide not in (a, b) and along > 0.99 * float(np.linalg.norm(apart)):
                    lengths.append(along)
    return max(lengths)


def why_no_torques(robot: Robot) -> str:
    """Return why the model has no torques for this robot; empty if it has."""
    try:
        robot.massive()
    except ParameterError as error:
        return str(error)
    return ""


def find_members_fault(robot: Robot) -> str:
    """Return why maps reject the file's members; empty if they do not, or there are none."""
    try:
        robot.structure()
    except RigidError:
        return ""
    except ParameterError as error:
        return str(error)
    return ""
