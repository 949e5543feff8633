# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Frequency response of the tool point in a pose, actuators locked, by damped modes.

The lowest modes of the elastic frame respond dynamically, the others as springs (static residual):
H = sum of p p' / (w^2 - W^2 + 2 i z w W) + (C - sum of p p' / w^2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen.arrays import Array, doubles, one_vector
from pkm_twin.errors import ParameterError, check_limit
from pkm_twin.robot.robot import Robot
from stiffness_monitor.frame import rigid_offset
from stiffness_monitor.modes import ELEMENTS, frame_system, solve_modes, stiffness_root

Complex = NDArray[np.complex128]

DYNAMIC_MODES: Final = 24
"""Modes that respond dynamically; the others respond statically."""
MAX_TOOL_DISTANCE: Final = 10.0
"""Largest distance of a tool point along an axis, over the machine's extent."""
DAMPING_RANGE: Final = (1e-5, 0.99)
"""Valid range of modal damping ratios."""


def responses(at: Array, turn: Array, damping: Array, shapes: Array) -> Complex:
    """Sum the modes' responses p p' / (w^2 - W^2 + 2 i z w W), shape (k, d, d).

    :param at: W, shape (k,), and ``turn``, w, shape (m,), rad/s. ``damping``: z, shape (m,).
    :param shapes: p of unit generalised mass, shape (m, d).
    """
    at = at[:, None]
    gain = 1.0 / (turn**2 - at**2 + 2j * damping * turn * at)
    return np.asarray(np.einsum("km,mi,mj->kij", gain, shapes, shapes))


@dataclass(frozen=True, eq=False)
class ToolModes:
    """Hold modes of a robot in a pose at its tool point, lowest first.

    ``frequencies``: (count,), Hz. ``damping``: ratios (count,). ``shapes``: displacement and
    rotation of the tool point in base axes, of unit generalised mass, (count, 6). ``rest``: static
    compliance of the modes left out, (6, 6). ``rotation``: of the platform, (3, 3).
    """

    frequencies: Array
    damping: Array
    shapes: Array
    rest: Array
    rotation: Array

    def receptance(self, frequencies: ArrayLike) -> Complex:
        """Return displacement per force at frequencies (k,), Hz: (k, 6, 6), m, rad per N, N m."""
        at = doubles(frequencies, "frequencies")
        if at.ndim != 1:
            raise ParameterError("frequencies", at.shape, "one frequency after another")
        for frequency in (at.min(), at.max()) if at.size else ():
            check_limit("frequencies", float(frequency), "Hz", 0.0, 1e6)
        own = 2.0 * np.pi * self.frequencies
        return responses(2.0 * np.pi * at, own, self.damping, self.shapes) + self.rest

    def find_peak_response(self, frequencies: ArrayLike) -> tuple[float, float, Array]:
        """Find the largest dynamic compliance of the tool point between the first and last frequency.

        Returns its frequency, Hz, the compliance, m/N, and its direction (3,), base axes. Peaks
        are checked too: they may be narrower than the steps of the frequencies.
        """
        grid = doubles(frequencies, "frequencies")
        peaks = self.frequencies * np.sqrt(np.maximum(1.0 - 2.0 * self.damping**2, 0.0))
        tried = np.concatenate([grid, peaks[(peaks >= grid[0]) & (peaks <= grid[-1])]])
        _, size, ways = np.linalg.svd(self.receptance(tried)[:, :3, :3])
        k = int(size[:, 0].argmax())
        # Remove the common phase of the complex vector: a direction is real.
        way = ways[k, 0] / np.exp(1j * np.angle(ways[k, 0][np.abs(ways[k, 0]).argmax()]))
        return float(tried[k]), float(size[k, 0]), np.asarray(way.real)

    def respond(self, low: float, high: float, points: int) -> ToolResponse:
        """Compute the translational response to forces at ``points`` frequencies from low to high, Hz.

        :raises ParameterError: the range is empty or negative.
        """
        if not 0.0 <= low < high:
            raise ParameterError("frequencies", f"{low:g},{high:g}", "Hz, 0 or more, rising")
        grid = np.linspace(low, high, points)
        static = self.receptance([0.0])[0, :3, :3].real
        return ToolResponse(grid, self.receptance(grid)[:, :3, :3], static, *self.find_peak_response(grid))


