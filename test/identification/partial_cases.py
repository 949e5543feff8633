# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulated partial measurements, and a printer's kinematics by trilateration alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from pkm_twin import Robot
from pkm_twin.codegen.arrays import Array
from pkm_twin.identification.calibration import list_geometric_paths
from pkm_twin.identification.measurements import Measured, make_measured
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.support.robots import random_joints

NOISE = {
    **dict.fromkeys(("height", "plane"), 2e-5),
    **dict.fromkeys(("radius", "range"), 1e-5),
    **dict.fromkeys(("x", "y", "z", "distance"), 5e-5),
    **dict.fromkeys(("roll", "pitch", "yaw"), 3e-4),
}
OFF = 1e-3
"""By which a machine's lengths are not as drawn, m; angles by as much at its platform's radius."""


class Case(NamedTuple):
    """A machine as drawn, what was measured of the real one, and the real one's numbers."""

    drawn: Robot
    measured: Measured
    paths: tuple[str, ...]
    truth: dict[str, float]


def case(drawn: Robot, kinds: Sequence[str], count: int, seed: int, flat: bool = False) -> Case:
    """A machine that was not built as drawn, measured with noise.

    :param flat: with the platform at home's height, as on a printer's bed.
    """
    rng = np.random.default_rng(seed)
    if drawn.limits.position is None:
        box = np.array([0.6, 0.6, 0.0 if flat else 0.4]) * drawn.size
        q = drawn.inverse(drawn.home() + rng.uniform(-box, box, (count, 3)))
    else:
        q = random_joints(drawn, rng, count)
    read = np.asarray(drawn.controller.controller_positions(q))
    paths = list_geometric_paths(drawn, q)
    truth = {}
    for path in paths:
        turned = any(word in path for word in ("axis", "axes", "angle", "azimuth"))
        size = OFF / drawn.size if turned else OFF
        truth[path] = drawn.number(path) + float(rng.normal(scale=size))
    real = drawn.with_file_values(truth)
    scales = [OFF if unit == "m" else OFF / drawn.size for unit in drawn.joint_units]
    offsets = rng.normal(size=len(scales)) * scales
    names = zip(drawn.joint_names, drawn.controller.offsets + offsets, strict=True)
    truth |= {f"joint_map.{name}.offset": float(offset) for name, offset in names}
    position, rotation = real.platform(q - offsets)
    angles = Rotation.from_matrix(rotation).as_euler("xyz")
    normal = np.array([0.01, -0.02, 1.0]) / np.linalg.norm([0.01, -0.02, 1.0])
    centre = position.mean(0) - [0.02, 0.01, 0.3]
    other = np.roll(np.arange(count), 1)
    columns = dict(zip(("x", "y", "z"), position.T, strict=True))
    columns |= dict(zip(("roll", "pitch", "yaw"), angles.T, strict=True))
    columns |= {
        "height": position[:, 2],
        "plane": position @ normal - 0.05,
        "radius": np.linalg.norm(position - centre, axis=1),
        "range": np.linalg.norm(position - [1.5, -2.0, 0.8], axis=1) - 2.3,
        "distance": np.linalg.norm(position - position[other], axis=1),
    }
    values = {kind: columns[kind] + rng.normal(scale=NOISE[kind], size=count) for kind in kinds}
    second = read[other] if "distance" in kinds else None
    return Case(drawn, make_measured(read, second, values, np.arange(count) + 2, {}), paths, truth)


