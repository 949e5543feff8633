# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Describe the shapes to draw for a machine and for the effects of a load, in base axes, m."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine import rotations
from pkm_twin.machine.joints import perpendicular_axes
from pkm_twin.machine.members import Place
from pkm_twin.robot.outline import Posture, robot_bars
from pkm_twin.robot.robot import Robot
from pkm_twin.settings import SCALE_BOUNDS, setting
from pkm_twin.state.state import State

Kind = Literal["cylinder", "sphere", "arrow", "line", "text"]
Colour = tuple[float, float, float, float]

COLOURS: Final[Mapping[str, Colour]] = {
    "neutral": (0.55, 0.57, 0.60, 1.0),
    "deflected": (0.84, 0.37, 0.0, 0.9),
    "ellipsoid": (0.0, 0.45, 0.70, 0.25),
    "force": (0.80, 0.47, 0.65, 1.0),
    "moment": (0.94, 0.89, 0.26, 1.0),
    "text": (1.0, 1.0, 1.0, 1.0),
}
"""Colours that can be distinguished with every kind of colour vision (Okabe and Ito 2008)."""
SIZES: Final = {"line": 0.004, "arrow": 0.012, "joint": 0.02, "letter": 0.06}
"""Widths of lines, arrows and joints, and height of letters, as fractions of the machine's size."""


@dataclass(frozen=True, eq=False)
class WrenchEffects:
    """Deflection, compliance and strain energy of the machine under a wrench, base axes, at the reference point.

    ``wrench`` (6,), N and N m; ``compliance`` (6, 6); ``deflection`` (6,), m and rad.
    ``energy_fractions``: fraction of the strain energy of each element; ``dominant``: the element
    with the largest one. ``members``: points (k, 3) along each member and their displacements (k, 3), m.
    """

    wrench: Array
    compliance: Array
    deflection: Array
    energy_fractions: Mapping[str, float]
    dominant: str
    members: Mapping[str, tuple[Array, Array]]


@dataclass(frozen=True)
class Scales:
    """Scales of drawing: deflections times ``deflection``, arrows in m per N and m per N m.

    ``ellipsoid_force``: size of the force, in all directions, whose deflections form the ellipsoid,
    N.
    """

    deflection: float = setting(
        1000.0, "factor by which deflections are enlarged", name="deflection_scale", **SCALE_BOUNDS
    )
    force: float = setting(1e-3, "length of force arrows", name="force_scale", unit="m/N", **SCALE_BOUNDS)
    moment: float = setting(1e-2, "length of moment arrows", name="moment_scale", unit="m/(N m)", **SCALE_BOUNDS)
    ellipsoid_force: float = setting(
        100.0, "force whose deflections the compliance ellipsoid shows", unit="N", **SCALE_BOUNDS
    )


@dataclass(frozen=True, eq=False)
class Shape:
    """A shape to draw, with the fields of a visualization_msgs/Marker.

    ``group`` and ``number`` identify the shape. ``position`` (3,), ``quaternion`` x y z w.
    ``size``: for a cylinder (along z) or sphere the diameters and length, for an arrow the
    diameters of shaft and head and the head's length, for a line its width, for a text its height
    as the last entry. ``points``: points of a line or an arrow, (k, 3). ``lasting``: keep the shape
    until it is drawn again.
    """

    kind: Kind
    group: str
    number: int
    colour: Colour
    size: tuple[float, float, float]
    position: Array = field(default_factory=lambda: np.zeros(3))
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    text: str = ""
    lasting: bool = False


def choose_heat_colour(share: float) -> Colour:
    """Return the colour of a fraction from 0 to 1: blue, yellow, vermilion."""
    scale = (COLOURS["ellipsoid"], COLOURS["moment"], COLOURS["deflected"])
    r, g, b = (float(np.interp(2.0 * share, (0.0, 1.0, 2.0), values)) for values in list(zip(*scale, strict=True))[:3])
    return r, g, b, 1.0


