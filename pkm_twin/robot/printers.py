# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read the logs and configurations of linear Delta printers, and write their configurations.

Formats by the documentation of Klipper (``[delta_calibrate]``), Marlin (G33, M665, M666),
RepRapFirmware (G32, height maps, M665, M666) and Smoothieware (G29.1).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.files import parse_decimal
from pkm_twin.robot.robot import Robot

TOWER_ANGLES: Final = np.array([210.0, 330.0, 90.0])
"""Nominal angles of the towers, degrees."""
G33_ANGLES: Final = {"x": 210, "y": 330, "z": 90, "yz": 30, "zx": 150, "xy": 270}
"""Angles of the points that G33 reports, degrees; c is the centre."""
_NUMBER: Final = r"[-+]?\d*\.?\d+"
_G33: Final = re.compile(rf"\b(c|xy|yz|zx|x|y|z)\s*:\s*({_NUMBER})")


class Firmware(StrEnum):
    """The firmware of a printer."""

    KLIPPER = "klipper"
    MARLIN = "marlin"
    REPRAPFIRMWARE = "reprapfirmware"
    SMOOTHIEWARE = "smoothieware"


@dataclass(frozen=True, eq=False)
class Printer:
    """A printer's geometry and probed points: mm, degrees.

    ``ends``: height of each carriage's rod ends above the bed at its endstop, shape (3,). ``heights``:
    positions of the carriages below their endstops, negative, and the nozzle's height, (k, 4).
    ``distances``: positions of the carriages at two points, and their distance, (d, 7).
    """

    radius: float
    angles: Array
    arms: Array
    ends: Array
    heights: Array
    distances: Array

    def yaml(self, head: str) -> str:
        """Write the robot file; joint positions are those of the carriages below their endstops, m."""
        numbers = [f"{value:.9g}" for value in np.radians(self.angles)]
        arms = [f"{value / 1e3:.9g}" for value in self.arms]
        lines = [
            f"# {head}",
            "# Masses are not the printer's: set them before computing forces.",
            "mechanism: linear_delta",
            "geometry:",
            f"  radius: {self.radius / 1e3:.9g}",
            f"  angles: [{', '.join(numbers)}]",
            f"  arm_lengths: [{', '.join(arms)}]",
            "inertia: {platform_mass: 0.3, carriage_mass: 0.2, rod_mass: 0.02}",
            "joint_map:",
        ]
        ends = zip("abc", self.ends, strict=True)
        lines += [f"  stepper_{limb}: {{offset: {-end / 1e3:.9g}}}" for limb, end in ends]
        return "\n".join([*lines, ""])

    def table(self) -> str:
        """Write the measurements as a CSV for ``calibrate``, m."""
        names = [f"stepper_{limb}.position" for limb in "abc"]
        high, paired = len(self.heights) > 0, len(self.distances) > 0
        head = [*names, *(f"{name}_2" for name in names if paired), *["height"] * high, *["distance"] * paired]
        heights, distances = ([[f"{v:.9g}" for v in row] for row in t / 1e3] for t in (self.heights, self.distances))
        rows = [[*row[:3], *[""] * 3 * paired, row[3], *[""] * paired] for row in heights]
        rows += [[*row[:6], *[""] * high, row[6]] for row in distances]
        return "\n".join([",".join(head), *(",".join(row) for row in rows), ""])


def convert_to_printer(robot: Robot) -> Printer:
    """Return the printer of a robot file, rotated so that its third tower is at 90 degrees.

    :raises ParameterError: not a linear Delta, leaning towers, or joints with a ratio.
    """
    if robot.mechanism != "linear_delta":
        raise ParameterError(
            f"{robot.name}: mechanism", robot.mechanism, "linear_delta, as in a file that `pkm-twin convert` writes"
        )
    g: Any = vars(robot)["geometry"]
    own = robot.controller
    if g.leans is not None and np.any(g.leans):
        raise ParameterError("geometry.leans", g.leans.tolist(), "0, because no firmware supports them")
    if not (own.factors == 1.0).all():
        raise ParameterError("joint_map", own.factors.tolist(), "ratios and signs of 1")
    angles = np.degrees(g.angles)
    angles = (angles - angles[2] + TOWER_ANGLES[2]) % 360.0
    none = np.zeros((0, 4))
    return Printer(1e3 * g.radius, angles, 1e3 * g.arm_lengths, -1e3 * own.offsets, none, none)