@dataclass(frozen=True, eq=False)
class ToolResponse:
    """Hold the tool point's displacement per force, m/N, base axes.

    ``response``: at ``frequencies`` (k,), Hz, shape (k, 3, 3); ``static``: at rest, (3, 3). The
    response is largest, ``peak``, at ``peak_frequency`` along the unit vector ``direction`` (3,).
    """

    frequencies: Array
    response: Complex
    static: Array
    peak_frequency: float
    peak: float
    direction: Array

    @property
    def amplification(self) -> float:
        """Largest response over the largest static compliance."""
        return self.peak / float(np.linalg.eigvalsh(self.static).max())

    def columns(self) -> dict[str, Array]:
        """Return a table's columns: the frequency, real and imaginary parts of each component."""
        columns = {"frequency": self.frequencies}
        for i, row in enumerate("xyz"):
            for j, column in enumerate("xyz"):
                columns[f"{row}{column}.real"] = self.response[:, i, j].real
                columns[f"{row}{column}.imag"] = self.response[:, i, j].imag
        return columns


def tool_modes(
    robot: Robot,
    pose: ArrayLike,
    *,
    damping: ArrayLike | None = None,
    tool: ArrayLike = (0.0, 0.0, 0.0),
    elements: int = ELEMENTS,
) -> ToolModes:
    """Compute the modes at the tool point.

    Other errors as :func:`~stiffness_monitor.modes.natural_frequencies`.

    :param pose: shape (m,), the mechanism's pose coordinates, m and rad.
    :param damping: ratio of all modes, or of each from the lowest on, the last one of all further
        modes; default the robot file's ``modal_damping``.
    :param tool: from the platform's reference point, platform axes, m.
    :raises ParameterError: no damping is given, a ratio beyond :data:`DAMPING_RANGE`, or a tool point
        farther off than :data:`MAX_TOOL_DISTANCE` times the machine's extent.
    """
    q = robot.inverse(one_vector(pose, len(robot.pose_names), "the pose"))
    system = frame_system(robot, q, elements)
    count = min(DYNAMIC_MODES, len(system.mass))
    ratios = damping_ratios(robot, damping, count)
    frequencies, vectors = solve_modes(system, count, (), vectors=True)
    rotation = robot.platform(q)[1]
    point = one_vector(tool, 3, "the tool point")
    far = MAX_TOOL_DISTANCE * robot.graph.size
    for value in point.tolist():
        check_limit("tool", value, "m", -far, far)
    moved = rigid_offset(rotation @ point)
    shapes = (moved @ vectors[:6]).T
    loads = np.zeros((len(system.mass), 6))
    loads[:6] = moved.T
    whole = loads.T @ scipy.linalg.cho_solve((stiffness_root(system, ()), True), loads)
    rest = whole - (shapes.T / (2.0 * np.pi * frequencies) ** 2) @ shapes
    return ToolModes(frequencies, ratios, shapes, rest, rotation)


def frequency_response(
    robot: Robot,
    pose: ArrayLike,
    frequencies: ArrayLike,
    *,
    damping: ArrayLike | None = None,
    tool: ArrayLike = (0.0, 0.0, 0.0),
) -> Complex:
    """Return the tool point's receptance, actuators locked: displacement per harmonic force.

    :param pose: shape (..., m), the mechanism's pose coordinates, m and rad.
    :param frequencies: shape (k,), Hz.
    :returns: shape (..., k, 6, 6), complex; rows displacement (m) and rotation (rad) of the tool
        point, columns force (N) and moment (N m) there, base axes.

    Other parameters and errors as :func:`tool_modes`.
    """
    poses = np.asarray(pose, np.float64)
    at = np.atleast_1d(doubles(frequencies, "frequencies"))
    found = [
        tool_modes(robot, one, damping=damping, tool=tool).receptance(at) for one in poses.reshape(-1, poses.shape[-1])
    ]
    return np.array(found).reshape(*poses.shape[:-1], len(at), 6, 6)


def damping_ratios(robot: Robot, given: ArrayLike | None, count: int) -> Array:
    """Return the damping ratios of modes, (count,); parameters and errors as :func:`tool_modes`."""
    field = "modal_damping" if given is None else "damping"
    values = np.atleast_1d(doubles(robot.modal_damping if given is None else given, field))
    if not values.size:
        raise ParameterError(field, None, "damping ratios of the modes, in the robot's file or with --damping")
    if values.ndim != 1:
        raise ParameterError(field, values.shape, "one damping ratio after another")
    for value in values.tolist():
        check_limit(field, value, "", *DAMPING_RANGE)
    return values[np.minimum(np.arange(count), len(values) - 1)]
