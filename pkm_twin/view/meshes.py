# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read the meshes of a robot's URDF and place them at home."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import one_line, warn_of_file
from pkm_twin.machine.urdf_file import Visual
from pkm_twin.robot.robot import Robot

MAX_MESH_BYTES: Final = 64 * 1024 * 1024
"""Largest mesh file."""


def read_body_meshes(robot: Robot) -> dict[str, tuple[Array, NDArray[np.int64]]]:
    """Read each body's meshes: corners (k, 3) at home, m, base axes, and triangles (j, 3).

    A mesh that cannot be read is left out with a warning.
    """
    found: dict[str, list[tuple[Array, NDArray[np.int64]]]] = {}
    for visual in robot.visuals:
        try:
            part = _read_mesh(visual)
        except Exception as error:
            # Mesh readers may raise any exception.
            why = one_line(str(error)) or type(error).__name__
            warn_of_file(visual.urdf, f"mesh {visual.mesh!r}: {why}; it is not shown")
        else:
            found.setdefault(visual.body, []).append(part)
    result = {}
    for body, parts in found.items():
        shifts = np.cumsum([0, *(len(corners) for corners, _ in parts[:-1])])
        corners = np.concatenate([corners for corners, _ in parts])
        faces = np.concatenate([f + shift for (_, f), shift in zip(parts, shifts, strict=True)])
        result[body] = corners, faces
    return result


def _find_in_package(package: str, rest: str, folder: Path) -> Iterator[Path]:
    for above in (folder, *folder.parents):
        if above.name == package:
            yield above / rest
        yield above / package / rest
    try:
        from ament_index_python.packages import get_package_share_directory

        yield Path(get_package_share_directory(package)) / rest
    except (ImportError, LookupError, ValueError):
        return


def _read_mesh(visual: Visual) -> tuple[Array, NDArray[np.int64]]:
    import trimesh  # viser needs it as well

    # A mesh's file: a path from the URDF's folder, file:// or package://.
    kind, separator, rest = visual.mesh.partition("://")
    folder = visual.urdf.resolve().parent
    tried: Iterator[Path] = iter((folder / visual.mesh,))
    if separator and kind == "file":
        tried = iter((Path(unquote(rest)),))
    elif separator and kind == "package":
        tried = _find_in_package(*rest.partition("/")[::2], folder)
    path = next((path for path in tried if path.is_file()), None)
    if path is None:
        raise FileNotFoundError("no such file")
    if path.stat().st_size > MAX_MESH_BYTES:
        raise ValueError(f"more than {MAX_MESH_BYTES} bytes")
    mesh: Any = trimesh.load(path, force="mesh")
    corners = np.asarray(mesh.vertices, np.float64) * visual.scale
    faces = np.asarray(mesh.faces, np.int64)
    if not len(faces) or not np.isfinite(corners).all():
        raise ValueError("no triangles, or a corner that is not finite")
    return corners @ visual.pose.rotation.T + visual.pose.position, faces