def write_configuration(printer: Printer, firmware: Firmware) -> str:
    """Write the lines of a firmware's configuration."""
    radius, arms = printer.radius, printer.arms
    above = printer.ends - _find_carriage_heights(arms, radius, "geometry.arm_lengths")
    if firmware is Firmware.KLIPPER:
        lines = ["[printer]", f"delta_radius: {radius:.6f}"]
        for k, limb in enumerate("abc"):
            lines += [
                "",
                f"[stepper_{limb}]",
                f"angle: {printer.angles[k]:.6f}",
                f"arm_length: {arms[k]:.6f}",
                f"position_endstop: {above[k]:.6f}",
            ]
        return "\n".join([*lines, ""])
    trims = (printer.angles - TOWER_ANGLES + 180.0) % 360.0 - 180.0
    turned = " ".join(f"{axis}{trim:.4f}" for axis, trim in zip("XYZ", trims, strict=True))
    if firmware is Firmware.REPRAPFIRMWARE:
        height = float(above.mean())
        stops, rods = above - height, ":".join(f"{arm:.4f}" for arm in arms)
        first = f"M665 L{rods} R{radius:.4f} H{height:.4f} {turned}"
    elif firmware is Firmware.MARLIN:
        height, rod = float(above.min()), float(arms.mean())
        stops = height - above
        each = " ".join(f"{axis}{arm - rod:.4f}" for axis, arm in zip("ABC", arms, strict=True))
        first = f"M665 L{rod:.4f} R{radius:.4f} H{height:.4f} {turned} {each}"
    else:
        raise ParameterError("--firmware", firmware.value, "klipper, marlin or reprapfirmware")
    second = " ".join(f"{axis}{stop:.4f}" for axis, stop in zip("XYZ", stops, strict=True))
    return f"{first}\nM666 {second}\n"


def read_printer(text: str, firmware: Firmware | None, probe_radius: float | None) -> Printer:
    """Read a printer from its configuration and probe tables, in one text.

    :param probe_radius: of G33's points, mm, where no M665 B gives it.
    :raises ParameterError: the geometry or the probings are missing.
    """
    if firmware is None and re.search(r"^[^\w\n]*\[(printer|delta_calibrate|stepper_a)\]", text, re.M):
        firmware = Firmware.KLIPPER
    elif firmware is None and re.search(r"bed probe heights|height map|^[ \t]*G30\s+P\d", text, re.M | re.I):
        firmware = Firmware.REPRAPFIRMWARE
    elif firmware is None:
        table = re.search(r"G33|M666 X-?[\d.]+ Y", text) and _G33.search(text)
        smooth = not table and ("G29.1" in text or "G32" in text)
        firmware = Firmware.SMOOTHIEWARE if smooth else Firmware.MARLIN
    if firmware is Firmware.KLIPPER:
        return _read_klipper(text)
    m665, m666 = _read_words(text, "M665"), _read_words(text, "M666")
    for word, what in (("L", "rod length"), ("R", "radius")):
        if word not in m665:
            raise ParameterError(f"M665 {word}", None, f"M665 with {word}, the {what}, in the log")
    arms, radius = np.resize(m665["L"], 3), m665["R"][0]
    trims = np.array([m666.get(axis, [0.0])[0] for axis in "XYZ"])
    angles, height = TOWER_ANGLES.copy(), m665.get("H", [0.0])[0]
    if firmware is Firmware.SMOOTHIEWARE:
        height = m665.get("Z", [0.0])[0]
    else:
        angles += [m665.get(axis, [0.0])[0] for axis in "XYZ"]
    if firmware is Firmware.MARLIN:
        arms = arms + [m665.get(axis, [0.0])[0] for axis in "ABC"]
    sign = 1.0 if firmware is Firmware.REPRAPFIRMWARE else -1.0
    ends = height + _find_carriage_heights(arms, radius, "M665 L") + sign * trims
    points = _read_points(text, firmware, probe_radius or m665.get("B", [0.0])[0])
    turned = np.radians(angles)
    towers = radius * np.stack([np.cos(turned), np.sin(turned)], -1)
    away = np.sum((points[:, None, :2] - towers) ** 2, -1)
    if not (away < arms**2).all():
        raise ParameterError("probe points", None, "points that the rods reach, mm")
    carriages = points[:, 2:] + np.sqrt(arms**2 - away)
    heights = np.column_stack([carriages - ends, np.zeros(len(points))])
    return Printer(radius, angles, arms, ends, heights, np.zeros((0, 7)))