class Scene:
    """The shapes of one robot."""

    def __init__(self, robot: Robot, scales: Scales | None = None) -> None:
        self.robot, self.scales = robot, scales or Scales()
        self.bars = robot_bars(robot)
        self._size = robot.graph.size
        bodies = {bar.element for bar in self.bars}
        self.joints: dict[str, Place] = {}
        """Position of each joint, by its name among the elastic elements."""
        for joint in robot.graph.joints.values():
            if joint.kind != "translation":
                self.joints.setdefault(joint.label or joint.name, (joint.outer, joint.at))
        for rod in robot.graph.rods.values():
            for name, body, end in zip(rod.joint_names, (rod.inner, rod.outer), rod.ends, strict=True):
                self.joints.setdefault(name, (body, end))
        self.joints = {name: place for name, place in self.joints.items() if name not in bodies}

    def shapes(self, state: State, load: WrenchEffects | None = None) -> list[Shape]:
        """Return the shapes of the machine in a state, and of the load's effects."""
        places = self.place_bars(state.q)
        # Energies relative to the largest one; nothing without energy.
        factors = {} if load is None else load.energy_fractions
        greatest = max(factors.values(), default=0.0)
        shares = {name: value / greatest for name, value in factors.items()} if greatest > 0.0 else {}
        shapes = []
        for k, (bar, (start, end)) in enumerate(zip(self.bars, places, strict=True)):
            share = shares.get(bar.element)
            colour = COLOURS["neutral"] if share is None else choose_heat_colour(share)
            span, thickness = end - start, 2.0 * bar.radius
            length = float(np.linalg.norm(span))
            quaternion = (0.0, 0.0, 0.0, 1.0)
            if length > 0.0:
                z = span / length
                x = perpendicular_axes(z)[0]
                quaternion = _to_quaternion(np.column_stack((x, np.cross(z, x), z)))
            cylinder, middle = (thickness, thickness, length), (start + end) / 2.0
            shapes.append(
                Shape("cylinder", "bars", k, colour, cylinder, middle, quaternion, text=bar.part, lasting=True)
            )
        if load is None:
            return shapes
        # Elastic joints as spheres.
        names = [name for name in self.joints if name in shares]
        points = self._find_points(state.q, [self.joints[name] for name in names])
        sphere = (1.5 * SIZES["joint"] * self._size,) * 3
        for k, (name, point) in enumerate(zip(names, points, strict=True)):
            shapes.append(Shape("sphere", "joints", k, choose_heat_colour(shares[name]), sphere, point, text=name))
        # Deflected members and the displaced platform, both enlarged by the same factor.
        scale, width = self.scales.deflection, (SIZES["line"] * self._size, 0.0, 0.0)
        lines = [(name, x + scale * u) for name, (x, u) in load.members.items()]
        for bar, ends in zip(self.bars, places, strict=True):
            if bar.part == self.robot.graph.platform:
                moved = load.deflection[:3] + np.cross(load.deflection[3:], ends - state.position)
                lines.append((bar.part, ends + scale * moved))
        for k, (name, line) in enumerate(lines):
            shapes.append(Shape("line", "deflected", k, COLOURS["deflected"], width, points=line, text=name))
        # The deflections under forces of one size: an ellipsoid with the axes of C.
        values, axes = np.linalg.eigh(load.compliance[:3, :3])
        axes = axes if np.linalg.det(axes) > 0.0 else -axes
        x, y, z = (2.0 * values * self.scales.ellipsoid_force * scale).tolist()
        turned = _to_quaternion(axes)
        shapes.append(Shape("sphere", "compliance", 0, COLOURS["ellipsoid"], (x, y, z), state.position, turned))
        shapes += self._draw_arrows(state, load)
        if load.dominant != "none":
            height = SIZES["letter"] * self._size
            at, size = state.position + np.array([0.0, 0.0, 2.0 * height]), (0.0, 0.0, height)
            shapes.append(Shape("text", "dominant", 0, COLOURS["text"], size, at, text=load.dominant))
        return shapes

    def place_bars(self, q: Array) -> Array:
        """Compute the ends of all bars at joint positions (n,), shape (bars, 2, 3), m."""
        ends = [end for bar in self.bars for end in (bar.start, bar.end)]
        return self._find_points(q, ends).reshape(len(self.bars), 2, 3)

    def _find_points(self, q: Array, places: Sequence[Place]) -> Array:
        posture = Posture(self.robot, q)
        return np.array([posture.locate_point(*place) for place in places]).reshape(-1, 3)

    def _draw_arrows(self, state: State, load: WrenchEffects) -> list[Shape]:
        """Draw force and moment as arrows from the reference point."""
        shaft = SIZES["arrow"] * self._size
        size = (shaft, 2.0 * shaft, 3.0 * shaft)
        parts = (
            (load.wrench[:3], self.scales.force, COLOURS["force"]),
            (load.wrench[3:], self.scales.moment, COLOURS["moment"]),
        )
        return [
            Shape(
                "arrow", "wrench", k, colour, size, points=np.array([state.position, state.position + scale * vector])
            )
            for k, (vector, scale, colour) in enumerate(parts)
            if vector.any()
        ]


def _to_quaternion(rotation: Array) -> tuple[float, float, float, float]:
    x, y, z, w = rotations.to_quaternion(rotation).tolist()
    return x, y, z, w
