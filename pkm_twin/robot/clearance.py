# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute the distances between members of different limbs.

A member is a straight round bar, modelled as a capsule: all points within its radius of the segment
between its two joints. Members of one limb share joints, so they are not compared. Parts without shape
in the file are left out: platform and base, sliders and their guides, housings of joints, and the
crosspieces of parallelograms.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import cross
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.operations import maximum, minimum, sqrt
from pkm_twin.codegen.program import Program
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.traced import Traced
from pkm_twin.machine.members import Beam
from pkm_twin.robot.rejection import reject_joints
from pkm_twin.robot.robot import Robot


def distance(start: Any, span: Any, other: Any, other_span: Any) -> Any:
    """Return the distance (m) of two segments, each from a point along a vector; either may be a point.

    The lines' nearest points, clamped to the first segment, then to the second, then to the
    first again (Ericson, Real-Time Collision Detection, 5.1.9); parallel lines allow any first guess.
    A cross product gives the lines' common normal accurately for directions that are nearly parallel.
    """
    w, tiny = other - start, 1e-300
    uu, vv = span @ span, other_span @ other_span
    n = cross(span, other_span)
    s = _clamp((cross(w, other_span) @ n) / maximum(n @ n, tiny))
    t = _clamp(((s * span - w) @ other_span) / maximum(vv, tiny))
    s = _clamp(((t * other_span + w) @ span) / maximum(uu, tiny))
    gap = w + t * other_span - s * span
    return sqrt(gap @ gap)


def _clamp(value: Any) -> Any:
    return minimum(1.0, maximum(0.0, value))


def clearance(robot: Robot, pose: ArrayLike) -> Array:
    """Compute the least distance between the surfaces of members of different limbs, shape (...), m.

    Members are round bars between their joints, with the outer diameters in the robot's file: the
    bars of the 2UPR-RPU, the limbs of the 3-PRRU, arms and rods of a Delta. The value is the
    distance of the axes minus the radii: zero if two members touch, negative if they intersect. The
    files contain no shapes of platform, base, drives and joints, so these are left out.

    :param pose: shape (..., m), in the robot's pose coordinates.
    :raises ParameterError: the file has no diameters of the members.
    :raises UnreachableError: a pose that is none of the mechanism's, by limb, sample and miss.
    :raises SingularityError: a pose where the mechanism is singular.
    :raises ValueError: a pose that is not finite.
    """
    return joint_clearance(robot, robot.inverse(pose))


def has_clearance(robot: Robot) -> bool:
    """Return whether the robot's file states the members' diameters, so that :func:`clearance` is known."""
    return len({beam.limb for beam in robot.beams}) > 1


def joint_clearance(robot: Robot, q: ArrayLike, refuse: bool = True) -> Array:
    """Return the clearance at joint positions, shape (..., n).

    :param refuse: False gives NaN where there is no assembly, instead of an error.
    """
    return np.asarray(member_gaps(robot, q, refuse).min(-1), np.float64)


def member_gaps(robot: Robot, q: ArrayLike, refuse: bool = True) -> Array:
    """Return the distances of all :func:`member_pairs`, shape (..., pairs), m."""
    (gaps,), status = _make_clearance_kernel(robot)(np.array([beam.radius for beam in robot.beams]), q)
    if status is not None and refuse:
        reject_joints(robot, robot.engine, status, q)
    return gaps


def member_pairs(robot: Robot) -> list[tuple[Beam, Beam]]:
    """Return all pairs of members of different limbs."""
    return [pair for pair in combinations(robot.beams, 2) if pair[0].limb != pair[1].limb]


def _make_clearance_kernel(robot: Robot) -> Kernel:
    if not has_clearance(robot):
        raise ParameterError("members", None, "a section that gives the members' outer diameters")
    ends = [(beam.limb, *((body, point.tolist()) for body, point in (beam.inner, beam.outer))) for beam in robot.beams]

    def write_clearance_program(t: Traced) -> Program:
        """Write the program of the gaps between all pairs of members, modelled as capsules."""
        t.solve()
        segments, radii = {}, {}
        for beam, radius in zip(robot.beams, t.tape.inputs("p", len(robot.beams)), strict=True):
            start, end = (t.motion.point(body, point) for body, point in (beam.inner, beam.outer))
            segments[beam.name], radii[beam.name] = (start, end - start), radius
        gaps = [
            distance(*segments[a.name], *segments[b.name]) - (radii[a.name] + radii[b.name])
            for a, b in member_pairs(robot)
        ]
        outputs = {"clearance": t.lift(gaps)}
        return Program(t.inputs("q"), len(segments), outputs, t.equations())

    return robot.engine.kernel(f"clearance {ends!r}", write_clearance_program)
