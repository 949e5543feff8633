# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read elements, numbers and frames of untrusted XML; every error names the field."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Collection, Container, Mapping
from pathlib import Path
from typing import Any, Final
from xml.parsers import expat

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.files import parse_decimal, read_bounded
from pkm_twin.machine.formulas import MAX_SIZE
from pkm_twin.machine.names import plain_name
from pkm_twin.machine.rotations import Pose, from_quaternion, from_rpy

MAX_FILE_SIZE: Final = 4 * 1024 * 1024
"""Largest URDF that is read, bytes."""
MAX_DEPTH: Final = 64
"""Deepest nesting of elements that is read."""
UNLIMITED: Final = {"revolute": 2.0 * math.pi - 1e-6, "prismatic": 10.0, "velocity": 1e6, "effort": 1e6}
"""Limits of this size count as none, because a URDF needs numbers: rad, m, per second, N m or N."""


def parse_xml(path: Path) -> ET.Element:
    """Parse an XML file without a document type, thus without entities; return its top element.

    :raises ParameterError: not readable, too large, too deep, or not well-formed.
    """
    content = read_bounded(path, MAX_FILE_SIZE, "a URDF file")
    builder = ET.TreeBuilder()
    depth = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > MAX_DEPTH:
            raise ParameterError(str(path), "deeply nested elements", f"a nesting of at most {MAX_DEPTH}")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def doctype(*_: object) -> None:
        raise ParameterError(str(path), "<!DOCTYPE", "XML without a document type")

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.StartDoctypeDeclHandler = doctype
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        if isinstance(error, ParameterError):
            raise
        raise ParameterError(str(path), error, "well-formed XML") from None
    return builder.close()


def read_name(element: ET.Element, taken: Container[str]) -> str:
    """Read an element's name, which has to be unique."""
    own = element.get("name")
    kind = element.tag
    if not own:
        raise ParameterError(kind, own, f"every <{kind}> with a name")
    if own in taken:
        raise ParameterError(f"{kind}.{own}", own, "a unique name")
    return own


def free_name(name: str, taken: set[str], more: str = "_") -> str:
    """Choose a free name for a part without a name in the file, and mark it as taken."""
    while name in taken:
        name += more
    taken.add(name)
    return name


def reject_other_children(element: ET.Element | None, where: str, tags: Collection[str]) -> None:
    """Reject child elements with other tags: a misspelt element would be taken for a missing one.

    :raises UnknownNameError: another child; the error names the closest valid tag.
    """
    for child in element if element is not None else ():
        if child.tag not in tags and ":" not in child.tag:
            raise UnknownNameError(where, child.tag, tags)


def find_single_child(element: ET.Element | None, tag: str, where: str) -> ET.Element | None:
    """Find the only child element of a tag; None if there is none, or no element.

    :raises ParameterError: there are several, of which a parser may take any.
    """
    found = [] if element is None else element.findall(tag)
    if len(found) > 1:
        raise ParameterError(f"{where}.{tag}", f"{len(found)} <{tag}> elements", "at most one")
    return found[0] if found else None


def find_link(where: str, name: str, links: Collection[str]) -> str:
    """Find a link by its name, or by the name of the part of a robot file that it was written for.

    :raises UnknownNameError: there is none.
    """
    for known in (name, plain_name(name)):
        if known in links:
            return known
    raise UnknownNameError(where, name, links)


def read_link_reference(element: ET.Element | None, where: str, links: Collection[str]) -> str:
    """Find the link that an element names."""
    link = None if element is None else element.get("link", element.get("name"))
    if link is None:
        raise ParameterError(where, None, "the name of a link")
    if link not in links:
        raise UnknownNameError(where, link, links)
    return link


def read_axis(element: ET.Element, tag: str, where: str) -> Array:
    """Read a unit vector; a missing one is x, as in every URDF."""
    stated = find_single_child(element, tag, where)
    return parse_direction("1 0 0" if stated is None else stated.get("xyz"), f"{where}.{tag}")