def _find_carriage_heights(arms: Array, radius: float, where: str) -> Array:
    """Return the height of the carriages above the nozzle at the centre, mm, shape (3,).

    :raises ParameterError: an arm does not reach the centre.
    """
    if not 0.0 < radius < arms.min():
        raise ParameterError(where, float(arms.min()), f"arms longer than the radius, {radius:g} mm (above 0)")
    return np.sqrt(arms**2 - radius**2)


def _read_words(text: str, code: str) -> dict[str, list[float]]:
    """Read the numbers by letter in all lines of a G-code; later lines replace earlier numbers."""
    found: dict[str, list[float]] = {}
    for line in re.findall(rf"\b{code}\b([^;\n]*)", text):
        for letter, values in re.findall(rf"([A-Z])\s*({_NUMBER}(?::{_NUMBER})*)", line):
            found[letter] = [float(value) for value in values.split(":")]
    return found


def _read_points(text: str, firmware: Firmware, radius: float) -> Array:
    """Read the probed points and their heights, mm, (k, 3).

    :raises ParameterError: there are none, or their positions are unknown.
    """
    found: list[tuple[float, float, float]] = []
    heights = re.findall(r"bed probe heights:((?:\s+" + _NUMBER + r")+)", text, re.I)
    rows = list(_read_height_map(text))
    if firmware is Firmware.MARLIN and re.search(r"\bc\s*:", text):
        seen: set[str] = set()
        for name, value in _G33.findall(text[re.search(r"\bc\s*:", text).start() :]):  # type: ignore[union-attr]
            # Only the first table: later ones were probed with other parameters.
            if name in seen:
                break
            seen.add(name)
            if name != "c" and not radius > 0.0:
                raise ParameterError("--probe-radius", None, "the radius of G33's points, mm")
            turn = np.radians(G33_ANGLES.get(name, 0))
            away = 0.0 if name == "c" else radius
            found.append((away * np.cos(turn), away * np.sin(turn), float(value)))
    elif firmware is Firmware.MARLIN and "G33" in text:
        raise ParameterError("G33", "no table of points", "a log of `G33 V3`, which prints one")
    elif heights:
        # Within one line, since a search across lines would take quadratic time.
        point = rf"^[ \t]*G30\s+P\d+\s+X({_NUMBER})\s*Y({_NUMBER})"
        places, values = re.findall(point, text, re.M), heights[0].split()
        if len(places) < len(values):
            raise ParameterError("G30 P", len(places), f"a line `G30 Pn Xx Yy` for each of {len(values)} heights")
        found = [(float(x), float(y), float(z)) for (x, y), z in zip(places, values, strict=False)]
    elif rows:
        found = rows
    else:
        point = r"\b" + r"[,\s]+".join(rf"{axis}[:=]?\s*({_NUMBER})" for axis in "XYZ")
        for line in text.splitlines():
            match = re.search(point, line)
            if match and not re.match(r"\W*[GM]\d", line):
                found.append((float(match[1]), float(match[2]), float(match[3])))
    if len(found) < 3:
        raise ParameterError("probe table", f"{len(found)} points", "at least 3 probed points")
    return np.array(found)


def _read_height_map(text: str) -> Iterator[tuple[float, float, float]]:
    """Read the probed points of RepRapFirmware's heightmap.csv."""
    lines = text.splitlines()
    heads = (k for k, line in enumerate(lines) if line.startswith(("xmin,", "axis0,")))
    start = next(heads, None)
    if start is None:
        return
    names = [name.strip() for name in lines[start].split(",")]
    given = dict(zip(names, lines[start + 1].split(","), strict=False))
    keys = ("xmin", "ymin", "xspacing", "yspacing")
    keys = keys if "xmin" in given else ("min0", "min1", "spacing0", "spacing1")
    x0, y0, dx, dy = (float(given.get(key, given.get("spacing", "nan"))) for key in keys)
    for row, line in enumerate(lines[start + 2 :]):
        for column, cell in enumerate(line.split(",")):
            # A point outside the radius is not probed and written as 0.
            if cell.strip() not in ("", "0"):
                yield x0 + column * dx, y0 + row * dy, float(cell)


