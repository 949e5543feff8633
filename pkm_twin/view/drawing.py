# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A picture of a robot at home: the scene of ``pkm-twin view``, drawn without a browser."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.path import Path as Outline

from pkm_twin.codegen.arrays import Array
from pkm_twin.report.plots import pyplot
from pkm_twin.robot.outline import base_line
from pkm_twin.robot.robot import Robot
from pkm_twin.view.scene import ANCHORS, GROUND_COLOUR, PLATFORM_COLOUR, Scene, choose_anchors
from pkm_twin.view.stage import MAX_LETTER_PIXELS, VIEW_DIRECTION

PICTURE_SUFFIXES: Final = (".png", ".svg")
"""Name endings of pictures."""
WIDTH, HEIGHT = 600, 480
DPI: Final = 100
SAMPLES_PER_PIXEL: Final = 2
"""Samples per pixel in each direction, which are averaged."""


class Camera:
    """Parallel projection from :data:`~pkm_twin.view.stage.VIEW_DIRECTION` on a grid of samples.

    Camera coordinates are right, up, and the distance from the camera, m. Nearer shapes cover
    farther ones in any order of drawing.
    """

    def __init__(self, low: Array, high: Array) -> None:
        """Set the corners of the box to show: ``low`` and ``high``, base axes, (3,) m."""
        away = -VIEW_DIRECTION / np.linalg.norm(VIEW_DIRECTION)
        right = np.cross(away, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self.turn = np.array([right, np.cross(right, away), away])
        corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
        seen = self.to_camera(corners)[:, :2]
        middle = (seen.min(0) + seen.max(0)) / 2
        size = np.array([WIDTH, HEIGHT])
        self.pixel = float((np.ptp(seen, axis=0) / (0.86 * size)).max())
        self.low, self.high = middle - self.pixel * size / 2, middle + self.pixel * size / 2
        x, y = (
            np.linspace(a, b, SAMPLES_PER_PIXEL * n)
            for a, b, n in zip(self.low, self.high, (WIDTH, HEIGHT), strict=True)
        )
        self.x, self.y = x, y
        self.depth = np.full((len(y), len(x)), np.inf)
        self.image = np.ones((len(y), len(x), 3))

    def to_camera(self, points: Array) -> Array:
        """Transform base coordinates, (..., 3), to those of the camera."""
        return np.asarray(points @ self.turn.T, np.float64)

    def _find_window(self, points: Array, radius: float) -> tuple[Any, Array, Array]:
        """Return the samples within a radius around the bounding box of points, and their coordinates."""
        (left, low), (right, high) = points[:, :2].min(0) - radius, points[:, :2].max(0) + radius
        columns = slice(*np.searchsorted(self.x, [left, right]))
        rows = slice(*np.searchsorted(self.y, [low, high]))
        x, y = np.meshgrid(self.x[columns], self.y[rows])
        return (rows, columns), x, y

    def _paint(self, window: Any, depth: Array, normal: Array, colour: Any, opacity: float = 1.0) -> None:
        # The light comes from behind the camera, left and above.
        bright = 0.5 + 0.5 * np.clip(normal @ np.array([-0.45, 0.65, -0.61]), 0.0, 1.0)
        nearer = depth < self.depth[window]
        lit = bright[..., None] * np.asarray(colour) / 255.0
        under = self.image[window]
        under[nearer] += opacity * (lit - under)[nearer]
        self.depth[window][nearer] = depth[nearer]

    def draw_ball(self, at: Array, radius: float, colour: Any) -> None:
        """Draw a ball around a point (3,) in base coordinates."""
        (middle,) = self.to_camera(at[None])
        window, x, y = self._find_window(middle[None], radius)
        across = np.stack([x - middle[0], y - middle[1]], -1)
        with np.errstate(invalid="ignore"):
            towards = np.sqrt(radius**2 - (across**2).sum(-1))
        normal = np.concatenate([across, -towards[..., None]], -1) / radius
        self._paint(window, np.nan_to_num(middle[2] - towards, nan=np.inf), normal, colour)

    def draw_cylinder(self, ends: Array, radius: float, colour: Any) -> None:
        """Draw a cylinder between two points (2, 3) in base coordinates, with its lids."""
        start, end = self.to_camera(ends)
        length = float(np.linalg.norm(end - start))
        if not length > 0.0:
            return
        axis = (end - start) / length
        window, x, y = self._find_window(np.array([start, end]), radius)
        ray = np.stack([x, y, np.zeros_like(x)], -1) - start
        along = ray @ axis
        across = ray - along[..., None] * axis
        slope = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
        a, b, c = slope @ slope, across @ slope, (across**2).sum(-1) - radius**2
        with np.errstate(invalid="ignore", divide="ignore"):
            depth = (-b - np.sqrt(b**2 - a * c)) / a
            place = along + depth * axis[2]
            wall = ray + depth[..., None] * [0.0, 0.0, 1.0] - place[..., None] * axis
            good = (place >= 0.0) & (place <= length)
            self._paint(window, np.where(good, depth, np.inf), wall / radius, colour)
            lid = ((0.0 if axis[2] > 0.0 else length) - along) / axis[2]
            good = ((across + lid[..., None] * slope) ** 2).sum(-1) <= radius**2
        facing = np.broadcast_to(-np.sign(axis[2]) * axis, ray.shape)
        self._paint(window, np.where(good, lid, np.inf), facing, colour)

    def draw_plate(self, corners: Array, colour: Any, opacity: float = 1.0) -> None:
        """Draw a flat plate by its corners in base coordinates, shape (k, 3)."""
        corners = self.to_camera(corners)
        middle = corners.mean(0)
        normal = np.linalg.svd(corners - middle)[2][2]
        normal = normal * -np.sign(normal[2])
        if abs(normal[2]) < 1e-3:  # seen from its edge
            return
        window, x, y = self._find_window(corners, 0.0)
        inside = Outline(corners[:, :2]).contains_points(np.stack([x, y], -1).reshape(-1, 2))
        away = ((x - middle[0]) * normal[0] + (y - middle[1]) * normal[1]) / normal[2]
        depth = np.where(inside.reshape(x.shape), middle[2] - away, np.inf)
        self._paint(window, depth, np.broadcast_to(normal, (*x.shape, 3)), colour, opacity)


def draw(robot: Robot, marked: bool = False) -> Any:
    """Draw the robot at home as a matplotlib figure.

    Colours are those of ``pkm-twin view``: drives blue, rods light blue, the platform orange. The
    names of the drives are next to them, the base frame and a scale in the corners.

    :param marked: also draw the bodies' centres of mass and the reference point.
    """
    from matplotlib import patheffects

    scene, q = Scene(robot), robot.inverse(robot.home())
    shapes = scene.shapes(q)
    camera = Camera(*scene.find_bounds())
    sizes = shapes.cylinder_sizes[:, 0]
    for pair, radius, colour in zip(shapes.ends, sizes, shapes.cylinder_colours, strict=True):
        camera.draw_cylinder(pair, float(radius), colour)
    for at, radius, colour in zip(shapes.ball_at, shapes.ball_sizes[:, 0], shapes.ball_colours, strict=True):
        camera.draw_ball(at, float(radius), colour)
    if len(scene.platform):
        camera.draw_plate(scene.platform + shapes.platform_at, PLATFORM_COLOUR)
    if len(scene.base):
        camera.draw_plate(scene.base, GROUND_COLOUR, opacity=0.35)
    elif len(ground := base_line(robot.graph)):
        camera.draw_cylinder(ground, 0.015 * scene.size, GROUND_COLOUR)
    figure = pyplot().figure(figsize=(WIDTH / DPI, HEIGHT / DPI), dpi=DPI)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    extent = (camera.low[0], camera.high[0], camera.low[1], camera.high[1])
    fine = camera.image.reshape(HEIGHT, SAMPLES_PER_PIXEL, WIDTH, SAMPLES_PER_PIXEL, 3)
    ax.imshow(fine.mean((1, 3)), origin="lower", extent=extent, interpolation="nearest")
    ax.axis("off")
    halo = patheffects.withStroke(linewidth=3, foreground="w")
    style: dict[str, Any] = {"fontsize": 9, "path_effects": [halo], "ha": "center"}
    points = camera.to_camera(np.array(list(shapes.drives.values())))[:, :2]
    sizes = np.array([[MAX_LETTER_PIXELS[0] * len(name) + 8.0, MAX_LETTER_PIXELS[1]] for name in shapes.drives])
    down = np.array([1.0, -1.0])
    spots = down * (points - [camera.low[0], camera.high[1]]) / camera.pixel
    found = choose_anchors(spots, sizes, (WIDTH, HEIGHT))
    for name, point, size, anchor in zip(shapes.drives, points, sizes, found, strict=True):
        if anchor:
            at = point + camera.pixel * down * size / 2 * ANCHORS[anchor]
            ax.text(*at, name, va="center", **style)
    # The axes of the base frame at the left, a scale at the right.
    start = camera.low + 45 * camera.pixel
    for name, colour, axis in zip("xyz", ((213, 60, 40), (40, 140, 60), (40, 80, 200)), np.eye(3), strict=True):
        tip = start + 32 * camera.pixel * camera.to_camera(axis)[:2]
        ax.annotate("", tip, start, arrowprops={"arrowstyle": "-|>", "color": np.array(colour) / 255, "linewidth": 1.5})
        at = start + 42 * camera.pixel * camera.to_camera(axis)[:2]
        ax.text(*at, name, va="center", **style)
    reach = 0.25 * (camera.high[0] - camera.low[0])
    length = max(
        part * 10.0 ** np.floor(np.log10(reach))
        for part in (1, 2, 5)
        if part * 10.0 ** np.floor(np.log10(reach)) <= reach
    )
    right, low = camera.high[0] - 25 * camera.pixel, camera.low[1] + 22 * camera.pixel
    ax.plot([right - length, right], [low, low], color="k", linewidth=2)
    ax.text(right - length / 2, low + 8 * camera.pixel, f"{length:g} m", **style)
    if marked:
        masses = [body.com for body in robot.graph.bodies.values() if body.mass > 0.0]
        for places, marker, name in (
            (masses, "o", "centre of mass of a body"),
            ([robot.graph.origin], "X", "reference point"),
        ):
            seen = camera.to_camera(np.reshape(places, (-1, 3)))[:, :2]
            ax.plot(*seen.T, marker, label=name, color="w", markeredgecolor="k", markersize=8)
        ax.legend(loc="upper left", fontsize=9, frameon=False)
        ax.set(xlim=(camera.low[0], camera.high[0]), ylim=(camera.low[1], camera.high[1]))
    return figure
