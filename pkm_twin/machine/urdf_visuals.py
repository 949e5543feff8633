# SPDX-License-Identifier: Apache-2.0
"""Meshes that a URDF's links are drawn with: their names and places; nothing else of visuals."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, warn
from pkm_twin.machine import urdf_xml
from pkm_twin.machine.rotations import Pose


@dataclass(frozen=True, eq=False)
class Visual:
    """A mesh of a body: the name that the URDF ``urdf`` gives it, ``scale`` (3,), and its place.

    ``pose``: of the mesh's frame at home, base axes.
    """

    urdf: Path
    mesh: str
    body: str
    scale: Array
    pose: Pose


def visuals(
    path: Path, robot: ET.Element, places: Mapping[str, Pose], bodies: Mapping[str, str]
) -> Iterator[Visual]:
    """Meshes of all links; an invalid one is left out with a warning.

    :param places: of the links at home, base axes; ``bodies``: the body of each link.
    """
    for link in robot.findall("link"):
        name = link.get("name", "")
        for number, visual in enumerate(link.findall("visual")):
            mesh = visual.find("geometry/mesh")
            if mesh is None:
                continue
            where = f"link.{name}.visual.{number}"
            try:
                pose = urdf_xml.origin(urdf_xml.single(visual, "origin", where), where)
                scale = urdf_xml.vector(mesh.get("scale", "1 1 1"), f"{where}.scale", 3)
                if not mesh.get("filename"):
                    raise ParameterError(f"{where}.filename", None, "the file of the mesh")
            except ParameterError as error:
                warn(path, f"{error}; this mesh is not shown")
                continue
            file = str(mesh.get("filename"))
            yield Visual(path, file, bodies[name], scale, places[name] @ pose)