class Towers(NamedTuple):
    """A printer's numbers, mm and rad; ``ends``: carriages at their endstops."""

    radius: float
    angles: Array
    arms: Array
    ends: Array

    def nozzle(self, travel: Array, lean: Array | None = None) -> Array:
        """Where three spheres about the rods' upper ends meet, below, (k, 3).

        :param travel: carriages below their endstops, (k, 3). ``lean``: of each tower, (3, 2).
        """
        place = self.radius * np.stack([np.cos(self.angles), np.sin(self.angles)], -1)
        height = self.ends - travel
        tops = np.concatenate([np.broadcast_to(place, (len(travel), 3, 2)), height[..., None]], -1)
        if lean is not None:
            tops[..., :2] += lean * height[..., None]
        a, b, c = tops[:, 0], tops[:, 1], tops[:, 2]
        length = np.linalg.norm(b - a, axis=1)
        ex = (b - a) / length[:, None]
        i = np.sum(ex * (c - a), 1)
        ey = c - a - i[:, None] * ex
        j = np.linalg.norm(ey, axis=1)
        ey /= j[:, None]
        squares = self.arms**2
        x = (squares[0] - squares[1] + length**2) / (2 * length)
        y = (squares[0] - squares[2] + i**2 + j**2 - 2 * i * x) / (2 * j)
        z = np.sqrt(squares[0] - x**2 - y**2)
        ez = np.cross(ex, ey)
        ez *= -np.sign(ez[:, 2:])
        return np.asarray(a + x[:, None] * ex + y[:, None] * ey + z[:, None] * ez)

    def travel(self, places: Array) -> Array:
        """Of carriages to places, (k, 3)."""
        tower = self.radius * np.stack([np.cos(self.angles), np.sin(self.angles)], -1)
        away = np.sum((places[:, None, :2] - tower) ** 2, -1)
        return np.asarray(self.ends - places[:, 2:] - np.sqrt(self.arms**2 - away))

    def robot(self) -> Robot:
        """The same as a robot file."""
        offsets = {f"stepper_{k}": {"offset": -e / 1e3} for k, e in zip("abc", self.ends)}  # noqa: B905
        return robot_of_data(
            {
                "mechanism": "linear_delta",
                "geometry": {
                    "radius": self.radius / 1e3,
                    "angles": self.angles.tolist(),
                    "arm_lengths": (self.arms / 1e3).tolist(),
                },
                "inertia": {"platform_mass": 0.3, "carriage_mass": 0.2},
                "joint_map": offsets,
            },
            "printer",
        )


def published(start: Towers, travel: Array, pairs: tuple[Array, Array, Array] | None) -> tuple[Towers, float, Array]:
    """Klipper's calibration: least squares of heights, and of distances where there are some.

    Heights alone: radius, two angles, three endstops; with distances three arm lengths too. Written
    from its documentation; its coordinate descent seeks the same least sum.

    :returns: the printer, the root mean square of its heights, the distances' residuals, mm.
    """

    def of(v: Array) -> Towers:
        arms = start.arms if pairs is None else v[6:9]
        angles = np.append(v[1:3], start.angles[2])
        # An endstop is stored as the nozzle's height there.
        ends = v[3:6] + np.sqrt(arms**2 - v[0] ** 2)
        return Towers(float(v[0]), angles, arms, ends)

    def distances(t: Towers) -> Array:
        if pairs is None:
            return np.zeros(0)
        first, second, lengths = pairs
        return np.linalg.norm(t.nozzle(first) - t.nozzle(second), axis=1) - lengths

    def residual(v: Array) -> Array:
        t = of(v)
        far = distances(t)
        # The documented weight of heights: half of the distances' number over their own.
        weight = 1.0 if pairs is None else np.sqrt(len(far) / (0.5 * len(travel)))
        return np.concatenate([weight * t.nozzle(travel)[:, 2], far])

    above = start.ends - np.sqrt(start.arms**2 - start.radius**2)
    first = np.concatenate([[start.radius], start.angles[:2], above])
    first = first if pairs is None else np.concatenate([first, start.arms])
    found = of(least_squares(residual, first, x_scale="jac", xtol=1e-12, ftol=1e-12).x)
    heights = found.nozzle(travel)[:, 2]
    return found, float(np.sqrt(np.mean(heights**2))), distances(found)