def parse_direction(text: str | None, where: str) -> Array:
    """Parse a vector that is not zero, and scale it to length 1; shape (3,)."""
    value = parse_vector(text, where, 3)
    size = float(np.linalg.norm(value))
    if not size > 1e-9:
        raise ParameterError(where, value.tolist(), "a vector that is not zero")
    return value / size


def read_origin(element: ET.Element | None, where: str) -> Pose:
    """Read the frame of an ``<origin>`` or a similar element; the identity without one."""
    if element is None:
        return Pose()
    position = parse_vector(element.get("xyz", "0 0 0"), f"{where}.xyz", 3)
    turned = element.get("quat_xyzw")
    if turned is not None:
        return Pose(rotation_of_quaternion(parse_vector(turned, f"{where}.quat_xyzw", 4), where), position)
    angles = parse_vector(element.get("rpy", "0 0 0"), f"{where}.rpy", 3)
    return Pose(from_rpy(angles), position)


def rotation_of_quaternion(values: Array, where: str) -> Array:
    """Return the rotation of a quaternion x, y, z, w of any length but zero, shape (3, 3)."""
    size = float(np.linalg.norm(values))
    if not size > 1e-9:
        raise ParameterError(f"{where}.quat_xyzw", values.tolist(), "a quaternion that is not zero")
    return from_quaternion(*(values / size).tolist())


def parse_vector(text: str | None, where: str, size: int) -> Array:
    """Parse ``size`` finite numbers, shape (size,)."""
    items = (text or "").split()
    if len(items) != size:
        raise ParameterError(where, text, f"{size} numbers")
    return np.array([parse_number(item, where) for item in items])


def parse_number(text: str | None, where: str, low: float = -math.inf) -> float:
    """Parse a finite number; ``low``: zero if it may not be negative."""
    try:
        value = parse_decimal(text or "")
    except (TypeError, ValueError):
        raise ParameterError(where, text, "a number") from None
    if not math.isfinite(value) or abs(value) > MAX_SIZE:
        raise ParameterError(where, text, "a finite number")
    if value < low:
        raise ParameterError(where, value, "zero or more")
    return value


def read_friction(element: ET.Element, where: str) -> tuple[float, float]:
    """Read the viscous and Coulomb friction of a joint or closure; zero if not stated."""
    for tag in ("dynamics", "joint_properties"):
        dynamics = find_single_child(element, tag, where)
        if dynamics is not None:
            keys = ("damping", "friction")
            viscous, coulomb = (parse_number(dynamics.get(key, "0"), f"{where}.{tag}.{key}", 0.0) for key in keys)
            return viscous, coulomb
    return 0.0, 0.0


def parse_boolean(text: str, where: str) -> bool:
    """Parse a truth value, in the spellings of XML schemas and of Python."""
    value = {"true": True, "1": True, "false": False, "0": False}.get(text.strip().lower())
    if value is None:
        raise ParameterError(where, text, "true or false")
    return value


def read_limits(limit: Mapping[str, str], where: str, kind: str) -> dict[str, Any]:
    """Read stated limits; zero, an empty range and :data:`UNLIMITED` sizes mean no limit."""
    found: dict[str, Any] = {}
    if kind in UNLIMITED and (limit.get("lower") or limit.get("upper")):
        low, high = (parse_limit(limit.get(end, "0"), f"{where}.limit.{end}") for end in ("lower", "upper"))
        if low > high:
            raise ParameterError(f"{where}.limit", [low, high], "lower below upper")
        far = UNLIMITED[kind]
        if low < high and (low > -far or high < far):
            found["position"] = [max(low, -far), min(high, far)]
    for key in ("velocity", "effort"):
        value = parse_limit(limit.get(key, "0"), f"{where}.limit.{key}")
        if value < 0.0:
            raise ParameterError(f"{where}.limit.{key}", value, "zero or more")
        if 0.0 < value < UNLIMITED[key]:
            found[key] = value
    return found


def parse_limit(text: str, where: str) -> float:
    """Parse a limit, the only number that may be infinite."""
    endless = text.strip().lower().lstrip("+-") in ("inf", "infinity")
    return float(text) if endless else parse_number(text, where)