def _read_klipper(text: str) -> Printer:
    """Read a printer.cfg, with the block that SAVE_CONFIG appends.

    :raises ParameterError: an entry is missing.
    """
    sections: dict[str, dict[str, str]] = {}
    name = ""
    for raw in text.splitlines():
        line = raw.removeprefix("#*#").split("#")[0].split(";")[0].strip()
        header = re.fullmatch(r"\[([^\]]+)\]", line)
        entry = re.match(r"([\w.]+)\s*[:=]\s*(.*)", line)
        if header:
            name = header[1].strip()
        elif entry and entry[2]:
            sections.setdefault(name, {})[entry[1]] = entry[2].strip()
    steppers = [sections.get(f"stepper_{limb}", {}) for limb in "abc"]

    def read_stepper_value(stepper: int, key: str, default: float | None = None) -> float:
        # Steppers b and c default to the entries of stepper_a.
        value = steppers[stepper].get(key, steppers[0].get(key))
        if value is None and default is None:
            raise ParameterError(f"[stepper_{'abc'[stepper]}] {key}", None, "a value")
        return default if value is None else _read_number(value, key)  # type: ignore[return-value]

    kind = sections.get("printer", {}).get("kinematics", "delta")
    if kind != "delta":
        raise ParameterError("[printer] kinematics", kind, "delta, a linear Delta printer")
    if "delta_radius" not in sections.get("printer", {}):
        raise ParameterError("[printer] delta_radius", None, "a linear Delta's radius, mm")
    radius = _read_number(sections["printer"]["delta_radius"], "delta_radius")
    arms = np.array([read_stepper_value(k, "arm_length") for k in range(3)])
    angles = np.array(
        [_read_number(s["angle"], "angle") if "angle" in s else a for s, a in zip(steppers, TOWER_ANGLES, strict=True)]
    )
    ends = np.array([read_stepper_value(k, "position_endstop") for k in range(3)])
    ends = ends + _find_carriage_heights(arms, radius, "arm_length")
    steps = np.array([_find_step_length(read_stepper_value, steppers, k) for k in range(3)])
    stored = sections.get("delta_calibrate", {})

    def read_carriage_positions(key: str) -> list[float]:
        """Convert the three step counts of an entry to carriage positions, mm."""
        values = [_read_number(value, key) for value in stored[key].split(",")]
        if len(values) != 3:
            raise ParameterError(f"[delta_calibrate] {key}", len(values), "3 step counts")
        return [float(v) for v in -np.array(values) * steps]

    heights = [
        [*read_carriage_positions(f"{key}_pos"), _read_number(stored[key], key)]
        for key in stored
        if re.fullmatch(r"(manual_)?height\d+", key) and f"{key}_pos" in stored
    ]
    distances = [
        [
            *read_carriage_positions(f"{key}_pos1"),
            *read_carriage_positions(f"{key}_pos2"),
            _read_number(stored[key], key),
        ]
        for key in stored
        if re.fullmatch(r"distance\d+", key) and f"{key}_pos1" in stored
    ]
    if not heights and not distances:
        raise ParameterError("[delta_calibrate]", None, "height0, height0_pos ...: run DELTA_CALIBRATE, SAVE_CONFIG")
    shapes = np.array(heights).reshape(-1, 4), np.array(distances).reshape(-1, 7)
    return Printer(radius, angles, arms, ends, *shapes)


def _find_step_length(read_stepper_value: Callable[..., float], steppers: list[dict[str, str]], k: int) -> float:
    """Return the carriage's travel per step, mm."""
    if "step_distance" in {**steppers[0], **steppers[k]}:
        return float(read_stepper_value(k, "step_distance"))
    gear = steppers[k].get("gear_ratio", steppers[0].get("gear_ratio", "1:1"))
    turns = 1.0
    for pair in gear.split(","):
        driven, _, driving = pair.partition(":")
        turns *= _read_number(driven, "gear_ratio") / _read_number(driving or "1", "gear_ratio")
    full = read_stepper_value(k, "full_steps_per_rotation", 200.0)
    return float(read_stepper_value(k, "rotation_distance") / (full * read_stepper_value(k, "microsteps") * turns))


def _read_number(text: str, key: str) -> float:
    try:
        return parse_decimal(text)
    except ValueError:
        raise ParameterError(key, text, "a number") from None
