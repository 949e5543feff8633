# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The 3-D half of the page: a scene's shapes as viser draws them."""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.graph import BASE
from pkm_twin.view.meshes import read_body_meshes
from pkm_twin.view.scene import (
    BODY_COLOUR,
    GROUND_COLOUR,
    PLATFORM_COLOUR,
    RIGID,
    Deflection,
    Scene,
    choose_anchors,
    make_plate,
    make_round_meshes,
    project_points,
)

ARROW_COLOUR: Final = (0, 158, 115)
MAX_LETTER_PIXELS: Final = (7.4, 19.0)
"""Largest width and height of a letter in a label, pixels."""
VIEW_DIRECTION: Final = np.array([0.62, -0.95, 0.42])
"""Direction from the machine's middle to the initial camera."""


def fit_narrow_window(width: float, height: float) -> float:
    """Return the factor on the camera's distance that fits the machine into a narrow window."""
    return max(1.0, height / width)


class Stage:
    """Draw a machine on a viser server."""

    def __init__(self, server: Any, scene: Scene, q: Array, lowest: float) -> None:
        """Draw the ground below ``lowest``, the smallest z of the platform, m."""
        self._server, self._scene = server, scene
        draw, size, shapes = server.scene, scene.size, scene.shapes(q)
        draw.set_up_direction("+z")
        # Own lights, which show a lit face in its given colour.
        draw.configure_default_lights(False)
        draw.configure_environment_map(None)
        draw.add_light_ambient("/lights/all", intensity=1.5)
        for name, place in (("key", VIEW_DIRECTION * [-0.3, 0.5, 3.0]), ("back", -VIEW_DIRECTION)):
            bright = 1.7 if name == "key" else 0.4
            draw.add_light_directional(
                f"/lights/{name}", intensity=bright, position=tuple(place.tolist()), cast_shadow=name == "key"
            )
        low, high = scene.find_bounds()
        middle, reach = (low + high) / 2, float((high - low).max())
        cell = 10.0 ** np.floor(np.log10(reach))
        draw.add_grid(
            "/grid",
            width=6 * reach,
            height=6 * reach,
            cell_size=cell / 2,
            section_size=cell,
            cell_color=(222, 225, 229),
            section_color=(186, 192, 200),
            fade_distance=7 * reach,
            position=(0.0, 0.0, float(min(low[2], 0.0, lowest)) - 0.06 * size),
            plane_color=(248, 249, 250),
            plane_opacity=1.0,
            shadow_opacity=0.35,
        )
        self._server.on_client_connect(self._fit_camera)
        camera = self._server.initial_camera
        camera.position = tuple((middle + 1.15 * reach * VIEW_DIRECTION).tolist())
        camera.look_at = tuple(middle.tolist())
        camera.up = (0.0, 0.0, 1.0)
        draw.add_frame("/base", **_size_axes(0.12 * size, size))
        graph = scene.robot.graph
        feet = [j.at for j in graph.joints.values() if BASE in (j.inner, j.outer)]
        away = float(np.sign((graph.origin - np.mean(feet, axis=0))[2])) or 1.0
        if len(scene.base):
            draw.add_mesh_simple(
                "/base_plate",
                *make_plate(scene.base - [0.0, 0.0, 0.02 * away * size], 0.03 * size),
                color=(150, 156, 164),
                flat_shading=True,
            )
        self._platform = draw.add_frame("/platform", **_size_axes(0.1 * size, size))
        # A flange and its axis on the platform.
        (round_, faces), _ = make_round_meshes()
        for name, radius, length in (("flange", 0.05, 0.03), ("tool", 0.012, 0.2)):
            shape = size * (round_ * [radius, radius, length] + [0.0, 0.0, away * length / 2])
            draw.add_mesh_simple(f"/platform/{name}", shape, faces, color=BODY_COLOUR)
        self._rest = draw.add_frame("/at_rest", show_axes=False, visible=False)
        self._rest_bars = draw.add_line_segments(
            "/bars_at_rest",
            np.zeros((1, 2, 3)),
            colors=GROUND_COLOUR,
            thickness=1.5,
            thickness_units="screen",
            visible=False,
        )
        if len(scene.platform):
            moving = make_plate(scene.platform, 0.016 * size)
            draw.add_mesh_simple("/platform/plate", *moving, color=PLATFORM_COLOUR, flat_shading=True)
            still = make_plate(scene.platform, 0.01 * size)
            draw.add_mesh_simple("/at_rest/plate", *still, color=(110, 110, 110), opacity=0.35)
        (cylinder, cylinder_faces), (ball, ball_faces) = make_round_meshes()
        self._cylinders = draw.add_batched_meshes_simple(
            "/machine/bars",
            cylinder,
            cylinder_faces,
            shapes.cylinder_turns,
            shapes.cylinder_at,
            batched_scales=shapes.cylinder_sizes,
            lod="off",
            batched_colors=_to_linear(shapes.cylinder_colours),
        )
        turns = np.tile([1.0, 0.0, 0.0, 0.0], (len(shapes.ball_at), 1))
        self._balls = draw.add_batched_meshes_simple(
            "/machine/balls",
            ball,
            ball_faces,
            turns,
            shapes.ball_at,
            batched_scales=shapes.ball_sizes,
            batched_colors=_to_linear(shapes.ball_colours),
            lod="off",
        )
        # The meshes are transparent, so that bars are visible.
        self.meshes = {}
        for k, (body, mesh) in enumerate(read_body_meshes(scene.robot).items()):
            self.meshes[body] = draw.add_frame(f"/meshes/{k}", show_axes=False)
            colour = {BASE: GROUND_COLOUR, scene.robot.graph.platform: PLATFORM_COLOUR}.get(body, BODY_COLOUR)
            draw.add_mesh_simple(f"/meshes/{k}/mesh", *mesh, color=colour, opacity=0.6)
        self._passed: list[Array] = []
        rotates = any(unit == "rad" for unit in scene.robot.pose_units)
        self.gizmo = draw.add_transform_controls(
            "/drag", 0.3 * size, disable_rotations=not rotates, depth_test=False, visible=False
        )
        self._trail = draw.add_line_segments(
            "/trail", np.zeros((1, 2, 3)), colors=ARROW_COLOUR, thickness=0.006 * size, visible=False
        )
        self._named, self._element = True, ""
        self._places: dict[str, Array] = shapes.drives
        self._drives = tuple(self._places)
        self._labels: dict[int, tuple[Any, dict[str, Any]]] = {}
        server.on_client_disconnect(lambda client: self._labels.pop(client.client_id, None))
        self._arrows = draw.add_arrows(
            "/wrench",
            np.zeros((2, 2, 3)),
            _to_linear(np.array([ARROW_COLOUR, (204, 121, 167)])),
            shaft_radius=0.008 * size,
            head_radius=0.02 * size,
            head_length=0.05 * size,
            visible=False,
        )

    async def _fit_camera(self, client: Any) -> None:
        """Fit the camera to the whole machine, now and after each change of the window's size.

        A camera that the visitor has turned or moved stays where it is.
        """
        start = self._server.initial_camera
        middle = np.array(start.look_at)
        begin = np.array(start.position) - middle
        placed: deque[float] = deque(maxlen=16)
        # One label per name, since a browser may show a changed text before its changed position.
        labels = {
            name: client.scene.add_label(f"/names/{k}", name, visible=False)
            for k, name in enumerate(["", *self._drives])
        }
        self._labels[client.client_id] = client.camera, labels

        async def fit_to_window(camera: Any) -> None:
            # Ignore invalid numbers from a browser.
            with contextlib.suppress(ArithmeticError, TypeError, ValueError):
                self._place_labels(camera, labels)
                width, height = camera.image_width, camera.image_height
                # A smaller window is not laid out yet.
                if not min(width, height) >= 100:
                    return
                way, factor = camera.position - camera.look_at, fit_narrow_window(width, height)
                part = float(way @ begin / (begin @ begin))
                ours = any(math.isclose(part, known, rel_tol=1e-3) for known in (1.0, *placed))
                near = 1e-3 * float(np.linalg.norm(begin))
                still = np.allclose(way, part * begin, atol=near)
                still = still and np.allclose(camera.look_at, middle, atol=near)
                if ours and still and not math.isclose(part, factor, rel_tol=1e-3):
                    placed.append(factor)
                    with client.atomic():
                        camera.position, camera.look_at = middle + factor * begin, middle

        client.camera.on_update(fit_to_window)

    def show_meshes(self, shown: bool) -> None:
        """Show or hide the meshes of the robot's file."""
        for frame in self.meshes.values():
            frame.visible = shown

    def draw(
        self, q: Array, moved: Deflection = RIGID, shares: Mapping[str, float] | None = None, dominant: str = ""
    ) -> None:
        """Draw the machine at q (n,), with a deflection that is already enlarged.

        The undeflected platform and bars are drawn in grey. Elements are coloured by their share of
        the strain energy; ``dominant`` gets a label.
        """
        shares = shares or {}
        shapes = self._scene.shapes(q, moved, shares)
        bars, balls = self._cylinders, self._balls
        bars.batched_positions, bars.batched_wxyzs = shapes.cylinder_at, shapes.cylinder_turns
        bars.batched_scales = shapes.cylinder_sizes
        bars.batched_colors = _to_linear(shapes.cylinder_colours)
        balls.batched_positions = shapes.ball_at
        balls.batched_scales = shapes.ball_sizes
        balls.batched_colors = _to_linear(shapes.ball_colours)
        self._platform.position, self._platform.wxyz = shapes.platform_at, shapes.platform_turn
        if self.meshes:
            for body, (at, turn) in self._scene.frames(q, moved).items():
                if body in self.meshes:
                    self.meshes[body].position, self.meshes[body].wxyz = at, turn
        self._places, self._element = dict(shapes.drives), ""
        self._rest.visible = self._rest_bars.visible = moved is not RIGID
        if moved is not RIGID:
            rest = self._scene.shapes(q)
            self._rest.position, self._rest.wxyz = rest.platform_at, rest.platform_turn
            self._rest_bars.points = rest.ends
        if dominant in shapes.places:
            self._element = f"{dominant}: {100 * shares[dominant]:.0f} % of the strain energy"
            self._places = {self._element: shapes.places[dominant]} | self._places
        self._place_all_labels()

    def _place_all_labels(self) -> None:
        for camera, labels in list(self._labels.values()):
            with contextlib.suppress(ArithmeticError, TypeError, ValueError):
                self._place_labels(camera, labels)

    def _place_labels(self, camera: Any, labels: Mapping[str, Any]) -> None:
        """Place the labels of one browser next to their points, without overlaps."""
        texts = [text for text in self._places if self._named or text == self._element]
        points = np.array([self._places[text] for text in texts]).reshape(-1, 3)
        pixels, ahead = project_points(points, camera)
        # The dominant element has priority, then the nearest points.
        order = sorted(range(len(texts)), key=lambda k: (texts[k] != self._element, ahead[k]))
        sizes = np.array([[MAX_LETTER_PIXELS[0] * len(texts[k]) + 8.0, MAX_LETTER_PIXELS[1]] for k in order])
        window = camera.image_width, camera.image_height
        found = choose_anchors(pixels[order], sizes.reshape(-1, 2), window)
        placed = {texts[k]: anchor for k, anchor in zip(order, found, strict=True) if anchor}
        for name, label in labels.items():
            text = name or self._element
            label.visible = text in placed
            if label.visible:
                label.text, label.anchor, label.position = text, placed[text], self._places[text]

    def draw_wrench(self, at: Array, part: Array) -> None:
        """Draw a wrench at the reference point: the force's arrow ends there, the moment's begins.

        :param part: the wrench as a fraction of the largest wrench, (6,), base axes.
        """
        self._arrows.visible = bool(part.any())
        force, moment = 0.4 * self._scene.size * part.reshape(2, 3)
        self._arrows.points = np.array([[at - force, at], [at, at + moment]])

    def show_trail(self, shown: bool) -> None:
        """Show or hide the path of the reference point; it begins at the present position."""
        self._trail.visible, self._passed = shown, []

    def extend_trail(self, at: Array) -> None:
        """Extend the trail to the reference point's present position, (3,) m."""
        passed = self._passed
        if not self._trail.visible or (passed and np.linalg.norm(at - passed[-1]) < 1e-3 * self._scene.size):
            return
        passed.append(at)
        del passed[:-1000]
        if len(passed) > 1:
            self._trail.points = np.stack([passed[:-1], passed[1:]], axis=1)

    def show_drive_names(self, shown: bool) -> None:
        """Show or hide the names of the drives."""
        self._named = shown
        self._place_all_labels()


def _size_axes(length: float, size: float) -> dict[str, float]:
    return {"axes_length": length, "axes_radius": 0.004 * size, "origin_radius": 0.008 * size}


def _to_linear(colours: NDArray[Any]) -> NDArray[np.uint8]:
    """Convert sRGB colours to linear ones, which viser expects for batches."""
    part = np.asarray(colours) / 255.0
    light = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    return np.round(255 * light).astype(np.uint8)
